"""Tables, intervals and goals of ``benchmarks.policies``."""

import math
import statistics
from typing import Any

from hasm_torch.evaluation.runner import EXPERIMENTS

CONDITIONS = {
    "force": "force of the touch, N",
    "posture": "posture, from shown to any",
    "between": "two patches at once",
    "start_noise": "noise of the start, rad",
    "object": "object moved by up to, m",
    "demonstrations": "episodes a behaviour",
    "dead": "dead cells, share",
    "noise": "noise, N a point",
    "lost": "lost samples, share",
    "offset": "constant offset, N a point",
    "stuck": "a stuck cell, N a point",
    "crowding": "unrelated motions stored",
}
# Where a curve's unharmed point lies on its axis; without an entry the curve has none.
UNHARMED = {"start_noise": 0.05, "object": 0.01, "dead": 0.0, "noise": 0.0, "lost": 0.0,
            "offset": 0.0, "stuck": 0.0}  # fmt: skip
DEFAULT, NEIGHBOURS = "default", "nearest neighbours, tuned"
NETWORKS = ("ACT", "Diffusion")
SHARED, UNROTATED = "one shared memory", "one shared memory without RoPE3D"
BEHAVIOURS = 4  # of a shared memory, between which a guess has to choose


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
    pooled: dict[tuple[str, str, float, str], list[dict[str, Any]]] = {}
    for entry in entries:
        for experiment, figures in entry["results"].items():
            key = (entry["contestant"], entry["condition"], entry["level"], experiment)
            pooled.setdefault(key, []).append({"seed": entry["seed"], **figures})
    names = ("contestant", "condition", "level", "experiment")
    return [{**dict(zip(names, key)), **_pooled(found)} for key, found in pooled.items()]


def _pooled(found: list[dict[str, Any]]) -> dict[str, Any]:
    successes = sum(figures["successes"] for figures in found)
    rollouts = sum(figures["rollouts"] for figures in found)
    point = {
        "seeds": [figures["seed"] for figures in found],
        "successes": successes,
        "rollouts": rollouts,
        "interval": wilson(successes, rollouts),
        "train_seconds": statistics.mean(figures["train_seconds"] for figures in found),
        "memory_bytes": statistics.mean(figures["memory_bytes"] for figures in found),
        "step_ms": statistics.median(figures["step_ms"] for figures in found),
    }
    if "angle_median" in found[0]:
        weights = [figures["rollouts"] for figures in found]
        for name in ("within", "angle_median"):
            total = sum(figures[name] * n for figures, n in zip(found, weights))
            point[name] = total / sum(weights)
        return point
    point["drift"] = max(drift(figures) for figures in found)
    if "step_times" in found[0]:
        for name in ("median", "recall_median", "recall_p99"):
            times = [figures["step_times"][name] for figures in found]
            point[f"step_{name}_ms"] = statistics.median(times)
        point["associations"] = statistics.mean(
            sum(part["learned"] + part["unrelated"] for part in figures["stored"].values())
            for figures in found
        )
        for name in ("smallest", "smallest_unrelated"):
            leads = [m[name] for figures in found for m in figures["margins"].values()]
            point[f"margin_{name}"] = min(leads)
    return point


def drift(figures: dict[str, Any]) -> float:
    """Largest motion of a joint while nobody touched, rad or m.

    Args:
        figures: Of one cell and experiment.
    """
    if "behaviours" in figures:
        return max(float(b["release_drift_rad"]) for b in figures["behaviours"].values())
    return float(figures["hold_drift_rad"])


def curve_table(points: list[dict[str, Any]]) -> str:
    """One line a condition and level: successes of every contestant and experiment.

    Args:
        points: From ``pool``.
    """
    columns = list(dict.fromkeys((p["contestant"], p["experiment"]) for p in points))
    found = {(p["condition"], p["level"], p["contestant"], p["experiment"]): p for p in points}
    header = ["condition", *(f"{name}: {experiment}" for name, experiment in columns)]
    lines = ["  ".join([header[0].ljust(18), *(cell.rjust(26) for cell in header[1:])])]
    for condition, level in dict.fromkeys((p["condition"], p["level"]) for p in points):
        cells = []
        for column in columns:
            point = found.get((condition, level, *column))
            cells.append(_shown(point) if point else "")
        lines.append(
            "  ".join([f"{condition} {level:g}".ljust(18), *(cell.rjust(26) for cell in cells)])
        )
    return "\n".join(lines)


def _shown(point: dict[str, Any]) -> str:
    low, high = point["interval"]
    return f"{point['successes']}/{point['rollouts']} ({100 * low:.0f}-{100 * high:.0f} %)"


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


Goal = dict[str, Any]


def goals(ranked: list[dict[str, Any]], curves: list[dict[str, Any]]) -> list[Goal]:
    """What the default model should reach, and whether it does.

    A goal says what was measured in words; those whose cells are not finished are left out.

    Args:
        ranked: Finished cells of the table.
        curves: From ``pool``.
    """
    table = {entry["contestant"]: entry["results"] for entry in ranked}
    return [*_shared_goals(table), *_network_goals(table, curves), *_curve_goals(curves)]


def _shared_goals(table: dict[str, Any]) -> list[Goal]:
    found = []
    if SHARED in table:
        rate = _rate(table[SHARED]["compliance"])
        found.append(_goal("shared memory with RoPE3D: right behaviour", "100 %", rate, rate == 1))
    if UNROTATED in table:
        rate, chance = _rate(table[UNROTATED]["compliance"]), 1 / BEHAVIOURS
        found.append(
            _goal("the same without RoPE3D", f"≤ {chance:.0%} (chance)", rate, rate <= chance)
        )
    return found


def _network_goals(table: dict[str, Any], curves: list[dict[str, Any]]) -> list[Goal]:
    found = []
    for name in NETWORKS:
        for experiment in EXPERIMENTS:
            ours, theirs = (
                _point(curves, who, "demonstrations", 1.0, experiment) for who in (DEFAULT, name)
            )
            if ours and theirs:
                told = f"{_rate(ours):.0%} : {_rate(theirs):.0%}"
                better = _rate(ours) > _rate(theirs)
                found.append(
                    _goal(
                        f"1 episode a behaviour, {experiment}: default : {name}", ">", told, better
                    )
                )
            if not {DEFAULT, name} <= table.keys():
                continue
            ours, theirs = (table[who][experiment] for who in (DEFAULT, name))
            told = f"{_rate(ours):.0%} : {_rate(theirs):.0%}"
            least = _rate(ours) >= _rate(theirs)
            found.append(_goal(f"all episodes, {experiment}: default : {name}", "≥", told, least))
            ratio = theirs["train_seconds"] / ours["train_seconds"]
            found.append(
                _goal(f"all episodes, {experiment}: training time of {name} / default", "≥ 100",
                      f"{ratio:.0f}", ratio >= 100)
            )  # fmt: skip
    return found


def _curve_goals(curves: list[dict[str, Any]]) -> list[Goal]:
    found = []
    for condition in ("force", "posture", "dead", "noise", "lost", "offset", "stuck"):
        for experiment in EXPERIMENTS:
            mine, theirs = (
                [p for p in curves if (p["contestant"], p["condition"], p["experiment"])
                 == (who, condition, experiment)]
                for who in (DEFAULT, NEIGHBOURS)
            )  # fmt: skip
            if not mine or len(mine) != len(theirs):
                continue
            pairs = [(_rate(a), _rate(b)) for a, b in zip(mine, theirs)]
            told = ", ".join(f"{a:.0%} : {b:.0%}" for a, b in pairs)
            least = all(a >= b for a, b in pairs)
            what = f"{CONDITIONS[condition]} ({experiment}): default : neighbours"
            found.append(_goal(what, "≥ everywhere", told, least))
    between = _point(curves, DEFAULT, "between", 0.0, "compliance")
    if between:
        within = between["within"]
        found.append(_goal("two patches at once: within 20° of the sum", "≥ 95 %", within,
                           within >= 0.95))  # fmt: skip
    for condition, level in (("dead", 0.3), ("lost", 0.3), ("noise", 0.5)):
        points = [
            [_point(curves, DEFAULT, name, at, experiment) for experiment in EXPERIMENTS]
            for name, at in (("unharmed", 0.0), (condition, level))
        ]
        if all(point for row in points for point in row):
            before, after = (_together(row) for row in points)
            what = f"{CONDITIONS[condition]}: {level:g}, loss of success"
            found.append(_goal(what, "≤ 5 points", f"{100 * (before - after):.1f} points",
                               before - after <= 0.05))  # fmt: skip
    few, crowd = (_point(curves, DEFAULT, "crowding", n, "grasp") for n in (0.0, 1000.0))
    if few and crowd:
        loss = _rate(few) - _rate(crowd)
        found.append(_goal("1,000 unrelated motions: loss of success", "≤ 2 points",
                           f"{100 * loss:.1f} points", loss <= 0.02))  # fmt: skip
        for name in ("step_median_ms", "step_recall_median_ms"):
            what = "a step with a recall" if "recall" in name else "a step under touch"
            found.append(_goal(f"1,000 unrelated motions: {what}, median", "≤ 1 ms",
                               f"{crowd[name]:.2f} ms", crowd[name] <= 1.0))  # fmt: skip
    return found


def goal_table(reached: list[Goal]) -> str:
    """One Markdown line a goal."""
    lines = ["| what | should be | is | reached |", "|---|---|---|---|"]
    for goal in reached:
        yes = "yes" if goal["reached"] else "**no**"
        lines.append(f"| {goal['what']} | {goal['should']} | {goal['is']} | {yes} |")
    return "\n".join(lines)


def _goal(what: str, should: str, measured: float | str, reached: bool) -> Goal:
    told = measured if isinstance(measured, str) else f"{measured:.1%}"
    return {"what": what, "should": should, "is": told, "reached": bool(reached)}


def _rate(figures: dict[str, Any]) -> float:
    return float(figures["successes"] / figures["rollouts"])


def _together(points: list[dict[str, Any]]) -> float:
    """Success rate over the rollouts of both experiments."""
    won, made = (sum(point[name] for point in points) for name in ("successes", "rollouts"))
    return float(won / made)


def _point(
    curves: list[dict[str, Any]], who: str, condition: str, level: float, experiment: str
) -> dict[str, Any]:
    """A point of a curve; empty where it is not finished."""
    wanted = (who, condition, level, experiment)
    names = ("contestant", "condition", "level", "experiment")
    return next((p for p in curves if tuple(p[name] for name in names) == wanted), {})
