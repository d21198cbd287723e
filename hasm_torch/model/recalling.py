"""The memory with its codes and its read-out: from what is done and felt to what is recalled."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pad

from hasm_torch import kernels
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.kernels.readout import first_order_of_one
from hasm_torch.memory.layer import HeteroAssociativeMemory
from hasm_torch.model.control import Course, Touched
from hasm_torch.model.frames import base_indices, out_of_base
from hasm_torch.model.lessons import COURSE_POINTS
from hasm_torch.model.query import QueryCode, parts_of
from hasm_torch.model.readout import covariates_of, first_order, ridge_of
from hasm_torch.model.settled import Settled
from hasm_torch.model.table import Table

Array = NDArray[np.float64]


class Recalling(nn.Module):
    """Recalls for one settled memory.

    Attributes:
        code: Makes the queries.
        memory: The associations, what each recalls, and from which episode each comes.
        where: (K, 2) int64: sample of the episode, and patch, from which each association comes.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen; sizes the memory.
    """

    where: Tensor

    def __init__(self, config: HASMConfig, body: Body, settled: Settled) -> None:
        super().__init__()
        self.settled = settled
        self.code = QueryCode(config, body, settled)
        self._base = base_indices(body)
        self._moved = np.array(settled.moved)
        self._anchored = np.isin(self._moved, body.limited)
        self._span = 2.0 * np.array(body.max_speed)[self._moved]
        limited = self._anchored
        ranges = (np.array(body.upper) - np.array(body.lower))[self._moved]
        self._span[limited] = ranges[limited]
        ridge = ridge_of(settled.value, len(settled.observed))
        self._ridge = ridge if settled.readout == "first_order" else None
        self._observed = np.array(settled.observed).reshape(-1, 2)
        self._joints, self._patches = len(body.joints), body.patches
        values = len(self._moved)
        if settled.value != "displacement":
            values = values * (COURSE_POINTS if settled.value == "goal" else 1) + 1
        if self._ridge is not None:
            count = len(self._ridge)
            values = values * count + count * count
        self.memory = HeteroAssociativeMemory(
            self.code.code_dim,
            values,
            max(settled.capacity, 1),
            beta=torch.tensor(settled.beta, dtype=torch.float64),
            storage=config.storage,
            when_full="grow",
        )
        self.register_buffer("where", torch.zeros(settled.capacity, 2, dtype=torch.int64))
        self._parts = parts_of(body, settled.touch)
        self._masks: list[Tensor | None] | None = None

    @property
    def code_dim(self) -> int:
        """D, entries of a query."""
        return self.code.code_dim

    @property
    def origins(self) -> Tensor:
        """(K, 3) episode, sample and patch from which each association comes."""
        return torch.cat([self.memory.origins[: len(self.where), None], self.where], dim=1)

    def append(self, codes: Tensor, successors: Tensor, keys: Table) -> None:
        """Store associations (K, D) with what each recalls (K, values) and what they are made of.

        The associations of a later call stand behind those of an earlier one.
        """
        held = int(self.memory.count)
        episode = torch.from_numpy(keys.episode)
        self.memory.write(codes, torch.ones_like(codes), successors, origin=episode)
        where = torch.from_numpy(np.stack([keys.frame, keys.patch], axis=1))
        self.where = torch.cat([self.where[:held], where.to(self.where.device)])
        self._masks = None

    def remove(self, episode: int) -> None:
        """Forget the associations of an episode; the others keep their order."""
        self.where = self.where[self.memory.origins[: len(self.where)] != episode]
        self.memory.remove(origin=episode)
        self._masks = None

    def query(self, positions: Array, touch: Touched) -> Tensor:
        """Q of one control step, (D,)."""
        least, greatest = self.settled.density
        density = min(max(touch.density, least), greatest)
        if kernels.enabled() and self.where.device.type == "cpu":
            touched = touch.patch, touch.direction, touch.observation
            return self.code.in_arrays(positions, density, *touched)
        device = self.where.device
        row = [torch.from_numpy(x)[None].to(device) for x in (positions, touch.direction)]
        observation = torch.from_numpy(touch.observation)[None].to(device)
        patch = torch.tensor([touch.patch], device=device)
        ask = torch.tensor([density], device=device)
        return self.code(row[0], ask, patch, row[1], observation)[0]

    def mask(self, patch: int) -> Tensor | None:
        """(capacity,) which associations a touch of a patch may recall; None is all of them."""
        if self._masks is None:
            part = torch.tensor(self._parts, device=self.where.device)[self.where[:, 1]]
            several = len(part.unique()) > 1
            empty = (0, self.memory.capacity - len(part))
            self._masks = [pad(part == p, empty) if several else None for p in self._parts]
        return self._masks[patch]

    def weights(self, query: Tensor, patch: int) -> Array:
        """Weight of each association in a recall, (K,)."""
        weights: Array = self.memory.weights(query, self.mask(patch)).double().cpu().numpy()
        return weights[: len(self.where)]

    def sureness(self, query: Tensor, patch: int) -> tuple[float, float]:
        """Agreement of the best match with a query (D,), 0 to 1, and its lead over the second."""
        found = self.memory.inspect(query, self.mask(patch))
        best, lead = (float(x) / self.code_dim for x in (found.score, found.margin))
        return min(max(best, 0.0), 1.0), lead

    def confidence(self, query: Tensor, patch: int) -> float:
        """Agreement of the best match with a query (D,), 0 to 1."""
        return self.sureness(query, patch)[0]

    def recall(self, query: Tensor, touch: Touched) -> Array:
        """What a query (D,) recalls under a touch, read out, (V,)."""
        mean = self.memory.recall(query, self.mask(touch.patch))
        recalled: Array = mean.cpu().numpy().astype(np.float64)
        if self._ridge is None:
            return recalled
        observed = touch.direction, touch.observation, self._observed
        x = covariates_of(self.settled.value, *observed)
        read = first_order_of_one if kernels.enabled() else first_order
        return read(recalled, x, self._ridge)

    def displacement(self, query: Tensor, touch: Touched, yaw: float) -> Array:
        """What one spike does, (joints,), rad or m.

        Args:
            query: See ``query``.
            touch: What is felt.
            yaw: Yaw of the base, rad.
        """
        step = np.zeros(self._joints)
        step[self._moved] = self.recall(query, touch)
        return out_of_base(step, yaw, self._base)

    def course(self, query: Tensor, touch: Touched, positions: Array, yaw: float) -> Course:
        """Where a touch leads from some positions (joints,), rad or m; the rest as above."""
        values = self.recall(query, touch)
        spent = max(float(values[-1]), 1.0)
        points: Array = values[:-1].reshape(-1, len(self._moved))
        whole: Array = np.zeros((len(points), self._joints))
        whole[:, self._moved] = points
        whole = out_of_base(whole, yaw, self._base)[:, self._moved]
        # Of joints without limits a displacement since the touch began is known.
        points = np.where(self._anchored, points, positions[self._moved] + whole)
        # Joints that this touch does not move stay where they are, not where they were taught.
        mine = self.settled.moved_by.get(self._patches[touch.patch], self.settled.moved)
        points = np.where(np.isin(self._moved, mine), points, positions[self._moved])
        if self.settled.value == "goal":
            spread = np.linspace(0.0, spent, len(points)).astype(np.float64)
            course = Course(points, spread)
            course.join(positions[self._moved], self._span)
            return course
        return Course(np.stack([positions[self._moved], points[0]]), np.array([0.0, spent]))
