"""One demonstration, and the names of a dataset's features."""

from dataclasses import dataclass

import numpy as np

STATE, TACTILE, ACTION = "observation.state", "observation.tactile", "action"
ENVIRONMENT = "observation.environment_state"


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
        observations: ``(T, N)`` float32 further observations that are bound, side by side in the
            order of `EpisodeSet.observations`, or None where there are none.
    """

    index: int
    task: str
    time: np.ndarray
    state: np.ndarray
    action: np.ndarray
    tactile: np.ndarray | None = None
    observations: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.state)
