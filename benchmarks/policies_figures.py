"""Figures of ``benchmarks.policies``."""

from pathlib import Path
from typing import Any

from benchmarks.policies_report import CONDITIONS, DEFAULT, UNHARMED, wilson
from hasm_torch.evaluation.runner import EXPERIMENTS

# Panels, down the columns of two.
Panel = tuple[str, str]
GENERALISATION: tuple[Panel, ...] = (
    ("compliance", "force"),
    ("grasp", "force"),
    ("compliance", "posture"),
    ("grasp", "start_noise"),
    ("compliance", "demonstrations"),
    ("grasp", "demonstrations"),
    ("grasp", "object"),
)
FAULTS: tuple[Panel, ...] = tuple(
    (experiment, fault)
    for fault in ("dead", "noise", "lost", "offset", "stuck")
    for experiment in EXPERIMENTS
)


def draw_all(
    ranked: list[dict[str, Any]], curves: list[dict[str, Any]], directory: Path
) -> list[Path]:
    """Everything that there are cells for.

    Args:
        ranked: Finished cells of the table.
        curves: From ``policies_report.pool``.
        directory: Where the pictures go.
    """
    paths = [draw_contestants(ranked, directory / "policies.png")] if ranked else []
    drawn = {(point["experiment"], point["condition"]) for point in curves}
    for name, panels in (("generalisation", GENERALISATION), ("faults", FAULTS)):
        found = [panel for panel in panels if panel in drawn]
        if found:
            paths.append(draw_curves(curves, found, directory / f"policies_{name}.png"))
    crowds = [point for point in curves if point["condition"] == "crowding" and point["level"]]
    if crowds:
        paths.append(draw_crowding(crowds, directory / "policies_crowding.png"))
    return paths


def draw_contestants(entries: list[dict[str, Any]], path: Path) -> Path:
    """Success rates of all contestants in both experiments."""
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
        axes.set_title(f"{experiment}, {found[0]['rollouts']} rollouts each")
        axes.grid(axis="x", alpha=0.3)
    both[0].invert_yaxis()
    figure.savefig(path, dpi=110)
    return path


def draw_curves(curves: list[dict[str, Any]], panels: list[Panel], path: Path) -> Path:
    """Success rate against some conditions, a panel each."""
    from matplotlib.figure import Figure

    columns = -(-len(panels) // 2)
    figure = Figure(figsize=(1.5 + 2.6 * columns, 5.6), layout="constrained")
    grid = figure.subplots(2, columns, squeeze=False, sharey=True)
    names = list(dict.fromkeys(point["contestant"] for point in curves))
    for axes in grid.T.flat[len(panels) :]:
        axes.set_axis_off()
    for axes, (experiment, condition) in zip(grid.T.flat, panels):
        for shift, name in enumerate(names):
            mine = _curve(curves, name, condition, experiment)
            if mine:
                _draw_curve(axes, mine, name, shift)
        axes.set(xlabel=CONDITIONS[condition], ylim=(-0.04, 1.04))
        axes.set_ylabel(f"{experiment}: success rate")
        axes.grid(alpha=0.3)
    legend: dict[str, Any] = {}
    for axes in grid.flat:
        handles, labels = axes.get_legend_handles_labels()
        legend.update(zip(labels, handles))
    handles, labels = list(legend.values()), list(legend)
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    figure.savefig(path, dpi=110)
    return path


def draw_crowding(points: list[dict[str, Any]], path: Path) -> Path:
    """What unrelated motions in the memories do to the grasp."""
    from matplotlib.figure import Figure

    points = sorted(points, key=lambda point: float(point["level"]))
    stored = [point["associations"] for point in points]
    figure = Figure(figsize=(13, 3.4), layout="constrained")
    success, margin, size, step = figure.subplots(1, 4)
    rates = [point["successes"] / point["rollouts"] for point in points]
    arms = _arms(rates, [point["interval"] for point in points])
    success.errorbar(stored, rates, yerr=arms, marker="o", capsize=3)
    success.set(ylabel="grasps: success rate", ylim=(-0.04, 1.04))
    margin.plot(stored, [p["margin_smallest_unrelated"] for p in points], "o-", label="unrelated")
    margin.plot(stored, [p["margin_smallest"] for p in points], "o-", label="any other")
    margin.set(ylabel="smallest lead in a recall, inner product", ylim=(0, None))
    margin.legend()
    size.loglog(stored, [point["memory_bytes"] / 1e6 for point in points], "o-")
    size.set_ylabel("memory, MB")
    step.plot(stored, [p["step_recall_median_ms"] for p in points], "o-", label="with a recall")
    step.plot(stored, [p["step_median_ms"] for p in points], "o-", label="all under touch")
    step.set(ylabel="control step on one thread, median, ms", ylim=(0, None))
    step.legend()
    for axes in (success, margin, size, step):
        axes.set(xlabel="associations stored", xscale="log")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path


def _curve(
    curves: list[dict[str, Any]], name: str, condition: str, experiment: str
) -> list[tuple[float, dict[str, Any]]]:
    """Levels and points of one contestant, the unharmed one included where it has a place."""
    mine = []
    for point in curves:
        if (point["contestant"], point["experiment"]) != (name, experiment):
            continue
        if point["condition"] == condition:
            mine.append((float(point["level"]), point))
        elif point["condition"] == "unharmed" and condition in UNHARMED:
            mine.append((UNHARMED[condition], point))
    shown = any(point["condition"] == condition for _, point in mine)
    return sorted(mine, key=lambda pair: pair[0]) if shown else []


def _draw_curve(axes: Any, mine: list[tuple[float, dict[str, Any]]], name: str, shift: int) -> None:
    rates = [point["successes"] / point["rollouts"] for _, point in mine]
    reach = max(level for level, _ in mine)
    axes.errorbar(
        [level + 0.012 * reach * shift for level, _ in mine],  # so that bars do not hide each other
        rates,
        yerr=_arms(rates, [point["interval"] for _, point in mine]),
        marker="o",
        capsize=3,
        label=name,
        zorder=3 if name == DEFAULT else 2,
    )


def _arms(rates: list[float], spans: list[tuple[float, float]]) -> list[list[float]]:
    return [
        [max(0.0, rate - span[0]) for rate, span in zip(rates, spans)],
        [max(0.0, span[1] - rate) for rate, span in zip(rates, spans)],
    ]
