"""Learning: from episodes to a memory, with everything chosen that the settings leave open.

    episodes ──collect──► lessons ──settle──► settings ──build──► memory

``fit`` does all of it and changes nothing: ``HASM.fit`` puts what it returns in place. An episode
that is learned later is a lesson more: what ``facts_of`` and ``rows`` say of it is what they would
have said in the beginning.
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
from hasm_torch.model.collect import collect
from hasm_torch.model.felt import Recording, calibrate
from hasm_torch.model.frames import base_indices, out_of_base
from hasm_torch.model.lessons import COURSE_POINTS, Lessons
from hasm_torch.model.moments import moments
from hasm_torch.model.readout import stored_values
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.table import Table, joined
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
        lessons: What every episode taught.
        report: For people.
    """

    settled: Settled
    memory: Recalling | Timed
    lessons: Lessons
    report: FitReport


@torch.no_grad()
def fit(config: HASMConfig, body: Body, episodes: Iterable[Recording], first: int = 0) -> Fitted:
    """Learn episodes.

    Args:
        config: Settings of the method; what they leave open is chosen by held-out prediction.
        body: Joints and skin of the robot.
        episodes: Recordings of the body.
        first: Number of the first one.

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
    lessons = read(config, body, settled, episodes, first)
    if config.drive == "auto" and settled.drive == "spike" and lessons.led() < LED_BY_TOUCH:
        settled = replace(settled, drive="time")
        lessons = read(config, body, settled, episodes, first)
    return settle(config, body, settled, lessons)


def read(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    episodes: Iterable[Recording],
    first: int = 0,
) -> Lessons:
    """Read episodes, one at a time; arguments as in ``fit``."""
    lessons = Lessons(body)
    lessons.next = first
    for number, episode in enumerate(episodes, first):
        lessons.add(collect(config, body, settled, episode, number))
    if not len(lessons):
        raise ValueError("no episode to learn from: expected at least one")
    return lessons


def settle(config: HASMConfig, body: Body, settled: Settled, lessons: Lessons) -> Fitted:
    """Choose what the settings leave open, and build the memory.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: With the drive, threshold and current of the skin.
        lessons: What the episodes taught.
    """
    if settled.drive == "time":
        return _settle_timed(config, body, settled, lessons)
    settled = facts_of(body, settled, lessons)
    choice = choose(config, body, settled, lessons.samples, lessons.phases)
    settled = replace(choice.settled, chosen_from=len(lessons))
    settled, memory = build(config, body, settled, lessons)
    return Fitted(settled, memory, lessons, reported(body, settled, memory, lessons, choice.errors))


def _settle_timed(config: HASMConfig, body: Body, settled: Settled, lessons: Lessons) -> Fitted:
    """The same for a robot that time moves on."""
    settled = replace(
        settled,
        value="displacement",
        readout="first_order",
        taught=body.patches,
        moved=list(range(len(body.joints))),
    )
    settled, errors = choose_timed(config, body, settled, lessons.series)
    settled = replace(settled, chosen_from=len(lessons))
    settled, memory = build(config, body, settled, lessons)
    return Fitted(settled, memory, lessons, reported(body, settled, memory, lessons, errors))


def reported(
    body: Body,
    settled: Settled,
    memory: Recalling | Timed,
    lessons: Lessons,
    errors: dict[str, dict[str, float]],
) -> FitReport:
    """What was learned and chosen, and the errors of what was tried, for people."""
    if settled.drive == "time":
        chosen = {
            "frames back": " ".join(map(str, settled.past)),
            "touch": f"{settled.flip:g} of the code",
            "trend": str(settled.trend),
        }
    else:
        chosen = {"touch": settled.touch, "value": settled.value, "readout": settled.readout}
    choices = {
        "drive": settled.drive,
        **chosen,
        "βD": f"{settled.beta * memory.code_dim:.3g}",
        "joints": " ".join(body.joints[j] for j in settled.joints),
    }
    return FitReport(len(lessons), settled.capacity, settled.taught, choices, errors)


def build(
    config: HASMConfig, body: Body, settled: Settled, lessons: Lessons
) -> tuple[Settled, Recalling | Timed]:
    """The memory of some lessons under what was chosen, and its capacity settled."""
    if settled.drive == "time":
        found = moments(lessons.series, settled.past, config.horizon)
        number = torch.tensor([x.number for x in lessons if x.series is not None])
        found = found._replace(episode=number[found.episode])
        return replace(settled, capacity=len(found.state)), stored(config, body, settled, found)
    keys, values = rows(config, body, settled, lessons.samples, lessons.phases)
    taught = [body.patches[p] for p in np.unique(keys.patch)]
    settled = replace(settled, capacity=len(keys), taught=taught)
    memory = Recalling(config, body, settled)
    memory.append(table_codes(config, body, settled, keys), values, keys)
    return settled, memory


def tolerance_of(body: Body, lag: Array) -> Tensor:
    """How far the reference may be from each joint, (J,), rad or m."""
    return torch.from_numpy(LAG_FACTOR * lag + LAG_SECONDS * np.array(body.max_speed)).float()


def facts_of(body: Body, settled: Settled, lessons: Lessons) -> Settled:
    """What follows from the lessons without choosing: ranges, and which joints a touch moves.

    Raises:
        ValueError: If no lesson holds a touch, or no touch moves a joint.
    """
    span = np.array(body.upper) - np.array(body.lower)
    least = np.where(
        np.isfinite(span), MOVED_SHARE * span, MOVED_SECONDS * np.array(body.max_speed)
    )
    patches = sorted(set().union(*(lesson.travel for lesson in lessons)))
    if not patches or not any(len(lesson.samples) for lesson in lessons):
        raise ValueError(
            f"none of the {len(lessons)} episodes holds a touch that makes a neuron spike; "
            "check the tactile feature's unit (N) and current_per_newton"
        )
    moved = {}
    for patch in patches:
        travel = [lesson.travel[patch] for lesson in lessons if patch in lesson.travel]
        moved[body.patches[patch]] = np.flatnonzero(np.max(travel, axis=0) > least).tolist()
    if not any(moved.values()):
        raise ValueError(
            f"no joint moves under touch in any of the {len(lessons)} episodes: expected one to "
            f"travel more than {MOVED_SHARE:.0%} of its range"
        )
    lowest, highest = np.array([lesson.density for lesson in lessons]).T
    return replace(
        settled,
        moved=sorted(set().union(*moved.values())),
        moved_by=moved,
        density=[float(lowest.min()), float(highest.max())],
        observed=_observed(np.array([lesson.observed for lesson in lessons])),
    )


def _observed(ranges: Array) -> list[list[float]]:
    """Range over which each entry is coded, from the lessons' own ranges (N, 2, O)."""
    coded = []
    for low, high in zip(ranges[:, 0].min(0).tolist(), ranges[:, 1].max(0).tolist()):
        room = OBSERVED_MARGIN * (high - low) or 1e-3 * max(1.0, abs(high))
        coded.append([low - room, high + room])
    return coded


def rows(
    config: HASMConfig, body: Body, settled: Settled, samples: Table, phases: Table
) -> tuple[Table, Tensor]:
    """What the memory stores of some samples and phases: keys and values."""
    if settled.value == "successor":
        return _walk(config, body, settled, samples, phases)
    table = samples if settled.value == "displacement" else phases
    values, _ = recalled_values(body, settled, table)
    if settled.readout == "first_order":
        x, _ = covariates(settled, table)
        values = torch.from_numpy(stored_values(values.double().numpy(), x)).float()
    return table, values


def _walk(
    config: HASMConfig, body: Body, settled: Settled, samples: Table, phases: Table
) -> tuple[Table, Tensor]:
    """States and the states that follow them: of distinct ones, or of all samples."""
    anchored = np.array([j in body.limited for j in settled.moved])
    if not config.distinct:
        table = samples
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
    for patch in np.unique(phases.patch):
        states = _states(body, phases.rows(phases.patch == patch))
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
