"""Three ways to remember, side by side: where each would take the robot.

the same touch ──► the one most similar association (β = ∞)     ──► ghost
──► the mean of all associations (β = 0)         ──► ghost
──► what the model does: weights in between      ──► ghost
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.model.control import Rollout
from hasm_torch.model.hasm import HASM
from hasm_torch.sim.env import CONTROL_RATE

Array = NDArray[np.float64]

WAYS = ("best memory alone", "mean of all memories", "its own weights")
FELT = 0.05  # N on the whole skin: less is no touch
_WARM_STEPS = 5  # at 3 N a cell every patch spikes in the first
REST = round(0.5 * CONTROL_RATE)  # steps without touch after which the ghosts come home


def ways(model: HASM) -> list[HASM]:
    """The model in the three ways to remember, in the order of `WAYS`; none if it knows nothing.

    What their answers need is made and compiled here, so that no control step waits for it.
    """
    if model.settled is None:
        return []
    models = [model.with_beta(math.inf), model.with_beta(0.0), model]
    for one in models:
        _warm_up(one)
    return models


def _warm_up(model: HASM) -> None:
    """Make and compile what answers and explanations take, so that the robot never waits."""
    body = model.body
    state = torch.zeros(len(body.joints))
    seen = torch.zeros(sum(body.observations.values())) if body.observations else None
    rollout = model.new_rollout()
    for _ in range(_WARM_STEPS):
        model.step(state, torch.ones(body.readings), rollout, seen)
        model.explain(rollout)


class Ghosts:
    """Robots without weight that feel what the robot feels and are moved by other recalls.

    They start where the robot is when a touch begins, and go their own ways until it ends.

    Args:
        models: What the robot knows, in each of `WAYS`.
    """

    def __init__(self, models: Sequence[HASM]) -> None:
        self._models = models
        self._rollouts: list[Rollout] = []
        self._rested = 0

    def step(self, state: Tensor, skin: Tensor, observation: Tensor | None) -> dict[str, Array]:
        """Where each way has taken its ghost, (J,) rad or m by name; empty without a touch.

        Args:
            state: (J,) the robot's joint positions, from which the ghosts start, rad or m.
            skin: The robot's skin.
            observation: What else is bound.
        """
        self._rested = 0 if float(skin.sum()) > FELT else self._rested + 1
        if self._rested > REST or (self._rested and not self._rollouts):
            self._rollouts = []
            return {}
        if not self._rollouts:
            self._rollouts = [model.new_rollout() for model in self._models]
        found = {}
        for name, model, rollout in zip(WAYS, self._models, self._rollouts, strict=True):
            here = rollout.reference
            at = state if here is None else torch.from_numpy(here.astype(np.float32))
            found[name] = model.step(at, skin, rollout, observation).numpy().astype(np.float64)
        return found
