"""Sparsemax, entmax15 and top-k recall against thresholds found by bisection in NumPy."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch import HeteroAssociativeMemory, functional
from hasm_torch.encoders.bipolar import binarise
from hasm_torch.memory.recall import (
    Stored,
    inspect_packed,
    pack,
    recall_packed,
    weights_dense,
    weights_packed,
)

SPARSE = ("sparsemax", "entmax15")
STORAGES = ("float32", "int8", "bit")


def bisected(z: np.ndarray, interaction: str) -> np.ndarray:
    """[z/p − τ]₊^p with the τ at which the weights sum to one, by halving an interval."""
    power = {"sparsemax": 1, "entmax15": 2}[interaction]
    x = z / power
    low, high = x.max() - 1.0, x.max()
    for _ in range(200):
        middle = (low + high) / 2
        if (np.maximum(x - middle, 0.0) ** power).sum() > 1.0:
            low = middle
        else:
            high = middle
    return np.maximum(x - low, 0.0) ** power


def expected_weights(scores, beta, interaction, top_k=None, taking_part=None):
    """Weights of one query's scores (rows,), float64."""
    z = beta * scores
    allowed = np.ones(len(z), bool) if taking_part is None else taking_part.copy()
    if top_k is not None:
        order = -scores if beta < 0 else scores
        ranked = np.sort(order[allowed])[::-1]
        allowed &= order >= ranked[min(top_k, len(ranked)) - 1]
    weights = np.zeros(len(z))
    if interaction == "softmax":
        weights[allowed] = np.exp(z[allowed] - z[allowed].max())
        weights /= weights.sum()
    else:
        weights[allowed] = bisected(z[allowed], interaction)
    return weights


def dense_weights(scores, beta, interaction, top_k=None):
    """Weights that the library gives to scores (rows,)."""
    rows = scores[:, None]
    memory = Stored(rows, rows, beta, interaction=interaction, top_k=top_k)
    return weights_dense(torch.ones_like(scores[:1]), memory)


@settings(max_examples=60, deadline=None)
@given(
    interaction=st.sampled_from(["softmax", *SPARSE]),
    storage=st.sampled_from(STORAGES),
    rows=st.integers(1, 3000),
    dim=st.integers(1, 90),
    beta=st.sampled_from([-0.2, 0.0, 1e-3, 0.02, 0.1, 0.5, 3.0, 50.0]),
    top_k=st.sampled_from([None, None, 1, 7, 256]),
    masked=st.booleans(),
    seed=st.integers(0, 2**16),
)
def test_recall_with_few_associations(interaction, storage, rows, dim, beta, top_k, masked, seed):
    rng = np.random.default_rng(seed)
    codes = np.where(rng.random((rows, dim)) < 0.5, 1.0, -1.0)
    values = rng.standard_normal((rows, 2))
    query = codes[rng.integers(rows)] * np.where(rng.random((2, dim)) < 0.15, -1, 1)
    mask = rng.random((2, rows + 3)) < (0.4 if masked else 1.1)
    mask[:, rng.integers(rows)] = True
    memory = HeteroAssociativeMemory(
        dim, 2, rows + 3, beta=beta, storage=storage, interaction=interaction, top_k=top_k
    )
    memory.beta = memory.beta.double().fill_(beta)
    memory.write(torch.tensor(codes), torch.ones(rows, dim), torch.tensor(values))
    asked = torch.tensor(query).float(), torch.tensor(mask) if masked else None
    found, weights = memory.inspect(*asked), memory.weights(*asked).numpy()
    torch.testing.assert_close(memory.recall(*asked), found.decision)
    assert weights.shape == (2, rows + 3)
    assert not weights[:, rows:].any()
    for number in range(2):
        scores, taking_part = codes @ query[number], mask[number, :rows]
        expected = expected_weights(scores, beta, interaction, top_k, taking_part)
        np.testing.assert_allclose(weights[number, :rows], expected, atol=2e-6)
        np.testing.assert_allclose(found.decision[number], expected @ values, atol=2e-5)
        ranked = np.where(taking_part, np.sign(beta or 1.0) * scores, -np.inf)
        assert int(found.match[number]) == ranked.argmax()
        assert float(found.score[number]) == scores[ranked.argmax()]
        entropy = -sum(w * np.log(w) for w in expected if w > 0)
        np.testing.assert_allclose(float(found.entropy[number]), entropy, atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(
    interaction=st.sampled_from(SPARSE),
    rows=st.integers(1, 20_000),
    spread=st.sampled_from([1e-6, 1e-3, 0.1, 1.0, 30.0]),
    seed=st.integers(0, 2**16),
)
def test_weights_of_real_scores_from_one_to_all_of_many_rows(interaction, rows, spread, seed):
    scores = np.random.default_rng(seed).standard_normal(rows)
    expected = expected_weights(scores, spread, interaction)
    found = dense_weights(torch.tensor(scores), spread, interaction)
    np.testing.assert_allclose(found, expected, atol=1e-11)
    single = dense_weights(torch.tensor(scores).float(), spread, interaction)
    np.testing.assert_allclose(single, expected, atol=3e-6)


def test_two_and_three_associations_by_hand():
    # Sparsemax of (0.6, 0): τ = -0.2; entmax15 of (1.2, 0): x = 0.6 and 0, (0.6 - τ)² + τ² = 1.
    pair = torch.tensor([1.0, 0.0])
    found = dense_weights(pair, 0.6, "sparsemax")
    torch.testing.assert_close(found, torch.tensor([0.8, 0.2]))
    tau = 0.3 - (0.5 - 0.3**2) ** 0.5
    found = dense_weights(pair, 1.2, "entmax15")
    torch.testing.assert_close(found, torch.tensor([(0.6 - tau) ** 2, tau**2]))
    found = dense_weights(torch.tensor([2.0, 1.0, 1.0]), 9.0, "softmax", 2)
    rest = torch.tensor(9.0).exp()
    torch.testing.assert_close(found, torch.stack([rest, rest / rest, rest / rest]) / (rest + 2))


@pytest.mark.parametrize("interaction", ["softmax", *SPARSE])
@pytest.mark.parametrize("storage", STORAGES)
def test_from_the_mean_of_all_to_the_best_alone(interaction, storage):
    codes = binarise(torch.randn(50, 40, generator=torch.Generator().manual_seed(0)))
    values = torch.arange(50.0)[:, None]
    memory = HeteroAssociativeMemory(40, 1, 60, storage=storage, interaction=interaction)
    memory.write(codes, torch.ones(50, 40), values)
    for beta, expected in ((0.0, torch.tensor([24.5, 24.5])), (torch.inf, torch.tensor([3.0, 9]))):
        memory.beta.fill_(beta)
        torch.testing.assert_close(memory.recall(codes[[3, 9]])[:, 0], expected)


@pytest.mark.parametrize("interaction", SPARSE)
@pytest.mark.parametrize("top_k", [None, 4])
def test_gradients_of_every_input(interaction, top_k):
    generator = torch.Generator().manual_seed(0)
    query, stored, successor = (
        torch.randn(*shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((2, 3, 6), (2, 9, 6), (2, 9, 2))
    )
    beta = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    mask = torch.rand(2, 3, 9, generator=generator) < 0.8

    def recall(*inputs):
        return functional.recall(*inputs, mask, interaction, top_k)

    weighing = (
        weights_dense(query, Stored(stored, stored, beta, interaction=interaction)) > 0
    ).sum(-1)
    assert weighing.min() < weighing.max() < 9  # several supports, none of them all rows
    assert torch.autograd.gradcheck(recall, (query, stored, successor, beta))
    assert torch.autograd.gradgradcheck(recall, (query, stored, successor, beta), fast_mode=True)


@pytest.mark.parametrize("interaction", SPARSE)
def test_gradients_of_a_packed_memory(interaction):
    generator = torch.Generator().manual_seed(1)
    codes = binarise(torch.randn(2, 90, 50, generator=generator))
    query, words = codes[:, :3] * 1.0, pack(codes)
    successors = torch.randn(2, 90, 4, generator=generator, dtype=torch.float64)
    limits = torch.tensor([90, 61]), torch.rand(2, 3, 90, generator=generator) < 0.6
    beta = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)

    def recall(beta, successors):
        return recall_packed(query, Stored(words, successors, beta, *limits, interaction))

    assert torch.autograd.gradcheck(recall, (beta, successors.requires_grad_()))


@pytest.mark.parametrize("interaction", [*SPARSE, "exponential", 3])
def test_a_packed_memory_for_every_sample_equals_a_dense_one(interaction):
    generator = torch.Generator().manual_seed(2)
    codes = binarise(torch.randn(3, 2, 150, 40, generator=generator))
    query = binarise(torch.randn(3, 2, 4, 40, generator=generator))
    values = torch.randn(3, 2, 150, 5, generator=generator)
    count = torch.randint(1, 151, (3, 2), generator=generator)
    found = recall_packed(query, Stored(pack(codes), values, 0.1, count, None, interaction, 20))
    for place in np.ndindex(3, 2):
        held = int(count[place])
        one = codes[place][:held], values[place][:held]
        alone = functional.recall(query[place], *one, 0.1, interaction=interaction, top_k=20)
        torch.testing.assert_close(found[place], alone, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("interaction", SPARSE)
def test_a_query_that_may_recall_nothing_gives_nan(interaction):
    codes, values = binarise(torch.randn(5, 40)), torch.ones(5, 2)
    mask = torch.tensor([[False] * 5, [False, True, False, True, False]])
    packed = inspect_packed(
        codes[:2], Stored(pack(codes), values, 1.0, mask=mask, interaction=interaction)
    )
    assert packed.match.tolist()[0] == -1
    assert packed.decision[0].isnan().all()
    torch.testing.assert_close(packed.decision[1], torch.ones(2))
    weights = weights_packed(codes[:2], Stored(pack(codes), values, 1.0, None, mask, interaction))
    assert weights[0].isnan().all()
    assert functional.recall(codes[:2], codes, values, 1.0, mask, interaction)[0].isnan().all()


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("interaction", SPARSE)
def test_compiles_exports_and_maps(storage, interaction):
    torch._dynamo.reset()
    memory = HeteroAssociativeMemory(
        48, 3, 64, beta=0.1, storage=storage, interaction=interaction, top_k=9
    )
    compiled = torch.compile(memory.recall, fullgraph=True, backend="aot_eager")
    generator = torch.Generator().manual_seed(0)
    codes, values = (torch.randn(64, n, generator=generator) for n in (48, 3))
    query = torch.randn(5, 48, generator=generator)
    with torch._dynamo.config.patch(error_on_recompile=True):
        for part in torch.arange(64).split(16):
            memory.write(codes[part], torch.ones(16, 48), values[part])
            torch.testing.assert_close(compiled(query), memory.recall(query))
    program = torch.export.export(memory, (query, query.sign()))
    other = torch.randn(5, 48, generator=generator)
    torch.testing.assert_close(program.module()(other, query), memory(other, query))
    if storage != "bit":
        mapped = torch.func.vmap(memory.recall)(query)
        torch.testing.assert_close(mapped, memory.recall(query))
