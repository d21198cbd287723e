"""Interaction functions: how the match with an association becomes its weight.

With z = β Mᵀ q,

    softmax        w = e^z / Σ e^z      the paper's update rule: every association weighs something
    sparsemax      w = [z − τ]₊         the point of the simplex nearest to z
    entmax15       w = [z/2 − τ]₊²      between the two
    exponential    w = e^z              exponential dense associative memory
    d = 1, 2, 3 …  w = z^d              polynomial dense associative memory

τ makes the weights sum to one. The last two are not normalised: a decision is then read by its
sign.

The threshold. Sparsemax and entmax15 maximise wᵀz + H(w) over the simplex, H being ½ Σ w (1 − w)
and 4/3 Σ w (1 − √w); softmax does so for Shannon's entropy. Where w > 0 the derivative is one and
the same number for all rows, which gives w = [x − τ]₊^p with x = z/p and p = 1 or 2. Elsewhere
w = 0, so only the n best rows weigh, and with their mean μ and sum of squares S about it,

    p = 1:  n μ − n τ = 1                   τ = μ − 1/n
    p = 2:  S + n (μ − τ)² = 1              τ = μ − √((1 − S) / n).

n is the largest number at which the n-th best x still lies above this τ. As Σ w = 1 and each w is
at most 1, the best x lies at most 1 above τ: a row farther behind weighs nothing, whatever the
others are.

Sources: Krotov and Hopfield 2016; Demircigil et al. 2017; Martins and Astudillo 2016 (sparsemax);
Peters, Niculae and Martins 2019 (entmax); Chaudhry et al. 2023 (asymmetric, for sequences).
"""

from typing import Literal

import torch
from torch import Tensor

Interaction = Literal["softmax", "sparsemax", "entmax15", "exponential"] | int
POWERS = {"sparsemax": 1, "entmax15": 2}  # p
NORMALISED = ("softmax", *POWERS)
_LARGEST = torch.finfo(torch.float32).max


def check_interaction(interaction: Interaction, top_k: int | None = None) -> None:
    """Refuse an interaction that does not exist.

    Raises:
        ValueError: If it is none of the names and no degree of at least 1, or ``top_k`` is below 1.
    """
    named = interaction in (*NORMALISED, "exponential")
    degree = isinstance(interaction, int) and not isinstance(interaction, bool) and interaction >= 1
    if not (named or degree):
        names = ", ".join(repr(name) for name in (*NORMALISED, "exponential"))
        raise ValueError(
            f"unknown interaction {interaction!r}, valid: {names}, or a degree 1, 2, 3, ..."
        )
    if top_k is not None and top_k < 1:
        raise ValueError(f"top_k must be at least 1, or None for all associations, got {top_k}")


def interact(
    scores: Tensor,
    beta: float | Tensor,
    interaction: Interaction = "softmax",
    top_k: int | None = None,
    absent: Tensor | None = None,
) -> Tensor:
    """Weights of the associations from the query's inner products with them.

    Args:
        scores: Mᵀ q, (..., rows).
        beta: β, a number or a () tensor.
        interaction: The function.
        top_k: Only the k best matches weigh, and what matches exactly as well as the k-th.
        absent: Rows that take no part, (..., rows) bool.

    Returns:
        (..., rows); 0 for rows that take no part, NaN if none does and the weights are normalised.
    """
    if not isinstance(beta, Tensor):
        beta = torch.as_tensor(beta, dtype=scores.dtype, device=scores.device)
    ranked = rank(scores.detach(), beta, absent)
    if top_k is not None:
        least = ranked.topk(min(top_k, ranked.shape[-1])).values[..., -1:]
        ranked = ranked.masked_fill(ranked < least, -torch.inf)
    left_out = ranked == -torch.inf
    if interaction not in NORMALISED:
        z = beta * scores.masked_fill(left_out, 0.0)
        weights = torch.exp(z) if interaction == "exponential" else z ** int(interaction)
        return weights.masked_fill(left_out, 0.0)
    # Relative to the best match, so that an infinite β leaves it at 0 and all others at -infinity.
    best = ranked.amax(-1, keepdim=True)
    behind = (scores - torch.where(beta < 0, -best, best)).masked_fill(left_out, 0.0)
    z = (beta.clamp(-_LARGEST, _LARGEST) * behind).masked_fill(left_out, -torch.inf)
    if interaction == "softmax":
        return torch.softmax(z, dim=-1)
    return _above_threshold(z, POWERS[str(interaction)])


def rank(scores: Tensor, beta: float | Tensor, absent: Tensor | None) -> Tensor:
    """Order of the matches, the greatest first recalled; −∞ for rows that take no part."""
    ranked = torch.where(torch.as_tensor(beta) < 0, -scores, scores)
    return ranked if absent is None else ranked.masked_fill(absent, -torch.inf)


def _above_threshold(z: Tensor, power: int) -> Tensor:
    """Weights [z/p − τ]₊^p of logits whose largest is 0, see the module."""
    x = z / power
    with torch.no_grad():
        best = x.double().clamp(min=-1.0).sort(dim=-1, descending=True).values
        count = torch.arange(1, x.shape[-1] + 1, device=x.device)
        mean = best.cumsum(-1) / count
        spread = best.square().cumsum(-1) - count * mean.square()
        threshold = _threshold(mean, spread, count, power)
        fitting = (best > threshold).sum(-1, keepdim=True)
        weighs = x > threshold.gather(-1, (fitting - 1).clamp(min=0))
    # The support found, τ is a smooth function of what lies in it, and so are the weights.
    count = weighs.sum(-1, keepdim=True)
    mean = x.masked_fill(~weighs, 0.0).sum(-1, keepdim=True) / count
    spread = (x - mean).masked_fill(~weighs, 0.0).square().sum(-1, keepdim=True)
    above = (x - _threshold(mean, spread, count, power)).masked_fill(~weighs, 0.0)
    weights = above**power
    return weights / weights.sum(-1, keepdim=True)  # NaN where no row takes part


def _threshold(mean: Tensor, spread: Tensor, count: Tensor, power: int) -> Tensor:
    """τ for the n best x, of mean μ and sum of squares about it S."""
    if power == 1:
        return mean - count.to(mean.dtype).reciprocal()
    return mean - ((1 - spread) / count).clamp(min=0.0).sqrt()
