"""Experiment 2, yield: the touched point moves along the force, wherever the robot is touched."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle, islice
from typing import Any

import numpy as np

from hasm_torch.evaluation import along_force
from hasm_torch.evaluation.along_force import ALONG, motion
from hasm_torch.evaluation.correlation import spearman
from hasm_torch.evaluation.push import Push, swelling
from hasm_torch.evaluation.rollout import Array, Human, Trace, limit_violations, limits_of
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.tasks import (
    ARM_JOINTS,
    BASE_JOINTS,
    TEST_FORCES,
    TORSO_PATCHES,
    WRIST_PATCHES,
    YIELD_GAIN,
    random_posture,
)

# What is done to the wrist in turn: half of the pushes are even ones of one finger.
KINDS = ("even", "changing", "even", "two_patches", "even", "opposite", "even", "blocked_joint",
         "even", "held")  # fmt: skip
TOUCH_AT, PUSH_SECONDS = 0.1, 1.6  # s
REST = 0.7  # s after the release, in which the robot must come to rest and hold still
SETTLED_AFTER = 0.3  # s from the release until it must hold still
GRIP = 0.8  # s for which a "held" robot cannot move
LEAST_DIFFERENCE = 4.0  # N between the fingers on opposite patches, so that they push somewhere
STRAIGHT = 0.9  # cos of base and force that a push on the torso must reach


@dataclass(frozen=True)
class YieldCase:
    """One rollout to be made.

    Attributes:
        seed: Seed of the start posture.
        kind: One of ``KINDS``, or "torso".
        push: What the human does.
    """

    seed: int
    kind: str
    push: Push
    place: tuple[float, float] = (0.0, 0.0)  # there is no object

    def begin(self, sim: Any, start: Array | None) -> tuple[Push, Array]:
        """The push and where the robot starts, see ``start_posture``."""
        if start is None:
            start = start_posture(self, sim.joint_lower, sim.joint_upper)
        return self.push, start

    def measure(self, trace: Trace, human: Human, sim: Any) -> dict[str, Any]:
        """The figures of the rollout, see ``measure``."""
        return measure(trace, self, *limits_of(sim))

    def without_rest(self) -> "YieldCase":
        """The same case up to the release, which is all that is needed of most rollouts."""
        return replace(self, push=replace(self.push, rest=0.0))


def cases(
    rollouts: int,
    seed: int,
    forces: Sequence[float] = (),
    kinds: Sequence[str] = KINDS,
    patches: Sequence[str] = WRIST_PATCHES,
) -> list[YieldCase]:
    """Plan pushes on the wrist.

    Args:
        rollouts: How many.
        seed: Seed of everything that is drawn.
        forces: Forces of single fingers to take in turn, N; by default drawn from ``TEST_FORCES``.
        kinds: Kinds to take in turn.
        patches: Patches that single fingers press.
    """
    rng, skin = np.random.default_rng(seed), Skin.load()
    given = cycle(forces)

    def touch(patch: str, force: float) -> tuple[float, int]:
        return float(force), int(rng.integers(skin.slices[patch].stop - skin.slices[patch].start))

    def draw(kind: str) -> Push:
        pairs = (WRIST_PATCHES[:2], WRIST_PATCHES[2:])  # opposite sides
        low, high = TEST_FORCES
        end = TOUCH_AT + PUSH_SECONDS
        if kind == "two_patches":
            names = [str(rng.choice(pair)) for pair in pairs]
            pressed = {name: touch(name, rng.uniform(low, high)) for name in names}
        elif kind == "opposite":
            names = rng.permutation(pairs[rng.integers(2)]).tolist()
            weak = rng.uniform(low, (low + high) / 2)
            strong = rng.uniform(weak + LEAST_DIFFERENCE, high)
            pressed = {name: touch(name, force) for name, force in zip(names, (weak, strong))}
        else:
            patch = str(rng.choice(list(patches)))
            pressed = {patch: touch(patch, next(given) if forces else rng.uniform(low, high))}
        push = Push(pressed, TOUCH_AT, end, REST)
        if kind == "changing":
            return swelling(push, rng)
        if kind == "blocked_joint":
            return replace(push, held=(str(rng.choice(ARM_JOINTS)),))
        return replace(push, grip=GRIP, end=end + GRIP) if kind == "held" else push

    return [
        YieldCase(int(rng.integers(2**31)), kind, draw(kind))
        for kind in islice(cycle(kinds), rollouts)
    ]


def torso_cases(rollouts: int, seed: int, forces: Sequence[float] = ()) -> list[YieldCase]:
    """Plan pushes on the torso; see ``cases``."""
    planned = cases(rollouts, seed, forces, ("even",), TORSO_PATCHES)
    return [replace(case, kind="torso") for case in planned]


def start_posture(case: YieldCase, lower: Array, upper: Array) -> Array:
    """Every joint anywhere in its range, the base turned anywhere."""
    rng = np.random.default_rng(case.seed)
    posture = random_posture(lower, upper, rng)
    posture[JOINTS.index("odom_t")] = rng.uniform(-np.pi, np.pi)
    return posture


def measure(
    trace: Trace, case: YieldCase, lower: Array, upper: Array, max_speed: Array
) -> dict[str, Any]:
    """The figures of one rollout.

    Returns:
        ``motion`` of the touched point; ``base``, of the mobile base in the plane; ``drift``, the
        largest motion of a joint once it must hold still, rad or m, NaN where nobody watched;
        ``violations``.
    """
    x, y = (trace.state[:, JOINTS.index(joint)] for joint in BASE_JOINTS[:2])
    still = trace.state[trace.time > case.push.end + SETTLED_AFTER]
    return {
        "motion": motion(trace),
        "base": motion(trace, plane=True, point=np.stack([x, y, 0 * x], axis=1)),
        "drift": float(np.ptp(still, axis=0).max()) if len(still) else float("nan"),
        "violations": limit_violations(trace, lower, upper, max_speed),
    }


Figures = Sequence[dict[str, Any]]


def along(mine: Figures, teacher: Figures) -> dict[str, Any]:
    """``along_force`` of some rollouts against the teacher's on the same cases."""
    return along_force.summarise([f["motion"] for f in mine], [f["motion"] for f in teacher])


def summarise(planned: Sequence[YieldCase], mine: Figures, teacher: Figures) -> dict[str, Any]:
    """The figures of the pushes on the wrist.

    Args:
        planned: The cases.
        mine: What was measured of the policy.
        teacher: What was measured of the demonstrator's law.

    Returns:
        ``along_force``, over all and by kind; ``speed`` along the force over the even pushes that
        the teacher follows: rank correlation with the expected speed k·F and with the teacher's,
        which joint limits hold back, and median of its share of k·F; ``release_drift_rad``;
        ``limit_violations``; ``velocities``, force (N) and speed (m/s) of these pushes.
    """
    kinds = {}
    for kind in dict.fromkeys(case.kind for case in planned):
        some = [i for i, case in enumerate(planned) if case.kind == kind]
        kinds[kind] = along([mine[i] for i in some], [teacher[i] for i in some])
    led = [
        (m["motion"], t["motion"])
        for case, m, t in zip(planned, mine, teacher)
        if case.kind == "even" and t["motion"].cos > ALONG
    ]
    force, speed, wanted = np.array([(m.force, m.speed, t.speed) for m, t in led]).reshape(-1, 3).T
    return {
        "along_force": along(mine, teacher),
        "kinds": kinds,
        "speed": {
            "spearman": spearman(YIELD_GAIN * force, speed),
            "spearman_of_teacher": spearman(wanted, speed),
            "of_expected": float(np.median(speed / (YIELD_GAIN * force))) if led else None,
        },
        **hold(mine),
        "velocities": [[m.force, m.speed] for m, _ in led],
    }


def summarise_torso(mine: Figures, teacher: Figures) -> dict[str, Any]:
    """The figures of the pushes on the torso.

    Returns:
        ``along_force`` of the touched point; ``base_cos_09``, share of the pushes in which the
        base moves along the force's part in the plane; ``base_cos_median``;
        ``release_drift_rad``; ``limit_violations``.
    """
    cosines = [f["base"].cos for f in mine]
    return {
        "along_force": along(mine, teacher),
        "base_cos_09": float(np.mean([cos > STRAIGHT for cos in cosines])),
        "base_cos_median": float(np.median(cosines)),
        **hold(mine),
    }


def hold(figures: Figures) -> dict[str, Any]:
    """Holding still and limits over some rollouts."""
    return {
        "release_drift_rad": float(np.nanmax([f["drift"] for f in figures])),
        "limit_violations": int(sum(f["violations"] for f in figures)),
    }
