"""Where taught things are kept: datasets and checkpoints in one folder, by name."""

import re
from pathlib import Path

KINDS = ("checkpoint", "dataset")
_MARKS = {"checkpoint": "config.json", "dataset": "meta/info.json"}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class Shelf:
    """A folder of datasets and checkpoints.

    Args:
        root: The folder; made when something is put there.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def place(self, kind: str, name: str) -> Path:
        """Folder of one thing.

        Args:
            kind: "checkpoint" or "dataset".
            name: Its name: letters, digits, _ and -, so that nothing is ever written elsewhere.

        Raises:
            ValueError: It cannot be called so.
        """
        if kind not in KINDS:
            raise ValueError(f"expected one of {KINDS}, got {kind!r}")
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"a name has 1 to 64 letters, digits, _ or - and begins with a letter or digit, "
                f"got {name[:80]!r}"
            )
        return self.root / f"{kind}s" / name

    def things(self) -> list[tuple[str, str]]:
        """Kind and name of all that is there."""
        found = []
        for kind in KINDS:
            folders = sorted((self.root / f"{kind}s").glob("*"))
            found += [
                (kind, folder.name)
                for folder in folders
                if (folder / _MARKS[kind]).is_file() and _NAME.fullmatch(folder.name)
            ]
        return found
