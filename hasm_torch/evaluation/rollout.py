"""One rollout: a human touches, a policy answers, the simulation moves."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]

FINGERS = 2  # that a human touches with at once


class Policy(Protocol):
    """What is rolled out: joint positions and skin in, joint targets out."""

    def reset(self) -> None:
        """Start a new rollout."""

    def step(self, state: Tensor, skin: Tensor, *, observation: Tensor | None = None) -> Tensor:
        """Target of one control step, see ``HASM.step``; the observation is what else is seen."""


class Human(Protocol):
    """Whoever touches the robot with one or two fingers, and may hold some of its joints."""

    def touches(self, time: float, state: Array) -> Mapping[str, tuple[float, int | None]]:
        """Force, N, and cell (None: the centre) of each patch that is pressed from now on."""

    def holds(self, time: float) -> Sequence[str]:
        """Joints that do not move from now on, whatever the robot wants."""
        return ()

    def finished(self, time: float, state: Array) -> bool:
        """Whether the rollout is over."""


@dataclass
class Trace:
    """What happened, one row a control step; positions and forces in the frame ``odom``.

    Attributes:
        time: (T,) s.
        state: (T, joints) measured joint positions, rad or m.
        target: (T, joints) joint targets, rad or m.
        velocity: (T, joints) measured joint speeds, rad/s or m/s.
        patch: (T, fingers) patch that each finger presses, "" for none.
        cell: (T, fingers) cell of the patch, -1 for none or the patch's centre.
        force: (T, fingers, 3) force that each finger really applied to the skin, N; 0 for none.
        point: (T, fingers, 3) where the pressed point of the skin is, m; NaN for none.
        object: (T, 3) centre of the object, m; NaN without one.
        height: (T,) height of the object above its place on the table, m.
        success: What the environment said at the end.
    """

    time: Array
    state: Array
    target: Array
    velocity: Array
    patch: NDArray[np.str_]
    cell: NDArray[np.int64]
    force: Array
    point: Array
    object: Array
    height: Array
    success: bool

    @classmethod
    def of(cls, rows: Sequence[tuple[Any, ...]], success: bool) -> "Trace":
        """A trace from the rows of its control steps, see ``row_of``."""
        names = [f.name for f in fields(cls) if f.name != "success"]
        columns = {n: np.array(c) for n, c in zip(names, zip(*rows, strict=True), strict=True)}
        return cls(**columns, success=success)

    @property
    def strength(self) -> Array:
        """(T,) force of all fingers together, N, whatever their directions."""
        return np.asarray(np.linalg.norm(self.force, axis=2).sum(axis=1))


def roll_out(
    env: Any,
    policy: Policy,
    human: Human,
    joints: Array,
    seed: int,
    object_offset: tuple[float, float] = (0.0, 0.0),
    watch: Callable[[], None] | None = None,
) -> Trace:
    """Roll a policy out.

    Args:
        env: A ``HSRTouchEnv``.
        policy: The policy; it is reset first.
        human: Who touches the robot.
        joints: (joints,) start positions, rad or m.
        seed: Seed of the environment.
        object_offset: How far the object stands from its usual place, m.
        watch: Called after every step.

    Returns:
        What happened.
    """
    sim = env.unwrapped
    observation, info = env.reset(seed=seed, options={"joints": joints, "object": object_offset})
    policy.reset()
    rows: list[tuple[Any, ...]] = []
    success = False
    time, state = float(info["time"]), np.asarray(observation["state"], dtype=np.float64)
    while not human.finished(time, state):
        sim.touch_all(human.touches(time, state))
        sim.block(human.holds(time))
        target = _ask(policy, observation)
        observation, _, _, truncated, info = env.step(target)
        time, state = float(info["time"]), np.asarray(observation["state"], dtype=np.float64)
        success = bool(info["is_success"])
        rows.append(row_of(sim, target, info))
        if watch is not None:
            watch()
        if truncated:
            break
    return Trace.of(rows, success)


class Case(Protocol):
    """One rollout to be made: where it begins, what the human does, what is measured."""

    @property
    def seed(self) -> int:
        """Seed of the environment."""

    @property
    def place(self) -> tuple[float, float]:
        """How far the object stands from its usual place, m."""

    def begin(self, sim: Any, start: Array | None) -> tuple[Human, Array]:
        """The human, and the start positions (joints,), rad or m; see ``run_case``."""

    def measure(self, trace: Trace, human: Human, sim: Any) -> dict[str, Any]:
        """The figures of the rollout."""


def run_case(
    case: Case,
    env: Any,
    policy: Policy,
    watch: Callable[[], None] | None = None,
    start: Array | None = None,
) -> tuple[Trace, dict[str, Any]]:
    """Roll one case out and measure it.

    Args:
        case: The case.
        env: The environment of its experiment.
        policy: The policy.
        watch: Called after every step.
        start: (joints,) start posture in place of the case's own (compliance, yield) or of the
            usual one, to which the case adds noise (grasp), rad or m.

    Returns:
        The trace and its figures.
    """
    human, begin = case.begin(env.unwrapped, start)
    trace = roll_out(env, policy, human, begin, case.seed, case.place, watch)
    return trace, case.measure(trace, human, env.unwrapped)


def limits_of(sim: Any) -> tuple[Array, Array, Array]:
    """Lower, upper and speed limits of a ``HSRTouchEnv``, (joints,) each, rad or m and a second."""
    return sim.joint_lower, sim.joint_upper, sim.joint_speed_limit


def row_of(sim: Any, target: Array, info: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a ``HSRTouchEnv`` shows after a control step, a row of a ``Trace``."""
    place = sim.object_position
    return (
        *(float(info["time"]), sim.joint_position, target, sim.joint_velocity),
        *_fingers(sim.touch_points()),
        np.full(3, np.nan) if place is None else place,
        info["object_height"],
    )


def _ask(policy: Policy, observation: Mapping[str, Any]) -> Array:
    state, skin = (torch.from_numpy(observation[name]) for name in ("state", "tactile"))
    seen = observation.get("environment_state")
    if seen is None:
        return policy.step(state, skin).numpy()
    return policy.step(state, skin, observation=torch.from_numpy(seen)).numpy()


def _fingers(touches: Sequence[Any]) -> tuple[Any, ...]:
    """Patch, cell, force and point of every finger, those that touch first."""
    idle = [("", None, np.zeros(3), np.full(3, np.nan))] * (FINGERS - len(touches))
    patch, cell, force, point = zip(*touches, *idle)
    return patch, [-1 if c is None else c for c in cell], force, point


def limit_violations(
    trace: Trace, lower: Array, upper: Array, max_speed: Array, tolerance: float = 1e-6
) -> int:
    """Number of control steps in which a joint is outside its position or speed limits.

    Args:
        trace: A rollout.
        lower: (joints,) lower limits, rad or m.
        upper: (joints,) upper limits, rad or m.
        max_speed: (joints,) speed limits, rad/s or m/s.
        tolerance: Rounding allowed for, rad or m (and per second); float32 readings need it.
    """
    outside = (trace.state < lower - tolerance) | (trace.state > upper + tolerance)
    outside |= (trace.target < lower - tolerance) | (trace.target > upper + tolerance)
    fast = np.abs(trace.velocity) > max_speed + tolerance
    return int((outside | fast).any(axis=1).sum())
