"""From an episode to what can be stored: what every spike did, and the course of every touch.

A *sample* is a stretch of ``horizon`` samples of an episode in which the skin spikes: where it
began, how it was touched, and how far the joints moved. A *phase* is a touch of one patch, pauses
included, until another patch is touched or the episode ends: where it began, and the course of the
joints by spikes.
"""

from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.touch import pair_with_spikes
from hasm_torch.model.felt import Recording, Touch, felt
from hasm_torch.model.frames import base_indices, into_base
from hasm_torch.model.lessons import COURSE_POINTS, Lesson
from hasm_torch.model.moments import Series
from hasm_torch.model.settled import Settled
from hasm_torch.model.table import Table, empty_table, joined

Array = NDArray[np.float64]

# Stretches with fewer spikes than this share of the usual number are left out: what one stray spike
# did is mostly what was done without it.
LEAST_SPIKES = 0.25
SHORTEST_PHASE = 3  # samples with spikes; shorter ones are flicker between two patches
ARRIVED = 0.005  # share of a course's length; what is nearer to its end is no motion


def collect(
    config: HASMConfig, body: Body, settled: Settled, episode: Recording, number: int = 0
) -> Lesson:
    """Read an episode.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: Threshold and current of the skin, and what drives the robot.
        episode: The recording.
        number: Its number, for errors and for what is found.

    Returns:
        What it teaches.

    Raises:
        ValueError: If it does not fit the body or is not finite.
    """
    state, action = positions_of(body, episode, number)
    period = 1.0 / body.rate
    if settled.drive == "time":
        density: Array = np.zeros((len(state), 0))
        if body.channels:
            density = felt(config, body, settled, episode).density
        series = Series(torch.from_numpy(state), torch.from_numpy(density))
        nothing = empty_table(body, 0), empty_table(body, COURSE_POINTS)
        lag = np.zeros(len(body.joints))
        return Lesson(number, len(state) * period, *nothing, lag, series=series)
    path = action if config.pattern == "action" else state
    observation = observations_of(body, episode, number, len(path))
    touch = felt(config, body, settled, episode)
    phases = _phases(config, body, path, touch, observation, number)
    pace = (np.abs(np.diff(path, axis=0)) / np.array(body.max_speed)).max(axis=1)
    return Lesson(
        number,
        len(path) * period,
        _samples(config, body, path, touch, observation, number, phases),
        phases,
        np.abs(action - state).max(axis=0),
        np.stack([pace, touch.spikes.sum(axis=1)[1:]], axis=1),
    )


def positions_of(body: Body, episode: Recording, number: int) -> tuple[Array, Array]:
    """State and action of an episode, (T, J) each, within the joint limits.

    Raises:
        ValueError: If a shape does not fit the body, or a value is not finite.
    """
    series = []
    for name in ("state", "action"):
        values = np.asarray(getattr(episode, name), dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != len(body.joints):
            raise ValueError(
                f"episode {number}: expected {name} (T, {len(body.joints)}), got {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"episode {number}: {name} holds NaN or infinity")
        series.append(np.clip(values, body.lower, body.upper))
    if (
        len(series[0]) == 0
        or len(series[0]) != len(series[1])
        or len(episode.time) != len(series[0])
    ):
        raise ValueError(
            f"episode {number}: expected as many times and actions as states and at least one, got "
            f"{len(episode.time)}, {len(series[1])} and {len(series[0])}"
        )
    return series[0], series[1]


def observations_of(body: Body, episode: Recording, number: int, length: int) -> Array:
    """Further observations of an episode, (T, O).

    Raises:
        ValueError: If the body binds some that the episode lacks, or they are not finite.
    """
    expected = (length, sum(body.observations.values()))
    if not expected[1]:
        return np.zeros(expected)
    values = getattr(episode, "observations", None)
    if values is None or np.shape(values) != expected or not np.isfinite(values).all():
        raise ValueError(
            f"episode {number}: expected finite observations {expected} of "
            f"{', '.join(body.observations)}, got {None if values is None else np.shape(values)}"
        )
    return np.asarray(values, dtype=np.float64)


def _samples(
    config: HASMConfig,
    body: Body,
    path: Array,
    touch: Touch,
    observation: Array,
    number: int,
    phases: Table,
) -> Table:
    base, ahead = base_indices(body), config.horizon
    every = ahead if config.distinct else 1
    begin = np.arange(0, max(len(path) - ahead, 0), every)
    total = np.concatenate([np.zeros((1, touch.spikes.shape[1])), touch.spikes.cumsum(axis=0)])
    spent = total[begin + ahead + 1] - total[begin + 1]
    used = spent.sum(axis=1)
    enough = (used > 0) & (used >= LEAST_SPIKES * _median(used[used > 0]))
    begin, spent = begin[enough], spent[enough]
    patch = spent.argmax(axis=1)
    paired = np.array([_nearest_spike(touch, p, config, body) for p in range(spent.shape[1])])
    at = paired[patch, begin]
    near = at >= 0
    begin, spent, patch, at = begin[near], spent[near], patch[near], at[near]
    yaw = path[begin, base[2]] if base else 0.0
    return Table(
        positions=path[begin],
        moved=into_base(path[begin + ahead] - path[begin], yaw, base),
        spikes=spent.sum(axis=1),
        density=_phase_density(phases, touch, at, patch),
        patch=patch,
        direction=touch.direction[at, patch],
        observation=observation[begin],
        episode=np.full(len(begin), number),
        frame=begin,
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _nearest_spike(touch: Touch, patch: int, config: HASMConfig, body: Body) -> NDArray[np.int64]:
    """Sample of the spike of a patch closest to every sample, −1 where none is near, (T,)."""
    times = torch.arange(len(touch.spikes), dtype=torch.float64) / body.rate
    spiking = np.flatnonzero(touch.spikes[:, patch] > 0)
    if not len(spiking):
        return np.full(len(times), -1)
    index = pair_with_spikes(times, times[spiking], config.pair_window_s).numpy()
    return np.where(index >= 0, spiking[index.clip(min=0)], -1)


def _phase_density(
    phases: Table, touch: Touch, at: NDArray[np.int64], patch: NDArray[np.int64]
) -> Array:
    """ρ of the phase to which each sample belongs; its own where it belongs to none."""
    own = touch.density[at, patch]
    if not len(phases):
        return own
    last = np.searchsorted(phases.frame, at, side="right") - 1
    same = (last >= 0) & (phases.patch[last.clip(min=0)] == patch)
    return np.where(same, phases.density[last.clip(min=0)], own)


def _phases(
    config: HASMConfig, body: Body, path: Array, touch: Touch, observation: Array, number: int
) -> Table:
    base = base_indices(body)
    spiking = np.flatnonzero(touch.spikes.sum(axis=1) > 0)
    if not len(spiking):
        return empty_table(body, COURSE_POINTS)
    leader = touch.spikes[spiking].argmax(axis=1)
    borders = np.flatnonzero(np.r_[True, leader[1:] != leader[:-1], True])
    found = []
    for first, end in pairwise(borders):
        if end - first < SHORTEST_PHASE:
            continue
        mine, patch = spiking[first:end], leader[first]
        begin = max(int(mine[0]) - 1, 0)
        stop = int(mine[-1])
        course = path[begin : stop + 1] - path[begin]
        course = into_base(course, path[begin, base[2]] if base else 0.0, base)
        spikes = touch.spikes[begin : stop + 1].sum(axis=1).cumsum()
        spikes -= spikes[0]
        course, spent, at = _course(course / np.array(body.max_speed), course, spikes)
        felt_at = mine[np.searchsorted(mine, begin + at).clip(max=len(mine) - 1)]
        found.append(
            Table(
                positions=path[begin][None],
                moved=course[None],
                spikes=np.array([spent]),
                density=np.array([np.median(touch.density[mine, patch])]),
                patch=np.array([patch]),
                direction=touch.direction[felt_at, patch][None],
                observation=observation[begin][None],
                episode=np.array([number]),
                frame=np.array([begin]),
            )
        )
    return joined([empty_table(body, COURSE_POINTS), *found])


def _course(scaled: Array, course: Array, spikes: Array) -> tuple[Array, float, NDArray[np.int64]]:
    """A course at evenly spread spikes (N, J), the spikes till it arrives, and its samples (N,)."""
    way = np.abs(np.diff(scaled, axis=0)).max(axis=1).cumsum()
    end = len(course) - 1
    if len(way) and way[-1] > 0:
        end = int(np.searchsorted(way, (1.0 - ARRIVED) * way[-1])) + 1
    spent = float(spikes[end])
    wanted = np.linspace(0.0, spent, COURSE_POINTS)
    # Of samples at the same spike count the last one stands: motion waits for spikes.
    last = np.flatnonzero(np.r_[np.diff(spikes[: end + 1]) > 0, True])
    points = [np.interp(wanted, spikes[last], column[last]) for column in course.T]
    return np.stack(points, axis=1), spent, np.searchsorted(spikes, wanted).clip(max=end)
