"""Where the files that come with the package lie."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def asset_path(name: str) -> Path:
    """Path of a file that comes with the package.

    An installed wheel holds them in ``hasm_torch/assets``, a checkout in ``assets`` beside it.

    Args:
        name: file name, such as ``"hsr.urdf"`` or ``"skin.json"``.

    Returns:
        Path of the existing file.

    Raises:
        FileNotFoundError: no such file; the message lists those that exist.
    """
    folders = [_PACKAGE / "assets", _PACKAGE.parent / "assets"]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    found = sorted({f.name for d in folders if d.is_dir() for f in d.iterdir() if f.is_file()})
    raise FileNotFoundError(f"no asset named {name!r}; there are: {', '.join(found) or 'none'}")
