"""Demonstrations of a LeRobot v3.0 dataset as arrays, one `Episode` each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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
    skin_from_info,
    tactile_layout,
)
from hasm_torch.episode import ACTION, STATE, TACTILE, Episode


@dataclass(eq=False)
class EpisodeSet:
    """The demonstrations of one dataset and what their columns mean.

    Attributes:
        episodes: The demonstrations.
        fps: Frames per second.
        joints: Names of the state's entries.
        units: Units of the state's entries (``rad``, ``m``, ``deg``; ``unknown`` if not stated).
        skin: Patches by name, or None without skin.
        root: Folder of the dataset.
        action_names: Names of the action's entries.
        observations: Number of entries of each further observation that is bound, by feature.
    """

    episodes: list[Episode]
    fps: float
    joints: tuple[str, ...]
    units: tuple[str, ...]
    skin: dict[str, SkinPatch] | None
    root: Path
    action_names: tuple[str, ...]
    observations: dict[str, int] = field(default_factory=dict)

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
    root: str | Path, features: FeatureMap | None = None, tolerance_s: float = 1e-4
) -> EpisodeSet:
    """Reads a LeRobot v3.0 dataset from disk.

    Args:
        root: Folder of the dataset (the one that holds ``meta`` and ``data``).
        features: Names of the features to read; LeRobot's usual names by default.
        tolerance_s: How far a frame may lie from one period after the frame before it, s.

    Returns:
        Every episode of the dataset.

    Raises:
        FileNotFoundError: There is no dataset, or a file of it is missing.
        ValueError: The dataset is of another format, empty or damaged, lacks a feature, or holds
            values that are not finite, of another shape than declared, or not at its frame rate.
    """
    stream = EpisodeStream(root, features, tolerance_s)
    return EpisodeSet(
        list(stream),
        stream.fps,
        stream.joints,
        stream.units,
        stream.skin,
        stream.root,
        stream.action_names,
        stream.observations,
    )


class EpisodeStream:
    """The demonstrations of a dataset, read anew from disk at every iteration, one at a time.

    For datasets that do not fit in memory: what is held is an episode and a row group of a file.
    Attributes are those of `EpisodeSet`.

    Args:
        root: Folder of the dataset.
        features: Names of the features to read; LeRobot's usual names by default.
        tolerance_s: See `load_episodes`.

    Raises:
        FileNotFoundError, ValueError: as `load_episodes`, for episodes when they are reached.
    """

    def __init__(
        self, root: str | Path, features: FeatureMap | None = None, tolerance_s: float = 1e-4
    ) -> None:
        from hasm_torch.data import parquet  # loads pyarrow

        self.root, self._tolerance_s = Path(root), tolerance_s
        self._plan = _plan(self.root, features or FeatureMap())
        plan = self._plan
        self.fps, self.joints, self.units = plan.fps, plan.joints, plan.units
        self.skin, self.action_names = plan.skin, plan.action_names
        self.observations = plan.observations
        self._tasks = np.array(parquet.read_tasks(self.root), dtype=object)

    def __len__(self) -> int:
        return len(self._plan.spans)

    @property
    def nbytes(self) -> int:
        """Size of all frames in memory."""
        entries = sum(int(np.prod(shape)) for shape in self._plan.shapes.values())
        return self._plan.spans[-1][1] * entries * 8

    def __iter__(self) -> Iterator[Episode]:
        from hasm_torch.data import parquet

        plan = self._plan
        groups = parquet.iterate_columns(plan.files, plan.shapes)
        parts: list[dict[str, np.ndarray]] = []
        for index, (start, stop) in zip(plan.indices.tolist(), plan.spans, strict=True):
            while (rows := sum(len(part["timestamp"]) for part in parts)) < stop - start:
                part = next(groups, None)
                if part is None:
                    raise self._incomplete(start + rows)
                parts.append(part)
            if len(parts) > 1:
                parts = [{key: np.concatenate([p[key] for p in parts]) for key in parts[0]}]
            mine = {key: values[: stop - start] for key, values in parts[0].items()}
            parts = [{key: values[stop - start :] for key, values in parts[0].items()}]
            check_owner(mine["episode_index"], index, start, self.root)
            yield _episode_of(plan, mine, index, self._tasks, self._tolerance_s)
        more = sum(len(part["timestamp"]) for part in (*parts, *groups))
        if more:
            raise self._incomplete(plan.spans[-1][1] + more)

    def _incomplete(self, frames: int) -> ValueError:
        return ValueError(
            f"Expected {self._plan.spans[-1][1]} frames in {self.root}/data as meta/episodes says, "
            f"got {frames}. The recording was cut off or the files were changed."
        )


def open_episodes(
    root: str | Path, features: FeatureMap | None = None, most_bytes: int = 1 << 30
) -> EpisodeSet | EpisodeStream:
    """A dataset in memory where it takes up to ``most_bytes`` there, else as a stream.

    Args:
        root: Folder of the dataset.
        features: Names of the features to read; LeRobot's usual names by default.
        most_bytes: Most memory for the frames.

    Raises:
        FileNotFoundError, ValueError: see `load_episodes`.
    """
    stream = EpisodeStream(root, features)
    return stream if stream.nbytes > most_bytes else load_episodes(root, features)


@dataclass(eq=False)
class _Plan:
    """What ``meta`` says about a dataset: where its episodes lie and what its columns mean."""

    root: Path
    names: FeatureMap
    fps: float
    shapes: dict[str, tuple[int, ...]]
    files: list[Path]
    indices: np.ndarray
    spans: list[tuple[int, int]]
    declared: Mapping[str, Any]
    layout: tuple[int, int] | None
    skin: dict[str, SkinPatch] | None
    observations: dict[str, int]

    @property
    def joints(self) -> tuple[str, ...]:
        return _entry_names(self.declared[self.names.state], self.names.state)

    @property
    def units(self) -> tuple[str, ...]:
        return _units(self.declared[self.names.state], len(self.joints), self.names.state)

    @property
    def action_names(self) -> tuple[str, ...]:
        return _entry_names(self.declared[self.names.action], self.names.action)


def _plan(root: Path, names: FeatureMap) -> _Plan:
    from hasm_torch.data import parquet  # loads pyarrow

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
    keys = [key for key in (*used, *bound) if key]
    shapes: dict[str, tuple[int, ...]] = {key: _shape(declared, key, root) for key in keys}
    rows = parquet.read_episode_rows(root)
    borders = (rows[f"dataset_{end}_index"].tolist() for end in ("from", "to"))
    spans = list(zip(*borders, strict=True))
    check_spans(spans, root)
    layout = tactile_layout(declared[tactile], tactile) if tactile else None
    return _Plan(
        root=root,
        names=names,
        fps=float(info["fps"]),
        shapes={**shapes, "timestamp": (), "episode_index": (), "task_index": ()},
        files=_data_files(root, info, rows),
        indices=rows["episode_index"],
        spans=spans,
        declared=declared,
        layout=layout,
        skin=skin_from_info(declared[tactile], *layout, tactile) if tactile and layout else None,
        observations={key: prod(shapes[key]) for key in bound},
    )


def _episode_of(
    plan: _Plan,
    columns: dict[str, np.ndarray],
    index: int,
    tasks: np.ndarray,
    tolerance_s: float,
) -> Episode:
    """One episode from its own rows, checked."""
    names, length = plan.names, len(columns["timestamp"])
    check_time(columns["timestamp"], index, plan.fps, tolerance_s)
    skin = [str(names.tactile)] if plan.layout else []
    for key in (names.state, names.action, *skin, *plan.observations):
        columns[key] = columns[key].astype(np.float32)  # a copy: what Arrow gives is read-only
        check_finite(columns[key], key, index)
    check_tasks(columns["task_index"], tasks, plan.root)
    return Episode(
        index=index,
        # an episode with several tasks names them in the order in which they come up
        task="; ".join(dict.fromkeys(tasks[columns["task_index"]])),
        time=columns["timestamp"].copy(),
        state=columns[names.state].reshape(length, -1),
        action=columns[names.action].reshape(length, -1),
        tactile=None
        if plan.layout is None
        else columns[str(names.tactile)].reshape(-1, *plan.layout),
        observations=np.concatenate(
            [columns[key].reshape(length, -1) for key in plan.observations], axis=1
        )
        if plan.observations
        else None,
    )


def windows(values: np.ndarray, offsets: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Neighbouring frames of every frame of one episode, as LeRobot's ``delta_timestamps`` gives.

    A frame beyond an end of the episode is replaced by that end's frame and marked.

    Args:
        values: ``(T, ...)`` one episode's column.
        offsets: Frames relative to the current one, W of them; negative ones lie in the past.

    Returns:
        ``(T, W, ...)`` windows and ``(T, W)`` bool, true where the frame is padding.
    """
    wanted = np.arange(len(values))[:, None] + np.asarray(offsets, dtype=np.int64)
    inside = wanted.clip(0, len(values) - 1)
    return values[inside], wanted != inside


def _shape(declared: Mapping[str, Any], key: str, root: Path) -> tuple[int, ...]:
    if key not in declared:
        raise ValueError(
            f"Expected a feature {key!r} in {root}, found {sorted(declared)}. "
            "Name the feature to read with FeatureMap."
        )
    if declared[key].get("dtype") in ("image", "video", "string"):
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
