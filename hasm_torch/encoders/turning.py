"""The rotation of a link in the base frame: forward kinematics without positions.

    R = Π_r  R_fixed,r · Rot(axis_r, m_r q[j_r] + o_r)

over the rows r of the link's chain, see ``Body.chains``.
"""

import numpy as np
from numpy.typing import NDArray

from hasm_torch import kernels
from hasm_torch.kernels.turning import turn

Array = NDArray[np.float64]


def link_rotation(rows: Array, positions: Array) -> Array:
    """Rotation of a link in the base frame.

    Args:
        rows: (R, 15) rows of its chain.
        positions: (K, J) joint positions, rad or m.

    Returns:
        (K, 3, 3), from the link's frame to the base frame.
    """
    if kernels.enabled():
        return turn(rows, np.ascontiguousarray(positions, dtype=np.float64))
    whole = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    for row in rows:
        joint = int(row[12])
        angle = row[14] + (row[13] * positions[:, joint] if joint >= 0 else 0.0)
        whole = whole @ row[:9].reshape(3, 3) @ _about(row[9:12], angle)
    return whole


def _about(axis: Array, angle: Array | float) -> Array:
    """Rotations (..., 3, 3) about a unit axis (3,) by angles (...)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, versine = np.sin(angle)[..., None, None], (1.0 - np.cos(angle))[..., None, None]
    rotation: Array = np.eye(3) + sine * cross + versine * (cross @ cross)
    return rotation
