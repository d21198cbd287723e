"""Runs the packed scan on the CPU, on the threads torch uses.

The compiled functions are called by address. Large memories are scanned by a team of threads:
torch's own OpenMP team where its runtime is reachable, so that no second pool of threads competes
with it, and Python threads elsewhere.
"""

import ctypes
import functools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

# A team is worth waking to compare at least so many 32-bit words, about 0.1 ms of one thread.
_TEAM_WORDS = 1 << 20

_CPU = torch.device("cpu")

Team = Callable[[int, int, int], None]  # (address of the function, address of its job, threads)


class _Kernel(NamedTuple):
    job: Callable[..., ctypes.Structure]
    begin: Callable[[int], None]
    scan: Callable[[int], None]
    scan_address: int
    finish: Callable[[int], None]
    state_entries: Callable[[int], int]
    buffer_entries: int
    team: Team


@functools.cache
def _load_kernel() -> _Kernel:
    """Compiles the kernel, or loads it from numba's cache."""
    from hasm_torch.memory.recall import packed_kernel as kernel

    kinds = {"i8": ctypes.c_int64, "f8": ctypes.c_double}
    fields = [(name, kinds[kind]) for name, kind in kernel.JOB_FIELDS]
    steps = (kernel.begin, kernel.scan, kernel.finish)
    begin, scan, finish = (int(step.address or 0) for step in steps)
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
    return _Kernel(
        job=type("Job", (ctypes.Structure,), {"_fields_": fields}),
        begin=call(begin),
        scan=call(scan),
        scan_address=scan,
        finish=call(finish),
        state_entries=kernel.state_entries,
        buffer_entries=kernel.BUFFER_ENTRIES,
        team=_openmp_team() or _python_team,
    )


def _openmp_team() -> Team | None:
    """The fork of the OpenMP runtime torch has loaded, if it has the GNU entry point."""
    already_loaded = getattr(os, "RTLD_NOLOAD", None)
    if already_loaded is None:
        return None
    shipped = Path(torch.__file__).parent.glob("lib/lib*omp*")
    for library in (*map(str, shipped), "libgomp.so.1", "libiomp5.so", "libomp.so.5"):
        try:
            fork = ctypes.CDLL(library, mode=already_loaded | os.RTLD_NOW).GOMP_parallel
        except (OSError, AttributeError):
            continue
        fork.restype = None
        fork.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
        return lambda function, job, threads: fork(function, job, threads, 0)
    return None


def _python_team(function: int, job: int, threads: int) -> None:
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(function)
    helpers = [threading.Thread(target=call, args=(job,)) for _ in range(threads - 1)]
    for helper in helpers:
        helper.start()
    call(job)
    for helper in helpers:
        helper.join()


def scan_cpu(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: float,
    count: Tensor,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Recalls from a packed memory; shapes as in ``recall_packed``, tensors contiguous.

    Args:
        query: (*batch, ..., dim) float32.
        words: (*batch, blocks, width, 64) int32.
        successors: (*batch, rows, values) float32.
        beta: Inverse temperature, not NaN.
        count: (*batch,) int64.
        mask: (*batch, ..., rows) bool.

    Returns:
        Decision (*batch, ..., values); row of the best match (*batch, ...) int64; its score, its
        margin and the entropy of the weights, (3, *batch, ...).
    """
    kernel = _load_kernel()
    leading, dim = query.shape[:-1], query.shape[-1]
    blocks, width = words.shape[-3:-1]
    rows, values = successors.shape[-2:]
    memories = count.numel()
    total = query.numel() // dim
    live = int(count) if memories == 1 else int(count.max())
    compared = total * width * live
    threads = torch.get_num_threads() if compared >= _TEAM_WORDS else 1

    decision = torch.empty(*leading, values, dtype=torch.float32, device=_CPU)
    match = torch.empty(leading, dtype=torch.int64, device=_CPU)
    certainty = torch.empty(3, *leading, dtype=torch.float32, device=_CPU)
    if total == 0:
        return decision, match, certainty

    # Scratch, in float64 entries: packed queries, states, buffers.
    states = -(-total * width // 2)
    buffers = states + threads * total * kernel.state_entries(values)
    scratch = torch.empty(
        buffers + threads * kernel.buffer_entries, dtype=torch.float64, device=_CPU
    )
    place = scratch.data_ptr()
    job = kernel.job(
        next_task=0,
        query=query.data_ptr(),
        words=words.data_ptr(),
        successors=successors.data_ptr(),
        counts=count.data_ptr(),
        mask=0 if mask is None else mask.data_ptr(),
        decision=decision.data_ptr(),
        match=match.data_ptr(),
        certainty=certainty.data_ptr(),
        signs=place,
        states=place + 8 * states,
        buffers=place + 8 * buffers,
        memories=memories,
        queries=total // memories,
        dim=dim,
        values=values,
        rows=rows,
        blocks=blocks,
        threads=threads,
        beta=beta,
    )
    address = ctypes.addressof(job)
    kernel.begin(address)
    if threads == 1:
        kernel.scan(address)
    else:
        kernel.team(kernel.scan_address, address, threads)
    kernel.finish(address)
    return decision, match, certainty
