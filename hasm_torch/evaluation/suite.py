"""What an evaluation rolls out: which cases by which policy, and the figures of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hasm_torch.evaluation import compliance, grasp, teaching, yielding
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.evaluation.rollout import Case
from hasm_torch.sim.tasks import FAR, NEAR

SIZES = (5, 10, 20, 40, 80)  # demonstrations at the wrist, of the curve
# Largest displacements of moved objects, m, and which demonstrations the model learns.
MOVED = {0.02: teaching.near_places, NEAR: teaching.near_places, FAR: teaching.far_places}
ROLLOUTS = {
    "compliance": 16,
    "yield": 60,
    "unseen_patch": 24,
    "torso": 20,
    "grasp": 20,
    "moved": 12,
}


@dataclass(frozen=True)
class Group:
    """Rollouts by one policy.

    Attributes:
        name: The experiment, of the model that is judged; "<experiment>/teacher", of the
            demonstrator's law on the same cases; "<experiment>/<what>", of further ones.
        cases: What is done.
        learns: Demonstrations that a model of its own learns; None is the model that is judged.
    """

    name: str
    cases: Sequence[Case]
    learns: teaching.Choice | None = None

    @property
    def experiment(self) -> str:
        """One of ``EXPERIMENTS``."""
        return self.name.partition("/")[0]

    @property
    def taught(self) -> bool:
        """Whether the demonstrator's own law answers."""
        return self.name.endswith("/teacher")


def plan(config: EvalConfig) -> list[Group]:
    """Everything that is rolled out, first what needs no further model."""

    def count(group: str) -> int:
        return ROLLOUTS[group] if config.rollouts is None else config.rollouts

    drawn, groups = (config.seed, config.forces), []
    if "compliance" in config.experiments:
        touches = compliance.cases(count("compliance"), *drawn)
        groups.append(Group("compliance", touches))
        groups.append(Group("compliance/teacher", compliance.led(touches)))
    if "yield" in config.experiments:
        pushes = yielding.cases(count("yield"), *drawn)
        torso = yielding.torso_cases(count("torso"), *drawn)
        unseen = yielding.cases(count("unseen_patch"), *drawn, ("even",), teaching.UNSEEN)
        brief = [case.without_rest() for case in pushes]
        groups.append(Group("yield", pushes))
        groups.append(Group("yield/teacher", brief))
        groups.append(Group("yield/torso", torso))
        groups.append(Group("yield/torso/teacher", torso))
        groups.append(Group("yield/unseen_patch/teacher", unseen))
        for size in sizes(config):
            groups.append(Group(f"yield/{size}", brief, teaching.wrist_and_torso(size)))
        shown = teaching.wrist_and_torso(config.episodes, teaching.UNSEEN)
        groups.append(Group("yield/unseen_patch", unseen, shown))
    if "grasp" in config.experiments:
        near = grasp.cases(
            count("grasp"), *drawn, config.object_noise, config.pauses, config.start_noise
        )
        groups.append(Group("grasp", near))
        for reach, choice in MOVED.items():
            moved = grasp.cases(count("moved"), *drawn, reach, 0, config.start_noise)
            groups.append(Group(f"grasp/moved_{reach:.2f}", moved, choice))
    if config.checkpoint is not None:  # nobody knows what it was taught
        groups = [g for g in groups if g.learns is None and "unseen" not in g.name]
    return sorted(groups, key=lambda group: group.learns is not None)


def sizes(config: EvalConfig) -> list[int]:
    """Demonstrations of the models of the curve, fewer than those of the model that is judged."""
    return [size for size in SIZES if size < config.episodes]


def summarise(
    config: EvalConfig,
    groups: Sequence[Group],
    found: Mapping[str, list[dict[str, Any]]],
) -> dict[str, Any]:
    """The figures of every experiment.

    Args:
        config: What was evaluated.
        groups: What ``plan`` made of it.
        found: What was measured of each case, by the name of its group.
    """
    metrics: dict[str, Any] = {}
    cases: dict[str, Any] = {group.name: group.cases for group in groups}
    if "compliance" in found:
        metrics["compliance"] = compliance.summarise(
            cases["compliance"], found["compliance"], found["compliance/teacher"]
        )
    if "yield" in found:
        teacher = found["yield/teacher"]
        mine = yielding.summarise(cases["yield"], found["yield"], teacher)
        if config.checkpoint is None:
            curve = {str(size): found[f"yield/{size}"] for size in sizes(config)}
            curve[str(config.episodes)] = found["yield"]
            mine["episodes"] = {n: yielding.along(f, teacher) for n, f in curve.items()}
            name = "yield/unseen_patch"
            mine["unseen_patch"] = {
                "patches": list(teaching.UNSEEN),
                **yielding.along(found[name], found[f"{name}/teacher"]),
            }
        mine["torso"] = yielding.summarise_torso(found["yield/torso"], found["yield/torso/teacher"])
        metrics["yield"] = mine
    if "grasp" in found:
        moved = {
            f"{reach:.2f}": found[f"grasp/moved_{reach:.2f}"]
            for reach in MOVED
            if config.checkpoint is None
        }
        metrics["grasp"] = grasp.summarise(found["grasp"], moved)
    return metrics
