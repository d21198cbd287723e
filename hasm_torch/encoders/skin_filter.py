"""What a noisy, drifted or partly dead skin would have read if it were sound.

    lost samples ──hold──► noise, offset, stuck cells ──reject──► dead cells ──impute──► forces

A clean reading passes unchanged, to the last bit. r_c is the L1 norm of a cell's three forces.

* **Lost sample.** A sample in which every cell reads exactly zero right after a touch repeats the
  last one, for at most ``HOLD_S``; a touch that ends does so that much later.
* **Noise.** Its level is the median over the cells of |r_c(t) − 2 r_c(t−1) + r_c(t−2)|, which a
  steady or slowly changing touch does not raise, and neither does a strong one on a few cells.
  It is at most twice the spread over the cells, which stands for it in the first two samples. A
  cell whose mean reading of the last samples is within ``REJECT`` standard errors reads zero.
* **Common level.** An offset that every patch has is no touch: what the least pressed patch reads
  in the middle of its cells is taken from all, but for what noise adds to a reading that cannot
  fall below zero; to a cell that is pressed noise adds nothing.
  Cells are compared only across ``PATCHES_COMPARED`` patches or more: a hand may hold all of fewer.
* **Stuck cell.** A cell that reads a force from the first sample on while no other cell of its
  patch reads any, although its touches always spread, may be stuck. It reads zero for
  ``PROBATION_S``, and on as long as its reading has not changed at all while others did in
  ``STIRRED`` samples.
* **Dead cell.** A touch spreads through the elastomer, so that each cell of a patch takes a share
  of its force. Cells that took theirs at every touch of the episodes are silent only if they are
  dead: their share is then put back, from the median over the other cells of reading / share.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.encoders.readings import patch_borders
from hasm_torch.kernels.compiling import compile_kernel

HOLD_S = 0.06
WINDOW = 5  # samples over which a cell's reading is averaged to tell it from noise
LONG_WINDOW = 25  # samples over which the levels of noise and offset are taken
REJECT = 6.0  # standard errors above the common level
PATCHES_COMPARED = 4
RECTIFIED = 1.2  # mean over standard deviation of a sum of three rectified normal noises
SILENT = 1e-3  # N: a cell that should read CLEAR times as much is dead
CLEAR = 5.0
PROBATION_S = 0.4
STIRRED = 5
TOUCHED = 1.0  # N on a patch of the episodes, from which a cell's share of it is learned
# Standard deviation over median of |second difference| and over median absolute deviation.
_SECOND_DIFFERENCE, _DEVIATION = 1 / (0.6745 * 6**0.5), 1 / 0.6745


@dataclass
class FilterState:
    """What a stream needs to go on.

    Attributes:
        last: (cells, 3) last sample that was not lost, N.
        missed: Samples lost since.
        seen: Samples so far.
        readings: (LONG_WINDOW, cells) last readings, the newest at ``(seen − 1) % LONG_WINDOW``, N.
        changes: (LONG_WINDOW,) last medians of the second differences, N.
        stuck: (cells,) what a cell has read since the first sample that may be stuck, N; else 0.
        stirred: Samples in which a cell that may not be stuck read something new.
    """

    last: NDArray[np.float32]
    missed: int
    seen: int
    readings: NDArray[np.float32]
    changes: NDArray[np.float32]
    stuck: NDArray[np.float32]
    stirred: int

    @classmethod
    def start(cls, cells: int) -> "FilterState":
        """Before the first sample."""
        return cls(
            np.zeros((cells, 3), np.float32),
            0,
            0,
            np.zeros((LONG_WINDOW, cells), np.float32),
            np.zeros(LONG_WINDOW, np.float32),
            np.zeros(cells, np.float32),
            0,
        )


def clean_skin(
    skin: Tensor,
    cells: list[int],
    rate: float,
    footprint: NDArray[np.float32],
    state: FilterState | None = None,
) -> tuple[Tensor, FilterState]:
    """Clean a stream of skin samples; a chunked stream equals a whole one.

    Args:
        skin: (T, C, 3) forces of all cells, N.
        cells: Number of cells of each patch; C in all.
        rate: Sampling rate, Hz.
        footprint: (C,) share of its patch's force that a cell takes at every touch, 0 where a
            touch may leave it out; see ``Footprint``.
        state: What an earlier chunk returned; it is used up.

    Returns:
        (T, C, 3) forces, N, on the device of ``skin``; the state to go on from.

    Raises:
        ValueError: If a shape does not fit.
    """
    total = sum(cells)
    if skin.ndim != 3 or skin.shape[1:] != (total, 3) or footprint.shape != (total,):
        raise ValueError(
            f"expected skin (T, {total}, 3) and footprint ({total},), got {tuple(skin.shape)} and "
            f"{footprint.shape}"
        )
    state = FilterState.start(total) if state is None else state
    cleaned = skin.detach().float().cpu().numpy().copy()
    borders = patch_borders(tuple(cells))
    state.missed, state.seen, state.stirred = _compiled()(
        cleaned, borders, footprint, round(HOLD_S * rate), round(PROBATION_S * rate), state.last,
        state.missed, state.seen, state.readings, state.changes, state.stuck, state.stirred,
    )  # fmt: skip
    return torch.from_numpy(cleaned).to(skin.device), state


class Footprint:
    """Share of its patch's force that each cell takes at every touch, over some episodes.

    Args:
        cells: Number of cells of each patch.
    """

    def __init__(self, cells: list[int]) -> None:
        self._borders = patch_borders(tuple(cells))
        self._total: NDArray[np.float64] = np.zeros(sum(cells))
        self._touches = np.zeros(sum(cells), np.int64)
        self._always = np.ones(sum(cells), np.bool_)

    def add(self, skin: Tensor) -> None:
        """Take in an episode.

        Args:
            skin: (T, C, 3) forces of all cells, N.
        """
        readings = skin.abs().sum(-1).double().cpu().numpy()
        for first, end in zip(self._borders[:-1], self._borders[1:]):
            force = readings[:, first:end].sum(1)
            touched = readings[force >= TOUCHED, first:end]
            self._total[first:end] += (touched / force[force >= TOUCHED, None]).sum(0)
            self._touches[first:end] += len(touched)
            self._always[first:end] &= (touched > SILENT).all(0)

    def shares(self) -> Tensor:
        """(C,) mean shares; 0 for a cell that was ever silent while its patch was touched."""
        shares = np.where(self._always, self._total / np.maximum(self._touches, 1), 0.0)
        return torch.from_numpy(shares).float()


@functools.cache
def _compiled() -> Callable[..., tuple[int, int, int]]:
    """The pass, compiled on first use and then cached on disk."""

    def kernel(
        skin: Any, borders: Any, footprint: Any, hold: int, probation: int, last: Any, missed: int,
        seen: int, readings: Any, changes: Any, stuck: Any, stirred: int,
    ) -> tuple[int, int, int]:  # fmt: skip
        samples, cells = skin.shape[:2]
        reading, mean, change = np.empty(cells), np.empty(cells), np.empty(cells)
        for t in range(samples):
            lost = True
            for c in range(cells):
                for i in range(3):
                    if skin[t, c, i] != 0.0:
                        lost = False
            missed = missed + 1 if lost else 0
            if not lost:
                last[:] = skin[t]
            elif missed <= hold:
                skin[t] = last

            newest, before = seen % LONG_WINDOW, (seen - 1) % LONG_WINDOW
            older = (seen - 2) % LONG_WINDOW
            for c in range(cells):
                reading[c] = abs(skin[t, c, 0]) + abs(skin[t, c, 1]) + abs(skin[t, c, 2])
                readings[newest, c] = reading[c]
                change[c] = abs(reading[c] - 2.0 * readings[before, c] + readings[older, c])
            if seen == 0:
                for p in range(len(borders) - 1):
                    pressed, spreading, at = 0, 0, 0
                    for c in range(borders[p], borders[p + 1]):
                        spreading += footprint[c] > 0.0
                        if reading[c] > SILENT:
                            pressed, at = pressed + 1, c
                    if pressed == 1 and spreading > 1 and footprint[at] > 0.0:
                        stuck[at] = readings[newest, at]
            news = False
            for c in range(cells):
                if readings[newest, c] != stuck[c]:
                    stuck[c] = 0.0
                if stuck[c] == 0.0 and seen and readings[newest, c] != readings[before, c]:
                    news = True
            stirred += news
            seen += 1
            known = min(seen, LONG_WINDOW)
            compared = len(borders) > PATCHES_COMPARED
            spread = np.median(np.abs(reading - np.median(reading))) * _DEVIATION
            noise = spread if compared else 0.0
            if seen > 2:
                changes[(seen - 3) % LONG_WINDOW] = np.median(change)
                noise = np.median(changes[: min(seen - 2, LONG_WINDOW)]) * _SECOND_DIFFERENCE
                noise = min(noise, 2.0 * spread)

            level: Any = 0.0
            if compared:
                level = np.inf
                for c in range(cells):
                    mean[c] = readings[:known, c].mean()
                for p in range(len(borders) - 1):
                    level = min(level, np.median(mean[borders[p] : borders[p + 1]]))
            doubt = REJECT * noise / np.sqrt(min(seen, WINDOW))
            offset = max(level - RECTIFIED * noise, 0.0)
            if level > 0.0 or doubt > 0.0:
                for c in range(cells):
                    mean[c] = 0.0
                    for i in range(min(seen, WINDOW)):
                        mean[c] += readings[(seen - 1 - i) % LONG_WINDOW, c]
                    mean[c] /= min(seen, WINDOW)
                    felt = max(reading[c] - offset, 0.0) if mean[c] - level > doubt else 0.0
                    scale = felt / reading[c] if reading[c] > 0.0 else 0.0
                    for i in range(3):
                        skin[t, c, i] *= scale
                    reading[c] = felt

            for c in range(cells):
                if stuck[c] > 0.0 and (seen <= probation or stirred >= STIRRED):
                    skin[t, c, :] = 0.0
                    reading[c] = 0.0

            silent = max(SILENT, doubt)
            for p in range(len(borders) - 1):
                first, end = borders[p], borders[p + 1]
                alive = 0
                for c in range(first, end):
                    if footprint[c] > 0.0 and reading[c] > silent:
                        change[alive] = reading[c] / footprint[c]
                        alive += 1
                if alive < 2:
                    continue  # one cell alone does not tell how hard its patch is touched
                ratios = np.sort(change[:alive])
                force = ratios[(alive - 1) // 2]
                for c in range(first, end):
                    share = force * footprint[c]
                    if reading[c] <= silent and share > CLEAR * silent:
                        for i in range(3):
                            skin[t, c, i] = share / 3.0
        return missed, seen, stirred

    return compile_kernel(kernel)
