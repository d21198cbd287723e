"""A saved model is the same model, and a damaged file is no model."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from toys import along, make_body, postures, press, record, smooth_path, spell, yielding

from hasm_torch import HASM, HASMConfig

BODY = make_body(3)
PATH = smooth_path(BODY, 200, 0, [0, 1])
BASED = make_body(3, base=True, observations={"observation.place": 2})


def fitted(config: HASMConfig | None = None) -> HASM:
    model = HASM(config or HASMConfig(), BODY)
    model.fit([record(BODY, "front", PATH, 6.0), record(BODY, "back", PATH[::-1], 6.0)])
    return model


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    directory = tmp_path_factory.mktemp("original")
    fitted().save_pretrained(directory)
    return directory


@pytest.fixture
def saved(original, tmp_path):
    return Path(shutil.copytree(original, tmp_path / "model"))


@pytest.mark.parametrize(
    "config",
    [
        HASMConfig(),
        HASMConfig(value="displacement", readout="mean"),
        HASMConfig(value="displacement", touch="direction", readout="first_order"),
        HASMConfig(value="successor"),
        HASMConfig(storage="int8"),
        HASMConfig(storage="bfloat16"),
        HASMConfig(storage="float32"),
        HASMConfig.literal(),
    ],
    ids=["goal", "mean", "law", "walk", "int8", "bfloat16", "float32", "literal"],
)
def test_a_loaded_model_takes_identical_steps(tmp_path, config):
    model = fitted(config)
    model.save_pretrained(tmp_path / "deep" / "model")
    loaded = HASM.from_pretrained(tmp_path / "deep" / "model")
    assert loaded.config == model.config
    assert loaded.body == model.body
    assert loaded.settled == model.settled
    start = torch.tensor(PATH[20], dtype=torch.float32)
    series = []
    for robot in (model, loaded):
        robot.reset()
        there = spell(robot, BODY, start, "front", 7.0, 40)
        series.append(torch.cat([there, spell(robot, BODY, there[-1], "back", 3.0, 20)]))
    assert torch.equal(*series)
    assert len(torch.unique(series[0][:, 0])) > 10  # it did move
    assert loaded.memory_bytes() == model.memory_bytes()
    assert (loaded.origins == model.origins).all()
    assert torch.equal(loaded.tolerance, model.tolerance)


def test_base_chains_and_observations_travel_along(tmp_path):
    episodes = []
    for i, q in enumerate(postures(BASED, 4, 0)):
        episode = yielding(BASED, along(BASED), q, [(None, 10), ("front", 30), (None, 10)])
        episode.observations = torch.tensor([[0.1 * i, 1.0 - i]]).expand(50, 2).numpy()
        episodes.append(episode)
    model = HASM(HASMConfig(value="displacement"), BASED)
    model.fit(episodes)
    model.save_pretrained(tmp_path)
    loaded = HASM.from_pretrained(tmp_path)
    assert loaded.body == BASED  # with joints that have no limits, as JSON
    state = torch.tensor(postures(BASED, 1, 5)[0]).float()
    seen = torch.tensor([0.2, 0.3])
    for _ in range(8):
        one, other = (m.step(state, press(BASED, "front", 6.0), None, seen)
                      for m in (model, loaded))  # fmt: skip
        assert torch.equal(one, other)
    assert (one - state).abs().max() > 0.005


def test_a_checkpoint_says_what_a_policy_needs(saved):
    content = json.loads((saved / "config.json").read_text())
    assert content["type"] == "hasm"
    assert content["input_features"] == {
        "observation.state": {"type": "STATE", "shape": [3]},
        "observation.tactile": {"type": "STATE", "shape": [18]},
    }
    assert content["output_features"] == {"action": {"type": "ACTION", "shape": [3]}}
    for name in ("preprocessor", "postprocessor"):
        assert json.loads((saved / f"policy_{name}.json").read_text())["steps"]


def test_saving_again_replaces_the_model(saved):
    model = HASM(HASMConfig(neurons=6), BODY)
    model.fit([record(BODY, "side", PATH, 6.0)])
    model.save_pretrained(saved)
    loaded = HASM.from_pretrained(saved)
    assert loaded.patches == ["side"]
    assert loaded.config.neurons == 6
    assert not list(saved.glob("*.partial"))


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"no {name} in checkpoint"):
        HASM.from_pretrained(saved)


def test_a_missing_directory_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        HASM.from_pretrained(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_file_is_no_model(saved, name, share):
    content = (saved / name).read_bytes()
    (saved / name).write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"checkpoint .* is damaged"):
        HASM.from_pretrained(saved)


def test_a_config_of_other_bytes_is_no_model(saved):
    (saved / "config.json").write_bytes(b"\xff\xfe\x00 not text")
    with pytest.raises(ValueError, match="is damaged"):
        HASM.from_pretrained(saved)


def test_an_older_checkpoint_is_refused_by_name(saved):
    """One that held a memory a patch, under "memories"."""
    content = json.loads((saved / "config.json").read_text())
    del content["settled"]
    content["memories"] = {"front": {"joints": [0, 1], "capacity": 90, "touch_levels": 2}}
    content["body"]["directions"] = content["body"].pop("normals")
    (saved / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"older version, with memories a patch.*train again"):
        HASM.from_pretrained(saved)


def edit_settings(content):
    content["model"]["bits"] = 8


def drop_section(content):
    del content["settled"]


def unknown_setting(content):
    content["model"]["colour"] = "red"


def unknown_entry(content):
    content["settled"]["mood"] = "good"


def wrong_type(content):
    content["model"]["neurons"] = "ten"


def unknown_choice(content):
    content["model"]["storage"] = "paper"


def unknown_patch(content):
    content["settled"]["taught"] = ["tail"]


def foreign_joint(content):
    content["settled"]["joints"] = [0, 17]


def foreign_moved(content):
    content["settled"]["moved"] = [0, 1, 17]


def other_capacity(content):
    content["settled"]["capacity"] += 1


def no_capacity(content):
    content["settled"]["capacity"] = 0


def no_joint(content):
    content["settled"]["joints"] = []


def list_of_choices(content):
    content["settled"] = ["front"]


def other_value(content):
    content["settled"]["value"] = "displacement"


def fewer_limits(content):
    content["body"]["lower"].pop()


EDITS = [edit_settings, drop_section, unknown_setting, unknown_entry, wrong_type, unknown_choice,
         unknown_patch, foreign_joint, foreign_moved, other_capacity, no_capacity, no_joint,
         list_of_choices, other_value, fewer_limits]  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_config_does_not_load(saved, edit):
    content = json.loads((saved / "config.json").read_text())
    edit(content)
    (saved / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"(?s)checkpoint .*train"):
        HASM.from_pretrained(saved)


def test_a_config_that_is_no_object_does_not_load(saved):
    (saved / "config.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="is damaged"):
        HASM.from_pretrained(saved)


def test_weights_with_a_missing_or_strange_entry_do_not_load(saved):
    weights = load_file(saved / "model.safetensors")
    for name in weights:
        changed = {k: v for k, v in weights.items() if k != name}
        save_file(changed, saved / "model.safetensors")
        with pytest.raises(ValueError, match="is damaged"):
            HASM.from_pretrained(saved)
    save_file({**weights, "more": torch.zeros(2)}, saved / "model.safetensors")
    with pytest.raises(ValueError, match="is damaged"):
        HASM.from_pretrained(saved)


def test_weights_that_are_not_finite_do_not_load(saved):
    weights = load_file(saved / "model.safetensors")
    name = next(name for name in weights if name.endswith("successors"))
    weights[name][1, 0] = float("nan")
    save_file(weights, saved / "model.safetensors")
    with pytest.raises(ValueError, match=r"successors holds NaN"):
        HASM.from_pretrained(saved)


def test_a_memory_that_is_not_full_does_not_load(saved):
    weights = load_file(saved / "model.safetensors")
    name = next(name for name in weights if name.endswith("memory.count"))
    for count in (0, int(weights[name]) + 1, -1):
        save_file({**weights, name: torch.tensor(count)}, saved / "model.safetensors")
        with pytest.raises(ValueError, match="associations held, expected 2"):
            HASM.from_pretrained(saved)
