"""The figures of the compliance experiment on traces whose answers are known."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.evaluation.compliance import (
    BEHAVIOURS,
    END_AT,
    RELEASE_AT,
    ROOM,
    TOUCH_AT,
    Behaviour,
    ComplianceCase,
    Push,
    cases,
    measure,
    r_squared,
    spearman,
    start_posture,
    summarise,
    tracking,
)
from hasm_torch.evaluation.report import table
from hasm_torch.evaluation.rollout import Trace, limit_violations
from hasm_torch.robot import JOINTS

PERIOD = 0.02
NAMES = ("lift", "elbow")
LOWER, UPPER, SPEED = np.array([0.0, -2.0]), np.array([1.0, 2.0]), np.array([0.5, 1.0])
UP, DOWN = Behaviour("up", "under", "elbow", +1), Behaviour("down", "upper", "elbow", -1)


def trace(elbow: np.ndarray, force: np.ndarray | float = 5.0) -> Trace:
    """A rollout of a robot with two joints; only the elbow moves."""
    time = PERIOD * np.arange(1, len(elbow) + 1)
    state = np.stack([np.full(len(time), 0.5), elbow], axis=1)
    touched = (time >= TOUCH_AT) & (time <= RELEASE_AT)
    return Trace(
        time=time,
        state=state,
        target=state.copy(),
        velocity=np.gradient(state, PERIOD, axis=0),
        force=np.where(touched, force, 0.0),
        patch=[None] * len(time),
        object_height=np.full(len(time), np.nan),
        success=False,
    )


TIME = PERIOD * np.arange(1, round(END_AT / PERIOD) + 1)


def ramp(speed: float, begin: float = 0.0) -> np.ndarray:
    return begin + speed * (np.clip(TIME, TOUCH_AT, RELEASE_AT) - TOUCH_AT)


def figures(elbow: np.ndarray, behaviour: Behaviour, force: np.ndarray | float = 5.0):
    return measure(trace(elbow, force), behaviour, NAMES, LOWER, UPPER, SPEED)


@pytest.mark.parametrize("speed", [0.1, 0.4])
def test_an_even_motion(speed):
    measured = figures(ramp(speed), UP)
    assert measured["displacement"] == pytest.approx(1.5 * speed)
    assert measured["speed"] == pytest.approx(speed)
    assert measured["force"] == pytest.approx(5.0)
    assert measured["drift"] == 0.0
    assert measured["others"] == 0.0
    assert measured["violations"] == 0


def test_the_wrong_way_is_negative():
    assert figures(ramp(0.2), DOWN)["displacement"] == pytest.approx(-0.3)
    assert figures(ramp(0.2), DOWN)["speed"] == pytest.approx(-0.2)
    assert figures(ramp(-0.2), DOWN)["speed"] == pytest.approx(0.2)


def test_a_joint_that_creeps_on_after_the_release_drifts():
    creeping = ramp(0.2) + 0.05 * np.clip(TIME - RELEASE_AT, 0.0, None)
    assert figures(creeping, UP)["drift"] == pytest.approx(0.05 * 1.0, abs=0.05 * 2 * PERIOD)
    overshoot = ramp(0.2) + 0.1 * ((TIME > RELEASE_AT) & (TIME < RELEASE_AT + 0.2))
    assert figures(overshoot, UP)["drift"] == 0.0  # its transient is over in time


def test_the_way_at_the_joints_end_does_not_count():
    stopped = np.minimum(ramp(0.5, 1.7), 2.0)
    assert figures(stopped, UP)["speed"] == pytest.approx(0.5, rel=0.1)
    assert np.isnan(figures(np.full(len(TIME), 2.0), UP)["speed"])


def test_another_joint_that_moves_is_seen():
    rollout = trace(ramp(0.2))
    rollout.state[-1, 0] += 0.07
    measured = measure(rollout, UP, NAMES, LOWER, UPPER, SPEED)
    assert measured["others"] == pytest.approx(0.07)


def test_violations_are_counted_by_the_step():
    rollout = trace(ramp(0.2))
    assert limit_violations(rollout, LOWER, UPPER, SPEED) == 0
    rollout.state[3, 1] = 2.01
    rollout.state[3, 0] = -0.01  # the same step counts once
    rollout.target[10, 1] = -2.5
    rollout.velocity[20:23, 0] = -0.6
    rollout.state[30, 0] = 1.0 + 1e-8  # rounding
    assert limit_violations(rollout, LOWER, UPPER, SPEED) == 1 + 1 + 3


@pytest.mark.parametrize("lag", [0, 3, 8])
def test_tracking_finds_a_speed_that_follows_the_force_late(lag):
    time = PERIOD * np.arange(200)
    force = 8 + 3 * np.sin(2 * np.pi * time / 1.1)
    speed = 0.05 * np.roll(force, lag)
    position = np.concatenate([[0.0], np.cumsum(speed[1:] * PERIOD)])
    assert tracking(force[20:], position[20:], PERIOD) > 0.995


def test_tracking_is_low_for_a_speed_that_does_not_follow():
    time = PERIOD * np.arange(200)
    force = 8 + 3 * np.sin(2 * np.pi * time / 1.1)
    against = np.cumsum(0.5 - 0.03 * force) * PERIOD
    assert tracking(force, against, PERIOD) < 0.0
    noise = np.cumsum(np.random.default_rng(0).normal(0.3, 0.1, 200)) * PERIOD
    assert tracking(force, noise, PERIOD) < 0.7
    late = np.cumsum(0.05 * np.roll(force, 25)) * PERIOD  # half a second is too late
    assert tracking(force, late, PERIOD) < 0.5


def test_tracking_of_nothing_is_no_number():
    assert np.isnan(tracking(np.full(100, 5.0), np.linspace(0, 1, 100) ** 2, PERIOD))
    assert np.isnan(tracking(np.sin(np.arange(100.0)), np.zeros(100), PERIOD))
    assert np.isnan(tracking(np.arange(5.0), np.arange(5.0), PERIOD))


numbers = st.lists(
    st.tuples(st.integers(-5, 5).map(float), st.floats(-9, 9, width=16)), min_size=2, max_size=30
)


@given(pairs=numbers)
@settings(max_examples=80, deadline=None)
def test_correlations_are_scipys(pairs):
    x, y = np.array(pairs).T
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert spearman(x, y) == r_squared(x, y) == 0.0
        return
    expected = scipy.stats.spearmanr(x, y).statistic
    assert spearman(x, y) == pytest.approx(expected, abs=1e-9)
    if np.ptp(y) > 1e-3:
        assert r_squared(x, y) == pytest.approx(scipy.stats.linregress(x, y).rvalue ** 2, abs=1e-9)


def test_correlations_of_nothing_are_zero():
    nothing = np.zeros(0)
    assert spearman(nothing, nothing) == r_squared(nothing, nothing) == 0.0


def test_a_push_begins_swells_and_ends():
    push = Push("under", 8.0, swing=3.0, period=1.0)
    state = np.zeros(2)
    assert push.touch(TOUCH_AT - 0.01, state) == (None, 0.0)
    assert push.touch(TOUCH_AT, state) == ("under", 8.0)
    assert push.touch(TOUCH_AT + 0.25, state)[1] == pytest.approx(11.0)
    assert push.touch(TOUCH_AT + 0.75, state)[1] == pytest.approx(5.0)
    assert push.touch(RELEASE_AT, state) == (None, 0.0)
    assert not push.finished(RELEASE_AT, state)
    assert push.finished(END_AT, state)
    even = {Push("under", 8.0).touch(t, state)[1] for t in np.arange(TOUCH_AT, RELEASE_AT, 0.1)}
    assert even == {8.0}


def test_cases_are_planned_from_the_seed():
    planned = cases(8, [], seed=3)
    assert planned == cases(8, [], seed=3)
    assert planned != cases(8, [], seed=4)
    for index in range(len(BEHAVIOURS)):
        mine = [case for case in planned if case.behaviour == index]
        assert [case.changing for case in mine] == [False] * 8 + [True] * 2
        assert all(2.0 <= case.force <= 14.0 for case in mine)
    taken_in_turn = [c.force for c in cases(5, [3.0, 9.0], 0) if not c.changing][:5]
    assert taken_in_turn == [3.0, 9.0, 3.0, 9.0, 3.0]


@pytest.mark.parametrize("index", range(len(BEHAVIOURS)))
def test_a_start_leaves_the_yielding_joint_room(index):
    joints = JOINTS
    lower, upper = np.arange(8.0), np.arange(8.0) + 2.0
    behaviour = BEHAVIOURS[index]
    shares = np.array(
        [
            (start_posture(ComplianceCase(index, seed, 5.0, False), joints, lower, upper) - lower)
            / 2.0
            for seed in range(50)
        ]
    )
    assert (shares >= 0).all()
    assert (shares <= 1).all()
    mine = shares[:, joints.index(behaviour.joint)]
    ahead = 1 - mine if behaviour.direction > 0 else mine
    assert ahead.min() >= ROOM
    assert np.delete(shares, joints.index(behaviour.joint), axis=1).std(axis=0).min() > 0.2


def test_figures_of_many_rollouts_are_put_together():
    planned, measured = [], []
    for index in range(4):
        for force in (2.0, 4.0, 8.0):
            planned.append(ComplianceCase(index, 0, force, False))
            measured.append(
                {"displacement": 0.1, "drift": 0.001 * force, "others": 0.0, "violations": 1,
                 "force": force, "speed": 0.05 * force, "tracking": float("nan")}
            )  # fmt: skip
        planned.append(ComplianceCase(index, 0, 8.0, True))
        measured.append({**measured[-1], "tracking": 0.9, "displacement": -0.1})
    summary = summarise(planned, measured)
    assert summary["limit_violations"] == 16
    assert list(summary["behaviours"]) == ["arm_down", "arm_up", "wrist_left", "wrist_right"]
    for found in summary["behaviours"].values():
        assert found["direction_correct"] == 0.75
        assert found["spearman"] == pytest.approx(1.0)
        assert found["r2"] == pytest.approx(1.0)
        assert found["tracking"] == pytest.approx(0.9)
        assert found["release_drift_rad"] == pytest.approx(0.008)
        assert found["velocities"] == [[2.0, 0.1], [4.0, 0.2], [8.0, 0.4]]


def metrics(**changes):
    behaviour = {
        "direction_correct": 1.0, "spearman": 0.99, "r2": 0.95, "tracking": 0.97,
        "release_drift_rad": 0.001,
    }  # fmt: skip
    return {
        "compliance": {"behaviours": {"arm_up": {**behaviour, **changes}}, "limit_violations": 0},
        "grasp": {"success_rate": 0.96, "hold_drift_rad": 0.002, "limit_violations": 0},
        "train_seconds": 1.5,
        "memory_bytes": 150_000,
        "tick_ms": {"median": 0.4, "p99": 0.9},
    }


def test_the_table_marks_what_misses_its_goal():
    assert "!" not in table(metrics())
    for key, value in (("spearman", 0.97), ("release_drift_rad", 0.02), ("r2", float("nan"))):
        marked = [line for line in table(metrics(**{key: value})).splitlines() if "!" in line]
        assert len(marked) == 1
        assert key in marked[0]
    violated = metrics()
    violated["grasp"]["limit_violations"] = 1
    assert sum("!" in line for line in table(violated).splitlines()) == 1


def test_the_table_has_lines_for_what_was_measured_only():
    both = table(metrics())
    assert "train_seconds" in both
    loaded = metrics()
    loaded["train_seconds"] = None
    del loaded["grasp"]
    assert "train_seconds" not in table(loaded)
    assert "grasp" not in table(loaded)
