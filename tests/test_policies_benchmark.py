"""Baselines learn what they claim, faults damage what they say, and the benchmark resumes."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from toys import make_body, press

from benchmarks import policies
from benchmarks.baselines.contestants import CONTESTANTS, settings, train
from benchmarks.baselines.demonstrations import (
    Ahead,
    Series,
    cross_validate,
    folds,
    moved,
    values_of,
)
from benchmarks.baselines.faults import Fault, FaultySkin
from benchmarks.baselines.policies import (
    DenseMemory,
    NearestNeighbours,
    StandStill,
    dense_memory_candidates,
    neighbour_candidates,
)
from benchmarks.policies_bench import Cell, plan, some_episodes, start_of
from benchmarks.policies_report import CONDITIONS, goals, pool, wilson
from hasm_torch.body import Body
from hasm_torch.data.episodes import Episode
from hasm_torch.evaluation.rollout import Policy
from hasm_torch.evaluation.runner import EXPERIMENTS


@dataclass
class Reader:
    """A policy that keeps what its skin read."""

    read: list

    def reset(self):
        self.read.append([])

    def step(self, state, skin):
        self.read[-1].append(skin)
        return state


def touched_episodes(body: Body) -> list[Episode]:
    """Touch on the front moves the first joint up, on the side down, twice as fast at 8 N."""
    episodes = []
    for patch, sign in (("front", 1), ("side", -1)):
        for force in (4.0, 8.0):
            speed = sign * force * 0.001
            steps = int(1.2 / abs(speed))
            action = np.zeros((steps, 3), np.float32)
            action[:, 0] = -sign * 0.6 + speed * np.arange(steps)
            skin = press(body, patch, force).numpy()
            episodes.append(
                Episode(len(episodes), patch, np.arange(steps) / 50, action, action,
                        np.broadcast_to(skin, (steps, *skin.shape)).copy())
            )  # fmt: skip
    return episodes


def test_values_are_the_later_action_and_stop_at_the_end():
    action = torch.tensor([[0.0], [0.1], [0.3], [0.6]])
    series = Series("task", action, action, torch.zeros(4, 1))
    target = values_of(series, Ahead(2, "target"))
    torch.testing.assert_close(target, torch.tensor([[0.3], [0.6], [0.6], [0.6]]))
    way = values_of(series, Ahead(2, "displacement"))
    torch.testing.assert_close(way, torch.tensor([[0.15], [0.25], [0.15], [0.0]]))


@pytest.mark.parametrize("mode", ["displacement", "target"])
def test_following_exact_values_repeats_the_motion(mode):
    action = 0.01 * torch.arange(50.0).unsqueeze(1)
    series = Series("task", action, action, torch.zeros(50, 1))
    ahead = Ahead(5, mode)
    values, at = values_of(series, ahead), action[:1]
    for step in range(30):
        at = moved(at, values[step : step + 1], ahead, torch.tensor([0.02]))
    assert float(at) == pytest.approx(0.30, abs=1e-5)


def test_motion_keeps_within_limits():
    ahead = Ahead(1, "target")
    at = moved(
        torch.tensor([[0.5, 0.5]]), torch.tensor([[2.0, 1.0]]), ahead, torch.tensor([0.1, 1])
    )
    torch.testing.assert_close(at, torch.tensor([[0.6, 0.5 + 0.5 / 15]]))
    out = moved(torch.tensor([[0.99]]), torch.tensor([[5.0]]), ahead, torch.tensor([0.1]))
    assert float(out) == 1.0


def test_nearest_neighbours_are_weighted_by_inverse_distance():
    rng = np.random.default_rng(0)
    states, touches, values = (rng.random((40, n)) for n in (3, 2, 3))
    query_state, query_touch = rng.random((5, 3)), rng.random((5, 2))
    scale = 2.0 / touches.max()
    expected = []
    for state, touch in zip(query_state, query_touch):
        away = np.sqrt(((states - state) ** 2).sum(1) + (scale * (touches - touch)) ** 2 @ [1, 1])
        near = np.argsort(away)[:4]
        expected.append(np.average(values[near], axis=0, weights=1 / (away[near] + 1e-6)))
    tensors = [torch.from_numpy(a) for a in (states, touches, values)]
    knn = NearestNeighbours(*tensors, neighbours=4, touch_weight=2.0)
    found = knn.predict(torch.from_numpy(query_state), torch.from_numpy(query_touch))
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)


def test_the_dense_memory_returns_the_sample_that_is_asked_for():
    states = torch.linspace(0.05, 0.95, 10).unsqueeze(1).repeat(1, 2)
    touches = torch.tensor([[0.0, 5.0], [5.0, 0.0]]).repeat(5, 1)
    values = torch.arange(10.0).unsqueeze(1).repeat(1, 2)
    memory = DenseMemory(states, touches, values)
    torch.testing.assert_close(memory.predict(states, touches), values)


def test_held_out_episodes_are_not_learned_and_every_task_stays():
    series = [Series(task, *[torch.zeros(1, 1)] * 3) for task in "aabbaab"]
    held_at_all = []
    for learned, held in folds(series):
        assert {s.task for s in learned} == {"a", "b"}
        assert not {id(s) for s in learned} & {id(s) for s in held}
        assert len(learned) + len(held) == len(series)
        held_at_all += [id(s) for s in held]
    assert sorted(held_at_all) == sorted(id(s) for s in series)
    assert not list(folds(series[:1])), "nothing can be held out of a single episode"


def test_cross_validation_prefers_what_generalises():
    """The motion goes on at another height, where only displacements are right."""
    body = make_body(1)
    episodes = []
    for low in (0.0, 0.3, 0.6):
        action = low + 0.002 * torch.arange(150.0).unsqueeze(1)
        episodes.append(Series("task", action, action, torch.ones(150, 3)))
    best, errors = cross_validate(neighbour_candidates(), episodes, body)
    assert best.ahead.mode == "displacement"
    of_targets = min(error for name, error in errors.items() if "target" in name)
    assert errors[best.name] == min(errors.values()) < 0.1 * of_targets


@pytest.mark.parametrize("candidates", [neighbour_candidates, dense_memory_candidates])
def test_baselines_follow_the_touch(candidates):
    body = make_body()
    name = {neighbour_candidates: "nearest neighbours", dense_memory_candidates: "dense"}
    full = next(n for n in CONTESTANTS if n.startswith(name[candidates]))
    policy = train(full, "compliance", body, touched_episodes(body)).policy
    way = {}
    for patch, force in (("front", 4.0), ("front", 8.0), ("side", 8.0)):
        policy.reset()
        state = torch.zeros(3)
        for _ in range(25):
            state = policy.step(state, press(body, patch, force))
        way[patch, force] = float(state[0])
    assert way["front", 4.0] == pytest.approx(0.1, rel=0.2)
    assert way["front", 8.0] == pytest.approx(0.2, rel=0.2)
    assert way["side", 8.0] == pytest.approx(-0.2, rel=0.2)


def test_standing_still_stands_still():
    policy = StandStill()
    start = torch.tensor([0.1, 0.2])
    policy.reset()
    assert torch.equal(policy.step(start, torch.ones(6)), start)
    assert torch.equal(policy.step(start + 1, torch.ones(6)), start)
    policy.reset()
    assert torch.equal(policy.step(start + 1, torch.ones(6)), start + 1)


def read_of(fault: Fault, skin: torch.Tensor, steps: int, rollouts: int = 1, seed: int = 0):
    reader = Reader([])
    policy: Policy = FaultySkin(reader, fault, np.random.default_rng(seed))
    for _ in range(rollouts):
        policy.reset()
        for _ in range(steps):
            policy.step(torch.zeros(1), skin)
    return [torch.stack(read) for read in reader.read]


def test_faults_do_what_they_say():
    skin = torch.full((54 * 3,), 2.0)
    dead, again = (r.reshape(5, 54, 3) for r in read_of(Fault("dead", 0.3), skin, 5, 2))
    silent = (dead == 0).all(-1)
    assert (silent.sum(-1) == 16).all()
    assert (silent == silent[0]).all()
    assert not torch.equal(silent, (again == 0).all(-1)), "other cells in another rollout"
    (noise,) = read_of(Fault("noise", 0.5), skin, 300)
    assert float(noise.std()) == pytest.approx(0.5, rel=0.02)
    assert float(noise.mean()) == pytest.approx(2.0, rel=0.01)
    assert float(noise.min()) >= 0
    (lost,) = read_of(Fault("lost", 0.3), skin, 2000)
    assert set(lost.unique().tolist()) == {0.0, 2.0}
    assert float((lost[:, 0] == 0).double().mean()) == pytest.approx(0.3, abs=0.04)
    (offset,) = read_of(Fault("offset", 0.2), skin, 3)
    torch.testing.assert_close(offset, torch.full_like(offset, 2.2))
    (stuck,) = (r.reshape(4, 54, 3) for r in read_of(Fault("stuck", 1.0), skin, 4))
    assert ((stuck == 1.0).all(-1).sum(-1) == 1).all()
    assert int((stuck == 2.0).sum()) == 4 * 53 * 3
    assert torch.equal(skin, torch.full((54 * 3,), 2.0)), "the true skin is left alone"


def test_all_policies_meet_the_same_damage():
    """Damage of a rollout does not depend on how long the one before took."""
    skin = torch.ones(30)
    short = read_of(Fault("noise", 0.5), skin, 2, rollouts=2)
    long = read_of(Fault("noise", 0.5), skin, 9, rollouts=2)
    assert torch.equal(short[1], long[1][:2])
    assert not torch.equal(short[0], read_of(Fault("noise", 0.5), skin, 2, seed=1)[0])


@pytest.mark.parametrize(("kind", "level"), [("broken", 0.1), ("dead", 1.5), ("noise", -1.0)])
def test_a_fault_that_does_not_exist_is_refused(kind, level):
    with pytest.raises(ValueError, match=r"unknown fault|expected a share"):
        Fault(kind, level)


def test_wilson_is_the_published_interval():
    assert wilson(8, 10) == pytest.approx((0.4901, 0.9433), abs=2e-4)  # Newcombe 1998's form
    assert wilson(0, 10)[0] == 0.0
    assert wilson(10, 10)[1] == 1.0
    with pytest.raises(ValueError, match="at least 1 trial"):
        wilson(0, 0)


def test_the_default_is_the_default():
    changed = [name for name, config in settings().items() if config == settings()["default"]]
    assert changed == ["default"], "every other contestant changes something"


def test_a_run_is_resumed_and_reported(tmp_path, capsys):
    log = tmp_path / "policies.jsonl"
    options = policies.Options(
        ["default"], curves=False, quick=True, workers=1, output_dir=tmp_path
    )
    assert all(path.stat().st_size > 0 for path in policies.run(options))
    (line,) = log.read_text().splitlines()
    log.write_text(line + "\n" + line[:40])  # as a run leaves it that is cut off in the next cell
    options.contestants = ["default", "standing still"]
    policies.run(options)
    again = log.read_text().splitlines()
    assert again[0] == line, "a finished cell is not run again"
    assert [json.loads(entry)["contestant"] for entry in again] == options.contestants
    content = json.loads((tmp_path / "policies.json").read_text())
    ours, still = (entry["results"] for entry in content["contestants"])
    assert ours["compliance"]["successes"] == ours["compliance"]["rollouts"] == 8
    assert ours["grasp"]["successes"] == ours["grasp"]["rollouts"] == 1
    assert still["compliance"]["successes"] == still["grasp"]["successes"] == 0
    assert {"cpu", "threads"} <= content["machine"].keys()
    assert content["seed"] == 0
    assert "standing still" in capsys.readouterr().out


def test_every_cell_is_planned_once_and_fairly():
    """The neighbours meet what the default meets, seed by seed, and networks few episodes too."""
    planned = policies.cells(policies.Options(workers=1))
    keys = [cell.key for cell in planned]
    assert len(keys) == len(set(keys))
    assert {cell.condition for cell in planned} == {"none", "unharmed", *CONDITIONS}
    for rival in (policies.TUNED_NEIGHBOURS, "ACT", "Diffusion"):
        theirs = {(*vars(c).values(),)[1:] for c in planned if c.contestant == rival}
        ours = {(*vars(c).values(),)[1:] for c in planned if c.contestant == "default"}
        assert theirs <= ours
    for condition in {cell.condition for cell in planned} - {"none"}:
        seeds = {cell.seed for cell in planned if cell.condition == condition}
        assert len(seeds) == 3


def test_conditions_change_what_they_say():
    def cell(condition: str, level: float) -> Cell:
        return Cell("default", condition, level, 0, 4, 4)

    assert {c.force for c in plan(cell("force", 8.0), "compliance") if not c.changing} == {8.0}
    assert {c.force for c in plan(cell("force", 8.0), "grasp")} == {8.0}
    assert {c.start_noise for c in plan(cell("start_noise", 0.3), "grasp")} == {0.3}
    assert {c.object_noise for c in plan(cell("object", 0.04), "grasp")} == {0.04}
    assert plan(cell("dead", 0.3), "grasp") == plan(cell("unharmed", 0.0), "grasp")


def test_a_posture_moves_from_the_shown_one_to_any():
    @dataclass
    class Limits:
        joint_lower: np.ndarray
        joint_upper: np.ndarray

        @property
        def unwrapped(self):
            return self

    env = Limits(np.full(8, -1.0), np.full(8, 2.0))
    for case in plan(Cell("default", "posture", 0.0, 0, 3, 0), "compliance"):
        shown, half, drawn = (
            start_of(Cell("default", "posture", level, 0, 3, 0), case, env)
            for level in (0.0, 0.5, 1.0)
        )
        np.testing.assert_allclose(half, (shown + drawn) / 2)
        assert (shown == drawn).sum() == 1, "the yielding joint starts where it would anyway"
    assert start_of(Cell("default", "none", 0.0, 0, 3, 0), case, env) is None


def test_few_episodes_are_drawn_from_every_behaviour():
    episodes = touched_episodes(make_body())
    picked = some_episodes(episodes, 1, seed=3)
    assert sorted(episodes[i].task for i in picked) == ["front", "side"]
    assert {some_episodes(episodes, 1, seed) for seed in range(8)} != {picked}
    assert some_episodes(episodes, 9, seed=3) == (0, 1, 2, 3)


def entry(contestant, condition, level, seed, experiment, successes, rollouts, **more):
    drifts = {"hold_drift_rad": 0.0} if experiment == "grasp" else {"behaviours": {}}
    figures = {"successes": successes, "rollouts": rollouts, "train_seconds": 1.0,
               "memory_bytes": 10, "step_ms": 0.2, **drifts, **more}  # fmt: skip
    if experiment == "compliance":
        figures["behaviours"] = {"arm_up": {"release_drift_rad": 0.01 * seed}}
    return {"contestant": contestant, "condition": condition, "level": level, "seed": seed,
            "results": {experiment: figures}}  # fmt: skip


def test_seeds_are_pooled_and_goals_judged():
    curves = pool(
        [entry("default", "unharmed", 0.0, s, e, 10, 10) for s in range(3) for e in EXPERIMENTS]
        + [entry("default", "dead", 0.3, s, e, 9, 10) for s in range(3) for e in EXPERIMENTS]
        + [entry("nearest neighbours, tuned", "dead", 0.3, s, "grasp", 10, 10) for s in range(3)]
    )
    found = {(p["contestant"], p["condition"], p["experiment"]): p for p in curves}
    point = found["default", "dead", "compliance"]
    assert (point["successes"], point["rollouts"], point["seeds"]) == (27, 30, [0, 1, 2])
    assert point["interval"] == pytest.approx(wilson(27, 30))
    assert point["drift"] == pytest.approx(0.02)
    reached = {goal["what"]: goal for goal in goals([], curves)}
    loss = reached["dead cells, share: 0.3, loss of success"]
    assert loss["is"] == "10.0 points"
    assert not loss["reached"]
    (beside,) = (goal for what, goal in reached.items() if "neighbours" in what)
    assert beside["is"] == "90% : 100%"
    assert not beside["reached"]
