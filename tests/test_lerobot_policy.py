"""The policy in LeRobot: what it stores, rolls out, saves and loads, and how it is found."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from safetensors.torch import load_file, save_file

from hasm_torch import HASM
from hasm_torch.config import HASMConfig as Settings
from hasm_torch.data import load_episodes
from hasm_torch.data.body import body_of
from hasm_torch.lerobot.configuration_hasm import HASMConfig
from hasm_torch.lerobot.modeling_hasm import HASMPolicy

REPOSITORY = Path(__file__).parents[1]
PLUGINS = REPOSITORY / "plugins"
ROOT, OTHER = REPOSITORY / "datasets" / "hsr_compliance", REPOSITORY / "datasets" / "hsr_grasp"
STATE, TACTILE, ACTION = "observation.state", "observation.tactile", "action"
SHOWN = (1, 4, 10)  # episodes of different behaviours and forces


@pytest.fixture(scope="module")
def data():
    return load_episodes(ROOT)


def new_policy(root=ROOT, **config):
    config = HASMConfig(device="cpu", push_to_hub=False, **config)
    return make_policy(config, ds_meta=LeRobotDatasetMetadata("local/set", root=root))


def batch_of(data, episodes, every=40):
    """Frames of some episodes, shuffled as training shuffles them."""
    starts = np.cumsum([0, *(len(episode) for episode in data)])
    rows = [(i, t) for i in episodes for t in range(0, len(data.episodes[i]), every)]
    rows = np.random.default_rng(0).permutation(rows)
    column = {
        key: np.stack([getattr(data.episodes[i], name)[t].ravel() for i, t in rows])
        for key, name in ((STATE, "state"), (ACTION, "action"), (TACTILE, "tactile"))
    }
    column["episode_index"] = rows[:, 0]
    column["index"] = starts[rows[:, 0]] + rows[:, 1]
    return {key: torch.from_numpy(values) for key, values in column.items()}


@pytest.fixture(scope="module")
def model(data):
    """What HASM.fit itself makes of the episodes."""
    model = HASM(Settings(), body_of(data))
    model.fit(data.episodes[i] for i in SHOWN)
    return model


@pytest.fixture(scope="module")
def trained(data):
    policy = new_policy()
    policy.forward(batch_of(data, SHOWN))
    return policy.eval()


@pytest.fixture
def checkpoint(trained, tmp_path):
    """A directory as LeRobot's training writes it."""
    trained.save_pretrained(tmp_path / "lerobot")
    stats = LeRobotDatasetMetadata("local/set", root=ROOT).stats
    for steps in make_pre_post_processors(trained.config, dataset_stats=stats):
        steps.save_pretrained(tmp_path / "lerobot")
    return tmp_path / "lerobot"


def assert_same(first, second):
    first, second = first.state_dict(), second.state_dict()
    assert first.keys() == second.keys()
    for name, values in first.items():
        assert torch.equal(values, second[name]), name


def observations(data, episodes, steps=120):
    """Observations of one robot an episode, from the touch on: (steps, robots, ...)."""
    begin = 10
    for t in range(begin, begin + steps):
        rows = [data.episodes[i] for i in episodes]
        yield {
            STATE: torch.from_numpy(np.stack([row.state[t] for row in rows])),
            TACTILE: torch.from_numpy(np.stack([row.tactile[t].ravel() for row in rows])),
        }


def roll_out(policy, data, episodes):
    policy.reset()
    with torch.inference_mode():
        steps = [policy.select_action(o).clone() for o in observations(data, episodes)]
    return torch.stack(steps)


# ---------------------------------------------------------------------------------- training


def test_training_stores_what_fit_stores(trained, model):
    assert_same(trained.model, model)
    assert trained.config.episodes == list(SHOWN)


def test_memories_depend_on_the_episodes_shown_alone(data, model):
    policy = new_policy()
    for episodes in ((10,), (1, 10), (4, 1), (10, 4)):
        policy.forward(batch_of(data, episodes))
    assert_same(policy.model, model)


def test_held_out_episodes_are_measured_but_not_stored(data, trained, model):
    loss, figures = trained.forward(batch_of(data, (2, 7)))
    assert 0 < loss.item() < 0.2
    assert figures["episodes"] == len(SHOWN)
    assert_same(trained.model, model)


def test_loss_is_the_mean_distance_of_recalled_and_recorded_targets(data, trained, model):
    batch = batch_of(data, (4,), every=25)
    loss, figures = trained.forward(batch)
    episode = data.episodes[4]
    skin = torch.from_numpy(episode.tactile)
    counts = model.skin(skin)[0]
    errors = []
    for frame in range(0, len(episode), 25):
        for patch in model.memories:
            index = model.body.patches.index(patch)
            if counts[frame, index] == 0:
                continue
            window = counts[max(0, frame - 9) : frame + 1, index]  # 0.2 s
            density = torch.clamp(window.sum() / 0.2 / 800.0, max=1.0)
            joints = model.memory(patch).joints
            recalled, _ = model.memory(patch)(
                torch.from_numpy(episode.state[frame])[joints], density
            )
            errors += (recalled - torch.from_numpy(episode.action[frame])[joints]).abs().tolist()
    assert len(errors) > 10
    assert loss.item() == pytest.approx(np.mean(errors), rel=1e-5)
    assert figures["associations"] == sum(s.capacity for s in model.shapes.values())
    loss.backward()  # LeRobot's loop needs a gradient, even if it is zero
    assert float(trained.anchor.grad) == 0.0


def test_batches_of_a_lerobot_dataset_are_understood(data, model):
    policy = new_policy()
    dataset = LeRobotDataset("local/set", root=ROOT, episodes=list(SHOWN), video_backend="pyav")
    loader = torch.utils.data.DataLoader(dataset, batch_size=len(dataset))
    loss, _ = policy.forward(next(iter(loader)))
    assert torch.isfinite(loss)
    assert_same(policy.model, model)


def test_resuming_adds_and_repeats_nothing(data, checkpoint, model):
    policy = new_policy_from(checkpoint, ROOT)
    policy.train()
    assert_same(policy.model, model)
    policy.forward(batch_of(data, (4,)))
    assert_same(policy.model, model)
    policy.forward(batch_of(data, (0,)))
    whole = HASM(Settings(), body_of(data))
    whole.fit(data.episodes[i] for i in (0, *SHOWN))
    assert_same(policy.model, whole)


def new_policy_from(checkpoint, root):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    return make_policy(config, ds_meta=LeRobotDatasetMetadata("local/set", root=root))


def test_another_dataset_takes_the_place_of_the_first(checkpoint, caplog):
    policy = new_policy_from(checkpoint, OTHER)
    assert "held another dataset" in caplog.text
    policy.train()
    policy.forward(batch_of(load_episodes(OTHER), (1,), every=100))
    assert policy.config.episodes == [1]


def test_another_body_is_refused(checkpoint):
    content = json.loads((checkpoint / "config.json").read_text())
    content["body"]["upper"][0] += 0.1
    (checkpoint / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"another body .*\(upper differ\)"):
        new_policy_from(checkpoint, ROOT)


def test_policy_without_dataset_or_checkpoint_is_refused():
    with pytest.raises(ValueError, match="needs a dataset"):
        HASMPolicy(HASMConfig(device="cpu"))


def test_missing_feature_is_named(data):
    features = new_policy().config.input_features
    del features[TACTILE]
    with pytest.raises(ValueError, match=r"missing: observation.tactile"):
        HASMConfig(device="cpu", input_features=features).validate_features()


# ---------------------------------------------------------------------------------- rollouts


def test_policy_steps_as_the_model_does(data, trained, model):
    targets = roll_out(trained, data, [4])[:, 0]
    model.reset()
    expected = [model.step(o[STATE][0], o[TACTILE][0]) for o in observations(data, [4])]
    assert torch.equal(targets, torch.stack(expected))
    assert float(targets[:, 1].max() - targets[:, 1].min()) > 0.01


def test_robots_of_a_batch_do_not_disturb_each_other(data, trained):
    together = roll_out(trained, data, SHOWN)
    for column, episode in enumerate(SHOWN):
        assert torch.equal(together[:, column], roll_out(trained, data, [episode])[:, 0])
    assert float(together.amax(0).sub(together.amin(0)).amax(-1).min()) > 0.01  # all three moved


def test_reset_begins_anew(data, trained):
    assert torch.equal(roll_out(trained, data, [1]), roll_out(trained, data, [1]))


def test_chunk_is_one_action(data, trained):
    trained.reset()
    observation = next(observations(data, SHOWN))
    chunk = trained.predict_action_chunk(observation)
    trained.reset()
    assert torch.equal(chunk[:, 0], trained.select_action(observation))
    assert chunk.shape == (3, 1, 8)


def test_batch_that_changes_size_is_refused(data, trained):
    trained.reset()
    trained.select_action(next(observations(data, SHOWN)))
    with pytest.raises(ValueError, match="3 robots"):
        trained.select_action(next(observations(data, SHOWN[:2])))
    trained.reset()


# ------------------------------------------------------------------------------- checkpoints


def test_model_loads_what_lerobot_wrote(checkpoint, model):
    assert_same(HASM.from_pretrained(checkpoint), model)


def test_lerobot_loads_what_the_model_wrote(data, model, trained, tmp_path):
    model.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--device=cpu"])
    policy = HASMPolicy.from_pretrained(tmp_path, config=config)
    assert_same(policy.model, model)
    assert torch.equal(roll_out(policy, data, [10]), roll_out(trained, data, [10]))
    assert config.input_features == trained.config.input_features
    assert config.output_features == trained.config.output_features


@pytest.mark.parametrize("writer", ["model", "lerobot"])
def test_processors_change_no_value(data, model, checkpoint, tmp_path, writer):
    directory = checkpoint
    if writer == "model":
        directory = tmp_path / "model"
        model.save_pretrained(directory)
    config = PreTrainedConfig.from_pretrained(directory, cli_overrides=["--device=cpu"])
    meta = LeRobotDatasetMetadata("local/set", root=ROOT)
    features = {**config.input_features, **config.output_features}
    norm = {"features": features, "norm_map": config.normalization_mapping, "stats": meta.stats}
    before, after = make_pre_post_processors(
        config,
        pretrained_path=str(directory),
        # what lerobot-train sets by name when it goes on from a checkpoint
        preprocessor_overrides={
            "device_processor": {"device": "cpu"},
            "normalizer_processor": norm,
            "rename_observations_processor": {"rename_map": {}},
        },
        postprocessor_overrides={"unnormalizer_processor": norm},
    )
    observation = next(observations(data, SHOWN))
    processed = before(observation)
    for key, values in observation.items():
        assert torch.equal(processed[key], values)
    action = torch.from_numpy(data.episodes[0].action[:3])
    assert torch.equal(after(action), action)


def test_part_of_a_memory_is_refused(checkpoint):
    path = checkpoint / "model.safetensors"
    weights = load_file(path)
    broken = {key: values for key, values in weights.items() if "successors" not in key}
    save_file(broken, path)
    with pytest.raises(ValueError, match="successors"):
        HASMPolicy.from_pretrained(checkpoint)
    empty = {k: torch.zeros_like(v) if k.endswith("count") else v for k, v in weights.items()}
    save_file(empty, path)
    with pytest.raises(ValueError, match="holds 0 associations"):
        HASMPolicy.from_pretrained(checkpoint)


def test_checkpoint_without_memories_is_refused(checkpoint):
    content = json.loads((checkpoint / "config.json").read_text())
    content["memories"] = {}
    (checkpoint / "config.json").write_text(json.dumps(content))
    weights = load_file(checkpoint / "model.safetensors")
    kept = {key: values for key, values in weights.items() if not key.startswith("memories")}
    save_file(kept, checkpoint / "model.safetensors")
    with pytest.raises(ValueError, match="holds no memory"):
        HASMPolicy.from_pretrained(checkpoint)


def test_untrained_policy_saves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="learned nothing"):
        new_policy().save_pretrained(tmp_path)


# ------------------------------------------------------------------- LeRobot's command lines


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Environment of a process in which both plugins are installed."""
    site = tmp_path_factory.mktemp("site")
    for source in sorted(PLUGINS.glob("lerobot_*")):
        name = tomllib.loads((source / "pyproject.toml").read_text())["project"]["name"]
        shutil.copytree(source / "src" / name, site / name)
        metadata = site / f"{name}-0.1.0.dist-info" / "METADATA"
        metadata.parent.mkdir()
        metadata.write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: 0.1.0\n")
    paths = os.pathsep.join([str(site), str(REPOSITORY)])
    return {**os.environ, "PYTHONPATH": paths, "HF_HUB_OFFLINE": "1", "ACCELERATE_USE_CPU": "true"}


OPTIONS = {
    "policy.type": "hasm",
    "policy.device": "cpu",
    "policy.push_to_hub": "false",
    "dataset.repo_id": "local/hsr_compliance",
    "dataset.root": ROOT,
    "dataset.episodes": list(SHOWN),
    "dataset.video_backend": "pyav",
    "batch_size": 32,
    "num_workers": 0,
    "steps": 2,
    "env_eval_freq": 0,
}

# lerobot-train, whose processes each save what they hold in the end.
TRAIN = """
import os, sys
from pathlib import Path
from lerobot.scripts import lerobot_train

policies, make_policy = [], lerobot_train.make_policy
lerobot_train.make_policy = lambda **given: policies.append(make_policy(**given)) or policies[0]
lerobot_train.main()
policies[0].save_pretrained(Path(__file__).parent / os.environ["RANK"])
"""


@pytest.fixture(scope="module")
def trained_by_two(installed, tmp_path_factory):
    """What lerobot-train leaves behind after training on two processes."""
    place = tmp_path_factory.mktemp("two")
    (place / "train.py").write_text(TRAIN)
    options = [f"--{key}={value}" for key, value in OPTIONS.items()]
    command = ["torch.distributed.run", "--standalone", "--nproc_per_node=2", place / "train.py"]
    done = subprocess.run(
        [sys.executable, "-m", *command, *options, f"--output_dir={place / 'train'}"],
        env=installed,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return place


def test_processes_hold_the_same_memories(trained_by_two, model):
    for rank in ("0", "1"):
        assert_same(HASM.from_pretrained(trained_by_two / rank), model)


def test_training_resumes_and_evaluates_in_the_loop(trained_by_two, model, monkeypatch, capfd):
    from lerobot.scripts.lerobot_train import train

    import hasm_torch.lerobot.env_hsr_touch  # noqa: F401  # registers the environment
    from hasm_torch.sim import HSRTouchEnv

    black = np.zeros((48, 64, 3), np.uint8)
    monkeypatch.setattr(HSRTouchEnv, "render", lambda self: black)  # pictures take most time
    checkpoints = trained_by_two / "train" / "checkpoints"
    last = checkpoints / "last" / "pretrained_model"
    assert_same(HASM.from_pretrained(last), model)
    resume = [f"--config_path={last / 'train_config.json'}", "--resume=true", "--steps=3"]
    evaluate = ["--env.type=hsr_touch", "--env.task=arm_down", "--env_eval_freq=1"]
    small = ["--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *resume, *evaluate, *small])
    train()
    assert (checkpoints / "last").resolve().name == "000003"
    assert_same(HASM.from_pretrained(last), model)
    assert "'pc_success': 100.0" in capfd.readouterr().err
