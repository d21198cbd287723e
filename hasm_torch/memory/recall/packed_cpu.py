"""Runs the packed scan on the CPU, large memories on the threads that torch may use."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from hasm_torch.memory.recall import packed_kernel as kernel
from hasm_torch.memory.recall.interaction import Interaction
from hasm_torch.memory.recall.packed_weigh import EXPONENTIAL, KINDS

# Rows within reach that are held at once: 2 MiB, about the second-level cache of two threads; but
# for fewer queries than this a large memory would be read anew too often.
_HELD, _QUERIES = 1 << 18, 16
# Threads are worth starting to compare at least so many 32-bit words, about 0.5 ms of one thread.
_TEAM_WORDS = 1 << 22


def scan_cpu(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    count: Tensor,
    mask: Tensor | None,
    beta: float,
    interaction: Interaction,
    top_k: int | None,
    decision: Tensor | None = None,
    match: Tensor | None = None,
    certainty: Tensor | None = None,
    weights: Tensor | None = None,
) -> None:
    """Recalls from a packed memory into the tensors given for what is wanted, all contiguous.

    Args:
        query: (*batch, ..., dim) float32.
        words: (*batch, blocks, width, 64) int32.
        successors: (*batch, rows, values) float32.
        count: (*batch,) int64.
        mask: (*batch, ..., rows) bool.
        beta: Inverse temperature, not NaN.
        interaction: How a match becomes a weight.
        top_k: Best matches that weigh; None for all.
        decision: (*batch, ..., values) float32.
        match: Row of the best match, (*batch, ...) int64; together with ``certainty``.
        certainty: Its score, its margin and the entropy of the weights, (3, *batch, ...) float32.
        weights: (*batch, ..., rows) float32, zeros before.
    """
    *_, blocks, width, _ = words.shape
    *_, rows, values = successors.shape
    dim, memories = query.shape[-1], count.numel()
    queries = query.numel() // (dim * memories)
    sizes = memories, queries, dim, blocks, width, rows, values
    tensors = query, words, successors, count, mask, decision, match, certainty, weights
    addresses = tuple([0 if tensor is None else tensor.data_ptr() for tensor in tensors])
    kind = KINDS[interaction] if isinstance(interaction, str) else EXPONENTIAL - interaction
    options = beta, kind, top_k or 0
    step = max(_QUERIES, _HELD // (blocks * kernel.ROWS + dim))
    shares = [
        (memory, first, min(first + step, queries))
        for memory in range(memories)
        for first in range(0, queries, step)
    ]
    threads = torch.get_num_threads()
    if memories * queries * width * blocks * kernel.ROWS < _TEAM_WORDS:
        threads = 1
    if 1 < threads <= len(shares):
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda share: kernel.recall(sizes, addresses, options, share), shares))
        return
    for share in shares:
        if threads == 1:
            kernel.recall(sizes, addresses, options, share)
        else:
            _recall_by_team(threads, sizes, addresses, options, share)


def _recall_by_team(threads: int, *arguments: Any) -> None:
    """``recall`` with the blocks of the memory divided among threads."""
    job = kernel.prepare(threads, *arguments)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda part: kernel.compare(job, part), range(threads)))
        kernel.weigh(job)
        list(pool.map(lambda part: kernel.add(job, part), range(threads)))
    kernel.join(job)
