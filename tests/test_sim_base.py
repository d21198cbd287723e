"""The mobile base, joints that are held, and what fingers tell: points and forces in odom."""

import numpy as np
import pytest
import torch
from postures import anywhere

from hasm_torch.robot import BASE_FRAME, JOINTS, Kinematics
from hasm_torch.sim import HSRTouchEnv
from hasm_torch.sim.scene import OBJECT_HALF_SIZE, OBJECT_POSITION, TABLE_HEIGHT

BASE = slice(8, 11)
HSR = Kinematics()


@pytest.fixture(scope="module")
def env():
    env = HSRTouchEnv("compliance")
    yield env
    env.close()


@pytest.fixture(scope="module")
def grasp():
    env = HSRTouchEnv("grasp")
    yield env
    env.close()


def test_the_base_goes_to_its_target_as_fast_as_it_may(env):
    start = env.reset(seed=0)[0]["state"].astype(np.float64)
    for goal in ([0.4, -0.4, 2.0], [-0.2, 0.3, -1.0]):
        target = np.r_[start[:8], goal]
        distance, fastest = np.abs(env.joint_position - target)[BASE], np.zeros(3)
        ticks = 0
        while np.abs(env.joint_position - target).max() > 1e-3:
            *_, info = env.step(target)
            fastest = np.maximum(fastest, np.abs(env.joint_velocity[BASE]))
            ticks += 1
            assert np.abs(env.joint_position - target)[:8].max() < 5e-3  # the arm stays
        limit = env.joint_speed_limit[BASE]
        assert (fastest <= limit).all()
        assert (fastest > 0.94 * limit).all()
        assert ticks / 50 < (distance / limit).max() / 0.95 + 0.4
        assert info["finger_force"] == 0.0


def test_the_base_stands_firm_in_a_push(env):
    hold = env.reset(seed=0)[0]["state"]
    for patch in ("torso_front", "torso_left", "torso_right", "wrist_under"):
        env.touch(patch, 14.0)
        for _ in range(20):
            env.step(hold)
        assert np.abs(env.joint_position - hold)[BASE].max() < 1e-3


def test_where_the_object_is_turns_with_the_base(grasp):
    options = {"joints": np.r_[np.zeros(8), 0.3, -0.2, 0.0], "object": (0.02, -0.03)}
    observation, _ = grasp.reset(seed=0, options=options)
    x, y = OBJECT_POSITION
    place = np.array([x + 0.02, y - 0.03, TABLE_HEIGHT + OBJECT_HALF_SIZE[2]])
    seen = observation["environment_state"]
    assert seen.dtype == np.float32
    assert observation["state"][8] == pytest.approx(0.3)
    np.testing.assert_allclose(seen, place - [0.3, -0.2, 0.0], atol=1e-6)
    target = np.r_[np.zeros(8), -0.1, 0.1, 1.5]
    for _ in range(150):
        observation, *_ = grasp.step(target)
        assert grasp.observation_space.contains(observation)
        pose = HSR.forward(torch.from_numpy(grasp.joint_position))[BASE_FRAME].numpy()
        expected = pose[:3, :3].T @ (grasp.object_position - pose[:3, 3])
        np.testing.assert_allclose(observation["environment_state"], expected, atol=1e-5)
    np.testing.assert_allclose(grasp.object_position, place, atol=1e-3)  # it did not move itself
    turn = np.array([[np.cos(1.5), np.sin(1.5)], [-np.sin(1.5), np.cos(1.5)]])
    expected = turn @ (place[:2] - [-0.1, 0.1])
    np.testing.assert_allclose(observation["environment_state"][:2], expected, atol=2e-3)


@pytest.mark.parametrize("offset", [(x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
def test_far_objects_stand_on_the_table(grasp, offset):
    hold = grasp.reset(seed=0, options={"object": offset})[0]["state"]
    place = grasp.object_position
    for _ in range(50):
        *_, info = grasp.step(hold)
    np.testing.assert_allclose(grasp.object_position, place, atol=1e-3)
    assert abs(info["object_height"]) < 1e-3


def test_blocked_joints_stay_and_go_on_when_let_go(env):
    held = [JOINTS.index(name) for name in ("arm_flex_joint", "wrist_roll_joint", "odom_x")]
    start = env.reset(seed=0)[0]["state"].astype(np.float64)
    target = start + 0.4
    env.touch("wrist_upper", 6.0)
    for _ in range(15):
        env.step(target)
    assert np.abs(env.joint_velocity[held]).min() > 0.1  # caught in full motion
    before = env.joint_position
    for tick in range(100):
        env.block([JOINTS[index] for index in held])  # said again, it is the same place
        env.step(target)
        assert np.abs(env.joint_position - before)[held].max() < 0.08  # braking from full speed
        assert (np.abs(env.joint_velocity) <= env.joint_speed_limit).all()
        if tick == 15:
            caught = env.joint_position
        if tick > 15:
            assert np.abs(env.joint_position - caught)[held].max() < 2e-3
            assert np.abs(env.joint_velocity[held]).max() < 5e-3
    free = np.delete(np.arange(11), held)
    np.testing.assert_allclose(env.joint_position[free], target[free], atol=5e-3)
    env.block([])
    for _ in range(150):
        env.step(target)
        assert (np.abs(env.joint_velocity) <= env.joint_speed_limit).all()
    np.testing.assert_allclose(env.joint_position, target, atol=5e-3)


def test_a_reset_lets_blocked_joints_go(env):
    env.block(JOINTS)
    target = env.reset(seed=0)[0]["state"] + np.float32(0.1)
    for _ in range(100):
        env.step(target)
    np.testing.assert_allclose(env.joint_position, target, atol=5e-3)
    with pytest.raises(ValueError, match=r"joints to block must be of .*odom_t.* got \['elbow'\]"):
        env.block(["odom_t", "elbow"])


@pytest.mark.parametrize("seed", range(4))
def test_touch_points_are_of_the_skin_and_their_forces_are_real(env, seed):
    """While arm and base move: points by forward kinematics, forces along the normals."""
    rng = np.random.default_rng(seed)
    start = anywhere(rng)
    env.reset(seed=0, options={"joints": start})
    touches = {"wrist_left": (9.0, 3), "torso_front": (4.0, None)}
    env.touch_all(touches)
    assert env.touch_points() == []
    target = start + rng.choice([-0.3, 0.3], 11)
    for tick in range(60):
        *_, info = env.step(target)
        positions, normals = env.skin.poses(HSR, torch.from_numpy(env.joint_position))
        found = env.touch_points()
        assert [(point.patch, point.cell) for point in found] == [
            (patch, cell) for patch, (_, cell) in touches.items()
        ]
        for (_, cell, force, point), (patch, (wanted, _)) in zip(found, touches.items()):
            span = env.skin.slices[patch]
            place = positions[span].mean(0) if cell is None else positions[span][cell]
            np.testing.assert_allclose(point, place.numpy(), atol=2e-5)
            felt = env.skin_forces[span].sum()
            assert np.linalg.norm(force) == pytest.approx(felt, abs=1e-6)
            if tick >= 5:
                assert felt == pytest.approx(wanted, abs=0.3)
                along = -force @ normals[span][0].numpy() / felt
                assert along > 0.999
        if tick == 0:  # the fingers are still on their way
            assert info["finger_force"] == 0.0
            assert not np.any([point.force for point in found])
    env.touch_all({"wrist_left": 0.0})
    env.step(target)
    assert env.touch_points() == []


def test_two_fingers_on_two_cells(env):
    hold = env.reset(seed=0)[0]["state"]
    env.touch_all({"wrist_upper": (5.0, 2), "wrist_right": (7.0, 6)})
    for _ in range(8):
        env.step(hold)
    for patch, cell, force in (("wrist_upper", 2, 5.0), ("wrist_right", 6, 7.0)):
        cells = env.skin_forces[env.skin.slices[patch]].sum(1)
        assert cells.argmax() == cell
        assert cells.sum() == pytest.approx(force, abs=0.1)
    with pytest.raises(ValueError, match="cell of wrist_right must be 0 to 6, got 7"):
        env.touch_all({"wrist_right": (7.0, 7)})
