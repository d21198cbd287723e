"""Choosing the settings by predicting episodes that were left out, among the learned ones alone."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.prediction.neighbours import NeighbourRegression, NeighbourSettings
from hasm_torch.prediction.predictor import JointPredictor, Recalled
from hasm_torch.prediction.series import Moments, Series, moments, thin
from hasm_torch.prediction.settings import PredictionSettings

# What is tried.
CONTEXT_S = (0.0, 0.1, 0.3)  # 0 is one frame
CONTEXTS = (0.25, 1.0)
TOUCHES = (0.1, 0.3)
EMPHASES = (0.0, 3.0, 10.0)
PERPLEXITIES = (4.0, 8.0, 16.0, 32.0, 64.0)
SHIFTS = (0.0, 0.5, 1.0)
NEIGHBOUR_TOUCHES = (0.25, 1.0)
FIRST_EMPHASIS, FIRST_PERPLEXITY = 3.0, 12.0

# Recordings of fewer frames than this are split three ways, each part left out once; of longer
# ones a quarter is left out. So many frames a part are predicted.
FEW_FRAMES, SPLITS, LEFT_OUT, QUERIES = 3000, 3, 4, 600
# A code of more entries than this, for many patches, is not tried.
LARGEST_CODE = 16384

Split = tuple[Moments, Moments]  # learned, left out
Part = tuple[list[Series], list[Series]]  # learned, left out


def choose_settings(
    series: Sequence[Series], body: Body, horizon: int, generator: np.random.Generator
) -> PredictionSettings:
    """Settings of ``JointPredictor`` for some episodes.

    First the context, then the touch, each by the error over all joints; then emphasis,
    perplexity and momentum for each joint by its own error.

    Args:
        series: Episodes that are learned from; nothing else is looked at.
        body: Their robot.
        horizon: Frames ahead.
        generator: Draws which episodes are left out.

    Raises:
        ValueError: If there are too few episodes to leave any out.
    """
    parts = list(_parts(series, generator))
    best, lowest = PredictionSettings(), float("inf")
    for context_s, context in _contexts(body.rate):
        tried = replace(PredictionSettings(), context_s=context_s, context=context)
        error = _first_error(tried, parts, body, horizon)
        if error < lowest:
            best, lowest = tried, error
    for tried in list(_touches(best, series, body)):
        error = _first_error(tried, parts, body, horizon)
        if error < lowest:
            best, lowest = tried, error
    return _for_each_joint(best, parts, body, horizon)


def choose_neighbours(
    series: Sequence[Series], body: Body, horizon: int, generator: np.random.Generator
) -> NeighbourSettings:
    """Settings of ``NeighbourRegression``; arguments as in ``choose_settings``."""
    parts = list(_parts(series, generator))
    best, lowest = NeighbourSettings(), float("inf")
    contexts = [(context_s, context) for context_s, context in _contexts(body.rate)]
    for context_s, context in contexts:
        tried = NeighbourSettings(context_s, context)
        found, error = _fit_neighbours(tried, parts, body, horizon)
        if error < lowest:
            best, lowest = found, error
    for skin in ("patches", "cells") if body.channels else ():
        for touch in NEIGHBOUR_TOUCHES:
            found, error = _fit_neighbours(
                replace(best, touch=touch, skin=skin), parts, body, horizon
            )
            if error < lowest:
                best, lowest = found, error
    return best


def frames_back(context_s: float, rate: float) -> int:
    """Frames of a time, at least one."""
    return max(1, round(context_s * rate))


def _parts(series: Sequence[Series], generator: np.random.Generator) -> Iterator[Part]:
    """Episodes to learn and to leave out."""
    if len(series) < 2:
        raise ValueError(
            f"expected at least 2 episodes, to leave some out for choosing, got {len(series)}"
        )
    order = generator.permutation(len(series))
    few = sum(len(episode.state) for episode in series) < FEW_FRAMES
    folds = min(SPLITS if few else LEFT_OUT, len(series))
    for fold in range(folds if few else 1):
        out = set(order[fold::folds].tolist())
        yield (
            [episode for i, episode in enumerate(series) if i not in out],
            [episode for i, episode in enumerate(series) if i in out],
        )


def _splits(parts: list[Part], context_s: float, body: Body, horizon: int) -> Iterator[Split]:
    """Moments of the parts; one whose episodes are all shorter than the horizon is left aside."""
    lag = frames_back(context_s, body.rate)
    usable = [
        part for part in parts if all(any(len(e.state) > horizon for e in side) for side in part)
    ]
    if not usable:
        raise ValueError(
            f"too few episodes are longer than the horizon of {horizon} frames to learn from some "
            "and choose settings by others: choose a shorter horizon"
        )
    for learned, out in usable:
        yield moments(learned, lag, horizon), thin(moments(out, lag, horizon), QUERIES)


def _contexts(rate: float) -> list[tuple[float, float]]:
    back = sorted({frames_back(context_s, rate) / rate for context_s in CONTEXT_S})
    return [(back[0], 0.0), *((context_s, w) for context_s in back for w in CONTEXTS)]


def _touches(
    best: PredictionSettings, series: Sequence[Series], body: Body
) -> Iterator[PredictionSettings]:
    if not body.channels:
        return
    felt = int((torch.stack([episode.touch.amax(0) for episode in series]).amax(0) > 0).sum())
    channels = len(body.joints) * (2 if best.context > 0 else 1)
    code = channels * best.neurons * best.bits_for(channels)
    for touch in TOUCHES if felt else ():
        yield replace(best, touch=touch, patches="whole")
        if 1 < felt <= LARGEST_CODE // code:
            yield replace(best, touch=touch, patches="each")


def momentum_of(learned: Moments) -> Tensor:
    """Slope of the displacement to the successor over the recent displacement, (J,)."""
    power = learned.recent.square().sum(0)
    return torch.where(power > 0, (learned.recent * learned.target).sum(0) / power, 0.0)


def _first_error(
    settings: PredictionSettings, parts: list[Part], body: Body, horizon: int
) -> float:
    """Error over all joints at a usual emphasis and perplexity, the best corrections a joint."""
    errors = _Corrections(body)
    for learned, out in _splits(parts, settings.context_s, body, horizon):
        predictor = JointPredictor(settings, body, learned)
        emphasis = torch.full((len(predictor.moving),), FIRST_EMPHASIS)
        perplexity = torch.full((len(predictor.moving),), FIRST_PERPLEXITY)
        matches = predictor.match(out)
        weights = predictor.weights(matches, emphasis, perplexity)
        errors.add(learned, out, predictor.decide(out, matches, weights), predictor.moving)
    return errors.over_all()


def _for_each_joint(
    settings: PredictionSettings, parts: list[Part], body: Body, horizon: int
) -> PredictionSettings:
    options = [(e, p) for e in EMPHASES for p in PERPLEXITIES]
    errors = [_Corrections(body) for _ in options]
    for learned, out in _splits(parts, settings.context_s, body, horizon):
        predictor = JointPredictor(settings, body, learned)
        matches = predictor.match(out)
        for option, mine in zip(options, errors):
            emphasis, perplexity = (torch.full((len(predictor.moving),), v) for v in option)
            weights = predictor.weights(matches, emphasis, perplexity)
            mine.add(learned, out, predictor.decide(out, matches, weights), predictor.moving)
    best = torch.stack([mine.lowest() for mine in errors]).argmin(0).tolist()
    corrections = [errors[i].best() for i in best]
    return replace(
        settings,
        emphasis=[options[i][0] for i in best],
        perplexity=[options[i][1] for i in best],
        shift=[shift[j] for j, (shift, _) in enumerate(corrections)],
        momentum=[momentum[j] for j, (_, momentum) in enumerate(corrections)],
    )


def _fit_neighbours(
    settings: NeighbourSettings, parts: list[Part], body: Body, horizon: int
) -> tuple[NeighbourSettings, float]:
    """The best corrections for some inputs, joint by joint, and the error over all joints."""
    errors = _Corrections(body)
    everything = torch.arange(len(body.joints))
    for learned, out in _splits(parts, settings.context_s, body, horizon):
        errors.add(learned, out, NeighbourRegression(settings, learned).recall(out), everything)
    shift, momentum = errors.best()
    return replace(settings, shift=shift, momentum=momentum), errors.over_all()


class _Corrections:
    """Summed squared errors of every shift, without and with momentum, joint by joint."""

    def __init__(self, body: Body) -> None:
        self.span = torch.tensor(body.upper) - torch.tensor(body.lower)
        self.errors = torch.zeros(2 * len(SHIFTS), len(self.span), dtype=torch.float64)
        self.slopes: list[Tensor] = []

    def add(self, learned: Moments, out: Moments, recalled: Recalled, moving: Tensor) -> None:
        """Add the predictions of one part; the joints that do not move are predicted to stay."""
        slope = momentum_of(learned)
        self.slopes.append(slope)
        for i, (shift, share) in enumerate((s, m) for s in SHIFTS for m in (0.0, 1.0)):
            whole = torch.zeros_like(out.target)
            shifts = torch.full((len(moving),), shift)
            whole[:, moving] = recalled.predict(shifts, share * slope[moving])
            self.errors[i] += (whole - out.target).square().sum(0)

    def lowest(self) -> Tensor:
        """Error of each joint with its best correction."""
        return self.errors.amin(0)

    def over_all(self) -> float:
        """Error of all joints, each in shares of its range."""
        return float((self.lowest() / self.span**2).sum())

    def best(self) -> tuple[list[float], list[float]]:
        """Shift and momentum of each joint."""
        best = self.errors.argmin(0).tolist()
        slope = torch.stack(self.slopes).mean(0).tolist()
        shift = [SHIFTS[i // 2] for i in best]
        return shift, [s if i % 2 else 0.0 for i, s in zip(best, slope)]
