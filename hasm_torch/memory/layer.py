"""The hetero-associative sequential memory: m = s ⊗ o, d = S₋₁ softmax(β Mᵀ q).

Notation: s is the code of the state, o the code of the observation, m their association, M the
stored associations as rows, S₋₁ the successors as rows, q = s ⊗ o the query, β the inverse
temperature and d the decision.

Source: Wang, Wang, Cheng, "A Hetero-Associative Sequential Memory Model Utilizing Neuromorphic
Signals", sections "Association Creation" and "Hetero-associative Sequential Memory".
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

from hasm_torch.encoders.bipolar import binarise
from hasm_torch.encoders.rope3d import RoPE3D
from hasm_torch.memory import functional
from hasm_torch.memory.crowding import Crowding, crowding
from hasm_torch.memory.interaction import Interaction, check_interaction, interact
from hasm_torch.memory.recall import (
    Recall,
    inspect_dense,
    inspect_packed,
    recall_dense,
    recall_packed,
)
from hasm_torch.memory.store import INT8_STEPS, AssociationStore, Storage, WhenFull


class HeteroAssociativeMemory(AssociationStore):
    """Stores bound codes with what followed them, and recalls by similarity.

        m = s ⊗ RoPE3D(o; n, θ)                              (Association Creation)
        d = S₋₁ softmax(β Mᵀ q),   q = s ⊗ RoPE3D(o; n, θ)   (Hetero-associative Sequential Memory)

    Buffers have the shape the capacity gives them, so ``state_dict``, ``torch.compile`` and
    ``torch.export`` see fixed shapes; ``count`` says how much is filled.

    Attributes:
        associations: M, (capacity, code_dim); with ``storage="bit"`` packed by ``recall.pack``.
        successors: S₋₁, (capacity, value_dim), float32 or better.
        count: () int64, number of associations held.
        oldest: () int64, row of the oldest association.
        beta: β, () float32 or better.
        rope: The rotary embedding applied to observations.

    Args:
        code_dim: Entries of a code, D.
        value_dim: Entries of a successor.
        capacity: Associations that fit.
        beta: Inverse temperature β of the unnormalised inner products: a number, a tensor or a
            parameter, which is then shared.
        learn_beta: Whether β is a parameter.
        storage: How associations are held: "float32"; "bfloat16"; "int8" (steps of 1/64, exact
            for ±1); "bit" (one bit an entry: associations and queries are taken by sign, exact
            for ±1). Left out: float32 if patterns are learned or the associations take at most
            256 MiB in it, else bit.
        learn_patterns: Whether associations and successors are parameters (float32 only).
        binarised: Whether associations and queries are taken by their sign, with a
            straight-through gradient; always so with "bit".
        interaction: "softmax"; "exponential" or a degree for a dense associative memory, whose
            weights are not normalised.
        when_full: "error" refuses a write that does not fit; "overwrite" replaces the oldest.

    Raises:
        ValueError: If a size is below 1, an option is unknown, or two options exclude each other.
    """

    beta: Tensor

    def __init__(
        self,
        code_dim: int,
        value_dim: int,
        capacity: int,
        beta: float | Tensor = 1.0,
        learn_beta: bool = False,
        storage: Storage | None = None,
        learn_patterns: bool = False,
        binarised: bool = False,
        interaction: Interaction = "softmax",
        when_full: WhenFull = "error",
    ) -> None:
        super().__init__(code_dim, value_dim, capacity, storage, learn_patterns, when_full)
        check_interaction(interaction)
        self.interaction = interaction
        self.binarised = binarised or self.storage == "bit"
        self.rope = RoPE3D(code_dim)
        if isinstance(beta, nn.Parameter):
            self.beta = beta
        else:
            value = torch.as_tensor(beta).detach().clone()
            value = value.to(torch.promote_types(value.dtype, torch.float32)).reshape(())
            if learn_beta:
                self.beta = nn.Parameter(value)
            else:
                self.register_buffer("beta", value)

    @property
    def _precise(self) -> tuple[str, ...]:
        return ("successors", "beta")

    def extra_repr(self) -> str:
        """Sizes and options, as printed."""
        return (
            f"code_dim={self.code_dim}, value_dim={self.value_dim}, capacity={self.capacity}, "
            f"storage={self.storage!r}, interaction={self.interaction!r}"
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
            axis: Rotation axis of the touch, (..., 3); without it nothing is rotated.
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
        return functional.associate(state, observation, axis, angle)

    def crowding(self, confidence: float = 1e6) -> Crowding:
        """Report how full and how crowded the memory is, with a β that fits; see ``crowding``.

        Args:
            confidence: Ratio of the right weight to all others together at the suggested β.

        Raises:
            ValueError: If the memory is empty.
        """
        return crowding(self.stored(), self.capacity, confidence)

    def forward(
        self,
        state: Tensor,
        observation: Tensor,
        axis: Tensor | None = None,
        angle: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Decide what follows a state under an observation; arguments as in ``associate``.

        Leading dimensions may hold a whole sequence.

        Args:
            state: s, (..., code_dim).
            observation: o, (..., code_dim).
            axis: Rotation axis of the touch, (..., 3).
            angle: Rotation angle of the touch, (...,), rad.
            mask: Rows that each query may recall, (..., capacity) bool.

        Returns:
            Decision d, (..., value_dim).
        """
        return self.recall(self.associate(state, observation, axis, angle), mask)

    def recall(self, query: Tensor, mask: Tensor | None = None) -> Tensor:
        """Recall the decision for queries.

        Args:
            query: q, (..., code_dim).
            mask: Rows that each query may recall, (..., capacity) bool.

        Returns:
            Decision d, (..., value_dim); differentiable in the query, β and the stored patterns,
            in those of "bit" storage in β and the successors alone.

        Raises:
            ValueError: If a shape is off.
            RuntimeError: If the memory is empty.
        """
        self._check_query(query)
        with _full_precision(query.device.type):
            if self.interaction != "softmax":
                weights = self._interacting(query, mask)
                return weights.to(self.successors.dtype) @ self.successors
            if self.storage == "bit":
                return recall_packed(*self._packed(query), count=self.count, mask=mask)
            return recall_dense(*self._dense(query), count=self.count, mask=mask)

    def inspect(self, query: Tensor, mask: Tensor | None = None) -> Recall:
        """Recall, and tell how sure the memory is: a confident recall from a guess.

        Args:
            query: q, (..., code_dim).
            mask: Rows that each query may recall, (..., capacity) bool.

        Returns:
            ``decision`` (..., value_dim); ``match`` (...,) row of the best match; ``score`` (...,)
            its inner product with the query; ``margin`` (...,) its lead over the second best;
            ``entropy`` (...,) of the weights, nats, 0 if one association decides alone.

        Raises:
            ValueError: If a shape is off, or the interaction is not "softmax".
            RuntimeError: If the memory is empty.
        """
        self._check_query(query)
        if self.interaction != "softmax":
            raise ValueError(
                f"inspect needs normalised weights, interaction 'softmax', got {self.interaction!r}"
            )
        with _full_precision(query.device.type):
            if self.storage == "bit":
                return inspect_packed(*self._packed(query), count=self.count, mask=mask)
            recalled = inspect_dense(*self._dense(query), count=self.count, mask=mask)
        scale = self._score_scale
        return recalled._replace(score=recalled.score / scale, margin=recalled.margin / scale)

    def weights(self, query: Tensor, mask: Tensor | None = None) -> Tensor:
        """Weight of every stored association in the decision.

        Args:
            query: q, (..., code_dim).
            mask: Rows that each query may recall, (..., capacity) bool.

        Returns:
            (..., capacity), 0 for rows that are empty or masked.
        """
        self._check_query(query)
        with _full_precision(query.device.type):
            return self._interacting(query, mask)

    def iterate(
        self,
        state: Tensor,
        steps: int,
        encode: Callable[[Tensor], Tensor] = binarise,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Recall again and again, each decision encoded as the next state.

        Args:
            state: s of the start, (..., code_dim).
            steps: Number of recalls.
            encode: Turns a decision (..., value_dim) into a state code (..., code_dim).
            observation: o that stays, (..., code_dim), already rotated; none for an unbound state.

        Returns:
            (..., steps, value_dim) the decisions in order.
        """
        decisions = []
        for _ in range(steps):
            query = state if observation is None else self.associate(state, observation)
            decisions.append(self.recall(query))
            state = encode(decisions[-1])
        return torch.stack(decisions, dim=-2)

    def _packed(self, query: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return query, self.associations, self.successors, self.beta

    def _dense(self, query: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        associations = self.associations
        if self.binarised:
            query, associations = binarise(query), binarise(associations)
        return query, associations, self.successors, self.beta / self._score_scale

    @property
    def _score_scale(self) -> int:
        """What a stored entry's integer steps multiply the inner products by."""
        return INT8_STEPS if self.storage == "int8" and not self.binarised else 1

    def _interacting(self, query: Tensor, mask: Tensor | None) -> Tensor:
        codes = self._codes().to(torch.promote_types(query.dtype, torch.float32))
        if self.binarised:
            query, codes = binarise(query), binarise(codes)
        scores = query.to(codes.dtype) @ codes.mT
        absent = torch.arange(self.capacity, device=query.device) >= self.count
        if mask is not None:
            absent = absent | ~mask
        return interact(scores.masked_fill(absent, torch.nan), self.beta, self.interaction)

    def _check_query(self, query: Tensor) -> None:
        if query.shape[-1] != self.code_dim:
            raise ValueError(f"expected query (..., {self.code_dim}), got {tuple(query.shape)}")
        if not torch.compiler.is_compiling() and int(self.count) == 0:
            raise RuntimeError("the memory is empty: write at least one association first")


def _full_precision(device: str) -> AbstractContextManager[None]:
    """Scores in full precision under autocast; entering autocast costs, so only where it is on."""
    if torch.is_autocast_enabled(device):
        return torch.autocast(device, enabled=False)
    return nullcontext()
