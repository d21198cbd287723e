"""What each rule of the skin filter is worth, fault by fault.

The default model is rolled out with a damaged skin: without the filter, with all of it, and with
each rule alone switched off. Yield pushes are judged by the share within 45° of the force and the
way along it, compliance by the share of the rollouts in which the right joint moves the right way
and all others stay.

    uv run benchmarks/skin_filter.py    # a quarter of an hour of one core
"""

from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks.baselines.contestants import FILTER
from benchmarks.baselines.faults import Fault, Faulty
from benchmarks.machine import RESULTS, print_machine, save_json
from hasm_torch.apps.command_line import parse_options
from hasm_torch.config import HASMConfig
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.encoders.skin_filter import RULES, SkinFilter
from hasm_torch.evaluation import along_force, compliance, yielding
from hasm_torch.evaluation.filtered import Filtered
from hasm_torch.evaluation.rollout import Policy
from hasm_torch.evaluation.runner import Runner
from hasm_torch.model.hasm import HASM

LEVELS = {"lost": (0.3, 0.5), "noise": (0.1, 0.5, 2.0), "offset": (0.2, 0.5), "stuck": (0.5, 1.0),
          "dead": (0.3, 0.5)}  # fmt: skip
FAULTS = {f"{kind} {level:g}": (kind, level) for kind, levels in LEVELS.items() for level in levels}
VARIANTS = ("no filter", "whole", *(f"without {rule}" for rule in RULES))


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        faults: Of ``FAULTS``, and "none".
        pushes: Yield pushes a cell.
        rollouts: Evenly pressed compliance rollouts of each behaviour a cell.
        seed: Seed of the cases.
        datasets: Folder of the bundled datasets.
        output_dir: Where ``skin_filter.json`` goes.
    """

    faults: list[str] = field(default_factory=lambda: ["none", *FAULTS])
    pushes: int = 10
    rollouts: int = 2
    seed: int = 1
    datasets: Path = Path("datasets")
    output_dir: Path = RESULTS


def load(directory: str) -> Policy:
    """A model with a damaged skin and a filter, by <model>/<fault>/<variant>."""
    path = Path(directory)
    fault, variant, checkpoint = path.parent.name, path.name, path.parents[1]
    policy: Policy = HASM.from_pretrained(checkpoint)
    if variant != "no filter":
        whole = torch.load(checkpoint / FILTER, weights_only=False)
        left_out = [rule for rule in RULES if variant == f"without {rule}"]
        policy = Filtered(policy, SkinFilter(whole.cells, whole.rate, whole.footprint, left_out))
    if fault == "none":
        return policy
    kind, level = FAULTS[fault]
    return Faulty(policy, Fault(kind, level))  # type: ignore[arg-type]


def run(options: Options) -> dict[str, Any]:
    """Figures by fault and variant."""
    cases: dict[str, Any] = {
        "yield": [case.without_rest() for case in yielding.cases(options.pushes, options.seed)],
        "compliance": compliance.cases(options.rollouts, options.seed),
    }
    started: dict[tuple[str, str, str], Any] = {}
    with TemporaryDirectory() as scratch, closing(Runner(load)) as runner:
        law = runner.start("yield", cases["yield"], None)
        for experiment, planned in cases.items():
            data = load_episodes(options.datasets / f"hsr_{experiment}")
            body, folder = body_of(data), Path(scratch) / experiment
            model = HASM(HASMConfig(), body)
            model.fit(data)
            model.save_pretrained(folder)
            torch.save(SkinFilter.learn(body, data), folder / FILTER)
            for fault in options.faults:
                for variant in VARIANTS:
                    futures = runner.start(experiment, planned, folder / fault / variant)
                    started[fault, variant, experiment] = futures
        found = {key: [future.result()[1] for future in some] for key, some in started.items()}
        teacher = [future.result()[1]["motion"] for future in law]
    return {
        fault: {
            variant: {
                "yield": along_force.summarise(
                    [f["motion"] for f in found[fault, variant, "yield"]], teacher
                ),
                "compliance": succeeded(found[fault, variant, "compliance"]),
            }
            for variant in VARIANTS
        }
        for fault in options.faults
    }


def succeeded(figures: list[dict[str, Any]]) -> dict[str, float]:
    """Share of the rollouts that succeeded, and the median way of the touched joint, rad."""
    return {
        "success": float(np.mean([compliance.succeeded(f) for f in figures])),
        "displacement": float(np.median([f["displacement"] for f in figures])),
    }


def main() -> None:
    """Measure and write the results."""
    options = parse_options(Options)
    torch.set_num_threads(1)
    print_machine()
    asked = {name: getattr(options, name) for name in ("pushes", "rollouts", "seed")}
    print(save_json(options.output_dir, "skin_filter", {"options": asked, "faults": run(options)}))


if __name__ == "__main__":
    main()
