"""What ``fit`` chooses for some episodes, by predicting the ones that it holds out."""

import math

import numpy as np
import pytest
import torch
from toys import (
    Recorded,
    along,
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

from hasm_torch import HASM, HASMConfig
from hasm_torch.body import Body
from hasm_torch.model.choose import absence, soft_weights
from hasm_torch.model.fit import FitReport

BODY = make_body(3)
PLACED = make_body(3, observations={"observation.place": 1})
BOTH = [(None, 10), ("front", 20), (None, 10), ("side", 20), (None, 10)]
ONE = [(None, 10), ("front", 30), (None, 10)]


def fitted(body: Body, episodes, **config) -> tuple[HASM, FitReport]:
    model = HASM(HASMConfig(**config), body)
    return model, model.fit(episodes)


def compliant(count: int = 8, seed: int = 0) -> list[Recorded]:
    """The hand goes where it is pushed, from postures anywhere."""
    return [yielding(BODY, along(BODY), q, BOTH) for q in postures(BODY, count, seed)]


def moved(model: HASM, body: Body, q: np.ndarray, patch: str, seen: float | None = None):
    """How far 20 steps of a touch move the joints from a posture."""
    model.reset()
    start = state = torch.tensor(q).float()
    more = None if seen is None else torch.tensor([seen])
    for _ in range(20):
        state = model.step(state, press(body, patch, 6.0), None, more)
    return (state - start).numpy()


def cosine(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other / np.linalg.norm(one) / np.linalg.norm(other))


def test_where_the_law_follows_the_direction_the_direction_tells_touches_apart():
    model, report = fitted(BODY, compliant())
    assert report.choices["touch"] == "direction"
    assert report.choices["value"] == "displacement"
    tried = report.errors["displacement: touch"]
    assert tried["direction"] < 0.7 * tried["patch"]
    for q in postures(BODY, 10, 99):
        for patch in ("front", "side"):
            wanted = along(BODY)(push(BODY, patch, q), q)
            assert cosine(moved(model, BODY, q, patch), wanted) > 0.9


def test_where_the_patch_names_the_function_the_patch_does():
    """Front moves joint 0 and side joint 1, wherever the hand is turned to."""

    def function(joint: int):
        return lambda toward, positions: 0.01 * (np.arange(3) == joint)

    episodes = [
        yielding(BODY, function(joint), q, [(None, 10), (patch, 30), (None, 10)])
        for q in postures(BODY, 6, 1)
        for joint, patch in enumerate(("front", "side"))
    ]
    model, report = fitted(BODY, episodes)
    assert report.choices["touch"] == "patch"
    tried = report.errors["displacement: touch"]
    assert tried["patch"] < 0.7 * tried["direction"]
    for q in postures(BODY, 6, 98):
        for joint, patch in enumerate(("front", "side")):
            assert cosine(moved(model, BODY, q, patch), np.eye(3)[joint]) > 0.95


def test_a_course_to_what_is_observed_is_a_goal():
    """Touch leads to a posture that depends on what is bound; between and beside those shown."""

    def goal(place: float, q: np.ndarray) -> np.ndarray:
        return np.array([0.2 + 0.5 * place, -0.3 * place, q[2]])

    episodes = []
    for place, q in zip(np.linspace(-1, 1, 9), postures(PLACED, 9, 5, 0.1)):
        path = q + (goal(place, q) - q) * np.linspace(0, 1, 60)[:, None]
        episodes.append(record(PLACED, "front", path, 6.0, observation=[place]))
    model, report = fitted(PLACED, episodes)
    assert (report.choices["value"], report.choices["readout"]) == ("goal", "first_order")
    q = postures(PLACED, 1, 77, 0.1)[0]
    for place in (-1.05, -0.9, -0.3, 0.1, 0.63):
        model.reset()
        state = torch.tensor(q).float()
        for _ in range(140):
            state = model.step(state, press(PLACED, "front", 6.0), None, torch.tensor([place]))
        np.testing.assert_allclose(state, goal(place, q), atol=0.02)
    assert model.settled.observed == [[-1.2, 1.2]]  # a tenth of the range to each side


@pytest.mark.parametrize("episodes", [2, 10])
def test_behaviours_of_one_patch_are_told_apart_by_the_state(episodes):
    """Back moves joint 0 up where joint 1 is above its middle, else down."""

    def law(toward, positions):
        return np.array([0.01 if positions[1] > 0.3 else -0.01, 0.003, 0.0])

    starts = postures(BODY, episodes, 2, 0.2)
    starts[:, 1] = np.where(np.arange(episodes) % 2, 0.8, -0.6)
    touch = [(None, 10), ("back", 30), (None, 10)]
    model, report = fitted(BODY, [yielding(BODY, law, q, touch) for q in starts])
    assert "joint_1" in report.choices["joints"]
    for q in starts if episodes == 2 else postures(BODY, 4, 97, 0.2):
        for where, sign in ((0.8, 1), (-0.6, -1)):
            if episodes > 2 or q[1] == where:
                start = np.array([q[0], where, q[2]])
                assert sign * moved(model, BODY, start, "back")[0] > 0.05


def test_conflicting_demonstrations_are_told_apart_by_what_is_observed():
    episodes = []
    for i, q in enumerate(postures(PLACED, 10, 3)):
        way = (-1.0) ** i
        law = lambda toward, positions, way=way: np.array([0.01 * way, 0.0, 0.0])  # noqa: E731
        episode = yielding(PLACED, law, q, ONE)
        episode.observations = np.full((len(episode.time), 1), way)
        episodes.append(episode)
    model, _ = fitted(PLACED, episodes)
    for q in postures(PLACED, 5, 96):
        for way in (-1.0, 1.0):
            assert way * moved(model, PLACED, q, "front", way)[0] > 0.05


def test_one_demonstration_a_patch_needs_no_other():
    """Nothing can be held out: each patch leads along its own course all the same."""
    first = smooth_path(BODY, 200, 0, [0, 1])
    then = np.tile(first[-1], (150, 1))
    then[:, 2] = straight(BODY, 2)[:, 2]
    first[:, 2] = then[0, 2]
    paths = {"front": first, "side": then}
    one, other = (record(BODY, patch, path, 6.0) for patch, path in paths.items())
    both = [np.concatenate([getattr(e, name) for e in (one, other)])
            for name in ("state", "action", "tactile")]  # fmt: skip
    together = Recorded(np.arange(len(both[0])) / BODY.rate, *both)
    for episodes in ([one, other], [one], [together]):
        model, report = fitted(BODY, episodes)
        assert report.choices["value"] == "goal"
        assert "value" not in report.errors
        for patch in report.taught:
            model.reset()
            targets = spell(model, BODY, torch.tensor(paths[patch][0]).float(), patch, 6.0, 230)
            np.testing.assert_allclose(targets[-1], paths[patch][-1], atol=0.05)


GIVEN = [
    {"touch": "patch"},
    {"touch": "direction"},
    {"value": "displacement", "readout": "mean"},
    {"value": "displacement", "readout": "first_order"},
    {"value": "goal"},
    {"joints": ["joint_1"]},
    {"rope_angle": 1.0},
    {"beta": 0.07, "value": "displacement"},
    {"beta": 0.0, "value": "displacement"},
]


@pytest.mark.parametrize("given", GIVEN, ids=str)
def test_what_is_given_by_hand_is_kept(given):
    model, report = fitted(BODY, compliant(3), **given)
    chosen = model.settled
    for name, value in given.items():
        if name == "joints":
            assert [BODY.joints[j] for j in chosen.joints] == value
        else:
            held = getattr(chosen, {"rope_angle": "angle"}.get(name, name))
            assert held == value
    left = report.errors.get("displacement: read-out", {})
    if "beta" in given:
        assert all("βD = " in name for name in left)
        assert len(left) == 2  # a mean and a law


def test_an_infinite_beta_is_the_argmax():
    model, _ = fitted(BODY, compliant(3), beta=math.inf, value="displacement")
    moved(model, BODY, postures(BODY, 1, 5)[0], "front")
    ((_, weights),) = model.recalled()
    assert weights.max() > 0.49  # of all, or shared by two that are alike
    assert (weights > 1e-6).sum() <= 2


def test_a_walk_is_sharp_unless_another_beta_is_given():
    path = smooth_path(BODY, 200, 0, [0, 1])
    episodes = [record(BODY, "front", path, 6.0)] * 2
    model, report = fitted(BODY, episodes, value="successor")
    assert model.settled.value == "successor"
    assert float(report.choices["βD"]) > 1e5
    assert fitted(BODY, episodes, value="successor", beta=0.5)[0].settled.beta == 0.5


def test_the_angle_of_rope3d_follows_the_readout():
    for readout, angle in (("mean", math.pi / 2), ("first_order", math.pi / 4)):
        model, _ = fitted(BODY, compliant(3), readout=readout, value="displacement")
        assert model.settled.angle == angle


def test_joints_that_cannot_be_coded_are_named():
    body = make_body(2, base=True)
    with pytest.raises(ValueError, match="cannot code the joints odom_x, tail; joints with limits"):
        fitted(
            body,
            [record(body, "front", straight(body, 0), 6.0)],
            joints=["joint_0", "odom_x", "tail"],
        )


def test_lists_generators_and_streams_give_identical_models():
    class Stream:
        """Read anew, an episode at a time, whenever it is asked for."""

        def __iter__(self):
            return iter(compliant(4))

    states = [fitted(BODY, episodes)[0].state_dict() for episodes in
              (compliant(4), (e for e in compliant(4)), tuple(compliant(4)), Stream())]  # fmt: skip
    for other in states[1:]:
        assert other.keys() == states[0].keys()
        assert all(torch.equal(other[name], values) for name, values in states[0].items())


def test_nothing_is_drawn_from_the_global_generators():
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002
    before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    fitted(BODY, compliant(2))
    assert torch.equal(torch.random.get_rng_state(), before[0])
    np.testing.assert_array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


def test_the_report_says_what_was_learned_tried_and_chosen():
    model, report = fitted(BODY, compliant(4))
    text = str(report)
    assert text.startswith(f"4 episodes, {len(model.origins)} associations of the patches front, ")
    for name, value in report.choices.items():
        assert f"{name} {value}" in text
    assert list(report.choices) == ["drive", "touch", "value", "readout", "βD", "joints"]
    for name, errors in report.errors.items():
        assert f"held-out error of {name}: " in text
        for option, error in errors.items():
            assert f"{option} {error:.3f}" in text
    assert {"displacement: touch", "displacement: read-out", "goal: touch", "value"} <= set(
        report.errors
    )
    assert "standing still 1" in text
    dim = len(report.choices["joints"].split()) * 160
    assert float(report.choices["βD"]) == pytest.approx(model.settled.beta * dim, rel=0.01)


@pytest.mark.parametrize("softness", [0.0, 4.0, 60.0, math.inf])
def test_soft_weights_reach_from_the_mean_to_the_argmax(softness):
    scores = torch.tensor([[0.2, 0.9, 0.5, 1.0], [0.3, 0.8, 0.3, 0.1]])
    excluded = torch.tensor([[False, False, False, True], [False, True, False, False]])
    weights = soft_weights(scores, absence(excluded), softness)
    torch.testing.assert_close(weights.sum(1), torch.ones(2))
    assert not weights[excluded].any()
    if softness == 0:
        torch.testing.assert_close(weights[0, :3], torch.full((3,), 1 / 3))
    elif softness == math.inf:
        assert weights.tolist() == [[0, 1, 0, 0], [0.5, 0, 0.5, 0]]
    else:
        ratio = weights[0, 1] / weights[0, 2]
        assert ratio.item() == pytest.approx(math.exp(softness * 0.4), rel=1e-4)
