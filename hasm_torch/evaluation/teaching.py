"""Which demonstrations each model of an evaluation learns."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hasm_torch.config import HASMConfig
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.episode import Episode
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import Skin
from hasm_torch.sim.tasks import YIELD_TORSO

# Patches that a model of "yield" is not shown, to be tested on them: one of each pair of opposite
# sides, so that half of the directions are left.
UNSEEN = ("wrist_under", "wrist_right")
NEAR_PLACES = 9  # of the grasps, the first of tasks.OBJECT_PLACES; sixteen are farther apart
TOUCHED = 0.05  # N on a patch: less is noise
SHORTEST = 5  # samples of an episode: a shorter rest of a cut one teaches nothing

Choice = Callable[[Sequence[Episode]], Sequence[Episode]]


def learn(root: Path, config: HASMConfig, choice: Choice | None = None) -> HASM:
    """A model of some episodes of a dataset.

    Args:
        root: Folder of the dataset.
        config: Settings of the method.
        choice: Picks the episodes; all by default.

    Raises:
        FileNotFoundError: If there is no dataset.
        ValueError: If the dataset is damaged or lacks what the method or the choice needs.
    """
    data = load_episodes(root)
    if choice is not None:
        data = replace(data, episodes=choice(data.episodes))
    model = HASM(config, body_of(data))
    model.fit(data)
    return model


def wrist_and_torso(count: int, without: Sequence[str] = ()) -> Choice:
    """The first demonstrations at the wrist, and all at the torso.

    Args:
        count: How many at the wrist.
        without: Patches whose touches are cut out.

    Returns:
        What picks them. It raises ValueError where there are fewer.
    """

    def choose(episodes: Sequence[Episode]) -> Sequence[Episode]:
        torso = [e for e in episodes if e.task == YIELD_TORSO]
        wrist = [e for e in episodes if e.task != YIELD_TORSO]
        if len(wrist) < count:
            raise ValueError(
                f"episodes must be at most {len(wrist)}, the yield demonstrations at the wrist "
                f"that there are, got {count}"
            )
        pieces = [piece for e in wrist[:count] for piece in cut(e, without)]
        return [replace(e, index=i) for i, e in enumerate(pieces + torso)]

    return choose


def near_places(episodes: Sequence[Episode]) -> Sequence[Episode]:
    """Grasps of the object at the nine places within 5 cm."""
    return episodes[:NEAR_PLACES]


def far_places(episodes: Sequence[Episode]) -> Sequence[Episode]:
    """Grasps of the object at the sixteen places within 10 cm."""
    return episodes[NEAR_PLACES:]


def cut(episode: Episode, patches: Sequence[str]) -> list[Episode]:
    """What is left of an episode of the HSR without the touches of some patches.

    Args:
        episode: The episode.
        patches: The patches.

    Returns:
        The stretches between such touches, as episodes of their own.
    """
    skin = Skin.load().slices
    force = np.zeros(len(episode))
    if episode.tactile is not None:
        for patch in patches:
            force += np.abs(episode.tactile[:, skin[patch]]).sum(axis=(1, 2))
    kept = np.flatnonzero(force < TOUCHED)
    runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
    return [_part(episode, run) for run in runs if len(run) >= SHORTEST]


def _part(episode: Episode, rows: np.ndarray) -> Episode:
    more = episode.tactile, episode.observations
    tactile, observations = (None if values is None else values[rows] for values in more)
    time = episode.time[rows] - episode.time[rows[0]]
    return Episode(
        episode.index,
        episode.task,
        time,
        episode.state[rows],
        episode.action[rows],
        tactile,
        observations,
    )
