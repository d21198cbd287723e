"""The table that an evaluation prints."""

from collections.abc import Iterator
from typing import Any

# Figure, what it must reach, and whether more is better.
COMPLIANCE_FIGURES = (
    ("direction_correct", 1.0, True),
    ("with_force", 1.0, True),
    ("correct_turn", 1.0, True),
    ("spearman", 0.98, True),
    ("r2", 0.90, True),
    ("tracking", 0.90, True),
    ("release_drift_rad", 0.01, False),
)
YIELD_SHARES = {"10": 0.65, "40": 0.80, "80": 0.92}  # share_07_of_teacher by demonstrations
AGAINST, TRAVEL = 0.03, (0.8, 1.2)
UNSEEN_SHARE, BASE_STRAIGHT = 0.75, 0.95
GRASP_FIGURES = (("success_rate", 0.95, True), ("hold_drift_rad", 0.01, False))
GRASP_MOVED = {"0.02": 0.90, "0.05": 0.90, "0.10": 0.85}

Row = tuple[str, str, str, str]


def table(metrics: dict[str, Any]) -> str:
    """All figures with what they should reach; those that miss it are marked with !.

    Args:
        metrics: The content of ``metrics.json``.
    """
    rows = [*_compliance(metrics), *_yield(metrics), *_grasp(metrics)]
    if metrics["train_seconds"] is not None:
        rows.append(_row("all", "train_seconds", metrics["train_seconds"], 5.0, False))
    rows.append(_row("all", "memory_bytes", metrics["memory_bytes"], 1_000_000, False))
    rows.append(_row("control step", "tick_ms median", metrics["tick_ms"]["median"], 0.35, False))
    header = ("", "figure", "measured", "should be")
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(4)]
    lines = [
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths))
        )
        for row in (header, *rows)
    ]
    return "\n".join((lines[0], "-" * len(lines[0]), *lines[1:]))


def _compliance(metrics: dict[str, Any]) -> Iterator[Row]:
    if "compliance" not in metrics:
        return
    for name, figures in metrics["compliance"]["behaviours"].items():
        for key, goal, more in COMPLIANCE_FIGURES:
            if key in figures:
                yield _row(f"compliance {name}", key, figures[key], goal, more)
    violations = metrics["compliance"]["limit_violations"]
    yield _row("compliance", "limit_violations", violations, 0, False)


def _yield(metrics: dict[str, Any]) -> Iterator[Row]:
    if "yield" not in metrics:
        return
    found = metrics["yield"]
    along = found["along_force"]
    for size, figures in found.get("episodes", {}).items():
        key, share = f"share_07_of_teacher, {size} episodes", figures["share_07_of_teacher"]
        yield _row("yield", key, share, YIELD_SHARES.get(size), True)
    if "episodes" not in found:
        yield _row("yield", "share_07_of_teacher", along["share_07_of_teacher"], None, True)
    if "unseen_patch" in found:
        share = found["unseen_patch"]["share_07_of_teacher"]
        yield _row("yield unseen patch", "share_07_of_teacher", share, UNSEEN_SHARE, True)
    yield _row("yield", "against", along["against"], AGAINST, False)
    low, high = TRAVEL
    travel = along["travel_of_teacher"]
    reached = travel is not None and low <= travel <= high
    shown = "none" if travel is None else f"{travel:.4f}"
    yield "yield", "travel_of_teacher", shown + _mark(reached), f"{low:g} to {high:g}"
    for key in ("spearman", "spearman_of_teacher"):
        yield _row("yield", f"speed {key}", found["speed"][key], None, True)
    yield _row("yield torso", "base_cos_09", found["torso"]["base_cos_09"], BASE_STRAIGHT, True)
    for name, figures in (("yield", found), ("yield torso", found["torso"])):
        yield _row(name, "release_drift_rad", figures["release_drift_rad"], 0.01, False)
        yield _row(name, "limit_violations", figures["limit_violations"], 0, False)


def _grasp(metrics: dict[str, Any]) -> Iterator[Row]:
    if "grasp" not in metrics:
        return
    for key, goal, more in GRASP_FIGURES:
        yield _row("grasp", key, metrics["grasp"][key], goal, more)
    for reach, share in metrics["grasp"].get("moved", {}).items():
        yield _row("grasp", f"moved by up to {reach} m", share, GRASP_MOVED[reach], True)
    yield _row("grasp", "limit_violations", metrics["grasp"]["limit_violations"], 0, False)


def _row(where: str, key: str, value: float | None, goal: float | None, more: bool) -> Row:
    if value is None:
        return where, key, "none" + _mark(goal is None), "" if goal is None else f"{goal:g}"
    shown = str(value) if isinstance(value, int) else f"{value:.4f}"
    if goal is None:
        return where, key, shown + _mark(True), ""
    reached = value >= goal if more else value <= goal
    return where, key, shown + _mark(reached), f"{'≥' if more else '≤'} {goal:g}"


def _mark(reached: bool) -> str:
    return "  " if reached else " !"
