"""Recall on a GPU against the CPU's scan, and the Triton kernel in its interpreter without one."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch

from hasm_torch.memory.recall import Stored, inspect_packed, pack

# (batch, rows, dim, queries, values, beta, masked)
CASES = [
    ((), 1, 1, 1, 1, 1.0, False),
    ((), 70, 33, 3, 5, 0.1, True),
    ((2,), 700, 200, 2, 8, 3.0, True),
    ((3,), 300, 64, 2, 3, -0.05, False),
    ((), 600, 40, 2, 3, 0.0, False),
    ((), 600, 31, 2, 9, 50.0, True),
    ((), 600, 31, 2, 9, float("inf"), False),
]


def draw(batch, rows, dim, queries, values, beta, masked):
    generator = torch.Generator().manual_seed(rows + dim)
    codes, query = (
        torch.randint(0, 2, (*batch, n, dim), generator=generator) * 2.0 - 1.0
        for n in (rows, queries)
    )
    mask = None
    if masked:
        mask = torch.rand(*batch, queries, rows, generator=generator) < 0.5
        mask[..., 0, :] = False
    return query, Stored(
        pack(codes),
        torch.randn(*batch, rows, values, generator=generator),
        torch.tensor(beta),
        torch.randint(1, rows + 1, batch, generator=generator),
        mask,
    )


def assert_same(found, expected):
    for left, right in zip(found, expected, strict=True):
        torch.testing.assert_close(left.cpu(), right, atol=1e-5, rtol=1e-5, equal_nan=True)


def on_gpu(memory):
    return Stored(*(part.cuda() if torch.is_tensor(part) else part for part in memory))


def compare_interpreted():
    from hasm_torch.memory.recall.packed import _distances, _pack_codes
    from hasm_torch.memory.recall.packed_gpu import distances_gpu

    for case in CASES:
        query, memory = draw(*case)
        packed = _pack_codes(query), memory.associations
        assert torch.equal(distances_gpu(*packed), _distances(*packed))


@pytest.mark.skipif(find_spec("triton") is None, reason="needs Triton")
def test_interpreted_kernels_agree_with_the_cpu():
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    ran = subprocess.run(
        [sys.executable, __file__], env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("interaction", ["softmax", "sparsemax", "entmax15"])
@pytest.mark.parametrize("case", CASES)
def test_the_gpu_agrees_with_the_cpu(case, interaction):
    query, memory = draw(*case)
    memory = memory._replace(interaction=interaction)
    assert_same(inspect_packed(query.cuda(), on_gpu(memory)), inspect_packed(query, memory))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_large_memory_on_the_gpu():
    query, memory = draw((), 200_001, 400, 40, 8, 0.2, False)
    assert_same(inspect_packed(query.cuda(), on_gpu(memory)), inspect_packed(query, memory))


if __name__ == "__main__":
    compare_interpreted()
