"""The skin's encoder in arrays: what ``encoders.skin`` does on the CPU where no gradient is wanted.

A control step encodes one sample; as two dozen tensor operations that takes several times longer
than the neurons themselves. Sums are taken in the same order as there.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.kernels.compiling import compile_kernel
from hasm_torch.kernels.izhikevich import run

Array = NDArray[np.float32]


class Neuron(NamedTuple):
    """Parameters of the Izhikevich neurons, see ``encoders.izhikevich``; ``dt`` in ms."""

    a: float
    b: float
    c: float
    d: float
    v_th: float
    dt: float


def encode_skin(
    skin: Array,
    normals: Array,
    borders: NDArray[np.int64],
    threshold: float,
    gain: float,
    steps: int,
    neuron: Neuron,
    recent: Array,
    v: Array,
    u: Array,
) -> tuple[Array, Array, Array]:
    """Spikes, effective force and push of every patch, of S independent streams in float32.

    Args:
        skin: (S, T, C, 3) forces of the cells, N.
        normals: (C, 3) outward unit normals of the cells.
        borders: (P + 1,) first cell of each patch, and C.
        threshold: Soft threshold τ, N.
        gain: Synaptic current a newton.
        steps: Integration steps a sample.
        neuron: The neurons' parameters.
        recent: (S, window − 1, P, 4) sums of the samples before, N.
        v: (S · P,) membrane potentials, mV, moved on in place.
        u: (S · P,) recovery variables, moved on in place.

    Returns:
        (S, T, P) spikes in each sample period; (S, T, P, 4) effective force and the three
        components of the push, N, averaged over the window; (S, window − 1, P, 4) sums of the last
        samples, N.
    """
    streams, samples = skin.shape[:2]
    before, patches = recent.shape[1:3]
    totals = np.empty((streams, before + samples, patches, 4), np.float32)
    totals[:, :before] = recent
    means = np.empty((streams, samples, patches, 4), np.float32)
    _compiled()(skin, normals, borders, np.float32(threshold), totals, means)
    current = np.float32(gain) * means[..., 0].transpose(0, 2, 1).reshape(
        streams * patches, samples
    )
    # One sample of current a step, held over the sample period.
    spikes = run(np.repeat(current, steps, axis=1), v, u, *neuron)
    counts = spikes.reshape(streams, patches, samples, steps).sum(-1).transpose(0, 2, 1)
    # Copies, so that a long stream is not kept for its last samples.
    return np.ascontiguousarray(counts), means, totals[:, samples:].copy()


@functools.cache
def _compiled() -> Callable[..., None]:
    """The pass, compiled on first use and then cached on disk."""

    def kernel(
        skin: Any, normals: Any, borders: Any, threshold: Any, totals: Any, means: Any
    ) -> None:
        zero = np.float32(0.0)
        streams, samples, patches = means.shape[:3]
        window = totals.shape[1] - samples + 1
        for s in range(streams):
            for t in range(samples):
                for p in range(patches):
                    total, x, y, z = zero, zero, zero, zero
                    for c in range(borders[p], borders[p + 1]):
                        cell = skin[s, t, c]
                        excess = abs(cell[0]) + abs(cell[1]) + abs(cell[2]) - threshold
                        if not excess <= zero:  # a NaN stays one
                            total += excess
                            x -= excess * normals[c, 0]
                            y -= excess * normals[c, 1]
                            z -= excess * normals[c, 2]
                    new = totals[s, window - 1 + t, p]
                    new[0], new[1], new[2], new[3] = total, x, y, z
                for p in range(patches):
                    for i in range(4):
                        mean = zero
                        for w in range(window):
                            mean += totals[s, t + w, p, i]
                        means[s, t, p, i] = mean / np.float32(window)

    return compile_kernel(kernel)
