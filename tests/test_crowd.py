"""Unrelated motions are stored as ``fit`` stores them, and what is measured beside them holds."""

from pathlib import Path

import numpy as np
import pytest
import torch
from toys import Recorded, make_body, press, record, smooth_path

from benchmarks.baselines.crowd import crowded, known_states, random_motions
from benchmarks.baselines.crowd_measures import beta_of, codes_of, margin, step_times
from hasm_torch import HASM, HASMConfig
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.memory.recall import inspect_packed, pack
from hasm_torch.sim.poses import START_POSES

FORCES = (4.0, 8.0)


def trained(joints, samples=300):
    """A model that knows one motion at each of two forces, and the episodes."""
    body = make_body(joints)
    moved = list(range(joints))
    episodes = [
        record(body, "front", smooth_path(body, 300, seed, moved)[:samples], force)
        for seed, force in enumerate(FORCES)
    ]
    model = HASM(HASMConfig(), body)
    model.fit(episodes)
    return model, episodes


def taught_positions(model, episodes):
    taught = torch.cat([torch.from_numpy(episode.action) for episode in episodes])
    return taught[:, model.memory("front").joints]


def as_episodes(model, episodes, sequences, length, seed):
    """The motions that ``crowded`` draws, as a robot would have recorded them."""
    generator = np.random.default_rng(seed)
    memory = model.memory("front")
    known = known_states(memory, taught_positions(model, episodes))
    motions = random_motions(memory, known, sequences, length, generator).numpy()
    levels = generator.integers(len(memory.touch_levels), size=sequences)
    forces = [FORCES[i] for i in memory.touch_levels.argsort().argsort()[levels]]
    taught = []
    for level in range(len(FORCES)):
        for motion, force, at in zip(motions, forces, levels):
            if at == level:
                path = np.vstack([motion[:1].repeat(10, 0), motion, motion[-1:].repeat(10, 0)])
                skin = press(model.body, "front", force).numpy()
                tactile = np.broadcast_to(skin, (len(path), *skin.shape)).copy()
                taught.append(Recorded(np.arange(len(path)) / 50, path, path, tactile))
    return taught


def contents(model):
    """Associations and the positions stored with them, as a set."""
    memory = model.memory("front").memory
    codes = np.packbits(memory.stored().numpy() > 0, axis=1)
    positions = memory.successors[: int(memory.count), :-1].numpy()
    return {(code.tobytes(), at.tobytes()) for code, at in zip(codes, positions)}


@pytest.mark.parametrize(
    ("joints", "samples", "sequences"), [(1, 300, 6), (1, 100, 12), (2, 300, 40), (3, 300, 40)]
)
def test_motions_are_stored_as_fit_stores_them(joints, samples, sequences):
    model, episodes = trained(joints, samples)
    crowd = crowded(model, episodes, sequences, 60, np.random.default_rng(7))
    together = HASM(model.config, model.body)
    together.fit([*episodes, *as_episodes(model, episodes, sequences, 60, 7)])
    assert contents(crowd.model) == contents(together)
    stored = crowd.stored["front"]
    memory = crowd.model.memory("front").memory
    assert stored.learned + stored.unrelated == int(memory.count) == memory.capacity
    if joints == 1 and samples == 300:
        assert stored.unrelated == 0, "this case is to hold no state that is not known"
    if joints == 1 and samples == 100:
        assert stored.redirected > 0, "this case is to hold a known end that is continued"
    if joints == 2:
        assert min(stored.joined, stored.met) > 0, "this case is to hold motions that cross"


def test_states_are_distinct_and_ends_link_to_themselves():
    model, episodes = trained(3)
    crowd = crowded(model, episodes, 30, 60, np.random.default_rng(1))
    taught = as_episodes(model, episodes, 30, 60, 1)
    memory = crowd.model.memory("front")
    known = known_states(memory, taught_positions(model, [*episodes, *taught]))
    codes = memory.place_code(known.positions)
    for level in range(len(FORCES)):
        mine = codes[known.level == level]
        differing = (mine.shape[1] - mine @ mine.mT) / 2
        assert differing.fill_diagonal_(torch.inf).min() >= model.config.resolution
    ends = known.following == torch.arange(len(known.following))
    at = torch.arange(len(known.following))
    for _ in range(len(at)):
        at = known.following[at]
    assert ends[at].all(), "every motion comes to its end"


def test_without_motions_nothing_changes():
    model, episodes = trained(2)
    crowd = crowded(model, episodes, 0, 60, np.random.default_rng(0))
    before, after = model.state_dict(), crowd.model.state_dict()
    assert before.keys() == after.keys()
    for name, tensor in before.items():
        torch.testing.assert_close(after[name], tensor, rtol=1e-6, atol=0)
    assert model.memory("front").memory is not crowd.model.memory("front").memory


def test_what_was_known_is_recalled_beside_the_motions():
    model, episodes = trained(3)
    crowd = crowded(model, episodes, 200, 60, np.random.default_rng(2))
    memory = model.memory("front")
    known = known_states(memory, taught_positions(model, episodes))
    recalled, _ = crowd.model.memory("front")(known.positions, memory.touch_levels[known.level])
    error = (recalled - known.positions[known.following]).abs() / torch.tensor(memory.span)
    assert crowd.stored["front"].redirected == 0
    assert error.max() < 1e-3


def test_margin_and_beta_agree_with_brute_force():
    model, episodes = trained(2)
    crowd = crowded(model, episodes, 20, 60, np.random.default_rng(3))
    memory, learned = crowd.model.memory("front").memory, crowd.stored["front"].learned
    codes = memory.stored().numpy().astype(np.float64)
    np.testing.assert_array_equal(codes_of(memory, torch.arange(5, 70)).numpy(), codes[5:70])
    matches = codes[:learned] @ codes.T
    own = matches[np.arange(learned), np.arange(learned)].copy()
    matches[np.arange(learned), np.arange(learned)] = -np.inf
    leads = np.sort(own - matches.max(1))
    unrelated = np.sort(own - matches[:, learned:].max(1))
    fifth = int(0.05 * (learned - 1))
    expected = (leads[0], leads[fifth], unrelated[0], unrelated[fifth])
    assert margin(memory, learned) == pytest.approx(expected)
    assert margin(model.memory("front").memory, learned)[2:] == (np.inf, np.inf)
    assert beta_of(memory) == pytest.approx(memory.crowding().beta, rel=1e-6)
    assert float(memory.beta) == pytest.approx(memory.crowding().beta, rel=1e-6)


def test_a_model_that_cannot_be_crowded_is_refused():
    model, episodes = trained(2)
    with pytest.raises(ValueError, match="stored states are not in the episodes"):
        crowded(model, episodes[:1], 2, 60, np.random.default_rng(0))
    model.config.storage = "float32"
    with pytest.raises(ValueError, match="storage='bit'"):
        crowded(model, episodes, 2, 60, np.random.default_rng(0))


def test_the_grasp_beside_motions():
    data = load_episodes(Path(__file__).parent.parent / "datasets" / "hsr_grasp")
    model = HASM(HASMConfig(), body_of(data))
    model.fit(data.episodes)
    crowd = crowded(model, data.episodes, 20, 110, np.random.default_rng(0))
    for patch, stored in crowd.stored.items():
        before, after = model.memory(patch).memory, crowd.model.memory(patch).memory
        query = codes_of(before, torch.arange(stored.learned))
        found = after.inspect(query)
        assert torch.equal(found.match, torch.arange(stored.learned))
        span = torch.tensor(model.memory(patch).span)
        error = (found.decision - before.successors)[:, :-1].abs() / span
        assert error.max() < 1e-3
        assert margin(after, stored.learned).smallest > 0
    times = step_times(crowd.model, torch.tensor(START_POSES["grasp"]), rounds=1)
    assert 0 < times.recall_steps < times.steps
    assert times.median <= times.p99 <= times.largest


@pytest.mark.parametrize("flipped", [0.0, 0.02, 0.2])
@pytest.mark.parametrize("dim", [257, 800, 1280])
def test_long_codes_are_recalled_exactly_though_far_ones_are_left_early(dim, flipped):
    rng = np.random.default_rng(dim)
    walks = np.where(np.cumsum(rng.random((1500, dim)) < 0.01, axis=0) % 2, 1.0, -1.0)
    values = rng.standard_normal((len(walks), 3))
    query = walks[[3, 700, 1499]] * np.where(rng.random((3, dim)) < flipped, -1, 1)
    for beta in (0.02, 0.5, 3.0, -0.1):
        found = inspect_packed(
            torch.from_numpy(query).float(),
            pack(torch.from_numpy(walks)),
            torch.from_numpy(values).float(),
            beta,
        )
        scores = query @ walks.T
        weights = np.exp(beta * scores - (beta * scores).max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        ranked = np.sort(np.sign(beta) * scores, axis=1)
        np.testing.assert_allclose(found.decision.numpy(), weights @ values, atol=1e-5)
        np.testing.assert_array_equal(found.margin.numpy(), ranked[:, -1] - ranked[:, -2])
        best = scores[np.arange(3), found.match.numpy()]
        np.testing.assert_array_equal(best, np.sign(beta) * ranked[:, -1])
