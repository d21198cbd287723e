"""Softmax recall over a dense memory: d = S₋₁ softmax(β Mᵀ q).

Notation: M holds one association a row, S₋₁ its successors, q is the query, β the inverse
temperature and d the decision.

Source: Wang, Wang, Cheng, "A Hetero-Associative Sequential Memory Model Utilizing Neuromorphic
Signals", section "Hetero-associative Sequential Memory".
"""

from typing import NamedTuple

import torch
from torch import Tensor

# Storage narrower than float32 is widened in parts of at most so many entries (64 MiB).
_WIDENED_ENTRIES = 1 << 24


class Recall(NamedTuple):
    """A decision and how sure the memory is of it.

    Attributes:
        decision: d, (..., values).
        match: Row of the best match, (...,) int64; the first of equals, -1 if no row takes part.
        score: Inner product of the query with the best match, (...,).
        margin: How much better the best match scores than the second best, (...,) >= 0;
            infinite if one row takes part.
        entropy: Entropy of the softmax weights, (...,), nats.
    """

    decision: Tensor
    match: Tensor
    score: Tensor
    margin: Tensor
    entropy: Tensor


def recall_dense(
    query: Tensor,
    associations: Tensor,
    successors: Tensor,
    beta: float | Tensor,
    count: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Recalls what followed the associations most like the query.

        d = S₋₁ softmax(β Mᵀ q)      (Hetero-associative Sequential Memory)

    Differentiable in the query, β, the associations (where they are floating point) and the
    successors. Scores and softmax are computed in float32 or better whatever the storage.

    Args:
        query: q, (*batch, ..., dim).
        associations: M, (*batch, rows, dim): one memory for all queries without ``batch``, else a
            memory for each of its entries; floating point or int8.
        successors: S₋₁, (*batch, rows, values).
        beta: β, a number or a () tensor.
        count: Number of rows filled, () or (*batch,) int64; without it all of them.
        mask: Rows each query may recall, (*batch, ..., rows) bool.

    Returns:
        Decision d, (*batch, ..., values); NaN where no row takes part.

    Raises:
        ValueError: If the shapes do not fit one another.
    """
    _, logits = _scores(query, associations, successors, beta, count, mask)
    return _decide(torch.softmax(logits, dim=-1), query, successors)


def inspect_dense(
    query: Tensor,
    associations: Tensor,
    successors: Tensor,
    beta: float | Tensor,
    count: Tensor | None = None,
    mask: Tensor | None = None,
) -> Recall:
    """Recalls like ``recall_dense`` and tells the best match, its margin and the entropy."""
    scores, logits = _scores(query, associations, successors, beta, count, mask)
    return summarise(scores, logits, beta, query, successors)


def recall_weights(
    query: Tensor,
    associations: Tensor,
    beta: float | Tensor,
    count: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """The softmax weight of every row, (*batch, ..., rows); arguments as in ``recall_dense``."""
    _, logits = _scores(query, associations, None, beta, count, mask)
    return torch.softmax(logits, dim=-1)


def check_shapes(
    query: Tensor, batch: torch.Size, rows: int, successors: Tensor, mask: Tensor | None
) -> None:
    """Refuses a query, successors or a mask that do not fit a memory of ``batch`` and ``rows``."""
    if query.ndim <= len(batch) or query.shape[: len(batch)] != batch:
        raise ValueError(
            f"expected a query with the memory's leading dimensions {tuple(batch)}, got "
            f"{tuple(query.shape)}"
        )
    if successors.shape[:-2] != batch or successors.shape[-2] > rows or successors.ndim < 2:
        raise ValueError(
            f"expected successors {(*batch, rows, 'values')}, got {tuple(successors.shape)}"
        )
    if mask is not None and mask.shape != (*query.shape[:-1], successors.shape[-2]):
        raise ValueError(
            f"expected a mask {(*query.shape[:-1], successors.shape[-2])}, got {tuple(mask.shape)}"
        )


def exclude(scores: Tensor, batch_dims: int, count: Tensor | None, mask: Tensor | None) -> Tensor:
    """Which rows take no part, broadcastable to the scores (..., rows)."""
    rows = torch.arange(scores.shape[-1], device=scores.device)
    if count is None:
        empty = torch.zeros_like(rows, dtype=torch.bool)
    else:
        between = scores.ndim - batch_dims if count.ndim else 0
        empty = rows >= count.reshape([*count.shape, *[1] * between])
    return empty if mask is None else empty | ~mask


def summarise(
    scores: Tensor, logits: Tensor, beta: float | Tensor, query: Tensor, successors: Tensor
) -> Recall:
    """Decision and statistics from the scores and logits (-inf: takes no part) of every row."""
    weights = torch.softmax(logits, dim=-1)
    ranked = torch.where(
        logits > -torch.inf, torch.where(torch.as_tensor(beta) < 0, -scores, scores), -torch.inf
    )
    best = ranked.argmax(-1, keepdim=True)
    found = ranked.gather(-1, best).squeeze(-1)
    rival = ranked.scatter(-1, best, -torch.inf).amax(-1)
    missing = found == -torch.inf
    return Recall(
        _decide(weights, query, successors),
        torch.where(missing, -1, best.squeeze(-1)),
        torch.where(missing, torch.nan, scores.gather(-1, best).squeeze(-1)),
        torch.where(missing, torch.nan, found - rival),
        torch.special.entr(weights).sum(-1),
    )


def _scores(
    query: Tensor,
    associations: Tensor,
    successors: Tensor | None,
    beta: float | Tensor,
    count: Tensor | None,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Scores Mᵀq and logits βMᵀq, (*batch, ..., rows); logits are -inf where a row is left out."""
    batch, (rows, dim) = associations.shape[:-2], associations.shape[-2:]
    check_shapes(query, batch, rows, associations if successors is None else successors, mask)
    if query.shape[-1] != dim:
        raise ValueError(f"expected a query (..., {dim}), got {tuple(query.shape)}")
    dtype = torch.promote_types(torch.float32, query.dtype)
    if associations.dtype.is_floating_point:
        dtype = torch.promote_types(dtype, associations.dtype)
    queries = query.to(dtype).reshape(*batch, -1, dim)
    if associations.dtype == dtype:
        scores = queries @ associations.mT
    else:
        step = max(1, _WIDENED_ENTRIES // (dim * max(1, batch.numel())))
        parts = [queries @ part.to(dtype).mT for part in associations.split(step, dim=-2)]
        scores = parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
    scores = scores.reshape(*query.shape[:-1], rows)
    logits = beta * scores
    if count is not None or mask is not None:
        logits = logits.masked_fill(exclude(scores, len(batch), count, mask), -torch.inf)
    return scores, logits


def _decide(weights: Tensor, query: Tensor, successors: Tensor) -> Tensor:
    dtype = torch.promote_types(weights.dtype, successors.dtype)
    batch, (rows, values) = successors.shape[:-2], successors.shape[-2:]
    flat = weights.to(dtype).reshape(*batch, -1, weights.shape[-1])[..., :rows]
    return (flat @ successors.to(dtype)).reshape(*query.shape[:-1], values)
