"""The teaching laws: how a robot that is taught by touch answers the finger.

    what finger and skin say ──law──► joint speeds ──┐
    previous target ─────────────────────────────────┴─► target

A teacher is a policy that knows the simulation: it is rolled out like a memory, both to record
demonstrations and to show what a memory can reach at best.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.robot import JOINTS, PATCHES
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.grasp_path import grasp_poses
from hasm_torch.sim.scene import OBJECT_POSITION
from hasm_torch.sim.tasks import (
    ARM_JOINTS,
    BASE_JOINTS,
    BASE_RANGE,
    BEHAVIOURS,
    COMPLIANCE_SPEED,
    GRASP_PATCH,
    GRASP_SPEED,
    REACH_PATCH,
    TORSO_PATCHES,
    YIELD_DAMPING,
    YIELD_GAIN,
)
from hasm_torch.sim.touch_env import CONTROL_RATE, TouchEnv

Array = NDArray[np.float64]

# Of the joints' speed limits, this much is used: the servo that follows needs the rest.
SPEED_SHARE = 0.9
# How far a target may be ahead of a joint, s at its speed limit: a servo at full speed lags by 0.1
# (arm) to 0.15 (base); what something blocks does not run off when it is let go.
LEAD_TIME = 0.15
# Poses to which the touch of each patch leads, see `GRASP_POSES`.
_STAGES = {REACH_PATCH: ("before", "around"), GRASP_PATCH: ("closed", "lifted")}


HSR_LED = {patch: BASE_JOINTS[:2] if patch in TORSO_PATCHES else ARM_JOINTS for patch in PATCHES}
"""Joints of the HSR that yield to each patch: those of the torso lead the base, others the arm."""


class Teacher(ABC):
    """A law that moves the target of the joints, rolled out like any other policy.

    Attributes:
        target: (J,) what was asked for last, rad or m; None before the first step.

    Args:
        env: The simulation in which it is rolled out.
    """

    def __init__(self, env: TouchEnv) -> None:
        self.env = env
        self.reset()

    def reset(self) -> None:
        """Start a new rollout."""
        self.target: Array | None = None

    def step(self, state: Tensor, skin: Tensor, observation: Tensor | None = None) -> Tensor:
        """One control step.

        Args:
            state: (J,) measured joint positions, rad or m.
            skin: (cells, 3) or flat, forces of the skin's cells, N.
            observation: Not needed: the law knows the simulation.

        Returns:
            (J,) float32 joint targets, within the joint limits.
        """
        measured = state.numpy().astype(np.float64)
        if self.target is None:
            self.target = measured
            self._begin()
        forces = skin.numpy().reshape(-1, 3)
        felt = {p: float(forces[cells].sum()) for p, cells in self.env.skin.slices.items()}
        target = self._move(self.target, measured, felt)
        self.target = np.clip(target, self.env.joint_lower, self.env.joint_upper)
        return torch.from_numpy(self.target.astype(np.float32))

    def _begin(self) -> None:  # noqa: B027  # only some laws prepare anything
        """What is to be known at the start of a rollout."""

    @abstractmethod
    def _move(self, target: Array, measured: Array, felt: dict[str, float]) -> Array:
        """The next target, from the last one, the joints and the force on each patch."""

    def _lead(self, target: Array, speed: Array, measured: Array) -> Array:
        """The target moved on by joint speeds, shortened to what the joints can do."""
        limit = self.env.joint_speed_limit
        share = np.abs(speed / (SPEED_SHARE * limit)).max()
        ahead = LEAD_TIME * limit
        moved = target + speed / max(1.0, share) / CONTROL_RATE
        return np.clip(moved, measured - ahead, measured + ahead)


class YieldTeacher(Teacher):
    """Every touched point moves at `YIELD_GAIN` times the force that the finger applies to it.

    Several touches add up. The joint speeds are damped least squares, weighted by the squared speed
    limits W: ``W Jᵀ (J W Jᵀ + λ² I)⁻¹ v`` with the (3, n) Jacobian J of the pushed point.

    Attributes:
        tilt: (3, 3) rotation from the force to the direction in which the point is led. The
            finger is frictionless, so its force is normal to the skin; a human who teaches leads
            a link a little beside the normal.

    Args:
        env: The simulation in which it is rolled out.
        led: Joints that each patch leads, by default those of the HSR.
    """

    def __init__(self, env: TouchEnv, led: Mapping[str, Sequence[str]] = HSR_LED) -> None:
        super().__init__(env)
        self._dofs = np.array([int(env.model.joint(name).dofadr[0]) for name in env.joints])
        self._led = {patch: np.isin(env.joints, led[patch]) for patch in env.skin.patches}

    def reset(self) -> None:
        """Start a new rollout, led along the force."""
        super().reset()
        self.tilt = np.eye(3)

    def _move(self, target: Array, measured: Array, felt: dict[str, float]) -> Array:
        model, data = self.env.model, self.env.data
        speed = np.zeros(len(self.env.joints))
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_comPos(model, data)  # the Jacobian needs it up to date
        for touch in self.env.touch_points():
            link = model.body(self.env.skin.link[touch.patch]).id
            mujoco.mj_jac(model, data, jacobian, None, touch.point, link)
            led = self._led[touch.patch]
            weights = self.env.joint_speed_limit[led] ** 2
            wanted = YIELD_GAIN * self.tilt @ touch.force
            speed[led] += damped_least_squares(jacobian[:, self._dofs[led]], weights, wanted)
        return self._lead(target, speed, measured)


def damped_least_squares(
    jacobian: Array, weights: Array, wanted: Array, damping: float = YIELD_DAMPING
) -> Array:
    """Joint speeds that give a point a velocity, cheaply for the fast joints.

    Args:
        jacobian: (3, n) of the point, m/rad or 1.
        weights: (n,) squared speed limits, rad²/s² or m²/s².
        wanted: (3,) velocity, m/s.
        damping: λ, m/s; limits the joint speeds where the joints cannot do it.

    Returns:
        (n,) rad/s or m/s.
    """
    weighted = weights[:, None] * jacobian.T
    return weighted @ np.linalg.solve(jacobian @ weighted + damping**2 * np.eye(3), wanted)


class ComplianceTeacher(Teacher):
    """The joint of a touched behaviour moves at a speed proportional to the felt force."""

    def _move(self, target: Array, measured: Array, felt: dict[str, float]) -> Array:
        speed = np.zeros(len(JOINTS))
        for behaviour in BEHAVIOURS:
            joint = JOINTS.index(behaviour.joint)
            span = self.env.joint_upper[joint] - self.env.joint_lower[joint]
            pace = behaviour.direction * COMPLIANCE_SPEED * span
            speed[joint] += pace * felt[behaviour.patch]
        return self._lead(target, speed, measured)


class GraspTeacher(Teacher):
    """Touch on one patch reaches for the object wherever it stands, on another grasps and lifts.

    The speed along the path is proportional to the felt force.
    """

    env: HSRTouchEnv

    def reset(self) -> None:
        """Start a new rollout."""
        super().reset()
        self._paths: dict[str, tuple[Array, Array]] = {}
        self._travelled = dict.fromkeys(_STAGES, 0.0)

    def progress(self, patch: str) -> float:
        """How much of the path of a patch's stage is done, 0 to 1."""
        if patch not in self._paths:
            return 0.0
        return self._travelled[patch] / float(self._paths[patch][0][-1])

    def _begin(self) -> None:
        place = self.env.object_position
        if place is None:
            raise ValueError('the grasp is taught in the scene "grasp", which has an object')
        self._poses = grasp_poses(self.env, place[:2] - OBJECT_POSITION)

    def _move(self, target: Array, measured: Array, felt: dict[str, float]) -> Array:
        for patch, names in _STAGES.items():
            if felt[patch] == 0.0:
                continue
            if patch not in self._paths:
                path = np.array([target, *(self._poses[name] for name in names)])
                self._paths[patch] = self._mileage(path), path
            mileage, path = self._paths[patch]
            way = self._travelled[patch] + GRASP_SPEED * felt[patch] / CONTROL_RATE
            self._travelled[patch] = way = min(way, float(mileage[-1]))
            target = np.array([np.interp(way, mileage, column) for column in path.T])
        return target

    def _mileage(self, path: Array) -> Array:
        """Distance from the start of a path to each of its poses, joint ranges."""
        span = self.env.joint_upper - self.env.joint_lower
        span[np.isin(JOINTS, BASE_JOINTS)] = BASE_RANGE
        return np.cumsum([0.0, *(np.abs(np.diff(path, axis=0)) / span).max(axis=1)])
