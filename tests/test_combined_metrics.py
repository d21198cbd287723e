"""Touches between two patches, measured on robots and policies whose answers are known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hasm_torch.apps.training import train
from hasm_torch.config import HASMConfig
from hasm_torch.evaluation.combined import (
    LARGEST_ANGLE,
    PAIRS,
    CombinedCase,
    Hold,
    angle,
    cases,
    run_case,
    start_posture,
    summarise,
)
from hasm_torch.evaluation.compliance import BEHAVIOURS, END_MARGIN, RELEASE_AT, ROOM, TOUCH_AT
from hasm_torch.evaluation.runner import make_env
from hasm_torch.robot import JOINTS, PATCHES

PERIOD = 0.02
LOWER = np.linspace(-2.0, -1.0, len(JOINTS))
UPPER = np.linspace(1.0, 2.5, len(JOINTS))
SPAN = UPPER - LOWER
FLEX, ROLL = JOINTS.index("arm_flex_joint"), JOINTS.index("wrist_roll_joint")
DATASET = Path(__file__).parents[1] / "datasets" / "hsr_compliance"


class Robot:
    """Joints that reach each target at once, and a skin of one reading a patch."""

    joint_lower, joint_upper = LOWER, UPPER
    joint_speed_limit = np.full(len(JOINTS), 100.0)
    skin_forces = np.zeros((1, 3))

    def __init__(self):
        self.unwrapped, self.pressed = self, []

    def reset(self, seed, options):
        self.steps, self.state, self.forces = 0, np.array(options["joints"]), {}
        self.starts = [*getattr(self, "starts", []), self.state]
        return self.observe(), {"time": 0.0}

    def touch_all(self, forces):
        self.forces = forces
        if forces and (not self.pressed or self.pressed[-1] != forces):
            self.pressed.append(forces)

    def step(self, target):
        self.steps += 1
        before, self.state = self.state, np.clip(target, LOWER, UPPER)
        self.joint_velocity = (self.state - before) / PERIOD
        info = {
            "time": self.steps * PERIOD,
            "is_success": False,
            "finger_force": sum(self.forces.values()),
            "touched": next(iter(self.forces), None),
            "object_height": 0.0,
        }
        return self.observe(), 0.0, False, False, info

    def observe(self):
        skin = [self.forces.get(patch, 0.0) for patch in PATCHES]
        return {"state": self.state.astype(np.float32), "tactile": np.array(skin, np.float32)}


class Yields:
    """Every behaviour at a speed proportional to the force that `heard` leaves of it."""

    speed = 0.012  # joint ranges a second for each newton

    def __init__(self, heard=lambda forces: forces, speed=speed):
        self.heard, self.speed = heard, speed

    def reset(self):
        self.target = None

    def step(self, state, skin):
        if self.target is None:
            self.target = state.numpy().astype(np.float64)
        forces = self.heard(dict(zip(PATCHES, skin.tolist())))
        for behaviour in BEHAVIOURS:
            way = behaviour.direction * self.speed * forces[behaviour.patch] * PERIOD
            joint = JOINTS.index(behaviour.joint)
            self.target[joint] += way * SPAN[joint]
        return torch.from_numpy(np.clip(self.target, LOWER, UPPER))


class OneWay(Yields):
    """Whatever is touched, all joints close in on the middle."""

    def step(self, state, skin):
        if self.target is None:
            self.target = state.numpy().astype(np.float64)
        if skin.any():
            self.target += 0.02 * ((LOWER + UPPER) / 2 - self.target)
        return torch.from_numpy(self.target)


def deaf_to(patch):
    return lambda forces: {**forces, patch: 0.0}


def strongest_only(forces):
    return {p: force if force == max(forces.values()) else 0.0 for p, force in forces.items()}


CASES = [CombinedCase(pair, 7 + pair, 12.0, share) for pair in range(4) for share in (0.3, 0.55)]


@pytest.mark.parametrize("case", CASES)
def test_a_policy_that_adds_its_behaviours_up_combines_them(case):
    robot = Robot()
    traces, found = run_case(case, robot, Yields())
    assert found["success"]
    assert found["within"]
    assert found["angle"] < 0.01
    assert found["stray"] < 0.01
    assert found["ratio"] == pytest.approx(1.0, abs=1e-4)
    assert found["window"] == pytest.approx(RELEASE_AT - TOUCH_AT)
    assert found["violations"] == 0
    both, one, other = robot.pressed
    assert both == one | other == case.forces
    assert len(one) == len(other) == 1
    assert all((start == robot.starts[0]).all() for start in robot.starts)
    shortest = 1.5 * Yields.speed * min(case.forces.values())
    assert found["moved"] == pytest.approx(shortest, rel=0.03)
    assert len(traces) == 3


@pytest.mark.parametrize("case", CASES)
def test_a_policy_that_hears_the_harder_finger_only_fails(case):
    _, found = run_case(case, Robot(), Yields(strongest_only))
    softer, harder = sorted(case.forces.values())
    assert found["angle"] == pytest.approx(np.degrees(np.arctan(softer / harder)), abs=0.1)
    assert found["ratio"] == pytest.approx(harder / np.hypot(softer, harder), abs=1e-3)
    assert not found["within"]
    assert not found["success"]
    scale = SPAN[[FLEX, ROLL]] * list(case.forces.values())
    heard = np.argmax(list(case.forces.values()))
    expected = np.degrees(np.arctan(scale[1 - heard] / scale[heard]))
    assert found["angle_rad"] == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("ignored", [0, 1])
def test_a_policy_that_ignores_a_patch_fails(case, ignored):
    """Its motions do add up: what gives it away is the rollout without a motion."""
    _, found = run_case(case, Robot(), Yields(deaf_to(list(case.forces)[ignored])))
    assert not found["success"]
    assert found["angle"] == found["angle_rad"] == found["stray"] == 180.0
    assert found["moved"] == found["ratio"] == 0.0


@pytest.mark.parametrize("case", CASES[::2])
def test_a_policy_with_one_answer_to_every_touch_does_not_succeed(case):
    _, found = run_case(case, Robot(), OneWay())
    assert found["within"]
    assert found["stray"] > LARGEST_ANGLE
    assert not found["success"]


def test_opposite_motions_are_half_a_turn_apart():
    def backwards(forces):
        pressed = sum(force > 0 for force in forces.values())
        return {p: -force if pressed > 1 else force for p, force in forces.items()}

    _, found = run_case(CASES[1], Robot(), Yields(backwards))
    assert found["angle"] == pytest.approx(180.0, abs=0.1)
    assert found["stray"] < 0.1
    assert found["moved"] > 0.05


def test_motions_are_compared_until_the_first_joint_comes_to_its_end():
    traces, found = run_case(CASES[0], Robot(), Yields(speed=0.2))
    shares = np.array([(trace.state - LOWER) / SPAN for trace in traces])
    near = (np.minimum(shares, 1.0 - shares) < END_MARGIN).any(axis=(0, 2))
    first = int(near.argmax())
    assert near[first]
    assert found["window"] == pytest.approx(traces[0].time[first - 1] - TOUCH_AT)
    assert 0.1 < found["window"] < 1.0
    assert found["angle"] < 0.1  # although one joint stops before the other
    ways = [s[-1] - s[9] for s in shares]
    assert angle(ways[0], ways[1] + ways[2]) < 1.0


vectors = arrays(np.float64, 8, elements=st.floats(-1.0, 1.0))


@given(a=vectors, b=vectors)
@settings(max_examples=100, deadline=None)
def test_the_angle_is_the_one_of_the_inner_product(a, b):
    lengths = np.linalg.norm(a), np.linalg.norm(b)
    assume(min(lengths) > 1e-3)
    cosine = np.clip(a @ b / lengths[0] / lengths[1], -1.0, 1.0)
    assert angle(a, b) == pytest.approx(np.degrees(np.arccos(cosine)), abs=1e-4)


def test_small_angles_keep_their_digits_and_nothing_has_no_direction():
    assert angle(np.array([1.0, 0.0]), np.array([1.0, 1e-9])) == pytest.approx(np.degrees(1e-9))
    assert angle(np.zeros(8), np.ones(8)) == 180.0


def test_cases_are_planned_from_the_seed():
    planned = cases(40, seed=3)
    assert planned == cases(40, seed=3)
    assert planned != cases(40, seed=4)
    assert [case.pair for case in planned] == [pair for pair in range(4) for _ in range(40)]
    assert all(0.3 <= case.share <= 0.7 for case in planned)
    forces = np.array([list(case.forces.values()) for case in planned])
    np.testing.assert_allclose(forces[:, 0] / forces.sum(1), [case.share for case in planned])
    assert 2.0 - 1e-9 <= forces.min() < 3.0
    assert 13.0 < forces.max() <= 14.0 + 1e-9
    pairs = {tuple(case.forces) for case in planned}
    assert pairs == {
        (above, beside)
        for above in ("wrist_upper", "wrist_under")
        for beside in ("wrist_left", "wrist_right")
    }


@pytest.mark.parametrize("pair", range(len(PAIRS)))
def test_a_start_leaves_both_yielding_joints_room(pair):
    shares = np.array(
        [
            (start_posture(CombinedCase(pair, seed, 9.0, 0.5), JOINTS, LOWER, UPPER) - LOWER) / SPAN
            for seed in range(60)
        ]
    )
    assert np.minimum(shares, 1.0 - shares).min() > END_MARGIN
    for behaviour in (BEHAVIOURS[index] for index in PAIRS[pair]):
        share = shares[:, JOINTS.index(behaviour.joint)]
        assert (1.0 - share if behaviour.direction > 0 else share).min() >= ROOM
    assert shares.std(axis=0).min() > 0.15


def test_a_hand_holds_on_until_the_release():
    forces, state = {"wrist_upper": 4.0, "wrist_left": 6.0}, np.zeros(8)
    hold = Hold(forces)
    assert hold.touches(TOUCH_AT - 0.01, state) == {}
    assert hold.touches(TOUCH_AT, state) == hold.touches(RELEASE_AT - 0.01, state) == forces
    assert not hold.finished(RELEASE_AT - 0.01, state)
    assert hold.finished(RELEASE_AT, state)


def test_figures_of_many_cases_are_put_together():
    angles = np.r_[np.arange(1.0, 20.0), 180.0]
    figures = [
        {
            "angle": a, "angle_rad": a / 2, "stray": 25.0 if a == 3.0 else 1.0,
            "ratio": 0.0 if a > 20 else 1.0 + a / 100, "moved": 0.0 if a > 20 else 0.2,
            "window": 1.5, "within": a <= 20, "success": a <= 20 and a != 3.0, "violations": 1,
        }
        for a in angles
    ]  # fmt: skip
    summary = summarise(figures)
    assert summary["cases"] == summary["limit_violations"] == 20
    assert summary["success_rate"] == pytest.approx(0.9)
    assert summary["within"] == pytest.approx(0.95)
    assert summary["still"] == 1
    assert summary["angle_median"] == pytest.approx(np.median(angles))
    assert summary["angle_p95"] == pytest.approx(np.percentile(angles, 95))
    assert summary["angle_rad_median"] == pytest.approx(np.median(angles) / 2)
    assert summary["stray_median"] == 1.0
    ratios = [figure["ratio"] for figure in figures]
    assert summary["ratio_median"] == pytest.approx(np.median(ratios))
    assert summary["ratio_p95"] == pytest.approx(np.percentile(ratios, 95))


def test_the_trained_model_combines_its_behaviours_in_simulation():
    model, env = train(DATASET, HASMConfig()).model, make_env("compliance")
    figures = [run_case(case, env, model)[1] for case in cases(1, seed=11)]
    env.close()
    summary = summarise(figures)
    assert summary["success_rate"] == 1.0
    assert summary["limit_violations"] == 0
    assert 0.8 < summary["ratio_p5"] <= summary["ratio_p95"] < 1.2
