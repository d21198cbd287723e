"""Demonstrations in and out: LeRobot v3.0 datasets with synchronised joints and skin.

Inside this package ``import lerobot`` is the installed LeRobot library. Reading needs pyarrow
only; LeRobot itself is imported where a dataset is written.
"""

from hasm_torch._extras import require

require("robot")

from hasm_torch.data.card import write_card  # noqa: E402
from hasm_torch.data.episodes import (  # noqa: E402
    Episode,
    EpisodeSet,
    FeatureMap,
    load_episodes,
)
from hasm_torch.data.recording import write_episodes  # noqa: E402
from hasm_torch.data.skin import SkinPatch, skin_patches  # noqa: E402

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
