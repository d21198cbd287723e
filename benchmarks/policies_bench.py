"""What ``benchmarks.policies`` does for one cell of its plan: train, roll out, measure."""

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from benchmarks.baselines.contestants import Trained, train
from benchmarks.baselines.faults import Fault, FaultySkin, Kind
from hasm_torch.config import Body
from hasm_torch.evaluation import compliance, grasp
from hasm_torch.evaluation.rollout import Policy
from hasm_torch.evaluation.runner import EXPERIMENTS, make_env, run_case
from hasm_torch.lerobot.body import body_of
from hasm_torch.lerobot.episodes import Episode, load_episodes
from hasm_torch.lerobot.human_env import MOVED, STAYED

START_NOISE = 0.05  # rad, where it is not varied
OBJECT_NOISE, PAUSES = 0.01, 3
TIMED_STEPS = 300


@dataclass(frozen=True)
class Cell:
    """One contestant under one condition, rolled out in one or both experiments.

    Attributes:
        contestant: Who.
        condition: "none" in the table; in the curves "unharmed", a fault of the skin,
            "start_noise" or "demonstrations".
        level: How much of it.
        seed: Seed of rollouts, faults and the choice of demonstrations.
        behaviour_rollouts: Evenly pressed compliance rollouts a behaviour; 0 makes none.
        grasps: Grasps; 0 makes none.
    """

    contestant: str
    condition: str
    level: float
    seed: int
    behaviour_rollouts: int
    grasps: int

    @property
    def key(self) -> str:
        """Tells a finished cell; cells of other sizes and versions are others."""
        return json.dumps([version("hasm-torch"), *vars(self).values()])


class Bench:
    """Datasets, environments and trained contestants, each made once.

    Args:
        datasets: Folder of the bundled datasets.
    """

    def __init__(self, datasets: Path) -> None:
        self.episodes: dict[str, list[Episode]] = {}
        self.body: dict[str, Body] = {}
        self.env: dict[str, Any] = {}
        for experiment in EXPERIMENTS:
            data = load_episodes(datasets / f"hsr_{experiment}")
            self.episodes[experiment], self.body[experiment] = data.episodes, body_of(data)
            self.env[experiment] = make_env(experiment)
        self.trained = cache(self._train)
        train("default", "compliance", self.body["compliance"], self.episodes["compliance"][:1])

    def close(self) -> None:
        """Close the environments."""
        for env in self.env.values():
            env.close()

    def run(self, cell: Cell) -> dict[str, Any]:
        """Train (or take up) a contestant and roll it out.

        Returns:
            For each experiment its figures; ``successes`` of ``rollouts`` among them.
        """
        return {
            experiment: self._run(cell, experiment)
            for experiment, number in zip(EXPERIMENTS, (cell.behaviour_rollouts, cell.grasps))
            if number
        }

    def _run(self, cell: Cell, experiment: str) -> dict[str, Any]:
        picked = tuple(range(len(self.episodes[experiment])))
        if cell.condition == "demonstrations":
            picked = some_episodes(self.episodes[experiment], int(cell.level), cell.seed)
        trained = self.trained(cell.contestant, experiment, picked)
        policy: Policy = trained.policy
        if cell.condition in get_args(Kind):
            fault = Fault(cell.condition, cell.level)  # type: ignore[arg-type]  # it checks
            policy = FaultySkin(policy, fault, np.random.default_rng(cell.seed))
        planned = plan(cell, experiment)
        figures = [run_case(experiment, c, self.env[experiment], policy)[1] for c in planned]
        if experiment == "compliance":
            summary = compliance.summarise(planned, figures)
            for behaviour in summary["behaviours"].values():
                del behaviour["velocities"]
            won = [f["displacement"] > MOVED and f["others"] < STAYED for f in figures]
        else:
            summary = grasp.summarise(figures)
            del summary["results"]
            won = [f["success"] for f in figures]
        return summary | {
            "successes": sum(won),
            "rollouts": len(won),
            "train_seconds": trained.seconds,
            "memory_bytes": trained.policy.memory_bytes(),
            "step_ms": step_ms(trained.policy, self.body[experiment]),
            "notes": trained.notes,
        }

    def _train(self, contestant: str, experiment: str, picked: tuple[int, ...]) -> Trained:
        episodes = [self.episodes[experiment][i] for i in picked]
        return train(contestant, experiment, self.body[experiment], episodes)


def plan(cell: Cell, experiment: str) -> list[Any]:
    """The rollouts of a cell."""
    if experiment == "compliance":
        return compliance.cases(cell.behaviour_rollouts, [], cell.seed)
    noise = cell.level if cell.condition == "start_noise" else START_NOISE
    return grasp.cases(cell.grasps, [], cell.seed, PAUSES, noise, OBJECT_NOISE)


def some_episodes(episodes: Sequence[Episode], number: int, seed: int) -> tuple[int, ...]:
    """So many episodes of each behaviour, drawn."""
    rng = np.random.default_rng(seed)
    tasks: dict[str, list[int]] = {}
    for i, episode in enumerate(episodes):
        tasks.setdefault(episode.task, []).append(i)
    drawn = [rng.choice(mine, min(number, len(mine)), replace=False) for mine in tasks.values()]
    return tuple(sorted(int(i) for i in np.concatenate(drawn)))


def step_ms(policy: Policy, body: Body) -> float:
    """Median time of a control step under a touch of 8 N at the first patch, ms."""
    state = (torch.tensor(body.lower) + torch.tensor(body.upper)) / 2
    skin = torch.zeros(sum(body.cells), 3)
    skin[3] = 8.0 / 3
    policy.reset()
    spent = []
    for _ in range(TIMED_STEPS):
        begin = time.perf_counter()
        state = policy.step(state, skin)
        spent.append(1e3 * (time.perf_counter() - begin))
    policy.reset()
    return statistics.median(spent)
