"""Which stored state follows which: the back-shifted action patterns S₋₁.

Two rules. ``shifted_links`` is the paper's: sample k is followed by the sample a horizon later in
the same episode. ``distinct_links`` keeps only states whose codes differ, so that a recall that is
fed its own decision never stands still.

Why the second rule visits every state. Each episode is read as a walk over the *distinct* codes it
passes (a code within ``resolution`` entries of a stored one counts as that stored one). A code
that the walk meets several times keeps only its *last* exit, so along one episode the time of the
last visit grows strictly with every link and no loop is left. A code that an earlier episode
already left keeps its earlier exit, so a later episode can join an earlier walk but not redirect
it; an episode's end may be continued only by a link from which that end cannot be reached again.
Hence following the links from any stored state passes through distinct states to the end of an
episode, which links to itself.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class DistinctLinks(NamedTuple):
    """Links between the distinct codes of some episodes.

    Attributes:
        state: (K,) int64, sample that stands for each distinct code.
        successor: (K,) int64, sample that stands for the code that follows; the end of a walk is
            its own successor.
        left: (K,) int64, sample at which the code was entered before it was left for good.
        entered: (K,) int64, sample at which the following code was entered; equal to ``left`` at
            the end of a walk.
    """

    state: Tensor
    successor: Tensor
    left: Tensor
    entered: Tensor


def shifted_links(episodes: Tensor, horizon: int = 1) -> tuple[Tensor, Tensor]:
    """Pair every sample with the sample a horizon later in the same episode.

    Args:
        episodes: (T,) integers, the episode of each sample, samples of one episode contiguous and
            in order of time.
        horizon: Number of samples to look ahead, at least 1.

    Returns:
        (K,) indices of the samples and (K,) indices of their successors; the last ``horizon``
        samples of an episode have no successor and are left out.

    Raises:
        ValueError: If the horizon is below 1 or ``episodes`` is not one-dimensional.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1 sample, got {horizon}")
    if episodes.ndim != 1:
        raise ValueError(
            f"episodes must be (T,), one integer a sample, got {tuple(episodes.shape)}"
        )
    index = torch.arange(max(len(episodes) - horizon, 0), device=episodes.device)
    inside = episodes[index] == episodes[index + horizon]
    return index[inside], index[inside] + horizon


def distinct_links(codes: Tensor, episodes: Tensor, resolution: int = 1) -> DistinctLinks:
    """Reduce episodes to their distinct codes and link each to the one that follows.

    Args:
        codes: (T, D) bipolar state codes.
        episodes: (T,) integers, the episode of each sample, samples of one episode contiguous and
            in order of time.
        resolution: Two codes count as the same state when fewer than this many entries differ.

    Returns:
        The links, one a distinct code, in the order in which the codes first appear.

    Raises:
        ValueError: If shapes disagree, the resolution is below 1, or there is no sample.
    """
    if codes.ndim != 2 or episodes.shape != codes.shape[:1]:
        raise ValueError(
            f"expected codes (T, D) and episodes (T,), got {tuple(codes.shape)} and "
            f"{tuple(episodes.shape)}"
        )
    if resolution < 1:
        raise ValueError(f"resolution must be at least 1 entry, got {resolution}")
    if len(codes) == 0:
        raise ValueError("no sample to link: expected at least one row in codes")
    # Neighbouring entries go to different parts: with all entries of a joint in each, many codes
    # would share one.
    mixed = np.argsort(np.arange(codes.shape[1]) % resolution, kind="stable")
    bits = np.packbits(np.ascontiguousarray((codes > 0).cpu().numpy()[:, mixed]), axis=1)
    walk = _Walk(bits, resolution)
    labels = episodes.cpu().numpy()
    starts = np.flatnonzero(np.r_[True, labels[1:] != labels[:-1]])
    for start, stop in zip(starts, np.r_[starts[1:], len(labels)]):
        walk.follow(int(start), int(stop))
    columns = [walk.representative, [walk.representative[s] for s in walk.successor]]
    columns += [walk.left, walk.entered]
    return DistinctLinks(
        *(torch.tensor(c, dtype=torch.int64, device=codes.device) for c in columns)
    )


class _Walk:
    """The growing set of distinct codes and the links between them.

    Two codes that differ in fewer than ``resolution`` entries agree in at least one of as many
    parts, so only known codes that share a part with a sample need to be compared with it.
    """

    def __init__(self, bits: np.ndarray, resolution: int) -> None:
        padding = -bits.shape[1] % 8
        self.words = np.pad(bits, ((0, 0), (0, padding))).view(np.uint64)
        self.keys = np.empty_like(self.words)
        self.resolution = resolution
        size = self.words.shape[1] * 8
        # With fewer bytes than parts some parts would be empty, and then all codes share them.
        self.borders = [size * i // resolution for i in range(resolution + 1)]
        self.sharing: list[dict[bytes, list[int]]] = [{} for _ in range(resolution)]
        self.representative: list[int] = []
        self.successor: list[int] = []
        self.left: list[int] = []
        self.entered: list[int] = []

    def follow(self, start: int, stop: int) -> None:
        """Add the samples start..stop-1 of one episode."""
        known = len(self.representative)
        visits = self._visits(start, stop)
        exits: dict[int, tuple[int, int, int]] = {}
        for (state, left), (following, entered) in pairwise(visits):
            exits[state] = (following, left, entered)  # a later exit replaces an earlier one
        exits.pop(visits[-1][0], None)  # the walk ended there for good
        # New states first, so that an old open end is judged against all links of this episode.
        for state in sorted(exits, reverse=True):
            following, left, entered = exits[state]
            if state >= known or self._may_continue(state, following):
                self.successor[state] = following
                self.left[state], self.entered[state] = left, entered

    def _visits(self, start: int, stop: int) -> list[tuple[int, int]]:
        """The distinct codes in the order visited, each with the sample of the visit."""
        visits: list[tuple[int, int]] = []
        for sample in range(start, stop):
            state = self._state(sample, visits[-1][0] if visits else None)
            if not visits or visits[-1][0] != state:
                visits.append((state, sample))
        return visits

    def _state(self, sample: int, current: int | None) -> int:
        word = self.words[sample]
        if current is not None:
            # Staying is preferred to moving to an equally near neighbour: no flicker.
            distance = int(np.bitwise_count(self.keys[current] ^ word).sum())
            if distance < self.resolution:
                return current
        whole = word.tobytes()
        parts = [whole[a:b] for a, b in pairwise(self.borders)]
        near = {key for part, known in zip(parts, self.sharing) for key in known.get(part, ())}
        if near:
            candidates = np.array(sorted(near))
            distances = np.bitwise_count(self.keys[candidates] ^ word).sum(axis=1)
            nearest = int(distances.argmin())
            if distances[nearest] < self.resolution:
                return int(candidates[nearest])
        count = len(self.representative)
        for part, known in zip(parts, self.sharing):
            known.setdefault(part, []).append(count)
        self.keys[count] = word
        self.representative.append(sample)
        self.successor.append(count)
        self.left.append(sample)
        self.entered.append(sample)
        return count

    def _may_continue(self, state: int, following: int) -> bool:
        """Whether a known state is an open end that this link would not close into a loop."""
        if self.successor[state] != state:
            return False
        while following != state and self.successor[following] != following:
            following = self.successor[following]
        return following != state
