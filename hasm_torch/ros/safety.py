"""What stands between a policy and the motors; it knows nothing of ROS.

    readings ──take_joints, take_skin──► Guard ──► Order: positions to send and base speeds, or none
    targets ──command──────────────────►   ▲
    a clock ──check, when nobody commands──┘

    WAITING ──everything was read──► DRIVING ◄──readings are back── HOLDING ──it lasts──► STOPPED
    any ──stop──► EMERGENCY ──release──► WAITING

Whatever comes in, positions stay within the joint limits and move at most ``max_speed / rate`` a
step from the last ones sent.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Mode(Enum):
    """What the robot is allowed to do."""

    WAITING = "waiting"
    DRIVING = "driving"
    HOLDING = "holding"
    STOPPED = "stopped"
    EMERGENCY = "emergency"


@dataclass(frozen=True)
class SafetyConfig:
    """When the robot is held and stopped.

    Attributes:
        rate: Control rate, Hz.
        stale_after: Age from which a reading is too old to move by, s.
        silent_after: Time without a command after which the caller is taken for dead, s.
        stop_after: How long a hold lasts until the robot is stopped, s.
        lead: How far a position that is sent may be ahead of the joint, s at its speed limit: what
            something blocks does not run off when it is let go. A servo at full speed lags by 0.15,
            and what is known of it may be ``stale_after`` old.

    Raises:
        ValueError: If one of them is not above 0.
    """

    rate: float = 50.0
    stale_after: float = 0.1
    silent_after: float = 0.1
    stop_after: float = 0.5
    lead: float = 0.3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be above 0, got {value}")


@dataclass(frozen=True)
class Limits:
    """Limits of the joints.

    Attributes:
        joints: Their names.
        lower: (J,) lower limits, rad or m; minus infinity where there is none.
        upper: (J,) upper limits.
        max_speed: (J,) speed limits, rad/s or m/s.

    Raises:
        ValueError: If a lower limit is not below the upper one, or a speed is not above 0.
    """

    joints: tuple[str, ...]
    lower: Array
    upper: Array
    max_speed: Array

    def __post_init__(self) -> None:
        for name, low, high, speed in zip(
            self.joints, self.lower, self.upper, self.max_speed, strict=True
        ):
            if not (low < high and 0 < speed < np.inf):
                raise ValueError(
                    f"{name}: expected lower < upper and a speed above 0, "
                    f"got {low}, {high}, {speed}"
                )


class Order(NamedTuple):
    """What may be sent now.

    Attributes:
        mode: What the robot is allowed to do.
        position: (J,) positions, rad or m; None: no command may be sent.
        speed: (J,) speeds that lead there, rad/s or m/s, for joints that are sent speeds: zeros
            unless the robot is driven.
    """

    mode: Mode
    position: Array | None
    speed: Array


class Guard:
    """Lets through what is safe.

    Times are those of any one clock, s.

    Attributes:
        mode: What the robot is allowed to do.
        why: What made it so, in words; "" while driving.
        position: (J,) what was last read of each joint, rad or m; NaN before.

    Args:
        limits: Limits of the joints.
        patches: Names of the skin's patches.
        config: When the robot is held and stopped.
    """

    def __init__(
        self, limits: Limits, patches: tuple[str, ...], config: SafetyConfig | None = None
    ) -> None:
        self._limits, self._config = limits, config or SafetyConfig()
        self._names = (*limits.joints, *patches)
        self.mode = Mode.WAITING
        self.reset()

    def reset(self) -> None:
        """Forget what was read and sent; an emergency stop stays."""
        joints = len(self._limits.joints)
        self.position: Array = np.full(joints, np.nan)
        self._read = np.full(len(self._names), -np.inf)  # when each joint and patch was read
        self._sent: Array | None = None
        self._commanded = self._held = -np.inf
        if self.mode is not Mode.EMERGENCY:
            self.mode, self.why = Mode.WAITING, "nothing was read yet"

    # ---- Readings.

    def take_joints(self, position: Array, time: float) -> NDArray[np.bool_]:
        """Take in positions.

        A reading counts as missing if it is not finite, or if no joint could have got there: a
        joint is nowhere beyond its limits, and since it was last read it has moved at its speed
        limit at most. Both with the distance that it can go in ``stale_after``, by which readings
        may be late.

        Args:
            position: (J,) rad or m; NaN where nothing was read.
            time: When.

        Returns:
            (J,) whether each joint's reading was taken.
        """
        limits, joints = self._limits, len(self._limits.joints)
        slack = limits.max_speed * self._config.stale_after
        with np.errstate(invalid="ignore"):
            way = np.abs(position - self.position)
            taken = (position >= limits.lower - slack) & (position <= limits.upper + slack)
            passed = np.maximum(time - self._read[:joints], 0.0)
            taken &= np.isnan(self.position) | (way <= limits.max_speed * passed + slack)
        taken &= np.isfinite(position)
        self.position = np.where(taken, position, self.position)
        self._read[:joints] = np.where(taken, time, self._read[:joints])
        return taken

    def take_skin(self, patch: int, time: float) -> None:
        """Note that a patch, by its number, was read."""
        self._read[len(self._limits.joints) + patch] = time

    def missing(self, time: float) -> list[str]:
        """Joints and patches whose readings are too old."""
        old = ~(time - self._read <= self._config.stale_after)
        return [self._names[i] for i in np.flatnonzero(old)]

    # ---- Orders.

    def command(self, target: Array, time: float) -> Order:
        """What may be sent, where the caller wants joints to be.

        Args:
            target: (J,) rad or m; a joint whose target is not finite stays.
            time: Now.
        """
        silent, self._commanded = time - self._commanded, time
        if self.mode is Mode.EMERGENCY:
            return self._still(None)
        if missing := self.missing(time):
            return self._hold(time, "no new readings of " + ", ".join(missing))
        limits, config = self._limits, self._config
        if self._sent is None or self.mode in (Mode.WAITING, Mode.STOPPED):
            self._sent = np.clip(self.position, limits.lower, limits.upper)
        self.mode, self.why, self._held = Mode.DRIVING, "", -np.inf
        # Who commands more often than the rate moves the robot no faster.
        step = limits.max_speed * float(np.clip(silent, 0.0, 1 / config.rate))
        ahead = limits.max_speed * config.lead
        with np.errstate(invalid="ignore"):
            wanted = np.clip(target, self.position - ahead, self.position + ahead)
        wanted = np.where(np.isfinite(target), wanted, self._sent)
        wanted = np.clip(wanted, limits.lower, limits.upper)
        moved = np.clip(wanted - self._sent, -step, step)
        self._sent = self._sent + moved
        return Order(self.mode, self._sent.copy(), moved * config.rate)

    def check(self, time: float) -> Order | None:
        """The watchdog: what is to be sent while nobody commands, or None.

        Call it at the control rate.

        Args:
            time: Now.
        """
        if self.mode is Mode.EMERGENCY:
            return self._still(None)
        alive = time - self._commanded <= self._config.silent_after
        if alive or self.mode in (Mode.WAITING, Mode.STOPPED):
            return None
        return self._hold(time, "nobody sends commands")

    def stop(self, why: str) -> None:
        """Emergency stop: nothing moves until it is released."""
        self.mode, self.why = Mode.EMERGENCY, f"emergency stop: {why}"

    def release(self) -> None:
        """End an emergency stop; the robot goes on from where it then is, once it was read anew."""
        if self.mode is Mode.EMERGENCY:
            self.mode = Mode.WAITING
            self.reset()

    def _hold(self, time: float, why: str) -> Order:
        if self._sent is None or self.mode in (Mode.WAITING, Mode.STOPPED):
            self.why = why  # it does not move yet, or no more
            return self._still(None)
        if self.mode is not Mode.HOLDING:
            self.mode, self._held = Mode.HOLDING, time
        self.why = why
        if time - self._held >= self._config.stop_after:
            self.mode = Mode.STOPPED
            return self._still(None)
        return self._still(self._sent.copy())

    def _still(self, position: Array | None) -> Order:
        return Order(self.mode, position, np.zeros(len(self._limits.joints)))


def planar_twist(speed: Array, yaw: float) -> tuple[float, float, float]:
    """What a mobile base is told to do, in its own frame.

    Args:
        speed: (3,) speeds of x, y and yaw in the frame of odometry, m/s and rad/s.
        yaw: How the base is turned, rad.

    Returns:
        Speed ahead and to the left, m/s, and turning left, rad/s.
    """
    x, y, turn = (float(value) for value in speed)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * x + sin * y, cos * y - sin * x, turn
