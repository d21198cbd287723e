"""The yardsticks: standing still, and k-nearest-neighbour regression on the same inputs."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from hasm_torch.prediction.predictor import Recalled
from hasm_torch.prediction.series import Moments

NEIGHBOURS = 5
_BLOCK = 512


@dataclass
class NeighbourSettings:
    """Inputs and outputs of the regression; ``choose_neighbours`` finds them in the episodes.

    Attributes:
        context_s: As in ``PredictionSettings``.
        context: Weight of the standardised recent displacement; 0 leaves it out.
        touch: Weight of the standardised touch; 0 leaves it out.
        skin: "patches", the rate densities, or "cells", every cell's reading.
        shift: As in ``PredictionSettings``.
        momentum: As in ``PredictionSettings``.
    """

    context_s: float = 0.1
    context: float = 0.5
    touch: float = 0.0
    skin: Literal["patches", "cells"] = "patches"
    shift: list[float] = field(default_factory=list)
    momentum: list[float] = field(default_factory=list)


class NeighbourRegression:
    """Mean of what followed the five nearest states.

    Inputs are standardised by the learned episodes; the distance is Euclidean.

    Args:
        settings: Inputs and outputs.
        learned: Moments to look among.
    """

    def __init__(self, settings: NeighbourSettings, learned: Moments) -> None:
        self.settings, self.learned = settings, learned
        self._scale = [_one_over_spread(x) for x in self._inputs(learned)]
        self._stored = self._features(learned)

    def _inputs(self, found: Moments) -> list[Tensor]:
        skin = found.touch if self.settings.skin == "patches" else found.cells
        return [found.state, found.recent, skin.to(found.state)]

    def _features(self, found: Moments) -> Tensor:
        weights = (1.0, self.settings.context, self.settings.touch)
        parts = zip(weights, self._scale, self._inputs(found))
        return torch.cat([w * (x * scale) for w, scale, x in parts if w > 0], dim=-1).float()

    def recall(self, found: Moments) -> Recalled:
        """Means over the neighbours."""
        count = min(NEIGHBOURS, len(self._stored))
        blocks = self._features(found).split(_BLOCK)
        rows = torch.cat(
            [torch.cdist(block, self._stored).topk(count, largest=False)[1] for block in blocks]
        )
        learned = self.learned
        recent, state = learned.recent[rows].mean(1), learned.state[rows].mean(1)
        return Recalled(learned.target[rows].mean(1), found.recent - recent, found.state - state)

    def __call__(self, found: Moments) -> Tensor:
        """Predicted displacement to the successor, (K, J); targets are not looked at."""
        shift, momentum = torch.tensor(self.settings.shift), torch.tensor(self.settings.momentum)
        return self.recall(found).predict(shift, momentum)


def _one_over_spread(values: Tensor) -> Tensor:
    spread = (values - values.mean(0)).square().mean(0).sqrt()
    return torch.where(spread > 1e-9, 1.0 / spread.clamp(min=1e-9), 0.0)
