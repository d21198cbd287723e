"""Readings that come at their own times, and the sample times that they are paired with.

As in the paper each sample takes the closest reading within a small window, here of each joint and
each cell of the skin by itself, since a message may hold only some of them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]  # ns
Array = NDArray[np.float32]


class Series(NamedTuple):
    """What was read of some entries (joints, cells of a skin), a row a message.

    Attributes:
        times: (N,) ns, in order.
        entries: (name, number) of each of the E entries.
        values: (N, E, channels); NaN where a message did not hold the entry.
        issued: (N,) ns when each row was sent, where that is not its time.
    """

    times: Times
    entries: list[tuple[str, int]]
    values: Array
    issued: Times

    @property
    def reported(self) -> NDArray[np.bool_]:
        """(N, E) which entries each message holds."""
        return np.asarray(~np.isnan(self.values).any(axis=2))


class Collector:
    """Puts a series together from parts in any order."""

    def __init__(self) -> None:
        self._names: dict[str, int] = {}
        self._parts: list[tuple[Times, Times, NDArray[np.int64], Array]] = []

    def add(
        self,
        times: Times,
        names: NDArray[np.bytes_],
        numbers: NDArray[np.int64],
        values: NDArray[np.generic],
        issued: Times | None = None,
    ) -> None:
        """Take in n messages of k entries each.

        Args:
            times: (n,) ns.
            names: (n, k) or (1, k), of the sensors or joints.
            numbers: (n, k) or (1, k), of the cells.
            values: (n, k, channels).
            issued: (n,) ns when each was sent, by default ``times``.
        """
        found, back = np.unique(names, return_inverse=True)
        places = [self._names.setdefault(n.decode(), len(self._names)) for n in found.tolist()]
        key = (np.array(places, np.int64)[back].reshape(names.shape) << 32) + numbers
        key = np.broadcast_to(key, values.shape[:2])
        sent = times if issued is None else issued
        self._parts.append((times, sent, key, values.astype(np.float32)))

    def series(self) -> Series | None:
        """All that was taken in, or None."""
        parts = [part for part in self._parts if part[3].size]
        if not parts:
            return None
        channels = {part[3].shape[2] for part in parts}
        if len(channels) != 1:
            raise ValueError(f"expected cells of as many readings each, got {sorted(channels)}")
        keys = np.unique(np.concatenate([np.unique(part[2]) for part in parts]))
        times, issued = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        values = np.full((len(times), len(keys), channels.pop()), np.nan, np.float32)
        row = 0
        for part in parts:
            rows = np.arange(row, row := row + len(part[0]))
            values[rows[:, None], np.searchsorted(keys, part[2])] = part[3]
        order = np.argsort(times, kind="stable")
        name = list(self._names)
        entries = [(name[(key + 2**31) >> 32], key) for key in keys.tolist()]
        named = [(label, key - (self._names[label] << 32)) for label, key in entries]
        return Series(times[order], named, values[order], issued[order])


def nearest(times: Times, at: Times, window: int) -> NDArray[np.int64]:
    """Index of the closest time to each sample within a window; of two as close, the earlier.

    Args:
        times: (N,) ns, in order, at least one.
        at: (T,) ns of the samples.
        window: ns to either side.

    Returns:
        (T,) indices into ``times``, -1 where none is in the window.
    """
    after = np.searchsorted(times, at).clip(1, max(len(times) - 1, 1))
    before = after - 1
    after = after.clip(max=len(times) - 1)
    index = np.where(at - times[before] <= times[after] - at, before, after)
    return np.where(np.abs(times[index] - at) <= window, index, -1)


def paired(series: Series, at: Times, window: int) -> Array:
    """(T, E, channels) closest reading of every entry; NaN where none is within the window."""
    reported = series.reported
    out = np.full((len(at), *series.values.shape[1:]), np.nan, np.float32)
    always = reported.all(axis=0)
    if always.any():
        index = nearest(series.times, at, window)
        found = index >= 0
        out[np.ix_(found, always)] = series.values[index[found]][:, always]
    for entry in np.flatnonzero(~always & reported.any(axis=0)):
        rows = np.flatnonzero(reported[:, entry])
        index = nearest(series.times[rows], at, window)
        found = index >= 0
        out[found, entry] = series.values[rows[index[found]], entry]
    return out


def last(series: Series, at: Times) -> Array:
    """(T, E, channels) last reading of every entry at or before each sample; else NaN."""
    out = np.full((len(at), *series.values.shape[1:]), np.nan, np.float32)
    for entry, mine in enumerate(series.reported.T):
        rows = np.flatnonzero(mine)
        index = np.searchsorted(series.times[rows], at, side="right") - 1
        out[index >= 0, entry] = series.values[rows[index[index >= 0]], entry]
    return out
