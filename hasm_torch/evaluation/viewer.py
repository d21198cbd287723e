"""Recordings for the Rerun viewer: joints, skin in 3D, spikes and recall weights over time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS, Kinematics, Skin

Array = NDArray[Any]

CELL_RADIUS = 0.012  # m, half a cell's width
FULL_COLOUR = 4.0  # N in one cell
_IDLE, _PRESSED = np.array([30.0, 90.0, 70.0]), np.array([255.0, 60.0, 20.0])


@dataclass
class Scenes:
    """What a recording shows, one row a sample.

    Attributes:
        time: (T,) s.
        joints: Names of the joints.
        state: (T, joints) rad or m.
        skin: (T, cells, points) forces, or None.
        patches: Names of the patches.
        spikes: (T, patches) spikes in each sample period, or None.
        weights: Touched patch and recall weight of each of its associations, or None without
            touch; empty where no memory was recalled.
        cells: (T, cells, 3) places of the cells in the frame in which the robot stood at the
            start, m, or None.
    """

    time: Array
    joints: list[str]
    state: Array
    skin: Array | None = None
    patches: list[str] = field(default_factory=list)
    spikes: Array | None = None
    weights: Sequence[tuple[str, Array] | None] = field(default_factory=list)
    cells: Array | None = None


def write_recording(path: Path, scenes: Scenes, name: str) -> None:
    """Write an ``.rrd`` file.

    Args:
        path: File to write.
        scenes: What it shows.
        name: Name of the recording in the viewer.
    """
    import rerun as rr

    stream = rr.RecordingStream(name)
    stream.save(path)
    times = [rr.TimeColumn("time", duration=np.asarray(scenes.time, dtype=np.float64))]
    for joint, values in zip(scenes.joints, np.asarray(scenes.state).T):
        stream.send_columns(f"joints/{joint}", times, rr.Scalars.columns(scalars=values))
    if scenes.spikes is not None:
        for patch, values in zip(scenes.patches, np.asarray(scenes.spikes).T):
            stream.send_columns(f"spikes/{patch}", times, rr.Scalars.columns(scalars=values))
    if scenes.skin is not None:
        force = np.abs(scenes.skin).sum(axis=-1)
        stream.send_columns("skin/force", times, rr.Scalars.columns(scalars=force.sum(axis=1)))
        if scenes.cells is not None:
            for i, t in enumerate(scenes.time):
                stream.set_time("time", duration=float(t))
                points = rr.Points3D(scenes.cells[i], colors=colours(force[i]), radii=CELL_RADIUS)
                stream.log("skin/cells", points)
    for t, weights in zip(scenes.time, scenes.weights):
        if weights is not None:
            stream.set_time("time", duration=float(t))
            stream.log(f"recall/{weights[0]}", rr.BarChart(weights[1]))
    stream.flush()


def colours(force: Array) -> NDArray[np.uint8]:
    """(cells, 3) colours, from green without force to red at 4 N."""
    share = np.clip(np.asarray(force) / FULL_COLOUR, 0.0, 1.0)[:, None]
    return (_IDLE + share * (_PRESSED - _IDLE)).astype(np.uint8)


def cell_places(joints: list[str], state: Array) -> Array | None:
    """Places of the HSR's skin cells in the frame odom, (T, cells, 3), m; None for other robots."""
    if list(joints) != list(JOINTS):
        return None
    positions, _ = Skin.load().poses(Kinematics(), torch.as_tensor(np.asarray(state)).double())
    return positions.numpy()
