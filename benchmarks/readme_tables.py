"""Write the README's result tables from evaluations, so that no number is typed by hand.

uv run eval.py --render=false --output_dir=outputs/eval/default
uv run eval.py --render=false --method=literal --output_dir=outputs/eval/literal
uv run benchmarks/policies.py
uv run python -m benchmarks.readme_tables
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus

from benchmarks.machine import RESULTS
from benchmarks.policies_report import goal_table
from hasm_torch.evaluation.report import COMPLIANCE_FIGURES, GRASP_FIGURES, table


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        default: Evaluation of the default method.
        literal: Evaluation of the paper as written.
        policies: What ``benchmarks/policies.py`` wrote.
        readme: File whose tables are replaced.
    """

    default: Path = Path("outputs/eval/default")
    literal: Path = Path("outputs/eval/literal")
    policies: Path = RESULTS / "policies.json"
    readme: Path = Path("README.md")


# Contestants of the README's table; the full one is what the benchmark prints.
SHOWN = (
    "default",
    "the paper literally",
    "without spikes",
    "every sample stored",
    "touch in the base frame",
    "real-valued codes",
    "binary, 4 bits",
    "gray, 8 bits",
    "one shared memory",
    "one shared memory without RoPE3D",
    "standing still",
    "nearest neighbours",
    "nearest neighbours, tuned",
    "dense associative memory",
    "ACT",
    "Diffusion",
)


def contestants(entries: list[dict[str, Any]]) -> str:
    """A Markdown table of contestants; costs are those of both experiments together."""
    lines = [
        "| contestant | compliance | grasp | force order | training | kept | control step |",
        "|---|---|---|---|---|---|---|",
    ]
    found = {entry["contestant"]: entry["results"] for entry in entries}
    for name in SHOWN:
        if name not in found:
            continue
        both = yielding, grasping = found[name]["compliance"], found[name]["grasp"]
        order = min(b["spearman"] for b in yielding["behaviours"].values())
        cells = [
            name,
            *(f"{result['successes']}/{result['rollouts']}" for result in both),
            f"{order:.2f}",
            f"{sum(result['train_seconds'] for result in both):.1f} s",
            f"{sum(result['memory_bytes'] for result in both) / 1e3:,.0f} kB",
            f"{max(yielding['step_ms'], grasping['step_ms']):.2f} ms",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def comparison(default: dict[str, Any], literal: dict[str, Any]) -> str:
    """A Markdown table of both; of the four behaviours each figure's worst."""
    lines = ["| figure | must reach | default | literal |", "|---|---|---|---|"]
    for key, goal, more in COMPLIANCE_FIGURES:
        worst = [
            (min if more else max)(b[key] for b in m["compliance"]["behaviours"].values())
            for m in (default, literal)
        ]
        lines.append(_row(f"compliance, worst of 4: `{key}`", goal, more, worst))
    for key, goal, more in GRASP_FIGURES:
        lines.append(
            _row(f"grasp: `{key}`", goal, more, [m["grasp"][key] for m in (default, literal)])
        )
    violations = [
        m["compliance"]["limit_violations"] + m["grasp"]["limit_violations"]
        for m in (default, literal)
    ]
    lines.append(_row("`limit_violations`", 0, False, violations))
    for key, goal in (("train_seconds", 5), ("memory_bytes", 1_000_000)):
        lines.append(_row(f"`{key}`", goal, False, [m[key] for m in (default, literal)]))
    ticks = [m["tick_ms"]["median"] for m in (default, literal)]
    lines.append(_row("`tick_ms`, median", 1, False, ticks))
    return "\n".join(lines)


def _row(name: str, goal: float, more: bool, values: list[float]) -> str:
    shown = [f"{v:,}" if isinstance(v, int) else f"{v:.3g}" for v in values]
    return f"| {name} | {'≥' if more else '≤'} {goal:,} | {' | '.join(shown)} |"


def main() -> None:
    """Replace the tables between the README's markers."""
    options = draccus.parse(config_class=Options)
    default, literal = (
        json.loads((folder / "metrics.json").read_text())
        for folder in (options.default, options.literal)
    )
    policies = json.loads(options.policies.read_text())
    text = options.readme.read_text()
    printed = "```\n" + re.sub(r" +$", "", table(default), flags=re.M) + "\n```"
    tables = {
        "default": printed,
        "literal": comparison(default, literal),
        "contestants": contestants(policies["contestants"]),
        "goals": goal_table(policies["goals"]),
    }
    for name, content in tables.items():
        before, _, rest = text.partition(f"<!-- table:{name} -->\n")
        _, end, after = rest.partition(f"<!-- /table:{name} -->")
        text = f"{before}<!-- table:{name} -->\n{content}\n{end}{after}"
    options.readme.write_text(text)


if __name__ == "__main__":
    main()
