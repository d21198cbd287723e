"""Rows that turn a link: equal to the kinematics, for the HSR and for a robot of every kind."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hasm_torch._assets import asset_path
from hasm_torch.robot import (
    BASE_FRAME,
    JOINTS,
    Kinematics,
    Skin,
    link_turns,
    planar_base,
    rigid_body,
)
from hasm_torch.robot.urdf import read_urdf

# A planar base (y before x, a fixed link between), a mast that lifts and tilts, an arm whose
# elbow follows the shoulder, and a finger that follows a joint which nobody gives.
SYNTHETIC = """<robot name="r">
<link name="map"/><link name="s0"/><link name="s1"/><link name="s2"/><link name="base"/>
<link name="mast"/><link name="lift"/><link name="arm"/><link name="plate"/><link name="fore"/>
<link name="tool"/><link name="finger"/><link name="spring"/>
<joint name="side" type="prismatic"><parent link="map"/><child link="s0"/>
  <axis xyz="0 2 0"/></joint>
<joint name="j0" type="fixed"><parent link="s0"/><child link="s1"/><origin xyz="0 0 .1"/></joint>
<joint name="ahead" type="prismatic"><parent link="s1"/><child link="s2"/></joint>
<joint name="turn" type="continuous"><parent link="s2"/><child link="base"/>
  <axis xyz="0 0 1"/><limit lower="0" upper="0" effort="1" velocity="1"/></joint>
<joint name="j1" type="fixed"><parent link="base"/><child link="mast"/>
  <origin xyz="0 .1 .5" rpy=".3 -.2 .7"/></joint>
<joint name="up" type="prismatic"><parent link="mast"/><child link="lift"/>
  <origin xyz="0 0 0" rpy="0 .4 0"/><axis xyz="0 0 1"/></joint>
<joint name="shoulder" type="revolute"><parent link="lift"/><child link="arm"/>
  <origin xyz=".2 0 0" rpy="1 0 .2"/><axis xyz="1 2 -.5"/>
  <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j2" type="fixed"><parent link="arm"/><child link="plate"/>
  <origin xyz="0 0 .2" rpy="0 -.6 0"/></joint>
<joint name="elbow" type="revolute"><parent link="plate"/><child link="fore"/>
  <origin xyz="0 0 .1" rpy="0 0 .9"/><axis xyz="0 1 0"/>
  <mimic joint="shoulder" multiplier="-.5" offset=".25"/></joint>
<joint name="j3" type="fixed"><parent link="fore"/><child link="tool"/>
  <origin xyz="0 0 .2" rpy=".1 .2 .3"/></joint>
<joint name="grip" type="revolute"><parent link="tool"/><child link="spring"/>
  <axis xyz="0 0 1"/></joint>
<joint name="tip" type="revolute"><parent link="spring"/><child link="finger"/>
  <axis xyz="1 0 0"/><mimic joint="grip" offset=".4"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("robot") / "robot.urdf"
    path.write_text(SYNTHETIC)
    return path


def turned(rows: list[list[float]], q: np.ndarray) -> np.ndarray:
    """(3, 3) product of the rows, by Rodrigues' formula."""
    result = np.eye(3)
    for row in rows:
        x, y, z = row[9:12]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        index = int(row[12])
        angle = row[14] + (row[13] * q[index] if index >= 0 else 0.0)
        rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        result = result @ np.array(row[:9]).reshape(3, 3) @ rotation
    return result


def check(kinematics: Kinematics, link: str, frame: str, most_rows: int) -> None:
    """Rows of a link equal its pose in a frame at random joint positions."""
    rows = link_turns(kinematics, kinematics.joints, link)
    assert len(rows) <= most_rows
    assert all(len(row) == 15 for row in rows)
    assert all(row[12] >= 0 for row in rows[:-1])
    q = np.random.default_rng(0).uniform(-3, 3, (30, len(kinematics.joints)))
    poses = kinematics.pose(torch.from_numpy(q), link, frame)[:, :3, :3].numpy()
    np.testing.assert_allclose([turned(rows, row) for row in q], poses, atol=1e-12)


@pytest.mark.parametrize("link", [*sorted(set(Skin.load().link.values())), "hand_l_distal_link"])
def test_links_of_the_hsr(link: str) -> None:
    moving = {"torso_lift_link": 0, "wrist_roll_link": 4, "hand_palm_link": 4}
    check(Kinematics(), link, BASE_FRAME, moving.get(link, 6) + 1)


def test_a_torso_that_only_rises_needs_no_row() -> None:
    assert link_turns(Kinematics(), JOINTS, "torso_lift_link") == []


def test_links_of_a_robot_of_every_kind(synthetic: Path) -> None:
    joints = ("shoulder", "turn", "side", "up", "ahead")
    kinematics = Kinematics(synthetic, joints)
    for link, rows in (("mast", 1), ("arm", 1), ("fore", 2), ("tool", 3), ("finger", 3)):
        check(kinematics, link, "base", rows)
    assert len(link_turns(kinematics, joints, "tool")) == 3  # shoulder, elbow, what is fixed
    # Without all of its joints the base is none: what turns, turns the links too.
    check(Kinematics(synthetic, ("turn", "grip", "shoulder")), "finger", "map", 6)
    # A follower that is given by itself no longer follows.
    check(Kinematics(synthetic, ("elbow", "shoulder", "tip")), "finger", "map", 4)


def test_joints_of_another_urdf_are_those_that_move_by_themselves(synthetic: Path) -> None:
    assert Kinematics(synthetic).joints == ("side", "ahead", "turn", "up", "shoulder", "grip")


def test_planar_bases(synthetic: Path) -> None:
    hsr, robot = read_urdf(asset_path("hsr.urdf")), read_urdf(synthetic)
    assert planar_base(hsr, JOINTS) == ["odom_x", "odom_y", "odom_t"]
    assert planar_base(hsr, JOINTS[:-1]) == []
    assert planar_base(robot, ["up", "turn", "side", "ahead"]) == ["ahead", "side", "turn"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('xyz="0 2 0"', 'xyz="0 -2 0"'),  # backwards
        ('xyz="0 2 0"', 'xyz="1 0 0"'),  # x twice
        ('xyz="0 2 0"', 'xyz="0 0 1"'),  # up
        ('<axis xyz="0 2 0"/>', '<axis xyz="0 2 0"/><limit lower="-1" upper="1"/>'),
        ('"turn" type="continuous"', '"turn" type="revolute"'),  # to its limits of 0
        ('<origin xyz="0 0 .1"/>', '<origin xyz="0 0 .1" rpy="0 0 .1"/>'),
        ('<parent link="s1"/>', '<parent link="s0"/>'),  # two branches at once
    ],
)
def test_what_is_no_planar_base(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "robot.urdf"
    assert old in SYNTHETIC
    path.write_text(SYNTHETIC.replace(old, new, 1))
    assert planar_base(read_urdf(path), ["side", "ahead", "turn"]) == []


def test_rigid_bodies(synthetic: Path) -> None:
    hsr, robot = read_urdf(asset_path("hsr.urdf")), read_urdf(synthetic)
    assert rigid_body(hsr, "hand_palm_link") == rigid_body(hsr, "wrist_roll_link")
    assert rigid_body(hsr, "torso_lift_link") == "torso_lift_link"
    bodies = {link: rigid_body(robot, link) for link in robot.links}
    expected = {"map": "map", "mast": "base", "lift": "lift", "plate": "arm", "tool": "fore"}
    assert expected.items() <= bodies.items()
    for function in (rigid_body, lambda _, link: link_turns(Kinematics(), JOINTS, link)):
        with pytest.raises(ValueError, match=r"unknown link 'tail'; valid links are: .*odom"):
            function(hsr, "tail")
