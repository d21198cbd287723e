"""Demonstrations of a LeRobot v3.0 dataset as arrays, one `Episode` each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.lerobot.skin import (
    UNKNOWN_UNIT,
    SkinPatch,
    feature_names,
    skin_from_info,
    tactile_layout,
)


@dataclass(eq=False)
class Episode:
    """One demonstration: T frames at a fixed rate.

    Attributes:
        index: Number of the episode in its dataset.
        task: What is done, in words.
        time: ``(T,)`` s, from the start of the episode.
        state: ``(T, J)`` float32 joint positions, units as in `EpisodeSet.units`.
        action: ``(T, A)`` float32 joint targets; A = J wherever an action is a target per joint.
        tactile: ``(T, cells, channels)`` float32 skin readings, or None without skin. Three
            channels are forces in N, one is a pressure, six are a wrench.
    """

    index: int
    task: str
    time: np.ndarray
    state: np.ndarray
    action: np.ndarray
    tactile: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.state)


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
    from hasm_torch.lerobot import parquet  # loads pyarrow

    root, names = Path(root), features or FeatureMap()
    info = parquet.read_info(root)
    declared = info["features"]
    has_skin = names.tactile in declared
    keys = [names.state, names.action, *([names.tactile] if has_skin and names.tactile else [])]
    shapes: dict[str, tuple[int, ...]] = {key: _shape(declared, key, root) for key in keys}
    rows = parquet.read_episode_rows(root)
    spans = list(zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True))
    if not spans:
        raise ValueError(f"Expected at least one episode in {root}, got none.")
    columns = parquet.read_columns(
        _data_files(root, info, rows),
        {**shapes, "timestamp": (), "episode_index": (), "task_index": ()},
    )
    _check_spans(spans, rows["episode_index"], columns["episode_index"], root)
    time = columns["timestamp"]
    fps = float(info["fps"])
    _check_time(time, spans, rows["episode_index"], fps, tolerance_s)
    for key in keys:
        columns[key] = columns[key].astype(np.float32, copy=False)
        _check_finite(columns[key], key, spans, rows["episode_index"])

    tasks = np.array(parquet.read_tasks(root), dtype=object)
    _check_tasks(columns["task_index"], tasks, root)
    tactile, skin = None, None
    if has_skin and names.tactile:
        cells, channels = tactile_layout(declared[names.tactile], names.tactile)
        skin = skin_from_info(declared[names.tactile], cells, names.tactile)
        tactile = columns[names.tactile].reshape(-1, cells, channels)
    state, action = (_flat(columns[key]) for key in (names.state, names.action))
    episodes = [
        Episode(
            index=int(index),
            # an episode with several tasks names them in the order in which they come up
            task="; ".join(dict.fromkeys(tasks[columns["task_index"][start:stop]])),
            time=time[start:stop],
            state=state[start:stop],
            action=action[start:stop],
            tactile=None if tactile is None else tactile[start:stop],
        )
        for index, (start, stop) in zip(rows["episode_index"], spans, strict=True)
    ]
    joints = _entry_names(declared[names.state], names.state)
    units = _units(declared[names.state], len(joints), names.state)
    actions = _entry_names(declared[names.action], names.action)
    return EpisodeSet(episodes, fps, joints, units, skin, root, actions)


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


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)


def _data_files(root: Path, info: Mapping[str, Any], rows: Mapping[str, np.ndarray]) -> list[Path]:
    template = info.get("data_path", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
    places = dict.fromkeys(
        zip(rows["data/chunk_index"].tolist(), rows["data/file_index"].tolist(), strict=True)
    )
    return [root / template.format(chunk_index=chunk, file_index=file) for chunk, file in places]


def _check_spans(
    spans: list[tuple[int, int]], indices: np.ndarray, found: np.ndarray, root: Path
) -> None:
    lengths = np.array([stop - start for start, stop in spans])
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    if (lengths < 1).any() or (starts != [start for start, _ in spans]).any():
        raise ValueError(
            f"Expected episodes of at least one frame that follow each other in {root}/meta/"
            f"episodes, got frame ranges {[(int(a), int(b)) for a, b in spans[:10]]}."
        )
    expected = np.repeat(indices, lengths)
    if len(expected) != len(found):
        raise ValueError(
            f"Expected {len(expected)} frames in {root}/data as meta/episodes says, "
            f"got {len(found)}. The recording was cut off or the files were changed."
        )
    wrong = np.flatnonzero(expected != found)
    if wrong.size:
        raise ValueError(
            f"Expected frame {wrong[0]} of {root}/data to be of episode {expected[wrong[0]]}, "
            f"got episode {found[wrong[0]]}."
        )


def _check_time(
    time: np.ndarray,
    spans: list[tuple[int, int]],
    indices: np.ndarray,
    fps: float,
    tolerance_s: float,
) -> None:
    if not fps > 0:
        raise ValueError(f"Expected a positive frame rate in meta/info.json, got fps={fps}.")
    _check_finite(time, "timestamp", spans, indices)
    step = np.diff(time.astype(np.float64))
    # time stamps are float32: late in a long episode they are no finer than this
    tolerance = tolerance_s + np.spacing(np.abs(time[1:])).astype(np.float64)
    bad = (step <= 0) | (np.abs(step - 1 / fps) > tolerance)
    bad[[start - 1 for start, _ in spans[1:]]] = False
    if bad.any():
        frame = int(np.flatnonzero(bad)[0]) + 1
        episode, offset = _locate(frame, spans, indices)
        raise ValueError(
            f"Expected time stamps {1 / fps:.6g} s apart ({fps:g} fps), got a step of "
            f"{step[frame - 1]:.6g} s to frame {offset} of episode {episode}. Resample the "
            "recording, correct fps, or pass a larger tolerance_s."
        )


def _check_finite(
    values: np.ndarray, key: str, spans: list[tuple[int, int]], indices: np.ndarray
) -> None:
    flat = _flat(values)
    bad = ~np.isfinite(flat).all(axis=1)
    if bad.any():
        frame = int(np.flatnonzero(bad)[0])
        episode, offset = _locate(frame, spans, indices)
        entry = int(np.flatnonzero(~np.isfinite(flat[frame]))[0])
        raise ValueError(
            f"Expected finite numbers in {key!r}, got {flat[frame, entry]} in entry {entry} of "
            f"frame {offset} of episode {episode}; {int(bad.sum())} frames are affected."
        )


def _locate(frame: int, spans: list[tuple[int, int]], indices: np.ndarray) -> tuple[int, int]:
    row = int(np.searchsorted([start for start, _ in spans], frame, side="right")) - 1
    return int(indices[row]), frame - int(spans[row][0])


def _check_tasks(found: np.ndarray, tasks: np.ndarray, root: Path) -> None:
    if found.min() < 0 or found.max() >= len(tasks):
        raise ValueError(
            f"Expected task numbers from 0 to {len(tasks) - 1} as {root}/meta/tasks.parquet has "
            f"{len(tasks)} tasks, got {found.min()} to {found.max()}."
        )


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
