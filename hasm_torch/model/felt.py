"""What the skin of a robot felt through a whole episode: the one entry for recorded touch."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.readings import forces_of, patch_borders
from hasm_torch.encoders.skin import SkinEncoder
from hasm_torch.encoders.touch import spike_density
from hasm_torch.encoders.turning import link_rotation
from hasm_torch.model.settled import Settled

Array = NDArray[np.float64]

# A skin in newtons: below the threshold a point's noise, and the current at which spikes are most
# nearly proportional to the force from 2 to 14 N (66 spikes a newton at 6 N, 54 to 66 elsewhere).
NEWTON_THRESHOLD, NEWTON_CURRENT = 0.05, 2.5
# Any other skin: the resting level of its cells drives no current, the strongest touch the one at
# which a neuron fires 800 times a second.
RESTING_SHARE, STRONGEST_SHARE, STRONGEST_CURRENT = 0.1, 0.99, 40.0


class Recording(Protocol):
    """One episode.

    time (T,) s; state, action (T, J) rad or m; tactile (T, cells, channels); where the body binds
    some, observations (T, N).
    """

    time: Any
    state: Any
    action: Any
    tactile: Any


class Touch(NamedTuple):
    """What the patches felt in an episode.

    Attributes:
        spikes: (T, patches) spikes in each sample period.
        density: (T, patches) rate density ρ.
        direction: (T, patches, 3) direction of the force, in the base frame where the body says
            how its links turn; zero where nothing pushes.
    """

    spikes: Array
    density: Array
    direction: Array


def skin_encoder(config: HASMConfig, body: Body, threshold: float, current: float) -> SkinEncoder:
    """The encoder of a body's skin."""
    return SkinEncoder(
        body.cells,
        body.normals,
        body.rate,
        threshold,
        max(1, round(config.force_window_s * body.rate)),
        current,
        config.spike_dt_ms,
    )


def rate_window(config: HASMConfig, body: Body) -> int:
    """Samples of the window in which spikes are counted."""
    return max(1, round(config.rate_window_s * body.rate))


def felt(config: HASMConfig, body: Body, settled: Settled, episode: Recording) -> Touch:
    """What the skin felt through an episode.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: Threshold and current of the skin.
        episode: The recording, its skin as the sensor gives it.

    Returns:
        Spikes, rate density and direction of every patch.

    Raises:
        ValueError: If the skin's shape does not fit the body or the state.
    """
    skin = recorded_forces(body, episode)
    encoder = skin_encoder(config, body, settled.threshold, settled.current_per_newton)
    touch, _ = encoder(skin)
    window = rate_window(config, body)
    total = torch.nn.functional.pad(touch.spikes.cumsum(0), (0, 0, window, 0))
    rate = (total[window:] - total[:-window]) * (body.rate / window)
    density = spike_density(rate, config.max_rate)
    state = np.asarray(episode.state, dtype=np.float64)
    direction = PushDirection(body, config.frame)(touch.push.numpy(), state)
    return Touch(touch.spikes.double().numpy(), density.double().numpy(), direction)


def recorded_forces(body: Body, episode: Recording) -> torch.Tensor:
    """(T, cells, 3) forces of an episode's skin.

    Raises:
        ValueError: If the skin's shape does not fit the body, or it is not finite.
    """
    length = len(episode.state)
    tactile = getattr(episode, "tactile", None)
    if tactile is None and body.channels:
        raise ValueError("an episode has no tactile series, so there is no touch to learn from")
    readings = None if tactile is None else torch.tensor(np.asarray(tactile), dtype=torch.float32)
    skin = forces_of(body, readings, (length,))
    if len(skin) != length:
        raise ValueError(f"expected tactile of {length} samples like the state, got {len(skin)}")
    if not torch.isfinite(skin).all():
        raise ValueError("the tactile series holds NaN or infinity")
    return skin


class PushDirection:
    """Directions of the force on every patch, f̂ = R push / |push|.

    Args:
        body: Says how the links turn.
        frame: "base", or "link", where R is left out.
    """

    def __init__(self, body: Body, frame: str) -> None:
        chains = body.chains if frame == "base" else {}
        rows = {name: np.array(chain, dtype=np.float64) for name, chain in chains.items() if chain}
        self._rows = [rows.get(link) for link in body.links]
        self._links = list(dict.fromkeys(body.links))
        self._patches = [[p for p, x in enumerate(body.links) if x == link] for link in self._links]

    def __call__(self, push: Array, positions: Array) -> Array:
        """Directions in the base frame.

        Args:
            push: (T, patches, 3) in the frames of the links, N.
            positions: (T, J) joint positions, rad or m.

        Returns:
            (T, patches, 3), of length 1, or zero where nothing pushes.
        """
        turned = _meant(push)
        length = np.sqrt((turned**2).sum(axis=-1, keepdims=True))
        turned /= np.where(length > 0, length, 1.0)
        for mine in self._patches:
            rows = self._rows[mine[0]]
            if rows is not None and length[:, mine].any():
                rotation = link_rotation(rows, positions)
                turned[:, mine] = turned[:, mine] @ rotation.swapaxes(-1, -2)
        return turned

    def of_patch(self, patch: int, push: Array, positions: Array) -> Array:
        """The same of one patch at one moment, (3,), from its push (3,) and positions (J,)."""
        direction = _meant(push)
        direction /= math.sqrt(float(direction @ direction)) or 1.0
        rows = self._rows[patch]
        return direction if rows is None else link_rotation(rows, positions[None])[0] @ direction


def _meant(push: Array) -> Array:
    """A push in float64, whose squares stay finite; what overflowed in float32 says nothing."""
    return np.where(np.isfinite(push), push, 0.0).astype(np.float64)


def calibrate(config: HASMConfig, body: Body, episodes: Iterable[Recording]) -> tuple[float, float]:
    """Threshold τ and current a unit of effective force.

    Args:
        config: What is set by hand stays.
        body: Its skin and the skin's unit.
        episodes: Recordings; looked at only where the skin does not read newtons.

    Returns:
        Both, in the unit of the readings.
    """
    threshold, current = NEWTON_THRESHOLD, NEWTON_CURRENT
    if body.unit != "N" and body.channels and None in (config.threshold, config.current_per_newton):
        readings = np.concatenate(
            [recorded_forces(body, e).abs().sum(-1).numpy() for e in episodes]
        )
        threshold = max(0.0, float(np.quantile(readings, RESTING_SHARE)))
        excess = np.clip(readings - threshold, 0.0, None)
        patches = np.add.reduceat(excess, patch_borders(tuple(body.cells))[:-1], axis=1)
        strongest = float(np.quantile(patches, STRONGEST_SHARE))
        current = STRONGEST_CURRENT / strongest if strongest > 0 else 1.0
    return (
        threshold if config.threshold is None else config.threshold,
        current if config.current_per_newton is None else config.current_per_newton,
    )
