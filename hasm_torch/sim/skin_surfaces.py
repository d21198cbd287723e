"""Hexagonal grids of skin cells on a link's shapes: faces of boxes, round sides, meshes.

A cell is a flat hexagon with a thickness; it lies on the link like a plate, and its position is
the centre of its outer face.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from hasm_torch.robot import SkinSurface
from hasm_torch.sim.patch import CLOSED, THICKNESS, Patch

Array = NDArray[np.float64]

_STEEP = np.cos(np.radians(60))  # a cell turned farther from where the patch looks is left out


@dataclass
class Laid:
    """Cells of one patch in the frame of its link.

    Attributes:
        positions: (n, 3) m.
        axes: (n, 3, 3) unit vectors as rows: along the row of cells, across it, outward.
        surface: The box of a flat patch.
    """

    positions: Array
    axes: Array
    surface: SkinSurface | None = None


def rows(width: float, height: float, pitch: float) -> list[Array]:
    """The hexagonal grid with the longest rows that a rectangle around 0 holds.

    Args:
        width: Along the rows, m; whole cells fit in.
        height: Across the rows, m.
        pitch: Between neighbours, m.

    Returns:
        (n, 2) places of each row's cells, m; empty if none fits.
    """
    side = pitch / np.sqrt(3)
    count = int(np.floor((height - 2 * side) / (1.5 * side) + 1e-6)) + 1 if height > 0 else 0
    long = int(np.floor(width / pitch + 1e-6))
    # Every other row is shifted by half a pitch: it has a cell less unless there is room.
    short = long if (long + 0.5) * pitch <= width * (1 + 1e-6) else long - 1
    found = []
    for row in range(count if height >= 2 * side * (1 - 1e-6) else 0):
        cells = short if row % 2 else long
        shift = (0.25 if row % 2 else -0.25) if short == long and count > 1 else 0.0
        u = (np.arange(cells) - (cells - 1) / 2 + shift) * pitch
        found.append(np.column_stack([u, np.full(cells, (row - (count - 1) / 2) * 1.5 * side)]))
    return found


class Shape:
    """A geom in the frame of its link, with rays that meet it."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> None:
        self._model, self._data, self._geom = model, data, geom
        body = model.geom_bodyid[geom]
        self._turn, self._origin = data.xmat[body].reshape(3, 3), data.xpos[body]
        self.name, self.type = model.geom(geom).name, model.geom_type[geom]
        self.size = model.geom_size[geom].copy()
        self.collides = bool(model.geom_contype[geom] | model.geom_conaffinity[geom])
        self.position = (data.geom_xpos[geom] - self._origin) @ self._turn
        self.axes = data.geom_xmat[geom].reshape(3, 3).T @ self._turn  # rows
        reach = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
        box = model.geom_aabb[geom]
        self.corners = self.position + (box[:3] + reach * box[3:]) @ self.axes

    def distance(self, point: Array, direction: Array) -> float:
        """How far a ray goes until it meets the geom, m; infinite if it does not."""
        start, ray = self._origin + self._turn @ point, self._turn @ direction
        if self.type == mujoco.mjtGeom.mjGEOM_MESH:
            way = mujoco.mj_rayMesh(self._model, self._data, self._geom, start, ray)
        else:
            place = self._data.geom_xpos[self._geom], self._data.geom_xmat[self._geom]
            way = mujoco.mju_rayGeom(*place, self.size, start, ray, self.type)
        return way if way >= 0 else np.inf


def _beside(direction: Array) -> Array:
    """A unit vector across a direction: the link's axis that lies most across it, made upright."""
    axis = np.eye(3)[int(np.abs(direction).argmin())]
    across = axis - direction * (axis @ direction)
    return across / np.linalg.norm(across)


def _unit(vector: Sequence[float] | Array) -> Array:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)


def _on_box(shapes: list[Shape], patch: Patch) -> Laid:
    (box,) = shapes
    local = box.axes @ _unit(patch.toward)
    face = int(np.abs(local).argmax())
    u, v = (face + 1) % 3, (face + 2) % 3
    out = np.sign(local[face])
    axes = np.stack([box.axes[u], out * box.axes[v], out * box.axes[face]])
    found = np.concatenate([np.zeros((0, 2)), *rows(2 * box.size[u], 2 * box.size[v], patch.pitch)])
    outer = box.position + axes[2] * (box.size[face] + THICKNESS)
    half = np.array([box.size[u], box.size[v], THICKNESS / 2])
    centre = outer - axes[2] * THICKNESS / 2
    surface = SkinSurface(*(torch.from_numpy(part) for part in (centre, half, axes)))
    return Laid(outer + found @ axes[:2], np.tile(axes, (len(found), 1, 1)), surface)


def _on_round_side(shapes: list[Shape], patch: Patch) -> Laid:
    (shape,) = shapes
    radius, axis = shape.size[0] + THICKNESS, shape.axes[2]
    if patch.pitch > 2 * radius:
        raise ValueError(
            f"patch {patch.name!r}: cells {patch.pitch} m apart do not fit around {patch.link!r}, "
            f"which is {radius:.3f} m in radius with the skin on it"
        )
    middle = _unit(patch.toward) - axis * (axis @ _unit(patch.toward))
    middle = _unit(middle) if np.linalg.norm(middle) > 1e-6 else _beside(axis)
    step = 2 * np.arcsin(patch.pitch / (2 * radius))  # cells are a pitch apart as the crow flies
    covered = np.radians(patch.angle)
    grid = rows(covered / step * patch.pitch, 2 * shape.size[1], patch.pitch)
    if patch.angle == CLOSED:
        around = int(covered / step)
        turns = [
            np.column_stack(
                [(np.arange(around) + row % 2 / 2) / around * covered, np.full(around, cells[0, 1])]
            )
            for row, cells in enumerate(grid)
        ]
    else:
        turns = [cells / (patch.pitch / step, 1.0) for cells in grid]
    angle, height = np.concatenate([np.zeros((0, 2)), *turns]).T
    side = np.cross(axis, middle)
    outward = np.cos(angle)[:, None] * middle + np.sin(angle)[:, None] * side
    along = np.cos(angle)[:, None] * side - np.sin(angle)[:, None] * middle
    positions = shape.position + height[:, None] * axis + radius * outward
    return Laid(positions, np.stack([along, np.tile(axis, (len(angle), 1)), outward], axis=1))


def _on_mesh(shapes: list[Shape], patch: Patch) -> Laid:
    """Cells where rays from outside meet the link: plates on what seven rays a cell tell of it."""
    out = _unit(patch.toward)
    u = _beside(out)
    frame = np.stack([u, np.cross(out, u), out])
    corners = np.clip(np.concatenate([shape.corners for shape in shapes]), *patch.bounds)
    low, high = (corners @ frame.T).min(0), (corners @ frame.T).max(0)
    start = max(float((shape.corners @ out).max()) for shape in shapes) + 1.0
    # Cells reach over the bounds of their centres by half of themselves.
    width, height = (high - low)[:2] + patch.pitch * np.array([1.0, 2 / np.sqrt(3)])
    grid = np.concatenate([np.zeros((0, 2)), *rows(width, height, patch.pitch)])
    angles = np.pi / 6 + np.arange(6) * np.pi / 3
    rim = patch.pitch / np.sqrt(3) * np.column_stack([np.cos(angles), np.sin(angles)])
    foot = np.concatenate([np.zeros((1, 2)), rim])
    positions: list[Array] = []
    axes: list[Array] = []
    for place in grid + (low + high)[:2] / 2:
        feet = place + foot
        starts = feet @ frame[:2] + start * out
        heights = start - np.array([min(s.distance(p, -out) for s in shapes) for p in starts])
        if not np.isfinite(heights).all():
            continue
        slope = np.linalg.lstsq(np.column_stack([foot, np.ones(7)]), heights, rcond=None)[0]
        bumps = heights - foot @ slope[:2] - slope[2]
        normal = _unit(np.array([-slope[0], -slope[1], 1.0]) @ frame)
        # A plate cannot follow an edge or a step that is higher than the cell is thick.
        if normal @ out < _STEEP or np.ptp(bumps) > THICKNESS:
            continue
        centre = place @ frame[:2] + (slope[2] + bumps.max()) * out + THICKNESS * normal
        along = _unit(u - normal * (u @ normal))
        positions.append(centre)
        axes.append(np.stack([along, np.cross(normal, along), normal]))
    return Laid(np.array(positions).reshape(-1, 3), np.array(axes).reshape(-1, 3, 3))


LAYERS = {
    "box": _on_box,
    "capsule": _on_round_side,
    "cylinder": _on_round_side,
    "mesh": _on_mesh,
}
