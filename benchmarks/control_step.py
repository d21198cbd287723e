"""Time of one control step: skin and joints in, joint targets out.

The default model of some bundled demonstrations is touched by a force that rises and falls, one
taught patch after the other, and the robot takes up every target at once. Beside the time on the
clock stands the time that the thread computed: on a busy machine the first one's tail is that of
the other programs. The parts of a step with a recall are timed on their own; what is left is the
bookkeeping between them.

    python -m benchmarks.control_step
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.machine import RESULTS, interleaved, print_machine, save_json
from hasm_torch import HASM, HASMConfig
from hasm_torch.apps.command_line import parse_options
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.encoders.readings import pressed
from hasm_torch.model.control import Touched
from hasm_torch.model.felt import PushDirection
from hasm_torch.model.recalling import Recalling
from hasm_torch.sim.tasks import TEST_FORCES

FORCE_PERIOD = 100  # control steps in which the force rises and falls
TOUCH_STEPS = 150  # control steps until another patch is touched and the robot starts again


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        dataset: Demonstrations that the model learns, with spikes that lead it.
        steps: Control steps of the rollout.
        rounds: Timed rollouts.
        threads: CPU threads.
        output_dir: Where the result goes.
    """

    dataset: Path = Path("datasets/hsr_yield")
    steps: int = 2000
    rounds: int = 3
    threads: int = 1
    output_dir: str = str(RESULTS)


def learn(dataset: Path) -> tuple[HASM, torch.Tensor]:
    """The default model of a dataset, and the (joints,) state in which its first episode begins."""
    data = load_episodes(dataset)
    model = HASM(HASMConfig(), body_of(data))
    model.fit(data)
    return model, torch.from_numpy(data.episodes[0].state[0])


def roll_out(model: HASM, start: torch.Tensor, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Run a rollout.

    Args:
        model: From ``learn``.
        start: (joints,) where the robot starts.
        steps: Control steps.

    Returns:
        (2, steps) seconds of each step, on the clock and computed by this thread; (steps,) recalls.
    """
    low, high = TEST_FORCES
    seen = torch.zeros(sum(model.body.observations.values()))
    seconds, recalls = np.empty((2, steps)), np.zeros(steps, dtype=np.int64)
    for step in range(steps):
        if step % TOUCH_STEPS == 0:
            model.reset()
            state, patch = start, model.patches[step // TOUCH_STEPS % len(model.patches)]
        wave = 0.5 - 0.5 * math.cos(2 * math.pi * step / FORCE_PERIOD)
        skin = pressed(model.body, patch, low + (high - low) * wave)
        clock, computed = time.perf_counter(), time.thread_time()
        state = model.step(state, skin, observation=seen)
        computed_after = time.thread_time()
        seconds[:, step] = time.perf_counter() - clock, computed_after - computed
        recalls[step] = len(model.rollout.asked)
    return seconds, recalls


def parts(model: HASM, start: torch.Tensor, rounds: int) -> dict[str, np.ndarray]:
    """Time the parts of a step.

    Args:
        model: From ``learn``, of displacements.
        start: (joints,) where the robot stands.
        rounds: Timings of each part.

    Returns:
        For each part (rounds,) seconds.
    """
    assert model.skin is not None
    recalling, skin = model.recalling, model.skin
    assert isinstance(recalling, Recalling)
    patch = model.body.patches.index(model.patches[0])
    positions = start.double().numpy()
    forces = pressed(model.body, model.patches[0], 6.0).numpy()[None, None]
    state = skin.start()
    push = skin.encode(forces, state)[1][0, 0, :, 1:]
    to_base = PushDirection(model.body, model.config.frame)
    direction = to_base.of_patch(patch, push[patch], positions)
    touch = Touched(patch, 3.0, 0.4, direction, np.zeros(sum(model.body.observations.values())))
    query = recalling.query(positions, touch)
    calls: dict[str, Callable[[], Any]] = {
        "skin and spikes": lambda: skin.encode(forces, state),
        "direction of the force": lambda: to_base.of_patch(patch, push[patch], positions),
        "codes of a query": lambda: recalling.query(positions, touch),
        "recall and read-out": lambda: recalling.recall(query, touch),
    }
    return interleaved(calls, rounds)


@torch.no_grad()
def measure(options: Options) -> dict[str, Any]:
    """Learn and time.

    Returns:
        Sizes, recalls and, under ``ms``, median and 99th percentile by what was timed.

    Raises:
        RuntimeError: If nothing was recalled.
    """
    model, start = learn(options.dataset)
    runs = [roll_out(model, start, options.steps) for _ in range(options.rounds)]
    seconds, computed = np.hstack([run[0] for run in runs])
    recalls = np.concatenate([run[1] for run in runs])
    if not recalls.any():
        raise RuntimeError("no step recalled anything, so this rollout measures no recall")
    samples = {
        "control step": seconds,
        "with a recall": seconds[recalls > 0],
        "without": seconds[recalls == 0],
        "computed: control step": computed,
        "computed: with a recall": computed[recalls > 0],
    }
    for name, values in parts(model, start, 500 * options.rounds).items():
        samples[f"part: {name}"] = values
    assert isinstance(model.recalling, Recalling)
    return {
        "dataset": str(options.dataset),
        "associations": len(model.origins),
        "steps": len(seconds),
        "code_dim": model.recalling.code.code_dim,
        "share_with_recall": float((recalls > 0).mean()),
        "mean_recalls": float(recalls.mean()),
        "ms": {
            name: {
                "median": float(1e3 * np.median(values)),
                "p99": float(1e3 * np.quantile(values, 0.99)),
            }
            for name, values in samples.items()
            if len(values)
        },
    }


def main() -> None:
    """Measure, print the table and write the result."""
    options = parse_options(Options)
    torch.set_num_threads(options.threads)
    print_machine()
    result = measure(options)
    print(
        f"{result['steps']} steps, {result['associations']} associations x {result['code_dim']} "
        f"entries, {result['share_with_recall']:.0%} of the steps with a recall"
    )
    print(f"{'':34} {'median':>8} {'p99':>8}  ms")
    for name, ms in result["ms"].items():
        print(f"{name:34} {ms['median']:8.3f} {ms['p99']:8.3f}")
    print(save_json(options.output_dir, "control_step", result))


if __name__ == "__main__":
    main()
