"""From the forces of a whole skin to the spikes of one neuron a patch.

    m_c(t) = max(0, ‖f_c(t)‖₁ − τ),   F = Σ_{t ∈ [t₀−Δt, t₀]} Σ_c m_c(t),   I ∝ F

and the Izhikevich neuron of the patch turns I into spikes. Source: section "Neuromorphic Encoding
of External Forces" of the paper.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from hasm_torch.izhikevich import Izhikevich, IzhikevichState
from hasm_torch.touch import EffectiveForce


class SkinState(NamedTuple):
    """What a stream of skin samples needs to go on.

    Attributes:
        recent: (..., window − 1, cells, points), the last samples, N.
        neurons: Membrane state of the (..., patches) neurons.
    """

    recent: Tensor
    neurons: IzhikevichState | None


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
        ValueError: If there is no patch, or the sample period is not a multiple of the step.
    """

    gather: Tensor

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
        steps = 1000.0 / rate / spike_dt_ms
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"the sample period {1000 / rate} ms must be a multiple of spike_dt_ms, "
                f"got {spike_dt_ms} ms"
            )
        self.steps = round(steps)
        self.rate, self.total = rate, sum(cells)
        self.current_per_newton = current_per_newton
        self.force = EffectiveForce(threshold, window)
        self.neuron = Izhikevich(dt_ms=spike_dt_ms)
        # Row p lists the cells of patch p; shorter patches point at a cell of zero force.
        gather = torch.full((len(cells), max(cells)), self.total)
        start = 0
        for patch, count in enumerate(cells):
            gather[patch, :count] = torch.arange(start, start + count)
            start += count
        self.register_buffer("gather", gather)

    def forward(
        self, skin: Tensor, state: SkinState | None = None
    ) -> tuple[Tensor, Tensor, SkinState]:
        """Encode a stream of skin samples; a chunked stream equals a whole one.

        Args:
            skin: (..., T, cells, points), force of every point, N.
            state: What an earlier chunk returned.

        Returns:
            (..., T, patches) spikes in each sample period; (..., T, patches) effective force, N,
            averaged over the window; the state to go on from.

        Raises:
            ValueError: If the number of cells is not the skin's.
        """
        if skin.ndim < 3 or skin.shape[-2] != self.total:
            raise ValueError(
                f"expected skin (..., T, {self.total}, points), got {tuple(skin.shape)}"
            )
        window = self.force.window
        shape = (*skin.shape[:-3], window - 1, *skin.shape[-2:])
        recent = state.recent if state is not None else skin.new_zeros(shape)
        stream = torch.cat([recent, skin], dim=-3)
        padded = torch.nn.functional.pad(stream, (0, 0, 0, 1))
        patches = padded[..., self.gather, :].movedim(-3, -4)  # (..., patches, T, cells, points)
        force = self.force(patches)[..., window - 1 :] / window
        current = self.current_per_newton * force.repeat_interleave(self.steps, dim=-1)
        spikes, neurons = self.neuron(current, None if state is None else state.neurons)
        counts = spikes.unflatten(-1, (-1, self.steps)).sum(-1)
        after = SkinState(stream[..., stream.shape[-3] - window + 1 :, :, :], neurons)
        return counts.movedim(-1, -2), force.movedim(-1, -2), after
