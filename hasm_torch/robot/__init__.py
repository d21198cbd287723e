"""The Toyota HSR: its joints and links (``Kinematics``) and the skin on them (``Skin``)."""

from hasm_torch._extras import require
from hasm_torch._headless import prefer_egl

require("robot")
prefer_egl()

from hasm_torch.robot.kinematics import BASE_FRAME, JOINTS, METRES, Kinematics  # noqa: E402
from hasm_torch.robot.skin import PATCHES, Skin, SkinSurface  # noqa: E402
from hasm_torch.robot.turns import link_turns, planar_base, rigid_body  # noqa: E402

__all__ = [
    "BASE_FRAME",
    "JOINTS",
    "METRES",
    "PATCHES",
    "Kinematics",
    "Skin",
    "SkinSurface",
    "link_turns",
    "planar_base",
    "rigid_body",
]
