import mujoco
import numpy as np
import pytest

from hasm_torch.sim import HSRTouchEnv
from hasm_torch.sim.render import EXTENTS, HEIGHT, WIDTH, SceneRenderer
from hasm_torch.sim.tasks import START_POSES


@pytest.fixture(params=["compliance", "grasp"])
def env(request):
    env = HSRTouchEnv(request.param, render_mode="rgb_array")
    env.reset(seed=0)
    try:
        env.render()
    except RuntimeError as error:
        pytest.skip(f"no OpenGL: {error}")
    yield env
    env.close()


def glowing(image):
    """Pixels of the colours that touched cells have: strong red, hardly any blue."""
    red, green, blue = image.astype(int).transpose(2, 0, 1)
    return (red > 120) & (blue < 60) & (red - blue > 100) & (green < red + 20)


def test_touched_cells_glow_and_the_finger_is_seen(env):
    observation, _ = env.reset(seed=0)
    dark = env.render()
    assert dark.shape == (480, 640, 3)
    assert dark.dtype == np.uint8
    assert dark.std() > 20
    env.touch("wrist_right", 10.0)
    for _ in range(8):
        env.step(observation["state"])
    lit = env.render()
    changed = (np.abs(lit.astype(int) - dark.astype(int)).max(2) > 40).sum()
    assert 100 < changed < 20_000
    assert glowing(lit).sum() > glowing(dark).sum()


def test_rendering_changes_nothing(env):
    runs = []
    for draw in (False, True):
        observation, _ = env.reset(seed=1)
        target = observation["state"] + 0.2
        env.touch("wrist_upper", 5.0)
        for tick in range(20):
            if tick == 10:
                env.touch("wrist_right", 5.0)
            observation, *_ = env.step(target)
            if draw and tick % 3 == 0:
                env.render()
        runs.append(np.concatenate([observation["state"], observation["tactile"]]))
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("env", ["grasp"], indirect=True)
@pytest.mark.parametrize(("camera", "axes"), [("top", [0, 1]), ("side", [0, 2])])
def test_parallel_cameras_show_the_world_to_scale(env, camera, axes):
    for base in ([0.0, 0.0, 0.0], [-0.3, -0.2, 0.5]):
        joints = np.r_[START_POSES["grasp"][:8], base]
        env.reset(seed=0, options={"joints": joints, "object": (0.05, 0.1)})
        red, green, blue = env.render(camera).astype(int).transpose(2, 0, 1)
        rows, columns = np.nonzero((red > 1.8 * green) & (red > 1.8 * blue) & (red > 100))
        left, right, bottom, top = EXTENTS[camera]
        found = [
            left + (columns.mean() + 0.5) / WIDTH * (right - left),
            top - (rows.mean() + 0.5) / HEIGHT * (top - bottom),
        ]
        np.testing.assert_allclose(found, env.object_position[axes], atol=0.006)


def test_the_camera_that_follows_keeps_the_robot_in_view(env):
    joints = np.r_[START_POSES[env.scene][:8], 0.0, 0.0, 0.0]
    seen = []
    for x, y in ((0.0, 0.0), (-0.8, 0.0), (0.0, 0.8), (0.0, -0.8)):
        joints[8:10] = x, y
        env.reset(seed=0, options={"joints": joints})
        env.touch("wrist_right", 10.0)
        for _ in range(8):
            env.step(joints)
        seen.append(glowing(env.render()).sum())
    assert min(seen) > 10
    with pytest.raises(ValueError, match="'follow', 'top' or 'side', got 'front'"):
        env.render("front")


def test_closing_frees_the_renderer_and_may_be_repeated(env):
    env.close()
    env.close()
    assert env.render().shape == (480, 640, 3)


def test_without_opengl_the_error_says_what_to_do(monkeypatch):
    def fail(*_):
        raise ImportError("libEGL.so.1: cannot open shared object file")

    env = HSRTouchEnv(render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    monkeypatch.setattr(mujoco, "Renderer", fail)
    monkeypatch.setattr(SceneRenderer, "_failure", None)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="MUJOCO_GL"):
            env.render()
    env.step(observation["state"])
    env.close()


def test_without_a_render_mode_nothing_is_drawn():
    env = HSRTouchEnv()
    env.reset(seed=0)
    assert env.render() is None
    env.close()
