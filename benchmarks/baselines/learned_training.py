"""Windows of episodes, which of them are held out, and training until those stop improving."""

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.baselines.demonstrations import Series

HELD_OUT_OF = 5  # one of so many episodes of a task, or blocks of an episode, is held out
# With fewer episodes of a task, blocks are held out: each of three has a force of its own, and
# without one of the three forces the rest teach too little between them.
FEWEST = 4
BLOCK_S = 1.0
JUDGED = 512  # held-out windows that an evaluation looks at, spread over all
IMPROVEMENT = 1e-3  # share by which the held-out loss must fall to count as falling
WARM_UP, LAST_RATE = 50, 0.01  # updates to the full learning rate; share of it that is left
CLIP_NORM = 10.0

# LeRobot's keys.
STATE, ENVIRONMENT = "observation.state", "observation.environment_state"
ACTION, PADDED = "action", "action_is_pad"


@dataclass(frozen=True)
class Training:
    """How a network is trained: by AdamW, its rate half a cosine over the seconds or steps.

    Attributes:
        seconds: Longest training, s of processor time, so that other load does not shorten it.
        steps: Most updates; where they and not the seconds end it, it is the same everywhere.
        patience: Evaluations without improvement after which training stops.
        every: Updates between evaluations.
        batch: Windows an update.
        learning_rate: The highest.
        average: Share of the averaged weights, which are what is kept, that outlives an update.
        seed: Seed of weights, batches and noise.
    """

    seconds: float = 150.0
    steps: int = 100_000
    patience: int = 12
    every: int = 100
    batch: int = 64
    learning_rate: float = 1e-3
    average: float = 0.99
    seed: int = 0

    def __post_init__(self) -> None:
        counts = (self.steps, self.patience, self.every, self.batch)
        if not self.seconds > 0 or min(counts) < 1 or not 0 <= self.average < 1:
            raise ValueError(
                "expected seconds above 0, at least 1 step, evaluation, update between them and "
                f"window a batch, and an average of 0 to 1, got {self}"
            )


class Span(NamedTuple):
    """Samples t + first to t + last around the current sample t of a window."""

    first: int
    last: int


class Windows(NamedTuple):
    """What a network sees and should do, one row a window.

    Attributes:
        state: (N, observed, joints) measured positions, shares.
        touch: (N, observed, patches + 3) forces, N.
        seen: (N, observed, O) further observations.
        action: (N, horizon, joints) commanded positions, shares.
        before: (N, horizon, joints) the commands one sample earlier, the same.
        padded: (N, horizon) true behind the end of the episode, where the last command stays.
    """

    state: Tensor
    touch: Tensor
    seen: Tensor
    action: Tensor
    before: Tensor
    padded: Tensor


def windows_of(series: Series, starts: Tensor, observed: int, span: Span) -> Windows:
    """The windows of one episode.

    Args:
        series: The episode.
        starts: (N,) current sample of each window.
        observed: Observations up to the current one.
        span: Samples of the actions.
    """
    end = len(series.action) - 1
    seen = (starts[:, None] + torch.arange(1 - observed, 1)).clamp(min=0)
    wanted = starts[:, None] + torch.arange(span.first, span.last + 1)
    done, earlier = wanted.clamp(0, end), (wanted - 1).clamp(0, end)
    return Windows(
        series.state[seen],
        series.touch[seen],
        series.seen[seen],
        series.action[done],
        series.action[earlier],
        wanted > end,
    )


def split(episodes: Sequence[Series], span: Span, rate: float) -> list[tuple[Tensor, Tensor]]:
    """Current samples of the trained and of the held-out windows of each episode.

    A task with four or more episodes holds out the middle one of every five. With fewer, each
    episode holds out the middle of every five blocks of a second; no trained window reaches into
    such a block, and no held-out one out of it.

    Args:
        episodes: The episodes.
        span: Samples that a window reaches, its observations included.
        rate: Sampling rate, Hz.
    """
    tasks = [series.task for series in episodes]
    parts = []
    for i, series in enumerate(episodes):
        every = torch.arange(len(series.action))
        of, number = tasks.count(series.task), tasks[:i].count(series.task)
        if of < FEWEST:
            parts.append(_blocks(len(series.action), span, rate))
        elif number % HELD_OUT_OF == min(HELD_OUT_OF, of) // 2:
            parts.append((every[:0], every))
        else:
            parts.append((every, every[:0]))
    return parts


def _blocks(length: int, span: Span, rate: float) -> tuple[Tensor, Tensor]:
    block = max(round(BLOCK_S * rate), span.last - span.first + 1)
    held = (torch.arange(length) // block) % HELD_OUT_OF == HELD_OUT_OF // 2
    reach = torch.arange(length)[:, None] + torch.arange(span.first, span.last + 1)
    inside = held[reach.clamp(0, length - 1)]
    return torch.nonzero(~inside.any(1))[:, 0], torch.nonzero(inside.all(1))[:, 0]


def gather(
    episodes: Sequence[Series], observed: int, span: Span, rate: float
) -> tuple[Windows, Windows]:
    """Trained and held-out windows of all episodes; see ``split`` and ``windows_of``.

    Raises:
        ValueError: If the episodes are too short to hold any window out.
    """
    # An increment needs the command before the first action.
    whole = Span(min(1 - observed, span.first - 1), span.last)
    sides: tuple[list[Windows], list[Windows]] = ([], [])
    for series, parts in zip(episodes, split(episodes, whole, rate)):
        for side, starts in zip(sides, parts):
            side.append(windows_of(series, starts, observed, span))
    trained, held = (Windows(*(torch.cat(column) for column in zip(*side))) for side in sides)
    if not len(trained.state) or not len(held.state):
        raise ValueError(
            f"expected windows to train on and to hold out, got {len(trained.state)} and "
            f"{len(held.state)}; give episodes of {HELD_OUT_OF * BLOCK_S:g} s or four a task"
        )
    return trained, held


def fit(
    network: nn.Module,
    trained: dict[str, Tensor],
    held: dict[str, Tensor],
    training: Training,
    state_noise: Tensor,
) -> dict[str, Any]:
    """Train a LeRobot policy; the averaged weights that did best on what is held out are kept.

    Draws from torch's global generator, as the policy's own loss does.

    Args:
        network: Called with a batch, gives its loss first.
        trained: What it learns, by LeRobot's keys, (N, ...) each.
        held: What it is judged on, the same.
        training: How.
        state_noise: (joints,) standard deviation of what is added to the states of each window
            that it learns, in the network's units.

    Returns:
        ``steps``, ``best_step``, ``held_out_loss`` (the best), ``held_out_curve`` (pairs of step
        and loss) and ``stopped`` ("patience", "seconds" or "steps").
    """
    begin = time.process_time()
    optimiser = torch.optim.AdamW(network.parameters(), lr=training.learning_rate)
    averaged = copy.deepcopy(network)
    loss = _held_out(averaged, held)
    best, weights, curve = (loss, 0), copy.deepcopy(averaged.state_dict()), [(0, loss)]
    size, step, waited, level, stopped = len(trained[ACTION]), 0, 0, loss, ""
    while not stopped:
        network.train()
        for _ in range(training.every):
            spent = (time.process_time() - begin) / training.seconds
            rate = _rate(step, max(step / training.steps, spent))
            for group in optimiser.param_groups:
                group["lr"] = rate * training.learning_rate
            rows = torch.randint(size, (training.batch,))
            batch = {key: value[rows] for key, value in trained.items()}
            _update(network, optimiser, _noisy(batch, state_noise))
            step += 1
            _average(averaged, network, min(training.average, step / (step + 10)))
            if step == training.steps or spent > 1:
                stopped = "steps" if step == training.steps else "seconds"
                break
        loss = _held_out(averaged, held)
        curve.append((step, loss))
        if loss < best[0]:
            best, weights = (loss, step), copy.deepcopy(averaged.state_dict())
        waited, level = (0, loss) if loss < (1 - IMPROVEMENT) * level else (waited + 1, level)
        if waited == training.patience:
            stopped = stopped or "patience"
    network.load_state_dict(weights)
    network.eval()
    return {
        "steps": step,
        "best_step": best[1],
        "held_out_loss": best[0],
        "held_out_curve": curve,
        "stopped": stopped,
    }


def _rate(step: int, done: float) -> float:
    """Share of the learning rate: a warm-up, then half a cosine."""
    cosine = (1 + math.cos(math.pi * min(done, 1.0))) / 2
    return min(1.0, (step + 1) / WARM_UP) * (LAST_RATE + (1 - LAST_RATE) * cosine)


def _noisy(batch: dict[str, Tensor], deviation: Tensor) -> dict[str, Tensor]:
    """The batch with other states; the observations of a window are moved together."""
    state = batch[STATE]
    noise = deviation * torch.randn(state[:, 0].shape if state.ndim == 3 else state.shape)
    return {**batch, STATE: state + (noise[:, None] if state.ndim == 3 else noise)}


def _update(network: nn.Module, optimiser: torch.optim.Optimizer, batch: dict[str, Tensor]) -> None:
    loss = network(batch)[0]
    optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
    optimiser.step()


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, keep: float) -> None:
    for mine, new in zip(averaged.parameters(), network.parameters()):
        mine.lerp_(new, 1 - keep)


@torch.no_grad()
def _held_out(network: nn.Module, held: dict[str, Tensor]) -> float:
    """Mean loss, with the same noise at every evaluation."""
    network.eval()
    size = len(held[ACTION])
    rows = torch.linspace(0, size - 1, min(size, JUDGED)).long()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        loss = float(network({key: value[rows] for key, value in held.items()})[0])
    return loss if math.isfinite(loss) else math.inf
