"""Learning one episode more and forgetting one, against fitting all of them together."""

import dataclasses

import numpy as np
import pytest
import torch
from recordings import KINDS, write
from toys import BASE, Recorded, along, make_body, postures, press, record, smooth_path, yielding

from hasm_torch import HASM, Body, HASMConfig
from hasm_torch.data import load_episodes
from hasm_torch.data.body import body_of
from hasm_torch.model.explain import KNOWN_COSINE, LEAST_WEIGHT

BODY = make_body(3)
PLACED = make_body(3, observations={"observation.place": 1})
TOUCHES = [(None, 10), ("front", 20), (None, 10), ("side", 20), (None, 10)]
VALUES = [
    {"value": "displacement", "readout": "first_order", "beta": 0.05},
    {"value": "displacement", "readout": "mean", "beta": 0.05, "storage": "float32"},
    {"value": "goal", "readout": "mean", "beta": 0.1},
    {"value": "successor"},
]


def pushes(count: int, seed: int = 0, body=BODY):
    """Episodes in which the hand goes where it is pushed."""
    return [yielding(body, along(body), q, TOUCHES) for q in postures(body, count, seed)]


def fitted(episodes, body=BODY, **config) -> HASM:
    joints = [body.joints[j] for j in body.limited]
    model = HASM(HASMConfig(touch="direction", joints=joints, **config), body)
    model.fit(episodes)
    return model


def assert_alike(one: HASM, other: HASM) -> None:
    """Same settings, same associations in the same order, same steps."""
    left, right = (dataclasses.replace(m.settled, chosen_from=0) for m in (one, other))
    assert left == right
    held = int(one.recalling.memory.count)
    assert held == int(other.recalling.memory.count)
    assert held >= (12 if one.settled.value == "goal" else 20)
    torch.testing.assert_close(one.recalling.memory.stored(), other.recalling.memory.stored())
    torch.testing.assert_close(
        one.recalling.memory.successors[:held],
        other.recalling.memory.successors[:held],
        rtol=0,
        atol=0,
    )
    torch.testing.assert_close(one.tolerance, other.tolerance, rtol=0, atol=0)
    np.testing.assert_array_equal(one.origins[:, 1:], other.origins[:, 1:])
    for q in postures(BODY, 3, 77):
        for patch in ("front", "side"):
            paths = []
            for model in (one, other):
                model.reset()
                state = torch.tensor(q).float()
                for _ in range(15):
                    state = model.step(state, press(BODY, patch, 5.0))
                paths.append(state)
            torch.testing.assert_close(*paths, rtol=0, atol=1e-6)
            assert float((paths[0] - torch.tensor(q)).abs().max()) > 1e-3


@pytest.mark.parametrize("config", VALUES, ids=lambda c: f"{c['value']} {c.get('storage', '')}")
def test_episodes_learned_one_by_one_are_those_fitted_together(config):
    episodes = pushes(9)
    grown = fitted(episodes[:5], **config)
    for episode in episodes[5:]:
        known = grown.learn(episode)
        assert known.associations > 0 or config["value"] == "successor"
    assert_alike(grown, fitted(episodes, **config))


@pytest.mark.parametrize("config", VALUES, ids=lambda c: f"{c['value']} {c.get('storage', '')}")
@pytest.mark.parametrize("gone", [0, 3, 6])
def test_a_forgotten_episode_was_never_there(config, gone):
    episodes = pushes(7)
    model = fitted(episodes, **config)
    model.forget(gone)
    assert gone not in model.origins[:, 0]
    assert [known.number for known in model.episodes] == [n for n in range(7) if n != gone]
    assert_alike(model, fitted(episodes[:gone] + episodes[gone + 1 :], **config))


@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_learning_and_forgetting_ends_at_the_same_memory(seed):
    rng = np.random.default_rng(seed)
    episodes = pushes(12, 5)
    model = fitted(episodes[:6], **VALUES[0])
    held = {n: episodes[n] for n in range(6)}
    for episode in episodes[6:]:
        held[model.learn(episode).number] = episode
        gone = int(rng.choice(list(held)))
        model.forget(gone)
        del held[gone]
    assert [known.number for known in model.episodes] == list(held)
    assert_alike(model, fitted(list(held.values()), **VALUES[0]))


def test_an_episode_with_wider_ranges_codes_all_anew():
    """A new patch, more joints and a stronger touch than before."""
    weak = [record(BODY, "front", smooth_path(BODY, 60, s, [0]), 2.0) for s in range(4)]
    strong = record(BODY, "back", smooth_path(BODY, 60, 9, [1, 2]), 9.0)
    config = VALUES[0]
    model = fitted(weak, **config)
    before = model.settled
    known = model.learn(strong, "from behind")
    assert (known.name, known.patches, known.seconds) == (
        "from behind",
        ["back"],
        len(strong.time) / 50,
    )
    assert model.settled.moved > before.moved
    assert model.settled.density[1] > before.density[1]
    assert model.patches == ["front", "back"]
    together = fitted([*weak, strong], **config)
    assert_alike_settings = (model.settled.moved_by, model.settled.density, model.settled.taught)
    other = together.settled
    assert assert_alike_settings == (other.moved_by, other.density, other.taught)
    torch.testing.assert_close(model.recalling.memory.stored(), together.recalling.memory.stored())
    model.forget(known.number)
    assert model.settled.code_facts == before.code_facts
    assert model.patches == ["front"]


def test_an_empty_model_learns_and_forgets_its_last_episode():
    model = HASM(HASMConfig(), BODY)
    assert model.episodes == []
    with pytest.raises(RuntimeError, match="learned nothing"):
        model.step(torch.zeros(3), press(BODY, "front", 5.0))
    for number, episode in enumerate(pushes(8)):
        known = model.learn(episode)
        assert known.number == number
        assert known.name == f"episode {number}"
    assert model.settled.chosen_from == 8  # chosen anew at 1, 2, 4 and 8
    assert model.settled.touch == "direction"
    for number in range(8):
        model.forget(number)
    assert model.episodes == []
    with pytest.raises(RuntimeError, match="learned nothing"):
        model.step(torch.zeros(3), press(BODY, "front", 5.0))
    assert model.learn(pushes(1)[0]).number == 8  # no number is used twice


def test_what_cannot_be_learned_changes_nothing():
    episodes = pushes(5)
    model = fitted(episodes, **VALUES[0])
    quiet = dataclasses.replace(episodes[0], tactile=np.zeros_like(episodes[0].tactile))
    broken = dataclasses.replace(episodes[0], state=episodes[0].state[:, :2])
    for episode, message in ((quiet, "no touch"), (broken, r"episode 5: expected state")):
        with pytest.raises(ValueError, match=message):
            model.learn(episode)
    with pytest.raises(ValueError, match="no episode 5 is known, valid: 0, 1, 2, 3, 4"):
        model.forget(5)
    assert_alike(model, fitted(episodes, **VALUES[0]))


def test_a_checkpoint_knows_its_episodes(tmp_path):
    episodes = pushes(8)
    model = fitted(episodes[:6], **VALUES[0])
    model.learn(episodes[6], "späte Berührung")
    model.forget(2)
    model.save_pretrained(tmp_path)
    loaded = HASM.from_pretrained(tmp_path)
    assert loaded.episodes == model.episodes
    np.testing.assert_array_equal(loaded.origins, model.origins)
    for each in (loaded, model):
        assert each.learn(episodes[7]).number == 7
        each.forget(0)
    assert_alike(loaded, model)


def test_a_robot_that_time_moves_on_learns_and_forgets_too(tmp_path):
    body = Body(
        ["joint_0", "joint_1"], [-1.0] * 2, [1.0] * 2, [5.0] * 2, ["sequence"], [1],
        [[0.0, 0.0, 1.0]], rate=50.0, channels=0,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(5):
        t = np.arange(80) / 50
        path = 0.3 * np.sin(5 * t[:, None] + rng.uniform(0, 6) + np.array([0.0, 1.0]))
        episodes.append(Recorded(t, path, path, np.zeros((80, 0, 3))))
    model, together = HASM(HASMConfig(beta=0.02), body), HASM(HASMConfig(beta=0.02), body)
    model.fit(episodes[:4])
    model.learn(episodes[4])
    model.save_pretrained(tmp_path)
    model = HASM.from_pretrained(tmp_path)
    model.forget(0)
    assert set(model.origins[:, 0]) == {1, 2, 3, 4}
    together.fit(episodes[1:])
    state = torch.tensor(episodes[1].state[0]).float()
    if model.settled.joints == together.settled.joints:  # the same choice was made
        torch.testing.assert_close(model.recalling.memory.count, together.recalling.memory.count)
    model.step(state, None)
    (explanation,) = model.explain()
    assert explanation.patch == ""
    assert explanation.posture_known
    assert sum(explanation.episodes.values()) == pytest.approx(1)
    np.testing.assert_allclose(
        model.posture(explanation.sources[0].row),
        episodes[explanation.sources[0].episode].state[round(explanation.sources[0].time * 50)],
    )


def test_an_explanation_names_what_the_recall_drew_on():
    model = fitted(pushes(9), **VALUES[0])
    rollout = model.new_rollout()
    start = torch.tensor(postures(BODY, 1, 0)[0]).float()
    assert model.explain(rollout) == []
    for _ in range(10):
        model.step(start, press(BODY, "front", 6.0), rollout)
    (why,) = model.explain(rollout)
    weights = model.recalling.weights(rollout.asked[0].query, 0)
    assert weights.sum() == pytest.approx(1)
    assert why.patch == "front"
    assert why.entropy == pytest.approx(-(weights * np.log(weights)).sum())
    for number, weight in why.episodes.items():
        assert weight == pytest.approx(weights[model.origins[:, 0] == number].sum())
    named = [source.row for source in why.sources]
    assert named == sorted(named, key=lambda row: -weights[row])
    assert sorted(named) == np.flatnonzero(weights >= LEAST_WEIGHT).tolist()
    for source in why.sources:
        episode, frame, _ = model.origins[source.row]
        assert (source.episode, source.time) == (episode, frame / BODY.rate)
        assert source.weight == pytest.approx(weights[source.row])
        asked = pushes(9)[episode].action[frame]
        np.testing.assert_allclose(model.posture(source.row), asked)
    codes, query = model.recalling.memory.stored().numpy(), rollout.asked[0].query.numpy()
    scores = np.sort(codes @ np.where(query < 0, -1, 1)) / len(query)
    assert why.confidence == pytest.approx(scores[-1])
    assert why.margin == pytest.approx(scores[-1] - scores[-2])
    # Where this posture was taught, its own episode weighs most, and after forgetting nothing.
    assert max(why.episodes, key=why.episodes.__getitem__) == 0
    model.forget(0)
    for _ in range(10):
        model.step(start, press(BODY, "front", 6.0), rollout)
    assert 0 not in model.explain(rollout)[0].episodes


def test_what_was_not_taught_is_said_to_be_unknown():
    near = [
        yielding(BODY, along(BODY), np.full(3, 0.2) + 0.1 * q, [(None, 5), ("front", 30)])
        for q in postures(BODY, 6, 3)
    ]
    model = fitted(near, **VALUES[0])

    def asked(posture, patch):
        model.reset()
        for _ in range(5):
            model.step(torch.tensor(posture).float(), press(BODY, patch, 6.0))
        return model.explain()

    (here,) = asked(np.full(3, 0.2), "front")
    assert here.posture_known
    assert here.touch_known
    (far,) = asked(np.array([-0.9, -1.0, -1.1]), "front")
    assert not far.posture_known
    assert far.confidence < here.confidence
    (aside,) = asked(np.full(3, 0.2), "side")
    directions = [x.samples.direction for x in model.lessons]
    toward = model.rollout.asked[0].touch.direction
    assert aside.touch_known == bool((np.concatenate(directions) @ toward >= KNOWN_COSINE).any())
    assert not aside.touch_known
    assert asked(np.full(3, 0.2), "back") == []  # nothing was taught on that body


def test_below_a_confidence_the_robot_holds_still():
    model = fitted(pushes(9), **VALUES[0])
    posture = torch.tensor(postures(BODY, 1, 42)[0]).float()

    def moved(hold_below: float) -> float:
        model.reset()
        state = posture
        for _ in range(15):
            state = model.step(state, press(BODY, "front", 6.0), hold_below=hold_below)
        return float((state - posture).abs().max())

    assert moved(0.0) > 0.01
    sure = min(why.confidence for why in model.explain())
    assert moved(1.0) == 0.0
    assert moved(0.5 * sure) == moved(0.0)


def test_a_copy_with_another_beta_shares_nothing():
    model = fitted(pushes(9), **VALUES[0])
    state = torch.tensor(postures(BODY, 1, 42)[0]).float()
    steps = {}
    for beta in (0.0, 0.05, float("inf")):
        copy = model.with_beta(beta)
        for _ in range(5):
            steps[beta] = copy.step(state, press(BODY, "front", 6.0))
        (why,) = copy.explain()
        assert (why.entropy < 0.7) == (beta == float("inf"))
    for _ in range(5):
        own = model.step(state, press(BODY, "front", 6.0))
    torch.testing.assert_close(own, steps[0.05], rtol=0, atol=0)
    assert float((steps[0.0] - steps[float("inf")]).abs().max()) > 1e-5
    copy.forget(0)
    assert len(model.episodes) == 9


def test_a_base_without_limits_is_learned_too():
    body = make_body(3, base=True)
    starts = postures(body, 5, 2)
    law = lambda toward, q: np.array([0, 0, 0, *(0.003 * toward[:2]), 0])  # noqa: E731
    episodes = [yielding(body, law, q, [(None, 5), ("back", 30)]) for q in starts]
    model = HASM(HASMConfig(touch="direction"), body)
    for episode in episodes:
        model.learn(episode)
    moved = [body.joints[j] for j in model.settled.moved]
    assert set(moved) & set(BASE[:2])


@pytest.mark.parametrize("kind", KINDS)
def test_skins_of_every_kind_are_learned_forgotten_and_explained(kind, tmp_path):
    """Three forces, one pressure, a wrench, no touch, and one more observation bound."""
    data = load_episodes(write(kind, tmp_path / "data"))
    body, episodes = body_of(data), data.episodes
    model = HASM(HASMConfig(), body)
    model.fit(episodes[:-1])
    before, first = model.settled, model.origins
    known = model.learn(episodes[-1])
    assert known.number == len(episodes) - 1
    assert model.settled.touch == before.touch
    assert model.settled.beta == before.beta
    last = episodes[-1]
    for t in range(40):
        seen = None if last.observations is None else torch.from_numpy(last.observations[t])
        skin = None if last.tactile is None else torch.from_numpy(last.tactile[t])
        model.step(torch.from_numpy(last.state[t]), skin, None, seen)
    (why,) = model.explain()
    assert sum(why.episodes.values()) == pytest.approx(1)
    assert set(why.episodes) <= {known.number for known in model.episodes}
    model.forget(known.number)
    assert model.settled.code_facts == before.code_facts
    np.testing.assert_array_equal(model.origins, first)
    model.save_pretrained(tmp_path / "model")
    assert HASM.from_pretrained(tmp_path / "model").episodes == model.episodes
