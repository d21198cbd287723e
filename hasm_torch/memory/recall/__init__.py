"""Softmax recall d = S₋₁ softmax(β Mᵀ q) over dense and packed memories."""

from hasm_torch.memory.recall.dense import Recall, inspect_dense, recall_dense, recall_weights
from hasm_torch.memory.recall.packed import ROWS, inspect_packed, pack, recall_packed, store, unpack

__all__ = [
    "ROWS",
    "Recall",
    "inspect_dense",
    "inspect_packed",
    "pack",
    "recall_dense",
    "recall_packed",
    "recall_weights",
    "store",
    "unpack",
]
