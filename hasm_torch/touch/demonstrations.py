"""What a person shows: recorded a control step at a time, and played again."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hasm_torch.episode import Episode
from hasm_torch.robot import Skin
from hasm_torch.sim.demonstrator import episode_of
from hasm_torch.sim.env import CONTROL_RATE, LARGEST_FORCE
from hasm_torch.sim.scene import FINGERS

Array = NDArray[np.float64]

LONGEST = 120.0  # s; no one teaches a push for longer
FELT = 0.1  # N on a patch: less is no touch to be played again


class Recorder:
    """Collects the rows of one demonstration."""

    def __init__(self) -> None:
        self._rows: list[tuple[NDArray[np.float32], ...]] = []

    @property
    def seconds(self) -> float:
        """How long it is so far, s."""
        return len(self._rows) / CONTROL_RATE

    @property
    def full(self) -> bool:
        """Whether it holds as much as it may."""
        return self.seconds >= LONGEST

    def add(self, observation: Mapping[str, NDArray[np.float32]], target: Array) -> None:
        """Take in one control step: what was seen, and where the joints were then led."""
        state, *seen = [np.array(values) for values in observation.values()]
        self._rows.append((state, np.asarray(target, dtype=np.float32), *seen))

    def episode(self, index: int, task: str) -> Episode:
        """Everything recorded so far.

        Raises:
            ValueError: Nothing was recorded.
        """
        if not self._rows:
            raise ValueError("nothing was recorded: record a demonstration first")
        return episode_of(self._rows, index, task)


@dataclass
class Replay:
    """A demonstration that is played again, from its own start.

    Attributes:
        episode: The demonstration.
        moved: Whether its motion is played; else its touch, to which the robot answers.
        step: Control steps played so far.
    """

    episode: Episode
    moved: bool
    step: int = 0

    @property
    def finished(self) -> bool:
        """Whether it is over."""
        return self.step >= len(self.episode)

    @property
    def target(self) -> Array:
        """(J,) where the joints were led then, rad or m."""
        return self.episode.action[self.step].astype(np.float64)

    def touches(self, skin: Skin) -> dict[str, float | tuple[float, int | None]]:
        """What the fingers did then, as `HSRTouchEnv.touch_all` takes it.

        It is read off the skin: the force on each of the most pushed patches, at its most pushed
        cell.
        """
        if self.episode.tactile is None:
            return {}
        forces = self.episode.tactile[self.step].astype(np.float64).sum(axis=1)
        felt = {patch: float(forces[cells].sum()) for patch, cells in skin.slices.items()}
        pushed = sorted((p for p in felt if felt[p] > FELT), key=lambda p: -felt[p])
        return {
            patch: (min(felt[patch], LARGEST_FORCE), int(forces[skin.slices[patch]].argmax()))
            for patch in pushed[: len(FINGERS)]
        }
