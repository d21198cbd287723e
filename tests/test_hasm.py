"""One control step after another: what a robot is asked to do under touch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import limits, make_body, press, record, smooth_path, spell

from hasm_torch import HASM, HASMConfig

BODY = make_body(4)
LOWER, UPPER = (torch.tensor(x, dtype=torch.float32) for x in limits(BODY))
STEP = 0.9 * torch.tensor(BODY.max_speed) / BODY.rate  # largest motion of a control step
FRONT, SIDE = smooth_path(BODY, 400, 3, [0, 1]), smooth_path(BODY, 400, 4, [2])
FORCE = 6.0
START = torch.tensor(FRONT[0], dtype=torch.float32)


@pytest.fixture(scope="module")
def trained():
    """Touch on the front moves joints 0 and 1, on the side joint 2; the back does nothing."""
    model = HASM(HASMConfig(), BODY)
    model.fit([record(BODY, "front", FRONT, FORCE), record(BODY, "side", SIDE, FORCE)])
    return model


@pytest.fixture
def model(trained):
    trained.reset()
    return trained


def test_a_touch_leads_through_every_stored_state_to_the_end(model):
    targets = spell(model, BODY, START, "front", FORCE, 480)
    memory = model.memories["front"]
    stored = memory.memory.successors[: int(memory.memory.count), :-1]
    assert len(stored) > 80
    gap = torch.cdist(stored, targets[:, memory.joints]).amin(1)
    assert gap.max() < STEP.max()
    end = torch.tensor(FRONT[-1], dtype=torch.float32)
    assert ((targets[-1] - end).abs() < 0.02 * (UPPER - LOWER)).all()
    assert torch.equal(targets[-1], targets[-20])


def test_a_start_beside_the_demonstration_leads_to_its_end(model):
    generator = torch.Generator().manual_seed(5)
    for _ in range(3):
        model.reset()
        noise = 0.03 * (UPPER - LOWER) * (2 * torch.rand(4, generator=generator) - 1)
        targets = spell(model, BODY, START + noise, "front", FORCE, 500)
        joints = model.memories["front"].joints
        end = torch.tensor(FRONT[-1], dtype=torch.float32)
        assert ((targets[-1] - end).abs() < 0.02 * (UPPER - LOWER))[joints].all()


@pytest.mark.parametrize("shown", [(6.0,), (3.0, 6.0, 10.0)])
def test_the_joint_moves_faster_the_harder_the_touch(shown):
    """Between, below and above the forces of the episodes."""
    model = HASM(HASMConfig(), BODY)
    paths = {force: smooth_path(BODY, round(2000 / force), 1, [0]) for force in shown}
    model.fit([record(BODY, "front", path, force) for force, path in paths.items()])
    start = torch.tensor(paths[6.0][5], dtype=torch.float32)
    speeds = []
    for force in (2.0, 3.0, 3.8, 5.0, 6.5, 7.6, 9.0, 11.0, 12.0):
        model.reset()
        targets = spell(model, BODY, start, "front", force, 60)
        speeds.append(float(targets[50, 0] - targets[15, 0]))
    assert speeds[0] > 0
    assert np.diff(speeds).min() > 0


def test_untouched_joints_stay_where_they_are(model):
    targets = spell(model, BODY, START, "front", FORCE, 200)
    assert (targets[:, 2:] == START[2:]).all()
    assert (targets[-1] - START)[0] > 0.3


def test_without_touch_nothing_moves(model):
    spell(model, BODY, START, "front", FORCE, 50)
    generator = torch.Generator().manual_seed(0)
    held = [
        model.step(START + 0.01 * torch.randn(4, generator=generator), press(BODY, None, 0.0))
        for _ in range(60)
    ]
    assert torch.equal(torch.stack(held[5:]), held[5].expand(55, -1))
    assert model.touched == []


def test_a_patch_without_a_memory_moves_nothing(model):
    targets = spell(model, BODY, START, "back", 12.0, 50)
    assert torch.equal(targets, START.expand(50, -1))


def test_a_touch_that_is_resumed_goes_on_where_it_was(model):
    whole = spell(model, BODY, START, "front", FORCE, 240)
    model.reset()
    first = spell(model, BODY, START, "front", FORCE, 90)
    pause = spell(model, BODY, first[-1], None, 0.0, 60)
    second = spell(model, BODY, pause[-1], "front", FORCE, 90)
    assert torch.equal(pause[5:], pause[5].expand(55, -1))
    assert (pause[5] - first[-1]).abs().max() < 3 * STEP.max()
    assert (torch.cat([first, pause, second])[:, 0].diff() >= 0).all()  # never back
    assert second[-1, 0] - second[0, 0] > 0.2
    gap = torch.cdist(second, whole).amin(1)
    assert gap.max() < STEP.max()  # on the same way as without the pause


def test_two_touches_at_once_move_both(model):
    alone = spell(model, BODY, START, "front", FORCE, 100)
    model.reset()
    other = spell(model, BODY, START, "side", FORCE, 100)
    model.reset()
    state, both = START, []
    for _ in range(100):
        state = model.step(state, press(BODY, "front", FORCE) + press(BODY, "side", FORCE))
        both.append(state)
    assert sorted(model.touched) == ["front", "side"]
    torch.testing.assert_close(torch.stack(both)[:, :2], alone[:, :2], rtol=0, atol=1e-3)
    torch.testing.assert_close(torch.stack(both)[:, 2], other[:, 2], rtol=0, atol=1e-3)


def test_joints_that_were_moved_by_hand_are_taken_up(model):
    before = spell(model, BODY, START, "front", FORCE, 50)
    spell(model, BODY, before[-1], None, 0.0, 20)
    moved = torch.tensor(FRONT[300], dtype=torch.float32)
    held = spell(model, BODY, before[-1], None, 0.0, 1)[-1]
    assert torch.equal(model.step(moved, press(BODY, None, 0.0)), held)  # not before a touch
    targets = spell(model, BODY, moved, "front", FORCE, 60)
    assert (targets[5] - moved).abs()[:2].max() < 6 * STEP.max()
    assert targets[-1, 0] > moved[0]
    assert (targets[5:, 0].diff() >= 0).all()


def test_the_reference_waits_for_a_joint_that_is_held_up(model):
    targets = torch.stack([model.step(START, press(BODY, "front", FORCE)) for _ in range(300)])
    lag = (targets - START).abs()
    assert (lag <= model.tolerance + STEP).all()
    assert torch.equal(targets[-1], targets[-100])
    free = spell(model, BODY, targets[-1], "front", FORCE, 60)
    assert free[-1, 0] > targets[-1, 0] + 0.1  # let go, it moves on


def test_a_reset_forgets(model):
    first = spell(model, BODY, START, "front", FORCE, 60)
    spell(model, BODY, first[-1], "side", 9.0, 33)
    model.reset()
    with pytest.raises(RuntimeError, match="no reference yet"):
        _ = model.reference
    assert not model.density.any()
    assert torch.equal(spell(model, BODY, START, "front", FORCE, 60), first)


def test_robots_that_share_the_memories_do_not_meet(model):
    alone = spell(model, BODY, START, "front", FORCE, 40)
    model.reset()
    one, two = model.new_rollout(), model.new_rollout()
    a = b = START
    for k in range(40):
        a = model.step(a, press(BODY, "front", FORCE), one)
        b = model.step(b, press(BODY, "side", 9.0), two)
        assert torch.equal(a, alone[k])
    assert one.touched == ["front"]
    assert two.touched == ["side"]
    with pytest.raises(RuntimeError, match="no reference yet"):
        _ = model.reference  # the model's own rollout has not begun


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("where", ["state", "skin"])
def test_an_unreadable_sample_holds_the_last_target(model, where, value):
    last = spell(model, BODY, START, "front", FORCE, 40)[-1]
    state, skin = last.clone(), press(BODY, "front", FORCE)
    if where == "state":
        state[1] = value
    else:
        skin[0, 0] = value
    for _ in range(30):
        assert torch.equal(model.step(state, skin), last)
    assert model.touched == []
    onward = spell(model, BODY, last, "front", FORCE, 40)
    assert torch.isfinite(onward).all()
    assert onward[-1, 0] > last[0]


def test_an_unreadable_skin_at_first_holds_the_measured_joints(model):
    assert torch.equal(model.step(START, torch.full((6, 3), torch.nan)), START)


def test_an_unreadable_first_state_leaves_nothing_to_hold(model):
    with pytest.raises(RuntimeError, match="no finite joint reading yet"):
        model.step(torch.full((4,), torch.nan), press(BODY, None, 0.0))
    assert torch.equal(model.step(START, press(BODY, None, 0.0)), START)


finite = st.floats(-(2.0**100), 2.0**100, width=32)
states = st.lists(st.one_of(st.floats(-2, 2, width=32), finite), min_size=4, max_size=4)
forces = st.one_of(st.floats(-20, 20, width=32), st.sampled_from([1e9, -1e9, 3e38, 0.0]))
readings = st.lists(
    st.tuples(st.booleans(), states, st.lists(forces, min_size=6, max_size=6)),
    min_size=1,
    max_size=8,
)


@given(readings=readings)
@settings(max_examples=60, deadline=None)
def test_targets_keep_the_limits_whatever_is_felt(trained, readings):
    trained.reset()
    before = None
    for follows, state, cells in readings:
        state = before if follows and before is not None else torch.tensor(state)
        skin = torch.tensor(cells).unsqueeze(-1).expand(6, 3)
        measured = state.clamp(LOWER, UPPER)
        for _ in range(3):
            target = trained.step(state, skin)
            assert torch.isfinite(target).all()
            assert (target >= LOWER).all()
            assert (target <= UPPER).all()
            if before is None:
                before = measured
            # from the last target, or from where a hand has put the joint meanwhile
            near = (target - before).abs() <= STEP + 1e-6
            taken = (target - measured).abs() <= STEP + 1e-6
            assert (near | taken).all()
            before = target


def test_an_absurd_force_moves_no_faster_than_the_limits(model):
    targets = spell(model, BODY, START, "front", 1e9, 100)
    steps = torch.cat([START[None], targets]).diff(dim=0).abs()
    assert (steps <= STEP + 1e-6).all()
    model.reset()
    assert torch.equal(spell(model, BODY, START, "front", FORCE, 5)[:, 2:], START[2:].expand(5, -1))


def test_skin_may_be_flat_and_of_another_dtype(model):
    rows = spell(model, BODY, START, "front", FORCE, 20)
    model.reset()
    state = START.double()
    for k in range(20):
        state = model.step(state, press(BODY, "front", FORCE).flatten().double())
        assert torch.equal(state, rows[k])


def test_the_callers_tensors_are_left_alone(model):
    state, skin = START.clone(), press(BODY, "front", FORCE)
    target = model.step(state, skin)
    target += 1.0  # the caller's copy, not the model's reference
    again = model.step(START, press(BODY, "front", FORCE))
    assert torch.equal(state, START)
    assert torch.equal(skin, press(BODY, "front", FORCE))
    assert (again - START).abs().max() < 0.5


@pytest.mark.parametrize(
    ("state", "skin", "message"),
    [
        (torch.zeros(3), torch.zeros(6, 3), r"expected state \(4,\), got \(3,\)"),
        (torch.zeros(1, 4), torch.zeros(6, 3), r"expected state \(4,\)"),
        (torch.tensor(0.0), torch.zeros(6, 3), r"expected state \(4,\)"),
        (torch.zeros(4), torch.zeros(5, 3), r"expected skin \(6, 3\) or flat"),
        (torch.zeros(4), torch.zeros(20), r"expected skin \(6, 3\) or flat"),
        (torch.zeros(4), torch.zeros(0), r"expected skin \(6, 3\) or flat"),
        (torch.zeros(4), torch.zeros(1, 6, 3), r"expected skin \(6, 3\) or flat"),
    ],
)
def test_wrong_shapes_are_named(model, state, skin, message):
    with pytest.raises(ValueError, match=message):
        model.step(state, skin)


def test_a_model_that_has_learned_nothing_says_so(tmp_path):
    empty = HASM(HASMConfig(), BODY)
    with pytest.raises(RuntimeError, match="learned nothing: call fit or from_pretrained"):
        empty.step(START, press(BODY, None, 0.0))
    with pytest.raises(RuntimeError, match="learned nothing"):
        empty.save_pretrained(tmp_path / "model")
    assert not (tmp_path / "model").exists()
