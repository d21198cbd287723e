"""What crowded memories do to the recall: its margin, the β that fits, and the control step.

Everything is read off the packed codes, so that memories of a million associations can be judged.
"""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hasm_torch.encoders.readings import pressed
from hasm_torch.evaluation.grasp import GRASP_PATCH, REACH_PATCH
from hasm_torch.memory.crowding import fitting_beta, judged_rows
from hasm_torch.memory.layer import HeteroAssociativeMemory
from hasm_torch.memory.recall.packed import ROWS, unpack
from hasm_torch.model.hasm import HASM

# Associations that are asked for in one recall.
QUERIES_AT_ONCE = 16

FORCE = 8.0  # N
# A walk is over when the target stayed for so many steps; it never takes longer than the most.
STILL_STEPS, MOST_STEPS = 25, 3000


class Margin(NamedTuple):
    """Leads of stored associations in the recall of themselves, inner products of codes.

    Attributes:
        smallest: Smallest lead over any other association.
        fifth: 5th percentile of it.
        smallest_unrelated: Smallest lead over the unrelated ones; inf without any.
        fifth_unrelated: 5th percentile of it.
    """

    smallest: float
    fifth: float
    smallest_unrelated: float
    fifth_unrelated: float


class StepTimes(NamedTuple):
    """Time of control steps, ms.

    Attributes:
        median: Of all steps.
        p99: 99th percentile.
        largest: Longest.
        recall_median: Median of the steps with a recall.
        recall_p99: 99th percentile of these.
        steps: Steps of the walk.
        recall_steps: Of these, such with a recall.
        most_recalls: Most recalls in one step.
    """

    median: float
    p99: float
    largest: float
    recall_median: float
    recall_p99: float
    steps: int
    recall_steps: int
    most_recalls: int


def margin(memory: HeteroAssociativeMemory, learned: int) -> Margin:
    """Ask a packed memory for each of its first associations.

    Args:
        memory: With one bit an entry.
        learned: Associations asked for; the rows from here on are unrelated.
    """
    unrelated = torch.arange(memory.capacity) >= learned
    any_other, far = [], []
    for rows in torch.arange(learned).split(QUERIES_AT_ONCE):
        query = codes_of(memory, rows)
        any_other.append(memory.inspect(query).margin)
        best = memory.inspect(query, unrelated.expand(len(rows), -1)).score
        far.append((memory.code_dim - best).nan_to_num(nan=math.inf))  # NaN where none takes part
    leads, leads_unrelated = torch.cat(any_other).numpy(), torch.cat(far).numpy()
    return Margin(
        float(leads.min()),
        float(np.percentile(leads, 5, method="lower")),
        float(leads_unrelated.min()),
        float(np.percentile(leads_unrelated, 5, method="lower")),
    )


def beta_of(memory: HeteroAssociativeMemory) -> float:
    """β as ``HASM.fit`` derives it by ``crowding``, from the packed codes.

    Args:
        memory: With one bit an entry and different codes.

    Returns:
        ln(confidence · (K − 1)) / margin, with the smallest lead of as many associations as
        ``crowding`` judges.
    """
    held = int(memory.count)
    judged = judged_rows(held, memory.code_dim).split(QUERIES_AT_ONCE)
    leads = torch.cat([memory.inspect(codes_of(memory, rows)).margin for rows in judged])
    smallest = float(leads.min()) if held > 1 else memory.code_dim
    return fitting_beta(held, smallest)


def codes_of(memory: HeteroAssociativeMemory, rows: Tensor) -> Tensor:
    """Some rows of a packed memory as real numbers, (len(rows), code_dim)."""
    words = memory.associations[rows // ROWS, :, rows % ROWS]
    return unpack(words.mT.unsqueeze(0), memory.code_dim)


def step_times(model: HASM, start: Tensor, rounds: int = 3) -> StepTimes:
    """Time the control steps in which a touch leads through reach and grasp, on one thread.

    The robot takes up every target at once. A first walk counts the recalls, which makes the
    first calls too; the timed ones repeat it.

    Args:
        model: Knows the grasp.
        start: (joints,) where the walk starts, rad or m.
        rounds: Timed walks.

    Raises:
        RuntimeError: If no step recalled anything.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _counted(model) as calls:
            counts = np.array([count for _, count in _walk(model, start, calls)])
        rounds_ms = [[ms for ms, _ in _walk(model, start, [])] for _ in range(rounds)]
    finally:
        torch.set_num_threads(threads)
        model.reset()
    if not counts.any():
        raise RuntimeError("no step recalled anything: the start must be one that the model knows")
    spent = np.array(rounds_ms)
    recalling = spent[:, counts > 0]
    return StepTimes(
        float(np.median(spent)),
        float(np.percentile(spent, 99)),
        float(spent.max()),
        float(np.median(recalling)),
        float(np.percentile(recalling, 99)),
        len(counts),
        int((counts > 0).sum()),
        int(counts.max()),
    )


def _walk(model: HASM, start: Tensor, calls: list[Any]) -> Iterator[tuple[float, int]]:
    """Milliseconds and recalls of every step up to where both motions have ended."""
    model.reset()
    state = start
    for patch in (REACH_PATCH, GRASP_PATCH):
        skin, since, steps = pressed(model.body, patch, FORCE), 0, 0
        while since < STILL_STEPS and steps < MOST_STEPS:
            calls.clear()
            begin = time.perf_counter()
            target = model.step(state, skin)
            spent = 1e3 * (time.perf_counter() - begin)
            since = since + 1 if torch.equal(target, state) else 0
            state, steps = target, steps + 1
            yield spent, len(calls)


@contextmanager
def _counted(model: HASM) -> Iterator[list[Any]]:
    """Gathers one entry for every recall."""
    calls: list[Any] = []
    hooks = [
        model.memory(patch).memory.register_forward_hook(lambda *_: calls.append(None))
        for patch in model.memories
    ]
    try:
        yield calls
    finally:
        for hook in hooks:
            hook.remove()
