"""The whole evaluation: train or load, roll out, measure, draw."""

import statistics
import sys
import time
from collections.abc import Callable
from contextlib import closing
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from hasm_torch.body import Body
from hasm_torch.config import write_json
from hasm_torch.data.training import settings, warm_up
from hasm_torch.encoders.readings import pressed
from hasm_torch.evaluation import suite, teaching
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.evaluation.report import table
from hasm_torch.evaluation.runner import Rolled, Runner
from hasm_torch.evaluation.traces import write_traces
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS, Skin

TIMED_STEPS = 1000
TIMED_FORCE = 8.0  # N


def evaluate(config: EvalConfig) -> dict[str, Any]:
    """Run the evaluation and write ``metrics.json``, figures and videos.

    Args:
        config: What to evaluate; ``teach_seed`` must have been seen to.

    Returns:
        The content of ``metrics.json``.

    Raises:
        FileNotFoundError: If a dataset or checkpoint is missing.
        ValueError: If a dataset or checkpoint is damaged, or does not fit the simulated robot.
    """
    directory = config.output_dir or Path("outputs/eval") / f"{datetime.now():%Y%m%d-%H%M%S}"
    models, seconds = _models(config)
    for model in models.values():
        _check_robot(model.body)
    directory.mkdir(parents=True, exist_ok=True)
    tick = time_steps(models.get("yield") or next(iter(models.values())))
    for experiment, model in models.items():
        model.save_pretrained(directory / "checkpoints" / experiment)
    groups = suite.plan(config)
    rolled = _roll_out(config, groups, directory / "checkpoints")
    figures = {name: [found for _, found in rollouts] for name, rollouts in rolled.items()}
    distinct = {id(model): model for model in models.values()}
    metrics = suite.summarise(config, groups, figures) | {
        "train_seconds": seconds,
        "memory_bytes": sum(model.memory_bytes() for model in distinct.values()),
        "tick_ms": tick,
    }
    write_json(directory / "metrics.json", metrics)
    print(table(metrics))
    paths = _pictures(config, models, metrics, directory)
    if config.traces:
        paths.append(directory / "traces.npz")
        write_traces(paths[-1], {name: [trace for trace, _ in r] for name, r in rolled.items()})
    for path in (*paths, directory / "metrics.json"):
        print(path)
    return metrics


def _models(config: EvalConfig) -> tuple[dict[str, HASM], float | None]:
    """The model of each experiment, and the seconds it took to train them (None if loaded)."""
    if config.checkpoint is not None:
        model = HASM.from_pretrained(config.checkpoint)
        return dict.fromkeys(config.experiments, model), None
    warm_up()
    models, seconds = {}, 0.0
    for experiment in tqdm(config.experiments, desc="training", unit="model"):
        choice = teaching.wrist_and_torso(config.episodes) if experiment == "yield" else None
        begin = time.perf_counter()
        models[experiment] = _learn(config, experiment, choice)
        seconds += time.perf_counter() - begin
    return models, seconds


def _learn(config: EvalConfig, experiment: str, choice: teaching.Choice | None) -> HASM:
    root = config.datasets / f"hsr_{experiment}"
    return teaching.learn(root, settings(config.method, config.model), choice)


def _check_robot(body: Body) -> None:
    skin = Skin.load()
    cells = [skin.slices[patch].stop - skin.slices[patch].start for patch in skin.patches]
    for what, mine, robots in (
        ("joints", body.joints, list(JOINTS)),
        ("patches", body.patches, list(skin.patches)),
        ("cells", body.cells, cells),
    ):
        if mine != robots:
            raise ValueError(f"the simulated robot has the {what} {robots}, the model's are {mine}")


def _roll_out(
    config: EvalConfig, groups: list[suite.Group], checkpoints: Path
) -> dict[str, list[Rolled]]:
    """Roll everything out; models that learn other demonstrations are not kept."""
    with closing(Runner()) as runner, TemporaryDirectory() as scratch:
        started, learned = {}, dict[teaching.Choice, Path]()
        for group in groups:
            checkpoint: Path | None = checkpoints / group.experiment
            if group.taught:
                checkpoint = None
            elif group.learns is not None:
                if group.learns not in learned:
                    learned[group.learns] = Path(scratch) / str(len(learned))
                    model = _learn(config, group.experiment, group.learns)
                    model.save_pretrained(learned[group.learns])
                checkpoint = learned[group.learns]
            started[group.name] = runner.start(group.experiment, group.cases, checkpoint)
        return {name: [future.result() for future in futures] for name, futures in started.items()}


def time_steps(model: HASM, steps: int = TIMED_STEPS) -> dict[str, float]:
    """Time of one control step under a touch, encoders and recall, on one CPU thread.

    Args:
        model: The model; the first patch that it was taught is touched throughout.
        steps: Steps to time.

    Returns:
        Median and 99th percentile of the steps in which the touch is answered, ms.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    skin = pressed(model.body, model.patches[0], TIMED_FORCE)
    state = begin = torch.zeros(len(model.body.joints))
    for j in model.body.limited:
        begin[j] = (model.body.lower[j] + model.body.upper[j]) / 2
    seen = torch.zeros(sum(model.body.observations.values()))
    spent = []
    for i in range(steps + 50):
        if i % 250 == 0:
            model.reset()  # the motion ends after some seconds: begin it again
            state = begin
        start = time.perf_counter()
        state = model.step(state, skin, observation=seen)
        passed = 1e3 * (time.perf_counter() - start)
        if i >= 50 and model.touched:
            spent.append(passed)
    model.reset()
    torch.set_num_threads(threads)
    return {"median": statistics.median(spent), "p99": float(np.percentile(spent, 99))}


def _pictures(
    config: EvalConfig, models: dict[str, HASM], metrics: dict[str, Any], directory: Path
) -> list[Path]:
    from hasm_torch.evaluation import films, showcase

    draw: dict[str, Callable[..., list[Path]]] = {
        "compliance": showcase.draw_compliance,
        "yield": showcase.draw_yield,
        "grasp": showcase.draw_grasp,
    }
    paths = []
    for experiment, model in models.items():
        paths += draw[experiment](config, model, metrics[experiment], directory)
        if config.rerun:
            paths.append(showcase.record(experiment, model, config.seed, directory))
    if config.render:
        for experiment, model in tqdm(models.items(), desc="videos", unit="video"):
            try:
                paths.append(films.film(experiment, model, config.seed, directory))
            except RuntimeError as error:
                print(f"no video of {experiment}: {error}", file=sys.stderr)
    return paths
