"""What each part of the memory is worth where the touched link is to go where it is pushed.

Every contestant learns the same demonstrations at the wrist and is pushed in the same cases, in
postures that nobody taught; the demonstrator's own law is pushed beside them. With fewer than all
demonstrations each seed learns others. Shares are over the demonstrator's, with 95 % intervals by
drawing the cases anew; so are the differences to the default.

    python -m benchmarks.yield_controls            # half an hour
    python -m benchmarks.yield_controls --quick=true
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.baselines.nearest import load, save_nearest
from benchmarks.machine import RESULTS, print_machine, save_json
from hasm_torch.apps.command_line import parse_options
from hasm_torch.config import HASMConfig
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import EpisodeSet, load_episodes
from hasm_torch.evaluation import along_force, yielding
from hasm_torch.evaluation.along_force import ALONG, Motion
from hasm_torch.evaluation.runner import Rolled, Runner
from hasm_torch.evaluation.touch_plots import plot_shares
from hasm_torch.model.hasm import HASM
from hasm_torch.sim.tasks import YIELD_TORSO

Array = NDArray[np.float64]

MEAN = HASMConfig(touch="direction", value="displacement", readout="mean")
CONTESTANTS = {
    "memory, default": HASMConfig(),
    "first order": replace(MEAN, readout="first_order"),
    "first order, real-valued": replace(MEAN, readout="first_order", storage="float32"),
    "mean": MEAN,
    "mean, real-valued": replace(MEAN, storage="float32"),
    "argmax": replace(MEAN, beta=float("inf")),
    "nearest stored sample": MEAN,
    "RoPE3D off": replace(MEAN, rope=False),
    "first order, RoPE3D off": replace(MEAN, readout="first_order", rope=False),
    "rotation constant a patch": replace(MEAN, frame="link"),
    "random key a patch": replace(MEAN, rope=False, touch="patch"),
}
DEFAULT, TABLE = "memory, default", "nearest stored sample"
RESAMPLES = 2000


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        sizes: Demonstrations at the wrist.
        seeds: Seeds of the cases and of which demonstrations are learned.
        pushes: Cases a seed.
        contestants: Which of ``CONTESTANTS``.
        datasets: Folder of the bundled datasets.
        quick: One seed, few pushes, 10 demonstrations.
        output_dir: Where ``yield_controls.json`` and its figure go.
    """

    sizes: list[int] = field(default_factory=lambda: [10, 40, 80])
    seeds: list[int] = field(default_factory=lambda: [1, 2, 3])
    pushes: int = 100
    contestants: list[str] = field(default_factory=lambda: list(CONTESTANTS))
    datasets: Path = Path("datasets")
    quick: bool = False
    output_dir: Path = RESULTS

    def __post_init__(self) -> None:
        if self.quick:
            self.sizes, self.seeds, self.pushes = [10], self.seeds[:1], min(self.pushes, 10)
        unknown = sorted(set(self.contestants) - set(CONTESTANTS))
        if unknown:
            raise ValueError(f"unknown contestants {unknown}, valid: {', '.join(CONTESTANTS)}")


def pick(data: EpisodeSet, size: int, seed: int) -> EpisodeSet:
    """Some demonstrations at the wrist, drawn by the seed, and all at the torso."""
    wrist = [e for e in data if e.task != YIELD_TORSO]
    torso = [e for e in data if e.task == YIELD_TORSO]
    if size > len(wrist):
        raise ValueError(f"expected at most {len(wrist)} demonstrations, got {size}")
    drawn = sorted(np.random.default_rng(seed).permutation(len(wrist))[:size].tolist())
    return replace(data, episodes=[*(wrist[i] for i in drawn), *torso])


def learn(name: str, data: EpisodeSet, directory: Path) -> None:
    """Write the checkpoint of a contestant."""
    model = HASM(CONTESTANTS[name], body_of(data))
    model.fit(data)
    if name == TABLE:
        save_nearest(model, directory)
    else:
        model.save_pretrained(directory)


def share(mine: Array, teacher: Array) -> float:
    """Share of cosines within 45° of the force, over the teacher's."""
    return float((mine > ALONG).mean() / (teacher > ALONG).mean())


def lead(ahead: Array, mine: Array, teacher: Array) -> float:
    """By how much one share is larger than another."""
    return share(ahead, teacher) - share(mine, teacher)


def interval(statistic: Callable[..., float], *columns: Array) -> list[float]:
    """95 % interval of a statistic of some columns, by drawing cases with replacement."""
    rng, cases = np.random.default_rng(0), len(columns[0])
    drawn = []
    for _ in range(RESAMPLES):
        rows = rng.integers(cases, size=cases)
        drawn.append(statistic(*(column[rows] for column in columns)))
    low, high = np.quantile(drawn, [0.025, 0.975]).tolist()
    return [low, high]


def summarise(
    motions: dict[str, Sequence[Motion]], teacher: Sequence[Motion]
) -> dict[str, dict[str, Any]]:
    """Figures of every contestant of one size, and what the default is ahead of it."""
    cosines = {name: np.array([m.cos for m in mine]) for name, mine in motions.items()}
    best = np.array([m.cos for m in teacher])
    found = {}
    for name, mine in cosines.items():
        figures = along_force.summarise(motions[name], teacher)
        figures["share_07_of_teacher_interval"] = interval(share, mine, best)
        if DEFAULT in cosines and name != DEFAULT:
            compared = cosines[DEFAULT], mine, best
            figures["default_is_ahead_by"] = lead(*compared)
            figures["default_is_ahead_by_interval"] = interval(lead, *compared)
        found[name] = figures
    return found


def run(options: Options) -> dict[str, Any]:
    """Teach and push every contestant.

    Returns:
        Figures by size and contestant.
    """
    data = load_episodes(options.datasets / "hsr_yield")
    cases = {
        seed: [case.without_rest() for case in yielding.cases(options.pushes, seed)]
        for seed in options.seeds
    }
    rolled: dict[tuple[int, str], list[Future[Rolled]]] = {}
    with closing(Runner(load)) as runner, TemporaryDirectory() as scratch:
        teacher = [f for seed in cases for f in runner.start("yield", cases[seed], None)]
        for size in options.sizes:
            for seed in options.seeds:
                some = pick(data, size, seed)
                for name in options.contestants:
                    directory = Path(scratch) / f"{size}-{seed}-{name}"
                    learn(name, some, directory)
                    started = runner.start("yield", cases[seed], directory)
                    rolled.setdefault((size, name), []).extend(started)
        law = _motions(teacher)
        return {
            str(size): summarise(
                {name: _motions(rolled[size, name]) for name in options.contestants}, law
            )
            for size in options.sizes
        }


def table(figures: dict[str, Any]) -> str:
    """Shares by size, with half widths of their intervals, as text."""
    lines = [f"{'share_07_of_teacher':<28}" + "".join(f"{size:>16}" for size in figures)]
    for name in next(iter(figures.values())):
        cells = []
        for found in figures.values():
            low, high = found[name]["share_07_of_teacher_interval"]
            cells.append(f"{found[name]['share_07_of_teacher']:.3f} ± {(high - low) / 2:.3f}")
        lines.append(f"{name:<28}" + "".join(f"{cell:>16}" for cell in cells))
    return "\n".join(lines)


def _motions(rolled: Sequence[Future[Rolled]]) -> list[Motion]:
    return [future.result()[1]["motion"] for future in rolled]


def main() -> None:
    """Measure, print a table, write the results and their figure."""
    options = parse_options(Options)
    torch.set_num_threads(1)
    print_machine()
    figures = run(options)
    print(table(figures))
    if options.quick:
        return
    curves = {
        name: {size: found[name] for size, found in figures.items()} for name in options.contestants
    }
    asked = asdict(options) | {"datasets": str(options.datasets)}
    del asked["output_dir"], asked["quick"]
    save_json(options.output_dir, "yield_controls", {"options": asked, "sizes": figures})
    plot_shares(options.output_dir / "yield_controls.png", curves)


if __name__ == "__main__":
    main()
