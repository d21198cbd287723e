"""Experiment 1, pseudo-compliance: a joint yields to the touch of one patch.

Section "Pseudo-compliance Controller" of the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hasm_torch.evaluation import along_force
from hasm_torch.evaluation.along_force import ALONG, motion
from hasm_torch.evaluation.correlation import r_squared, spearman, tracking
from hasm_torch.evaluation.push import Push, swelling
from hasm_torch.evaluation.rollout import Array, Human, Trace, limit_violations, limits_of
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.tasks import (
    BEHAVIOURS,
    TEST_FORCES,
    Behaviour,
    random_posture,
    upright_posture,
)

TOUCH_AT, RELEASE_AT, END_AT = 0.2, 1.8, 2.6  # s
SETTLED_AFTER = 0.3  # s from a touch or a release until its transient is over
ROOM = 0.3  # share of the yielding joint's range that is left ahead of it at the start
END_MARGIN = 0.02  # share of the range: nearer to its end a joint has nowhere to go
MOVED = 0.02  # rad, what the yielding joint of a successful rollout must travel at least
STAYED = 0.005  # rad or m, what every other joint of it may give way


@dataclass(frozen=True)
class ComplianceCase:
    """One rollout to be made.

    Attributes:
        behaviour: Index into ``BEHAVIOURS``.
        seed: Seed of the start posture.
        push: What the human does.
    """

    behaviour: int
    seed: int
    push: Push
    place: tuple[float, float] = (0.0, 0.0)  # there is no object

    def begin(self, sim: Any, start: Array | None) -> tuple[Push, Array]:
        """The push and where the robot starts, see ``start_posture``."""
        if start is None:
            rng, behaviour = np.random.default_rng(self.seed), BEHAVIOURS[self.behaviour]
            start = start_posture(behaviour, sim.joint_lower, sim.joint_upper, rng)
        return self.push, start

    def measure(self, trace: Trace, human: Human, sim: Any) -> dict[str, Any]:
        """The figures of the rollout, see ``measure``."""
        return measure(trace, BEHAVIOURS[self.behaviour], JOINTS, *limits_of(sim))

    @property
    def changing(self) -> bool:
        """Whether the force changes during the touch."""
        return self.push.swing > 0.0


def even_push(behaviour: Behaviour, force: float, cell: int | None = None) -> Push:
    """A push that stays as it is, N."""
    return Push({behaviour.patch: (force, cell)}, TOUCH_AT, RELEASE_AT, END_AT - RELEASE_AT)


def cases(rollouts: int, seed: int, forces: Sequence[float] = ()) -> list[ComplianceCase]:
    """Plan the rollouts: evenly pressed ones, and a quarter as many with a changing force.

    Args:
        rollouts: Evenly pressed rollouts a behaviour.
        seed: Seed of forces, cells and postures.
        forces: Forces to take in turn, N; by default drawn from ``TEST_FORCES``.
    """
    rng, skin = np.random.default_rng(seed), Skin.load()
    planned = []
    for index, behaviour in enumerate(BEHAVIOURS):
        cells = skin.slices[behaviour.patch]
        for i in range(rollouts + max(1, rollouts // 4)):
            force = float(forces[i % len(forces)] if forces else rng.uniform(*TEST_FORCES))
            push = even_push(behaviour, force, int(rng.integers(cells.stop - cells.start)))
            if i >= rollouts:
                push = swelling(push, rng)
            planned.append(ComplianceCase(index, int(rng.integers(2**31)), push))
    return planned


def start_posture(
    behaviour: Behaviour, lower: Array, upper: Array, rng: np.random.Generator
) -> Array:
    """Every joint anywhere, the yielding one with room ahead of it.

    Where the arm yields the wrist is upright, as in the teaching: a twisted one would be pushed
    another way than arm_flex can go.
    """
    joint = JOINTS.index(behaviour.joint)
    draw = upright_posture if yields_along(behaviour) else random_posture
    posture = draw(lower, upper, rng)
    ahead = 1.0 if behaviour.direction < 0 else 0.0
    share = ROOM * ahead + (1.0 - ROOM) * rng.uniform()
    posture[joint] = lower[joint] + share * (upper[joint] - lower[joint])
    return posture


def measure(
    trace: Trace,
    behaviour: Behaviour,
    joints: tuple[str, ...],
    lower: Array,
    upper: Array,
    max_speed: Array,
) -> dict[str, Any]:
    """The figures of one rollout.

    Returns:
        ``motion`` of the touched point, ``displacement`` (rad, along the wanted direction),
        ``force`` (N, mean), ``speed`` (rad/s, mean, signed along the wanted direction),
        ``tracking`` (correlation of force and speed), ``drift`` (rad or m), ``others`` (largest
        motion of another joint, rad or m), ``violations``.
    """
    index, strength = joints.index(behaviour.joint), trace.strength
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
        "motion": motion(trace),
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
        figures["force"] = float(strength[first : last + 1].mean())
        figures["speed"] = float(
            (position[last] - position[first]) / (trace.time[last] - trace.time[first])
        )
        figures["tracking"] = tracking(
            strength[first : last + 1], position[first : last + 1], period
        )
    return figures


def succeeded(figures: dict[str, Any]) -> bool:
    """Whether the right joint went the right way and the others stayed.

    Args:
        figures: What ``measure`` found.
    """
    return bool(figures["displacement"] > MOVED and figures["others"] < STAYED)


def yields_along(behaviour: Behaviour) -> bool:
    """Whether the touched point is to go where it is pushed: the arm's does, a wrist's turns."""
    return behaviour.joint == "arm_flex_joint"


def led(planned: Sequence[ComplianceCase]) -> list[ComplianceCase]:
    """The cases that are compared with the demonstrator's law along the force: the arm's."""
    return [case for case in planned if yields_along(BEHAVIOURS[case.behaviour])]


def summarise(
    planned: Sequence[ComplianceCase],
    figures: Sequence[dict[str, Any]],
    teacher: Sequence[dict[str, Any]],
) -> dict[str, Any]:
    """The figures of every behaviour over its rollouts.

    Args:
        planned: The cases.
        figures: What ``measure`` found for each.
        teacher: What it measured of the demonstrator's law for those of ``led``.

    Returns:
        ``behaviours``, by name: figures of the yielding joint, and ``with_force`` (arm),
        share of rollouts with a cos above 0.7, or ``correct_turn`` (wrist), share that turns in
        the taught sense. Over all: ``along_force``, ``with_force``, ``correct_turn``,
        ``limit_violations``.
    """
    behaviours = {}
    for index, behaviour in enumerate(BEHAVIOURS):
        mine = [(c, f) for c, f in zip(planned, figures) if c.behaviour == index]
        even = [f for c, f in mine if not c.changing]
        pairs = [(f["force"], f["speed"]) for f in even if np.isfinite(f["speed"])]
        forces, speeds = np.array(pairs).reshape(-1, 2).T
        tracked = [f["tracking"] for c, f in mine if c.changing]
        if yields_along(behaviour):
            moved = {"with_force": float(np.mean([f["motion"].cos > ALONG for _, f in mine]))}
        else:
            moved = {"correct_turn": float(np.mean([f["displacement"] > MOVED for _, f in mine]))}
        behaviours[behaviour.name] = {
            "rollouts": len(mine),
            "direction_correct": float(np.mean([f["displacement"] > 0.005 for _, f in mine])),
            **moved,
            "spearman": spearman(forces, speeds),
            "r2": r_squared(forces, speeds),
            "tracking": float(np.mean(np.nan_to_num(tracked, nan=0.0))),
            "tracking_min": float(np.min(np.nan_to_num(tracked, nan=0.0))),
            "release_drift_rad": float(np.max([f["drift"] for _, f in mine])),
            "others_moved": float(np.max([f["others"] for _, f in mine])),
            "velocities": [[float(f), float(s)] for f, s in pairs],
        }
    along = [f["motion"] for c, f in zip(planned, figures) if yields_along(BEHAVIOURS[c.behaviour])]
    return {
        "behaviours": behaviours,
        "along_force": along_force.summarise(along, [f["motion"] for f in teacher]),
        **{
            key: float(np.mean([b[key] for b in behaviours.values() if key in b]))
            for key in ("with_force", "correct_turn")
        },
        "limit_violations": int(sum(f["violations"] for f in figures)),
    }
