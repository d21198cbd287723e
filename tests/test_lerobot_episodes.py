"""Reading datasets: layouts, names, units and every way in which a dataset is broken."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hasm_torch.data import FeatureMap, load_episodes

FPS = 10
LENGTHS = (4, 1, 7)
RECORDINGS = Path(__file__).parents[2] / "shared" / "data"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def feature(shape, **more):
    return {"dtype": "float32", "shape": list(shape), "names": None, **more}


def nested(values: np.ndarray, fixed: bool) -> pa.Array:
    """An array of any dimension as a column of (nested) lists."""
    column = pa.array(values.reshape(-1))
    for i in range(values.ndim - 1, 0, -1):
        width = values.shape[i]
        if fixed:
            column = pa.FixedSizeListArray.from_arrays(column, width)
        else:
            offsets = np.arange(0, len(column) + 1, width, dtype=np.int32)
            column = pa.ListArray.from_arrays(offsets, column)
    return column


def write(root: Path, columns: dict, features: dict, *, fixed=True, files=1, tasks=("a", "b")):
    """A LeRobot v3.0 dataset written by hand, so that reading is checked against its definition."""
    starts = np.concatenate([[0], np.cumsum(LENGTHS)])
    frame = np.concatenate([np.arange(n) for n in LENGTHS])
    episode = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    table = {
        **{key: nested(np.asarray(value), fixed) for key, value in columns.items()},
        "timestamp": pa.array((frame / FPS).astype(np.float32)),
        "frame_index": pa.array(frame),
        "episode_index": pa.array(episode),
        "index": pa.array(np.arange(len(frame))),
        "task_index": pa.array(episode % len(tasks)),
    }
    file = np.minimum(np.arange(len(LENGTHS)), files - 1)
    for i in range(files):
        part = pa.table(table).filter(pa.array(file[episode] == i))
        path = root / f"data/chunk-000/file-{i:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(part, path)
    rows = {
        "episode_index": np.arange(len(LENGTHS)),
        "tasks": [[tasks[i % len(tasks)]] for i in range(len(LENGTHS))],
        "length": np.array(LENGTHS),
        "data/chunk_index": np.zeros(len(LENGTHS), dtype=np.int64),
        "data/file_index": file,
        "dataset_from_index": starts[:-1],
        "dataset_to_index": starts[1:],
    }
    (root / EPISODES).parent.mkdir(parents=True)
    pq.write_table(pa.table(rows), root / EPISODES)
    task_rows = {"task_index": np.arange(len(tasks)), "task": list(tasks)}
    pq.write_table(pa.table(task_rows), root / "meta/tasks.parquet")
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    }
    (root / "meta/info.json").write_text(json.dumps(info))


def make(root: Path, tactile_shape=(6,), tactile_feature=None, **options) -> dict:
    rng = np.random.default_rng(0)
    frames = sum(LENGTHS)
    columns = {
        "observation.state": rng.normal(size=(frames, 2)).astype(np.float32),
        "action": rng.normal(size=(frames, 2)).astype(np.float32),
        "observation.tactile": rng.random((frames, *tactile_shape)).astype(np.float32),
    }
    features = {
        "observation.state": feature([2], names=["knee", "lift"], info={"units": ["rad", "m"]}),
        "action": feature([2], names=[["knee", "lift"]]),
        "observation.tactile": feature(tactile_shape, **(tactile_feature or {})),
    }
    write(root, columns, features, **options)
    return columns


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("whole") / "set"
    make(root)
    return root


@pytest.fixture
def broken(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "set"))


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("files", [1, 3])
def test_every_frame_of_every_episode(tmp_path, fixed, files):
    columns = make(tmp_path / "set", fixed=fixed, files=files)
    data = load_episodes(str(tmp_path / "set"))
    assert [len(e) for e in data] == list(LENGTHS)
    assert [e.index for e in data] == [0, 1, 2]
    assert [e.task for e in data] == ["a", "b", "a"]
    assert (data.fps, data.joints, data.units) == (FPS, ("knee", "lift"), ("rad", "m"))
    assert data.action_names == ("knee", "lift")
    for key, name in [("observation.state", "state"), ("action", "action")]:
        joined = np.concatenate([getattr(e, name) for e in data])
        assert joined.dtype == np.float32
        np.testing.assert_array_equal(joined, columns[key])
    tactile = np.concatenate([e.tactile for e in data])
    np.testing.assert_array_equal(tactile[..., 0], columns["observation.tactile"])
    np.testing.assert_allclose(data.episodes[2].time, np.arange(7) / FPS, rtol=1e-6)


WRENCH = ["fx", "fy", "fz", "tx", "ty", "tz"]


@pytest.mark.parametrize(
    ("shape", "extra", "layout"),
    [
        ((6,), {}, (6, 1)),
        ((6,), {"info": {"layout": [2, 3]}}, (2, 3)),
        ((12,), {"info": {"layout": [2, 2, 3]}}, (4, 3)),
        ((6,), {"names": WRENCH}, (1, 6)),
        ((6,), {"names": {"axes": WRENCH}}, (1, 6)),
        ((4, 3), {}, (4, 3)),
        ((4, 1), {}, (4, 1)),
        ((2, 4, 3), {}, (8, 3)),
        ((5, 4), {}, (20, 1)),
        ((2, 6), {}, (2, 6)),
        ((3, 3), {"info": {"layout": [3, 3, 1]}}, (9, 1)),
        ((1, 3), {}, (1, 3)),
    ],
)
def test_tactile_layouts(tmp_path, shape, extra, layout):
    columns = make(tmp_path / "set", shape, extra)
    data = load_episodes(tmp_path / "set")
    tactile = np.concatenate([e.tactile for e in data])
    assert tactile.shape == (sum(LENGTHS), *layout)
    np.testing.assert_array_equal(tactile.ravel(), columns["observation.tactile"].ravel())
    assert [p.cells for p in data.skin.values()] == [slice(0, layout[0])]


def test_skin_geometry(tmp_path):
    patches = [
        {"name": "wrist", "start": 0, "stop": 1, "link": "arm", "normals": [[0, 0, 1]]},
        {"name": "hand", "start": 1, "stop": 2, "link": "palm", "points": [[[1, 2, 3]] * 3]},
    ]
    info = {"unit": "N", "layout": [2, 3], "patches": patches}
    make(tmp_path / "set", (6,), {"info": info})
    skin = load_episodes(tmp_path / "set").skin
    assert list(skin) == ["wrist", "hand"]
    assert (skin["hand"].cells, skin["hand"].link, skin["hand"].unit) == (slice(1, 2), "palm", "N")
    np.testing.assert_array_equal(skin["wrist"].normals, [[0, 0, 1]])
    assert skin["hand"].points.shape == (1, 3, 3)
    assert skin["hand"].normals is None


def test_patches_given_by_name_share_the_cells(tmp_path):
    make(tmp_path / "set", (6,), {"info": {"patches": ["left", "right"]}})
    skin = load_episodes(tmp_path / "set").skin
    assert {name: p.cells for name, p in skin.items()} == {
        "left": slice(0, 3),
        "right": slice(3, 6),
    }


def test_a_dataset_without_skin_or_names(tmp_path):
    frames = sum(LENGTHS)
    columns = {"observation.state": np.zeros((frames, 2)), "action": np.zeros((frames, 3))}
    features = {"observation.state": feature([2]), "action": feature([3])}
    write(tmp_path / "set", columns, features)
    data = load_episodes(tmp_path / "set")
    assert data.skin is None
    assert data.episodes[0].tactile is None
    assert data.joints == ("observation.state.0", "observation.state.1")
    assert data.units == ("unknown", "unknown")
    assert data.episodes[0].action.shape == (4, 3)


def test_one_joint_is_stored_as_a_plain_number(tmp_path):
    values = np.arange(sum(LENGTHS), dtype=np.float32)
    features = {"observation.state": feature([1]), "action": feature([1])}
    write(tmp_path / "set", {"observation.state": values, "action": values}, features)
    data = load_episodes(tmp_path / "set")
    np.testing.assert_array_equal(data.episodes[2].state, values[5:, None])


def test_other_feature_names(whole):
    data = load_episodes(whole, FeatureMap(state="action", tactile=None))
    np.testing.assert_array_equal(data.episodes[0].state, data.episodes[0].action)
    assert data.skin is None


# Broken datasets: each must say what was expected, what came and where.


def test_missing_root_says_where_it_looked(tmp_path, whole):
    with pytest.raises(FileNotFoundError, match=r"nowhere.*does not exist.*write_episodes"):
        load_episodes(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"has no meta/info.json.*whole0/set"):
        load_episodes(whole.parent)


@pytest.mark.parametrize("name", [DATA, EPISODES, "meta/tasks.parquet"])
def test_missing_file(broken, name):
    (broken / name).unlink()
    with pytest.raises(FileNotFoundError, match=name.split("/chunk")[0]):
        load_episodes(broken)


@pytest.mark.parametrize("name", [DATA, EPISODES, "meta/tasks.parquet"])
@pytest.mark.parametrize("damage", ["empty", "cut", "text", "flipped"])
def test_damaged_file_is_named(broken, name, damage):
    path = broken / name
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[4:60] = bytes(56)
    else:
        content = {"empty": b"", "cut": content[: len(content) // 2], "text": b"no parquet"}[damage]
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{name}.*empty, truncated or damaged"):
        load_episodes(broken)


def edit_info(root: Path, change) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    change(info)
    (root / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"codebase_version": "v3.0", "fps": 10}'])
def test_damaged_info(broken, text):
    (broken / "meta/info.json").write_text(text)
    with pytest.raises(ValueError, match=r"codebase_version, fps and features in .*info\.json"):
        load_episodes(broken)


def test_older_format(broken):
    edit_info(broken, lambda info: info.update(codebase_version="v2.1"))
    with pytest.raises(ValueError, match=r"v3\.0.*v2\.1.*convert_dataset_v21_to_v30"):
        load_episodes(broken)


def test_missing_feature_lists_the_features(whole):
    with pytest.raises(ValueError, match=r"'observation.joints'.*'action', 'observation.state'"):
        load_episodes(whole, FeatureMap(state="observation.joints"))


def test_feature_that_is_no_number(broken):
    edit_info(broken, lambda info: info["features"]["action"].update(dtype="video"))
    with pytest.raises(ValueError, match="numbers in feature 'action', got video"):
        load_episodes(broken)


def replace_column(root: Path, key: str, values, name: str = DATA) -> None:
    table = pq.read_table(root / name)
    column = values if isinstance(values, pa.Array) else nested(np.asarray(values), True)
    pq.write_table(table.set_column(table.schema.get_field_index(key), key, column), root / name)


@pytest.mark.parametrize("key", ["observation.state", "observation.tactile", "action"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_not_finite_names_feature_episode_and_frame(broken, key, value):
    column = np.stack(pq.read_table(broken / DATA).column(key).to_pylist()).astype(np.float32)
    column[LENGTHS[0] + LENGTHS[1] + 3, 1] = value
    replace_column(broken, key, column)
    with pytest.raises(ValueError, match=f"'{key}', got {value} .* frame 3 of episode 2"):
        load_episodes(broken)


def test_mis_shaped_feature(broken):
    other = feature([5])
    edit_info(broken, lambda info: info["features"].update({"observation.state": other}))
    with pytest.raises(ValueError, match=r"observation.state.*expected shape \(5,\).*got \(2,\)"):
        load_episodes(broken)


def test_rows_of_unlike_length(broken):
    rows = pq.read_table(broken / DATA).column("action").to_pylist()
    rows[0], rows[1] = [1.0], [1.0, 2.0, 3.0]
    replace_column(broken, "action", pa.array(rows, pa.list_(pa.float32())))
    with pytest.raises(ValueError, match=r"'action'.*rows of 1 to 3 entries"):
        load_episodes(broken)


@pytest.mark.parametrize("missing", [[1.0, None], None])
def test_missing_values(broken, missing):
    rows = pq.read_table(broken / DATA).column("action").to_pylist()
    rows[2] = missing
    replace_column(broken, "action", pa.array(rows, pa.list_(pa.float32())))
    with pytest.raises(ValueError, match=r"'action'.*1 values are missing"):
        load_episodes(broken)


def test_text_where_numbers_belong(broken):
    replace_column(broken, "action", pa.array(["x"] * sum(LENGTHS)))
    with pytest.raises(ValueError, match=r"'action'.*expected numbers.*string"):
        load_episodes(broken)


def test_column_declared_but_not_there(broken):
    table = pq.read_table(broken / DATA).drop_columns(["action"])
    pq.write_table(table, broken / DATA)
    with pytest.raises(ValueError, match=r"Expected columns \['action'\] in .*file-000.parquet"):
        load_episodes(broken)


@pytest.mark.parametrize("frames", [0, sum(LENGTHS) - 2, sum(LENGTHS) + 3])
def test_fewer_or_more_frames_than_the_episodes_need(broken, frames):
    table = pq.read_table(broken / DATA)
    pq.write_table(pa.concat_tables([table, table]).slice(0, frames), broken / DATA)
    with pytest.raises(ValueError, match=f"Expected 12 frames .* got {frames}"):
        load_episodes(broken)


def test_frames_of_another_episode(broken):
    replace_column(broken, "episode_index", np.repeat([0, 2, 1], LENGTHS))
    with pytest.raises(ValueError, match=r"frame 4 .* episode 1, got episode 2"):
        load_episodes(broken)


def test_episodes_that_do_not_follow_each_other(broken):
    replace_column(broken, "dataset_from_index", np.array([0, 3, 5]), EPISODES)
    with pytest.raises(ValueError, match="follow each other"):
        load_episodes(broken)


def test_no_episodes(broken):
    pq.write_table(pq.read_table(broken / EPISODES).slice(0, 0), broken / EPISODES)
    with pytest.raises(ValueError, match="at least one episode"):
        load_episodes(broken)


def test_unknown_task(broken):
    replace_column(broken, "task_index", np.full(sum(LENGTHS), 2))
    with pytest.raises(ValueError, match=r"task numbers from 0 to 1 .* got 2"):
        load_episodes(broken)


@pytest.mark.parametrize("shift", [-0.2, -0.1, 0.03])
def test_time_that_does_not_run_at_the_frame_rate(broken, shift):
    time = pq.read_table(broken / DATA).column("timestamp").to_numpy().copy()
    time[8:] += np.float32(shift)
    replace_column(broken, "timestamp", time)
    with pytest.raises(ValueError, match=r"0\.1 s apart \(10 fps\).* frame 3 of episode 2"):
        load_episodes(broken)
    if shift > 0:
        assert len(load_episodes(broken, tolerance_s=0.05)) == 3


def test_wrong_fps(broken):
    edit_info(broken, lambda info: info.update(fps=50))
    with pytest.raises(ValueError, match=r"0\.02 s apart \(50 fps\), got a step of 0\.1 s"):
        load_episodes(broken)
    edit_info(broken, lambda info: info.update(fps=0))
    with pytest.raises(ValueError, match="positive frame rate"):
        load_episodes(broken)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"layout": [4, 3]}, "layout with 6 entries"),
        ({"layout": [3, 2]}, "layout with 6 entries"),
        ({"patches": ["a", "b", "c", "d"]}, "cannot be shared equally"),
        ({"patches": [{"name": "a", "start": 0}]}, "name, start, stop"),
        ({"patches": [{"name": "a", "start": 0, "stop": 7}]}, "cells within 0 to 6"),
        ({"patches": [{"name": "a", "start": 0, "stop": 2, "normals": [[0, 1]]}]}, "geometry"),
    ],
)
def test_geometry_that_does_not_fit(broken, info, message):
    edit_info(broken, lambda i: i["features"]["observation.tactile"].update(info=info))
    with pytest.raises(ValueError, match=message):
        load_episodes(broken)


def test_names_and_units_that_do_not_fit(broken):
    edit_info(broken, lambda i: i["features"]["observation.state"].update(names=["knee"]))
    with pytest.raises(ValueError, match=r"Expected 2 names for 'observation.state', got 1"):
        load_episodes(broken)
    change = {"names": None, "info": {"units": ["rad"]}}
    edit_info(broken, lambda i: i["features"]["observation.state"].update(change))
    with pytest.raises(ValueError, match="Expected 2 units"):
        load_episodes(broken)


def test_reading_does_not_import_lerobot(whole):
    code = (
        "import sys; from hasm_torch.data import load_episodes; assert 'pyarrow' not in "
        f"sys.modules; load_episodes({str(whole)!r}); assert 'lerobot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="real recordings are not at hand")
@pytest.mark.parametrize(
    ("name", "episodes", "frames", "joints", "tactile", "units"),
    [
        ("icub_grasp", 140, 1736, 9, (60, 1), "deg"),
        ("g1_inspire", 100, 35965, 26, None, "unknown"),
    ],
)
def test_real_recordings(name, episodes, frames, joints, tactile, units):
    data = load_episodes(RECORDINGS / name)
    assert (len(data), sum(map(len, data))) == (episodes, frames)
    assert len(data.joints) == len(data.units) == joints
    assert set(data.units) == {units}
    if tactile is None:
        assert data.skin is None
    else:
        assert data.episodes[0].tactile.shape[1:] == tactile
        assert [p.cells.start for p in data.skin.values()] == [0, 12, 24, 36, 48]
