"""A sound skin passes unchanged; a damaged one is told from a touched one."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.body import Body
from hasm_torch.encoders.skin_filter import HOLD_S, PROBATION_S, RULES, SkinFilter
from hasm_torch.episode import Episode

CELLS, RATE = [7, 7, 7, 7, 6, 5], 50.0
TOTAL = sum(CELLS)
HELD = round(HOLD_S * RATE)
NOTHING = np.zeros(TOTAL, np.float32)
SHARES = np.array([0.93, *[0.07 / 6] * 6])


def clean(skin: torch.Tensor, footprint: np.ndarray = NOTHING, **options) -> torch.Tensor:
    return SkinFilter(CELLS, RATE, footprint, **options)(skin)[0]


def learned(*skins: torch.Tensor) -> np.ndarray:
    """Shares of the cells over these recordings."""
    names = [f"patch {number}" for number in range(len(CELLS))]
    normals = [[0.0, 0.0, 1.0]] * TOTAL
    body = Body(["elbow"], [0.0], [1.0], [1.0], names, CELLS, normals, rate=RATE)
    still = np.zeros((0, 1), np.float32)
    episodes = [Episode(0, "", still, still, still, skin.numpy()) for skin in skins]
    return SkinFilter.learn(body, episodes).footprint


def touched(force: np.ndarray, patch: int = 1) -> torch.Tensor:
    """Forces (T,) N on a patch of seven cells, spread as by an elastomer: (T, C, 3)."""
    skin = np.zeros((len(force), TOTAL, 3), np.float32)
    first = sum(CELLS[:patch])
    skin[:, first : first + 7] = (force[:, None] * SHARES / 3)[..., None]
    return torch.from_numpy(skin)


def push(samples: int, force: float, seed: int = 0) -> np.ndarray:
    """A push that begins after 10 samples and varies as a hand does, (T,) N."""
    rng = np.random.default_rng(seed)
    course = force * (1 + 0.2 * np.sin(np.arange(samples) / rng.uniform(5, 12)))
    return np.where(np.arange(samples) < 10, 0.0, course)


def newtons(skin: torch.Tensor) -> np.ndarray:
    """Force of each patch, (T, patches) N."""
    return torch.stack([p.abs().sum((1, 2)) for p in skin.split(CELLS, dim=1)], 1).numpy()


FOOTPRINT = learned(*(touched(push(60, 8.0), patch) for patch in range(4)))


@given(forces=st.lists(st.floats(0.05, 14.0), min_size=1, max_size=3), patch=st.integers(0, 2),
       seed=st.integers(0, 99))  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_a_sound_skin_passes_to_the_last_bit(forces, patch, seed):
    skin = sum(touched(push(80, force, seed + i), patch + i % 2) for i, force in enumerate(forces))
    assert torch.equal(clean(skin, FOOTPRINT), skin)


@given(parts=st.lists(st.integers(0, 9), min_size=1, max_size=5), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_chunks_equal_the_whole(parts, seed):
    rng = np.random.default_rng(seed)
    skin = touched(push(sum(parts), 6.0, seed))
    skin = (skin + 0.3 * torch.from_numpy(rng.standard_normal(skin.shape)).float()).clamp(min=0)
    skin[rng.random(len(skin)) < 0.2] = 0.0
    state, pieces, skin_filter = None, [], SkinFilter(CELLS, RATE, FOOTPRINT)
    for chunk in skin.split(parts):
        piece, state = skin_filter(chunk, state)
        pieces.append(piece)
    assert torch.equal(torch.cat(pieces), clean(skin, FOOTPRINT))


def test_lost_samples_repeat_the_last_one_and_a_release_comes_through():
    skin = touched(push(60, 8.0))
    gaps = skin.clone()
    gaps[20 : 20 + HELD] = 0.0
    gaps[40] = 0.0
    held = clean(gaps)
    assert torch.equal(held[20 : 20 + HELD], skin[19].expand(HELD, -1, -1))
    assert torch.equal(held[40], skin[39])
    gaps[45:] = 0.0
    released = clean(gaps)
    assert not released[45 + HELD :].any()


@pytest.mark.parametrize("level", [0.1, 0.5, 2.0])
def test_noise_alone_is_no_touch(level):
    rng = np.random.default_rng(0)
    false = 0
    for _ in range(5):
        noise = level * rng.standard_normal((400, TOTAL, 3))
        false += int((newtons(clean(torch.from_numpy(noise.clip(0)).float())) > 0).sum())
    assert false < 0.002 * 5 * 400 * len(CELLS)


@pytest.mark.parametrize(("level", "force"), [(0.1, 2.0), (0.5, 3.0), (2.0, 10.0)])
def test_a_touch_under_noise_keeps_its_strength_and_its_patch(level, force):
    rng = np.random.default_rng(1)
    course = push(300, force)
    noisy = touched(course) + level * torch.from_numpy(rng.standard_normal((300, TOTAL, 3))).float()
    felt = newtons(clean(noisy.clamp(min=0), FOOTPRINT))[30:]
    assert felt[:, 1].mean() == pytest.approx(course[30:].mean(), rel=0.25)
    others = np.delete(felt, 1, axis=1)
    assert (others > 0).mean() < 0.002


def test_an_offset_of_the_whole_skin_is_taken_out():
    skin = touched(push(100, 5.0)) + 0.2
    felt = newtons(clean(skin, FOOTPRINT))
    np.testing.assert_allclose(felt, newtons(skin - 0.2), atol=1e-4)


def test_a_body_of_few_patches_may_be_held_all_over():
    cells = [4, 4, 4]
    skin = torch.full((50, 12, 3), 0.5)
    cleaned, _ = SkinFilter(cells, RATE, np.zeros(12, np.float32))(skin)
    assert torch.equal(cleaned, skin)


@pytest.mark.parametrize("dead", [[0], [0, 3], [0, 1, 4], [2, 5]])
def test_dead_cells_take_their_share_again(dead):
    skin = touched(push(100, 8.0, 3))
    broken = skin.clone()
    broken[:, [CELLS[0] + cell for cell in dead]] = 0.0
    expected, felt = newtons(skin)[:, 1], newtons(clean(broken, FOOTPRINT))[:, 1]
    np.testing.assert_allclose(felt, expected, rtol=0.01)
    assert (newtons(clean(broken))[20:, 1] < 0.99 * expected[20:]).all()  # not without a footprint


def test_a_touch_beside_the_usual_place_is_not_taken_for_a_dead_cell():
    skin = torch.zeros(40, TOTAL, 3)
    place = CELLS[0] + 1
    skin[10:, place] = 5.0 / 3
    skin[10:, [CELLS[0], place + 1, place + 5]] = 0.05 / 3
    felt, real = newtons(clean(skin, FOOTPRINT))[:, 1], newtons(skin)[:, 1]
    assert (felt <= 1.2 * real).all()


@pytest.mark.parametrize("stuck", [0, 3, 20])
def test_a_cell_that_is_stuck_from_the_start_is_no_touch(stuck):
    skin = touched(push(100, 6.0, 2))
    broken = skin.clone()
    broken[:, stuck] = 0.5
    felt, real = newtons(clean(broken, FOOTPRINT)), newtons(skin)
    np.testing.assert_allclose(felt, real, rtol=0.01, atol=1e-5)


def test_a_constant_touch_from_the_start_is_a_touch():
    """Pressed evenly at once; on a single cell after the probation, since nothing else stirs."""
    even = touched(np.full(60, 6.0))
    assert torch.equal(clean(even, FOOTPRINT), even)
    lonely = torch.zeros(60, TOTAL, 3)
    lonely[:, CELLS[0]] = 2.0
    cleaned = clean(lonely, FOOTPRINT)
    waiting = round(PROBATION_S * RATE)
    assert not cleaned[:waiting].any()
    assert torch.equal(cleaned[waiting:, CELLS[0]], lonely[waiting:, CELLS[0]])
    assert torch.equal(clean(lonely), lonely)  # nothing is known of how touches spread


def test_a_stuck_cell_that_comes_back_is_heard_again():
    skin = touched(push(100, 6.0, 2))
    skin[:60, CELLS[0] + CELLS[1]] = 0.5
    skin[60:, CELLS[0] + CELLS[1]] = 0.7
    assert clean(skin, FOOTPRINT)[60:, CELLS[0] + CELLS[1]].any()


def test_a_footprint_leaves_out_cells_that_a_touch_may_miss():
    skin = touched(push(50, 8.0), 0)
    np.testing.assert_allclose(learned(skin)[:7], SHARES, rtol=1e-4)
    beside = skin.clone()
    beside[:, 4] = 0.0
    shares = learned(skin, beside)
    assert shares[4] == 0
    assert (shares[[0, 1, 2, 3, 5, 6]] > 0).all()
    assert not shares[7:].any()  # never touched


def test_a_rule_that_is_left_out_leaves_its_fault():
    skin = touched(push(100, 6.0, 2))
    dead, lost, stuck = skin.clone(), skin.clone(), skin.clone()
    dead[:, CELLS[0]] = 0.0
    lost[20] = 0.0
    stuck[:, 0] = 0.5
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(skin.shape)).float()
    faulty = {"dead": dead, "lost": lost, "stuck": stuck, "offset": skin + 0.2,
              "noise": (skin + 0.5 * noise).clamp(min=0)}  # fmt: skip
    for rule in RULES:
        felt, real = newtons(clean(faulty[rule], FOOTPRINT)), newtons(skin)
        left = newtons(clean(faulty[rule], FOOTPRINT, without=[rule]))
        assert np.abs(left - real).mean() > 3 * np.abs(felt - real).mean(), rule


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"expected skin \(T, 39, 3\)"):
        clean(torch.zeros(5, 38, 3))
    with pytest.raises(ValueError, match=r"footprint \(39,\)"):
        clean(torch.zeros(5, TOTAL, 3), NOTHING[:-1])
    with pytest.raises(ValueError, match=r"unknown rules \['odd'\], valid: lost, noise"):
        clean(torch.zeros(5, TOTAL, 3), without=["odd"])
