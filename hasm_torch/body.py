"""The robot that a model moves: its joints, its limits and its skin, and how the skin turns."""

import math
from dataclasses import dataclass, field

ROW = 15  # numbers of one row of a chain: fixed rotation 9, axis 3, joint, multiplier, offset


@dataclass
class Body:
    """Joints and skin of a robot, in the order of its state and tactile vectors.

    Attributes:
        joints: Names of the joints.
        lower: Lower joint limits, rad or m; minus infinity for a joint without limits, which is
            moved but not coded.
        upper: Upper joint limits, rad or m.
        max_speed: Joint speed limits, rad/s or m/s.
        patches: Names of the skin patches.
        cells: Number of cells of each patch; patches follow each other in the tactile vector.
        normals: Outward unit normal of each cell in the frame of the link that carries it.
        links: Name of the link that carries each patch.
        chains: How each of these links turns in the base frame, by its name: rows of R_fixed (9
            numbers, row by row), axis (3), index of a joint (-1: none), multiplier m and offset o.
            The link's rotation is the product of R_fixed · Rot(axis, m q + o) over the rows. A
            link that is not named keeps its own frame.
        groups: Which patches are parts of one rigid body, an integer a patch: touches on it act
            alike.
        base: Names of the joints x, y and yaw of a mobile base, or none.
        observations: Number of entries of each further observation that is bound, by its name.
        targets: Names of the joints in the order in which a robot takes its targets, where that
            is another than that of its state.
        rate: Control and sampling rate, Hz.
        channels: Readings of a cell in the tactile vector: 3 forces, 1 pressure, or a wrench of 6,
            whose sensor then counts as six cells, one a direction (see ``readings``); 0 is a robot
            without skin, whose one patch is touched all the time.

    Raises:
        ValueError: If sizes differ, limits are not in order, or a speed is no speed.
    """

    joints: list[str]
    lower: list[float]
    upper: list[float]
    max_speed: list[float]
    patches: list[str] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)
    normals: list[list[float]] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    chains: dict[str, list[list[float]]] = field(default_factory=dict)
    groups: list[int] = field(default_factory=list)
    base: list[str] = field(default_factory=list)
    observations: dict[str, int] = field(default_factory=dict)
    targets: list[str] = field(default_factory=list)
    rate: float = 50.0
    channels: int = 3
    unit: str = "N"

    @property
    def readings(self) -> int:
        """Length of the tactile vector."""
        return sum(self.cells) * {0: 0, 3: 3}.get(self.channels, 1)

    @property
    def limited(self) -> list[int]:
        """Indices of the joints that have limits."""
        ranges = zip(self.lower, self.upper)
        return [j for j, (low, high) in enumerate(ranges) if math.isfinite(high - low)]

    def __post_init__(self) -> None:
        if self.channels not in (0, 1, 3, 6):
            raise ValueError(f"channels must be 0, 1, 3 or 6 readings a cell, got {self.channels}")
        if not self.links:
            self.links = [""] * len(self.patches)
        if not self.groups:  # patches of one link are one rigid body, as far as is known
            self.groups = [self.links.index(link) for link in self.links]
        for what, names in (("joints", self.joints), ("patches", self.patches)):
            for name in ("lower", "upper", "max_speed") if what == "joints" else ("cells", "links"):
                if len(getattr(self, name)) != len(names):
                    raise ValueError(
                        f"{name} has {len(getattr(self, name))} entries, expected one for each of "
                        f"the {len(names)} {what}: {', '.join(names)}"
                    )
        if len(self.normals) != sum(self.cells):
            raise ValueError(
                f"expected a normal for each of the {sum(self.cells)} cells, "
                f"got {len(self.normals)}"
            )
        for name, low, high, speed in zip(self.joints, self.lower, self.upper, self.max_speed):
            if not low < high:
                raise ValueError(f"{name}: expected lower < upper limit, got {low} and {high}")
            if not speed > 0:
                raise ValueError(f"{name}: expected a speed limit above 0, got {speed}")
        if self.targets and sorted(self.targets) != sorted(self.joints):
            raise ValueError(
                f"targets must be the joints in some order, {', '.join(self.joints)}, got "
                f"{', '.join(self.targets)}"
            )
        if unknown := [name for name in self.base if name not in self.joints]:
            raise ValueError(f"the base names unknown joints: {', '.join(unknown)}")
