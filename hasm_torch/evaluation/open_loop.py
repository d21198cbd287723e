"""Open-loop prediction: where will the joints be, in episodes that were not learned?

Judged is the model that rolls out, fitted with a horizon of the frames ahead. One that touch moves
is stepped on from a frame with its skin as it is felt then, which takes longer, so that of each
episode ``STEPPED`` frames are predicted.

The error of a joint is the root mean square over all held-out frames of predicted less real
position, divided by that of standing still, which predicts the present position: 1 is no better
than that. Over all joints, squared errors are first divided by the square of the joint's range
in the dataset, so that degrees, radians and metres add up.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from hasm_torch.body import Body
from hasm_torch.config import write_json
from hasm_torch.data.body import body_of, describe_body
from hasm_torch.data.episodes import EpisodeSet, load_all
from hasm_torch.data.training import settings
from hasm_torch.episode import Episode
from hasm_torch.evaluation.opponents import tuned
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.model.collect import collect
from hasm_torch.model.hasm import HASM
from hasm_torch.model.moments import Series, moments

Array = np.ndarray

CONTESTANTS = ("hasm", "ridge", "neighbours")

# Joints and seconds that the plot shows.
PLOT_JOINTS, PLOT_SECONDS = 6, 20.0
# Frames of an episode that are predicted where touch moves the robot.
STEPPED = 60


@dataclass
class Predicted:
    """Held-out frames of one fold, K of them, as displacements from the present state.

    Attributes:
        by: (K, J) predicted by each contestant.
        real: (K, J) what came.
        state: (K, J) the present state.
        episode: (K,) index of the episode in the dataset.
        choices: What was chosen for the memory.
    """

    by: dict[str, Array]
    real: Array
    state: Array
    episode: Array
    choices: dict[str, str]


def open_loop(config: EvalConfig) -> dict[str, Any]:
    """Run the evaluation; write ``open_loop.json`` and a plot, print a table.

    Args:
        config: What to evaluate, of ``mode`` "open_loop".

    Returns:
        The content of ``open_loop.json``.

    Raises:
        FileNotFoundError: If the dataset or the URDF is missing.
        ValueError: If the dataset is damaged, or has too few or too short episodes.
    """
    if config.dataset.root is None:
        raise ValueError("open_loop needs a dataset: --dataset.root=FOLDER")
    if not config.horizon_s > 0:
        raise ValueError(f"horizon_s must be above 0 s, got {config.horizon_s}")
    begin = time.perf_counter()
    data = load_all(config.dataset.roots, config.features)
    whole = body_of(data, config.robot.urdf)
    for line in describe_body(data, whole, config.robot.urdf):
        print(line)
    horizons = {"one_step": 1, "horizon": max(1, round(config.horizon_s * data.fps))}
    parts = fold_episodes(len(data), config.folds, np.random.default_rng(config.seed))
    found: dict[str, list[Predicted]] = {name: [] for name in horizons}
    jobs = [(part, name) for part in parts for name in horizons]
    for part, name in tqdm(jobs, desc="open loop", unit="fold"):
        if all(len(data.episodes[i]) <= horizons[name] for i in part):
            continue  # no frame of these episodes has a successor to compare with
        found[name].append(predict_fold(data, part, horizons[name], config))
    if not all(found.values()):
        raise ValueError(
            f"no episode is longer than {config.horizon_s:g} s: choose a shorter horizon_s"
        )
    report = _report(data, whole, found, horizons, parts, config)
    report["seconds"] = time.perf_counter() - begin
    directory = config.output_dir or Path("outputs/open_loop") / f"{datetime.now():%Y%m%d-%H%M%S}"
    directory.mkdir(parents=True, exist_ok=True)
    write_json(directory / "open_loop.json", report)
    _plot(directory / "open_loop.png", data, found["horizon"], report)
    print(table(report))
    print(directory / "open_loop.png")
    print(directory / "open_loop.json")
    return report


def fold_episodes(count: int, folds: int, generator: np.random.Generator) -> list[list[int]]:
    """Split episodes at random into parts of nearly equal size.

    Raises:
        ValueError: If there are fewer than 2 folds, or fewer than 3 episodes or one a fold.
    """
    if not 2 <= folds <= count or count < 3:
        raise ValueError(
            f"folds must be at least 2 and at most the number of episodes, of which there must be "
            f"at least 3; got {folds} folds of {count} episodes"
        )
    order = generator.permutation(count)
    return [sorted(order[fold::folds].tolist()) for fold in range(folds)]


def predict_fold(
    data: EpisodeSet, held_out: Sequence[int], horizon: int, config: EvalConfig
) -> Predicted:
    """Predict some episodes from all others.

    Limits, thresholds, settings and memories come from the other episodes alone.

    Args:
        data: The dataset.
        held_out: Numbers of the episodes to predict.
        horizon: Frames ahead.
        config: Method, settings and URDF; the horizon of its model is not used.

    Raises:
        ValueError: If the episodes are too short for the horizon.
    """
    out = set(held_out)
    learned = [episode for i, episode in enumerate(data) if i not in out]
    unseen = [data.episodes[i] for i in held_out if len(data.episodes[i]) > horizon]
    body = body_of(replace(data, episodes=learned), config.robot.urdf)
    method = replace(settings(config.method, config.model), horizon=horizon)
    model = HASM(method, body)
    report = model.fit(learned)
    assert model.settled is not None
    most = 10**9 if model.settled.drive == "time" else STEPPED
    mine, frames = zip(*(model.predict(episode, horizon, most) for episode in unseen))
    by = {"hasm": np.concatenate(mine)}
    # The opponents get what a memory of a robot gets that time moves on, whatever moves this one.
    timed = replace(model.settled, drive="time")

    def series_of(episodes: Sequence[Episode]) -> list[Series]:
        lessons = (collect(method, body, timed, e, i) for i, e in enumerate(episodes))
        return [lesson.series for lesson in lessons if lesson.series is not None]

    series, asked = series_of(learned), series_of(unseen)
    starts = np.cumsum([0, *(len(e) - horizon for e in unseen)])[:-1]
    rows = torch.from_numpy(np.concatenate([s + f for s, f in zip(starts, frames)]))
    for name, (past, predict) in tuned(series, horizon).items():
        found = moments(asked, past, horizon).rows(rows)
        by[name] = predict(moments(series, past, horizon), found).numpy()
    episode = np.array([e.index for e in unseen])[found.episode.numpy()]
    return Predicted(by, found.target.numpy(), found.state.numpy(), episode, report.choices)


def relative_errors(
    predicted: Array, real: Array, span: Array
) -> tuple[float | None, list[float | None]]:
    """Errors relative to standing still.

    Args:
        predicted: (K, J) predicted displacements.
        real: (K, J) real ones.
        span: (J,) range of each joint; joints with none are left out over all.

    Returns:
        Over all joints, and of each joint; None where standing still makes no error.
    """
    error, still = ((x**2).mean(0) for x in (predicted - real, real))
    moves = span > 0
    shares = [(x[moves] / span[moves] ** 2).sum() for x in (error, still)]
    over_all = float(np.sqrt(shares[0] / shares[1])) if shares[1] > 0 else None
    each = [float(np.sqrt(e / s)) if s > 0 else None for e, s in zip(error, still)]
    return over_all, each


def _report(
    data: EpisodeSet,
    body: Body,
    found: dict[str, list[Predicted]],
    horizons: dict[str, int],
    parts: list[list[int]],
    config: EvalConfig,
) -> dict[str, Any]:
    states = np.concatenate([episode.state for episode in data]).astype(np.float64)
    span = states.max(0) - states.min(0)
    figures = {}
    for name, folds in found.items():
        real = np.concatenate([fold.real for fold in folds])
        errors = {
            who: relative_errors(np.concatenate([fold.by[who] for fold in folds]), real, span)
            for who in folds[0].by
        }
        figures[name] = {
            "frames_ahead": horizons[name],
            "seconds_ahead": horizons[name] / data.fps,
            "frames": len(real),
            **{who: over_all for who, (over_all, _) in errors.items()},
            "still": 1.0,
            "per_joint": {
                joint: {who: each[j] for who, (_, each) in errors.items()}
                for j, joint in enumerate(body.joints)
            },
            "choices": [fold.choices for fold in folds],
        }
    ahead = figures["horizon"]
    return {
        "horizon_s": ahead["seconds_ahead"],
        **{key: ahead[key] for key in (*CONTESTANTS, "still", "per_joint")},
        "error": "RMS over held-out frames, joints in shares of their range, over that of still",
        "one_step": figures["one_step"],
        "horizon": ahead,
        "method": config.method,
        "seed": config.seed,
        "folds": [[data.episodes[i].index for i in part] for part in parts],
        "dataset": config.dataset.root.name if config.dataset.root else "",
        "touch": bool(body.channels),
    }


def table(report: dict[str, Any]) -> str:
    """Errors over all joints and of each, as text."""

    def row(name: str, *values: float | None) -> str:
        return f"{name:<28}" + "".join(
            f"{'does not move':>15}" if v is None else f"{v:>15.3f}" for v in values
        )

    one, ahead = report["one_step"], report["horizon"]
    names = "".join(f"{who:>15}" for who in CONTESTANTS)
    later = f"{report['horizon_s']:.3g} s ahead"
    wide = 15 * len(CONTESTANTS)
    lines = [
        "error relative to standing still (1 = predicting the present state)",
        f"{'':<28}{'one frame ahead':>{wide}}{later:>{wide}}",
        f"{'':<28}{names}{names}",
        row("all joints", *(part[who] for part in (one, ahead) for who in CONTESTANTS)),
    ]
    for joint in one["per_joint"]:
        errors = [part["per_joint"][joint][who] for part in (one, ahead) for who in CONTESTANTS]
        lines.append(row(joint, *errors))
    return "\n".join(lines)


def _plot(path: Path, data: EpisodeSet, folds: list[Predicted], report: dict[str, Any]) -> None:
    """Joints that move most, through the first held-out episodes of the first fold."""
    from hasm_torch.evaluation.plots import plot_prediction

    fold = folds[0]
    count = min(len(fold.real), max(2, round(PLOT_SECONDS * data.fps)))
    span = np.ptp(fold.state, axis=0)
    share = np.divide((fold.real**2).mean(0), span**2, out=np.zeros_like(span), where=span > 0)
    joints = np.sort(np.argsort(-share)[:PLOT_JOINTS])
    seconds = np.arange(count) / data.fps
    seconds[np.flatnonzero(np.diff(fold.episode[:count]))] = np.nan

    def positions(displacement: Array) -> Array:
        return (fold.state + displacement)[:count, joints]

    plot_prediction(
        path,
        seconds,
        positions(fold.real),
        {"memory": positions(fold.by["hasm"]), "neighbours": positions(fold.by["neighbours"])},
        [(data.joints[j], data.units[j]) for j in joints.tolist()],
        f"Joint positions {report['horizon_s']:.3g} s ahead, predicted in held-out episodes",
    )
