"""How the paper is read where it leaves a choice: one test a point."""

import math

import numpy as np
import pytest
import reference
import torch
from torch import nn
from toys import along, make_body, postures, press, record, settled, smooth_path, spell, yielding

from hasm_torch import (
    HASM,
    HASMConfig,
    HeteroAssociativeMemory,
    PlaceCode,
    RoPE3D,
    TactileEmbedding,
    binarise,
)
from hasm_torch.encoders.touch import EffectiveForce, pair_with_spikes
from hasm_torch.memory.successors import shifted_links
from hasm_torch.model.query import QueryCode

BODY = make_body(3)


def random_code(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.where(
        torch.rand(*shape, generator=generator, dtype=torch.float64) < 0.5, -1.0, 1.0
    )


def test_the_axis_is_that_of_the_touch_and_the_same_in_every_block():
    """Turned about itself, as the sentence can be read, a block does not move."""
    code = random_code(12)
    axis = nn.functional.normalize(torch.tensor([0.3, -0.9, 0.2], dtype=torch.float64), dim=0)
    angle = torch.tensor(2.0, dtype=torch.float64)
    turned = RoPE3D(12)(code, axis, angle)
    expected = reference.rope3d_matrix(12, axis, float(angle)) @ code.numpy()
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    assert (turned - code).abs().max() > 0.5
    np.testing.assert_allclose(reference.rope3d_literal(code, float(angle)), code, atol=1e-12)


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
    path = smooth_path(BODY, 200, 0, [0])
    low, high = path[:80], path[120:]
    model = HASM(HASMConfig(value="successor"), BODY)
    model.fit([record(BODY, "front", part, 6.0) for part in (low, high)])
    targets = spell(model, BODY, torch.tensor(low[0]).float(), "front", 6.0, 250)
    assert targets[:, 0].max() <= low[-1, 0] + 0.01
    assert targets[-1, 0] == pytest.approx(low[-1, 0], abs=0.05)


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


def touch_code(model: HASM, toward: list[float]) -> torch.Tensor:
    """The query of a touch from some direction, in one posture."""
    row = torch.zeros(1, 3), torch.tensor([0.5]), torch.tensor([0])
    return model.recalling.code(*row, torch.tensor([toward], dtype=torch.float64))[0]


def taught(body, **config) -> HASM:
    model = HASM(HASMConfig(value="displacement", **config), body)
    touches = [(None, 10), ("front", 30), (None, 10)]
    model.fit([yielding(body, along(body), q, touches) for q in postures(body, 5, 0)])
    return model


def test_rotated_codes_are_real_or_taken_by_their_sign():
    """The text rotates ±1 codes into real ones, the abstract says bipolar: the storage decides."""
    for storage in ("float32", "bit"):
        model = taught(BODY, touch="direction", storage=storage)
        real = touch_code(model, [0.6, 0.0, 0.8])
        assert (real.abs() - 1).abs().max() > 0.1
        stored = model.recalling.memory.stored()
        assert (set(stored.unique().tolist()) == {-1.0, 1.0}) == (storage == "bit")


def test_the_axis_is_the_direction_of_the_force_and_the_angle_one_for_all_blocks():
    model = taught(BODY, touch="direction", readout="mean", joints=["joint_0", "joint_2"])
    code = model.recalling.code
    still = touch_code(model, [0.0, 0.0, 0.0])
    toward = [0.0, -0.6, 0.8]
    state = code.place_code(torch.zeros(1, 2))[0]
    blocks = code.code_dim // 3
    plain = (still * state)[: 3 * blocks].reshape(blocks, 3).double()
    turned = (touch_code(model, toward) * state)[: 3 * blocks].reshape(blocks, 3).double()
    for i in range(blocks):
        turn = reference.rodrigues(toward, math.pi / 2 * 10 ** (-(i + 1) / code.code_dim))
        expected = code.mixing[i].numpy() @ turn @ plain[i].numpy()
        np.testing.assert_allclose(turned[i], expected, atol=1e-5)


def test_a_rotation_that_is_constant_a_patch_cancels_in_the_match():
    """(s ⊗ c) · (s′ ⊗ c) = s · s′ for a touch c that never changes: RoPE3D must be seen to turn."""
    positions = torch.tensor(postures(BODY, 12, 1))
    row = torch.full((12,), 0.5), torch.zeros(12, dtype=torch.int64)
    toward = torch.tensor([[0.6, 0.0, -0.8]], dtype=torch.float64).expand(12, 3)
    matches = []
    for rope in (True, False):
        code = QueryCode(HASMConfig(rope=rope), BODY, settled(BODY))
        signs = binarise(code(positions, *row, toward))
        matches.append(signs @ signs.T)
    assert torch.equal(*matches)


def test_in_the_links_frame_rope3d_moves_nothing_but_in_the_base_frame_it_does():
    start = torch.tensor(postures(BODY, 1, 9)[0]).float()
    moved = {}
    for frame in ("link", "base"):
        for rope in (True, False):
            chosen = {"touch": "direction", "readout": "mean", "beta": 0.05,
                      "joints": ["joint_0", "joint_1"]}  # fmt: skip
            model = taught(BODY, frame=frame, rope=rope, **chosen)
            moved[frame, rope] = spell(model, BODY, start, "front", 6.0, 12)
    torch.testing.assert_close(moved["link", True], moved["link", False], rtol=0, atol=1e-5)
    assert (moved["base", True] - moved["base", False]).abs().max() > 1e-3


def test_spikes_drive_the_steps():
    """Every spike of the patch moves the joints, by what a spike moved them when taught."""
    path = smooth_path(BODY, 300, 0, [0])
    episode = record(BODY, "front", path, 6.0)
    for value in ("displacement", "goal", "successor"):
        model = HASM(HASMConfig(value=value), BODY)
        model.fit([episode])
        state, moved, fired = torch.tensor(path[3]).float(), [], []
        for force in [3.0] * 60 + [8.0] * 30 + [0.0] * 20:
            target = model.step(state, press(BODY, "front", force))
            moved.append(float(target[0] - state[0]))
            fired.append(float(model.rollout.spikes[-1][0]))
            state = target
        moved, fired = np.array(moved), np.array(fired)
        assert (moved[fired == 0] == 0).all()
        assert (moved[fired > 0] > 0).all()
        pace = fired / np.where(moved > 0, moved, np.nan)
        steady = np.r_[20:60, 70:88]
        assert np.nanstd(pace[steady]) < 0.15 * np.nanmean(pace[steady])


def test_the_touch_code_stored_is_that_at_the_closest_spike():
    pairs = pair_with_spikes(torch.tensor([0.0, 0.02, 0.5]), torch.tensor([0.03, 0.1]), 0.05)
    assert pairs.tolist() == [0, 0, -1]  # within the window, before or after; see test_collect


def test_the_paper_as_written_is_a_setting():
    literal = HASMConfig.literal()
    assert (literal.bits, literal.code, literal.neurons, literal.width) == (4, "binary", 10, 1.0)
    assert (literal.value, literal.distinct, literal.drive) == ("successor", False, "spike")
    assert (literal.ranks, literal.pattern, literal.storage) == ("place", "state", "float32")
    assert (literal.touch, literal.readout) == ("patch", "mean")
    assert literal.beta > 1
    assert literal.rope  # but its memories know one patch each, in which it cancels


def test_the_literal_memory_follows_its_samples():
    """One recall a control step, towards the state ``horizon`` samples after the nearest."""
    path = smooth_path(BODY, 240, 0, [0])
    model = HASM(HASMConfig.literal(), BODY)
    model.fit([record(BODY, "front", path, 6.0)])
    assert model.recalling.code.angle == 0.0
    assert len(model.origins) > 150  # every sample with a spike near it
    state = torch.tensor(path[10]).float()
    for _ in range(60):
        state = model.step(state, press(BODY, "front", 6.0))
        assert len(model.recalled()) <= 1
    assert state[0] > path[10, 0] + 0.2
