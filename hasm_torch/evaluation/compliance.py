"""Experiment 1, pseudo-compliance: a joint yields to the touch of one patch.

Section "Pseudo-compliance Controller" of the paper.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hasm_torch.evaluation.rollout import Array, Policy, Trace, limit_violations, roll_out
from hasm_torch.robot import JOINTS


@dataclass(frozen=True)
class Behaviour:
    """A one-joint behaviour.

    Attributes:
        name: Its name in the metrics.
        patch: Patch that is touched.
        joint: Joint that yields.
        direction: Sign of the joint's motion.
    """

    name: str
    patch: str
    joint: str
    direction: int


BEHAVIOURS = (
    Behaviour("arm_down", "wrist_upper", "arm_flex_joint", -1),
    Behaviour("arm_up", "wrist_under", "arm_flex_joint", +1),
    Behaviour("wrist_left", "wrist_left", "wrist_roll_joint", +1),
    Behaviour("wrist_right", "wrist_right", "wrist_roll_joint", -1),
)

TOUCH_AT, RELEASE_AT, END_AT = 0.2, 1.7, 3.0  # s
SETTLED_AFTER = 0.3  # s from a touch or a release until its transient is over
ROOM = 0.3  # share of the yielding joint's range that is left ahead of it at the start
END_MARGIN = 0.02  # share of the range: nearer to its end a joint has nowhere to go
SPEED_WINDOW = 0.1  # s over which the speed within a rollout is taken
LARGEST_LAG = 0.2  # s between force and speed
MOVED = 0.02  # rad, what the yielding joint of a successful rollout must travel at least
STAYED = 0.005  # rad or m, what every other joint of it may give way


class Push:
    """A human who presses one patch with a force that may change, then leaves.

    Args:
        patch: The patch.
        force: Force from the beginning of the touch, N.
        swing: Amplitude of the change, N; 0 presses evenly.
        period: Period of the change, s.
        phase: Phase of the change at the beginning, rad.
    """

    def __init__(
        self, patch: str, force: float, swing: float = 0.0, period: float = 1.5, phase: float = 0.0
    ) -> None:
        self.patch, self.force, self.swing = patch, force, swing
        self.period, self.phase = period, phase

    def touch(self, time: float, state: Array) -> tuple[str | None, float]:
        """Press between the touch and the release."""
        if not TOUCH_AT <= time < RELEASE_AT:
            return None, 0.0
        angle = 2 * np.pi * (time - TOUCH_AT) / self.period + self.phase
        return self.patch, self.force + self.swing * float(np.sin(angle))

    def finished(self, time: float, state: Array) -> bool:
        """After the time in which the joint must have come to rest."""
        return time >= END_AT


@dataclass
class ComplianceCase:
    """One rollout to be made.

    Attributes:
        behaviour: Index into ``BEHAVIOURS``.
        seed: Seed of the start posture.
        force: Mean force, N.
        changing: Whether the force changes during the touch.
    """

    behaviour: int
    seed: int
    force: float
    changing: bool


def cases(rollouts: int, forces: list[float], seed: int) -> list[ComplianceCase]:
    """Plan the rollouts: evenly pressed ones, and a quarter as many with a changing force.

    Args:
        rollouts: Evenly pressed rollouts a behaviour.
        forces: Forces to cycle through, N; without any, forces are drawn from 2 to 14 N.
        seed: Seed of forces and postures.
    """
    rng = np.random.default_rng(seed)
    planned = []
    for index in range(len(BEHAVIOURS)):
        for i in range(rollouts):
            force = forces[i % len(forces)] if forces else float(rng.uniform(2.0, 14.0))
            planned.append(ComplianceCase(index, int(rng.integers(2**31)), force, False))
        for _ in range(max(1, rollouts // 4)):
            force = float(rng.uniform(6.0, 10.0))
            planned.append(ComplianceCase(index, int(rng.integers(2**31)), force, True))
    return planned


def start_posture(
    case: ComplianceCase, joints: tuple[str, ...], lower: Array, upper: Array
) -> Array:
    """Every joint anywhere in its range, the yielding one with room ahead of it."""
    rng = np.random.default_rng(case.seed)
    behaviour = BEHAVIOURS[case.behaviour]
    share = rng.uniform(0.0, 1.0, len(joints))
    yielding = joints.index(behaviour.joint)
    ahead = 1.0 if behaviour.direction < 0 else 0.0
    share[yielding] = ROOM * ahead + (1.0 - ROOM) * share[yielding]
    return lower + share * (upper - lower)


def run_case(
    case: ComplianceCase,
    env: Any,
    policy: Policy,
    frame_every: int = 0,
    watch: Callable[[Policy], None] | None = None,
    start: Array | None = None,
) -> tuple[Trace, dict[str, Any]]:
    """Roll one case out and measure it.

    Args:
        case: The case.
        env: The "compliance" environment.
        policy: The policy.
        frame_every: Take a picture every so many steps; 0 takes none.
        watch: Called with the policy after every step.
        start: (joints,) start posture in place of the case's own, rad or m.

    Returns:
        The trace and its figures: ``displacement`` (rad, along the wanted direction), ``force``
        (N, mean), ``speed`` (rad/s, mean, signed along the wanted direction), ``tracking``
        (correlation of force and speed), ``drift`` (rad), ``others`` (largest motion of another
        joint, rad or m), ``violations``.
    """
    sim = env.unwrapped
    behaviour = BEHAVIOURS[case.behaviour]
    limits = (sim.joint_lower, sim.joint_upper)
    if start is None:
        start = start_posture(case, JOINTS, *limits)
    rng = np.random.default_rng(case.seed + 1)
    if case.changing:
        swing, period = rng.uniform(2.0, 4.0), rng.uniform(0.8, 1.5)
        human = Push(behaviour.patch, case.force, swing, period, rng.uniform(0.0, 2 * np.pi))
    else:
        human = Push(behaviour.patch, case.force)
    trace = roll_out(env, policy, human, start, case.seed, frame_every=frame_every, watch=watch)
    return trace, measure(trace, behaviour, JOINTS, *limits, sim.joint_speed_limit)


def measure(
    trace: Trace,
    behaviour: Behaviour,
    joints: tuple[str, ...],
    lower: Array,
    upper: Array,
    max_speed: Array,
) -> dict[str, Any]:
    """The figures of one compliance rollout; see ``run_case``."""
    index = joints.index(behaviour.joint)
    period = float(np.median(np.diff(trace.time)))
    position = trace.state[:, index] * behaviour.direction
    end = (upper[index] if behaviour.direction > 0 else -lower[index]) - END_MARGIN * (
        upper[index] - lower[index]
    )
    pressed = (trace.time > TOUCH_AT + SETTLED_AFTER) & (trace.time <= RELEASE_AT)
    moving = pressed & (position < end)
    rows = np.flatnonzero(moving)
    held = trace.time > RELEASE_AT + SETTLED_AFTER
    still = trace.state[held]
    others = np.delete(trace.state, index, axis=1)
    figures: dict[str, Any] = {
        "displacement": float(position[-1] - position[0]),
        "drift": float(np.ptp(still, axis=0).max()) if len(still) else float("nan"),
        "others": float(np.ptp(others, axis=0).max()),
        "violations": limit_violations(trace, lower, upper, max_speed),
        "force": float("nan"),
        "speed": float("nan"),
        "tracking": float("nan"),
    }
    if len(rows) > 1:
        first, last = rows[0], rows[-1]
        figures["force"] = float(trace.force[first : last + 1].mean())
        figures["speed"] = float(
            (position[last] - position[first]) / (trace.time[last] - trace.time[first])
        )
        figures["tracking"] = tracking(
            trace.force[first : last + 1], position[first : last + 1], period
        )
    return figures


def succeeded(figures: dict[str, Any]) -> bool:
    """Whether the right joint went the right way and the others stayed.

    Args:
        figures: What ``run_case`` measured.
    """
    return bool(figures["displacement"] > MOVED and figures["others"] < STAYED)


def tracking(force: Array, position: Array, period: float) -> float:
    """Correlation of force and speed at the best lag of the speed, 0 to 0.2 s.

    Args:
        force: (T,) N.
        position: (T,) rad.
        period: Time between rows, s.

    Returns:
        The correlation; NaN where force or speed does not change.
    """
    width = max(1, round(SPEED_WINDOW / period))
    kernel = np.ones(width) / width
    if len(force) < 4 * width:
        return float("nan")
    speed = np.convolve(np.diff(position) / period, kernel, mode="valid")
    smooth = np.convolve(force[1:], kernel, mode="valid")
    best = -1.0
    for lag in range(round(LARGEST_LAG / period) + 1):
        a, b = smooth[: len(smooth) - lag], speed[lag:]
        if np.ptp(a) < 1e-9 or np.ptp(b) < 1e-9:
            return float("nan")
        best = max(best, float(np.corrcoef(a, b)[0, 1]))
    return best


def summarise(planned: list[ComplianceCase], figures: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of every behaviour over its rollouts.

    Args:
        planned: The cases.
        figures: What ``run_case`` measured for each.

    Returns:
        ``{"behaviours": {name: {...}}, "limit_violations": n}``.
    """
    behaviours = {}
    for index, behaviour in enumerate(BEHAVIOURS):
        mine = [(c, f) for c, f in zip(planned, figures) if c.behaviour == index]
        even = [f for c, f in mine if not c.changing]
        pairs = [(f["force"], f["speed"]) for f in even if np.isfinite(f["speed"])]
        forces, speeds = np.array(pairs).reshape(-1, 2).T
        tracked = [f["tracking"] for c, f in mine if c.changing]
        behaviours[behaviour.name] = {
            "rollouts": len(mine),
            "direction_correct": float(np.mean([f["displacement"] > 0.005 for _, f in mine])),
            "spearman": spearman(forces, speeds),
            "r2": r_squared(forces, speeds),
            "tracking": float(np.mean(np.nan_to_num(tracked, nan=0.0))),
            "tracking_min": float(np.min(np.nan_to_num(tracked, nan=0.0))),
            "release_drift_rad": float(np.max([f["drift"] for _, f in mine])),
            "others_moved": float(np.max([f["others"] for _, f in mine])),
            "velocities": [[float(f), float(s)] for f, s in pairs],
        }
    return {
        "behaviours": behaviours,
        "limit_violations": int(sum(f["violations"] for f in figures)),
    }


def spearman(x: Array, y: Array) -> float:
    """Rank correlation with mean ranks for ties; 0 where one side does not change."""
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(_ranks(np.asarray(x)), _ranks(np.asarray(y)))[0, 1])


def r_squared(x: Array, y: Array) -> float:
    """Share of the variance of y that a straight line through (x, y) explains."""
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1] ** 2)


def _ranks(values: Array) -> Array:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[inverse]
