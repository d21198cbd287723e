"""Makes ``--env.type=hsr_touch`` known to LeRobot, which imports this package by its name."""

from hasm_torch.lerobot.env_hsr_touch import HSRTouchConfig

__all__ = ["HSRTouchConfig"]
