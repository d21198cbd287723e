import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.encoders.place_code import PlaceCode
from hasm_torch.encoders.touch import (
    EffectiveForce,
    TactileEmbedding,
    effective_force,
    pair_with_spikes,
    spike_density,
)

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def random_forces(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("device", DEVICES)
@given(
    steps=st.integers(0, 12),
    cells=st.integers(1, 7),
    window=st.integers(1, 15),
    threshold=st.floats(0, 4),
    seed=st.integers(0, 999),
)
@settings(max_examples=20, deadline=None)
def test_effective_force_matches_the_paper(device, steps, cells, window, threshold, seed):
    forces = random_forces(2, steps, cells, seed=seed)
    result = EffectiveForce(threshold, window)(forces.to(device)).cpu()
    for row in range(2):
        expected = reference.effective_force(forces[row], threshold, window)
        np.testing.assert_allclose(result[row], expected, rtol=1e-12, atol=1e-12)


def test_effective_force_ignores_the_future_and_noise():
    forces = random_forces(20, 7)
    later = forces.clone()
    later[12:] = 100.0
    assert torch.equal(effective_force(forces, 0.5, 4)[:12], effective_force(later, 0.5, 4)[:12])
    quiet = 0.3 * forces / forces.abs().sum(-1, keepdim=True)
    assert torch.equal(effective_force(quiet, 0.31, 4), torch.zeros(20, dtype=torch.float64))


def test_effective_force_remembers_the_window_only():
    forces = torch.zeros(2000, 1, 3)
    forces[:1000] = 1e4 / 3
    forces[1500:] = 0.1
    result = effective_force(forces, 0.0, 10)
    assert torch.equal(result[1010:1500], torch.zeros(490))
    torch.testing.assert_close(result[1510:], torch.full((490,), 3.0))


def test_effective_force_gradients():
    forces = random_forces(6, 4, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: effective_force(f, 1.0, 3), (forces,))


def test_spike_density_is_clamped():
    rates = torch.tensor([-1.0, 0.0, 150.0, 300.0, 900.0])
    for rate in (rates, rates.numpy()):
        assert spike_density(rate, 300.0).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    with pytest.raises(ValueError, match="max_rate > 0"):
        spike_density(rates, 0.0)


@pytest.mark.parametrize("device", DEVICES)
@given(
    rho=st.floats(0, 1),
    joints=st.integers(1, 5),
    neurons=st.integers(2, 12),
    bits=st.integers(1, 5),
    top=st.sampled_from([1, 3, 255]),
    seed=st.integers(0, 999),
)
@settings(max_examples=30, deadline=None)
def test_tactile_embedding_matches_the_paper(device, rho, joints, neurons, bits, top, seed):
    generator = torch.Generator().manual_seed(seed)
    levels = torch.randint(0, top + 1, (3, joints * neurons), generator=generator)
    embed = TactileEmbedding(joints, neurons, bits)
    density = torch.full((3,), rho, dtype=torch.float64)
    result = embed(density.to(device), levels.to(device).int()).cpu()
    for row in range(3):
        expected = reference.tactile_embedding(rho, levels[row].numpy(), bits)
        np.testing.assert_array_equal(result[row], expected)


def test_more_force_only_adds_active_entries():
    encoder = PlaceCode([-2.62, -1.9], [0.0, 3.8])
    embed = TactileEmbedding(2, 10, 4)
    rho = torch.linspace(0, 1, 21).unsqueeze(-1)
    codes = embed(rho, encoder.levels(torch.tensor([[-1.0, 0.5], [-2.0, 1.0]])))
    assert codes.shape == (21, 2, 80)
    assert (codes.diff(dim=0) >= 0).all()
    active = (codes > 0).sum(-1)
    assert torch.equal(active, torch.arange(0, 84, 4).unsqueeze(-1).expand(21, 2))


def test_tactile_embedding_broadcasts_and_compiles_whole():
    embed = TactileEmbedding(2, 3, 2)
    levels = torch.tensor([[3, 1, 3, 0, 2, 3], [0, 0, 0, 0, 0, 0]])
    codes = embed(torch.tensor(1 / 3), levels)
    assert codes.tolist() == [
        [1, 1, -1, -1, 1, 1, -1, -1, -1, -1, -1, -1],
        [1, 1, 1, 1, -1, -1, -1, -1, -1, -1, -1, -1],
    ]
    rho = torch.rand(4, 1, generator=torch.Generator().manual_seed(0))
    compiled = torch.compile(embed, fullgraph=True, backend="eager")
    assert torch.equal(compiled(rho, levels), embed(rho, levels))
    assert embed(rho.bfloat16(), levels).dtype == torch.bfloat16


times = st.integers(0, 64).map(lambda tick: tick / 64)  # exact, so that ties are ties


@pytest.mark.parametrize("device", DEVICES)
@given(
    samples=st.lists(times, max_size=8),
    spikes=st.lists(times, max_size=8, unique=True),
    window=st.sampled_from([0.0, 1 / 64, 0.2, 5.0]),
)
@settings(max_examples=40, deadline=None)
def test_pairs_match_brute_force(device, samples, spikes, window):
    spikes = sorted(spikes)
    result = pair_with_spikes(
        torch.tensor(samples, dtype=torch.float64, device=device),
        torch.tensor(spikes, dtype=torch.float64, device=device),
        window,
    )
    assert result.tolist() == reference.closest_spikes(samples, spikes, window)


def test_pairs_prefer_the_earlier_spike_and_ignore_filling():
    inf = torch.inf
    samples = torch.tensor([[0.5, 2.5, 9.0], [1.0, 3.0, 7.0]])
    spikes = torch.tensor([[0.0, 1.0, 4.0, inf], [2.0, inf, inf, inf]])
    expected = [[0, 1, -1], [0, 0, -1]]
    assert pair_with_spikes(samples, spikes, 1.5).tolist() == expected
    assert pair_with_spikes(samples, torch.full((2, 1), inf), inf).tolist() == [[-1] * 3] * 2


def test_errors_say_what_was_expected():
    with pytest.raises(ValueError, match=r"\(\.\.\., T, cells, 3\), got \(4, 7, 2\)"):
        effective_force(torch.zeros(4, 7, 2), 0.0, 1)
    for window in (0, 2.5):
        with pytest.raises(ValueError, match=f"window.*got {window}"):
            EffectiveForce(0.1, window)
    with pytest.raises(ValueError, match=r"threshold >= 0 N, got -0\.1"):
        EffectiveForce(-0.1, 1)
    embed = TactileEmbedding(2, 10, 4)
    with pytest.raises(ValueError, match=r"\(\.\.\., 20\), got \(3, 10\)"):
        embed(torch.zeros(3), torch.zeros(3, 10).int())
    for rho in (-0.1, 1.1, torch.nan):
        with pytest.raises(ValueError, match=r"rho in \[0, 1\]"):
            embed(torch.tensor([0.5, rho]), torch.zeros(2, 20).int())
    with pytest.raises(ValueError, match=r"leading dimensions, got \(2, 3\) and \(3,\)"):
        pair_with_spikes(torch.zeros(2, 3), torch.zeros(3), 0.1)
    with pytest.raises(ValueError, match="ascending spike times"):
        pair_with_spikes(torch.zeros(3), torch.tensor([1.0, 0.5]), 0.1)
