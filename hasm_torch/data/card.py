"""The dataset card: what a recording holds, for people."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hasm_torch.data.episodes import EpisodeSet, load_episodes
from hasm_torch.episode import ACTION, STATE, TACTILE

_FRONT_MATTER = """---
license: apache-2.0
task_categories:
- robotics
tags:
- LeRobot
- tactile
pretty_name: {title}
configs:
- config_name: default
  data_files: data/*/*.parquet
---
"""


def write_card(root: str | Path, *, title: str, summary: str, recording: str, command: str) -> Path:
    """Writes ``README.md`` of a dataset; features and statistics come from the dataset itself.

    Args:
        root: Folder of the dataset.
        title: Heading of the card, one line.
        summary: What the dataset is and what it is for.
        recording: How it was recorded.
        command: Command line that records it again.

    Returns:
        Path of the card.

    Raises:
        FileNotFoundError, ValueError: see `load_episodes`.
    """
    data = load_episodes(root)
    parts = [
        _FRONT_MATTER.format(title=json.dumps(title, ensure_ascii=False)),
        f"# {title}\n\n{summary}\n",
        f"## Recording\n\n{recording}\n\nRecord it again:\n\n```bash\n{command}\n```\n",
        f"## Features\n\n{_feature_table(data)}\n",
        f"## Statistics\n\n{_statistics(data)}\n",
    ]
    path = Path(root) / "README.md"
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _feature_table(data: EpisodeSet) -> str:
    units = ", ".join(dict.fromkeys(data.units))
    rows = [
        (f"`{STATE}`", f"({len(data.joints)},)", units, "joint positions"),
        (f"`{ACTION}`", f"({len(data.action_names)},)", units, "joint targets"),
    ]
    tactile = data.episodes[0].tactile
    if data.skin is not None and tactile is not None:
        unit = next(iter(data.skin.values())).unit
        cells, channels = tactile.shape[1:]
        text = f"skin readings, {cells} cells x {channels}, flat; geometry in the feature's `info`"
        rows.insert(1, (f"`{TACTILE}`", f"({cells * channels},)", unit, text))
    for key, entries in data.observations.items():
        rows.append((f"`{key}`", f"({entries},)", "", "a further observation to bind"))
    rows += [
        ("`timestamp`", "(1,)", "s", f"time in the episode, {data.fps:g} frames per second"),
        ("`task_index`", "(1,)", "", "row of `meta/tasks.parquet`"),
    ]
    return _table(("feature", "shape", "unit", "what"), rows)


def _statistics(data: EpisodeSet) -> str:
    frames = sum(len(episode) for episode in data)
    parts = [f"{len(data)} episodes, {frames:,} frames, {frames / data.fps:.1f} s.\n"]
    tasks: dict[str, int] = {}
    for episode in data:
        tasks[episode.task] = tasks.get(episode.task, 0) + 1
    parts.append(_table(("task", "episodes"), [(task, str(n)) for task, n in tasks.items()]) + "\n")
    state = np.concatenate([episode.state for episode in data])
    rows = [
        (f"`{joint}`", unit, *(f"{f(state[:, j]):.3f}" for f in (np.min, np.mean, np.max)))
        for j, (joint, unit) in enumerate(zip(data.joints, data.units, strict=True))
    ]
    parts.append(_table(("joint", "unit", "least", "mean", "most"), rows))
    if data.skin is not None:
        tactile = np.concatenate([e.tactile for e in data if e.tactile is not None])
        rows = []
        for patch in data.skin.values():
            total = np.abs(tactile[:, patch.cells]).sum(axis=(1, 2))
            rows.append(
                (
                    f"`{patch.name}`",
                    patch.link or "",
                    str(patch.cells.stop - patch.cells.start),
                    f"{100 * np.mean(total > 0):.1f}",
                    f"{total.max():.2f}",
                )
            )
        unit = next(iter(data.skin.values())).unit
        header = ("patch", "link", "cells", "frames touched, %", f"largest sum, {unit}")
        parts.append("\n" + _table(header, rows))
    return "\n".join(parts)
