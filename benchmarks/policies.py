"""Our policy beside its own variants and what others would use, on the same episodes and rollouts.

Three parts: all contestants in both experiments; the default and nearest neighbours under faults
of the skin and noisy starts; the same two with few demonstrations. Rollouts are seeded, so that
all contestants meet the same forces, postures, objects and faults. A compliance rollout succeeds
if the right joint went the right way by 0.02 rad and no other joint gave way by 0.005 rad or m; a
grasp if the object is lifted and held at the end. Finished cells are kept one JSON line each, and
a run that was stopped goes on behind them.

    python -m benchmarks.policies               # about 40 minutes
    python -m benchmarks.policies --quick=true  # about two minutes; another folder
"""

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.baselines.contestants import CONTESTANTS, TUNED_NEIGHBOURS
from benchmarks.machine import RESULTS, print_machine, save_json
from benchmarks.policies_bench import Bench, Cell
from benchmarks.policies_report import curve_table, draw_contestants, draw_curves, pool, table
from hasm_torch.command_line import parse_options

COMPARED = ("default", TUNED_NEIGHBOURS)
FAULTS = {
    "dead": (0.1, 0.3, 0.5),  # share of the cells
    "noise": (0.1, 0.5, 2.0),  # N a point
    "lost": (0.1, 0.3, 0.5),  # share of the samples
    "offset": (0.2,),  # N a point
    "stuck": (1.0,),  # N a point
}
START_NOISES = (0.1, 0.2, 0.3)  # rad
DEMONSTRATIONS = (1, 2)  # episodes a behaviour


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        contestants: Who is in the table; everyone by default.
        curves: Whether faults, noisy starts and few demonstrations are run.
        rollouts: Evenly pressed rollouts a behaviour for the table; grasps are twice as many.
            A point of a curve takes a quarter of both from each seed.
        seeds: Seeds of the curves.
        seed: First seed.
        quick: One rollout, one seed and the hardest level of each curve.
        minutes: Stop after so long; the next run goes on.
        threads: CPU threads.
        datasets: Folder of the bundled datasets.
        output_dir: Where the results go.
    """

    contestants: list[str] = field(default_factory=lambda: list(CONTESTANTS))
    curves: bool = True
    rollouts: int = 8
    seeds: int = 3
    seed: int = 0
    quick: bool = False
    minutes: float | None = None
    threads: int = 1
    datasets: Path = Path("datasets")
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.contestants if name not in CONTESTANTS]
        if unknown:
            raise ValueError(f"unknown contestants {unknown}, valid: {', '.join(CONTESTANTS)}")
        if self.quick:
            self.rollouts, self.seeds = 1, 1
        if self.rollouts < 1 or self.seeds < 1:
            raise ValueError(
                f"rollouts and seeds must be at least 1, got {self.rollouts} and {self.seeds}"
            )
        if self.output_dir is None:
            self.output_dir = Path("outputs/benchmarks/policies") if self.quick else RESULTS


def cells(options: Options) -> Iterator[Cell]:
    """All cells, the table's first."""
    for name in options.contestants:
        yield Cell(name, "none", 0.0, options.seed, options.rollouts, 2 * options.rollouts)
    if not options.curves:
        return
    few, grasps = math.ceil(options.rollouts / 4), math.ceil(options.rollouts / 2)
    conditions = {**FAULTS, "start_noise": START_NOISES, "demonstrations": DEMONSTRATIONS}
    if options.quick:
        hardest = {"demonstrations": min}
        conditions = {name: (hardest.get(name, max)(c),) for name, c in conditions.items()}
    for seed in range(options.seed, options.seed + options.seeds):
        for name in COMPARED:
            yield Cell(name, "unharmed", 0.0, seed, few, grasps)
            for condition, levels in conditions.items():
                # Compliance begins in any posture, so a noisy start means nothing to it.
                pushed = 0 if condition == "start_noise" else few
                for level in levels:
                    yield Cell(name, condition, float(level), seed, pushed, grasps)


def finished(path: Path) -> dict[str, dict[str, Any]]:
    """Results of an earlier run, by the key of their cell; a line that was cut off is left out."""
    results = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            entry = json.loads(line)
            results[entry["key"]] = entry
        except (json.JSONDecodeError, KeyError):
            continue
    return results


def main() -> None:
    """Run what is not finished, print the table, write JSON and figures."""
    options = parse_options(Options)
    torch.set_num_threads(options.threads)
    print_machine()
    print(*run(options), sep="\n")


def run(options: Options) -> list[Path]:
    """Run the cells that are not finished and report all; see ``main``.

    Returns:
        The files written.
    """
    assert options.output_dir is not None
    begin = time.perf_counter()
    options.output_dir.mkdir(parents=True, exist_ok=True)
    log = options.output_dir / "policies.jsonl"
    planned, results = list(cells(options)), finished(log)
    bench = Bench(options.datasets)
    waiting = [cell for cell in planned if cell.key not in results]
    if results:  # without a line that was cut off
        log.write_text("".join(json.dumps(entry) + "\n" for entry in results.values()))
    with log.open("a") as lines, tqdm(waiting, desc="cells", unit="cell") as bar:
        for cell in bar:
            if options.minutes and time.perf_counter() - begin > 60 * options.minutes:
                break
            bar.set_postfix_str(f"{cell.contestant}, {cell.condition} {cell.level:g}")
            results[cell.key] = {"key": cell.key, **vars(cell), "results": bench.run(cell)}
            lines.write(json.dumps(results[cell.key]) + "\n")
            lines.flush()
    bench.close()
    done = [results[cell.key] for cell in planned if cell.key in results]
    ranked = [entry for entry in done if entry["condition"] == "none"]
    curves = pool([entry for entry in done if entry not in ranked])
    print(table(ranked), curve_table(curves), sep="\n\n")
    content = {
        "version": version("hasm-torch"),
        "seed": options.seed,
        "cells": {"planned": len(planned), "finished": len(done)},
        "contestants": [{k: v for k, v in entry.items() if k != "key"} for entry in ranked],
        "curves": curves,
    }
    paths = [save_json(options.output_dir, "policies", content)]
    paths.append(draw_contestants(ranked, options.output_dir / "policies.png"))
    if curves:
        paths.append(draw_curves(curves, options.output_dir / "policies_curves.png"))
    return paths


if __name__ == "__main__":
    main()
