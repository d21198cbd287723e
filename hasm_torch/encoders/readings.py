"""Skin readings of any layout as the forces of cells.

A cell gives three normal forces (the paper's skin), one pressure, or a wrench (fx, fy, fz, tx, ty,
tz). A pressure is the first of three forces. A wrench becomes six cells of its patch, one each way
along its sensor's axes, each with the force that pushes that way: their normals weighted by their
forces add up to the direction of the force, as those of a curved patch do. Its torques are left
aside. A robot without skin has one cell that is touched steadily, so that its memory plays back
sequences at their own pace.
"""

import functools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body

FORCES, PRESSURE, WRENCH = 3, 1, 6
STEADY_FORCE = 8.0  # N, that touches a robot without skin
# Outward normals of the six cells that a wrench becomes: a push along +x meets the one facing -x.
PUSHES = (
    (-1.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, -1.0),
    (0.0, 0.0, 1.0),
)


def as_forces(readings: Tensor) -> Tensor:
    """Readings as forces.

    Args:
        readings: (..., cells, channels) with 3, 1 or 6 channels.

    Returns:
        (..., cells, 3), or (..., 6 · cells, 3) for wrenches, in the order of ``PUSHES`` for each
        cell.

    Raises:
        ValueError: If a cell has another number of channels.
    """
    channels = readings.shape[-1] if readings.ndim else 0
    if channels == FORCES:
        return readings
    if channels == PRESSURE:
        return torch.nn.functional.pad(readings, (0, FORCES - PRESSURE))
    if channels != WRENCH:
        raise ValueError(
            f"expected 3 forces, 1 pressure or a wrench of 6 a cell, got {tuple(readings.shape)}"
        )
    force = readings[..., :3]
    pushes = torch.stack([force.clamp(min=0), (-force).clamp(min=0)], dim=-1).flatten(-2)
    return torch.nn.functional.pad(pushes.flatten(-2).unsqueeze(-1), (0, FORCES - PRESSURE))


@functools.cache
def patch_borders(cells: tuple[int, ...]) -> NDArray[np.int64]:
    """First cell of each patch, and behind the last one the number of all cells, (P + 1,).

    Args:
        cells: Number of cells of each patch; patches follow each other.
    """
    borders = np.concatenate([[0], np.cumsum(cells)])
    borders.flags.writeable = False  # all callers share it
    return borders


def pressed(body: Body, patch: str, force: float) -> Tensor:
    """Forces of a robot's cells while one patch is pressed evenly.

    Args:
        body: The robot.
        patch: Name of the patch.
        force: N.

    Returns:
        (cells, 3), N.
    """
    index = body.patches.index(patch)
    borders = patch_borders(tuple(body.cells))
    skin = torch.zeros(int(borders[-1]), FORCES)
    skin[borders[index] : borders[index + 1]] = force / (FORCES * body.cells[index])
    return skin


def forces_of(body: Body, readings: Tensor | None, leading: tuple[int, ...] = ()) -> Tensor:
    """Forces of a robot's cells from its tactile vector.

    Args:
        body: Says how the skin reads.
        readings: (*leading, cells, channels) or (*leading, cells · channels) as the sensor gives
            them; None for a robot without skin.
        leading: Leading dimensions, of which only the number counts where there are readings.

    Returns:
        (*leading, cells, 3).

    Raises:
        ValueError: If the shape does not fit the body.
    """
    if not body.channels:
        return torch.full((*leading, sum(body.cells), FORCES), STEADY_FORCE / FORCES)
    sensors = body.readings // body.channels
    dims = len(leading)
    if readings is not None and readings.ndim == dims + 1 and readings.shape[-1] == body.readings:
        readings = readings.unflatten(-1, (sensors, body.channels))
    if (
        readings is None
        or readings.ndim != dims + 2
        or readings.shape[-2:]
        != (
            sensors,
            body.channels,
        )
    ):
        came = "nothing" if readings is None else tuple(readings.shape)
        before = "..., T, " if leading else ""
        raise ValueError(f"expected skin ({before}{sensors}, {body.channels}) or flat, got {came}")
    return as_forces(readings)
