"""The HSR and its surroundings as a MuJoCo model, built from the URDF and the skin file.

    hsr.urdf ──MjSpec──► robot ──+ drives, skin, fingers──► "compliance"
                                 └─+ table and object──► "grasp"

Names, limits and masses come from the URDF; what is set here is how the joints are driven and
what may touch what.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch._assets import asset_path
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.robot.urdf import read_urdf
from hasm_torch.sim.add_skin import add_skin
from hasm_torch.sim.assemble import (
    FINGERS,
    GRIPPER,
    SUPPORT,
    TIMESTEP,
    add_drives,
    add_finger,
    add_room,
    set_physics,
)
from hasm_torch.sim.cell_shape import hexagon_vertices

Array = NDArray[np.float64]

SCENES = ("compliance", "grasp")
# What the geared motors add to the links' inertia: it also makes them stand firm in a push.
_ARMATURE = {"arm_lift_joint": 4.0, "hand_motor_joint": 0.1}  # kg, kg m^2
_ARM_ARMATURE = 0.25  # kg m^2
# N m on the hand motor: the fingers press an object with about 8 N each. The friction of its
# gears holds most of that when the target is no closer than where the fingers are.
_HAND_TORQUE, _HAND_FRICTION = 2.5, 1.0

TABLE_CENTRE = (0.69, 0.078)  # m
TABLE_HALF_SIZE = (0.16, 0.26, 0.015)  # m
TABLE_HEIGHT = 0.54  # m, top surface
OBJECT_HALF_SIZE = (0.0275, 0.0275, 0.07)  # m
OBJECT_MASS = 0.18  # kg
OBJECT_POSITION = (0.677, 0.078)  # m, where the scripted grasp expects it


def joint_speed_limits() -> Array:
    """Speed limits of `JOINTS` in the URDF, (11,), rad/s or m/s.

    A joint that another one follows is slowed down to what the follower can do.
    """
    joints = read_urdf(asset_path("hsr.urdf")).joints
    speeds = {name: joints[name].velocity for name in JOINTS}
    for joint in joints.values():
        if joint.mimic is not None and joint.mimic.joint in speeds:
            allowed = joint.velocity / abs(joint.mimic.multiplier)
            speeds[joint.mimic.joint] = min(speeds[joint.mimic.joint], allowed)
    return np.array([speeds[name] for name in JOINTS])


def build_model(scene: str, skin: Skin) -> mujoco.MjModel:
    """Compiles a scene.

    Args:
        scene: "compliance" (the robot alone on a floor) or "grasp" (with a table and an object).
        skin: Patches to put on the robot.

    Returns:
        Model with one position actuator for each of the HSR's `JOINTS`, the mobile base's too, in
        that order: the wheels' friction on the floor is left to the base's drives; skin
        geoms named "skin/<patch>"; the bodies `FINGERS` on three slides each; in "grasp" a
        free body "object".

    Raises:
        ValueError: The scene is not known.
    """
    if scene not in SCENES:
        raise ValueError(f"scene must be one of {SCENES}, got {scene!r}")
    spec = _load_robot()
    set_physics(spec)
    _add_drives(spec)
    add_skin(spec, skin)
    for name in FINGERS:
        add_finger(spec, name)
    spec.add_mesh(name="cell", uservert=hexagon_vertices().ravel())
    add_room(spec)
    if scene == "grasp":
        _add_table_and_object(spec)
    return spec.compile()


def _load_robot() -> mujoco.MjSpec:
    """The URDF with all its frames and shapes, joints outside `JOINTS` locked, weight balanced."""
    spec = mujoco.MjSpec.from_string(asset_path("hsr.urdf").read_text())
    followers = {e.name1 for e in spec.equalities if e.name2 in JOINTS}
    for equality in list(spec.equalities):
        if equality.name1 not in followers:
            spec.delete(equality)
        else:
            equality.solref = [2 * TIMESTEP, 1]
            equality.solimp = [0.99, 0.999, 0.001, 0.5, 2]
    for joint in list(spec.joints):
        if joint.name not in JOINTS and joint.name not in followers:
            spec.delete(joint)
            continue
        # The drives damp; what is left here keeps the light finger links well posed.
        joint.damping = np.zeros(3)
        joint.armature = _ARMATURE.get(joint.name, _ARM_ARMATURE)
        if joint.name in followers:
            # The rule alone leads it: the fingers' own limits end 0.09 rad before the motor's.
            joint.armature, joint.limited = 0.0005, False
    for body in spec.bodies[1:]:
        body.gravcomp = 1
        gripper = _inside_hand(body)
        for geom in body.geoms:
            collides = geom.contype != 0
            geom.contype = GRIPPER if collides and gripper else 0
            geom.conaffinity = 0
            geom.group = 3 if collides else 1
            if collides and gripper:
                _make_grippy(geom)
    return spec


def _inside_hand(body: Any) -> bool:
    while body.name != "world":
        if body.name == "hand_palm_link":
            return True
        body = body.parent
    return False


def _make_grippy(geom: Any) -> None:
    geom.condim = 4
    geom.friction = [1.0, 0.02, 0.0001]
    geom.solref = [0.01, 1]


def _add_drives(spec: mujoco.MjSpec) -> None:
    add_drives(spec, JOINTS)
    hand = spec.actuator("hand_motor_joint")
    hand.forcelimited = True
    hand.forcerange = [-_HAND_TORQUE, _HAND_TORQUE]
    spec.joint("hand_motor_joint").frictionloss = _HAND_FRICTION


def _add_table_and_object(spec: mujoco.MjSpec) -> None:
    x, y = TABLE_CENTRE
    thickness = TABLE_HALF_SIZE[2]
    wood = [0.72, 0.58, 0.42, 1]
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[x, y, TABLE_HEIGHT - thickness],
        size=TABLE_HALF_SIZE,
        rgba=wood,
        contype=SUPPORT,
        conaffinity=0,
        # Smooth: an object that one finger meets first slides to the middle and does not tip.
        priority=1,
        condim=4,
        friction=[0.3, 0.005, 0.0001],
    )
    leg = (TABLE_HEIGHT - 2 * thickness) / 2
    for dx in (-1, 1):
        for dy in (-1, 1):
            foot = [x + dx * (TABLE_HALF_SIZE[0] - 0.03), y + dy * (TABLE_HALF_SIZE[1] - 0.03), leg]
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                pos=foot,
                size=[0.015, leg, 0],
                rgba=wood,
                contype=0,
                conaffinity=0,
            )
    item = spec.worldbody.add_body(
        name="object", pos=[*OBJECT_POSITION, TABLE_HEIGHT + OBJECT_HALF_SIZE[2]]
    )
    item.add_freejoint(name="object")
    item.add_geom(
        name="object",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=OBJECT_HALF_SIZE,
        mass=OBJECT_MASS,
        rgba=[0.85, 0.33, 0.22, 1],
        contype=0,
        conaffinity=GRIPPER | SUPPORT,
    )
    _make_grippy(item.geoms[0])
