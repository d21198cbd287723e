"""The reference the joint drives follow: commanded targets under speed and acceleration limits.

    joint target (50 Hz) ──clip──► discrete-time-optimal stop ──► reference of every physics step

Measured positions and speeds keep within the limits because the reference does.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class SlewedReference:
    """Turns joint targets into references that respect position, speed and acceleration limits.

    Within a control tick the acceleration is constant, so the references of all physics steps
    of a tick follow from one vectorised expression. The speed at the end of a tick is the
    largest from which the joint still comes to rest on the target in whole ticks: the distance
    needed from speed u (in units of acceleration * tick) is piecewise linear with the
    triangular numbers k(k+1)/2 at its corners. The reference therefore never passes a limit.

    Args:
        lower: (J,) lowest reference, rad or m.
        upper: (J,) highest reference, rad or m.
        velocity: (J,) largest speed, rad/s or m/s.
        acceleration: (J,) largest acceleration, rad/s^2 or m/s^2.
        tick: Length of a control tick, s.
        substeps: Physics steps a tick.
    """

    def __init__(
        self,
        lower: Array,
        upper: Array,
        velocity: Array,
        acceleration: Array,
        tick: float,
        substeps: int,
    ) -> None:
        self.lower, self.upper = lower, upper
        self._speed_unit = acceleration * tick
        self._distance_unit = acceleration * tick**2
        self._fastest = velocity / self._speed_unit
        self._times = np.arange(1, substeps + 1)[:, None] * (tick / substeps)
        self._ramp = self._times**2 / (2 * tick)
        self.position = np.zeros_like(lower)
        self.velocity = np.zeros_like(lower)

    def reset(self, position: Array) -> None:
        """Puts the reference at rest at `position`, (J,), moved inside the limits."""
        self.position = np.clip(position, self.lower, self.upper)
        self.velocity = np.zeros_like(self.position)

    def stay_near(self, measured: Array, lead: float) -> None:
        """Stops the reference of joints that are blocked, so that they later start from rest.

        Args:
            measured: (J,) measured joint positions, rad or m.
            lead: Farthest that a reference may be from them; more than the drives' lag.
        """
        blocked = np.abs(self.position - measured) > lead
        near = np.clip(self.position, measured - lead, measured + lead)
        self.position = np.where(blocked, np.clip(near, self.lower, self.upper), self.position)
        self.velocity = np.where(blocked, 0.0, self.velocity)

    def plan(self, target: Array) -> Array:
        """References of the next tick's physics steps.

        Args:
            target: (J,) joint target, rad or m; moved inside the limits.

        Returns:
            (substeps, J) references; the last one is the new `position`.
        """
        speed = self.velocity / self._speed_unit
        error = (np.clip(target, self.lower, self.upper) - self.position) / self._distance_unit
        ahead = error - speed / 2
        distance = np.abs(ahead)
        whole = np.floor((np.sqrt(8 * distance + 1) - 1) / 2)
        wanted = np.copysign(whole + (distance - whole * (whole + 1) / 2) / (whole + 1), ahead)
        wanted = np.clip(wanted, speed - 1, speed + 1)
        new = np.clip(wanted, -self._fastest, self._fastest) * self._speed_unit
        references = (
            self.position + self.velocity * self._times + (new - self.velocity) * self._ramp
        )
        self.position, self.velocity = references[-1].copy(), new
        return references
