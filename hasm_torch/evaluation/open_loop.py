"""Open-loop prediction: where will the joints be, in episodes that were not learned?

The error of a joint is the root mean square over all held-out frames of predicted less real
position, divided by that of standing still, which predicts the present position: 1 is no better
than that. Over all joints, squared errors are first divided by the square of the joint's range
in the dataset, so that degrees, radians and metres add up.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from hasm_torch.apps.training import DatasetConfig, FeaturesConfig, RobotConfig
from hasm_torch.body import Body
from hasm_torch.config import write_json
from hasm_torch.data.body import body_of, describe_body
from hasm_torch.data.episodes import Episode, EpisodeSet, FeatureMap, load_episodes
from hasm_torch.prediction.neighbours import NEIGHBOURS, NeighbourRegression, NeighbourSettings
from hasm_torch.prediction.predictor import JointPredictor
from hasm_torch.prediction.selection import choose_neighbours, choose_settings, frames_back
from hasm_torch.prediction.series import Series, TouchRates, moments
from hasm_torch.prediction.settings import PredictionSettings

if TYPE_CHECKING:
    from hasm_torch.evaluation.evaluate import EvalConfig

Array = np.ndarray

# Joints and seconds that the plot shows.
PLOT_JOINTS, PLOT_SECONDS = 6, 20.0


@dataclass
class OpenLoopConfig:
    """Options of ``eval.py --mode=open_loop``.

    Attributes:
        dataset: Which dataset.
        features: Which of its features are read.
        robot: Which robot recorded it.
        method: "default" chooses the settings within the learned episodes; "literal" is the
            paper as written.
        folds: Parts into which the episodes are split; each is predicted by the others.
        horizon_s: How far ahead, s, beside one frame ahead.
        seed: Seed of the split.
        output_dir: Where results go; by default ``outputs/open_loop/<time>``.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    method: Literal["default", "literal"] = "default"
    folds: int = 5
    horizon_s: float = 0.5
    seed: int = 0
    output_dir: Path | None = None

    @classmethod
    def of(cls, options: "EvalConfig") -> "OpenLoopConfig":
        """The options of ``eval.py`` that open-loop prediction takes."""
        return cls(**{f.name: getattr(options, f.name) for f in fields(cls)})


@dataclass
class Predicted:
    """Held-out frames of one fold, K of them, as displacements from the present state.

    Attributes:
        hasm: (K, J) predicted by the memory.
        knn: (K, J) predicted by the nearest neighbours.
        real: (K, J) what came.
        state: (K, J) the present state.
        episode: (K,) index of the episode in the dataset.
        frame: (K,) frame of the episode.
        settings: What was chosen for the memory and for the neighbours.
    """

    hasm: Tensor
    knn: Tensor
    real: Tensor
    state: Tensor
    episode: Tensor
    frame: Tensor
    settings: dict[str, Any]


def open_loop(config: OpenLoopConfig) -> dict[str, Any]:
    """Run the evaluation; write ``open_loop.json`` and a plot, print a table.

    Args:
        config: What to evaluate.

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
    data = load_episodes(config.dataset.root, FeatureMap(**asdict(config.features)))
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
    data: EpisodeSet, held_out: Sequence[int], horizon: int, config: OpenLoopConfig
) -> Predicted:
    """Predict some episodes from all others.

    Limits, thresholds, settings and memories come from the other episodes alone.

    Args:
        data: The dataset.
        held_out: Numbers of the episodes to predict.
        horizon: Frames ahead.
        config: Method, URDF and seed.

    Raises:
        ValueError: If the episodes are too short for the horizon.
    """
    out = set(held_out)
    learned = [episode for i, episode in enumerate(data) if i not in out]
    unseen = [data.episodes[i] for i in held_out]
    body = body_of(replace(data, episodes=learned), config.robot.urdf)
    rates = TouchRates(body, learned)
    known = [rates(episode) for episode in learned]
    asked = [rates(episode) for episode in unseen]
    if config.method == "literal":
        settings = PredictionSettings.literal(len(body.joints))
    else:
        settings = choose_settings(known, body, horizon, np.random.default_rng(config.seed))
    rivals = choose_neighbours(known, body, horizon, np.random.default_rng(config.seed))
    return _predict(known, asked, unseen, body, horizon, settings, rivals)


def _predict(
    known: list[Series],
    asked: list[Series],
    unseen: list[Episode],
    body: Body,
    horizon: int,
    settings: PredictionSettings,
    rivals: NeighbourSettings,
) -> Predicted:
    lag = frames_back(settings.context_s, body.rate)
    mine = moments(asked, lag, horizon)
    hasm = JointPredictor(settings, body, moments(known, lag, horizon))(mine)
    lag = frames_back(rivals.context_s, body.rate)
    knn = NeighbourRegression(rivals, moments(known, lag, horizon))(moments(asked, lag, horizon))
    index = torch.tensor([episode.index for episode in unseen])
    chosen = {"hasm": asdict(settings), "knn": asdict(rivals)}
    return Predicted(hasm, knn, mine.target, mine.state, index[mine.episode], mine.frame, chosen)


def relative_errors(
    predicted: Tensor, real: Tensor, span: Tensor
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
    over_all = float((shares[0] / shares[1]).sqrt()) if float(shares[1]) > 0 else None
    each = [float((e / s).sqrt()) if float(s) > 0 else None for e, s in zip(error, still)]
    return over_all, each


def _report(
    data: EpisodeSet,
    body: Body,
    found: dict[str, list[Predicted]],
    horizons: dict[str, int],
    parts: list[list[int]],
    config: OpenLoopConfig,
) -> dict[str, Any]:
    states = torch.from_numpy(np.concatenate([episode.state for episode in data])).double()
    span = states.amax(0) - states.amin(0)
    figures = {}
    for name, folds in found.items():
        real = torch.cat([fold.real for fold in folds])
        hasm, knn = (torch.cat([getattr(fold, who) for fold in folds]) for who in ("hasm", "knn"))
        (mine, my_joints), (theirs, their_joints) = (
            relative_errors(predicted, real, span) for predicted in (hasm, knn)
        )
        figures[name] = {
            "frames_ahead": horizons[name],
            "seconds_ahead": horizons[name] / data.fps,
            "frames": len(real),
            "hasm": mine,
            "knn": theirs,
            "still": 1.0,
            "per_joint": {
                joint: {"hasm": a, "knn": b}
                for joint, a, b in zip(body.joints, my_joints, their_joints)
            },
            "settings": [fold.settings for fold in folds],
        }
    ahead = figures["horizon"]
    return {
        "horizon_s": ahead["seconds_ahead"],
        **{key: ahead[key] for key in ("hasm", "knn", "still", "per_joint")},
        "error": "RMS over held-out frames, joints in shares of their range, over that of still",
        "knn_is": f"mean of {NEIGHBOURS} neighbours, inputs and outputs chosen like those of hasm",
        "one_step": figures["one_step"],
        "horizon": ahead,
        "method": config.method,
        "seed": config.seed,
        "folds": [[data.episodes[i].index for i in part] for part in parts],
        "dataset": str(config.dataset.root),
        "touch": bool(body.channels),
    }


def table(report: dict[str, Any]) -> str:
    """Errors over all joints and of each, as text."""

    def row(name: str, *values: float | None) -> str:
        return f"{name:<28}" + "".join(
            f"{'does not move':>15}" if v is None else f"{v:>15.3f}" for v in values
        )

    one, ahead = report["one_step"], report["horizon"]
    lines = [
        "error relative to standing still (1 = predicting the present state)",
        f"{'':<28}{'one step':>15}{'':>15}{f'{report["horizon_s"]:.3g} s ahead':>15}",
        f"{'':<28}{'hasm':>15}{'5-NN':>15}{'hasm':>15}{'5-NN':>15}",
        row("all joints", one["hasm"], one["knn"], ahead["hasm"], ahead["knn"]),
    ]
    for joint, errors in one["per_joint"].items():
        later = ahead["per_joint"][joint]
        lines.append(row(joint, errors["hasm"], errors["knn"], later["hasm"], later["knn"]))
    return "\n".join(lines)


def _plot(path: Path, data: EpisodeSet, folds: list[Predicted], report: dict[str, Any]) -> None:
    """Joints that move most, through the first held-out episodes of the first fold."""
    from hasm_torch.evaluation.plots import plot_prediction

    fold = folds[0]
    count = min(len(fold.real), max(2, round(PLOT_SECONDS * data.fps)))
    share = fold.real.square().mean(0) / (fold.state.amax(0) - fold.state.amin(0)) ** 2
    joints = share.nan_to_num(0.0).argsort(descending=True)[:PLOT_JOINTS].sort().values
    seconds = np.arange(count) / data.fps
    seconds[np.flatnonzero(np.diff(fold.episode[:count].numpy()))] = np.nan

    def positions(displacement: Tensor) -> Array:
        return (fold.state + displacement)[:count, joints].numpy()

    plot_prediction(
        path,
        seconds,
        positions(fold.real),
        {"memory": positions(fold.hasm), "5 nearest neighbours": positions(fold.knn)},
        [(data.joints[j], data.units[j]) for j in joints.tolist()],
        f"Joint positions {report['horizon_s']:.3g} s ahead, predicted in held-out episodes",
    )
