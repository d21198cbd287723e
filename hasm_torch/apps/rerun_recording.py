"""The episodes of a dataset for the Rerun viewer.

uv run python -m hasm_torch.apps.rerun_recording --dataset.root=data/mine --output=mine.rrd
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hasm_torch.apps.command_line import parse_options
from hasm_torch.config import HASMConfig
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import FeatureMap, load_all
from hasm_torch.data.training import DatasetConfig, RobotConfig
from hasm_torch.evaluation.viewer import Scenes, cell_places, write_recording
from hasm_torch.model.felt import calibrate, recorded_forces, skin_encoder


def dataset_scenes(
    roots: Sequence[Path], features: FeatureMap | None = None, urdf: Path | None = None
) -> Scenes:
    """All episodes of a dataset, one after the other.

    Args:
        roots: Folders of datasets of one robot.
        features: Which features are read; LeRobot's usual names by default.
        urdf: The robot's URDF, see ``body_of``.

    Raises:
        FileNotFoundError, ValueError: See ``load_episodes`` and ``body_of``.
    """
    data = load_all(roots, features)
    state = np.concatenate([episode.state for episode in data])
    scenes = Scenes(np.arange(len(state)) / data.fps, list(data.joints), state)
    if data.skin:
        config, body = HASMConfig(), body_of(data, urdf)
        encoder = skin_encoder(config, body, *calibrate(config, body, data))
        forces = [recorded_forces(body, episode) for episode in data]
        scenes.spikes = np.concatenate([encoder(skin)[0].spikes.numpy() for skin in forces])
        scenes.skin = np.concatenate([skin.numpy() for skin in forces])
        scenes.patches, scenes.cells = body.patches, cell_places(scenes.joints, state)
    return scenes


@dataclass
class RecordingConfig:
    """Options.

    Attributes:
        dataset: Which dataset to show.
        features: Which of its features are read.
        robot: Which robot recorded it.
        output: The ``.rrd`` file to write.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    features: FeatureMap = field(default_factory=FeatureMap)
    robot: RobotConfig = field(default_factory=RobotConfig)
    output: Path = Path("episodes.rrd")


def main() -> None:
    """Write a recording of a dataset."""
    config = parse_options(RecordingConfig)
    if config.dataset.root is None:
        sys.exit("a dataset is needed, for example --dataset.root=datasets/hsr_grasp")
    try:
        scenes = dataset_scenes(config.dataset.roots, config.features, config.robot.urdf)
        write_recording(config.output, scenes, "episodes")
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    print(f"{config.output}: open it with `uv run rerun {config.output}`")


if __name__ == "__main__":
    main()
