"""The hetero-associative sequential memory: m = s ⊗ o, d = S₋₁ softmax(β Mᵀ q).

Notation: s is the code of the state, o the code of the observation, m their association, M the
stored associations as rows, S₋₁ the successors as rows, q = s ⊗ o the query, β the inverse
temperature and d the decision.

Source: Wang, Wang, Cheng, "A Hetero-Associative Sequential Memory Model Utilizing Neuromorphic
Signals", sections "Association Creation" and "Hetero-associative Sequential Memory".
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, Self, get_args

import torch
from torch import Tensor, nn

from hasm_torch.bipolar import binarise, bind
from hasm_torch.recall import pack, recall_dense, recall_packed, store, unpack
from hasm_torch.rope3d import RoPE3D

Storage = Literal["float32", "bfloat16", "int8", "bit"]

# An int8 entry holds 1/64 steps: ±1 is exact, and ±√3, the most a rotated block of three ±1
# entries can reach, still fits.
INT8_STEPS = 64


class Crowding(NamedTuple):
    """How full and how crowded a memory is.

    Attributes:
        count: Associations held.
        capacity: Associations that fit.
        margin: Smallest lead of a stored association's match with itself over its best match
            with a different association, in units of the inner product; ``code_dim`` if there is
            no other.
        crosstalk: Mean over the associations of the best match with another one, divided by the
            match with itself.
        beta: Inverse temperature at which a stored association outweighs all others together by
            ``confidence``.
    """

    count: int
    capacity: int
    margin: float
    crosstalk: float
    beta: float


class HeteroAssociativeMemory(nn.Module):
    """Stores bound codes with what followed them, and recalls by similarity.

        m = s ⊗ RoPE3D(o; n, θ)                              (Association Creation)
        d = S₋₁ softmax(β Mᵀ q),   q = s ⊗ RoPE3D(o; n, θ)   (Hetero-associative Sequential Memory)

    Buffers have the shape the capacity gives them, so ``state_dict``, ``torch.compile`` and
    ``torch.export`` see fixed shapes; ``count`` says how much is filled.

    Attributes:
        associations: M, (capacity, code_dim), or packed as ``recall.pack`` does with ``storage="bit"``.
        successors: S₋₁, (capacity, value_dim), float32 or better.
        count: () int64, number of associations held.
        beta: β, () float32 or better; a parameter with ``learn_beta``.
        rope: The rotary embedding applied to observations.

    Args:
        code_dim: Entries of a code, D.
        value_dim: Entries of a successor.
        capacity: Associations that fit.
        beta: Inverse temperature β of the softmax over unnormalised inner products.
        learn_beta: Whether β is a parameter.
        storage: How associations are held: "float32"; "bfloat16"; "int8" (steps of 1/64, exact
            for ±1); "bit" (one bit an entry: associations and queries are re-binarised by sign).

    Raises:
        ValueError: If a size is below 1 or the storage is unknown.
    """

    associations: Tensor
    successors: Tensor
    count: Tensor

    def __init__(
        self,
        code_dim: int,
        value_dim: int,
        capacity: int,
        beta: float = 1.0,
        learn_beta: bool = False,
        storage: Storage = "float32",
    ) -> None:
        super().__init__()
        for name, size in (("code_dim", code_dim), ("value_dim", value_dim)):
            if size < 1:
                raise ValueError(f"{name} must be at least 1, got {size}")
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1 association, got {capacity}")
        if storage not in get_args(Storage):
            raise ValueError(f"unknown storage {storage!r}, valid: {', '.join(get_args(Storage))}")
        self.code_dim, self.value_dim, self.capacity = code_dim, value_dim, capacity
        self.storage: Storage = storage
        self.rope = RoPE3D(code_dim)
        if storage == "bit":
            empty = torch.zeros_like(pack(torch.empty(capacity, code_dim)))
        else:
            empty = torch.zeros(capacity, code_dim, dtype=getattr(torch, storage))
        self.register_buffer("associations", empty)
        self.register_buffer("successors", torch.zeros(capacity, value_dim))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        value = torch.as_tensor(beta, dtype=torch.float32).detach().clone()
        if learn_beta:
            self.beta = nn.Parameter(value)
        else:
            self.register_buffer("beta", value)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Joint positions and β keep float32 or better, whatever the dtype of the codes.
        kept = {"successors": self.successors, "beta": self.beta}
        super()._apply(fn, recurse)
        for name, before in kept.items():
            now = getattr(self, name)
            if now.dtype in (torch.float16, torch.bfloat16):
                now.data = before.data.to(now.device)
        return self

    def extra_repr(self) -> str:
        """Sizes and storage, as printed."""
        return (
            f"code_dim={self.code_dim}, value_dim={self.value_dim}, capacity={self.capacity}, "
            f"storage={self.storage!r}"
        )

    def associate(
        self,
        state: Tensor,
        observation: Tensor,
        axis: Tensor | None = None,
        angle: Tensor | None = None,
    ) -> Tensor:
        """Bind a state to an observation that is rotated by the touch.

        Args:
            state: s, (..., code_dim).
            observation: o, (..., code_dim).
            axis: Unit rotation axis of the touch, (..., 3); without it nothing is rotated.
            angle: Rotation angle of the touch, (...,), rad.

        Returns:
            (..., code_dim), the association or the query.

        Raises:
            ValueError: If a code has another length, or only one of axis and angle is given.
        """
        for name, code in (("state", state), ("observation", observation)):
            if code.shape[-1] != self.code_dim:
                raise ValueError(
                    f"expected {name} code (..., {self.code_dim}), got {tuple(code.shape)}"
                )
        if (axis is None) != (angle is None):
            raise ValueError("axis and angle describe one rotation: give both or neither")
        if axis is not None and angle is not None:
            observation = self.rope(observation, axis, angle)
        return bind(state, observation)

    def forward(
        self,
        state: Tensor,
        observation: Tensor,
        axis: Tensor | None = None,
        angle: Tensor | None = None,
    ) -> Tensor:
        """Decide what follows a state under an observation; shapes as in ``associate``.

        Returns:
            Decision d, (..., value_dim).
        """
        return self.recall(self.associate(state, observation, axis, angle))

    def recall(self, query: Tensor) -> Tensor:
        """Recall the decision for a query.

        Args:
            query: q, (..., code_dim).

        Returns:
            Decision d, (..., value_dim); differentiable in query, β and the stored patterns
            unless the storage is "bit".

        Raises:
            ValueError: If the query has another length.
            RuntimeError: If the memory is empty.
        """
        self._check_query(query)
        if self.storage == "bit":
            return recall_packed(
                query, self.associations, self.successors, self.beta, count=self.count
            )
        scale = INT8_STEPS if self.storage == "int8" else 1
        return recall_dense(
            query, self.associations, self.successors, self.beta / scale, count=self.count
        )

    def weights(self, query: Tensor) -> Tensor:
        """The softmax weight of every stored association, softmax(β Mᵀ q).

        Args:
            query: q, (..., code_dim).

        Returns:
            (..., count), at least float32.
        """
        self._check_query(query)
        stored = self.stored().float()
        if self.storage == "bit":
            query = binarise(query)
        return torch.softmax(self.beta * (query.to(stored.dtype) @ stored.mT), dim=-1)

    @torch.no_grad()
    def write(
        self,
        state: Tensor,
        observation: Tensor,
        successor: Tensor,
        axis: Tensor | None = None,
        angle: Tensor | None = None,
    ) -> None:
        """Store what followed a state under an observation.

        Args:
            state: s, (..., code_dim).
            observation: o, (..., code_dim).
            successor: What followed, (..., value_dim), finite.
            axis: Unit rotation axis of the touch, (..., 3).
            angle: Rotation angle of the touch, (...,), rad.

        Raises:
            ValueError: If a shape is off or a value is not finite; nothing is stored then.
            RuntimeError: If the memory has no room for all of them; nothing is stored then.
        """
        association = self.associate(state, observation, axis, angle)
        if successor.shape != (*association.shape[:-1], self.value_dim):
            raise ValueError(
                f"expected successor {(*association.shape[:-1], self.value_dim)}, "
                f"got {tuple(successor.shape)}"
            )
        if not (torch.isfinite(association).all() and torch.isfinite(successor).all()):
            raise ValueError("codes and successors must be finite, got NaN or infinity")
        association = association.reshape(-1, self.code_dim)
        held, new = int(self.count), len(association)
        if held + new > self.capacity:
            raise RuntimeError(
                f"the memory is full: it holds {held} of {self.capacity} associations and {new} "
                "more were to be written; build it with a larger capacity"
            )
        if self.storage == "bit":
            rows = torch.arange(held, held + new, device=association.device)
            store(self.associations, rows, association)
        elif self.storage == "int8":
            steps = (association * INT8_STEPS).round().clamp(-127, 127)
            self.associations[held : held + new] = steps.to(torch.int8)
        else:
            self.associations[held : held + new] = association.to(self.associations.dtype)
        self.successors[held : held + new] = successor.reshape(-1, self.value_dim).to(
            self.successors.dtype
        )
        self.count.add_(new)

    def clear(self) -> None:
        """Forget every association."""
        self.count.zero_()

    def stored(self) -> Tensor:
        """The associations held, (count, code_dim), as real numbers."""
        if self.storage == "bit":
            return unpack(self.associations, self.code_dim)[: int(self.count)]
        rows = self.associations[: int(self.count)]
        return rows.float() / INT8_STEPS if self.storage == "int8" else rows

    def memory_bytes(self) -> int:
        """Resident bytes of the buffers for associations and successors."""
        return self.associations.nbytes + self.successors.nbytes

    def crowding(self, confidence: float = 1e6) -> Crowding:
        """Report how full the memory is and how alike its associations are.

        Identical associations are one address and count once.

        Args:
            confidence: Ratio of the right weight to the sum of all others that ``beta`` in the
                report reaches: β = ln(confidence · (count − 1)) / margin.

        Raises:
            RuntimeError: If the memory is empty.
        """
        self._check_filled()
        stored = torch.unique(self.stored().float(), dim=0)
        own = (stored**2).sum(-1)
        rival = torch.full_like(own, -torch.inf)
        for rows in torch.arange(len(stored), device=stored.device).split(1024):
            scores = stored[rows] @ stored.mT
            scores[torch.arange(len(rows), device=stored.device), rows] = -torch.inf
            rival[rows] = scores.amax(-1)
        if len(stored) == 1:
            rival = torch.zeros_like(own)
        margin = float((own - rival).min())
        others = max(len(stored) - 1, 1)
        beta = float(torch.log(torch.tensor(confidence * others))) / max(margin, 1e-6)
        return Crowding(int(self.count), self.capacity, margin, float((rival / own).mean()), beta)

    def _check_query(self, query: Tensor) -> None:
        if query.shape[-1] != self.code_dim:
            raise ValueError(f"expected query (..., {self.code_dim}), got {tuple(query.shape)}")
        self._check_filled()

    def _check_filled(self) -> None:
        if not torch.compiler.is_compiling() and int(self.count) == 0:
            raise RuntimeError("the memory is empty: write at least one association first")
