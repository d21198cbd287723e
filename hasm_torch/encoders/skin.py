"""From the forces of a whole skin to spikes and the direction of the push, patch by patch.

    m_c(t) = max(0, ‖f_c(t)‖₁ − τ),   F = Σ_{t ∈ [t₀−Δt, t₀]} Σ_c m_c(t),   I ∝ F
    push(t₀) = −Σ_{t ∈ [t₀−Δt, t₀]} Σ_c m_c(t) n_c

and the Izhikevich neuron of the patch turns I into spikes. n_c is the outward normal of cell c in
the frame of its link, so that a touch on a curved patch pushes along the normals that it presses.
Source: section "Neuromorphic Encoding of External Forces" of the paper.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch import kernels
from hasm_torch.encoders.izhikevich import Izhikevich, IzhikevichState, resting_state
from hasm_torch.encoders.readings import patch_borders
from hasm_torch.encoders.touch import cell_excess
from hasm_torch.kernels.skin import Neuron, encode_skin

Array = NDArray[np.float32]


def spike_step(rate: float, longest_ms: float) -> float:
    """The longest integration step up to ``longest_ms`` that divides the sample period.

    Args:
        rate: Sampling rate, Hz.
        longest_ms: Longest step, ms.

    Returns:
        The step, ms: ``longest_ms`` itself where it divides the period.

    Raises:
        ValueError: If one of them is not positive.
    """
    if not (rate > 0 and longest_ms > 0):
        raise ValueError(f"expected rate and step above 0, got {rate} Hz and {longest_ms} ms")
    period = 1000.0 / rate
    steps = period / longest_ms
    if abs(steps - round(steps)) <= 1e-6:
        return longest_ms
    return period / math.ceil(steps)


class SkinState(NamedTuple):
    """What a stream of skin samples needs to go on.

    Attributes:
        recent: (..., window − 1, patches, 4), effective force and push of the last samples, N.
        neurons: Membrane state of the (..., patches) neurons.
    """

    recent: Tensor
    neurons: IzhikevichState


class ArrayState(NamedTuple):
    """The same in arrays, for S streams side by side.

    Attributes:
        recent: (S, window − 1, patches, 4), N.
        v: (S · patches,) membrane potentials, mV.
        u: (S · patches,) recovery variables.
    """

    recent: Array
    v: Array
    u: Array


class Felt(NamedTuple):
    """What the patches feel at every sample.

    Attributes:
        spikes: (..., T, patches) spikes in each sample period.
        force: (..., T, patches) effective force, N, averaged over the window.
        push: (..., T, patches, 3) force that the touch exerts, N, in the frame of each patch's
            link, averaged over the window.
    """

    spikes: Tensor
    force: Tensor
    push: Tensor


class SkinEncoder(nn.Module):
    """Spikes, effective force and push of every patch at every sample of the skin.

    Args:
        cells: Number of cells of each patch; patches follow each other in the skin.
        normals: (cells, 3) outward unit normal of each cell in the frame of its link.
        rate: Sampling rate of the skin, Hz.
        threshold: Soft threshold τ, N.
        window: Accumulation window Δt, samples. The current is proportional to the window's mean,
            so that one current per newton fits every window.
        current_per_newton: Synaptic current a newton.
        spike_dt_ms: Longest integration step, ms; shortened to divide the sample period.

    Raises:
        ValueError: If there is no patch, a rate, step or window is not positive, the threshold is
            negative, or there is not a normal for each cell.
    """

    patch_of_cell: Tensor
    normals: Tensor

    def __init__(
        self,
        cells: list[int],
        normals: list[list[float]] | Tensor,
        rate: float,
        threshold: float,
        window: int,
        current_per_newton: float,
        spike_dt_ms: float,
    ) -> None:
        super().__init__()
        if not cells:
            raise ValueError("a skin needs at least one patch, got none")
        if window < 1 or not threshold >= 0:
            raise ValueError(
                f"expected window >= 1 sample and threshold >= 0 N, got {window} and {threshold}"
            )
        outward = torch.as_tensor(normals, dtype=torch.float32)
        if outward.shape != (sum(cells), 3):
            raise ValueError(f"expected normals ({sum(cells)}, 3), got {tuple(outward.shape)}")
        step = spike_step(rate, spike_dt_ms)
        self.steps = round(1000.0 / rate / step)
        self.rate, self.patches, self.total = rate, len(cells), sum(cells)
        self.threshold, self.window = threshold, window
        self.current_per_newton = current_per_newton
        self.neuron = Izhikevich(dt_ms=step)
        self._borders = patch_borders(tuple(cells))
        patch_of_cell = torch.repeat_interleave(torch.arange(len(cells)), torch.tensor(cells))
        self.register_buffer("patch_of_cell", patch_of_cell, persistent=False)
        self.register_buffer("normals", outward, persistent=False)
        one = self.neuron
        self._normals = outward.cpu().numpy()
        self._constants = Neuron(one.a, one.b, one.c, one.d, one.v_th, one.dt_ms)

    def forward(self, skin: Tensor, state: SkinState | None = None) -> tuple[Felt, SkinState]:
        """Encode a stream of skin samples; a chunked stream equals a whole one.

        Args:
            skin: (..., T, cells, 3), force of the three points of every cell, N.
            state: What an earlier chunk returned.

        Returns:
            What the patches feel; the state to go on from.

        Raises:
            ValueError: If the number of cells is not the skin's, or a cell has not three forces.
        """
        if skin.ndim < 3 or skin.shape[-2:] != (self.total, 3):
            raise ValueError(f"expected skin (..., T, {self.total}, 3), got {tuple(skin.shape)}")
        leading = skin.shape[:-3]
        if state is None:
            recent = skin.new_zeros(*leading, self.window - 1, self.patches, 4)
            neurons = resting_state(recent.new_zeros(*leading, self.patches, 1), self.neuron.b)
            state = SkinState(recent, neurons)
        tensors = (skin, state.recent, *state.neurons)
        on_cpu = all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)
        wants_grad = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
        if on_cpu and kernels.enabled() and not wants_grad:
            return self._in_arrays(skin, state)
        means, recent = self._window_means(skin, state.recent)
        # One sample of current a step, held over the sample period.
        current = (self.current_per_newton * means[..., 0]).mT.unsqueeze(-1)
        current = current.expand(*current.shape[:-1], self.steps).flatten(-2)
        spikes, neurons = self.neuron(current, state.neurons)
        counts = spikes.unflatten(-1, (-1, self.steps)).sum(-1).mT
        return Felt(counts, means[..., 0], means[..., 1:]), SkinState(recent, neurons)

    def _in_arrays(self, skin: Tensor, state: SkinState) -> tuple[Felt, SkinState]:
        leading, streams = skin.shape[:-3], math.prod(skin.shape[:-3])
        neurons = (x.detach().numpy().reshape(streams * self.patches) for x in state.neurons)
        recent = state.recent.detach().numpy().reshape(streams, *state.recent.shape[-3:])
        forces = skin.detach().contiguous().numpy().reshape(streams, *skin.shape[-3:])
        counts, means, after = self.encode(forces, ArrayState(recent, *neurons))
        v, u = (torch.from_numpy(x.reshape(*leading, self.patches)) for x in (after.v, after.u))
        counted, mean, last = (
            torch.from_numpy(x.reshape(*leading, *x.shape[1:]))
            for x in (counts, means, after.recent)
        )
        felt = Felt(counted, mean[..., 0], mean[..., 1:])
        return felt, SkinState(last, IzhikevichState(v, u))

    def encode(self, skin: Array, state: ArrayState) -> tuple[Array, Array, ArrayState]:
        """``forward`` in arrays, for the control loop.

        Args:
            skin: (S, T, cells, 3) float32 forces of S independent streams, N.
            state: What an earlier call returned, or ``start``.

        Returns:
            (S, T, patches) spikes; (S, T, patches, 4) effective force and push, N; the state to go
            on from.
        """
        v, u = state.v.copy(), state.u.copy()
        counts, means, recent = encode_skin(
            skin,
            self._normals,
            self._borders,
            self.threshold,
            self.current_per_newton,
            self.steps,
            self._constants,
            state.recent,
            v,
            u,
        )
        return counts, means, ArrayState(recent, v, u)

    def start(self) -> ArrayState:
        """The state of one stream before its first sample."""
        recent = np.zeros((1, self.window - 1, self.patches, 4), np.float32)
        resting = resting_state(torch.zeros(self.patches, 1), self.neuron.b)
        return ArrayState(recent, resting.v.numpy(), resting.u.numpy())

    def _window_means(self, skin: Tensor, recent: Tensor) -> tuple[Tensor, Tensor]:
        """(..., T, patches, 4) force and push over the window, and the last samples' own."""
        excess = cell_excess(skin, self.threshold)
        parts = torch.cat([excess.unsqueeze(-1), -excess.unsqueeze(-1) * self.normals], dim=-1)
        totals = parts.new_zeros(*parts.shape[:-2], self.patches, 4)
        totals = totals.index_add(-2, self.patch_of_cell, parts)
        stream = torch.cat([recent, totals], dim=-3)
        # Added in order of time, so that rounding does not depend on the length of the chunk.
        shifts = (stream[..., i : i + skin.shape[-3], :, :] for i in range(self.window))
        return sum(shifts, torch.zeros_like(totals)) / self.window, stream[
            ..., skin.shape[-3] :, :, :
        ]
