"""Skins: which messages hold readings of cells, and where in them."""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.data.bags.decode import Leaf
from hasm_torch.data.bags.messages import XELA_STREAMS
from hasm_torch.data.bags.pairing import Array, Collector, Series
from hasm_torch.data.bags.reading import Heard

Fields = dict[str, list[Leaf]]
UNNAMED = np.array([[b""]])
AXES = ("x", "y", "z")


@dataclass
class SkinTopic:
    """A patch of skin in a bag.

    Attributes:
        topic: Where its readings come from.
        sensor: Which of the topic's sensors it is (the name in ``tactile_msgs/TactileState``, the
            position in Xela's stream); by default all of them, side by side.
        cells: Numbers of its cells, in their order in the dataset; by default those that reported
            in any of the bags, in rising order. A cell that none reports is only known from here.
        read: What is read of a cell: "force", "prox", "acc" or "temp" of TUM's skin, "forces" or
            "taxels" of Xela's; by default the force.
        channels: Readings a cell where a message holds a plain list: 3 forces, 1 pressure or 6 of a
            wrench; by default 3 of an array (as AnySkin's magnetometers), 1 of a TactileState.
        gain: Factor from the sensor's unit to the dataset's, or "noise": readings count in standard
            deviations of what the cell reads in the first seconds.
        link: Link that carries the patch.
        normals: Outward normal of each cell in the link's frame, or one for all.
    """

    topic: str = ""
    sensor: str = ""
    cells: list[int] = field(default_factory=list)
    read: str = ""
    channels: int = 0
    gain: float | Literal["noise"] = 1.0
    link: str = ""
    normals: list[list[float]] = field(default_factory=list)


def _tum(fields: Fields, skin: SkinTopic, times: NDArray[np.int64], into: Collector) -> None:
    values = fields[f"data.{skin.read or 'force'}"]
    cells = {len(leaf.values[0]) for leaf in values} - {0}  # a cell may leave a reading out
    for width in cells:
        mine = [i for i, leaf in enumerate(values) if leaf.values.shape[1] == width]
        numbers = np.concatenate([fields["data.cellId"][i].values for i in mine], axis=1)
        read = np.stack([values[i].values for i in mine], axis=1)
        into.add(times, UNNAMED, numbers.astype(np.int64), read)


def _tactile_state(
    fields: Fields, skin: SkinTopic, times: NDArray[np.int64], into: Collector
) -> None:
    for name, values in zip(fields["sensors.name"], fields["sensors.values"], strict=True):
        _flat(values.values, name.values, skin.channels or 1, times, into)


def _array(fields: Fields, skin: SkinTopic, times: NDArray[np.int64], into: Collector) -> None:
    _flat(fields["data"][0].values, UNNAMED, skin.channels or 3, times, into)


def _flat(
    values: NDArray[np.generic],
    names: NDArray[np.bytes_],
    channels: int,
    times: NDArray[np.int64],
    into: Collector,
) -> None:
    cells, rest = divmod(values.shape[1], channels)
    if rest:
        raise ValueError(
            f"{values.shape[1]} values a message are no cells of {channels} readings each: give "
            "the skin's channels"
        )
    into.add(times, names, np.arange(cells)[None], values.reshape(len(times), cells, channels))


def _xela(fields: Fields, skin: SkinTopic, times: NDArray[np.int64], into: Collector) -> None:
    read = skin.read or "forces"
    axes = [fields[f"sensors.{read}.{axis}"] for axis in AXES]
    for (sensor,), position in fields["sensors.sensor_pos"]:
        mine = [i for i, leaf in enumerate(axes[0]) if leaf.where[0] == sensor]
        if mine:
            values = [np.concatenate([axis[i].values for i in mine], axis=1) for axis in axes]
            numbers = np.arange(len(mine))[None]
            into.add(times, position.astype("S"), numbers, np.stack(values, axis=2))


def _wrench(fields: Fields, skin: SkinTopic, times: NDArray[np.int64], into: Collector) -> None:
    values = [fields[f"wrench.{part}.{a}"][0].values for part in ("force", "torque") for a in AXES]
    into.add(times, UNNAMED, np.array([[0]]), np.stack(values, axis=2))


class Kind(NamedTuple):
    """A kind of skin.

    Attributes:
        wanted: Fields of its messages; "*" stands for what ``SkinTopic.read`` says.
        fields: What that may be, the first by default.
        take: Takes the readings of some messages in.
        unit: Unit of its readings where that is known.
    """

    wanted: tuple[str, ...]
    fields: tuple[str, ...]
    take: Callable[[Fields, SkinTopic, NDArray[np.int64], Collector], None]
    unit: str = "unknown"


_XELA = Kind(
    ("sensors.sensor_pos", *(f"sensors.*.{axis}" for axis in AXES)), ("forces", "taxels"), _xela
)
KINDS = {
    "tum_ics_skin_msgs/msg/SkinCellDataArray": Kind(
        ("data.cellId", "data.*"), ("force", "prox", "acc", "temp"), _tum
    ),
    "tactile_msgs/msg/TactileState": Kind(("sensors.name", "sensors.values"), (), _tactile_state),
    **dict.fromkeys(XELA_STREAMS, _XELA),
    **{
        f"std_msgs/msg/{number}MultiArray": Kind(("data",), (), _array)
        for number in ("Float32", "Float64", "Int16", "UInt16", "Int32", "UInt32")
    },
    "geometry_msgs/msg/WrenchStamped": Kind(
        tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in AXES),
        (),
        _wrench,
        "N",
    ),
}


class SkinReader:
    """Reads one patch.

    Args:
        name: Name of the patch.
        skin: Where it is.
        message_type: Type of the topic's messages.

    Raises:
        ValueError: Messages of this type are no skin, or do not hold the field.
    """

    def __init__(self, name: str, skin: SkinTopic, message_type: str) -> None:
        if message_type not in KINDS:
            raise ValueError(
                f"topic {skin.topic} holds {message_type}, which is no skin that can be read; "
                "these can:" + "".join(f"\n  {kind}" for kind in KINDS)
            )
        self.name, self.skin, self.kind = name, skin, KINDS[message_type]
        if skin.read and skin.read not in self.kind.fields:
            raise ValueError(
                f"skin {name}: {message_type} has no field {skin.read!r}; valid: "
                f"{', '.join(self.kind.fields) or 'none, leave it out'}"
            )
        read = skin.read or next(iter(self.kind.fields), "")
        self.wanted = {path.replace("*", read) for path in self.kind.wanted}
        self._collector = Collector()

    def take(self, heard: Heard) -> None:
        """Take the readings of some messages in."""
        try:
            self.kind.take(heard.fields, self.skin, heard.times, self._collector)
        except ValueError as error:
            raise ValueError(f"skin {self.name}: {error}") from error

    def series(self) -> Series:
        """All readings of the patch.

        Raises:
            ValueError: There are none.
        """
        series = self._collector.series()
        sensors = sorted({name for name, _ in series.entries} if series else (), key=_natural)
        wanted = self.skin.sensor or None
        if series is None or (wanted is not None and wanted not in sensors):
            raise ValueError(
                f"skin {self.name}: topic {self.skin.topic} holds no readings"
                + (f" of sensor {wanted!r}; its sensors: {', '.join(sensors)}" if wanted else "")
                + (f": try another field of {self.kind.fields}" if self.kind.fields else "")
            )
        cells = self.skin.cells
        mine = [
            i
            for i, (name, number) in enumerate(series.entries)
            if wanted in (None, name) and (not cells or number in cells)
        ]
        if len(mine) == len(series.entries):
            return series
        entries = [series.entries[i] for i in mine]
        return series._replace(entries=entries, values=series.values[:, mine])


def in_order(found: Collection[tuple[str, int]], cells: Sequence[int]) -> list[tuple[str, int]]:
    """The cells of a patch in their order: sensors by name, then ``cells``, else by number."""
    sensors = sorted({name for name, _ in found}, key=_natural)
    if cells:
        return [(name, number) for name in sensors for number in cells]
    return sorted(found, key=lambda cell: (_natural(cell[0]), cell[1]))


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts "2" before "10"."""
    return [
        (int(part or 0), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)
    ]


class Rest(NamedTuple):
    """What a patch reads at rest.

    Attributes:
        baseline: (E, channels) mean reading.
        gain: (E, channels) factor, or a number.
    """

    baseline: Array
    gain: Array | float


def at_rest(series: Series, seconds: float, start: int, gain: float | Literal["noise"]) -> Rest:
    """Baseline and gain from the first seconds, in which nothing touches the skin.

    A cell that does not report in them rests where the others of its patch do in the middle.

    Args:
        series: Readings of the patch.
        seconds: How long; 0 takes readings as they are.
        start: When they begin, ns.
        gain: Factor, or "noise" for the inverse of the standard deviation, at least that of
            rounding to the smallest step between two readings of the patch.

    Raises:
        ValueError: Nothing reports in these seconds, or there are none for the gain.
    """
    if not seconds:
        if gain == "noise":
            raise ValueError("the gain noise is taken from the first seconds: give --baseline_s")
        return Rest(np.zeros(series.values.shape[1:], np.float32), gain)
    rows = (series.times >= start) & (series.times <= start + round(seconds * 1e9))
    values = series.values[rows].astype(np.float64)
    silent = np.isnan(values).any(axis=2).all(axis=0)
    if silent.all():
        raise ValueError(
            f"no cell reports in the first {seconds:g} s, from which its baseline is taken: give "
            "other --baseline_s, or 0 for none"
        )
    baseline, noise = np.zeros(values.shape[1:]), np.zeros(values.shape[1:])
    baseline[~silent] = np.nanmean(values[:, ~silent], axis=0)
    noise[~silent] = np.nanstd(values[:, ~silent], axis=0)
    baseline[silent] = np.median(baseline[~silent], axis=0)
    noise[silent] = np.median(noise[~silent], axis=0)
    if gain != "noise":
        return Rest(baseline.astype(np.float32), gain)
    some = series.values[:: 1 + len(series.values) // 4096]  # enough to meet neighbouring levels
    levels = np.unique(some[np.isfinite(some)])
    step = float(np.diff(levels).min()) if len(levels) > 1 else 1.0
    return Rest(baseline.astype(np.float32), (1 / np.maximum(noise, step / 12**0.5)).astype("f4"))
