import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from postures import LOWER, UPPER, anywhere

import hasm_torch.sim  # registers the environment
from hasm_torch.robot import JOINTS, PATCHES, Kinematics
from hasm_torch.sim import HSRTouchEnv
from hasm_torch.sim.scene import SCENES


@pytest.fixture(scope="module", params=SCENES)
def env(request):
    env = HSRTouchEnv(request.param)
    yield env
    env.close()


def roll(env, seed, ticks=60):
    rng = np.random.default_rng(7)
    observation, _ = env.reset(seed=seed)
    seen = [observation]
    for tick in range(ticks):
        if tick % 15 == 0:
            env.touch(PATCHES[tick // 15], 6.0)
            target = anywhere(rng)
        seen.append(env.step(target)[0])
    rows = [np.concatenate([o["state"], o["tactile"]]) for o in seen]
    return np.stack(rows), env.object_position


@pytest.mark.parametrize("scene", SCENES)
def test_gymnasium_accepts_the_environment(scene):
    env = gym.make("hasm_torch/HSRTouch-v0", scene=scene)
    assert env.get_wrapper_attr("_max_episode_steps") == 1500
    assert env.metadata["render_fps"] == 50
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    # The action is a joint target in rad, not a number from -1 to 1, and the base has no limits.
    expected = ("symmetric and normalized", "infinity. This is probably too")
    assert [w for w in caught if not any(text in str(w.message) for text in expected)] == []
    env.close()


def test_the_time_limit_of_make_counts():
    env = gym.make("hasm_torch/HSRTouch-v0", max_episode_steps=3)
    observation, _ = env.reset(seed=0)
    ends = [env.step(observation["state"])[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    env.close()


def test_a_seed_fixes_everything(env):
    first, first_object = roll(env, seed=5)
    again, again_object = roll(env, seed=5)
    np.testing.assert_array_equal(first, again)
    if env.scene == "grasp":
        np.testing.assert_array_equal(first_object, again_object)
        _, other_object = roll(env, seed=6)
        assert not np.array_equal(first_object, other_object)


def test_limits_are_those_of_the_urdf(env):
    joints = [Kinematics().robot.joints[name] for name in JOINTS]
    np.testing.assert_allclose(env.joint_lower, [joint.lower for joint in joints])
    np.testing.assert_allclose(env.joint_upper, [joint.upper for joint in joints])
    # Half of the arm's lift is the torso's, whose limit is half the arm's.
    np.testing.assert_allclose(env.joint_speed_limit, [joint.velocity for joint in joints])


def test_links_are_where_the_kinematics_say(env):
    kinematics = Kinematics()
    rng = np.random.default_rng(1)
    for _ in range(5):
        joints = anywhere(rng)
        env.reset(seed=0, options={"joints": joints})
        poses = kinematics.forward(torch.from_numpy(env.joint_position))
        bodies = {env.model.body(i).name for i in range(env.model.nbody)}
        assert set(env.skin.link.values()) | {"hand_l_distal_link", "head_tilt_link"} <= bodies
        for link in bodies & set(poses):
            position, rotation = env.data.body(link).xpos, env.data.body(link).xmat.reshape(3, 3)
            np.testing.assert_allclose(position, poses[link][:3, 3].numpy(), atol=1e-5)
            np.testing.assert_allclose(rotation, poses[link][:3, :3].numpy(), atol=1e-5)


def test_followers_keep_to_their_rule_while_everything_moves(env):
    rng = np.random.default_rng(2)
    env.reset(seed=0)
    for _ in range(6):
        target = anywhere(rng)
        for _ in range(10):
            env.step(target)
            lift = env.data.joint("arm_lift_joint").qpos[0]
            assert abs(env.data.joint("torso_lift_joint").qpos[0] - lift / 2) < 5e-4
            hand = env.data.joint("hand_motor_joint").qpos[0]
            for side in "lr":
                distal = env.data.joint(f"hand_{side}_distal_joint").qpos[0]
                assert abs(env.data.joint(f"hand_{side}_proximal_joint").qpos[0] - hand) < 5e-3
                assert abs(distal + hand + 0.087) < 5e-3


@pytest.mark.parametrize("seed", range(3))
def test_positions_and_speeds_stay_within_limits(seed, monkeypatch):
    """Targets jump between the limits, pushes come and go: checked in every physics step."""
    env = HSRTouchEnv("compliance")
    rng = np.random.default_rng(seed)
    share = np.zeros(len(JOINTS))
    inside = []

    def watched(step):
        def run(model, data):
            nonlocal share
            step(model, data)
            share = np.maximum(share, np.abs(env.joint_velocity) / env.joint_speed_limit)
            position = env.joint_position
            inside.append(((env.joint_lower <= position) & (position <= env.joint_upper)).all())

        return run

    monkeypatch.setattr(mujoco, "mj_step", watched(mujoco.mj_step))
    monkeypatch.setattr(mujoco, "mj_step2", watched(mujoco.mj_step2))
    env.reset(seed=seed, options={"joints": anywhere(rng)})
    for tick in range(600):
        if tick % 40 == 0:
            ends = np.where(rng.random(len(JOINTS)) < 0.5, LOWER, UPPER)
            inner = anywhere(rng)
            target = np.where(rng.random(len(JOINTS)) < 0.7, ends, inner)
        if tick % 20 == 0:
            env.touch(*((rng.choice(PATCHES), rng.uniform(2, 14)) if tick % 60 else (None, 0.0)))
        observation, *_ = env.step(target)
        assert env.observation_space.contains(observation)
    assert len(inside) == 6000
    assert all(inside)
    assert (share <= 1.0).all()
    assert (share > 0.9).sum() >= 8  # the limits were really put to the test


def test_targets_are_reached_and_held_against_gravity(env):
    target = np.array([0.3, -1.3, 0.5, -0.6, -0.4, 0.3, -0.5, 0.9, 0.4, -0.3, 1.5])
    env.reset(seed=0)
    for _ in range(200):
        env.step(target)
    np.testing.assert_allclose(env.joint_position, target, atol=2e-3)
    np.testing.assert_allclose(env.joint_velocity, 0, atol=1e-3)


def test_targets_beyond_the_limits_are_clipped(env):
    env.reset(seed=0)
    for _ in range(300):
        env.step(np.r_[np.full(8, 100.0), np.zeros(3)])
    np.testing.assert_allclose(env.joint_position[:8], env.joint_upper[:8], atol=4e-3)


def test_options_set_joints_and_object():
    env = HSRTouchEnv("grasp")
    joints = np.array([0.1, -1.0, 0.2, -0.3, 0.4, 0.5, -0.6, 0.7, 0.1, -0.2, 4.0])
    observation, info = env.reset(seed=0, options={"joints": joints, "object": (0.01, -0.02)})
    np.testing.assert_allclose(observation["state"], joints, atol=1e-6)
    moved = env.object_position
    env.reset(seed=0, options={"joints": joints, "object": (0.0, 0.0)})
    np.testing.assert_allclose(moved - env.object_position, [0.01, -0.02, 0.0], atol=1e-12)
    assert abs(info["object_height"]) < 1e-9
    assert info["is_success"] is False


@pytest.mark.parametrize(
    "action",
    [np.full(11, np.nan), np.r_[np.inf, np.zeros(10)], np.zeros(8), np.zeros((1, 11)), 0.0],
)
def test_bad_actions_are_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must"):
        env.step(action)


def test_bad_touches_are_refused(env):
    with pytest.raises(ValueError, match=r"'elbow'") as refused:
        env.touch("elbow", 3.0)
    assert all(patch in str(refused.value) for patch in PATCHES)
    for force in (-1.0, np.nan, np.inf, 1000.0):
        with pytest.raises(ValueError, match="force must be"):
            env.touch("hand", force)
    for cell in (-1, 99):
        with pytest.raises(ValueError, match="cell of hand must be 0 to 4"):
            env.touch("hand", 3.0, cell=cell)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint": np.zeros(11)}, "'joints' and 'object'"),
        ({"joints": np.zeros(5)}, "joints must have shape"),
        ({"joints": np.full(11, np.nan)}, "joints must be finite"),
        ({"object": (0.0, np.inf)}, "object must be finite"),
    ],
)
def test_bad_reset_options_are_refused(env, options, message):
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0, options=options)


def test_bad_construction_is_refused():
    with pytest.raises(ValueError, match="compliance"):
        HSRTouchEnv("kitchen")
    with pytest.raises(ValueError, match="rgb_array"):
        HSRTouchEnv(render_mode="human")
    assert hasm_torch.sim.__all__ == ["HSRTouchEnv"]
