"""Opponents of open-loop prediction: linear regression and nearest neighbours on the same inputs.

Inputs are the joint positions, their displacements over some times back, and the touch of every
patch, as the memory of a robot that time moves on gets them. Each opponent's settings are chosen
by the same held-out prediction inside the learned episodes.
"""

from collections.abc import Callable, Sequence
from itertools import product

import torch
from torch import Tensor

from hasm_torch.model.choose_timed import LEARNED, PASTS, QUERIES, splits
from hasm_torch.model.moments import Moments, Series, Trend, moments, thin

NEIGHBOURS = (5, 15, 30)
AT_ONCE = 256

Option = Callable[[Moments, Moments], Tensor]  # (known, asked) → displacements


def ridge(known: Moments, asked: Moments) -> Tensor:
    """Displacements (K, J) by the linear trend through the known moments."""
    return Trend.through(known)(asked)


def neighbours(known: Moments, asked: Moments, count: int, trend: bool) -> Tensor:
    """Mean displacement (K, J) of the nearest moments, inputs in shares of their spread.

    Args:
        known: Moments to look among.
        asked: Moments to predict.
        count: Neighbours.
        trend: Whether the linear trend is predicted and the neighbours add what it leaves.
    """
    x, y = Trend.inputs(known), Trend.inputs(asked)
    scale = x.std(0, correction=0).clamp(min=1e-12)
    near, far = (x / scale).float(), (y / scale).float()
    line = Trend.through(known)
    values = known.target - line(known) if trend else known.target
    blocks = far.split(AT_ONCE)
    rows = [torch.cdist(b, near).topk(min(count, len(near)), largest=False)[1] for b in blocks]
    found = torch.cat([values[r].mean(1) for r in rows])
    return found + line(asked) if trend else found


def tuned(learned: Sequence[Series], horizon: int) -> dict[str, tuple[tuple[int, ...], Option]]:
    """Each opponent with the settings that predict held-out ones of the learned episodes best.

    Args:
        learned: Episodes.
        horizon: Frames ahead.

    Returns:
        By name: frames back of its displacements, and (known, asked) → displacements.
    """

    def by_neighbours(count: int, trend: bool) -> Option:
        return lambda known, asked: neighbours(known, asked, count, trend)

    kinds: dict[str, list[Option]] = {
        "ridge": [ridge],
        "neighbours": [by_neighbours(n, t) for n, t in product(NEIGHBOURS, (False, True))],
    }
    parts = splits(learned)
    chosen = {}
    for name, options in kinds.items():
        errors = {
            (past, option): sum(_error(part, past, option, horizon) for part in parts)
            for past, option in product(PASTS, options)
        }
        chosen[name] = min(errors, key=errors.__getitem__)
    return chosen


def _error(
    part: tuple[list[Series], list[Series]],
    past: tuple[int, ...],
    option: Option,
    horizon: int,
) -> float:
    if not any(len(s.state) > horizon for s in part[1]):
        return 0.0
    known = thin(moments(part[0], past, horizon), LEARNED)
    asked = thin(moments(part[1], past, horizon), QUERIES)
    span = known.state.amax(0) - known.state.amin(0)
    weight = torch.where(span > 0, 1.0 / span.clamp(min=1e-12), 0.0)
    return float(((option(known, asked) - asked.target) * weight).square().sum())
