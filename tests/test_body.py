"""The body of any dataset: limits, units, layouts of touch, no touch; learning from each."""

import importlib
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch import HASM, HASMConfig
from hasm_torch.apps.training import FeaturesConfig, RobotConfig, describe, train
from hasm_torch.body import Body
from hasm_torch.data import (
    Episode,
    EpisodeSet,
    EpisodeStream,
    FeatureMap,
    SkinPatch,
    iter_episodes,
    load_episodes,
    open_episodes,
    write_episodes,
)
from hasm_torch.data.body import body_of, describe_body, limits_of
from hasm_torch.encoders.readings import DIRECTIONS, as_forces, forces_of
from hasm_torch.encoders.skin import spike_step
from hasm_torch.model.checkpoint import TACTILE, features

RECORDINGS = Path(__file__).parents[2] / "shared" / "data"
URDF = """<robot name="made">
  <link name="base"/><link name="upper"/><link name="tip"/>
  <joint name="elbow" type="revolute"><parent link="base"/><child link="upper"/>
    <limit lower="-1.0" upper="2.0" velocity="1.5" effort="1"/></joint>
  <joint name="slide" type="{kind}"><parent link="upper"/><child link="tip"/>{limit}</joint>
</robot>"""
SLIDE_LIMIT = '<limit lower="0" upper="0.5" velocity="0.2" effort="1"/>'
FPS = 30
LAYOUTS = {"forces": 3, "pressures": 1, "wrench": 6}


def episode(index: int = 0, channels: int | None = 3, frames: int = 30, cells: int = 4) -> Episode:
    """The elbow bends as it is touched."""
    state = np.stack([np.linspace(0, 1.5, frames), np.full(frames, 0.1)], axis=1)
    state = state.astype(np.float32)
    tactile = None
    if channels is not None:
        tactile = np.zeros((frames, 1 if channels == 6 else cells, channels), dtype=np.float32)
        tactile[2:, 0, 0] = -7.0 if channels == 6 else 7.0
    time = (np.arange(frames) / FPS).astype(np.float32)
    return Episode(index, "bend", time, state, state.copy(), tactile)


def dataset(channels: int | None = 3, units=("rad", "m"), unit="N", count=2) -> EpisodeSet:
    skin = None
    if channels is not None:
        cells = 1 if channels == 6 else 2
        skin = {"fore": SkinPatch("fore", slice(0, cells), unit=unit, channels=channels)}
        if channels != 6:
            side = np.tile([0.0, 2.0, 0.0], (2, 1))
            skin["back"] = SkinPatch(
                "back", slice(2, 4), "upper", normals=side, unit=unit, channels=channels
            )
    joints = ("elbow", "slide")
    episodes = [episode(i, channels) for i in range(count)]
    return EpisodeSet(episodes, float(FPS), joints, units, skin, Path("made"), joints)


def with_state(data: EpisodeSet, change) -> EpisodeSet:
    first = data.episodes[0]
    state = first.state.copy()
    change(state)
    return replace(data, episodes=[replace(first, state=state), *data.episodes[1:]])


@pytest.fixture
def urdf(tmp_path) -> Path:
    path = tmp_path / "made.urdf"
    path.write_text(URDF.format(kind="prismatic", limit=SLIDE_LIMIT))
    return path


# Joint limits.


def test_limits_of_a_urdf(urdf):
    data = dataset()
    limits = limits_of(data, urdf)
    assert limits.lower == [-1.0, 0.0]
    assert limits.upper == [2.0, 0.5]
    assert limits.max_speed == [1.5, 0.2]
    assert str(urdf) in describe_body(data, body_of(data, urdf), urdf)[0]


def test_limits_follow_the_order_of_the_dataset(urdf):
    data = dataset()
    turned = [replace(e, state=e.state[:, ::-1], action=e.action[:, ::-1]) for e in data]
    other = replace(data, episodes=turned, joints=("slide", "elbow"), units=("m", "rad"))
    assert limits_of(other, urdf).upper == [0.5, 2.0]


def test_limits_of_the_bundled_robot():
    names = ("arm_flex_joint", "wrist_roll_joint")
    data = replace(dataset(), joints=names, units=("rad", "rad"))
    data = replace(data, episodes=[replace(e, state=-e.state) for e in data])
    assert "bundled" in describe_body(data, body_of(data))[0]
    assert body_of(data).lower[0] == pytest.approx(-2.62)


def test_limits_of_the_data():
    """State and targets both fit; a joint that stands still gets a little room."""
    data = dataset()
    wide = replace(data.episodes[1], action=data.episodes[1].action + np.float32(0.25))
    limits = limits_of(replace(data, episodes=[data.episodes[0], wide]))
    assert limits.source == "the range of the data"
    assert (limits.lower[0], limits.upper[0]) == pytest.approx((0.0, 1.75))
    assert limits.max_speed[0] == pytest.approx(1.5 / 29 * FPS, rel=1e-5)
    still = limits_of(data)
    assert still.lower[1] < 0.1 < still.upper[1]
    assert still.max_speed[1] > 0
    with pytest.raises(ValueError, match="no episode to take joint limits from"):
        limits_of(replace(data, episodes=[]))


def test_what_a_urdf_leaves_open_comes_from_the_data(tmp_path):
    path = tmp_path / "open.urdf"
    path.write_text(URDF.format(kind="continuous", limit=""))
    limits = limits_of(dataset(), path)
    assert limits.upper[0] == 2.0
    assert limits.lower[1] < 0.1 < limits.upper[1]
    assert np.isfinite(limits.max_speed).all()


def test_urdf_of_another_robot(urdf, tmp_path):
    with pytest.raises(ValueError, match=r"no joint wrist of dataset made; its joints: elbow"):
        limits_of(replace(dataset(), joints=("elbow", "wrist")), urdf)
    with pytest.raises(FileNotFoundError, match=r"no URDF at .*none.urdf"):
        limits_of(dataset(), tmp_path / "none.urdf")


# Units.


@pytest.mark.parametrize("unit", ["deg", "degrees", "DEG", "°"])
def test_declared_degrees(urdf, unit):
    data = dataset(units=(unit, "m"))
    message = rf"elbow in degrees \(unit '{unit}'\).*radians.*leave the URDF out"
    with pytest.raises(ValueError, match=message):
        body_of(data, urdf)
    assert body_of(data).upper[0] == pytest.approx(1.5)  # without it, degrees are as good


def test_degrees_that_nobody_declared(urdf):
    data = with_state(dataset(units=("unknown", "unknown")), lambda s: s.__setitem__((7, 0), 80.0))
    message = r"elbow in the state of made reaches 80 at frame 7 of episode 0.*looks like degrees"
    with pytest.raises(ValueError, match=message):
        body_of(data, urdf)


def test_far_beyond_a_limit_is_no_degree(urdf):
    data = with_state(dataset(), lambda state: state.__setitem__((3, 1), 1.5))
    with pytest.raises(ValueError, match=r"slide .* frame 3 of episode 0.*order of the joints"):
        body_of(data, urdf)


def test_little_beyond_a_limit_is_a_warning(urdf):
    data = with_state(dataset(), lambda state: state.__setitem__((4, 0), 2.1))
    with pytest.warns(UserWarning, match=r"elbow .* 2.1 at frame 4 of episode 0.*taken as"):
        assert body_of(data, urdf).upper[0] == 2.0
    within = with_state(dataset(), lambda state: state.__setitem__((4, 0), 2.001))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body_of(within, urdf)


def test_wrong_frame_rate(urdf):
    with pytest.warns(UserWarning, match=r"elbow .* episode 0.*check fps \(300\)"):
        body_of(replace(dataset(), fps=300.0), urdf)


# Layouts of touch.


def test_forces_and_pressures():
    forces = torch.arange(12.0).reshape(2, 2, 3)
    assert as_forces(forces) is forces
    pressed = as_forces(torch.tensor([[[2.0], [3.0]]]))
    torch.testing.assert_close(pressed, torch.tensor([[[2.0, 0, 0], [3.0, 0, 0]]]))
    with pytest.raises(ValueError, match=r"3 forces, 1 pressure or a wrench of 6 a cell"):
        as_forces(torch.zeros(2, 4))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-50, 50), min_size=6, max_size=6))
def test_wrench_keeps_force_and_direction(wrench):
    """The six pushes along their directions add up to the force; the torque is left aside."""
    pushes = as_forces(torch.tensor([wrench], dtype=torch.float64))
    assert pushes.shape == (6, 3)
    assert (pushes >= 0).all()
    directions = torch.tensor(list(DIRECTIONS.values()), dtype=torch.float64)
    torch.testing.assert_close(
        (pushes.sum(-1, keepdim=True) * directions).sum(0),
        torch.tensor(wrench[:3], dtype=torch.float64),
    )


@pytest.mark.parametrize(("name", "channels"), LAYOUTS.items())
def test_body_of_each_layout(name, channels):
    data = dataset(channels)
    found = body_of(data)
    assert found.channels == channels
    assert found.readings == data.episodes[0].tactile[0].size
    if name == "wrench":
        assert found.patches == [f"fore {direction}" for direction in DIRECTIONS]
        assert found.directions == [list(d) for d in DIRECTIONS.values()]
        assert found.cells == [1] * 6
    else:
        assert (found.patches, found.cells) == (["fore", "back"], [2, 2])
        assert found.directions == [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
        assert found.links == ["", "upper"]
    assert str(found.readings // channels) in describe_body(data, found)[1]


@pytest.mark.parametrize(("name", "channels"), LAYOUTS.items())
def test_each_layout_is_learned_and_recalled(name, channels):
    """A touch moves the elbow on; the other way round, and at rest, it stays."""
    data = dataset(channels)
    model = HASM(HASMConfig(), body_of(data))
    report = model.fit(data)
    patch = "fore -x" if name == "wrench" else "fore"
    assert list(report.associations) == [patch]
    assert report.joints[patch] == ["elbow"]
    start, touched = torch.from_numpy(data.episodes[0].state[0]), data.episodes[0].tactile[5]

    def after(skin):
        model.reset()
        target = start
        for _ in range(10):
            target = model.step(target, torch.from_numpy(skin))
        return float(target[0])

    moved = after(touched)
    assert moved > 0.05
    assert after(touched.ravel()) == moved  # flat, as LeRobot gives it
    assert after(0 * touched) == 0.0
    if name == "wrench":
        assert after(-touched) == 0.0


def test_without_touch_a_sequence_plays_back():
    data = dataset(None)
    found = body_of(data)
    assert (found.patches, found.channels, found.readings) == (["sequence"], 0, 0)
    assert "no touch in this dataset: a plain sequence memory" in describe_body(data, found)
    assert TACTILE not in features(found)[0]
    model = HASM(HASMConfig(), found)
    model.fit(data)
    state = torch.from_numpy(data.episodes[0].state[0])
    positions = [float(state[0])]
    for _ in range(80):
        state = model.step(state, None)
        positions.append(float(state[0]))
    assert (np.diff(positions) >= -1e-6).all()
    assert positions[-1] == pytest.approx(1.5, abs=0.05)
    # at about the recorded pace: half way after half of the recording
    assert 0.4 < positions[15] < 1.1


def test_readings_that_do_not_fit():
    pressed = body_of(dataset(1))
    with pytest.raises(ValueError, match=r"expected skin \(4, 1\) or flat, got \(12,\)"):
        forces_of(pressed, torch.zeros(12))
    with pytest.raises(ValueError, match="got nothing"):
        forces_of(pressed, None)
    with pytest.raises(ValueError, match="channels must be 0, 1, 3 or 6"):
        Body(["j"], [0.0], [1.0], [1.0], channels=2)


def test_patch_names_with_dots():
    skin = {"left.hand": SkinPatch("left.hand", slice(0, 4))}
    assert body_of(replace(dataset(), skin=skin)).patches == ["left_hand"]


@settings(max_examples=50, deadline=None)
@given(rate=st.floats(1, 1000), longest=st.floats(0.01, 0.5))
def test_spike_step_divides_the_period(rate, longest):
    step = spike_step(rate, longest)
    assert 0 < step <= longest * (1 + 1e-9)
    steps = 1000.0 / rate / step
    assert steps == pytest.approx(round(steps), abs=1e-6)
    assert spike_step(50.0, 0.1) == 0.1


# From files.


@pytest.fixture(params=[3, 1, None])
def stored(request, tmp_path) -> tuple[Path, EpisodeSet]:
    data = dataset(request.param, unit="count", count=3)
    root = tmp_path / "made"
    write_episodes(
        root, data, joints=data.joints, units=data.units, skin=data.skin, fps=FPS,
        robot_type="made",
    )  # fmt: skip
    return root, data


def test_training_on_any_layout(stored, tmp_path):
    root, data = stored
    trained = train(root, HASMConfig())
    text = describe(trained)
    assert "the range of the data" in text
    assert ("no touch" in text) == (data.skin is None)
    if data.skin is not None:  # the unit is no newton: threshold and current are the data's
        assert trained.model.config.current_per_newton != HASMConfig().current_per_newton
    trained.model.save_pretrained(tmp_path / "saved")
    loaded = HASM.from_pretrained(tmp_path / "saved")
    assert loaded.body == trained.model.body


def test_features_and_robot_by_option(stored, urdf):
    root, _ = stored
    names = FeaturesConfig(state="action", tactile="none", action="observation.state")
    trained = train(root, HASMConfig(), names, RobotConfig(urdf))
    assert trained.model.body.upper == [2.0, 0.5]
    assert "no touch" in describe(trained)
    with pytest.raises(ValueError, match=r"Expected a feature 'joints'"):
        train(root, HASMConfig(), FeaturesConfig(state="joints"))


def test_stream_reads_the_same_episodes(stored):
    root, _ = stored
    whole, stream = load_episodes(root), EpisodeStream(root)
    assert len(stream) == len(whole)
    assert body_of(stream) == body_of(whole)
    for _ in range(2):  # it can be read again
        for mine, theirs in zip(stream, whole, strict=True):
            assert (mine.index, mine.task) == (theirs.index, theirs.task)
            np.testing.assert_array_equal(mine.state, theirs.state)
            np.testing.assert_array_equal(mine.time, theirs.time)
            if theirs.tactile is not None:
                np.testing.assert_array_equal(mine.tactile, theirs.tactile)
    assert next(iter(iter_episodes(root, FeatureMap(tactile=None)))).tactile is None
    assert isinstance(open_episodes(root), EpisodeSet)
    assert isinstance(open_episodes(root, most_bytes=10), EpisodeStream)


def test_options_of_the_command_line(stored, urdf, tmp_path, monkeypatch, capsys):
    root, data = stored
    if data.skin is not None:
        pytest.skip("one layout is enough for the command line")
    options = [
        f"--dataset.root={root}",
        f"--robot.urdf={urdf}",
        "--features.state=action",
        f"--output_dir={tmp_path}/out",
    ]
    monkeypatch.setattr(sys, "argv", ["train.py", *options])
    importlib.import_module("train").main()
    printed = capsys.readouterr().out
    assert "no touch in this dataset" in printed
    assert str(urdf) in printed


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="real recordings are not at hand")
@pytest.mark.parametrize(
    ("name", "patches", "channels"), [("icub_grasp", 5, 1), ("g1_inspire", 1, 0)]
)
def test_real_recordings(name, patches, channels):
    stream = EpisodeStream(RECORDINGS / name)
    found = body_of(stream)
    assert (len(found.patches), found.channels) == (patches, channels)
    lower, upper = np.array(found.lower) - 1e-5, np.array(found.upper) + 1e-5
    for number, mine in enumerate(stream):
        assert mine.index == number
        assert ((mine.state >= lower) & (mine.state <= upper)).all()
