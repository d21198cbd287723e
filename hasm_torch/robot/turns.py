"""How a link turns with the joints, as numbers that need neither a URDF nor a chain.

    chain of pytorch-kinematics ──► rows of R_fixed (9), axis (3), joint, multiplier and offset

A link's rotation is the product of R_fixed · Rot(axis, multiplier · q[joint] + offset) over its
rows: what slides is left out, what stands still is folded into the next row.
"""

from collections.abc import Sequence

import torch
from pytorch_kinematics.transforms import axis_and_angle_to_matrix_33
from torch import Tensor

from hasm_torch.robot.kinematics import Kinematics
from hasm_torch.robot.urdf import Urdf, UrdfJoint

_NO_JOINT = [0.0, 0.0, 1.0, -1.0, 0.0, 0.0]  # rest of a row that only turns by its R_fixed


def link_turns(kinematics: Kinematics, joints: Sequence[str], link: str) -> list[list[float]]:
    """Rotation of a link in the frame of the base, as rows.

    Args:
        kinematics: The robot, of any URDF.
        joints: Joints that are given, in the order of the rows' indices. Those that follow one of
            them do so; all others stand at 0.
        link: Name of the link.

    Returns:
        Rows of 15 numbers: R_fixed row by row, axis, index in `joints` (-1: none), multiplier and
        offset, rad. The frame is that of the link that a planar base carries (see `planar_base`),
        or of the root. Only the last row may have no joint; a link that never turns has none.

    Raises:
        ValueError: If there is no such link.
    """
    robot = kinematics.robot
    base = planar_base(robot, joints)
    rows: list[list[float]] = []
    fixed = torch.eye(3, dtype=torch.float64)
    for joint in _path(robot, link):
        built = kinematics.chain.find_frame(joint.child).joint
        fixed = fixed @ built.offset.get_matrix()[0, :3, :3].double().cpu()
        if joint.type != "revolute" or joint.name in base:
            continue
        axis = built.axis.double().cpu()
        leader, multiplier, offset = robot.rule(joint.name, joints)
        if leader is None:
            angle = torch.tensor([offset], dtype=torch.float64)
            fixed = fixed @ axis_and_angle_to_matrix_33(axis, angle)[0]
        else:
            turn = [float(list(joints).index(leader)), multiplier, offset]
            rows.append([*fixed.flatten().tolist(), *axis.tolist(), *turn])
            fixed = torch.eye(3, dtype=torch.float64)
    if not _is_identity(fixed):
        rows.append([*fixed.flatten().tolist(), *_NO_JOINT])
    return rows


def planar_base(robot: Urdf, joints: Sequence[str]) -> list[str]:
    """Joints that move the whole robot over the floor.

    Args:
        robot: The robot.
        joints: Joints that are given: a base counts if all of its joints are among them.

    Returns:
        Names of the joints x, y and yaw: two that slide along x and y and then one that turns about
        z, none with position limits, all alone between the root and the rest of the robot. Empty
        where there is no such base.
    """
    found: dict[str, str] = {}
    link = robot.root
    while len(found) < 3:
        behind = [joint for joint in robot.joints.values() if joint.parent == link]
        if len(behind) != 1 or not _is_identity(behind[0].origin[:3, :3]):
            return []
        joint, link = behind[0], behind[0].child
        if joint.type == "fixed":
            continue
        limited = max(joint.lower, -joint.upper) > -float("inf")
        kind = (joint.type, tuple(value / max(map(abs, joint.axis)) for value in joint.axis))
        part = _BASE_PARTS.get(kind, "none")
        # The yaw is last: x and y are those of the root's frame.
        expected = {"yaw"} if len(found) == 2 else {"x", "y"} - set(found)
        if limited or joint.mimic or joint.name not in joints or part not in expected:
            return []
        found[part] = joint.name
    return [found["x"], found["y"], found["yaw"]] if len(found) == 3 else []


_BASE_PARTS: dict[tuple[str, tuple[float, ...]], str] = {
    ("prismatic", (1.0, 0.0, 0.0)): "x",
    ("prismatic", (0.0, 1.0, 0.0)): "y",
    ("revolute", (0.0, 0.0, 1.0)): "yaw",
}


def rigid_body(robot: Urdf, link: str) -> str:
    """The topmost link to which a link is fixed: one body, as a touch on either of them tells.

    Args:
        robot: The robot.
        link: Name of a link.

    Returns:
        Name of that link: `link` itself where a joint moves it.

    Raises:
        ValueError: If there is no such link.
    """
    for joint in reversed(_path(robot, link)):
        if joint.type != "fixed":
            return joint.child
    return robot.root


def _path(robot: Urdf, link: str) -> list[UrdfJoint]:
    """All joints from the root to a link."""
    if link not in robot.links:
        raise ValueError(f"unknown link {link!r}; valid links are: {', '.join(robot.links)}")
    above = {joint.child: joint for joint in robot.joints.values()}
    path = []
    while link != robot.root:
        path.append(above[link])
        link = above[link].parent
    return path[::-1]


def _is_identity(rotation: Tensor) -> bool:
    return torch.allclose(rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
