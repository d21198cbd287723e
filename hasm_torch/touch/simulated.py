"""The simulated HSR as datasets and models describe it."""

from pathlib import Path

from hasm_torch.body import Body
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import EpisodeSet
from hasm_torch.data.recording import write_episodes
from hasm_torch.data.skin import skin_patches
from hasm_torch.episode import ENVIRONMENT, Episode
from hasm_torch.robot import JOINTS, METRES, Skin
from hasm_torch.sim.env import CONTROL_RATE
from hasm_torch.sim.tasks import OBJECT_ENTRIES

BUNDLED = {"compliance": "hsr_yield", "grasp": "hsr_grasp"}
"""The bundled teaching of each scene, a dataset."""

UNITS = tuple("m" if joint in METRES else "rad" for joint in JOINTS)


def bound_in(scene: str) -> dict[str, dict[str, str]]:
    """Entries and units of what is bound besides joints and skin in a scene, by feature."""
    return {ENVIRONMENT: OBJECT_ENTRIES} if scene == "grasp" else {}


def body_in(scene: str) -> Body:
    """Joints and skin of the robot in a scene, as a model takes them before it knows anything."""
    nothing = EpisodeSet(
        episodes=[],
        fps=CONTROL_RATE,
        joints=tuple(JOINTS),
        units=UNITS,
        skin=skin_patches(Skin.load()),
        root=Path(),
        action_names=tuple(JOINTS),
        observations={name: len(entries) for name, entries in bound_in(scene).items()},
    )
    return body_of(nothing)


def check_body(body: Body, scene: str) -> None:
    """Raise ValueError where a model of a body cannot move the robot in a scene."""
    robot = body_in(scene)
    if (body.joints, body.cells) != (robot.joints, robot.cells):
        raise ValueError(
            f"it was taught to a robot with {len(body.joints)} joints and {sum(body.cells)} skin "
            f"cells, expected the HSR's {len(robot.joints)} and {sum(robot.cells)}"
        )
    if body.observations != robot.observations:
        raise ValueError(
            f"it binds {list(body.observations) or 'no object'}, and the scene {scene} has "
            f"{list(robot.observations) or 'no object'}: use the other --scene"
        )


def write_dataset(root: Path, episodes: list[Episode], scene: str) -> Path:
    """Write demonstrations as a LeRobot dataset.

    Args:
        root: Folder of the dataset; one that is there is replaced.
        episodes: The demonstrations.
        scene: Where they were shown.

    Returns:
        The folder.

    Raises:
        FileExistsError: The folder holds something else.
        ValueError: There are no demonstrations.
    """
    return write_episodes(
        root,
        episodes,
        joints=JOINTS,
        units=UNITS,
        skin=skin_patches(Skin.load()),
        fps=CONTROL_RATE,
        robot_type="hsr",
        observations=bound_in(scene) or None,
        overwrite=True,
    )
