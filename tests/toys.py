"""Small robots and recordings to test the whole model with."""

from dataclasses import dataclass

import numpy as np
import torch

from hasm_torch.body import Body

RATE = 50.0


@dataclass
class Recorded:
    """One episode, as ``HASM.fit`` takes it."""

    time: np.ndarray
    state: np.ndarray
    action: np.ndarray
    tactile: np.ndarray


def make_body(joints: int = 3) -> Body:
    """A body with patches of one, three and two cells."""
    return Body(
        joints=[f"joint_{i}" for i in range(joints)],
        lower=[-1.0 - 0.1 * i for i in range(joints)],
        upper=[1.5 + 0.2 * i for i in range(joints)],
        max_speed=[1.0 + 0.5 * i for i in range(joints)],
        patches=["front", "side", "back"],
        cells=[1, 3, 2],
        directions=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
        rate=RATE,
    )


def limits(body: Body) -> tuple[np.ndarray, np.ndarray]:
    return np.array(body.lower), np.array(body.upper)


def press(body: Body, patch: str | None, force: float) -> torch.Tensor:
    """One reading of the skin, (cells, 3) N: `force` shared by the points of one patch."""
    skin = torch.zeros(sum(body.cells), 3)
    if patch is not None:
        index = body.patches.index(patch)
        first = sum(body.cells[:index])
        skin[first : first + body.cells[index]] = force / (3 * body.cells[index])
    return skin


def smooth_path(body: Body, samples: int, seed: int, moved: list[int]) -> np.ndarray:
    """A random smooth path of some joints through most of their ranges, (samples, joints).

    The first of `moved` goes one way from limit to limit, so that no state comes twice.
    """
    rng = np.random.default_rng(seed)
    lower, upper = limits(body)
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


def record(body: Body, patch: str, path: np.ndarray, force: float, rest: int = 10) -> Recorded:
    """An episode in which a touch leads the joints along a path and they follow exactly."""
    path = np.vstack([np.repeat(path[:1], rest, 0), path, np.repeat(path[-1:], rest, 0)])
    tactile = np.zeros((len(path), sum(body.cells), 3))
    tactile[rest:-rest] = press(body, patch, force).numpy()
    positions = path.astype(np.float32)
    return Recorded(
        np.arange(len(path)) / body.rate, positions, positions, tactile.astype(np.float32)
    )


def spell(model, body: Body, state: torch.Tensor, patch: str | None, force: float, steps: int):
    """Steps with one touch and a robot that reaches every target at once; all targets."""
    skin, targets = press(body, patch, force), []
    for _ in range(steps):
        state = model.step(state, skin)
        targets.append(state)
    return torch.stack(targets)
