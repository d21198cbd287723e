"""What the benchmarks share: the machine they ran on, interleaved timing and result files."""

import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

RESULTS = Path(__file__).parent / "results"


def machine() -> dict[str, str | int]:
    """CPU, GPU, threads and versions, as printed with every result."""
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        cpu = names[0].partition(":")[2].strip() if names else cpu
    gpu = {"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}
    return {
        "cpu": cpu,
        **gpu,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def print_machine() -> None:
    """Print the machine on one line."""
    print(", ".join(f"{name} {value}" for name, value in machine().items()))


def interleaved(
    calls: dict[str, Callable[[], Any]], rounds: int, repeats: int = 1
) -> dict[str, np.ndarray]:
    """Time some calls in turn, so that other load on the machine meets all of them.

    Args:
        calls: What to time, by name; each is called once before timing starts.
        rounds: How often the whole list is gone through.
        repeats: How often a call is made within one timing.

    Returns:
        For each name (rounds,) seconds of one call.
    """
    for call in calls.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.perf_counter()
            for _ in range(repeats):
                call()
            seconds[name].append((time.perf_counter() - start) / repeats)
    return {name: np.array(values) for name, values in seconds.items()}


def save_json(directory: str | Path, name: str, content: dict[str, Any]) -> Path:
    """Write a result with the machine it was measured on, and return where it lies."""
    path = Path(directory) / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"machine": machine(), **content}, indent=2) + "\n")
    return path
