"""A robot that time moves on: its moments, its memory, what is chosen for it, and its steps."""

import numpy as np
import pytest
import reference
import torch
from toys import Recorded, along, make_body, postures, settled, yielding

from hasm_torch import HASM, HASMConfig
from hasm_torch.body import Body
from hasm_torch.model.choose_timed import choose_timed, splits
from hasm_torch.model.moments import TREND_RIDGE, Moments, Series, Trend, moments, thin
from hasm_torch.model.timed import FEW_QUERIES, RIDGE, SHORTLIST, Timed

RATE = 20.0
TURN = 0.25  # rad a frame of the oscillation
HELD = 3  # frames for which a touch tells the future in `turning`


def plain(joints: int = 2) -> Body:
    """A robot without skin."""
    return Body(
        [f"joint_{j}" for j in range(joints)], [-3.0] * joints, [3.0] * joints, [50.0] * joints,
        ["sequence"], [1], [[0.0, 0.0, 1.0]], rate=RATE, channels=0,
    )  # fmt: skip


def chosen(body: Body, **changes):
    """What ``choose_timed`` settles."""
    usual = {"drive": "time", "readout": "first_order", "joints": [0, 1], "past": [1], "beta": 0.03}
    return settled(body, **{**usual, **changes})


def drawn(count: int, joints: int, past: int, patches: int, seed: int) -> Moments:
    """Moments of nobody's robot."""
    rng = np.random.default_rng(seed)
    shapes = [(count, joints), (count, joints, past), (count, patches), (count, joints)]
    columns = [torch.from_numpy(rng.normal(size=shape)) for shape in shapes]
    columns[2] = columns[2].abs().clamp(max=1.0)
    return Moments(*columns, torch.zeros(count, dtype=torch.int64), torch.arange(count))


def circle(phase: float, frames: int) -> np.ndarray:
    """Two joints of one oscillation, (frames, 2) rad."""
    angle = phase + TURN * np.arange(frames)
    return np.stack([np.cos(angle), 0.8 * np.sin(angle)], axis=1)


def oscillation(phase: float, frames: int = 60) -> Recorded:
    state = circle(phase, frames).astype(np.float32)
    return Recorded(np.arange(frames) / RATE, state, state, np.zeros((frames, 0, 3), np.float32))


def turning(seed: int, telling: bool, frames: int = 80) -> Series:
    """Joints that turn one way or the other, which a touch tells HELD frames before, or nothing."""
    rng = np.random.default_rng(seed)
    ways = np.repeat(rng.choice([-1.0, 1.0], frames // 5 + 1), 5)[:frames]
    angle = rng.uniform(0, 2 * np.pi) + np.cumsum(TURN * np.r_[np.ones(HELD), ways[:-HELD]])
    state = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    state += 0.01 * rng.normal(size=state.shape)
    told = ways if telling else np.repeat(rng.choice([-1.0, 1.0], frames // 5 + 1), 5)[:frames]
    touch = np.stack([0.8 * (told > 0), np.zeros(frames)], axis=1)
    return Series(torch.from_numpy(state), torch.from_numpy(touch))


SKIN = Body(
    ["joint_0", "joint_1"], [-3.0] * 2, [3.0] * 2, [50.0] * 2, ["left", "right"], [1, 1],
    [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], rate=RATE,
)  # fmt: skip


def touched(seed: int, frames: int = 60) -> Recorded:
    """An oscillation during which the skin is touched now and then, to no effect."""
    rng = np.random.default_rng(seed)
    recording = oscillation(rng.uniform(0, 2 * np.pi), frames)
    recording.tactile = np.zeros((frames, 2, 3), np.float32)
    for patch in range(2):
        recording.tactile[:, patch] = np.repeat(2.0 * rng.integers(0, 2, (frames // 6, 1)), 6, 0)
    return recording


@pytest.fixture(scope="module")
def oscillator() -> HASM:
    model = HASM(HASMConfig(horizon=1), plain())
    model.fit([oscillation(phase) for phase in np.linspace(0, 2 * np.pi, 8, endpoint=False)])
    return model


@pytest.fixture(scope="module")
def unmoved() -> HASM:
    """A robot with skin whose motion does not follow touch."""
    model = HASM(HASMConfig(horizon=3), SKIN)
    model.fit([touched(seed) for seed in range(5)])
    return model


def test_moments_stay_in_their_episode():
    series = [turning(seed, telling=True, frames=24) for seed in range(2)]
    found = moments(series, (1, 3), horizon=4)
    assert len(found.state) == 2 * (24 - 4)
    for number, (state, touch) in enumerate(series):
        mine = found.rows(found.episode == number)
        assert mine.frame.tolist() == list(range(20))
        torch.testing.assert_close(mine.state + mine.target, state[4:])
        torch.testing.assert_close(mine.touch, touch[:20])
        for n, back in zip((1, 3), mine.past.unbind(-1)):
            torch.testing.assert_close(back[:n], state[:n] - state[0])
            torch.testing.assert_close(back[n:], state[n:20] - state[: 20 - n])


def test_episodes_as_short_as_the_horizon_have_no_moment():
    series = [turning(0, True, frames=n) for n in (24, 9)]
    assert set(moments(series, (1,), horizon=9).episode.tolist()) == {0}
    with pytest.raises(ValueError, match=r"horizon of 24 frames, the longest has 24"):
        moments(series, (1,), horizon=24)


def test_thinned_moments_are_spread_evenly():
    found = drawn(100, 2, 1, 0, 0)
    assert thin(found, 12).frame.tolist() == [round(x) for x in np.linspace(0, 99, 12)]
    assert thin(found, 100) is found


def test_the_trend_is_a_ridge_regression():
    known, asked = (drawn(40, 2, 3, 2, seed) for seed in (0, 1))
    known.touch[:, 1] = 0.5  # says nothing and has no spread to divide by
    asked.touch[:, 1] = 0.5

    def inputs(m):
        return np.concatenate([m.state, m.past.reshape(len(m.state), -1), m.touch], axis=1)

    x, y = inputs(known), known.target.numpy()
    centre, spread = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-12)
    ridge = np.full(x.shape[1], TREND_RIDGE * len(x))
    law = reference.linear_law(y - y.mean(axis=0), (x - centre) / spread, np.ones(len(x)), ridge)
    expected = (inputs(asked) - centre) / spread @ law.T + y.mean(axis=0)
    np.testing.assert_allclose(Trend.through(known)(asked), expected, atol=1e-9)


@pytest.mark.parametrize("code", ["thermometer", "gray"])
def test_codes_are_place_codes_flipped_by_touch(code):
    body, past = make_body(3), [1, 2]
    config = HASMConfig(neurons=5, bits=4, code=code)
    memory = Timed(config, body, chosen(body, joints=[0, 2], past=past, flip=0.25, capacity=30))
    found, asked = (drawn(count, 3, 2, 3, seed) for count, seed in ((30, 0), (6, 1)))
    asked.touch[0] = 0.0
    memory.store(found)

    state, back = (x.numpy()[:, [0, 2]] for x in (found.state, found.past))
    reach = [3 * state.std(axis=0), *(6 * np.sqrt((back**2).mean(axis=0))).T]
    middle = [state.mean(axis=0), np.zeros(2), np.zeros(2)]
    lower = np.concatenate([m - r for m, r in zip(middle, reach)])
    upper = np.concatenate([m + r for m, r in zip(middle, reach)])
    generator = torch.Generator().manual_seed(0)
    dim = 2 * (1 + len(past)) * 5 * 4
    orders = [torch.randperm(dim, generator=generator).numpy() for _ in body.patches]
    assert memory.code_dim == dim
    for row, got in enumerate(memory.codes(asked).numpy()):
        channels = np.concatenate([asked.state[row, [0, 2]], asked.past[row, [0, 2]].T.flatten()])
        levels = reference.place_levels(channels, lower, upper, 5, 4, config.width, code)
        expected = reference.place_bits(levels, 4, code)
        for rho, order in zip(asked.touch[row].tolist(), orders):
            expected *= -reference.tactile_embedding(0.25 * rho, order, 1)
        np.testing.assert_array_equal(got, expected)


def test_a_large_code_is_written_with_fewer_bits():
    body = make_body(8)
    everything = chosen(body, joints=list(range(8)), past=[1, 2, 4, 8])
    assert Timed(HASMConfig(), body, everything).code_dim == 8 * 5 * 10 * 4
    assert Timed(HASMConfig(), body, chosen(body)).code_dim == 2 * 2 * 10 * 16


@pytest.mark.parametrize("storage", ["bit", "int8", "float32"])
@pytest.mark.parametrize("count", [5, 70])
def test_scores_are_inner_products_for_few_and_for_many_queries(storage, count):
    body = make_body(3)
    config = HASMConfig(neurons=5, bits=5, storage=storage)
    memory = Timed(config, body, chosen(body, flip=0.3, capacity=count))
    assert memory.code_dim % 64  # the last word of a code is not full
    known, asked = (drawn(n, 3, 1, 3, seed) for n, seed in ((count, 0), (FEW_QUERIES, 1)))
    memory.store(known)
    queries = memory.codes(asked)
    expected = queries.float() @ memory.codes(known).float().mT
    assert torch.equal(memory._scores(queries, count), expected)
    for few in range(1, FEW_QUERIES):
        assert torch.equal(memory._scores(queries[:few], count), expected[:few])


@pytest.mark.parametrize("trend", [False, True])
@pytest.mark.parametrize("beta", [0.0, 0.05])
def test_the_readout_is_a_weighted_ridge_regression_of_each_joint(trend, beta):
    body, count = make_body(3), 60
    config = HASMConfig(neurons=6, bits=4)
    options = chosen(body, joints=[0, 1, 2], past=[1, 4], beta=beta, trend=trend, capacity=count)
    memory = Timed(config, body, options)
    known, asked = (drawn(n, 3, 2, 3, seed) for n, seed in ((count, 0), (9, 1)))
    memory.store(known)
    assert count <= SHORTLIST

    def covariates(m):
        raw = np.stack([m.state, m.past[..., 0], Trend.through(known)(m)], axis=-1)
        return raw[..., : 3 if trend else 2]

    x, here = covariates(known), covariates(asked)
    x, here = ((part - x.mean(axis=0)) / x.std(axis=0) for part in (x, here))
    scores = memory.codes(asked).numpy().astype(float) @ memory.codes(known).numpy().T
    expected = np.zeros((9, 3))
    for row in range(9):
        weights = np.exp(beta * (scores[row] - scores[row].max()))
        weights /= weights.sum()
        for joint in range(3):
            rows, mine = (np.insert(part[..., joint, :], 0, 1.0, -1) for part in (x, here[row]))
            ridge = np.full(rows.shape[1], RIDGE)
            law = reference.linear_law(known.target[:, joint, None], rows, weights, ridge)
            expected[row, joint] = law[0] @ mine
    np.testing.assert_allclose(memory(asked), expected, atol=2e-4)


def test_weights_name_the_associations_that_take_part():
    body, count = plain(), SHORTLIST + 40
    memory = Timed(HASMConfig(), body, chosen(body, capacity=count))
    known = drawn(count, 2, 1, 0, 0)
    memory.store(known)
    weights = memory.weights(known.rows(torch.tensor([17])))
    assert weights.shape == (count,)
    assert weights.sum() == pytest.approx(1.0)
    assert weights.argmax() == 17
    assert np.count_nonzero(weights) <= SHORTLIST
    assert memory.origins[17].tolist() == [0, 17, -1]


@pytest.mark.parametrize("telling", [True, False])
def test_touch_is_used_where_it_tells_the_future(telling):
    """Touch tells which way the joints will turn: no linear trend, nor what they did, says it."""
    series = [turning(seed, telling) for seed in range(6)]
    config = HASMConfig(horizon=HELD)
    found, errors = choose_timed(config, SKIN, chosen(SKIN, beta=0.0), series)
    shares = {
        share: min(errors["touch"][f"{share}, trend {trend}"] for trend in (True, False))
        for share in (0.0, 0.125, 0.25, 0.5)
    }
    if telling:
        assert found.flip > 0
        assert shares[found.flip] < 0.7 * shares[0.0]
    else:
        assert found.flip == 0
        assert shares[0.0] == min(shares.values())
    assert found.beta > 0


def test_without_touch_nothing_is_flipped():
    series = [turning(seed, telling=True) for seed in range(2)]
    series = [Series(state, torch.zeros_like(touch)) for state, touch in series]
    found, errors = choose_timed(HASMConfig(horizon=2), SKIN, chosen(SKIN), series)
    assert found.flip == 0
    assert "touch" not in errors


@pytest.mark.parametrize(("frames", "parts"), [(50, 3), (1000, 1)])
def test_every_short_episode_is_left_out_once_of_long_ones_a_quarter(frames, parts):
    series = [Series(torch.full((frames, 1), float(i)), torch.zeros(frames, 0)) for i in range(8)]
    found = splits(series)
    assert len(found) == parts
    left_out = sorted(int(s.state[0]) for _, out in found for s in out)
    assert len(left_out) == len(set(left_out)) == (8 if parts == 3 else 2)
    for learned, out in found:
        assert sorted(int(s.state[0]) for s in learned + out) == list(range(8))
    assert splits(series[:1]) == []


def test_one_episode_is_learned_without_a_choice():
    model = HASM(HASMConfig(horizon=1), plain())
    report = model.fit([oscillation(0.3)])
    assert report.errors == {}
    predicted, _ = model.predict(oscillation(0.3), 1)
    np.testing.assert_allclose(predicted, np.diff(circle(0.3, 60), axis=0), atol=0.02)


def test_what_is_given_by_hand_is_kept():
    config = HASMConfig(horizon=2, joints=["joint_1"], beta=0.07)
    model = HASM(config, plain())
    report = model.fit([oscillation(phase) for phase in (0.0, 2.0, 4.0)])
    assert model.settled is not None
    assert (model.settled.joints, report.choices["joints"]) == ([1], "joint_1")
    assert model.settled.beta == pytest.approx(0.07)


def test_an_infinite_beta_is_the_best_match():
    model = HASM(HASMConfig(horizon=2, beta=float("inf")), plain())
    episodes = [oscillation(phase) for phase in (0.0, 2.0, 4.0)]
    model.fit(episodes)
    predicted, frames = model.predict(episodes[1], 2)
    real = episodes[1].state[frames + 2] - episodes[1].state[frames]
    np.testing.assert_allclose(predicted, real, atol=0.05)


def test_joints_that_stand_still_are_not_coded_and_stay():
    episodes = [oscillation(phase) for phase in (0.0, 2.0, 4.0)]
    for episode in episodes:
        episode.state = episode.action = np.insert(episode.state, 1, 0.5, axis=1)
    model = HASM(HASMConfig(horizon=2), plain(3))
    model.fit(episodes)
    assert model.settled is not None
    assert 1 not in model.settled.joints
    assert np.abs(model.predict(episodes[0], 2)[0][:, 1]).max() < 1e-9
    for episode in episodes:
        episode.state = episode.action = np.full((60, 3), 0.5)
    with pytest.raises(ValueError, match="no joint moves"):
        model.fit(episodes)
    with pytest.raises(ValueError, match="no episode to learn from"):
        model.fit([])


def test_steps_follow_a_learned_oscillation_from_a_new_phase(oscillator):
    """Two turns, each step from where the last one led."""
    assert oscillator.settled.drive == "time"
    real = circle(0.41, 52)
    oscillator.reset()
    state, path = torch.tensor(real[0]).float(), []
    for _ in range(51):
        state = oscillator.step(state, None)
        path.append(state.numpy())
    np.testing.assert_allclose(path, real[1:], atol=0.1)


def test_a_step_is_a_share_of_the_displacement_over_the_horizon(unmoved):
    episode = touched(9)
    unmoved.reset()
    for state, skin in zip(torch.tensor(episode.state[:12]), torch.tensor(episode.tactile)):
        target = unmoved.step(state, skin)
    onward = unmoved.predict(episode, 3)[0][11]
    np.testing.assert_allclose(target, episode.state[11] + onward / 3, atol=1e-6)


def test_a_step_keeps_speed_and_limits(oscillator):
    slow = plain()
    slow.max_speed, slow.upper = [0.5, 50.0], [3.0, 0.5]
    model = HASM(oscillator.config, slow, oscillator.settled)
    model.load_state_dict(oscillator.state_dict())
    state, before = torch.tensor([0.0, 0.5]), torch.tensor([0.0, 0.5])
    for _ in range(20):
        target = model.step(state, None)
        assert abs(target - before)[0] <= 0.5 / RATE + 1e-6
        assert target[1] <= 0.5
        state = before = target


def test_the_control_loop_sees_what_was_learned(unmoved):
    """Step by step the same moments come up as through a whole recording."""
    episode = touched(11)
    series = Series(torch.tensor(episode.state).double(), torch.zeros(60, 2))
    expected = moments([series], unmoved.settled.past, 3)
    unmoved.reset()
    densities = []
    for frame in range(57):
        unmoved.step(torch.tensor(episode.state[frame]), torch.tensor(episode.tactile[frame]))
        got, want = unmoved.rollout.moment, expected.rows(torch.tensor([frame]))
        torch.testing.assert_close(got.state, want.state)
        torch.testing.assert_close(got.past, want.past)
        densities.append(got.touch[0])
        torch.testing.assert_close(got.touch[0].float(), unmoved.density)
    felt = torch.stack(densities) > 0
    pressed = torch.tensor(episode.tactile[:57].sum(-1) > 0)
    assert felt[pressed].float().mean() > 0.7
    (name, weights), *more = unmoved.recalled()
    assert (name, more) == ("", [])
    assert weights.sum() == pytest.approx(1.0)
    number, frame, patch = unmoved.origins[weights.argmax()]
    assert patch == -1
    assert np.abs(touched(number).state[frame] - episode.state[56]).max() < 0.4


def test_a_reset_forgets_where_the_joints_came_from(oscillator):
    oscillator.reset()
    state = torch.tensor([0.2, 0.1])
    first = oscillator.step(state, None)
    oscillator.step(state + 0.3, None)
    other = oscillator.new_rollout()
    assert torch.equal(oscillator.step(state, None, other), first)
    oscillator.reset()
    assert oscillator.recalled() == []
    assert torch.equal(oscillator.step(state, None), first)


def test_time_moves_on_what_touch_does_not_move(unmoved):
    assert unmoved.settled.drive == "time"
    body = make_body(3)
    touches = [(None, 10), ("front", 25), (None, 10)]
    episodes = [yielding(body, along(body), q, touches) for q in postures(body, 6, 1)]
    assert HASM(HASMConfig(), body).fit(episodes).choices["drive"] == "spike"
    forced = HASM(HASMConfig(drive="time"), body).fit(episodes)
    assert forced.choices["drive"] == "time"
    assert forced.associations == sum(len(e.state) - 5 for e in episodes)


def test_a_prediction_is_one_recall(oscillator, unmoved):
    episode = oscillation(1.23)
    predicted, frames = oscillator.predict(episode, 1)
    series = Series(torch.tensor(episode.state).double(), torch.zeros(60, 0))
    found = moments([series], oscillator.settled.past, 1)
    np.testing.assert_array_equal(frames, np.arange(59))
    np.testing.assert_allclose(predicted, oscillator.recalling(found), atol=1e-12)
    np.testing.assert_allclose(predicted, found.target, atol=0.03)
    for model, horizon in ((oscillator, 1), (unmoved, 3)):
        with pytest.raises(ValueError, match=f"looks {horizon} frames ahead, not 2"):
            model.predict(touched(0), 2)


def test_frames_that_are_predicted_are_spread_evenly(oscillator):
    whole, _ = oscillator.predict(oscillation(1.0), 1)
    some, frames = oscillator.predict(oscillation(1.0), 1, most=7)
    assert frames.tolist() == [0, 10, 19, 29, 39, 48, 58]
    np.testing.assert_allclose(some, whole[frames], atol=1e-6)


def test_a_robot_that_touch_moves_is_stepped_on_with_its_skin_held():
    """Pushed at the front it goes on along the push; untouched it stays, whatever comes next."""
    body, pace, ahead = make_body(3), 0.008, 6
    law, touches = along(body, pace), [(None, 12), ("front", 40), (None, 12)]
    model = HASM(HASMConfig(value="displacement"), body)
    model.fit([yielding(body, law, q, touches) for q in postures(body, 12, 1, 0.4)])
    assert model.settled.drive == "spike"
    episode = yielding(body, law, postures(body, 1, 5, 0.4)[0], touches)
    predicted, frames = model.predict(episode, ahead)
    np.testing.assert_array_equal(frames, np.arange(len(episode.state) - ahead))
    real = episode.state[frames + ahead] - episode.state[frames]
    np.testing.assert_array_equal(predicted[:12], 0.0)
    assert np.abs(real[8:12]).max() > pace  # the touch that comes was not looked at
    held = slice(20, 52 - ahead)
    assert np.linalg.norm(real[held], axis=1) == pytest.approx(pace * ahead, rel=0.05)
    np.testing.assert_allclose(predicted[held], real[held], atol=0.15 * pace * ahead)
    # At the end of the touch the skin is held, so the robot is expected to go on.
    assert np.linalg.norm(predicted[51]) > 4 * np.linalg.norm(real[51])


def test_a_short_episode_has_nothing_to_predict():
    body = make_body(3)
    touches = [(None, 10), ("front", 25), (None, 10)]
    episodes = [yielding(body, along(body), q, touches) for q in postures(body, 4, 1)]
    model = HASM(HASMConfig(value="displacement"), body)
    model.fit(episodes)
    predicted, frames = model.predict(episodes[0], len(episodes[0].state))
    assert predicted.shape == (0, 3)
    assert frames.shape == (0,)


@pytest.mark.parametrize("which", ["oscillator", "unmoved"])
def test_a_loaded_model_predicts_and_steps_identically(which, request, tmp_path):
    model = request.getfixturevalue(which)
    model.save_pretrained(tmp_path)
    loaded = HASM.from_pretrained(tmp_path)
    assert loaded.settled == model.settled
    episode, horizon = touched(13), model.config.horizon
    np.testing.assert_array_equal(
        loaded.predict(episode, horizon)[0], model.predict(episode, horizon)[0]
    )
    model.reset()
    for state, skin in zip(torch.tensor(episode.state[:15]), torch.tensor(episode.tactile)):
        felt = skin if model.body.channels else None
        assert torch.equal(loaded.step(state, felt), model.step(state, felt))
    np.testing.assert_array_equal(loaded.origins, model.origins)
    assert loaded.memory_bytes() == model.memory_bytes()
