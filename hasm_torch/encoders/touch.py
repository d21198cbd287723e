"""From skin forces to a touch code.

    m_c(t) = max(0, |f_c1| + |f_c2| + |f_c3| - tau)         effective force of cell c
    F_total(t) = sum of m_c over a window that ends at t    effective force of a patch
    rho = clamp(r_f / R, 0, 1)                              spike rate density
    N = round(rho N_n N_J)                                  entries of the touch code that are +1

(paper, sections "Neuromorphic Encoding of External Forces" and "Tactile Embedding"). The window's
sum runs over all cells of the patch, since a patch has one neuron.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch.encoders.bipolar import to_bipolar


def cell_excess(forces: Tensor, threshold: float) -> Tensor:
    """Soft-thresholded force of each cell, m_c = max(0, |f_c1| + |f_c2| + |f_c3| - tau).

    Args:
        forces: (..., 3), N.
        threshold: tau, N.

    Returns:
        (...,), N.
    """
    return (forces.abs().sum(-1) - threshold).clamp(min=0)


def effective_force(forces: Tensor, threshold: float, window: int) -> Tensor:
    """Effective force on a patch: the excess of its cells over the threshold, over a window.

    Args:
        forces: (..., T, cells, 3), N, the three normal forces of each cell.
        threshold: tau, N, below which a cell's force counts as noise.
        window: samples in the window, the current one included; before the first there is none.

    Returns:
        (..., T), N.

    Raises:
        ValueError: if the cells have not three forces, or an option is out of range.
    """
    if forces.ndim < 3 or forces.shape[-1] != 3:
        raise ValueError(f"expected forces of shape (..., T, cells, 3), got {tuple(forces.shape)}")
    _check_force_options(threshold, window)
    total = cell_excess(forces, threshold).sum(-1)
    if total.shape[-1] == 0:
        return total
    # summed window by window: differences of a running sum would keep old rounding errors
    return nn.functional.pad(total, (window - 1, 0)).unfold(-1, window, 1).sum(-1)


def spike_density[Rate: (Tensor, NDArray[np.float64])](rate: Rate, max_rate: float) -> Rate:
    """Spike rate density rho = clamp(r_f / R, 0, 1).

    Args:
        rate: (...), spikes/s, a tensor or an array.
        max_rate: R, spikes/s.

    Returns:
        (...) in [0, 1].

    Raises:
        ValueError: if `max_rate` is not positive.
    """
    if not max_rate > 0:
        raise ValueError(f"expected max_rate > 0 spikes/s, got {max_rate}")
    return (rate / max_rate).clip(0, 1)


def tactile_embedding(rho: Tensor, levels: Tensor, bits: int) -> Tensor:
    """Touch code: +1 at the N = round(rho M) most active of the M place neurons, -1 elsewhere.

    Args:
        rho: (...) spike rate density in [0, 1].
        levels: (..., M) quantised rates of the place neurons, whose leading dimensions broadcast
            against `rho`. Of equal levels the one of lower index comes first.
        bits: n, how often each entry is repeated.

    Returns:
        (..., M * bits) in {-1, +1}, in the dtype of `rho`.
    """
    neurons = levels.shape[-1]
    count = torch.round(rho.to(torch.promote_types(rho.dtype, torch.float32)) * neurons).long()
    # no two keys are equal, so the N-th largest key is a threshold and one sort is enough
    tie_break = torch.arange(neurons - 1, -1, -1, device=levels.device)
    keys = levels.long() * neurons + tie_break
    descending = keys.sort(-1, descending=True).values
    keys, descending = (
        x.expand(*torch.broadcast_shapes(count.shape, x.shape[:-1]), neurons)
        for x in (keys, descending)
    )
    count = count.expand(keys.shape[:-1]).unsqueeze(-1)
    smallest = descending.gather(-1, (count - 1).clamp(min=0))
    active = (keys >= smallest) & (count > 0)
    return to_bipolar(active, rho.dtype).repeat_interleave(bits, -1)


def pair_with_spikes(sample_times: Tensor, spike_times: Tensor, window: float) -> Tensor:
    """Index of the spike closest to each joint sample, within a time window.

    Args:
        sample_times: (..., S), s, in any order.
        spike_times: (..., K), s, ascending, with the same leading dimensions; trains with fewer
            spikes are filled up with inf.
        window: s, the largest distance that still pairs, included.

    Returns:
        (..., S) int64 into `spike_times`, -1 where no spike is near. Of two spikes equally far the
        earlier is taken.

    Raises:
        ValueError: if the leading dimensions differ, or spike times descend (not checked under
            torch.compile).
    """
    if sample_times.shape[:-1] != spike_times.shape[:-1]:
        raise ValueError(
            "expected sample and spike times with the same leading dimensions, got "
            f"{tuple(sample_times.shape)} and {tuple(spike_times.shape)}"
        )
    count = spike_times.shape[-1]
    if count == 0:
        return torch.full(sample_times.shape, -1, device=sample_times.device)
    if not torch.compiler.is_compiling() and (spike_times[..., 1:] < spike_times[..., :-1]).any():
        raise ValueError("expected ascending spike times, got descending ones; sort them first")
    after = torch.searchsorted(spike_times.contiguous(), sample_times.contiguous())
    before = (after - 1).clamp(min=0)
    after = after.clamp(max=count - 1)
    to_before = (sample_times - spike_times.gather(-1, before)).abs()
    to_after = (sample_times - spike_times.gather(-1, after)).abs()
    closest = torch.where(to_before <= to_after, before, after)
    distance = torch.minimum(to_before, to_after)
    return torch.where((distance <= window) & distance.isfinite(), closest, -1)


class EffectiveForce(nn.Module):
    """Effective force on a skin patch; see `effective_force`.

    Args:
        threshold: tau, N, for each cell.
        window: samples in the window, at least 1.

    Raises:
        ValueError: if an option is out of range.
    """

    def __init__(self, threshold: float, window: int) -> None:
        super().__init__()
        _check_force_options(threshold, window)
        self.threshold, self.window = threshold, window

    def forward(self, forces: Tensor) -> Tensor:
        """(..., T, cells, 3) N -> (..., T) N."""
        return effective_force(forces, self.threshold, self.window)

    def extra_repr(self) -> str:
        """Options shown by print."""
        return f"threshold={self.threshold}, window={self.window}"


class TactileEmbedding(nn.Module):
    """Touch code of a spike rate density; see `tactile_embedding`.

    Args:
        joints: N_J.
        neurons: N_n, place neurons a joint.
        bits: n, bits a place neuron.
    """

    def __init__(self, joints: int, neurons: int, bits: int) -> None:
        super().__init__()
        self.joints, self.neurons, self.bits = joints, neurons, bits

    def forward(self, rho: Tensor, levels: Tensor) -> Tensor:
        """Touch code, before it is rotated.

        Args:
            rho: (...) in [0, 1].
            levels: (..., joints * neurons), from PlaceCode.levels.

        Returns:
            (..., joints * neurons * bits) in {-1, +1}.

        Raises:
            ValueError: if `levels` has another shape, or `rho` leaves [0, 1] (not checked under
                torch.compile).
        """
        if levels.ndim == 0 or levels.shape[-1] != self.joints * self.neurons:
            raise ValueError(
                f"expected levels of shape (..., {self.joints * self.neurons}), got "
                f"{tuple(levels.shape)}"
            )
        if not torch.compiler.is_compiling() and not ((rho >= 0) & (rho <= 1)).all():
            raise ValueError("expected rho in [0, 1]; use spike_density(rate, max_rate)")
        return tactile_embedding(rho, levels, self.bits)

    def extra_repr(self) -> str:
        """Options shown by print."""
        return f"joints={self.joints}, neurons={self.neurons}, bits={self.bits}"


def _check_force_options(threshold: float, window: int) -> None:
    if window != int(window) or window < 1:
        raise ValueError(f"expected a window of whole samples, at least 1, got {window}")
    if not threshold >= 0:
        raise ValueError(f"expected a threshold >= 0 N, got {threshold}")
