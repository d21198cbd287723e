"""Dense recall against a float64 NumPy reference written from d = S₋₁ softmax(β Mᵀ q)."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.memory.recall import Stored, inspect_dense, recall_dense, weights_dense


def reference(query, associations, successors, beta, taking_part=None):
    """Decision, weights and scores of one query (dim,), in float64."""
    scores = associations.astype(np.float64) @ query.astype(np.float64)
    logits = beta * scores
    if taking_part is not None:
        logits = np.where(taking_part, logits, -np.inf)
    weights = np.exp(logits - logits.max())
    weights /= weights.sum()
    return weights @ successors.astype(np.float64), weights, scores


def memory(seed, rows, dim, values, *batch, bipolar=True):
    rng = np.random.default_rng(seed)
    codes = rng.standard_normal((*batch, rows, dim))
    if bipolar:
        codes = np.where(codes >= 0, 1.0, -1.0)
    return codes, rng.standard_normal((*batch, rows, values)), rng


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**16),
    rows=st.integers(1, 70),
    dim=st.integers(1, 65),
    beta=st.sampled_from([-3.0, -0.1, 0.0, 1e-3, 0.1, 1.0, 10.0, 50.0]),
    data=st.data(),
)
def test_decision_matches_the_reference(seed, rows, dim, beta, data):
    codes, successors, rng = memory(seed, rows, dim, 3)
    count = data.draw(st.integers(1, rows))
    query = np.where(rng.random(dim) < 0.5, 1.0, -1.0)
    mask = rng.random(rows) < 0.7
    mask[rng.integers(count)] = True
    expected, weights, _ = reference(
        query, codes, successors, beta, mask & (np.arange(rows) < count)
    )
    arguments = (torch.from_numpy(codes).float(), torch.from_numpy(successors).float(), beta)
    limits = {"held": torch.tensor(count), "mask": torch.from_numpy(mask)}
    decision = recall_dense(torch.from_numpy(query).float(), Stored(*arguments, **limits))
    np.testing.assert_allclose(decision.numpy(), expected, atol=1e-5)
    found = weights_dense(
        torch.from_numpy(query).float(),
        Stored(arguments[0], arguments[0], beta, limits["held"], limits["mask"]),
    )
    np.testing.assert_allclose(found.numpy(), weights, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.int8])
def test_every_storage_of_bipolar_codes_decides_alike(dtype):
    # Sums of 701 entries exceed the 256 that bfloat16 counts to: scores must not be rounded to it.
    codes, successors, rng = memory(1, 300, 701, 4)
    query = codes[7] * np.where(rng.random(701) < 0.05, -1, 1)
    expected = reference(query, codes, successors, 0.02)[0]
    decision = recall_dense(
        torch.from_numpy(query).float(),
        Stored(torch.from_numpy(codes).to(dtype), torch.from_numpy(successors).float(), 0.02),
    )
    assert decision.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    np.testing.assert_allclose(decision.numpy(), expected, atol=1e-5)


def test_narrow_storage_is_widened_in_parts(monkeypatch):
    codes, successors, _ = memory(2, 50, 16, 2)
    monkeypatch.setattr("hasm_torch.memory.recall.dense._WIDENED_ENTRIES", 16 * 7)
    decision = recall_dense(
        torch.from_numpy(codes[3]).float(),
        Stored(torch.from_numpy(codes).to(torch.int8), torch.from_numpy(successors).float(), 0.3),
    )
    np.testing.assert_allclose(
        decision.numpy(), reference(codes[3], codes, successors, 0.3)[0], atol=1e-5
    )


def test_a_memory_for_every_sample_and_one_for_all():
    codes, successors, rng = memory(3, 20, 12, 3, 4, bipolar=False)
    query = rng.standard_normal((4, 5, 12))
    count = np.array([20, 1, 7, 13])
    mask = rng.random((4, 5, 20)) < 0.8
    mask[..., 0] = True
    decision = recall_dense(
        torch.from_numpy(query),
        Stored(
            *map(torch.from_numpy, (codes, successors)),
            0.7,
            held=torch.from_numpy(count),
            mask=torch.from_numpy(mask),
        ),
    )
    shared = recall_dense(
        torch.from_numpy(query), Stored(*map(torch.from_numpy, (codes[0], successors[0])), 0.7)
    )
    for sample in range(4):
        for number in range(5):
            part = mask[sample, number] & (np.arange(20) < count[sample])
            expected = reference(
                query[sample, number], codes[sample], successors[sample], 0.7, part
            )[0]
            np.testing.assert_allclose(decision[sample, number], expected, atol=1e-12)
            expected = reference(query[sample, number], codes[0], successors[0], 0.7)[0]
            np.testing.assert_allclose(shared[sample, number], expected, atol=1e-12)


@pytest.mark.parametrize("beta", [0.4, -0.4, 0.0])
def test_statistics(beta):
    codes, successors, rng = memory(4, 40, 31, 2)
    query = np.where(rng.random((6, 31)) < 0.5, 1.0, -1.0)
    found = inspect_dense(
        torch.from_numpy(query), Stored(*map(torch.from_numpy, (codes, successors)), beta)
    )
    for number in range(6):
        decision, weights, scores = reference(query[number], codes, successors, beta)
        ranked = -scores if beta < 0 else scores
        np.testing.assert_allclose(found.decision[number], decision, atol=1e-12)
        assert found.match[number] == ranked.argmax()
        assert found.score[number] == scores[ranked.argmax()]
        best, second = np.sort(ranked)[::-1][:2]
        assert found.margin[number] == best - second
        entropy = -(weights * np.log(weights)).sum()
        np.testing.assert_allclose(found.entropy[number], entropy, atol=1e-10)


def test_ties_take_the_first_and_have_no_margin():
    codes = torch.tensor([[1.0, -1.0], [1.0, 1.0], [1.0, 1.0]])
    found = inspect_dense(
        torch.tensor([1.0, 1.0]), Stored(codes, torch.tensor([[0.0], [1.0], [3.0]]), 20.0)
    )
    assert found.match == 1
    assert found.margin == 0.0
    torch.testing.assert_close(found.decision, torch.tensor([2.0]))
    torch.testing.assert_close(found.entropy, torch.tensor(2.0).log())


def test_one_row_has_nothing_to_lead_and_none_gives_nan():
    codes, successors = torch.ones(3, 4), torch.ones(3, 2)
    alone = inspect_dense(torch.ones(4), Stored(codes, successors, 1.0, held=torch.tensor(1)))
    assert alone.margin == torch.inf
    assert alone.entropy == 0.0
    none = inspect_dense(
        torch.ones(4), Stored(codes, successors, 1.0, mask=torch.zeros(3, dtype=torch.bool))
    )
    assert none.match == -1
    assert all(torch.isnan(none[field]).all() for field in (0, 2, 3, 4))


def test_rows_beyond_the_count_get_no_weight_and_no_gradient():
    codes, successors, _ = memory(5, 6, 8, 2)
    stored = torch.from_numpy(codes).requires_grad_()
    values = torch.from_numpy(successors).requires_grad_()
    recall_dense(
        stored[0].detach(), Stored(stored, values, 0.5, held=torch.tensor(4))
    ).sum().backward()
    for gradient in (stored.grad, values.grad):
        assert torch.isfinite(gradient).all()
        assert gradient[:4].abs().sum() > 0
        assert (gradient[4:] == 0).all()


def test_gradients():
    generator = torch.Generator().manual_seed(0)
    query, stored, successors = (
        torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((2, 3, 4), (2, 5, 4), (2, 5, 3))
    )
    beta = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)
    count = torch.tensor([5, 3])
    assert torch.autograd.gradcheck(
        lambda query, *inputs: recall_dense(query, Stored(*inputs, held=count)),
        (query, stored, successors, beta),
        fast_mode=True,
    )


def test_filling_the_memory_does_not_recompile():
    codes, successors, _ = memory(6, 32, 16, 2)
    stored, values = torch.from_numpy(codes).float(), torch.from_numpy(successors).float()
    compiled = torch.compile(recall_dense, fullgraph=True, backend="aot_eager")
    torch._dynamo.reset()
    with torch._dynamo.config.patch(error_on_recompile=True):
        for count in (1, 5, 32):
            arguments = stored[2], Stored(stored, values, torch.tensor(1.5), torch.tensor(count))
            torch.testing.assert_close(compiled(*arguments), recall_dense(*arguments))


@pytest.mark.parametrize(
    ("query", "stored", "successors", "mask"),
    [
        ((5,), (3, 4), (3, 2), None),
        ((4,), (2, 3, 4), (2, 3, 2), None),
        ((4,), (3, 4), (2, 3, 2), None),
        ((4,), (3, 4), (3, 2), (4,)),
    ],
)
def test_shapes_that_do_not_fit_are_refused(query, stored, successors, mask):
    limit = None if mask is None else torch.ones(mask, dtype=torch.bool)
    with pytest.raises(ValueError, match="expected"):
        recall_dense(
            torch.ones(query), Stored(torch.ones(stored), torch.ones(successors), 1.0, mask=limit)
        )
