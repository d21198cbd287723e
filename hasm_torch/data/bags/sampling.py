"""A bag as one recording at a fixed rate: joints, commands and skins paired by time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.data.bags.joints import JointReader, chosen, commanded
from hasm_torch.data.bags.pairing import Array, Series, Times, last, paired
from hasm_torch.data.bags.reading import Bag
from hasm_torch.data.bags.skins import SkinReader, SkinTopic, at_rest

Missing = Literal["hold", "nan", "error"]


@dataclass
class Sampling:
    """How readings are paired.

    Attributes:
        fps: Samples a second.
        window_s: How far a reading may lie from its sample, s.
        missing: What a cell reads that reported nothing within the window: "hold" is its last
            reading, at first its baseline; "nan" is NaN; "error" refuses the recording.
        baseline_s: Seconds at the start in which nothing touches the skin: their mean is the
            baseline of each cell; 0 takes readings as they come.
    """

    fps: int = 50
    window_s: float = 0.02
    missing: Missing = "hold"
    baseline_s: float = 2.0


class Skin(NamedTuple):
    """What one patch read.

    Attributes:
        cells: (sensor, number) of each cell.
        readings: (T, cells, channels), baseline and gain applied.
        unit: Unit of the sensor.
    """

    cells: list[tuple[str, int]]
    readings: Array
    unit: str


@dataclass
class Recording:
    """A bag at a fixed rate.

    Attributes:
        joints: Names of the joints.
        state: (T, joints) measured positions.
        action: (T, joints) targets: the last command, without any the next state.
        skins: Patches by name.
        notes: What the skin did at rest and where it did not report, for people.
    """

    joints: list[str]
    state: Array
    action: Array
    skins: dict[str, Skin]
    notes: list[str] = field(default_factory=list)


def sample(
    bag: Bag,
    state: str,
    joints: Sequence[str],
    actions: Sequence[str],
    skins: Mapping[str, SkinTopic],
    sampling: Sampling,
) -> Recording:
    """Pair what a bag holds.

    Args:
        bag: The bag, open.
        state: Topic of the joint states.
        joints: Names of the joints; none takes all of them in alphabetical order.
        actions: Topics of commands, of which a later one goes before an earlier one.
        skins: Patches by name.
        sampling: How they are paired.

    Returns:
        Samples from when all topics have begun until the joint states end.

    Raises:
        ValueError: A topic is not there, of the wrong type or empty, or has a gap.
    """
    measured = JointReader(state, bag.type_of(state))
    commands = [JointReader(t, bag.type_of(t), commands=True, joints=[*joints]) for t in actions]
    patches = [SkinReader(name, skin, bag.type_of(skin.topic)) for name, skin in skins.items()]
    listeners: list[tuple[str, JointReader | SkinReader]] = [(state, measured)]
    listeners += [(reader.topic, reader) for reader in commands]
    listeners += [(patch.skin.topic, patch) for patch in patches]
    wanted: dict[str, set[str]] = {}
    for topic, reader in listeners:
        wanted.setdefault(topic, set()).update(reader.wanted)
    for heard in bag.read(wanted):
        for topic, reader in listeners:
            if topic == heard.topic:
                reader.take(heard)

    series = measured.series()
    if series is None:
        raise ValueError(f"{bag.path}: topic {state} holds no joint positions")
    names = [*joints] or sorted(name for name, _ in series.entries)
    positions = chosen(series, names, state)
    felt = [patch.series() for patch in patches]
    begin = max(int(s.times[0]) for s in (positions, *felt))
    length = (int(positions.times[-1]) - begin) * sampling.fps // 10**9 + 1
    if length < 2:
        raise ValueError(f"{bag.path}: {state} ends before the topics of the skin begin")
    at = begin + np.arange(length) * 10**9 // sampling.fps
    window = round(sampling.window_s * 1e9)
    path = _without_gaps(paired(positions, at, window), at, names, f"{bag.path}, topic {state}")
    action = np.concatenate([path[1:], path[-1:]])
    for reader in commands:
        orders = reader.series()
        if orders is not None:
            target = commanded(orders, names, at)
            action = np.where(np.isnan(target), action, target)
    recording = Recording(names, path, action, {})
    for patch, readings in zip(patches, felt, strict=True):
        recording.skins[patch.name], notes = _skin(patch, readings, at, window, sampling)
        recording.notes += notes
    return recording


def _without_gaps(state: Array, at: Times, joints: list[str], what: str) -> Array:
    missing = np.isnan(state[:, :, 0])
    if missing.any():
        length, start, joint = longest_gap(missing)
        lacking = ", ".join(np.array(joints)[missing.any(axis=0)])
        raise ValueError(
            f"{what}: no position of {lacking} within the window of some samples, the longest gap "
            f"{_span(at, length, start)} ({joints[joint]}): give a larger --window_s, cut the bag "
            "there, or name the joints that are wanted with --joints"
        )
    return state[:, :, 0]


def _skin(
    patch: SkinReader, series: Series, at: Times, window: int, sampling: Sampling
) -> tuple[Skin, list[str]]:
    skin, notes = patch.skin, []
    try:
        rest = at_rest(series, sampling.baseline_s, int(at[0]), skin.gain)
    except ValueError as error:
        raise ValueError(f"skin {patch.name}: {error}") from error
    if sampling.baseline_s:
        low, high = rest.baseline.min(), rest.baseline.max()
        notes.append(f"skin {patch.name}: baseline {low:.4g} to {high:.4g} in the sensor's unit")
    readings = paired(series, at, window)
    missing = np.asarray(np.isnan(readings).any(axis=2))
    if missing.any():
        length, start, cell = longest_gap(missing)
        name = " ".join(str(part) for part in series.entries[cell] if part != "")
        told = (
            f"skin {patch.name}: {missing.mean():.2%} of the readings did not come within the "
            f"window, the longest gap {_span(at, length, start)} (cell {name})"
        )
        if sampling.missing == "error":
            raise ValueError(f"{told}: give a larger --window_s, or --missing=hold or nan")
        notes.append(f"{told}: {'held' if sampling.missing == 'hold' else 'NaN'}")
    if sampling.missing == "hold" and missing.any():
        readings = np.where(np.isnan(readings), last(series, at), readings)
        readings = np.where(np.isnan(readings), rest.baseline, readings)
    readings = ((readings - rest.baseline) * rest.gain).astype(np.float32)
    unit = "noise" if skin.gain == "noise" else patch.kind.unit
    return Skin(series.entries, readings, unit), notes


def longest_gap(missing: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Length, first row and column of the longest run of true rows in (T, E)."""
    change = np.diff(np.pad(missing.T, ((0, 0), (1, 1))).astype(np.int8))
    starts, ends = np.argwhere(change == 1), np.argwhere(change == -1)
    lengths = ends[:, 1] - starts[:, 1]
    longest = int(lengths.argmax())
    column, start = starts[longest].tolist()
    return int(lengths[longest]), start, column


def _span(at: Times, length: int, start: int) -> str:
    period = (at[1] - at[0]) / 1e9
    return f"{length * period:.3f} s from {(at[start] - at[0]) / 1e9:.3f} s on"
