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
from hasm_torch.sim.cell_shape import hexagon_vertices

Array = NDArray[np.float64]

SCENES = ("compliance", "grasp")
TIMESTEP = 0.002  # s
FINGERS = ("finger", "finger2")  # bodies of thumb and index of the hand that touches
FINGER_RADIUS = 0.008  # m
FINGER_MASS = 0.05  # kg

# Who may touch whom: a pair collides if one's contype meets the other's conaffinity.
_SKIN, _GRIPPER, _SUPPORT = 1, 2, 4

# The drives answer like a critically damped spring of this natural frequency, rad/s, at the
# largest inertia they meet, and more slowly elsewhere: measured speeds never exceed the
# reference's.
_DRIVE_FREQUENCY = 100.0
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
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # MuJoCo 4.0.0 takes wrong Newton steps with a sparse constraint Jacobian.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 50  # an object in the hand creeps by 0.03 mm/s
    _add_drives(spec)
    _add_skin(spec, skin)
    for name in FINGERS:
        _add_finger(spec, name)
    spec.add_mesh(name="cell", uservert=hexagon_vertices().ravel())
    _add_room(spec)
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
            geom.contype = _GRIPPER if collides and gripper else 0
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
    inertia = _largest_inertia(spec)
    for name in JOINTS:
        drive = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        stiffness = inertia[name] * _DRIVE_FREQUENCY**2
        drive.set_to_position(kp=stiffness, kv=2 * inertia[name] * _DRIVE_FREQUENCY)
        if name == "hand_motor_joint":
            drive.forcelimited = True
            drive.forcerange = [-_HAND_TORQUE, _HAND_TORQUE]
            spec.joint(name).frictionloss = _HAND_FRICTION


def _largest_inertia(spec: mujoco.MjSpec) -> dict[str, float]:
    """The largest inertia each joint moves over 64 postures, its mimic followers included.

    The base, which has no range, stays at 0: where it stands changes no inertia.
    """
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    matrix = np.zeros((model.nv, model.nv))
    largest = np.zeros(model.njnt)
    drives = np.eye(model.nv)
    for follower, leader, polynomial in zip(
        model.eq_obj1id, model.eq_obj2id, model.eq_data, strict=True
    ):
        drives[leader, follower] = polynomial[1]
    for _ in range(64):
        data.qpos[:] = rng.uniform(model.jnt_range[:, 0], model.jnt_range[:, 1])
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        largest = np.maximum(largest, np.diag(drives @ matrix @ drives.T))
    return {name: float(largest[model.joint(name).id]) for name in JOINTS}


def _add_skin(spec: mujoco.MjSpec, skin: Skin) -> None:
    for name, surface in skin.surfaces.items():
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, surface.axes.T.flatten().numpy())
        spec.body(skin.link[name]).add_geom(
            name=f"skin/{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=surface.centre.numpy(),
            quat=quaternion,
            size=surface.half_size.numpy(),
            mass=0,
            contype=_SKIN,
            conaffinity=0,
            condim=1,
            group=1,
            rgba=[0.16, 0.2, 0.19, 1],
        )


def _add_finger(spec: mujoco.MjSpec, name: str) -> None:
    finger = spec.worldbody.add_body(name=name, gravcomp=1)
    for axis in range(3):
        finger.add_joint(
            name=f"{name}/{'xyz'[axis]}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=np.eye(3)[axis]
        )
    # Frictionless: the skin measures normal forces, the finger gives nothing else.
    finger.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[FINGER_RADIUS, 0, 0],
        mass=FINGER_MASS,
        contype=0,
        conaffinity=_SKIN,
        condim=1,
        solref=[0.006, 1],
        group=3,
    )


def _add_room(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.7, 0.75, 0.8],
        width=64,
        height=384,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.82, 0.83, 0.85],
        rgb2=[0.76, 0.77, 0.79],
        width=128,
        height=128,
    )
    spec.add_material(name="floor", textures=["", "floor"], texrepeat=[20, 20])
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[5, 5, 0.1],
        material="floor",
        contype=_SUPPORT,
        conaffinity=0,
    )
    spec.worldbody.add_light(pos=[1.0, -1.5, 2.5], dir=[-0.4, 0.6, -1.0], castshadow=False)
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.45, 0.45, 0.45]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]


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
        contype=_SUPPORT,
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
        conaffinity=_GRIPPER | _SUPPORT,
    )
    _make_grippy(item.geoms[0])
