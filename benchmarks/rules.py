"""Each rule and constant of the way from skin to motion switched off, or set otherwise, alone.

The same demonstrations and pushes as ``benchmarks/yield_controls.py``, 40 demonstrations, default
settings chosen by held-out prediction anew for every row.

    python -m benchmarks.rules            # some minutes
    python -m benchmarks.rules --quick=true
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.machine import RESULTS, print_machine, save_json
from benchmarks.yield_controls import interval, pick, share
from hasm_torch.apps.command_line import parse_options
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.evaluation import along_force, yielding
from hasm_torch.evaluation.runner import Runner
from hasm_torch.model.hasm import HASM
from hasm_torch.sim.tasks import ARM_JOINTS

PAPER_CODE = HASMConfig(code="binary", bits=4, width=1.0)
CONFIGS = {
    "default": HASMConfig(),
    "F ranked by the place code": HASMConfig(ranks="place"),
    "tuning width 1 spacing": HASMConfig(width=1.0),
    "binary codes, 4 bits, width 1": PAPER_CODE,
    "all five arm joints coded": HASMConfig(joints=list(ARM_JOINTS)),
    "displacement of 1 sample": HASMConfig(horizon=1),
    "displacement of 25 samples": HASMConfig(horizon=25),
    "force of one sample": HASMConfig(force_window_s=0.02),
    "measured instead of commanded positions": HASMConfig(pattern="state"),
}


def no_body_keys(body: Body) -> Body:
    """Touches on the wrist and on the torso told apart by their direction alone."""
    return replace(body, groups=[0] * len(body.patches))


def density_as_it_is(model: HASM) -> None:
    """ρ of a touch beyond what was taught is not brought back."""
    assert model.settled is not None
    model.settled.density = [0.0, 1.0]


def no_tether(model: HASM) -> None:
    """The reference may run away from joints that are held up."""
    model.tolerance.fill_(1e6)


TWEAKS: dict[str, Callable[[HASM], None]] = {
    "ρ of unseen forces as it is": density_as_it_is,
    "reference not kept near the joints": no_tether,
}


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        episodes: Demonstrations at the wrist.
        seeds: Seeds of the cases and of which demonstrations are learned.
        pushes: Cases a seed.
        datasets: Folder of the bundled datasets.
        quick: One seed and few pushes.
        output_dir: Where ``rules.json`` goes.
    """

    episodes: int = 40
    seeds: list[int] = field(default_factory=lambda: [1])
    pushes: int = 60
    datasets: Path = Path("datasets")
    quick: bool = False
    output_dir: Path = RESULTS

    def __post_init__(self) -> None:
        if self.quick:
            self.seeds, self.pushes = self.seeds[:1], min(self.pushes, 6)


def run(options: Options) -> dict[str, dict[str, object]]:
    """Teach and push the default and each variant; their figures by name."""
    data = load_episodes(options.datasets / "hsr_yield")
    cases = {seed: yielding.cases(options.pushes, seed) for seed in options.seeds}
    names = [*CONFIGS, *TWEAKS, "no key a rigid body"]
    rolled: dict[str, list] = {name: [] for name in ["teacher", *names]}
    with closing(Runner()) as runner, TemporaryDirectory() as scratch:
        for seed, planned in cases.items():
            rolled["teacher"] += runner.start("yield", planned, None)
            some = pick(data, options.episodes, seed)
            for name in names:
                body = body_of(some)
                if name not in CONFIGS and name not in TWEAKS:
                    body = no_body_keys(body)
                model = HASM(CONFIGS.get(name, HASMConfig()), body)
                model.fit(some)
                TWEAKS.get(name, lambda _: None)(model)
                folder = Path(scratch) / f"{seed}-{name}"
                model.save_pretrained(folder)
                rolled[name] += runner.start("yield", planned, folder)
        motions = {n: [f.result()[1]["motion"] for f in found] for n, found in rolled.items()}
    teacher = motions.pop("teacher")
    law = torch.tensor([m.cos for m in teacher]).numpy()
    figures = {}
    for name, mine in motions.items():
        cosines = torch.tensor([m.cos for m in mine]).numpy()
        figures[name] = along_force.summarise(mine, teacher) | {
            "share_07_of_teacher_interval": interval(share, cosines, law)
        }
    return figures


def main() -> None:
    """Measure, print a table, write the results."""
    options = parse_options(Options)
    torch.set_num_threads(1)
    print_machine()
    figures = run(options)
    for name, found in figures.items():
        print(f"{name:<42}{found['share_07_of_teacher']:8.3f}{found['travel_of_teacher']:8.2f}")
    if not options.quick:
        asked = {"episodes": options.episodes, "seeds": options.seeds, "pushes": options.pushes}
        save_json(options.output_dir, "rules", {"options": asked, "variants": figures})


if __name__ == "__main__":
    main()
