"""From the forces of a whole skin to the spikes of one neuron a patch.

    m_c(t) = max(0, ‖f_c(t)‖₁ − τ),   F = Σ_{t ∈ [t₀−Δt, t₀]} Σ_c m_c(t),   I ∝ F

and the Izhikevich neuron of the patch turns I into spikes. Source: section "Neuromorphic Encoding
of External Forces" of the paper.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hasm_torch.encoders.izhikevich import Izhikevich, IzhikevichState, resting_state
from hasm_torch.encoders.readings import patch_borders
from hasm_torch.encoders.touch import cell_excess
from hasm_torch.kernels.skin import encode_skin


def spike_step(rate: float, longest_ms: float) -> float:
    """The longest integration step up to ``longest_ms`` that divides the sample period.

    Args:
        rate: Sampling rate, Hz.
        longest_ms: Longest step, ms.

    Returns:
        The step, ms: ``longest_ms`` itself where it divides the period.
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
        recent: (..., window − 1, patches), effective force of the last samples, N.
        neurons: Membrane state of the (..., patches) neurons.
    """

    recent: Tensor
    neurons: IzhikevichState


class SkinEncoder(nn.Module):
    """Effective force and spike count of every patch at every sample of the skin.

    Args:
        cells: Number of cells of each patch; patches follow each other in the skin.
        rate: Sampling rate of the skin, Hz.
        threshold: Soft threshold τ, N.
        window: Accumulation window Δt, samples. The current is proportional to the window's mean,
            so that one current per newton fits every window.
        current_per_newton: Synaptic current a newton.
        spike_dt_ms: Integration step, ms; divides the sample period.

    Raises:
        ValueError: If there is no patch, a rate, step or window is not positive, the threshold is
            negative, or the sample period is not a multiple of the step.
    """

    patch_of_cell: Tensor

    def __init__(
        self,
        cells: list[int],
        rate: float,
        threshold: float,
        window: int,
        current_per_newton: float,
        spike_dt_ms: float,
    ) -> None:
        super().__init__()
        if not cells:
            raise ValueError("a skin needs at least one patch, got none")
        if not (rate > 0 and spike_dt_ms > 0):
            raise ValueError(
                f"expected rate and spike_dt_ms above 0, got {rate} Hz and {spike_dt_ms} ms"
            )
        if window < 1 or not threshold >= 0:
            raise ValueError(
                f"expected window >= 1 sample and threshold >= 0 N, got {window} and {threshold}"
            )
        steps = 1000.0 / rate / spike_dt_ms
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"the sample period {1000 / rate} ms must be a multiple of spike_dt_ms, "
                f"got {spike_dt_ms} ms"
            )
        self.steps = round(steps)
        self.rate, self.patches, self.total = rate, len(cells), sum(cells)
        self.threshold, self.window = threshold, window
        self.current_per_newton = current_per_newton
        self.neuron = Izhikevich(dt_ms=spike_dt_ms)
        self._borders = patch_borders(tuple(cells))
        patch_of_cell = torch.repeat_interleave(torch.arange(len(cells)), torch.tensor(cells))
        self.register_buffer("patch_of_cell", patch_of_cell)

    def forward(
        self, skin: Tensor, state: SkinState | None = None
    ) -> tuple[Tensor, Tensor, SkinState]:
        """Encode a stream of skin samples; a chunked stream equals a whole one.

        Args:
            skin: (..., T, cells, 3), force of the three points of every cell, N.
            state: What an earlier chunk returned.

        Returns:
            (..., T, patches) spikes in each sample period; (..., T, patches) effective force, N,
            averaged over the window; the state to go on from.

        Raises:
            ValueError: If the number of cells is not the skin's, or a cell has not three forces.
        """
        if skin.ndim < 3 or skin.shape[-2:] != (self.total, 3):
            raise ValueError(f"expected skin (..., T, {self.total}, 3), got {tuple(skin.shape)}")
        leading = skin.shape[:-3]
        if state is None:
            recent = skin.new_zeros(*leading, self.window - 1, self.patches)
            neurons = resting_state(recent.new_zeros(*leading, self.patches, 1), self.neuron.b)
            state = SkinState(recent, neurons)
        tensors = (skin, state.recent, *state.neurons)
        on_cpu = all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)
        if on_cpu and not (torch.is_grad_enabled() and any(x.requires_grad for x in tensors)):
            return self._in_arrays(skin, state)
        force, recent = self._window_forces(skin, state.recent)
        # One sample of current a step, held over the sample period.
        current = (self.current_per_newton * force).mT.unsqueeze(-1)
        current = current.expand(*current.shape[:-1], self.steps).flatten(-2)
        spikes, neurons = self.neuron(current, state.neurons)
        counts = spikes.unflatten(-1, (-1, self.steps)).sum(-1).mT
        return counts, force, SkinState(recent, neurons)

    def _in_arrays(self, skin: Tensor, state: SkinState) -> tuple[Tensor, Tensor, SkinState]:
        leading, streams = skin.shape[:-3], math.prod(skin.shape[:-3])
        v, u = (x.detach().numpy().reshape(streams * self.patches).copy() for x in state.neurons)
        counts, force, recent = encode_skin(
            skin.detach().contiguous().numpy().reshape(streams, *skin.shape[-3:]),
            self._borders,
            self.threshold,
            self.current_per_newton,
            self.steps,
            self.neuron,
            state.recent.detach().numpy().reshape(streams, *state.recent.shape[-2:]),
            v,
            u,
        )
        after = (torch.from_numpy(x.reshape(*leading, self.patches)) for x in (v, u))
        counted, felt, last = (
            torch.from_numpy(x.reshape(*leading, *x.shape[1:])) for x in (counts, force, recent)
        )
        return counted, felt, SkinState(last, IzhikevichState(*after))

    def _window_forces(self, skin: Tensor, recent: Tensor) -> tuple[Tensor, Tensor]:
        """Effective force of each patch, averaged over the window, and the last samples' own."""
        excess = cell_excess(skin, self.threshold)
        totals = excess.new_zeros(*excess.shape[:-1], self.patches)
        totals = totals.index_add(-1, self.patch_of_cell, excess)
        stream = torch.cat([recent, totals], dim=-2)
        # Added in order of time, so that rounding does not depend on the length of the chunk.
        shifts = (stream[..., i : i + skin.shape[-3], :] for i in range(self.window))
        force = sum(shifts, torch.zeros_like(totals)) / self.window
        return force, stream[..., skin.shape[-3] :, :]
