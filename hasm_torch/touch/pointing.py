"""From a mouse to a finger: which cell was hit, and how hard a drag pushes.

press ──Ray──► cells that face the viewer ──► the nearest one
drag, pixels ──FORCE_A_PIXEL──► force, at most a finger's
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import Skin
from hasm_torch.sim.env import LARGEST_FORCE

Array = NDArray[np.float64]

FORCE_A_PIXEL = 0.1  # N: 60 pixels push with the teaching force, 150 with the largest one
HIT = 0.014  # m from the centre of a cell, whose side is that long: inside it
SAME = 0.01  # m of depth: cells that are hit as near to each other are of one patch
NEAR = 0.03  # m from the line of sight: beside a patch, whose border is half a cell wide


class Ray(NamedTuple):
    """A line of sight in `odom`.

    Attributes:
        origin: (3,) where the viewer's eye is, m.
        direction: (3,) where it looks; of any length but zero.
    """

    origin: Array
    direction: Array


class Cells(NamedTuple):
    """The skin's cells in `odom`.

    Attributes:
        positions: (C, 3) centres, m.
        normals: (C, 3) outward unit normals.
    """

    positions: Array
    normals: Array


def cells_in_world(model: mujoco.MjModel, data: mujoco.MjData, skin: Skin) -> Cells:
    """Where the cells of a simulated robot are.

    Args:
        model: Model of the scene.
        data: Simulation, with up-to-date kinematics.
        skin: Geometry of the cells.
    """
    positions, normals = np.empty((skin.cells, 3)), np.empty((skin.cells, 3))
    for patch, cells in skin.slices.items():
        body = data.body(model.body(skin.link[patch]).id)
        rotation = body.xmat.reshape(3, 3)
        positions[cells] = skin.positions[cells].numpy() @ rotation.T + body.xpos
        normals[cells] = skin.normals[cells].numpy() @ rotation.T
    return Cells(positions, normals)


def hit_cell(ray: Ray, cells: Cells) -> int | None:
    """The cell that a viewer points at.

    Only cells that face the viewer count. Of those under the pointer the first one is hit; where
    there is none, the one nearest to the line of sight, if it is near.

    Args:
        ray: The line of sight.
        cells: The cells.

    Returns:
        Index of the cell, or None where the viewer points at no skin.
    """
    direction = np.asarray(ray.direction, dtype=np.float64)
    length = float(np.linalg.norm(direction))
    if not np.isfinite(length) or length == 0.0 or not np.isfinite(ray.origin).all():
        return None
    direction = direction / length
    away = cells.positions - ray.origin
    height = (cells.normals * away).sum(axis=1)
    middle = away @ direction
    facing = np.flatnonzero((height < 0) & (cells.normals @ direction < 0) & (middle > 0))
    if not len(facing):
        return None
    away, height, normals = away[facing], height[facing], cells.normals[facing]
    depth = height / (normals @ direction)  # where the line of sight meets the cell's plane
    aside = np.linalg.norm(depth[:, None] * direction - away, axis=1)
    inside = aside <= HIT
    if inside.any():
        first = inside & (depth <= depth[inside].min() + SAME)
        return int(facing[np.where(first, aside, np.inf).argmin()])
    beside = np.linalg.norm(away - middle[facing, None] * direction, axis=1)
    nearest = int(beside.argmin())
    return int(facing[nearest]) if beside[nearest] <= NEAR else None


def patch_of(skin: Skin, cell: int) -> tuple[str, int]:
    """Patch of a cell, and its number there."""
    for patch, cells in skin.slices.items():
        if cells.start <= cell < cells.stop:
            return patch, cell - cells.start
    raise ValueError(f"cell must be 0 to {skin.cells - 1}, got {cell}")


def drag_force(pixels: float) -> float:
    """Force of a drag, N, which grows with its length up to what a finger can do.

    Args:
        pixels: How far the mouse is from where it was pressed.
    """
    if not np.isfinite(pixels):
        return 0.0
    return float(np.clip(FORCE_A_PIXEL * pixels, 0.0, LARGEST_FORCE))
