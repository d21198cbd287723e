"""Displacements of a mobile base, seen from the base.

A robot that drives forwards does the same wherever it stands: what is stored of the base's joints
x and y is their displacement in the base's own frame, turned back by its yaw ψ,

    (Δx, Δy)_base = R(−ψ) (Δx, Δy).
"""

import numpy as np
from numpy.typing import NDArray

from hasm_torch.body import Body

Array = NDArray[np.float64]


def base_indices(body: Body) -> list[int]:
    """Indices of the base's joints x, y and yaw; empty for a robot that stands still."""
    return [body.joints.index(name) for name in body.base]


def into_base(displacement: Array, yaw: Array | float, base: list[int]) -> Array:
    """Displacements as the base sees them.

    Args:
        displacement: (..., J) of all joints, rad or m.
        yaw: (...) yaw of the base, rad.
        base: See ``base_indices``.

    Returns:
        (..., J).
    """
    return out_of_base(displacement, -np.asarray(yaw), base)


def out_of_base(displacement: Array, yaw: Array | float, base: list[int]) -> Array:
    """The inverse of ``into_base``."""
    if not base:
        return displacement
    if not (displacement[..., base[0]].any() or displacement[..., base[1]].any()):
        return displacement
    turned = displacement.copy()
    x, y = displacement[..., base[0]], displacement[..., base[1]]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turned[..., base[0]], turned[..., base[1]] = cosine * x - sine * y, sine * x + cosine * y
    return turned
