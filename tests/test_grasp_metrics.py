"""The figures of the grasp experiment and the human who guides it."""

import numpy as np
import pytest

from hasm_torch.evaluation.grasp import (
    SOFT_PATIENCE,
    STALLED_AFTER,
    TIME_LIMIT,
    GraspCase,
    Guide,
    cases,
    summarise,
)
from hasm_torch.evaluation.rollout import Human, roll_out, run_case
from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import TouchPoint
from hasm_torch.sim.tasks import GRASP_PATCH, LIFT_NOISE_SHARE, REACH_PATCH, noisy_start

PERIOD = 0.02
LOWER, UPPER = np.full(len(JOINTS), -1.0), np.full(len(JOINTS), 1.0)
HOME = np.zeros(len(JOINTS))


def guided(guide: Guide, speed: float, seconds: float = TIME_LIMIT + 5, stuck_after: float = 1.0):
    """A robot that moves for `stuck_after` seconds of each patch's touch; what was touched."""
    state, seen, moved = np.zeros(3), [], {REACH_PATCH: 0.0, GRASP_PATCH: 0.0}
    for step in range(round(seconds / PERIOD)):
        time = step * PERIOD
        if guide.finished(time, state):
            break
        patch, (force, _) = next(iter(guide.touches(time, state).items()), (None, (0.0, None)))
        seen.append((time, patch, force))
        if patch is not None and moved[patch] < stuck_after:
            moved[patch] += PERIOD
            state = state + speed * PERIOD
    return seen


def test_a_guide_reaches_then_grasps_then_is_done():
    guide = Guide(7.0, 0, np.random.default_rng(0))
    seen = guided(guide, speed=0.5)
    patches = [patch for _, patch, _ in seen if patch is not None]
    assert patches == sorted(patches, key=[REACH_PATCH, GRASP_PATCH].index)
    assert {force for _, patch, force in seen if patch} == {7.0}
    for patch in (REACH_PATCH, GRASP_PATCH):
        touched = PERIOD * patches.count(patch)
        patience = STALLED_AFTER + SOFT_PATIENCE / 7.0
        assert touched == pytest.approx(1.0 + patience, abs=0.2)
    assert len(guide.pauses) == 2  # once after each stage
    assert seen[-1][0] < 12.0


def test_a_guide_leaves_at_random_moments_and_comes_back():
    guide = Guide(7.0, 3, np.random.default_rng(1))
    seen = guided(guide, speed=0.2, stuck_after=6.0)
    assert len(guide.pauses) == 3 + 2
    for begin, end in guide.pauses:
        assert {patch for time, patch, _ in seen if begin <= time < end - 1e-9} == {None}
    lengths = [end - begin for begin, end in guide.pauses]
    assert sum(0.8 <= length <= 1.6 for length in lengths) == 3
    again = Guide(7.0, 3, np.random.default_rng(1))
    assert guided(again, speed=0.2, stuck_after=6.0) == seen


def test_a_guide_goes_on_after_a_pause_where_it_was():
    """A pause does not count as the robot's standing still."""
    guide = Guide(7.0, 0, np.random.default_rng(0))
    guide.moments, guide.lengths = [0.5], [10.0]
    seen = guided(guide, speed=0.5)
    after = [patch for time, patch, _ in seen if time > guide.pauses[0][1]]
    assert after[0] == REACH_PATCH


def test_patience_ends():
    guide = Guide(7.0, 0, np.random.default_rng(0))
    seen = guided(guide, speed=0.5, stuck_after=1e9)
    assert seen[-1][0] == pytest.approx(TIME_LIMIT, abs=2 * PERIOD)


def test_start_noise_has_its_size_and_keeps_the_limits():
    rng = np.random.default_rng(0)
    starts = np.array([noisy_start(HOME, 0.05, LOWER, UPPER, rng) for _ in range(2000)])
    expected = 0.05 * np.array([LIFT_NOISE_SHARE, *[1.0] * 7, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(starts.std(axis=0), expected, rtol=0.1)
    wild = np.array([noisy_start(HOME, 50.0, LOWER, UPPER, rng) for _ in range(50)])
    assert (wild >= LOWER).all()
    assert (wild <= UPPER).all()
    np.testing.assert_array_equal(noisy_start(UPPER, 0.0, LOWER, UPPER, rng), UPPER)


def test_cases_are_planned_from_the_seed():
    planned = cases(5, 1, [4.0, 8.0], pauses=2, start_noise=0.1)
    assert planned == cases(5, 1, [4.0, 8.0], pauses=2, start_noise=0.1)
    assert [case.force for case in planned] == [4.0, 8.0, 4.0, 8.0, 4.0]
    assert len({case.seed for case in planned}) == 5
    assert all(3.0 <= case.force <= 12.0 for case in cases(20, 1))
    far = np.array([case.place for case in cases(200, 1, object_noise=0.1)])
    assert 0.09 < np.abs(far).max() <= 0.1


class Table:
    """A robot that reaches each target at once; the object rises as it is told."""

    joint_lower, joint_upper = LOWER, UPPER
    joint_speed_limit = np.full(len(JOINTS), 100.0)
    object_position = np.array([0.7, 0.1, 0.5])

    def __init__(self, drift: float = 0.0, lift: float = 0.1, success: bool = True) -> None:
        self.unwrapped, self.drift, self.lift, self.success = self, drift, lift, success

    def reset(self, seed, options):
        self.steps, self.joint_position, self.touched = 0, np.array(options["joints"]), {}
        self.offset = options["object"]
        return self.observe(), {"time": 0.0}

    def touch_all(self, touches):
        self.touched = touches

    def touch_points(self):
        return [
            TouchPoint(patch, cell, np.array([0.0, 0.0, -force]), np.zeros(3))
            for patch, (force, cell) in self.touched.items()
        ]

    def block(self, joints):
        self.blocked = joints

    def step(self, target):
        self.steps += 1
        before, self.joint_position = self.joint_position, np.clip(target + self.drift, -1.0, 1.0)
        self.joint_velocity = (self.joint_position - before) / PERIOD
        info = {
            "time": self.steps * PERIOD,
            "is_success": self.success,
            "object_height": self.lift,
        }
        return self.observe(), 0.0, False, False, info

    def observe(self):
        seen = {"state": self.joint_position, "tactile": np.zeros(3), "environment_state": HOME[:3]}
        return {name: values.astype(np.float32) for name, values in seen.items()}


class Holder:
    """A policy that asks for the joints as they are."""

    def reset(self):
        self.resets = getattr(self, "resets", 0) + 1

    def step(self, state, skin, *, observation):
        assert observation.shape == (3,)
        return state.clone()


CASE = GraspCase(seed=3, force=6.0, place=(0.004, -0.003), pauses=2)


def test_a_robot_that_holds_still_does_not_drift():
    policy = Holder()
    trace, found = run_case(CASE, Table(), policy)
    assert found["success"]
    assert found["hold_drift"] == 0.0
    assert found["force"] == 6.0
    assert found["violations"] == 0
    assert policy.resets == 1
    assert set(trace.patch[:, 0]) == {"", REACH_PATCH, GRASP_PATCH}
    assert set(trace.patch[:, 1]) == {""}


def test_a_robot_that_moves_in_a_pause_drifts():
    trace, found = run_case(CASE, Table(drift=1e-4), Holder())
    longest = max(
        np.ptp(trace.time[(trace.time >= a + 0.3) & (trace.time <= b)]) for a, b in pauses_of(trace)
    )
    assert found["hold_drift"] == pytest.approx(1e-4 * longest / PERIOD, rel=0.1)


def pauses_of(trace):
    """Spells without touch after the first touch, as (begin, end)."""
    free = trace.patch[:, 0] == ""
    edges = np.flatnonzero(np.diff(free.astype(int)))
    times = trace.time[edges]
    spans = zip(times[1::2], [*times[2::2], trace.time[-1]])
    return [(begin, end) for begin, end in spans if end - begin > 0.4]


def test_success_needs_the_environment_and_the_height():
    assert not run_case(CASE, Table(lift=0.04), Holder())[1]["success"]
    assert not run_case(CASE, Table(success=False), Holder())[1]["success"]


def test_a_rollout_hands_on_what_the_case_says():
    class Two(Human):
        def touches(self, time, state):
            return {"wrist_left": (3.0, 2), "hand": (1.0, None)} if time < 0.05 else {}

        def holds(self, time):
            return ["odom_x"]

        def finished(self, time, state):
            return time >= 0.1

    table, seen = Table(), []
    start = np.linspace(0.0, 1.0, len(JOINTS))
    place = (0.004, -0.003)
    trace = roll_out(table, Holder(), Two(), start, 0, place, lambda: seen.append(table.steps))
    assert table.offset == place
    assert table.blocked == ["odom_x"]
    assert seen == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(trace.state, np.tile(start, (5, 1)), atol=1e-7)
    np.testing.assert_allclose(trace.time, PERIOD * np.arange(1, 6))
    np.testing.assert_allclose(trace.strength, [4.0, 4.0, 4.0, 0.0, 0.0])
    assert trace.patch[:3].tolist() == [["wrist_left", "hand"]] * 3
    assert trace.cell[[0, 4]].tolist() == [[2, -1], [-1, -1]]
    np.testing.assert_allclose(trace.force[0], [[0, 0, -3.0], [0, 0, -1.0]])
    assert np.isnan(trace.point[4]).all()
    np.testing.assert_allclose(trace.object[0], table.object_position)


def test_figures_of_many_grasps_are_put_together():
    one = {"success": True, "hold_drift": 0.001, "violations": 0, "seconds": 10.0}
    two = {"success": False, "hold_drift": 0.004, "violations": 2, "seconds": 20.0}
    summary = summarise([one, one, one, two], {})
    assert summary["rollouts"] == 4
    assert summary["success_rate"] == 0.75
    assert summary["hold_drift_rad"] == 0.004
    assert summary["limit_violations"] == 2
    assert summary["mean_seconds"] == 12.5


def test_moved_objects_are_counted_by_largest_offset():
    near = [{"success": True, "place": [0.01, 0.02]}, {"success": False, "place": [-0.02, 0.0]}]
    rest = {"hold_drift": 0.0, "violations": 0, "seconds": 9.0}
    summary = summarise([near[0] | rest], {"0.02": near, "0.10": near[:1]})
    assert summary["moved"] == {"0.02": 0.5, "0.10": 1.0}
    assert summary["moved_results"]["0.02"] == [[0.01, 0.02, 1.0], [-0.02, 0.0, 0.0]]
