"""Two fingers on two patches at once."""

import numpy as np
import pytest

from hasm_torch.robot import JOINTS, PATCHES
from hasm_torch.sim import HSRTouchEnv, finger, scene

PAIRS = [(above, beside) for above in PATCHES[:2] for beside in PATCHES[2:4]]


@pytest.fixture(scope="module")
def env():
    env = HSRTouchEnv("compliance")
    yield env
    env.close()


def felt(env, *patches):
    """Force on each patch, N."""
    return np.array([env.skin_forces[env.skin.slices[patch]].sum() for patch in patches])


def swaying(ticks):
    """Targets with which arm and base sway at up to 0.5 rad/s."""
    middle = np.array([0.3, -1.2, 0.4, -0.4, 0.6, 0.0, -0.3, 0.6, 0.0, 0.0, 0.0])
    sway = np.array([0.0, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.0, 0.1, 0.1, 0.3])
    return middle + sway * np.sin(0.5 / 0.3 * np.arange(ticks)[:, None] / 50)


def rollout(env, touch, ticks=60):
    """States and forces of a swaying robot; `touch` is called before every tick."""
    targets = swaying(ticks)
    env.reset(seed=0, options={"joints": targets[0]})
    rows = []
    for tick, target in enumerate(targets):
        touch(env, tick)
        env.step(target)
        rows.append(np.r_[env.joint_position, env.joint_velocity, env.skin_forces.ravel()])
    return np.array(rows)


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("forces", [(2.0, 14.0), (6.0, 6.0), (14.0, 4.0)])
def test_both_patches_feel_their_force_while_the_arm_moves(env, pair, forces):
    targets = swaying(100)
    env.reset(seed=0, options={"joints": targets[0]})
    env.touch_all(dict(zip(pair, forces)))
    speed = 0.0
    for tick, target in enumerate(targets):
        *_, info = env.step(target)
        speed = max(speed, env.joint_velocity[JOINTS.index("arm_flex_joint")])
        if tick >= 5:
            np.testing.assert_allclose(felt(env, *pair), forces, atol=0.3)
            assert info["finger_force"] == pytest.approx(felt(env, *pair).sum())
            assert info["touched"] == pair[0]
    assert speed > 0.4


def test_touch_is_touch_all_of_one_patch(env):
    def one(env, tick):
        env.touch("wrist_left" if 10 <= tick < 40 else None, 7.0)

    def all_of_one(env, tick):
        env.touch_all({"wrist_left": 7.0} if 10 <= tick < 40 else {})

    np.testing.assert_array_equal(rollout(env, one), rollout(env, all_of_one))


def test_a_finger_that_waits_changes_nothing(env, monkeypatch):
    def push(env, tick):
        env.touch("wrist_upper" if tick % 20 > 4 else None, 2.0 + tick / 5)

    with_two = rollout(env, push)
    for module in (scene, finger):
        monkeypatch.setattr(module, "FINGERS", ("finger",))
    alone = HSRTouchEnv("compliance")
    assert alone.model.nv == env.model.nv - 3
    np.testing.assert_allclose(rollout(alone, push), with_two, atol=1e-9)
    assert with_two[:, 2 * len(JOINTS) :].max() > 1.0


def test_a_finger_stays_on_its_patch_while_the_other_comes_and_goes(env):
    hold = env.reset(seed=0)[0]["state"]
    env.touch_all({"wrist_upper": 8.0, "wrist_left": 5.0})
    for _ in range(8):
        env.step(hold)
    for others in ({}, {"wrist_right": 3.0}, {"wrist_upper": 6.0}, {"wrist_upper": 0.0}):
        env.touch_all(others | {"wrist_left": 5.0})
        for _ in range(8):
            *_, info = env.step(hold)
            np.testing.assert_allclose(felt(env, "wrist_left"), 5.0, atol=0.1)
        wanted = [others.get(patch, 0.0) for patch in PATCHES if patch != "wrist_left"]
        found = felt(env, *(patch for patch in PATCHES if patch != "wrist_left"))
        np.testing.assert_allclose(found, wanted, atol=0.1)
        pressed = [patch for patch, force in others.items() if force > 0] + ["wrist_left"]
        assert info["touched"] == pressed[0]
    env.touch_all({})
    env.step(hold)
    assert not env.skin_forces.any()


def test_one_finger_lets_the_other_go(env):
    hold = env.reset(seed=0)[0]["state"]
    env.touch_all({"wrist_upper": 8.0, "wrist_left": 5.0})
    for _ in range(5):
        env.step(hold)
    env.touch("wrist_left", 4.0)
    for _ in range(5):
        env.step(hold)
    np.testing.assert_allclose(felt(env, *PATCHES), [0, 0, 4, 0, 0, 0, 0, 0], atol=0.1)


def test_bad_touches_are_refused_and_leave_the_touch_as_it_is(env):
    hold = env.reset(seed=0)[0]["state"]
    env.touch("hand", 3.0)
    with pytest.raises(ValueError, match="at most 2 patches") as refused:
        env.touch_all(dict.fromkeys(PATCHES[:3], 3.0))
    assert all(patch in str(refused.value) for patch in PATCHES)
    with pytest.raises(ValueError, match=r"'elbow'") as refused:
        env.touch_all({"wrist_left": 3.0, "elbow": 3.0})
    assert all(patch in str(refused.value) for patch in PATCHES)
    for force in (-1.0, np.nan, np.inf, 1000.0):
        with pytest.raises(ValueError, match="force must be 0 to 15 N"):
            env.touch_all({"wrist_left": 3.0, "wrist_upper": force})
    for _ in range(5):
        *_, info = env.step(hold)
    assert info["touched"] == "hand"
    assert info["finger_force"] == pytest.approx(3.0, abs=0.1)


def test_both_fingers_are_drawn():
    env = HSRTouchEnv("compliance", render_mode="rgb_array")
    sleeves = []
    for forces in ({}, {"wrist_upper": 6.0}, {"wrist_upper": 6.0, "wrist_right": 6.0}):
        hold = env.reset(seed=0)[0]["state"]
        env.touch_all(forces)
        for _ in range(5):
            env.step(hold)
        try:
            image = env.render().astype(int)
        except RuntimeError as error:
            pytest.skip(f"no OpenGL: {error}")
        red, _, blue = image.transpose(2, 0, 1)
        sleeves.append(((blue > 120) & (blue > 2 * red)).sum())
    env.close()
    none, one, two = sleeves
    assert one - none > 300
    assert two - one > 300
