"""The neural baselines learn, hold out what they say, keep the limits and repeat themselves."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from toys import limits, make_body, press

from benchmarks.baselines.demonstrations import Sensed, Series, Units
from benchmarks.baselines.learned import ACT, DIFFUSION, ChunkPolicy, Kind, Scaling
from benchmarks.baselines.learned_training import Span, Training, gather, split
from hasm_torch.body import Body
from hasm_torch.episode import Episode

SPAN = Span(-2, 15)
SHORT = Training(seconds=60.0, steps=24, every=12, batch=16, learning_rate=4e-3, average=0.5)
KINDS = [pytest.param(ACT, id="act"), pytest.param(DIFFUSION, id="diffusion")]


@pytest.fixture(autouse=True)
def _needs_diffusers(request: pytest.FixtureRequest) -> None:
    if "diffusion" in request.node.name:
        pytest.importorskip("diffusers", reason="LeRobot's Diffusion Policy needs diffusers")


def episodes(body: Body, forces=(6.0, 12.0, 9.0), rest: int = 10) -> list[Episode]:
    """Touch on the front moves the first joint up, on the side down, faster with more force."""
    made = []
    for patch, sign in (("front", 1), ("side", -1)):
        for force in forces:
            steps = int(1.2 / (force * 0.001))
            action = np.zeros((steps + 2 * rest, 3), np.float32)
            action[:, 0] = sign * np.interp(
                np.arange(len(action)), [rest, rest + steps], [-0.6, 0.6]
            )
            skin = np.zeros((len(action), sum(body.cells), 3), np.float32)
            skin[rest : rest + steps] = press(body, patch, force).numpy()
            time = np.arange(len(action)) / 50
            made.append(Episode(len(made), patch, time, action, action, skin))
    return made


@cache
def trained(kind: Kind, experiment: str) -> ChunkPolicy:
    """A policy of each kind, trained once."""
    body = make_body()
    return ChunkPolicy(kind, experiment, body, episodes(body), SHORT)


def plain(task: str, samples: int) -> Series:
    return Series(task, *[torch.zeros(samples, 1)] * 4)


@pytest.mark.parametrize("kind", KINDS)
def test_training_lowers_the_held_out_loss(kind):
    policy = trained(kind, "compliance")
    notes = policy.notes
    losses = [loss for _, loss in notes["held_out_curve"]]
    assert notes["stopped"] == "steps"
    assert notes["steps"] == SHORT.steps
    assert notes["held_out_loss"] == min(losses) < 0.8 * losses[0]
    assert notes["parameters"] > 500_000
    assert policy.memory_bytes() == 4 * notes["parameters"]


def test_training_stops_when_the_held_out_loss_does_not_fall():
    body = make_body()
    still = replace(SHORT, learning_rate=1e-9, every=2, patience=2, steps=1000)
    notes = ChunkPolicy(ACT, "compliance", body, episodes(body), still).notes
    assert notes["stopped"] == "patience"
    assert notes["steps"] < 20


@pytest.mark.parametrize(("number", "held"), [(4, [2]), (6, [2]), (10, [2, 7])])
def test_a_task_with_several_episodes_holds_out_whole_ones(number, held):
    parts = split([plain("a", 60)] * number + [plain("b", 300)], SPAN, rate=50.0)
    assert [i for i, (_, out) in enumerate(parts[:number]) if len(out)] == held
    assert all(len(learned) + len(out) == 60 for learned, out in parts[:number])


@pytest.mark.parametrize("number", [1, 3])
def test_few_episodes_hold_out_blocks_that_no_trained_window_reaches(number):
    parts = split([plain("a", 600)] * number, SPAN, rate=50.0)
    assert len(parts) == number
    learned, out = parts[-1]
    offsets = torch.arange(SPAN.first, SPAN.last + 1)
    samples = [set((starts[:, None] + offsets).flatten().tolist()) for starts in (learned, out)]
    assert not samples[0] & samples[1]
    assert samples[1] == {*range(100, 150), *range(350, 400)}
    assert len(learned) > 0.6 * 600


def test_episodes_too_short_to_hold_out_are_refused():
    with pytest.raises(ValueError, match="four a task"):
        gather([plain("a", 60)], 1, SPAN, rate=50.0)


@pytest.mark.parametrize("mode", ["absolute", "increment"])
def test_predictions_return_to_the_commands_of_the_episodes(mode):
    body = make_body()
    series = [Units(body).series(episode) for episode in episodes(body)]
    windows, _ = gather(series, 1, Span(0, 19), body.rate)
    scaling = Scaling(windows, mode)
    action = scaling.batch(windows)["action"]
    assert float(action.abs().max()) == pytest.approx(1.0, abs=1e-5)
    value = scaling.value(action)
    if mode == "increment":
        value = windows.before[:, :1] + value.cumsum(1)
    torch.testing.assert_close(value[..., 0], windows.action[..., 0], atol=1e-5, rtol=0)


def test_what_never_changes_is_not_seen():
    body = make_body()
    series = [Units(body).series(episode) for episode in episodes(body)]
    windows, _ = gather(series, 1, Span(0, 19), body.rate)
    scaling = Scaling(windows, "increment")
    state, touch = torch.rand(5, 3), 10 * torch.rand(5, 6)
    seen = scaling.observation(Sensed(state, touch, torch.zeros(5, 0)))
    assert not seen["observation.state"][:, 1:].any()
    assert not seen["observation.environment_state"][:, 2].any(), "nobody touches the back"
    assert seen["observation.state"][:, 0].all()
    assert seen["observation.environment_state"][:, :2].all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("experiment", ["compliance", "grasp"])
def test_targets_keep_the_limits_and_what_no_episode_moves(kind, experiment):
    body = make_body()
    policy = trained(kind, experiment)
    lower, upper = limits(body)
    for edge in (lower, upper):
        policy.reset()
        state = torch.tensor(edge, dtype=torch.float32)
        for _ in range(20):
            target = policy.step(state, press(body, "front", 14.0).flatten())
            assert target.shape == (3,)
            assert (target.numpy() >= lower - 1e-6).all()
            assert (target.numpy() <= upper + 1e-6).all()
            way = (target - state).abs().numpy() * body.rate
            assert (way <= np.array(body.max_speed) + 1e-3).all()
            np.testing.assert_allclose(target[1:], state[1:], atol=1e-6)
            state = target


@pytest.mark.parametrize("kind", KINDS)
def test_reset_forgets_the_chunk(kind):
    body = make_body()
    policy = trained(kind, "grasp")
    skin = press(body, "front", 6.0)

    def rollout(steps: int) -> torch.Tensor:
        policy.reset()
        return torch.stack([policy.step(torch.zeros(3), skin) for _ in range(steps)])

    whole = rollout(15)
    for before in (3, 12):
        policy.step(torch.full((3,), 0.5), press(body, "side", 9.0))
        rollout(before)
        torch.testing.assert_close(rollout(15), whole, atol=0, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_decides_everything(kind):
    body = make_body()
    few, skin = episodes(body, forces=(12.0, 12.0, 12.0)), press(body, "side", 6.0)
    runs = []
    for seed in (0, 0, 1):
        torch.manual_seed(100 + len(runs))
        training = replace(SHORT, steps=4, every=2, seed=seed)
        policy = ChunkPolicy(kind, "grasp", body, few, training)
        losses = [loss for _, loss in policy.notes["held_out_curve"]]
        targets = torch.stack([policy.step(torch.zeros(3), skin)[0] for _ in range(12)])
        runs.append(np.concatenate([losses, targets.numpy()]))
    # Sums over memory that lies elsewhere may round otherwise.
    np.testing.assert_allclose(runs[0], runs[1], rtol=1e-4, atol=1e-5)
    assert np.abs(runs[0] - runs[2]).max() > 1e-2


def test_training_leaves_the_global_generator_alone():
    body = make_body()
    before = torch.random.get_rng_state()
    ChunkPolicy(ACT, "compliance", body, episodes(body), replace(SHORT, steps=2))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_unknown_experiments_are_named():
    body = make_body()
    with pytest.raises(ValueError, match="valid: compliance, yield, grasp"):
        ChunkPolicy(ACT, "juggling", body, episodes(body), SHORT)
