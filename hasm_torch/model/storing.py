"""Filling memories: from the touched samples of episodes to associations."""

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from hasm_torch.config import MemoryShape
from hasm_torch.memory.successors import distinct_links, shifted_links

if TYPE_CHECKING:
    from hasm_torch.model.hasm import HASM
    from hasm_torch.model.patch_memory import PatchMemory

# Rate densities nearer to each other than this are one touch level, or what their codes tell apart.
LEVEL_GAP = 0.06

# A recalled successor that is off by more than this share of the joint range is worth a warning.
RECALL_ERROR = 1e-3

# Recalled successors that are checked in each memory, evenly spread over it.
CHECKED_RECALLS = 4096


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
        associations: Associations held, by memory: that of a patch, by its name, or the shared one.
        joints: Names of the joints that the patches of each memory move.
        betas: Inverse temperature of each memory.
        recall_errors: Largest error of a recalled successor at its own association (of at most
            4,096 of each patch), as a share of the joint range, by memory. Where it is small,
            recall visits every stored state.
    """

    episodes: int
    associations: dict[str, int]
    joints: dict[str, list[str]]
    betas: dict[str, float]
    recall_errors: dict[str, float]


class Associations(NamedTuple):
    """What one patch stores.

    Attributes:
        patch: Its name.
        moved: (J,) which of the memory's joints its touch moves.
        positions: (K, J) joint positions, rad or m.
        density: (K,) rate density ρ.
        successor: (K, J) positions that follow, rad or m.
        pace: (K,) spikes a full joint range.
        link: (K, 3, 3) rotation of the patch's link in the base frame; None in the link's frame.
    """

    patch: str
    moved: Tensor
    positions: Tensor
    density: Tensor
    successor: Tensor
    pace: Tensor
    link: Tensor | None


def store(
    model: "HASM",
    name: str,
    chains: dict[str, list[Chain]],
    moved: dict[str, list[int]],
    report: FitReport,
) -> None:
    """Build and fill a memory.

    Args:
        model: Gets the memory.
        name: Name of the memory: its patch, or ``SHARED``.
        chains: What the memory's patches felt and how the joints moved.
        moved: Indices of the joints that each of them moves.
        report: What was stored is noted there.

    Raises:
        ValueError: If a touch is too short to have a successor.
    """
    joints = sorted(set().union(*moved.values()))
    levels, level_of = torch.zeros(0), dict.fromkeys(chains, torch.zeros(0, dtype=torch.int64))
    if model.config.touch_levels == "nearest":
        medians = [c.density.median() for patch in chains for c in chains[patch]]
        # Levels nearer to each other than one of a joint's neurons could share a touch code.
        gap = max(LEVEL_GAP, 1 / model.config.neurons if model.config.ranks == "joint" else 0.0)
        levels, group = _touch_levels(torch.stack(medians), gap)
        level_of = dict(zip(chains, group.split([len(found) for found in chains.values()])))
    patches = [] if list(chains) == [name] else list(chains)
    probe = model.add_memory(name, MemoryShape(joints, 1, len(levels), patches))
    probe.touch_levels.copy_(levels)
    found = [
        _associations(model, probe, patch, chains[patch], level_of[patch], moved[patch])
        for patch in chains
    ]
    count = sum(len(part.pace) for part in found)
    memory = model.add_memory(name, MemoryShape(joints, count, len(levels), patches))
    memory.touch_levels.copy_(levels)
    for part in found:
        memory.write(
            part.positions,
            part.density,
            part.successor,
            part.pace,
            part.link,
            part.patch,
            part.moved,
        )
    beta = model.config.beta if model.config.beta is not None else memory.memory.crowding().beta
    memory.memory.beta.fill_(beta)
    span = (model.upper - model.lower)[joints]
    error = max(_recall_error(memory, part, span) for part in found)
    if model.config.store == "distinct" and error > RECALL_ERROR:
        warnings.warn(
            f"{name}: a recalled successor is off by {error:.1%} of the joint range, so the recall "
            f"may miss stored states; raise beta (now {beta:.3g}) or resolution",
            stacklevel=2,
        )
    report.associations[name] = count
    report.joints[name] = [model.body.joints[j] for j in joints]
    report.betas[name] = beta
    report.recall_errors[name] = error


def _associations(
    model: "HASM",
    probe: "PatchMemory",
    patch: str,
    chains: list[Chain],
    level_of: Tensor,
    moved: list[int],
) -> Associations:
    """What a patch stores in a memory of the probe's joints and touch levels."""
    config = model.config
    joints, levels = probe.joints.tolist(), probe.touch_levels
    everything = torch.cat([chain.positions for chain in chains])
    positions = everything[:, joints]
    episodes = torch.cat([torch.full((len(c.spikes),), i) for i, c in enumerate(chains)])
    if len(levels):
        density = levels[level_of[episodes]]
    else:
        density = torch.cat([chain.density for chain in chains])
    if config.store == "distinct":
        # A state felt at another touch level is another state: each level has walks of its own.
        state = probe.place_code(positions)
        rows, following, paces = [], [], []
        for level in level_of.unique().tolist() if len(levels) else [None]:
            mine = torch.arange(len(density))
            if level is not None:
                mine = mine[level_of[episodes] == level]
            links = distinct_links(state[mine], episodes[mine], config.resolution)
            rows.append(mine[links.state])
            following.append(mine[links.successor])
            spent = mine[links.left], mine[links.entered]
            span = (model.upper - model.lower)[joints]
            paces.append(_pace(chains, *spent, episodes, span, joints))
        source, target, pace = torch.cat(rows), torch.cat(following), torch.cat(paces)
    else:
        source, target = shifted_links(episodes, config.horizon)
        if not len(source):
            raise ValueError(f"no touch of {patch} lasts longer than horizon={config.horizon}")
        pace = torch.ones(len(source))
    return Associations(
        patch,
        torch.isin(probe.joints, torch.tensor(moved)),
        positions[source],
        density[source],
        positions[target],
        pace,
        model.link_rotation(patch, everything[source]),
    )


def _recall_error(memory: "PatchMemory", stored: Associations, span: Tensor) -> float:
    """Largest error of a recalled successor at its own association, as a share of the range."""
    checked = torch.arange(0, len(stored.pace), -(-len(stored.pace) // CHECKED_RECALLS))
    link = None if stored.link is None else stored.link[checked]
    recalled, _ = memory(stored.positions[checked], stored.density[checked], link, stored.patch)
    error = (recalled - stored.successor[checked]).abs() / span
    return float(error[:, stored.moved].max())


def _touch_levels(densities: Tensor, gap: float) -> tuple[Tensor, Tensor]:
    """Group the episodes' rate densities: (levels,) means and (episodes,) the level of each."""
    order = densities.argsort()
    gaps = densities[order].diff() > gap
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
