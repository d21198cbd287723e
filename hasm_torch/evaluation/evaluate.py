"""The whole evaluation: train or load, roll out, measure, draw."""

import statistics
import sys
import time
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tqdm import tqdm

from hasm_torch.apps.training import DatasetConfig, FeaturesConfig, RobotConfig, settings, train
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig, write_json
from hasm_torch.encoders.readings import pressed
from hasm_torch.evaluation import compliance, grasp
from hasm_torch.evaluation.report import table
from hasm_torch.evaluation.runner import EXPERIMENTS, check_experiments, run_cases
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.env import LARGEST_FORCE

ROLLOUTS = {"compliance": 40, "grasp": 100}
TIMED_STEPS = 2000
TIMED_FORCE = 8.0  # N


@dataclass
class EvalConfig:
    """Options of ``eval.py``.

    Attributes:
        mode: "rollout" in simulation, or "open_loop" prediction of a dataset's held-out episodes,
            which takes ``dataset``, ``features``, ``robot``, ``folds``, ``horizon_s``, ``method``,
            ``seed`` and ``output_dir`` and nothing else.
        dataset: Dataset of open-loop prediction.
        features: Which of its features are read.
        robot: Which robot recorded it.
        folds: Parts into which its episodes are split; each is predicted by the others.
        horizon_s: How far ahead it is predicted, s, beside one frame ahead.
        checkpoint: Directory written by ``train.py``, rolled out in every experiment named;
            without it a model a experiment is trained on the bundled episodes.
        experiments: "compliance", "grasp" or both.
        datasets: Folder of the bundled datasets.
        method: "default", with the settings under ``model``, or "literal", the paper as written.
        model: Settings of the method, where a model is trained.
        rollouts: Rollouts a compliance behaviour, and grasps; by default 40 and 100.
        seed: Seed of everything that is drawn.
        forces: Forces of the touches, N, 0.5 to 15, taken in turn; by default drawn from 2 to
            14 N (compliance) and 3 to 12 N (grasp).
        start_noise: Noise of a grasp's start state, rad; the arm lift gets a fifth of it in m.
        object_noise: The object stands up to this far from its place along x and y, m.
        pauses: Random pauses in a grasp.
        render: Whether to make videos.
        rerun: Whether to write a recording of a rollout for the Rerun viewer.
        output_dir: Where results go; by default ``outputs/eval/<time>``, or
            ``outputs/open_loop/<time>``.
    """

    mode: Literal["rollout", "open_loop"] = "rollout"
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    folds: int = 5
    horizon_s: float = 0.5
    checkpoint: Path | None = None
    experiments: list[str] = field(default_factory=lambda: list(EXPERIMENTS))
    datasets: Path = Path("datasets")
    method: Literal["default", "literal"] = "default"
    model: HASMConfig = field(default_factory=HASMConfig)
    rollouts: int | None = None
    seed: int = 0
    forces: list[float] = field(default_factory=list)
    start_noise: float = 0.05
    object_noise: float = 0.01
    pauses: int = 3
    render: bool = True
    rerun: bool = False
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        if self.mode not in ("rollout", "open_loop"):
            raise ValueError(f"unknown mode {self.mode!r}, valid: rollout, open_loop")
        if self.mode == "rollout" and self.dataset.root is not None:
            raise ValueError(
                "a rollout takes --checkpoint, not --dataset.root: train with train.py first, or "
                "give --mode=open_loop"
            )
        check_experiments(self.experiments)
        if not self.experiments:
            raise ValueError(f"experiments is empty, valid: {', '.join(EXPERIMENTS)}")
        if self.rollouts is not None and self.rollouts < 1:
            raise ValueError(f"rollouts must be at least 1, got {self.rollouts}")
        for force in self.forces:
            if not 0.5 <= force <= LARGEST_FORCE:
                raise ValueError(f"forces must be 0.5 to {LARGEST_FORCE:g} N, got {force}")
        for name in ("start_noise", "object_noise", "pauses"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(
                    f"{name} must be finite and not negative, got {getattr(self, name)}"
                )


def evaluate(config: EvalConfig) -> dict[str, Any]:
    """Run the evaluation and write ``metrics.json``, figures and videos.

    Args:
        config: What to evaluate.

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
    metrics: dict[str, Any] = {}
    for experiment, model in models.items():
        checkpoint = directory / "checkpoints" / experiment
        model.save_pretrained(checkpoint)
        planned = _plan(experiment, config)
        figures = run_cases(experiment, planned, checkpoint)
        if experiment == "compliance":
            metrics[experiment] = compliance.summarise(planned, figures)
        else:
            metrics[experiment] = grasp.summarise(figures)
    metrics["train_seconds"] = seconds
    distinct = {id(model): model for model in models.values()}
    metrics["memory_bytes"] = sum(model.memory_bytes() for model in distinct.values())
    metrics["tick_ms"] = time_steps(
        next(iter(distinct.values())) if len(distinct) == 1 else models["grasp"]
    )
    write_json(directory / "metrics.json", metrics)
    print(table(metrics))
    for path in _pictures(config, models, metrics, directory):
        print(path)
    print(directory / "metrics.json")
    return metrics


def _models(config: EvalConfig) -> tuple[dict[str, HASM], float | None]:
    """The model of each experiment, and the seconds it took to train them (None if loaded)."""
    if config.checkpoint is not None:
        model = HASM.from_pretrained(config.checkpoint)
        return dict.fromkeys(config.experiments, model), None
    settled = settings(config.method, config.model)
    models, seconds = {}, 0.0
    for experiment in tqdm(config.experiments, desc="training", unit="model"):
        trained = train(config.datasets / f"hsr_{experiment}", settled)
        models[experiment] = trained.model
        seconds += trained.seconds
    return models, seconds


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


def _plan(experiment: str, config: EvalConfig) -> list[Any]:
    rollouts = config.rollouts or ROLLOUTS[experiment]
    if experiment == "compliance":
        return compliance.cases(rollouts, config.forces, config.seed)
    return grasp.cases(
        rollouts,
        config.forces,
        config.seed,
        config.pauses,
        config.start_noise,
        config.object_noise,
    )


def time_steps(model: HASM, steps: int = TIMED_STEPS) -> dict[str, float]:
    """Time of one control step under a touch, encoders and recall, on one CPU thread.

    Args:
        model: The model; its first memory's patch is touched throughout.
        steps: Steps to time.

    Returns:
        Median and 99th percentile, ms.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    skin = pressed(model.body, model.patches[0], TIMED_FORCE)
    begin = (model.lower + model.upper) / 2
    model.reset()
    state, spent = begin, []
    for i in range(steps + 50):
        if i % 250 == 0:
            model.reset()  # the walk ends after some seconds: begin it again
            state = begin
        start = time.perf_counter()
        state = model.step(state, skin)
        if i >= 50:
            spent.append(1e3 * (time.perf_counter() - start))
    model.reset()
    torch.set_num_threads(threads)
    return {"median": statistics.median(spent), "p99": float(np.percentile(spent, 99))}


def _pictures(
    config: EvalConfig, models: dict[str, HASM], metrics: dict[str, Any], directory: Path
) -> list[Path]:
    from hasm_torch.evaluation import showcase

    paths = []
    if "compliance" in models:
        paths += showcase.draw_compliance(models["compliance"], metrics["compliance"], directory)
    if "grasp" in models:
        paths += showcase.draw_grasp(models["grasp"], config.seed, directory)
    if config.rerun:
        for experiment, model in models.items():
            paths.append(showcase.record(experiment, model, config.seed, directory))
    if config.render:
        for experiment, model in tqdm(models.items(), desc="videos", unit="video"):
            try:
                paths.append(showcase.film(experiment, model, config.seed, directory))
            except RuntimeError as error:
                print(f"no video of {experiment}: {error}", file=sys.stderr)
    return paths
