"""The environment in LeRobot: the human's touches, what counts as success, vector forms."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.configs import FeatureType
from lerobot.envs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

from hasm_torch.episode import ENVIRONMENT
from hasm_torch.lerobot.env_hsr_touch import GYM_ID, TASKS, HSRTouchConfig
from hasm_torch.lerobot.human_env import HumanTouchEnv
from hasm_torch.robot import JOINTS
from hasm_torch.sim.teacher import ComplianceTeacher, GraspTeacher, YieldTeacher

JOINT = {"arm": JOINTS.index("arm_flex_joint"), "wrist": JOINTS.index("wrist_roll_joint")}
RIGHT_WAY = {"arm_down": -1, "arm_up": 1, "wrist_left": 1, "wrist_right": -1}
LAWS = {"arm_down": ComplianceTeacher, "yield": YieldTeacher, "torso": YieldTeacher,
        "grasp": GraspTeacher}  # fmt: skip


def run(env, turned=0, way=0, other=0.0, seed=0):
    """Roll out a target that holds still, but turns joints while the finger pushes.

    Returns:
        The infos of all steps and the last reward.
    """
    observation, info = env.reset(seed=seed)
    target = observation["state"].copy()
    infos, ended = [info], False
    while not ended:
        if infos[-1]["finger_force"] > 0.1:
            target[turned] += 0.01 * way
            target[JOINTS.index("head_pan_joint")] += other
        target = np.clip(target, env.sim.joint_lower, env.sim.joint_upper).astype(np.float32)
        observation, reward, ended, truncated, info = env.step(target)
        assert not truncated
        infos.append(info)
    return infos, reward


def follow(env, law, seed):
    """Roll a teaching law out; the infos of all steps."""
    observation, info = env.reset(seed=seed)
    law.reset()
    infos, ended = [info], False
    while not ended:
        state, skin = (
            torch.from_numpy(observation["state"]),
            torch.from_numpy(observation["tactile"]),
        )
        observation, _, ended, _, info = env.step(law.step(state, skin).numpy())
        infos.append(info)
    return infos


@pytest.mark.parametrize(
    ("task", "seeds"), [("arm_down", 2), ("yield", 4), ("torso", 2), ("grasp", 1)]
)
def test_a_law_that_was_taught_succeeds_and_holding_still_does_not(task, seeds):
    env = HumanTouchEnv(task)
    law = LAWS[task](env.sim)
    for seed in range(seeds):
        infos = follow(env, law, seed)
        assert infos[-1]["is_success"]
        assert len(infos) <= env._max_episode_steps
        assert max(info["finger_force"] for info in infos) > 1.0
    if task != "grasp":
        assert not run(env, seed=0)[0][-1]["is_success"]


@pytest.mark.parametrize("task", ["wrist_left", "yield", "grasp"])
def test_gymnasium_finds_no_fault(task):
    check_env(gym.make(GYM_ID, task=task).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("task", TASKS[:4])
def test_success_is_the_right_joint_going_the_right_way(task):
    joint, way = JOINT[task.split("_")[0]], RIGHT_WAY[task]
    env = HumanTouchEnv(task)
    infos, reward = run(env, joint, way)
    assert infos[-1]["is_success"]
    assert reward == 1.0
    assert not any(info["is_success"] for info in infos[:-1])
    assert max(info["finger_force"] for info in infos) > 1.0
    for motion in ((joint, 0), (joint, -way), (joint, way, 0.002)):
        infos, reward = run(env, *motion)
        assert not any(info["is_success"] for info in infos)
        assert reward == 0.0


def test_grasp_without_a_policy_fails_when_the_human_gives_up():
    env = HumanTouchEnv("grasp")
    infos, _ = run(env)
    assert not infos[-1]["is_success"]
    assert 5.0 < infos[-1]["time"] < 60.0
    assert len(infos) <= env._max_episode_steps


def test_seed_decides_the_episode():
    def start(env, seed):
        observation, _ = env.reset(seed=seed, options={"lerobot_new_rollout": True})
        return np.concatenate([observation["state"], [env._human.force]])

    env, other = HumanTouchEnv("grasp"), HumanTouchEnv("grasp")
    assert np.array_equal(start(env, 3), start(other, 3))
    assert not np.array_equal(start(env, 3), start(env, 4))
    first = start(env, 3)
    env.step(first[:-1])
    assert not np.array_equal(start(env, None), first)


def test_force_can_be_set():
    env = HumanTouchEnv("arm_up", force=5.0)
    infos, _ = run(env)
    assert np.median([i["finger_force"] for i in infos if i["finger_force"] > 0]) == pytest.approx(
        5.0, abs=0.3
    )


def test_unknown_task_names_the_valid_ones():
    with pytest.raises(ValueError, match=r"'juggle', valid: arm_down, arm_up"):
        HumanTouchEnv("juggle")
    with pytest.raises(ValueError, match="valid: arm_down"):
        HSRTouchConfig(task="juggle")


def test_video_stays_black_without_opengl(monkeypatch):
    env = HumanTouchEnv("arm_down")
    env.reset(seed=0)

    def broken():
        raise RuntimeError("no OpenGL")

    monkeypatch.setattr(env.sim, "render", broken)
    with pytest.warns(UserWarning, match="black: no OpenGL"):
        picture = env.render()
    assert picture.shape == (480, 640, 3)
    assert picture.dtype == np.uint8
    assert picture.max() == 0


def test_picture_is_drawn_every_fifth_step(monkeypatch):
    env = HumanTouchEnv("arm_down")
    drawn = []
    monkeypatch.setattr(env.sim, "render", lambda: drawn.append(1) or np.zeros((4, 4, 3)))
    observation, _ = env.reset(seed=0)
    for _ in range(11):
        env.render()
        env.step(observation["state"])
    assert len(drawn) == 3


def test_lerobot_makes_it_and_reads_its_observations():
    config = EnvConfig.get_choice_class("hsr_touch")(task="wrist_right")
    (env,) = make_env(config, n_envs=2)["hsr_touch"].values()
    observation, _ = env.reset(seed=[5, 6], options={"lerobot_new_rollout": True})
    single = HumanTouchEnv("wrist_right")
    alone, _ = single.reset(seed=6)
    read = preprocess_observation(observation)
    features = env_to_policy_features(config)
    assert set(features) == {"action", "observation.state", "observation.tactile"}
    for key, name in (("observation.state", "state"), ("observation.tactile", "tactile")):
        assert read[key].shape == (2, *features[key].shape)
        assert np.array_equal(read[key][1].numpy(), alone[name])
    assert env.call("_max_episode_steps") == (131, 131)
    assert env.call("task_description")[0] == "turn the wrist at its right side"
    env.close()


def test_a_grasp_also_observes_the_object():
    features = env_to_policy_features(HSRTouchConfig(task="grasp"))
    assert (features[ENVIRONMENT].type, features[ENVIRONMENT].shape) == (FeatureType.ENV, (3,))
    env = HumanTouchEnv("grasp")
    observation, _ = env.reset(seed=0)
    read = preprocess_observation(observation)
    assert set(read) == {key for key in features if key != "action"}
    place = read[ENVIRONMENT][0].numpy()  # the base stands at the origin of odom
    np.testing.assert_allclose(place, env.sim.object_position, atol=1e-5)
    other, _ = env.reset(seed=1)
    assert np.abs(other["environment_state"] - place)[:2].max() > 1e-3


def test_separate_processes_agree_with_one_process():
    config = HSRTouchConfig(task="arm_down")
    results = []
    for asynchronous in (False, True):
        (env,) = make_env(config, n_envs=2, use_async_envs=asynchronous)["hsr_touch"].values()
        observation, _ = env.reset(seed=[1, 2])
        for _ in range(20):
            observation, *_ = env.step(observation["state"])
        results.append(observation)
        env.close()
    for key, values in results[0].items():
        assert np.array_equal(values, results[1][key])
