"""Which extra of the package brings a library that is not installed."""

from importlib.util import find_spec

EXTRAS = {
    "fast": ("numba",),
    "robot": (
        "pytorch_kinematics",
        "safetensors",
        "huggingface_hub",
        "draccus",
        "tqdm",
        "pyarrow",
    ),
    "sim": ("mujoco", "gymnasium"),
    "viz": ("matplotlib", "PIL", "av", "rerun"),
    "lerobot": ("lerobot",),
    "touch": ("viser",),
    "ros": ("rosbags", "rclpy"),
}


def require(extra: str) -> None:
    """Check that the libraries of an extra are installed.

    Args:
        extra: Its name, a key of ``EXTRAS``.

    Raises:
        ModuleNotFoundError: If one is missing; the message says how to install it.
    """
    for name in EXTRAS[extra]:
        if find_spec(name) is None:
            raise ModuleNotFoundError(
                f'{name} is not installed: pip install "hasm-torch[{extra}]"', name=name
            )
