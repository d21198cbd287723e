"""What forward kinematics needs from a URDF, read in float64."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import torch
from torch import Tensor


@dataclass(frozen=True)
class Mimic:
    """Rule of a joint that follows another: ``q = multiplier * q[joint] + offset``."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        name: joint name.
        type: ``"revolute"``, ``"prismatic"`` or ``"fixed"``; ``continuous`` is read as revolute
            without position limits.
        parent: link before the joint.
        child: link behind the joint.
        origin: (4, 4) float64, pose of the joint in the parent link, m.
        axis: axis of motion in the joint frame.
        lower: lower limit, rad or m; minus infinity where the URDF gives none.
        upper: upper limit, rad or m; infinity where the URDF gives none.
        velocity: highest speed, rad/s or m/s; infinity where the URDF gives none.
        mimic: the joint it follows, or None.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: Tensor
    axis: tuple[float, float, float]
    lower: float
    upper: float
    velocity: float
    mimic: Mimic | None


@dataclass(frozen=True)
class Urdf:
    """Links and joints of a robot.

    Attributes:
        root: the link that is no joint's child.
        links: names of all links.
        joints: all joints, the fixed ones too, by name.
    """

    root: str
    links: tuple[str, ...]
    joints: dict[str, UrdfJoint]

    def rule(self, name: str, given: Sequence[str]) -> tuple[str | None, float, float]:
        """Where the position of a joint comes from if some joints are given.

        Args:
            name: a joint.
            given: joints whose positions are known; all others stand at 0.

        Returns:
            A joint of ``given`` or None, multiplier and offset:
            ``q[name] = multiplier * q[joint] + offset``.
        """
        if name in given:
            return name, 1.0, 0.0
        mimic = self.joints[name].mimic
        if mimic is None:
            return None, 0.0, 0.0
        return (mimic.joint if mimic.joint in given else None), mimic.multiplier, mimic.offset


def read_urdf(path: str | Path) -> Urdf:
    """Read the kinematic tree of a URDF file.

    Args:
        path: the URDF file.

    Returns:
        Its links and joints; shapes and masses are not read.

    Raises:
        ValueError: a joint of another type than revolute, continuous, prismatic or fixed, a joint
            on an unknown link, a mimic rule on a joint that does not move by itself, or more than
            one root link.
    """
    robot = ElementTree.parse(path).getroot()
    links = tuple(element.attrib["name"] for element in robot.findall("link"))
    joints = {j.name: j for j in map(_read_joint, robot.findall("joint"))}
    leaders = [j.name for j in joints.values() if j.type != "fixed" and j.mimic is None]
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(
                    f"joint {joint.name!r} names the link {link!r}; links are: {', '.join(links)}"
                )
        if joint.mimic is not None and joint.mimic.joint not in leaders:
            raise ValueError(
                f"joint {joint.name!r} follows {joint.mimic.joint!r}, which is not a joint that "
                f"moves by itself; those are: {', '.join(leaders)}"
            )
    children = {joint.child for joint in joints.values()}
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise ValueError(f"expected one root link in {path}, found {len(roots)}: {roots}")
    return Urdf(roots[0], links, joints)


def _read_joint(element: ElementTree.Element) -> UrdfJoint:
    name, kind = element.attrib["name"], element.attrib["type"]
    endless = kind == "continuous"
    kind = "revolute" if endless else kind
    if kind not in ("revolute", "prismatic", "fixed"):
        raise ValueError(
            f"joint {name!r} is of type {kind!r}; "
            "valid types are revolute, continuous, prismatic and fixed"
        )
    origin, limit = element.find("origin"), element.find("limit")
    axis, mimic = element.find("axis"), element.find("mimic")
    bounds = {} if limit is None else limit.attrib
    return UrdfJoint(
        name=name,
        type=kind,
        parent=_linked(element, "parent"),
        child=_linked(element, "child"),
        origin=_pose({} if origin is None else origin.attrib),
        # A URDF without <axis> means x.
        axis=(1.0, 0.0, 0.0) if axis is None else _triple(axis.attrib["xyz"]),
        lower=-math.inf if endless else float(bounds.get("lower", -math.inf)),
        upper=math.inf if endless else float(bounds.get("upper", math.inf)),
        velocity=float(bounds.get("velocity", math.inf)),
        mimic=None
        if mimic is None
        else Mimic(
            mimic.attrib["joint"],
            float(mimic.attrib.get("multiplier", 1.0)),
            float(mimic.attrib.get("offset", 0.0)),
        ),
    )


def _linked(element: ElementTree.Element, tag: str) -> str:
    found = element.find(tag)
    if found is None:
        raise ValueError(f"joint {element.attrib['name']!r} has no <{tag} link=...>")
    return found.attrib["link"]


def _triple(text: str) -> tuple[float, float, float]:
    x, y, z = map(float, text.split())
    return x, y, z


def _pose(attributes: dict[str, str]) -> Tensor:
    """(4, 4) pose of an ``<origin>``: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch, yaw = _triple(attributes.get("rpy", "0 0 0"))
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    x, y, z = _triple(attributes.get("xyz", "0 0 0"))
    return torch.tensor(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ],
        dtype=torch.float64,
    )
