"""What the rows of a dataset must fulfil, and where they do not."""

from pathlib import Path

import numpy as np


def flat(values: np.ndarray) -> np.ndarray:
    """Entries of each frame in a row, (frames, entries)."""
    return values.reshape(len(values), -1)


def check_spans(
    spans: list[tuple[int, int]], indices: np.ndarray, found: np.ndarray, root: Path
) -> None:
    """Raises ValueError unless episodes follow each other and the frames are theirs."""
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


def check_time(
    time: np.ndarray,
    spans: list[tuple[int, int]],
    indices: np.ndarray,
    fps: float,
    tolerance_s: float,
) -> None:
    """Raises ValueError unless the frames of every episode come at the frame rate."""
    if not fps > 0:
        raise ValueError(f"Expected a positive frame rate in meta/info.json, got fps={fps}.")
    check_finite(time, "timestamp", spans, indices)
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


def check_finite(
    values: np.ndarray, key: str, spans: list[tuple[int, int]], indices: np.ndarray
) -> None:
    """Raises ValueError for the first value that is not finite."""
    entries = flat(values)
    bad = ~np.isfinite(entries).all(axis=1)
    if bad.any():
        frame = int(np.flatnonzero(bad)[0])
        episode, offset = _locate(frame, spans, indices)
        entry = int(np.flatnonzero(~np.isfinite(entries[frame]))[0])
        raise ValueError(
            f"Expected finite numbers in {key!r}, got {entries[frame, entry]} in entry {entry} of "
            f"frame {offset} of episode {episode}; {int(bad.sum())} frames are affected."
        )


def _locate(frame: int, spans: list[tuple[int, int]], indices: np.ndarray) -> tuple[int, int]:
    row = int(np.searchsorted([start for start, _ in spans], frame, side="right")) - 1
    return int(indices[row]), frame - int(spans[row][0])


def check_tasks(found: np.ndarray, tasks: np.ndarray, root: Path) -> None:
    """Raises ValueError for task numbers that have no task."""
    if found.min() < 0 or found.max() >= len(tasks):
        raise ValueError(
            f"Expected task numbers from 0 to {len(tasks) - 1} as {root}/meta/tasks.parquet has "
            f"{len(tasks)} tasks, got {found.min()} to {found.max()}."
        )
