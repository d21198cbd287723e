"""Makes ``--robot.type=hsr`` known to LeRobot, which imports this package by its name."""

from hasm_torch.lerobot.hsr import HSR, HSRConfig

__all__ = ["HSR", "HSRConfig"]
