"""Experiment 3, tactile-guided grasp: one patch reaches, another grasps and retracts.

Section "Multi-joint Action Sequence" of the paper. What a touch does is named by its patch here,
not by the direction of the force, so ``along_force`` means nothing and is not measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hasm_torch.evaluation.rollout import Array, Human, Trace, limit_violations, limits_of
from hasm_torch.sim.tasks import GRASP_PATCH, REACH_PATCH, START_NOISE, START_POSES, noisy_start

FORCES = (3.0, 12.0)  # N, from which a touch is drawn
PLACE_NOISE = 0.01  # m, of the object about its usual place
PAUSES = 3  # of the human in a grasp
LIFTED = 0.05  # m above the table
SETTLED_AFTER = 0.3  # s from the finger's leaving until the robot must hold still
# A human takes a motion as finished after so long a touch without motion, s, and longer for a soft
# touch, N s: the hand closes on an object for a while with nothing to be seen.
STALLED_AFTER, SOFT_PATIENCE = 0.8, 7.0
STALLED_BELOW = 2e-3  # rad or m
TIME_LIMIT = 60.0  # s


class Guide(Human):
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

    def touches(self, time: float, state: Array) -> dict[str, tuple[float, int | None]]:
        """Press the current stage's patch, unless it is time for a pause."""
        if time < self.resume or not self.stages:
            self.last = time
            return {}
        self.touched += time - self.last
        self.last = time
        if self.moments and self.touched >= self.moments[0]:
            self.moments.pop(0)
            self._leave(time, self.lengths.pop(0))
            return {}
        if self.anchor is None or np.abs(state - self.anchor).max() > STALLED_BELOW:
            self.anchor, self.moved_at = state, self.touched
        if self.touched - self.moved_at > STALLED_AFTER + SOFT_PATIENCE / self.force:
            self.stages.pop(0)
            self.anchor = None
            self._leave(time, 0.5)
            return {}
        return {self.stages[0]: (self.force, None)}

    def finished(self, time: float, state: Array) -> bool:
        """After both stages, or when patience ends."""
        return (not self.stages and time >= self.resume) or time > TIME_LIMIT

    def _leave(self, time: float, length: float) -> None:
        self.resume = time + length
        self.pauses.append((time, self.resume))


@dataclass(frozen=True)
class GraspCase:
    """One rollout to be made.

    Attributes:
        seed: Seed of pauses and start state.
        force: Force of the touch, N.
        place: Displacement of the object from its usual place in x and y, m.
        pauses: Number of random pauses.
        start_noise: Standard deviation of the start state's noise, see ``tasks.noisy_start``.
    """

    seed: int
    force: float
    place: tuple[float, float] = (0.0, 0.0)
    pauses: int = PAUSES
    start_noise: float = START_NOISE

    def begin(self, sim: Any, start: Array | None) -> tuple[Guide, Array]:
        """The human and where the robot starts: near the usual posture, or another."""
        rng = np.random.default_rng(self.seed)
        guide = Guide(self.force, self.pauses, rng)
        home = np.array(START_POSES["grasp"]) if start is None else start
        limits = sim.joint_lower, sim.joint_upper
        return guide, noisy_start(home, self.start_noise, *limits, rng)

    def measure(self, trace: Trace, human: Human, sim: Any) -> dict[str, Any]:
        """The figures of the rollout.

        Returns:
            ``success``, ``height`` (m above the table at the end), ``hold_drift`` (rad or m,
            largest motion of a joint in a pause after its first 0.3 s), ``force`` (N), ``place``
            (m), ``seconds``, ``violations``.
        """
        assert isinstance(human, Guide)
        height = float(trace.height[-1])
        drift = 0.0
        for left, resumed in human.pauses:
            held = (trace.time >= left + SETTLED_AFTER) & (trace.time <= resumed)
            if held.any():
                drift = max(drift, float(np.ptp(trace.state[held], axis=0).max()))
        return {
            "success": bool(trace.success and height >= LIFTED),
            "height": height,
            "hold_drift": drift,
            "force": self.force,
            "place": list(self.place),
            "seconds": float(trace.time[-1]),
            "violations": limit_violations(trace, *limits_of(sim)),
        }


def cases(
    rollouts: int,
    seed: int,
    forces: Sequence[float] = (),
    object_noise: float = PLACE_NOISE,
    pauses: int = PAUSES,
    start_noise: float = START_NOISE,
) -> list[GraspCase]:
    """Plan the rollouts.

    Args:
        rollouts: How many.
        seed: Seed of everything that is drawn.
        forces: Forces to take in turn, N; by default drawn from ``FORCES``.
        object_noise: The object stands anywhere up to this far from its place in x and y, m.
        pauses: Number of random pauses.
        start_noise: Noise of the start state, rad.
    """
    rng = np.random.default_rng(seed)
    planned = []
    for i in range(rollouts):
        force = forces[i % len(forces)] if forces else float(rng.uniform(*FORCES))
        x, y = rng.uniform(-object_noise, object_noise, 2).tolist()
        case = GraspCase(int(rng.integers(2**31)), force, (x, y), pauses, start_noise)
        planned.append(case)
    return planned


Figures = Sequence[dict[str, Any]]


def summarise(figures: Figures, moved: Mapping[str, Figures]) -> dict[str, Any]:
    """The figures over all grasp rollouts.

    Args:
        figures: Of the object near its usual place.
        moved: Of the object elsewhere, by its largest offset, m.
    """
    found: dict[str, Any] = {
        "rollouts": len(figures),
        "success_rate": _success(figures),
        "hold_drift_rad": float(np.max([f["hold_drift"] for f in figures])),
        "limit_violations": int(sum(f["violations"] for f in figures)),
        "mean_seconds": float(np.mean([f["seconds"] for f in figures])),
        "results": list(figures),
    }
    if moved:
        found["moved"] = {reach: _success(some) for reach, some in moved.items()}
        found["moved_results"] = {
            reach: [[*f["place"], float(f["success"])] for f in some]
            for reach, some in moved.items()
        }
    return found


def _success(figures: Figures) -> float:
    return float(np.mean([f["success"] for f in figures]))
