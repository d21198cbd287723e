"""Hetero-associative sequential memory for touch-driven robots, as PyTorch modules."""

from hasm_torch.bipolar import binarise, bind, to_bipolar
from hasm_torch.config import Body, HASMConfig
from hasm_torch.hasm import HASM
from hasm_torch.izhikevich import Izhikevich, IzhikevichState
from hasm_torch.memory import HeteroAssociativeMemory
from hasm_torch.place_code import PlaceCode
from hasm_torch.rope3d import RoPE3D, rope3d, touch_rotation
from hasm_torch.touch import EffectiveForce, TactileEmbedding

__all__ = [
    "HASM",
    "Body",
    "EffectiveForce",
    "HASMConfig",
    "HeteroAssociativeMemory",
    "Izhikevich",
    "IzhikevichState",
    "PlaceCode",
    "RoPE3D",
    "TactileEmbedding",
    "binarise",
    "bind",
    "rope3d",
    "to_bipolar",
    "touch_rotation",
]
