"""Drawing without a display."""

import ctypes.util
import os
import sys


def prefer_egl() -> None:
    """Let MuJoCo draw by EGL where there is no display and no other choice was made.

    MuJoCo chooses its OpenGL backend when it is first imported, so this comes before any import
    that may bring it in (pytorch-kinematics does).
    """
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not display and ctypes.util.find_library("EGL"):
        os.environ.setdefault("MUJOCO_GL", "egl")
