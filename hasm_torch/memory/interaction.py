"""Interaction functions: how the match with an association becomes its weight.

    softmax        w = softmax(β Mᵀ q)            the paper's update rule
    exponential    w = exp(β Mᵀ q)                exponential dense associative memory
    d = 1, 2, 3 …  w = (β Mᵀ q)^d                 polynomial dense associative memory

The last two are not normalised: a decision is then read by its sign. Sources: Krotov and Hopfield
2016; Demircigil et al. 2017; Chaudhry et al. 2023 (asymmetric, for sequences).
"""

from typing import Literal

import torch
from torch import Tensor

Interaction = Literal["softmax", "exponential"] | int
NAMES = "'softmax', 'exponential', or a degree 1, 2, 3, ..."


def check_interaction(interaction: Interaction) -> None:
    """Refuse an interaction that does not exist.

    Raises:
        ValueError: If it is none of the names and no degree of at least 1.
    """
    named = interaction in ("softmax", "exponential")
    degree = isinstance(interaction, int) and not isinstance(interaction, bool) and interaction >= 1
    if not (named or degree):
        raise ValueError(f"unknown interaction {interaction!r}, valid: {NAMES}")


def interact(scores: Tensor, beta: float | Tensor, interaction: Interaction) -> Tensor:
    """Weights of the associations from the query's inner products with them.

    Args:
        scores: Mᵀ q, (..., rows); rows that take no part hold NaN.
        beta: β, a number or a () tensor.
        interaction: The function.

    Returns:
        (..., rows); 0 for rows that take no part.
    """
    absent = torch.isnan(scores)
    logits = beta * torch.where(absent, 0.0, scores)
    if interaction == "softmax":
        return torch.softmax(logits.masked_fill(absent, -torch.inf), dim=-1)
    weights = torch.exp(logits) if interaction == "exponential" else logits**interaction
    return torch.where(absent, 0.0, weights)
