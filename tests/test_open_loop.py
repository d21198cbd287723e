"""Open-loop prediction: known answers, no leak between folds, its opponents, the report."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.config import HASMConfig
from hasm_torch.data import Episode, EpisodeSet, SkinPatch, load_episodes, write_episodes
from hasm_torch.data.training import DatasetConfig
from hasm_torch.evaluation import opponents
from hasm_torch.evaluation.open_loop import (
    CONTESTANTS,
    STEPPED,
    fold_episodes,
    open_loop,
    predict_fold,
    relative_errors,
)
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.model.choose_timed import splits
from hasm_torch.model.moments import TREND_RIDGE, Moments, Series, moments

RECORDINGS = Path(__file__).parents[2] / "shared" / "data"
FPS = 10.0
TIMED = HASMConfig(drive="time")


def swing(index: int, frames: int = 24, touched: bool = False) -> Episode:
    """A joint that moves to a goal with its own speed, one that follows, and noise of its own."""
    rng = np.random.default_rng(index)
    path = np.linspace(rng.uniform(0.0, 0.1), 1.0, frames) ** rng.uniform(1.0, 1.4)
    state = np.stack([path, 50 * path**2], axis=1) + 0.002 * rng.normal(size=(frames, 2))
    state = state.astype(np.float32)
    tactile = np.abs(rng.normal(size=(frames, 4, 1))).astype(np.float32) if touched else None
    time = np.arange(frames, dtype=np.float32) / np.float32(FPS)
    return Episode(index, "swing", time, state, state, tactile)


def pushed(index: int) -> Episode:
    """A joint that goes up under touch and stays where it is left."""
    force = np.repeat([0.0, 6.0, 0.0, 6.0, 0.0], 15)
    arm = 0.1 * index + 0.02 * np.concatenate([[0.0], np.cumsum(force[:-1] > 0)])
    state = np.stack([arm, np.full(75, 0.5)], axis=1).astype(np.float32)
    tactile = np.zeros((75, 4, 1), np.float32)
    tactile[:, 0, 0] = force
    time = np.arange(75, dtype=np.float32) / np.float32(FPS)
    return Episode(index, "push", time, state, state, tactile)


def dataset(episodes: list[Episode]) -> EpisodeSet:
    skin = None
    if episodes[0].tactile is not None:
        skin = {
            name: SkinPatch(name, slice(first, first + 2), channels=1)
            for name, first in (("left", 0), ("right", 2))
        }
    names = ("arm", "tool")
    return EpisodeSet(episodes, FPS, names, ("rad", "mm"), skin, Path("made"), names)


def swings(count: int = 9, touched: bool = False) -> EpisodeSet:
    return dataset([swing(i, touched=touched) for i in range(count)])


def known_and_asked(past: tuple[int, ...]) -> tuple[Moments, Moments]:
    rng = np.random.default_rng(0)
    series = [
        Series(torch.tensor(e.state).double(), torch.from_numpy(rng.uniform(size=(24, 2))))
        for e in swings(5)
    ]
    return moments(series[:3], past, 2), moments(series[3:], past, 2)


def inputs(found: Moments) -> np.ndarray:
    return np.concatenate([found.state, found.past.flatten(1), found.touch], axis=1)


def by_ridge(known: Moments, asked: Moments) -> np.ndarray:
    x, y = inputs(known), known.target.numpy()
    centre, spread = x.mean(axis=0), x.std(axis=0)
    ridge = np.full(x.shape[1], TREND_RIDGE * len(x))
    law = reference.linear_law(y - y.mean(axis=0), (x - centre) / spread, np.ones(len(x)), ridge)
    return (inputs(asked) - centre) / spread @ law.T + y.mean(axis=0)


def test_ridge_by_definition():
    known, asked = known_and_asked((1, 3))
    np.testing.assert_allclose(opponents.ridge(known, asked), by_ridge(known, asked), atol=1e-9)


@pytest.mark.parametrize("trend", [False, True])
@pytest.mark.parametrize("count", [1, 4])
def test_neighbours_by_definition(count, trend):
    known, asked = known_and_asked((2,))
    spread = inputs(known).std(axis=0)
    left = known.target.numpy() - trend * by_ridge(known, known)
    line = trend * by_ridge(known, asked)
    got = opponents.neighbours(known, asked, count, trend).numpy()
    assert got.shape == asked.target.shape
    for i, row in enumerate(inputs(asked)):
        away = (((inputs(known) - row) / spread) ** 2).sum(axis=1)
        nearest = np.argsort(away)[:count]
        np.testing.assert_allclose(got[i], left[nearest].mean(axis=0) + line[i], atol=1e-6)


def test_neighbours_are_all_where_fewer_were_learned():
    known, asked = known_and_asked((1,))
    few = known.rows(torch.arange(3))
    found = opponents.neighbours(few, asked, 5, trend=False)
    torch.testing.assert_close(found, few.target.mean(0).expand_as(found))


def test_opponents_are_tuned_inside_the_learned_episodes():
    series = [
        Series(torch.tensor(e.state).double(), torch.zeros(24, 0, dtype=torch.float64))
        for e in swings(6)
    ]
    chosen = opponents.tuned(series, 2)
    assert list(chosen) == ["ridge", "neighbours"]

    def error(past, option) -> float:
        wrong = 0.0
        for learned, out in splits(series):
            known, asked = moments(learned, past, 2), moments(out, past, 2)
            span = np.ptp(known.state.numpy(), axis=0)
            wrong += (((option(known, asked) - asked.target).numpy() / span) ** 2).sum()
        return wrong

    pasts = ((1,), (1, 2, 4, 8), (1, 2, 3, 4, 8, 16))
    ridge = min(error(past, opponents.ridge) for past in pasts)
    others = [
        error(past, lambda k, a, n=n, t=t: opponents.neighbours(k, a, n, t))
        for past in pasts
        for n in (5, 15, 30)
        for t in (False, True)
    ]
    assert error(*chosen["ridge"]) == pytest.approx(ridge)
    assert error(*chosen["neighbours"]) == pytest.approx(min(others))


@settings(max_examples=40, deadline=None)
@given(count=st.integers(3, 40), folds=st.integers(2, 10), seed=st.integers(0, 9))
def test_folds_cover_every_episode_once(count, folds, seed):
    folds = min(folds, count)
    parts = fold_episodes(count, folds, np.random.default_rng(seed))
    assert sorted(i for part in parts for i in part) == list(range(count))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize(("count", "folds"), [(2, 2), (5, 1), (5, 6)])
def test_impossible_folds(count, folds):
    with pytest.raises(ValueError, match="folds must be at least 2"):
        fold_episodes(count, folds, np.random.default_rng(0))


@pytest.mark.parametrize("touched", [False, True])
def test_nothing_of_a_held_out_episode_is_learned(touched):
    """Changing the held-out episodes changes neither what is chosen nor what others get.

    The future of a held-out episode (all but its first frames) is replaced by another: what was
    predicted from the first frames stays the same to the last bit.
    """
    data = swings(5, touched)
    config = EvalConfig("open_loop", model=TIMED)
    before = predict_fold(data, [2, 4], 3, config)
    changed = list(data.episodes)
    for i in (2, 4):
        other = changed[i].state.copy()
        other[10:] = 1e3 - other[10:]
        tactile = changed[i].tactile
        if tactile is not None:
            tactile = tactile.copy()
            tactile[10:] *= 100
        changed[i] = replace(changed[i], state=other, action=other, tactile=tactile)
    after = predict_fold(replace(data, episodes=changed), [2, 4], 3, config)
    assert after.choices == before.choices
    early = np.tile(np.arange(21) < 10, 2)
    for who in CONTESTANTS:
        np.testing.assert_array_equal(after.by[who][early], before.by[who][early])
    assert not np.array_equal(after.real, before.real)


def test_a_leak_would_be_seen():
    """The test above can fail: with a copy of its own episode learned a fold is predicted."""
    rng = np.random.default_rng(0)
    walks = []
    for i in range(6):
        state = rng.normal(size=(40, 2)).cumsum(axis=0).astype(np.float32)
        time = (np.arange(40) / FPS).astype(np.float32)
        walks.append(replace(swing(i), time=time, state=state, action=state))
    sharp = EvalConfig("open_loop", model=HASMConfig(beta=1.0))
    errors = []
    for episodes in (walks, [*walks, replace(walks[0], index=6)]):
        fold = predict_fold(dataset(episodes), [0], 1, sharp)
        errors.append(relative_errors(fold.by["hasm"], fold.real, np.ones(2))[0])
    fair, leaked = errors
    assert leaked < 0.3 < 0.8 < fair


def test_a_fold_holds_what_came():
    data = swings(6)  # episodes 1 and 5 stay in the range of the others
    fold = predict_fold(data, [1, 5], 4, EvalConfig("open_loop"))
    states = [data.episodes[i].state for i in (1, 5)]
    np.testing.assert_allclose(fold.state, np.concatenate([s[:-4] for s in states]))
    np.testing.assert_allclose(fold.real, np.concatenate([s[4:] - s[:-4] for s in states]), 1e-5)
    assert fold.episode.tolist() == [1] * 20 + [5] * 20
    assert list(fold.by) == list(CONTESTANTS)
    assert fold.choices["drive"] == "time"
    for who in CONTESTANTS:
        error, _ = relative_errors(fold.by[who], fold.real, np.ptp(fold.state, axis=0))
        assert error < 0.4


def test_what_touch_moves_is_predicted_from_some_frames():
    """Steps take longer than recalls; opponents are asked for the same frames."""
    data = dataset([pushed(i) for i in range(5)])
    fold = predict_fold(data, [2], 3, EvalConfig("open_loop"))
    assert fold.choices["drive"] == "spike"
    frames = np.unique(np.linspace(0, 71, STEPPED).round().astype(int))
    state = data.episodes[2].state
    np.testing.assert_allclose(fold.state, state[frames])
    np.testing.assert_allclose(fold.real, state[frames + 3] - state[frames], atol=1e-6)
    assert {len(predicted) for predicted in fold.by.values()} == {len(frames)}
    error, _ = relative_errors(fold.by["hasm"], fold.real, np.ptp(state, axis=0))
    assert error < 0.7


def test_errors_by_definition():
    real = np.array([[1.0, 0.0, 4.0], [-1.0, 0.0, 0.0]])
    predicted = np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    over_all, each = relative_errors(predicted, real, np.array([1.0, 0.0, 2.0]))
    assert each == pytest.approx([np.sqrt(0.5), None, 0.5])
    assert over_all == pytest.approx(np.sqrt((0.5 + 2 / 4) / (1.0 + 8 / 4)))
    assert relative_errors(real, real, np.ones(3))[0] == 0.0
    assert relative_errors(0 * real, real, np.ones(3))[0] == 1.0
    assert relative_errors(real, 0 * real, np.ones(3)) == (None, [None] * 3)


def write(root: Path, data: EpisodeSet) -> Path:
    return write_episodes(
        root, data, joints=data.joints, units=data.units, skin=data.skin, fps=round(FPS),
        robot_type="made",
    )  # fmt: skip


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("stored") / "swing", swings(5, touched=True))


def test_open_loop_writes_figures_and_says_what_it_did(stored, tmp_path, capsys):
    config = EvalConfig(
        "open_loop", DatasetConfig(stored), model=TIMED, folds=2, horizon_s=0.4, output_dir=tmp_path
    )
    report = open_loop(config)
    written = json.loads((tmp_path / "open_loop.json").read_text())
    assert written == report
    assert (written["horizon_s"], written["still"]) == (0.4, 1.0)
    assert sorted(i for part in written["folds"] for i in part) == list(range(5))
    assert set(written["per_joint"]) == {"arm", "tool"}
    for part in (written, written["one_step"]):
        assert all(0 < part[who] < 1 for who in CONTESTANTS)
        assert set(part["per_joint"]["arm"]) == set(CONTESTANTS)
    assert [chosen["drive"] for chosen in written["horizon"]["choices"]] == ["time"] * 2
    assert written["horizon"]["frames"] == 5 * (24 - 4)
    assert written["one_step"]["frames"] == 5 * (24 - 1)
    assert (tmp_path / "open_loop.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "the range of the data" in printed
    assert "4 cells x pressure" in printed
    assert "0.4 s ahead" in printed
    assert f"{written['one_step']['per_joint']['arm']['hasm']:.3f}" in printed


def test_the_paper_as_written_can_be_evaluated(tmp_path):
    root = write(tmp_path / "pushed", dataset([pushed(i) for i in range(3)]))
    config = EvalConfig(
        "open_loop",
        DatasetConfig(root),
        method="literal",
        folds=2,
        horizon_s=0.3,
        output_dir=tmp_path,
    )
    report = open_loop(config)
    assert report["method"] == "literal"
    chosen = report["horizon"]["choices"][0]
    assert (chosen["drive"], chosen["touch"], chosen["value"]) == ("spike", "patch", "successor")
    assert chosen["βD"] == f"{2.0 * 10 * 4:.3g}"  # of the one joint that moves


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon_s": 0.0}, "horizon_s must be above 0"),
        ({"folds": 8}, "at most the number of episodes"),
        ({"horizon_s": 9.0}, "choose a shorter horizon"),
        ({"dataset": DatasetConfig()}, "needs a dataset: --dataset.root"),
        ({"method": "literal", "model": TIMED}, "leave the --model options out"),
    ],
)
def test_impossible_options(stored, tmp_path, options, message):
    usual = {"dataset": DatasetConfig(stored), "folds": 2, "model": TIMED, "output_dir": tmp_path}
    with pytest.raises(ValueError, match=message):
        open_loop(EvalConfig("open_loop", **{**usual, **options}))
    assert not list(tmp_path.iterdir())


def test_command_line(stored, tmp_path, monkeypatch, capsys):
    def run(*options):
        monkeypatch.setattr(sys, "argv", ["eval.py", *options])
        importlib.import_module("eval").main()

    with pytest.raises(SystemExit, match=r"eval.py: .*none, which does not exist"):
        run("--mode=open_loop", f"--dataset.root={tmp_path}/none")
    with pytest.raises(SystemExit, match=r"needs a dataset: --dataset.root"):
        run("--mode=open_loop")
    with pytest.raises(SystemExit, match=r"not --dataset.root"):
        run(f"--dataset.root={stored}")
    run(
        "--mode=open_loop", f"--dataset.root={stored}", "--folds=2", "--features.tactile=null",
        "--horizon_s=0.2", f"--output_dir={tmp_path}",
    )  # fmt: skip
    assert "no touch in this dataset" in capsys.readouterr().out
    written = json.loads((tmp_path / "open_loop.json").read_text())
    assert (written["horizon_s"], written["touch"]) == (0.2, False)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="real recordings are not at hand")
def test_real_recordings_are_predicted_better_than_by_neighbours():
    """A third of the episodes, one fold, a horizon of 5 frames, settings chosen in the others."""
    data = load_episodes(RECORDINGS / "icub_grasp")
    data = replace(data, episodes=data.episodes[::3])
    part = fold_episodes(len(data), 5, np.random.default_rng(0))[0]
    found = predict_fold(data, part, 5, EvalConfig("open_loop"))
    span = np.ptp(np.concatenate([episode.state for episode in data]), axis=0)
    mine, theirs = (
        relative_errors(found.by[who], found.real, span)[0] for who in ("hasm", "neighbours")
    )
    assert mine < theirs < 1
