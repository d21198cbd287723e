"""Demonstrations of a LeRobot v3.0 dataset as arrays, one `Episode` each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.data.checks import (
    check_finite,
    check_spans,
    check_tasks,
    check_time,
    flat,
)
from hasm_torch.data.skin import (
    UNKNOWN_UNIT,
    SkinPatch,
    feature_names,
    skin_from_info,
    tactile_layout,
)
from hasm_torch.episode import Episode


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
    """

    episodes: list[Episode]
    fps: float
    joints: tuple[str, ...]
    units: tuple[str, ...]
    skin: dict[str, SkinPatch] | None
    root: Path
    action_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.episodes)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.episodes)


@dataclass(frozen=True)
class FeatureMap:
    """Which features of the dataset are read.

    Attributes:
        state: Joint positions.
        tactile: Skin readings; None reads no skin, and a dataset without this feature has none.
        action: Joint targets.
    """

    state: str = "observation.state"
    tactile: str | None = "observation.tactile"
    action: str = "action"


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
    from hasm_torch.data import parquet  # loads pyarrow

    plan = _plan(Path(root), features or FeatureMap())
    columns = parquet.read_columns(plan.files, plan.shapes)
    check_spans(plan.spans, plan.indices, columns["episode_index"], plan.root)
    check_time(columns["timestamp"], plan.spans, plan.indices, plan.fps, tolerance_s)
    tasks = np.array(parquet.read_tasks(plan.root), dtype=object)
    episodes = []
    for index, (start, stop) in zip(plan.indices, plan.spans, strict=True):
        mine = {key: values[start:stop] for key, values in columns.items()}
        episodes.append(_episode_of(plan, mine, int(index), tasks, tolerance_s))
    return EpisodeSet(
        episodes, plan.fps, plan.joints, plan.units, plan.skin, plan.root, plan.action_names
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
        self._tasks = np.array(parquet.read_tasks(self.root), dtype=object)

    def __len__(self) -> int:
        return len(self._plan.spans)

    @property
    def nbytes(self) -> int:
        """Size of all frames in memory."""
        entries = sum(int(np.prod(shape)) for shape in self._plan.shapes.values())
        return int(self._plan.spans[-1][1]) * entries * 8

    def __iter__(self) -> Iterator[Episode]:
        from hasm_torch.data import parquet

        plan = self._plan
        groups = parquet.iterate_columns(plan.files, plan.shapes)
        held = {key: np.empty((0, *shape)) for key, shape in plan.shapes.items()}
        for index, (start, stop) in zip(plan.indices, plan.spans, strict=True):
            count = int(stop - start)
            parts, rows = [held], len(held["timestamp"])
            while rows < count:
                part = next(groups, None)
                if part is None:
                    raise ValueError(
                        f"Expected {count} frames of episode {index} in {self.root}/data as "
                        f"meta/episodes says, got {rows}. The recording was cut off or the files "
                        "were changed."
                    )
                parts.append(part)
                rows += len(part["timestamp"])
            filled = [part for part in parts if len(part["timestamp"])]
            joined = {key: np.concatenate([part[key] for part in filled]) for key in held}
            held = {key: values[count:] for key, values in joined.items()}
            mine = {key: values[:count] for key, values in joined.items()}
            check_spans([(0, count)], np.array([index]), mine["episode_index"], self.root)
            yield _episode_of(plan, mine, int(index), self._tasks, self._tolerance_s)


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


def iter_episodes(root: str | Path, features: FeatureMap | None = None) -> Iterator[Episode]:
    """The episodes of a dataset, one at a time; see `EpisodeStream`."""
    return iter(EpisodeStream(root, features))


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
    tactile = names.tactile if names.tactile in declared else None
    keys = [names.state, names.action, *([tactile] if tactile else [])]
    shapes: dict[str, tuple[int, ...]] = {key: _shape(declared, key, root) for key in keys}
    rows = parquet.read_episode_rows(root)
    spans = list(zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True))
    if not spans:
        raise ValueError(f"Expected at least one episode in {root}, got none.")
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
    )


def _episode_of(
    plan: _Plan,
    columns: dict[str, np.ndarray],
    index: int,
    tasks: np.ndarray,
    tolerance_s: float,
) -> Episode:
    """One episode from its own rows, checked."""
    names, spans, indices = plan.names, [(0, len(columns["timestamp"]))], np.array([index])
    check_time(columns["timestamp"], spans, indices, plan.fps, tolerance_s)
    for key in (names.state, names.action, *([names.tactile] if plan.layout else [])):
        columns[str(key)] = columns[str(key)].astype(np.float32, copy=False)
        check_finite(columns[str(key)], str(key), spans, indices)
    check_tasks(columns["task_index"], tasks, plan.root)
    return Episode(
        index=index,
        # an episode with several tasks names them in the order in which they come up
        task="; ".join(dict.fromkeys(tasks[columns["task_index"]])),
        time=columns["timestamp"],
        state=flat(columns[names.state]),
        action=flat(columns[names.action]),
        tactile=None
        if plan.layout is None
        else columns[str(names.tactile)].reshape(-1, *plan.layout),
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
