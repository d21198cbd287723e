"""Standing still, nearest neighbours, and a dense associative memory, as policies."""

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Literal

import torch
from torch import Tensor

from benchmarks.baselines.demonstrations import (
    Ahead,
    Candidate,
    Predictor,
    build,
    cross_validate,
    largest_way,
    moved,
    patch_forces,
    series_of,
)
from hasm_torch import HeteroAssociativeMemory, PlaceCode
from hasm_torch.body import Body
from hasm_torch.data.episodes import Episode

Mode = Literal["displacement", "target"]
MODES: tuple[Mode, ...] = ("displacement", "target")
HORIZONS = (1, 5, 15)  # samples
NEIGHBOURS = (3, 1, 8, 24)
TOUCH_WEIGHTS = (1.0, 3.0, 10.0)  # the largest force counts as much as so many joint ranges
# What the episodes cannot tell, since their postures vary little, but rollouts do.
TUNED_WEIGHT = {"compliance": 10.0, "grasp": 1.0}

# A polynomial of this degree lets the best match win: at 95 % of its match another weighs 0.63.
DEGREE = 9
CODE_NEURONS, CODE_BITS = 10, 6


class StandStill:
    """Holds the posture in which a rollout begins."""

    def __init__(self) -> None:
        self.posture: Tensor | None = None

    def reset(self) -> None:
        """Forget the posture."""
        self.posture = None

    def step(self, state: Tensor, skin: Tensor) -> Tensor:
        """The posture of the first step."""
        if self.posture is None:
            self.posture = state.clone()
        return self.posture

    def memory_bytes(self) -> int:
        """Nothing is kept."""
        return 0


class NearestNeighbours:
    """Mean of the nearest samples, weighted by the inverse of their distances.

    Args:
        states: (N, joints) shares of the joint ranges.
        touches: (N, patches) N.
        values: (N, joints) what each sample predicts.
        neighbours: k.
        touch_weight: How much the largest force counts, joint ranges.
    """

    def __init__(
        self, states: Tensor, touches: Tensor, values: Tensor, neighbours: int, touch_weight: float
    ) -> None:
        self.scale = touch_weight / touches.max()
        self.samples = torch.cat([states, touches * self.scale], dim=-1)
        self.squares = self.samples.square().sum(-1)
        self.values, self.neighbours = values, neighbours

    def predict(self, state: Tensor, touch: Tensor) -> Tensor:
        """See ``Predictor``."""
        query = torch.cat([state, touch * self.scale], dim=-1)
        # |a − b|² without |b|², which is the same for all samples.
        order = torch.addmm(self.squares, query, self.samples.mT, alpha=-2.0)
        nearest = order.topk(self.neighbours, largest=False).indices
        distance = (self.samples[nearest] - query.unsqueeze(-2)).norm(dim=-1)
        weight = 1.0 / (distance + 1e-6)
        weight = weight / weight.sum(-1, keepdim=True)
        return (weight.unsqueeze(-1) * self.values[nearest]).sum(-2)

    def memory_bytes(self) -> int:
        """Samples and values."""
        return self.samples.nbytes + self.squares.nbytes + self.values.nbytes


class DenseMemory:
    """Place codes of joints and forces in a dense associative memory; the best match decides.

    Args:
        states: (N, joints) shares of the joint ranges.
        touches: (N, patches) N.
        values: (N, joints) what each sample predicts.
    """

    def __init__(self, states: Tensor, touches: Tensor, values: Tensor) -> None:
        joints, patches = states.shape[-1], touches.shape[-1]
        self.scale = 1.0 / touches.max()
        size = joints + patches
        self.code = PlaceCode(
            [0.0] * size, [1.0] * size, CODE_NEURONS, CODE_BITS, code="thermometer"
        )
        dim = self.code.code_dim
        self.memory = HeteroAssociativeMemory(
            dim, joints, len(states), 1.0 / dim, storage="float32", interaction=DEGREE
        )
        code = self._code(states, touches)
        self.memory.write(code, torch.ones_like(code), values)

    def predict(self, state: Tensor, touch: Tensor) -> Tensor:
        """See ``Predictor``."""
        winner = self.memory.weights(self._code(state, touch)).argmax(-1)
        return self.memory.successors[winner]

    def memory_bytes(self) -> int:
        """Associations and successors."""
        return self.memory.memory_bytes()

    def _code(self, state: Tensor, touch: Tensor) -> Tensor:
        features = torch.cat([state, touch * self.scale], dim=-1)
        code: Tensor = self.code(features.clamp(0.0, 1.0))
        return code


class SamplePolicy:
    """Follows a predictor from tick to tick, with a joint target of its own.

    Attributes:
        choice: Name of the candidate that cross-validation chose.
        errors: Error of every candidate on held-out episodes, shares of the joint range.

    Args:
        body: The robot.
        episodes: What is learned.
        candidates: What cross-validation chooses from.
    """

    def __init__(
        self, body: Body, episodes: Sequence[Episode], candidates: Sequence[Candidate]
    ) -> None:
        self.body = body
        series = [series_of(episode, body) for episode in episodes]
        best, self.errors = cross_validate(candidates, series, body)
        self.choice, self.ahead = best.name, best.ahead
        self.predictor: Predictor = build(best, series)
        self.lower = torch.tensor(body.lower)
        self.upper = torch.tensor(body.upper)
        self.largest = largest_way(body)
        self.reference: Tensor | None = None

    def reset(self) -> None:
        """Start from the measured joints."""
        self.reference = None

    @torch.no_grad()
    def step(self, state: Tensor, skin: Tensor) -> Tensor:
        """Target of one control step, (joints,)."""
        touch = patch_forces(skin.float().reshape(-1, 3), self.body)
        span = self.upper - self.lower
        shares = ((state - self.lower) / span).unsqueeze(0)
        if self.reference is None:
            self.reference = shares.clamp(0.0, 1.0)
        value = self.predictor.predict(shares, touch.unsqueeze(0))
        self.reference = moved(self.reference, value, self.ahead, self.largest)
        target = self.lower + self.reference[0] * span
        return target.clamp(self.lower, self.upper)

    def memory_bytes(self) -> int:
        """Bytes that the predictor keeps."""
        return self.predictor.memory_bytes()


def neighbour_candidates(
    modes: Sequence[Mode] = MODES, weights: Sequence[float] = TOUCH_WEIGHTS
) -> list[Candidate]:
    """Nearest neighbours with every number and horizon, and the modes and weights given."""
    return [
        Candidate(
            f"k={k}, touch weight {weight:g}, {mode} {horizon} samples ahead",
            Ahead(horizon, mode),
            partial(NearestNeighbours, neighbours=k, touch_weight=weight),
        )
        for mode, horizon, k, weight in product(modes, HORIZONS, NEIGHBOURS, weights)
    ]


def tuned_neighbour_candidates(experiment: str) -> list[Candidate]:
    """Nearest neighbours with the mode and weight that did best in rollouts."""
    return neighbour_candidates(("displacement",), (TUNED_WEIGHT[experiment],))


def dense_memory_candidates() -> list[Candidate]:
    """The dense associative memory with every mode and the longer horizons.

    With a horizon of 1 the best match is mostly a state that its successor shares a code with.
    """
    return [
        Candidate(f"{mode} {horizon} samples ahead", Ahead(horizon, mode), DenseMemory)
        for mode, horizon in product(MODES, HORIZONS[1:])
    ]
