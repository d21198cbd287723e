"""``hasm-import``: a LeRobot dataset from ROS 1 bags, ROS 2 bags and MCAP files.

hasm-import --root=data/mine --bag=push.bag --state=/hsrb/joint_states --skin=/patch1
hasm-import --root=data/mine --bag='[push_1, push_2]' --config_path=my_lab.yaml
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from tqdm import tqdm

from hasm_torch.apps.command_line import parse_options
from hasm_torch.data.bags.reading import Bag
from hasm_torch.data.bags.sampling import Recording, Sampling, Skin, sample
from hasm_torch.data.bags.skins import SkinTopic, in_order
from hasm_torch.data.recording import write_episodes
from hasm_torch.data.skin import SkinPatch
from hasm_torch.episode import Episode


@dataclass
class ImportConfig(Sampling):
    """Options of ``hasm-import``, besides those of ``Sampling``.

    A lab's topics are best kept in a YAML file of these options, given as ``--config_path``.

    Attributes:
        root: Folder of the new dataset.
        bag: Bags, an episode each: ``.bag``, ``.mcap`` or the folder of a ROS 2 bag.
        state: Topic of the joint states, ``sensor_msgs/JointState``.
        skin: Topics of the skin, a patch each, or patches by name (see ``SkinTopic``).
        action: Topics of the commands, ``JointTrajectory``, ``JointState`` or
            ``Float64MultiArray``; where there are none, an action is the next state.
        joints: Names of the joints in their order in the dataset; by default all.
        units: Unit of each joint; "rad" for all by default.
        clock: When a message counts: when the bag "received" it, or when its header says that it
            was "stamped", as far as it has one; the clocks of all computers must then agree.
        tactile_unit: Unit of the skin's readings after their gain; by default what is known.
        split_s: Cut each bag into episodes of this length, s; 0 keeps it whole.
        task: What is done, in words.
        robot_type: Robot the bags come from.
        overwrite: Replace a dataset at ``root``.
    """

    root: Path | None = None
    bag: list[str] | str = field(default_factory=list)
    state: str = ""
    skin: dict[str, SkinTopic] | list[str] | str = field(default_factory=list)
    action: list[str] | str = field(default_factory=list)
    joints: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    clock: Literal["received", "stamped"] = "received"
    tactile_unit: str = ""
    split_s: float = 0.0
    task: str = "move under touch"
    robot_type: str = "unknown"
    overwrite: bool = False


def import_bags(config: ImportConfig) -> tuple[Path, list[str]]:
    """Import bags.

    Args:
        config: Which ones and where to.

    Returns:
        Folder of the dataset; what there is to say about the bags, a line each.

    Raises:
        FileExistsError: If the folder holds something already.
        FileNotFoundError: If a bag is not there.
        ImportError: If ``rosbags`` is not installed.
        ValueError: If an option is missing, or does not fit what the bags hold.
    """
    bags = _several(config.bag)
    if config.root is None or not bags or not config.state:
        raise ValueError("expected --root, --bag and --state, the topic of the joint states")
    skins = config.skin
    if not isinstance(skins, dict):
        skins = {topic.strip("/").replace("/", "_"): SkinTopic(topic) for topic in _several(skins)}
    recordings: list[Recording] = []
    for path in tqdm(bags, unit="bag", disable=None):
        with Bag(Path(path), stamped=config.clock == "stamped") as bag:
            joints = config.joints or (recordings[0].joints if recordings else [])
            actions = _several(config.action)
            recordings.append(sample(bag, config.state, joints, actions, skins, config))
    notes = [f"{path}: {note}" for path, r in zip(bags, recordings) for note in r.notes]
    patches, cells = _patches(config, skins, [recording.skins for recording in recordings])
    root = write_episodes(
        config.root,
        _episodes(config, recordings, cells),
        joints=recordings[0].joints,
        units=config.units or ["rad"] * len(recordings[0].joints),
        skin=patches,
        fps=config.fps,
        robot_type=config.robot_type,
        gaps=config.missing == "nan",
        overwrite=config.overwrite,
    )
    return root, notes


def _several(value: list[str] | str) -> list[str]:
    return [value] if isinstance(value, str) else value


Cells = dict[str, list[tuple[str, int]]]


def _patches(
    config: ImportConfig, topics: dict[str, SkinTopic], found: list[dict[str, Skin]]
) -> tuple[dict[str, SkinPatch] | None, Cells]:
    """The patches of the dataset, and the cells of each in their order, over all bags."""
    patches: dict[str, SkinPatch] = {}
    cells: Cells = {}
    units, channels, stop = {}, {}, 0
    for name, topic in topics.items():
        mine = [skins[name] for skins in found]
        cells[name] = in_order({cell for skin in mine for cell in skin.cells}, topic.cells)
        units[name] = config.tactile_unit or mine[0].unit
        channels[name] = mine[0].readings.shape[2]
        start, stop, normals = stop, stop + len(cells[name]), None
        if topic.normals:
            if len(topic.normals) not in (1, stop - start):
                raise ValueError(
                    f"skin {name}: expected a normal for each of its {stop - start} cells or one "
                    f"for all, got {len(topic.normals)}"
                )
            normals = np.broadcast_to(np.array(topic.normals, float), (stop - start, 3))
        patches[name] = SkinPatch(
            name, slice(start, stop), topic.link or None, normals=normals, unit=units[name]
        )
    for what, values in (("readings a cell", channels), ("units", units)):
        if len(set(values.values())) > 1:
            raise ValueError(
                f"the skin of a dataset is of one kind, got {what} {values}: import the patches "
                "into datasets of their own, or give --tactile_unit"
            )
    return patches or None, cells


def _episodes(config: ImportConfig, recordings: list[Recording], cells: Cells) -> Iterator[Episode]:
    number = 0
    absent = np.nan if config.missing == "nan" else 0.0
    for recording in recordings:
        length = len(recording.state)
        tactile = [
            _at(recording.skins[name], wanted, absent, length) for name, wanted in cells.items()
        ]
        skin = np.concatenate(tactile, axis=1) if tactile else None
        step = round(config.split_s * config.fps) or length
        for start in range(0, length, step):
            part = slice(start, start + step)
            state, action = recording.state[part], recording.action[part]
            time = np.arange(len(state)) / config.fps
            felt = None if skin is None else skin[part]
            yield Episode(number, config.task, time, state, action, felt)
            number += 1


def _at(skin: Skin, wanted: list[tuple[str, int]], absent: float, length: int) -> np.ndarray:
    """Readings of the wanted cells; a cell that this bag does not know is absent."""
    out = np.full((length, len(wanted), skin.readings.shape[2]), absent, np.float32)
    out[:, [wanted.index(cell) for cell in skin.cells]] = skin.readings
    return out


def main() -> None:
    """Import with the options of the command line."""
    try:
        root, notes = import_bags(parse_options(ImportConfig))
    except (FileExistsError, FileNotFoundError, ImportError, ValueError) as error:
        sys.exit(f"hasm-import: {error}")
    print(
        *notes,
        f"imported {root}; train on it with: uv run train.py --dataset.root={root}",
        sep="\n",
    )


if __name__ == "__main__":
    main()
