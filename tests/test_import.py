"""Bags that are written here, imported, and compared with what was written."""

import hashlib
import re
import shlex
import sys
from pathlib import Path

import draccus
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from hasm_torch.apps.import_bags import ImportConfig, import_bags, main
from hasm_torch.apps.record import RecordConfig
from hasm_torch.apps.record import record as record_arrays
from hasm_torch.data import load_episodes
from hasm_torch.data.bags.decode import decode
from hasm_torch.data.bags.messages import typestore
from hasm_torch.data.bags.skins import SkinTopic

EPOCH = 1_700_000_000_000_000_000  # ns
FPS, WINDOW = 50, 0.025
JOINTS = ["flex", "lift", "roll"]
STATE = "/hsrb/joint_states"
STORES = {ros1: typestore(ros1) for ros1 in (True, False)}


class Recorder:
    """Writes a bag of one kind: "ros1", "sqlite3" or "mcap"."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path = path.with_suffix(".bag") if kind == "ros1" else path
        self.ros1, self.store = kind == "ros1", STORES[kind == "ros1"]
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = (
            Writer1(self.path)
            if self.ros1
            else Writer2(self.path, version=9, storage_plugin=plugin)
        )
        self.topics: dict = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *error):
        self.writer.close()

    def make(self, name: str, *values):
        return self.store.types[name](*values)

    def stamp(self, seconds: float):
        nanoseconds = EPOCH + round(seconds * 1e9)
        return self.make("builtin_interfaces/msg/Time", *divmod(nanoseconds, 10**9))

    def header(self, seconds: float):
        before = (0,) if self.ros1 else ()  # the header of ROS 1 counts
        return self.make("std_msgs/msg/Header", *before, self.stamp(seconds), "")

    def send(self, topic: str, seconds: float, message) -> None:
        kind = message.__msgtype__
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        time = EPOCH + round(seconds * 1e9)
        self.writer.write(self.topics[topic], time, bytes(serialize(message, kind)))

    def joints(self, topic: str, seconds: float, names, positions, stamp=None) -> None:
        header, nothing = self.header(seconds if stamp is None else stamp), np.zeros(0)
        kind = "sensor_msgs/msg/JointState"
        message = self.make(kind, header, list(names), np.asarray(positions), nothing, nothing)
        self.send(topic, seconds, message)

    def tum(self, topic: str, seconds: float, cells, forces) -> None:
        kind = "tum_ics_skin_msgs/msg/SkinCell"
        data = [
            self.make(f"{kind}Data", int(c), 0, np.ones(1), np.asarray(f), np.ones(3), np.ones(2))
            for c, f in zip(cells, forces, strict=True)
        ]
        self.send(topic, seconds, self.make(f"{kind}DataArray", data))

    def tactile_state(self, topic: str, seconds: float, sensors: dict) -> None:
        channels = [
            self.make("sensor_msgs/msg/ChannelFloat32", name, np.asarray(values, np.float32))
            for name, values in sensors.items()
        ]
        kind = "tactile_msgs/msg/TactileState"
        self.send(topic, seconds, self.make(kind, self.header(seconds), channels))

    def array(self, topic: str, seconds: float, values, number="Float32") -> None:
        layout = self.make("std_msgs/msg/MultiArrayLayout", [], 0)
        values = np.asarray(values, number.lower())
        self.send(topic, seconds, self.make(f"std_msgs/msg/{number}MultiArray", layout, values))

    def xela(self, topic: str, seconds: float, sensors: dict) -> None:
        package = "xela_server_ros/msg/"
        full = [
            self.make(
                f"{package}SensorFull", 1, seconds, f"uSPa{position}", position,
                [self.make(f"{package}Taxel", 40000, 2, 3)],
                [self.make(f"{package}Forces", *map(float, f)) for f in forces],
            )
            for position, forces in sensors.items()
        ]  # fmt: skip
        self.send(topic, seconds, self.make(f"{package}SensStream", full))

    def wrench(self, topic: str, seconds: float, values) -> None:
        vectors = [
            self.make("geometry_msgs/msg/Vector3", *map(float, v)) for v in np.split(values, 2)
        ]
        wrench = self.make("geometry_msgs/msg/Wrench", *vectors)
        kind = "geometry_msgs/msg/WrenchStamped"
        self.send(topic, seconds, self.make(kind, self.header(seconds), wrench))

    def trajectory(self, topic: str, seconds: float, names, points: dict) -> None:
        nothing = np.zeros(0)
        kind = "trajectory_msgs/msg/JointTrajectory"
        made = [
            self.make(
                f"{kind}Point", np.asarray(p, float), nothing, nothing, nothing,
                self.make("builtin_interfaces/msg/Duration", *divmod(round(t * 1e9), 10**9)),
            )
            for t, p in points.items()
        ]  # fmt: skip
        self.send(topic, seconds, self.make(kind, self.header(seconds), list(names), made))


def irregular(rng, rate: float, seconds: float, start: float = 0.0) -> np.ndarray:
    """Times that jitter by a third of a period, a tenth of them lost but for the first and last."""
    times = start + (np.arange(round(rate * seconds)) + rng.uniform(-0.3, 0.3)) / rate
    times += rng.uniform(0, 0.3 / rate, len(times)) + 0.5 / rate
    kept = rng.random(len(times)) > 0.1
    kept[[0, -1]] = True
    return np.round(times[kept], 9)


def move(times) -> np.ndarray:
    return np.sin(np.asarray(times)[..., None] * [1.0, 2.0, 3.0] + [0.1, 0.2, 0.3])


def reports(times, have, values, at, window) -> np.ndarray:
    """(T, E, ...) what every entry reported closest to each sample; NaN outside of the window."""
    out = np.full((len(at), *values.shape[1:]), np.nan)
    for i, t in enumerate(at):
        for e in range(values.shape[1]):
            distance = np.where(have[:, e], np.abs(times - t), np.inf)
            if distance.min() <= window:
                out[i, e] = values[distance.argmin(), e]
    return out


def hold(series, times, have, values, at) -> np.ndarray:
    """The same with the last report in place of NaN, 0 before the first."""
    out = series.copy()
    for i, e in np.argwhere(np.isnan(series).reshape(*series.shape[:2], -1).any(-1)):
        before = np.flatnonzero(have[:, e] & (times <= at[i]))
        out[i, e] = values[before[-1], e] if len(before) else 0.0
    return out


def samples(first: float, last: float) -> np.ndarray:
    return first + np.arange(int((last - first) * FPS + 1e-6) + 1) / FPS


def config(root: Path, bags, **changes) -> ImportConfig:
    options = {"state": STATE, "fps": FPS, "window_s": WINDOW, "baseline_s": 0.0}
    bag = [str(bag) for bag in bags] if isinstance(bags, list) else str(bags)
    return ImportConfig(root=root, bag=bag, **{**options, **changes})


def imported(root: Path, bags, **changes):
    return load_episodes(import_bags(config(root, bags, **changes))[0])


@pytest.mark.parametrize("missing", ["hold", "nan"])
@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_partial_skins_and_joints_of_every_bag(tmp_path, kind, missing):
    rng = np.random.default_rng(5)
    cells = np.array([3, 4, 7, 12, 30])
    states, skins = irregular(rng, 100, 3), irregular(rng, 60, 2.9, start=0.05)
    skins = skins[(skins < 1.0) | (skins > 1.3)]  # a gap of all cells
    have = rng.random((len(skins), 5)) < 0.6
    have[0], have[skins < 1.6, 4] = [1, 1, 1, 1, 0], False  # one cell wakes up late
    forces = rng.integers(0, 300, (len(skins), 5, 3)) / 1024
    moving = rng.random((len(states), 3)) < 0.8
    moving[:2], moving[-2:] = True, True
    with Recorder(tmp_path / "bag", kind) as bag:
        for t, q, mine in zip(states, move(states), moving, strict=True):
            order = rng.permutation(np.flatnonzero(mine))
            bag.joints(STATE, t, [JOINTS[j] for j in order], q[order])
        for t, f, mine in zip(skins, forces, have, strict=True):
            order = rng.permutation(np.flatnonzero(mine))
            bag.tum("/patch1", t, cells[order], f[order])
        bag.array("/other", 0.5, [1.0])
    config_of = config(tmp_path / "set", bag.path, skin="/patch1", missing=missing, window_s=0.03)
    root, notes = import_bags(config_of)
    (episode,) = load_episodes(root)
    at = samples(max(states[0], skins[have.any(1)][0]), states[-1])
    assert len(episode) == len(at)
    expected = reports(states, moving, move(states), at, 0.03)
    np.testing.assert_allclose(episode.state, expected, atol=1e-6)
    np.testing.assert_array_equal(episode.action[:-1], episode.state[1:])
    felt = reports(skins, have, forces, at, 0.03)
    assert 0.05 < np.isnan(felt).mean() < 0.5  # there was something to fill
    filled = hold(felt, skins, have, forces, at)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    table = LeRobotDataset("local/set", root=root, video_backend="pyav").hf_dataset
    stored = np.stack([np.asarray(row) for row in table["observation.tactile"]])
    stored = stored.reshape(len(at), 5, 3)
    np.testing.assert_array_equal(stored, filled if missing == "hold" else felt)
    if missing == "nan":  # what is loaded to learn holds the last sample
        loaded = episode.tactile
        known = ~np.isnan(felt)
        np.testing.assert_array_equal(loaded[known], felt[known])
        for i, e, c in np.argwhere(~known):
            assert loaded[i, e, c] == (loaded[i - 1, e, c] if i else 0.0)
    share = np.isnan(felt[..., 0]).mean()
    assert any(f"{share:.2%} of the readings did not come within" in note for note in notes)
    with pytest.raises(ValueError, match=r"skin patch1: .* longest gap .* \(cell 30\).*--missing"):
        import_bags(
            config(tmp_path / "new", bag.path, skin="/patch1", missing="error", window_s=0.03)
        )


def record(path: Path, kind: str, send, seconds: float = 1.0) -> tuple[Path, np.ndarray]:
    """A bag of joint states and what ``send`` does at every skin time, (T,) s."""
    rng = np.random.default_rng(1)
    times = irregular(rng, 80, seconds)
    with Recorder(path, kind) as bag:
        for t in irregular(rng, 100, seconds + 0.1):
            bag.joints(STATE, t, JOINTS, move(t))
        for i, t in enumerate(times):
            send(bag, i, t)
    return bag.path, times


def felt_at(data, times, values) -> None:
    """The skin of the one episode is what was written, (N, cells, channels), paired."""
    (episode,) = data
    begin = max(times[0], irregular_state_start(len(times)))
    at = begin + np.arange(len(episode)) / FPS
    expected = reports(times, np.ones(values.shape[:2], bool), values, at, WINDOW)
    assert np.isfinite(expected).mean() > 0.9
    expected = hold(expected, times, np.ones(values.shape[:2], bool), values, at)
    np.testing.assert_allclose(episode.tactile, expected, rtol=1e-6)


def irregular_state_start(_length: int, seconds: float = 1.0) -> float:
    rng = np.random.default_rng(1)
    irregular(rng, 80, seconds)
    return float(irregular(rng, 100, seconds + 0.1)[0])


def test_tactile_state(tmp_path):
    values = np.random.default_rng(2).random((100, 7)).astype(np.float32)

    def send(bag, i, t):  # the sensors come in turning order
        sensors = {"palm10": values[i, 3:5], "palm2": values[i, :3], "tip": values[i, 5:]}
        bag.tactile_state("/tactile", t, dict(list(sensors.items())[:: (-1) ** i]))

    path, times = record(tmp_path / "bag", "ros1", send)
    data = imported(tmp_path / "all", path, skin=["/tactile"])
    felt_at(data, times, values[: len(times), :, None])
    tip = {"tip": SkinTopic("/tactile", sensor="tip", link="finger", normals=[[1.0, 0.0, 0.0]])}
    data = imported(tmp_path / "tip", path, skin=tip)
    felt_at(data, times, values[: len(times), 5:, None])
    patch = data.skin["tip"]
    assert (patch.link, patch.channels, patch.unit) == ("finger", 1, "unknown")
    np.testing.assert_array_equal(patch.normals, [[1, 0, 0]] * 2)


def test_xela(tmp_path):
    forces = np.random.default_rng(3).normal(size=(100, 4, 3)).astype(np.float32)

    def send(bag, i, t):
        bag.xela("/xServTopic", t, {12: forces[i, 2:], 2: forces[i, :2]})

    path, times = record(tmp_path / "bag", "sqlite3", send)
    felt_at(imported(tmp_path / "all", path, skin="/xServTopic"), times, forces[: len(times)])
    one = {"tip": SkinTopic("/xServTopic", sensor="12")}
    felt_at(imported(tmp_path / "one", path, skin=one), times, forces[: len(times), 2:])
    raw = {"tip": SkinTopic("/xServTopic", sensor="2", read="taxels", gain=0.5)}
    data = imported(tmp_path / "raw", path, skin=raw, tactile_unit="N")
    assert data.episodes[0].tactile[0].tolist() == [[20000.0, 1.0, 1.5]]
    assert data.skin["tip"].unit == "N"
    with pytest.raises(ValueError, match=r"no readings of sensor '3'; its sensors: 2, 12"):
        imported(tmp_path / "no", path, skin={"tip": SkinTopic("/xServTopic", sensor="3")})


@pytest.mark.parametrize("number", ["Float32", "Int16"])
def test_arrays(tmp_path, number):
    fluxes = np.random.default_rng(4).integers(-900, 900, (100, 15))
    path, times = record(
        tmp_path / "bag", "mcap", lambda bag, i, t: bag.array("/skin", t, fluxes[i], number)
    )
    data = imported(tmp_path / "d", path, skin="/skin")
    felt_at(data, times, fluxes[: len(times)].reshape(-1, 5, 3))
    flat = {"skin": SkinTopic("/skin", channels=1, cells=[14, 0, 99])}
    (episode,) = imported(tmp_path / "flat", path, skin=flat)
    np.testing.assert_array_equal(
        episode.tactile[:, :2], data.episodes[0].tactile[:, [4, 0], [2, 0], None]
    )
    assert not episode.tactile[:, 2].any()  # a cell that never reported
    with pytest.raises(ValueError, match="15 values a message are no cells of 6"):
        imported(tmp_path / "no", path, skin={"skin": SkinTopic("/skin", channels=6)})


def test_wrench(tmp_path):
    values = np.random.default_rng(5).normal(size=(100, 6))
    topic = "/hsrb/wrist_wrench/compensated"
    path, times = record(
        tmp_path / "bag", "ros1", lambda bag, i, t: bag.wrench(topic, t, values[i])
    )
    data = imported(tmp_path / "d", path, skin=topic)
    felt_at(data, times, values[: len(times), None])
    patch = data.skin["hsrb_wrist_wrench_compensated"]
    assert (patch.channels, patch.unit) == (6, "N")


def test_baseline_and_gain_of_the_first_seconds(tmp_path):
    rng = np.random.default_rng(6)
    level, spread = np.array([0.2, 0.5, 0.9]), np.array([0.01, 0.02, 0.04])
    forces = level[:, None] + spread[:, None] * rng.normal(size=(200, 3, 3))
    forces[100:] += 4.0

    def send(bag, i, t):  # the last cell only reports when it is touched
        cells = [1, 2, 3] if t > 1.2 else [1, 2]
        bag.tum("/patch1", t, cells, forces[i, : len(cells)])

    path, times = record(tmp_path / "bag", "sqlite3", send, seconds=2.0)
    options = {"skin": {"p": SkinTopic("/patch1", gain=9.0)}, "baseline_s": 1.0}
    raw = imported(tmp_path / "raw", path, skin="/patch1").episodes[0].tactile
    data = imported(tmp_path / "d", path, tactile_unit="N", **options)
    begin = max(times[0], irregular_state_start(0, 2.0))
    early = forces[: len(times)][(times >= begin) & (times <= begin + 1.0)][:, :2]
    assert 50 < len(early) < 90
    rest = early.mean(axis=0)
    rest = np.vstack([rest, np.median(rest, axis=0)])
    silent = (raw[:, 2] == 0.0).all(axis=1)
    expected = (raw - rest) * 9.0
    expected[silent, 2] = 0.0
    np.testing.assert_allclose(data.episodes[0].tactile, expected, atol=1e-4)
    options["skin"]["p"].gain = "noise"
    data = imported(tmp_path / "noise", path, **options)
    np.testing.assert_allclose(
        data.episodes[0].tactile[:, :2],
        (raw - rest)[:, :2] / early.std(axis=0),
        rtol=1e-3,
        atol=0.01,
    )
    assert data.skin["p"].unit == "noise"


def test_commands(tmp_path):
    def send(bag, i, t):
        if i == 0:
            # what the first one plans for 0.8 s never comes: the second one replaces it
            for at, second in ((0.3, 0.5), (0.72, 0.2)):
                points = {0.1: [5, 6], second: [7, 8], 0.6: [9, 1]}
                bag.trajectory("/arm", at, ["roll", "flex"], points)
            bag.joints("/hand", 0.5, ["lift"], [-3.0])
        if i == 20:
            bag.array("/all", 0.4, [1.5, 2.5, 3.5], "Float64")

    path, _ = record(tmp_path / "bag", "sqlite3", send)
    (episode,) = imported(tmp_path / "d", path, action=["/arm", "/hand"])
    at = irregular_state_start(0) + episode.time
    following = np.vstack([episode.state[1:], episode.state[-1:]])
    lift = np.where(at >= 0.5, -3.0, following[:, 1])
    np.testing.assert_allclose(episode.action[:, 1], lift, atol=1e-6)
    roll = following[:, 2].copy()
    for start, value in ((0.3, 5), (0.4, 7), (0.72, 5), (0.82, 7), (0.92, 9)):
        roll[at >= start] = value
    np.testing.assert_allclose(episode.action[:, 2], roll, atol=1e-6)
    (episode,) = imported(tmp_path / "all", path, action="/all", joints=["roll", "flex", "lift"])
    np.testing.assert_allclose(
        episode.state[0], move(irregular_state_start(0))[[2, 0, 1]], atol=1e-6
    )
    assert episode.action[-1].tolist() == [1.5, 2.5, 3.5]
    with pytest.raises(ValueError, match="/all does not name its joints: give --joints"):
        imported(tmp_path / "no", path, action="/all")


def test_stamped_clock(tmp_path):
    times = np.arange(0.0, 1.0, 0.01)
    with Recorder(tmp_path / "bag", "mcap") as bag:
        for t in times:  # received late, by up to 8 ms
            bag.joints(STATE, t + 0.008 * (t % 0.02 > 0.005), JOINTS, move(t), stamp=t)
    (episode,) = imported(tmp_path / "d", bag.path, clock="stamped")
    np.testing.assert_allclose(episode.state, move(np.arange(50) / 50), atol=1e-6)


def test_several_bags_split_and_learned(tmp_path):
    paths = []
    for number, cells in enumerate(([4, 2], [2, 9])):
        touch = lambda i, k=number: 0.01 + 0.5 * (i % 40 > 20) * (k + 1)  # noqa: E731
        paths.append(
            record(
                tmp_path / f"bag{number}", ("ros1", "mcap")[number],
                lambda bag, i, t, c=cells, f=touch: bag.tum("/p", t, c, np.full((2, 3), f(i))),
                seconds=4.0,
            )[0]
        )  # fmt: skip
    data = imported(tmp_path / "d", paths, skin="/p", split_s=1.0, baseline_s=0.2)
    assert [len(e) for e in data.episodes[:4]] == [50] * 4
    assert len(data) >= 8
    assert data.skin["p"].cells == slice(0, 3)  # 2, 4, 9
    assert not data.episodes[0].tactile[:, 2].any()
    assert not data.episodes[-1].tactile[:, 1].any()
    assert data.episodes[0].tactile[:, :2].max() > 0.4
    from hasm_torch.config import HASMConfig
    from hasm_torch.data.training import train

    trained = train(data.root, HASMConfig())
    assert trained.model.body.joints == JOINTS
    assert "touch: 3 cells x 3 forces" in str(trained)


def test_yaml_and_command_line(tmp_path, monkeypatch, capsys):
    path, times = record(
        tmp_path / "bag", "mcap", lambda bag, i, t: bag.tum("/patch1", t, [1], [[t, 0.0, 0.0]])
    )
    lab = tmp_path / "lab.yaml"
    lab.write_text(
        f"state: {STATE}\njoints: [roll, lift]\nunits: [rad, m]\nbaseline_s: 0\n"
        "skin:\n  wrist: {topic: /patch1, link: arm, gain: 2.0}\n"
    )
    options = [f"--root={tmp_path}/d", f"--bag={path}", f"--config_path={lab}"]
    monkeypatch.setattr(sys, "argv", ["hasm-import", *options])
    main()
    said = capsys.readouterr().out
    assert "train on it with" in said
    data = load_episodes(tmp_path / "d")
    assert (data.joints, data.units) == (("roll", "lift"), ("rad", "m"))
    assert data.skin["wrist"].link == "arm"
    assert data.episodes[0].tactile.max() > times[-5] * 2.0
    with pytest.raises(SystemExit, match="already holds a dataset"):
        main()
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--skin=/patch1", "--overwrite=true"])
    main()
    assert list(load_episodes(tmp_path / "d").skin) == ["patch1"]


def test_errors_say_what_to_do(tmp_path):
    def send(bag, i, t):
        bag.tum("/patch1", t, [1], [[0.0, 0.0, 0.0]])
        bag.wrench("/wrench", t, np.zeros(6))
        bag.tum("/empty", t, [], [])

    path, _ = record(tmp_path / "bag", "sqlite3", send)
    for changes, message in (
        (
            {"skin": "/patch2"},
            r"no topic '/patch2'; its topics:\n(.|\n)*/patch1  tum_ics_skin_msgs/",
        ),
        ({"skin": STATE}, r"JointState, which is no skin .* can:\n(.|\n)*tactile_msgs/msg/Tactile"),
        ({"state": "/patch1"}, r"no joint states .*\n  sensor_msgs/msg/JointState"),
        ({"action": "/wrench"}, r"no commands .*\n(.|\n)*JointTrajectory"),
        ({"joints": ["flex", "knee"]}, "no joint knee; its joints: flex, lift, roll"),
        ({"skin": ["/patch1", "/wrench"]}, "one kind, got readings a cell"),
        ({"skin": "/empty"}, "topic /empty holds no readings"),
        ({"skin": {"p": SkinTopic("/patch1", read="smell")}}, "valid: force, prox, acc, temp"),
        ({"skin": {"p": SkinTopic("/patch1", normals=[[0, 0, 1]] * 2)}}, "each of its 1 cells"),
        ({"window_s": 0.001}, "no position of flex, lift, roll .* gap .* s from .* --window_s"),
        ({"state": ""}, "expected --root, --bag and --state"),
        ({"bag": str(tmp_path / "no.bag")}, "no bag"),
    ):
        error = FileNotFoundError if "bag" in changes else ValueError
        with pytest.raises(error, match=message):
            import_bags(config(tmp_path / "d", path, **changes) if "bag" not in changes else
                        config(tmp_path / "d", changes["bag"]))  # fmt: skip
    assert not (tmp_path / "d").exists()


def test_a_damaged_bag(tmp_path):
    path, _ = record(tmp_path / "bag", "ros1", lambda bag, i, t: None)
    path.write_bytes(b"#ROSBAG V2.0\n" + b"x" * 100)
    with pytest.raises(ValueError, match="is no bag that can be read"):
        imported(tmp_path / "d", path)
    with Recorder(tmp_path / "cut", "mcap") as bag:
        bag.joints(STATE, 0.0, JOINTS, np.zeros(3))
        message = b"\0\1\0\0" + b"\7\0\0\0" * 6
        bag.writer.write(bag.topics[STATE], EPOCH + 1, message)
    with pytest.raises(ValueError, match=f"topic {STATE}: a message of 28 bytes .*ends early"):
        imported(tmp_path / "d", bag.path)


def test_without_rosbags(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match=r'pip install "hasm-torch\[ros\]"'):
        imported(tmp_path / "d", tmp_path / "bag")


@pytest.mark.parametrize("ros1", [True, False])
def test_decodes_what_rosbags_decodes(ros1):
    """Blocks of many layouts against ``rosbags``' own deserialisation, message by message."""
    rng, store = np.random.default_rng(8), STORES[ros1]
    kind = "xela_server_ros/msg/SensStream"
    make = lambda name, *values: store.types[f"xela_server_ros/msg/{name}"](*values)  # noqa: E731

    def several(name: str, draw) -> list:
        return [make(name, *draw()) for _ in range(rng.integers(3))]

    streams = []
    for _ in range(60):
        sensors = [
            make(
                "SensorFull", int(rng.integers(2**32)), float(rng.normal()),
                "uSPa"[: rng.integers(5)], int(rng.integers(256)),
                several("Taxel", lambda: rng.integers(2**16, size=3).tolist()),
                several("Forces", lambda: rng.normal(size=3).tolist()),
            )
            for _ in range(rng.integers(3))
        ]  # fmt: skip
        streams.append(make("SensStream", sensors))
    orders = [True] if ros1 else [True, False]
    for little in orders:
        raw = [
            bytes(
                store.serialize_ros1(s, kind)
                if ros1
                else store.serialize_cdr(s, kind, little_endian=little)
            )
            for s in streams
        ]
        back = [(store.deserialize_ros1 if ros1 else store.deserialize_cdr)(r, kind) for r in raw]
        paths = {"sensors.time", "sensors.model", "sensors.taxels.y", "sensors.forces.z"}
        seen = []
        for rows, fields in decode(raw, kind, store.fielddefs, paths, cdr=not ros1):
            for place, row in enumerate(rows.tolist()):
                sensors = back[row].sensors
                seen.append(row)
                flat = {path: [leaf.values[place, 0] for leaf in fields[path]] for path in paths}
                assert flat["sensors.time"] == [s.time for s in sensors]
                assert flat["sensors.model"] == [s.model.encode() for s in sensors]
                assert flat["sensors.taxels.y"] == [x.y for s in sensors for x in s.taxels]
                expected = [np.float32(x.z) for s in sensors for x in s.forces]
                assert flat["sensors.forces.z"] == expected
                where = [leaf.where for leaf in fields["sensors.taxels.y"]]
                assert where == [
                    (i, k) for i, s in enumerate(sensors) for k in range(len(s.taxels))
                ]
        assert sorted(seen) == list(range(60))


def test_bags_without_definitions(tmp_path):
    """Older ROS 2 bags do not say what their messages are made of."""
    import sqlite3

    path, times = record(
        tmp_path / "bag", "sqlite3", lambda bag, i, t: bag.tum("/p", t, [5], [[1.0, 2.0, 3.0]])
    )
    with sqlite3.connect(path / "bag.db3") as base:
        base.execute("DELETE FROM message_definitions")
    base.close()
    felt_at(
        imported(tmp_path / "d", path, skin="/p"), times, np.tile([[[1, 2, 3]]], (len(times), 1, 1))
    )


def test_definitions_are_those_of_the_package():
    md5 = STORES[True].generate_msgdef("tum_ics_skin_msgs/msg/SkinCellDataArray")[1]
    assert md5 == "25fa07a551bcc135c5207881df75ddd7"


def test_reading_does_not_change_what_is_written_twice(tmp_path):
    path, _ = record(tmp_path / "bag", "mcap", lambda bag, i, t: bag.tum("/p", t, [5], [[t, 0, 0]]))
    digests = []
    for name in "ab":
        root, _ = import_bags(config(tmp_path / name / "set", path, skin="/p"))
        files = sorted(p for p in root.rglob("*") if p.is_file())
        digests.append([hashlib.sha256(p.read_bytes()).hexdigest() for p in files])
    assert digests[0] == digests[1]


PAGE = (Path(__file__).parents[1] / "docs" / "recordings.md").read_text()


def test_the_page_names_options_that_there_are(tmp_path, monkeypatch):
    """Every YAML file and every line of ours on the page is read as the programs read it."""
    yamls = re.findall(r"```yaml\n(.*?)```", PAGE, re.S)
    assert len(yamls) >= 5
    for text in yamls:
        (tmp_path / "my_lab.yaml").write_text(text)
        options = draccus.parse(ImportConfig, config_path=tmp_path / "my_lab.yaml", args=[])
        assert options.state
        assert all(isinstance(patch, SkinTopic) and patch.topic for patch in options.skin.values())
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"uv run hasm-(import|record) (.*)", PAGE)
    assert len(lines) >= 5
    for program, line in lines:
        options = draccus.parse(
            {"import": ImportConfig, "record": RecordConfig}[program], args=shlex.split(line)
        )
        assert options.root is not None
    for option in set(re.findall(r"`--(\w+)", PAGE)) - {"mode", "env", "config_path"}:
        assert option in ImportConfig.__dataclass_fields__


def test_the_page_records_arrays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (snippet,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    exec(compile(snippet, "docs/recordings.md", "exec"), {})
    (line,) = re.findall(r"hasm-record (.*--arrays.*)", PAGE)
    data = load_episodes(record_arrays(draccus.parse(RecordConfig, args=shlex.split(line))))
    assert [len(episode) for episode in data] == [100, 100]
