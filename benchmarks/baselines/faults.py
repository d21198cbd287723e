"""Faults of the skin, around any policy."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.evaluation.rollout import Policy

Kind = Literal["dead", "noise", "lost", "offset", "stuck"]


@dataclass(frozen=True)
class Fault:
    """What is wrong with the skin.

    Attributes:
        kind: "dead": cells that read 0; "noise": of every point, which reads no less than 0;
            "lost": samples that arrive as no touch; "offset": of every point; "stuck": one cell
            always reads the same.
        level: Share of the cells (dead) or samples (lost); N a point: standard deviation of the
            noise, offset, or what the stuck cell reads.
    """

    kind: Kind
    level: float

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"unknown fault {self.kind!r}, valid: {', '.join(get_args(Kind))}")
        if not self.level >= 0 or (self.kind in ("dead", "lost") and self.level > 1):
            raise ValueError(
                f"{self.kind}: expected a share of 0 to 1, or N of at least 0, got {self.level}"
            )


class FaultySkin:
    """A policy that reads a damaged skin.

    The damage of the n-th rollout depends on the generator and n alone, so that policies that
    move differently meet the same one.

    Args:
        policy: The policy.
        fault: What is wrong.
        generator: Source of everything random.
    """

    def __init__(self, policy: Policy, fault: Fault, generator: np.random.Generator) -> None:
        self.policy, self.fault, self.generator = policy, fault, generator
        self.rng = generator
        self.cells: NDArray[np.int64] | None = None

    def reset(self) -> None:
        """Start a new rollout with other cells damaged."""
        self.rng = self.generator.spawn(1)[0]
        self.cells = None
        self.policy.reset()

    def step(self, state: Tensor, skin: Tensor) -> Tensor:
        """One control step of the policy, with what the damaged skin reads."""
        return self.policy.step(state, self.damaged(skin))

    def damaged(self, skin: Tensor) -> Tensor:
        """What the damaged skin reads.

        Args:
            skin: (cells, 3) or flat, N.

        Returns:
            The same shape, N.
        """
        points: NDArray[np.float64] = skin.detach().cpu().double().numpy().reshape(-1, 3)
        kind, level = self.fault.kind, self.fault.level
        if self.cells is None:
            count = {"dead": round(level * len(points)), "stuck": 1}.get(kind, 0)
            self.cells = self.rng.permutation(len(points))[:count]
        if kind in ("dead", "stuck"):
            points = points.copy()
            points[self.cells] = 0.0 if kind == "dead" else level
        elif kind == "noise":
            points = np.maximum(points + level * self.rng.standard_normal(points.shape), 0.0)
        elif kind == "offset":
            points = points + level
        elif self.rng.random() < level:
            points = np.zeros_like(points)
        return torch.from_numpy(points.astype(np.float32)).reshape(skin.shape)
