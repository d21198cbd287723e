"""The reference the joint drives follow: commanded targets under speed and acceleration limits.

    joint target (50 Hz) ──clip──► discrete-time-optimal stop ──► reference of every physics step

Measured positions and speeds keep within the limits because the reference does.
"""

import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS, METRES

Array = NDArray[np.float64]

# Under a push a joint gives way by about a milliradian: the reference keeps that much distance
# from the limits and from the speed limits, so that the measured values keep within them.
_MARGIN, _MARGIN_OF_SLIDES = 0.002, 0.0005  # rad, m
_SPEED_SHARE = 0.95
_LARGEST_LEAD = 0.03  # rad or m, of the reference over a joint that something blocks
_TIME_TO_FULL_SPEED = 0.1  # s
# The HSR's hand starts more gently: a grip lets go with a jerk. The base takes 0.95 m/s^2 of the
# 1.67 m/s^2 that its drive wheels can do (41.7 rad/s^2 at a radius of 0.04 m), and turns with as
# little: half the wheels' tread of 0.266 m at 4.75 rad/s^2 is 0.63 m/s^2.
_GENTLE = {"hand_motor_joint": 0.25, "odom_x": 0.2, "odom_y": 0.2, "odom_t": 0.2}  # s


def drive_reference(
    lower: Array,
    upper: Array,
    velocity: Array,
    slides: NDArray[np.bool_],
    tick: float,
    substeps: int,
    times: Array | float = _TIME_TO_FULL_SPEED,
) -> "SlewedReference":
    """A reference with which measured values keep within the limits.

    Args:
        lower: (J,) lower joint limits, rad or m; minus infinity where there is none.
        upper: (J,) upper joint limits, rad or m; infinity where there is none.
        velocity: (J,) speed limits, rad/s or m/s.
        slides: (J,) whether a joint slides.
        tick: Length of a control tick, s.
        substeps: Physics steps a tick.
        times: (J,) or one, from rest to full speed, s.
    """
    speed, margin = _SPEED_SHARE * velocity, np.where(slides, _MARGIN_OF_SLIDES, _MARGIN)
    return SlewedReference(lower + margin, upper - margin, speed, speed / times, tick, substeps)


def hsr_reference(
    lower: Array, upper: Array, velocity: Array, tick: float, substeps: int
) -> "SlewedReference":
    """The reference of the HSR's `JOINTS`, see ``drive_reference``."""
    times = np.array([_GENTLE.get(name, _TIME_TO_FULL_SPEED) for name in JOINTS])
    slides = np.isin(JOINTS, METRES)
    return drive_reference(lower, upper, velocity, slides, tick, substeps, times)


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
        self._acceleration = acceleration
        self._speed_unit = acceleration * tick
        self._distance_unit = acceleration * tick**2
        self._fastest = velocity / self._speed_unit
        self._times = np.arange(1, substeps + 1)[:, None] * (tick / substeps)
        self._ramp = self._times**2 / (2 * tick)
        self.position = np.zeros_like(lower)
        self.velocity = np.zeros_like(lower)
        self._held: NDArray[np.bool_] = np.zeros(len(lower), bool)
        self._place = np.zeros_like(lower)

    def reset(self, position: Array) -> None:
        """Puts the reference at rest at `position`, (J,), moved inside the limits; holds none."""
        self.position = np.clip(position, self.lower, self.upper)
        self.velocity = np.zeros_like(self.position)
        self._held = np.zeros(len(self.position), bool)

    def hold(self, joints: NDArray[np.bool_]) -> None:
        """Brings some joints to rest as soon as their accelerations allow, and keeps them there.

        Args:
            joints: (J,) whether a joint is held from now on; one that was held stays where it was.
        """
        braking = self.velocity * np.abs(self.velocity) / (2 * self._acceleration)
        caught = joints & ~self._held
        self._place = np.where(caught, self.position + braking, self._place)
        self._held = joints

    def stay_near(self, measured: Array) -> None:
        """Stops the reference of joints that something blocks, so that they later start from rest.

        Args:
            measured: (J,) measured joint positions, rad or m.
        """
        # More than the drives' lag.
        blocked = np.abs(self.position - measured) > _LARGEST_LEAD
        near = np.clip(self.position, measured - _LARGEST_LEAD, measured + _LARGEST_LEAD)
        self.position = np.where(blocked, np.clip(near, self.lower, self.upper), self.position)
        self.velocity = np.where(blocked, 0.0, self.velocity)

    def plan(self, target: Array) -> Array:
        """References of the next tick's physics steps.

        Args:
            target: (J,) joint target, rad or m; moved inside the limits, ignored where held.

        Returns:
            (substeps, J) references; the last one is the new `position`.
        """
        target = np.where(self._held, self._place, target)
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
