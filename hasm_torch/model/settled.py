"""What ``fit`` settles for some episodes: everything that the settings leave to them."""

from dataclasses import dataclass, field


@dataclass
class Settled:
    """What a fitted model needs, beside its settings and its body, to be built again.

    Attributes:
        touch: "direction" or "patch".
        value: "displacement", "successor" or "goal".
        readout: "mean" or "first_order".
        drive: "spike" or "time".
        beta: Inverse temperature β.
        joints: Indices of the coded joints.
        moved: Indices of the joints that are moved; the others are left where they are.
        chosen_from: Number of episodes from which it was chosen.
        moved_by: Indices of those that the touch of each taught patch moves, by its name.
        angle: Angle θ of RoPE3D, rad.
        threshold: Soft threshold τ, in the skin's unit.
        current_per_newton: Synaptic current a unit of effective force.
        capacity: Associations held.
        taught: Names of the patches whose touch was taught.
        density: Least and greatest rate density ρ of the taught touches.
        observed: Range of each entry of the further observations.
        past: Where time drives the robot, frames back of the displacements that are coded.
        flip: There, share of the neurons whose code the strongest touch of a patch flips.
        trend: There, whether the linear trend is a covariate of the read-out.
    """

    touch: str
    value: str
    readout: str
    drive: str
    beta: float
    joints: list[int]
    moved: list[int]
    angle: float
    threshold: float
    current_per_newton: float
    capacity: int
    taught: list[str]
    chosen_from: int = 0
    moved_by: dict[str, list[int]] = field(default_factory=dict)
    density: list[float] = field(default_factory=lambda: [0.0, 1.0])
    observed: list[list[float]] = field(default_factory=list)
    past: list[int] = field(default_factory=list)
    flip: float = 0.0
    trend: bool = False

    @property
    def code_facts(self) -> tuple[object, ...]:
        """What the codes and values of stored associations depend on beside what was chosen."""
        return self.moved, self.density, self.observed
