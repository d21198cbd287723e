"""Place code, touch code, rotation and binding of queries in one compiled pass.

A control step codes one query; as some forty tensor operations that takes ten times longer than
the recall itself. The pass does what ``model.query`` does in torch, one equation after the other.
Rates are taken in float64, so that a level can differ from those of a float32 position where a
rate is within rounding of the border between two levels.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.kernels.compiling import compile_kernel

THERMOMETER, GRAY, BINARY = 0, 1, 2


class CodeTables(NamedTuple):
    """What does not change from query to query.

    Attributes:
        lower: (J,) float64 lower limits of the coded joints, rad or m.
        upper: (J,) float64 upper limits.
        neurons: Neurons a joint.
        bits: Entries a neuron.
        width: Tuning width in neuron spacings.
        code: ``THERMOMETER``, ``GRAY`` or ``BINARY``.
        rank: (J · neurons,) int64 place of each neuron in a fixed order of activity; empty where
            the neurons' own levels rank them.
        keys: (parts, D) float32 ±1, with which the touch code is bound before it is rotated.
        phases: (blocks,) float64 angle ω_i θ of each block of three, rad; empty turns nothing.
        mixing: (blocks, 3, 3) float64 orthogonal matrix applied to each turned block.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    neurons: int
    bits: int
    width: float
    code: int
    rank: NDArray[np.int64]
    keys: NDArray[np.float32]
    phases: NDArray[np.float64]
    mixing: NDArray[np.float64]


def encode_queries(
    tables: CodeTables,
    positions: NDArray[np.float64],
    density: NDArray[np.float64],
    part: NDArray[np.int64],
    axis: NDArray[np.float64],
    bound: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Queries q = s ⊗ o ⊗ p.

    Args:
        tables: What does not change.
        positions: (K, J) positions of the coded joints, rad or m.
        density: (K,) rate density ρ, 0 to 1.
        part: (K,) key of each touch.
        axis: (K, 3) direction of the force, of length 1 or 0.
        bound: (K, D) code of further observations, or (0, D).

    Returns:
        (K, D).
    """
    queries = np.empty((len(positions), tables.keys.shape[1]), np.float32)
    _compiled()(*tables, positions, density, part, axis, bound, queries)
    return queries


@functools.cache
def _compiled() -> Callable[..., None]:
    """The pass, compiled on first use and then cached on disk."""

    def kernel(
        lower: Any, upper: Any, neurons: int, bits: int, width: float, code: int, rank: Any,
        keys: Any, phases: Any, mixing: Any, positions: Any, density: Any, part: Any, axis: Any,
        bound: Any, queries: Any,
    ) -> None:  # fmt: skip
        rows, joints = positions.shape
        total, blocks = joints * neurons, len(phases)
        highest = bits if code == THERMOMETER else 2**bits - 1
        levels = np.empty(total, np.int64)
        counts = np.empty(highest + 1, np.int64)
        state, touch = np.empty(total * bits), np.empty(total * bits)
        sines, versines = np.sin(phases), 2.0 * np.sin(0.5 * phases) ** 2
        for k in range(rows):
            counts[:] = 0
            for joint in range(joints):
                low, high = lower[joint], upper[joint]
                at = min(max(positions[k, joint], low), high)
                at = (at - low) / (high - low) * (neurons - 1)
                for neuron in range(neurons):
                    rate = np.exp(-0.5 * ((at - neuron) / width) ** 2)  # eq. tuning_curve
                    if code == THERMOMETER:
                        level = int(np.rint(rate * bits))
                    else:
                        level = int(np.rint(rate * 255)) >> (8 - bits)
                    index = joint * neurons + neuron
                    levels[index] = level
                    counts[level] += 1
                    word = level ^ (level >> 1) if code == GRAY else level
                    for bit in range(bits):
                        on = level > bit if code == THERMOMETER else word >> bits - 1 - bit & 1 == 1
                        state[index * bits + bit] = 1.0 if on else -1.0
            # N = round(ρ M) most active of M neurons; of equal ones those of lower index
            wanted = int(np.rint(density[k] * total))
            cut, left = highest, wanted
            while cut >= 0 and left > counts[cut]:
                left -= counts[cut]
                cut -= 1
            key = keys[part[k]]
            for index in range(total):
                if len(rank):
                    active = rank[index] < wanted
                else:
                    active = levels[index] > cut
                    if levels[index] == cut and left > 0:
                        active = True
                        left -= 1
                for bit in range(index * bits, (index + 1) * bits):
                    touch[bit] = key[bit] if active else -key[bit]
            nx, ny, nz = axis[k, 0], axis[k, 1], axis[k, 2]
            still = nx == 0.0 and ny == 0.0 and nz == 0.0
            for i in range(0 if still else blocks):  # eq. rope3d1, then the fixed mixing
                x, y, z = touch[3 * i], touch[3 * i + 1], touch[3 * i + 2]
                cx, cy, cz = ny * z - nz * y, nz * x - nx * z, nx * y - ny * x
                sx, sy, sz = ny * cz - nz * cy, nz * cx - nx * cz, nx * cy - ny * cx
                x += sines[i] * cx + versines[i] * sx
                y += sines[i] * cy + versines[i] * sy
                z += sines[i] * cz + versines[i] * sz
                mix = mixing[i]
                for j in range(3):
                    touch[3 * i + j] = mix[j, 0] * x + mix[j, 1] * y + mix[j, 2] * z
            if len(bound):
                for i in range(len(touch)):
                    queries[k, i] = state[i] * touch[i] * bound[k, i]
            else:
                for i in range(len(touch)):
                    queries[k, i] = state[i] * touch[i]

    return compile_kernel(kernel)
