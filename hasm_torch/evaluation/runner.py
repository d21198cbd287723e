"""Rolling out many cases on all processor cores."""

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from hasm_torch.evaluation.rollout import Case, Policy, Trace, run_case
from hasm_torch.model.hasm import HASM
from hasm_torch.sim.teacher import ComplianceTeacher, GraspTeacher, YieldTeacher

Rolled = tuple[Trace, dict[str, Any]]
_TEACHERS: dict[str, Any] = {
    "compliance": ComplianceTeacher,
    "yield": YieldTeacher,
    "grasp": GraspTeacher,
}
EXPERIMENTS = tuple(_TEACHERS)
MAX_STEPS = 10_000  # more than any human's patience

# What a worker process has made so far: environments by scene, policies by name; and how.
_envs: dict[str, Any] = {}
_policies: dict[str, Policy] = {}
_loaders: list[Callable[[str], Policy]] = []


class Runner:
    """Processes that roll cases out as soon as they are handed in, with a progress bar.

    Close it at the end.

    Args:
        load: Makes a policy from the directory of its checkpoint.
    """

    def __init__(self, load: Callable[[str], Policy] = HASM.from_pretrained) -> None:
        self._pool = ProcessPoolExecutor(
            os.cpu_count() or 1,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(load,),
        )
        self._bar = tqdm(total=0, desc="rollouts", unit="rollout")

    def start(
        self, experiment: str, cases: Sequence[Case], checkpoint: Path | None
    ) -> list[Future[Rolled]]:
        """Hand cases of one experiment in.

        Args:
            experiment: One of ``EXPERIMENTS``.
            cases: The cases.
            checkpoint: Directory of the policy; None is the demonstrator's own law.

        Returns:
            The trace and the figures of each case, in order, once they are there.
        """
        name = None if checkpoint is None else str(checkpoint)
        futures = [self._pool.submit(_roll_out, experiment, case, name) for case in cases]
        self._bar.total += len(futures)
        for future in futures:
            future.add_done_callback(lambda _: self._bar.update())
        return futures

    def close(self) -> None:
        """End the processes; what they have not begun is left."""
        self._pool.shutdown(cancel_futures=True)
        self._bar.close()


def make_env(experiment: str, render: bool = False) -> Any:
    """The environment of an experiment."""
    import gymnasium

    import hasm_torch.sim  # noqa: F401  # registers the environment

    return gymnasium.make(
        "hasm_torch/HSRTouch-v0",
        scene="grasp" if experiment == "grasp" else "compliance",
        render_mode="rgb_array" if render else None,
        max_episode_steps=MAX_STEPS,
        disable_env_checker=True,
    )


def make_teacher(experiment: str, env: Any) -> Policy:
    """The demonstrator's own law of an experiment, as a policy."""
    teacher: Policy = _TEACHERS[experiment](env.unwrapped)
    return teacher


def check_experiments(experiments: Sequence[str]) -> None:
    """Raise ValueError for an experiment that does not exist, or none at all."""
    valid = f"valid: {', '.join(EXPERIMENTS)}"
    if not experiments:
        raise ValueError(f"experiments is empty, {valid}")
    for experiment in experiments:
        if experiment not in EXPERIMENTS:
            raise ValueError(f"unknown experiment {experiment!r}, {valid}")


def _begin(load: Callable[[str], Policy]) -> None:
    torch.set_num_threads(1)
    _loaders.append(load)


def _roll_out(experiment: str, case: Case, checkpoint: str | None) -> Rolled:
    if experiment not in _envs:
        _envs[experiment] = make_env(experiment)
    env, name = _envs[experiment], checkpoint or f"{experiment} teacher"
    if name not in _policies:
        made = make_teacher(experiment, env) if checkpoint is None else _loaders[0](checkpoint)
        _policies[name] = made
    return run_case(case, env, _policies[name])
