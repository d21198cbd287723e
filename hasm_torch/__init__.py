"""Hetero-associative sequential memory for touch-driven robots, as PyTorch modules."""

from importlib.metadata import PackageNotFoundError, version

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.bipolar import binarise, bind, to_bipolar
from hasm_torch.encoders.izhikevich import Izhikevich, IzhikevichState
from hasm_torch.encoders.place_code import PlaceCode
from hasm_torch.encoders.rope3d import RoPE3D, rope3d
from hasm_torch.encoders.touch import EffectiveForce, TactileEmbedding
from hasm_torch.memory import functional
from hasm_torch.memory.layer import HeteroAssociativeMemory
from hasm_torch.model.hasm import HASM

try:
    __version__ = version("hasm-torch")
except PackageNotFoundError:  # run from a folder without being installed
    __version__ = "0+unknown"

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
    "__version__",
    "binarise",
    "bind",
    "functional",
    "rope3d",
    "to_bipolar",
]
