"""Table, intervals and figures of ``benchmarks.policies``."""

import math
from pathlib import Path
from typing import Any

from hasm_torch.evaluation.runner import EXPERIMENTS

CONDITIONS = {
    "dead": "dead cells, share",
    "noise": "noise, N a point",
    "lost": "lost samples, share",
    "offset": "constant offset, N a point",
    "stuck": "a stuck cell, N a point",
    "start_noise": "noise of the start, rad",
    "demonstrations": "episodes a behaviour",
}
# Where a curve's unharmed point lies on its axis.
UNHARMED = {"start_noise": 0.05, "demonstrations": 4.0}


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate.

    Raises:
        ValueError: If there was no trial, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"expected 0 to {trials} successes of at least 1 trial, got {successes}")
    share, square = successes / trials, z * z / trials
    middle = (share + square / 2) / (1 + square)
    half = z / (1 + square) * math.sqrt(share * (1 - share) / trials + square / (4 * trials))
    return max(0.0, middle - half), min(1.0, middle + half)


def pool(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add up the seeds of every contestant, condition and level, with intervals.

    Args:
        entries: Finished cells.
    """
    pooled: dict[tuple[str, str, float, str], dict[str, Any]] = {}
    for entry in entries:
        for experiment, figures in entry["results"].items():
            key = (entry["contestant"], entry["condition"], entry["level"], experiment)
            names = ("contestant", "condition", "level", "experiment")
            point = pooled.setdefault(
                key,
                dict(zip(names, key)) | {"seeds": [], "successes": 0, "rollouts": 0, "drift": 0.0},
            )
            point["seeds"].append(entry["seed"])
            point["successes"] += figures["successes"]
            point["rollouts"] += figures["rollouts"]
            point["drift"] = max(point["drift"], drift(figures))
    for point in pooled.values():
        point["interval"] = wilson(point["successes"], point["rollouts"])
    return list(pooled.values())


def drift(figures: dict[str, Any]) -> float:
    """Largest motion of a joint while nobody touched, rad or m.

    Args:
        figures: Of one cell and experiment.
    """
    if "behaviours" in figures:
        return max(float(b["release_drift_rad"]) for b in figures["behaviours"].values())
    return float(figures["hold_drift_rad"])


def curve_table(points: list[dict[str, Any]]) -> str:
    """One line a condition and level: successes and drift of every contestant and experiment.

    Args:
        points: From ``pool``.
    """
    columns = list(dict.fromkeys((p["contestant"], p["experiment"]) for p in points))
    found = {(p["condition"], p["level"], p["contestant"], p["experiment"]): p for p in points}
    header = ["condition", *(f"{name}: {experiment}" for name, experiment in columns)]
    lines = ["  ".join([header[0].ljust(18), *(cell.rjust(36) for cell in header[1:])])]
    for condition, level in dict.fromkeys((p["condition"], p["level"]) for p in points):
        cells = []
        for column in columns:
            point = found.get((condition, level, *column))
            cells.append(_shown(point) if point else "")
        lines.append(
            "  ".join([f"{condition} {level:g}".ljust(18), *(cell.rjust(36) for cell in cells)])
        )
    return "\n".join(lines)


def _shown(point: dict[str, Any]) -> str:
    low, high = point["interval"]
    return (
        f"{point['successes']}/{point['rollouts']} ({100 * low:.0f}-{100 * high:.0f} %), "
        f"drift {point['drift']:.3f}"
    )


def table(entries: list[dict[str, Any]]) -> str:
    """One line a contestant: of the behaviours' figures the worst, both experiments' costs added.

    Args:
        entries: Finished cells of the table.
    """
    header = (
        "contestant", "yields", "direction", "spearman", "r²", "tracking", "drift", "others",
        "grasps", "95 %", "drift", "outside", "train s", "kB", "step ms",
    )  # fmt: skip
    rows = [header, *(_row(entry) for entry in entries)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    lines = [
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths))
        )
        for row in rows
    ]
    return "\n".join((lines[0], "-" * len(lines[0]), *lines[1:]))


def _row(entry: dict[str, Any]) -> tuple[str, ...]:
    yielding, grasping = (entry["results"][experiment] for experiment in EXPERIMENTS)
    behaviours = yielding["behaviours"].values()
    low, high = wilson(grasping["successes"], grasping["rollouts"])
    return (
        entry["contestant"],
        f"{yielding['successes']}/{yielding['rollouts']}",
        *(
            f"{min(b[key] for b in behaviours):.2f}"
            for key in ("direction_correct", "spearman", "r2", "tracking")
        ),
        f"{max(b['release_drift_rad'] for b in behaviours):.3f}",
        f"{max(b['others_moved'] for b in behaviours):.3f}",
        f"{grasping['successes']}/{grasping['rollouts']}",
        f"{100 * low:.0f}-{100 * high:.0f} %",
        f"{grasping['hold_drift_rad']:.3f}",
        str(yielding["limit_violations"] + grasping["limit_violations"]),
        f"{yielding['train_seconds'] + grasping['train_seconds']:.2f}",
        f"{(yielding['memory_bytes'] + grasping['memory_bytes']) / 1e3:.0f}",
        f"{max(yielding['step_ms'], grasping['step_ms']):.2f}",
    )


def draw_contestants(entries: list[dict[str, Any]], path: Path) -> Path:
    """Success rates of all contestants in both experiments.

    Args:
        entries: Finished cells of the table.
        path: Where the picture goes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.2 + 0.28 * len(entries)), layout="constrained")
    both = figure.subplots(1, 2, sharey=True)
    names = [entry["contestant"] for entry in entries]
    for axes, experiment in zip(both, EXPERIMENTS):
        found = [entry["results"][experiment] for entry in entries]
        rates = [result["successes"] / result["rollouts"] for result in found]
        spans = [wilson(result["successes"], result["rollouts"]) for result in found]
        axes.barh(names, rates, color="tab:blue", alpha=0.6)
        axes.errorbar(rates, names, xerr=_arms(rates, spans), fmt="none", ecolor="k", capsize=2)
        axes.set(xlim=(0, 1.02), xlabel="success rate, with Wilson's 95 % interval")
        axes.set_title(f"{experiment}, {found[0]['rollouts']} rollouts each" if found else "")
        axes.grid(axis="x", alpha=0.3)
    if entries:
        both[0].invert_yaxis()
    figure.savefig(path, dpi=110)
    return path


def draw_curves(points: list[dict[str, Any]], path: Path) -> Path:
    """Success rate against every fault, noisy starts and few demonstrations.

    Args:
        points: From ``pool``.
        path: Where the picture goes.
    """
    from matplotlib.figure import Figure

    conditions = [c for c in CONDITIONS if any(p["condition"] == c for p in points)]
    figure = Figure(figsize=(2 + 2.4 * len(conditions), 6), layout="constrained")
    grid = figure.subplots(2, max(1, len(conditions)), squeeze=False, sharey=True)
    names = list(dict.fromkeys(point["contestant"] for point in points))
    for row, experiment in zip(grid, EXPERIMENTS):
        for axes, condition in zip(row, conditions):
            if (condition, experiment) not in {(p["condition"], p["experiment"]) for p in points}:
                axes.set_axis_off()
                continue
            for shift, name in enumerate(names):
                mine = [
                    (
                        UNHARMED.get(condition, 0.0)
                        if p["condition"] == "unharmed"
                        else p["level"],
                        p,
                    )
                    for p in points
                    if p["contestant"] == name
                    and p["experiment"] == experiment
                    and p["condition"] in (condition, "unharmed")
                ]
                mine.sort(key=lambda pair: pair[0])
                rates = [p["successes"] / p["rollouts"] for _, p in mine]
                reach = max((level for level, _ in mine), default=1.0)
                axes.errorbar(
                    [level + 0.015 * reach * shift for level, _ in mine],
                    rates,
                    yerr=_arms(rates, [p["interval"] for _, p in mine]),
                    marker="o",
                    capsize=3,
                    label=name,
                )
            axes.set(xlabel=CONDITIONS[condition], ylim=(-0.03, 1.03))
            axes.grid(alpha=0.3)
            if condition == "demonstrations":
                axes.set_xticks([1, 2, UNHARMED[condition]], ["1", "2", "all"])
        row[0].set_ylabel(f"{experiment}: success rate")
    grid[0][0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    return path


def _arms(rates: list[float], spans: list[tuple[float, float]]) -> list[list[float]]:
    return [
        [max(0.0, rate - span[0]) for rate, span in zip(rates, spans)],
        [max(0.0, span[1] - rate) for rate, span in zip(rates, spans)],
    ]
