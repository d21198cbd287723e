"""The physical figures on rollouts whose answers are known."""

import numpy as np
import pytest

from hasm_torch.evaluation.along_force import (
    MOVED,
    SETTLED_AFTER,
    Motion,
    motion,
    resultant,
    summarise,
)
from hasm_torch.evaluation.rollout import Trace

PERIOD = 0.02
STEPS = 100
TIME = PERIOD * np.arange(1, STEPS + 1)
BEGIN, END = 10, 90  # steps in which the skin is pressed
X, Y = np.eye(3)[:2]


def pressed(way, force, second=None) -> Trace:
    """One or two fingers push points along ways, (T, 3) each, with (T, 3) or (3,) forces."""
    fingers = [(way, force)] + ([] if second is None else [second])
    patch = np.zeros((STEPS, 2), dtype="<U12")
    cell = np.full((STEPS, 2), -1)
    forces, points = np.zeros((STEPS, 2, 3)), np.full((STEPS, 2, 3), np.nan)
    for number, (points_of, forces_of) in enumerate(fingers):
        patch[BEGIN:END, number] = ("wrist_upper", "wrist_left")[number]
        cell[BEGIN:END, number] = number
        forces[BEGIN:END, number] = np.broadcast_to(forces_of, (STEPS, 3))[BEGIN:END]
        points[BEGIN:END, number] = points_of[BEGIN:END]
    state = np.zeros((STEPS, 11))
    return Trace(
        time=TIME, state=state, target=state, velocity=state, patch=patch, cell=cell, force=forces,
        point=points, object=np.full((STEPS, 3), np.nan), height=np.zeros(STEPS), success=False,
    )  # fmt: skip


def line(velocity, origin=(0.5, 0.1, 0.7)) -> np.ndarray:
    return np.array(origin) + TIME[:, None] * np.array(velocity)


@pytest.mark.parametrize(("degrees", "cos"), [(0, 1.0), (60, 0.5), (90, 0.0), (180, -1.0)])
def test_the_cosine_is_that_of_way_and_force(degrees, cos):
    angle = np.radians(degrees)
    measured = motion(pressed(line(0.1 * (np.cos(angle) * X + np.sin(angle) * Y)), 8.0 * X))
    assert measured.cos == pytest.approx(cos, abs=1e-9)
    seconds = (END - BEGIN - 1) * PERIOD - SETTLED_AFTER
    assert measured.travel == pytest.approx(0.1 * cos * seconds, abs=0.1 * PERIOD + 1e-9)
    assert measured.speed == pytest.approx(0.1 * cos, abs=1e-9)
    assert measured.force == pytest.approx(8.0)


def test_a_detour_costs_and_a_stronger_push_counts_for_more():
    way = line(0.1 * X)
    way[50:] = way[50] + (TIME[50:, None] - TIME[50]) * 0.1 * Y  # then across
    force = np.where(TIME[:, None] <= TIME[50], 2.0, 6.0) * X
    straight = BEGIN + round(SETTLED_AFTER / PERIOD)
    along, across = 50 - straight, END - 51
    expected = 2.0 * along / (2.0 * along + 6.0 * across)
    assert motion(pressed(way, force)).cos == pytest.approx(expected, rel=0.02)
    there_and_back = line(np.zeros(3)) + 0.02 * np.sin(2 * np.pi * TIME / 0.65)[:, None] * X
    assert abs(motion(pressed(there_and_back, 8.0 * X)).cos) < 0.05


def test_a_point_that_gives_way_a_little_has_not_moved():
    shaken = line(np.zeros(3)) + 0.45 * MOVED * np.sin(20 * TIME)[:, None] * X
    assert motion(pressed(shaken, 5.0 * X)).cos == 0.0
    assert motion(pressed(shaken, 5.0 * X)).travel == pytest.approx(0.0, abs=MOVED)
    slow = line(1.5 * MOVED / (STEPS * PERIOD) * X)
    assert motion(pressed(slow, 5.0 * X)).cos == 0.0
    assert motion(pressed(line(0.01 * X), 5.0 * X)).cos == pytest.approx(1.0)


def test_the_beginning_and_what_comes_after_the_release_do_not_count():
    way = line(0.1 * X)
    settling = BEGIN + round(SETTLED_AFTER / PERIOD)
    way[:settling] = way[settling] + (TIME[:settling, None] - TIME[settling]) * 0.5 * Y
    assert motion(pressed(way, 5.0 * X)).cos == pytest.approx(1.0)
    trace = pressed(line(0.1 * X), 5.0 * X)
    trace.force[BEGIN + 30 :] = 0.0  # the finger hovers
    assert motion(trace).travel == pytest.approx(0.1 * (29 * PERIOD - SETTLED_AFTER), abs=2.1e-3)
    assert motion(pressed(way, 0.2 * X)) == Motion(0.0, 0.0, 0.0, 0.0, 0.0)  # a brush is no push


def test_two_fingers_are_their_resultant_at_the_weighted_mean_of_their_points():
    one, other = line(0.1 * X), line(0.1 * X, (0.4, 0.3, 0.6))
    trace = pressed(one, 6.0 * X, (other, 2.0 * X))
    force, point, _ = resultant(trace)
    np.testing.assert_allclose(force[50], 8.0 * X)
    np.testing.assert_allclose(point[50], 0.75 * one[50] + 0.25 * other[50])
    assert np.isnan(point[0]).all()
    # A link that turns about the middle between two equal opposite pushes goes nowhere.
    turning = np.stack([0 * TIME, np.cos(TIME), np.sin(TIME)], axis=1)
    spun = motion(pressed(turning, 5.0 * X, (-turning, 3.0 * X)))
    assert spun.travel == pytest.approx(0.0, abs=1e-9)
    # Opposite pushes: the stronger one says which way is along.
    led = motion(pressed(line(0.1 * X), 9.0 * X, (line(0.1 * X), -4.0 * X)))
    assert (led.cos, led.force) == pytest.approx((1.0, 5.0))


def test_a_trembling_force_does_not_move_the_point():
    """The weights of two points stay while both are pressed."""
    tremor = 1.0 + 0.3 * np.sin(60 * TIME)[:, None]
    trace = pressed(line(np.zeros(3)), 5.0 * tremor * X, (line(np.zeros(3), (0, 0, 0)), 5.0 * X))
    _, point, _ = resultant(trace)
    assert np.ptp(point[BEGIN:END], axis=0).max() == pytest.approx(0.0, abs=1e-12)


def test_a_change_of_the_pressed_cell_is_no_way():
    way = line(0.1 * X)
    way[50:] += 0.3 * Y  # another cell, beside the first
    trace = pressed(way, 5.0 * X)
    trace.cell[50:, 0] = 3
    assert motion(trace).cos == pytest.approx(1.0)
    trace.cell[50:, 0] = 0
    assert motion(trace).cos < 0.5


def test_a_blocked_robot_has_not_moved_and_counts_from_where_it_is_let_go():
    way = line(np.zeros(3))
    assert motion(pressed(way, 5.0 * X)).cos == 0.0
    free = BEGIN + 40
    way[free:] = way[free] + (TIME[free:, None] - TIME[free]) * 0.2 * X
    assert motion(pressed(way, 5.0 * X)).cos == pytest.approx(1.0)


def test_the_base_can_be_what_moves():
    trace = pressed(line(0.1 * Y), 5.0 * X + 50.0 * np.eye(3)[2])
    base = line(0.1 * X) + TIME[:, None] * np.eye(3)[2]
    assert motion(trace, plane=True, point=base).cos == pytest.approx(1.0)
    assert motion(trace, plane=True, point=base).force == pytest.approx(5.0)
    assert motion(trace, plane=True, point=line(-0.1 * X)).cos == pytest.approx(-1.0)


def moved(cos: float, travel: float = 0.1) -> Motion:
    return Motion(cos, travel, 6.0, travel, abs(travel))


def test_figures_of_many_rollouts_are_compared_with_the_teacher():
    mine = [moved(0.95), moved(0.8, 0.05), moved(0.6, 0.2), moved(-0.4, -0.1), moved(0.0, 0.0)]
    teacher = [moved(1.0), moved(0.99), moved(0.9), moved(0.75), moved(0.3)]
    summary = summarise(mine, teacher)
    assert summary == {
        "rollouts": 5,
        "cos_median": 0.6,
        "share_07": 0.4,
        "share_07_of_teacher": pytest.approx(0.4 / 0.8),
        "against": 0.2,
        "travel_of_teacher": pytest.approx(np.median([1.0, 0.5, 2.0, -1.0])),
    }
    assert summarise(teacher, teacher)["share_07_of_teacher"] == 1.0
    assert summarise(teacher, teacher)["travel_of_teacher"] == pytest.approx(1.0)


def test_a_teacher_that_cannot_either_is_no_measure():
    summary = summarise([moved(0.9)], [moved(0.1)])
    assert summary["share_07"] == 1.0
    assert summary["share_07_of_teacher"] is None
    assert summary["travel_of_teacher"] is None
