"""Write the result tables of README.md and docs/ from results, so that no number is typed by hand.

A table stands between <!-- table:NAME --> and <!-- /table:NAME --> in any of these pages; what it
is made of lies in benchmarks/results/:

    uv run eval.py --render=false --output_dir=outputs/eval/default
    uv run eval.py --render=false --method=literal --output_dir=outputs/eval/literal
    cp outputs/eval/default/metrics.json benchmarks/results/eval_default.json
    cp outputs/eval/literal/metrics.json benchmarks/results/eval_literal.json
    uv run eval.py --mode=open_loop --dataset.root=FOLDER  # open_loop.json → open_loop_icub.json
    uv run eval.py --mode=open_loop --dataset.root=OTHER   # open_loop.json → open_loop_g1.json
    uv run examples/teach_in_two_minutes.py                # → teach_in_two_minutes.json
    uv run benchmarks/yield_controls.py                    # → yield_controls.json
    uv run benchmarks/rules.py                             # → rules.json
    uv run benchmarks/skin_filter.py                       # → skin_filter.json
    uv run examples/skin_on_another_robot.py               # → another_robot.json
    uv run benchmarks/recall.py --quick=true               # recall.json → recall.json
    uv run benchmarks/izhikevich.py                        # izhikevich.json → izhikevich.json
    uv run benchmarks/readme_tables.py
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.machine import RESULTS
from hasm_torch.apps.command_line import parse_options
from hasm_torch.evaluation.report import (
    COMPLIANCE_FIGURES,
    GRASP_FIGURES,
    GRASP_MOVED,
    YIELD_SHARES,
    table,
)

MARKED = re.compile(r"(<!-- table:(\w+) -->\n)(.*?)(<!-- /table:\2 -->)", re.DOTALL)
OPEN_LOOP = {"hasm": "memory", "neighbours": "tuned neighbours", "ridge": "ridge on lags"}
ROBOTS = {"open_loop_icub": "iCub", "open_loop_g1": "G1"}

RECALLS = {
    "hasm_torch packed": "packed",
    "torch float32": "torch float32",
    "torch bfloat16": "torch bfloat16",
    "torch SDPA": "SDPA",
}

Rows = Sequence[Sequence[str]]


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        results: Folder of the results.
        root: Folder of README.md and docs/.
    """

    results: Path = RESULTS
    root: Path = Path()


def markdown(header: Sequence[str], rows: Rows) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def default(evaluated: dict[str, Any]) -> str:
    """What an evaluation prints."""
    return "```\n" + re.sub(r" +$", "", table(evaluated), flags=re.MULTILINE) + "\n```"


def literal(*both: dict[str, Any]) -> str:
    """Figures of the default and of the paper as written; of behaviours each figure's worst."""
    rows = []
    for key, goal, more in COMPLIANCE_FIGURES:
        behaviours = [m["compliance"]["behaviours"].values() for m in both]
        worst = [(min if more else max)(b[key] for b in found if key in b) for found in behaviours]
        rows.append(_row(f"compliance, the worst: `{key}`", goal, more, worst))
    for size, goal in YIELD_SHARES.items():
        key = "share_07_of_teacher"
        shares = [m["yield"]["episodes"][size][key] for m in both]
        rows.append(_row(f"yield, {size} episodes: `{key}`", goal, True, shares))
    for key, goal, more in GRASP_FIGURES:
        rows.append(_row(f"grasp: `{key}`", goal, more, [m["grasp"][key] for m in both]))
    for reach, goal in GRASP_MOVED.items():
        moved = [m["grasp"]["moved"][reach] for m in both]
        rows.append(_row(f"grasp, moved by up to {reach} m", goal, True, moved))
    parts = [(m["compliance"], m["yield"], m["yield"]["torso"], m["grasp"]) for m in both]
    violations = [sum(part["limit_violations"] for part in mine) for mine in parts]
    rows.append(_row("`limit_violations`", 0, False, violations))
    rows.append(_row("`train_seconds`", 5, False, [m["train_seconds"] for m in both]))
    rows.append(_row("`memory_bytes`", 1_000_000, False, [m["memory_bytes"] for m in both]))
    ticks = [m["tick_ms"]["median"] for m in both]
    rows.append(_row("`tick_ms`, median", 0.35, False, ticks))
    return markdown(("figure", "must reach", "default", "literal"), rows)


def yielding(evaluated: dict[str, Any]) -> str:
    """Yielding by number of demonstrations."""
    keys = ("share_07_of_teacher", "cos_median", "against", "travel_of_teacher")
    rows = [
        [size, *(_shown(figures[key]) for key in keys)]
        for size, figures in evaluated["yield"]["episodes"].items()
    ]
    return markdown(("episodes", *(f"`{key}`" for key in keys)), rows)


def open_loop(*reports: dict[str, Any]) -> str:
    """Errors of open-loop prediction, relative to standing still."""
    rows = [
        [robot, f"{part['seconds_ahead']:.2g} s", *(_shown(part[who]) for who in OPEN_LOOP)]
        for robot, report in zip(ROBOTS.values(), reports)
        for part in (report["one_step"], report["horizon"])
    ]
    return markdown(("robot", "ahead", *OPEN_LOOP.values()), rows)


def controls(measured: dict[str, Any]) -> str:
    """Yielding of the memory's variants, by number of demonstrations, with 95 % intervals."""
    sizes = measured["sizes"]
    rows = [
        [name, *(_interval(found[name]) for found in sizes.values())]
        for name in next(iter(sizes.values()))
    ]
    return markdown(("`share_07_of_teacher`", *(f"{size} episodes" for size in sizes)), rows)


def rules(measured: dict[str, Any]) -> str:
    """Yielding with each rule or constant changed alone, with 95 % intervals."""
    rows = [
        [name, _interval(found), _shown(found["travel_of_teacher"])]
        for name, found in measured["variants"].items()
    ]
    return markdown(("changed", "`share_07_of_teacher`", "`travel_of_teacher`"), rows)


def teach(*sessions: dict[str, Any]) -> str:
    """What sessions of teaching by hand came to, a column each."""
    rows = [
        ["pushes shown", *(_shown(found["pushes"]) for found in sessions)],
        ["lessons", *(_shown(found["lessons"]) for found in sessions)],
        ["time of teaching", *(f"{found['taught_s']:.0f} s" for found in sessions)],
        ["time of learning, all lessons", *(f"{found['learned_s']:.2f} s" for found in sessions)],
        [
            "unseen pushes with cos > 0.7, of the hand's own",
            *_shares_taught(sessions, "memory"),
        ],
        *(
            [f"the same, {name}", *_shares_taught(sessions, name)]
            for name in sessions[0]["tested"]
            if name != "memory"
        ),
        [
            "weight of a lesson in its own posture, before and after forgetting it",
            *(
                f"{found['forgotten']['weight_before']:.2f}, "
                f"{found['forgotten']['weight_after']:.2f}"
                for found in sessions
            ),
        ],
        [
            "a grasp shown once: lifted from other starts",
            *(f"{found['grasp']['lifted']} of {found['grasp']['starts']}" for found in sessions),
        ],
    ]
    return markdown(("", "lessons of a dozen pushes", "single pushes"), rows)


def _shares_taught(sessions: Sequence[dict[str, Any]], name: str) -> list[str]:
    return [f"{found['tested'][name]['share_07_of_teacher']:.0%}" for found in sessions]


def skin_filter(measured: dict[str, Any]) -> str:
    """Share, way and compliance with a damaged skin, without and with the filter."""

    def shown(found: dict[str, Any]) -> str:
        pushed = found["yield"]
        figures = pushed["share_07_of_teacher"], pushed["travel_of_teacher"]
        return ", ".join(f"{x:.2f}" for x in (*figures, found["compliance"]["success"]))

    rows = []
    for fault, found in measured["faults"].items():
        own = found.get(f"without {fault.split()[0]}")
        cells = [shown(found["no filter"]), shown(found["whole"]), shown(own) if own else ""]
        rows.append([fault, *cells])
    return markdown(("fault", "no filter", "filter", "filter without its rule"), rows)


def another_robot(measured: dict[str, Any]) -> str:
    """Yielding of a robot that the code was not written for."""
    rows = [
        [
            name,
            f"{found['share_07_of_teacher']:.2f}",
            f"{round(found['travel_of_teacher'], 2) + 0:.2f}",
        ]
        for name, found in measured["tested"].items()
    ]
    return markdown(("", "`share_07_of_teacher`", "`travel_of_teacher`"), rows)


def recall(measured: dict[str, Any]) -> str:
    """Times of a recall, a row a size, a column a contestant."""
    times: dict[tuple[int, int, int], dict[str, float]] = {}
    for found in measured["results"]:
        size = found["rows"], found["dim"], found["batch"]
        times.setdefault(size, {})[found["contestant"]] = found["seconds"]
    rows = [
        [
            f"{count:,} x {dim}, {batch:,}",
            *(f"{_shown(1e3 * mine[who])} ms" if who in mine else "" for who in RECALLS),
        ]
        for (count, dim, batch), mine in times.items()
    ]
    return markdown(("associations x entries, queries", *RECALLS.values()), rows)


def izhikevich(measured: dict[str, Any]) -> str:
    """Times of the neurons beside another library's."""
    rows = [
        [
            f"{name}, {found['neurons']:,} x {found['steps']:,}",
            *(f"{_shown(1e3 * found['median_s'][who])} ms" for who in ("ours", "norse")),
            _shown(found["ratio"]),
        ]
        for name, found in measured["work"].items()
    ]
    return markdown(("neurons x steps", "hasm_torch", "norse", "ratio"), rows)


def resources(evaluated: dict[str, Any]) -> str:
    """What learning, the memory and a control step take."""
    tick = evaluated["tick_ms"]
    rows = [
        ["learning, s", "≤ 5", _shown(evaluated["train_seconds"])],
        ["memory, bytes", "≤ 1,000,000", _shown(evaluated["memory_bytes"])],
        ["control step, median, ms", "≤ 0.35", _shown(tick["median"])],
        ["control step, 99 of 100, ms", "", _shown(tick["p99"])],
    ]
    return markdown(("", "should be", "measured"), rows)


# What each table is made of, in the order of its arguments.
TABLES: dict[str, tuple[Callable[..., str], tuple[str, ...]]] = {
    "default": (default, ("eval_default",)),
    "literal": (literal, ("eval_default", "eval_literal")),
    "yield": (yielding, ("eval_default",)),
    "open_loop": (open_loop, tuple(ROBOTS)),
    "controls": (controls, ("yield_controls",)),
    "rules": (rules, ("rules",)),
    "skin_filter": (skin_filter, ("skin_filter",)),
    "another_robot": (another_robot, ("another_robot",)),
    "recall": (recall, ("recall",)),
    "izhikevich": (izhikevich, ("izhikevich",)),
    "resources": (resources, ("eval_default",)),
    "teach": (teach, ("teach_in_two_minutes", "teach_single_pushes")),
}


def write(results: Path, root: Path) -> list[str]:
    """Replace what stands between the markers of all pages.

    Args:
        results: Folder of the results.
        root: Folder of README.md and docs/.

    Returns:
        What was done to each table, a line each. A table whose results are not there stays.
    """
    done = []
    for page in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        text = page.read_text()

        def replaced(match: re.Match[str], page: Path = page) -> str:
            begin, name, _, end = match.groups()
            if name not in TABLES:
                done.append(f"{page}: no table {name!r}, valid: {', '.join(TABLES)}")
                return match[0]
            make, sources = TABLES[name]
            paths = [results / f"{source}.json" for source in sources]
            missing = [str(path) for path in paths if not path.exists()]
            if missing:
                done.append(f"{page}: {name} stays as it is without {', '.join(missing)}")
                return match[0]
            done.append(f"{page}: {name}")
            return f"{begin}{make(*(json.loads(path.read_text()) for path in paths))}\n{end}"

        written = MARKED.sub(replaced, text)
        if written != text:
            page.write_text(written)
    return done


def _row(name: str, goal: float, more: bool, values: Sequence[float | None]) -> list[str]:
    return [name, f"{'≥' if more else '≤'} {goal:,}", *(_shown(value) for value in values)]


def _interval(figures: dict[str, Any]) -> str:
    low, high = figures["share_07_of_teacher_interval"]
    return f"{figures['share_07_of_teacher']:.2f} ({low:.2f} to {high:.2f})"


def _shown(value: float | None) -> str:
    if value is None:
        return "none"
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def main() -> None:
    """Write all tables."""
    options = parse_options(Options)
    print(*write(options.results, options.root), sep="\n")


if __name__ == "__main__":
    main()
