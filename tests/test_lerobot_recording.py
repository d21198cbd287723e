"""Writing datasets: LeRobot reads back what was written, and nothing is ever half-written."""

import gc
import hashlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hasm_torch.data import (
    Episode,
    FeatureMap,
    SkinPatch,
    load_episodes,
    skin_patches,
    write_card,
    write_episodes,
)

FPS = 50
RECORDINGS = Path(__file__).parents[2] / "shared" / "data"
JOINTS = ("lift", "flex", "roll")
UNITS = ("m", "rad", "rad")
SKIN = {
    "wrist": SkinPatch("wrist", slice(0, 2), "arm", np.ones((2, 3)), np.eye(3)[:2]),
    "hand": SkinPatch("hand", slice(2, 5), "palm", points=np.arange(27.0).reshape(3, 3, 3)),
}


def episodes(lengths=(6, 1, 9), cells=5, channels=3) -> list[Episode]:
    rng = np.random.default_rng(1)
    return [
        Episode(
            index=i,
            task=["push up", "push down"][i % 2],
            time=np.arange(length) / FPS,
            state=rng.normal(size=(length, 3)).astype(np.float32),
            action=rng.normal(size=(length, 3)).astype(np.float32),
            tactile=rng.random((length, cells, channels)).astype(np.float32),
        )
        for i, length in enumerate(lengths)
    ]


def record(root: Path, recorded=None, **changes) -> Path:
    options = {"joints": JOINTS, "units": UNITS, "skin": SKIN, "fps": FPS, "robot_type": "hsr"}
    recorded = episodes() if recorded is None else recorded
    return write_episodes(root, recorded, **{**options, **changes})


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("recorded") / "deep" / "set")


def read(root: Path, **options):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("local/set", root=root, video_backend="pyav", **options)


def same(a: Episode, b: Episode) -> None:
    assert a.task == b.task
    for name in ("time", "state", "action", "tactile"):
        x, y = (np.asarray(getattr(e, name), dtype=np.float32) for e in (a, b))
        np.testing.assert_array_equal(x, y)


def test_round_trip(root):
    data = load_episodes(root)
    assert (data.fps, data.joints, data.units, data.action_names) == (FPS, JOINTS, UNITS, JOINTS)
    for back, written in zip(data, episodes(), strict=True):
        same(back, written)
    assert list(data.skin) == list(SKIN)
    for name, patch in SKIN.items():
        back = data.skin[name]
        assert (back.cells, back.link, back.unit) == (patch.cells, patch.link, "N")
        for key in ("positions", "normals", "points"):
            np.testing.assert_array_equal(getattr(back, key), getattr(patch, key))


def test_a_loaded_dataset_can_be_written_again(root, tmp_path):
    data = load_episodes(root)
    options = {"joints": data.joints, "units": data.units, "skin": data.skin}
    again = record(tmp_path / "set", list(data), **options)
    assert digest(again) == digest(root)


@pytest.mark.parametrize("channels", [1, 6])
def test_pressures_and_wrenches(tmp_path, channels):
    skin = {name: replace(patch, unit="raw") for name, patch in SKIN.items()}
    written = episodes((3,), channels=channels)
    data = load_episodes(record(tmp_path / "set", written, skin=skin))
    same(data.episodes[0], written[0])
    assert data.skin["hand"].unit == "raw"


def test_without_skin_and_with_one_joint(tmp_path):
    written = [
        replace(e, tactile=None, state=e.state[:, :1], action=e.action[:, :1]) for e in episodes()
    ]
    record(tmp_path / "set", written, skin=None, joints=JOINTS[:1], units=UNITS[:1])
    data = load_episodes(tmp_path / "set")
    assert data.skin is None
    np.testing.assert_array_equal(data.episodes[2].action, written[2].action)


BOUND = {"observation.environment_state": {"x": "m", "y": "m"}, "observation.load": ["grams"]}


def with_observations() -> list[Episode]:
    rng = np.random.default_rng(2)
    sizes = [(e, (len(e), 3)) for e in episodes()]
    return [replace(e, observations=rng.normal(size=n).astype(np.float32)) for e, n in sizes]


def test_further_observations(tmp_path):
    written = with_observations()
    folder = record(tmp_path / "set", iter(written), observations=BOUND)
    data, stream = load_episodes(folder), load_episodes(folder, most_bytes=0)
    assert data.observations == stream.observations == {k: len(v) for k, v in BOUND.items()}
    for whole, streamed, mine in zip(data, stream, written, strict=True):
        np.testing.assert_array_equal(whole.observations, mine.observations)
        np.testing.assert_array_equal(streamed.observations, mine.observations)
    features = read(folder).features
    assert features["observation.load"]["info"] == {"bind": True, "units": ["unknown"]}
    environment = features["observation.environment_state"]
    assert (environment["names"], environment["info"]["units"]) == (["x", "y"], ["m", "m"])
    frame = read(folder)[7]["observation.environment_state"]
    np.testing.assert_array_equal(frame, written[2].observations[0, :2])


def test_which_observations_are_bound_can_be_named(tmp_path):
    folder = record(tmp_path / "set", with_observations(), observations=BOUND)
    none = load_episodes(folder, FeatureMap(bound=[]))
    assert none.observations == {}
    assert none.episodes[0].observations is None
    one = load_episodes(folder, FeatureMap(bound=["observation.load"]))
    assert one.observations == {"observation.load": 1}
    expected = with_observations()[2].observations[:, 2:]
    np.testing.assert_array_equal(one.episodes[2].observations, expected)
    with pytest.raises(ValueError, match=r"Expected a feature 'observation.lode' in"):
        load_episodes(folder, FeatureMap(bound=["observation.lode"]))


def test_lerobot_reads_the_same_frames(root):
    dataset, data = read(root), load_episodes(root)
    assert (dataset.fps, dataset.num_episodes) == (FPS, len(data))
    assert dataset.meta.robot_type == "hsr"
    assert dataset.features["observation.tactile"]["names"][:4] == [
        "wrist.0.0",
        "wrist.0.1",
        "wrist.0.2",
        "wrist.1.0",
    ]
    i = 0
    for episode in data:
        for t in range(len(episode)):
            item = dataset[i]
            assert item["task"] == episode.task
            assert item["timestamp"].item() == episode.time[t]
            np.testing.assert_array_equal(item["observation.state"], episode.state[t])
            np.testing.assert_array_equal(item["action"], episode.action[t])
            np.testing.assert_array_equal(item["observation.tactile"], episode.tactile[t].ravel())
            i += 1
    assert i == len(dataset)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="real recordings are not at hand")
def test_lerobot_reads_the_same_frames_of_a_real_recording():
    dataset = read(RECORDINGS / "icub_grasp")
    data = load_episodes(RECORDINGS / "icub_grasp")
    starts = np.cumsum([0, *map(len, data)])
    for number in (0, 57, 139):
        episode = data.episodes[number]
        item = dataset[int(starts[number + 1]) - 1]
        assert item["task"] == episode.task
        np.testing.assert_array_equal(item["observation.state"], episode.state[-1])
        np.testing.assert_array_equal(item["observation.tactile"], episode.tactile[-1].ravel())


def digest(root: Path) -> dict[str, str]:
    files = (path for path in sorted(root.rglob("*")) if path.is_file())
    return {str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_the_same_episodes_give_the_same_bytes(root, tmp_path):
    again = record(tmp_path / "another", iter(episodes()))
    assert digest(again) == digest(root)


def interrupted(error: type[BaseException]):
    yield from episodes()[:2]
    raise error("arm stopped")


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_recording_leaves_nothing(tmp_path, error):
    came = None
    try:  # pytest.raises would keep the unfinished writer alive, and that writes when it dies
        record(tmp_path / "set", interrupted(error))
    except BaseException as raised:
        came = type(raised)
    assert came is error
    gc.collect()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_root_is_refused(tmp_path, root):
    before = digest(root)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        record(root)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "diary.txt").touch()
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match="no LeRobot dataset"):
            record(tmp_path / "notes", overwrite=overwrite)
    assert digest(root) == before


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "set").mkdir()
    assert len(load_episodes(record(tmp_path / "set"))) == 3


def test_overwrite_replaces_whole_or_not_at_all(tmp_path):
    folder = record(tmp_path / "set")
    before = digest(folder)
    with pytest.raises(RuntimeError, match="arm stopped"):
        record(folder, interrupted(RuntimeError), overwrite=True)
    gc.collect()
    assert digest(folder) == before
    record(folder, episodes((2,)), overwrite=True)
    assert [len(e) for e in load_episodes(folder)] == [2]
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def change(**values):
    first, *rest = episodes()
    return [replace(first, **values), *rest]


@pytest.mark.parametrize(
    ("recorded", "options", "message"),
    [
        ([], {}, "at least one episode"),
        (change(state=np.zeros((6, 2))), {}, "Episode 0.*observation.state.*6.*got \\(6, 2\\)"),
        (change(action=np.zeros((5, 3))), {}, "Episode 0: expected 'action'.*got \\(5, 3\\)"),
        (change(action=np.full((6, 3), np.nan)), {}, "finite numbers in 'action', got nan"),
        (change(state=np.full((6, 3), 1e39)), {}, "finite numbers in 'observation.state', got inf"),
        (change(tactile=np.full((6, 5, 3), np.inf)), {}, "finite numbers in 'observation.tactile'"),
        (change(tactile=np.zeros((6, 15))), {}, "tactile of shape"),
        (change(tactile=None), {}, "got tactile missing and their description given"),
        (episodes(), {"skin": None}, "got tactile given and their description missing"),
        (change(observations=np.zeros((6, 3))), {}, "got observations given and .* missing"),
        (episodes(), {"observations": BOUND}, "got observations missing and .* given"),
        (change(observations=np.zeros((6, 2))), {"observations": BOUND}, "got \\(6, 2\\)"),
        (change(time=np.arange(6) / 30), {}, "6 time stamps 0.02 s apart"),
        (change(time=np.arange(5) / FPS), {}, "6 time stamps"),
        (change(task=""), {}, "task in words"),
        (episodes((0,)), {}, "at least one"),
        (episodes(), {"units": ("rad",)}, "a unit each"),
        (episodes(), {"joints": ("a", "b", "a")}, "different names"),
        (episodes(), {"fps": 29.97}, "whole number of frames"),
        (episodes(cells=6), {}, "covering 6 cells, got 5"),
        (episodes(), {"skin": dict(reversed(SKIN.items()))}, "start at cell 0"),
        (episodes(), {"skin": {**SKIN, "hand": replace(SKIN["hand"], unit="kPa")}}, "one unit"),
        (
            episodes(),
            {"skin": {**SKIN, "hand": replace(SKIN["hand"], normals=np.ones((2, 3)))}},
            "normals of patch 'hand' of shape \\(3, 3\\), got \\(2, 3\\)",
        ),
    ],
)
def test_what_cannot_be_read_back_is_not_written(tmp_path, recorded, options, message):
    with pytest.raises(ValueError, match=message):
        record(tmp_path / "set", recorded, **options)
    assert list(tmp_path.iterdir()) == []


def test_the_skin_of_a_robot():
    skin = SimpleNamespace(
        patches=("wrist", "hand"),
        slices={"wrist": slice(0, 1), "hand": slice(1, 3)},
        link={"wrist": "arm", "hand": "palm"},
        positions=np.arange(9.0).reshape(3, 3),
        normals=np.eye(3),
        points=np.arange(27.0).reshape(3, 3, 3),
    )
    patches = skin_patches(skin)
    assert list(patches) == ["wrist", "hand"]
    assert patches["hand"].link == "palm"
    np.testing.assert_array_equal(patches["hand"].positions, skin.positions[1:])
    np.testing.assert_array_equal(patches["hand"].points, skin.points[1:])


def test_card(tmp_path):
    folder = record(tmp_path / "set")
    path = write_card(
        folder,
        title='Touched arm: "soft"',
        summary="An arm that yields.",
        recording="Pushed with a finger.",
        command="python record.py --out set",
    )
    text = path.read_text()
    front = text.split("---")[1]
    from huggingface_hub import DatasetCard

    card = DatasetCard.load(path)
    assert card.data.license == "apache-2.0"
    assert card.data.task_categories == ["robotics"]
    assert "LeRobot" in card.data.tags
    assert card.data.pretty_name == 'Touched arm: "soft"'
    assert "data/*/*.parquet" in front
    for expected in (
        "An arm that yields.",
        "Pushed with a finger.",
        "python record.py --out set",
        "3 episodes, 16 frames, 0.3 s",
        "| `observation.tactile` | (15,) | N |",
        "| push up | 2 |",
        "| `lift` | m |",
        "| `wrist` | arm | 2 | 100.0 |",
    ):
        assert expected in text
    assert len(read(folder)) == 16
