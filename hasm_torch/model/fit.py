"""Learning: from episodes to a memory, with everything chosen that the settings leave open.

``fit`` reads the episodes, settles what fits them and returns the rows of the memory; it changes
nothing. ``HASM.fit`` puts what it returns in place.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.place_code import PlaceCode
from hasm_torch.memory.successors import distinct_links
from hasm_torch.model.choose import choose, covariates, recalled_values, table_codes
from hasm_torch.model.choose_timed import choose_timed, stored
from hasm_torch.model.collect import (
    COURSE_POINTS,
    Collected,
    Table,
    collect,
    joined,
    positions_of,
)
from hasm_torch.model.felt import Recording, calibrate, felt
from hasm_torch.model.frames import base_indices, out_of_base
from hasm_torch.model.moments import Series, moments
from hasm_torch.model.readout import stored_values
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.timed import Timed

Array = NDArray[np.float64]

# A joint that moves less than this share of its range in every touch is not moved by it; one
# without limits, less than it could in this many seconds.
MOVED_SHARE, MOVED_SECONDS = 0.02, 0.05
# Where motion and spikes correlate less than this, time moves the robot on: measured are 0.46 to
# 0.72 in what was taught by touch, −0.06 in a hand that closes on objects.
LED_BY_TOUCH = 0.2
# The reference keeps this near to the joints: twice the lag of the episodes, and this many seconds
# at full speed, in which a drive that is not blocked has followed.
LAG_FACTOR, LAG_SECONDS = 2.0, 0.05
# Observations are coded over their range in the episodes and this share of it to each side, so
# that one a little beyond still has a code of its own.
OBSERVED_MARGIN = 0.1


@dataclass
class FitReport:
    """What ``fit`` learned and chose.

    Attributes:
        episodes: Episodes read.
        associations: Associations stored.
        taught: Names of the patches whose touch was taught.
        choices: What was settled, by name.
        errors: Error of every value tried in a choice, relative to standing still.
    """

    episodes: int
    associations: int
    taught: list[str]
    choices: dict[str, str]
    errors: dict[str, dict[str, float]]

    def __str__(self) -> str:
        chosen = ", ".join(f"{name} {value}" for name, value in self.choices.items())
        lines = [
            f"{self.episodes} episodes, {self.associations} associations of the patches "
            f"{', '.join(self.taught)}",
            f"chosen: {chosen}",
        ]
        for name, errors in self.errors.items():
            tried = ", ".join(f"{option} {error:.3f}" for option, error in errors.items())
            lines.append(f"held-out error of {name}: {tried} (standing still 1)")
        return "\n".join(lines)


@dataclass
class Fitted:
    """A learned memory, before it is put in place.

    Attributes:
        settled: What was chosen.
        memory: The memory with its codes, filled.
        tolerance: (J,) how far the reference may be from a joint, rad or m.
        report: For people.
    """

    settled: Settled
    memory: Recalling | Timed
    tolerance: Tensor
    report: FitReport


@torch.no_grad()
def fit(config: HASMConfig, body: Body, episodes: Iterable[Recording]) -> Fitted:
    """Learn episodes.

    Args:
        config: Settings of the method; what they leave open is chosen by held-out prediction.
        body: Joints and skin of the robot.
        episodes: Recordings of the body.

    Returns:
        What was learned.

    Raises:
        ValueError: If there is no episode, no touch, no motion, or a value is not finite.
    """
    if iter(episodes) is episodes:
        episodes = list(episodes)  # they are read more than once
    threshold, current = calibrate(config, body, episodes)
    skinless = not body.channels and config.drive == "auto"
    settled = Settled(
        touch="patch",
        value="displacement",
        readout="mean",
        drive="time" if skinless or config.drive == "time" else "spike",
        beta=0.0,
        joints=[],
        moved=[],
        angle=0.0,
        threshold=threshold,
        current_per_newton=current,
        capacity=0,
        taught=[],
    )
    if settled.drive == "time":
        return _fit_timed(config, body, settled, episodes)
    found = collect(config, body, settled, episodes)
    if config.drive == "auto" and found.led < LED_BY_TOUCH:
        return _fit_timed(config, body, replace(settled, drive="time"), episodes)
    if not len(found.samples) or not len(found.phases):
        raise ValueError(
            f"none of the {found.episodes} episodes holds a touch that makes a neuron spike; "
            "check the tactile feature's unit (N) and current_per_newton"
        )
    moved = _moved(body, found)
    settled = replace(
        settled,
        moved=sorted(set().union(*moved.values())),
        moved_by=moved,
        density=[float(found.phases.density.min()), float(found.phases.density.max())],
        observed=_observed(found.samples.observation),
    )
    choice = choose(config, body, settled, found)
    table, values = _rows(config, body, choice.settled, found)
    taught = [body.patches[p] for p in np.unique(table.patch)]
    settled = replace(choice.settled, capacity=len(table), taught=taught)
    memory = Recalling(config, body, settled)
    origins = torch.from_numpy(np.stack([table.episode, table.frame, table.patch], axis=1))
    memory.fill(table_codes(config, body, settled, table), values, origins)
    choices = {
        "drive": settled.drive,
        "touch": settled.touch,
        "value": settled.value,
        "readout": settled.readout,
        "βD": f"{settled.beta * memory.code.code_dim:.3g}",
        "joints": " ".join(body.joints[j] for j in settled.joints),
    }
    report = FitReport(found.episodes, len(table), taught, choices, choice.errors)
    return Fitted(settled, memory, tolerance_of(body, found.lag), report)


def _fit_timed(
    config: HASMConfig, body: Body, settled: Settled, episodes: Iterable[Recording]
) -> Fitted:
    """Learn the episodes of a robot that time moves on."""
    series = [timed_series(config, body, settled, e, number) for number, e in enumerate(episodes)]
    if not series:
        raise ValueError("no episode to learn from: expected at least one")
    settled = replace(settled, value="displacement", readout="first_order", taught=body.patches)
    settled, errors = choose_timed(config, body, settled, series)
    rows = moments(series, settled.past, config.horizon)
    settled = replace(settled, capacity=len(rows.state), moved=list(range(len(body.joints))))
    memory = stored(config, body, settled, rows)
    choices = {
        "drive": settled.drive,
        "frames back": " ".join(map(str, settled.past)),
        "touch": f"{settled.flip:g} of the code",
        "trend": str(settled.trend),
        "βD": f"{settled.beta * memory.code_dim:.3g}",
        "joints": " ".join(body.joints[j] for j in settled.joints),
    }
    report = FitReport(len(series), settled.capacity, settled.taught, choices, errors)
    return Fitted(settled, memory, tolerance_of(body, np.zeros(len(body.joints))), report)


def timed_series(
    config: HASMConfig, body: Body, settled: Settled, episode: Recording, number: int
) -> Series:
    """One episode of a robot that time moves on: measured positions and rate densities."""
    state, _ = positions_of(body, episode, number)
    if not body.channels:
        return Series(torch.from_numpy(state), torch.zeros(len(state), 0, dtype=torch.float64))
    density = felt(config, body, settled, episode).density
    return Series(torch.from_numpy(state), torch.from_numpy(density))


def tolerance_of(body: Body, lag: Array) -> Tensor:
    """How far the reference may be from each joint, (J,), rad or m."""
    return torch.from_numpy(LAG_FACTOR * lag + LAG_SECONDS * np.array(body.max_speed)).float()


def _moved(body: Body, found: Collected) -> dict[str, list[int]]:
    """Joints that the touches of each patch move."""
    span = np.array(body.upper) - np.array(body.lower)
    least = np.where(
        np.isfinite(span), MOVED_SHARE * span, MOVED_SECONDS * np.array(body.max_speed)
    )
    travel = np.ptp(found.phases.moved, axis=1)
    moved = {
        body.patches[patch]: np.flatnonzero(
            travel[found.phases.patch == patch].max(axis=0) > least
        ).tolist()
        for patch in np.unique(found.phases.patch)
    }
    if not any(moved.values()):
        raise ValueError(
            f"no joint moves under touch in any of the {found.episodes} episodes: expected one to "
            f"travel more than {MOVED_SHARE:.0%} of its range"
        )
    return moved


def _observed(observations: Array) -> list[list[float]]:
    """Range over which each entry is coded."""
    ranges = []
    for column in observations.T:
        low, high = float(column.min()), float(column.max())
        room = OBSERVED_MARGIN * (high - low) or 1e-3 * max(1.0, abs(high))
        ranges.append([low - room, high + room])
    return ranges


def _rows(
    config: HASMConfig, body: Body, settled: Settled, found: Collected
) -> tuple[Table, Tensor]:
    """What the memory stores: keys and values."""
    if settled.value == "successor":
        return _walk(config, body, settled, found)
    table = found.samples if settled.value == "displacement" else found.phases
    values, _ = recalled_values(body, settled, table)
    if settled.readout == "first_order":
        x, _ = covariates(settled, table)
        values = torch.from_numpy(stored_values(values.double().numpy(), x)).float()
    return table, values


def _walk(
    config: HASMConfig, body: Body, settled: Settled, found: Collected
) -> tuple[Table, Tensor]:
    """States and the states that follow them: of distinct ones, or of all samples."""
    anchored = np.array([j in body.limited for j in settled.moved])
    if not config.distinct:
        table = found.samples
        onward = table.moved[:, settled.moved]
        following = np.where(anchored, table.positions[:, settled.moved], 0.0) + onward
        values = np.concatenate([following, table.spikes[:, None]], axis=1)
        return table, torch.from_numpy(values).float()
    tables, stored_rows = [], []
    coder = PlaceCode(
        [body.lower[j] for j in settled.joints],
        [body.upper[j] for j in settled.joints],
        config.neurons,
        config.bits,
        config.width,
        config.code,
    )
    for patch in np.unique(found.phases.patch):
        states = _states(body, found.phases.rows(found.phases.patch == patch))
        codes = coder(torch.from_numpy(states.positions[:, settled.joints]).float())
        phase = torch.arange(len(states)) // COURSE_POINTS
        links = distinct_links(codes, phase, config.resolution)
        source, target, left, entered = (x.numpy() for x in links)
        onward = (states.positions[target] - states.positions[source])[:, settled.moved]
        following = np.where(anchored, states.positions[target][:, settled.moved], onward)
        spent = np.maximum(states.spikes[entered] - states.spikes[left], 0.0)
        tables.append(states.rows(source))
        stored_rows.append(np.concatenate([following, spent[:, None]], axis=1))
    return joined(tables), torch.from_numpy(np.concatenate(stored_rows)).float()


def _states(body: Body, phases: Table) -> Table:
    """The points of courses as samples, whose spikes count from the beginning of the course."""
    count, base = len(phases), base_indices(body)
    yaw = phases.positions[:, None, base[2]] if base else 0.0
    positions = phases.positions[:, None] + out_of_base(phases.moved, yaw, base)
    spread = np.linspace(0.0, 1.0, COURSE_POINTS)
    repeated = {
        name: np.repeat(vars(phases)[name], COURSE_POINTS, axis=0)
        for name in ("density", "patch", "observation", "episode", "frame")
    }
    return Table(
        positions=positions.reshape(count * COURSE_POINTS, -1),
        moved=np.zeros((count * COURSE_POINTS, len(body.joints))),
        spikes=(phases.spikes[:, None] * spread).ravel(),
        direction=phases.direction.reshape(-1, 3),
        **repeated,
    )
