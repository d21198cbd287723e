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
from recordings import KINDS, PLACE, assert_same, write_all
from safetensors.torch import load_file, save_file

from hasm_torch import HASM
from hasm_torch.config import HASMConfig as Settings
from hasm_torch.data import load_episodes, write_episodes
from hasm_torch.data.body import body_of
from hasm_torch.data.training import train as train_py
from hasm_torch.episode import ACTION, STATE, TACTILE
from hasm_torch.lerobot.configuration_hasm import HASMConfig
from hasm_torch.lerobot.modeling_hasm import HASMPolicy

REPOSITORY = Path(__file__).parents[1]
PLUGINS = REPOSITORY / "plugins"
HSR = REPOSITORY / "datasets" / "hsr_compliance"
SHOWN = (0, 3, 4)  # episodes that bend and stretch
COLUMNS = {STATE: "state", ACTION: "action", TACTILE: "tactile", PLACE: "observations"}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    return write_all(tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def root(roots):
    return roots["forces"]


@pytest.fixture(scope="module")
def data(root):
    return load_episodes(root)


def new_policy(root, **config):
    config = HASMConfig(device="cpu", push_to_hub=False, **config)
    return make_policy(config, ds_meta=LeRobotDatasetMetadata("local/set", root=root))


def batch_of(data, episodes, every=8):
    """Frames of some episodes, shuffled as training shuffles them."""
    starts = np.cumsum([0, *(len(episode) for episode in data)])
    rows = [(i, t) for i in episodes for t in range(0, len(data.episodes[i]), every)]
    rows = np.random.default_rng(0).permutation(rows)
    column = {
        key: np.stack([getattr(data.episodes[i], name)[t].ravel() for i, t in rows])
        for key, name in COLUMNS.items()
        if getattr(data.episodes[0], name) is not None
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
def trained(root, data):
    policy = new_policy(root)
    policy.forward(batch_of(data, SHOWN))
    return policy.eval()


@pytest.fixture
def checkpoint(trained, root, tmp_path):
    """A directory as LeRobot's training writes it."""
    trained.save_pretrained(tmp_path / "lerobot")
    stats = LeRobotDatasetMetadata("local/set", root=root).stats
    for steps in make_pre_post_processors(trained.config, dataset_stats=stats):
        steps.save_pretrained(tmp_path / "lerobot")
    return tmp_path / "lerobot"


def observations(data, episodes, steps=60):
    """Observations of one robot an episode, from the touch on: (steps, robots, ...)."""
    begin = 10
    for t in range(begin, begin + steps):
        rows = [data.episodes[i] for i in episodes]
        yield {
            key: torch.from_numpy(np.stack([getattr(row, name)[t].ravel() for row in rows]))
            for key, name in COLUMNS.items()
            if key != ACTION and getattr(rows[0], name) is not None
        }


def roll_out(step, data, episodes, steps=60):
    """Targets of robots that reach them at once, while the skin feels the episodes' touches."""
    targets = []
    with torch.inference_mode():
        for observation in observations(data, episodes, steps):
            if targets:
                observation[STATE] = targets[-1]
            targets.append(step(observation).clone())
    return torch.stack(targets)


def follow(policy, data, episodes):
    policy.reset()
    return roll_out(policy.select_action, data, episodes)


# ---------------------------------------------------------------------------------- training


def test_training_stores_what_fit_stores(trained, model):
    assert_same(trained.model, model)
    assert trained.config.episodes == list(SHOWN)


@pytest.mark.parametrize("kind", KINDS)
def test_lerobot_and_train_py_store_the_same(roots, kind):
    """Whatever the skin reads, and whatever else is bound; held as one policy and one model."""
    data, policy = load_episodes(roots[kind]), new_policy(roots[kind])
    policy.forward(batch_of(data, range(len(data))))
    trained = train_py(roots[kind], Settings())
    assert_same(policy.model, trained.model)
    assert policy.config.settled == trained.model.settled
    assert (TACTILE in policy.config.input_features) == (kind != "none")


def test_memory_depends_on_the_episodes_shown_alone(data, root, model):
    policy = new_policy(root)
    for episodes in ((4,), (0, 4), (3, 0), (4, 3)):
        policy.forward(batch_of(data, episodes))
    assert_same(policy.eval().model, model)


def test_memory_is_built_anew_when_enough_new_episodes_came(data, root, monkeypatch):
    policy, fitted, fit = new_policy(root), [], HASM.fit

    def watched(self, episodes):
        episodes = list(episodes)
        fitted.append([episode.index for episode in episodes])
        return fit(self, episodes)

    monkeypatch.setattr(HASM, "fit", watched)
    for number in range(8):
        _, figures = policy.forward(batch_of(data, (number,), every=40))
    assert [len(episodes) for episodes in fitted] == [1, 2, 3, 5, 8]
    assert figures["episodes"] == 8
    policy.forward(batch_of(data, (0, 7)))
    assert len(fitted) == 5
    late = new_policy(root)
    late.forward(batch_of(data, range(6)))
    late.forward(batch_of(data, (7,)))
    assert fitted[5:] == [list(range(6))]
    late.eval()  # what is used holds all that was shown
    assert late.config.episodes == fitted[-1] == [0, 1, 2, 3, 4, 5, 7]


def test_held_out_episodes_are_measured_but_not_stored(data, trained, model):
    loss, figures = trained.forward(batch_of(data, (2, 7)))
    assert 0 < loss.item() < 0.2
    assert figures == {"episodes": len(SHOWN), "associations": model.settled.capacity}
    assert_same(trained.model, model)
    loss.backward()  # LeRobot's loop needs a gradient, even if it is zero
    assert float(trained.anchor.grad) == 0.0


def test_loss_is_the_mean_error_of_predictions(data, trained, model):
    loss, _ = trained.forward(batch_of(data, (2, 4)))
    expected = []
    for index in (2, 4):
        state = data.episodes[index].state
        moved, frames = model.predict(data.episodes[index], 5, 8)
        assert len(frames) == 8
        expected.append(np.abs(moved + state[frames] - state[frames + 5]).mean())
    assert loss.item() == pytest.approx(np.mean(expected), rel=1e-5)


def test_batches_of_a_lerobot_dataset_are_understood(root, model):
    policy = new_policy(root)
    dataset = LeRobotDataset("local/set", root=root, episodes=list(SHOWN), video_backend="pyav")
    loader = torch.utils.data.DataLoader(dataset, batch_size=len(dataset))
    loss, _ = policy.forward(next(iter(loader)))
    assert torch.isfinite(loss)
    assert_same(policy.model, model)


def new_policy_from(checkpoint, root):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    return make_policy(config, ds_meta=LeRobotDatasetMetadata("local/set", root=root))


def test_resuming_adds_and_repeats_nothing(data, root, checkpoint, model):
    policy = new_policy_from(checkpoint, root)
    policy.train()
    assert_same(policy.model, model)
    policy.forward(batch_of(data, (4,)))
    assert_same(policy.model, model)
    policy.forward(batch_of(data, (1, 2)))
    whole = HASM(Settings(), body_of(data))
    whole.fit(data.episodes[i] for i in sorted((1, 2, *SHOWN)))
    assert_same(policy.model, whole)


def test_another_dataset_takes_the_place_of_the_first(checkpoint, data, tmp_path, caplog):
    fewer = write_episodes(
        tmp_path / "fewer", data.episodes[:5], joints=data.joints, units=data.units,
        skin=data.skin, fps=int(data.fps), robot_type="made",
    )  # fmt: skip
    content = json.loads((checkpoint / "config.json").read_text())
    content["body"] |= vars(body_of(load_episodes(fewer)))
    (checkpoint / "config.json").write_text(json.dumps(content))
    policy = new_policy_from(checkpoint, fewer)
    assert "held another dataset" in caplog.text
    policy.train()
    policy.forward(batch_of(load_episodes(fewer), (1,)))
    assert policy.config.episodes == [1]


def test_another_body_is_refused(checkpoint, root):
    content = json.loads((checkpoint / "config.json").read_text())
    content["body"]["upper"][0] += 0.1
    (checkpoint / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"another body .*\(upper differ\)"):
        new_policy_from(checkpoint, root)


def test_policy_without_dataset_or_checkpoint_is_refused():
    with pytest.raises(ValueError, match="needs a dataset"):
        HASMPolicy(HASMConfig(device="cpu"))
    with pytest.raises(ValueError, match="knows no body yet"):
        HASMConfig(device="cpu").validate_features()


@pytest.mark.parametrize("feature", [STATE, TACTILE, PLACE, ACTION])
def test_missing_or_misshapen_feature_is_named(roots, feature):
    config = new_policy(roots["bound"]).config
    features = config.output_features if feature == ACTION else config.input_features
    features[feature].shape = (7,)
    with pytest.raises(ValueError, match=rf"needs {feature} with \d+ entries, got shape \(7,\)"):
        config.validate_features()
    del features[feature]
    with pytest.raises(ValueError, match=rf"missing: {feature}; there are: "):
        config.validate_features()


def test_what_is_bound_can_be_named(roots):
    policy = new_policy(roots["bound"], bound=[])
    assert policy.model.body.observations == {}
    data = load_episodes(roots["bound"])
    policy.forward(batch_of(data, (0, 1)))
    assert follow(policy.eval(), data, [0]).shape == (60, 1, 3)


# ---------------------------------------------------------------------------------- rollouts


@pytest.mark.parametrize("kind", KINDS)
def test_policy_steps_as_the_model_does(roots, kind):
    data, policy = load_episodes(roots[kind]), new_policy(roots[kind])
    policy.forward(batch_of(data, range(4)))
    model = policy.eval().model
    targets = follow(policy, data, [2])
    model.reset()

    def step(observation):
        skin = None if kind == "none" else observation[TACTILE][0]
        seen = observation[PLACE][0] if kind == "bound" else None
        return model.step(observation[STATE][0], skin, observation=seen)[None]

    assert torch.equal(targets, roll_out(step, data, [2]))
    assert float(targets[:, 0, 0].max() - targets[:, 0, 0].min()) > 0.1


def test_robots_of_a_batch_do_not_disturb_each_other(data, trained):
    together = follow(trained, data, SHOWN)
    for column, episode in enumerate(SHOWN):
        assert torch.equal(together[:, column], follow(trained, data, [episode])[:, 0])
    assert float(together.amax(0).sub(together.amin(0)).amax(-1).min()) > 0.1  # all three moved


def test_reset_begins_anew(data, trained):
    assert torch.equal(follow(trained, data, [3]), follow(trained, data, [3]))


def test_chunk_is_one_action(data, trained):
    trained.reset()
    observation = next(observations(data, SHOWN))
    chunk = trained.predict_action_chunk(observation)
    trained.reset()
    assert torch.equal(chunk[:, 0], trained.select_action(observation))
    assert chunk.shape == (3, 1, 3)


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
    assert torch.equal(follow(policy, data, [4]), follow(trained, data, [4]))
    assert config.input_features == trained.config.input_features
    assert config.output_features == trained.config.output_features


@pytest.mark.parametrize("kind", ["none", "bound", "wrench"])
def test_lerobot_loads_every_kind_that_train_py_wrote(roots, tmp_path, kind):
    train_py(roots[kind], Settings()).model.save_pretrained(tmp_path)
    policy, data = HASMPolicy.from_pretrained(tmp_path), load_episodes(roots[kind])
    declared = set(policy.config.input_features)
    assert declared == {STATE} | ({TACTILE} - {kind == "none" and TACTILE}) | (
        {PLACE} if kind == "bound" else set()
    )
    targets = follow(policy, data, [1])
    assert float(targets[:, 0, 0].max() - targets[:, 0, 0].min()) > 0.1


@pytest.mark.parametrize("writer", ["model", "lerobot"])
def test_processors_change_no_value(data, root, model, checkpoint, tmp_path, writer):
    directory = checkpoint
    if writer == "model":
        directory = tmp_path / "model"
        model.save_pretrained(directory)
    config = PreTrainedConfig.from_pretrained(directory, cli_overrides=["--device=cpu"])
    meta = LeRobotDatasetMetadata("local/set", root=root)
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
    with pytest.raises(ValueError, match="0 associations held, expected"):
        HASMPolicy.from_pretrained(checkpoint)


def test_checkpoint_without_memory_is_refused(checkpoint):
    content = json.loads((checkpoint / "config.json").read_text())
    content["settled"] = None
    (checkpoint / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="holds no memory"):
        HASMPolicy.from_pretrained(checkpoint)


def test_untrained_policy_saves_nothing(root, tmp_path):
    with pytest.raises(RuntimeError, match="learned nothing"):
        new_policy(root).save_pretrained(tmp_path)


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


def options(**more):
    """Options of lerobot-train."""
    usual = {
        "policy.type": "hasm",
        "policy.device": "cpu",
        "policy.push_to_hub": "false",
        "dataset.repo_id": "local/set",
        "dataset.video_backend": "pyav",
        "batch_size": 32,
        "num_workers": 0,
        "env_eval_freq": 0,
    }
    return [f"--{key.replace('__', '.')}={value}" for key, value in {**usual, **more}.items()]


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
def trained_by_two(installed, root, tmp_path_factory):
    """What lerobot-train leaves behind after training on two processes."""
    place = tmp_path_factory.mktemp("two")
    (place / "train.py").write_text(TRAIN)
    given = options(
        dataset__root=root, dataset__episodes=list(SHOWN), steps=2, output_dir=place / "train"
    )
    command = ["torch.distributed.run", "--standalone", "--nproc_per_node=2", place / "train.py"]
    done = subprocess.run(
        [sys.executable, "-m", *command, *given], env=installed, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return place


def test_processes_hold_the_same_memory(trained_by_two, model):
    for rank in ("0", "1"):
        assert_same(HASM.from_pretrained(trained_by_two / rank), model)


def test_training_resumes(trained_by_two, model, monkeypatch):
    from lerobot.scripts.lerobot_train import train

    checkpoints = trained_by_two / "train" / "checkpoints"
    last = checkpoints / "last" / "pretrained_model"
    assert_same(HASM.from_pretrained(last), model)
    resume = [f"--config_path={last / 'train_config.json'}", "--resume=true", "--steps=3"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *resume])
    train()
    assert (checkpoints / "last").resolve().name == "000003"
    assert_same(HASM.from_pretrained(last), model)


def test_training_evaluates_in_the_loop(tmp_path, monkeypatch, capfd):
    from lerobot.scripts.lerobot_train import train

    import hasm_torch.lerobot.env_hsr_touch as env  # registers the environment
    from hasm_torch.lerobot.human_env import DESCRIPTIONS
    from hasm_torch.sim import HSRTouchEnv

    black = np.zeros((48, 64, 3), np.uint8)
    monkeypatch.setattr(HSRTouchEnv, "render", lambda self: black)  # pictures take most time
    task = env.TASKS[0]
    shown = [e.index for e in load_episodes(HSR) if e.task == DESCRIPTIONS[task]]
    given = options(
        dataset__root=HSR, dataset__episodes=shown, steps=1, output_dir=tmp_path / "train",
        batch_size=64, env__type="hsr_touch", env__task=task, eval__n_episodes=2,
        eval__batch_size=2, eval__use_async_envs="false",
    )  # fmt: skip
    given.remove("--env_eval_freq=0")
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *given, "--env_eval_freq=1"])
    train()
    assert "'pc_success': 100.0" in capfd.readouterr().err
