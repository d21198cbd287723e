"""The body that a dataset describes: joint limits, skin of any layout, what else is bound."""

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hasm_torch._assets import asset_path
from hasm_torch.body import Body
from hasm_torch.data.episodes import EpisodeSet
from hasm_torch.data.skin import SkinPatch
from hasm_torch.encoders.readings import PUSHES, WRENCH
from hasm_torch.episode import Episode
from hasm_torch.robot.kinematics import Kinematics
from hasm_torch.robot.turns import link_turns, planar_base, rigid_body
from hasm_torch.robot.urdf import UrdfJoint, read_urdf

# A position beyond its limits by more than this share of the range is worth a warning; by more
# than FAR it is another unit or another joint.
BEYOND, FAR = 0.01, 0.5
# Faster than the speed limit by this factor: the frame rate is wrong.
TOO_FAST = 2.0
DEGREES = ("deg", "degree", "degrees", "°")
FROM_DATA = "the range of the data"
UPWARD = [0.0, 0.0, 1.0]  # normal of a cell of which the dataset tells none


class Limits(NamedTuple):
    """Limits of every joint, in the dataset's units and order."""

    lower: list[float]
    upper: list[float]
    max_speed: list[float]


def body_of(data: EpisodeSet, urdf: Path | None = None) -> Body:
    """Joints and skin of a dataset.

    Args:
        data: The episodes; each is looked at once or twice.
        urdf: The robot's URDF. Without it, it is the bundled HSR's where that has all of the
            dataset's joints; else limits are the range of the data, and directions of touch stay
            in their link's frame.

    Returns:
        The body, in the order of the dataset's vectors. A joint that the URDF does not limit has
        no limits.

    Raises:
        FileNotFoundError: If there is no URDF where it is looked for.
        ValueError: If the URDF lacks one of the joints, or the data cannot be in its units.
    """
    limits, chosen = limits_of(data, urdf), _urdf_of(data, urdf)
    patches = list((data.skin or {}).values())
    cells = [_cells_of(patch) for patch in patches] or [[UPWARD]]
    parts = [patch.link or f"patch {patch.name}" for patch in patches]  # a body each if unknown
    body = Body(
        joints=list(data.joints),
        lower=limits.lower,
        upper=limits.upper,
        max_speed=limits.max_speed,
        patches=[patch.name.replace(".", "_") for patch in patches] or ["sequence"],
        cells=[len(normals) for normals in cells],
        normals=[normal for normals in cells for normal in normals],
        links=[patch.link or "" for patch in patches] or [""],
        groups=[parts.index(part) for part in parts] or [0],
        observations=dict(data.observations),
        targets=list(data.action_names) if data.reordered else [],
        rate=float(data.fps),
        channels=patches[0].channels if patches else 0,
        unit=patches[0].unit if patches else "N",
    )
    return body if chosen is None else _jointed(body, chosen)


def _jointed(body: Body, urdf: Path) -> Body:
    """The body with what its URDF says of base, links and rigid parts."""
    kinematics = Kinematics(urdf, body.joints)
    robot = kinematics.robot
    known = [link for link in dict.fromkeys(body.links) if link in robot.links]
    if strange := sorted(set(body.links) - {*known, ""}):
        warnings.warn(
            f"{urdf} has no link {', '.join(strange)}, which carry skin in the dataset: directions "
            "of touch stay in these links' own frames",
            stacklevel=3,
        )
    rigid = [
        rigid_body(robot, link) if link in known else str(group)
        for link, group in zip(body.links, body.groups)
    ]
    return replace(
        body,
        base=planar_base(robot, body.joints),
        chains={link: link_turns(kinematics, body.joints, link) for link in known},
        groups=[rigid.index(part) for part in rigid],
    )


def describe_body(data: EpisodeSet, body: Body, urdf: Path | None = None) -> list[str]:
    """Where limits and touch of ``body_of`` come from, a line each, for people."""
    lines = [f"joint limits: {_urdf_of(data, urdf) or FROM_DATA}"]
    if body.base:
        lines.append(f"mobile base: {', '.join(body.base)}")
    if not data.skin or not body.channels:
        lines.append("no touch in this dataset: a plain sequence memory")
    else:
        kind = {1: "pressure", 3: "3 forces", 6: "wrench"}[body.channels]
        unit = next(iter(data.skin.values())).unit
        sensors = body.readings // body.channels
        lines.append(f"touch: {sensors} cells x {kind}, {len(body.patches)} patches, unit: {unit}")
    if body.observations:
        bound = (f"{name} ({entries})" for name, entries in body.observations.items())
        lines.append(f"bound besides: {', '.join(bound)}")
    if data.unused:
        lines.append(f"not used, since the memory takes no pictures: {', '.join(data.unused)}")
    return lines


def limits_of(data: EpisodeSet, urdf: Path | None = None) -> Limits:
    """Joint limits of a dataset; arguments and errors as in ``body_of``."""
    chosen = _urdf_of(data, urdf)
    if chosen is None:
        return Limits(*_widened(*_range(data)))
    joints = _urdf_joints(data, chosen)
    _check_units(data, joints, chosen)
    lower = np.array([joint.lower for joint in joints])
    upper = np.array([joint.upper for joint in joints])
    speed = np.array([joint.velocity for joint in joints])
    free = ~np.isfinite(upper - lower)
    lower[free], upper[free] = -np.inf, np.inf
    if not np.isfinite(speed).all():
        speed = np.where(np.isfinite(speed), speed, _widened(*_range(data))[2])
    _check_positions(data, joints, lower, upper, chosen)
    _check_speeds(data, joints, chosen)
    return Limits(lower.tolist(), upper.tolist(), speed.tolist())


def _urdf_of(data: EpisodeSet, urdf: Path | None) -> Path | None:
    """The URDF by option, else the bundled one where it has the dataset's joints, else none."""
    bundled = asset_path("hsr.urdf")
    known = urdf is None and set(data.joints) <= set(read_urdf(bundled).joints)
    return bundled if known else urdf


def _urdf_joints(data: EpisodeSet, urdf: Path) -> list[UrdfJoint]:
    if not urdf.is_file():
        raise FileNotFoundError(f"no URDF at {urdf}: check --robot.urdf")
    joints = {j.name: j for j in read_urdf(urdf).joints.values() if j.type != "fixed"}
    missing = [name for name in data.joints if name not in joints]
    if missing:
        raise ValueError(
            f"{urdf} has no moving joint {', '.join(missing)} of dataset {data.root}; its joints: "
            f"{', '.join(joints)}. Name the dataset's joints as the URDF does, or leave the URDF "
            "out: the limits are then the range of the data"
        )
    return [joints[name] for name in data.joints]


def _check_units(data: EpisodeSet, joints: Iterable[UrdfJoint], urdf: Path) -> None:
    for joint, unit in zip(joints, data.units):
        if joint.type == "revolute" and unit.lower() in DEGREES:
            raise ValueError(
                f"the state of {data.root} gives {joint.name} in degrees (unit {unit!r}), {urdf} "
                "limits it in radians: convert the dataset to radians, or leave the URDF out so "
                "that the limits are the range of the data"
            )


def _check_positions(
    data: EpisodeSet, joints: list[UrdfJoint], lower: np.ndarray, upper: np.ndarray, urdf: Path
) -> None:
    span = np.where(np.isfinite(upper), upper - lower, 1.0)
    worst = np.full(len(joints), BEYOND)
    found: dict[int, tuple[Episode, int]] = {}
    for episode in data:
        beyond = np.maximum(lower - episode.state, episode.state - upper) / span
        frames = beyond.argmax(axis=0)
        for j in np.flatnonzero(beyond.max(axis=0) > worst):
            worst[j], found[int(j)] = beyond[frames[j], j], (episode, int(frames[j]))
    for j, (episode, frame) in found.items():
        value, joint = episode.state[frame, j], joints[j]
        where = (
            f"{joint.name} in the state of {data.root} reaches {value:.4g} at frame {frame} of "
            f"episode {episode.index}, beyond its limits {lower[j]:.4g} to {upper[j]:.4g} in {urdf}"
        )
        if worst[j] > FAR:
            degrees = joint.type == "revolute" and abs(value) > 2 * math.pi
            raise ValueError(
                f"{where}: "
                + (
                    "this looks like degrees; convert the dataset to radians"
                    if degrees
                    else "check the order of the joints and their units, or name another URDF"
                )
                + ", or leave the URDF out so that the limits are the range of the data"
            )
        warnings.warn(f"{where}; it is taken as the limit", stacklevel=4)


def _check_speeds(data: EpisodeSet, joints: list[UrdfJoint], urdf: Path) -> None:
    limit = np.array([joint.velocity for joint in joints])
    for episode in data:
        if len(episode) < 2:
            continue
        # Not the fastest frames: a jump of a sensor is no matter of the rate.
        speed = np.quantile(np.abs(np.diff(episode.state, axis=0)), 0.9, axis=0) * data.fps
        fast = np.flatnonzero(speed > TOO_FAST * limit)
        if fast.size:
            j = int(fast[0])
            warnings.warn(
                f"{joints[j].name} in the state of {data.root} moves at {speed[j]:.3g} per second "
                f"in episode {episode.index}, {urdf} allows {limit[j]:.3g}: check fps "
                f"({data.fps:g}) in meta/info.json and the unit of the joint",
                stacklevel=4,
            )
            return


def _range(data: EpisodeSet) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and greatest position and greatest speed of each joint, over states and targets."""
    joints = len(data.joints)
    lower, upper = np.full(joints, np.inf), np.full(joints, -np.inf)
    speed = np.zeros(joints)
    for episode in data:
        for series in (episode.state, episode.action):
            if series.shape[1] == joints:
                lower = np.minimum(lower, series.min(axis=0))
                upper = np.maximum(upper, series.max(axis=0))
        if len(episode) > 1:
            steps = np.abs(np.diff(episode.state.astype(np.float64), axis=0)).max(axis=0)
            speed = np.maximum(speed, steps * data.fps)
    if not np.isfinite(lower).all():
        raise ValueError(f"dataset {data.root} has no episode to take joint limits from")
    return lower.astype(np.float64), upper.astype(np.float64), speed


def _widened(
    lower: np.ndarray, upper: np.ndarray, speed: np.ndarray
) -> tuple[list[float], list[float], list[float]]:
    """A joint that stands still gets a little range and speed, for limits must differ."""
    still = upper - lower <= 1e-6 * np.maximum(1.0, np.abs(upper))
    room = np.where(still, 1e-3 * np.maximum(1.0, np.abs(upper)), 0.0)
    slowest = (upper - lower + 2 * room) / 100.0
    return (lower - room).tolist(), (upper + room).tolist(), np.maximum(speed, slowest).tolist()


def _cells_of(patch: SkinPatch) -> list[list[float]]:
    """Unit normal of each cell of a patch as the model takes it."""
    count = patch.cells.stop - patch.cells.start
    if patch.channels == WRENCH:
        return [list(push) for push in PUSHES] * count
    normals = np.zeros((count, 3)) if patch.normals is None else np.array(patch.normals, float)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 0, normals / np.maximum(lengths, 1e-12), UPWARD).tolist()
