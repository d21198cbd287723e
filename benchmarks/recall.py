"""Time recall from a packed memory against what else computes or approximates it.

uv run benchmarks/recall.py --output_dir=outputs/benchmarks/recall

One process times all contestants in turn, round after round, and reports medians. torchhd and
faiss-cpu are used where they are installed. Writes a table, recall.json and recall.png.
"""

import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import print_machine, save_json
from hasm_torch.apps.command_line import parse_options
from hasm_torch.memory.recall import Stored, recall_packed, unpack, warm_up

VALUES = 8  # joints
BETA = 1.0
FLIPPED = 0.1  # share of a query's entries that differ from the stored code
OURS, FP32, BF16 = "hasm_torch packed", "torch float32", "torch bfloat16"
SDPA, TORCHHD, FAISS = "torch SDPA", "torchhd attention", "FAISS binary top-64"
COPY = "copy of the packed memory"
PAUSE = 0.003  # s; lets the threads of the contestant before go to sleep
BURST = 0.002  # s; fast calls are timed several at a time

Contestants = dict[str, Callable[[], Any]]


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        quick: A few sizes, a few rounds.
        output_dir: Where the results go.
    """

    quick: bool = False
    output_dir: Path = Path("outputs/benchmarks/recall")


@dataclass
class Result:
    """Times of one contestant on one memory."""

    device: str
    rows: int
    dim: int
    batch: int
    contestant: str
    seconds: float  # median of a call
    fastest: float  # s
    packed_bytes: int
    difference_to_float32: float | None


def main() -> None:
    """Time every size, print tables, write the results and their figure."""
    options = parse_options(Options)
    print_machine()
    warm_up()
    rounds = 5 if options.quick else 15
    results: list[Result] = []
    with torch.inference_mode():
        for device in ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]:
            for dim, rows in sizes(device, options.quick):
                results += run_size(device, dim, rows, options.quick, rounds)
                gc.collect()
    summarise(results)
    content = {"beta": BETA, "results": [asdict(result) for result in results]}
    print(save_json(options.output_dir, "recall", content))
    plot(results, options.output_dir / "recall.png")
    print(options.output_dir / "recall.png")


def sizes(device: str, quick: bool) -> Iterator[tuple[int, int]]:
    """Code lengths and numbers of associations, the largest last."""
    rows = [2_000, 100_000, 1_000_000] if quick else [2_000, 10_000, 100_000, 300_000, 1_000_000]
    if device == "cuda":
        rows += [10_000_000] if quick else [10_000_000, 100_000_000, 1_000_000_000]
    for dim in [400] if quick else [200, 400, 1024]:
        yield from ((dim, row) for row in rows)
    if quick:
        yield 200, 2_000


def run_size(device: str, dim: int, rows: int, quick: bool, rounds: int) -> list[Result]:
    """Times every contestant on one memory, for each batch size."""
    packed_bytes = -(-rows // 64) * 64 * (-(-dim // 32) * 4 + VALUES * 4)
    if packed_bytes * 3 > free_bytes(device):
        print(f"{device}: {rows} x {dim} does not fit, skipped")
        return []
    generator = torch.Generator(device).manual_seed(0)
    words = torch.empty(-(-rows // 64), -(-dim // 32), 64, dtype=torch.int32, device=device)
    words.random_(-(2**31), 2**31, generator=generator)
    if dim % 32:  # entries past the code are zero
        words[:, -1] &= (1 << dim % 32) - 1
    successors = torch.randn(rows, VALUES, generator=generator, device=device)
    count = torch.tensor(rows, device=device)
    beta = torch.tensor(BETA, device=device)
    # Room for the codes in float32 and bfloat16, and for what their users copy.
    codes = codes_of(words, rows, dim) if rows * dim * 12 < free_bytes(device) else None

    target = torch.empty_like(words)
    results: list[Result] = []
    for batch in [1, 1024] if quick else [1, 16, 1024]:
        if batch * rows > 1_024 * 100_000:
            continue
        picked = torch.randint(rows, (batch,), generator=generator, device=device)
        query = torch.stack([row_of(words, int(row), dim) for row in picked])
        flip = torch.rand(query.shape, generator=generator, device=device) < FLIPPED
        query = torch.where(flip, -query, query)

        contestants: Contestants = {
            OURS: partial(recall_packed, query, Stored(words, successors, beta, count)),
            COPY: lambda: target.copy_(words),
        }
        if codes is not None:
            contestants |= dense_contestants(query, codes, successors)
            expected = contestants[FP32]()
            difference = float((contestants[OURS]() - expected).abs().max())
        else:
            difference = float("nan")
        if device == "cpu":
            contestants |= faiss_contestant(query, words, dim, rows)
        for name, samples in measure(contestants, device, rounds).items():
            results.append(
                Result(
                    device,
                    rows,
                    dim,
                    batch,
                    name,
                    statistics.median(samples),
                    min(samples),
                    words.nbytes,
                    difference if name == OURS else None,
                )
            )
        print_size(results, device, rows, dim, batch)
    return results


def free_bytes(device: str) -> int:
    """Memory that is free."""
    if device == "cuda":
        return torch.cuda.mem_get_info()[0]
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        lines = dict(line.split(":") for line in meminfo.read_text().splitlines())
        return int(lines["MemAvailable"].split()[0]) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def codes_of(words: Tensor, rows: int, dim: int) -> Tensor:
    """The codes in float32, (rows, dim), unpacked part by part."""
    codes = torch.empty(rows, dim, device=words.device)
    for part in torch.arange(len(words)).split(1024):
        start = int(part[0]) * 64
        unpacked = unpack(words[part[0] : part[-1] + 1], dim)
        codes[start : start + len(unpacked)] = unpacked[: rows - start]
    return codes


def row_of(words: Tensor, row: int, dim: int) -> Tensor:
    """One code, (dim,)."""
    return unpack(words[row // 64 : row // 64 + 1], dim)[row % 64]


def dense_contestants(query: Tensor, codes: Tensor, successors: Tensor) -> Contestants:
    """What recalls from unpacked codes."""
    half, narrow = codes.to(torch.bfloat16), query.to(torch.bfloat16)
    contestants: Contestants = {
        FP32: lambda: torch.softmax(BETA * (query @ codes.mT), -1) @ successors,
        BF16: lambda: torch.softmax(BETA * (narrow @ half.mT).float(), -1) @ successors,
        SDPA: lambda: torch.nn.functional.scaled_dot_product_attention(
            query[None], codes[None], successors[None], scale=BETA
        ),
    }
    try:
        from torchhd.memory import attention
    except ImportError:
        _note("torchhd is not installed (pip install torch-hd): left out")
    else:
        contestants[TORCHHD] = lambda: attention(query, codes, successors, BETA)
    return contestants


def faiss_contestant(query: Tensor, words: Tensor, dim: int, rows: int) -> Contestants:
    """An approximation: the 64 nearest associations, without the softmax over them."""
    try:
        import faiss
    except ImportError:
        _note("FAISS is not installed (pip install faiss-cpu): left out")
        return {}
    faiss.omp_set_num_threads(torch.get_num_threads())
    index = faiss.IndexBinaryFlat(dim)
    for part in words.split(1024):
        stored = part.mT.contiguous().view(torch.uint8).flatten(0, 1)[:, : dim // 8]
        index.add(stored[: rows - index.ntotal].contiguous().numpy())
    bits = (query >= 0).view(len(query), -1, 8).to(torch.uint8) << torch.arange(8).to(torch.uint8)
    packed = bits.sum(-1, dtype=torch.uint8).numpy()
    return {FAISS: lambda: index.search(packed, 64)}


def measure(contestants: Contestants, device: str, rounds: int) -> dict[str, list[float]]:
    """Seconds a call, one sample a round; the contestants take turns."""
    samples: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(rounds + 1):
        for name, call in contestants.items():
            expected = samples[name][-1] if samples[name] else 1.0
            if turn > 2 and expected > 1.0:
                continue  # three samples of a slow one are enough
            time.sleep(PAUSE)
            if expected < 0.05:
                call()  # wakes the threads
            repeats = max(1, min(50, int(BURST / expected)))
            synchronise(device)
            start = time.perf_counter()
            for _ in range(repeats):
                call()
            synchronise(device)
            samples[name].append((time.perf_counter() - start) / repeats)
    return {name: times[1:] for name, times in samples.items()}  # the first turn warms up


def synchronise(device: str) -> None:
    """Waits for the GPU."""
    if device == "cuda":
        torch.cuda.synchronize()


def print_size(results: list[Result], device: str, rows: int, dim: int, batch: int) -> None:
    """One block of the table."""
    found = {r.contestant: r for r in results if r.batch == batch}
    ours = found[OURS].seconds
    difference = found[OURS].difference_to_float32
    print(f"\n{device}  K = {rows:,}  D = {dim}  batch {batch}  (differs by {difference:.1e})")
    for name, result in found.items():
        seconds, fastest = result.seconds, result.fastest
        print(
            f"  {name:<26}{seconds * 1e3:12.3f} ms (fastest {fastest * 1e3:10.3f})"
            f"{seconds / ours:9.2f} x ours"
        )


def summarise(results: list[Result]) -> None:
    """Prints how recall grows with the memory, next to reading it at copy bandwidth."""
    times = {(r.device, r.dim, r.rows, r.contestant): r for r in results if r.batch == 1}
    for device, dim in sorted({key[:2] for key in times}):
        sizes_run = sorted({key[2] for key in times if key[:2] == (device, dim)})
        few, many = (100_000, sizes_run[-1])
        if few not in sizes_run or many <= few:
            continue
        first, last = (times[device, dim, rows, OURS] for rows in (few, many))
        slope = (last.seconds - first.seconds) / (many - few)
        copying = times[device, dim, many, COPY]
        print(
            f"\n{device}  D = {dim}: {slope * 1e9:.2f} ns an association from {few:,} to {many:,}; "
            f"reading it at copy bandwidth takes {reading(copying) / many * 1e9:.2f} ns"
        )


def reading(copying: Result) -> float:
    """Seconds to read the packed memory once at the bandwidth of a copy, which also writes it."""
    return copying.seconds / 2


def plot(results: list[Result], path: Path) -> None:
    """Time a recall over the number of associations, log-log, by batch and code length."""
    from matplotlib.figure import Figure

    panels = sorted({(r.device, r.batch, r.dim) for r in results})
    dims = sorted({dim for _, _, dim in panels})
    lines = sorted({(device, batch) for device, batch, _ in panels})
    figure = Figure(figsize=(4.5 * len(dims), 3.5 * len(lines)), layout="constrained")
    axes = figure.subplots(len(lines), len(dims), squeeze=False, sharex=True)
    for device, batch, dim in panels:
        panel = axes[lines.index((device, batch))][dims.index(dim)]
        chosen = [r for r in results if (r.device, r.batch, r.dim) == (device, batch, dim)]
        for name in dict.fromkeys(r.contestant for r in chosen):
            points = sorted((r.rows, r.seconds) for r in chosen if r.contestant == name)
            if name == COPY:
                rows, seconds = points[-1]
                label = "packed memory read at copy bandwidth"
                ends = [points[0][0], rows]
                limit = [seconds / 2 / rows * end * 1e3 for end in ends]
                panel.plot(ends, limit, "k--", label=label)
            else:
                style = {"linewidth": 2.5, "zorder": 3} if name == OURS else {}
                rows_run, seconds_run = zip(*points, strict=True)
                panel.plot(rows_run, [s * 1e3 for s in seconds_run], "o-", label=name, **style)
        panel.set(xscale="log", yscale="log", title=f"{device}, {dim} entries, batch {batch}")
        panel.set(xlabel="associations stored", ylabel="time of a batch (ms)")
        panel.grid(alpha=0.3)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=150)


_noted: set[str] = set()


def _note(text: str) -> None:
    if text not in _noted:
        _noted.add(text)
        print(text)


if __name__ == "__main__":
    main()
