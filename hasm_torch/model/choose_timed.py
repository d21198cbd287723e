"""Choosing the settings of a robot that time moves on, by predicting episodes that are held out.

In this order, each with and without the trend as a covariate: how far back the displacements reach
that are coded; which joints are coded; how far a touch changes the code; β.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.model.choose import ARGMAX_BETA
from hasm_torch.model.moments import Moments, Series, moments, thin
from hasm_torch.model.settled import Settled
from hasm_torch.model.timed import Timed

# What is tried: frames back; share of the movement that the coded joints make; share of the
# neurons that the strongest touch of a patch flips; βD.
PASTS = ((1,), (1, 2, 4, 8), (1, 2, 3, 4, 8, 16))
COVERS = (1.0, 0.97, 0.9, 0.8)
FLIPS, USUAL_FLIP = (0.25, 0.0, 0.125, 0.5), 0.125
SOFTNESSES = (30.0, 15.0, 20.0, 40.0, 60.0)
# Recordings of fewer frames than this are split three ways, each part left out once; of longer
# ones a quarter is left out. So many frames a part are predicted, so many learned.
FEW_FRAMES, SPLITS, LEFT_OUT, QUERIES, LEARNED = 3000, 3, 4, 400, 12000
SPLIT_SEED = 0
EVEN = 1.02  # by this factor another share than the usual one must be better


def choose_timed(
    config: HASMConfig, body: Body, settled: Settled, series: Sequence[Series]
) -> tuple[Settled, dict[str, dict[str, float]]]:
    """Settle what the settings leave open; see the module.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What is settled already.
        series: The episodes.

    Returns:
        What was settled, and the error of everything tried, by the step, relative to standing
        still.
    """
    felt = any(bool((s.touch > 0).any()) for s in series)
    settled = replace(
        settled,
        past=list(PASTS[0]),
        joints=_covering(series, config.horizon, COVERS[0]),
        flip=FLIPS[0] if felt else 0.0,
        trend=True,
    )
    parts = splits(series)
    errors: dict[str, dict[str, float]] = {}
    if not parts:
        return _at_softness(config, body, settled, SOFTNESSES[0]), errors
    covers = [_covering(series, config.horizon, cover) for cover in COVERS]
    steps: list[tuple[str, str, list]] = [
        ("frames back", "past", [list(past) for past in PASTS]),
        ("coded joints", "joints", covers),
    ]
    if config.joints is not None:
        steps[1] = ("coded joints", "joints", [[body.joints.index(n) for n in config.joints]])
    if felt:
        steps.append(("touch", "flip", list(FLIPS)))
    known: dict[str, float] = {}
    for name, field, values in steps:
        options = [replace(settled, **{field: v}, trend=t) for v in values for t in (True, False)]
        found = {_key(o): _error(config, body, o, parts, SOFTNESSES[:1], known) for o in options}

        def judged(
            option: Settled, found: dict[str, list[float]] = found, field: str = field
        ) -> float:
            usual = field != "flip" or option.flip == USUAL_FLIP
            return found[_key(option)][0] * (1.0 if usual else EVEN)

        settled = min(options, key=judged)
        labels = [f"{_label(getattr(o, field))}, trend {o.trend}" for o in options]
        errors[name] = {label: found[_key(o)][0] for label, o in zip(labels, options)}
    softnesses: Sequence[float] = SOFTNESSES
    if config.beta is not None:
        softnesses = [min(config.beta, ARGMAX_BETA) * Timed(config, body, settled).code_dim]
    found_beta = _error(config, body, settled, parts, softnesses, {})
    errors["βD"] = {f"{s:g}": e for s, e in zip(softnesses, found_beta)}
    best = softnesses[int(np.argmin(found_beta))]
    return _at_softness(config, body, settled, best), errors


def _at_softness(config: HASMConfig, body: Body, settled: Settled, softness: float) -> Settled:
    return replace(settled, beta=softness / Timed(config, body, settled).code_dim)


def _key(settled: Settled) -> str:
    return repr((settled.past, settled.joints, settled.flip, settled.trend))


def _label(value: object) -> str:
    return f"{len(value)} joints" if isinstance(value, list) and len(value) > 6 else str(value)


def _covering(series: Sequence[Series], horizon: int, cover: float) -> list[int]:
    """The joints that make a share of the movement, and move at all."""
    found = moments(series, (1,), horizon)
    move = found.target.square().mean(0)
    order = move.argsort(descending=True)
    share = move[order].cumsum(0) / move.sum().clamp(min=1e-12)
    joints = order[: int((share < cover).sum()) + 1].sort().values
    moving = joints[found.state[:, joints].std(0, correction=0) > 0]
    if not len(moving):
        raise ValueError("no joint moves in the episodes, so there is nothing to learn")
    return [int(j) for j in moving]


def splits(series: Sequence[Series]) -> list[tuple[list[Series], list[Series]]]:
    """Episodes to learn and to leave out; none where there is one episode only."""
    if len(series) < 2:
        return []
    order = np.random.default_rng(SPLIT_SEED).permutation(len(series))
    few = sum(len(s.state) for s in series) < FEW_FRAMES
    folds = min(SPLITS if few else LEFT_OUT, len(series))
    found = []
    for fold in range(folds if few else 1):
        out = set(order[fold::folds].tolist())
        learned = [s for i, s in enumerate(series) if i not in out]
        found.append((learned, [series[i] for i in sorted(out)]))
    return found


def _error(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    parts: list[tuple[list[Series], list[Series]]],
    softnesses: Sequence[float],
    known: dict[str, float],
) -> list[float]:
    """Error at each softness, joints in shares of how much they vary, over standing still."""
    if _key(settled) in known:
        return [known[_key(settled)]]
    wrong, still = torch.zeros(len(softnesses), dtype=torch.float64), 0.0
    for learned, out in parts:
        if not any(len(s.state) > config.horizon for s in out):
            continue
        rows = thin(moments(learned, settled.past, config.horizon), LEARNED)
        asked = thin(moments(out, settled.past, config.horizon), QUERIES)
        memory = stored(config, body, settled, rows)
        matches = memory.match(asked)
        span = rows.state.amax(0) - rows.state.amin(0)
        weight = torch.where(span > 0, 1.0 / span.clamp(min=1e-12), 0.0)
        for i, softness in enumerate(softnesses):
            beta = softness / memory.code_dim
            apart = memory.read(asked, matches, beta, settled.trend) - asked.target
            wrong[i] += (apart * weight).square().sum()
        still += float((asked.target * weight).square().sum())
    result = (wrong / max(still, 1e-12)).sqrt().tolist()
    if len(softnesses) == 1:
        known[_key(settled)] = result[0]
    return result


def stored(config: HASMConfig, body: Body, settled: Settled, rows: Moments) -> Timed:
    """A memory of some moments."""
    memory = Timed(config, body, replace(settled, capacity=len(rows.state)))
    memory.store(rows)
    return memory
