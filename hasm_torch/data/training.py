"""From a dataset to a trained model."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.data.body import body_of, describe_body
from hasm_torch.data.episodes import FeatureMap, load_all
from hasm_torch.episode import Episode
from hasm_torch.model.fit import FitReport
from hasm_torch.model.hasm import HASM

Method = Literal["default", "literal"]
MOST_BYTES = 1 << 30  # of a dataset that is held in memory; a larger one is read as it is learned


@dataclass
class DatasetConfig:
    """Which dataset to learn from.

    Attributes:
        root: Folder of the LeRobot v3.0 dataset.
        more: Folders of further datasets of the same robot, learned together with it.
    """

    root: Path | None = None
    more: list[Path] = field(default_factory=list)

    @property
    def roots(self) -> list[Path]:
        """All folders."""
        return [] if self.root is None else [self.root, *self.more]


@dataclass
class RobotConfig:
    """Which robot recorded the dataset.

    Attributes:
        urdf: Its URDF, for joint limits and the directions of touch; by default the bundled HSR's
            where that has the dataset's joints, else the limits are the range of the data.
    """

    urdf: Path | None = None


@dataclass
class Trained:
    """A trained model.

    Attributes:
        model: The model.
        report: What it stored and chose.
        seconds: Time from the files to the model, s; importing libraries and compiling
            kernels is not in it.
        notes: Where joint limits and touch come from, for people.
    """

    model: HASM
    report: FitReport
    seconds: float
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        size = self.model.memory_bytes() / 1e3
        stored = f"stored in {self.seconds:.2f} s, {size:.0f} kB"
        return "\n".join([*self.notes, str(self.report), stored])


def settings(method: Method, model: HASMConfig) -> HASMConfig:
    """The settings of a named method.

    Raises:
        ValueError: If "literal" meets settings that differ from the defaults and would be lost.
    """
    if method == "default":
        return model
    if model != HASMConfig():
        raise ValueError(
            "--method=literal fixes every setting of the model: leave the --model options out, "
            "or give them all with --method=default"
        )
    return HASMConfig.literal()


def train(
    roots: Path | Sequence[Path],
    config: HASMConfig,
    features: FeatureMap | None = None,
    urdf: Path | None = None,
) -> Trained:
    """Learn a dataset; one that is large for the memory is read an episode at a time.

    Args:
        roots: Folder of the dataset, or of several.
        config: Settings of the method.
        features: Which features are read; LeRobot's usual names by default.
        urdf: The robot's URDF, see ``body_of``.

    Returns:
        The model and what it took.

    Raises:
        FileNotFoundError: If there is no dataset.
        ValueError: If the dataset is damaged or lacks what the method needs.
    """
    warm_up()
    begin = time.perf_counter()
    names = features or FeatureMap()
    folders = [roots] if isinstance(roots, Path) else list(roots)
    data = load_all(folders, names, most_bytes=MOST_BYTES)
    body = body_of(data, urdf)
    if len(data.action_names) != len(body.joints):
        raise ValueError(
            f"the action of {data.root} has {len(data.action_names)} entries, expected a target "
            f"for each of the {len(body.joints)} joints; with --features.action={names.state} "
            "the measured positions are learned instead"
        )
    model = HASM(config, body)
    report = model.fit(data)
    return Trained(model, report, time.perf_counter() - begin, describe_body(data, body, urdf))


def warm_up() -> None:
    """Import and compile what training uses, once a process, so that it is not timed."""
    import pyarrow.parquet  # noqa: F401

    turn = [*np.eye(3).ravel().tolist(), 0.0, 0.0, 1.0, 0.0, 1.0, 0.0]  # about z, by the joint
    body = Body(
        *(["joint"], [0.0], [1.0], [1.0]),
        *(["patch"], [1], [[1.0, 0.0, 0.0]]),
        links=["link"],
        chains={"link": [turn]},
    )
    way = np.linspace(0.2, 0.8, 20, dtype=np.float32)[:, None]
    touch = np.full((20, 1, 3), 3.0, np.float32)
    episodes = [Episode(i, "", np.arange(20) / body.rate, way, way, touch) for i in range(2)]
    HASM(HASMConfig(drive="spike"), body).fit(episodes)
