"""Recall d = S₋₁ softmax(β Mᵀ q), and other interactions, over dense and packed memories."""

from hasm_torch.memory.recall.dense import (
    Recall,
    Stored,
    inspect_dense,
    recall_dense,
    weights_dense,
)
from hasm_torch.memory.recall.interaction import NORMALISED, Interaction, check_interaction
from hasm_torch.memory.recall.packed import (
    ROWS,
    inspect_packed,
    pack,
    recall_packed,
    store,
    unpack,
    warm_up,
    weights_packed,
)

__all__ = [
    "NORMALISED",
    "ROWS",
    "Interaction",
    "Recall",
    "Stored",
    "check_interaction",
    "inspect_dense",
    "inspect_packed",
    "pack",
    "recall_dense",
    "recall_packed",
    "store",
    "unpack",
    "warm_up",
    "weights_dense",
    "weights_packed",
]
