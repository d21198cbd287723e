"""The robot that a model moves: its joints, limits and skin."""

from dataclasses import dataclass, field


@dataclass
class Body:
    """Joints and skin of a robot, in the order of its state and tactile vectors.

    Attributes:
        joints: Names of the joints.
        lower: Lower joint limits, rad or m.
        upper: Upper joint limits, rad or m.
        max_speed: Joint speed limits, rad/s or m/s.
        patches: Names of the skin patches.
        cells: Number of cells of each patch; patches follow each other in the tactile vector.
        directions: Outward normal of each patch in the frame of the link that carries it.
        links: Name of the link that carries each patch; needed for the base frame only.
        rate: Control and sampling rate, Hz.
        channels: Readings of a cell in the tactile vector: 3 forces, 1 pressure, or a wrench of 6,
            whose sensor then counts as six patches of one cell, one a direction (see
            ``readings``); 0 is a robot without skin, whose one patch is touched all the time.
    """

    joints: list[str]
    lower: list[float]
    upper: list[float]
    max_speed: list[float]
    patches: list[str] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)
    directions: list[list[float]] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    rate: float = 50.0
    channels: int = 3

    @property
    def readings(self) -> int:
        """Length of the tactile vector."""
        return sum(self.cells) * {0: 0, 3: 3}.get(self.channels, 1)

    def __post_init__(self) -> None:
        if self.channels not in (0, 1, 3, 6):
            raise ValueError(f"channels must be 0, 1, 3 or 6 readings a cell, got {self.channels}")
        sizes = {
            "lower": len(self.lower),
            "upper": len(self.upper),
            "max_speed": len(self.max_speed),
        }
        for name, size in sizes.items():
            if size != len(self.joints):
                raise ValueError(
                    f"{name} has {size} entries, expected one for each of the "
                    f"{len(self.joints)} joints: {', '.join(self.joints)}"
                )
        if not len(self.patches) == len(self.cells) == len(self.directions):
            raise ValueError(
                f"expected as many cell counts and directions as patches, got "
                f"{len(self.patches)} patches, {len(self.cells)} cell counts and "
                f"{len(self.directions)} directions"
            )
        for name, low, high in zip(self.joints, self.lower, self.upper):
            if not low < high:
                raise ValueError(f"{name}: expected lower < upper limit, got {low} and {high}")
