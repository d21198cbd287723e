"""One rollout: a human touches, a policy answers, the simulation moves."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]


class Policy(Protocol):
    """What is rolled out: joint positions and skin in, joint targets out."""

    def reset(self) -> None:
        """Start a new rollout."""

    def step(self, state: Tensor, skin: Tensor) -> Tensor:
        """Target of one control step; see ``HASM.step``."""


class Human(Protocol):
    """Whoever touches the robot with one finger."""

    def touch(self, time: float, state: Array) -> tuple[str | None, float]:
        """Patch to press and force, N, from now on; None leaves the skin alone."""

    def finished(self, time: float, state: Array) -> bool:
        """Whether the rollout is over."""


@runtime_checkable
class Holder(Protocol):
    """Whoever touches several patches of the robot at once."""

    def touches(self, time: float, state: Array) -> dict[str, float]:
        """Force on each patch that is pressed from now on, N; the other skin is left alone."""

    def finished(self, time: float, state: Array) -> bool:
        """Whether the rollout is over."""


@dataclass
class Trace:
    """What happened, one row a control step.

    Attributes:
        time: (T,) s.
        state: (T, joints) measured joint positions, rad or m.
        target: (T, joints) joint targets, rad or m.
        velocity: (T, joints) measured joint speeds, rad/s or m/s.
        force: (T,) force that the fingers really applied, N.
        patch: (T,) name of the (first) patch pressed, or None.
        object_height: (T,) height of the object above its place on the table, m.
        success: What the environment said at the end.
        frames: Pictures, if asked for.
        skin: (T, cells, 3) forces on the skin, N.
    """

    time: Array
    state: Array
    target: Array
    velocity: Array
    force: Array
    patch: list[str | None]
    object_height: Array
    success: bool
    frames: list[NDArray[np.uint8]] = field(default_factory=list)
    skin: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))


def roll_out(
    env: Any,
    policy: Policy,
    human: Human | Holder,
    joints: Array,
    seed: int,
    object_offset: tuple[float, float] = (0.0, 0.0),
    frame_every: int = 0,
    watch: Callable[[Policy], None] | None = None,
) -> Trace:
    """Roll a policy out.

    Args:
        env: A ``HSRTouchEnv``.
        policy: The policy; it is reset first.
        human: Who touches the robot.
        joints: (joints,) start positions, rad or m.
        seed: Seed of the environment.
        object_offset: How far the object stands from its usual place, m.
        frame_every: Take a picture every so many steps; 0 takes none.
        watch: Called with the policy after every step.

    Returns:
        What happened.
    """
    sim = env.unwrapped
    observation, info = env.reset(seed=seed, options={"joints": joints, "object": object_offset})
    policy.reset()
    names = ("time", "state", "target", "velocity", "force", "skin", "patch", "height")
    rows: dict[str, list[Any]] = {name: [] for name in names}
    frames: list[NDArray[np.uint8]] = []
    success = False
    time, state = float(info["time"]), np.asarray(observation["state"], dtype=np.float64)
    while not human.finished(time, state):
        if isinstance(human, Holder):
            sim.touch_all(human.touches(time, state))
        else:
            sim.touch(*human.touch(time, state))
        target = policy.step(
            torch.from_numpy(observation["state"]), torch.from_numpy(observation["tactile"])
        ).numpy()
        if watch is not None:
            watch(policy)
        observation, _, _, truncated, info = env.step(target)
        time, state = float(info["time"]), np.asarray(observation["state"], dtype=np.float64)
        success = bool(info["is_success"])
        motion = (time, state, target, sim.joint_velocity)
        touch = (info["finger_force"], sim.skin_forces, info["touched"])
        for name, value in zip(names, (*motion, *touch, info["object_height"])):
            rows[name].append(value)
        if frame_every and len(rows["time"]) % frame_every == 0:
            frames.append(env.render())
        if truncated:
            break
    series = {
        name: np.array(rows[name], dtype=np.float64)
        for name in ("time", "state", "target", "velocity", "force", "skin")
    }
    heights = np.array(rows["height"], dtype=np.float64)
    return Trace(
        **series, patch=rows["patch"], object_height=heights, success=success, frames=frames
    )


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
