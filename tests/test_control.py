"""Courses of touches, speed limits, and displacements as a mobile base sees them."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import make_body

from hasm_torch.model.control import SPEED_SHARE, Course, limit_speed
from hasm_torch.model.frames import base_indices, into_base, out_of_base

POINTS = np.array([[0.0, 0.0], [1.0, 0.5], [1.0, 2.0], [-1.0, 2.5], [-1.0, 2.5]])
SPIKES = np.array([0.0, 4.0, 10.0, 30.0, 31.0])


def course() -> Course:
    return Course(POINTS, SPIKES)


def test_a_course_is_followed_spike_by_spike():
    way, here = course(), POINTS[0]
    for spent, left in ((1, 0), (3, 0), (3, 0), (14, 0), (0, 0), (12, 2)):
        here, rest = way.advance(here, spent)
        assert rest == left
        expected = [np.interp(way.done, SPIKES, column) for column in POINTS.T]
        np.testing.assert_allclose(here, expected, atol=1e-12)
    assert way.finished
    here, rest = way.advance(here, 7.0)
    assert rest == 7.0
    np.testing.assert_array_equal(here, POINTS[-1])


@given(spikes=st.lists(st.integers(0, 9), min_size=1, max_size=12),
       offset=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)))  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_the_way_depends_on_the_number_of_spikes_alone(spikes, offset):
    apart, together = course(), course()
    here = start = POINTS[0] + offset
    for count in spikes:
        here, _ = apart.advance(here, count)
    there, _ = together.advance(start, sum(spikes))
    assert apart.done == together.done == min(sum(spikes), SPIKES[-1])
    np.testing.assert_allclose(here, there, atol=1e-9)
    # and a reference beside the course comes back to it at its next point
    if sum(spikes) >= SPIKES[1]:
        expected = [np.interp(apart.done, SPIKES, column) for column in POINTS.T]
        np.testing.assert_allclose(here, expected, atol=1e-9)


def test_a_course_is_joined_at_its_nearest_point():
    for point in range(4):
        way = course()
        way.join(POINTS[point] + [0.1, -0.1], np.array([1.0, 1.0]))
        assert way.done == SPIKES[point]
    way = course()  # in shares of the joints' spans: the second joint hardly counts
    way.join(np.array([0.9, 100.0]), np.array([1.0, 1e6]))
    assert way.done == SPIKES[1]


vectors = st.lists(st.floats(-10, 10, width=32), min_size=3, max_size=3).map(torch.tensor)


@given(before=vectors, after=vectors, period=st.sampled_from([0.01, 0.02, 0.1]))
@settings(max_examples=60, deadline=None)
def test_limit_speed_shortens_a_step_to_the_limits(before, after, period):
    max_speed = torch.tensor([0.5, 2.0, 30.0])
    arrays = (tensor.double().numpy() for tensor in (before, after, max_speed))
    limited = torch.from_numpy(limit_speed(*arrays, period)).float()
    allowed = SPEED_SHARE * max_speed * period
    wanted, moved = after - before, limited - before
    assert (moved.abs() <= allowed + 1e-5).all()
    if (wanted.abs() <= allowed).all():
        torch.testing.assert_close(limited, after, rtol=0, atol=2e-6)
    else:
        assert ((moved.abs() / allowed).max() - 1).abs() < 2e-2  # no shorter than need be
        # and it points where the step pointed
        share = (moved * wanted).sum() / (wanted * wanted).sum()
        torch.testing.assert_close(moved, share * wanted, rtol=0, atol=1e-5)


BASE = base_indices(make_body(2, base=True))


@given(yaw=st.floats(-7, 7), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_a_displacement_is_seen_from_the_base(yaw, seed):
    world = np.random.default_rng(seed).normal(size=(4, 5))
    seen = into_base(world, yaw, BASE)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(seen[:, 2:4] @ turn.T, world[:, 2:4], atol=1e-9)
    np.testing.assert_array_equal(seen[:, [0, 1, 4]], world[:, [0, 1, 4]])
    np.testing.assert_allclose(out_of_base(seen, yaw, BASE), world, atol=1e-9)
    each = into_base(world, np.full(4, yaw), BASE)
    np.testing.assert_allclose(each, seen)


def test_forwards_is_forwards_whichever_way_the_base_looks():
    ahead = np.array([0.0, 0.0, 0.1, 0.0, 0.0])
    np.testing.assert_allclose(out_of_base(ahead, np.pi / 2, BASE), [0, 0, 0, 0.1, 0], atol=1e-12)
    assert BASE == [2, 3, 4]


def test_a_robot_that_stands_still_has_no_base():
    assert base_indices(make_body(2)) == []
    displacement = np.ones(2)
    assert into_base(displacement, 1.0, []) is displacement


def test_without_spikes_nothing_moves():
    here, rest = course().advance(np.array([3.0, 4.0]), 0.0)
    np.testing.assert_array_equal(here, [3.0, 4.0])
    assert rest == 0.0
