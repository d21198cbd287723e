"""Records the bundled datasets again.

uv run python -m hasm_torch.sim.record --root=datasets --seed=0
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import draccus
from tqdm import tqdm

from hasm_torch.data import Episode, skin_patches, write_card, write_episodes
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.demonstrator import (
    COMPLIANCE_FORCES,
    GRASP_FORCES,
    compliance_episodes,
    grasp_episodes,
)
from hasm_torch.sim.env import CONTROL_RATE


@dataclass
class RecordConfig:
    """Options.

    Attributes:
        root: Folder that holds the datasets.
        seed: Seed of start states, pauses and object places.
        grasps: Number of grasp episodes.
    """

    root: Path = Path("datasets")
    seed: int = 0
    grasps: int = 6


def main() -> None:
    """Record both datasets, replacing those that are there."""
    config = draccus.parse(config_class=RecordConfig)
    command = f"uv run python -m hasm_torch.sim.record --root=datasets --seed={config.seed}"
    newtons = "{} N".format(" N, ".join(f"{f:g}" for f in COMPLIANCE_FORCES))
    root = config.root / "hsr_compliance"
    _write(root, tqdm(compliance_episodes(), desc="compliance", unit="episode"))
    write_card(
        root,
        title="HSR pseudo-compliance by touch",
        summary=(
            "A simulated Toyota HSR with robot skin yields to a finger: touch on the upper or "
            "under side of the wrist moves the arm down or up, touch on its left or right side "
            "turns the wrist. Each episode covers the whole range of one joint."
        ),
        recording=(
            f"MuJoCo simulation, {CONTROL_RATE} Hz. Every behaviour is shown once with each of "
            f"{newtons}; the joint target advances at a speed proportional to the force that the "
            "skin feels. Spikes are not stored: the model derives them from the forces."
        ),
        command=command,
    )
    newtons = "{} N".format(" N, ".join(f"{f:g}" for f in GRASP_FORCES))
    root = config.root / "hsr_grasp"
    episodes = grasp_episodes(config.grasps, config.seed)
    bar = tqdm(episodes, total=config.grasps, desc="grasp", unit="episode")
    _write(root, bar)
    write_card(
        root,
        title="HSR grasp guided by touch",
        summary=(
            "A simulated Toyota HSR with robot skin is led by a finger: touch on the upper side of "
            "the wrist reaches for an object on a table, touch on its right side grasps it and "
            "retracts. Head, torso, arm, wrist and hand move together."
        ),
        recording=(
            f"MuJoCo simulation, {CONTROL_RATE} Hz. The touch is {newtons} in turn and pauses once "
            "in each stage; the start state varies by 0.05 rad (arm lift 1 cm) and the object "
            "stands up to 1 cm from its place. Spikes are not stored: the model derives them from "
            "the forces."
        ),
        command=command,
    )


def _write(root: Path, episodes: Iterable[Episode]) -> None:
    write_episodes(
        root,
        episodes,
        joints=JOINTS,
        units=["m" if joint == "arm_lift_joint" else "rad" for joint in JOINTS],
        skin=skin_patches(Skin.load()),
        fps=CONTROL_RATE,
        robot_type="hsr",
        overwrite=True,
    )


if __name__ == "__main__":
    main()
