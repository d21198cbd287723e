"""What stands between a policy and the motors, whatever comes in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.ros.safety import Guard, Limits, Mode, SafetyConfig, planar_twist

LIMITS = Limits(("a", "b", "x"), np.array([-1.0, 0.0, -np.inf]), np.array([1.0, 0.5, np.inf]),
                np.array([1.0, 0.2, 0.3]))  # fmt: skip
CONFIG = SafetyConfig()
TICK = 1 / CONFIG.rate
REST = np.array([0.2, 0.1, 0.0])
anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
triples = st.lists(anything, min_size=3, max_size=3)


def ready(time=0.0, at=REST):
    guard = Guard(LIMITS, ("skin",), CONFIG)
    read(guard, time, at)
    return guard


def read(guard, time, at=REST):
    guard.take_skin(0, time)
    return guard.take_joints(np.array(at), time)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(triples, triples, st.floats(0.0, 0.2), st.booleans()), max_size=40))
def test_positions_stay_within_limits_and_steps_within_speed(events):
    guard, time, last = ready(), 0.0, None
    for readings, target, passed, felt in events:
        time += passed
        guard.take_joints(np.array(readings), time)
        if felt:
            guard.take_skin(0, time)
        order = guard.command(np.array(target), time)
        assert np.isfinite(order.speed).all()
        assert (np.abs(order.speed) <= LIMITS.max_speed * (1 + 1e-9)).all()
        if order.position is None:
            last = None  # it starts anew from where the robot then is
            assert not order.speed.any()
            continue
        assert (order.position >= LIMITS.lower).all()
        assert (order.position <= LIMITS.upper).all()
        if last is not None:
            assert (np.abs(order.position - last) <= LIMITS.max_speed * TICK + 1e-9).all()
        last = order.position


def test_a_target_is_reached_at_the_speed_limit_and_no_faster_for_asking_more_often():
    for calls in (1, 5):
        guard = ready()
        guard.command(REST, 0.0)
        at = REST
        for step in range(1, 10 * calls + 1):
            read(guard, step * TICK / calls, at)
            at = guard.command(np.array([1.0, 0.1, 0.0]), step * TICK / calls).position
        np.testing.assert_allclose(at[0], REST[0] + 10 * TICK)


def test_a_blocked_joint_is_led_no_farther_than_the_lead():
    guard = ready()
    for step in range(200):
        read(guard, step * TICK)
        order = guard.command(np.array([1.0, 0.1, 0.0]), step * TICK)
    np.testing.assert_allclose(order.position[0], REST[0] + CONFIG.lead)


def test_readings_that_no_joint_could_have_reached_count_as_missing():
    guard = ready()
    assert read(guard, TICK, [np.nan, 0.7, 0.0]).tolist() == [False, False, True]
    assert read(guard, 2 * TICK, [0.2 + 0.5, 0.1, 0.0]).tolist() == [False, True, True]
    assert guard.position[0] == 0.2
    guard.take_skin(0, 0.2)
    guard.take_joints(np.array([np.inf, 0.1, 0.0]), 0.2)
    assert guard.missing(0.2) == ["a"]
    assert guard.command(REST, 0.2).mode is Mode.WAITING


@pytest.mark.parametrize("stale", ["joints", "skin"])
def test_stale_readings_hold_then_stop_and_new_ones_go_on_from_where_the_robot_is(stale):
    guard = ready()
    for step in range(5):
        read(guard, step * TICK)
        sent = guard.command(np.array([1.0, 0.1, 0.3]), step * TICK).position
    time, held = 5 * TICK, 0
    while guard.mode is not Mode.STOPPED:
        if stale == "joints":
            guard.take_skin(0, time)
        else:
            guard.take_joints(REST, time)
        order = guard.command(np.array([1.0, 0.1, 0.3]), time)
        if order.mode is Mode.HOLDING:
            held += 1
            np.testing.assert_array_equal(order.position, sent)
            assert not order.speed.any()
        elif order.mode is Mode.DRIVING:
            sent = order.position
        time += TICK
        assert time < 1.0
    assert order.position is None
    assert held * TICK == pytest.approx(CONFIG.stop_after, abs=1.5 * TICK)
    elsewhere = REST + np.array([0.05, 0.0, 0.0])
    read(guard, time, elsewhere)
    order = guard.command(elsewhere, time)
    assert order.mode is Mode.DRIVING
    np.testing.assert_allclose(order.position, elsewhere)


def test_the_watchdog_holds_then_stops_where_nobody_commands():
    guard = ready()
    guard.command(REST, 0.0)
    assert guard.check(CONFIG.silent_after) is None
    modes = [guard.check(t) for t in np.arange(0.11, 0.7, TICK)]
    assert modes[0].mode is Mode.HOLDING
    assert not modes[0].speed.any()
    assert guard.mode is Mode.STOPPED
    assert guard.check(1.0) is None


def test_an_emergency_stop_latches_until_released():
    guard = ready()
    guard.command(REST, 0.0)
    guard.stop("test")
    for step in range(1, 50):
        read(guard, step * TICK)
        assert guard.command(REST, step * TICK).position is None
        assert guard.check(step * TICK).mode is Mode.EMERGENCY
    guard.reset()
    assert guard.mode is Mode.EMERGENCY
    guard.release()
    assert guard.command(REST, 1.0).position is None  # nothing was read since
    read(guard, 1.0)
    assert guard.command(REST, 1.0).mode is Mode.DRIVING


def test_the_base_is_told_in_its_own_frame():
    ahead, left, turn = planar_twist(np.array([0.0, 0.2, 0.1]), np.pi / 2)
    assert (ahead, left, turn) == pytest.approx((0.2, 0.0, 0.1))


def test_settings_and_limits_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="stop_after"):
        SafetyConfig(stop_after=0.0)
    with pytest.raises(ValueError, match="lower < upper"):
        Limits(("a",), np.array([1.0]), np.array([0.0]), np.array([1.0]))
