"""The table: what one spike did in the nearest stored sample, and no memory.

Skin, spikes, control loop and stored samples are those of the memory; only the recall is another:
of the samples on the same rigid part, the nearest in joints (shares of their ranges) and direction
of the force. How much a direction counts is chosen by predicting left-out episodes.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hasm_torch.body import Body
from hasm_torch.model.choose import recalled_values
from hasm_torch.model.control import Touched
from hasm_torch.model.hasm import HASM
from hasm_torch.model.recalling import Recalling

Array = NDArray[np.float64]

FILE = "nearest.npz"
DIRECTION_WEIGHTS = (0.1, 0.2, 0.3, 0.5, 0.8, 1.2)  # joint ranges for a distance of 1
ASKED = 500  # samples that are predicted to choose one of them


class Nearest(Recalling):
    """A recall that looks the nearest sample up.

    Attributes:
        keys: (K, joints + 3) scaled joints and directions.
        values: (K, V) what one spike did.
        weight: What a direction counts.

    Args:
        model: The memory whose place it takes.
        table: What ``save_nearest`` wrote.
    """

    def __init__(self, model: HASM, table: Any) -> None:
        assert model.settled is not None
        assert isinstance(model.recalling, Recalling)
        super().__init__(model.config, model.body, model.settled)
        self.load_state_dict(model.recalling.state_dict())
        self.keys, self.values, self.part = table["keys"], table["values"], table["part"]
        self.weight = float(table["weight"])
        self._joint_scale = _scale(model.body, model.settled.joints)

    def query(self, positions: Array, touch: Touched) -> Any:
        """Scaled joints and direction."""
        coded = positions[self.settled.joints] / self._joint_scale
        return np.concatenate([coded, self.weight * touch.direction])

    def recall(self, query: Any, touch: Touched) -> Array:
        """What one spike did in the nearest sample of the touched part."""
        mine = np.flatnonzero(self.part == int(self.code.parts[touch.patch]))
        nearest = np.square(self.keys[mine] - query).sum(axis=1).argmin()
        found: Array = self.values[mine[nearest]]
        return found


def save_nearest(model: HASM, directory: Path) -> None:
    """Write a model and the table that takes the place of its recall.

    Args:
        model: A model of displacements.
        directory: Where both go.
    """
    settled, body = model.settled, model.body
    assert settled is not None
    assert isinstance(model.recalling, Recalling)
    samples = model.lessons.samples
    values = recalled_values(body, settled, samples)[0].double().numpy()
    joints = samples.positions[:, settled.joints] / _scale(body, settled.joints)
    part = model.recalling.code.parts.numpy()[samples.patch]
    errors = {
        weight: _left_out(
            np.concatenate([joints, weight * samples.direction], axis=1),
            values / np.array(body.max_speed)[settled.moved],
            part,
            samples.episode,
        )
        for weight in DIRECTION_WEIGHTS
    }
    weight = min(errors, key=lambda w: errors[w])
    model.save_pretrained(directory)
    keys = np.concatenate([joints, weight * samples.direction], axis=1)
    np.savez(directory / FILE, keys=keys, values=values, part=part, weight=weight)


def load(directory: str) -> HASM:
    """A model, with the table in place of its recall where there is one."""
    model = HASM.from_pretrained(directory)
    table = Path(directory) / FILE
    if table.exists():
        model.recalling = Nearest(model, np.load(table))
    return model


def _left_out(
    keys: Array, values: Array, part: NDArray[np.int64], episode: NDArray[np.int64]
) -> float:
    """Squared error of samples predicted from the nearest one of another episode."""
    error = 0.0
    for i in np.unique(np.linspace(0, len(keys) - 1, ASKED).round().astype(int)):
        far = np.square(keys - keys[i]).sum(axis=1)
        far[(part != part[i]) | (episode == episode[i])] = np.inf
        error += float(np.square(values[far.argmin()] - values[i]).sum())
    return error


def _scale(body: Body, joints: list[int]) -> Array:
    """Range of each joint, rad or m."""
    return np.array([body.upper[j] - body.lower[j] for j in joints])
