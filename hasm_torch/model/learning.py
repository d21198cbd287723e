"""Learning episodes: from recordings to what every patch felt and how the joints moved."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn

from hasm_torch.config import SHARED
from hasm_torch.encoders.readings import forces_of
from hasm_torch.encoders.skin_filter import Footprint
from hasm_torch.encoders.touch import pair_with_spikes, spike_density
from hasm_torch.model.storing import Chain, FitReport, store

if TYPE_CHECKING:
    from hasm_torch.model.hasm import HASM

# A joint that moves less than this share of its range under a patch is not moved by it.
MOVED_SHARE = 0.02

# The reference waits for a joint that lags this many times more than it ever did in the episodes.
LAG_FACTOR = 2.0


class Recording(Protocol):
    """One episode: time (T,) s; state, action (T, J) rad or m; tactile (T, cells, 3) N."""

    time: Any
    state: Any
    action: Any
    tactile: Any


@torch.no_grad()
def learn(model: "HASM", episodes: Iterable[Recording]) -> FitReport:
    """Store episodes in the model's memories, in place of what these held.

    Args:
        model: The model; its config says how.
        episodes: Recordings of the model's body.

    Returns:
        What was stored.

    Raises:
        ValueError: If there is no episode, no touch, or a value is not finite; the model is
            then as it was.
    """
    chains: dict[str, list[Chain]] = {patch: [] for patch in model.body.patches}
    lag = torch.zeros_like(model.lower)
    footprint = Footprint(model.body.cells)
    count = 0
    for count, episode in enumerate(episodes, start=1):
        state, action = _positions(model, episode, count - 1)
        lag = torch.maximum(lag, (action - state).abs().amax(0))
        for patch, chain in _touches(model, episode, state, action, footprint).items():
            chains[patch].append(chain)
    if count == 0:
        raise ValueError("no episode to learn from: expected at least one")
    chains = {patch: found for patch, found in chains.items() if found}
    if not chains:
        raise ValueError(
            f"none of the {count} episodes holds a touch that makes a neuron spike; "
            "check the tactile feature's unit (N) and current_per_newton"
        )
    report = FitReport(count, {}, {}, {}, {})
    held = model.memories, model.shapes
    model.memories, model.shapes = nn.ModuleDict(), {}
    try:
        moved = {patch: _moved_joints(model, found) for patch, found in chains.items()}
        chains = {patch: found for patch, found in chains.items() if moved[patch]}
        if model.config.memories == "shared" and chains:
            store(model, SHARED, chains, moved, report)
        elif model.config.memories == "patch":
            for patch, found in chains.items():
                store(model, patch, {patch: found}, {patch: moved[patch]}, report)
        if not report.associations:
            raise ValueError(
                f"no joint moves under touch in any of the {count} episodes: expected one to "
                f"travel more than {MOVED_SHARE:.0%} of its range"
            )
    except BaseException:
        model.memories, model.shapes = held
        raise
    span = model.upper - model.lower
    model.tolerance.copy_(LAG_FACTOR * lag + 0.02 * span)
    model.footprint.copy_(footprint.shares())
    return report


def _positions(model: "HASM", episode: Recording, index: int) -> tuple[Tensor, Tensor]:
    series = []
    for name in ("state", "action"):
        values = torch.as_tensor(getattr(episode, name), dtype=torch.float32)
        if values.ndim != 2 or values.shape[1] != len(model.body.joints):
            raise ValueError(
                f"episode {index}: expected {name} (T, {len(model.body.joints)}), "
                f"got {tuple(values.shape)}"
            )
        if not torch.isfinite(values).all():
            raise ValueError(f"episode {index}: {name} holds NaN or infinity")
        series.append(torch.clamp(values, model.lower, model.upper))
    if len(series[0]) == 0 or len(series[0]) != len(series[1]):
        raise ValueError(
            f"episode {index}: expected as many states as actions and at least one, got "
            f"{len(series[0])} and {len(series[1])}"
        )
    return series[0], series[1]


def _touches(
    model: "HASM", episode: Recording, state: Tensor, action: Tensor, footprint: Footprint
) -> dict[str, Chain]:
    """The chain of every patch that spiked in an episode, whose touches the footprint takes in."""
    config, body = model.config, model.body
    if episode.tactile is None and body.channels:
        raise ValueError("an episode has no tactile series, so there is no touch to learn from")
    tactile = None if episode.tactile is None else torch.as_tensor(episode.tactile).float()
    skin = forces_of(body, tactile, (len(state),))
    if len(skin) != len(state) or len(episode.time) != len(state):
        raise ValueError(
            f"expected time and tactile of {len(state)} samples like the state, got "
            f"{len(episode.time)} and {len(skin)}"
        )
    time = torch.as_tensor(episode.time, dtype=torch.float64)
    if not (torch.isfinite(skin).all() and torch.isfinite(time).all()):
        raise ValueError("the time or tactile series holds NaN or infinity")
    if body.channels:
        footprint.add(skin)
    counts, density = spike_series(model, skin)
    positions = action if config.pattern == "action" else state
    chains = {}
    for index, patch in enumerate(body.patches):
        spiked = time[counts[:, index] > 0]
        if len(spiked):
            kept = pair_with_spikes(time, spiked, config.pair_window_s) >= 0
            chains[patch] = Chain(
                positions[kept], density[kept, index], counts[:, index].cumsum(0)[kept]
            )
    return chains


def spike_series(model: "HASM", skin: Tensor) -> tuple[Tensor, Tensor]:
    """What the patches of a whole episode felt.

    Args:
        model: Encodes the skin.
        skin: (T, cells, 3), N.

    Returns:
        Spikes in each sample period and rate density ρ, both (T, patches).
    """
    config, rate = model.config, model.body.rate
    felt, _ = model.clean(skin)
    counts, _, _ = model.skin(felt)
    window = max(1, round(config.rate_window_s * rate))
    total = torch.nn.functional.pad(counts.cumsum(0), (0, 0, window, 0))
    windowed = (total[window:] - total[:-window]) * (rate / window)
    return counts, spike_density(windowed, config.max_rate)


def _moved_joints(model: "HASM", chains: Sequence[Chain]) -> list[int]:
    if model.config.code_joints == "all":
        return list(range(len(model.body.joints)))
    travel = torch.stack([c.positions.amax(0) - c.positions.amin(0) for c in chains]).amax(0)
    moved = travel > MOVED_SHARE * (model.upper - model.lower)
    return torch.nonzero(moved).flatten().tolist()
