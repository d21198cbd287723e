"""The figures of the compliance experiment on traces whose answers are known."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.evaluation.along_force import Motion
from hasm_torch.evaluation.compliance import (
    END_AT,
    RELEASE_AT,
    ROOM,
    TOUCH_AT,
    ComplianceCase,
    cases,
    even_push,
    led,
    measure,
    start_posture,
    summarise,
)
from hasm_torch.evaluation.correlation import r_squared, spearman, tracking
from hasm_torch.evaluation.rollout import Trace, limit_violations
from hasm_torch.robot import JOINTS
from hasm_torch.sim.tasks import BEHAVIOURS, UPRIGHT, Behaviour

PERIOD = 0.02
NAMES = ("lift", "elbow")
LOWER, UPPER, SPEED = np.array([0.0, -2.0]), np.array([1.0, 2.0]), np.array([0.5, 1.0])
UP = Behaviour("up", "under", "elbow", +1, "push it up")
DOWN = Behaviour("down", "upper", "elbow", -1, "push it down")


def trace(elbow: np.ndarray, force: np.ndarray | float = 5.0) -> Trace:
    """A rollout of a robot with two joints; only the elbow moves."""
    time = PERIOD * np.arange(1, len(elbow) + 1)
    state = np.stack([np.full(len(time), 0.5), elbow], axis=1)
    touched = (time >= TOUCH_AT) & (time <= RELEASE_AT)
    forces = np.zeros((len(time), 2, 3))
    forces[:, 0, 2] = np.where(touched, force, 0.0)
    return Trace(
        time=time,
        state=state,
        target=state.copy(),
        velocity=np.gradient(state, PERIOD, axis=0),
        patch=np.stack([np.where(touched, "under", ""), np.full(len(time), "")], axis=1),
        cell=np.full((len(time), 2), -1),
        force=forces,
        point=np.zeros((len(time), 2, 3)),
        object=np.full((len(time), 3), np.nan),
        height=np.zeros(len(time)),
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
    assert measured["displacement"] == pytest.approx((RELEASE_AT - TOUCH_AT) * speed)
    assert measured["speed"] == pytest.approx(speed)
    assert measured["force"] == pytest.approx(5.0)
    assert measured["drift"] == 0.0
    assert measured["others"] == 0.0
    assert measured["violations"] == 0


def test_the_wrong_way_is_negative():
    assert figures(ramp(0.2), DOWN)["displacement"] == pytest.approx(-0.32)
    assert figures(ramp(0.2), DOWN)["speed"] == pytest.approx(-0.2)
    assert figures(ramp(-0.2), DOWN)["speed"] == pytest.approx(0.2)


def test_a_joint_that_creeps_on_after_the_release_drifts():
    creeping = ramp(0.2) + 0.05 * np.clip(TIME - RELEASE_AT, 0.0, None)
    assert figures(creeping, UP)["drift"] == pytest.approx(
        0.05 * (END_AT - RELEASE_AT - 0.3), abs=0.05 * 2 * PERIOD
    )
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


def test_cases_are_planned_from_the_seed():
    planned = cases(8, seed=3)
    assert planned == cases(8, seed=3)
    assert planned != cases(8, seed=4)
    for index, behaviour in enumerate(BEHAVIOURS):
        mine = [case for case in planned if case.behaviour == index]
        assert [case.changing for case in mine] == [False] * 8 + [True] * 2
        for case in mine:
            [(patch, (force, cell))] = case.push.pressed.items()
            assert patch == behaviour.patch
            assert 2.0 <= force <= 14.0
            assert cell is not None
    in_turn = [next(iter(c.push.pressed.values()))[0] for c in cases(5, 0, [3.0, 9.0])][:5]
    assert in_turn == [3.0, 9.0, 3.0, 9.0, 3.0]
    assert {BEHAVIOURS[case.behaviour].name for case in led(planned)} == {"arm_down", "arm_up"}


@pytest.mark.parametrize("behaviour", BEHAVIOURS, ids=lambda b: b.name)
def test_a_start_leaves_the_yielding_joint_room_and_the_arms_wrist_upright(behaviour):
    lower, upper = np.arange(11.0) - 5.0, np.arange(11.0) - 3.0
    lower[-3:], upper[-3:] = -np.inf, np.inf
    rng = np.random.default_rng(0)
    starts = np.array([start_posture(behaviour, lower, upper, rng) for _ in range(50)])
    assert (starts[:, -3:] == 0.0).all()
    joint = JOINTS.index(behaviour.joint)
    share = (starts[:, joint] - lower[joint]) / 2.0
    assert (1 - share if behaviour.direction > 0 else share).min() >= ROOM
    straight = [JOINTS.index(name) for name in UPRIGHT]
    upright = (np.abs(starts[:, straight]) <= list(UPRIGHT.values())).all()
    assert upright == behaviour.name.startswith("arm")
    free = [j for j in range(8) if j != joint and j not in straight]
    assert starts[:, free].std(axis=0).min() > 0.4


def moved(cos: float) -> Motion:
    return Motion(cos, 0.1 * cos, 5.0, 0.05, 0.1)


def test_figures_of_many_rollouts_are_put_together():
    planned, measured = [], []
    for index, behaviour in enumerate(BEHAVIOURS):
        for force in (2.0, 4.0, 8.0):
            planned.append(ComplianceCase(index, 0, even_push(behaviour, force)))
            measured.append(
                {"displacement": 0.1, "drift": 0.001 * force, "others": 0.0, "violations": 1,
                 "force": force, "speed": 0.05 * force, "tracking": float("nan"),
                 "motion": moved(0.9)}
            )  # fmt: skip
        swell = replace(even_push(behaviour, 8.0), swing=2.0)
        planned.append(ComplianceCase(index, 0, swell))
        changing = {"tracking": 0.9, "displacement": -0.1, "motion": moved(-0.5)}
        measured.append({**measured[-1], **changing})
    summary = summarise(planned, measured, [{"motion": moved(1.0)}] * len(led(planned)))
    assert summary["limit_violations"] == 16
    assert list(summary["behaviours"]) == ["arm_down", "arm_up", "wrist_left", "wrist_right"]
    for name, found in summary["behaviours"].items():
        assert found["direction_correct"] == 0.75
        assert found["with_force" if name.startswith("arm") else "correct_turn"] == 0.75
        assert len({"with_force", "correct_turn"} & set(found)) == 1
        assert found["spearman"] == pytest.approx(1.0)
        assert found["r2"] == pytest.approx(1.0)
        assert found["tracking"] == pytest.approx(0.9)
        assert found["release_drift_rad"] == pytest.approx(0.008)
        assert found["velocities"] == [[2.0, 0.1], [4.0, 0.2], [8.0, 0.4]]
    assert summary["with_force"] == summary["correct_turn"] == 0.75
    along = summary["along_force"]
    assert (along["rollouts"], along["share_07"], along["against"]) == (8, 0.75, 0.25)
    assert along["travel_of_teacher"] == pytest.approx(0.9)
