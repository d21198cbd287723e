"""How the paper is read where it leaves a choice: one test a point."""

import math

import numpy as np
import pytest
import reference
import torch
from toys import make_body, press, record, smooth_path

from hasm_torch import (
    HASM,
    HASMConfig,
    HeteroAssociativeMemory,
    PlaceCode,
    RoPE3D,
    TactileEmbedding,
    bind,
    touch_rotation,
)
from hasm_torch.encoders.touch import EffectiveForce
from hasm_torch.memory.successors import shifted_links

BODY = make_body(3)


def random_code(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.where(
        torch.rand(*shape, generator=generator, dtype=torch.float64) < 0.5, -1.0, 1.0
    )


def test_the_axis_is_that_of_the_touch_and_the_same_in_every_block():
    """Turned about itself, as the sentence can be read, a block does not move."""
    code = random_code(12)
    axis, angle = touch_rotation(torch.tensor([0.3, -0.9, 0.2], dtype=torch.float64))
    turned = RoPE3D(12)(code, axis, angle)
    expected = reference.rope3d_matrix(12, axis, float(angle)) @ code.numpy()
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    assert (turned - code).abs().max() > 0.5
    np.testing.assert_allclose(reference.rope3d_literal(code, float(angle)), code, atol=1e-12)


def test_opposite_directions_have_a_rotation():
    for direction in ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]):
        axis, angle = touch_rotation(torch.tensor(direction))
        assert torch.isfinite(axis).all()
        assert float(angle) == pytest.approx(math.pi if direction[2] < 0 else 0.0, abs=1e-6)


@pytest.mark.parametrize("dim", [9, 200])
def test_the_frequency_of_block_i_is_ten_to_the_minus_i_over_d(dim):
    """Seen where each block turns within the plane across the axis."""
    code = torch.zeros(dim, dtype=torch.float64)
    code[0 : dim - dim % 3 : 3] = 1.0
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turned = RoPE3D(dim)(code, axis, torch.tensor(1.0, dtype=torch.float64))
    blocks = turned[: dim - dim % 3].reshape(-1, 3)
    angles = torch.atan2(blocks[:, 1], blocks[:, 0])
    expected = [10 ** (-i / dim) for i in range(1, dim // 3 + 1)]
    np.testing.assert_allclose(angles, expected, rtol=1e-12)
    assert turned.norm() == pytest.approx(float(code.norm()))


def test_entries_beyond_the_last_block_stay():
    code = random_code(200)
    turned = RoPE3D(200)(code, torch.tensor([1.0, 0, 0]).double(), torch.tensor(2.0).double())
    assert torch.equal(turned[198:], code[198:])
    assert turned.norm() == pytest.approx(float(code.norm()))


def test_codes_are_bits_times_neurons_times_joints_long():
    place = PlaceCode([-1.0] * 5, [1.0] * 5)
    code = place(torch.zeros(5))
    touch = TactileEmbedding(5, 10, 4)(torch.tensor(0.3), place.levels(torch.zeros(5)))
    assert code.shape == touch.shape == (4 * 10 * 5,)


def test_rates_keep_their_most_significant_bits():
    """A neuron fires at 1, written 255, at its preferred position, at e^-1/2 a spacing off."""
    place = PlaceCode([0.0], [9.0], neurons=10, bits=4)
    levels = place.levels(torch.tensor([3.0]))
    assert levels[3] == 255 >> 4
    assert levels[2] == levels[4] == round(255 * math.exp(-0.5)) >> 4
    word = place(torch.tensor([3.0]))[4 * 4 : 4 * 5]  # neuron 4, most significant bit first
    assert word.tolist() == [1.0 if b == "1" else -1.0 for b in format(int(levels[4]), "04b")]


def test_zeros_are_written_as_minus_one():
    code = PlaceCode([-1.0, 0.0], [1.0, 2.0])(torch.tensor([0.3, 1.1]))
    assert set(code.tolist()) == {-1.0, 1.0}


def test_the_n_largest_are_taken_over_levels_and_ties_go_to_the_lower_index():
    embed = TactileEmbedding(1, 6, 2)
    levels = torch.tensor([1, 3, 3, 0, 3, 1])

    def marked(count: int) -> list[int]:
        code = embed(torch.tensor(count / 6), levels).reshape(6, 2)
        assert (code[:, 0] == code[:, 1]).all()  # ranked before they became bits
        return torch.nonzero(code[:, 0] > 0).flatten().tolist()

    assert [marked(n) for n in range(4)] == [[], [1], [1, 2], [1, 2, 4]]
    assert marked(4) == [0, 1, 2, 4]
    assert marked(6) == [0, 1, 2, 3, 4, 5]


def test_the_cells_of_a_patch_are_summed_after_the_threshold():
    forces = torch.zeros(1, 2, 3)
    forces[0, 0], forces[0, 1, 0] = torch.tensor([1.0, -2.0, 0.5]), 0.9
    assert EffectiveForce(1.0, 1)(forces).item() == pytest.approx(3.5 - 1.0)


def test_the_successor_is_a_later_state_of_the_same_episode():
    source, target = shifted_links(torch.tensor([0, 0, 0, 1, 1]), horizon=1)
    assert source.tolist() == [0, 1, 3]
    assert target.tolist() == [1, 2, 4]


def test_no_recall_leads_from_one_episode_into_another():
    """Two episodes in different corners: after its last state the first one holds still."""
    low, high = smooth_path(BODY, 200, 0, [0])[:80], smooth_path(BODY, 200, 0, [0])[120:]
    model = HASM(HASMConfig(store="sample", touch_levels="nearest"), BODY)
    model.fit([record(BODY, "front", path, 6.0) for path in (low, high)])
    memory = model.memories["front"]
    here = torch.tensor(low[:1, :1], dtype=torch.float32)
    for _ in range(200):
        here, _ = memory(here, torch.tensor([0.5]))
    assert here.item() <= low[-1, 0] + 0.01


def test_beta_weighs_unnormalised_inner_products():
    states, touch = random_code(4, 60), random_code(60, seed=1)
    values = torch.eye(4, dtype=torch.float64)
    memory = HeteroAssociativeMemory(60, 4, capacity=4, beta=0.0625).double()
    memory.write(states, touch.expand(4, 60), values)
    recalled = memory(states[2], touch)
    stored = (states * touch).numpy()
    expected = reference.softmax_recall(stored.T, values.T, stored[2], 0.0625)
    np.testing.assert_allclose(recalled, expected, atol=1e-9)
    assert recalled[2] < 0.95  # 60 / 16 is no clear lead ...
    memory.beta.fill_(2.0)
    assert memory(states[2], touch)[2] > 1 - 1e-9  # ... beta > 1 picks one memory


def test_rotated_codes_are_real_or_taken_by_their_sign():
    axis, angle = touch_rotation(torch.tensor([1.0, 0.4, -0.3]))
    body = make_body(3)
    body.directions[0] = [1.0, 0.4, -0.3]
    codes = {}
    for rebinarise in (True, False):
        config = HASMConfig(rebinarise=rebinarise, storage="float32")
        model = HASM(config, body)
        model.fit([record(body, "front", smooth_path(body, 100, 0, [0]), 6.0)])
        memory = model.memories["front"]
        state, codes[rebinarise] = memory.codes(torch.zeros(1), torch.tensor(0.5))
        touch = memory.embedding(memory.touch_levels[0], memory.place_code.levels(torch.zeros(1)))
        real = memory.memory.rope(touch, axis, angle)
        torch.testing.assert_close(codes[rebinarise], real.sign() if rebinarise else real)
        assert torch.equal(bind(state, codes[rebinarise]), state * codes[rebinarise])
    assert (codes[False].abs() - 1).abs().max() > 0.1
    assert set(codes[True].tolist()) == {-1.0, 1.0}


def test_spikes_drive_the_steps():
    """Every spike of the patch moves the joints; the way is the number of spikes over the pace."""
    model = HASM(HASMConfig(), BODY)
    model.fit([record(BODY, "front", smooth_path(BODY, 300, 0, [0]), 6.0)])
    state, moved, fired = torch.tensor(smooth_path(BODY, 300, 0, [0])[3]).float(), [], []
    for force in [2.0] * 60 + [8.0] * 30 + [0.0] * 20:
        skin = press(BODY, "front", force)
        target = model.step(state, skin)
        moved.append(float(target[0] - state[0]))
        fired.append(float(model.rollout.spikes[-1][0]))
        state = target
    moved, fired = np.array(moved), np.array(fired)
    assert (moved[fired == 0] == 0).all()
    assert (moved[fired > 0] > 0).all()
    pace = fired / np.where(moved > 0, moved, np.nan)
    steady = np.r_[20:60, 70:88]
    assert np.nanstd(pace[steady]) < 0.15 * np.nanmean(pace[steady])


def test_the_paper_as_written_is_a_setting():
    literal = HASMConfig.literal()
    assert (literal.bits, literal.code, literal.neurons) == (4, "binary", 10)
    assert (literal.store, literal.horizon, literal.advance) == ("sample", 1, "tick")
    assert not literal.rebinarise
    assert literal.beta > 1
