"""Demonstrations of a LeRobot v3.0 dataset as arrays, one `Episode` each."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.data.checks import (
    check_finite,
    check_owner,
    check_spans,
    check_tasks,
    check_time,
)
from hasm_torch.data.skin import (
    UNKNOWN_UNIT,
    SkinPatch,
    feature_names,
    held,
    same_skin,
    skin_from_info,
    tactile_layout,
)
from hasm_torch.episode import ACTION, STATE, TACTILE, Episode

PICTURES = ("image", "video")


@dataclass(eq=False)
class EpisodeSet:
    """The demonstrations of one dataset and what their columns mean.

    Attributes:
        episodes: The demonstrations: a list, or read from disk at every iteration.
        fps: Frames per second.
        joints: Names of the state's entries.
        units: Units of the state's entries (``rad``, ``m``, ``deg``; ``unknown`` if not stated).
        skin: Patches by name, or None without skin.
        root: Folder of the dataset.
        action_names: Names of the action's entries as the dataset has them; where they are the
            joints in another order, the episodes have them in the order of the joints.
        unused: Names of pictures and videos that the dataset has besides.
        observations: Number of entries of each further observation that is bound, by feature.
    """

    episodes: Sequence[Episode]
    fps: float
    joints: tuple[str, ...]
    units: tuple[str, ...]
    skin: dict[str, SkinPatch] | None
    root: Path
    action_names: tuple[str, ...]
    observations: dict[str, int] = field(default_factory=dict)
    unused: tuple[str, ...] = ()

    @property
    def reordered(self) -> list[int]:
        """Entry of the action that is each joint's target; empty where the order is the same."""
        same = self.action_names == self.joints
        if same or sorted(self.action_names) != sorted(self.joints):
            return []
        return [self.action_names.index(joint) for joint in self.joints]

    def __len__(self) -> int:
        return len(self.episodes)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.episodes)


@dataclass(frozen=True)
class FeatureMap:
    """Which features of the dataset are read.

    Attributes:
        state: Joint positions.
        tactile: Skin readings: cells x 3 forces, cells x 1 pressure, or wrenches of 6. None reads
            no skin; a dataset may lack the usual feature, but not one of another name.
        action: Joint targets.
        bound: Further observations to bind, such as an object's position; None takes those that
            the dataset declares by ``"bind": true`` in the feature's ``info``.
    """

    state: str = STATE
    tactile: str | None = TACTILE
    action: str = ACTION
    bound: list[str] | None = None


def load_episodes(
    root: str | Path,
    features: FeatureMap | None = None,
    tolerance_s: float = 1e-4,
    most_bytes: float = math.inf,
) -> EpisodeSet:
    """Reads a LeRobot v3.0 dataset from disk.

    Args:
        root: Folder of the dataset (the one that holds ``meta`` and ``data``).
        features: Names of the features to read; LeRobot's usual names by default.
        tolerance_s: How far a frame may lie from one period after the frame before it, s.
        most_bytes: Most memory for the frames. Episodes of a dataset that is larger are read anew
            at every iteration, one at a time, and checked when they are reached.

    Returns:
        Every episode of the dataset. Cells that did not report hold their last reading, where the
        dataset declares their NaN by ``"missing": "nan"`` in the tactile feature's ``info``.

    Raises:
        FileNotFoundError: There is no dataset, or a file of it is missing.
        ValueError: The dataset is of another format, empty or damaged, lacks a feature, or holds
            values that are not finite, of another shape than declared, or not at its frame rate.
    """
    from hasm_torch.data import parquet  # loads pyarrow

    root, names = Path(root), features or FeatureMap()
    info = parquet.read_info(root)
    declared = info["features"]
    tactile = names.tactile
    if tactile == TACTILE and tactile not in declared:
        tactile = None
    used = (names.state, names.action, tactile)
    bound = names.bound
    if bound is None:
        wanted = (key for key in declared if (declared[key].get("info") or {}).get("bind"))
        bound = [key for key in wanted if key not in used]
    shapes = {key: _shape(declared, key, root) for key in (*used, *bound) if key}
    rows = parquet.read_episode_rows(root)
    borders = (rows[f"dataset_{end}_index"].tolist() for end in ("from", "to"))
    spans = list(zip(*borders, strict=True))
    check_spans(spans, root)
    layout = tactile_layout(declared[tactile], tactile) if tactile else None
    joints = _entry_names(declared[names.state], names.state)
    data = EpisodeSet(
        episodes=[],
        fps=float(info["fps"]),
        joints=joints,
        units=_units(declared[names.state], len(joints), names.state),
        skin=skin_from_info(declared[tactile], *layout, tactile) if tactile and layout else None,
        root=root,
        action_names=_entry_names(declared[names.action], names.action),
        observations={key: prod(shapes[key]) for key in bound},
        unused=tuple(key for key in declared if declared[key].get("dtype") in PICTURES),
    )
    stored = _Stored(
        data=data,
        names=replace(names, tactile=tactile),
        shapes={**shapes, "timestamp": (), "episode_index": (), "task_index": ()},
        files=_data_files(root, info, rows),
        indices=rows["episode_index"].tolist(),
        spans=spans,
        layout=layout,
        gaps=bool(tactile and (declared[tactile].get("info") or {}).get("missing") == "nan"),
        tasks=np.array(parquet.read_tasks(root), dtype=object),
        tolerance_s=tolerance_s,
    )
    data.episodes = stored if stored.nbytes > most_bytes else list(stored)
    return data


def load_all(
    roots: Sequence[Path], features: FeatureMap | None = None, most_bytes: float = math.inf
) -> EpisodeSet:
    """The episodes of several datasets of one robot, one dataset after the other.

    Args:
        roots: Their folders, at least one.
        features: See ``load_episodes``.
        most_bytes: See ``load_episodes``, for each dataset.

    Raises:
        FileNotFoundError, ValueError: See ``load_episodes``.
        ValueError: If two differ in joints, skin, frame rate or what is bound.
    """
    sets = [load_episodes(root, features, most_bytes=most_bytes) for root in roots]
    first = sets[0]
    for other in sets[1:]:
        for what in ("fps", "joints", "units", "action_names", "observations"):
            mine, theirs = getattr(first, what), getattr(other, what)
            if mine != theirs:
                raise ValueError(
                    f"datasets that are learned together must have the same {what}: {first.root} "
                    f"has {mine}, {other.root} has {theirs}"
                )
        if not same_skin(first.skin, other.skin):
            raise ValueError(
                f"datasets that are learned together must have the same skin: that of {first.root} "
                f"and {other.root} differ"
            )
    if len(sets) == 1:
        return first
    chained = _Chained(sets)
    held = all(isinstance(part.episodes, list) for part in sets)
    return replace(first, episodes=list(chained) if held else chained)


class _Read(Sequence[Episode]):
    """Episodes that are reached by going through those before them."""

    def __getitem__(self, index: Any) -> Any:
        return next(islice(self, index, None))


@dataclass(eq=False)
class _Chained(_Read):
    """The episodes of several datasets, numbered on."""

    sets: list[EpisodeSet]

    def __len__(self) -> int:
        return sum(map(len, self.sets))

    def __iter__(self) -> Iterator[Episode]:
        for number, episode in enumerate(chain.from_iterable(self.sets)):
            yield replace(episode, index=number)


@dataclass(eq=False)
class _Stored(_Read):
    """The episodes on disk, of which an episode and a row group of a file are held."""

    data: EpisodeSet
    names: FeatureMap
    shapes: dict[str, tuple[int, ...]]
    files: list[Path]
    indices: list[int]
    spans: list[tuple[int, int]]
    layout: tuple[int, int] | None
    gaps: bool
    tasks: np.ndarray
    tolerance_s: float

    def __len__(self) -> int:
        return len(self.spans)

    @property
    def nbytes(self) -> int:
        """Size of all frames in memory."""
        return self.spans[-1][1] * sum(map(prod, self.shapes.values())) * 8

    def __iter__(self) -> Iterator[Episode]:
        from hasm_torch.data import parquet

        groups = parquet.iterate_columns(self.files, self.shapes)
        parts: list[dict[str, np.ndarray]] = []
        for index, (start, stop) in zip(self.indices, self.spans, strict=True):
            while (rows := sum(len(part["timestamp"]) for part in parts)) < stop - start:
                part = next(groups, None)
                if part is None:
                    raise self._incomplete(start + rows)
                parts.append(part)
            if len(parts) > 1:
                parts = [{key: np.concatenate([p[key] for p in parts]) for key in parts[0]}]
            mine = {key: values[: stop - start] for key, values in parts[0].items()}
            parts = [{key: values[stop - start :] for key, values in parts[0].items()}]
            check_owner(mine["episode_index"], index, start, self.data.root)
            yield self._episode(mine, index)
        more = sum(len(part["timestamp"]) for part in (*parts, *groups))
        if more:
            raise self._incomplete(self.spans[-1][1] + more)

    def _incomplete(self, frames: int) -> ValueError:
        return ValueError(
            f"Expected {self.spans[-1][1]} frames in {self.data.root}/data as meta/episodes says, "
            f"got {frames}. The recording was cut off or the files were changed."
        )

    def _episode(self, columns: dict[str, np.ndarray], index: int) -> Episode:
        """One episode from its own rows, checked."""
        names, bound, length = self.names, self.data.observations, len(columns["timestamp"])
        check_time(columns["timestamp"], index, self.data.fps, self.tolerance_s)
        check_tasks(columns["task_index"], self.tasks, self.data.root)
        values = {}
        for key in (names.state, names.action, names.tactile, *bound):
            if key is not None:
                # a copy: what Arrow gives is read-only
                values[key] = columns[key].astype(np.float32).reshape(length, -1)
                if key == names.tactile and self.gaps:
                    values[key] = held(values[key])
                check_finite(values[key], key, index)
        action: np.ndarray = values[names.action]
        if order := self.data.reordered:
            action = action[:, order]
        return Episode(
            index=index,
            # an episode with several tasks names them in the order in which they come up
            task="; ".join(dict.fromkeys(self.tasks[columns["task_index"]])),
            time=columns["timestamp"].copy(),
            state=values[names.state],
            action=action,
            tactile=values[names.tactile].reshape(-1, *self.layout)
            if names.tactile and self.layout
            else None,
            observations=np.concatenate([values[key] for key in bound], axis=1) if bound else None,
        )


def _shape(declared: Mapping[str, Any], key: str, root: Path) -> tuple[int, ...]:
    if key not in declared:
        raise ValueError(
            f"Expected a feature {key!r} in {root}, found {sorted(declared)}. "
            "Name the feature to read with FeatureMap."
        )
    if declared[key].get("dtype") in (*PICTURES, "string"):
        raise ValueError(f"Expected numbers in feature {key!r}, got {declared[key]['dtype']}.")
    shape = tuple(declared[key]["shape"])
    return () if shape == (1,) else shape  # LeRobot stores one entry as a plain number


def _data_files(root: Path, info: Mapping[str, Any], rows: Mapping[str, np.ndarray]) -> list[Path]:
    template = info.get("data_path", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
    places = dict.fromkeys(
        zip(rows["data/chunk_index"].tolist(), rows["data/file_index"].tolist(), strict=True)
    )
    return [root / template.format(chunk_index=chunk, file_index=file) for chunk, file in places]


def _entry_names(feature: Mapping[str, Any], key: str) -> tuple[str, ...]:
    width = int(np.prod(feature["shape"]))
    names = feature_names(feature) or tuple(f"{key}.{i}" for i in range(width))
    if len(names) != width:
        raise ValueError(f"Expected {width} names for {key!r}, got {len(names)}: {names}.")
    return names


def _units(feature: Mapping[str, Any], width: int, key: str) -> tuple[str, ...]:
    info = feature.get("info") or {}
    units = info.get("units", [info.get("unit", UNKNOWN_UNIT)] * width)
    if len(units) != width:
        raise ValueError(f"Expected {width} units for {key!r}, got {len(units)}: {units}.")
    return tuple(str(unit) for unit in units)
