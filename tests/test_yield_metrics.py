"""The yield experiment: its pushes, what is measured of them, and what its models are taught."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from hasm_torch.episode import Episode
from hasm_torch.evaluation.along_force import Motion
from hasm_torch.evaluation.push import Push, swelling
from hasm_torch.evaluation.rollout import Trace
from hasm_torch.evaluation.teaching import SHORTEST, UNSEEN, cut, wrist_and_torso
from hasm_torch.evaluation.yielding import (
    GRIP,
    KINDS,
    LEAST_DIFFERENCE,
    PUSH_SECONDS,
    REST,
    TOUCH_AT,
    YieldCase,
    cases,
    measure,
    start_posture,
    summarise,
    summarise_torso,
    torso_cases,
)
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.tasks import (
    ARM_JOINTS,
    TORSO_PATCHES,
    WRIST_PATCHES,
    YIELD_GAIN,
    YIELD_TORSO,
    YIELD_WRIST,
)

SKIN = Skin.load().slices
STATE = np.zeros(11)


def test_a_push_begins_swells_holds_and_ends():
    push = Push({"under": (8.0, 3)}, 0.2, 1.7, rest=0.5, swing=3.0, period=1.0, held=("elbow",))
    assert push.touches(0.19, STATE) == {}
    assert push.touches(0.2, STATE) == {"under": (8.0, 3)}
    assert push.touches(0.45, STATE)["under"][0] == pytest.approx(11.0)
    assert push.touches(0.95, STATE)["under"][0] == pytest.approx(5.0)
    assert push.touches(1.7, STATE) == {}
    assert push.holds(1.0) == ("elbow",)
    assert not push.finished(2.19, STATE)
    assert push.finished(2.2, STATE)
    gripped = replace(push, grip=0.4)
    assert list(gripped.holds(0.59)) == list(JOINTS)
    assert gripped.holds(0.61) == ("elbow",)
    swollen = swelling(replace(push, swing=0.0), np.random.default_rng(0))
    assert swollen.pressed["under"][1] == 3
    assert swollen.pressed["under"][0] - swollen.swing >= 2.0
    assert (swollen.begin, swollen.end, swollen.held) == (0.2, 1.7, ("elbow",))


def test_cases_are_planned_from_the_seed_and_hold_every_kind():
    planned = cases(200, seed=3)
    assert planned == cases(200, seed=3)
    assert planned != cases(200, seed=4)
    assert Counter(c.kind for c in planned) == Counter(KINDS * (200 // len(KINDS)))
    assert Counter(c.kind for c in planned)["even"] == 100
    for case in planned:
        push = case.push
        assert push.begin == TOUCH_AT
        assert push.end - push.begin - push.grip == pytest.approx(PUSH_SECONDS)
        assert push.rest == REST
        assert case.without_rest().push == replace(push, rest=0.0)
        for patch, (force, cell) in push.pressed.items():
            assert patch in WRIST_PATCHES
            assert 2.0 <= force <= 14.0
            assert 0 <= cell < SKIN[patch].stop - SKIN[patch].start
    assert PUSH_SECONDS >= 1.5
    by_kind = {kind: [c.push for c in planned if c.kind == kind] for kind in KINDS}
    assert all(set(p.held) <= set(ARM_JOINTS) and p.held for p in by_kind["blocked_joint"])
    assert {p.grip for p in by_kind["held"]} == {GRIP}
    assert all(p.swing > 0.0 for p in by_kind["changing"])
    sides = [WRIST_PATCHES[:2], WRIST_PATCHES[2:]]
    for push in by_kind["two_patches"]:
        assert [sum(patch in side for patch in push.pressed) for side in sides] == [1, 1]
    for push in by_kind["opposite"]:
        assert set(push.pressed) in [set(side) for side in sides]
        one, other = (force for force, _ in push.pressed.values())
        assert abs(one - other) >= LEAST_DIFFERENCE
    patches = Counter(patch for push in by_kind["even"] for patch in push.pressed)
    assert min(patches[patch] for patch in WRIST_PATCHES) > 10


def test_cases_can_be_told_patches_and_forces():
    unseen = cases(30, 0, [3.0, 9.0], ("even",), UNSEEN)
    assert {patch for case in unseen for patch in case.push.pressed} == set(UNSEEN)
    forces = [force for case in unseen for force, _ in case.push.pressed.values()]
    assert forces == [3.0, 9.0] * 15
    torso = torso_cases(40, 0)
    assert {patch for case in torso for patch in case.push.pressed} == set(TORSO_PATCHES)
    assert {case.kind for case in torso} == {"torso"}


def test_a_start_is_anywhere_and_turned_anywhere():
    lower, upper = np.arange(11.0) - 5.0, np.arange(11.0) - 3.0
    lower[-3:], upper[-3:] = -np.inf, np.inf
    starts = np.array([start_posture(case, lower, upper) for case in cases(60, 0)])
    assert (starts[:, :8] > lower[:8]).all()
    assert (starts[:, :8] < upper[:8]).all()
    assert (starts[:, 8:10] == 0.0).all()
    assert np.ptp(starts[:, 10]) > 5.0
    again = start_posture(cases(60, 0)[7], lower, upper)
    np.testing.assert_array_equal(again, starts[7])


def test_base_drift_and_violations_are_measured():
    case = YieldCase(0, "torso", Push({"torso_front": (6.0, 0)}, 0.1, 1.7, 0.7))
    time = 0.02 * np.arange(1, 121)
    pressed = (time > 0.1) & (time <= 1.7)
    state = np.zeros((120, 11))
    way = 0.1 * (np.clip(time, 0.1, 1.7) - 0.1)
    state[:, JOINTS.index("odom_x")] = -way
    state[:, JOINTS.index("odom_y")] = 0.5 * way
    state[:, 3] = 0.03 * np.clip(time - 2.1, 0.0, 0.2)
    state[5, 2] = 9.0
    force, point = np.zeros((120, 2, 3)), np.full((120, 2, 3), np.nan)
    force[pressed, 0] = [-6.0, 0.0, 2.0]
    point[pressed, 0] = [0.2, 0.0, 0.9]  # a point that stays behind
    trace = Trace(
        time, state, state, np.zeros_like(state),
        np.where(np.stack([pressed, np.zeros(120, bool)], 1), "torso_front", ""),
        np.where(np.stack([pressed, np.zeros(120, bool)], 1), 0, -1),
        force, point, np.full((120, 3), np.nan), np.zeros(120), False,
    )  # fmt: skip
    limit = np.full(11, 4.0)
    found = measure(trace, case, -limit, limit, limit)
    assert found["base"].cos == pytest.approx(1 / np.hypot(1, 0.5))
    assert found["base"].force == pytest.approx(6.0)
    assert found["motion"].cos == 0.0
    assert found["drift"] == pytest.approx(0.03 * 0.2)
    assert found["violations"] == 1
    brief = measure(trace, replace(case, push=replace(case.push, end=3.0)), -limit, limit, limit)
    assert np.isnan(brief["drift"])


def figure(cos: float, force: float = 6.0, speed: float = 0.09, **more):
    motion = Motion(cos, speed * 1.3, force, speed, 0.1)
    return {"motion": motion, "base": motion, "drift": 0.001, "violations": 0} | more


def test_figures_of_many_pushes_are_put_together():
    kinds = ["even", "even", "even", "held", "changing"]
    planned = [YieldCase(i, kind, cases(1, i)[0].push) for i, kind in enumerate(kinds)]
    mine = [
        figure(0.9, 4.0, 0.8 * YIELD_GAIN * 4.0),
        figure(0.8, 8.0, 0.9 * YIELD_GAIN * 8.0, drift=0.004, violations=2),
        figure(-0.5, 12.0, -0.1),
        figure(0.2),
        figure(0.99),
    ]
    teacher = [figure(1.0), figure(1.0), figure(0.1), figure(1.0), figure(1.0)]
    found = summarise(planned, mine, teacher)
    assert found["along_force"]["share_07_of_teacher"] == pytest.approx(3 / 4)
    assert found["along_force"]["against"] == 0.2
    assert {kind: along["rollouts"] for kind, along in found["kinds"].items()} == {
        "even": 3, "held": 1, "changing": 1,
    }  # fmt: skip
    assert found["kinds"]["held"]["share_07"] == 0.0
    assert found["speed"]["spearman"] == pytest.approx(1.0)  # of what the teacher follows
    assert found["speed"]["spearman_of_teacher"] == 0.0  # whose speeds are the same here
    assert found["speed"]["of_expected"] == pytest.approx(0.85)
    assert len(found["velocities"]) == 2
    assert found["release_drift_rad"] == 0.004
    assert found["limit_violations"] == 2
    torso = summarise_torso(mine, teacher)
    assert torso["base_cos_09"] == 0.2  # 0.9 is not above it
    assert torso["base_cos_median"] == 0.8


def episode(index: int, task: str, touched: dict[str, range], length: int = 60) -> Episode:
    tactile = np.zeros((length, sum(s.stop - s.start for s in SKIN.values()), 3), np.float32)
    for patch, rows in touched.items():
        tactile[list(rows), SKIN[patch].start + 1, 2] = 3.0
    state = np.tile(np.arange(length, dtype=np.float32)[:, None], (1, 11))
    return Episode(index, task, np.arange(length) / 50.0, state, state + 1, tactile)


def test_touches_are_cut_out_of_an_episode():
    whole = episode(7, YIELD_WRIST, {"wrist_left": range(10, 20), "wrist_upper": range(25, 35),
                                     "wrist_right": range(40, 57)})  # fmt: skip
    assert [len(piece) for piece in cut(whole, ())] == [60]
    pieces = cut(whole, ["wrist_left", "wrist_right"])
    assert [(p.state[0, 0], p.state[-1, 0]) for p in pieces] == [(0, 9), (20, 39)]
    assert SHORTEST > 3  # the last three samples are left out
    for piece in pieces:
        np.testing.assert_allclose(piece.time, np.arange(len(piece)) / 50.0)
        np.testing.assert_array_equal(piece.action, piece.state + 1)
        assert piece.observations is None
    assert pieces[1].tactile[:, SKIN["wrist_upper"]].sum() == pytest.approx(30.0)
    assert not pieces[1].tactile[:, SKIN["wrist_right"]].any()


def test_the_first_demonstrations_at_the_wrist_and_all_at_the_torso_are_learned():
    wrist = [episode(i, YIELD_WRIST, {"wrist_left": range(10, 20)}) for i in range(4)]
    torso = [episode(i, YIELD_TORSO, {"torso_left": range(10, 20)}) for i in (4, 5)]
    chosen = wrist_and_torso(3)([*torso, *wrist])
    assert [e.task for e in chosen] == [YIELD_WRIST] * 3 + [YIELD_TORSO] * 2
    assert [e.index for e in chosen] == list(range(5))
    pieces = wrist_and_torso(3, ["wrist_left"])([*wrist, *torso])
    assert [len(e) for e in pieces] == [10, 40] * 3 + [60] * 2
    with pytest.raises(ValueError, match=r"episodes must be at most 4, .* got 5"):
        wrist_and_torso(5)([*wrist, *torso])
