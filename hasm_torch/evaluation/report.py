"""The table that an evaluation prints."""

from typing import Any

# Figure, what it must reach, and whether more is better.
COMPLIANCE_FIGURES = (
    ("direction_correct", 1.0, True),
    ("spearman", 0.98, True),
    ("r2", 0.90, True),
    ("tracking", 0.90, True),
    ("release_drift_rad", 0.01, False),
)
GRASP_FIGURES = (("success_rate", 0.95, True), ("hold_drift_rad", 0.01, False))


def table(metrics: dict[str, Any]) -> str:
    """All figures with what they should reach; those that miss it are marked with !.

    Args:
        metrics: The content of ``metrics.json``.
    """
    rows: list[tuple[str, str, str, str]] = []
    behaviours = metrics.get("compliance", {}).get("behaviours", {})
    for name, figures in behaviours.items():
        for key, goal, more in COMPLIANCE_FIGURES:
            rows.append(_row(f"compliance {name}", key, figures[key], goal, more))
    if behaviours:
        violations = metrics["compliance"]["limit_violations"]
        rows.append(_row("compliance", "limit_violations", violations, 0, False))
    if "grasp" in metrics:
        for key, goal, more in GRASP_FIGURES:
            rows.append(_row("grasp", key, metrics["grasp"][key], goal, more))
        violations = metrics["grasp"]["limit_violations"]
        rows.append(_row("grasp", "limit_violations", violations, 0, False))
    if metrics["train_seconds"] is not None:
        rows.append(_row("both", "train_seconds", metrics["train_seconds"], 5.0, False))
    rows.append(_row("both", "memory_bytes", metrics["memory_bytes"], 1_000_000, False))
    rows.append(_row("control step", "tick_ms median", metrics["tick_ms"]["median"], 1.0, False))
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


def _row(where: str, key: str, value: float, goal: float, more: bool) -> tuple[str, str, str, str]:
    reached = value >= goal if more else value <= goal
    shown = str(value) if isinstance(value, int) else f"{value:.4f}"
    return where, key, shown + ("  " if reached else " !"), f"{'≥' if more else '≤'} {goal:g}"
