"""Skin on any robot: cells lie on its surfaces, and what touches them is felt, all of it."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import reference
import torch
from contacts import contact_force

from hasm_torch.apps.skin import main
from hasm_torch.robot import Skin
from hasm_torch.sim.add_skin import add_skin, plates
from hasm_torch.sim.any_robot import SkinnedRobot, body_of_robot, load_robot
from hasm_torch.sim.patch import PITCH, THICKNESS, Patch
from hasm_torch.sim.skin_layout import lay_out
from hasm_torch.sim.skin_sensor import SkinSensor
from hasm_torch.sim.skin_surfaces import rows
from hasm_torch.sim.teacher import YieldTeacher

FLAT = 0.98 * PITCH  # a little less than a cell is wide
HALF = (0.1, 0.08, 0.05)  # m, of the box
RADIUS, HALF_LENGTH = 0.05, 0.1  # m, of cylinder and capsule
BALL = 0.09  # m, radius of the sphere mesh

MJCF = f"""
<mujoco>
  <asset>
    <mesh name="sphere" builtin="sphere" params="4" scale="{BALL} {BALL} {BALL}"/>
  </asset>
  <worldbody>
    <body name="base">
      <geom type="cylinder" size="0.04 0.05"/>
      <body name="arm" pos="0 0 0.2" euler="10 20 30">
        <joint name="turn" axis="0 0 1" range="-90 90"/>
        <geom name="block" type="box" size="{HALF[0]} {HALF[1]} {HALF[2]}" pos="0.1 0.02 0"
          euler="0 0 25"/>
        <body name="hand" pos="0.3 0 0" euler="0 40 0">
          <joint name="nod" axis="0 1 0" range="-60 80"/>
          <joint name="slide" type="slide" axis="1 0 0" range="0 0.1"/>
          <geom name="rod" type="capsule" size="{RADIUS} {HALF_LENGTH}" pos="0 0.01 0"/>
          <body name="ball" pos="0 0 0.35">
            <joint name="roll" axis="1 0 0" range="-90 90"/>
            <geom name="globe" type="mesh" mesh="sphere"/>
            <geom type="cylinder" size="0.03 0.03" pos="0 0 -0.15"/>
            <joint name="loose" axis="0 1 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="turn"/></actuator>
  <keyframe><key qpos="0 0 0 0 0"/></keyframe>
</mujoco>
"""
URDF = f"""
<robot name="arm">
  <link name="base"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5" effort="9" velocity="2"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="0.2 0.16 0.1"/></geometry></visual>
    <collision><geometry><box size="0.2 0.16 0.1"/></geometry></collision></link>
  <joint name="fixed" type="fixed"><parent link="arm"/><child link="tool"/>
    <origin xyz="0.3 0 0" rpy="0 1 0"/></joint>
  <link name="tool"><collision><geometry><cylinder radius="{RADIUS}" length="{2 * HALF_LENGTH}"/>
    </geometry></collision></link>
</robot>
"""
PATCHES = [
    Patch("top", "arm", "box", toward=[0.0, 0.0, 1.0]),
    Patch("side", "arm", "box", "block", toward=[0.3, 1.0, 0.0]),
    Patch("rod", "hand", "capsule", toward=[1.0, 0.0, 0.0], angle=200.0),
    Patch("ball", "ball", geom="globe", toward=[1.0, 0.5, 0.4]),
]
JOINTS = ("turn", "nod", "slide", "roll")


def spec():
    return mujoco.MjSpec.from_string(MJCF)


@pytest.fixture(scope="module")
def skin():
    return lay_out(spec(), PATCHES)


@pytest.fixture(scope="module")
def robot():
    return SkinnedRobot(spec(), PATCHES, JOINTS, [2.0, 2.0, 0.2, 2.0], [0.1, -0.2, 0.05, 0.3])


def part(skin, patch):
    span = skin.slices[patch]
    return [array[span].numpy() for array in (skin.positions, skin.normals, skin.points)]


def neighbours(positions):
    """Distance of each cell's nearest one, m."""
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return apart.min(1)


# ---- where cells lie


@pytest.mark.parametrize(("width", "height"), [(0.2, 0.16), (0.0736, 0.0708), (0.086, 0.05)])
def test_a_rectangle_is_filled_with_whole_cells_in_rows(width, height):
    cells = np.concatenate(rows(width, height, PITCH))
    assert (np.abs(cells[:, 0]) + PITCH / 2 <= width / 2 + 1e-9).all()
    assert (np.abs(cells[:, 1]) + PITCH / np.sqrt(3) <= height / 2 + 1e-9).all()
    np.testing.assert_allclose(neighbours(cells), PITCH, rtol=1e-9)
    np.testing.assert_allclose(cells.mean(0)[1], 0, atol=PITCH)
    # At most a row and a column of cells are missing.
    area = PITCH**2 * np.sqrt(3) / 2
    assert len(cells) * area > (width - 1.5 * PITCH) * (height - 1.5 * PITCH)


def test_too_small_a_rectangle_holds_no_cell():
    assert not rows(0.02, 0.1, PITCH)[0].size
    assert rows(0.1, 0.02, PITCH) == []


def test_a_face_of_a_turned_box_is_covered(skin):
    turn = reference.rodrigues([0.0, 0.0, 1.0], np.radians(25))
    for name, axis, half, others in (("top", 2, HALF[2], (0, 1)), ("side", 1, HALF[1], (0, 2))):
        positions, normals, _ = part(skin, name)
        local = (positions - (0.1, 0.02, 0.0)) @ turn
        np.testing.assert_allclose(local[:, axis], half + THICKNESS, atol=1e-12)
        np.testing.assert_allclose(normals @ turn, np.tile(np.eye(3)[axis], (len(local), 1)),
                                   atol=1e-12)  # fmt: skip
        for other in others:
            assert np.abs(local[:, other]).max() <= HALF[other] - PITCH / 2
        np.testing.assert_allclose(neighbours(positions), PITCH, rtol=1e-6)
        assert name in skin.surfaces


@pytest.mark.parametrize("angle", [90.0, 200.0, 360.0])
def test_a_round_side_is_covered_over_its_angle(angle):
    patch = Patch("rod", "hand", "capsule", toward=[1.0, 0.0, 0.3], angle=angle)
    laid = lay_out(spec(), [patch])
    positions, normals, points = part(laid, "rod")
    offset = positions - (0.0, 0.01, 0.0)
    np.testing.assert_allclose(np.hypot(*offset[:, :2].T), RADIUS + THICKNESS, rtol=1e-9)
    np.testing.assert_allclose(
        normals, np.column_stack([offset[:, :2], 0 * offset[:, 2]]) / (RADIUS + THICKNESS),
        atol=1e-9)  # fmt: skip
    assert np.abs(offset[:, 2]).max() <= HALF_LENGTH - PITCH / np.sqrt(3) + 1e-9
    turned = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    assert np.ptp(turned) <= angle + 1e-9
    assert np.ptp(turned) > angle - 75  # a cell is 25 degrees wide
    assert neighbours(positions).min() >= FLAT
    np.testing.assert_allclose(points.mean(1), positions, atol=1e-12)
    np.testing.assert_allclose(np.einsum("npx,nx->np", points - positions[:, None], normals), 0,
                               atol=1e-12)  # fmt: skip


def test_a_mesh_is_covered_from_where_it_is_seen(skin):
    positions, normals, _ = part(skin, "ball")
    outward = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    # A plate on seven points of a ball: it lies on the ball and hardly leans.
    distance = np.einsum("nx,nx->n", positions, normals) - THICKNESS
    assert (np.abs(distance - BALL) < 0.002).all()
    assert (np.einsum("nx,nx->n", outward, normals) > np.cos(np.radians(4))).all()
    toward = np.array([1.0, 0.5, 0.4]) / np.linalg.norm([1.0, 0.5, 0.4])
    seen = outward @ toward
    assert seen.min() > 0.4
    assert seen.max() > np.cos(np.radians(12))
    assert neighbours(positions).min() >= FLAT
    # Half of what is seen under less than 60 degrees is a quarter of the ball.
    assert len(positions) * PITCH**2 * np.sqrt(3) / 2 > 0.5 * np.pi * BALL**2
    assert "ball" not in skin.surfaces


def test_bounds_and_other_patches_leave_cells_out():
    whole = lay_out(spec(), [Patch("a", "ball")])
    upper = lay_out(spec(), [Patch("a", "ball", lower=[-1.0, -1.0, 0.0])])
    assert 0 < upper.cells < whole.cells
    assert upper.positions[:, 2].min() >= 0
    both = lay_out(spec(), [Patch("a", "ball"), Patch("b", "ball", toward=[1.0, 1.0, 0.0])])
    assert both.slices["a"].stop == whole.cells < both.cells
    assert neighbours(both.positions.numpy()).min() >= FLAT
    box = lay_out(spec(), [Patch("a", "arm", "box", toward=[0, 0, 1], lower=[0.1, -1, -1])])
    assert not box.surfaces
    assert box.positions[:, 0].min() >= 0.1 - 1e-4


@pytest.mark.parametrize(
    ("patch", "says"),
    [
        (Patch(link="leg"), "no link 'leg'; the links are: .*arm, hand, ball"),
        (Patch(link="arm", surface="capsule"), "needs one capsule of 'arm', found 0.*box 'block'"),
        (Patch(link="arm", surface="box", geom="x"), "found 0"),
        (Patch(link="ball", pitch=0.5), "no cell of patch 'skin'.*pitch"),
        (Patch(link="hand", surface="capsule", pitch=0.2), "do not fit around"),
    ],
)
def test_what_cannot_be_covered_is_said(patch, says):
    with pytest.raises(ValueError, match=says):
        lay_out(spec(), [patch])


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"surface": "ball"}, "one of box, capsule, cylinder, mesh, got 'ball'"),
        ({"toward": [0, 0, 0]}, "toward"),
        ({"lower": [1.0]}, "lower must be three numbers"),
        ({"angle": 400.0}, "up to 360"),
        ({"pitch": 0.0}, "above 0 m"),
    ],
)
def test_a_patch_that_makes_no_sense_is_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        Patch(**wrong)


def test_a_skin_is_read_as_it_was_written(skin, tmp_path):
    skin.save(tmp_path / "skin.json")
    again = Skin.load(tmp_path / "skin.json")
    assert (again.patches, again.slices, again.link) == (skin.patches, skin.slices, skin.link)
    for name in ("positions", "normals", "points"):
        torch.testing.assert_close(getattr(again, name), getattr(skin, name), rtol=0, atol=0)
    assert again.surfaces.keys() == skin.surfaces.keys()
    (tmp_path / "other.json").write_text('{"patches": [{"name": "a"}]}')
    with pytest.raises(ValueError, match="holds no skin: expected patches"):
        Skin.load(tmp_path / "other.json")


# ---- what is felt


@pytest.mark.parametrize("patch", ["top", "side", "rod", "ball"])
def test_a_pushed_cell_lights_up_and_no_force_is_lost(robot, patch):
    hold = robot.reset()[0]["state"]
    span = robot.skin.slices[patch]
    _, normals, _ = part(robot.skin, patch)
    for cell in range(0, span.stop - span.start, 3):
        robot.touch(None)
        robot.step(hold)
        robot.touch(patch, 6.0, cell)
        for _ in range(8):
            _, _, _, _, info = robot.step(hold)
        forces = robot.skin_forces
        assert forces.shape == (robot.skin.cells, 3)
        assert (forces >= 0).all()
        assert abs(forces.sum() - contact_force(robot)) < 1e-9
        assert info["finger_force"] == pytest.approx(6.0, rel=0.02)
        assert forces.sum(1).argmax() == span.start + cell
        assert not np.delete(forces, np.arange(span.start, span.stop), axis=0).any()
        (touched,) = robot.touch_points()
        turn = robot.data.body(robot.skin.link[patch]).xmat.reshape(3, 3)
        assert touched.force @ (turn @ normals[cell]) < -0.9 * np.linalg.norm(touched.force)


def test_the_middle_of_a_bent_patch_is_one_of_its_cells(robot):
    robot.reset()
    robot.touch("rod", 5.0)
    for _ in range(8):
        robot.step(robot.home)
    assert robot.skin_forces.sum() == pytest.approx(5.0, rel=0.02)
    positions, _, _ = part(robot.skin, "rod")
    middle = np.linalg.norm(positions - positions.mean(0), axis=1).argmin()
    assert robot.skin_forces.sum(1).argmax() == robot.skin.slices["rod"].start + middle


def test_what_lies_on_the_skin_is_felt_with_all_its_weight():
    """No finger of ours: a body that falls on the robot's skin, in a model of one's own."""
    falling = mujoco.MjSpec.from_string(MJCF.replace(' euler="10 20 30"', ""))
    for element in [*falling.joints, *falling.actuators, *falling.keys]:
        falling.delete(element)
    skin = add_skin(falling, [Patch("top", "arm", toward=[0.0, 0.0, 1.0])])  # as a mesh: plates
    item = falling.worldbody.add_body(name="item", pos=[0.1, 0.02, 0.29])
    item.add_freejoint()
    item.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.03, 0.03, 0.02], mass=0.7)
    falling.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    model = falling.compile()
    data, sensor = mujoco.MjData(model), SkinSensor(model, skin)
    for _ in range(3000):
        mujoco.mj_step(model, data)
    assert sensor.read(data).sum() == pytest.approx(0.7 * 9.81, rel=1e-3)
    push = sensor.pushes[model.body("item").id]
    np.testing.assert_allclose(push, [0.0, 0.0, -0.7 * 9.81], atol=0.01)
    felt = sensor.read(data).sum(1)
    centre = felt @ skin.positions.numpy() / felt.sum()
    np.testing.assert_allclose(centre[:2], data.body("item").xpos[:2] - model.body("arm").pos[:2],
                               atol=0.01)  # fmt: skip


def test_the_same_on_a_urdf(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    patches = [
        Patch("arm", "arm", "box", toward=[0.0, -1.0, 0.0]),
        Patch("tool", "tool", "cylinder", angle=360.0),
        Patch("end", "tool", toward=[0.0, 0.0, 1.0]),
    ]
    env = SkinnedRobot(load_robot(tmp_path / "arm.urdf"), patches, ["turn"], [2.0], [0.3])
    assert set(env.skin.link.values()) == {"arm", "tool"}
    for patch in env.skin.patches:
        env.reset()
        env.touch(patch, 4.0, 2)
        for _ in range(10):
            env.step(env.home)
        assert abs(env.skin_forces.sum() - contact_force(env)) < 1e-9
        assert env.skin_forces.sum() == pytest.approx(4.0, rel=0.02)
        assert env.skin_forces.sum(1).argmax() == env.skin.slices[patch].start + 2


def test_plates_leave_no_gap_on_a_plane():
    """Three cells around a point, one row on the next: their plates meet there."""
    skin = lay_out(spec(), [Patch("a", "arm", "box", toward=[0, 0, 1], upper=[9.0, 9.0, 9.0])])
    flat = {name: getattr(skin, name) for name in ("positions", "normals", "points")}
    loose = Skin(skin.patches, skin.slices, skin.link, {}, **flat)
    boxes = plates(loose, "a")
    middle = skin.positions.numpy().mean(0)
    rng = np.random.default_rng(0)
    for point in middle + np.column_stack([rng.uniform(-0.03, 0.03, (200, 2)), np.zeros(200)]):
        inside = [
            (np.abs((point - b.centre) @ b.axes.T) <= b.half_size + 1e-9).all() for b in boxes
        ]
        assert any(inside)


def test_unknown_files_and_joints_are_said(tmp_path):
    with pytest.raises(FileNotFoundError, match="robot's MJCF or URDF"):
        load_robot(tmp_path / "none.xml")
    (tmp_path / "text.xml").write_text("<html/>")
    with pytest.raises(ValueError, match="is no MJCF or URDF that MuJoCo reads"):
        load_robot(tmp_path / "text.xml")
    with pytest.raises(ValueError, match="no joint elbow; the joints are: turn, nod, slide"):
        SkinnedRobot(spec(), PATCHES, ["elbow"], [1.0], [0.0])


# ---- the robot as models and teachers see it


def test_links_turn_as_the_simulation_turns_them(robot):
    body, rng = body_of_robot(robot), np.random.default_rng(4)
    assert body.joints == list(JOINTS)
    assert body.cells == [len(part(robot.skin, patch)[0]) for patch in robot.skin.patches]
    for _ in range(5):
        q = rng.uniform(robot.joint_lower + 0.01, robot.joint_upper - 0.01)
        robot.reset(options={"joints": q})
        for link, rows_of_link in body.chains.items():
            expected = robot.data.body(link).xmat.reshape(3, 3)
            found = reference.link_rotation(rows_of_link, robot.joint_position)
            np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_law_moves_the_pushed_point_with_the_force(robot):
    teacher = YieldTeacher(robot, dict.fromkeys(robot.skin.patches, JOINTS))
    for patch, cell in (("rod", 4), ("ball", 7)):
        observation, _ = robot.reset()
        teacher.reset()
        robot.touch(patch, 8.0, cell)
        places = []
        for _ in range(25):
            state, skin = (torch.from_numpy(observation[key]) for key in ("state", "tactile"))
            observation, *_ = robot.step(teacher.step(state, skin).numpy())
            places.append(robot.touch_points()[0])
        way = places[-1].point - places[10].point
        force = places[10].force
        assert way @ force > 0.7 * np.linalg.norm(way) * np.linalg.norm(force)
        assert np.linalg.norm(way) > 0.01


def test_a_link_that_turns_with_an_unnamed_joint_is_refused():
    env = SkinnedRobot(spec(), PATCHES, JOINTS, [2.0, 2.0, 0.2, 2.0], [0.0] * 4)
    env.joints = JOINTS[:1]
    with pytest.raises(ValueError, match="'hand' turns with 'nod'"):
        body_of_robot(env)


def test_the_page_is_true(monkeypatch, tmp_path, capsys):
    """Its blocks run one after the other, and its patches are laid out by its YAML too."""
    pytest.importorskip("lerobot", reason="the page writes a LeRobot dataset")
    text = (Path(__file__).parents[1] / "docs" / "robot.md").read_text()
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, "docs/robot.md", "exec"), names)
    assert (tmp_path / "outputs" / "my_robot" / "meta" / "info.json").is_file()
    assert float(capsys.readouterr().out.split("cos of way and force:")[1]) > 0.7
    (yaml,) = re.findall(r"```yaml\n(.*?)```", text, re.S)
    (tmp_path / "robot.xml").write_text(names["ROBOT"])
    (tmp_path / "skin.yaml").write_text(yaml)
    monkeypatch.setattr("sys.argv", ["hasm-skin", "--config_path=skin.yaml"])
    main()
    made = Skin.load(tmp_path / "skin.json")
    torch.testing.assert_close(made.positions, names["skin"].positions, rtol=0, atol=0)
