"""The experiments of ``eval.py`` across ROS in real time, and how late their commands come.

Late is the time from the moment in which the simulation begins to publish a sample, skin and joint
states, until the arm's trajectory, the last of the commands, arrives there from another process.

    python -m benchmarks.ros_latency
"""

import os
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchmarks.machine import RESULTS, print_machine, save_json
from hasm_torch.apps.command_line import parse_options
from hasm_torch.config import HASMConfig
from hasm_torch.evaluation import grasp, yielding
from hasm_torch.evaluation.rollout import Case, run_case
from hasm_torch.evaluation.runner import make_env
from hasm_torch.evaluation.teaching import learn
from hasm_torch.ros.experiment import roll_out_across

ALONG = 0.7  # cos from which a push counts, as in eval.py
IN_TIME = 5.0  # ms


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        pushes: Rollouts of the yield experiment.
        grasps: Rollouts of the grasp experiment.
        waits: Whether the simulation waits for commands instead of running in real time.
        seed: Seed of the cases.
        output_dir: Where the result goes.
    """

    pushes: int = 24
    grasps: int = 4
    waits: bool = False
    seed: int = 0
    output_dir: str = str(RESULTS)


def measure(options: Options) -> dict[str, Any]:
    """Roll out here and across ROS.

    Returns:
        Successes here and across, and the latencies in ms, by experiment.
    """
    planned: dict[str, Sequence[Case]] = {
        "yield": yielding.cases(options.pushes, options.seed),
        "grasp": grasp.cases(options.grasps, options.seed),
    }
    planned = {experiment: cases for experiment, cases in planned.items() if cases}
    models = {e: learn(RESULTS.parents[1] / f"datasets/hsr_{e}", HASMConfig()) for e in planned}
    rolled_across = roll_out_across(planned, models, options.waits)
    result: dict[str, Any] = {"waits": options.waits}
    for experiment, across in rolled_across.items():
        env, cases = make_env(experiment), planned[experiment]
        here = [run_case(case, env, models[experiment])[1] for case in cases]
        late = 1e3 * np.concatenate([rolled.latencies for rolled in across])
        # A sample without an answer is infinitely late, and counts in every quantile.
        median, worst = np.quantile(late, [0.5, 0.99], method="higher")
        result[experiment] = {
            "rollouts": len(cases),
            "succeeded_here": sum(map(succeeded, here)),
            "succeeded_across": sum(succeeded(rolled.figures) for rolled in across),
            "samples": len(late),
            "not_answered": int(np.isinf(late).sum()),
            "answered_in_time": float((late < IN_TIME).mean()),
            "latency_ms": {
                "median": float(median),
                "p99": float(worst) if np.isfinite(worst) else None,
            },
        }
    return result


def succeeded(figures: dict[str, Any]) -> bool:
    """Whether a rollout did what its experiment asks for."""
    motion = figures.get("motion")
    return bool(figures["success"] if motion is None else motion.cos > ALONG)


def main() -> None:
    """Measure, print and write the result."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.SystemRandom().randint(1, 101)))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    options = parse_options(Options)
    torch.set_num_threads(1)
    print_machine()
    result = measure(options)
    print(result)
    print(save_json(options.output_dir, "ros", result))


if __name__ == "__main__":
    main()
