"""The poses of the grasp for an object that stands beside its usual place.

nominal pose ──hand moved with the object──► wanted hand ──inverse kinematics──► pose
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.tasks import GRASP_POSES

Array = NDArray[np.float64]

_HAND = "hand_palm_link"
_ITERATIONS, _REACHED = 50, 1e-6  # m and rad
_REGULAR = 1e-9  # keeps the equations solvable where too few joints are left


def grasp_poses(env: HSRTouchEnv, offset: Array) -> dict[str, Array]:
    """The poses of `GRASP_POSES` with the hand moved as the object is, equally oriented.

    Arm and base share the way so that the change of the joints from the nominal pose is the least,
    each measured in its speed limit.

    Args:
        env: Gives the robot's model, limits and speeds.
        offset: (2,) displacement of the object in x and y of `odom`, m.

    Returns:
        Pose name to (J,) joint positions, rad or m.

    Raises:
        ValueError: The hand cannot get there.
    """
    shift = np.array([*offset, 0.0])
    return {name: _moved(env, np.array(pose), shift) for name, pose in GRASP_POSES.items()}


def _moved(env: HSRTouchEnv, nominal: Array, shift: Array) -> Array:
    model, data = env.model, mujoco.MjData(env.model)
    joints = [model.joint(name) for name in JOINTS]
    addresses = [int(joint.qposadr[0]) for joint in joints]
    dofs = [int(joint.dofadr[0]) for joint in joints]
    hand = model.body(_HAND).id
    jacobian, turn = np.zeros((6, model.nv)), np.zeros(3)

    def place(pose: Array) -> tuple[Array, Array]:
        data.qpos[addresses] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], hand)
        return data.xpos[hand].copy(), data.xquat[hand].copy()

    position, orientation = place(nominal)
    weights, origin, pose = env.joint_speed_limit**2, nominal, nominal
    for _ in range(_ITERATIONS):
        there, turned = place(pose)
        mujoco.mju_subQuat(turn, orientation, turned)
        # The difference of the orientations is given in the hand's frame.
        error = np.concatenate([position + shift - there, data.xmat[hand].reshape(3, 3) @ turn])
        if np.abs(error).max() < _REACHED:
            return pose
        # The least weighted change from the nominal pose for which the linearised hand is there.
        along = jacobian[:, dofs]
        wanted = error + along @ (pose - origin)
        weighted = weights[:, None] * along.T
        square = along @ weighted + _REGULAR * np.eye(6)
        pose = origin + weighted @ np.linalg.solve(square, wanted)
        # A joint that would leave its range stays at its end, and the others do without it.
        within = np.clip(pose, env.joint_lower, env.joint_upper)
        origin = np.where(pose == within, origin, within)
        weights, pose = np.where(pose == within, weights, 0.0), within
    raise ValueError(
        f"the hand cannot be moved by ({shift[0]:.3f}, {shift[1]:.3f}) m from the pose "
        f"{np.round(nominal, 3).tolist()}: still {np.abs(error).max():.1e} m or rad away"
    )
