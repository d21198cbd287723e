"""What episodes hold: what each spike did, how it was touched, and the course of each touch."""

import dataclasses

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import (
    Recorded,
    along,
    cells_of,
    limits,
    make_body,
    postures,
    press,
    record,
    settled,
    smooth_path,
    straight,
    yielding,
)

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.model.choose import recalled_values
from hasm_torch.model.collect import LEAST_SPIKES, SHORTEST_PHASE
from hasm_torch.model.felt import Touch, calibrate, felt
from hasm_torch.model.fit import read
from hasm_torch.model.lessons import COURSE_POINTS, Lessons

BODY = make_body(3)
CONFIG = HASMConfig()
RATE = BODY.rate


def collected(*episodes, config: HASMConfig = CONFIG, body: Body = BODY) -> Lessons:
    return read(config, body, settled(body), episodes)


def restless(seed: int, samples: int = 60) -> Recorded:
    """Touches that come, go and wander over the cells while the joints wander too."""
    rng = np.random.default_rng(seed)
    path = smooth_path(BODY, samples, seed, [0, 1, 2])
    tactile = np.zeros((samples, sum(BODY.cells), 3))
    at = 0
    while at < samples:
        length = int(rng.integers(1, 9))
        if rng.random() < 0.7:
            tactile[at : at + length, rng.integers(0, 6)] = rng.uniform(0.5, 3)
        at += length
    state = path + rng.uniform(-0.01, 0.01, path.shape)
    return Recorded(np.arange(samples) / RATE, state, path, tactile)


def felt_by(episode: Recorded) -> Touch:
    return felt(CONFIG, BODY, settled(BODY), episode)


def test_what_is_felt_through_an_episode():
    episode = restless(1)
    touch = felt_by(episode)
    assert touch.spikes.sum() > 50
    window = round(CONFIG.rate_window_s * RATE)
    for t in range(len(episode.time)):
        spikes = touch.spikes[max(0, t - window + 1) : t + 1].sum(axis=0)
        density = np.clip(spikes / (window / RATE) / CONFIG.max_rate, 0, 1)
        np.testing.assert_allclose(touch.density[t], density, atol=1e-6)
        for p, patch in enumerate(BODY.patches):
            mine = cells_of(BODY, patch)
            normals = np.array(BODY.normals)[mine]
            exerted = reference.push(episode.tactile[: t + 1, mine], normals, 0.05, 3)[-1]
            rows = BODY.chains.get(BODY.links[p], [])
            toward = reference.link_rotation(rows, episode.state[t]) @ exerted  # as measured
            expected = toward / (np.linalg.norm(toward) or 1.0)
            np.testing.assert_allclose(touch.direction[t, p], expected, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("distinct", [True, False])
def test_a_sample_is_paired_with_its_closest_spike(seed, distinct):
    """The touch stored with a joint sample is the one at its closest spike within the window."""
    episode, config = restless(seed), HASMConfig(distinct=distinct, horizon=4)
    touch = felt_by(episode)
    samples = collected(episode, config=config).samples
    every, rows = 4 if distinct else 1, []
    begins = range(0, len(episode.time) - 4, every)
    used = np.array([touch.spikes[begin + 1 : begin + 5].sum() for begin in begins])
    least = LEAST_SPIKES * np.median(used[used > 0])  # fewer tell nothing of what a spike does
    for begin in begins:
        spent = touch.spikes[begin + 1 : begin + 5].sum(axis=0)
        patch = int(spent.argmax())
        times = np.flatnonzero(touch.spikes[:, patch]) / RATE
        near = reference.closest_spikes([begin / RATE], times, config.pair_window_s)[0]
        if spent.sum() > 0 and spent.sum() >= least and near >= 0:
            rows.append((begin, patch, spent.sum(), round(times[near] * RATE)))
    begin, patch, spent, at = (np.array(column) for column in zip(*rows))
    assert len(rows) > 7
    assert (at != begin).any()
    np.testing.assert_array_equal(samples.frame, begin)
    np.testing.assert_array_equal(samples.patch, patch)
    np.testing.assert_array_equal(samples.spikes, spent)
    np.testing.assert_array_equal(samples.direction, touch.direction[at, patch])
    np.testing.assert_array_equal(samples.positions, episode.action[begin])
    np.testing.assert_allclose(samples.moved, episode.action[begin + 4] - episode.action[begin])


def test_a_value_is_the_displacement_of_one_spike():
    samples = collected(restless(2)).samples
    chosen = settled(BODY, moved=[0, 2])
    values, weight = recalled_values(BODY, chosen, samples)
    expected = samples.moved[:, [0, 2]] / samples.spikes[:, None]
    np.testing.assert_allclose(values, expected, rtol=1e-5)
    np.testing.assert_allclose(weight, 1 / np.array(BODY.max_speed)[[0, 2]])


@pytest.mark.parametrize("pattern", ["action", "state"])
def test_the_memorised_series_is_a_setting(pattern):
    episode = restless(3)
    samples = collected(episode, config=HASMConfig(pattern=pattern)).samples
    series = np.clip(getattr(episode, pattern), *limits(BODY))
    np.testing.assert_array_equal(samples.positions, series[samples.frame])


def test_the_lag_is_the_largest_distance_of_target_and_joint():
    found = collected(restless(4), restless(5))
    both = [
        np.abs(e.action - np.clip(e.state, *limits(BODY))).max(0) for e in map(restless, (4, 5))
    ]
    np.testing.assert_allclose(found.lag, np.max(both, axis=0))
    assert len(found) == 2


def pressed(*parts: tuple[str | None, int], joint: int = 0, step: float = 0.01) -> Recorded:
    """Patches pressed in turn while one joint moves evenly; it waits without touch."""

    def law(toward, positions):
        return step * (np.arange(3) == joint)

    return yielding(BODY, law, straight(BODY, joint)[0], parts)


def test_a_touch_goes_on_through_pauses_until_another_patch_is_touched():
    parts = [(None, 10), ("front", 20), (None, 25), ("front", 20), (None, 5), ("side", 30)]
    phases = collected(pressed(*parts, ("front", 20), (None, 5))).phases
    assert [BODY.patches[p] for p in phases.patch] == ["front", "side", "front"]
    assert (np.diff(phases.frame) > 0).all()
    assert 8 <= phases.frame[0] <= 12  # with the touch
    np.testing.assert_allclose(phases.moved[0, -1, 0], 0.4, atol=0.03)
    np.testing.assert_allclose(phases.moved[1, -1, 0], 0.3, atol=0.03)


def test_a_flicker_between_two_patches_is_no_touch():
    brief = [("front", 30), ("side", SHORTEST_PHASE - 2), ("front", 30)]
    phases = collected(pressed(*brief)).phases
    assert set(phases.patch) == {0}


def test_a_course_is_taken_by_spikes_not_by_time():
    """Even motion under an even touch is a straight course, whatever pauses it has."""
    whole = collected(pressed(("front", 60))).phases
    paused = collected(pressed(("front", 30), (None, 40), ("front", 30))).phases
    for phases in (whole, paused):
        assert phases.moved.shape == (1, COURSE_POINTS, 3)
        course = phases.moved[0, :, 0]
        assert course[0] == pytest.approx(0.0, abs=0.011)
        np.testing.assert_allclose(course, np.linspace(course[0], course[-1], 32), atol=0.012)
        assert course[-1] == pytest.approx(0.59, abs=0.02)
        assert not phases.moved[0, :, 1:].any()
    assert paused.spikes[0] == pytest.approx(whole.spikes[0], rel=0.1)


def test_a_course_ends_where_it_arrives():
    """Spikes after the joints have arrived are no part of the way."""
    path = straight(BODY, 0, samples=50)
    still = np.vstack([path, np.repeat(path[-1:], 100, axis=0)])
    moving, waiting = (collected(record(BODY, "front", p, 6.0)).phases for p in (path, still))
    assert waiting.spikes[0] == pytest.approx(moving.spikes[0], rel=0.05)
    np.testing.assert_allclose(waiting.moved, moving.moved, atol=0.02)


def test_samples_of_a_touch_have_its_density():
    """ρ is counted over a window, so at first it is low: the whole touch counts as one level."""
    found = collected(pressed((None, 12), ("front", 60), (None, 20)))
    samples, phases = found.samples, found.phases
    touch = felt_by(pressed((None, 12), ("front", 60), (None, 20)))
    assert phases.density[0] == pytest.approx(np.median(touch.density[13:72, 0]), abs=0.02)
    inside = samples.frame >= phases.frame[0]
    assert inside.sum() > 8
    assert (samples.density[inside] == phases.density[0]).all()


@given(yaw=st.floats(-6, 6), x=st.floats(-2, 2))
@settings(max_examples=10, deadline=None)
def test_displacements_of_the_base_are_seen_from_the_base(yaw, x):
    """A robot that drives ahead and turns does the same wherever it stands."""
    body = make_body(2, base=True)

    def law(toward, positions):
        ahead, turn = positions[4], 0.003
        return np.array([0.002, 0.0, 0.003 * np.cos(ahead), 0.003 * np.sin(ahead), turn])

    start = np.array([0.1, 0.2, 0.0, 0.0, 0.0])
    here = yielding(body, law, start, [("front", 40)])
    there = yielding(body, law, start + np.array([0.0, 0.0, x, -x, yaw]), [("front", 40)])
    one, other = (collected(e, body=body) for e in (here, there))
    np.testing.assert_allclose(one.samples.moved, other.samples.moved, atol=1e-5)
    np.testing.assert_allclose(one.phases.moved, other.phases.moved, atol=1e-5)
    np.testing.assert_allclose(one.samples.moved[:, 2], 0.015, atol=1e-3)  # ahead


def test_streams_and_generators_are_read_alike():
    episodes = [restless(seed, 40) for seed in range(3)]
    whole = collected(*episodes)
    streamed = read(CONFIG, BODY, settled(BODY), (restless(seed, 40) for seed in range(3)))
    for name, column in vars(whole.samples).items():
        np.testing.assert_array_equal(column, getattr(streamed.samples, name))
    assert sorted(set(whole.samples.episode)) == [0, 1, 2]


def test_observations_are_those_where_it_began():
    body = make_body(3, observations={"observation.place": 2})
    episode = record(body, "front", straight(body, 0), 6.0, observation=[0.3, 0.4])
    episode.observations = np.cumsum(episode.observations, axis=0)
    found = collected(episode, body=body)
    for table in (found.samples, found.phases):
        np.testing.assert_allclose(table.observation, episode.observations[table.frame])


def test_motion_is_led_by_touch_or_by_nothing():
    led = collected(pressed((None, 20), ("front", 30), (None, 20)))
    assert led.led() > 0.8
    path = np.vstack([straight(BODY, 0, samples=50), straight(BODY, 0, 0.9, 0.9, 50)])
    skin = np.zeros((100, 6, 3))
    skin[50:] = press(BODY, "front", 6.0).numpy()
    against = Recorded(np.arange(100) / RATE, path, path, skin)  # it moves before it is touched
    assert collected(against).led() < -0.5


GOOD = record(BODY, "front", straight(BODY, 0), 6.0)
PLACED = make_body(3, observations={"observation.place": 2})


def broken(**changes) -> Recorded:
    return dataclasses.replace(GOOD, **changes)


LATE = np.arange(len(GOOD.time)) == 40
NAN_STATE = np.where(LATE[:, None], np.nan, GOOD.state)
BAD = {
    "no episode": ([], "no episode to learn from: expected at least one"),
    "NaN state": ([GOOD, broken(state=NAN_STATE)], "episode 1: state holds NaN or infinity"),
    "NaN action": ([broken(action=NAN_STATE)], "episode 0: action holds NaN or infinity"),
    "infinite force": (
        [broken(tactile=np.where(LATE[:, None, None], np.inf, GOOD.tactile))],
        "tactile series holds NaN or infinity",
    ),
    "no skin": ([broken(tactile=None)], "no tactile series"),
    "joints": ([broken(state=GOOD.state[:, :2])], r"episode 0: expected state \(T, 3\), got"),
    "flat": ([broken(action=GOOD.action[:, 0])], r"expected action \(T, 3\), got \(170,\)"),
    "fewer actions": ([broken(action=GOOD.action[:-3])], "got 170, 167 and 170"),
    "fewer times": ([broken(time=GOOD.time[:-3])], "as many times and actions as states"),
    "no sample": (
        [broken(time=GOOD.time[:0], state=GOOD.state[:0], action=GOOD.action[:0])],
        "at least one, got 0, 0 and 0",
    ),
    "fewer readings": ([broken(tactile=GOOD.tactile[:-3])], "tactile of 170 samples.*got 167"),
    "cells": ([broken(tactile=GOOD.tactile[:, :4])], r"expected skin \(..., T, 6, 3\) or flat"),
    "pressures": ([broken(tactile=GOOD.tactile[..., :1])], r"expected skin \(..., T, 6, 3\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_recordings_are_named(case):
    episodes, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        collected(*episodes)


@pytest.mark.parametrize(
    "observations", [None, np.zeros((170, 3)), np.zeros((3, 2)), np.full((170, 2), np.nan)]
)
def test_a_missing_observation_is_named(observations):
    episode = broken(observations=observations)
    with pytest.raises(ValueError, match=r"finite observations \(170, 2\) of observation.place"):
        collected(episode, body=PLACED)


@pytest.mark.parametrize("unit", ["N", "kPa"])
def test_a_skin_of_another_unit_is_calibrated(unit):
    body = dataclasses.replace(BODY, unit=unit)
    scale, rest = 40.0, 1.5
    episode = broken(tactile=scale * GOOD.tactile + rest)
    threshold, current = calibrate(CONFIG, body, [episode])
    if unit == "N":
        assert (threshold, current) == (0.05, 2.5)
        return
    assert threshold == pytest.approx(3 * rest)  # what an untouched cell reads
    assert current == pytest.approx(40.0 / (scale * 6.0), rel=0.05)
    by_hand = HASMConfig(threshold=7.0, current_per_newton=0.3)
    assert calibrate(by_hand, body, [episode]) == (7.0, 0.3)
    assert calibrate(HASMConfig(threshold=7.0), body, [episode])[0] == 7.0


def test_a_law_is_recovered_from_what_is_collected():
    """Of a robot that yields evenly, one spike's displacement is the law's over the spikes."""
    episodes = [
        yielding(BODY, along(BODY), q, [("front", 25), ("side", 25)]) for q in postures(BODY, 4, 0)
    ]
    found = collected(*episodes)
    values, _ = recalled_values(BODY, settled(BODY, moved=[0, 1]), found.samples)
    rate = found.samples.spikes / CONFIG.horizon  # a sample
    steady = found.samples.spikes > np.median(found.samples.spikes) * 0.8
    pace = (values.numpy() * rate[:, None])[steady]
    np.testing.assert_allclose(pace, 0.01 * found.samples.direction[steady, :2], atol=1e-3)
    assert torch.isfinite(values).all()
