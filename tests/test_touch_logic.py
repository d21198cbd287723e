"""From a drag to a finger, and what else of the page needs no browser."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.episode import Episode
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.env import CONTROL_RATE, LARGEST_FORCE, HSRTouchEnv
from hasm_torch.sim.tasks import ARM_JOINTS, BASE_JOINTS
from hasm_torch.touch.charts import because, felt, plain
from hasm_torch.touch.demonstrations import LONGEST, Recorder, Replay
from hasm_torch.touch.figure import Figure
from hasm_torch.touch.fingers import Fingers
from hasm_torch.touch.guide import FASTEST, HandGuide
from hasm_torch.touch.history import SECONDS, History, Reason, Why
from hasm_torch.touch.pointing import (
    NEAR,
    Cells,
    Ray,
    cells_in_world,
    drag_force,
    hit_cell,
    patch_of,
)
from hasm_torch.touch.seat import Seat
from hasm_torch.touch.shelf import Shelf
from hasm_torch.touch.simulated import BUNDLED, body_in

PATCHES = ("a", "b", "c")
EYE = np.array([1.2, -1.0, 1.1])


@pytest.fixture(scope="module")
def env():
    made = HSRTouchEnv("compliance")
    made.reset(seed=0)
    return made


@pytest.fixture(scope="module")
def cells(env):
    return cells_in_world(env.model, env.data, env.skin)


def test_cells_are_where_the_kinematics_says(env, cells):
    import torch

    from hasm_torch._assets import asset_path
    from hasm_torch.robot import Kinematics

    kinematics = Kinematics(asset_path("hsr.urdf"), JOINTS)
    positions, normals = Skin.load().poses(kinematics, torch.tensor(env.joint_position).double())
    np.testing.assert_allclose(cells.positions, positions.numpy(), atol=1e-5)
    np.testing.assert_allclose(cells.normals, normals.numpy(), atol=1e-5)


def test_a_press_on_a_cell_in_view_hits_it(env, cells):
    seen = np.flatnonzero((cells.normals * (cells.positions - EYE)).sum(axis=1) < 0)
    wrist = [c for c in seen if patch_of(env.skin, c)[0].startswith("wrist")]
    assert len({patch_of(env.skin, c)[0] for c in wrist}) >= 2
    for cell in wrist:
        assert hit_cell(Ray(EYE, cells.positions[cell] - EYE), cells) == cell


def test_what_faces_away_is_never_hit(cells):
    for cell in range(len(cells.positions)):
        behind = cells.positions[cell] - 0.5 * cells.normals[cell]
        assert hit_cell(Ray(behind, cells.normals[cell]), cells) != cell


def test_the_first_of_two_cells_in_line_is_hit():
    two = Cells(np.array([[1.0, 0, 0], [2.0, 0, 0]]), np.array([[-1.0, 0, 0], [-1.0, 0, 0]]))
    assert hit_cell(Ray(np.zeros(3), np.array([1.0, 0, 0])), two) == 0
    assert hit_cell(Ray(np.array([1.5, 0, 0]), np.array([1.0, 0, 0])), two) == 1


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_beside_the_skin_the_nearest_cell_is_hit_up_to_a_distance(y, z):
    grid = np.array([[1.0, a, b] for a in (-0.03, 0.0, 0.03) for b in (-0.03, 0.0, 0.03)])
    cells = Cells(grid, np.tile([-1.0, 0.0, 0.0], (9, 1)))
    found = hit_cell(Ray(np.array([0.0, y, z]), np.array([2.0, 0.0, 0.0])), cells)
    away = np.hypot(grid[:, 1] - y, grid[:, 2] - z)
    if away.min() > NEAR:
        assert found is None
    else:
        assert found is not None
        assert away[found] == pytest.approx(away.min())


@pytest.mark.parametrize("way", [np.zeros(3), np.full(3, np.nan)])
def test_a_line_of_sight_that_is_none_hits_nothing(cells, way):
    assert hit_cell(Ray(EYE, way), cells) is None
    assert hit_cell(Ray(np.full(3, np.nan), np.ones(3)), cells) is None


@given(st.floats(0, 1e4), st.floats(0, 1e4))
def test_force_grows_with_the_drag_up_to_a_fingers(one, other):
    weak, strong = sorted((one, other))
    assert 0.0 <= drag_force(weak) <= drag_force(strong) <= LARGEST_FORCE
    assert drag_force(60.0) == pytest.approx(6.0)
    assert drag_force(float("nan")) == 0.0


def test_the_mouse_has_one_finger_and_pinned_ones_stay():
    fingers = Fingers(PATCHES)
    fingers.press("a", 1, 3.0)
    fingers.press("b", 2, 4.0)
    assert fingers.touches == {"b": (4.0, 2)}
    fingers.pin()
    fingers.press("a", 0, 5.0)
    assert fingers.touches == {"b": (4.0, 2), "a": (5.0, 0)}
    fingers.lift()
    assert fingers.touches == {"b": (4.0, 2)}
    fingers.press("b", 2, 99.0)  # the mouse takes the pinned push over
    fingers.lift()
    assert fingers.touches == {}


def test_there_are_two_fingers():
    fingers = Fingers(PATCHES)
    fingers.press("a", None, 3.0, pinned=True)
    fingers.press("b", None, 3.0, pinned=True)
    with pytest.raises(ValueError, match="fingers are in use"):
        fingers.press("c", None, 3.0)
    fingers.let_go()
    fingers.press("c", None, 3.0)
    with pytest.raises(ValueError, match="patch must be one of"):
        fingers.press("nose", None, 3.0)
    with pytest.raises(ValueError, match="force must be"):
        fingers.press("a", None, float("nan"))


def guided(env, guide, steps):
    """Steps an environment by a guiding hand; the greatest speed share of any joint."""
    import torch

    seen, fastest = env._observation(), 0.0
    for _ in range(steps):
        state, skin = (torch.from_numpy(seen[key]) for key in ("state", "tactile"))
        seen, *_ = env.step(guide.step(state, skin).numpy())
        fastest = max(fastest, float((np.abs(env.joint_velocity) / env.joint_speed_limit).max()))
    return fastest


@pytest.mark.parametrize("base", [False, True])
def test_the_grabbed_point_comes_to_where_it_is_dragged(env, base):
    env.reset(seed=0)
    guide = HandGuide(env)
    guide.base = base
    link = env.data.body("hand_palm_link")
    start, before = link.xpos.copy(), env.joint_position
    goal = start + np.array([-0.06, 0.05, -0.08])
    guide.grab("hand_palm_link", start)
    guide.drag(goal)
    assert guided(env, guide, 3 * CONTROL_RATE) <= 1.0 + 1e-6
    assert np.linalg.norm(link.xpos - goal) < 0.01
    moved = np.abs(env.joint_position - before) > 1e-3
    led = np.isin(JOINTS, ARM_JOINTS) | np.isin(JOINTS, BASE_JOINTS)
    assert not moved[~led].any()
    assert moved[[JOINTS.index(j) for j in BASE_JOINTS]].any() == base
    guide.let_go()
    held = env.joint_position
    guided(env, guide, 25)
    np.testing.assert_allclose(env.joint_position, held, atol=0.02)


def test_a_far_goal_is_approached_no_faster_than_a_hand_moves(env):
    env.reset(seed=0)
    guide = HandGuide(env)
    link = env.data.body("hand_palm_link")
    guide.grab("hand_palm_link", link.xpos)
    guide.drag(link.xpos + np.array([0.0, 0.0, 0.6]))
    guided(env, guide, 20)
    before = link.xpos.copy()
    guided(env, guide, 25)
    assert 0.05 < np.linalg.norm(link.xpos - before) / 0.5 < FASTEST + 0.02


def test_a_slid_joint_gets_there_and_is_let_go(env):
    env.reset(seed=0)
    guide = HandGuide(env)
    guide.slide("arm_flex_joint", -0.5)
    guide.slide("arm_lift_joint", 99.0)  # beyond its end
    assert guide.active
    assert guided(env, guide, 6 * CONTROL_RATE) <= 1.0 + 1e-6
    flex, lift = JOINTS.index("arm_flex_joint"), JOINTS.index("arm_lift_joint")
    assert env.joint_position[flex] == pytest.approx(-0.5, abs=0.01)
    assert env.joint_position[lift] == pytest.approx(env.joint_upper[lift], abs=0.01)
    assert not guide.active


def test_nonsense_moves_nothing(env):
    guide = HandGuide(env)
    for point in (np.full(3, np.nan), np.full(3, 1e9), np.zeros(2)):
        with pytest.raises(ValueError, match="expected a point"):
            guide.grab("hand_palm_link", point)
    for joint, position in (("nose", 0.0), ("arm_flex_joint", float("inf"))):
        with pytest.raises(ValueError, match="expected a position"):
            guide.slide(joint, position)
    assert not guide.active


def test_a_recorded_touch_is_read_off_the_skin(env):
    observation, _ = env.reset(seed=0)
    recorder = Recorder()
    pushed = {"wrist_upper": (6.0, 2), "torso_front": (4.0, 5)}
    for _ in range(40):
        env.touch_all(pushed)
        recorder.add(observation, env.joint_position)
        observation, *_ = env.step(env.joint_position.astype(np.float32))
    episode = recorder.episode(3, "stand")
    assert len(episode) == 40
    assert episode.tactile.shape == (40, env.skin.cells, 3)
    replay = Replay(episode, moved=False, step=30)
    for patch, (force, cell) in replay.touches(env.skin).items():
        assert (force, cell) == (pytest.approx(pushed[patch][0], abs=0.05), pushed[patch][1])
    assert set(replay.touches(env.skin)) == set(pushed)
    with pytest.raises(ValueError, match="nothing was recorded"):
        Recorder().episode(0, "x")


def test_a_recording_has_an_end():
    recorder = Recorder()
    seen = {"state": np.zeros(11, np.float32), "tactile": np.zeros(6, np.float32)}
    for _ in range(round(LONGEST * CONTROL_RATE)):
        assert not recorder.full
        recorder.add(seen, np.zeros(11))
    assert recorder.full


def test_one_page_drives_and_others_take_over_when_it_leaves():
    seat = Seat()
    assert seat.join(1)
    assert not seat.join(2)
    assert not seat.take(2)
    assert not seat.leave(3)
    assert seat.leave(1)
    assert seat.driver is None
    assert seat.take(2)
    assert not seat.join(1)
    assert (seat.driver, seat.pages) == (2, 2)
    assert not seat.take(7)


@pytest.mark.parametrize(
    "name", ["", "..", "../x", "a/b", "/etc", "a b", "x" * 65, "-x", "ü", "a\n"]
)
def test_nothing_is_put_outside_the_shelf(tmp_path, name):
    with pytest.raises(ValueError, match="letters, digits"):
        Shelf(tmp_path).place("dataset", name)
    with pytest.raises(ValueError, match="expected one of"):
        Shelf(tmp_path).place(name, "x")


@pytest.mark.parametrize("scene", BUNDLED)
def test_the_empty_robot_has_the_body_of_the_bundled_teaching(scene):
    assert body_in(scene) == body_of(load_episodes(f"datasets/{BUNDLED[scene]}"))


def volume(part):
    a, b, c = (part.vertices[part.faces[:, i]].astype(np.float64) for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("scene", ["compliance", "grasp"])
def test_what_is_drawn_is_what_collides_or_shows(scene):
    """Closed, facing outward, and as large as MuJoCo's own shapes (cylinders have twenty sides)."""
    env = HSRTouchEnv(scene)
    env.reset(seed=0)
    figure, model = Figure(env.model), env.model
    size = {0: 0.0}
    for geom in range(model.ngeom):
        half, kind = model.geom_size[geom], model.geom_type[geom]
        if model.geom_group[geom] > 1 or kind == 0 or model.geom(geom).name.startswith("skin/"):
            continue
        sphere, cylinder, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER, 6
        whole = {
            int(sphere): 4 / 3 * np.pi * half[0] ** 3,
            int(cylinder): 2 * np.pi * half[0] ** 2 * half[1],
            box: 8 * half.prod(),
        }[int(kind)]
        body = model.body_weldid[model.geom_bodyid[geom]]
        size[body] = size.get(body, 0.0) + whole
    drawn: dict[int, float] = {}
    for part in figure.parts():
        body = model.body(part.body).id
        drawn[body] = drawn.get(body, 0.0) + volume(part)
    for body, whole in size.items():
        if whole:
            assert drawn[body] == pytest.approx(whole, rel=0.06)


def test_bodies_are_drawn_where_they_are(env):
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.joint_position.astype(np.float32) + 0.1)
    figure = Figure(env.model)
    for poses, close in (
        (figure.poses(env.data.qpos), 1e-9),
        (figure.poses_at(env.joint_position, env.data.qpos), 2e-3),  # the fingers give way a bit
    ):
        places, frames = [], []
        for i, (name, pose) in enumerate(zip(figure.bodies, poses)):
            turned, parent = np.zeros(9), figure.parents[i]
            mujoco.mju_quat2Mat(turned, pose.orientation)
            outer = frames[parent] if parent < i else np.eye(3)
            places.append(outer @ pose.position + (places[parent] if parent < i else 0.0))
            frames.append(outer @ turned.reshape(3, 3))
            np.testing.assert_allclose(places[-1], env.data.body(name).xpos, atol=close)
    assert figure.bodies[0] == "world"
    assert "wrist_roll_link" in figure.bodies


def test_history_shows_the_last_seconds_in_order():
    history = History(2, 3)
    length = round(SECONDS * CONTROL_RATE)
    for i in range(2 * length + 7):
        history.add(np.full(2, i), np.full(3, -i), float(i))
    spikes, joints, force = history.last()
    np.testing.assert_array_equal(force, np.arange(length + 7, 2 * length + 7))
    np.testing.assert_array_equal(spikes[:, 1], force)
    np.testing.assert_array_equal(joints[:, 2], -force)


def test_bars_are_as_long_as_their_weights():
    reasons = tuple(Reason(i, 0.5 * i, 0.5 / (i + 1), i, "wrist_upper") for i in range(3))
    html = because(Why(reasons, 0.8, 3.2, False, True), known=4)
    for reason in reasons:
        assert f"demo {reason.episode} at {reason.time:.2f} s" in html
        assert f"width:{100 * reason.weight:.1f}%" in html
    assert "80 % sure" in html
    assert "This posture was not taught" in html
    assert "knows nothing" in because(None, known=0)


def test_charts_show_every_patch_and_joint_and_only_text(env):
    from pathlib import Path

    from hasm_torch.config import HASMConfig
    from hasm_torch.model.hasm import HASM
    from hasm_torch.touch.session import Session

    session = Session("compliance", HASM(HASMConfig(), body_in("compliance")), Shelf(Path("x")))
    html = felt(session.snapshot, env.skin.patches, env.joint_lower, env.joint_upper)
    session.close()
    assert all(plain(patch) in html for patch in env.skin.patches)
    assert all(plain(joint) in html for joint in JOINTS)
    assert "http" not in html
    assert "nan" not in html


def test_an_episode_without_skin_replays_without_touch(env):
    flat = np.zeros((3, 11), np.float32)
    assert Replay(Episode(0, "x", np.arange(3) / 50, flat, flat), True).touches(env.skin) == {}
