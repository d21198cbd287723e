"""The Izhikevich step compiled for the CPU, as the operator `hasm_torch::izhikevich`.

The step is the one explained in `encoders.izhikevich`; it is written for neurons side by side,
so that the compiler turns the inner loop into SIMD instructions, and in the same order of
operations as there, so that both give the same spikes.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.kernels.compiling import compile_kernel

LANES = 32  # neurons stepped side by side, as SIMD lanes
BLOCK = 512  # steps between two transpositions; a block stays in the L2 cache
PARALLEL_WORK = 1 << 20  # neuron steps above which starting threads costs less than it saves


@functools.cache
def _compiled_kernel() -> Callable[..., None]:
    """The kernel, compiled on first use and then cached on disk (numba loads in about 0.5 s)."""

    def kernel(
        current: Any, v: Any, u: Any, spikes: Any, a64: Any, b64: Any, c64: Any, d64: Any,
        v_th64: Any, dt64: Any,
    ) -> None:  # fmt: skip
        # numba takes a literal for float64: every constant is rounded to the dtype as torch does
        real = current.dtype.type
        a, b, c, d, v_th, dt = real(a64), real(b64), real(c64), real(d64), real(v_th64), real(dt64)
        half_dt_a, half_a, half_b = real(0.5 * dt64 * a64), real(0.5 * a64), real(0.5 * b64)
        quad, lin, base, zero, one = real(0.04), real(2.5), real(140.0), real(0.0), real(1.0)
        neurons, steps = current.shape
        drive_block = np.zeros((min(BLOCK, steps), LANES), current.dtype)
        spike_block = np.zeros((min(BLOCK, steps), LANES), current.dtype)
        v_lane = np.zeros(LANES, current.dtype)
        u_lane = np.zeros(LANES, current.dtype)
        for first in range(0, neurons, LANES):
            width = min(LANES, neurons - first)
            for k in range(width):
                v_lane[k] = v[first + k]
                u_lane[k] = u[first + k]
            for start in range(0, steps, BLOCK):
                length = min(BLOCK, steps - start)
                for k in range(width):
                    for t in range(length):
                        drive_block[t, k] = current[first + k, start + t] + base
                for t in range(length):
                    for k in range(LANES):  # free of branches, so that it becomes SIMD
                        v0, u0, drive = v_lane[k], u_lane[k], drive_block[t, k]
                        u_mid = u0 + half_dt_a * (b * v0 - u0)
                        slope = lin * v0 + (drive - u_mid) + v_th * (quad * v0 + lin)
                        gap = v_th - v0
                        spike = dt * slope - gap >= zero
                        tau = gap / slope if spike else zero
                        u_reset = u0 + (a * tau) * (half_b * (v0 + v_th) - u0) + d
                        u0 = u_reset if spike else u0
                        v0 = c if spike else v0
                        rest = dt - tau
                        u_mid = u0 + (half_a * rest) * (b * v0 - u0)
                        v1 = (v0 + rest * (lin * v0 + (drive - u_mid))) / (
                            one - rest * (quad * v0 + lin)
                        )
                        v1 = v_th if v1 > v_th else v1
                        u_lane[k] = u0 + (a * rest) * (half_b * (v0 + v1) - u_mid)
                        v_lane[k] = v1
                        spike_block[t, k] = one if spike else zero
                for k in range(width):
                    for t in range(length):
                        spikes[first + k, start + t] = spike_block[t, k]
            for k in range(width):
                v[first + k] = v_lane[k]
                u[first + k] = u_lane[k]

    # error_model="numpy": no test for a zero divisor, which would keep the loop from SIMD.
    # No fastmath: the kernel must give the spikes of the torch loop.
    return compile_kernel(kernel, error_model="numpy")


def run(
    current: NDArray[Any], v: NDArray[Any], u: NDArray[Any],
    a: float, b: float, c: float, d: float, v_th: float, dt_ms: float,
) -> NDArray[Any]:  # fmt: skip
    """Spikes of neurons side by side; arrays of one real dtype, C-contiguous.

    Args:
        current: (N, T) synaptic current, one sample a step.
        v: (N,) membrane potential, moved on in place.
        u: (N,) recovery variable, moved on in place.
        a: As for ``izhikevich``, like the parameters that follow.
        b: See there.
        c: See there.
        d: See there.
        v_th: See there.
        dt_ms: See there.

    Returns:
        (N, T), 0 or 1.
    """
    kernel = _compiled_kernel()
    spikes = np.empty_like(current)
    arrays = (current, v, u, spikes)
    neurons, steps = current.shape
    threads = min(torch.get_num_threads(), -(-neurons // LANES))
    if threads == 1 or neurons * steps < PARALLEL_WORK:
        kernel(*arrays, a, b, c, d, v_th, dt_ms)
        return spikes
    # Threads of this call alone: a pool kept for the next one would not survive a fork, and data
    # loaders fork.
    share = -(-neurons // (threads * LANES)) * LANES
    with ThreadPoolExecutor(threads) as pool:
        jobs = [
            pool.submit(
                kernel, *(x[first : first + share] for x in arrays), a, b, c, d, v_th, dt_ms
            )
            for first in range(0, neurons, share)
        ]
        for job in jobs:
            job.result()
    return spikes


def _run_kernel(
    current: Tensor, v: Tensor, u: Tensor,
    a: float, b: float, c: float, d: float, v_th: float, dt_ms: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """``run`` over (..., T) currents and (...) states on the CPU."""
    v = v.clone(memory_format=torch.contiguous_format)
    u = u.clone(memory_format=torch.contiguous_format)
    neurons = v.numel()
    spikes = run(
        current.detach().contiguous().numpy().reshape(neurons, current.shape[-1]),
        v.detach().numpy().reshape(neurons),
        u.detach().numpy().reshape(neurons),
        a, b, c, d, v_th, dt_ms,
    )  # fmt: skip
    return torch.from_numpy(spikes).view(current.shape), v, u


def _describe_kernel(
    current: Tensor, v: Tensor, u: Tensor, *_parameters: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Shapes and dtypes of the kernel's results, for torch.compile and torch.export."""
    return current.new_empty(current.shape), v.new_empty(v.shape), u.new_empty(u.shape)


# Registered with the low-level library: torch.library.custom_op adds some 10 microseconds to a
# call that takes that long.
_LIBRARY = torch.library.Library("hasm_torch", "FRAGMENT")
_LIBRARY.define(
    "izhikevich(Tensor current, Tensor v, Tensor u, float a, float b, float c, float d, "
    "float v_th, float dt_ms) -> (Tensor, Tensor, Tensor)"
)
_LIBRARY.impl("izhikevich", _run_kernel, "CPU")
torch.library.register_fake("hasm_torch::izhikevich", _describe_kernel, lib=_LIBRARY)
izhikevich_op = torch.ops.hasm_torch.izhikevich.default
