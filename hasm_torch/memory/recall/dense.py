"""Recall over a dense memory: d = S₋₁ softmax(β Mᵀ q), or another interaction.

Notation: M holds one association a row, S₋₁ its successors, q is the query, β the inverse
temperature and d the decision.

Source: Wang, Wang, Cheng, "A Hetero-Associative Sequential Memory Model Utilizing Neuromorphic
Signals", section "Hetero-associative Sequential Memory".
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hasm_torch.memory.recall.interaction import Interaction, interact, rank

# Storage narrower than float32 is widened in parts of at most so many entries (64 MiB).
_WIDENED_ENTRIES = 1 << 24


class Stored(NamedTuple):
    """What is recalled from, and how.

    Attributes:
        associations: M, (*batch, rows, dim): one memory for all queries without ``batch``, else a
            memory for each of its entries; floating point or int8. Of a packed memory as ``pack``
            gives it, (*batch, blocks, words, 64) int32.
        successors: S₋₁, (*batch, rows, values).
        beta: β, a number or a () tensor.
        held: Number of rows filled, () or (*batch,) int64; without it all of them.
        mask: Rows each query may recall, (*batch, ..., rows) bool.
        interaction: How a match becomes a weight, see ``interaction``.
        top_k: Best matches that weigh, see ``interaction``; None for all.
    """

    associations: Tensor
    successors: Tensor
    beta: float | Tensor
    held: Tensor | None = None
    mask: Tensor | None = None
    interaction: Interaction = "softmax"
    top_k: int | None = None


class Recall(NamedTuple):
    """A decision and how sure the memory is of it.

    Attributes:
        decision: d, (..., values).
        match: Row of the best match, (...,) int64; the first of equals, -1 if no row takes part.
        score: Inner product of the query with the best match, (...,).
        margin: How much better the best match scores than the second best, (...,) >= 0;
            infinite if one row takes part.
        entropy: Entropy of the weights, (...,), nats.
    """

    decision: Tensor
    match: Tensor
    score: Tensor
    margin: Tensor
    entropy: Tensor


def full_precision[**Given, Found](recall: Callable[Given, Found]) -> Callable[Given, Found]:
    """Keeps autocast from rounding the scores; entering a context costs, so only where it is on."""

    @functools.wraps(recall)
    def run(*given: Given.args, **options: Given.kwargs) -> Found:
        device = given[0].device.type  # type: ignore[attr-defined]
        if not torch.is_autocast_enabled(device):
            return recall(*given, **options)
        with torch.autocast(device, enabled=False):
            return recall(*given, **options)

    return run


@full_precision
def recall_dense(query: Tensor, memory: Stored) -> Tensor:
    """Recalls what followed the associations most like the query.

        d = S₋₁ softmax(β Mᵀ q)      (Hetero-associative Sequential Memory)

    Differentiable in the query, β, the associations (where they are floating point) and the
    successors. Scores and weights are computed in float32 or better whatever the storage.

    Args:
        query: q, (*batch, ..., dim).
        memory: What is recalled from.

    Returns:
        Decision d, (*batch, ..., values); NaN where no row takes part.

    Raises:
        ValueError: If the shapes do not fit one another.
    """
    return _decide(weigh(_scores(query, memory), memory), query, memory)


@full_precision
def inspect_dense(query: Tensor, memory: Stored) -> Recall:
    """Recalls like ``recall_dense`` and tells the best match, its margin and the entropy."""
    return summarise(_scores(query, memory), query, memory)


@full_precision
def weights_dense(query: Tensor, memory: Stored) -> Tensor:
    """The weight of every row, (*batch, ..., rows); arguments as in ``recall_dense``."""
    return weigh(_scores(query, memory), memory)


def check_shapes(query: Tensor, memory: Stored, batch: torch.Size, rows: int) -> None:
    """Refuses what does not fit associations of a leading ``batch`` and so many rows."""
    shape, leading = memory.successors.shape, len(batch)
    if query.ndim <= leading or (leading and query.shape[:leading] != batch):
        raise ValueError(
            f"expected a query with the memory's leading dimensions {tuple(batch)}, got "
            f"{tuple(query.shape)}"
        )
    if len(shape) != leading + 2 or shape[leading] > rows or (leading and shape[:leading] != batch):
        raise ValueError(f"expected successors {(*batch, rows, 'values')}, got {tuple(shape)}")
    mask = memory.mask
    if mask is not None and mask.shape != (*query.shape[:-1], shape[leading]):
        raise ValueError(
            f"expected a mask {(*query.shape[:-1], shape[leading])}, got {tuple(mask.shape)}"
        )


def weigh(scores: Tensor, memory: Stored) -> Tensor:
    """The weights that scores (*batch, ..., rows) give."""
    return interact(scores, memory.beta, memory.interaction, memory.top_k, _absent(scores, memory))


def summarise(scores: Tensor, query: Tensor, memory: Stored) -> Recall:
    """Decision and statistics from the scores (*batch, ..., rows)."""
    weights = weigh(scores, memory)
    ranked = rank(scores, memory.beta, _absent(scores, memory))
    best = ranked.argmax(-1, keepdim=True)
    found = ranked.gather(-1, best).squeeze(-1)
    rival = ranked.scatter(-1, best, -torch.inf).amax(-1)
    missing = found == -torch.inf
    return Recall(
        _decide(weights, query, memory),
        torch.where(missing, -1, best.squeeze(-1)),
        torch.where(missing, torch.nan, scores.gather(-1, best).squeeze(-1)),
        torch.where(missing, torch.nan, found - rival),
        torch.special.entr(weights).sum(-1),
    )


def _absent(scores: Tensor, memory: Stored) -> Tensor | None:
    """Which rows take no part, broadcastable to the scores (*batch, ..., rows); None if all do."""
    absent = None if memory.mask is None else ~memory.mask
    if memory.held is not None:
        held, rows = memory.held, torch.arange(scores.shape[-1], device=scores.device)
        between = scores.ndim - held.ndim if held.ndim else 0
        empty = rows >= held.reshape([*held.shape, *[1] * between])
        absent = empty if absent is None else empty | absent
    return absent


def _decide(weights: Tensor, query: Tensor, memory: Stored) -> Tensor:
    dtype = torch.promote_types(weights.dtype, memory.successors.dtype)
    *batch, rows, values = memory.successors.shape
    flat = weights.to(dtype).reshape(*batch, -1, rows)
    return (flat @ memory.successors.to(dtype)).reshape(*query.shape[:-1], values)


def _scores(query: Tensor, memory: Stored) -> Tensor:
    """Scores Mᵀq, (*batch, ..., rows)."""
    associations = memory.associations
    batch, (rows, dim) = associations.shape[:-2], associations.shape[-2:]
    check_shapes(query, memory, batch, rows)
    if query.shape[-1] != dim:
        raise ValueError(f"expected a query (..., {dim}), got {tuple(query.shape)}")
    dtype = torch.promote_types(torch.float32, query.dtype)
    if associations.dtype.is_floating_point:
        dtype = torch.promote_types(dtype, associations.dtype)
    queries = query.to(dtype).reshape(*batch, -1, dim)
    step = max(1, _WIDENED_ENTRIES // (dim * max(1, batch.numel())))
    if associations.dtype == dtype:
        step = max(1, rows)
    parts = [queries @ part.to(dtype).mT for part in associations.split(step, dim=-2)]
    scores = parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
    return scores.reshape(*query.shape[:-1], rows)
