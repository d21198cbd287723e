"""The layer needs torch and numpy alone, and its first recall does not wait for a compiler."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = "numba llvmlite scipy pandas draccus safetensors mujoco matplotlib lerobot pyarrow"

WITHOUT_NUMBA = """
import importlib.util, sys, warnings
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "numba" else find_spec(name, *more)
sys.modules["numba"] = sys.modules["llvmlite"] = None
"""
LAYER = """
import torch
from hasm_torch import HeteroAssociativeMemory
generator = torch.Generator().manual_seed(0)
codes = torch.randint(0, 2, (500, 90), generator=generator) * 2.0 - 1.0
values = torch.randn(500, 7, generator=generator)
memory = HeteroAssociativeMemory(90, 7, 500, beta=0.2, storage="bit")
memory.write(codes, torch.ones_like(codes), values)
noisy = torch.where(torch.rand(64, 90, generator=generator) < 0.1, -codes[:64], codes[:64])
"""
EXPECTED = """
weights = torch.softmax(0.2 * noisy.double() @ codes.double().T, dim=-1)
expected = weights @ values.double()
"""


def run(code: str, cache: Path | None = None) -> str:
    """What a fresh process prints, which finds compiled kernels in a cache or where they are."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_loads_torch_and_numpy_alone():
    code = f"import hasm_torch, sys; print([m for m in '{HEAVY}'.split() if m in sys.modules])"
    assert run(code).strip() == "[]"


def test_first_recall_does_not_wait_and_agrees_with_the_compiled_one(tmp_path):
    code = f"""{LAYER}{EXPECTED}
import threading
first, inspected, weighed = memory.recall(noisy), memory.inspect(noisy), memory.weights(noisy)
meanwhile = [thread.name for thread in threading.enumerate()]
from hasm_torch.memory.recall import warm_up
warm_up()
for early in (first, inspected.decision, memory.recall(noisy)):
    torch.testing.assert_close(early.double(), expected, atol=1e-5, rtol=1e-5)
torch.testing.assert_close(weighed.double(), weights, atol=1e-6, rtol=1e-5)
torch.testing.assert_close(memory.inspect(noisy).match, inspected.match)
print("hasm-kernel" in meanwhile)
"""
    assert run(code, tmp_path).strip() == "True"


def test_without_numba_everything_runs_and_says_so_once():
    code = f"""{WITHOUT_NUMBA}{LAYER}{EXPECTED}
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    recalled = [memory.recall(noisy) for _ in range(3)]
torch.testing.assert_close(recalled[-1].double(), expected, atol=1e-5, rtol=1e-5)
print(len(told), "hasm-torch[fast]" in str(told[0].message))
"""
    assert run(code).strip() == "1 True"


@pytest.mark.parametrize("drive", ["spike", "auto"])
def test_without_numba_the_model_learns_and_moves_as_with_it(drive):
    code = f"""
import numpy as np, torch
from hasm_torch import HASM, Body, HASMConfig
from hasm_torch.episode import Episode
turn = [*np.eye(3).ravel().tolist(), 0.0, 0.0, 1.0, 0.0, 1.0, 0.0]
body = Body(["joint"], [0.0], [1.0], [1.0], ["patch"], [1], [[1.0, 0.0, 0.0]],
            links=["link"], chains={{"link": [turn]}})
way = np.linspace(0.2, 0.8, 20, dtype=np.float32)[:, None]
touch = np.full((20, 1, 3), 3.0, np.float32)
episodes = [Episode(i, "", np.arange(20) / body.rate, way, way, touch) for i in range(2)]
model = HASM(HASMConfig(drive={drive!r}), body)
model.fit(episodes)
for _ in range(10):
    target = model.step(torch.tensor([0.4]), torch.full((1, 3), 3.0))
print(float(target[0]))
"""
    with_numba, without = (float(run(x)) for x in (code, WITHOUT_NUMBA + code))
    assert with_numba == pytest.approx(without, abs=1e-5)
    assert with_numba > 0.41
