"""Dense associative sequence memories hold as much as published theory and simulation say."""

import json
import math

import numpy as np
import pytest
import torch

from benchmarks import capacity
from hasm_torch import HeteroAssociativeMemory, to_bipolar

SEQUENCES = [(1, 20, 6), (2, 30, 25), (3, 20, 40), ("exponential", 10, 30)]


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the matrices are small
    yield
    torch.set_num_threads(threads)


def sequence(length: int, neurons: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return to_bipolar(torch.randint(0, 2, (length, neurons), generator=generator), torch.float64)


def next_by_definition(patterns: np.ndarray, state: np.ndarray, f, own_term: bool) -> np.ndarray:
    """sgn Σ_μ ξᵢ^(μ+1) f(Σ_(j≠i) ξⱼ^μ xⱼ), entry by entry; matches are whole numbers."""
    following = np.roll(patterns, -1, axis=0)
    decision = np.zeros(len(state))
    for i in range(len(state)):
        for mu in range(len(patterns)):
            match = sum(patterns[mu, j] * state[j] for j in range(len(state)) if own_term or j != i)
            decision[i] += following[mu, i] * f(match)
    return np.where(np.abs(decision) > 1e-6, np.sign(decision), 0)


@pytest.mark.parametrize(("interaction", "neurons", "length"), SEQUENCES)
@pytest.mark.parametrize("own_term", [False, True])
def test_a_step_of_recall_is_the_definition(interaction, neurons, length, own_term):
    patterns = sequence(length, neurons, seed=1)
    memory = capacity.sequence_memory(patterns, interaction)
    queries = torch.cat([patterns[:3], sequence(3, neurons, seed=2)])
    f = math.exp if interaction == "exponential" else lambda match: match**interaction
    expected = [next_by_definition(patterns.numpy(), q, f, own_term) for q in queries.numpy()]
    found = capacity.next_pattern(memory, queries, own_term)
    np.testing.assert_array_equal(found.numpy(), np.array(expected))


def test_the_own_term_kept_is_a_plain_recall_of_the_layer():
    patterns = sequence(25, 30, seed=3)
    ones = torch.ones_like(patterns)
    memory = HeteroAssociativeMemory(30, 30, 25, interaction=2).double()
    memory.write_episodes(
        torch.cat([patterns, patterns[:1]]),
        ones[0].expand(26, -1),
        torch.cat([patterns, patterns[:1]]),
    )
    found = capacity.next_pattern(capacity.sequence_memory(patterns, 2), patterns, own_term=True)
    assert torch.equal(memory(patterns, ones).sign(), found)


def test_two_patterns_that_differ_in_one_entry_tie_there():
    patterns = torch.ones(2, 8, dtype=torch.float64)
    patterns[1, 3] = -1
    memory = capacity.sequence_memory(patterns, "exponential")
    expected = patterns.roll(-1, dims=0)
    expected[:, 3] = 0
    assert torch.equal(capacity.next_pattern(memory, patterns, own_term=False), expected)


def test_theory_is_the_published_one():
    tables = json.loads(capacity.REFERENCE.read_text())["theory"]
    for kind, table in tables.items():
        interaction = kind if kind == "exponential" else int(kind)
        for neurons, expected in table.items():
            assert capacity.theory(interaction, int(neurons)) == pytest.approx(expected, rel=5e-3)


def test_search_finds_a_sharp_capacity():
    for limit in (1, 2, 7, 99):
        assert capacity.capacity(lambda length, limit=limit: length <= limit) == limit


@pytest.mark.parametrize(("interaction", "neurons"), [(1, 50), (2, 50), ("exponential", 10)])
def test_capacity_in_one_set_is_the_simulated_one(interaction, neurons):
    (case,) = [
        case
        for case in capacity.reference_cases()
        if (case.interaction, case.neurons, case.sets) == (interaction, neurons, 1)
    ]
    with torch.no_grad():
        measured = capacity.measure(case, 8, torch.Generator().manual_seed(0))
    assert abs(capacity.standard_errors(measured, case)) < 3
