"""The memory layer: what it recalls, how it is written, and how it embeds in PyTorch."""

import copy
import io

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch import HeteroAssociativeMemory, functional
from hasm_torch.encoders.bipolar import binarise
from hasm_torch.encoders.rope3d import rope3d

STORAGES = ("float32", "bfloat16", "int8", "bit")


def signs(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 2, shape, generator=generator).float() * 2 - 1


def filled(rows: int = 50, dim: int = 40, values: int = 3, seed: int = 0, **options):
    memory = HeteroAssociativeMemory(dim, values, options.pop("capacity", rows), **options)
    state, touch = signs(rows, dim, seed=seed), signs(rows, dim, seed=seed + 1)
    successor = torch.randn(rows, values, generator=torch.Generator().manual_seed(seed + 2))
    memory.write(state, touch, successor)
    return memory, state, touch, successor


def reference(query, associations, successors, beta):
    """d = S₋₁ softmax(β Mᵀ q), float64 NumPy, one query at a time."""
    m, s = associations.double().numpy(), successors.double().numpy()
    decisions = []
    for q in query.double().numpy().reshape(-1, query.shape[-1]):
        scores = beta * np.array([sum(row * q) for row in m])
        weights = np.exp(scores - scores.max())
        decisions.append((weights[:, None] * s).sum(0) / weights.sum())
    return torch.tensor(np.array(decisions)).reshape(*query.shape[:-1], -1)


@settings(max_examples=20, deadline=None)
@given(
    storage=st.sampled_from(STORAGES),
    rows=st.integers(1, 200),
    dim=st.integers(1, 70),
    beta=st.sampled_from([0.01, 0.3, 1.0, 5.0]),
    seed=st.integers(0, 99),
)
def test_recalls_as_the_paper_writes(storage, rows, dim, beta, seed):
    memory, state, touch, successor = filled(rows, dim, seed=seed, beta=beta, storage=storage)
    query = signs(2, 3, dim, seed=seed + 5)
    expected = reference(query, state * touch, successor, beta)
    torch.testing.assert_close(memory.recall(query).double(), expected, atol=1e-5, rtol=1e-5)


@settings(max_examples=15, deadline=None)
@given(storage=st.sampled_from(STORAGES), seed=st.integers(0, 99))
def test_order_of_the_associations_does_not_matter(storage, seed):
    memory, state, touch, successor = filled(60, 48, seed=seed, storage=storage, beta=0.2)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(seed))
    other = HeteroAssociativeMemory(48, 3, 60, beta=0.2, storage=storage)
    other.write(state[order], touch[order], successor[order])
    query = signs(4, 48, seed=seed + 9)
    torch.testing.assert_close(memory.recall(query), other.recall(query), atol=2e-6, rtol=1e-5)


def test_forward_binds_rotates_and_recalls():
    memory, *_ = filled(80, 60, beta=0.5)
    state, touch = signs(4, 60, seed=3), signs(4, 60, seed=4)
    axis, angle = torch.tensor([0.0, 0.6, 0.8]), torch.tensor(1.1)
    query = state * rope3d(touch, axis, angle)
    torch.testing.assert_close(memory(state, touch, axis, angle), memory.recall(query))


@pytest.mark.parametrize("storage", STORAGES)
def test_a_real_valued_memory_stays_within_its_storage(storage):
    dim, rows = 120, 300
    state, touch = signs(rows, dim), signs(rows, dim, seed=1)
    axis, angle = torch.randn(rows, 3, generator=torch.Generator().manual_seed(0)), torch.rand(rows)
    successor = torch.randn(rows, 4, generator=torch.Generator().manual_seed(1))
    memory = HeteroAssociativeMemory(dim, 4, rows, beta=0.05, storage=storage)
    memory.write(state, touch, successor, axis, angle)
    association = functional.associate(state, touch, axis, angle)
    query = association[:20]
    if storage == "bit":
        association, query = binarise(association), binarise(query)
    expected = reference(query, association, successor, 0.05)
    tolerance = {"float32": 1e-5, "bit": 1e-5, "int8": 0.02, "bfloat16": 0.02}[storage]
    torch.testing.assert_close(
        memory.recall(query).double(), expected, atol=tolerance, rtol=tolerance
    )


@pytest.mark.parametrize("storage", [*STORAGES, "binarised"])
def test_inspect_tells_a_recall_from_a_guess(storage):
    options = {"binarised": True} if storage == "binarised" else {"storage": storage}
    memory, state, touch, _ = filled(100, 64, beta=1.0, **options)
    query = torch.stack([state[7] * touch[7], signs(64, seed=77)])
    found = memory.inspect(query)
    scores = query @ (state * touch).T
    best = scores.sort(descending=True).values
    torch.testing.assert_close(found.score, best[:, 0])
    torch.testing.assert_close(found.margin, best[:, 0] - best[:, 1])
    assert found.match[0] == 7
    weights = torch.softmax(scores, -1)
    torch.testing.assert_close(
        found.entropy, -(weights * weights.clamp_min(1e-30).log()).sum(-1), atol=1e-4, rtol=1e-3
    )
    torch.testing.assert_close(found.decision, memory.recall(query))
    torch.testing.assert_close(memory.weights(query), weights, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_mask_leaves_rows_out(storage):
    memory, state, touch, successor = filled(40, 64, beta=3.0, storage=storage, capacity=50)
    query = (state * touch)[[3, 4]]
    mask = torch.ones(2, 50, dtype=torch.bool)
    mask[0, 3] = False
    found = memory.inspect(query, mask)
    assert found.match[0] != 3
    assert found.match[1] == 4
    kept = torch.arange(40) != 3
    expected = reference(query[:1], (state * touch)[kept], successor[kept], 3.0)
    torch.testing.assert_close(found.decision[:1].double(), expected, atol=1e-5, rtol=1e-5)
    assert memory.weights(query, mask)[0, 3] == 0


def test_any_real_beta():
    query = signs(5, 40, seed=8)
    results = []
    for beta in (2, 2.0, torch.tensor(2), torch.tensor(2.0), torch.tensor([2.0])):
        results.append(filled(beta=beta)[0].recall(query))
    parameter = torch.nn.Parameter(torch.tensor(2.0))
    memory, *_ = filled(beta=parameter)
    assert memory.beta is parameter
    results.append(memory.recall(query))
    for result in results[1:]:
        torch.testing.assert_close(result, results[0])
    memory.recall(query).sum().backward()
    assert parameter.grad is not None
    assert parameter.grad != 0


@pytest.mark.parametrize("interaction", ["exponential", 1, 2, 3])
def test_dense_associative_interactions(interaction):
    memory, state, touch, successor = filled(30, 50, beta=0.1, interaction=interaction)
    query = signs(6, 50, seed=4)
    x = 0.1 * (query.double() @ (state * touch).double().T)
    f = torch.exp(x) if interaction == "exponential" else x**interaction
    torch.testing.assert_close(
        memory.recall(query).double(), f @ successor.double(), rtol=1e-4, atol=1e-4
    )
    with pytest.raises(ValueError, match="inspect needs normalised weights"):
        memory.inspect(query)


def test_iterated_recall_walks_a_stored_sequence():
    sequence = signs(200, 500)
    memory = HeteroAssociativeMemory(500, 500, 200, beta=0.2)
    memory.write_episodes(sequence, torch.ones_like(sequence), sequence)
    walked = memory.iterate(sequence[0], 199, binarise)
    assert torch.equal(binarise(walked), sequence[1:])


@pytest.mark.parametrize("storage", STORAGES)
def test_a_full_memory_refuses_or_overwrites_the_oldest(storage):
    memory, state, touch, successor = filled(10, 96, storage=storage, beta=3.0)
    before = copy.deepcopy(memory.state_dict())
    with pytest.raises(RuntimeError, match=r"10 of 10 associations and 1 more"):
        memory.write(state[0], touch[0], successor[0])
    for name, tensor in memory.state_dict().items():
        assert torch.equal(tensor, before[name])
    ring = HeteroAssociativeMemory(96, 3, 10, storage=storage, beta=3.0, when_full="overwrite")
    codes, values = signs(37, 96, seed=5), torch.randn(37, 3)
    for part in torch.arange(37).split([4, 5, 3, 13, 12]):
        ring.write(codes[part], torch.ones(len(part), 96), values[part])
    assert int(ring.count) == 10
    assert torch.equal(ring.stored().float(), codes[-10:])
    found = ring.recall(codes[-10:])
    torch.testing.assert_close(found, values[-10:], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("storage", STORAGES)
def test_removing_and_merging(storage):
    memory, state, touch, successor = filled(20, 64, storage=storage, beta=3.0)
    codes = state * touch
    memory.remove(torch.tensor([0, 5, 19]))
    kept = [i for i in range(20) if i not in (0, 5, 19)]
    assert torch.equal(memory.stored().float(), codes[kept])
    near = codes[kept[0]].clone()
    near[:2] *= -1
    memory.write(near, torch.ones(64), torch.full((3,), 5.0))
    assert memory.merge(tolerance=1) == 0
    assert memory.merge(tolerance=2) == 1
    assert int(memory.count) == 17
    expected = (successor[kept[0]] + 5.0) / 2
    torch.testing.assert_close(memory.recall(codes[kept[0]]), expected, atol=1e-3, rtol=1e-3)
    with pytest.raises(ValueError, match="expected rows among the 17 held"):
        memory.remove(torch.tensor([17]))
    memory.clear()
    with pytest.raises(RuntimeError, match="memory is empty"):
        memory.recall(near)


@settings(max_examples=20, deadline=None)
@given(lengths=st.lists(st.integers(1, 12), min_size=1, max_size=5), horizon=st.integers(1, 4))
def test_episodes_never_link_into_one_another(lengths, horizon):
    total = sum(lengths)
    episodes = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    codes, values = signs(total, 64, seed=total), torch.arange(total).float().unsqueeze(1)
    memory = HeteroAssociativeMemory(64, 1, total)
    memory.write_episodes(codes, torch.ones_like(codes), values, episodes, horizon)
    expected = [
        (k, k + horizon)
        for k in range(total)
        if k + horizon < total and episodes[k] == episodes[k + horizon]
    ]
    assert int(memory.count) == len(expected)
    assert torch.equal(memory.stored(), codes[[k for k, _ in expected]])
    assert memory.successors[: len(expected), 0].tolist() == [float(f) for _, f in expected]


def test_storing_only_where_the_code_changes():
    codes = signs(30, 64).repeat_interleave(torch.randint(1, 5, (30,)), dim=0)
    values = torch.arange(len(codes)).float().unsqueeze(1)
    memory = HeteroAssociativeMemory(64, 1, 100)
    memory.write_episodes(codes, torch.ones_like(codes), values, resolution=1)
    assert int(memory.count) == 30


def test_crowding_reports_a_beta_that_recalls_every_association():
    memory, state, touch, successor = filled(400, 64, capacity=500)
    memory.write(state[:3], touch[:3], successor[:3])
    report = memory.crowding(confidence=1e4)
    codes = (state * touch).unique(dim=0)
    scores = codes @ codes.T
    rival = (scores - 1e9 * torch.eye(len(codes))).amax(1)
    assert report.held == 403
    assert report.capacity == 500
    assert report.duplicates == 403 - len(codes)
    assert report.margin == float((64 - rival).min())
    assert report.crosstalk == pytest.approx(float((rival / 64).mean()))
    memory.remove(torch.arange(400, 403))
    memory.beta.fill_(report.beta)
    weights = memory.weights(state * touch)[:, :400]
    same = (state * touch) @ (state * touch).T == 64
    assert ((weights * same).sum(1) > 1 - 1.01e-4).all()


def test_gradients_of_every_input():
    generator = torch.Generator().manual_seed(0)
    query, stored, successor = (
        torch.randn(*shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((3, 6), (9, 6), (9, 2))
    )
    beta = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    for interaction in ("softmax", "exponential", 1, 3):
        assert torch.autograd.gradcheck(
            lambda *x, f=interaction: functional.recall(*x, interaction=f),
            (query, stored, successor, beta),
        )


def test_gradients_through_the_module_in_float64():
    memory, *_ = filled(30, 12, learn_beta=True, beta=0.2)
    memory.double()
    query = torch.randn(4, 12, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(memory.recall, (query,))
    memory.recall(query).sum().backward()
    assert memory.beta.grad.dtype == torch.float64


def test_a_memory_for_each_sample_equals_a_loop():
    batch, rows, dim = 7, 30, 24
    state, touch = signs(batch, rows, dim), signs(batch, rows, dim, seed=1)
    axis = torch.randn(batch, 1, 3, generator=torch.Generator().manual_seed(0))
    angle, successor = torch.rand(batch, 1), torch.randn(batch, rows, 5)
    associations = functional.associate(state, touch, axis, angle)
    query = torch.randn(batch, 4, dim)
    for interaction in ("softmax", 2):
        together = functional.recall(query, associations, successor, 0.3, interaction=interaction)
        for b in range(batch):
            alone = functional.recall(
                query[b], associations[b], successor[b], 0.3, interaction=interaction
            )
            torch.testing.assert_close(together[b], alone, rtol=1e-4, atol=1e-4)


def test_vmap_and_functional_grad():
    memory, *_ = filled(40, 32, beta=0.3, learn_beta=True)
    queries = torch.randn(6, 32)
    mapped = torch.func.vmap(memory.recall)(queries)
    torch.testing.assert_close(mapped, memory.recall(queries))
    gradients = torch.func.vmap(torch.func.grad(lambda q: memory.recall(q).sum()))(queries)
    leaf = queries.clone().requires_grad_()
    memory.recall(leaf).sum().backward()
    torch.testing.assert_close(gradients, leaf.grad)
    fast = torch.func.vmap(lambda m, s, q: functional.recall(q, m, s, 0.5))
    stored, successor = torch.randn(6, 9, 32), torch.randn(6, 9, 2)
    torch.testing.assert_close(
        fast(stored, successor, queries),
        functional.recall(queries.unsqueeze(1), stored, successor, 0.5).squeeze(1),
    )


@pytest.mark.parametrize("storage", STORAGES)
def test_state_dict_and_deepcopy(storage):
    memory, *_ = filled(storage=storage, beta=0.4, capacity=64)
    query = signs(3, 40, seed=6)
    fresh = HeteroAssociativeMemory(40, 3, 64, storage=storage)
    buffer = io.BytesIO()
    torch.save(memory.state_dict(), buffer)
    buffer.seek(0)
    fresh.load_state_dict(torch.load(buffer))
    for other in (fresh, copy.deepcopy(memory)):
        assert torch.equal(other.recall(query), memory.recall(query))


@pytest.mark.parametrize("storage", STORAGES)
def test_a_lower_dtype_keeps_joint_positions_and_beta(storage):
    memory, *_ = filled(storage=storage, beta=0.123456789)
    before = memory.successors.clone()
    memory.to(torch.bfloat16)
    assert memory.successors.dtype == memory.beta.dtype == torch.float32
    assert torch.equal(memory.successors, before)
    assert memory.recall(signs(2, 40, seed=3).bfloat16()).dtype == torch.float32


def test_autocast_does_not_round_the_scores():
    memory, *_ = filled(500, 400, beta=1.0)
    query = signs(20, 400, seed=3)
    expected = memory.recall(query)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(memory.recall(query), expected)


@pytest.mark.parametrize("storage", STORAGES)
def test_compiles_whole_and_once_while_it_fills(storage):
    torch._dynamo.reset()
    memory = HeteroAssociativeMemory(48, 3, 64, beta=0.3, storage=storage)
    compiled = torch.compile(memory.recall, fullgraph=True, backend="aot_eager")
    query = signs(5, 48, seed=2)
    with torch._dynamo.config.patch(error_on_recompile=True):
        for seed in range(8):
            memory.write(signs(8, 48, seed=seed), signs(8, 48, seed=seed + 50), torch.randn(8, 3))
            torch.testing.assert_close(compiled(query), memory.recall(query))


@pytest.mark.parametrize("storage", STORAGES)
def test_exports(storage):
    memory, state, touch, _ = filled(storage=storage, beta=0.3)
    program = torch.export.export(memory, (state[:4], touch[:4]))
    torch.testing.assert_close(
        program.module()(state[8:12], touch[8:12]), memory(state[8:12], touch[8:12])
    )


def test_onnxruntime_gives_equal_results(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    memory, state, touch, _ = filled(200, 90, beta=0.3)
    axis, angle = torch.tensor([[0.0, 0.6, 0.8]]).expand(4, 3), torch.rand(4)
    inputs = (state[:4], touch[:4], axis.contiguous(), angle)
    path = tmp_path / "memory.onnx"
    torch.onnx.export(memory.eval(), inputs, path, dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(path)
    feeds = {i.name: t.numpy() for i, t in zip(session.get_inputs(), inputs)}
    (result,) = session.run(None, feeds)
    np.testing.assert_allclose(result, memory(*inputs).numpy(), atol=1e-5)


def test_learned_patterns_are_parameters_with_straight_through_signs():
    memory = HeteroAssociativeMemory(20, 2, 16, beta=0.5, learn_patterns=True, binarised=True)
    memory.initialise(torch.Generator().manual_seed(0))
    assert {name for name, _ in memory.named_parameters()} == {"associations", "successors"}
    query = torch.randn(5, 20)
    memory.recall(query).square().sum().backward()
    assert (memory.associations.grad != 0).any()
    with torch.no_grad():
        memory.associations.mul_(3.7)
    stored = binarise(memory.associations).detach()
    expected = reference(binarise(query), stored, memory.successors.detach(), 0.5)
    torch.testing.assert_close(memory.recall(query).double(), expected, atol=1e-5, rtol=1e-5)


def test_storage_is_chosen_by_size():
    assert HeteroAssociativeMemory(100, 1, 1000).storage == "float32"
    assert HeteroAssociativeMemory(1024, 1, 100_000).storage == "bit"
    large = HeteroAssociativeMemory(1024, 1, 100_000, learn_patterns=True)
    assert large.storage == "float32"


def test_packed_memory_is_small():
    memory = HeteroAssociativeMemory(400, 8, 64_000, storage="bit")
    assert memory.memory_bytes() / 64_000 <= 1.1 * (400 / 8 + 4 * 8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"code_dim": 0}, "code_dim must be at least 1"),
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"storage": "float8"}, "valid: float32, bfloat16, int8, bit"),
        ({"interaction": "cosine"}, "'entmax15', 'exponential', or a degree"),
        ({"interaction": 0}, "'entmax15', 'exponential', or a degree"),
        ({"top_k": 0}, "top_k must be at least 1"),
        ({"when_full": "wait"}, "valid: error, overwrite, grow"),
        ({"learn_patterns": True, "storage": "bit"}, "learned patterns need storage 'float32'"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        HeteroAssociativeMemory(**{"code_dim": 8, "value_dim": 2, "capacity": 4, **options})


def test_bad_input_stores_nothing():
    memory, state, touch, successor = filled(5, 30, capacity=20)
    cases = [
        (state[:, :-1], touch, successor, "expected state code"),
        (state, touch[:, :-1], successor, "expected observation code"),
        (state, touch, successor[:, :-1], "expected successor"),
        (state, touch, successor * torch.nan, "must be finite"),
        (state * torch.inf, touch, successor, "must be finite"),
    ]
    for s, o, d, message in cases:
        with pytest.raises(ValueError, match=message):
            memory.write(s, o, d)
    with pytest.raises(ValueError, match="give both or neither"):
        memory.write(state, touch, successor, axis=torch.ones(3))
    assert int(memory.count) == 5
    with pytest.raises(ValueError, match=r"expected query \(..., 30\)"):
        memory.recall(torch.ones(29))
    with pytest.raises(RuntimeError, match="memory is empty"):
        HeteroAssociativeMemory(30, 2, 3).recall(torch.ones(30))
