"""Open-loop prediction: known answers, no leak between folds, annealing, selection, the report."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hasm_torch.apps.training import DatasetConfig
from hasm_torch.body import Body
from hasm_torch.data import Episode, EpisodeSet, SkinPatch, load_episodes, write_episodes
from hasm_torch.encoders.place_code import PlaceCode
from hasm_torch.evaluation import open_loop as evaluation
from hasm_torch.evaluation.open_loop import (
    OpenLoopConfig,
    fold_episodes,
    open_loop,
    predict_fold,
    relative_errors,
)
from hasm_torch.prediction import JointPredictor, PredictionSettings, TouchRates, anneal, moments
from hasm_torch.prediction.annealing import perplexity
from hasm_torch.prediction.neighbours import NeighbourRegression, NeighbourSettings
from hasm_torch.prediction.own_codes import OwnCodes
from hasm_torch.prediction.predictor import int8_scores

RECORDINGS = Path(__file__).parents[2] / "shared" / "data"
FPS = 10.0


def swing(index: int, frames: int = 24, joints: int = 2, touched: bool = False) -> Episode:
    """A joint that moves to a goal with its own speed, one that follows, and noise of its own."""
    rng = np.random.default_rng(index)
    path = np.linspace(rng.uniform(0.0, 0.1), 1.0, frames) ** rng.uniform(1.0, 1.4)
    columns = [path, 50 * path**2, np.zeros(frames)][:joints]
    state = (np.stack(columns, axis=1) + 0.002 * rng.normal(size=(frames, joints))).astype(
        np.float32
    )
    if joints == 3:
        state[:, 2] = 0.5  # stands still
    tactile = np.abs(rng.normal(size=(frames, 4, 1))).astype(np.float32) if touched else None
    time = np.arange(frames, dtype=np.float32) / np.float32(FPS)
    return Episode(index, "swing", time, state, state, tactile)


def dataset(count: int = 9, touched: bool = False, joints: int = 2) -> EpisodeSet:
    skin = None
    if touched:
        skin = {
            "left": SkinPatch("left", slice(0, 2), channels=1),
            "right": SkinPatch("right", slice(2, 4), channels=1),
        }
    names = ("arm", "tool", "base")[:joints]
    return EpisodeSet(
        [swing(i, touched=touched, joints=joints) for i in range(count)],
        FPS, names, ("rad", "mm", "m")[:joints], skin, Path("made"), names,
    )  # fmt: skip


def body(joints: int = 2) -> Body:
    return Body(
        [f"j{i}" for i in range(joints)], [-0.2] * joints, [60.0] * joints, [1.0] * joints,
        ["sequence"], [1], [[0.0, 0.0, 1.0]], rate=FPS, channels=0,
    )  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(wanted=st.floats(1.5, 12.0), seed=st.integers(0, 99), scale=st.floats(1e-3, 1e3))
def test_annealed_weights_have_the_perplexity(wanted, seed, scale):
    scores = scale * torch.randn(3, 20, generator=torch.Generator().manual_seed(seed))
    lag = scores.amax(-1, keepdim=True) - scores
    assume((lag.kthvalue(2).values > 0.003 * lag.mean(-1)).all())  # no tie for the best
    weights = anneal(scores, wanted)
    torch.testing.assert_close(weights.sum(-1), torch.ones(3))
    torch.testing.assert_close(perplexity(weights), torch.full((3,), wanted), rtol=0.05, atol=0)
    assert (weights.argmax(-1) == scores.argmax(-1)).all()


def test_annealing_of_ties():
    """What cannot be told apart shares the weight, however few are wanted."""
    torch.testing.assert_close(anneal(torch.zeros(1, 8), 2.0), torch.full((1, 8), 1 / 8))
    weights = anneal(torch.tensor([[5.0, 5.0, 0.0, 0.0]]), 1.5)
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.5, 0.0, 0.0]]), atol=1e-3, rtol=0)


@pytest.mark.parametrize("code", ["binary", "gray", "thermometer"])
def test_own_codes_are_the_inner_products(code):
    coder = PlaceCode([0.0, -2.0], [1.0, 3.0], neurons=7, bits=4, width=2.0, code=code)
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(40, 2, generator=generator, dtype=torch.float64) * 5 - 2
    own = OwnCodes(coder)
    cells = own.cells(coder.levels(places).unflatten(-1, (2, 7)))
    codes = coder(places).float().unflatten(-1, (2, -1))
    for joint in range(2):
        got = own.products(cells[:, joint, None], cells[:, joint])
        torch.testing.assert_close(got.float(), codes[:, joint] @ codes[:, joint].mT)


def series_of(data: EpisodeSet):
    rates = TouchRates(body(len(data.joints)), data)
    return [rates(episode) for episode in data]


def test_a_memory_recalls_what_it_stored():
    """With one association in effect, a stored state is followed by its own successor."""
    learned = moments(series_of(dataset(3)), lag=1, horizon=2)
    chosen = PredictionSettings(emphasis=[2.0] * 2, perplexity=[1.0] * 2)
    predicted = JointPredictor(chosen, body(), learned)(learned)
    span = learned.state.amax(0) - learned.state.amin(0)
    assert (((predicted - learned.target) / span).abs() < 0.02).all()


def test_scores_of_the_int8_memory():
    """Shared scores equal the softmax memory's own inner products."""
    learned = moments(series_of(dataset(2)), lag=1, horizon=1)
    predictor = JointPredictor(PredictionSettings(), body(), learned)
    state, touch, _ = predictor.codes(learned)
    query = predictor.memory.associate(state, touch)
    scores = int8_scores(predictor.memory, query)
    torch.testing.assert_close(scores.float(), query @ predictor.memory.stored().float().mT)


def test_a_fixed_beta_is_the_memory_s_own_recall():
    """Without emphasis and corrections the prediction is d = S₋₁ softmax(β Mᵀ q)."""
    learned = moments(series_of(dataset(2)), lag=1, horizon=1)
    chosen = PredictionSettings(beta=0.1, shift=[1.0] * 2, shortlist=10**6)
    predictor = JointPredictor(chosen, body(), learned)
    state, touch, _ = predictor.codes(learned)
    predictor.memory.beta.fill_(0.1)
    torch.testing.assert_close(
        predictor(learned).float(), predictor.memory(state, touch)[:, :2], atol=1e-5, rtol=1e-4
    )


def test_shift_and_momentum():
    """Shift 0 recalls the position itself; the momentum adds the faster part."""
    learned = moments(series_of(dataset(3)), lag=1, horizon=1)
    asked = learned._replace(state=learned.state + 0.03, recent=learned.recent + 0.01)
    predicted = {}
    for shift, momentum in [(0.0, 0.0), (1.0, 0.0), (1.0, 2.0)]:
        chosen = PredictionSettings(
            context=0.0, perplexity=[4.0] * 2, shift=[shift] * 2, momentum=[momentum] * 2
        )
        predictor = JointPredictor(chosen, body(), learned)
        predicted[shift, momentum] = predictor(asked)
        recalled = predictor.decide(
            asked,
            predictor.match(asked),
            predictor.weights(predictor.match(asked), torch.zeros(2), torch.full((2,), 4.0)),
        )
    apart = predicted[1.0, 0.0] - predicted[0.0, 0.0]
    torch.testing.assert_close(apart, recalled.apart)
    torch.testing.assert_close(predicted[1.0, 2.0] - predicted[1.0, 0.0], 2 * recalled.faster)


def test_moments_stay_in_their_episode():
    found = moments(series_of(dataset(2)), lag=3, horizon=4)
    assert len(found.state) == 2 * (24 - 4)
    first = found.rows(found.episode == 1)
    whole = torch.from_numpy(dataset(2).episodes[1].state).double()
    torch.testing.assert_close(first.state + first.target, whole[4:])
    torch.testing.assert_close(first.recent[:3], whole[:3] - whole[0])
    torch.testing.assert_close(first.recent[3:], whole[3:20] - whole[:17])
    with pytest.raises(ValueError, match=r"horizon of 24 frames, the longest has 24"):
        moments(series_of(dataset(2)), lag=1, horizon=24)


def test_joints_that_stand_still_stay():
    learned = moments(series_of(dataset(4, joints=3)), lag=1, horizon=1)
    predictor = JointPredictor(PredictionSettings(), body(3), learned)
    assert predictor.moving.tolist() == [0, 1]
    assert (predictor(learned)[:, 2] == 0).all()
    still = learned._replace(state=torch.ones_like(learned.state))
    with pytest.raises(ValueError, match="no joint moves"):
        JointPredictor(PredictionSettings(), body(3), still)


def test_settings_need_an_entry_a_joint():
    learned = moments(series_of(dataset(2)), lag=1, horizon=1)
    with pytest.raises(ValueError, match="perplexity for each of 2 joints, got 3"):
        JointPredictor(PredictionSettings(perplexity=[1.0] * 3), body(), learned)


def test_neighbours_by_definition():
    learned = moments(series_of(dataset(3)), lag=2, horizon=2)
    asked = moments(series_of(dataset(5))[3:], lag=2, horizon=2)
    chosen = NeighbourSettings(context=0.5, shift=[1.0, 0.0], momentum=[0.0, 0.0])
    got = NeighbourRegression(chosen, learned)(asked).numpy()

    def features(m):
        scale = [x.numpy().std(axis=0) for x in (learned.state, learned.recent)]
        return np.concatenate([m.state.numpy() / scale[0], 0.5 * m.recent.numpy() / scale[1]], 1)

    known, query = features(learned), features(asked)
    for i in range(0, len(query), 7):
        rows = np.argsort(((known - query[i]) ** 2).sum(axis=1))[:5]
        moved = learned.target.numpy()[rows].mean(axis=0)
        placed = (learned.state + learned.target).numpy()[rows].mean(axis=0)
        np.testing.assert_allclose(got[i, 0], moved[0], atol=1e-5)
        np.testing.assert_allclose(got[i, 1], placed[1] - asked.state.numpy()[i, 1], atol=1e-4)


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
    """Changing the held-out episodes changes neither settings, nor limits, nor what others get.

    The future of a held-out episode (all but its first frames) is replaced by another: what was
    predicted from the first frames stays the same to the last bit.
    """
    data = dataset(8, touched)
    config = OpenLoopConfig()
    before = predict_fold(data, [2, 5], 3, config)
    changed = list(data.episodes)
    for i in (2, 5):
        other = changed[i].state.copy()
        other[10:] = 1e3 - other[10:]
        tactile = changed[i].tactile
        if tactile is not None:
            tactile = tactile.copy()
            tactile[10:] *= 100
        changed[i] = replace(changed[i], state=other, action=other, tactile=tactile)
    after = predict_fold(replace(data, episodes=changed), [2, 5], 3, config)
    assert after.settings == before.settings
    early = before.frame < 10
    assert early.any()
    assert torch.equal(after.hasm[early], before.hasm[early])
    assert torch.equal(after.knn[early], before.knn[early])
    assert not torch.equal(after.real, before.real)


def test_a_leak_would_be_seen():
    """The test above can fail: with its own episodes learned a fold is predicted better."""
    rng = np.random.default_rng(0)
    walks = []
    for i in range(6):
        state = rng.normal(size=(40, 2)).cumsum(axis=0).astype(np.float32)
        walks.append(replace(swing(i), time=np.arange(40) / FPS, state=state, action=state))
    data = replace(dataset(6), episodes=walks)
    honest = predict_fold(data, [0], 1, OpenLoopConfig())
    span = torch.ones(2)
    fair, _ = relative_errors(honest.hasm, honest.real, span)
    learned = moments(series_of(data), 1, 1)
    asked = moments(series_of(data)[:1], 1, 1)
    chosen = PredictionSettings(emphasis=[3.0] * 2, perplexity=[1.0] * 2)
    leaked, _ = relative_errors(JointPredictor(chosen, body(), learned)(asked), asked.target, span)
    assert fair is not None
    assert leaked is not None
    assert leaked < 0.3 < 0.8 < fair


def test_errors_by_definition():
    real = torch.tensor([[1.0, 0.0, 4.0], [-1.0, 0.0, 0.0]])
    predicted = torch.tensor([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    over_all, each = relative_errors(predicted, real, torch.tensor([1.0, 0.0, 2.0]))
    assert each == pytest.approx([np.sqrt(0.5), None, 0.5])
    assert over_all == pytest.approx(np.sqrt((0.5 + 2 / 4) / (1.0 + 8 / 4)))
    assert relative_errors(real, real, torch.ones(3))[0] == 0.0
    assert relative_errors(0 * real, real, torch.ones(3))[0] == 1.0


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("stored") / "swing"
    data = dataset(7, touched=True)
    write_episodes(
        root, data, joints=data.joints, units=data.units, skin=data.skin, fps=round(FPS),
        robot_type="made",
    )  # fmt: skip
    return root


def test_open_loop_writes_figures_and_says_what_it_did(stored, tmp_path, capsys):
    config = OpenLoopConfig(DatasetConfig(stored), folds=3, horizon_s=0.4, output_dir=tmp_path)
    report = open_loop(config)
    written = json.loads((tmp_path / "open_loop.json").read_text())
    assert written == report
    assert (written["horizon_s"], written["still"]) == (0.4, 1.0)
    assert sorted(i for part in written["folds"] for i in part) == list(range(7))
    assert set(written["per_joint"]) == {"arm", "tool"}
    for part in (written, written["one_step"]):
        assert 0 < part["hasm"] < 1
        assert 0 < part["knn"] < 1
        assert set(part["per_joint"]["arm"]) == {"hasm", "knn"}
    assert len(written["horizon"]["settings"]) == 3
    assert written["horizon"]["frames"] == 7 * (24 - 4)
    assert (tmp_path / "open_loop.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "the range of the data" in printed
    assert "4 cells x pressure" in printed
    assert "arm" in printed


def test_the_paper_as_written_can_be_evaluated(stored, tmp_path):
    config = OpenLoopConfig(
        DatasetConfig(stored), method="literal", folds=2, horizon_s=0.3, output_dir=tmp_path
    )
    chosen = open_loop(config)["horizon"]["settings"][0]["hasm"]
    assert (chosen["bits"], chosen["code"], chosen["beta"]) == (4, "binary", 2.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon_s": 0.0}, "horizon_s must be above 0"),
        ({"folds": 8}, "at most the number of episodes"),
        ({"horizon_s": 9.0}, "choose a shorter horizon"),
        ({"dataset": DatasetConfig()}, "needs a dataset: --dataset.root"),
    ],
)
def test_impossible_options(stored, tmp_path, options, message):
    config = OpenLoopConfig(**{"dataset": DatasetConfig(stored), "output_dir": tmp_path, **options})
    with pytest.raises(ValueError, match=message):
        open_loop(config)
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
        "--mode=open_loop", f"--dataset.root={stored}", "--folds=2", "--features.tactile=none",
        "--horizon_s=0.2", f"--output_dir={tmp_path}", "--method=literal",
    )  # fmt: skip
    assert "no touch in this dataset" in capsys.readouterr().out
    assert json.loads((tmp_path / "open_loop.json").read_text())["horizon_s"] == 0.2


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="real recordings are not at hand")
@pytest.mark.parametrize("name", ["icub_grasp"])
def test_real_recordings_beat_the_neighbours(name):
    """One fold, a horizon of 5 frames, settings chosen in the other episodes."""
    data = load_episodes(RECORDINGS / name)
    part = evaluation.fold_episodes(len(data), 5, np.random.default_rng(0))[0]
    found = predict_fold(data, part, 5, OpenLoopConfig())
    states = np.concatenate([episode.state for episode in data])
    span = torch.from_numpy(np.ptp(states, axis=0)).double()
    (mine, _), (theirs, _) = (relative_errors(p, found.real, span) for p in (found.hasm, found.knn))
    assert mine is not None
    assert theirs is not None
    assert mine <= theirs < 1
