"""The body of any dataset: limits, units, layouts of touch, how links turn, no touch."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.body import Body
from hasm_torch.data import (
    Episode,
    EpisodeSet,
    FeatureMap,
    SkinPatch,
    load_episodes,
    skin_patches,
    write_episodes,
)
from hasm_torch.data.body import body_of, describe_body, limits_of
from hasm_torch.encoders.readings import PUSHES, as_forces, forces_of
from hasm_torch.encoders.skin import spike_step
from hasm_torch.encoders.turning import link_rotation
from hasm_torch.robot import JOINTS, Skin

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
    data = replace(dataset(None), joints=names, units=("rad", "rad"))
    data = replace(data, episodes=[replace(e, state=-e.state) for e in data])
    assert "hsr.urdf" in describe_body(data, body_of(data))[0]
    assert body_of(data).lower[0] == pytest.approx(-2.62)


def test_limits_of_the_data():
    """State and targets both fit; a joint that stands still gets a little room."""
    data = dataset()
    wide = replace(data.episodes[1], action=data.episodes[1].action + np.float32(0.25))
    both = replace(data, episodes=[data.episodes[0], wide])
    limits = limits_of(both)
    assert describe_body(both, body_of(both))[0] == "joint limits: the range of the data"
    assert (limits.lower[0], limits.upper[0]) == pytest.approx((0.0, 1.75))
    assert limits.max_speed[0] == pytest.approx(1.5 / 29 * FPS, rel=1e-5)
    still = limits_of(data)
    assert still.lower[1] < 0.1 < still.upper[1]
    assert still.max_speed[1] > 0
    with pytest.raises(ValueError, match="no episode to take joint limits from"):
        limits_of(replace(data, episodes=[]))


@pytest.mark.parametrize("limit", ["", '<limit effort="1"/>', '<limit lower="0" effort="1"/>'])
def test_joints_that_a_urdf_does_not_limit_have_no_limits(tmp_path, limit):
    path = tmp_path / "open.urdf"
    path.write_text(URDF.format(kind="continuous", limit=limit))
    far = with_state(dataset(), lambda state: state.__setitem__((3, 1), 900.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = body_of(far, path)
    assert (found.lower, found.upper) == ([-1.0, -np.inf], [2.0, np.inf])
    assert found.limited == [0]
    assert np.isfinite(found.max_speed).all()  # of what nothing limits, the data's
    assert found.max_speed[1] > 0


def test_urdf_of_another_robot(urdf, tmp_path):
    with pytest.raises(ValueError, match=r"no moving joint wrist of .*; its joints: elbow"):
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
    """Six pushes against their cells' normals add up to the force; the torque is left aside."""
    pushes = as_forces(torch.tensor([wrench], dtype=torch.float64))
    assert pushes.shape == (6, 3)
    assert (pushes >= 0).all()
    normals = torch.tensor(PUSHES, dtype=torch.float64)
    torch.testing.assert_close(
        -(pushes.sum(-1, keepdim=True) * normals).sum(0),
        torch.tensor(wrench[:3], dtype=torch.float64),
    )


@pytest.mark.parametrize(("name", "channels"), LAYOUTS.items())
def test_body_of_each_layout(name, channels):
    data = dataset(channels)
    found = body_of(data)
    assert found.channels == channels
    assert found.readings == data.episodes[0].tactile[0].size
    if name == "wrench":  # one patch that feels all directions
        assert (found.patches, found.cells) == (["fore"], [6])
        assert found.normals == [list(push) for push in PUSHES]
    else:
        assert (found.patches, found.cells) == (["fore", "back"], [2, 2])
        assert found.normals == [[0.0, 0.0, 1.0]] * 2 + [[0.0, 1.0, 0.0]] * 2
        assert (found.links, found.groups) == (["", "upper"], [0, 1])
    assert (found.chains, found.base, found.unit) == ({}, [], "N")
    assert str(found.readings // channels) in describe_body(data, found)[1]


def test_patches_of_unknown_links_are_no_part_of_each_other():
    data = dataset()
    skin = {name: replace(patch, link=None) for name, patch in data.skin.items()}
    assert body_of(replace(data, skin=skin)).groups == [0, 1]
    one = {name: replace(patch, link="upper") for name, patch in data.skin.items()}
    assert body_of(replace(data, skin=one)).groups == [0, 0]


def test_a_urdf_says_how_links_turn(urdf):
    """Where the elbow bends about x, the skin behind it turns with it."""
    data = dataset()
    other = replace(data, skin={**data.skin, "fore": replace(data.skin["fore"], link="paw")})
    with pytest.warns(UserWarning, match=r"made.urdf has no link paw, which carry skin"):
        found = body_of(other, urdf)
    assert list(found.chains) == ["upper"]
    found = body_of(data, urdf)
    bend = 0.3
    positions = np.array([[bend, 0.2]])
    turn = link_rotation(np.array(found.chains["upper"]), positions)[0]
    cosine, sine = np.cos(bend), np.sin(bend)
    expected = [[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]
    np.testing.assert_allclose(turn, expected, atol=1e-12)
    fixed = {name: replace(patch, link=link) for (name, patch), link in
             zip(data.skin.items(), ("upper", "tip"))}  # fmt: skip
    assert body_of(replace(data, skin=fixed), urdf).groups == [0, 1]  # the slide is between them


def test_the_bundled_robot_has_a_base_and_links_that_turn():
    skin, state = Skin.load(), np.zeros((5, len(JOINTS)), np.float32)
    tactile = np.zeros((5, skin.cells, 3), np.float32)
    time = np.arange(5) / FPS
    data = EpisodeSet(
        [Episode(0, "stand", time, state, state, tactile)], float(FPS), JOINTS, ("rad",) * 11,
        skin_patches(skin), Path("made"), JOINTS, {"observation.environment_state": 3},
    )  # fmt: skip
    found = body_of(data)
    assert found.base == ["odom_x", "odom_y", "odom_t"]
    assert found.max_speed[-3:] == [0.2, 0.2, 1.0]
    assert found.limited == list(range(8))
    assert set(found.chains) == set(skin.link.values())
    by_patch = dict(zip(found.patches, found.groups))
    assert len({group for name, group in by_patch.items() if "wrist" in name}) == 1
    assert by_patch["torso_front"] == by_patch["torso_left"] != by_patch["wrist_left"]
    np.testing.assert_allclose(found.normals, skin.normals, atol=1e-9)
    assert found.observations == {"observation.environment_state": 3}
    text = "\n".join(describe_body(data, found))
    assert "mobile base: odom_x, odom_y, odom_t" in text
    assert "bound besides: observation.environment_state (3)" in text
    arm = replace(data, joints=JOINTS[:8], action_names=JOINTS[:8], episodes=[
        replace(data.episodes[0], state=state[:, :8], action=state[:, :8])])  # fmt: skip
    assert body_of(arm).base == []  # a base that was not recorded stands still


def test_a_body_without_touch():
    data = dataset(None)
    found = body_of(data)
    assert (found.patches, found.channels, found.readings) == (["sequence"], 0, 0)
    assert "no touch in this dataset: a plain sequence memory" in describe_body(data, found)


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


def test_stream_reads_the_same_episodes(stored):
    root, _ = stored
    whole, stream = load_episodes(root), load_episodes(root, most_bytes=10)
    assert isinstance(whole.episodes, list)
    assert not isinstance(stream.episodes, list)
    assert stream.episodes[1].index == whole.episodes[1].index
    assert len(stream) == len(whole)
    assert body_of(stream) == body_of(whole)
    for _ in range(2):  # it can be read again
        for mine, theirs in zip(stream, whole, strict=True):
            assert (mine.index, mine.task) == (theirs.index, theirs.task)
            np.testing.assert_array_equal(mine.state, theirs.state)
            np.testing.assert_array_equal(mine.time, theirs.time)
            if theirs.tactile is not None:
                np.testing.assert_array_equal(mine.tactile, theirs.tactile)
    assert next(iter(load_episodes(root, FeatureMap(tactile=None), most_bytes=0))).tactile is None


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="real recordings are not at hand")
@pytest.mark.parametrize(
    ("name", "patches", "channels"), [("icub_grasp", 5, 1), ("g1_inspire", 1, 0)]
)
def test_real_recordings(name, patches, channels):
    stream = load_episodes(RECORDINGS / name, most_bytes=0)
    found = body_of(stream)
    assert (len(found.patches), found.channels) == (patches, channels)
    lower, upper = np.array(found.lower) - 1e-5, np.array(found.upper) + 1e-5
    for number, mine in enumerate(stream):
        assert mine.index == number
        assert ((mine.state >= lower) & (mine.state <= upper)).all()
