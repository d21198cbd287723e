"""A human who presses the skin with one or two fingers for a while, then leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hasm_torch.evaluation.rollout import Array, Human
from hasm_torch.robot import JOINTS


@dataclass(frozen=True)
class Push(Human):
    """One push, even or swelling and fading.

    Attributes:
        pressed: Force at the beginning, N, and cell (None: the centre) of each patch.
        begin: When the touch begins, s.
        end: When it ends, s.
        rest: How long the human then watches, s.
        swing: Amplitude of the force's change, N; 0 presses evenly.
        period: Period of the change, s.
        phase: Phase of the change at the beginning, rad.
        held: Joints that are held all the time.
        grip: Time from the beginning of the touch in which all joints are held, s.
    """

    pressed: Mapping[str, tuple[float, int | None]]
    begin: float
    end: float
    rest: float = 0.0
    swing: float = 0.0
    period: float = 1.5
    phase: float = 0.0
    held: tuple[str, ...] = ()
    grip: float = 0.0

    def touches(self, time: float, state: Array) -> Mapping[str, tuple[float, int | None]]:
        """Press between the touch and the release."""
        if not self.begin <= time < self.end:
            return {}
        angle = 2 * np.pi * (time - self.begin) / self.period + self.phase
        change = self.swing * float(np.sin(angle))
        return {patch: (force + change, cell) for patch, (force, cell) in self.pressed.items()}

    def holds(self, time: float) -> Sequence[str]:
        """Everything while gripped, then what is held all the time."""
        return JOINTS if time < self.begin + self.grip else self.held

    def finished(self, time: float, state: Array) -> bool:
        """When the human has watched for long enough."""
        return time >= self.end + self.rest


@dataclass(frozen=True)
class Pushes(Human):
    """One push after the other; the robot may rest between them.

    Attributes:
        pushes: The pushes in the order of time.
    """

    pushes: Sequence[Push]

    def touches(self, time: float, state: Array) -> Mapping[str, tuple[float, int | None]]:
        """What the push does that is on."""
        return next(filter(None, (push.touches(time, state) for push in self.pushes)), {})

    def finished(self, time: float, state: Array) -> bool:
        """When the last push is over."""
        return self.pushes[-1].finished(time, state)


def swelling(push: Push, rng: np.random.Generator) -> Push:
    """A push of one finger whose force changes all the time instead of staying even."""
    [(patch, (_, cell))] = push.pressed.items()
    return replace(
        push,
        pressed={patch: (float(rng.uniform(6.0, 10.0)), cell)},
        swing=float(rng.uniform(2.0, 4.0)),
        period=float(rng.uniform(0.8, 1.5)),
        phase=float(rng.uniform(0.0, 2 * np.pi)),
    )
