"""The bundled recordings: whole, in LeRobot's layout, and what the simulation gives."""

import json
from pathlib import Path

import numpy as np
import pytest

from hasm_torch.data.episodes import load_episodes
from hasm_torch.episode import ENVIRONMENT
from hasm_torch.robot import JOINTS, METRES, PATCHES, Skin
from hasm_torch.sim.demonstrator import compliance_episodes, grasp_episodes, yield_episodes
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv
from hasm_torch.sim.scene import OBJECT_POSITION
from hasm_torch.sim.tasks import (
    BEHAVIOURS,
    GRASP,
    GRASP_PATCH,
    OBJECT_PLACES,
    PUSH_SECONDS,
    REACH_PATCH,
    TEACHING_FORCE,
    TORSO_PATCHES,
    TREMOR,
    WRIST_PATCHES,
    YIELD_TORSO,
    YIELD_WRIST,
)

DATASETS = Path(__file__).parents[1] / "datasets"
EPISODES = {"hsr_yield": 92, "hsr_compliance": 12, "hsr_grasp": 25}
TEACHING = {
    "hsr_yield": lambda generator: yield_episodes(2, torso=False, generator=generator),
    "hsr_compliance": compliance_episodes,
    "hsr_grasp": lambda generator: grasp_episodes(generator, OBJECT_PLACES[:2]),
}
ARM, HEAD_AND_HAND, BASE = slice(0, 5), slice(5, 8), slice(8, 11)


@pytest.fixture(scope="module", params=EPISODES)
def recorded(request):
    return request.param, load_episodes(DATASETS / request.param)


@pytest.fixture(scope="module")
def yields():
    return load_episodes(DATASETS / "hsr_yield").episodes


@pytest.fixture(scope="module")
def grasps():
    return load_episodes(DATASETS / "hsr_grasp").episodes


def felt(episode):
    """Force on every patch, (T, patches), N."""
    slices = Skin.load().slices
    return np.stack([episode.tactile[:, slices[p]].sum((1, 2)) for p in PATCHES], axis=1)


def test_layout_is_lerobots_version_3(recorded):
    name, data = recorded
    info = json.loads((DATASETS / name / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["total_episodes"] == len(data) == EPISODES[name]
    assert info["total_frames"] == sum(len(episode) for episode in data)
    assert info["fps"] == data.fps == CONTROL_RATE
    assert info["features"]["observation.state"]["shape"] == [len(JOINTS)]
    assert info["features"]["action"]["shape"] == [len(JOINTS)]
    assert info["features"]["observation.tactile"]["shape"] == [3 * Skin.load().cells]
    assert data.observations == ({ENVIRONMENT: 3} if name == "hsr_grasp" else {})
    for path in ("meta/stats.json", "meta/tasks.parquet", "README.md",
                 "meta/episodes/chunk-000/file-000.parquet",
                 "data/chunk-000/file-000.parquet"):  # fmt: skip
        assert (DATASETS / name / path).is_file()


def test_recordings_are_small():
    files = [path for path in DATASETS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 9e6


def test_body_and_skin_are_the_robots(recorded):
    _, data = recorded
    assert data.joints == data.action_names == JOINTS
    assert data.units == tuple("m" if joint in METRES else "rad" for joint in JOINTS)
    skin = Skin.load()
    assert list(data.skin) == list(PATCHES)
    for name, patch in data.skin.items():
        assert patch.cells == skin.slices[name]
        assert patch.link == skin.link[name]
        np.testing.assert_allclose(patch.normals, skin.normals[skin.slices[name]])


def test_values_are_finite_and_possible(recorded):
    _, data = recorded
    env = HSRTouchEnv("compliance")
    for index, episode in enumerate(data):
        assert episode.index == index
        np.testing.assert_allclose(np.diff(episode.time), 1 / CONTROL_RATE, atol=1e-4)
        for positions in (episode.state, episode.action):
            assert np.isfinite(positions).all()
            assert (positions >= env.joint_lower - 1e-6).all()
            assert (positions <= env.joint_upper + 1e-6).all()
        assert np.isfinite(episode.tactile).all()
        assert episode.tactile.min() >= 0.0
        assert felt(episode)[:5].max() == 0.0  # untouched at first
    env.close()


def test_the_joints_followed_what_they_were_asked(recorded):
    _, data = recorded
    for episode in data:
        lag = np.abs(episode.action - episode.state)
        lag[:, JOINTS.index("hand_motor_joint")] = 0.0  # the hand stops at the object
        assert lag.max() < 0.15


def test_one_force_teaches_everything(recorded):
    name, data = recorded
    pressed = np.concatenate([felt(episode).sum(axis=1) for episode in data])
    pressed = pressed[pressed > 0.5]
    assert np.median(pressed) == pytest.approx(TEACHING_FORCE, abs=0.1)
    width = TREMOR if name == "hsr_yield" else 0.0
    low, high = np.quantile(pressed, (0.05, 0.95)) / TEACHING_FORCE
    assert 1 - width - 0.05 < low < high < 1 + width + 0.05


def test_every_yield_episode_pushes_its_patches_once(yields):
    assert [e.task for e in yields] == [YIELD_WRIST] * 80 + [YIELD_TORSO] * 12
    seconds = []
    for episode in yields:
        patches = WRIST_PATCHES if episode.task == YIELD_WRIST else TORSO_PATCHES
        pressed = felt(episode) > 0.0
        assert {PATCHES[i] for i in np.flatnonzero(pressed.any(axis=0))} == set(patches)
        begins = (np.diff(pressed.astype(int), axis=0) > 0).sum(axis=0)
        assert begins.max() == 1
        seconds += list(pressed.sum(axis=0)[pressed.any(axis=0)] / CONTROL_RATE)
    assert PUSH_SECONDS - 0.06 < min(seconds) <= max(seconds) <= PUSH_SECONDS


def test_the_wrist_leads_the_arm_and_the_torso_the_base(yields):
    for episode in yields:
        led = ARM if episode.task == YIELD_WRIST else slice(8, 10)
        moved = np.ptp(episode.action, axis=0)
        assert moved[led].max() > 0.02
        moved[led] = 0.0
        assert moved.max() == 0.0


def test_yield_starts_anywhere_in_the_ranges(yields):
    env = HSRTouchEnv("compliance")
    starts = np.array([episode.state[0] for episode in yields])
    share = (starts[:, :8] - env.joint_lower[:8]) / (env.joint_upper - env.joint_lower)[:8]
    assert (np.quantile(share, 0.1, axis=0) < 0.25).all()
    assert (np.quantile(share, 0.9, axis=0) > 0.75).all()
    assert np.ptp(starts[:, 10]) > np.pi  # turned anywhere
    env.close()


def test_compliance_shows_every_behaviour_over_its_joints_range():
    data = load_episodes(DATASETS / "hsr_compliance").episodes
    assert [e.task for e in data] == [b.task for b in BEHAVIOURS for _ in range(3)]
    env = HSRTouchEnv("compliance")
    for number, episode in enumerate(data):
        behaviour = BEHAVIOURS[number // 3]
        joint = JOINTS.index(behaviour.joint)
        way = np.ptp(episode.action, axis=0)
        assert way[joint] == pytest.approx((env.joint_upper - env.joint_lower)[joint], abs=0.01)
        assert np.delete(way, joint).max() == 0.0
        assert (episode.action[-1] - episode.action[0])[joint] * behaviour.direction > 0
        twisted = [JOINTS.index(name) for name in ("arm_roll_joint", "wrist_roll_joint")]
        if behaviour.joint == "arm_flex_joint":
            assert not episode.action[:, twisted].any()
    env.close()


def test_grasps_stand_on_the_grid_and_know_the_objects_place(grasps):
    assert [episode.task for episode in grasps] == [GRASP] * len(OBJECT_PLACES)
    for episode, place in zip(grasps, OBJECT_PLACES, strict=True):
        base, seen = episode.state[:, BASE], episode.observations
        cos, sin = np.cos(base[:, 2]), np.sin(base[:, 2])
        x = base[:, 0] + cos * seen[:, 0] - sin * seen[:, 1]
        y = base[:, 1] + sin * seen[:, 0] + cos * seen[:, 1]
        np.testing.assert_allclose((x[0], y[0]), np.add(OBJECT_POSITION, place), atol=1e-4)
        pressed = felt(episode)
        reached = np.flatnonzero(pressed[:, PATCHES.index(REACH_PATCH)])[-1]
        assert np.hypot(x - x[0], y - y[0])[:reached].max() < 0.004  # not knocked over
        assert np.flatnonzero(pressed[:, PATCHES.index(GRASP_PATCH)])[0] > reached
        assert seen[-1, 2] - seen[0, 2] > 0.15  # lifted


def test_the_base_helps_to_reach_what_stands_elsewhere(grasps):
    way = np.array([np.ptp(episode.state[:, BASE], axis=0).max() for episode in grasps])
    far = np.abs(np.array(OBJECT_PLACES)).max(axis=1) > 0.04
    assert (way[far] > 0.02).all()
    assert way[4] < 0.01  # the usual place


@pytest.mark.parametrize("name", EPISODES)
def test_the_first_episodes_are_simulated_again_from_their_seed(name):
    recorded = load_episodes(DATASETS / name).episodes
    for again, before in zip(TEACHING[name](np.random.default_rng(0)), recorded[:2]):
        assert again.task == before.task
        assert len(again) == len(before)
        for column, tolerance in (("time", 1e-4), ("state", 1e-4), ("action", 1e-4),
                                  ("tactile", 0.05), ("observations", 1e-4)):  # fmt: skip
            ours, theirs = getattr(again, column), getattr(before, column)
            if theirs is None:
                assert ours is None
            else:
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance, err_msg=column)


def test_another_seed_teaches_in_other_postures():
    one, other = (next(yield_episodes(1, False, np.random.default_rng(seed))) for seed in (0, 1))
    assert np.abs(one.state[0] - other.state[0]).max() > 0.1
