"""Place code, tactile embedding and rotation of a few queries in one compiled pass.

A control step codes one query; as some forty tensor operations that takes ten times longer than
the recall itself. The pass does what ``place_code``, ``touch`` and ``rope3d`` do one after the
other, on the CPU and without gradients. Rates are taken in float64 here, so that a level can
differ from theirs where a rate is within rounding of the border between two levels.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hasm_torch.encoders.place_code import CODES, PlaceCode
from hasm_torch.encoders.rope3d import rope3d
from hasm_torch.kernels.compiling import compile_kernel


def block_rotations(dim: int, axis: Tensor, angle: Tensor) -> Tensor:
    """The rotation that RoPE3D applies to each block of three entries.

    Args:
        dim: Entries of a code.
        axis: (3,) rotation axis.
        angle: () rotation angle, rad.

    Returns:
        (blocks, 3, 3), float32 or better.
    """
    blocks = dim // 3
    # Row k holds the k-th unit vector in all blocks, and the code's whole length, on which the
    # frequencies depend.
    basis = torch.eye(3, dtype=axis.dtype, device=axis.device).repeat(1, blocks + 1)[:, :dim]
    turned = rope3d(basis, axis, angle)[:, : 3 * blocks]
    return turned.reshape(3, blocks, 3).permute(1, 2, 0).contiguous()


def encode_query(
    positions: Tensor,
    density: Tensor,
    coder: PlaceCode,
    ranked: int,
    keys: Tensor,
    key_of: Tensor,
    rotations: Tensor,
    rebinarise: bool,
) -> tuple[Tensor, Tensor]:
    """State code s and rotated touch code o of queries.

    Args:
        positions: (..., J) joint positions, rad or m, finite.
        density: (...,) rate density ρ, 0 to 1.
        coder: The place code.
        ranked: Neurons that are ranked together for the touch code: all, or one joint's.
        keys: (L, D) ±1, with one of which the touch code is bound before it is rotated.
        key_of: (...,) which one, int64.
        rotations: (blocks, 3, 3) of ``block_rotations``.
        rebinarise: Whether the rotated code returns to ±1.

    Returns:
        (..., D) and (..., D), float32.
    """
    leading, joints = positions.shape[:-1], positions.shape[-1]
    rows = positions.detach().float().reshape(-1, joints).contiguous()
    state = np.empty((len(rows), coder.code_dim), np.float32)
    touch = np.empty_like(state)
    _compiled()(
        rows.numpy(),
        density.detach().float().expand(leading).reshape(-1).contiguous().numpy(),
        coder.lower.numpy(),
        coder.upper.numpy(),
        coder.neurons,
        coder.bits,
        coder.width,
        CODES.index(coder.code),
        ranked,
        keys.numpy(),
        key_of.expand(leading).reshape(-1).contiguous().numpy(),
        rotations.numpy(),
        rebinarise,
        state,
        touch,
    )
    shape = (*leading, coder.code_dim)
    return torch.from_numpy(state).reshape(shape), torch.from_numpy(touch).reshape(shape)


@functools.cache
def _compiled() -> Callable[..., None]:
    """The pass, compiled on first use and then cached on disk."""
    thermometer, gray = CODES.index("thermometer"), CODES.index("gray")

    def kernel(
        positions: Any, density: Any, lower: Any, upper: Any, neurons: int, bits: int,
        width: float, code: int, ranked: int, keys: Any, key_of: Any, rotations: Any,
        rebinarise: bool, state: Any, touch: Any,
    ) -> None:  # fmt: skip
        rows, joints = positions.shape
        total = joints * neurons
        highest = bits if code == thermometer else 2**bits - 1
        levels = np.empty(total, np.int64)
        counts = np.empty((total // ranked, highest + 1), np.int64)
        for row in range(rows):
            counts[:] = 0
            for joint in range(joints):
                low, high = float(lower[joint]), float(upper[joint])
                at = min(max(float(positions[row, joint]), low), high)
                at = (at - low) / (high - low) * (neurons - 1)
                for neuron in range(neurons):
                    rate = np.exp(-0.5 * ((at - neuron) / width) ** 2)  # eq. tuning_curve
                    if code == thermometer:
                        level = int(np.rint(rate * bits))
                    else:
                        level = int(np.rint(rate * 255)) >> (8 - bits)
                    index = joint * neurons + neuron
                    levels[index] = level
                    counts[index // ranked, level] += 1
                    word = level ^ (level >> 1) if code == gray else level
                    for bit in range(bits):
                        on = level > bit if code == thermometer else word >> bits - 1 - bit & 1 == 1
                        state[row, index * bits + bit] = 1.0 if on else -1.0
            key = keys[key_of[row]]
            # N = round(ρ M) most active of M neurons; of equal ones those of lower index
            for group in range(len(counts)):
                wanted = int(np.rint(density[row] * np.float32(ranked)))
                cut = highest
                while cut >= 0 and wanted > counts[group, cut]:
                    wanted -= counts[group, cut]
                    cut -= 1
                for index in range(group * ranked, (group + 1) * ranked):
                    active = levels[index] > cut
                    if levels[index] == cut and wanted > 0:
                        active = True
                        wanted -= 1
                    for bit in range(index * bits, (index + 1) * bits):
                        touch[row, bit] = key[bit] if active else -key[bit]
            for block in range(len(rotations)):  # eq. rope3d1
                turn = rotations[block]
                x, y, z = (
                    touch[row, 3 * block],
                    touch[row, 3 * block + 1],
                    touch[row, 3 * block + 2],
                )
                for i in range(3):
                    value = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z
                    if rebinarise:
                        value = np.float32(-1.0) if value < 0 else np.float32(1.0)
                    touch[row, 3 * block + i] = value

    return compile_kernel(kernel)
