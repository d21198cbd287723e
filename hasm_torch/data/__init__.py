"""Demonstrations in and out: LeRobot v3.0 datasets with synchronised joints and skin.

Inside this package ``import lerobot`` is the installed LeRobot library. Reading needs pyarrow
only; LeRobot itself is imported where a dataset is written.
"""

from hasm_torch.data.card import write_card
from hasm_torch.data.episodes import (
    Episode,
    EpisodeSet,
    FeatureMap,
    load_episodes,
)
from hasm_torch.data.recording import write_episodes
from hasm_torch.data.skin import SkinPatch, skin_patches

__all__ = [
    "Episode",
    "EpisodeSet",
    "FeatureMap",
    "SkinPatch",
    "load_episodes",
    "skin_patches",
    "write_card",
    "write_episodes",
]
