"""Demonstrations out: writes a LeRobot v3.0 dataset, whole or not at all."""

import contextlib
import functools
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from hasm_torch._extras import require
from hasm_torch.data.checks import check_finite
from hasm_torch.data.skin import UNKNOWN_UNIT, SkinPatch, skin_to_info
from hasm_torch.episode import ACTION, STATE, TACTILE, Episode

Entries = Sequence[str] | Mapping[str, str]  # names, or names with their units


def write_episodes(
    root: str | Path,
    episodes: Iterable[Episode],
    *,
    joints: Sequence[str],
    units: Sequence[str],
    skin: Mapping[str, SkinPatch] | None,
    fps: int,
    robot_type: str,
    observations: Mapping[str, Entries] | None = None,
    gaps: bool = False,
    overwrite: bool = False,
) -> Path:
    """Writes demonstrations as a LeRobot v3.0 dataset.

    The dataset grows in a temporary folder beside ``root`` and takes its place when it is whole.
    The same episodes give the same bytes in every file. Episodes are numbered in the order in
    which they come; ``Episode.index`` is not used.

    Args:
        root: Folder of the new dataset.
        episodes: Demonstrations, each with a target per joint as action; may be a generator.
        joints: Names of the joints.
        units: Unit of each joint (``rad`` or ``m``).
        skin: Patches by name that cover all cells in order, or None for episodes without skin.
        fps: Frames per second, a whole number.
        robot_type: Robot the demonstrations come from.
        observations: Further observations to bind: names of the entries, or their units by name,
            of each feature, in the order of ``Episode.observations``.
        gaps: Tactile readings may be NaN, of cells that did not report; the dataset declares it.
        overwrite: Replace the dataset at ``root``; the old one stays until the new one is whole.

    Returns:
        ``root`` as an absolute path.

    Raises:
        FileExistsError: ``root`` exists, and ``overwrite`` is off or it is no dataset.
        ValueError: No episodes, or one of wrong shape, with a value that is not finite, or whose
            time stamps do not fit ``fps``.
    """
    root = Path(root).resolve()
    _check_root(root, overwrite)
    if len(units) != len(joints) or len(set(joints)) != len(joints) or not joints:
        raise ValueError(
            f"Expected joints of different names and a unit each, got {joints}, {units}."
        )
    if int(fps) != fps or fps < 1:
        raise ValueError(f"Expected a whole number of frames per second, got fps={fps}.")
    bound = dict(observations or {})
    frames = _checked(episodes, len(joints), skin, bound, int(fps), gaps)
    first = next(frames, None)
    if first is None:
        raise ValueError("Expected at least one episode to write, got none.")
    features = _features(first, tuple(joints), tuple(units), skin, bound)
    if gaps and skin is not None:
        features[TACTILE]["info"]["missing"] = "nan"

    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root.parent, prefix=f".{root.name}.") as folder:
        staging = Path(folder) / "new"
        _write(staging, chain([first], frames), features, int(fps), robot_type)
        _replace(root, staging, Path(folder) / "old")
    return root


def _write(
    root: Path,
    episodes: Iterable[Mapping[str, Any]],
    features: dict[str, dict[str, Any]],
    fps: int,
    robot_type: str,
) -> None:
    require("lerobot")
    from lerobot.datasets import dataset_writer as writer
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.utils import SuppressProgressBars

    dataset = LeRobotDataset.create(
        repo_id=f"local/{root.name}",
        fps=fps,
        features=features,
        root=root,
        robot_type=robot_type,
        use_videos=False,
        video_backend="pyav",  # any other choice loads a video library that is not needed here
    )
    # LeRobot looks the task of every frame up in a table
    dataset.meta.get_task_index = functools.cache(dataset.meta.get_task_index)
    try:
        for number, episode in enumerate(episodes):
            length = len(episode[STATE])
            columns = {
                **{key: episode[key] for key in features},
                "task": [episode["task"]] * length,
                "timestamp": np.arange(length) / fps,
                "frame_index": np.arange(length),
                "episode_index": number,
                "size": length,
                **dict.fromkeys(("index", "task_index"), ()),  # LeRobot fills these in itself
            }
            with SuppressProgressBars(), mock.patch.object(writer, "embed_images", _without_images):
                dataset.save_episode(episode_data=columns)
        dataset.finalize()
    except BaseException:
        # an open writer would flush, and create its folder anew, when it is garbage-collected
        with contextlib.suppress(Exception):
            dataset.finalize()
        raise


def _without_images(dataset: Any) -> Any:
    """In place of LeRobot's search of every row for pictures, nine tenths of its time to write."""
    return dataset


def _features(
    first: Mapping[str, Any],
    joints: tuple[str, ...],
    units: tuple[str, ...],
    skin: Mapping[str, SkinPatch] | None,
    bound: Mapping[str, Entries],
) -> dict[str, dict[str, Any]]:
    vector = {"dtype": "float32", "shape": (len(joints),), "names": list(joints)}
    features: dict[str, dict[str, Any]] = {
        STATE: {**vector, "info": {"units": list(units)}},
        ACTION: {**vector, "info": {"units": list(units), "meaning": "target of each joint"}},
    }
    if skin is not None:
        cells, channels = first["layout"]
        features[TACTILE] = {
            "dtype": "float32",
            "shape": (cells * channels,),
            "names": [
                f"{patch.name}.{cell}.{channel}"
                for patch in skin.values()
                for cell in range(patch.cells.stop - patch.cells.start)
                for channel in range(channels)
            ],
            "info": skin_to_info(skin, cells, channels),
        }
    for key, entries in bound.items():
        known = entries if isinstance(entries, Mapping) else dict.fromkeys(entries, UNKNOWN_UNIT)
        features[key] = {
            "dtype": "float32",
            "shape": (len(known),),
            "names": list(known),
            "info": {"bind": True, "units": list(known.values())},
        }
    return features


def _checked(
    episodes: Iterable[Episode],
    joints: int,
    skin: Mapping[str, SkinPatch] | None,
    bound: Mapping[str, Entries],
    fps: int,
    gaps: bool,
) -> Iterator[dict[str, Any]]:
    """The columns of each episode, checked: a dataset never holds what could not be read back."""
    layout: tuple[int, ...] | None = None
    for number, episode in enumerate(episodes):
        length = len(episode.state)
        if not isinstance(episode.task, str) or not episode.task:
            raise ValueError(f"Episode {number}: expected a task in words, got {episode.task!r}.")
        columns = {
            STATE: _column(episode.state, (length, joints), STATE, number),
            ACTION: _column(episode.action, (length, joints), ACTION, number),
        }
        for what, values, described in (
            ("tactile", episode.tactile, skin),
            ("observations", episode.observations, bound or None),
        ):
            if (values is None) != (described is None):
                raise ValueError(
                    f"Episode {number}: expected {what} exactly where they are described, got "
                    f"{what} {_came(values)} and their description {_came(described)}."
                )
        if skin is not None and episode.tactile is not None:
            if layout is None:
                layout = np.shape(episode.tactile)[1:]
                if len(layout) != 2 or layout[1] not in (1, 3, 6):
                    raise ValueError(
                        f"Episode {number}: expected tactile of shape (T, cells, 1, 3 or 6), "
                        f"got {np.shape(episode.tactile)}."
                    )
            tactile = _column(episode.tactile, (length, *layout), TACTILE, number, gaps)
            columns[TACTILE] = tactile.reshape(length, -1)
        if bound and episode.observations is not None:
            ends = np.cumsum([len(entries) for entries in bound.values()])
            name = ", ".join(bound)
            values = _column(episode.observations, (length, int(ends[-1])), name, number)
            columns |= dict(zip(bound, np.split(values, ends[:-1], axis=1)))
        _check_time(np.asarray(episode.time, dtype=np.float64), length, fps, number)
        yield {**columns, "task": episode.task, "layout": layout}


def _came(value: object) -> str:
    return "missing" if value is None else "given"


def _column(
    values: np.ndarray, shape: tuple[int, ...], key: str, number: int, gaps: bool = False
) -> np.ndarray:
    if np.shape(values) != shape or not shape[0]:
        raise ValueError(
            f"Episode {number}: expected {key!r} of shape {('T', *shape[1:])}, as many frames as "
            f"the state ({shape[0]}) and at least one, got {np.shape(values)}."
        )
    with np.errstate(over="ignore"):  # what float32 cannot hold is reported below
        column = np.ascontiguousarray(values, dtype=np.float32)
    check_finite(np.where(np.isnan(column), 0.0, column) if gaps else column, key, number)
    return column


def _check_time(time: np.ndarray, length: int, fps: int, number: int) -> None:
    # LeRobot writes frame / fps itself, so other time stamps would be lost without a word
    expected = np.arange(length) / fps
    tolerance = 1e-3 / fps + np.spacing(np.float32(length / fps))  # time may come as float32
    fits = time.shape == (length,) and np.allclose(time - time[0], expected, 0, tolerance)
    if not fits:
        raise ValueError(
            f"Episode {number}: expected {length} time stamps {1 / fps:g} s apart ({fps} fps), got "
            f"{time[:4].tolist()}..., shape {time.shape}. Resample the episode."
        )


def _check_root(root: Path, overwrite: bool) -> None:
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return
    if not (root / "meta" / "info.json").is_file():
        raise FileExistsError(f"{root} exists and is no LeRobot dataset. Choose another folder.")
    if not overwrite:
        raise FileExistsError(
            f"{root} already holds a dataset. Choose another folder, or pass overwrite=True."
        )


def _replace(root: Path, staging: Path, old: Path) -> None:
    if root.exists():
        root.rename(old)
    try:
        staging.rename(root)
    except OSError:
        if old.exists():
            old.rename(root)
        raise
