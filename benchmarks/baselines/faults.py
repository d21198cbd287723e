"""Faults of the skin in front of any policy."""

import zlib
from dataclasses import dataclass
from typing import Any, Literal, get_args

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


class Faulty:
    """A policy that reads a damaged skin.

    The damage of a rollout depends on the state in which it begins alone, so that all policies
    meet the same one.

    Args:
        policy: The policy.
        fault: What is wrong.
    """

    def __init__(self, policy: Policy, fault: Fault) -> None:
        self.policy, self.fault = policy, fault
        self.rng: np.random.Generator | None = None
        self.cells: NDArray[np.int64] = np.zeros(0, np.int64)

    def reset(self) -> None:
        """Start a new rollout."""
        self.rng = None
        self.policy.reset()

    def step(self, state: Tensor, skin: Tensor, **more: Any) -> Tensor:
        """One control step of the policy, with what it reads."""
        points: NDArray[np.float64] = skin.double().numpy().reshape(-1, 3)
        if self.rng is None:
            self.rng = np.random.default_rng(zlib.crc32(state.numpy().tobytes()))
            count = {"dead": round(self.fault.level * len(points)), "stuck": 1}
            order = self.rng.permutation(len(points))
            self.cells = order[: count.get(self.fault.kind, 0)]
        read = torch.from_numpy(self._damaged(points, self.fault, self.rng).astype(np.float32))
        return self.policy.step(state, read.reshape(skin.shape), **more)

    def _damaged(
        self, points: NDArray[np.float64], fault: Fault, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """What the damaged skin reads, (cells, 3) N."""
        if fault.kind in ("dead", "stuck"):
            points = points.copy()
            points[self.cells] = 0.0 if fault.kind == "dead" else fault.level
            return points
        if fault.kind == "noise":
            return np.maximum(points + fault.level * rng.standard_normal(points.shape), 0.0)
        if fault.kind == "offset":
            return points + fault.level
        return points * (rng.random() >= fault.level)
