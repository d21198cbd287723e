"""Unrelated motions stored beside a learned one, in the same memories.

``crowded`` adds random motions to every memory of a trained model, as ``HASM.fit`` would store
them had they been taught after what the model knows: the walks that the model holds and the new
motions go through ``successors.distinct_links`` together, so a motion that passes through a known
state joins the walk that holds it, and any other keeps to itself. A million associations are
written in parts, so that their codes never stand side by side as real numbers.
"""

import copy
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.baselines.crowd_measures import beta_of
from hasm_torch.config import MemoryShape
from hasm_torch.memory.successors import distinct_links
from hasm_torch.model.hasm import HASM
from hasm_torch.model.learning import Recording
from hasm_torch.model.patch_memory import PatchMemory

# Codes are real numbers for so many states at a time: with 1,280 entries 42 MB a code.
ROWS_AT_ONCE = 8192


@dataclass
class Stored:
    """What became of the motions in one memory.

    Attributes:
        learned: Associations of what the model knew before; they are the first rows.
        unrelated: Associations that the motions added.
        joined: Of these, such that lead into a state known before.
        met: Of these, such that lead into a state of another motion.
        redirected: States known before that now lead into a motion: ends of walks.
    """

    learned: int
    unrelated: int = 0
    joined: int = 0
    met: int = 0
    redirected: int = 0


class Crowded(NamedTuple):
    """A model with unrelated motions in its memories, and what became of them by patch."""

    model: HASM
    stored: dict[str, Stored]


class Known(NamedTuple):
    """The associations of one memory as positions.

    Attributes:
        positions: (K, J) rad or m.
        level: (K,) index of the touch level.
        following: (K,) row of the successor; an end of a walk is its own.
    """

    positions: Tensor
    level: Tensor
    following: Tensor


@torch.no_grad()
def crowded(
    model: HASM,
    episodes: Iterable[Recording],
    sequences: int,
    length: int,
    generator: np.random.Generator,
) -> Crowded:
    """Store unrelated motions beside what a model knows, in each of its memories.

    A motion moves the joints of the memory through random waypoints in their whole ranges, at the
    spacing of the states known before and under one of their touch levels.

    Args:
        model: Trained with one bit an entry, distinct states, the nearest touch level and touches
            in the link's frame, as by default; stays as it is.
        episodes: What it was trained on.
        sequences: Motions for each memory.
        length: Samples of a motion; of those nearer to each other than the resolution one is kept.
        generator: Source of the waypoints and touch levels.

    Returns:
        The crowded model; the rows known before come first in its memories.

    Raises:
        ValueError: If the model was trained otherwise, or not on these episodes.
    """
    config = model.config
    expected = {
        "memories": "patch",
        "storage": "bit",
        "store": "distinct",
        "touch_levels": "nearest",
        "frame": "link",
    }
    for name, value in expected.items():
        if getattr(config, name) != value:
            raise ValueError(
                f"crowding needs a model with {name}={value!r}, got {getattr(config, name)!r}"
            )
    taught = torch.cat(
        [torch.as_tensor(getattr(e, config.pattern), dtype=torch.float32) for e in episodes]
    )
    taught = torch.clamp(taught, model.lower, model.upper)
    full = copy.deepcopy(model)
    stored = {}
    for patch in model.memories:
        memory = model.memory(patch)
        known = known_states(memory, taught[:, memory.joints])
        motions = random_motions(memory, known, sequences, length, generator)
        levels = torch.from_numpy(generator.integers(len(memory.touch_levels), size=sequences))
        new = _Linked(memory, known, Stored(len(known.level)))
        for level in range(len(memory.touch_levels)):
            new.link(level, motions[levels == level], config.resolution)
        shape = model.shapes[patch]
        capacity = new.stored.learned + new.stored.unrelated
        target = full.add_memory(
            patch, MemoryShape(shape.joints, max(capacity, 1), shape.touch_levels)
        )
        new.write(target)
        beta = config.beta if config.beta is not None else beta_of(target.memory)
        target.memory.beta.fill_(beta)
        stored[patch] = new.stored
    full.reset()
    return Crowded(full, stored)


def known_states(memory: PatchMemory, taught: Tensor) -> Known:
    """Find the positions of what a memory holds among those that it was taught.

    Args:
        memory: The memory.
        taught: (T, J) positions of its joints, rad or m.

    Raises:
        ValueError: If a state of the memory is not among them.
    """
    held = int(memory.memory.count)
    associations = _bytes(memory.memory.stored())
    row_of = {association: row for row, association in enumerate(associations)}
    positions = torch.full((held, taught.shape[-1]), torch.nan)
    level_of = torch.zeros(held, dtype=torch.int64)
    row_of_state: dict[tuple[int, bytes], int] = {}
    for level, density in enumerate(memory.touch_levels):
        for part in taught.split(ROWS_AT_ONCE):
            state, touch = memory.codes(part, density.expand(len(part)))
            for at, association, code in zip(part, _bytes(state * touch), _bytes(state)):
                row = row_of.get(association)
                if row is not None and (level, code) not in row_of_state:
                    row_of_state[level, code] = row
                    positions[row], level_of[row] = at, level
    missing = int(positions.isnan().any(-1).sum())
    if missing:
        raise ValueError(
            f"{missing} of {held} stored states are not in the episodes: give those that the "
            "model was trained on"
        )
    successors = memory.memory.successors[:held, :-1]
    codes, _ = memory.codes(successors, memory.touch_levels[level_of])
    following = torch.tensor(
        [row_of_state[int(at), code] for at, code in zip(level_of, _bytes(codes))]
    )
    positions[following] = successors  # of several with one code the one that stands for it
    return Known(positions, level_of, following)


def random_motions(
    memory: PatchMemory, known: Known, sequences: int, length: int, generator: np.random.Generator
) -> Tensor:
    """Motions at constant speed along straight lines between random waypoints.

    Args:
        memory: Says which joints move, and where.
        known: Gives the spacing, the median one between a state and its successor, taken as the
            largest share of a joint range.
        sequences: Motions.
        length: Samples of a motion.
        generator: Draws the waypoints, uniformly in the joint ranges.

    Returns:
        (sequences, length, J) float32, rad or m.
    """
    lower = memory.place_code.lower.numpy()
    moving = known.following != torch.arange(len(known.following))
    way = (known.positions[known.following] - known.positions).abs().numpy() / memory.span
    spacing = float(np.median(way.max(-1)[moving.numpy()]))
    legs = 8 + math.ceil(4 * length * spacing)  # a leg takes a third of a range or more on average
    paths = np.empty((sequences, length, len(lower)), np.float32)
    for path in paths:
        points = generator.random((legs, len(lower)))
        passed = np.append(0.0, np.abs(np.diff(points, axis=0)).max(-1).cumsum())
        for joint in range(len(lower)):
            share = np.interp(spacing * np.arange(length), passed, points[:, joint])
            path[:, joint] = lower[joint] + memory.span[joint] * share
    return torch.from_numpy(paths)


class _Linked:
    """The motions of one memory, linked touch level by touch level to be written at once."""

    def __init__(self, memory: PatchMemory, known: Known, stored: Stored) -> None:
        self.memory, self.known, self.stored = memory, known, stored
        self.parts: list[tuple[int, Tensor, Tensor]] = []  # level, positions, successors
        self.redirected: list[tuple[int, Tensor]] = []

    def link(self, level: int, motions: Tensor, resolution: int) -> None:
        """Link motions (n, length, J) to each other and to what is known at a touch level."""
        walks = list(_walks(self.known, level))
        rows = torch.tensor([row for walk in walks for row in walk], dtype=torch.int64)
        labels = [torch.full((len(walk),), i) for i, walk in enumerate(walks)]
        motion = torch.arange(len(motions)).repeat_interleave(motions.shape[1]) + len(walks)
        positions = torch.cat([self.known.positions[rows], motions.flatten(0, 1)])
        parts = positions.split(ROWS_AT_ONCE)
        codes = torch.cat([self.memory.place_code(part) > 0 for part in parts])
        episode = torch.cat([*labels, motion])
        links = distinct_links(codes, episode, resolution)
        old = links.state < len(rows)
        for state, successor in zip(links.state[old], links.successor[old]):
            row = int(rows[state])
            stays = successor < len(rows) and rows[successor] == self.known.following[row]
            if not stays:
                self.redirected.append((row, positions[successor]))
        source, target = links.state[~old], links.successor[~old]
        if len(source):
            self.parts.append((level, positions[source], positions[target]))
        into_known = target < len(rows)
        self.stored.unrelated += len(source)
        self.stored.joined += int(into_known.sum())
        self.stored.met += int((~into_known & (episode[source] != episode[target])).sum())
        self.stored.redirected = len(self.redirected)

    def write(self, target: PatchMemory) -> None:
        """Fill an empty memory with what was known, then with the motions."""
        held, before, after = self.stored.learned, self.memory.memory, target.memory
        target.touch_levels.copy_(self.memory.touch_levels)
        after.associations[: len(before.associations)] = before.associations
        after.successors[:held] = before.successors[:held]
        after.count.fill_(held)
        for row, position in self.redirected:
            after.successors[row, :-1] = position
        paces = before.successors[:held, -1]
        for level, positions, successors in self.parts:
            density, pace = target.touch_levels[level], paces[self.known.level == level].mean()
            parts = zip(positions.split(ROWS_AT_ONCE), successors.split(ROWS_AT_ONCE))
            for at, to in parts:
                target.write(at, density.expand(len(at)), to, pace.expand(len(at)))


def _walks(known: Known, level: int) -> Iterator[list[int]]:
    """Rows of one touch level in the order of their links, up to an end or a row met before."""
    rows = torch.nonzero(known.level == level).flatten().tolist()
    following = known.following.tolist()
    led_to = {following[row] for row in rows if following[row] != row}
    met: set[int] = set()
    for row in (row for row in rows if row not in led_to):
        walk = [row]
        while walk[-1] not in met and following[walk[-1]] != walk[-1]:
            met.add(walk[-1])
            walk.append(following[walk[-1]])
        met.add(walk[-1])
        yield walk


def _bytes(codes: Tensor) -> list[bytes]:
    """Signs of codes (K, D), packed."""
    packed: NDArray[np.uint8] = np.packbits((codes > 0).numpy(), axis=1)
    return [row.tobytes() for row in packed]
