"""What the model of every touched robot needs: physics, drives, fingers that push, a lit room."""

from collections.abc import Sequence

import mujoco
import numpy as np

TIMESTEP = 0.002  # s
FINGERS = ("finger", "finger2")  # bodies of thumb and index of the hand that touches
FINGER_RADIUS = 0.008  # m
FINGER_MASS = 0.05  # kg

# Who may touch whom: a pair collides if one's contype meets the other's conaffinity.
SKIN, GRIPPER, SUPPORT = 1, 2, 4

# The drives answer like a critically damped spring of this natural frequency, rad/s, at the
# largest inertia they meet, and more slowly elsewhere: measured speeds never exceed the
# reference's.
_DRIVE_FREQUENCY = 100.0


def set_physics(spec: mujoco.MjSpec) -> None:
    """Time step and solver of a touched robot."""
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # MuJoCo 4.0.0 takes wrong Newton steps with a sparse constraint Jacobian.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 50  # an object in the hand creeps by 0.03 mm/s


def add_drives(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Adds a position actuator to each joint, in that order and of the joint's name."""
    inertia = _largest_inertia(spec, joints)
    for name in joints:
        drive = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        stiffness = inertia[name] * _DRIVE_FREQUENCY**2
        drive.set_to_position(kp=stiffness, kv=2 * inertia[name] * _DRIVE_FREQUENCY)


def _largest_inertia(spec: mujoco.MjSpec, joints: Sequence[str]) -> dict[str, float]:
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
    return {name: float(largest[model.joint(name).id]) for name in joints}


def add_finger(spec: mujoco.MjSpec, name: str) -> None:
    """Adds one of the `FINGERS`: a sphere on three slides that touches skin alone."""
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
        conaffinity=SKIN,
        condim=1,
        solref=[0.006, 1],
        group=3,
    )


def add_room(spec: mujoco.MjSpec) -> None:
    """Adds sky, floor and light."""
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
        contype=SUPPORT,
        conaffinity=0,
    )
    spec.worldbody.add_light(pos=[1.0, -1.5, 2.5], dir=[-0.4, 0.6, -1.0], castshadow=False)
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.45, 0.45, 0.45]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
