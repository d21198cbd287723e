"""Recall of a fixed fuzziness: β chosen for each query.

    w = softmax(β s),   β such that exp(H(w)) = P

H is the entropy of the weights w, s the scores Mᵀq and exp(H) the perplexity, the number of
associations that the recall in effect averages. One β for all queries averages too many where the
memory is dense and too few where it is sparse; one P does neither.
"""

import math

import torch
from torch import Tensor

# Bisections of log β between the bounds, which leaves β uncertain by 1 %.
_STEPS = 10
_LOG_BETA = (-3.0, 7.0)  # in units of one over the mean lag behind the best match


def anneal(scores: Tensor, perplexity: Tensor | float) -> Tensor:
    """Softmax weights whose perplexity is given.

    Args:
        scores: (..., K) scores of the associations that take part.
        perplexity: P, a number or broadcastable to (...,); where P is K or more, all weights are
            nearly equal.

    Returns:
        (..., K) weights that sum to 1. Associations that tie for the best, or lag behind it by less
        than some thousandth of the mean lag, share the weight even where they are more than P.
    """
    lag = scores.amax(-1, keepdim=True) - scores
    lag = lag / lag.mean(-1, keepdim=True).clamp(min=torch.finfo(lag.dtype).tiny)
    wanted = torch.as_tensor(perplexity, dtype=lag.dtype, device=lag.device).log()
    low, high = (torch.full(lag.shape[:-1], bound, dtype=lag.dtype) for bound in _LOG_BETA)
    low, high = low.to(lag.device), high.to(lag.device)
    for _ in range(_STEPS):
        middle = (low + high) / 2
        beta = middle.exp()
        weights = torch.exp(-beta.unsqueeze(-1) * lag)
        total = weights.sum(-1)
        entropy = total.log() + beta * (weights * lag).sum(-1) / total
        fuzzy = entropy > wanted
        low, high = torch.where(fuzzy, middle, low), torch.where(fuzzy, high, middle)
    return torch.softmax(-((low + high) / 2).exp().unsqueeze(-1) * lag, dim=-1)


def perplexity(weights: Tensor) -> Tensor:
    """exp(H) of weights (..., K) that sum to 1: 1 for one association, K for K equal ones."""
    return torch.special.entr(weights).sum(-1).clamp(0.0, math.inf).exp()
