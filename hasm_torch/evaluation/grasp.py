"""Experiment 2, tactile-guided grasp: one patch reaches, another grasps and retracts.

Section "Multi-joint Action Sequence" of the paper.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hasm_torch.evaluation.rollout import Array, Policy, Trace, limit_violations, roll_out

REACH_PATCH, GRASP_PATCH = "wrist_upper", "wrist_right"
LIFTED = 0.05  # m above the table
SETTLED_AFTER = 0.3  # s from the finger's leaving until the robot must hold still
# A human takes a motion as finished after so long a touch without motion, s, and longer for a soft
# touch, N s: the hand closes on an object for a while with nothing to be seen.
STALLED_AFTER, SOFT_PATIENCE = 0.8, 7.0
STALLED_BELOW = 2e-3  # rad or m
TIME_LIMIT = 60.0  # s
LIFT_NOISE_SHARE = 0.2  # noise of the arm lift, m, for each rad of the other joints' noise


class Guide:
    """A human who reaches by one patch, then grasps by another, and leaves at random moments.

    Args:
        force: Force of the touch, N.
        pauses: Number of random pauses.
        rng: Draws when the pauses come and how long they last.
    """

    def __init__(self, force: float, pauses: int, rng: np.random.Generator) -> None:
        self.force = force
        # Moments are counted in seconds of touch, so that a pause always interrupts a touch.
        self.moments = list(np.sort(rng.uniform(0.5, 9.0, pauses)))
        self.lengths = list(rng.uniform(0.8, 1.6, pauses))
        self.pauses: list[tuple[float, float]] = []
        self.stages = [REACH_PATCH, GRASP_PATCH]
        self.touched = 0.0
        self.resume = 0.3
        self.last = 0.0
        self.moved_at = 0.0
        self.anchor: Array | None = None

    def touch(self, time: float, state: Array) -> tuple[str | None, float]:
        """Press the current stage's patch, unless it is time for a pause."""
        if time < self.resume or not self.stages:
            self.last = time
            return None, 0.0
        self.touched += time - self.last
        self.last = time
        if self.moments and self.touched >= self.moments[0]:
            self.moments.pop(0)
            self._leave(time, self.lengths.pop(0))
            return None, 0.0
        if self.anchor is None or np.abs(state - self.anchor).max() > STALLED_BELOW:
            self.anchor, self.moved_at = state, self.touched
        if self.touched - self.moved_at > STALLED_AFTER + SOFT_PATIENCE / self.force:
            self.stages.pop(0)
            self.anchor = None
            self._leave(time, 0.5)
            return None, 0.0
        return self.stages[0], self.force

    def finished(self, time: float, state: Array) -> bool:
        """After both stages, or when patience ends."""
        return (not self.stages and time >= self.resume) or time > TIME_LIMIT

    def _leave(self, time: float, length: float) -> None:
        self.resume = time + length
        self.pauses.append((time, self.resume))


@dataclass
class GraspCase:
    """One rollout to be made.

    Attributes:
        seed: Seed of force, pauses, start state and object.
        pauses: Number of random pauses.
        start_noise: Standard deviation of the start state's noise, rad; the arm lift gets a
            fifth of it in m (0.05 rad: 1 cm).
        object_noise: The object stands up to this far from its place in x and y, m.
        force: Force of the touch, N; None draws it from 3 to 12 N.
    """

    seed: int
    pauses: int
    start_noise: float
    object_noise: float
    force: float | None


def cases(
    rollouts: int,
    forces: list[float],
    seed: int,
    pauses: int,
    start_noise: float,
    object_noise: float,
) -> list[GraspCase]:
    """Plan the rollouts; without forces each draws its own."""
    rng = np.random.default_rng(seed)
    return [
        GraspCase(
            int(rng.integers(2**31)),
            pauses,
            start_noise,
            object_noise,
            forces[i % len(forces)] if forces else None,
        )
        for i in range(rollouts)
    ]


def noisy_start(
    home: Array, noise: float, lower: Array, upper: Array, rng: np.random.Generator
) -> Array:
    """A start state near the usual one; the first joint is the arm lift, in m."""
    scale = np.full(len(home), noise)
    scale[0] = LIFT_NOISE_SHARE * noise
    return np.clip(home + scale * rng.standard_normal(len(home)), lower, upper)


def run_case(
    case: GraspCase,
    env: Any,
    policy: Policy,
    home: Array,
    frame_every: int = 0,
    watch: Callable[[Policy], None] | None = None,
) -> tuple[Trace, dict[str, Any]]:
    """Roll one case out and measure it.

    Args:
        case: The case.
        env: The "grasp" environment.
        policy: The policy.
        home: (joints,) usual start state, rad or m.
        frame_every: Take a picture every so many steps; 0 takes none.
        watch: Called with the policy after every step.

    Returns:
        The trace and its figures: ``success``, ``height`` (m above the table at the end),
        ``hold_drift`` (rad or m, largest motion of a joint in a pause after its first 0.3 s),
        ``force`` (N), ``seconds``, ``violations``.
    """
    sim = env.unwrapped
    rng = np.random.default_rng(case.seed)
    force = case.force if case.force is not None else float(rng.uniform(3.0, 12.0))
    guide = Guide(force, case.pauses, rng)
    start = noisy_start(home, case.start_noise, sim.joint_lower, sim.joint_upper, rng)
    x, y = rng.uniform(-case.object_noise, case.object_noise, 2)
    trace = roll_out(env, policy, guide, start, case.seed, (x, y), frame_every, watch)
    height = float(trace.object_height[-1])
    drift = 0.0
    for begin, end in guide.pauses:
        held = (trace.time >= begin + SETTLED_AFTER) & (trace.time <= end)
        if held.any():
            drift = max(drift, float(np.ptp(trace.state[held], axis=0).max()))
    return trace, {
        "success": bool(trace.success and height >= LIFTED),
        "height": height,
        "hold_drift": drift,
        "force": force,
        "seconds": float(trace.time[-1]),
        "violations": limit_violations(
            trace, sim.joint_lower, sim.joint_upper, sim.joint_speed_limit
        ),
    }


def summarise(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures over all grasp rollouts."""
    return {
        "rollouts": len(figures),
        "success_rate": float(np.mean([f["success"] for f in figures])),
        "hold_drift_rad": float(np.max([f["hold_drift"] for f in figures])),
        "limit_violations": int(sum(f["violations"] for f in figures)),
        "mean_seconds": float(np.mean([f["seconds"] for f in figures])),
        "results": figures,
    }
