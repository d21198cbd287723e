import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.encoders.skin import SkinEncoder

CELLS, RATE = [2, 1, 4], 50.0
SPANS = [slice(0, 2), slice(2, 3), slice(3, 7)]


def encoder(window: int = 3, threshold: float = 0.05) -> SkinEncoder:
    return SkinEncoder(CELLS, RATE, threshold, window, current_per_newton=2.5, spike_dt_ms=0.1)


def random_skin(*shape: int, seed: int = 0, scale: float = 2.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.rand(*shape, sum(CELLS), 3, generator=generator)


@given(parts=st.lists(st.integers(0, 6), min_size=1, max_size=5), window=st.integers(1, 5),
       seed=st.integers(0, 99))  # fmt: skip
@settings(max_examples=25, deadline=None)
def test_chunks_equal_the_whole(parts, window, seed):
    skin = random_skin(sum(parts), seed=seed)
    coder = encoder(window)
    counts, force, after = coder(skin)
    state, pieces = None, []
    for chunk in skin.split(parts):
        *piece, state = coder(chunk, state)
        pieces.append(piece)
    assert torch.equal(torch.cat([c for c, _ in pieces]), counts)
    assert torch.equal(torch.cat([f for _, f in pieces]), force)
    # and both go on alike
    later = random_skin(8, seed=seed + 1)
    for one, other in zip(coder(later, state)[:2], coder(later, after)[:2]):
        assert torch.equal(one, other)


@pytest.mark.parametrize("window", [1, 2, 5])
@pytest.mark.parametrize("threshold", [0.0, 0.5])
def test_force_of_each_patch_is_the_papers_window_mean(window, threshold):
    skin = random_skin(20, seed=3, scale=0.5) - 0.1  # some readings are negative
    _, force, _ = encoder(window, threshold)(skin)
    for patch, span in enumerate(SPANS):
        expected = reference.effective_force(skin[:, span], threshold, window) / window
        np.testing.assert_allclose(force[:, patch], expected, rtol=1e-5, atol=1e-6)


def test_spikes_are_those_of_an_izhikevich_neuron_under_the_current():
    newtons = np.array([2.0, 6.0, 12.0])
    skin = torch.zeros(15, sum(CELLS), 3)
    for span, force in zip(SPANS, newtons):
        skin[:, span.start] = force / 3  # all of it on one cell
    counts, force, _ = encoder(window=1, threshold=0.0)(skin)
    np.testing.assert_allclose(force[-1], newtons, rtol=1e-6)
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
        counts, force, _ = encoder()(skin)
        others = [p for p in range(3) if p != patch]
        assert counts[:, patch].sum() > 20
        assert not counts[:, others].any()
        assert not force[:, others].any()


def test_an_untouched_skin_is_silent():
    counts, force, _ = encoder()(torch.full((200, sum(CELLS), 3), 0.016))  # 0.048 N a cell
    assert not counts.any()
    assert not force.any()


def test_leading_dimensions_are_independent_streams():
    skin = random_skin(2, 3, 12, seed=7)
    coder = encoder()
    counts, force, state = coder(skin)
    assert counts.shape == force.shape == (2, 3, 12, 3)
    again, _, _ = coder(skin, state)
    for i in range(2):
        for j in range(3):
            alone, pressed, after = coder(skin[i, j])
            assert torch.equal(counts[i, j], alone)
            torch.testing.assert_close(force[i, j], pressed)
            assert torch.equal(again[i, j], coder(skin[i, j], after)[0])


def test_one_absurd_reading_does_not_deafen_a_neuron():
    coder = encoder()
    skin = torch.zeros(150, sum(CELLS), 3)
    skin[0, 0] = 1e9
    skin[100:, 0] = 1.0
    counts, force, _ = coder(skin)
    assert torch.isfinite(force).all()
    assert not counts[40:100].any()
    assert counts[110:, 0].all()


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="at least one patch"):
        SkinEncoder([], RATE, 0.05, 3, 2.5, 0.1)
    for rate, step in ((0.0, 0.1), (50.0, 0.0), (float("nan"), 0.1), (50.0, -0.1)):
        with pytest.raises(ValueError, match="above 0"):
            SkinEncoder(CELLS, rate, 0.05, 3, 2.5, step)
    with pytest.raises(ValueError, match="multiple of spike_dt_ms"):
        SkinEncoder(CELLS, RATE, 0.05, 3, 2.5, 0.15)
    with pytest.raises(ValueError, match="window"):
        SkinEncoder(CELLS, RATE, 0.05, 0, 2.5, 0.1)
    with pytest.raises(ValueError, match=r"expected skin \(..., T, 7, 3\)"):
        encoder()(torch.zeros(5, 6, 3))
    with pytest.raises(ValueError, match=r"expected skin \(..., T, 7, 3\)"):
        encoder()(torch.zeros(7, 3))
    with pytest.raises(ValueError, match=r"expected skin \(..., T, 7, 3\)"):
        encoder()(torch.zeros(5, 7, 1))


@given(parts=st.lists(st.integers(0, 6), min_size=1, max_size=3), window=st.integers(1, 4),
       leading=st.sampled_from([(), (2,), (2, 3)]), seed=st.integers(0, 99))  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_the_compiled_pass_equals_the_tensor_operations(parts, window, leading, seed):
    skin = random_skin(*leading, sum(parts), seed=seed) - 0.3
    coder, states = encoder(window), [None, None]
    for chunk in skin.split(parts, dim=-3):
        *plain, states[0] = coder(chunk, states[0])
        *tensors, states[1] = coder(chunk.clone().requires_grad_(), states[1])
        for one, other in zip(plain, tensors):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(states[0].recent, states[1].recent, rtol=1e-6, atol=1e-6)


def test_gradients_of_the_force_are_right():
    skin = (random_skin(4, seed=2) + 0.1).double().requires_grad_()
    coder = encoder(2)
    assert torch.autograd.gradcheck(lambda readings: coder(readings)[1], skin)
