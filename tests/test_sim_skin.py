import numpy as np
import pytest
from contacts import contact_force
from postures import anywhere

from hasm_torch.robot import PATCHES
from hasm_torch.sim import HSRTouchEnv
from hasm_torch.sim.skin_sensor import spread


@pytest.fixture(scope="module")
def env():
    env = HSRTouchEnv("compliance")
    yield env
    env.close()


@pytest.mark.parametrize("distance", [0.0, 0.01, 0.3])
def test_spread_keeps_the_force_and_falls_like_a_gaussian(distance):
    points = np.array([[[0.0, 0.0, 0.0], [0.004, 0.0, 0.0]]])
    forces = spread(7.0, np.array([-distance, 0.0, 0.0]), points, width=0.006)
    np.testing.assert_allclose(forces.sum(), 7.0, rtol=1e-15)
    ratio = np.exp((distance**2 - (distance + 0.004) ** 2) / (2 * 0.006**2))
    np.testing.assert_allclose(forces[0, 1] / forces[0, 0], ratio, rtol=1e-9)


@pytest.mark.parametrize("patch", PATCHES)
def test_every_cell_lights_up_where_it_is_pressed(env, patch):
    observation, _ = env.reset(seed=0)
    hold = observation["state"]
    span = env.skin.slices[patch]
    for cell in range(span.stop - span.start):
        env.touch(None)
        env.step(hold)
        env.touch(patch, 6.0, cell=cell)
        for _ in range(8):
            observation, _, _, _, info = env.step(hold)
        forces = env.skin_forces
        assert forces.shape == (env.skin.cells, 3)
        assert (forces >= 0).all()
        assert info["touched"] == patch
        assert forces.sum(1).argmax() == span.start + cell
        assert forces[span.start + cell].sum() > 3.0
        outside = np.delete(forces, np.arange(span.start, span.stop), axis=0)
        assert not outside.any()
        assert abs(forces.sum() - contact_force(env)) < 1e-9
        np.testing.assert_allclose(observation["tactile"], forces.ravel(), rtol=1e-6)


def test_the_centre_of_pressure_is_where_the_finger_is(env):
    """The force-weighted mean of a cell's points is the touched point, to the grid's fineness."""
    observation, _ = env.reset(seed=0)
    env.touch("wrist_upper", 6.0)
    for _ in range(8):
        env.step(observation["state"])
    points = env.skin.points.numpy()
    span = env.skin.slices["wrist_upper"]
    centre = (env.skin_forces[..., None] * points).sum((0, 1)) / env.skin_forces.sum()
    aim = env.skin.positions.numpy()[span].mean(0)
    assert np.linalg.norm(centre - aim) < 0.002


def test_untouched_skin_is_silent_in_any_posture(env):
    rng = np.random.default_rng(3)
    for _ in range(10):
        joints = anywhere(rng)
        observation, _ = env.reset(seed=0, options={"joints": joints})
        for _ in range(3):
            observation, _, _, _, info = env.step(joints)
        assert not observation["tactile"].any()
        assert info["touched"] is None
        assert info["finger_force"] == 0.0
