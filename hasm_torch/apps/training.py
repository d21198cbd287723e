"""``train.py``: store the episodes of a LeRobot dataset in a memory and write a checkpoint."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from hasm_torch.apps.command_line import parse_options
from hasm_torch.config import HASMConfig
from hasm_torch.data.episodes import FeatureMap
from hasm_torch.data.training import DatasetConfig, Method, RobotConfig, settings, train


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
    features: FeatureMap = field(default_factory=FeatureMap)
    robot: RobotConfig = field(default_factory=RobotConfig)
    method: Method = "default"
    model: HASMConfig = field(default_factory=HASMConfig)
    output_dir: Path | None = None


def main() -> None:
    """Train with the options of the command line."""
    config = parse_options(TrainConfig)
    if config.dataset.root is None or config.output_dir is None:
        sys.exit(
            "train.py needs a dataset and a place for the checkpoint, for example "
            "--dataset.root=datasets/hsr_yield --output_dir=outputs/train/yield"
        )
    try:
        method = settings(config.method, config.model)
        trained = train(config.dataset.roots, method, config.features, config.robot.urdf)
        trained.model.save_pretrained(config.output_dir)
    except (OSError, ValueError) as error:
        sys.exit(f"train.py: {error}")
    print(trained)
    print(f"checkpoint: {config.output_dir}")
