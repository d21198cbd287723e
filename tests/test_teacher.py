"""What the demonstrator's laws promise: the touched point moves with the force."""

import itertools

import mujoco
import numpy as np
import pytest
import torch

from hasm_torch.robot import JOINTS
from hasm_torch.sim import HSRTouchEnv
from hasm_torch.sim.grasp_path import grasp_poses
from hasm_torch.sim.tasks import (
    BEHAVIOURS,
    FAR,
    GRASP_PATCH,
    GRASP_POSES,
    OBJECT_PLACES,
    REACH_PATCH,
    START_POSES,
    UPRIGHT,
    YIELD_GAIN,
    noisy_start,
    random_posture,
    upright_posture,
)
from hasm_torch.sim.teacher import (
    LEAD_TIME,
    ComplianceTeacher,
    GraspTeacher,
    YieldTeacher,
    damped_least_squares,
)

ARM, BASE = slice(0, 5), slice(8, 11)
POSTURE = np.array([0.3, -1.2, 0.4, -0.8, 0.5, 0.0, 0.0, 0.3, 0.1, -0.2, 2.0])


@pytest.fixture(scope="module")
def env():
    env = HSRTouchEnv("compliance")
    yield env
    env.close()


@pytest.fixture(scope="module")
def scene():
    env = HSRTouchEnv("grasp")
    yield env
    env.close()


def roll(env, teacher, observation, steps):
    """Steps a teacher on; returns forces and places of all touches, and the last observation."""
    touches = []
    for _ in range(steps):
        state, skin = (torch.from_numpy(observation[name]) for name in ("state", "tactile"))
        target = teacher.step(state, skin).numpy()
        assert target.dtype == np.float32
        observation, *_ = env.step(target)
        touches.append(env.touch_points())
    return touches, observation


def push(env, teacher, start, touches, steps=60):
    """Positions (steps, J) and per finger forces and points (steps, 3) of a steady push."""
    observation, _ = env.reset(seed=0, options={"joints": start})
    teacher.reset()
    env.touch_all(touches)
    seen, observation = roll(env, teacher, observation, steps)
    forces = np.array([[touch.force for touch in row] for row in seen])
    points = np.array([[touch.point for touch in row] for row in seen])
    return observation, forces, points


def velocity(points):
    """Of the settled second half, m/s."""
    half = len(points) // 2
    return (points[-1] - points[half]) / (0.02 * (len(points) - 1 - half))


def cosine(a, b):
    return a @ b / np.linalg.norm(a) / np.linalg.norm(b)


def test_least_squares_give_the_velocity_where_the_joints_can():
    rng = np.random.default_rng(0)
    jacobian, wanted = rng.normal(size=(3, 5)), np.array([0.1, -0.2, 0.05])
    weights = np.array([0.04, 1.4, 4.0, 2.2, 2.2])
    speed = damped_least_squares(jacobian, weights, wanted, damping=1e-6)
    np.testing.assert_allclose(jacobian @ speed, wanted, atol=1e-6)
    # No other speeds that do so are cheaper: a change within the null space costs.
    for other in np.linalg.svd(jacobian)[2][3:]:
        assert abs((speed / weights) @ other) < 1e-6


def test_damping_bounds_the_speeds_near_singular_postures():
    weights = np.array([1.0, 4.0])
    for size in np.logspace(-4, 0, 20):
        jacobian = size * np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
        speed = damped_least_squares(jacobian, weights, np.array([0.09, 0.09, 0.0]))
        assert (np.abs(speed) <= np.sqrt(weights) * 0.09 / (2 * 0.05) + 1e-12).all()


@pytest.mark.parametrize("patch", ["wrist_upper", "wrist_under", "wrist_left", "wrist_right"])
@pytest.mark.parametrize("force", [3.0, 9.0])
def test_the_touched_point_of_the_wrist_moves_with_the_force(env, patch, force):
    observation, forces, points = push(env, YieldTeacher(env), POSTURE, {patch: (force, 2)})
    moved, applied = velocity(points[:, 0]), forces[-1, 0]
    assert cosine(moved, applied) > 0.9
    assert 0.8 < np.linalg.norm(moved) / (YIELD_GAIN * force) < 1.1
    np.testing.assert_allclose(observation["state"][5:], POSTURE[5:], atol=2e-3)  # the arm alone


@pytest.mark.parametrize("patch", ["torso_front", "torso_left", "torso_right"])
def test_the_base_moves_with_a_push_on_the_torso_whatever_its_yaw(env, patch):
    observation, forces, points = push(env, YieldTeacher(env), POSTURE, {patch: (6.0, None)}, 80)
    moved, applied = velocity(points[:, 0]), forces[-1, 0]
    assert cosine(moved[:2], applied[:2]) > 0.99
    assert cosine((observation["state"] - POSTURE)[8:10], applied[:2]) > 0.98
    still = np.delete(observation["state"] - POSTURE, [8, 9])
    assert np.abs(still).max() < 5e-3


def test_two_touches_add_up(env):
    teacher, asked = YieldTeacher(env), []
    for touches in ({"wrist_upper": 4.0}, {"torso_left": 6.0}, {"wrist_upper": 4.0, "torso_left": 6.0}):  # fmt: skip # noqa: E501
        push(env, teacher, POSTURE, touches)
        asked.append(teacher.target - POSTURE)
    np.testing.assert_allclose(asked[2], asked[0] + asked[1], atol=0.01)
    assert np.abs(asked[2]).max() > 0.05


def test_a_led_direction_is_turned_off_the_force(env):
    teacher = YieldTeacher(env)
    observation, _ = env.reset(seed=0, options={"joints": POSTURE})
    env.touch("torso_front", 6.0)
    teacher.tilt = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    roll(env, teacher, observation, 40)
    (touch,) = env.touch_points()
    moved = (teacher.target - POSTURE)[8:10]
    assert cosine(moved, np.array([-touch.force[1], touch.force[0]])) > 0.99
    teacher.reset()
    np.testing.assert_array_equal(teacher.tilt, np.eye(3))


def test_a_fast_push_keeps_its_direction_within_the_speed_limits(env):
    teacher = YieldTeacher(env)
    observation, _ = env.reset(seed=0, options={"joints": POSTURE})
    env.touch("torso_front", 15.0, 0)
    before, steps = POSTURE, []
    for _ in range(40):
        _, observation = roll(env, teacher, observation, 1)
        steps.append((teacher.target - before) * 50)
        before = teacher.target
        assert (np.abs(env.joint_velocity) <= env.joint_speed_limit).all()
    last, force = steps[-1], env.touch_points()[0].force
    assert np.abs(last / env.joint_speed_limit).max() == pytest.approx(0.9, abs=1e-6)
    assert cosine(last[8:10], force[:2]) > 0.999


def test_blocked_joints_do_not_wind_up_and_a_release_stops(env):
    teacher = YieldTeacher(env)
    observation, _ = env.reset(seed=0, options={"joints": POSTURE})
    env.block(JOINTS)
    env.touch("wrist_upper", 8.0)
    _, observation = roll(env, teacher, observation, 100)
    ahead = np.abs(teacher.target - env.joint_position)
    assert (ahead <= LEAD_TIME * env.joint_speed_limit + 1e-6).all()
    env.block([])
    env.touch(None)
    _, observation = roll(env, teacher, observation, 30)
    rested = observation["state"]
    _, observation = roll(env, teacher, observation, 30)
    np.testing.assert_allclose(observation["state"], rested, atol=1e-3)


def test_compliance_leads_one_joint_at_a_pace_proportional_to_the_force(env):
    speeds = []
    for force in (3.0, 9.0):
        teacher = ComplianceTeacher(env)
        observation, *_ = push(env, teacher, POSTURE, {"wrist_under": force}, 80)
        moved = observation["state"] - POSTURE
        assert moved[1] > 0.05
        assert np.abs(np.delete(moved, 1)).max() < 5e-3
        speeds.append(moved[1])
    assert speeds[1] / speeds[0] == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize("behaviour", BEHAVIOURS[:2], ids=lambda b: b.name)
def test_in_upright_postures_the_arm_moves_with_the_force(env, behaviour):
    """The corners of `UPRIGHT`, over the whole range of the joint, for every cell."""
    data, skin, joint = mujoco.MjData(env.model), env.skin, env.model.joint(behaviour.joint)
    link = env.model.body(skin.link[behaviour.patch]).id
    cells = skin.slices[behaviour.patch]
    jacobian, worst = np.zeros((3, env.model.nv)), 1.0
    corners = itertools.product(*((-reach, 0.0, reach) for reach in UPRIGHT.values()))
    for corner, flex in itertools.product(corners, np.linspace(*joint.range, 5)):
        for name, value in (*zip(UPRIGHT, corner), (behaviour.joint, flex)):
            data.qpos[env.model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(env.model, data)
        mujoco.mj_comPos(env.model, data)
        rotation = data.xmat[link].reshape(3, 3)
        force = -rotation @ skin.normals[cells][0].numpy()
        for cell in skin.positions[cells].numpy():
            point = data.xpos[link] + rotation @ cell
            mujoco.mj_jac(env.model, data, jacobian, None, point, link)
            moved = behaviour.direction * jacobian[:, joint.dofadr[0]]
            worst = min(worst, cosine(moved, force))
    assert 0.9 < worst < 0.95


def test_postures_lie_in_the_limits_and_cover_them(env):
    rng, limits = np.random.default_rng(0), (env.joint_lower, env.joint_upper)
    anywhere = np.array([random_posture(*limits, rng) for _ in range(500)])
    upright = np.array([upright_posture(*limits, rng) for _ in range(500)])
    home = np.array(START_POSES["grasp"])
    noisy = np.array([noisy_start(home, 0.05, *limits, rng) for _ in range(500)])
    for postures in (anywhere, upright, noisy):
        assert (postures >= limits[0]).all()
        assert (postures <= limits[1]).all()
        assert not postures[:, BASE].any()
    span = (limits[1] - limits[0])[:8]
    assert (np.ptp(anywhere[:, :8], axis=0) > 0.85 * span).all()
    for joint, reach in UPRIGHT.items():
        assert 0.9 * reach < np.abs(upright[:, JOINTS.index(joint)]).max() <= reach
    assert noisy[:, 0].std() < 0.012 < 0.03 < noisy[:, 2].std()


@pytest.mark.parametrize("offset", [(0.0, 0.0), (FAR, FAR), (-FAR, -FAR), (-FAR, FAR)])
def test_the_hand_is_moved_as_the_object_is(scene, offset):
    data, hand = mujoco.MjData(scene.model), scene.model.body("hand_palm_link").id
    addresses = [int(scene.model.joint(name).qposadr[0]) for name in JOINTS]

    def pose(joints):
        data.qpos[addresses] = joints
        mujoco.mj_kinematics(scene.model, data)
        return data.xpos[hand].copy(), data.xmat[hand].copy()

    moved = grasp_poses(scene, np.array(offset))
    assert list(moved) == list(GRASP_POSES)
    for name, nominal in GRASP_POSES.items():
        (before, turned), (after, now) = pose(nominal), pose(moved[name])
        np.testing.assert_allclose(after - before, (*offset, 0.0), atol=1e-5)
        np.testing.assert_allclose(now, turned, atol=1e-5)
        assert (moved[name] >= scene.joint_lower).all()
        assert (moved[name] <= scene.joint_upper).all()
        np.testing.assert_array_equal(moved[name][5:8], nominal[5:8])  # head and fingers


def test_arm_and_base_share_the_way(scene):
    changes = grasp_poses(scene, np.array((0.0, 0.05)))["around"] - GRASP_POSES["around"]
    assert 0.01 < np.abs(changes[BASE]).max() < 0.1
    assert np.abs(changes[ARM]).max() > 0.1


@pytest.mark.parametrize("place", [*OBJECT_PLACES[9:25:15], (0.07, -0.03)])
def test_the_grasp_teacher_lifts_the_object_at_other_places(scene, place):
    rng, limits = np.random.default_rng(3), (scene.joint_lower, scene.joint_upper)
    start = noisy_start(np.array(START_POSES["grasp"]), 0.05, *limits, rng)
    teacher = GraspTeacher(scene)
    observation, info = scene.reset(seed=0, options={"joints": start, "object": place})
    for patch in (REACH_PATCH, GRASP_PATCH):
        assert teacher.progress(patch) == 0.0
        scene.touch(patch, 12.0)
        for _ in range(400):
            _, observation = roll(scene, teacher, observation, 1)
            if teacher.progress(patch) == 1.0:
                break
    roll(scene, teacher, observation, 50)
    *_, info = scene.step(teacher.target.astype(np.float32))
    assert info["is_success"]
    assert info["object_height"] > 0.15


def test_a_grasp_without_an_object_is_an_error(env):
    teacher = GraspTeacher(env)
    observation, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match="has an object"):
        roll(env, teacher, observation, 1)


def test_a_place_out_of_reach_is_an_error(scene, monkeypatch):
    fixed = np.where(np.arange(len(JOINTS)) < 8, scene.joint_speed_limit, 1e-9)
    monkeypatch.setattr(scene, "joint_speed_limit", fixed)  # of a base that stays
    with pytest.raises(ValueError, match="cannot be moved by"):
        grasp_poses(scene, np.array((0.6, 0.0)))
