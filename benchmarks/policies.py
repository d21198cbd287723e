"""The memory beside its own variants and what others would use, on the same episodes and rollouts.

Every contestant learns all bundled demonstrations of each experiment and is rolled out as
``eval.py`` rolls out a checkpoint, which computes the figures: the same forces, postures, objects
and faults for everyone. The skin may be damaged and filtered, for all alike.

    uv run benchmarks/policies.py               # most of it trains two networks for each experiment
    uv run benchmarks/policies.py --quick=true  # minutes, too few rollouts to conclude from
"""

from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch
from tqdm import tqdm

from benchmarks.baselines.contestants import CONTESTANTS, loader, save, step_ms, train
from benchmarks.baselines.faults import Fault, Kind
from benchmarks.baselines.learned_training import Training
from benchmarks.machine import RESULTS, print_machine, save_json
from hasm_torch.apps.command_line import parse_options
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.data.training import warm_up
from hasm_torch.encoders.readings import pressed
from hasm_torch.evaluation import suite
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.evaluation.runner import EXPERIMENTS, Runner, check_experiments
from hasm_torch.sim.tasks import WRIST_PATCHES

QUICK_ROLLOUTS, QUICK_SECONDS = 1, 2.0
TIMED_FORCE, TIMED_STEPS = 8.0, 300  # N; control steps
BULKY = ("velocities", "results", "kinds")  # of the figures, that nobody compares


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        contestants: Who is rolled out; everyone by default.
        experiments: Of "compliance", "yield" and "grasp".
        rollouts: Rollouts of each group, see ``eval.py``; by default those of ``eval.py``.
        seed: Seed of everything that the tests draw.
        train_seconds: Longest training of a network, s of one core.
        fault: What is wrong with the skin, if anything; see ``benchmarks.baselines.faults``.
        level: How much of it.
        filter: Whether the skin filter stands before every policy.
        quick: Few rollouts, networks hardly trained; in another folder.
        datasets: Folder of the bundled datasets.
        output_dir: Where ``policies.json`` goes.
    """

    contestants: list[str] = field(default_factory=lambda: list(CONTESTANTS))
    experiments: list[str] = field(default_factory=lambda: list(EXPERIMENTS))
    rollouts: int | None = None
    seed: int = 0
    train_seconds: float = 120.0
    fault: Literal["none"] | Kind = "none"
    level: float = 0.0
    filter: bool = False
    quick: bool = False
    datasets: Path = Path("datasets")
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.contestants if name not in CONTESTANTS]
        if unknown:
            raise ValueError(f"unknown contestants {unknown}, valid: {', '.join(CONTESTANTS)}")
        check_experiments(self.experiments)
        self.damage()
        if self.quick:
            self.rollouts, self.train_seconds = QUICK_ROLLOUTS, QUICK_SECONDS
        if self.output_dir is None:
            self.output_dir = Path("outputs/benchmarks/policies") if self.quick else RESULTS

    def damage(self) -> Fault | None:
        """What is wrong with the skin."""
        return None if self.fault == "none" else Fault(self.fault, self.level)


def run(options: Options) -> dict[str, Any]:
    """Train and roll out every contestant.

    Returns:
        Figures by contestant: those of each experiment as in ``metrics.json``, and ``costs``.
    """
    warm_up()
    config = EvalConfig(  # a checkpoint is one that nobody knows the teaching of
        checkpoint=Path(),
        experiments=options.experiments,
        rollouts=options.rollouts,
        seed=options.seed,
    )
    groups = suite.plan(config)
    results: dict[str, dict[str, Any]] = {}
    with TemporaryDirectory() as scratch:
        for name in options.contestants:
            results[name] = {"costs": {}}
        for experiment in tqdm(options.experiments, desc="training", unit="experiment"):
            for name in options.contestants:
                directory = _directory(scratch, name, experiment)
                results[name]["costs"][experiment] = _train(options, name, experiment, directory)
        with closing(Runner(loader(options.damage(), options.filter))) as runner:
            led = {g.name: runner.start(g.experiment, g.cases, None) for g in groups if g.taught}
            rolled = {
                name: led
                | {
                    g.name: runner.start(
                        g.experiment, g.cases, _directory(scratch, name, g.experiment)
                    )
                    for g in groups
                    if not g.taught
                }
                for name in options.contestants
            }
            for name, started in rolled.items():
                found = {group: [f.result()[1] for f in fs] for group, fs in started.items()}
                results[name] |= _without(suite.summarise(config, groups, found))
    return results


def _directory(scratch: str, name: str, experiment: str) -> Path:
    return Path(scratch) / experiment / name.replace(" ", "_")


def _train(options: Options, name: str, experiment: str, directory: Path) -> dict[str, Any]:
    """Train a contestant and write it; what it cost."""
    data = load_episodes(options.datasets / f"hsr_{experiment}")
    body = body_of(data)
    training = Training(seconds=options.train_seconds)
    trained = train(name, experiment, body, data.episodes, training)
    save(trained.policy, body, data.episodes, directory)
    touch = pressed(body, WRIST_PATCHES[0], TIMED_FORCE)
    return {
        "train_seconds": trained.seconds,
        "memory_bytes": trained.policy.memory_bytes(),
        "step_ms": step_ms(trained.policy, body, touch, TIMED_STEPS),
        "notes": trained.notes,
    }


def _without(figures: dict[str, Any]) -> dict[str, Any]:
    """Figures less what is bulky."""
    return {
        key: _without(value) if isinstance(value, dict) else value
        for key, value in figures.items()
        if key not in BULKY
    }


def table(results: dict[str, Any]) -> str:
    """One line a contestant; of the behaviours' figures the worst, costs added or the largest."""
    header = [
        "contestant", "arm with force", "wrist turns", "spearman", "yields", "against", "base",
        "grasps", "train s", "kB", "step ms",
    ]  # fmt: skip
    rows = [header]
    for name, found in results.items():
        behaviours = found.get("compliance", {}).get("behaviours", {}).values()
        costs = found["costs"].values()
        cells = [
            found.get("compliance", {}).get("with_force"),
            found.get("compliance", {}).get("correct_turn"),
            min((b["spearman"] for b in behaviours), default=None),
            found.get("yield", {}).get("along_force", {}).get("share_07_of_teacher"),
            found.get("yield", {}).get("along_force", {}).get("against"),
            found.get("yield", {}).get("torso", {}).get("base_cos_09"),
            found.get("grasp", {}).get("success_rate"),
            sum(cost["train_seconds"] for cost in costs),
            sum(cost["memory_bytes"] for cost in costs) / 1e3,
            max(cost["step_ms"] for cost in costs),
        ]
        shown = ["" if x is None else f"{x:,.0f}" if x >= 100 else f"{x:.2f}" for x in cells]
        rows.append([name, *shown])
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    lines = ["  ".join(f"{c:>{w}}" if i else f"{c:<{w}}"
                       for i, (c, w) in enumerate(zip(row, widths))) for row in rows]  # fmt: skip
    return "\n".join((lines[0], "-" * len(lines[0]), *lines[1:]))


def main() -> None:
    """Train, roll out, print a table, write JSON."""
    options = parse_options(Options)
    assert options.output_dir is not None
    torch.set_num_threads(1)
    print_machine()
    results = run(options)
    print(table(results))
    asked = {
        name: getattr(options, name)
        for name in ("rollouts", "seed", "train_seconds", "fault", "level", "filter")
    }
    print(save_json(options.output_dir, "policies", {"options": asked, "contestants": results}))


if __name__ == "__main__":
    main()
