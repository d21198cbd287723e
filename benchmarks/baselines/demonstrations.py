"""Episodes as samples, what a sample predicts, and which prediction holds on unseen episodes.

Joints are shares of their ranges and patch forces shares of the largest one in the episodes, so
that distances mean the same for all of them.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.data.episodes import Episode
from hasm_torch.model.control import SPEED_SHARE

# Predictions are judged over so many samples of a held-out episode, from every STRIDE-th sample.
WINDOW, STRIDE = 25, 50
FOLDS = 3


class Series(NamedTuple):
    """One episode.

    Attributes:
        task: What is done.
        state: (T, joints) measured positions, shares of the joint ranges.
        action: (T, joints) commanded positions, the same.
        touch: (T, patches) force on each patch, N.
    """

    task: str
    state: Tensor
    action: Tensor
    touch: Tensor


@dataclass(frozen=True)
class Ahead:
    """What is predicted of the action.

    Attributes:
        horizon: How many samples ahead.
        mode: "displacement" predicts how far the action goes, which the policy adds to its
            target; "target" predicts where it goes, and the policy heads there.
    """

    horizon: int
    mode: Literal["displacement", "target"]


class Predictor(Protocol):
    """Predicts from samples; fitted when it is made."""

    def predict(self, state: Tensor, touch: Tensor) -> Tensor:
        """Value (B, joints) at states (B, joints) and touches (B, patches)."""

    def memory_bytes(self) -> int:
        """Bytes that it keeps."""


Build = Callable[[Tensor, Tensor, Tensor], Predictor]


@dataclass(frozen=True)
class Candidate:
    """One way to predict.

    Attributes:
        name: Its settings in words.
        ahead: What it predicts.
        build: Makes the predictor from states, touches and values.
    """

    name: str
    ahead: Ahead
    build: Build


def patch_forces(skin: Tensor, body: Body) -> Tensor:
    """Force on each patch, (..., patches) N, from the skin's points (..., cells, 3)."""
    return torch.stack([part.sum((-1, -2)) for part in skin.split(body.cells, dim=-2)], dim=-1)


def series_of(episode: Episode, body: Body) -> Series:
    """An episode in shares of the joint ranges, and force by patch."""
    lower, upper = torch.tensor(body.lower), torch.tensor(body.upper)
    assert episode.tactile is not None
    return Series(
        episode.task,
        (torch.from_numpy(episode.state) - lower) / (upper - lower),
        (torch.from_numpy(episode.action) - lower) / (upper - lower),
        patch_forces(torch.from_numpy(episode.tactile), body),
    )


def values_of(series: Series, ahead: Ahead) -> Tensor:
    """What each sample predicts, (T, joints); an episode's last action stays.

    displacement: (a(t+h) − a(t)) / h, one sample's part;  target: a(t+h).
    """
    last = len(series.action) - 1
    later = series.action[(torch.arange(last + 1) + ahead.horizon).clamp(max=last)]
    if ahead.mode == "target":
        return later
    return (later - series.action) / ahead.horizon


def moved(reference: Tensor, value: Tensor, ahead: Ahead, largest: Tensor) -> Tensor:
    """The reference one sample later, within the limits.

    Args:
        reference: (B, joints) joint targets, shares.
        value: (B, joints) predicted.
        ahead: What the value is.
        largest: (joints,) largest way of a sample, shares.
    """
    way = value if ahead.mode == "displacement" else (value - reference) / ahead.horizon
    excess = (way.abs() / largest).amax(-1, keepdim=True).clamp(min=1.0)
    return (reference + way / excess).clamp(0.0, 1.0)


def largest_way(body: Body) -> Tensor:
    """Largest way of a joint in a sample period, (joints,) shares of its range."""
    span = torch.tensor(body.upper) - torch.tensor(body.lower)
    return torch.tensor(body.max_speed) * SPEED_SHARE / body.rate / span


def build(candidate: Candidate, episodes: Sequence[Series]) -> Predictor:
    """Fit a candidate to episodes."""
    values = torch.cat([values_of(series, candidate.ahead) for series in episodes])
    states = torch.cat([series.state for series in episodes])
    return candidate.build(states, torch.cat([series.touch for series in episodes]), values)


def folds(episodes: Sequence[Series]) -> Iterator[tuple[list[Series], list[Series]]]:
    """Split into learned and held-out episodes, so that each task stays among the learned ones.

    Yields:
        Nothing if a task has a single episode.
    """
    number: dict[str, int] = {}
    of: list[int] = []
    for series in episodes:
        of.append(number.get(series.task, 0))
        number[series.task] = of[-1] + 1
    count = min(FOLDS, *number.values())
    for fold in range(count if count > 1 else 0):
        held = [series for series, i in zip(episodes, of) if i % count == fold]
        yield [series for series, i in zip(episodes, of) if i % count != fold], held


def error(predictor: Predictor, ahead: Ahead, held: Sequence[Series], largest: Tensor) -> float:
    """Mean distance from held-out episodes when the predictions are followed, shares of the range.

    The robot is taken to be where it is sent, and is touched as in the episode.
    """
    starts = [(s, t) for s in held for t in range(0, len(s.state) - WINDOW, STRIDE)]
    reference = torch.stack([series.action[t] for series, t in starts])
    total = 0.0
    for step in range(WINDOW):
        touch = torch.stack([series.touch[t + step] for series, t in starts])
        value = predictor.predict(reference, touch)
        reference = moved(reference, value, ahead, largest)
        wanted = torch.stack([series.action[t + step + 1] for series, t in starts])
        total += float((reference - wanted).abs().mean())
    return total / WINDOW


def cross_validate(
    candidates: Sequence[Candidate], episodes: Sequence[Series], body: Body
) -> tuple[Candidate, dict[str, float]]:
    """The candidate that follows held-out episodes best.

    Args:
        candidates: To choose from; the first where no episode can be held out.
        episodes: All that may be learned.
        body: The robot.

    Returns:
        The choice, and every candidate's error by name.
    """
    largest = largest_way(body)
    splits = list(folds(episodes))
    if not splits:
        return candidates[0], {}
    errors = {
        candidate.name: float(
            np.mean([error(build(candidate, learned), candidate.ahead, held, largest)
                     for learned, held in splits])
        )
        for candidate in candidates
    }  # fmt: skip
    best = min(candidates, key=lambda candidate: _finite(errors[candidate.name]))
    return best, errors


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.inf
