"""Robot and episodes in the units in which the baselines learn and act.

Joints are shares of their ranges. A mobile base, which has none, counts from where it stands at the
beginning, in its own frame and in what it drives in ``FREE_SECONDS`` at full speed. The skin is the
force on each patch and the resultant force in the base frame, so that nobody has to learn
kinematics to know where a push leads.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.encoders.readings import patch_borders
from hasm_torch.episode import Episode
from hasm_torch.model.control import SPEED_SHARE
from hasm_torch.model.felt import PushDirection
from hasm_torch.model.frames import base_indices, into_base, out_of_base

Array = NDArray[np.float64]

FREE_SECONDS = 2.0


class Series(NamedTuple):
    """One episode, float32.

    Attributes:
        task: What is done.
        state: (T, joints) measured positions, shares.
        action: (T, joints) commanded positions, shares.
        touch: (T, patches + 3) force on each patch and resultant, N.
        seen: (T, N) further observations.
    """

    task: str
    state: Tensor
    action: Tensor
    touch: Tensor
    seen: Tensor


class Units:
    """Between readings and targets of a robot and what the baselines compute with.

    Attributes:
        limited: (joints,) bool, which joints have limits.
        largest: (joints,) largest way of a sample period, shares.

    Args:
        body: The robot.
    """

    def __init__(self, body: Body) -> None:
        self.body = body
        low, high, speed = (np.array(x) for x in (body.lower, body.upper, body.max_speed))
        limited = np.isfinite(high - low)
        self._lower = np.where(limited, low, 0.0)
        self._span = np.where(limited, np.where(limited, high - low, 1.0), FREE_SECONDS * speed)
        self._base = base_indices(body)
        self._direction = PushDirection(body, "base")
        self._borders = patch_borders(tuple(body.cells))[:-1]
        self._normals = np.array(body.normals)
        self.limited = torch.from_numpy(limited)
        self.largest = torch.from_numpy(speed * SPEED_SHARE / body.rate / self._span).float()

    def shares(self, positions: Array, start: Array) -> Tensor:
        """Positions (..., joints), rad or m, of a robot that began at ``start`` (joints,)."""
        if self._base:
            positions = positions.copy()
            positions[..., self._base] -= start[self._base]
            positions = into_base(positions, start[self._base[2]], self._base)
        return torch.from_numpy((positions - self._lower) / self._span).float()

    def positions(self, shares: Tensor, start: Array) -> Tensor:
        """The inverse of ``shares``, (joints,) within the limits."""
        positions: Array = self._lower + shares.double().numpy() * self._span
        if self._base:
            positions = out_of_base(positions, start[self._base[2]], self._base)
            positions[self._base] += start[self._base]
        return torch.from_numpy(np.clip(positions, self.body.lower, self.body.upper)).float()

    def touch(self, skin: Array, positions: Array) -> Tensor:
        """Force on each patch and resultant in the base frame, (T, patches + 3) N.

        Args:
            skin: (T, cells, 3), N.
            positions: (T, joints), rad or m.
        """
        cells = skin.sum(axis=-1)
        force = np.add.reduceat(cells, self._borders, axis=1)
        push = -np.add.reduceat(cells[..., None] * self._normals, self._borders, axis=1)
        resultant = (self._direction(push, positions) * force[..., None]).sum(axis=1)
        return torch.from_numpy(np.concatenate([force, resultant], axis=1)).float()

    def series(self, episode: Episode) -> Series:
        """An episode in these units."""
        assert episode.tactile is not None
        state, action, skin = (
            np.asarray(x, dtype=np.float64)
            for x in (episode.state, episode.action, episode.tactile)
        )
        seen = np.zeros((len(state), 0)) if episode.observations is None else episode.observations
        return Series(
            episode.task,
            self.shares(state, state[0]),
            self.shares(action, state[0]),
            self.touch(skin, state),
            torch.from_numpy(np.asarray(seen)).float(),
        )

    def moved(self, reference: Tensor, way: Tensor) -> Tensor:
        """The reference (joints,) one sample period later, in shares within all limits."""
        excess = (way.abs() / self.largest).amax().clamp(min=1.0)
        goal = reference + way / excess
        return torch.where(self.limited, goal.clamp(0.0, 1.0), goal)


class Sensed(NamedTuple):
    """What a baseline gets in one control step, as in ``Series``: state, touch and seen."""

    state: Tensor
    touch: Tensor
    seen: Tensor


class Baseline:
    """A policy that follows ``way`` from step to step with a joint target of its own.

    Args:
        body: The robot.
    """

    def __init__(self, body: Body) -> None:
        self.units = Units(body)
        self.reset()

    def reset(self) -> None:
        """Start from the measured joints."""
        self._start: Array | None = None
        self.reference = torch.zeros(0)

    @torch.no_grad()
    def step(self, state: Tensor, skin: Tensor, *, observation: Tensor | None = None) -> Tensor:
        """Target of one control step, see ``hasm_torch.evaluation.rollout.Policy``."""
        measured = state.double().numpy()
        first = self._start is None
        if self._start is None:
            self._start = measured
        sensed = Sensed(
            self.units.shares(measured, self._start),
            self.units.touch(skin.double().numpy().reshape(1, -1, 3), measured[None])[0],
            torch.zeros(0) if observation is None else observation.float(),
        )
        if first:
            shares = sensed.state
            self.reference = torch.where(self.units.limited, shares.clamp(0.0, 1.0), shares)
        self.reference = self.units.moved(self.reference, self.way(sensed))
        return self.units.positions(self.reference, self._start)

    def way(self, sensed: Sensed) -> Tensor:
        """Where the reference goes in one sample period, (joints,) shares."""
        raise NotImplementedError


def folds(episodes: Sequence[Series], count: int) -> list[tuple[list[Series], list[Series]]]:
    """Split into learned and held-out episodes, so that each task stays among the learned ones.

    Returns:
        At most ``count`` splits; none if a task has a single episode.
    """
    number: dict[str, int] = {}
    of: list[int] = []
    for series in episodes:
        of.append(number.get(series.task, 0))
        number[series.task] = of[-1] + 1
    count = min(count, *number.values())
    return [
        (
            [series for series, i in zip(episodes, of) if i % count != fold],
            [series for series, i in zip(episodes, of) if i % count == fold],
        )
        for fold in range(count if count > 1 else 0)
    ]
