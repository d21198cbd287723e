"""Our policy beside its own variants and what others would use, on the same episodes and rollouts.

First the table: every contestant in both experiments of ``eval.py``, which computes the figures.
Then curves: how far a few of them generalise, what faults of the skin and few demonstrations do to
them, and what unrelated motions in the same memories do to the default. Rollouts are seeded, so
that all contestants meet the same forces, postures, objects and faults. A compliance rollout
succeeds if the right joint went the right way by 0.02 rad and no other joint gave way by 0.005 rad
or m; a grasp if the object is lifted and held at the end; a touch between two patches if the motion
is within 20 degrees of the sum of both behaviours' motions. Finished cells are kept one JSON line
each, and a run that was stopped goes on behind them.

    uv run benchmarks/policies.py               # about an hour on two cores
    uv run benchmarks/policies.py --quick=true  # three minutes, too few rollouts to conclude from
"""

import json
import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.baselines.contestants import CONTESTANTS, LEARNED, TUNED_NEIGHBOURS
from benchmarks.baselines.learned_training import Training
from benchmarks.machine import RESULTS, print_machine, save_json
from benchmarks.policies_bench import Bench, Cell
from benchmarks.policies_figures import draw_all
from benchmarks.policies_report import curve_table, goal_table, goals, pool, table
from hasm_torch.apps.command_line import parse_options

COMPARED = ("default", TUNED_NEIGHBOURS)
# Levels of every condition. Compliance and grasps are rolled out where both have a meaning.
BOTH: dict[str, tuple[float, ...]] = {
    "force": (3.0, 8.0, 12.0),  # N, on every touch
    "dead": (0.1, 0.3, 0.5),  # share of the cells
    "noise": (0.1, 0.5, 2.0),  # N a point
    "lost": (0.1, 0.3, 0.5),  # share of the samples
    "offset": (0.2, 0.5),  # N a point
    "stuck": (0.5, 1.0),  # N a point
}
COMPLIANCE_ONLY = {
    "posture": (0.0, 0.5, 1.0),  # way to any other posture
    "between": (0.0,),
}
GRASP_ONLY = {
    "start_noise": (0.1, 0.2, 0.3),  # rad
    "object": (0.02, 0.04),  # m
}
DEMONSTRATIONS = (1.0, 2.0, 5.0, 10.0)  # episodes a behaviour
CROWDS = (0.0, 10.0, 100.0, 1000.0, 10_000.0)  # unrelated motions in each memory
QUICK_SECONDS = 2.0  # of a network's training
# Conditions of ``--quick``, each at one level.
QUICK = {"dead": 0.3, "noise": 0.5, "posture": 1.0, "between": 0.0, "start_noise": 0.3}


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        contestants: Who is in the table; everyone by default.
        curves: Whether the curves are run.
        rollouts: Evenly pressed rollouts a behaviour for the table; grasps are twice as many.
            A point of a curve takes half of both from each seed.
        seeds: Seeds of the curves.
        seed: First seed.
        train_seconds: Longest training of a network for the table, s of one core; half as long
            for a point of a curve.
        quick: One rollout, one seed, few conditions, networks hardly trained; in another folder.
        minutes: Start nothing new after so long; the next run goes on.
        workers: Processes, each with one thread.
        datasets: Folder of the bundled datasets.
        output_dir: Where the results go.
    """

    contestants: list[str] = field(default_factory=lambda: list(CONTESTANTS))
    curves: bool = True
    rollouts: int = 4
    seeds: int = 3
    seed: int = 0
    train_seconds: float = 120.0
    quick: bool = False
    minutes: float | None = None
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    datasets: Path = Path("datasets")
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.contestants if name not in CONTESTANTS]
        if unknown:
            raise ValueError(f"unknown contestants {unknown}, valid: {', '.join(CONTESTANTS)}")
        if self.quick:
            self.rollouts, self.seeds, self.train_seconds = 1, 1, QUICK_SECONDS
        if min(self.rollouts, self.seeds, self.workers) < 1:
            raise ValueError(
                "rollouts, seeds and workers must be at least 1, got "
                f"{self.rollouts}, {self.seeds} and {self.workers}"
            )
        if self.output_dir is None:
            self.output_dir = Path("outputs/benchmarks/policies") if self.quick else RESULTS


def cells(options: Options) -> list[Cell]:
    """All cells: the table's, the curves', and behind them what trains networks."""
    return sorted(_cells(options), key=lambda cell: cell.contestant in LEARNED)


def _cells(options: Options) -> Iterator[Cell]:
    most = 1 if options.quick else 2 * options.rollouts
    for name in options.contestants:
        yield Cell(name, "none", 0.0, options.seed, options.rollouts, most)
    if not options.curves:
        return
    few, grasps = math.ceil(options.rollouts / 2), options.rollouts
    for seed in range(options.seed, options.seed + options.seeds):
        for name in COMPARED:
            yield Cell(name, "unharmed", 0.0, seed, few, grasps)
        for condition, levels in {**BOTH, **COMPLIANCE_ONLY, **GRASP_ONLY}.items():
            if options.quick:
                levels = (QUICK[condition],) if condition in QUICK else ()
            pushes = 0 if condition in GRASP_ONLY else few
            lifts = 0 if condition in COMPLIANCE_ONLY else grasps
            for level in levels:
                for name in COMPARED:
                    yield Cell(name, condition, level, seed, pushes, lifts)
        for level in DEMONSTRATIONS[:1] if options.quick else DEMONSTRATIONS:
            for name in (*COMPARED, *LEARNED):
                yield Cell(name, "demonstrations", level, seed, few, grasps)
        for level in CROWDS[1:2] if options.quick else CROWDS:
            yield Cell("default", "crowding", level, seed, 0, grasps)


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
    """Run what is not finished, print the tables, write JSON and figures."""
    options = parse_options(Options)
    print_machine()
    print(*run(options), sep="\n")


def run(options: Options) -> list[Path]:
    """Run the cells that are not finished and report all; see ``main``.

    Returns:
        The files written.
    """
    assert options.output_dir is not None
    options.output_dir.mkdir(parents=True, exist_ok=True)
    log = options.output_dir / "policies.jsonl"
    planned, results = cells(options), finished(log)
    waiting = [cell for cell in planned if cell.key not in results]
    if results:  # without a line that was cut off
        log.write_text("".join(json.dumps(entry) + "\n" for entry in results.values()))
    with log.open("a") as lines, tqdm(total=len(waiting), desc="cells", unit="cell") as bar:
        for cell, figures in _run_all(waiting, options):
            results[cell.key] = {"key": cell.key, **vars(cell), "results": figures}
            lines.write(json.dumps(results[cell.key]) + "\n")
            lines.flush()
            bar.set_postfix_str(f"{cell.contestant}, {cell.condition} {cell.level:g}")
            bar.update()
    done = [results[cell.key] for cell in planned if cell.key in results]
    ranked = [entry for entry in done if entry["condition"] == "none"]
    curves = pool([entry for entry in done if entry["condition"] != "none"])
    reached = goals(ranked, curves)
    print(table(ranked), curve_table(curves), goal_table(reached), sep="\n\n")
    content = {
        "version": version("hasm-torch"),
        "seed": options.seed,
        "workers": options.workers,
        "train_seconds": options.train_seconds,
        "cells": {"planned": len(planned), "finished": len(done)},
        "goals": reached,
        "contestants": [{k: v for k, v in entry.items() if k != "key"} for entry in ranked],
        "curves": curves,
    }
    paths = [save_json(options.output_dir, "policies", content)]
    return paths + draw_all(ranked, curves, options.output_dir)


def _run_all(waiting: list[Cell], options: Options) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Results of the cells as they come, from as many processes as there may be."""
    begin = time.perf_counter()
    training = Training(seconds=options.train_seconds)

    def in_time() -> bool:
        return not options.minutes or time.perf_counter() - begin < 60 * options.minutes

    if options.workers == 1:
        bench = Bench(options.datasets, training)
        for cell in waiting:
            if in_time():
                yield cell, bench.run(cell)
        bench.close()
        return
    queue, running = list(waiting), dict[Future[dict[str, Any]], Cell]()
    with ProcessPoolExecutor(
        options.workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(options.datasets, training),
    ) as workers:
        while running or (queue and in_time()):
            while queue and len(running) < options.workers and in_time():
                cell = queue.pop(0)
                running[workers.submit(_run_in_worker, cell)] = cell
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()


_worker: dict[str, Bench] = {}


def _start_worker(datasets: Path, training: Training) -> None:
    torch.set_num_threads(1)
    _worker["bench"] = Bench(datasets, training)


def _run_in_worker(cell: Cell) -> dict[str, Any]:
    return _worker["bench"].run(cell)


if __name__ == "__main__":
    main()
