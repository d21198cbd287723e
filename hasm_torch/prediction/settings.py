"""Settings of the prediction."""

from dataclasses import dataclass, field
from typing import Literal

# A code of more entries than this is written with fewer bits.
_ENTRIES = 4096
_BITS = (16, 8, 4)


@dataclass
class PredictionSettings:
    """How joint states are coded and recalled; ``choose_settings`` finds them in the episodes.

    Lists hold one entry a joint.

    Attributes:
        neurons: Neurons a channel, N_p; the channels are joint positions and, with a context,
            recent displacements.
        bits: Entries a neuron, n; None takes 16, 8 or 4, the most that keep a code within 4096
            entries.
        width: Tuning width σ in neuron spacings.
        code: "binary", "gray" or "thermometer".
        limits: Range that the neurons of a joint share: "spread", ``reach`` standard deviations
            to each side of its mean in the episodes, so that every joint counts as much as it
            varies; "body", its joint limits.
        reach: See ``limits``.
        context_s: How far back the recent displacement reaches, s.
        context: Weight of the recent displacement beside the position; 0 leaves it out.
        touch: Share of the place neurons that the strongest touch marks; 0 leaves touch out.
        patches: "each" patch has a segment of its own in the association; "whole" adds all up.
        shift: By how much of the way between the recalled and the present state the recalled
            successor is moved along: 0 takes the successor's position as it was, 1 takes its
            displacement.
        momentum: By how much of the difference between the present and the recalled recent
            displacement the recalled successor is moved on.
        emphasis: How often a joint's own place code is appended to the association that its
            successor is recalled with.
        perplexity: Associations that a recall in effect averages, see ``anneal``.
        beta: A fixed inverse temperature in place of ``perplexity``.
        shortlist: Best matches that take part in a recall.
        capacity: Most associations held; longer recordings are thinned evenly.
    """

    neurons: int = 10
    bits: int | None = None
    width: float = 2.0
    code: Literal["binary", "gray", "thermometer"] = "thermometer"
    limits: Literal["spread", "body"] = "spread"
    reach: float = 3.0
    context_s: float = 0.1
    context: float = 0.5
    touch: float = 0.0
    patches: Literal["each", "whole"] = "each"
    shift: list[float] = field(default_factory=list)
    momentum: list[float] = field(default_factory=list)
    emphasis: list[float] = field(default_factory=list)
    perplexity: list[float] = field(default_factory=list)
    beta: float | None = None
    shortlist: int = 128
    capacity: int = 16384

    @classmethod
    def literal(cls, joints: int) -> "PredictionSettings":
        """The paper as written: 4-bit binary codes of the joint limits, positions stored, one β.

        β = 2 stands for "a value bigger than 1".
        """
        return cls(
            bits=4,
            width=1.0,
            code="binary",
            limits="body",
            context=0.0,
            touch=1.0,
            shift=[0.0] * joints,
            beta=2.0,
        )

    def bits_for(self, channels: int) -> int:
        """Entries a neuron of a code of so many channels."""
        if self.bits is not None:
            return self.bits
        fitting = [bits for bits in _BITS if channels * self.neurons * bits <= _ENTRIES]
        return fitting[0] if fitting else _BITS[-1]

    def per_joint(self, name: str, joints: int, default: float) -> list[float]:
        """A setting that has one entry a joint.

        Raises:
            ValueError: If the list has another length.
        """
        values: list[float] = getattr(self, name)
        if values and len(values) != joints:
            raise ValueError(f"expected {name} for each of {joints} joints, got {len(values)}")
        return values or [default] * joints
