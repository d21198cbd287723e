"""Names of the HSR's topics, and what its messages mean.

    <prefix>/joint_states                       sensor_msgs/JointState, some joints or all
    <prefix>/skin                               std_msgs/Float32MultiArray, (cells, 3) forces, N
    <prefix>/object                             geometry_msgs/PointStamped in the base frame, m
    <prefix>/<controller>_controller/command    trajectory_msgs/JointTrajectory
    <prefix>/command_velocity                   geometry_msgs/Twist in the base frame, m/s, rad/s
    <prefix>/hasm/emergency_stop, .../release   std_msgs/Empty

The prefix of the HSR is ``/hsrb``; newer stacks have none.
"""

import re
from array import array
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Twist
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray, MultiArrayDimension
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hasm_torch.robot import JOINTS
from hasm_torch.sim.tasks import BASE_JOINTS

Array = NDArray[np.float64]

CONTROLLERS: dict[str, tuple[str, ...]] = {
    "head_trajectory": ("head_pan_joint", "head_tilt_joint"),
    "gripper": ("hand_motor_joint",),
    "arm_trajectory": JOINTS[:5],
}
"""Controllers and their joints; the base is driven by ``command_velocity``. The arm comes last."""

BASE = [JOINTS.index(joint) for joint in BASE_JOINTS]
# Nobody waits for a sensor's old readings; best effort takes those of reliable publishers too.
SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
COMMAND = QoSProfile(depth=1)

_INDEX = {joint: index for index, joint in enumerate(JOINTS)}


def topic(prefix: str, *parts: str) -> str:
    """Name of a topic.

    Raises:
        ValueError: If the prefix is no ROS namespace.
    """
    if not re.fullmatch(r"(/[A-Za-z_]\w*)*", prefix):
        raise ValueError(f"prefix must be empty or a ROS name such as /hsrb, got {prefix!r}")
    return "/".join((prefix, *parts))


def joint_state(position: Array, velocity: Array, time: float) -> JointState:
    """A message of all joints at a time, s."""
    message = JointState(name=list(JOINTS), position=position.tolist(), velocity=velocity.tolist())
    seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
    message.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
    return message


def positions(message: JointState) -> Array:
    """(J,) positions of ``JOINTS`` in a message, rad or m; NaN for those that it does not name."""
    found = np.full(len(JOINTS), np.nan)
    for name, position in zip(message.name, message.position):
        if name in _INDEX:
            found[_INDEX[name]] = position
    return found


def stamp(message: JointState) -> float:
    """When a message says that it was measured, s."""
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def skin_message(forces: NDArray[np.float32]) -> Float32MultiArray:
    """A message of the forces of all cells in the order of ``Skin``, (C, 3), N."""
    message = Float32MultiArray(data=array("f", forces.tobytes()))
    cells, points = forces.shape
    message.layout.dim = [
        MultiArrayDimension(label="cell", size=cells, stride=cells * points),
        MultiArrayDimension(label="point", size=points, stride=points),
    ]
    return message


def trajectory(joints: Sequence[str], position: Array, seconds: float) -> JointTrajectory:
    """A message that sends joints somewhere in some seconds from now."""
    nanoseconds = round(1e9 * seconds)
    after = Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    point = JointTrajectoryPoint(positions=position.tolist(), time_from_start=after)
    return JointTrajectory(joint_names=list(joints), points=[point])


def goals(message: JointTrajectory) -> dict[int, float]:
    """Where a message sends joints in the end, by their index in ``JOINTS``, rad or m."""
    if not message.points:
        return {}
    ends = zip(message.joint_names, message.points[-1].positions)
    return {_INDEX[name]: float(position) for name, position in ends if name in _INDEX}


def twist(ahead: float, left: float, turn: float) -> Twist:
    """A message that drives the base, m/s and rad/s."""
    message = Twist()
    message.linear.x, message.linear.y, message.angular.z = ahead, left, turn
    return message
