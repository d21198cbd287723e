"""From a dataset to a trained model."""

import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig, MemoryShape
from hasm_torch.model.hasm import HASM
from hasm_torch.model.learning import FitReport

METHODS = ("default", "literal")


@dataclass
class DatasetConfig:
    """Which dataset to learn from.

    Attributes:
        root: Folder of the LeRobot v3.0 dataset.
    """

    root: Path | None = None


@dataclass
class FeaturesConfig:
    """Which features of the dataset are read.

    Attributes:
        state: Joint positions.
        tactile: Skin readings: cells x 3 forces, cells x 1 pressure, or wrenches of 6. A dataset
            without this feature is a plain sequence memory.
        action: Joint targets.
    """

    state: str = "observation.state"
    tactile: str = "observation.tactile"
    action: str = "action"


@dataclass
class RobotConfig:
    """Which robot recorded the dataset.

    Attributes:
        urdf: Its URDF, for the joint limits; by default the bundled HSR's where that has the
            dataset's joints, else the limits are the range of the data.
    """

    urdf: Path | None = None


@dataclass
class TrainConfig:
    """Options of ``train.py``.

    Attributes:
        dataset: Which dataset to learn from.
        features: Which of its features are read.
        robot: Which robot recorded it.
        method: "default", with the settings under ``model``, or "literal", the paper as written.
        model: Settings of the method.
        output_dir: Where the checkpoint goes.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    method: Literal["default", "literal"] = "default"
    model: HASMConfig = field(default_factory=HASMConfig)
    output_dir: Path | None = None


@dataclass
class Trained:
    """A trained model.

    Attributes:
        model: The model.
        report: What it stored.
        seconds: Time from the files to the model, s; importing libraries and compiling
            kernels is not in it.
        notes: Where joint limits and touch come from, for people.
    """

    model: HASM
    report: FitReport
    seconds: float
    notes: list[str] = field(default_factory=list)


def settings(method: str, model: HASMConfig) -> HASMConfig:
    """The settings of a named method.

    Raises:
        ValueError: If the method is unknown, or "literal" meets settings that differ from the
            defaults and would be lost.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}, valid: {', '.join(METHODS)}")
    if method == "default":
        return model
    if model != HASMConfig():
        raise ValueError(
            "--method=literal fixes every setting of the model: leave the --model options out, "
            "or give them all with --method=default"
        )
    return HASMConfig.literal()


def train(
    root: Path,
    config: HASMConfig,
    features: FeaturesConfig | None = None,
    robot: RobotConfig | None = None,
) -> Trained:
    """Learn a dataset; one that is large for the memory is read an episode at a time.

    Args:
        root: Folder of the dataset.
        config: Settings of the method; where the skin does not read newtons, its threshold and
            current come from the episodes.
        features: Which features are read; LeRobot's usual names by default.
        robot: Which robot recorded it.

    Returns:
        The model and what it took.

    Raises:
        FileNotFoundError: If there is no dataset.
        ValueError: If the dataset is damaged or lacks what the method needs.
    """
    from hasm_torch.data.body import body_of, describe_body
    from hasm_torch.data.episodes import FeatureMap, open_episodes

    _load_libraries()
    begin = time.perf_counter()
    urdf = robot.urdf if robot else None
    names = FeatureMap(**asdict(features or FeaturesConfig()))
    data = open_episodes(root, names)
    body = body_of(data, urdf)
    notes = describe_body(data, body, urdf)
    if len(data.action_names) != len(body.joints):
        raise ValueError(
            f"the action of {root} has {len(data.action_names)} entries, expected a target for "
            f"each of the {len(body.joints)} joints; with --features.action={names.state} "
            "the measured positions are learned instead"
        )
    if data.skin and next(iter(data.skin.values())).unit != "N":
        from hasm_torch.prediction.series import calibrate

        threshold, current = calibrate(body, data)
        config = replace(config, threshold=threshold, current_per_newton=current)
        notes.append(f"touch threshold {threshold:.3g}, current a unit {current:.3g}: as recorded")
    model = HASM(config, body)
    report = model.fit(data)
    return Trained(model, report, time.perf_counter() - begin, notes)


def _load_libraries() -> None:
    """Import and compile what training uses, once a process, so that it is not timed."""
    import pyarrow.parquet  # noqa: F401

    body = Body(["joint"], [0.0], [1.0], [1.0], ["patch"], [1], [[1.0, 0.0, 0.0]])
    model = HASM(HASMConfig(), body)
    model.skin(model.clean(torch.zeros(1, 1, 3))[0])
    memory = model.add_memory("patch", MemoryShape([0], 1, 0))
    one = torch.zeros(1)
    memory.write(one.unsqueeze(0), one, one.unsqueeze(0), one)
    memory(one, one[0])


def describe(trained: Trained) -> str:
    """What was stored, as a table for people."""
    lines = [*trained.notes, f"{'patch':<14}{'associations':>14}{'beta':>8}  joints"]
    for patch, count in trained.report.associations.items():
        beta = trained.report.betas[patch]
        joints = ", ".join(j.removesuffix("_joint") for j in trained.report.joints[patch])
        lines.append(f"{patch:<14}{count:>14}{beta:>8.2f}  {joints}")
    size = trained.model.memory_bytes() / 1e3
    lines.append(
        f"{trained.report.episodes} episodes stored in {trained.seconds:.2f} s, {size:.0f} kB"
    )
    return "\n".join(lines)
