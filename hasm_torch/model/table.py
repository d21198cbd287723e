"""What episodes hold, as columns: a row for each sample or each touch."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hasm_torch.body import Body

Array = NDArray[np.float64]


@dataclass
class Table:
    """Samples or phases, K of them.

    Attributes:
        positions: (K, J) joint positions where it began, rad or m.
        moved: (K, J) displacement of a sample, a time of the base in the base's frame; of a phase
            (K, N, J), the course as displacements from the positions where it began.
        spikes: (K,) spikes that it took.
        density: (K,) rate density ρ of the touch.
        patch: (K,) int64, patch that is touched.
        direction: (K, 3) direction of the force, zero where nothing pushes; of a phase (K, N, 3),
            along its course.
        observation: (K, O) further observations.
        episode: (K,) int64 number of the episode.
        frame: (K,) int64 sample of the episode where it began.
    """

    positions: Array
    moved: Array
    spikes: Array
    density: Array
    patch: NDArray[np.int64]
    direction: Array
    observation: Array
    episode: NDArray[np.int64]
    frame: NDArray[np.int64]

    def rows(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> "Table":
        """Some of them."""
        return Table(**{name: column[index] for name, column in vars(self).items()})

    def __len__(self) -> int:
        return len(self.positions)


def empty_table(body: Body, points: int) -> Table:
    """A table of no samples, or of no phases with courses of so many points."""
    joints = len(body.joints)
    return Table(
        positions=np.zeros((0, joints)),
        moved=np.zeros((0, points, joints) if points else (0, joints)),
        spikes=np.zeros(0),
        density=np.zeros(0),
        patch=np.zeros(0, np.int64),
        direction=np.zeros((0, points, 3) if points else (0, 3)),
        observation=np.zeros((0, sum(body.observations.values()))),
        episode=np.zeros(0, np.int64),
        frame=np.zeros(0, np.int64),
    )


def joined(tables: list[Table]) -> Table:
    """Tables one after the other."""
    names = vars(tables[0])
    return Table(**{name: np.concatenate([vars(t)[name] for t in tables]) for name in names})
