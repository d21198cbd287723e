import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch import kernels
from hasm_torch.encoders.skin import SkinEncoder

CELLS, RATE = [2, 1, 4], 50.0
SPANS = [slice(0, 2), slice(2, 3), slice(3, 7)]
NORMALS = np.random.default_rng(5).normal(size=(7, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)


def encoder(window: int = 3, threshold: float = 0.05, rate: float = RATE) -> SkinEncoder:
    return SkinEncoder(CELLS, NORMALS.tolist(), rate, threshold, window, 2.5, spike_dt_ms=0.1)


def random_skin(*shape: int, seed: int = 0, scale: float = 2.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.rand(*shape, sum(CELLS), 3, generator=generator)


@given(parts=st.lists(st.integers(0, 6), min_size=1, max_size=5), window=st.integers(1, 5),
       seed=st.integers(0, 99))  # fmt: skip
@settings(max_examples=25, deadline=None)
def test_chunks_equal_the_whole(parts, window, seed):
    skin = random_skin(sum(parts), seed=seed)
    coder = encoder(window)
    whole, after = coder(skin)
    state, pieces = None, []
    for chunk in skin.split(parts):
        piece, state = coder(chunk, state)
        pieces.append(piece)
    for part, expected in zip(map(torch.cat, zip(*pieces)), whole):
        assert torch.equal(part, expected)
    # and both go on alike
    later = random_skin(8, seed=seed + 1)
    for one, other in zip(coder(later, state)[0], coder(later, after)[0]):
        assert torch.equal(one, other)


@pytest.mark.parametrize("window", [1, 2, 5])
@pytest.mark.parametrize("threshold", [0.0, 0.5])
@pytest.mark.parametrize("compiled", [True, False])
def test_force_and_push_of_each_patch_are_means_over_the_window(window, threshold, compiled):
    skin = random_skin(12, seed=3, scale=0.5) - 0.1  # some readings are negative
    if compiled:
        felt, _ = encoder(window, threshold)(skin)
    else:
        with kernels.disabled():
            felt, _ = encoder(window, threshold)(skin)
    for patch, span in enumerate(SPANS):
        force = reference.effective_force(skin[:, span], threshold, window) / window
        np.testing.assert_allclose(felt.force[:, patch], force, rtol=1e-5, atol=1e-6)
        push = reference.push(skin[:, span], NORMALS[span], threshold, window)
        np.testing.assert_allclose(felt.push[:, patch], push, rtol=1e-5, atol=1e-6)


def test_a_press_on_one_cell_pushes_against_its_normal():
    for patch, span in enumerate(SPANS):
        for cell in range(span.start, span.stop):
            skin = torch.zeros(1, sum(CELLS), 3)
            skin[0, cell, 1] = 3.0
            push = encoder(window=1, threshold=0.5)(skin)[0].push[0]
            np.testing.assert_allclose(push[patch], -2.5 * NORMALS[cell], atol=1e-6)
            assert not np.delete(push, patch, axis=0).any()


def test_spikes_are_those_of_an_izhikevich_neuron_under_the_current():
    newtons = np.array([2.0, 6.0, 12.0])
    skin = torch.zeros(15, sum(CELLS), 3)
    for span, force in zip(SPANS, newtons):
        skin[:, span.start] = force / 3  # all of it on one cell
    felt, _ = encoder(window=1, threshold=0.0)(skin)
    counts = felt.spikes
    np.testing.assert_allclose(felt.force[-1], newtons, rtol=1e-6)
    times, _, _ = reference.izhikevich(2.5 * newtons, duration=300.0, step=0.02)
    for patch, train in enumerate(times):
        assert len(train) > 20  # far more than the spike by which two integrators may differ
        assert counts[:, patch].sum() == pytest.approx(len(train), abs=1 + 0.01 * len(train))
        expected = np.histogram(train, bins=np.arange(0, 301, 20))[0]
        assert np.abs(counts[:, patch].numpy() - expected).max() <= 2


def test_a_touch_stays_on_its_patch():
    for patch, span in enumerate(SPANS):
        skin = torch.zeros(25, sum(CELLS), 3)
        skin[:, span] = 1.0
        felt, _ = encoder()(skin)
        others = [p for p in range(3) if p != patch]
        assert felt.spikes[:, patch].sum() > 20
        for values in felt:
            assert values[:, patch].any()
            assert not values[:, others].any()


def test_an_untouched_skin_is_silent():
    felt, _ = encoder()(torch.full((200, sum(CELLS), 3), 0.016))  # 0.048 N a cell
    assert not any(values.any() for values in felt)


def test_leading_dimensions_are_independent_streams():
    skin = random_skin(2, 3, 12, seed=7)
    coder = encoder()
    felt, state = coder(skin)
    assert felt.spikes.shape == felt.force.shape == (2, 3, 12, 3)
    assert felt.push.shape == (2, 3, 12, 3, 3)
    again, _ = coder(skin, state)
    for i in range(2):
        for j in range(3):
            alone, after = coder(skin[i, j])
            for values, expected in zip(felt, alone):
                assert torch.equal(values[i, j], expected)
            assert torch.equal(again.spikes[i, j], coder(skin[i, j], after)[0].spikes)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_reading_that_is_no_number_is_not_hidden(compiled):
    skin = torch.zeros(2, sum(CELLS), 3)
    skin[1, 0, 2] = torch.nan
    if compiled:
        felt, _ = encoder()(skin)
    else:
        with kernels.disabled():
            felt, _ = encoder()(skin)
    assert felt.force[1, 0].isnan()
    assert felt.push[1, 0].isnan().all()
    assert torch.isfinite(felt.force[:, 1:]).all()
    assert torch.isfinite(felt.force[0]).all()


def test_one_absurd_reading_does_not_deafen_a_neuron():
    coder = encoder()
    skin = torch.zeros(150, sum(CELLS), 3)
    skin[0, 0] = 1e9
    skin[100:, 0] = 1.0
    felt, _ = coder(skin)
    assert torch.isfinite(felt.force).all()
    assert not felt.spikes[40:100].any()
    assert felt.spikes[110:, 0].all()


def test_bad_arguments_are_named():
    def with_(cells=CELLS, normals=NORMALS, rate=RATE, threshold=0.05, window=3, step=0.1):
        return SkinEncoder(cells, normals, rate, threshold, window, 2.5, step)

    with pytest.raises(ValueError, match="at least one patch"):
        with_(cells=[])
    for rate, step in ((0.0, 0.1), (50.0, 0.0), (float("nan"), 0.1), (50.0, -0.1)):
        with pytest.raises(ValueError, match="above 0"):
            with_(rate=rate, step=step)
    for wrong in ({"window": 0}, {"threshold": -0.1}, {"threshold": float("nan")}):
        with pytest.raises(ValueError, match=r"window >= 1 sample and threshold >= 0 N, got"):
            with_(**wrong)
    for normals in (NORMALS[:6], NORMALS[:, :2]):
        with pytest.raises(ValueError, match=r"expected normals \(7, 3\), got"):
            with_(normals=normals)
    for shape in ((5, 6, 3), (7, 3), (5, 7, 1)):
        with pytest.raises(ValueError, match=r"expected skin \(..., T, 7, 3\)"):
            encoder()(torch.zeros(shape))


@given(parts=st.lists(st.integers(0, 4), min_size=1, max_size=3), window=st.integers(1, 4),
       leading=st.sampled_from([(), (2,), (2, 3)]), seed=st.integers(0, 99))  # fmt: skip
@settings(max_examples=12, deadline=None)
def test_the_compiled_pass_equals_the_tensor_operations(parts, window, leading, seed):
    skin = random_skin(*leading, sum(parts), seed=seed) - 0.3
    coder, states = encoder(window, rate=500.0), [None, None]
    for chunk in skin.split(parts, dim=-3):
        compiled, states[0] = coder(chunk, states[0])
        with kernels.disabled():
            plain, states[1] = coder(chunk, states[1])
        for one, other in zip((*compiled, states[0].recent), (*plain, states[1].recent)):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    graph, _ = coder(skin.clone().requires_grad_())  # takes the tensor operations by itself
    assert graph.force.requires_grad
    assert torch.equal(graph.spikes, coder(skin)[0].spikes)


def test_gradients_of_force_and_push_are_right():
    skin = (random_skin(4, seed=2) + 0.1).double().requires_grad_()
    coder = encoder(2, rate=10_000.0)  # a step of the neurons a sample
    assert torch.autograd.gradcheck(lambda readings: coder(readings)[0][1:], skin)


def test_gradients_reach_the_forces_through_spikes():
    skin = random_skin(3, seed=4).requires_grad_()
    encoder()(skin)[0].spikes.sum().backward()
    assert torch.isfinite(skin.grad).all()
    assert (skin.grad[:2] > 0).any()
