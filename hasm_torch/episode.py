"""One demonstration, and the names of a dataset's features."""

from dataclasses import dataclass

import numpy as np

STATE, TACTILE, ACTION = "observation.state", "observation.tactile", "action"


@dataclass(eq=False)
class Episode:
    """One demonstration: T frames at a fixed rate.

    Attributes:
        index: Number of the episode in its dataset.
        task: What is done, in words.
        time: ``(T,)`` s, from the start of the episode.
        state: ``(T, J)`` float32 joint positions, units as in `EpisodeSet.units`.
        action: ``(T, A)`` float32 joint targets; A = J wherever an action is a target per joint.
        tactile: ``(T, cells, channels)`` float32 skin readings, or None without skin. Three
            channels are forces in N, one is a pressure, six are a wrench.
    """

    index: int
    task: str
    time: np.ndarray
    state: np.ndarray
    action: np.ndarray
    tactile: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.state)
