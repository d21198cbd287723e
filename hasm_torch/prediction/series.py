"""Recordings as the prediction sees them: states, recent displacements, rate densities, targets."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.encoders.readings import as_forces
from hasm_torch.encoders.skin import SkinEncoder, spike_step

# The strongest touch of a recording drives its neuron with this current, which makes it fire at
# MAX_RATE; the resting level of the cells drives no current.
STRONGEST_CURRENT = 40.0
MAX_RATE = 800.0
RESTING_SHARE, STRONGEST_SHARE = 0.1, 0.99
RATE_WINDOW_S = 0.2
SPIKE_DT_MS = 0.1


class Recording(Protocol):
    """One episode: state (T, J) and tactile (T, cells, readings) or None."""

    state: Any
    tactile: Any


class Series(NamedTuple):
    """One episode.

    Attributes:
        state: (T, J) float64 joint positions.
        touch: (T, P) rate density ρ of every patch, 0 to 1; P is 0 without skin.
        cells: (T, C) sum of the absolute readings of every cell; C is 0 without skin.
    """

    state: Tensor
    touch: Tensor
    cells: Tensor


class Moments(NamedTuple):
    """Frames that have a successor, K of them.

    Attributes:
        state: (K, J) joint positions.
        recent: (K, J) displacement since ``lag`` frames ago, or since the episode's start.
        touch: (K, P) rate densities.
        cells: (K, C) readings of the cells.
        target: (K, J) displacement to the successor.
        episode: (K,) number of the episode in the sequence given.
        frame: (K,) number of the frame in its episode.
    """

    state: Tensor
    recent: Tensor
    touch: Tensor
    cells: Tensor
    target: Tensor
    episode: Tensor
    frame: Tensor

    def rows(self, index: Tensor) -> "Moments":
        """Some of the moments."""
        return Moments(*(column[index] for column in self))


class TouchRates:
    """From skin readings of any unit to the rate density of every patch.

    Thresholds and gains come from the episodes that it is made from: the resting level of the
    cells is below the threshold τ, and the strongest touch saturates the neuron. With readings in
    newton, counts of a sensor or anything else, ρ then runs from 0 to 1.

    Args:
        body: Skin of the robot.
        episodes: Episodes that are learned from.
    """

    def __init__(self, body: Body, episodes: Iterable[Recording]) -> None:
        self.encoder: SkinEncoder | None = None
        if not body.channels:
            return
        threshold, gain = calibrate(body, episodes)
        step = spike_step(body.rate, SPIKE_DT_MS)
        self.encoder = SkinEncoder(body.cells, body.rate, threshold, 1, gain, step)
        self.window = max(1, round(RATE_WINDOW_S * body.rate))

    def __call__(self, episode: Recording) -> Series:
        """One episode as a series; a tactile series is left aside where the body has no skin."""
        state = torch.as_tensor(np.asarray(episode.state, dtype=np.float64))
        if self.encoder is None:
            nothing = state.new_zeros(len(state), 0)
            return Series(state, nothing, nothing)
        skin = _forces(episode)
        counts, _, _ = self.encoder(skin)
        total = torch.nn.functional.pad(counts.cumsum(0), (0, 0, self.window, 0))
        rate = (total[self.window :] - total[: -self.window]) * (self.encoder.rate / self.window)
        return Series(state, torch.clamp(rate / MAX_RATE, 0.0, 1.0), skin.abs().sum(-1))


def calibrate(body: Body, episodes: Iterable[Recording]) -> tuple[float, float]:
    """Threshold τ and current a unit of effective force that make use of a skin's whole range.

    Args:
        body: Its patches and cells.
        episodes: Recordings with touch.

    Returns:
        The resting level of a cell, in the unit of the readings, and the current that lets the
        strongest touch of a patch fire its neuron at ``MAX_RATE``.
    """
    readings = np.concatenate([_forces(e).abs().sum(-1).numpy() for e in episodes])
    threshold = float(np.quantile(readings, RESTING_SHARE))
    excess = np.clip(readings - threshold, 0.0, None)
    edges = np.cumsum([0, *body.cells])[:-1]
    strongest = float(np.quantile(np.add.reduceat(excess, edges, axis=1), STRONGEST_SHARE))
    return threshold, STRONGEST_CURRENT / strongest if strongest > 0 else 1.0


def _forces(episode: Recording) -> Tensor:
    return as_forces(torch.as_tensor(np.asarray(episode.tactile, dtype=np.float32)))


def moments(series: Sequence[Series], lag: int, horizon: int) -> Moments:
    """The frames that have a successor in their own episode.

    Args:
        series: Episodes.
        lag: Frames back to which the recent displacement reaches, at least 1.
        horizon: Frames ahead of the successor, at least 1.

    Raises:
        ValueError: If no episode is longer than the horizon.
    """
    parts = []
    for number, episode in enumerate(series):
        count = len(episode.state) - horizon
        if count < 1:
            continue
        frame = torch.arange(count)
        now = episode.state[:count]
        parts.append(
            Moments(
                now,
                now - episode.state[(frame - lag).clamp(min=0)],
                episode.touch[:count],
                episode.cells[:count],
                episode.state[horizon:] - now,
                torch.full((count,), number),
                frame,
            )
        )
    if not parts:
        longest = max((len(episode.state) for episode in series), default=0)
        raise ValueError(
            f"no episode is longer than the horizon of {horizon} frames, the longest has "
            f"{longest}: choose a shorter horizon"
        )
    return Moments(*(torch.cat(columns) for columns in zip(*parts)))


def thin(found: Moments, most: int) -> Moments:
    """At most so many moments, evenly spread."""
    if len(found.state) <= most:
        return found
    return found.rows(torch.linspace(0, len(found.state) - 1, most).round().long())
