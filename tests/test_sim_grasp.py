import numpy as np
import pytest

from hasm_torch.sim import HSRTouchEnv
from hasm_torch.sim.tasks import GRASP_POSES, START_POSES

SECONDS = {"before": 3.0, "around": 1.5, "closed": 1.2, "lifted": 2.5}
HAND = 7


@pytest.fixture(scope="module")
def env():
    env = HSRTouchEnv("grasp")
    yield env
    env.close()


def grasp(env, seed, close=True, hold_where_closed=False):
    """Follows the poses one after the other; returns the last info."""
    rng = np.random.default_rng(seed)
    spread = np.array([0.01, *[0.05] * 7, 0.0, 0.0, 0.0])
    start = np.array(START_POSES["grasp"]) + rng.uniform(-1, 1, 11) * spread
    options = {"joints": start, "object": rng.uniform(-0.01, 0.01, 2)}
    env.reset(seed=seed, options=options)
    place = env.object_position
    last = env.joint_position
    hand = None
    for name, seconds in SECONDS.items():
        pose = np.array(GRASP_POSES[name])
        if not close:
            pose[HAND] = GRASP_POSES["around"][HAND]
        if hand is not None:
            pose[HAND] = hand
        ticks = round(seconds * 50)
        for tick in range(1, ticks + 1):
            share = tick / ticks
            *_, info = env.step(last + (pose - last) * share**2 * (3 - 2 * share))
            assert (np.abs(env.joint_velocity) <= env.joint_speed_limit).all()
        if name == "around":
            assert np.linalg.norm(env.object_position - place) < 1e-3  # nothing was hit
            assert not info["is_success"]
        if name == "closed" and hold_where_closed:
            hand = pose[HAND] = env.joint_position[HAND]
        last = pose
    return last, info


@pytest.mark.parametrize("seed", range(4))
def test_the_scripted_grasp_lifts_and_holds_the_object(env, seed):
    pose, info = grasp(env, seed)
    assert info["is_success"]
    assert info["object_height"] > 0.15
    before = env.object_position
    for _ in range(100):
        *_, info = env.step(pose)
    assert np.linalg.norm(env.object_position - before) < 1e-3
    assert info["is_success"]


def test_the_grip_lasts_when_the_target_is_the_measured_opening(env):
    _, info = grasp(env, 4, hold_where_closed=True)
    assert info["is_success"]


def test_without_closing_nothing_is_lifted(env):
    _, info = grasp(env, 5, close=False)
    assert not info["is_success"]
    assert abs(info["object_height"]) < 1e-3


def test_the_object_falls_when_the_hand_opens(env):
    pose, _ = grasp(env, 6)
    pose[HAND] = 1.2
    for _ in range(100):
        *_, info = env.step(pose)
        assert (np.abs(env.joint_velocity) <= env.joint_speed_limit).all()
    assert not info["is_success"]
