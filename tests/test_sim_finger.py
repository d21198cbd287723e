import numpy as np
import pytest

from hasm_torch.robot import JOINTS, PATCHES
from hasm_torch.sim import HSRTouchEnv


@pytest.fixture(scope="module")
def env():
    env = HSRTouchEnv("compliance")
    yield env
    env.close()


def moving_targets(env, seconds, speed):
    """Targets of a start posture and of arm and base swaying at up to `speed` rad/s."""
    middle = np.array([0.3, -1.2, 0.4, -0.4, 0.6, 0.0, -0.3, 0.6, 0.0, 0.0, 0.0])
    sway = np.array([0.0, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.0, 0.1, 0.1, 0.3])
    for tick in range(round(seconds * 50)):
        yield middle + sway * np.sin(speed / 0.3 * tick / 50)


@pytest.mark.parametrize("patch", PATCHES)
@pytest.mark.parametrize("force", [2.0, 14.0])
def test_set_force_is_kept_while_the_arm_moves(env, patch, force):
    targets = list(moving_targets(env, 3.0, 0.5))
    env.reset(seed=0, options={"joints": targets[0]})
    env.touch(patch, force)
    errors, speed = [], 0.0
    for tick, target in enumerate(targets):
        *_, info = env.step(target)
        speed = max(speed, env.joint_velocity[JOINTS.index("arm_flex_joint")])
        if tick >= 5:
            errors.append(info["finger_force"] - force)
            assert info["touched"] == patch
    assert speed > 0.4
    assert np.sqrt(np.mean(np.square(errors))) < 0.5


@pytest.mark.parametrize("force", [0.5, 15.0])
def test_contact_comes_within_three_ticks_and_ends_within_one(env, force):
    targets = list(moving_targets(env, 2.0, 0.5))
    env.reset(seed=0, options={"joints": targets[0]})
    forces = []
    for tick, target in enumerate(targets):
        if tick == 40:
            env.touch("wrist_upper", force)
        if tick == 70:
            env.touch(None)
        forces.append(env.step(target)[-1]["finger_force"])
    assert not any(forces[:40])
    assert all(forces[42:70])
    assert not any(forces[70:])
    np.testing.assert_allclose(forces[69], force, rtol=0.1)


def test_a_new_force_is_there_in_the_next_tick(env):
    observation, _ = env.reset(seed=0)
    for force in (4.0, 12.0, 6.0):
        env.touch("wrist_left", force)
        for _ in range(6):
            *_, info = env.step(observation["state"])
        np.testing.assert_allclose(info["finger_force"], force, atol=0.02)


def test_going_around_the_robot_touches_no_other_patch(env):
    observation, _ = env.reset(seed=0)
    for patch in (*PATCHES, *PATCHES[::-1]):
        env.touch(patch, 8.0)
        for _ in range(4):
            *_, info = env.step(observation["state"])
            assert info["touched"] in (None, patch)
            outside = np.delete(env.skin_forces, np.r_[env.skin.slices[patch]], axis=0)
            assert not outside.any()
        assert info["touched"] == patch


def test_going_to_another_cell_neither_jerks_nor_presses_harder(env):
    observation, _ = env.reset(seed=0)
    span = env.skin.slices["wrist_upper"]
    for cell in (0, 6, 3, 1):
        env.touch("wrist_upper", 8.0, cell=cell)
        for tick in range(6):
            *_, info = env.step(observation["state"])
            assert info["finger_force"] < 8.8
            if tick >= 3:
                assert env.skin_forces.sum(1).argmax() == span.start + cell
        np.testing.assert_allclose(info["finger_force"], 8.0, atol=0.02)


def test_zero_force_is_no_touch(env):
    observation, _ = env.reset(seed=0)
    env.touch("wrist_left", 5.0)
    for _ in range(5):
        env.step(observation["state"])
    env.touch("wrist_left", 0.0)
    for _ in range(5):
        *_, info = env.step(observation["state"])
        assert info["finger_force"] == 0.0
        assert info["touched"] is None


def test_a_push_moves_the_arm_against_the_skin_and_by_little(env):
    observation, _ = env.reset(seed=0)
    hold = observation["state"].astype(np.float64)
    for _ in range(20):
        env.step(hold)
    before = env.joint_position
    env.touch("wrist_upper", 14.0)
    for _ in range(30):
        env.step(hold)
    moved = env.joint_position - before
    # From above: flexing joints turn down, that is towards negative angles.
    assert moved[JOINTS.index("arm_flex_joint")] < -1e-4
    assert np.abs(moved).max() < 0.005
