"""The skin's encoder in arrays: what ``SkinEncoder`` does on the CPU where no gradient is wanted.

A control step encodes one sample; as two dozen tensor operations that takes several times longer
than the neurons themselves. Sums are taken in the same order as there.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hasm_torch.encoders.izhikevich import Izhikevich
from hasm_torch.kernels.compiling import compile_kernel
from hasm_torch.kernels.izhikevich import run

Array = NDArray[np.float32]


def encode_skin(
    skin: Array,
    borders: NDArray[np.int64],
    threshold: float,
    gain: float,
    steps: int,
    neuron: Izhikevich,
    recent: Array,
    v: Array,
    u: Array,
) -> tuple[Array, Array, Array]:
    """Spikes and effective force of every patch, of S independent streams in float32.

    Args:
        skin: (S, T, C, 3) forces of the cells, N.
        borders: (P + 1,) first cell of each patch, and C.
        threshold: Soft threshold τ, N.
        gain: Synaptic current a newton.
        steps: Integration steps a sample.
        neuron: The neurons' parameters.
        recent: (S, window − 1, P) effective force of the samples before, N.
        v: (S · P,) membrane potentials, mV, moved on in place.
        u: (S · P,) recovery variables, moved on in place.

    Returns:
        (S, T, P) spikes in each sample period; (S, T, P) effective force, N, averaged over the
        window; (S, window − 1, P) effective force of the last samples, N.
    """
    streams, samples = skin.shape[:2]
    before, patches = recent.shape[1:]
    totals = np.empty((streams, before + samples, patches), np.float32)
    totals[:, :before] = recent
    force = np.empty((streams, samples, patches), np.float32)
    _compiled()(skin, borders, np.float32(threshold), totals, force)
    current = (np.float32(gain) * force).transpose(0, 2, 1).reshape(streams * patches, samples)
    # One sample of current a step, held over the sample period.
    spikes = run(
        np.repeat(current, steps, axis=1), v, u,
        neuron.a, neuron.b, neuron.c, neuron.d, neuron.v_th, neuron.dt_ms,
    )  # fmt: skip
    counts = spikes.reshape(streams, patches, samples, steps).sum(-1).transpose(0, 2, 1)
    # A copy, so that a long stream is not kept for its last samples.
    return np.ascontiguousarray(counts), force, totals[:, samples:].copy()


@functools.cache
def _compiled() -> Callable[..., None]:
    """The pass, compiled on first use and then cached on disk."""

    def kernel(skin: Any, borders: Any, threshold: Any, totals: Any, force: Any) -> None:
        zero = np.float32(0.0)
        streams, samples, patches = force.shape
        window = totals.shape[1] - samples + 1
        for s in range(streams):
            for t in range(samples):
                for p in range(patches):
                    total = zero
                    for c in range(borders[p], borders[p + 1]):
                        cell = skin[s, t, c]
                        excess = abs(cell[0]) + abs(cell[1]) + abs(cell[2]) - threshold
                        if not excess <= zero:  # a NaN stays one
                            total += excess
                    totals[s, window - 1 + t, p] = total
                for p in range(patches):
                    mean = zero
                    for i in range(window):
                        mean += totals[s, t + i, p]
                    force[s, t, p] = mean / np.float32(window)

    return compile_kernel(kernel)
