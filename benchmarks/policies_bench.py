"""What ``benchmarks.policies`` does for one cell of its plan: train, roll out, measure."""

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from benchmarks.baselines.contestants import Trained, train
from benchmarks.baselines.crowd import crowded
from benchmarks.baselines.crowd_measures import margin, step_times
from benchmarks.baselines.faults import Fault, FaultySkin, Kind
from benchmarks.baselines.learned_training import Training
from hasm_torch.body import Body
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import Episode, load_episodes
from hasm_torch.encoders.readings import pressed
from hasm_torch.evaluation import combined, compliance, grasp
from hasm_torch.evaluation.evaluate import TIMED_FORCE
from hasm_torch.evaluation.rollout import Array, Policy
from hasm_torch.evaluation.runner import EXPERIMENTS, make_env, run_case
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.sim.demonstrator import POSTURE, compliance_episodes, grasp_episodes
from hasm_torch.sim.poses import START_POSES

START_NOISE = 0.05  # rad, where it is not varied
OBJECT_NOISE, PAUSES = 0.01, 3
TIMED_STEPS = 300
# What few and many demonstrations are drawn from: ten episodes a behaviour.
POOL_FORCES = tuple(float(f) for f in np.linspace(3.0, 10.0, 10))  # N
POOL_SEED = 1
CROWD_LENGTH = 115  # samples of an unrelated motion; some 100 of them are states of their own


@dataclass(frozen=True)
class Cell:
    """One contestant under one condition, rolled out in one or both experiments.

    Attributes:
        contestant: Who.
        condition: "none" in the table; in the curves "unharmed" or one of
            ``benchmarks.policies_report.CONDITIONS``.
        level: How much of it.
        seed: Seed of rollouts, faults, unrelated motions and the choice of demonstrations.
        behaviour_rollouts: Evenly pressed compliance rollouts a behaviour (pairs of patches in
            "between"); 0 makes none.
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
        training: How networks are trained for the table; for the curves half as long.
    """

    def __init__(self, datasets: Path, training: Training) -> None:
        self.training = training
        self.episodes: dict[str, list[Episode]] = {}
        self.body: dict[str, Body] = {}
        self.env: dict[str, Any] = {}
        for experiment in EXPERIMENTS:
            data = load_episodes(datasets / f"hsr_{experiment}")
            self.episodes[experiment], self.body[experiment] = data.episodes, body_of(data)
            self.env[experiment] = make_env(experiment)
        self.trained = cache(self._train)
        self.pool = cache(_pool)
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
            picked = some_episodes(self.pool(experiment), int(cell.level), cell.seed)
        trained = self.trained(
            cell.contestant, experiment, picked, cell.condition == "demonstrations"
        )
        policy = trained.policy
        more: dict[str, Any] = {}
        if cell.condition == "crowding" and cell.level:
            policy, more = self._crowd(trained.policy, experiment, cell)
        rolled: Policy = policy
        if cell.condition in get_args(Kind):
            fault = Fault(cell.condition, cell.level)  # type: ignore[arg-type]  # it checks
            rolled = FaultySkin(policy, fault, np.random.default_rng(cell.seed))
        return {
            **self._roll_out(cell, experiment, rolled),
            "train_seconds": trained.seconds,
            "memory_bytes": policy.memory_bytes(),
            "step_ms": step_ms(policy, self.body[experiment]),
            "notes": trained.notes,
            **more,
        }

    def _roll_out(self, cell: Cell, experiment: str, policy: Policy) -> dict[str, Any]:
        """The figures of the rollouts, as ``eval.py`` computes them."""
        env = self.env[experiment]
        if cell.condition == "between":
            pairs = combined.cases(cell.behaviour_rollouts, cell.seed)
            figures = [combined.run_case(case, env, policy)[1] for case in pairs]
            won = [figure["success"] for figure in figures]
            return {**combined.summarise(figures), "successes": sum(won), "rollouts": len(won)}
        planned = plan(cell, experiment)
        starts = [start_of(cell, case, env) for case in planned]
        figures = [
            run_case(experiment, case, env, policy, start=start)[1]
            for case, start in zip(planned, starts)
        ]
        if experiment == "compliance":
            summary = compliance.summarise(planned, figures)
            for behaviour in summary["behaviours"].values():
                del behaviour["velocities"]
            won = [compliance.succeeded(figure) for figure in figures]
        else:
            summary = grasp.summarise(figures)
            del summary["results"]
            won = [figure["success"] for figure in figures]
        return {**summary, "successes": sum(won), "rollouts": len(won)}

    def _train(
        self, contestant: str, experiment: str, picked: tuple[int, ...], from_pool: bool
    ) -> Trained:
        episodes = self.pool(experiment) if from_pool else self.episodes[experiment]
        chosen = [episodes[i] for i in picked]
        training = self.training
        if from_pool:
            training = replace(training, seconds=training.seconds / 2)
        return train(contestant, experiment, self.body[experiment], chosen, training)

    def _crowd(self, model: Any, experiment: str, cell: Cell) -> tuple[HASM, dict[str, Any]]:
        """The model with unrelated motions in each of its memories, and what they do to it."""
        rng = np.random.default_rng(cell.seed)
        begin = time.perf_counter()
        episodes = self.episodes[experiment]
        full = crowded(model, episodes, int(cell.level), CROWD_LENGTH, rng)
        seconds = time.perf_counter() - begin
        leads = {
            patch: margin(full.model.memory(patch).memory, stored.learned)._asdict()
            for patch, stored in full.stored.items()
        }
        times = step_times(full.model, torch.tensor(START_POSES["grasp"]))
        return full.model, {
            "crowding_seconds": seconds,
            "stored": {patch: asdict(stored) for patch, stored in full.stored.items()},
            "margins": leads,
            "step_times": times._asdict(),
        }


def _pool(experiment: str) -> list[Episode]:
    """Ten episodes of each behaviour, recorded anew."""
    if experiment == "compliance":
        return list(compliance_episodes(POOL_FORCES))
    return list(grasp_episodes(len(POOL_FORCES), POOL_SEED))


def plan(cell: Cell, experiment: str) -> list[Any]:
    """The rollouts of a cell."""
    forces = [cell.level] if cell.condition == "force" else []
    if experiment == "compliance":
        return compliance.cases(cell.behaviour_rollouts, forces, cell.seed)
    noise = cell.level if cell.condition == "start_noise" else START_NOISE
    place = cell.level if cell.condition == "object" else OBJECT_NOISE
    return grasp.cases(cell.grasps, forces, cell.seed, PAUSES, noise, place)


def start_of(cell: Cell, case: Any, env: Any) -> Array | None:
    """Start posture of a rollout, (joints,) rad or m; None for the case's own.

    "posture" moves the joints that do not yield from the posture of the demonstrations towards
    the case's own by its level.
    """
    if cell.condition != "posture":
        return None
    lower, upper = env.unwrapped.joint_lower, env.unwrapped.joint_upper
    start = compliance.start_posture(case, JOINTS, lower, upper)
    shown = lower + np.array(POSTURE) * (upper - lower)
    yielding = JOINTS.index(compliance.BEHAVIOURS[case.behaviour].joint)
    mixed = shown + cell.level * (start - shown)
    mixed[yielding] = start[yielding]
    return mixed


def some_episodes(episodes: Sequence[Episode], number: int, seed: int) -> tuple[int, ...]:
    """So many episodes of each behaviour, drawn."""
    rng = np.random.default_rng(seed)
    tasks: dict[str, list[int]] = {}
    for i, episode in enumerate(episodes):
        tasks.setdefault(episode.task, []).append(i)
    drawn = [rng.choice(mine, min(number, len(mine)), replace=False) for mine in tasks.values()]
    return tuple(sorted(int(i) for i in np.concatenate(drawn)))


def step_ms(policy: Policy, body: Body) -> float:
    """Mean time of a control step under a touch of 8 N at the first patch, ms.

    The mean, since some policies plan seldom and long.
    """
    state = (torch.tensor(body.lower) + torch.tensor(body.upper)) / 2
    skin = pressed(body, body.patches[0], TIMED_FORCE)
    policy.reset()
    spent = []
    for _ in range(TIMED_STEPS):
        begin = time.perf_counter()
        state = policy.step(state, skin)
        spent.append(1e3 * (time.perf_counter() - begin))
    policy.reset()
    return statistics.mean(spent)
