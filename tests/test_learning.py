"""What ``HASM.fit`` stores, and what it refuses."""

import dataclasses

import numpy as np
import pytest
import reference
import torch
from toys import (
    Recorded,
    along,
    limits,
    make_body,
    postures,
    press,
    push,
    record,
    smooth_path,
    spell,
    straight,
    yielding,
)

from hasm_torch import HASM, HASMConfig

BODY = make_body(3)
GOOD = record(BODY, "front", straight(BODY, 0), 6.0)


def fitted(*episodes, **config):
    model = HASM(HASMConfig(**config), BODY)
    return model, model.fit(episodes)


def test_every_association_knows_where_it_comes_from():
    episodes = [
        yielding(BODY, along(BODY), q, [(None, 10), (patch, 30), (None, 10)])
        for q in postures(BODY, 3, 0)
        for patch in ("front", "back")
    ]
    model, report = fitted(*episodes, value="displacement")
    origins = model.origins
    assert origins.shape == (report.associations, 3)
    assert report.episodes == 6
    assert report.taught == model.patches == ["front", "back"]
    assert set(origins[:, 0]) == set(range(6))
    for episode, frame, patch in origins:
        assert BODY.patches[patch] == ("front", "back")[episode % 2]
        assert 5 <= frame <= 40  # where the patch was touched
    assert model.memory_bytes() > report.associations * 3 * 4


def test_a_stored_state_recalls_what_was_stored_with_it():
    """Sharp enough, each association gives back its own displacement a spike."""
    episodes = [yielding(BODY, along(BODY), q, [(None, 10), ("front", 30), (None, 10)])
                for q in postures(BODY, 4, 1)]  # fmt: skip
    model, _ = fitted(
        *episodes, value="displacement", readout="mean", beta=float("inf"), joints=BODY.joints
    )
    memory = model.recalling.memory
    codes = memory.stored()
    np.testing.assert_array_equal(codes.abs(), 1.0)  # one bit an entry
    recalled = memory.recall(codes)
    for episode, frame, _ in model.origins:
        row = np.flatnonzero((model.origins[:, :2] == [episode, frame]).all(1))[0]
        path = episodes[episode].action[:, model.settled.moved]
        way = path[frame + 5] - path[frame]
        np.testing.assert_allclose(recalled[row] / (np.linalg.norm(recalled[row]) + 1e-12),
                                   way / (np.linalg.norm(way) + 1e-12), atol=1e-3)  # fmt: skip


@pytest.mark.parametrize("value", ["displacement", "goal", "successor"])
@pytest.mark.parametrize("force", [4.0, 9.0])
def test_at_the_recorded_force_the_recorded_speed_is_repeated(value, force):
    path = straight(BODY, 0, samples=200)
    model, _ = fitted(record(BODY, "front", path, force), value=value)
    targets = spell(model, BODY, torch.tensor(path[0]).float(), "front", force, 120)
    speed = (targets[100, 0] - targets[30, 0]) / 70
    recorded = (path[-1, 0] - path[0, 0]) / 199
    assert speed == pytest.approx(recorded, rel=0.05)


def test_fit_replaces_what_was_stored():
    model, _ = fitted(record(BODY, "front", straight(BODY, 0), 6.0))
    spell(model, BODY, torch.zeros(3), "front", 6.0, 5)
    model.fit([record(BODY, "side", straight(BODY, 1), 6.0)])
    assert model.patches == ["side"]
    assert set(model.origins[:, 2]) == {1}
    with pytest.raises(RuntimeError, match="no reference yet"):
        _ = model.reference  # the rollout is forgotten with it


@pytest.mark.parametrize("readout", ["mean", "first_order"])
def test_pushes_lead_a_mobile_base_whichever_way_it_looks(readout):
    """Taught at one yaw, tested at another: the push's direction turns along with the base."""
    body = make_body(3, base=True)

    def law(toward, positions):
        step, yaw = np.zeros(6), positions[5]
        turn = reference.rodrigues([0.0, 0.0, 1.0], yaw)
        step[3:] = [*(0.002 * turn @ toward)[:2], 0.004]
        return step

    touches = [(None, 10), ("front", 20), (None, 10), ("side", 20), (None, 10)]
    starts = postures(body, 10, 2)
    starts[:, 5] = 0.3
    model = HASM(HASMConfig(value="displacement", readout=readout), body)
    model.fit([yielding(body, law, q, touches) for q in starts])
    assert model.settled.moved == [3, 4, 5]
    cosines = []
    for yaw, q in zip((-2.5, 0.3, 1.9, 9.0), postures(body, 4, 3)):
        start = np.array([*q[:5], yaw])
        for patch in ("front", "side"):
            model.reset()
            targets = spell(model, body, torch.tensor(start).float(), patch, 6.0, 15)
            went = (targets[-1].numpy() - start)[3:5]
            wanted = law(push(body, patch, start), start)[3:5]
            cosines.append(went @ wanted / np.linalg.norm(went) / np.linalg.norm(wanted))
            torch.testing.assert_close(targets[:, :3], targets[:1, :3].expand(15, 3))
    assert np.median(cosines) > 0.95
    assert min(cosines) > (0.95 if readout == "first_order" else 0.3)


def test_the_paper_as_written_can_be_stored():
    model = HASM(HASMConfig.literal(), BODY)
    report = model.fit([record(BODY, "front", straight(BODY, 0, samples=300), 6.0)])
    chosen = report.choices
    assert (chosen["touch"], chosen["value"], chosen["readout"]) == ("patch", "successor", "mean")
    assert model.settled.beta == 2.0
    start = torch.tensor(straight(BODY, 0)[0]).float()
    targets = spell(model, BODY, start, "front", 6.0, 200)
    lower, upper = limits(BODY)
    assert torch.isfinite(targets).all()
    assert ((targets.numpy() >= lower) & (targets.numpy() <= upper)).all()
    assert targets[-1, 0] > start[0] + 0.1


def broken(**changes) -> Recorded:
    return dataclasses.replace(GOOD, **changes)


LATE = np.arange(len(GOOD.time)) == 40
BAD = {
    "no episode": ([], "no episode"),
    "NaN": ([GOOD, broken(state=np.where(LATE[:, None], np.nan, GOOD.state))], "episode 1: state"),
    "no skin": ([broken(tactile=None)], "no tactile series"),
    "joints": ([broken(state=GOOD.state[:, :2])], r"expected state \(T, 3\)"),
    "no touch": ([broken(tactile=0 * GOOD.tactile)], "none of the 1 episodes holds a touch"),
    "too soft": ([broken(tactile=0.01 * GOOD.tactile)] * 2, "none of the 2 episodes holds a touch"),
    "no motion": (
        [broken(state=0 * GOOD.state, action=0 * GOOD.action)],
        r"no joint moves under touch in any of the 1 episodes.*2%",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_recordings_are_refused_and_change_nothing(case):
    recordings, message = BAD[case]
    model, _ = fitted(record(BODY, "side", straight(BODY, 1), 6.0))
    spell(model, BODY, torch.zeros(3), "side", 6.0, 5)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    settled, reference_ = model.settled, model.reference
    with pytest.raises(ValueError, match=message):
        model.fit(recordings)
    after = model.state_dict()
    assert set(after) == set(before)
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert model.settled is settled
    assert torch.equal(model.reference, reference_)  # and the rollout goes on


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (HASMConfig(neurons=1), "neurons >= 2"),
        (HASMConfig(bits=9, code="binary"), "bits from 1 to 8"),
        (HASMConfig(width=0.0), "width > 0"),
        (HASMConfig(resolution=0, value="successor"), "resolution must be at least 1"),
        (HASMConfig(threshold=-1.0), "threshold >= 0"),
        (HASMConfig(spike_dt_ms=0.0), "above 0"),
    ],
    ids=lambda value: "" if isinstance(value, HASMConfig) else value,
)
def test_settings_that_cannot_be_are_refused(config, message):
    model = HASM(config, BODY)
    with pytest.raises(ValueError, match=message):
        model.fit([GOOD])
    assert model.settled is None
    assert model.patches == []


@pytest.mark.parametrize(
    "name",
    ["code", "ranks", "pattern", "touch", "frame", "value", "readout", "drive", "storage"],
)
def test_unknown_choices_are_named_with_the_valid_ones(name):
    with pytest.raises(
        ValueError, match=f"unknown {name} 'other', valid: .*{getattr(HASMConfig(), name)}"
    ):
        HASMConfig(**{name: "other"})


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize(
    "name", ["current_per_newton", "max_rate", "rate_window_s", "pair_window_s"]
)
def test_quantities_that_cannot_be_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite and above 0"):
        HASMConfig(**{name: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, "horizon must be at least 1 sample, got 0"),
        ({"beta": -1.0}, "beta must be 0 or above"),
        ({"beta": float("nan")}, "beta must be 0 or above"),
    ],
)
def test_numbers_out_of_range_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        HASMConfig(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lower": [0.0, 0.0]}, "lower has 2 entries, expected one for each of the 3 joints"),
        ({"cells": [1, 2]}, "cells has 2 entries, expected one for each of the 3 patches"),
        ({"links": ["hand"]}, "links has 1 entries, expected one for each of the 3 patches"),
        ({"cells": [1, 2, 2]}, "expected a normal for each of the 5 cells, got 6"),
        ({"upper": [0.0, -5.0, 1.0]}, "joint_1: expected lower < upper limit"),
        ({"max_speed": [1.0, 0.0, 1.0]}, "joint_1: expected a speed limit above 0"),
        ({"base": ["odom_x"]}, "the base names unknown joints: odom_x"),
        ({"channels": 2}, "channels must be 0, 1, 3 or 6"),
    ],
)
def test_bodies_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(BODY, **changes)


def test_patches_of_one_link_are_one_rigid_body():
    assert BODY.groups == [0, 0, 2]
    assert dataclasses.replace(BODY, groups=[4, 5, 4]).groups == [4, 5, 4]
    assert BODY.limited == [0, 1, 2]
    assert make_body(2, base=True).limited == [0, 1]


def test_forces_that_were_not_taught_are_answered_like_the_nearest_that_was():
    """ρ of a query is held within that of the episodes, so that no force is unlike all others."""
    model, _ = fitted(*[record(BODY, "front", smooth_path(BODY, 150, s, [0, 1]), 6.0)
                        for s in range(2)], value="displacement")  # fmt: skip
    low, high = model.settled.density
    assert low <= high < 0.7
    start = torch.tensor(smooth_path(BODY, 150, 0, [0, 1])[40]).float()
    best = []
    for force in (3.0, 6.0, 14.0):
        model.reset()
        for _ in range(12):
            model.step(start, press(BODY, "front", force))
        ((_, weights),) = model.recalled()
        best.append(weights)
    for weights in best:
        np.testing.assert_allclose(weights, best[1], atol=0.05)
