"""What the rows of a dataset must fulfil, and where they do not."""

from pathlib import Path

import numpy as np


def check_spans(spans: list[tuple[int, int]], root: Path) -> None:
    """Raises ValueError unless there are episodes of a frame or more that follow each other."""
    if not spans:
        raise ValueError(f"Expected at least one episode in {root}, got none.")
    starts = [0, *(stop for _, stop in spans[:-1])]
    if any(stop <= start for start, stop in spans) or starts != [start for start, _ in spans]:
        raise ValueError(
            f"Expected episodes of at least one frame that follow each other in {root}/meta/"
            f"episodes, got frame ranges {spans[:10]}."
        )


def check_owner(found: np.ndarray, episode: int, start: int, root: Path) -> None:
    """Raises ValueError for the first row that is of another episode."""
    wrong = np.flatnonzero(found != episode)
    if wrong.size:
        raise ValueError(
            f"Expected frame {start + wrong[0]} of {root}/data to be of episode {episode}, "
            f"got episode {found[wrong[0]]}."
        )


def check_time(time: np.ndarray, episode: int, fps: float, tolerance_s: float) -> None:
    """Raises ValueError unless the frames of an episode come at the frame rate."""
    if not fps > 0:
        raise ValueError(f"Expected a positive frame rate in meta/info.json, got fps={fps}.")
    check_finite(time, "timestamp", episode)
    step = np.diff(time.astype(np.float64))
    # time stamps are float32: late in a long episode they are no finer than this
    tolerance = tolerance_s + np.spacing(np.abs(time[1:])).astype(np.float64)
    bad = np.flatnonzero((step <= 0) | (np.abs(step - 1 / fps) > tolerance))
    if bad.size:
        raise ValueError(
            f"Expected time stamps {1 / fps:.6g} s apart ({fps:g} fps), got a step of "
            f"{step[bad[0]]:.6g} s to frame {bad[0] + 1} of episode {episode}. Resample the "
            "recording, correct fps, or pass a larger tolerance_s."
        )


def check_finite(values: np.ndarray, key: str, episode: int) -> None:
    """Raises ValueError for the first value of an episode that is not finite."""
    entries = values.reshape(len(values), -1)
    bad = np.argwhere(~np.isfinite(entries))
    if bad.size:
        frame, entry = bad[0]
        raise ValueError(
            f"Expected finite numbers in {key!r}, got {entries[frame, entry]} in entry {entry} of "
            f"frame {frame} of episode {episode}; {len(set(bad[:, 0]))} frames are affected."
        )


def check_tasks(found: np.ndarray, tasks: np.ndarray, root: Path) -> None:
    """Raises ValueError for task numbers that have no task."""
    if found.min() < 0 or found.max() >= len(tasks):
        raise ValueError(
            f"Expected task numbers from 0 to {len(tasks) - 1} as {root}/meta/tasks.parquet has "
            f"{len(tasks)} tasks, got {found.min()} to {found.max()}."
        )
