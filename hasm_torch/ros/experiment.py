"""The experiments of ``eval.py`` across ROS: the simulation and its human in another process.

this process: policy ◄──► HSRLink ◄──topics──► SimulatedHSR ◄──► simulation, human: the other
"""

import multiprocessing
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, NamedTuple

import torch

from hasm_torch.evaluation.rollout import Case, Policy, run_case
from hasm_torch.evaluation.runner import make_env
from hasm_torch.ros.link import HSRLink, LinkConfig, Reading
from hasm_torch.ros.simulated_hsr import SimulatedHSR

PATIENCE = 0.05  # s, in which the robot's loop looks up from waiting for a sample
FOUND = 20.0  # s in which ROS nodes of one machine find each other, with time to spare

_made: dict[str, Any] = {}  # what the simulation's process has made so far


class Rolled(NamedTuple):
    """One case, rolled out across ROS.

    Attributes:
        figures: What is measured of it, as ``eval.py`` does.
        latencies: See ``SimulatedHSR``.
    """

    figures: dict[str, Any]
    latencies: list[float]


def roll_out_across(
    planned: Mapping[str, Sequence[Case]],
    policies: Mapping[str, Policy],
    waits: bool,
    prefix: str = "/hsrb",
) -> dict[str, list[Rolled]]:
    """Roll cases out with the policies here and the simulation in another process.

    Args:
        planned: Cases by their experiment, of ``EXPERIMENTS``.
        policies: What drives the robot in each.
        waits: Whether the simulation waits for commands instead of running in real time.
        prefix: Before all topics.

    Returns:
        What came of each case.
    """
    spawn, rolled = multiprocessing.get_context("spawn"), {}
    with ProcessPoolExecutor(1, spawn, torch.set_num_threads, (1,)) as pool:
        for experiment, cases in planned.items():
            link = HSRLink(LinkConfig(prefix, False, True, experiment == "grasp", waits))
            policy, rolled[experiment] = policies[experiment], list[Rolled]()
            try:
                pool.submit(_begin, experiment, prefix, waits).result()
                for case in cases:
                    policy.reset()
                    link.reset()
                    playing = pool.submit(_play, case)
                    drive(link, policy, playing)
                    rolled[experiment].append(playing.result())
                pool.submit(_end).result()
            finally:
                link.close()
    return rolled


def drive(link: HSRLink, policy: Policy, until: Future[Any]) -> None:
    """Let a policy drive the robot: every sample is answered by a command.

    Args:
        link: The robot.
        policy: The policy.
        until: What ends it when it is done.
    """
    while not until.done():
        reading = link.observe(PATIENCE)
        if reading.new:
            link.command(answer(policy, reading).numpy())


def answer(policy: Policy, reading: Reading) -> torch.Tensor:
    """(J,) target of a policy for what was read."""
    state, skin = torch.from_numpy(reading.state), torch.from_numpy(reading.skin)
    seen = None if reading.object is None else torch.from_numpy(reading.object)
    return policy.step(state, skin, observation=seen)


def _begin(experiment: str, prefix: str, waits: bool) -> None:
    env = make_env(experiment)
    robot = SimulatedHSR(env.unwrapped, prefix, waits)
    _made.update(env=env, robot=robot)
    deadline = time.monotonic() + FOUND
    while not robot.found:
        if time.monotonic() > deadline:
            raise TimeoutError(f"ROS nodes of one machine did not find each other in {FOUND:g} s")
        time.sleep(PATIENCE)


def _play(case: Case) -> Rolled:
    robot: SimulatedHSR = _made["robot"]
    robot.latencies.clear()
    _, figures = run_case(case, _made["env"], robot)
    return Rolled(figures, list(robot.latencies))


def _end() -> None:
    _made.pop("robot").close()
