"""Predicting the joint states of any robot from its own recordings.

q, recent displacement ──PlaceCode──────────────────► s ┐
skin forces ──SkinEncoder──► ρ ──TactileEmbedding──RoPE3D──► o ┤ m = s ⊗ o ──► M, S₋₁
                                                         └─► softmax recall ──► q(t + horizon)
"""

from hasm_torch.prediction.annealing import anneal
from hasm_torch.prediction.predictor import JointPredictor
from hasm_torch.prediction.selection import choose_settings
from hasm_torch.prediction.series import Moments, Series, TouchRates, moments
from hasm_torch.prediction.settings import PredictionSettings

__all__ = [
    "JointPredictor",
    "Moments",
    "PredictionSettings",
    "Series",
    "TouchRates",
    "anneal",
    "choose_settings",
    "moments",
]
