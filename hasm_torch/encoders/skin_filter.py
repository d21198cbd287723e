"""What a noisy, drifted or partly dead skin would have read if it were sound.

    lost samples ──hold──► noise, offset, stuck cells ──reject──► dead cells ──impute──► forces

A sound reading passes unchanged to the last bit, with two exceptions: a touch ends ``HOLD_S``
later, and cells that a touch at the border of a patch leaves out may be taken for dead. r_c is the
L1 norm of a cell's three forces; a sample takes some 0.4 ms.

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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.encoders.readings import FORCES, forces_of, patch_borders
from hasm_torch.episode import Episode

Array = NDArray[np.float32]

RULES = ("lost", "noise", "offset", "stuck", "dead")  # each named after the fault that it meets
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
        stuck: (cells,) what a cell has read since the first sample that may be stuck, N; else 0.
        readings: (up to LONG_WINDOW, cells) last readings, N.
        changes: Up to LONG_WINDOW last medians of the second differences, N.
        missed: Samples lost since the last one that was not.
        seen: Samples so far.
        stirred: Samples in which a cell that may not be stuck read something new.
    """

    last: Array
    stuck: Array
    readings: Array
    changes: list[float] = field(default_factory=list)
    missed: int = 0
    seen: int = 0
    stirred: int = 0


@dataclass(frozen=True, eq=False)
class SkinFilter:
    """The filter of one skin.

    Attributes:
        cells: Number of cells of each patch; C in all.
        rate: Sampling rate, Hz.
        footprint: (C,) share of its patch's force that a cell takes at every touch, 0 where a
            touch may leave it out.
        without: Those of ``RULES`` that are left out.
    """

    cells: Sequence[int]
    rate: float
    footprint: Array
    without: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.footprint.shape != (sum(self.cells),):
            raise ValueError(
                f"expected a footprint ({sum(self.cells)},), got {self.footprint.shape}"
            )
        if unknown := set(self.without) - set(RULES):
            raise ValueError(f"unknown rules {sorted(unknown)}, valid: {', '.join(RULES)}")

    @classmethod
    def learn(
        cls, body: Body, episodes: Iterable[Episode], without: Sequence[str] = ()
    ) -> "SkinFilter":
        """The filter of a robot, with the mean shares of the touches of some episodes.

        Args:
            body: The robot.
            episodes: Its episodes, of a sound skin.
            without: Those of ``RULES`` that are left out.
        """
        borders = patch_borders(tuple(body.cells))
        total: NDArray[np.float64] = np.zeros(borders[-1])
        touches, always = np.zeros(borders[-1], np.int64), np.ones(borders[-1], np.bool_)
        for episode in episodes:
            skin = None if episode.tactile is None else torch.from_numpy(episode.tactile)
            readings = forces_of(body, skin, (len(episode),)).abs().sum(-1).double().numpy()
            for patch in map(slice, borders[:-1], borders[1:]):
                force = readings[:, patch].sum(1)
                touched = readings[force >= TOUCHED, patch]
                total[patch] += (touched / force[force >= TOUCHED, None]).sum(0)
                touches[patch] += len(touched)
                always[patch] &= (touched > SILENT).all(0)
        shares = np.where(always, total / np.maximum(touches, 1), 0.0)
        return cls(body.cells, body.rate, shares.astype(np.float32), without)

    @property
    def _patches(self) -> list[slice]:
        borders = patch_borders(tuple(self.cells)).tolist()
        return [slice(*ends) for ends in pairwise(borders)]

    def __call__(
        self, skin: Tensor, state: FilterState | None = None
    ) -> tuple[Tensor, FilterState]:
        """Clean a stream of skin samples; a chunked stream equals a whole one.

        Args:
            skin: (T, C, 3) forces of all cells, N.
            state: What an earlier chunk returned; it is used up.

        Returns:
            (T, C, 3) forces, N, on the device of ``skin``; the state to go on from.

        Raises:
            ValueError: If the shape does not fit.
        """
        total = len(self.footprint)
        if skin.ndim != 3 or skin.shape[1:] != (total, FORCES):
            raise ValueError(f"expected skin (T, {total}, 3), got {tuple(skin.shape)}")
        if state is None:
            nothing = np.zeros((total, FORCES), np.float32)
            state = FilterState(nothing, nothing[:, 0].copy(), np.zeros((0, total), np.float32))
        samples = skin.detach().float().cpu().numpy()
        cleaned = np.zeros_like(samples)
        for t, sample in enumerate(samples):
            cleaned[t] = self._sample(sample.copy(), state)
        return torch.from_numpy(cleaned).to(skin.device), state

    def _sample(self, forces: Array, state: FilterState) -> Array:
        """One sample (C, 3), which is used up; the state is brought up to date."""
        state.missed = 0 if forces.any() else state.missed + 1
        if not state.missed:
            state.last = forces.copy()
        elif state.missed <= round(HOLD_S * self.rate) and "lost" not in self.without:
            forces = state.last.copy()
        newest, earlier = np.abs(forces).sum(1), state.readings[-2:]
        state.readings = np.vstack([state.readings, newest])[-LONG_WINDOW:]
        self._watch(newest, earlier, state)
        state.seen += 1
        felt, doubt = self._felt(newest, earlier, state)
        if state.seen <= round(PROBATION_S * self.rate) or state.stirred >= STIRRED:
            felt[state.stuck > 0.0] = 0.0
        read = newest > 0.0
        forces[read] *= (felt[read] / newest[read])[:, None]
        if "dead" not in self.without:
            self._impute(forces, felt, max(SILENT, doubt))
        return forces

    def _watch(self, newest: Array, earlier: Array, state: FilterState) -> None:
        """Which cells may be stuck, and whether others read something new."""
        if not state.seen and "stuck" not in self.without:
            for patch in self._patches:
                spreads, pressed = self.footprint[patch] > 0.0, newest[patch] > SILENT
                if pressed.sum() == 1 and spreads.sum() > 1 and spreads[pressed].all():
                    state.stuck[patch][pressed] = newest[patch][pressed]
        state.stuck[newest != state.stuck] = 0.0
        if state.seen:
            state.stirred += bool((newest != earlier[-1])[state.stuck == 0.0].any())

    def _felt(
        self, newest: Array, earlier: Array, state: FilterState
    ) -> tuple[NDArray[np.float64], float]:
        """Readings (C,) less noise and common level, and the force that noise may feign, N."""
        reading, compared = newest.astype(np.float64), len(self.cells) >= PATCHES_COMPARED
        spread = float(np.median(np.abs(reading - np.median(reading)))) * _DEVIATION
        noise = spread if compared else 0.0
        if state.seen > 2:
            change = np.abs(reading - 2.0 * earlier[1] + earlier[0])
            state.changes = [*state.changes, float(np.median(change))][-LONG_WINDOW:]
            noise = min(float(np.median(state.changes)) * _SECOND_DIFFERENCE, 2.0 * spread)
        if "noise" in self.without:
            noise = 0.0
        level = 0.0
        if compared and "offset" not in self.without:
            means = state.readings.mean(0, dtype=np.float64)
            level = min(float(np.median(means[patch])) for patch in self._patches)
        doubt = REJECT * noise / min(state.seen, WINDOW) ** 0.5
        if not level and not doubt:
            return reading, doubt
        clear = state.readings[-WINDOW:].mean(0, dtype=np.float64) - level > doubt
        offset = max(level - RECTIFIED * noise, 0.0)
        return np.where(clear, np.maximum(reading - offset, 0.0), 0.0), doubt

    def _impute(self, forces: Array, felt: NDArray[np.float64], silent: float) -> None:
        """Put the shares of dead cells back, in place."""
        for patch in self._patches:
            footprint, heard = self.footprint[patch], felt[patch] > silent
            alive = heard & (footprint > 0.0)
            if alive.sum() < 2:
                continue  # one cell alone does not tell how hard its patch is touched
            ratios = np.sort(felt[patch][alive] / footprint[alive])
            share = ratios[(len(ratios) - 1) // 2] * footprint
            dead = ~heard & (share > CLEAR * silent)
            forces[patch][dead] = share[dead, None] / FORCES
