"""Records the bundled datasets again.

uv run python -m hasm_torch.apps.teach --root=datasets --teach_seed=0
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import draccus
import numpy as np
from tqdm import tqdm

from hasm_torch.data import skin_patches, write_card, write_episodes
from hasm_torch.episode import ENVIRONMENT, Episode
from hasm_torch.robot import JOINTS, METRES, Skin
from hasm_torch.sim.demonstrator import compliance_episodes, grasp_episodes, yield_episodes
from hasm_torch.sim.env import CONTROL_RATE
from hasm_torch.sim.tasks import (
    BEHAVIOURS,
    COMPLIANCE_EPISODES,
    FAR,
    NEAR,
    OBJECT_ENTRIES,
    OBJECT_PLACES,
    PUSH_SECONDS,
    PUSH_TILT,
    START_NOISE,
    TEACHING_FORCE,
    TORSO_EPISODES,
    TREMOR,
    WRIST_EPISODES,
    YIELD_GAIN,
)

SPIKES = "Spikes are not stored: the model derives them from the forces."
CARDS = {
    "hsr_yield": {
        "title": "HSR that yields to touch",
        "summary": (
            "A simulated Toyota HSR with robot skin is pushed by a finger, and the touched point "
            "moves along the force: pushes on the four sides of the wrist lead the arm, pushes on "
            "the torso lead the mobile base."
        ),
        "recording": (
            f"MuJoCo simulation, {CONTROL_RATE} Hz, {TEACHING_FORCE:g} N. In each episode every "
            f"patch is pushed once for {PUSH_SECONDS:g} s, in random order, at a random cell, in "
            f"one random posture. The first {WRIST_EPISODES} episodes push the wrist, the last "
            f"{TORSO_EPISODES} the torso; the base starts at a random place and yaw. The finger "
            f"trembles by {100 * TREMOR:g} %, and the point is led at {YIELD_GAIN:g} m/s for each "
            "newton in a direction that is off the force by a random angle a push (standard "
            f"deviation {PUSH_TILT:g} rad). {SPIKES}"
        ),
    },
    "hsr_compliance": {
        "title": "HSR pseudo-compliance by touch",
        "summary": (
            "A simulated Toyota HSR with robot skin yields to a finger: touch on the upper or "
            "under side of the wrist moves the arm down or up, touch on its left or right side "
            "turns the wrist. Each episode covers the whole range of one joint."
        ),
        "recording": (
            f"MuJoCo simulation, {CONTROL_RATE} Hz, {TEACHING_FORCE:g} N. Every behaviour is shown "
            f"{COMPLIANCE_EPISODES} times in different postures, with the arm's roll at 0 and the "
            "wrist nearly straight; in the arm's episodes it is not twisted, so that the touched "
            "point moves with the force. The joint target advances at a speed proportional to the "
            f"force that the skin feels. {SPIKES}"
        ),
    },
    "hsr_grasp": {
        "title": "HSR grasp guided by touch",
        "summary": (
            "A simulated Toyota HSR with robot skin is led by a finger: touch on the upper side of "
            "the wrist reaches for an object on a table, touch on its right side grasps it and "
            "retracts. Base, torso, arm, wrist, hand and head move together. The object's place in "
            "the frame of the base is bound with joints and skin."
        ),
        "recording": (
            f"MuJoCo simulation, {CONTROL_RATE} Hz, {TEACHING_FORCE:g} N with one pause in each "
            f"stage. The object stands on a 3 x 3 grid over {100 * NEAR:g} cm to each side of its "
            f"usual place (first nine episodes), then on a 4 x 4 grid over {100 * FAR:g} cm. The "
            f"start state varies by {START_NOISE:g} rad (arm lift 1 cm). {SPIKES}"
        ),
    },
}


@dataclass
class TeachConfig:
    """Options.

    Attributes:
        root: Folder that holds the datasets.
        teach_seed: Seed of everything random in the teaching.
    """

    root: Path = Path("datasets")
    teach_seed: int = 0


def record_if_missing(root: Path, names: Collection[str]) -> None:
    """Record bundled datasets where a checkout has them and an installed package does not.

    Args:
        root: Folder that holds the datasets; another than the default one is left alone.
        names: Which datasets are needed.
    """
    missing = [name for name in names if not (root / name).exists()]
    if missing and root == TeachConfig().root:
        print(f"recording the teaching, once, in simulation: {', '.join(missing)} in {root}")
        teach(root, TeachConfig().teach_seed, missing)


def main() -> None:
    """Record all datasets, replacing those that are there."""
    config = draccus.parse(config_class=TeachConfig)
    teach(config.root, config.teach_seed)


def teach(root: Path, seed: int, names: Collection[str] = tuple(CARDS)) -> None:
    """Record datasets, replacing those that are there.

    Args:
        root: Folder that holds the datasets.
        seed: Seed of everything random in the teaching.
        names: Which datasets.
    """
    yields, compliance, grasps = (np.random.default_rng(seed) for _ in range(3))
    taught: dict[str, tuple[Iterable[Episode], int]] = {
        "hsr_yield": (
            chain(
                yield_episodes(WRIST_EPISODES, torso=False, generator=yields),
                yield_episodes(TORSO_EPISODES, torso=True, generator=yields),
            ),
            WRIST_EPISODES + TORSO_EPISODES,
        ),
        "hsr_compliance": (
            compliance_episodes(compliance),
            COMPLIANCE_EPISODES * len(BEHAVIOURS),
        ),
        "hsr_grasp": (grasp_episodes(grasps), len(OBJECT_PLACES)),
    }
    command = "uv run python -m hasm_torch.apps.teach --root=datasets"
    for name in names:
        episodes, count = taught[name]
        write_episodes(
            root / name,
            tqdm(episodes, name, count, unit="episode"),
            joints=JOINTS,
            units=["m" if joint in METRES else "rad" for joint in JOINTS],
            skin=skin_patches(Skin.load()),
            fps=CONTROL_RATE,
            robot_type="hsr",
            observations={ENVIRONMENT: OBJECT_ENTRIES} if name == "hsr_grasp" else None,
            overwrite=True,
        )
        card = CARDS[name] | {"command": f"{command} --teach_seed={seed}"}
        write_card(root / name, **card)


if __name__ == "__main__":
    main()
