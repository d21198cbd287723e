"""Moving a reference by what is recalled, spike by spike.

The reference is the joint state that the robot is asked to take.

    displacement    every spike of a touched patch moves it by the recalled displacement of a spike
    goal            every spike moves it on along the course that was recalled when the touch began
    successor       the same towards the recalled next state; there the next one is recalled

Without spikes nothing moves, so the robot holds still. A control step handles a few numbers at a
time, which NumPy does in float64 and a fraction of the time that tensors take.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.encoders.skin import ArrayState
from hasm_torch.model.moments import Moments

Array = NDArray[np.float64]

# Of the joints' speed limits, this much is used: the servo that follows needs the rest.
SPEED_SHARE = 0.9


class Touched(NamedTuple):
    """One patch that spikes in a control step.

    Attributes:
        patch: Its index.
        spikes: Spikes in the step.
        density: Rate density ρ.
        direction: (3,) direction of the force.
        observation: (N,) further observations.
    """

    patch: int
    spikes: float
    density: float
    direction: Array
    observation: Array


class Asked(NamedTuple):
    """One recall of a control step.

    Attributes:
        touch: What was felt.
        query: (D,) what the memory was asked.
        positions: (joints,) for which positions, rad or m.
    """

    touch: Touched
    query: Tensor
    positions: Array


@dataclass
class Course:
    """Where a touch leads.

    Attributes:
        points: (N, J) positions of the moved joints on the way, rad or m.
        spikes: (N,) spikes from the first point to each.
        done: Spikes spent on the way so far.
        asked: The recall that gave it.
    """

    points: Array
    spikes: Array
    done: float = 0.0
    asked: Asked | None = None

    @property
    def finished(self) -> bool:
        """Whether its last point is reached."""
        return self.done >= self.spikes[-1]

    def join(self, positions: Array, span: Array) -> None:
        """Begin at the point nearest to positions (J,), in shares of the joints' spans (J,)."""
        away = (np.abs(self.points - positions) / span).max(axis=1)
        self.done = float(self.spikes[int(away.argmin())])

    def advance(self, positions: Array, spikes: float) -> tuple[Array, float]:
        """Move on by some spikes.

        The way to the next point shrinks in step with the spikes to it, so that a reference beside
        the course comes back to it.

        Args:
            positions: (J,) where the reference is, rad or m.
            spikes: Spikes to spend.

        Returns:
            (J,) where it is then, and the spikes that are left over at the end of the course.
        """
        while spikes > 0 and not self.finished:
            ahead = int(np.searchsorted(self.spikes, self.done, side="right"))
            needed = float(self.spikes[ahead]) - self.done
            if spikes < needed:
                self.done += spikes
                return positions + spikes / needed * (self.points[ahead] - positions), 0.0
            positions, spikes, self.done = self.points[ahead], spikes - needed, self.spikes[ahead]
        return (self.points[-1] if self.finished else positions), spikes


@dataclass
class Rollout:
    """What one robot's control loop needs to go on; several robots can share the memory.

    Attributes:
        spikes: Spikes of every patch in the last control steps, (patches,) each; as many steps as
            rates are counted over.
        total: (patches,) their sum.
        density: (patches,) rate density ρ of every patch at the last step.
        skin: State of the skin's encoder.
        touched: Names of the taught patches that spiked in the last step.
        reference: (J,) the joint state asked for; None before the first valid reading.
        courses: The course of each patch whose touch goes on, by its index.
        asked: The recalls of the last step.
        history: Measured positions, (J,) each, of a robot that time moves on.
        moment: What was last asked of its memory.
    """

    spikes: deque[Array]
    total: Array
    density: Array
    skin: ArrayState | None
    touched: list[str] = field(default_factory=list)
    reference: Array | None = None
    courses: dict[int, Course] = field(default_factory=dict)
    asked: list[Asked] = field(default_factory=list)
    history: list[Array] = field(default_factory=list)
    moment: Moments | None = None

    def count(self, spikes: Array) -> None:
        """Take in the spikes of a step, (patches,)."""
        self.total += spikes - self.spikes.popleft()
        self.spikes.append(spikes)


def limit_speed(before: Array, after: Array, max_speed: Array, period: float) -> Array:
    """Shorten a step, keeping its direction, so that no joint is asked to exceed its speed limit.

    Args:
        before: (joints,) positions now, rad or m.
        after: (joints,) positions wanted a control step later, rad or m.
        max_speed: (joints,) speed limits, rad/s or m/s.
        period: Duration of a control step, s.

    Returns:
        (joints,) positions that the limits allow.
    """
    way = after - before
    share = np.abs(way / max_speed).max() / (SPEED_SHARE * period)
    return after if share <= 1.0 else before + way / share
