"""A touch between two patches: the robot should make both behaviours' motions at once.

A hand at an edge of the wrist presses the patch above or below it with one finger and the patch
beside it with the other. Each case is rolled out three times from one posture: with both fingers,
and with each of them alone at the force that it had; the motion under both is then compared with
the sum of the two motions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from hasm_torch.evaluation.compliance import BEHAVIOURS, END_MARGIN, RELEASE_AT, ROOM, TOUCH_AT
from hasm_torch.evaluation.rollout import Array, Policy, Trace, limit_violations, roll_out
from hasm_torch.robot import JOINTS

# Neighbouring patches: the arm's behaviours with the wrist's, indices into `BEHAVIOURS`.
PAIRS = tuple(product((0, 1), (2, 3)))
SMALLEST_SHARE = 0.3  # of the force on the patch that is pressed less
SMALLEST_FORCE, LARGEST_FORCE = 2.0, 14.0  # N on each patch
# Degrees; with speeds proportional to forces an ignored finger costs at least atan(0.3 / 0.7).
LARGEST_ANGLE = 20.0
# Length of a motion in shares of the joint ranges: a push bends a robot that holds still by less.
MOVED_SHARE = 0.01


@dataclass
class CombinedCase:
    """Three rollouts to be made.

    Attributes:
        pair: Index into ``PAIRS``.
        seed: Seed of the start posture.
        force: Force of both fingers together, N.
        share: How much of it presses the first patch.
    """

    pair: int
    seed: int
    force: float
    share: float

    @property
    def forces(self) -> dict[str, float]:
        """Force on each of the two patches, N."""
        first, second = (BEHAVIOURS[index].patch for index in PAIRS[self.pair])
        return {first: self.share * self.force, second: (1.0 - self.share) * self.force}


class Hold:
    """A human who presses patches evenly, until the release.

    Args:
        forces: Force on each patch, N.
    """

    def __init__(self, forces: dict[str, float]) -> None:
        self.forces = forces

    def touches(self, time: float, state: Array) -> dict[str, float]:
        """Press from the touch on."""
        return self.forces if time >= TOUCH_AT else {}

    def finished(self, time: float, state: Array) -> bool:
        """At the release, where the comparison ends."""
        return time >= RELEASE_AT


def cases(rollouts: int, seed: int) -> list[CombinedCase]:
    """Plan the rollouts.

    Args:
        rollouts: Cases a pair of patches.
        seed: Seed of shares, forces and postures.
    """
    rng = np.random.default_rng(seed)
    planned = []
    for pair in range(len(PAIRS)):
        for _ in range(rollouts):
            share = float(rng.uniform(SMALLEST_SHARE, 1.0 - SMALLEST_SHARE))
            softer, harder = sorted((share, 1.0 - share))
            force = float(rng.uniform(SMALLEST_FORCE / softer, LARGEST_FORCE / harder))
            planned.append(CombinedCase(pair, int(rng.integers(2**31)), force, share))
    return planned


def start_posture(case: CombinedCase, joints: tuple[str, ...], lower: Array, upper: Array) -> Array:
    """Every joint anywhere but at its ends, the yielding ones with room ahead of them."""
    rng = np.random.default_rng(case.seed)
    lowest, highest = np.full(len(joints), 2 * END_MARGIN), np.full(len(joints), 1 - 2 * END_MARGIN)
    for behaviour in (BEHAVIOURS[index] for index in PAIRS[case.pair]):
        yielding = joints.index(behaviour.joint)
        if behaviour.direction < 0:
            lowest[yielding] = ROOM
        else:
            highest[yielding] = 1.0 - ROOM
    return lower + rng.uniform(lowest, highest) * (upper - lower)


def run_case(
    case: CombinedCase, env: Any, policy: Policy
) -> tuple[tuple[Trace, Trace, Trace], dict[str, Any]]:
    """Roll one case out three times and measure it.

    Args:
        case: The case.
        env: The "compliance" environment.
        policy: The policy.

    Returns:
        The traces with both fingers, the first and the second; the figures of ``measure``.
    """
    sim = env.unwrapped
    limits = (sim.joint_lower, sim.joint_upper)
    start = start_posture(case, JOINTS, *limits)
    first, second = ({patch: force} for patch, force in case.forces.items())
    both, one, other = (
        roll_out(env, policy, Hold(forces), start, case.seed)
        for forces in (case.forces, first, second)
    )
    yielding = [
        (JOINTS.index(BEHAVIOURS[index].joint), BEHAVIOURS[index].direction)
        for index in PAIRS[case.pair]
    ]
    traces = (both, one, other)
    return traces, measure(traces, yielding, *limits, sim.joint_speed_limit)


def measure(
    traces: tuple[Trace, Trace, Trace],
    yielding: Sequence[tuple[int, int]],
    lower: Array,
    upper: Array,
    max_speed: Array,
) -> dict[str, Any]:
    """The figures of one case.

    All motions are taken from the touch to the same moment: the release, or the last row before a
    joint comes near an end of its range in any of the rollouts, where its motion has to stop.

    Args:
        traces: Rollouts with both fingers, the first and the second, of the same rows.
        yielding: Index of the joint that yields to each finger, and the sign of its motion.
        lower: (joints,) lower limits, rad or m.
        upper: (joints,) upper limits, rad or m.
        max_speed: (joints,) speed limits, rad/s or m/s.

    Returns:
        ``angle`` (degrees, between the motion under both fingers and the sum of the single ones,
        in shares of the joint ranges), ``angle_rad`` (degrees, the same over the yielding joints
        alone in rad), ``stray`` (degrees, the larger of the angles between a single motion and
        its joint's alone), ``ratio`` (length of the motion under both over that of the sum),
        ``moved`` (length of the shortest of the three motions, joint ranges), ``window`` (s, how
        long was compared), ``within`` (the angle is at most ``LARGEST_ANGLE``), ``success``
        (``stray`` is too: a policy that answers every touch in one way adds up to that way, but
        combines no behaviours), ``violations``. Where one of the rollouts did not move, the
        angles are 180 degrees and the ratio is 0.
    """
    span = upper - lower
    shares = [(trace.state - lower) / span for trace in traces]
    time = traces[0].time
    near = np.any([(s < END_MARGIN) | (s > 1.0 - END_MARGIN) for s in shares], axis=(0, 2))
    begin = int(np.flatnonzero(time <= TOUCH_AT)[-1])
    stops = np.flatnonzero((near | (time > RELEASE_AT))[begin + 1 :])
    end = begin + int(stops[0]) if len(stops) else len(time) - 1
    both, one, other = (share[end] - share[begin] for share in shares)
    moved = min(float(np.linalg.norm(way)) for way in (both, one, other))
    angles, ratio = dict.fromkeys(("angle", "angle_rad", "stray"), 180.0), 0.0
    wanted = one + other
    if moved >= MOVED_SHARE:
        joints = [joint for joint, _ in yielding]
        alone = [sign * np.eye(len(span))[joint] for joint, sign in yielding]
        angles = {
            "angle": angle(both, wanted),
            "angle_rad": angle((both * span)[joints], (wanted * span)[joints]),
            "stray": max(angle(way, axis) for way, axis in zip((one, other), alone)),
        }
        ratio = float(np.linalg.norm(both)) / max(float(np.linalg.norm(wanted)), 1e-12)
    within = angles["angle"] <= LARGEST_ANGLE
    return {
        **angles,
        "ratio": ratio,
        "moved": moved,
        "window": float(time[end] - time[begin]),
        "within": within,
        "success": within and angles["stray"] <= LARGEST_ANGLE,
        "violations": sum(limit_violations(t, lower, upper, max_speed) for t in traces),
    }


def angle(a: Array, b: Array) -> float:
    """Angle between two vectors, degrees; 180 if one of them is zero."""
    lengths = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    if min(lengths) == 0.0:
        return 180.0
    a, b = a / lengths[0], b / lengths[1]
    # Of the difference and the sum, since the cosine of a small angle loses its digits.
    return float(np.degrees(2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))))


def summarise(figures: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures over many cases.

    Args:
        figures: What ``run_case`` measured for each.

    Returns:
        ``cases``; ``success_rate`` and ``within`` (shares of the cases); ``still`` (cases in which
        a rollout did not move); median and 95th percentile of ``angle``, ``angle_rad`` and
        ``stray``, degrees; median, 5th and 95th percentile of ``ratio``; ``limit_violations``.
    """
    column = {name: np.array([f[name] for f in figures], dtype=np.float64) for name in figures[0]}
    summary: dict[str, Any] = {
        "cases": len(figures),
        "success_rate": float(column["success"].mean()),
        "within": float(column["within"].mean()),
        "still": int((column["moved"] < MOVED_SHARE).sum()),
    }
    for name in ("angle", "angle_rad", "stray"):
        summary[f"{name}_median"] = float(np.median(column[name]))
        summary[f"{name}_p95"] = float(np.quantile(column[name], 0.95))
    for name, share in (("ratio_median", 0.5), ("ratio_p5", 0.05), ("ratio_p95", 0.95)):
        summary[name] = float(np.quantile(column["ratio"], share))
    return summary | {"limit_violations": int(column["violations"].sum())}
