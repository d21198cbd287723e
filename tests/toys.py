"""Small robots and recordings to test the whole model with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import reference
import torch
from numpy.typing import NDArray

from hasm_torch.body import Body
from hasm_torch.model.settled import Settled

RATE = 50.0
BASE = ["odom_x", "odom_y", "odom_t"]
TILT = reference.rodrigues([0.6, 0.0, 0.8], 0.7)  # between two links of the hand's chain
Law = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


@dataclass
class Recorded:
    """One episode, as ``HASM.fit`` takes it."""

    time: np.ndarray
    state: np.ndarray
    action: np.ndarray
    tactile: np.ndarray
    observations: np.ndarray | None = None


def make_body(joints: int = 3, base: bool = False, observations: dict[str, int] | None = None):
    """A body with patches of one, three and two cells.

    "front" and the bent "side" are on a hand that turns with the last three joints that have
    limits, "back" is on the trunk. `base` adds the joints of a planar base.
    """
    numbers = range(joints)
    turns = zip(reversed(numbers), np.eye(3)[[2, 0, 1]], (1.0, -0.7, 0.5))
    hand = [[*TILT.flatten(), *axis, float(joint), times, 0.2] for joint, axis, times in turns]
    return Body(
        joints=[f"joint_{i}" for i in numbers] + (BASE if base else []),
        lower=[-1.0 - 0.1 * i for i in numbers] + [-np.inf] * 3 * base,
        upper=[1.5 + 0.2 * i for i in numbers] + [np.inf] * 3 * base,
        max_speed=[1.0 + 0.5 * i for i in numbers] + [0.2, 0.2, 1.0] * base,
        patches=["front", "side", "back"],
        cells=[1, 3, 2],
        normals=[[1, 0, 0], [0, 1, 0], [0, 0.8, 0.6], [0, 0.8, -0.6], [-1, 0, 0], [-1, 0, 0]],
        links=["hand", "hand", "trunk"],
        chains={"hand": hand},
        base=BASE if base else [],
        observations=observations or {},
        rate=RATE,
    )


def settled(body: Body, **changes) -> Settled:
    """Choices as ``fit`` makes them for a touch that its direction tells apart."""
    chosen = {
        "touch": "direction", "value": "displacement", "readout": "mean", "drive": "spike",
        "beta": 0.03, "joints": body.limited, "moved": body.limited, "angle": np.pi / 2,
        "threshold": 0.05, "current_per_newton": 2.5, "capacity": 1, "taught": [],
    }  # fmt: skip
    return Settled(**{**chosen, **changes})


def limits(body: Body) -> tuple[np.ndarray, np.ndarray]:
    return np.array(body.lower), np.array(body.upper)


def ranges(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Limits, and half a metre or radian to each side of joints without any."""
    lower, upper = limits(body)
    return np.where(np.isfinite(lower), lower, -0.5), np.where(np.isfinite(upper), upper, 0.5)


def cells_of(body: Body, patch: str) -> slice:
    index = body.patches.index(patch)
    first = sum(body.cells[:index])
    return slice(first, first + body.cells[index])


def press(body: Body, patch: str | None, force: float) -> torch.Tensor:
    """One reading of the skin, (cells, 3) N: `force` shared by the points of one patch."""
    skin = torch.zeros(sum(body.cells), 3)
    if patch is not None:
        mine = cells_of(body, patch)
        skin[mine] = force / (3 * (mine.stop - mine.start))
    return skin


def push(body: Body, patch: str, positions: np.ndarray) -> np.ndarray:
    """Direction of an even press of a patch in the base frame, (3,)."""
    rows = body.chains.get(body.links[body.patches.index(patch)], [])
    inward = -np.array(body.normals)[cells_of(body, patch)].sum(axis=0)
    return reference.link_rotation(rows, positions) @ inward / np.linalg.norm(inward)


def smooth_path(body: Body, samples: int, seed: int, moved: list[int]) -> np.ndarray:
    """A random smooth path of some joints through most of their ranges, (samples, joints).

    The first of `moved` goes one way from limit to limit, so that no state comes twice.
    """
    rng = np.random.default_rng(seed)
    lower, upper = ranges(body)
    share = np.full((samples, len(lower)), 0.5)
    phase = np.linspace(0.0, 1.0, samples)
    share[:, moved[0]] = phase
    for joint in moved[1:]:
        waves = sum(
            rng.uniform(0.3, 1.0)
            * np.sin(2 * np.pi * (rng.uniform(0.3, 2.0) * phase + rng.random()))
            for _ in range(3)
        )
        share[:, joint] = 0.5 + 0.45 * waves / np.abs(waves).max()
    return lower + share * (upper - lower)


def straight(
    body: Body, joint: int, begin: float = 0.1, end: float = 0.9, samples: int = 150
) -> np.ndarray:
    """One joint moves evenly between two shares of its range, (samples, joints)."""
    lower, upper = ranges(body)
    share = np.full((samples, len(lower)), 0.5)
    share[:, joint] = np.linspace(begin, end, samples)
    return lower + share * (upper - lower)


def record(
    body: Body, patch: str, path: np.ndarray, force: float, rest: int = 10,
    observation: Sequence[float] | None = None,
) -> Recorded:  # fmt: skip
    """An episode in which a touch leads the joints along a path and they follow exactly."""
    path = np.vstack([np.repeat(path[:1], rest, 0), path, np.repeat(path[-1:], rest, 0)])
    tactile = np.zeros((len(path), sum(body.cells), 3))
    tactile[rest : len(path) - rest] = press(body, patch, force).numpy()
    positions = path.astype(np.float32)
    return Recorded(
        np.arange(len(path)) / body.rate,
        positions,
        positions,
        tactile.astype(np.float32),
        None if observation is None else np.tile(observation, (len(path), 1)),
    )


def yielding(
    body: Body, law: Law, start: np.ndarray, touches: Sequence[tuple[str | None, int]],
    force: float = 6.0,
) -> Recorded:  # fmt: skip
    """An episode in which patches are pressed in turn, each for some samples.

    ``law`` says how far the joints go in one sample, from the force's direction in the base frame
    (3,) and the positions (joints,).
    """
    positions, path, tactile = np.array(start, dtype=np.float64), [], []
    for patch, samples in touches:
        for _ in range(samples):
            path.append(positions)
            tactile.append(press(body, patch, force).numpy())
            if patch is not None:
                step = law(push(body, patch, positions), positions)
                positions = np.clip(positions + step, body.lower, body.upper)
    positions = np.array(path, dtype=np.float32)
    return Recorded(np.arange(len(path)) / body.rate, positions, positions, np.array(tactile))


def along(body: Body, pace: float = 0.01) -> Law:
    """The law of a robot whose joints 0 and 1 move along x and y, with the push."""

    def law(toward: np.ndarray, positions: np.ndarray) -> np.ndarray:
        step = np.zeros(len(body.joints))
        step[:2] = pace * toward[:2]
        return step

    return law


def postures(body: Body, count: int, seed: int, share: float = 0.6) -> np.ndarray:
    """Random positions in the middle of all ranges, (count, joints)."""
    low, high = ranges(body)
    reach = share * np.random.default_rng(seed).uniform(-1, 1, (count, len(low)))
    return (low + high) / 2 + reach * (high - low) / 2


def spell(model, body: Body, state: torch.Tensor, patch: str | None, force: float, steps: int):
    """Steps with one touch and a robot that reaches every target at once; all targets."""
    skin, targets = press(body, patch, force), []
    for _ in range(steps):
        state = model.step(state, skin)
        targets.append(state)
    return torch.stack(targets)
