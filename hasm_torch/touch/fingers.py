"""The two fingers of the person at the page: one that follows the mouse, and pinned ones."""

from typing import NamedTuple

import numpy as np

from hasm_torch.sim.env import LARGEST_FORCE
from hasm_torch.sim.scene import FINGERS


class Push(NamedTuple):
    """What a finger does to a patch.

    Attributes:
        patch: The patch.
        cell: Cell of the patch; None: its centre.
        force: N.
        pinned: Whether it stays when the mouse is let go.
    """

    patch: str
    cell: int | None
    force: float
    pinned: bool


class Fingers:
    """Pushes by patch, as many at once as there are fingers.

    Args:
        patches: Names of the patches that there are.
    """

    def __init__(self, patches: tuple[str, ...]) -> None:
        self._patches = patches
        self._pushes: dict[str, Push] = {}

    @property
    def pushes(self) -> list[Push]:
        """What the fingers do, the one that was put down first in front."""
        return list(self._pushes.values())

    @property
    def touches(self) -> dict[str, float | tuple[float, int | None]]:
        """The same as `HSRTouchEnv.touch_all` takes it."""
        return {p.patch: (p.force, p.cell) for p in self._pushes.values() if p.force > 0.0}

    def press(self, patch: str, cell: int | None, force: float, pinned: bool = False) -> None:
        """Push a patch: with the mouse's finger, or with one that stays.

        The mouse has one finger: it leaves the patch that it pushed before. A pinned push of the
        same patch is taken over.

        Raises:
            ValueError: The patch does not exist, the force is no force, or all fingers are pinned
                elsewhere.
        """
        if patch not in self._patches:
            raise ValueError(f"patch must be one of {self._patches}, got {patch!r}")
        if not np.isfinite(force) or force < 0.0:
            raise ValueError(f"force must be 0 to {LARGEST_FORCE:g} N, got {force}")
        if not pinned:
            self.lift()
        if patch not in self._pushes and len(self._pushes) == len(FINGERS):
            raise ValueError(
                f"all {len(FINGERS)} fingers are in use: let go of a pinned push first"
            )
        self._pushes[patch] = Push(patch, cell, min(force, LARGEST_FORCE), pinned)

    def lift(self) -> None:
        """Lift the mouse's finger; pinned ones stay."""
        self._pushes = {patch: push for patch, push in self._pushes.items() if push.pinned}

    def pin(self) -> None:
        """Let the push of the mouse's finger stay."""
        self._pushes = {patch: push._replace(pinned=True) for patch, push in self._pushes.items()}

    def let_go(self) -> None:
        """Lift all fingers."""
        self._pushes = {}
