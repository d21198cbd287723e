"""How full and how crowded a memory is, and which β fits it."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Multiplications spent on matches; where all pairs would take more, fewer rows are judged.
LARGEST_WORK = 1e11


@dataclass(frozen=True)
class Crowding:
    """How full and how crowded a memory is.

    Attributes:
        held: Associations held.
        capacity: Associations that fit.
        duplicates: Associations that share their code with another one.
        margin: Smallest lead of an association's match with itself over its best match with a
            different one, in units of the inner product; its match with itself if there is no
            other.
        crosstalk: Mean over the associations of the best match with a different one, as a share
            of the match with itself; 0 if there is no other.
        beta: Inverse temperature at which, for a query that equals a stored association, all
            others together weigh less than 1/``confidence`` of it.
    """

    held: int
    capacity: int
    duplicates: int
    margin: float
    crosstalk: float
    beta: float


def crowding(associations: Tensor, capacity: int, confidence: float = 1e6) -> Crowding:
    """Judge stored associations.

        β = ln(confidence · (K − 1)) / margin

    since K − 1 others, each at least ``margin`` behind, weigh at most (K − 1) e^(−β margin) of the
    best one.

    Args:
        associations: M, (K, code_dim), K at least 1.
        capacity: Associations that fit.
        confidence: Ratio of the right weight to all others together.

    Returns:
        The report; of many long associations margin and crosstalk come from an evenly spread
        sample, each judged against all others.

    Raises:
        ValueError: If there is no association, or the confidence is not above 0.
    """
    if len(associations) == 0:
        raise ValueError("an empty memory has no margin: write at least one association first")
    if not confidence > 0:
        raise ValueError(f"confidence must be above 0, got {confidence}")
    stored = associations[_distinct(associations)].float()
    held, alone = len(stored), len(stored) == 1
    own = stored.square().sum(-1)
    rows = torch.arange(0, held, max(1, math.ceil(held * stored.numel() / LARGEST_WORK)))
    rival = torch.cat([_best_rival(stored, part) for part in rows.to(own.device).split(512)])
    margin = float(own[0]) if alone else float((own[rows] - rival).min())
    crosstalk = 0.0 if alone else float((rival / own[rows]).mean())
    beta = math.log(max(confidence * max(held - 1, 1), math.e)) / max(margin, 1e-6)
    duplicates = len(associations) - held
    return Crowding(len(associations), capacity, duplicates, margin, crosstalk, beta)


def _distinct(rows: Tensor) -> Tensor:
    """Indices of the first of each group of equal rows, ascending."""
    values = np.ascontiguousarray(rows.detach().float().cpu().numpy())
    whole = values.view(np.dtype((np.void, values.strides[0]))).ravel()
    _, first = np.unique(whole, return_index=True)
    return torch.from_numpy(np.sort(first)).to(rows.device)


def _best_rival(stored: Tensor, rows: Tensor) -> Tensor:
    """Best match of some rows with any other row, (len(rows),)."""
    scores = stored[rows] @ stored.mT
    scores[torch.arange(len(rows), device=rows.device), rows] = -torch.inf
    return scores.amax(-1)
