"""One memory for all patches: the rotation of the touch alone says which behaviour follows."""

import warnings

import numpy as np
import pytest
import torch
from toys import limits, make_body, press, record, smooth_path

from hasm_torch import HASM, HASMConfig

BODY = make_body(4)
LOWER, UPPER = limits(BODY)
# Which joint a patch moves, and which way.
BEHAVIOURS = {"front": (0, 1), "side": (2, 1), "back": (0, -1)}
POSTURES = 15


def taught(config: HASMConfig) -> HASM:
    model = HASM(config, BODY)
    episodes = []
    for patch, (joint, sign) in BEHAVIOURS.items():
        path = smooth_path(BODY, 300, 0, [joint])[::sign]
        episodes += [record(BODY, patch, path, force) for force in (4.0, 9.0)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without RoPE3D the recall must be off
        model.fit(episodes)
    return model


def right(model: HASM, force: float = 6.0) -> float:
    """Share of touches, from postures anywhere, that move their joint their way and no other."""
    rng = np.random.default_rng(0)
    good = []
    for _ in range(POSTURES):
        start = torch.tensor(LOWER + rng.uniform(0.25, 0.75, 4) * (UPPER - LOWER)).float()
        for patch, (joint, sign) in BEHAVIOURS.items():
            model.reset()
            state, skin = start, press(BODY, patch, force)
            for _ in range(30):
                state = model.step(state, skin)
            way = sign * (state - start)
            others = torch.cat([way[:joint], way[joint + 1 :]])
            good.append(bool(way[joint] > 0.02) and not others.abs().max() > 1e-6)
    return float(np.mean(good))


@pytest.fixture(scope="module")
def shared():
    return taught(HASMConfig(memories="shared"))


def test_the_touched_patchs_behaviour_comes_out(shared):
    assert list(shared.memories) == ["shared"]
    assert sorted(shared.patches) == sorted(BEHAVIOURS)
    assert right(shared) == 1.0


def test_without_rotation_it_is_a_guess():
    assert right(taught(HASMConfig(memories="shared", rope=False))) <= 0.5


def test_two_touches_at_once_add_up(shared):
    start = torch.tensor((LOWER + UPPER) / 2).float()
    moved = {}
    for name, patches in {"front": ["front"], "side": ["side"], "both": ["front", "side"]}.items():
        shared.reset()
        state = start
        for _ in range(40):
            state = shared.step(state, sum(press(BODY, patch, 6.0) for patch in patches))
        moved[name] = state - start
    torch.testing.assert_close(moved["both"], moved["front"] + moved["side"], rtol=0.05, atol=1e-3)


def test_one_recall_a_step_moves_the_touched_patchs_joints_only():
    model = taught(HASMConfig(memories="shared", advance="tick"))
    start = torch.tensor((LOWER + UPPER) / 2).float()
    for _ in range(10):
        state = model.step(start, press(BODY, "side", 6.0))
    assert torch.equal(state[[0, 1, 3]], start[[0, 1, 3]])
