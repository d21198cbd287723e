"""``train.py`` on datasets of every kind: what is learned, said and refused."""

import importlib
import json
import sys

import numpy as np
import pytest
import torch
from recordings import FPS, JOINTS, KINDS, PLACE, REACHES, episodes, touch, write_all

from hasm_torch import HASM, HASMConfig
from hasm_torch.apps.rerun_recording import dataset_scenes
from hasm_torch.apps.rerun_recording import main as watch
from hasm_torch.data import FeatureMap
from hasm_torch.data.training import settings, train
from hasm_torch.episode import ACTION, STATE


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    return write_all(tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def trained(roots):
    return {kind: train(root, HASMConfig()) for kind, root in roots.items()}


def follow(model, start, skin, steps, observation=None):
    """Positions of a robot that reaches every target at once, (steps + 1, joints)."""
    model.reset()
    state = torch.tensor(start, dtype=torch.float32)
    positions = [state]
    for _ in range(steps):
        reading = None if skin is None else torch.from_numpy(skin)
        state = model.step(state, reading, observation=observation)
        positions.append(state)
    return torch.stack(positions).numpy()


@pytest.mark.parametrize("kind", ["forces", "pressures", "wrench"])
def test_touch_leads_the_elbow_the_way_it_was_taught(trained, kind):
    model, start = trained[kind].model, [0.5, 0.2, 0.1]
    bent = follow(model, start, touch(kind, "fore"), 20)
    stretched = follow(model, start, touch(kind, "back"), 20)
    assert bent[-1, 0] > 0.6
    assert stretched[-1, 0] < 0.4
    for moved in (bent, stretched):
        np.testing.assert_allclose(moved[:, 1:], moved[:1, 1:].repeat(len(moved), 0), atol=1e-6)
    still = follow(model, start, 0 * touch(kind, "fore"), 20)
    np.testing.assert_allclose(still, still[:1].repeat(len(still), 0), atol=1e-6)


def test_without_touch_a_sequence_plays_back(trained):
    positions = follow(trained["none"].model, [0.0, 0.2, 0.1], None, 100)
    assert positions[40, 0] > 0.3
    assert REACHES[0] - 0.1 < positions[:, 0].max() < REACHES[-1]
    np.testing.assert_allclose(positions[:, 1:], positions[:1, 1:].repeat(101, 0), atol=1e-6)


def test_what_is_bound_tells_how_far_to_go(trained):
    model = trained["bound"].model
    for reach in (0.75, 1.05):  # between those that were shown
        place = torch.tensor([reach, 1.0])
        positions = follow(model, [0.0, 0.2, 0.1], touch("bound", "fore"), 100, place)
        assert positions[-1, 0] == pytest.approx(reach, abs=0.06)
    with pytest.raises(ValueError, match=rf"expected observation \(2,\) of {PLACE}, got None"):
        follow(model, [0.0, 0.2, 0.1], touch("bound", "fore"), 1)


@pytest.mark.parametrize("kind", KINDS)
def test_checkpoints_of_every_kind_step_alike(trained, tmp_path, kind):
    model = trained[kind].model
    model.save_pretrained(tmp_path)
    loaded = HASM.from_pretrained(tmp_path)
    assert loaded.body == model.body
    place = torch.tensor([0.9, 1.0]) if kind == "bound" else None
    rollouts = [follow(m, [0.1, 0.2, 0.1], touch(kind, "fore"), 30, place) for m in (model, loaded)]
    np.testing.assert_array_equal(*rollouts)
    assert rollouts[0][-1, 0] > 0.15
    declared = json.loads((tmp_path / "config.json").read_text())["input_features"]
    assert ("observation.tactile" in declared) == (kind != "none")
    assert (PLACE in declared) == (kind == "bound")


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_learned_is_told(trained, kind):
    text = str(trained[kind])
    assert "joint limits: the range of the data" in text
    assert ("no touch in this dataset" in text) == (kind == "none")
    assert (f"bound besides: {PLACE} (2)" in text) == (kind == "bound")
    assert str(trained[kind].report) in text
    assert "kB" in text


def test_a_skin_in_another_unit_is_calibrated_by_the_fit(trained, roots):
    """Whoever fits, so that every way of training stores the same."""
    settled = trained["pressures"].model.settled
    assert settled.current_per_newton != trained["forces"].model.settled.current_per_newton
    model = HASM(HASMConfig(), trained["pressures"].model.body)
    model.fit(episodes("pressures"))
    assert model.settled == settled


def test_features_by_option(roots):
    swapped = train(roots["forces"], HASMConfig(), FeatureMap(STATE, None, STATE))
    assert swapped.model.body.channels == 0
    assert "no touch" in str(swapped)
    unbound = train(roots["bound"], HASMConfig(), FeatureMap(bound=[]))
    assert unbound.model.body.observations == {}
    with pytest.raises(ValueError, match="Expected a feature 'joints'"):
        train(roots["forces"], HASMConfig(), FeatureMap(state="joints"))
    with pytest.raises(ValueError, match=r"Expected a feature 'observation.tactil' in"):
        train(roots["forces"], HASMConfig(), FeatureMap(tactile="observation.tactil"))
    with pytest.raises(ValueError, match=r"the action of .* has 4 entries, expected a target for"):
        train(roots["pressures"], HASMConfig(), FeatureMap(action="observation.tactile"))


@pytest.mark.parametrize("kind", KINDS)
def test_episodes_of_every_kind_can_be_watched(roots, tmp_path, monkeypatch, capsys, kind):
    scenes = dataset_scenes([roots[kind]])
    frames = sum(len(episode) for episode in episodes(kind))
    assert scenes.state.shape == (frames, len(JOINTS))
    if kind == "none":
        assert scenes.spikes is None
    else:
        assert scenes.spikes.shape == (frames, len(scenes.patches))
        assert scenes.spikes.sum() > 100
        assert scenes.skin.min() >= 0.0  # forces, whatever the sensor reads
    path = tmp_path / "made.rrd"
    options = [f"--dataset.root={roots[kind]}", f"--output={path}", "--features.bound=[]"]
    monkeypatch.setattr(sys, "argv", ["rerun_recording", *options])
    watch()
    assert "uv run rerun" in capsys.readouterr().out
    assert path.stat().st_size > 1000


def test_the_literal_method_is_fixed():
    assert settings("literal", HASMConfig()) == HASMConfig.literal()
    with pytest.raises(ValueError, match="fixes every setting"):
        settings("literal", HASMConfig(bits=8))


URDF = """<robot name="made">
  <link name="base"/><link name="fore"/><link name="hand"/><link name="tip"/>
  <joint name="elbow" type="revolute"><parent link="base"/><child link="fore"/>
    <limit lower="-1" upper="2" velocity="1.5" effort="1"/></joint>
  <joint name="wrist" type="continuous"><parent link="fore"/><child link="hand"/></joint>
  <joint name="slide" type="prismatic"><parent link="hand"/><child link="tip"/>
    <limit lower="0" upper="0.5" velocity="0.2" effort="1"/></joint>
</robot>"""


def test_options_of_the_command_line(roots, tmp_path, monkeypatch, capsys):
    urdf = tmp_path / "made.urdf"
    urdf.write_text(URDF)
    options = [
        f"--dataset.root={roots['bound']}",
        f"--robot.urdf={urdf}",
        f"--features.action={STATE}",
        f"--features.bound=[{PLACE}, {ACTION}]",
        f"--output_dir={tmp_path}/out",
    ]
    main = importlib.import_module("train").main
    monkeypatch.setattr(sys, "argv", ["train.py", *options])
    main()
    printed = capsys.readouterr().out
    assert f"joint limits: {urdf}" in printed
    assert f"bound besides: {PLACE} (2), {ACTION} (3)" in printed
    assert "chosen:" in printed
    body = HASM.from_pretrained(tmp_path / "out").body
    assert (body.joints, body.rate) == (list(JOINTS), FPS)
    assert (body.lower[1], body.upper[0]) == (-np.inf, 2.0)
    monkeypatch.setattr(sys, "argv", ["train.py", *options, "--features.tactile=skin"])
    with pytest.raises(SystemExit, match=r"train.py: Expected a feature 'skin' in"):
        main()
    monkeypatch.setattr(sys, "argv", ["train.py"])
    with pytest.raises(SystemExit, match=r"train.py needs a dataset and a place"):
        main()
