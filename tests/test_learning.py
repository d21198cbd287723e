"""What `HASM.fit` stores, and what it refuses."""

import dataclasses

import numpy as np
import pytest
import torch
from toys import limits, make_body, press, record, smooth_path, spell

from hasm_torch import HASM, HASMConfig

BODY = make_body(3)


def path(joint: int = 0, samples: int = 150, begin: float = 0.1, end: float = 0.9) -> np.ndarray:
    """One joint moves evenly between two shares of its range."""
    lower, upper = limits(BODY)
    share = np.full((samples, 3), 0.5)
    share[:, joint] = np.linspace(begin, end, samples)
    return lower + share * (upper - lower)


def fitted(*episodes, config: HASMConfig | None = None):
    model = HASM(config or HASMConfig(), BODY)
    return model, model.fit(episodes)


def test_a_patch_codes_the_joints_that_its_touch_moves():
    model, report = fitted(record(BODY, "front", path(0), 6.0), record(BODY, "side", path(2), 6.0))
    assert report.episodes == 2
    assert report.joints == {"front": ["joint_0"], "side": ["joint_2"]}
    assert set(model.memories) == {"front", "side"}
    assert all(count > 30 for count in report.associations.values())
    assert all(error < 1e-5 for error in report.recall_errors.values())


def test_all_joints_can_be_coded():
    _, report = fitted(record(BODY, "front", path(0), 6.0), config=HASMConfig(code_joints="all"))
    assert report.joints == {"front": BODY.joints}


def test_forces_far_apart_are_levels_of_their_own():
    episodes = [record(BODY, "front", path(0), force) for force in (3.0, 3.1, 12.0)]
    model, report = fitted(*episodes)
    assert len(model.memories["front"].touch_levels) == 2
    _, one = fitted(*episodes[:2])
    assert report.associations["front"] == pytest.approx(2 * one.associations["front"], abs=4)


@pytest.mark.parametrize("force", [4.0, 9.0])
def test_recall_at_the_recorded_force_repeats_the_recorded_speed(force):
    samples = 200
    model, _ = fitted(record(BODY, "front", path(0, samples), force))
    start = torch.tensor(path(0, samples)[0], dtype=torch.float32)
    targets = spell(model, BODY, start, "front", force, 120)
    speed = (targets[100, 0] - targets[30, 0]) / 70
    recorded = (path(0, samples)[-1, 0] - path(0, samples)[0, 0]) / (samples - 1)
    assert speed == pytest.approx(recorded, rel=0.05)


def test_fit_replaces_what_was_stored():
    model, _ = fitted(record(BODY, "front", path(0), 6.0))
    model.fit([record(BODY, "side", path(1), 6.0)])
    assert set(model.memories) == set(model.shapes) == {"side"}


def test_the_order_of_the_episodes_changes_no_coverage():
    episodes = [record(BODY, "front", smooth_path(BODY, 200, seed, [0, 1]), 6.0) for seed in (1, 2)]
    _, one = fitted(*episodes)
    _, other = fitted(*episodes[::-1])
    assert one.associations["front"] == pytest.approx(other.associations["front"], rel=0.1)


def test_the_paper_as_written_can_be_stored():
    model, report = fitted(record(BODY, "front", path(0), 6.0), config=HASMConfig.literal())
    assert report.joints["front"] == BODY.joints
    assert report.betas["front"] == 2.0
    assert len(model.memories["front"].touch_levels) == 0
    target = model.step(torch.tensor(path(0)[60], dtype=torch.float32), press(BODY, "front", 6.0))
    assert torch.isfinite(target).all()


def broken(**changes):
    return dataclasses.replace(record(BODY, "front", path(0), 6.0), **changes)


GOOD = record(BODY, "front", path(0), 6.0)
NAN_STATE = np.where(np.arange(len(GOOD.time))[:, None] == 40, np.nan, GOOD.state)
INF_SKIN = np.where(np.arange(len(GOOD.time))[:, None, None] == 40, np.inf, GOOD.tactile)
NAN_TIME = np.where(np.arange(len(GOOD.time)) == 40, np.nan, GOOD.time)
BAD = {
    "no episode": ([], "no episode"),
    "NaN state": ([GOOD, broken(state=NAN_STATE)], "episode 1: state holds NaN or infinity"),
    "NaN action": ([broken(action=NAN_STATE)], "episode 0: action holds NaN or infinity"),
    "infinite force": ([broken(tactile=INF_SKIN)], "tactile series holds NaN or infinity"),
    "NaN time": ([broken(time=NAN_TIME)], "time or tactile series holds NaN"),
    "no skin": ([broken(tactile=None)], "no tactile series"),
    "joints": ([broken(state=GOOD.state[:, :2])], r"expected state \(T, 3\)"),
    "flat": ([broken(action=GOOD.action[:, 0])], r"expected action \(T, 3\)"),
    "fewer actions": ([broken(action=GOOD.action[:-3])], "as many states as actions"),
    "no sample": ([broken(state=GOOD.state[:0], action=GOOD.action[:0])], "at least one"),
    "fewer readings": ([broken(tactile=GOOD.tactile[:-3])], "expected time and tactile of 170"),
    "fewer times": ([broken(time=GOOD.time[:-3])], "expected time and tactile of 170"),
    "cells": ([broken(tactile=GOOD.tactile[:, :4])], r"expected skin \(..., T, 6, 3\)"),
    "pressures": ([broken(tactile=GOOD.tactile[..., :1])], r"expected skin \(..., T, 6, 3\)"),
    "no touch": ([broken(tactile=0 * GOOD.tactile)], "none of the 1 episodes holds a touch"),
    "no motion": (
        [broken(state=0 * GOOD.state, action=0 * GOOD.action)],
        "no joint moves under touch",
    ),
}


@pytest.mark.parametrize("episodes", BAD, ids=BAD.get)
def test_bad_recordings_are_refused_and_change_nothing(episodes):
    recordings, message = BAD[episodes]
    model, _ = fitted(record(BODY, "side", path(1), 6.0))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        model.fit(recordings)
    after = model.state_dict()
    assert set(after) == set(before)
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert set(model.shapes) == {"side"}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (HASMConfig(store="sample", horizon=0), "horizon must be at least 1"),
        (HASMConfig(store="sample", horizon=10_000), "no touch of front lasts longer"),
        (HASMConfig(resolution=0), "resolution must be at least 1"),
        (HASMConfig(neurons=1), "neurons >= 2"),
        (HASMConfig(bits=9, code="binary"), "bits from 1 to 8"),
        (HASMConfig(beta=float("nan")), "beta"),
    ],
    ids=lambda value: "" if isinstance(value, HASMConfig) else value,
)
def test_settings_that_cannot_be_are_refused(config, message):
    model = HASM(config, BODY)
    with pytest.raises(ValueError, match=message):
        model.fit([GOOD])
    assert not model.memories
    assert not model.shapes


@pytest.mark.parametrize(
    "name", ["code", "pattern", "store", "advance", "code_joints", "touch_levels", "storage"]
)
def test_unknown_choices_are_named_with_the_valid_ones(name):
    with pytest.raises(
        ValueError, match=f"unknown {name} 'other', valid: .*{getattr(HASMConfig(), name)}"
    ):
        HASMConfig(**{name: "other"})


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["current_per_newton", "max_rate", "rate_window_s"])
def test_quantities_that_cannot_be_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite and above 0"):
        HASMConfig(**{name: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lower": [0.0, 0.0]}, "lower has 2 entries, expected one for each of the 3 joints"),
        ({"cells": [1, 2]}, "as many cell counts and directions as patches"),
        ({"upper": [0.0, -5.0, 1.0]}, "joint_1: expected lower < upper limit"),
    ],
)
def test_bodies_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(BODY, **changes)
