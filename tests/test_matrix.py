"""Every way into the library takes every kind of dataset, and all store the same, bit for bit."""

import json
import shutil

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy
from recordings import FPS, JOINTS, KINDS, PLACE, UNITS, assert_same, episodes, skin_of, write_all

from hasm_torch import HASM, HASMConfig
from hasm_torch.apps.rerun_recording import dataset_scenes
from hasm_torch.data import load_episodes, write_episodes
from hasm_torch.data.episodes import load_all
from hasm_torch.data.training import DatasetConfig, train
from hasm_torch.episode import ACTION, STATE
from hasm_torch.evaluation.open_loop import open_loop
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.lerobot.configuration_hasm import HASMConfig as PolicyConfig

ORDER = (2, 0, 1)  # of the joints, where they come otherwise


def several(kind, place):
    """The same episodes as two datasets."""
    made, half = episodes(kind), len(episodes(kind)) // 2
    roots = []
    for number, part in enumerate((made[:half], made[half:])):
        roots.append(place / f"{kind}{number}")
        bound = {PLACE: ["x", "y"]} if kind == "bound" else None
        parts = dict(joints=JOINTS, units=UNITS, skin=skin_of(kind), fps=FPS, robot_type="arm")
        write_episodes(roots[-1], part, observations=bound, **parts)
    return roots


def with_pictures(root, place):
    """The dataset with a camera, written by LeRobot itself."""
    old = LeRobotDataset("local/old", root=root)
    camera = {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]}
    own = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    features = {k: v for k, v in old.meta.features.items() if k not in own}
    new = LeRobotDataset.create(
        "local/new", FPS, {**features, "observation.images.front": camera},
        root=place, robot_type="arm", use_videos=False,
    )  # fmt: skip
    for episode in range(old.meta.total_episodes):
        for row in (r for r in old.hf_dataset if int(r["episode_index"]) == episode):
            frame = {key: row[key].numpy().reshape(features[key]["shape"]) for key in features}
            picture = np.zeros((8, 8, 3), np.uint8)
            new.add_frame({**frame, "observation.images.front": picture, "task": "touch"})
        new.save_episode()
    new.finalize()
    return place


def with_actions_in_another_order(root, place):
    shutil.copytree(root, place)
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = place / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"][ACTION]["names"] = [info["features"][ACTION]["names"][i] for i in ORDER]
    path.write_text(json.dumps(info))
    for file in place.glob("data/*/*.parquet"):
        table = pq.read_table(file)
        rows = [[row[i] for i in ORDER] for row in table[ACTION].to_pylist()]
        column = pa.array(rows, type=table.schema.field(ACTION).type)
        table = table.set_column(table.schema.get_field_index(ACTION), ACTION, column)
        pq.write_table(table, file)
    return place


def policy_of(root):
    """What ``lerobot-train`` makes of all episodes."""
    meta = LeRobotDatasetMetadata("local/set", root=root)
    policy = make_policy(PolicyConfig(device="cpu", push_to_hub=False), ds_meta=meta)
    numbers = torch.arange(meta.total_episodes)
    policy.forward({"episode_index": numbers})
    return policy.eval()


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    return write_all(tmp_path_factory.mktemp("kinds"))


@pytest.fixture(scope="module")
def models(roots):
    return {kind: train(root, HASMConfig()).model for kind, root in roots.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_several_datasets_are_learned_as_one(models, tmp_path, kind):
    parts = several(kind, tmp_path)
    data = load_all(parts)
    assert [episode.index for episode in data] == list(range(len(episodes(kind))))
    assert_same(train(parts, HASMConfig()).model, models[kind])
    assert len(dataset_scenes(parts).time) == sum(len(episode) for episode in data)


@pytest.mark.parametrize("kind", ["bound"])
def test_open_loop_takes_several_datasets(roots, tmp_path, kind):
    figures = []
    for number, folders in enumerate(([roots[kind]], several(kind, tmp_path))):
        dataset = DatasetConfig(folders[0], folders[1:])
        out = tmp_path / f"out{number}"
        open_loop(EvalConfig(mode="open_loop", dataset=dataset, folds=2, output_dir=out))
        figures.append(json.loads((out / "open_loop.json").read_text()))
    told = [{k: v for k, v in f.items() if k not in ("dataset", "seconds")} for f in figures]
    assert told[0] == told[1]


@pytest.mark.parametrize("kind", ["forces", "none"])
def test_cameras_are_ignored_with_a_word(roots, models, tmp_path, kind):
    root = with_pictures(roots[kind], tmp_path / "filmed")
    trained = train(root, HASMConfig())
    assert_same(trained.model, models[kind])
    assert "takes no pictures: observation.images.front" in str(trained)
    assert "pictures" not in str(train(roots[kind], HASMConfig()))
    assert_same(policy_of(root).model, models[kind])


@pytest.mark.parametrize("kind", ["forces", "none"])
def test_actions_may_come_in_another_order_than_the_state(roots, models, tmp_path, kind):
    root = with_actions_in_another_order(roots[kind], tmp_path / "mixed")
    for mixed, plain in zip(load_episodes(root), load_episodes(roots[kind])):
        np.testing.assert_array_equal(mixed.action, plain.action)
    assert_same(train(root, HASMConfig()).model, models[kind])
    policy = policy_of(root)
    assert_same(policy.model, models[kind])
    state = torch.tensor([[0.3, 0.2, 0.1]])
    batch = {STATE: state}
    if kind == "forces":
        batch["observation.tactile"] = torch.full((1, 12), 2.0)
    target = policy.select_action(batch)[0]
    expected = models[kind].new_rollout(), batch.get("observation.tactile", [None])[0]
    plain = models[kind].step(state[0], expected[1], expected[0])
    assert torch.equal(target, plain[list(ORDER)])
    # and so it is in a checkpoint that train.py wrote
    train(root, HASMConfig()).model.save_pretrained(tmp_path / "saved")
    assert HASM.from_pretrained(tmp_path / "saved").body.targets == [JOINTS[i] for i in ORDER]


def test_datasets_that_differ_are_not_learned_together(roots):
    with pytest.raises(ValueError, match="must have the same skin"):
        load_all([roots["forces"], roots["pressures"]])
    with pytest.raises(ValueError, match="must have the same observations"):
        load_all([roots["forces"], roots["bound"]])
