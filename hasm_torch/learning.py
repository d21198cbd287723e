"""Storing episodes: from recordings to the associations of every patch."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from hasm_torch.config import MemoryShape
from hasm_torch.readings import forces_of
from hasm_torch.successors import distinct_links, shifted_links
from hasm_torch.touch import pair_with_spikes, spike_density

if TYPE_CHECKING:
    from hasm_torch.hasm import HASM

# A joint that moves less than this share of its range under a patch is not moved by it.
MOVED_SHARE = 0.02

# Rate densities nearer to each other than this are one touch level.
LEVEL_GAP = 0.06

# The reference waits for a joint that lags this many times more than it ever did in the episodes.
LAG_FACTOR = 2.0

# A recalled successor that is off by more than this share of the joint range is worth a warning.
RECALL_ERROR = 1e-3

# Recalled successors that ``fit`` checks in each memory, evenly spread over it.
CHECKED_RECALLS = 4096


class Recording(Protocol):
    """One episode: time (T,) s; state, action (T, J) rad or m; tactile (T, cells, 3) N."""

    time: Any
    state: Any
    action: Any
    tactile: Any


class Chain(NamedTuple):
    """The samples of one episode during which one patch was touched.

    Attributes:
        positions: (T, joints) joint positions that are memorised, rad or m.
        density: (T,) rate density ρ.
        spikes: (T,) spikes of the patch up to and with each sample.
    """

    positions: Tensor
    density: Tensor
    spikes: Tensor


@dataclass
class FitReport:
    """What ``fit`` stored.

    Attributes:
        episodes: Episodes read.
        associations: Associations held, by patch.
        joints: Names of the joints that each patch moves.
        betas: Inverse temperature of each patch's memory.
        recall_errors: Largest error of a recalled successor at its own association (of at most
            4,096 in each memory), as a share of the joint range, by patch. Where it is small,
            recall visits every stored state.
    """

    episodes: int
    associations: dict[str, int]
    joints: dict[str, list[str]]
    betas: dict[str, float]
    recall_errors: dict[str, float]


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
    count = 0
    for count, episode in enumerate(episodes, start=1):
        state, action = _positions(model, episode, count - 1)
        lag = torch.maximum(lag, (action - state).abs().amax(0))
        for patch, chain in _touches(model, episode, state, action).items():
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
        for patch, found in chains.items():
            joints = _moved_joints(model, found)
            if joints:
                _store(model, patch, joints, found, report)
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


def _touches(model: "HASM", episode: Recording, state: Tensor, action: Tensor) -> dict[str, Chain]:
    """The chain of every patch that spiked in an episode."""
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
    counts, _, _ = model.skin(skin)
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


def _store(
    model: "HASM", patch: str, joints: list[int], chains: list[Chain], report: FitReport
) -> None:
    """Build and fill the memory of one patch."""
    config, body = model.config, model.body
    everything = torch.cat([chain.positions for chain in chains])
    positions = everything[:, joints]
    episodes = torch.cat([torch.full((len(c.spikes),), i) for i, c in enumerate(chains)])
    span = (model.upper - model.lower)[joints]
    if config.touch_levels == "nearest":
        levels, level_of = _touch_levels(torch.stack([c.density.median() for c in chains]))
        density = levels[level_of[episodes]]
    else:
        levels = torch.zeros(0)
        density = torch.cat([chain.density for chain in chains])
    probe = model.add_memory(patch, MemoryShape(joints, 1, len(levels)))
    probe.touch_levels.copy_(levels)
    if config.store == "distinct":
        # A state felt at another touch level is another state: each level has walks of its own.
        state = probe.place_code(positions)
        rows, following, pace = [], [], []
        for level in range(len(levels)) if len(levels) else [None]:
            mine = torch.arange(len(density))
            if level is not None:
                mine = mine[level_of[episodes] == level]
            links = distinct_links(state[mine], episodes[mine], config.resolution)
            rows.append(mine[links.state])
            following.append(mine[links.successor])
            pace.append(
                _pace(chains, mine[links.left], mine[links.entered], episodes, span, joints)
            )
        source, target, paces = torch.cat(rows), torch.cat(following), torch.cat(pace)
    else:
        source, target = shifted_links(episodes, config.horizon)
        if not len(source):
            raise ValueError(f"no touch of {patch} lasts longer than horizon={config.horizon}")
        paces = torch.ones(len(source))
    memory = model.add_memory(patch, MemoryShape(joints, len(source), len(levels)))
    memory.touch_levels.copy_(levels)
    link = model.link_rotation(patch, everything[source])
    memory.write(positions[source], density[source], positions[target], paces, link)
    beta = config.beta if config.beta is not None else memory.memory.crowding().beta
    memory.memory.beta.fill_(beta)
    checked = torch.arange(0, len(source), -(-len(source) // CHECKED_RECALLS))
    at, to = source[checked], target[checked]
    recalled, _ = memory(positions[at], density[at], None if link is None else link[checked])
    error = ((recalled - positions[to]).abs() / span).max()
    if config.store == "distinct" and error > RECALL_ERROR:
        warnings.warn(
            f"{patch}: a recalled successor is off by {float(error):.1%} of the joint range, so "
            f"the recall may miss stored states; raise beta (now {beta:.3g}) or resolution",
            stacklevel=2,
        )
    report.associations[patch] = len(source)
    report.joints[patch] = [body.joints[j] for j in joints]
    report.betas[patch] = beta
    report.recall_errors[patch] = float(error)


def _touch_levels(densities: Tensor) -> tuple[Tensor, Tensor]:
    """Group the episodes' rate densities: (levels,) means and (episodes,) the level of each."""
    order = densities.argsort()
    gaps = densities[order].diff() > LEVEL_GAP
    group = torch.zeros(len(densities), dtype=torch.int64)
    group[order[1:]] = gaps.cumsum(0)
    levels = torch.stack([densities[group == g].mean() for g in range(int(group.max()) + 1)])
    return levels, group


def _pace(
    chains: list[Chain],
    left: Tensor,
    entered: Tensor,
    episodes: Tensor,
    span: Tensor,
    joints: list[int],
) -> Tensor:
    """Spikes a full joint range on every link, kept near the mean pace of its episode."""
    positions = torch.cat([chain.positions[:, joints] for chain in chains])
    spikes = torch.cat([chain.spikes for chain in chains])
    mean = torch.stack(
        [
            (c.spikes[-1] - c.spikes[0])
            / ((c.positions[:, joints].diff(dim=0).abs() / span).amax(-1).sum().clamp(min=1e-6))
            for c in chains
        ]
    )[episodes[left]]
    way = ((positions[entered] - positions[left]).abs() / span).amax(-1)
    pace = (spikes[entered] - spikes[left]) / way.clamp(min=1e-9)
    pace = torch.where(way > 0, pace, mean)
    return torch.minimum(torch.maximum(pace, mean / 4), mean * 4)
