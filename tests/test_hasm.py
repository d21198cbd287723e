"""One control step after another: what a robot is asked to do under touch."""

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import (
    along,
    limits,
    make_body,
    postures,
    press,
    push,
    record,
    smooth_path,
    spell,
    straight,
    yielding,
)

from hasm_torch import HASM, HASMConfig, kernels
from hasm_torch.model.motion import RECALLS_A_STEP

BODY = make_body(4)
LOWER, UPPER = (torch.tensor(x, dtype=torch.float32) for x in limits(BODY))
STEP = 0.9 * torch.tensor(BODY.max_speed) / BODY.rate  # largest motion of a control step
FRONT, SIDE = smooth_path(BODY, 400, 3, [0, 1]), smooth_path(BODY, 400, 4, [2])
FORCE = 6.0
START = torch.tensor(FRONT[0], dtype=torch.float32)
MIDDLE = torch.tensor(postures(BODY, 1, 0, 0.0)[0]).float()
COURSES = ["goal", "successor"]


def yields(**config) -> HASM:
    """A robot whose hand, pushed at the front, goes along in joints 0 and 1."""
    model = HASM(HASMConfig(value="displacement", **config), BODY)
    touches = [(None, 10), ("front", 25), (None, 10), ("front", 25), (None, 10)]
    model.fit([yielding(BODY, along(BODY), q, touches) for q in postures(BODY, 16, 1)])
    return model


@pytest.fixture(scope="module")
def taught():
    return yields()


@pytest.fixture
def yielding_model(taught):
    taught.reset()
    return taught


@pytest.fixture(scope="module")
def walkers():
    """Touch on the front leads joints 0 and 1, on the side joint 2, along a course each."""
    models = {}
    for value in COURSES:
        models[value] = HASM(HASMConfig(value=value), BODY)
        models[value].fit([record(BODY, "front", FRONT, FORCE), record(BODY, "side", SIDE, FORCE)])
    return models


@pytest.fixture(params=COURSES)
def walker(walkers, request):
    walkers[request.param].reset()
    return walkers[request.param]


def counted(model: HASM, skins) -> tuple[np.ndarray, np.ndarray]:
    """Spikes and displacements of steps with some skins, of a robot that follows at once."""
    state, spikes, ways = MIDDLE, [], []
    for skin in skins:
        target = model.step(state, skin)
        spikes.append(model.rollout.spikes[-1].sum())
        ways.append((target - state).numpy())
        state = target
    return np.array(spikes), np.array(ways)


# Displacements


def test_every_spike_moves_by_what_one_spike_did(yielding_model):
    """The step is the recalled displacement times the spikes: the recall by the reference."""
    recalling = yielding_model.recalling
    stored, values = recalling.memory.stored().numpy(), recalling.memory.successors.numpy()
    beta = yielding_model.settled.beta
    state, compared = MIDDLE, 0
    for force in [3.0] * 20 + [9.0] * 10:
        target = yielding_model.step(state, press(BODY, "front", force))
        spikes = yielding_model.rollout.spikes[-1][0]
        for asked in yielding_model.rollout.asked:
            patch, query = asked.touch.patch, asked.query
            assert patch == 0
            signs = np.where(query.numpy() < 0, -1.0, 1.0)
            recalled = reference.softmax_recall(stored.T, values[: len(stored)].T, signs, beta)
            count = 3 if yielding_model.settled.readout == "first_order" else 1
            toward = push(BODY, "front", state.double().numpy())
            if count == 3:
                squares, law = recalled[-9:].reshape(3, 3), recalled[:-9].reshape(-1, 3)
                recalled = law @ np.linalg.solve(squares + 0.01 * np.eye(3), toward)
            step = np.zeros(4)
            step[yielding_model.settled.moved] = spikes * recalled
            np.testing.assert_allclose(target - state, step, atol=2e-6)
            compared += 1
        state = target
    assert compared > 20


def test_twice_the_spikes_are_twice_the_speed(yielding_model):
    """At 2 to 14 N the way is proportional to the spikes; taught at one force."""
    paces, rates = [], []
    for force in (3.0, 4.5, 6.0, 9.0, 12.0):
        yielding_model.reset()
        spikes, ways = counted(yielding_model, [press(BODY, "front", force)] * 14)
        way = np.linalg.norm(ways[4:].sum(axis=0)[:2])
        rates.append(spikes[4:].sum())
        paces.append(way / rates[-1])
    assert max(rates) > 2.5 * min(rates)
    assert np.ptp(paces) < 0.12 * np.mean(paces)


def test_the_hand_goes_where_it_is_pushed(yielding_model):
    for q in postures(BODY, 6, 50):
        yielding_model.reset()
        start = torch.tensor(q).float()
        way = (spell(yielding_model, BODY, start, "front", FORCE, 15)[-1] - start).numpy()
        wanted = along(BODY)(push(BODY, "front", q), q)
        assert way @ wanted / np.linalg.norm(way) / np.linalg.norm(wanted) > 0.9
        assert not way[2:].any()  # joints that no touch moved stay where they are


def test_a_patch_never_touched_is_answered_on_the_same_rigid_body_only(yielding_model):
    assert yielding_model.patches == ["front"]
    for q in postures(BODY, 6, 51):
        start = torch.tensor(q).float()
        yielding_model.reset()
        way = (spell(yielding_model, BODY, start, "side", FORCE, 15)[-1] - start).numpy()
        assert yielding_model.touched == ["side"]
        wanted = along(BODY)(push(BODY, "side", q), q)
        assert way @ wanted / np.linalg.norm(way) / np.linalg.norm(wanted) > 0.7
        yielding_model.reset()
        other = spell(yielding_model, BODY, start, "back", FORCE, 15)
        assert torch.equal(other, start.expand(15, 4))
        assert yielding_model.touched == []


def test_where_patches_have_keys_no_other_patch_is_answered():
    model = yields(touch="patch")
    targets = spell(model, BODY, MIDDLE, "side", FORCE, 15)
    assert torch.equal(targets, MIDDLE.expand(15, 4))


def test_two_touches_at_once_add_up(yielding_model):
    moved = {}
    for patches in (("front",), ("side",), ("front", "side")):
        yielding_model.reset()
        skin = sum(press(BODY, patch, 4.0) for patch in patches)
        _, ways = counted(yielding_model, [skin] * 6)
        moved[patches] = ways.sum(axis=0)
    assert sorted(yielding_model.touched) == ["front", "side"]
    both = moved[("front",)] + moved[("side",)]
    np.testing.assert_allclose(moved[("front", "side")], both, rtol=0.1, atol=1e-3)


def test_a_blocked_joint_is_not_run_away_from_and_the_others_go_on(yielding_model):
    state, tolerance = MIDDLE.clone(), yielding_model.tolerance
    free = spell(yielding_model, BODY, MIDDLE, "front", FORCE, 60)[-1] - MIDDLE
    yielding_model.reset()
    blocked = int(free.abs().argmax())
    other = 1 - blocked
    for _ in range(60):
        target = yielding_model.step(state, press(BODY, "front", FORCE))
        assert ((target - state).abs() <= tolerance + STEP + 1e-6).all()
        state = target.clone()
        state[blocked] = MIDDLE[blocked]
    assert abs(target[blocked] - MIDDLE[blocked]) <= tolerance[blocked] + 1e-6
    assert abs(state[other] - MIDDLE[other]) > 0.5 * abs(free[other])
    state = target  # let go, it moves on at once
    onward = spell(yielding_model, BODY, state, "front", FORCE, 20)[-1] - state
    assert onward[blocked] * free[blocked] > 0


def test_recalled_says_which_demonstrations_take_part(yielding_model):
    spell(yielding_model, BODY, MIDDLE, "front", FORCE, 5)
    for patches in (("front",), ("front", "side")):
        yielding_model.step(MIDDLE, sum(press(BODY, patch, 5.0) for patch in patches))
        recalls = yielding_model.recalled()
        assert [patch for patch, _ in recalls] == list(patches)
        for _, weights in recalls:
            assert weights.shape == (len(yielding_model.origins),)
            assert weights.sum() == pytest.approx(1.0, abs=1e-6)
            assert (weights >= 0).all()
            shares = np.bincount(yielding_model.origins[:, 0], weights, minlength=16)
            assert (shares > 0.01).sum() >= 3  # several take part
    for _ in range(6):
        yielding_model.step(MIDDLE, press(BODY, None, 0.0))
    assert yielding_model.recalled() == []


# Courses


def test_a_touch_leads_along_its_course_to_the_end(walker):
    targets = spell(walker, BODY, START, "front", FORCE, 480)
    shown = torch.tensor(FRONT[::4]).float()
    assert torch.cdist(shown, targets).amin(1).max() < 2 * STEP.max()
    end = torch.tensor(FRONT[-1], dtype=torch.float32)
    assert ((targets[-1] - end).abs() < 0.02 * (UPPER - LOWER)).all()
    assert torch.equal(targets[-1], targets[-20])
    torch.testing.assert_close(targets[:, 2:], START[2:].expand(480, 2), rtol=0, atol=1e-5)


def test_a_start_beside_the_demonstration_leads_to_its_end(walker):
    generator = torch.Generator().manual_seed(5)
    for _ in range(2):
        walker.reset()
        noise = 0.03 * (UPPER - LOWER) * (2 * torch.rand(4, generator=generator) - 1)
        targets = spell(walker, BODY, START + noise, "front", FORCE, 500)
        end = torch.tensor(FRONT[-1], dtype=torch.float32)
        assert ((targets[-1] - end).abs() < 0.02 * (UPPER - LOWER))[:2].all()


def test_a_pause_continues_a_course(walker):
    whole = spell(walker, BODY, START, "front", FORCE, 240)
    walker.reset()
    first = spell(walker, BODY, START, "front", FORCE, 90)
    pause = spell(walker, BODY, first[-1], None, 0.0, 60)
    second = spell(walker, BODY, pause[-1], "front", FORCE, 90)
    assert torch.equal(pause[5:], pause[5].expand(55, -1))
    assert (torch.cat([first, pause, second])[:, 0].diff() >= 0).all()  # never back
    assert second[-1, 0] - second[0, 0] > 0.2
    assert torch.cdist(second, whole).amin(1).max() < STEP.max()


def test_another_patch_leads_away_from_a_course(walker):
    first = spell(walker, BODY, START, "front", FORCE, 90)
    assert list(walker.rollout.courses) == [0]
    aside = spell(walker, BODY, first[-1], "side", FORCE, 480)
    assert list(walker.rollout.courses) == [1]
    # The joints that this touch moves get to its end, the others stay where they were.
    end, led = first[-1].clone(), walker.settled.moved_by["side"]
    end[led] = torch.tensor(SIDE[-1], dtype=torch.float32)[led]
    assert 0 < len(led) < len(end)
    assert ((aside[-1] - end).abs() < 0.02 * (UPPER - LOWER)).all()
    spell(walker, BODY, aside[-1], "front", FORCE, 3)
    assert list(walker.rollout.courses) == [0]


def test_two_courses_at_once_are_both_followed(walker):
    state, skin = START, press(BODY, "front", FORCE) + press(BODY, "side", FORCE)
    for _ in range(60):
        state = walker.step(state, skin)
    assert sorted(walker.touched) == ["front", "side"]
    assert sorted(walker.rollout.courses) == [0, 1]
    assert state[0] > START[0] + 0.1


def test_a_course_waits_for_a_joint_that_is_held_up(walker):
    targets = torch.stack([walker.step(START, press(BODY, "front", FORCE)) for _ in range(200)])
    assert ((targets - START).abs() <= walker.tolerance + STEP).all()
    free = spell(walker, BODY, targets[-1], "front", FORCE, 60)
    assert free[-1, 0] > targets[-1, 0] + 0.1  # let go, it moves on


def test_joints_that_were_moved_by_hand_are_taken_up(walker):
    before = spell(walker, BODY, START, "front", FORCE, 50)
    spell(walker, BODY, before[-1], None, 0.0, 20)
    moved = torch.tensor(FRONT[300], dtype=torch.float32)
    held = spell(walker, BODY, before[-1], None, 0.0, 1)[-1]
    assert torch.equal(walker.step(moved, press(BODY, None, 0.0)), held)  # not before a touch
    walker.rollout.courses.clear()
    targets = spell(walker, BODY, moved, "front", FORCE, 60)
    assert (targets[5] - moved).abs()[:2].max() < 6 * STEP.max()
    assert targets[-1, 0] > moved[0]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("first", [0, 3])
def test_a_walk_comes_by_every_stored_state_to_its_end(first, seed):
    """Where joint 0 does not go one way, the path crosses itself: loops are left out."""
    path = smooth_path(BODY, 300, seed, list(dict.fromkeys([first, 0, 2])))
    path[:, 3] = 0.0
    model = HASM(HASMConfig(value="successor"), BODY)
    model.fit([record(BODY, "front", path, FORCE)])
    memory, moved = model.recalling.memory, model.settled.moved
    stored = memory.successors[: int(memory.count), :-1]
    assert len(stored) > 25
    targets = spell(model, BODY, torch.tensor(path[0]).float(), "front", FORCE, 400)[:, moved]
    end = torch.tensor(path[-1], dtype=torch.float32)[moved]
    assert (targets[-1] - end).abs().max() < 0.06
    if first == 0:
        assert torch.cdist(stored, targets).amin(1).max() < STEP.max()


# Whatever moves them


@pytest.fixture(params=["displacement", *COURSES])
def model(request, taught, walkers):
    one = taught if request.param == "displacement" else walkers[request.param]
    one.reset()
    return one


def test_without_touch_the_robot_holds_still(model):
    spell(model, BODY, START, "front", FORCE, 50)
    generator = torch.Generator().manual_seed(0)
    held = [
        model.step(START + 0.01 * torch.randn(4, generator=generator), press(BODY, None, 0.0))
        for _ in range(60)
    ]
    assert torch.equal(torch.stack(held[5:]), held[5].expand(55, -1))
    assert model.touched == []
    assert model.recalled() == []


def test_a_patch_that_was_not_taught_moves_nothing(model):
    targets = spell(model, BODY, START, "back", 12.0, 30)
    assert torch.equal(targets, START.expand(30, -1))


def test_a_reset_forgets(model):
    first = spell(model, BODY, START, "front", FORCE, 40)
    spell(model, BODY, first[-1], "side", 9.0, 33)
    model.reset()
    with pytest.raises(RuntimeError, match="no reference yet"):
        _ = model.reference
    assert not model.density.any()
    assert torch.equal(spell(model, BODY, START, "front", FORCE, 40), first)
    assert torch.equal(model.reference, first[-1])


def test_robots_that_share_the_memory_do_not_meet(model):
    alone = spell(model, BODY, START, "front", FORCE, 30)
    model.reset()
    one, two = model.new_rollout(), model.new_rollout()
    a = b = START
    for k in range(30):
        a = model.step(a, press(BODY, "front", FORCE), one)
        b = model.step(b, press(BODY, "side", 9.0), two)
        assert torch.equal(a, alone[k])
    assert (one.touched, two.touched) == (["front"], ["side"])
    with pytest.raises(RuntimeError, match="no reference yet"):
        _ = model.reference  # the model's own rollout has not begun


def test_without_compiled_loops_the_targets_are_the_same(model):
    compiled, counts = [], 12
    skins = [press(BODY, "front", FORCE) + press(BODY, "side", 3.0)] * counts
    for disabled in (False, True):
        model.reset()
        state, targets = START, []
        for skin in skins:
            if disabled:
                with kernels.disabled():
                    state = model.step(state, skin)
            else:
                state = model.step(state, skin)
            targets.append(state)
        compiled.append(torch.stack(targets))
    torch.testing.assert_close(*compiled, rtol=0, atol=1e-5)
    assert (compiled[0][-1] - START).abs().max() > 0.01


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("where", ["state", "skin"])
def test_an_unreadable_sample_holds_the_last_target(model, where, value):
    last = spell(model, BODY, START, "front", FORCE, 40)[-1]
    state, skin = last.clone(), press(BODY, "front", FORCE)
    if where == "state":
        state[1] = value
    else:
        skin[0, 0] = value
    for _ in range(10):
        assert torch.equal(model.step(state, skin), last)
    assert model.touched == []
    onward = spell(model, BODY, last, "front", FORCE, 20)
    assert torch.isfinite(onward).all()
    assert (onward[-1] - last).abs().max() > 0.01


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


@given(readings=readings, which=st.sampled_from(["displacement", *COURSES]))
@settings(max_examples=60, deadline=None)
def test_targets_keep_the_limits_whatever_is_felt(taught, walkers, readings, which):
    model = taught if which == "displacement" else walkers[which]
    model.reset()
    before = None
    for follows, state, cells in readings:
        state = before if follows and before is not None else torch.tensor(state)
        skin = torch.tensor(cells).unsqueeze(-1).expand(6, 3)
        measured = state.clamp(LOWER, UPPER)
        for _ in range(3):
            target = model.step(state, skin)
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


BASED = make_body(2, base=True, observations={"observation.place": 1})


@pytest.fixture(scope="module")
def driver():
    """A mobile robot whose goal depends on what it observes."""
    episodes = []
    for place in np.linspace(-1, 1, 5):
        path = straight(BASED, 0)[::3]
        path[:, 2] = np.linspace(0, 0.2 * place, 50)
        path[:, 4] = np.linspace(0.3, 0.5 + place, 50)
        episodes.append(record(BASED, "front", path, FORCE, observation=[place]))
    model = HASM(HASMConfig(value="goal", readout="first_order"), BASED)
    model.fit(episodes)
    assert model.settled.moved == [0, 2, 3, 4]
    return model


@given(
    stream=st.lists(
        st.tuples(st.lists(finite, min_size=5, max_size=5), forces, finite), min_size=1, max_size=6
    )
)
@settings(max_examples=40, deadline=None)
def test_a_base_keeps_its_speed_wherever_it_is_and_whatever_it_observes(driver, stream):
    driver.reset()
    low, high = (x.astype(np.float32) for x in limits(BASED))
    allowed = 0.9 * np.array(BASED.max_speed) / BASED.rate
    rollout = driver.rollout
    for state, force, place in stream:
        state, seen = torch.tensor(state), torch.tensor([place])
        skin = torch.full((6, 3), force)
        for _ in range(3):
            before = rollout.reference
            driver.step(state, skin, None, seen)
            target = rollout.reference
            assert np.isfinite(target).all()
            assert ((target >= low) & (target <= high)).all()
            if before is not None:
                measured = state.double().numpy().clip(low, high)
                rounding = 1e-12 * np.maximum(np.abs(before), np.abs(measured)) + 1e-9
                near = np.abs(target - before) <= allowed + rounding
                taken = np.abs(target - measured) <= allowed + rounding
                assert (near | taken).all()


def test_the_recalls_of_a_step_are_bounded(walkers):
    model = walkers["successor"]
    model.reset()
    counts = []
    for _ in range(20):
        model.step(START, press(BODY, "front", 1e9))
        counts.append(len(model.recalled()))
    assert 0 < max(counts) <= RECALLS_A_STEP


def test_an_absurd_force_moves_no_faster_than_the_limits(model):
    targets = spell(model, BODY, START, "front", 1e9, 60)
    steps = torch.cat([START[None], targets]).diff(dim=0).abs()
    assert (steps <= STEP + 1e-6).all()


def test_skin_may_be_flat_and_of_another_dtype(model):
    rows = spell(model, BODY, START, "front", FORCE, 10)
    model.reset()
    state = START.double()
    for k in range(10):
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
        (torch.zeros(4), torch.zeros(5, 3), r"expected skin \(6, 3\) or flat, got \(5, 3\)"),
        (torch.zeros(4), torch.zeros(20), r"expected skin \(6, 3\) or flat, got \(20,\)"),
        (torch.zeros(4), torch.zeros(1, 6, 3), r"expected skin \(6, 3\) or flat"),
        (torch.zeros(4), None, r"expected skin \(6, 3\) or flat, got nothing"),
    ],
)
def test_wrong_shapes_are_named(taught, state, skin, message):
    with pytest.raises(ValueError, match=message):
        taught.step(state, skin)


def test_a_bound_observation_is_asked_for_by_name():
    body = make_body(3, observations={"observation.place": 2})
    path = smooth_path(body, 60, 0, [0])
    model = HASM(HASMConfig(), body)
    model.fit([record(body, "front", path, FORCE, observation=[x, 0.5]) for x in (0.0, 1.0, 2.0)])
    state, skin = torch.tensor(path[0]).float(), press(body, "front", FORCE)
    for wrong in (None, torch.zeros(3), torch.zeros(1, 2)):
        with pytest.raises(ValueError, match=r"expected observation \(2,\) of observation.place"):
            model.step(state, skin, None, wrong)
    for _ in range(20):
        moved = model.step(state, skin, None, torch.tensor([1.0, 0.5]))
    held = model.step(state, skin, None, torch.tensor([1.0, float("nan")]))
    assert torch.equal(held, moved)


def test_a_model_that_has_learned_nothing_says_so(tmp_path):
    empty = HASM(HASMConfig(), BODY)
    with pytest.raises(RuntimeError, match="learned nothing: call fit or from_pretrained"):
        empty.step(START, press(BODY, None, 0.0))
    for ask in (empty.recalled, empty.memory_bytes, lambda: empty.origins):
        with pytest.raises(RuntimeError, match="learned nothing"):
            ask()
    with pytest.raises(RuntimeError, match="learned nothing"):
        empty.save_pretrained(tmp_path / "model")
    assert not (tmp_path / "model").exists()
    assert empty.patches == []
