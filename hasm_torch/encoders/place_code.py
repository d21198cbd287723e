"""Population place code: joint positions as the activity of tuned neurons, written in bits.

Each joint has N_p neurons whose preferred positions are spread evenly over its limits. Neuron i of
joint j answers with the rate (paper, eq. tuning_curve)

    r_i^j = exp(-(phi^j - phi_i^j)^2 / (2 sigma^2)),

which is quantised to a level and written as bits, 0 as -1. Entries run joint by joint, neuron by
neuron, bit by bit. Three ways of writing a level:

    binary       the rate as 8 bits (0 to 255), shifted right by 8 - n, most significant bit first:
                 the paper's "n bit-shift, keeping only the most significant n bits"
    gray         the same level in Gray code: neighbouring levels differ in one bit
    thermometer  level = round(rate n), entry i is +1 where level > i: codes differ in as many
                 entries as their levels lie apart
"""

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from hasm_torch.encoders.bipolar import binarise, to_bipolar

CODES = ("binary", "gray", "thermometer")
NARROWEST_CELL = 1e-9  # in neuron spacings; edges closer than that are one edge, but for rounding


def spike_rates(q: Tensor, lower: Tensor, upper: Tensor, neurons: int, width: float) -> Tensor:
    """Rates of the neurons tuned to each joint (paper, eq. tuning_curve).

    Args:
        q: (..., J) joint positions, rad or m; those outside the limits count as the limit.
        lower: (J,) lower joint limits.
        upper: (J,) upper joint limits, where the last neuron's preferred position lies.
        neurons: N_p, at least 2.
        width: sigma in neuron spacings.

    Returns:
        (..., J, neurons) in [0, 1], in the dtype of `q` or float32 where that is coarser.
    """
    dtype = torch.promote_types(q.dtype, torch.float32)
    lower, upper = lower.to(dtype), upper.to(dtype)
    # in neuron spacings, neuron i prefers position i
    position = (q.to(dtype).clamp(lower, upper) - lower) / (upper - lower) * (neurons - 1)
    preferred = torch.arange(neurons, dtype=dtype, device=q.device)
    return torch.exp(-0.5 * ((position.unsqueeze(-1) - preferred) / width) ** 2)


def quantise(rates: Tensor, bits: int, code: str) -> Tensor:
    """Levels of spike rates.

    Args:
        rates: (...) in [0, 1].
        bits: n, bits of the code.
        code: one of CODES.

    Returns:
        (...) int32, 0 to 2^n - 1 for binary and gray, 0 to n for thermometer.
    """
    if code == "thermometer":
        return torch.round(rates * bits).to(torch.int32)
    return torch.round(rates * 255).to(torch.int32) >> (8 - bits)


def place_code(levels: Tensor, bits: int, code: str, dtype: torch.dtype | None = None) -> Tensor:
    """Write levels as bipolar bits.

    Args:
        levels: (..., M) integers from `quantise`.
        bits: n, bits of the code.
        code: one of CODES.
        dtype: of the result; torch's default dtype where None.

    Returns:
        (..., M * bits) in {-1, +1}.
    """
    levels = levels.unsqueeze(-1)
    if code == "thermometer":
        on = levels > torch.arange(bits, device=levels.device)
    else:
        if code == "gray":
            levels = levels ^ (levels >> 1)
        on = (levels >> torch.arange(bits - 1, -1, -1, device=levels.device)) & 1 == 1
    return to_bipolar(on, dtype).flatten(-2)


class PlaceCode(nn.Module):
    """Bipolar place code of joint positions.

    The limits stay in the precision they were given in (float64 for numbers) when the module is
    converted to a dtype coarser than float32.

    Args:
        lower: (J,) lower joint limits, rad or m.
        upper: (J,) upper joint limits.
        neurons: N_p, neurons a joint, at least 2.
        bits: n, bits a neuron: 1 to 8 for binary and gray, 1 or more for thermometer.
        width: sigma of the tuning curve in neuron spacings.
        code: "binary", "gray" or "thermometer".

    Attributes:
        joints: J.
        code_dim: D = J * neurons * bits.

    Raises:
        ValueError: if the limits are not finite or not in order, or an option is out of range.
    """

    lower: Tensor
    upper: Tensor
    cell_positions: Tensor
    cell_codes: Tensor

    def __init__(
        self,
        lower: Tensor | Sequence[float],
        upper: Tensor | Sequence[float],
        neurons: int = 10,
        bits: int = 4,
        width: float = 1.0,
        code: str = "binary",
    ) -> None:
        super().__init__()
        lower, upper = _as_limits(lower), _as_limits(upper)
        _check_limits(lower, upper)
        _check_options(neurons, bits, width, code)
        self.joints, self.code_dim = len(lower), len(lower) * neurons * bits
        self.neurons, self.bits, self.width, self.code = neurons, bits, width, code
        self.register_buffer("lower", lower)
        self.register_buffer("upper", upper)
        positions, codes = self._cells()
        self.register_buffer("cell_positions", positions.to(lower.device), persistent=False)
        self.register_buffer("cell_codes", codes.to(lower.device), persistent=False)

    def levels(self, q: Tensor) -> Tensor:
        """Quantised rates of all neurons.

        Args:
            q: (..., J) joint positions, rad or m; those outside the limits count as the limit.

        Returns:
            (..., J * neurons) int32.

        Raises:
            ValueError: if `q` has another shape, or holds a non-finite position (not checked
                under torch.compile, where a check would wait for the device).
        """
        self.check(q)
        rates = spike_rates(q, self.lower, self.upper, self.neurons, self.width)
        return quantise(rates, self.bits, self.code).flatten(-2)

    def check(self, q: Tensor) -> None:
        """Refuse joint positions of another shape, or not finite; arguments as in ``levels``."""
        if q.ndim == 0 or q.shape[-1] != self.joints:
            raise ValueError(
                f"expected joint positions of shape (..., {self.joints}), got {tuple(q.shape)}"
            )
        if not torch.compiler.is_compiling():
            finite = torch.isfinite(q)
            if not finite.all():
                joints = (~finite).reshape(-1, self.joints).any(0).nonzero().flatten().tolist()
                raise ValueError(f"expected finite joint positions, got others at joints {joints}")

    def forward(self, q: Tensor) -> Tensor:
        """Place code of joint positions: (..., J) -> (..., D) in {-1, +1}, in the dtype of q."""
        return place_code(self.levels(q), self.bits, self.code, q.dtype)

    def decode(self, code: Tensor) -> Tensor:
        """Joint positions whose place code agrees with `code` in the most entries.

        The range of a joint falls into cells of positions that share one code; the answer is the
        middle of the best cell, whose own code is that of the cell. Counting agreeing
        entries is the best guess where single bits are wrong. (Comparing levels instead was
        measured with 10 % of the bits flipped, 10 neurons, 4 bits: a mean error of 1.2 % of the
        range against 0.5 %.)

        Args:
            code: (..., D); noisy or real-valued codes are taken by their signs.

        Returns:
            (..., J) joint positions, rad or m, in the dtype of `code` or float32 where that is
            coarser.

        Raises:
            ValueError: if `code` has another shape.
        """
        if code.ndim == 0 or code.shape[-1] != self.code_dim:
            raise ValueError(
                f"expected a code of shape (..., {self.code_dim}), got {tuple(code.shape)}"
            )
        dtype = torch.promote_types(code.dtype, torch.float32)
        signs = binarise(code.detach()).unflatten(-1, (self.joints, self.neurons * self.bits))
        agreement = signs.to(self.cell_codes.dtype) @ self.cell_codes.mT
        fraction = self.cell_positions[agreement.argmax(-1)]
        return (self.lower + fraction * (self.upper - self.lower)).to(dtype)

    def extra_repr(self) -> str:
        """Options shown by print."""
        return (
            f"joints={self.joints}, neurons={self.neurons}, bits={self.bits}, "
            f"width={self.width}, code={self.code!r}"
        )

    def _cells(self) -> tuple[Tensor, Tensor]:
        """Cells of a joint's range: middles (cells,) as fractions of it, codes (cells, N_p n).

        One table serves all joints, for the code depends on the fraction of the range alone. Neuron
        i changes to level k where its rate is r_k, half a level below it: at the positions
        i +- width sqrt(-2 ln r_k) in neuron spacings. A cell lies between two such positions.
        """
        top, step = (self.bits, 1) if self.code == "thermometer" else (255, 2 ** (8 - self.bits))
        rates = (np.arange(step, top + 1, step) - 0.5) / top
        reach = self.width * np.sqrt(-2.0 * np.log(rates))
        neurons = np.arange(self.neurons)[:, None]
        last = self.neurons - 1.0
        changes = np.concatenate([neurons - reach, neurons + reach], axis=None)
        changes = np.sort(changes[(changes > 0) & (changes < last)])
        edges = np.concatenate([[0.0], changes, [last]])
        widths = np.diff(edges)
        middles = torch.from_numpy((edges[:-1] + widths / 2)[widths > NARROWEST_CELL] / last)

        lower, upper = middles.new_zeros(1), middles.new_ones(1)
        levels = quantise(
            spike_rates(middles.unsqueeze(-1), lower, upper, self.neurons, self.width),
            self.bits,
            self.code,
        ).squeeze(-2)
        return middles, place_code(levels, self.bits, self.code, torch.float32)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Convert the module, but keep positions in float32 or better."""
        kept = {name: getattr(self, name) for name in ("lower", "upper", "cell_positions")}
        super()._apply(fn, recurse)
        for name, before in kept.items():
            after = getattr(self, name)
            if torch.finfo(after.dtype).bits < 32:
                setattr(self, name, before.to(after.device))
        return self


def _as_limits(limits: Tensor | Sequence[float]) -> Tensor:
    if isinstance(limits, Tensor):
        return limits.detach().to(torch.promote_types(limits.dtype, torch.float32)).clone()
    return torch.tensor(limits, dtype=torch.float64)


def _check_limits(lower: Tensor, upper: Tensor) -> None:
    if lower.ndim != 1 or lower.shape != upper.shape or len(lower) == 0:
        raise ValueError(
            "expected lower and upper limits of one shape (J,), got "
            f"{tuple(lower.shape)} and {tuple(upper.shape)}"
        )
    pairs = list(zip(lower.tolist(), upper.tolist(), strict=True))
    if not all(torch.isfinite(limits).all() for limits in (lower, upper)):
        raise ValueError(
            f"expected finite joint limits, got {pairs}; give a continuous joint a range of its own"
        )
    for joint, (low, high) in enumerate(pairs):
        if low >= high:
            raise ValueError(f"expected lower < upper, got [{low}, {high}] for joint {joint}")


def _check_options(neurons: int, bits: int, width: float, code: str) -> None:
    if code not in CODES:
        raise ValueError(f"unknown code {code!r}, expected one of {', '.join(CODES)}")
    if neurons < 2:
        raise ValueError(f"expected neurons >= 2, one at each joint limit, got {neurons}")
    if bits < 1 or (code != "thermometer" and bits > 8):
        raise ValueError(
            f"expected bits from 1 to 8 for the {code} code, got {bits}"
            if code != "thermometer"
            else f"expected bits >= 1, got {bits}"
        )
    if not 0 < width < float("inf"):
        raise ValueError(f"expected a width > 0 in neuron spacings, got {width}")
