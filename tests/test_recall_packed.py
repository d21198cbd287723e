"""Packed recall against a float64 NumPy reference over the codes it was packed from."""

import threading

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch import kernels
from hasm_torch.memory.recall import (
    Stored,
    inspect_packed,
    pack,
    recall_packed,
    store,
    unpack,
    weights_packed,
)

ROWS = 64


def bipolar(rng, *shape):
    return np.where(rng.random(shape) < 0.5, 1.0, -1.0)


def reference(query, codes, successors, beta, taking_part):
    """Recall of one query (dim,) as (decision, match, score, margin, entropy), in float64."""
    scores = codes @ query
    ranked = np.where(taking_part, -scores if beta < 0 else scores, -np.inf)
    logits = np.where(taking_part, beta * scores, -np.inf)
    weights = np.exp(logits - logits.max())
    weights /= weights.sum()
    best = int(ranked.argmax())
    rivals = np.delete(ranked, best)
    entropy = -sum(w * np.log(w) for w in weights if w > 0)
    margin = ranked[best] - rivals.max(initial=-np.inf)
    return weights @ successors, best, scores[best], margin, entropy


def check(found, expected):
    decision, match, score, margin, entropy = expected
    np.testing.assert_allclose(found[0], decision, atol=1e-5)
    assert (int(found[1]), float(found[2]), float(found[3])) == (match, score, margin)
    np.testing.assert_allclose(float(found[4]), entropy, atol=1e-4)


@pytest.fixture
def team(monkeypatch):
    """Lets even a small memory be scanned by a team of threads."""
    monkeypatch.setattr("hasm_torch.memory.recall.packed_cpu._TEAM_WORDS", 0)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**16),
    rows=st.integers(1, 400),
    dim=st.integers(1, 140),
    values=st.integers(1, 17),
    beta=st.sampled_from([-50.0, -0.2, 0.0, 1e-3, 0.05, 0.3, 1.0, 3.0, 50.0, float("inf")]),
    masked=st.booleans(),
    data=st.data(),
)
def test_recall_matches_the_reference(seed, rows, dim, values, beta, masked, data):
    rng = np.random.default_rng(seed)
    distinct = bipolar(rng, data.draw(st.integers(1, rows)), dim)
    codes = distinct[rng.integers(len(distinct), size=rows)]  # ties
    successors = rng.standard_normal((rows, values))
    count = data.draw(st.integers(1, rows))
    query = codes[rng.integers(rows)] * np.where(rng.random((2, dim)) < 0.2, -1, 1)
    mask = rng.random((2, rows)) < (0.3 if masked else 1.1)
    mask[:, rng.integers(count)] = True
    found = inspect_packed(
        torch.from_numpy(query).float(),
        Stored(
            pack(torch.from_numpy(codes)),
            torch.from_numpy(successors).float(),
            beta,
            torch.tensor(count),
            torch.from_numpy(mask) if masked else None,
        ),
    )
    for number in range(2):
        taking_part = mask[number] & (np.arange(rows) < count)
        # At infinite beta the best matches share the weight; 1e3 is as good on integer scores.
        finite = 1e3 if beta == float("inf") else beta
        expected = reference(query[number], codes, successors, finite, taking_part)
        check([field[number] for field in found], expected)


@pytest.mark.parametrize("beta", [-0.3, 0.01, 0.5, 4.0])
@pytest.mark.parametrize("order", ["as drawn", "nearest last"])
def test_a_large_memory_scanned_by_a_team(team, beta, order):
    rng = np.random.default_rng(11)
    codes, successors = bipolar(rng, 20_011, 200), rng.standard_normal((20_011, 8))
    query = codes[[17, 12_345]] * np.where(rng.random((2, 200)) < 0.1, -1, 1)
    if order == "nearest last":  # every block improves on the one before
        codes = codes[np.argsort(np.sign(beta) * (codes @ query[0]), kind="stable")]
    found = inspect_packed(
        torch.from_numpy(query).float(),
        Stored(pack(torch.from_numpy(codes)), torch.from_numpy(successors).float(), beta),
    )
    for number in range(2):
        expected = reference(query[number], codes, successors, beta, np.ones(len(codes), bool))
        check([field[number] for field in found], expected)


@pytest.mark.parametrize("interaction", ["softmax", "sparsemax", "entmax15", "exponential", 3])
@pytest.mark.parametrize("top_k", [None, 40])
def test_the_answer_does_not_depend_on_how_the_work_is_divided(
    team, monkeypatch, interaction, top_k
):
    rng = np.random.default_rng(3)
    words = pack(torch.from_numpy(bipolar(rng, 2, 2_000, 96)))
    successors = torch.from_numpy(rng.standard_normal((2, 2_000, 4))).float()
    query = torch.from_numpy(bipolar(rng, 2, 33, 96)).float()
    mask = torch.from_numpy(rng.random((2, 33, 2_000)) < 0.7)
    memory = Stored(words, successors, 0.02, torch.tensor([2_000, 1_700]), mask, interaction, top_k)

    def answers() -> dict[str, torch.Tensor]:
        weights = weights_packed(query, memory)
        # What is not normalised sums thousands of weights above 1, in float32 where it is plain.
        scale = weights.sum(-1, keepdim=True).clamp(min=1.0)
        found = {"w": weights / scale, "d": recall_packed(query, memory) / scale}
        normalised = interaction not in ("exponential", 3)  # only they say how sure they are
        return found | (inspect_packed(query, memory)._asdict() if normalised else {})

    together = answers()
    torch.set_num_threads(1)
    monkeypatch.setattr("hasm_torch.memory.recall.packed_cpu._HELD", 10_000)  # few queries at once
    alone = answers()
    with kernels.disabled():
        plain = answers()
    for name, expected in plain.items():
        torch.testing.assert_close(together[name], expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(alone[name], expected, atol=1e-5, rtol=1e-5)


def test_callers_in_several_threads_do_not_disturb_one_another(team):
    rng = np.random.default_rng(5)
    codes = bipolar(rng, 3_000, 64)
    words, successors = pack(torch.from_numpy(codes)), torch.arange(3_000.0).unsqueeze(-1)
    wrong = []

    def ask(first):
        for row in range(first, 3_000, 97):
            answer = recall_packed(
                torch.from_numpy(codes[row]).float(), Stored(words, successors, 50.0)
            )
            if answer.item() != row and (codes == codes[row]).all(1).sum() == 1:
                wrong.append(row)

    threads = [threading.Thread(target=ask, args=(first,)) for first in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_memory_for_every_sample():
    rng = np.random.default_rng(6)
    codes, successors = bipolar(rng, 3, 2, 150, 40), rng.standard_normal((3, 2, 150, 5))
    query, count = bipolar(rng, 3, 2, 4, 40), rng.integers(1, 151, (3, 2))
    found = inspect_packed(
        torch.from_numpy(query).float(),
        Stored(
            pack(torch.from_numpy(codes)),
            torch.from_numpy(successors).float(),
            0.15,
            torch.from_numpy(count),
        ),
    )
    assert found.decision.shape == (3, 2, 4, 5)
    assert found.entropy.shape == (3, 2, 4)
    for place in np.ndindex(3, 2, 4):
        memory = place[:2]
        expected = reference(
            query[place], codes[memory], successors[memory], 0.15, np.arange(150) < count[memory]
        )
        check([field[place] for field in found], expected)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**16), rows=st.integers(1, 130), dim=st.integers(1, 70))
def test_packing_keeps_every_sign(seed, rows, dim):
    codes = torch.from_numpy(np.random.default_rng(seed).standard_normal((2, rows, dim)))
    words = pack(codes)
    assert words.shape == (2, -(-rows // ROWS), -(-dim // 32), ROWS)
    assert words.dtype == torch.int32
    torch.testing.assert_close(
        unpack(words, dim)[:, :rows], torch.where(codes >= 0, 1.0, -1.0), rtol=0, atol=0
    )


def test_storing_row_by_row_equals_packing_at_once():
    codes = torch.from_numpy(bipolar(np.random.default_rng(7), 150, 45))
    words = torch.zeros_like(pack(codes))
    for rows in torch.arange(150).split(37):
        store(words, rows, codes[rows])
    assert torch.equal(words, pack(codes))
    store(words, torch.tensor([149, 3]), codes[[0, 1]])
    codes[[149, 3]] = codes[[0, 1]]
    assert torch.equal(words, pack(codes))


def test_an_association_of_400_entries_and_8_values_takes_84_bytes():
    words = pack(torch.ones(6_400, 400))
    assert words.nbytes / 6_400 + 8 * 4 == 84


def test_zero_counts_as_positive_in_every_dtype():
    words = pack(torch.tensor([[1.0, 1.0], [1.0, -1.0]]))
    successors = torch.tensor([[1.0], [2.0]])
    for query in (torch.tensor([3.0, 0.0]), torch.tensor([1, 0]), torch.zeros(2).bfloat16()):
        assert recall_packed(query, Stored(words, successors, 50.0)) == 1.0
    tiny = torch.tensor([1.0, -1e-300], dtype=torch.float64)
    assert recall_packed(tiny, Stored(words, successors, 50.0)) == 2.0


def test_a_query_that_may_recall_nothing_gives_nan():
    words, successors = pack(torch.ones(5, 4)), torch.ones(5, 2)
    found = inspect_packed(torch.ones(4), Stored(words, successors, 1.0, held=torch.tensor(0)))
    assert found.match == -1
    assert all(torch.isnan(found[field]).all() for field in (0, 2, 3, 4))
    mask = torch.tensor([[False] * 5, [False, True] * 2 + [False]])
    found = inspect_packed(torch.ones(2, 4), Stored(words, successors, 1.0, mask=mask))
    assert found.match.tolist() == [-1, 1]


def test_what_lies_beyond_the_count_is_not_read():
    codes = torch.from_numpy(bipolar(np.random.default_rng(8), 128, 16))
    successors = torch.full((128, 3), torch.nan)
    successors[:70] = 1.0
    decision = recall_packed(
        codes[100].float(), Stored(pack(codes), successors, 0.01, torch.tensor(70))
    )
    torch.testing.assert_close(decision, torch.ones(3))


def test_torch_operations_give_the_same_and_carry_gradients():
    rng = np.random.default_rng(9)
    codes = bipolar(rng, 2, 90, 50)
    query, words = torch.from_numpy(bipolar(rng, 2, 3, 50)), pack(torch.from_numpy(codes))
    successors = torch.from_numpy(rng.standard_normal((2, 90, 4)))
    mask = torch.from_numpy(rng.random((2, 3, 90)) < 0.6)
    limits = {"held": torch.tensor([90, 61]), "mask": mask}
    beta = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    slow = inspect_packed(query.float(), Stored(words, successors.float(), beta, **limits))
    with torch.no_grad():
        fast = inspect_packed(query.float(), Stored(words, successors.float(), beta, **limits))
    assert slow.decision.requires_grad
    assert not fast.decision.requires_grad
    for left, right in zip(slow, fast, strict=True):
        torch.testing.assert_close(left, right, atol=1e-5, rtol=0, check_dtype=False)

    def recall(beta, successors):
        return recall_packed(query, Stored(words, successors, beta, **limits))

    assert torch.autograd.gradcheck(recall, (beta, successors.requires_grad_()), fast_mode=True)


def _filled_memory():
    rng = np.random.default_rng(10)
    codes = torch.from_numpy(bipolar(rng, 100, 40)).float()
    return codes, pack(codes), torch.from_numpy(rng.standard_normal((100, 3))).float()


def test_filling_the_memory_does_not_recompile():
    codes, words, successors = _filled_memory()
    compiled = torch.compile(recall_packed, fullgraph=True, backend="aot_eager")
    torch._dynamo.reset()
    with torch._dynamo.config.patch(error_on_recompile=True):
        for count in (1, 60, 100):
            memory = Stored(words, successors, torch.tensor(0.4), torch.tensor(count))
            torch.testing.assert_close(
                compiled(codes[:7], memory), recall_packed(codes[:7], memory)
            )


def test_export():
    codes, words, successors = _filled_memory()

    class Memory(torch.nn.Module):
        def forward(self, query, count):
            return recall_packed(query, Stored(words, successors, 0.4, count))

    example = (codes[:2], torch.tensor(50))
    exported = torch.export.export(
        Memory(), example, dynamic_shapes=({0: torch.export.Dim("queries")}, None)
    )
    query = codes[:5]
    torch.testing.assert_close(
        exported.module()(query, torch.tensor(80)), Memory()(query, torch.tensor(80))
    )


def test_the_operator_is_registered_properly():
    codes, words, successors = _filled_memory()
    mask = torch.ones(4, 100, dtype=torch.bool)
    torch.library.opcheck(
        torch.ops.hasm_torch.packed_recall.default,
        (codes[:4], words, successors, torch.tensor(0.4), torch.tensor(70), mask, "entmax15", 9),
    )


@pytest.mark.parametrize("dim", [32, 65])
def test_a_query_of_another_length_is_refused(dim):
    words = pack(torch.ones(3, 40))
    with pytest.raises(ValueError, match="33 to 64 entries"):
        recall_packed(torch.ones(dim), Stored(words, torch.ones(3, 2), 1.0))


def test_beta_must_be_a_number():
    with pytest.raises(ValueError, match="NaN"):
        recall_packed(torch.ones(4), Stored(pack(torch.ones(3, 4)), torch.ones(3, 2), float("nan")))
