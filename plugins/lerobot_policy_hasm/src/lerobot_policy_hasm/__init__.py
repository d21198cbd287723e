"""Makes ``--policy.type=hasm`` known to LeRobot, which imports this package by its name."""

from hasm_torch.lerobot.configuration_hasm import HASMConfig

__all__ = ["HASMConfig"]
