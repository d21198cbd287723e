"""Open-loop prediction: where the joints will be in an episode that is watched."""

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.model.collect import collect
from hasm_torch.model.control import Array, Rollout
from hasm_torch.model.felt import Recording
from hasm_torch.model.moments import moments
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.timed import Timed


class Predicting(Protocol):
    """What is needed of a model, see ``HASM``."""

    config: HASMConfig
    body: Body
    settled: Settled | None
    recalling: Recalling | Timed | None

    def new_rollout(self) -> Rollout:
        """A control loop at its beginning."""

    def step(
        self,
        state: Tensor,
        skin: Tensor | None,
        rollout: Rollout | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """One control step."""


@torch.no_grad()
def predict(
    model: Predicting, episode: Recording, ahead: int, most: int
) -> tuple[Array, NDArray[np.int64]]:
    """Predict displacements; see ``HASM.predict``."""
    recalling, config, settled = model.recalling, model.config, model.settled
    if recalling is None or settled is None:
        raise RuntimeError("the model has learned nothing: call fit or from_pretrained first")
    count = max(len(episode.state) - ahead, 0)
    frames = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))[:count]
    if isinstance(recalling, Timed):
        if ahead != config.horizon:
            raise ValueError(f"the memory looks {config.horizon} frames ahead, not {ahead}")
        series = collect(config, model.body, settled, episode).series
        assert series is not None
        found = moments([series], settled.past, ahead).rows(torch.from_numpy(frames))
        return recalling(found).numpy(), frames
    stepped = [_stepped(model, episode, frame, ahead) for frame in frames]
    return np.array(stepped).reshape(len(frames), len(model.body.joints)), frames


def _stepped(model: Predicting, episode: Recording, frame: int, ahead: int) -> Array:
    """Displacement when the robot goes on from a frame for some more, (joints,)."""
    rollout, seconds = model.new_rollout(), model.config.rate_window_s
    first = max(0, frame - round(2 * seconds * model.body.rate))
    state = torch.from_numpy(np.asarray(episode.state, dtype=np.float32))
    skin = None if episode.tactile is None else torch.from_numpy(np.asarray(episode.tactile))
    more = getattr(episode, "observations", None)
    seen = None if more is None else torch.from_numpy(np.asarray(more))
    for t in range(first, frame + ahead):
        at, here = min(t, frame), state[min(t, frame)]
        felt, also = (None if x is None else x[at] for x in (skin, seen))
        if t == frame:  # up to here the skin was watched, the joints as they were
            rollout.reference, rollout.courses = here.double().numpy(), {}
        if t > frame:
            here = torch.from_numpy(rollout.reference).float()
        model.step(here, felt, rollout, also)
    assert rollout.reference is not None
    return rollout.reference - state[frame].double().numpy()
