"""Rotation of links in the base frame, from the rows of ``Body.chains``, in a compiled pass.

R = Π_r  R_fixed,r · Rot(axis_r, m_r q[j_r] + o_r)
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hasm_torch.kernels.compiling import compile_kernel

Array = NDArray[np.float64]


def turn(rows: Array, positions: Array) -> Array:
    """Rotations of one link.

    Args:
        rows: (R, 15) rows of its chain, see ``Body.chains``.
        positions: (K, J) joint positions, rad or m.

    Returns:
        (K, 3, 3), from the link's frame to the base frame.
    """
    rotations: Array = np.empty((len(positions), 3, 3))
    _compiled()(rows, positions, rotations)
    return rotations


@functools.cache
def _compiled() -> Callable[..., None]:
    """The pass, compiled on first use and then cached on disk."""

    def kernel(rows: Any, positions: Any, rotations: Any) -> None:
        local, step = np.empty((3, 3)), np.empty((3, 3))
        for k in range(len(positions)):
            whole = rotations[k]
            whole[:] = 0.0
            whole[0, 0] = whole[1, 1] = whole[2, 2] = 1.0
            for r in range(len(rows)):
                row = rows[r]
                joint, angle = int(row[12]), row[14]
                if joint >= 0:
                    angle += row[13] * positions[k, joint]
                x, y, z = row[9], row[10], row[11]
                c, s = np.cos(angle), np.sin(angle)
                v = 1.0 - c
                local[0, 0], local[1, 1], local[2, 2] = c + x * x * v, c + y * y * v, c + z * z * v
                local[0, 1], local[1, 0] = x * y * v - z * s, x * y * v + z * s
                local[0, 2], local[2, 0] = x * z * v + y * s, x * z * v - y * s
                local[1, 2], local[2, 1] = y * z * v - x * s, y * z * v + x * s
                for factor in range(2):  # first the fixed rotation, then that of the joint
                    for i in range(3):
                        for j in range(3):
                            total = 0.0
                            for m in range(3):
                                other = row[3 * m + j] if factor == 0 else local[m, j]
                                total += whole[i, m] * other
                            step[i, j] = total
                    whole[:] = step

    return compile_kernel(kernel)
