"""Time of one control step: skin and joints in, joint targets out.

A model of the HSR's size (8 joints, 8 patches of 7 cells with 3 points each) holds a smooth walk
of 5,000 states for one patch, and that patch is pressed all the time by a force that rises and
falls. The robot takes up every target at once. The same rollout is run twice: once to count the
recalls of every step, then for the time. Beside the time on the clock stands the time that the
thread computed: on a busy machine the first one's tail is that of the other programs. The parts
are timed on their own with the inputs of the control step; what is left is the bookkeeping between
them.

    python -m benchmarks.control_step
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.machine import RESULTS, interleaved, print_machine, save_json
from hasm_torch import HASM, Body, HASMConfig
from hasm_torch.apps.command_line import parse_options
from hasm_torch.config import MemoryShape
from hasm_torch.encoders.readings import pressed

JOINTS, PATCHES, CELLS = 8, 8, 7
TOUCHED = "patch_0"

# Force on the touched patch, N: between these, over so many control steps.
FORCE_LOW, FORCE_HIGH, FORCE_PERIOD = 2.0, 8.0, 100


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        associations: Associations in the memory of the touched patch.
        steps: Control steps of the rollout.
        rounds: Timed rollouts.
        threads: CPU threads.
        output_dir: Where the result goes.
    """

    associations: int = 5000
    steps: int = 2000
    rounds: int = 3
    threads: int = 1
    output_dir: str = str(RESULTS)


def build_model(associations: int) -> HASM:
    """A model whose touched patch holds a closed smooth walk through all joints.

    Args:
        associations: States of the walk. A link takes the spikes of one control step under a
            medium force, as in an episode recorded at the control rate.
    """
    body = Body(
        joints=[f"joint_{i}" for i in range(JOINTS)],
        lower=[-1.5] * JOINTS,
        upper=[1.5] * JOINTS,
        max_speed=[2.0] * JOINTS,
        patches=[f"patch_{i}" for i in range(PATCHES)],
        cells=[CELLS] * PATCHES,
        directions=[[math.cos(i), math.sin(i), 0.0] for i in range(PATCHES)],
    )
    model = HASM(HASMConfig(), body)
    memory = model.add_memory(TOUCHED, MemoryShape(list(range(JOINTS)), associations, 1))
    memory.touch_levels.fill_(0.4)
    turn = torch.arange(associations + 1) / associations * 2 * math.pi
    phase = torch.arange(JOINTS).float()
    walk = 1.3 * torch.sin((1 + torch.arange(JOINTS) % 3) * turn.unsqueeze(1) + phase)
    way = (walk.diff(dim=0).abs() / 3.0).amax(-1)
    counts, _, _ = model.skin(pressed(body, TOUCHED, 5.0).expand(50, -1, -1))
    pace = counts[:, 0].mean() / way
    memory.write(walk[:-1], torch.full((associations,), 0.4), walk[1:], pace)
    memory.memory.beta.fill_(memory.memory.crowding().beta)
    model.reset()
    return model


def start_position(model: HASM) -> Tensor:
    """Joint positions that the touched patch's memory knows."""
    return model.memory(TOUCHED).memory.successors[0, :JOINTS].clone()


def roll_out(model: HASM, steps: int) -> np.ndarray:
    """Run a rollout.

    Args:
        model: From ``build_model``.
        steps: Control steps.

    Returns:
        (2, steps) seconds of each step, on the clock and computed by this thread.
    """
    model.reset()
    state = start_position(model)
    seconds = np.empty((2, steps))
    for step in range(steps):
        wave = 0.5 - 0.5 * math.cos(2 * math.pi * step / FORCE_PERIOD)
        skin = pressed(model.body, TOUCHED, FORCE_LOW + (FORCE_HIGH - FORCE_LOW) * wave)
        clock, computed = time.perf_counter(), time.thread_time()
        state = model.step(state, skin)
        computed_after = time.thread_time()
        seconds[:, step] = time.perf_counter() - clock, computed_after - computed
    return seconds


def count_recalls(model: HASM, steps: int) -> np.ndarray:
    """Count the recalls in every step of the rollout.

    Args:
        model: From ``build_model``.
        steps: Control steps.

    Returns:
        (steps,) recalls.

    Raises:
        RuntimeError: If there was none.
    """
    recalls = np.zeros(steps, dtype=np.int64)
    counted, step = 0, 0

    def count(*_: Any) -> None:
        nonlocal counted
        counted += 1

    memory_hook = model.memory(TOUCHED).memory.register_forward_hook(count)
    inner = model.step

    def counting(state: Tensor, skin: Tensor) -> Tensor:
        nonlocal counted, step
        target = inner(state, skin)
        recalls[step], counted, step = counted, 0, step + 1
        return target

    model.step = counting  # type: ignore[method-assign, assignment]
    roll_out(model, steps)
    del model.step  # the instance's, which hid the class's
    memory_hook.remove()
    if not recalls.any():
        raise RuntimeError("no step recalled anything, so this rollout measures no recall")
    return recalls


def parts(model: HASM, rounds: int) -> dict[str, np.ndarray]:
    """Time the parts of a step with its inputs.

    Args:
        model: In the middle of a rollout.
        rounds: Timings of each part.

    Returns:
        For each part (rounds,) seconds.
    """
    skin, memory = model.skin, model.memory(TOUCHED)
    sample = pressed(model.body, TOUCHED, 5.0).unsqueeze(0)
    _, force, state = skin(sample, model.rollout.skin)
    drive = skin.current_per_newton * force[0].unsqueeze(-1).expand(-1, skin.steps).contiguous()
    reference, density = model.reference, model.density[0]
    codes = memory.codes(reference, density)
    calls: dict[str, Callable[[], Any]] = {
        "skin and spikes": lambda: skin(sample, state),
        "of which spikes": lambda: skin.neuron(drive, state.neurons),
        "codes of a query": lambda: memory.codes(reference, density),
        "binding and recall": lambda: memory.memory(*codes),
    }
    return interleaved(calls, rounds)


def main() -> None:
    """Measure, print the table and write the result."""
    options = parse_options(Options)
    torch.set_num_threads(options.threads)
    torch.set_grad_enabled(False)
    print_machine()
    model = build_model(options.associations)
    recalls = count_recalls(model, options.steps)
    seconds, computed = np.hstack([roll_out(model, options.steps) for _ in range(options.rounds)])
    recalls = np.tile(recalls, options.rounds)
    part_seconds = parts(model, 500 * options.rounds)

    result: dict[str, Any] = {
        "associations": options.associations,
        "steps": len(seconds),
        "code_dim": model.memory(TOUCHED).memory.code_dim,
        "share_with_recall": float((recalls > 0).mean()),
        "mean_recalls": float(recalls.mean()),
        "ms": {},
    }
    print(
        f"{len(seconds)} steps, {options.associations} associations x {result['code_dim']} bits, "
        f"{result['share_with_recall']:.0%} of the steps with a recall, "
        f"{result['mean_recalls']:.2f} recalls a step"
    )
    print(f"{'':26} {'median':>8} {'p99':>8}  ms")
    samples = {
        "control step": seconds,
        "  with a recall": seconds[recalls > 0],
        "  without": seconds[recalls == 0],
        "computed: control step": computed,
        "computed: with a recall": computed[recalls > 0],
        **{f"part: {name}": values for name, values in part_seconds.items()},
    }
    for name, values in samples.items():
        if len(values):
            median, tail = 1e3 * np.median(values), 1e3 * np.quantile(values, 0.99)
            print(f"{name:26} {median:8.3f} {tail:8.3f}")
            result["ms"][name.strip()] = {"median": float(median), "p99": float(tail)}
    print(save_json(options.output_dir, "control_step", result))


if __name__ == "__main__":
    main()
