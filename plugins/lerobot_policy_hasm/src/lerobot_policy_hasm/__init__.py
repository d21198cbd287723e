"""Makes ``--policy.type=hasm`` known to LeRobot, which imports this package by its name."""

from hasm_torch.lerobot.configuration_hasm import HASMConfig
from hasm_torch.lerobot.processor_hasm import SplitState  # checkpoints name it

__all__ = ["HASMConfig", "SplitState"]
