"""The bundled recordings: whole, in LeRobot's layout, and what the simulation gives."""

import json
from pathlib import Path

import numpy as np
import pytest

from hasm_torch.data.episodes import load_episodes
from hasm_torch.robot import JOINTS, PATCHES, Skin
from hasm_torch.sim.demonstrator import TASKS, compliance_episodes, grasp_episodes
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv

DATASETS = Path(__file__).parents[1] / "datasets"
EPISODES = {"hsr_compliance": 12, "hsr_grasp": 6}
FIRST = {
    "hsr_compliance": lambda: next(compliance_episodes()),
    "hsr_grasp": lambda: next(grasp_episodes(count=6, seed=0)),
}


@pytest.fixture(scope="module", params=EPISODES)
def recorded(request):
    return request.param, load_episodes(DATASETS / request.param)


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
    for path in ("meta/stats.json", "meta/tasks.parquet", "README.md",
                 "meta/episodes/chunk-000/file-000.parquet",
                 "data/chunk-000/file-000.parquet"):  # fmt: skip
        assert (DATASETS / name / path).is_file()


def test_recordings_are_small():
    files = [path for path in DATASETS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 5e6


def test_body_and_skin_are_the_robots(recorded):
    _, data = recorded
    assert data.joints == data.action_names == JOINTS
    assert data.units == ("m", *["rad"] * 7)
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
        assert episode.task in TASKS.values()
        np.testing.assert_allclose(np.diff(episode.time), 1 / CONTROL_RATE, atol=1e-4)
        for positions in (episode.state, episode.action):
            assert np.isfinite(positions).all()
            assert (positions >= env.joint_lower - 1e-6).all()
            assert (positions <= env.joint_upper + 1e-6).all()
        assert np.isfinite(episode.tactile).all()
        assert episode.tactile.min() >= 0.0
        pressed = episode.tactile.sum(axis=(1, 2))
        assert pressed[:5].max() == 0.0  # untouched at first
        assert 2.0 < pressed.max() < 30.0
    env.close()


def test_the_joints_followed_what_they_were_asked(recorded):
    _, data = recorded
    for episode in data:
        lag = np.abs(episode.action - episode.state)[:, :7]  # the hand stops at the object
        assert lag.max() < 0.15
        assert np.ptp(episode.action, axis=0).max() > 0.5


def test_the_first_episode_is_simulated_again_from_its_seed(recorded):
    name, data = recorded
    again, first = FIRST[name](), data.episodes[0]
    assert again.task == first.task
    assert len(again) == len(first)
    for column, tolerance in (("time", 1e-4), ("state", 1e-4), ("action", 1e-4), ("tactile", 0.05)):
        ours, theirs = getattr(again, column), getattr(first, column)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance, err_msg=column)
