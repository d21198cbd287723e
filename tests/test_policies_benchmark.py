"""Baselines learn what they claim, faults damage what they say, and the benchmark reports."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from toys import along, make_body, postures, press, push, ranges, yielding

from benchmarks import policies
from benchmarks.baselines.contestants import SETTINGS, load, save, train
from benchmarks.baselines.demonstrations import Sensed, Series, Units, folds
from benchmarks.baselines.faults import Fault, Faulty
from benchmarks.baselines.learned_training import Training
from benchmarks.baselines.neighbours import (
    HORIZON,
    LEAST,
    Neighbours,
    Samples,
    StandStill,
    mean_way,
    nearest,
)
from hasm_torch.body import Body
from hasm_torch.encoders.skin_filter import SkinFilter
from hasm_torch.episode import Episode
from hasm_torch.evaluation.filtered import Filtered


@dataclass
class Reader:
    """A policy that keeps what its skin read."""

    read: list

    def reset(self):
        self.read.append([])

    def step(self, state, skin, *, observation=None):
        self.read[-1].append(skin)
        return state


def touched_episodes(body: Body, count: int = 6) -> list[Episode]:
    """Pushed in turn on three patches, joints 0 and 1 move with the force."""
    touches = [("front", 20), (None, 5), ("side", 20), (None, 5), ("back", 20)]
    episodes = []
    for start in postures(body, count, seed=0):
        made = yielding(body, along(body), start, touches)
        columns = made.time, made.state, made.action, made.tactile
        episodes.append(Episode(len(episodes), "push", *columns))
    return episodes


def test_positions_are_shares_of_ranges_and_the_base_counts_from_its_start():
    body = make_body(base=True)
    units, rng = Units(body), np.random.default_rng(0)
    start = rng.uniform(*ranges(body))
    positions = rng.uniform(*ranges(body), (20, 6))
    shares = units.shares(positions, start)
    low, high = (limit[:3] for limit in ranges(body))
    np.testing.assert_allclose(shares[:, :3], (positions[:, :3] - low) / (high - low), rtol=1e-5)
    ahead = start + np.array([0, 0, 0, np.cos(start[5]), np.sin(start[5]), 0])
    np.testing.assert_allclose(units.shares(ahead, start)[3:], [1 / 0.4, 0, 0], atol=1e-6)
    for share, position in zip(shares, positions):
        np.testing.assert_allclose(units.positions(share, start), position, atol=1e-5)


def test_touch_is_the_force_of_each_patch_and_the_resultant_in_the_base_frame():
    body = make_body()
    for position in postures(body, 4, seed=1):
        skin = (press(body, "front", 6.0) + press(body, "back", 2.0)).numpy()[None]
        touch = Units(body).touch(skin.astype(np.float64), position[None])[0].numpy()
        np.testing.assert_allclose(touch[:3], [6.0, 0.0, 2.0], rtol=1e-6)
        resultant = 6.0 * push(body, "front", position) + 2.0 * push(body, "back", position)
        np.testing.assert_allclose(touch[3:], resultant, atol=1e-5)


def test_motion_keeps_within_limits():
    units = Units(make_body(base=True))
    before = torch.tensor([0.5, 0.5, 0.999, 0.0, 0.0, 0.0])
    way = torch.tensor([1.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    after = units.moved(before, way)
    assert float(after[0] - before[0]) == pytest.approx(float(units.largest[0]), rel=1e-4)
    assert float(after[1] - before[1]) == pytest.approx(float(units.largest[0]) / 2, rel=1e-4)
    assert float(units.moved(before, torch.eye(6)[2])[2]) == 1.0
    assert float(units.moved(-before, -torch.eye(6)[3])[3]) < 0.0, "a base has no limits"


def test_nearest_neighbours_are_weighted_by_inverse_distance():
    body, rng = make_body(observations={"object": 2}), np.random.default_rng(0)
    state, touch, seen, action = (rng.random((40, n)) for n in (3, 6, 2, 3))
    series = Series("", *(torch.from_numpy(x).float() for x in (state, action, touch, seen)))
    samples = Samples(body, Units(body), [series])
    assert samples.features == [*body.joints, "part", "patch", "direction", "observation"]
    scales = np.array([1.0, 2.0, 0.0, 0.5, 3.0, 0.3, 1.5])
    force = touch[:, :3].sum(1)
    ahead = np.minimum(np.arange(40)[:, None] + np.arange(HORIZON + 1), 39)
    ways = (action[ahead[:, -1]] - action) / force[ahead[:, 1:]].sum(1, keepdims=True)
    ways = ways[force > LEAST]
    # front and side are one rigid part, back another
    part = np.stack([touch[:, :2].sum(1), touch[:, 2]], axis=1) / force[:, None]
    features = [*state.T, part, touch[:, :3] / force[:, None], touch[:, 3:] / force[:, None],
                seen / np.ptp(seen[force > LEAST], axis=0)]  # fmt: skip
    columns = np.column_stack([x * scale for x, scale in zip(features, scales)])
    asked = samples.sensed(Sensed(series.state[:5], series.touch[:5] * 2, series.seen[:5]))
    asked[:, 0] += 0.1
    asked, keys = (samples.keys(x, torch.tensor(scales)) for x in (asked, samples.values))
    found = mean_way(*nearest(asked, keys, samples.ways, 4))
    for row in range(5):
        query = columns[row] + np.eye(columns.shape[1])[0] * 0.1
        away = np.linalg.norm(columns[force > LEAST] - query, axis=1)
        near = np.argsort(away)[:4]
        expected = np.average(ways[near], axis=0, weights=1 / (away[near] + 1e-6))
        np.testing.assert_allclose(found[row], expected, rtol=1e-3, atol=1e-5)


def test_held_out_episodes_are_not_learned_and_every_task_stays():
    series = [Series(task, *[torch.zeros(1, 1)] * 4) for task in "aabbaab"]
    held_at_all = []
    for learned, held in folds(series, 3):
        assert {s.task for s in learned} == {"a", "b"}
        assert not {id(s) for s in learned} & {id(s) for s in held}
        assert len(learned) + len(held) == len(series)
        held_at_all += [id(s) for s in held]
    assert sorted(held_at_all) == sorted(id(s) for s in series)
    assert not folds(series[:1], 3), "nothing can be held out of a single episode"


def test_tuned_neighbours_move_with_the_force_in_postures_that_nobody_taught():
    body = make_body()
    policy = Neighbours(body, touched_episodes(body, 12))
    scales = dict(zip(policy.samples.features, policy.scales.tolist()))
    assert scales["direction"] > 0, "what the motion depends on"
    cosines = []
    for start in postures(body, 5, seed=7):
        policy.reset()
        first = state = torch.from_numpy(start).float()
        for _ in range(10):
            state = policy.step(state, press(body, "front", 6.0))
        way, wanted = (state - first).numpy()[:2], push(body, "front", start)[:2]
        cosines.append(way @ wanted / np.linalg.norm(way) / np.linalg.norm(wanted))
    assert np.median(cosines) > 0.9


def test_a_base_is_led_in_its_own_frame():
    body = make_body(base=True)

    def ahead(toward, positions):
        return np.array([0.0, 0.0, 0.0, 0.002, 0.0, 0.0])

    starts = postures(body, 2, seed=0)
    starts[:, 3:] = 0.0
    made = [yielding(body, ahead, start, [("back", 40)]) for start in starts]
    episodes = [Episode(i, "", e.time, e.state, e.action, e.tactile) for i, e in enumerate(made)]
    policy = Neighbours(body, episodes)
    start = torch.tensor([*starts[0][:3], 0.1, 0.2, np.pi / 2]).float()
    state = start
    for _ in range(20):
        state = policy.step(state, press(body, "back", 6.0))
    x, y, yaw = (state - start)[3:].tolist()
    assert y == pytest.approx(0.04, rel=0.1)
    assert (x, yaw) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_standing_still_stands_still():
    policy = StandStill()
    start = torch.tensor([0.1, 0.2])
    policy.reset()
    assert torch.equal(policy.step(start, torch.ones(6)), start)
    assert torch.equal(policy.step(start + 1, torch.ones(6)), start)
    policy.reset()
    assert torch.equal(policy.step(start + 1, torch.ones(6)), start + 1)


def read_of(fault: Fault, skin: torch.Tensor, steps: int, start: float = 0.0) -> torch.Tensor:
    reader = Reader([])
    policy = Faulty(reader, fault)
    policy.reset()
    for step in range(steps):
        policy.step(torch.full((2,), start + step), skin)
    return torch.stack(reader.read[-1])


def test_faults_do_what_they_say():
    skin = torch.full((54 * 3,), 2.0)
    dead, again = (read_of(Fault("dead", 0.3), skin, 5, at).reshape(5, 54, 3) for at in (0.0, 0.5))
    silent = (dead == 0).all(-1)
    assert (silent.sum(-1) == 16).all()
    assert (silent == silent[0]).all()
    assert not torch.equal(silent, (again == 0).all(-1)), "other cells in another rollout"
    noise = read_of(Fault("noise", 0.5), skin, 300)
    assert float(noise.std()) == pytest.approx(0.5, rel=0.02)
    assert float(noise.mean()) == pytest.approx(2.0, rel=0.01)
    assert float(read_of(Fault("noise", 2.0), skin, 30).min()) == 0
    lost = read_of(Fault("lost", 0.3), skin, 2000)
    assert set(lost.unique().tolist()) == {0.0, 2.0}
    assert float((lost[:, 0] == 0).double().mean()) == pytest.approx(0.3, abs=0.04)
    offset = read_of(Fault("offset", 0.2), skin, 3)
    torch.testing.assert_close(offset, torch.full_like(offset, 2.2))
    stuck = read_of(Fault("stuck", 1.0), skin, 4).reshape(4, 54, 3)
    assert ((stuck == 1.0).all(-1).sum(-1) == 1).all()
    assert int((stuck == 2.0).sum()) == 4 * 53 * 3
    assert torch.equal(skin, torch.full((54 * 3,), 2.0)), "the true skin is left alone"


def test_all_policies_meet_the_same_damage():
    """Damage depends on where a rollout begins alone."""
    skin, fault = torch.ones(30), Fault("noise", 0.5)
    reader = Reader([])
    policy = Faulty(reader, fault)
    for steps in (7, 2):
        policy.reset()
        for step in range(steps):
            policy.step(torch.full((2,), float(step)), skin)
    torch.testing.assert_close(torch.stack(reader.read[-1]), read_of(fault, skin, 9)[:2])
    assert not torch.equal(read_of(fault, skin, 2), read_of(fault, skin, 2, 0.5))


@pytest.mark.parametrize(("kind", "level"), [("broken", 0.1), ("dead", 1.5), ("noise", -1.0)])
def test_a_fault_that_does_not_exist_is_refused(kind, level):
    with pytest.raises(ValueError, match=r"unknown fault|expected a share"):
        Fault(kind, level)


def test_the_filter_stands_behind_the_faults():
    body, reader = make_body(), Reader([])
    skin = press(body, "side", 6.0)
    shares = np.array([0, 1, 1, 1, 0, 0], np.float32) / 3
    filtered = Filtered(reader, SkinFilter(body.cells, body.rate, shares))
    for policy in (filtered, Faulty(filtered, Fault("lost", 1.0))):
        policy.reset()
        policy.step(torch.zeros(3), skin)
    sound, lost = (read[-1] for read in reader.read)
    assert torch.equal(sound, skin)
    assert not lost.any()


def test_every_variant_changes_one_thing():
    default, mean = (vars(SETTINGS[name]) for name in ("default", "mean read-out"))
    for name, config in SETTINGS.items():
        base = mean if name.startswith("mean, ") else default
        changed = [key for key, value in vars(config).items() if value != base[key]]
        assert len(changed) == {"default": 0}.get(name, 1) or name == "the paper literally"


@pytest.mark.parametrize("name", ["default", "nearest neighbours, tuned", "standing still"])
def test_what_is_loaded_does_what_was_saved(name, tmp_path):
    body = make_body()
    episodes = touched_episodes(body)
    trained = train(name, "yield", body, episodes, Training(seconds=1.0))
    save(trained.policy, body, episodes, tmp_path)
    policies = [trained.policy, load(str(tmp_path)), load(str(tmp_path), filtered=True)]
    targets = []
    for policy in policies:
        policy.reset()
        state, seen = torch.from_numpy(postures(body, 1, seed=3)[0]).float(), torch.zeros(0)
        for _ in range(8):
            state = policy.step(state, press(body, "front", 6.0), observation=seen)
        targets.append(state)
    torch.testing.assert_close(targets[1], targets[0])
    torch.testing.assert_close(targets[2], targets[0])


def test_the_benchmark_rolls_out_and_reports():
    names = ["default", "standing still"]
    options = policies.Options(names, ["compliance"], rollouts=1)
    results = policies.run(options)
    ours, still = (results[name]["compliance"] for name in names)
    assert ours["with_force"] == ours["correct_turn"] == 1.0
    assert still["with_force"] == still["correct_turn"] == 0.0
    assert results["default"]["costs"]["compliance"]["memory_bytes"] > 1000
    assert "velocities" not in ours["behaviours"]["arm_up"]
    header, _, *lines = policies.table(results).splitlines()
    assert "arm with force" in header
    assert [line.split("  ")[0] for line in lines] == names


def test_options_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="unknown contestants"):
        policies.Options(["nobody"])
    with pytest.raises(ValueError, match="unknown experiment"):
        policies.Options(experiments=["juggling"])
    with pytest.raises(ValueError, match="expected a share"):
        policies.Options(fault="dead", level=2.0)
