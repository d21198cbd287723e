"""Datasets from environments and from arrays."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from hasm_torch.apps.record import EnvSource, RecordConfig, main, record
from hasm_torch.data import load_episodes
from hasm_torch.episode import ENVIRONMENT


class Pendulum(gymnasium.Env):
    """Two joints that drift, felt by four pressure cells; as a lab might bring it."""

    metadata = {"render_fps": 25}  # noqa: RUF012

    def __init__(self, speed: float = 0.1):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        skin = spaces.Box(0, 100, (4,), np.float32)
        self.observation_space = spaces.Dict({"joints": box, "pressure": skin, "load": box})
        self.action_space, self.speed = box, speed

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        self.steps = 0
        return self._see(), {}

    def step(self, action):
        self.action, self.steps = action, self.steps + 1
        self.state = self.state + np.float32(self.speed)
        return self._see(), 0.0, self.steps == 7, False, {}

    def _see(self):
        pressure, load = np.full(4, self.steps, np.float32), 2 * self.state
        return {"joints": self.state, "pressure": pressure, "load": load}


gymnasium.register("hasm_torch_tests/Pendulum-v0", entry_point=Pendulum)


def lean(observation, info):
    return observation["joints"] + np.float32(0.5)


def test_records_any_environment(tmp_path):
    source = EnvSource(
        id="hasm_torch_tests/Pendulum-v0",
        options={"speed": 0.2},
        state="joints",
        tactile="pressure",
        observations=["load"],
        controller=f"{__name__}:lean",
    )
    config = RecordConfig(
        root=tmp_path / "d", env=source, joints=["hip", "knee"], units=["rad", "deg"],
        patches=["left", "right"], channels=1, episodes=3, seed=4, tactile_unit="kPa",
    )  # fmt: skip
    data = load_episodes(record(config))
    assert (len(data), data.fps) == (3, 25)
    assert data.joints == ("hip", "knee")
    assert data.units == ("rad", "deg")
    assert {name: patch.cells for name, patch in data.skin.items()} == {
        "left": slice(0, 2),
        "right": slice(2, 4),
    }
    for number, episode in enumerate(data):
        env = Pendulum(0.2)
        observation, _ = env.reset(seed=4 + number)
        expected = observation["joints"] + 0.2 * np.arange(7)[:, None]
        np.testing.assert_allclose(episode.state, expected, atol=1e-5)
        np.testing.assert_allclose(episode.action, episode.state + 0.5, atol=1e-6)
        assert episode.tactile.shape == (7, 4, 1)
        assert episode.tactile[:, 0, 0].tolist() == list(range(7))
        np.testing.assert_array_equal(episode.observations, 2 * episode.state)
    assert data.observations == {"observation.load": 2}
    config.root, config.env.observations = tmp_path / "other", ["lode"]
    with pytest.raises(ValueError, match=r"'pressure'\], not 'lode': give --env.observations"):
        record(config)


def test_records_the_touched_hsr(tmp_path):
    source = EnvSource(
        id="hasm_torch.sim:hasm_torch/HSRTouch-v0",
        options={"scene": "grasp"},
        observations=["environment_state"],
    )
    from hasm_torch.robot import JOINTS

    config = RecordConfig(root=tmp_path / "d", env=source, joints=list(JOINTS), max_steps=5)
    data = load_episodes(record(config))
    assert data.fps == 50
    assert next(iter(data.skin)) == "wrist_upper"
    assert data.episodes[0].tactile.shape == (5, 54, 3)
    assert data.observations == {ENVIRONMENT: 3}
    assert 0.3 < data.episodes[0].observations[0, 0] < 1.5  # m, in front of the robot


def test_records_arrays(tmp_path):
    rng = np.random.default_rng(0)
    state, tactile, place = rng.normal(size=(9, 2)), rng.uniform(size=(9, 6)), rng.random((9, 3))
    path = tmp_path / "a.npz"
    series = {"state": state, "tactile": tactile, "observation.place": place}
    np.savez(path, **series, episode=[0] * 5 + [1] * 4)
    config = RecordConfig(root=tmp_path / "d", arrays=path, joints=["a", "b"], fps=10)
    data = load_episodes(record(config))
    first, second = data.episodes
    np.testing.assert_allclose(first.state, state[:5], atol=1e-6)
    np.testing.assert_allclose(first.action, state[[1, 2, 3, 4, 4]], atol=1e-6)
    np.testing.assert_allclose(second.tactile, tactile[5:].reshape(4, 2, 3), atol=1e-6)
    np.testing.assert_allclose(second.observations, place[5:], atol=1e-6)
    assert data.observations == {"observation.place": 3}
    np.savez(path, **series, place=place)
    with pytest.raises(ValueError, match=r"expected state and what there is of .*, observation.<"):
        record(config)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arrays": None}, "either --env.id or --arrays"),
        ({"fps": None}, "give --fps"),
        ({"joints": ["a"]}, "a name for each of the 2 joints"),
        ({"channels": 4}, "flat with 4 channels"),
        ({"patches": ["a", "b", "c"]}, "cannot be shared equally"),
        ({"root": None}, "expected --root"),
    ],
)
def test_bad_options_write_nothing(tmp_path, changes, message):
    path = tmp_path / "a.npz"
    np.savez(path, state=np.zeros((4, 2)), tactile=np.zeros((4, 6)))
    options = {"root": tmp_path / "d", "arrays": path, "joints": ["a", "b"], "fps": 10}
    with pytest.raises(ValueError, match=message):
        record(RecordConfig(**{**options, **changes}))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz"]


def test_command_line(tmp_path, monkeypatch, capsys):
    path = tmp_path / "a.npz"
    np.savez(path, state=np.zeros((4, 1)))
    options = [f"--root={tmp_path}/d", f"--arrays={path}", "--joints=[hip]", "--fps=10"]
    monkeypatch.setattr(sys, "argv", ["hasm-record", *options])
    main()
    assert "train on it with" in capsys.readouterr().out
    assert load_episodes(tmp_path / "d").skin is None
    with pytest.raises(SystemExit, match="already holds a dataset"):
        main()
