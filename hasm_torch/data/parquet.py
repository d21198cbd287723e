"""Whole columns of a LeRobot v3.0 dataset as NumPy arrays, straight from its parquet files."""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

VERSION = "v3.0"


def read_info(root: Path) -> dict[str, Any]:
    """``meta/info.json`` of a dataset.

    Raises:
        FileNotFoundError: There is no dataset at ``root``.
        ValueError: The file is damaged, or the dataset is not of format v3.
    """
    path = root / "meta" / "info.json"
    if not path.is_file():
        below = sorted(str(p.parent.parent) for p in root.glob("*/meta/info.json"))
        hint = f"Datasets below it: {below}." if below else "Record one with write_episodes()."
        state = "has no meta/info.json" if root.is_dir() else "does not exist"
        raise FileNotFoundError(
            f"Expected a LeRobot {VERSION} dataset at {root.absolute()}, which {state}. {hint}"
        )
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version, _ = str(info["codebase_version"]), (info["fps"], info["features"])
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(
            f"Expected JSON with codebase_version, fps and features in {path}, got: {error!r}"
        ) from error
    if not version.startswith("v3."):
        raise ValueError(
            f"Expected a dataset of format {VERSION} at {root}, got {version}. Convert it with "
            "`python -m lerobot.scripts.convert_dataset_v21_to_v30`."
        )
    return info


@contextlib.contextmanager
def _opened(path: Path, columns: Sequence[str] = ()) -> Iterator[pq.ParquetFile]:
    """A parquet file with these columns.

    Raises:
        FileNotFoundError: The file is missing.
        ValueError: The file is damaged, or lacks a column.
    """
    if not path.is_file():
        raise FileNotFoundError(f"The dataset is incomplete: {path} is missing.")
    try:
        with pq.ParquetFile(path) as file:
            if missing := set(columns) - set(file.schema_arrow.names):
                found = file.schema_arrow.names
                raise ValueError(f"Expected columns {sorted(missing)} in {path}, found {found}.")
            yield file
    except (pa.ArrowException, OSError) as error:
        raise ValueError(
            f"{path} ({path.stat().st_size} bytes) is empty, truncated or damaged: {error}. "
            "Record or fetch the dataset again."
        ) from error


def read_tasks(root: Path) -> list[str]:
    """The task strings of a dataset in the order of their rows.

    Raises:
        FileNotFoundError, ValueError: The file is missing, damaged, or lacks its column.
    """
    path = root / "meta" / "tasks.parquet"
    with _opened(path) as file:
        table = file.read()
    # pandas names the column of an unnamed index __index_level_0__
    names = [name for name in ("task", "__index_level_0__") if name in table.column_names]
    if not names:
        raise ValueError(f"Expected a column 'task' in {path}, found {table.column_names}.")
    return [str(task) for task in table.column(names[0]).to_pylist()]


def read_episode_rows(root: Path) -> dict[str, np.ndarray]:
    """Where each episode's frames lie: one row an episode, in the order of their frames.

    Raises:
        FileNotFoundError, ValueError: see `iterate_columns`.
    """
    columns = ["episode_index", "dataset_from_index", "dataset_to_index"]
    columns += ["data/chunk_index", "data/file_index"]
    folder = root / "meta" / "episodes"
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        raise FileNotFoundError(f"The dataset is incomplete: no parquet file below {folder}.")
    parts = list(iterate_columns(paths, {column: () for column in columns}))
    empty = [{column: np.zeros(0, np.int64) for column in columns}]
    rows = {c: np.concatenate([part[c] for part in empty + parts]) for c in columns}
    order = np.argsort(rows["dataset_from_index"], kind="stable")
    return {column: values[order].astype(np.int64) for column, values in rows.items()}


def iterate_columns(
    paths: Sequence[Path], shapes: Mapping[str, tuple[int, ...]]
) -> Iterator[dict[str, np.ndarray]]:
    """Columns of several files, one row group after the other.

    Args:
        paths: Files in the order of their frames.
        shapes: Shape of one frame's entry, by column.

    Yields:
        Arrays of shape (frames, *shape), by column.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is damaged, lacks a column, or see `to_array`.
    """
    for path in paths:
        with _opened(path, list(shapes)) as file:
            for group in range(file.num_row_groups):
                table = file.read_row_group(group, columns=list(shapes))
                yield {
                    key: to_array(table.column(key), shape, f"{key!r} in {path}")
                    for key, shape in shapes.items()
                }


def to_array(column: pa.ChunkedArray, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A parquet column as one array, without a Python loop over its rows.

    Args:
        column: Numbers, or (nested) lists of numbers.
        shape: Shape that each row must have.
        where: Name and file of the column, for error messages.

    Returns:
        Array of shape (rows, *shape).

    Raises:
        ValueError: A row has another shape, a value is missing, or the column holds no numbers.
    """
    rows = len(column)
    values = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    came: list[int] = []
    if isinstance(values, pa.ExtensionArray):
        values = values.storage
    nulls = values.null_count
    while _is_list(values.type):
        lengths = np.unique(values.value_lengths().drop_null().to_numpy())
        if lengths.size > 1:
            raise ValueError(
                f"{where}: rows of {lengths.min()} to {lengths.max()} entries, expected {shape}."
            )
        came += lengths.tolist()
        values = values.flatten()
        nulls += values.null_count
    if nulls:
        raise ValueError(
            f"{where}: {nulls} values are missing (null), expected numbers everywhere."
        )
    if not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type)):
        raise ValueError(f"{where}: expected numbers of shape {shape} a frame, got {values.type}.")
    array = values.to_numpy(zero_copy_only=False)
    if array.size != rows * prod(shape) or (rows and prod(came) != prod(shape)):
        raise ValueError(f"{where}: expected shape {shape} a frame, got {tuple(came)}.")
    return array.reshape(rows, *shape)


def _is_list(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )
