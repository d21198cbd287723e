"""Write the README's result tables from evaluations, so that no number is typed by hand.

uv run eval.py --render=false --output_dir=outputs/eval/default
uv run eval.py --render=false --method=literal --output_dir=outputs/eval/literal
uv run python -m benchmarks.readme_tables
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus

from hasm_torch.evaluation.report import COMPLIANCE_FIGURES, GRASP_FIGURES, table


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        default: Evaluation of the default method.
        literal: Evaluation of the paper as written.
        readme: File whose tables are replaced.
    """

    default: Path = Path("outputs/eval/default")
    literal: Path = Path("outputs/eval/literal")
    readme: Path = Path("README.md")


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
    text = options.readme.read_text()
    printed = "```\n" + re.sub(r" +$", "", table(default), flags=re.M) + "\n```"
    for name, content in (("default", printed), ("literal", comparison(default, literal))):
        before, _, rest = text.partition(f"<!-- table:{name} -->\n")
        _, end, after = rest.partition(f"<!-- /table:{name} -->")
        text = f"{before}<!-- table:{name} -->\n{content}\n{end}{after}"
    options.readme.write_text(text)


if __name__ == "__main__":
    main()
