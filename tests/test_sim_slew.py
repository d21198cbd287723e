import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.sim.slew import SlewedReference

LEAD = 0.03  # m or rad
LOWER, UPPER = np.array([-1.0, 0.0]), np.array([2.0, 0.7])
VELOCITY, ACCELERATION = np.array([1.2, 0.2]), np.array([9.0, 2.5])
TICK, SUBSTEPS = 0.02, 10


def reference(start):
    slewed = SlewedReference(LOWER, UPPER, VELOCITY, ACCELERATION, TICK, SUBSTEPS)
    slewed.reset(np.array(start))
    return slewed


targets = st.lists(
    st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.integers(1, 40)), min_size=1, max_size=12
)


@settings(max_examples=60, deadline=None)
@given(start=st.tuples(st.floats(-2, 3), st.floats(-1, 1)), commands=targets)
def test_limits_hold_for_any_targets(start, commands):
    slewed = reference(start)
    path = [slewed.position[None]]
    for *target, ticks in commands:
        path += [slewed.plan(np.array(target)) for _ in range(ticks)]
    path = np.concatenate(path)
    speed = np.diff(path, axis=0) / (TICK / SUBSTEPS)
    acceleration = np.diff(speed, axis=0) / (TICK / SUBSTEPS)
    assert (path >= LOWER - 1e-12).all()
    assert (path <= UPPER + 1e-12).all()
    assert (np.abs(speed) <= VELOCITY + 1e-9).all()
    assert (np.abs(acceleration) <= ACCELERATION + 1e-5).all()


@settings(max_examples=40, deadline=None)
@given(start=st.floats(-1, 2), target=st.floats(-1, 2))
def test_target_is_reached_without_overshoot_in_nearly_the_shortest_time(start, target):
    slewed = reference([start, 0.0])
    goal = np.array([target, 0.0])
    distance = abs(target - start)
    speed, acceleration = VELOCITY[0], ACCELERATION[0]
    if distance > speed**2 / acceleration:
        shortest = distance / speed + speed / acceleration
    else:
        shortest = 2 * np.sqrt(distance / acceleration)
    # A whole number of ticks costs a few at the corners of the speed profile.
    ticks = int(np.ceil(shortest / TICK)) + 3
    path = np.concatenate([slewed.plan(goal) for _ in range(ticks)])[:, 0]
    assert path.max() <= max(start, target) + 1e-12
    assert path.min() >= min(start, target) - 1e-12
    np.testing.assert_allclose(path[-1], target, atol=1e-9)
    np.testing.assert_allclose(slewed.velocity, 0, atol=1e-9)


def test_small_steps_are_followed_within_one_tick_of_rest():
    slewed = reference([0.0, 0.0])
    step = 0.5 * ACCELERATION * TICK**2
    slewed.plan(step)
    slewed.plan(step)
    np.testing.assert_allclose(slewed.position, step, atol=1e-12)


def test_the_reference_of_a_blocked_joint_waits_at_rest():
    slewed = reference([0.0, 0.1])
    for _ in range(30):
        slewed.stay_near(np.array([0.0, slewed.position[1]]))
        slewed.plan(np.array([2.0, 0.7]))
    assert slewed.position[0] <= LEAD + ACCELERATION[0] * TICK**2
    np.testing.assert_allclose(slewed.position[1], 0.2, atol=0.02)
    np.testing.assert_allclose(slewed.velocity[1], VELOCITY[1])


def test_a_held_joint_brakes_as_fast_as_it_may_and_stays():
    slewed = reference([0.0, 0.1])
    for _ in range(20):
        slewed.plan(np.array([2.0, 0.7]))
    caught, speed = slewed.position.copy(), slewed.velocity[0]
    braking = speed**2 / (2 * ACCELERATION[0])
    for _ in range(30):
        slewed.hold(np.array([True, False]))  # said again, it is the same place
        slewed.plan(np.array([2.0, 0.7]))
    np.testing.assert_allclose(slewed.position[0], caught[0] + braking, atol=1e-9)
    np.testing.assert_allclose(slewed.velocity[0], 0, atol=1e-9)
    assert slewed.position[1] > caught[1] + 0.1
    slewed.hold(np.array([False, False]))
    slewed.plan(np.array([2.0, 0.7]))
    assert slewed.velocity[0] > 0.0
