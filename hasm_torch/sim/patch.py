"""What a patch of skin is to cover, in numbers that need no picture of the robot."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PITCH = 0.0245  # m, between neighbouring cells: hexagons of 14 mm a side and a quarter mm between
THICKNESS = 0.006  # m, of a cell
CLOSED = 360.0  # degrees
SURFACES = ("box", "capsule", "cylinder", "mesh")


@dataclass
class Patch:
    """A patch of skin to be laid out; lengths in m, all in the frame of the link.

    Raises:
        ValueError: A value is none of those that its field allows.
    """

    name: str = "skin"
    """Name of the patch."""

    link: str = ""
    """Link of the robot that carries it (MuJoCo calls it a body)."""

    surface: str = "mesh"
    """What the cells lie on: a face of a box, the round side of a capsule or cylinder, or, with
    mesh, the outside of whatever the link is made of. One of box, capsule, cylinder, mesh."""

    geom: str = ""
    """Name of the geom to cover, where a link has several."""

    toward: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0])
    """Where the patch looks, x, y and z: which face of a box, the middle of a round side, from
    where a mesh is seen."""

    angle: float = 180.0
    """Degrees of a round side that are covered; 360 goes all around."""

    lower: list[float] = field(default_factory=list)
    """Least x, y and z that a cell may have; empty for no bound."""

    upper: list[float] = field(default_factory=list)
    """Greatest x, y and z that a cell may have; empty for no bound."""

    pitch: float = PITCH
    """Distance of neighbouring cells: a cell of 14 mm a side is 24.2 mm wide."""

    def __post_init__(self) -> None:
        if self.surface not in SURFACES:
            raise ValueError(f"surface must be one of {', '.join(SURFACES)}, got {self.surface!r}")
        if len(self.toward) != 3 or not np.linalg.norm(self.toward) > 0:
            raise ValueError(f"toward must be a direction of three numbers, got {self.toward}")
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            if len(bound) not in (0, 3):
                raise ValueError(f"{name} must be three numbers or nothing, got {bound}")
        if not 0 < self.angle <= CLOSED:
            raise ValueError(f"angle must be above 0 and up to 360 degrees, got {self.angle}")
        if not self.pitch > 0:
            raise ValueError(f"pitch must be above 0 m, got {self.pitch}")

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest place of a cell, (3,) each, m."""
        return np.array(self.lower or [-np.inf] * 3), np.array(self.upper or [np.inf] * 3)
