"""Rolling out many cases on all processor cores."""

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from hasm_torch.evaluation import compliance, grasp
from hasm_torch.evaluation.rollout import Array, Trace
from hasm_torch.model.hasm import HASM

EXPERIMENTS = ("compliance", "grasp")
MAX_STEPS = 10_000  # more than any human's patience

_worker: dict[str, Any] = {}


def run_cases(
    experiment: str, cases: Sequence[Any], checkpoint: Path, workers: int | None = None
) -> list[dict[str, Any]]:
    """Roll out the cases of one experiment, with a progress bar.

    Args:
        experiment: "compliance" or "grasp".
        cases: ``compliance.ComplianceCase`` or ``grasp.GraspCase``.
        checkpoint: Directory of the model.
        workers: Processes; by default one a core.

    Returns:
        The figures of each case, in order.
    """
    check_experiments([experiment])
    workers = min(workers or os.cpu_count() or 1, len(cases))
    figures: list[dict[str, Any]] = [{} for _ in cases]
    with (
        ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(experiment, str(checkpoint)),
        ) as pool,
        tqdm(total=len(cases), desc=f"{experiment} rollouts", unit="rollout") as bar,
    ):
        running = {pool.submit(_run_in_worker, case): i for i, case in enumerate(cases)}
        for future in as_completed(running):
            figures[running[future]] = future.result()
            bar.update()
    return figures


def run_case(
    experiment: str,
    case: Any,
    env: Any,
    policy: Any,
    frame_every: int = 0,
    watch: Callable[[Any], None] | None = None,
    start: Array | None = None,
) -> tuple[Trace, dict[str, Any]]:
    """Roll one case out in this process.

    Args:
        experiment: "compliance" or "grasp".
        case: The case.
        env: The environment of the experiment.
        policy: The policy.
        frame_every: Take a picture every so many steps; 0 takes none.
        watch: Called with the policy after every step.
        start: (joints,) start posture in place of the case's own (compliance) or of the usual
            one, to which the case adds noise (grasp), rad or m.

    Returns:
        The trace and its figures.
    """
    if experiment == "compliance":
        return compliance.run_case(case, env, policy, frame_every, watch, start)
    from hasm_torch.sim.poses import START_POSES

    home = np.array(START_POSES["grasp"]) if start is None else start
    return grasp.run_case(case, env, policy, home, frame_every, watch)


def make_env(experiment: str, render: bool = False) -> Any:
    """The environment of an experiment."""
    import gymnasium

    import hasm_torch.sim  # noqa: F401  # registers the environment

    return gymnasium.make(
        "hasm_torch/HSRTouch-v0",
        scene=experiment,
        render_mode="rgb_array" if render else None,
        max_episode_steps=MAX_STEPS,
        disable_env_checker=True,
    )


def check_experiments(experiments: Sequence[str]) -> None:
    """Raise ValueError for an experiment that does not exist."""
    for experiment in experiments:
        if experiment not in EXPERIMENTS:
            raise ValueError(f"unknown experiment {experiment!r}, valid: {', '.join(EXPERIMENTS)}")


def _start_worker(experiment: str, checkpoint: str) -> None:
    torch.set_num_threads(1)
    _worker["experiment"] = experiment
    _worker["env"] = make_env(experiment)
    _worker["policy"] = HASM.from_pretrained(checkpoint)


def _run_in_worker(case: Any) -> dict[str, Any]:
    _, figures = run_case(_worker["experiment"], case, _worker["env"], _worker["policy"])
    return figures
