"""The Toyota HSR: its joints and links (``Kinematics``) and the skin on them (``Skin``)."""

from hasm_torch._headless import prefer_egl

prefer_egl()

from hasm_torch.robot.kinematics import JOINTS, Kinematics  # noqa: E402
from hasm_torch.robot.skin import PATCHES, Skin, SkinSurface  # noqa: E402

__all__ = ["JOINTS", "PATCHES", "Kinematics", "Skin", "SkinSurface"]
