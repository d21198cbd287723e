"""Any robot of an MJCF or URDF, with skin and drives, to be touched and taught.

robot.xml ──load_robot──► spec ──+ skin, drives, fingers──► SkinnedRobot ──body_of_robot──► Body
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.body import Body
from hasm_torch.robot import Skin
from hasm_torch.sim.add_skin import add_skin
from hasm_torch.sim.assemble import (
    FINGERS,
    add_drives,
    add_finger,
    add_room,
    set_physics,
)
from hasm_torch.sim.cell_shape import hexagon_vertices
from hasm_torch.sim.patch import Patch
from hasm_torch.sim.render import View
from hasm_torch.sim.touch_env import CONTROL_RATE, TouchEnv

Array = NDArray[np.float64]

# What geared motors add to the links' inertia, where the model says nothing: they stand firm in a
# push. kg m^2, kg
_ARMATURE = 0.25
STANDING = View((0.0, 0.0, 0.5), 1.8, 126.0, -16.0)
"""How a robot of about a metre is looked at that stands at 0."""


def load_robot(path: Path) -> mujoco.MjSpec:
    """A robot's MJCF or URDF, with every link a body of its own.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no robot's description.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: expected a robot's MJCF or URDF")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"{path} is no MJCF or URDF that MuJoCo reads: {error}") from error
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    return spec


class SkinnedRobot(TouchEnv):
    """A robot of any make whose skin a human touches, see `TouchEnv`.

    Only the skin and the human's fingers touch each other, and links carry no weight, so every
    posture is possible. Joints that are not named are locked where the model has them at 0.

    Args:
        spec: The robot; it is changed.
        patches: Skin to lay out, or one that is laid out.
        joints: Hinges and slides that move.
        speed_limit: (J,) rad/s or m/s.
        home: (J,) where an episode starts unless its reset says otherwise, rad or m.
        view: How the robot is looked at.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: A joint is unknown, or what `add_skin` raises.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        patches: Skin | Sequence[Patch],
        joints: Sequence[str],
        speed_limit: Sequence[float],
        home: Sequence[float],
        view: View = STANDING,
        render_mode: str | None = None,
    ) -> None:
        _leave_joints(spec, joints)
        set_physics(spec)
        add_drives(spec, joints)
        skin = add_skin(spec, patches)
        for name in FINGERS:
            add_finger(spec, name)
        spec.add_mesh(name="cell", uservert=hexagon_vertices().ravel())
        add_room(spec)
        limits = np.array(speed_limit, dtype=np.float64), np.array(home, dtype=np.float64)
        super().__init__(spec.compile(), skin, joints, *limits, view, render_mode)


def _leave_joints(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Locks all other joints and takes away weight, contacts and whatever else drives them."""
    known = [joint.name for joint in spec.joints]
    if unknown := [name for name in joints if name not in known]:
        raise ValueError(f"no joint {', '.join(unknown)}; the joints are: {', '.join(known)}")
    driving = (spec.actuators, spec.equalities, spec.tendons, spec.sensors, spec.keys, spec.pairs)
    for element in [e for group in driving for e in group]:
        spec.delete(element)
    for joint in list(spec.joints):
        if joint.name not in joints:
            spec.delete(joint)
            continue
        joint.damping, joint.frictionloss = np.zeros(3), 0.0  # the drives damp
        joint.armature = joint.armature or _ARMATURE
    for body in spec.bodies[1:]:
        body.gravcomp = 1
        for geom in body.geoms:
            geom.contype = geom.conaffinity = 0


def body_of_robot(env: TouchEnv) -> Body:
    """Joints, limits and skin of a simulated robot, as a model takes them.

    Args:
        env: The robot; its links turn as its MuJoCo model says.

    Raises:
        ValueError: A link with skin turns with a joint that is not among the environment's.
    """
    skin = env.skin
    links = [skin.link[patch] for patch in skin.patches]
    return Body(
        joints=list(env.joints),
        lower=env.joint_lower.tolist(),
        upper=env.joint_upper.tolist(),
        max_speed=env.joint_speed_limit.tolist(),
        patches=list(skin.patches),
        cells=[skin.slices[patch].stop - skin.slices[patch].start for patch in skin.patches],
        normals=skin.normals.tolist(),
        links=links,
        chains={link: _turns(env.model, env.joints, link) for link in dict.fromkeys(links)},
        rate=float(CONTROL_RATE),
    )


def _turns(model: mujoco.MjModel, joints: Sequence[str], link: str) -> list[list[float]]:
    """How a link turns in the world, rows as in `Body.chains`."""
    path = [model.body(link).id]
    while path[-1]:
        path.append(int(model.body_parentid[path[-1]]))
    rows: list[list[float]] = []
    fixed = np.eye(3)
    for body in path[-2::-1]:
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_quat[body])
        fixed = fixed @ turn.reshape(3, 3)
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            name = model.joint(joint).name
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                continue
            if name not in joints or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
                raise ValueError(
                    f"{link!r} turns with {name!r}, expected a hinge among the joints "
                    f"{', '.join(joints)}: name it there, or fix it in the robot's description"
                )
            offset = -float(model.qpos0[model.jnt_qposadr[joint]])
            axis = model.jnt_axis[joint].tolist()
            rows.append([*fixed.ravel().tolist(), *axis, float(joints.index(name)), 1.0, offset])
            fixed = np.eye(3)
    if not np.allclose(fixed, np.eye(3), rtol=0, atol=1e-12):
        rows.append([*fixed.ravel().tolist(), 0.0, 0.0, 1.0, -1.0, 0.0, 0.0])
    return rows
