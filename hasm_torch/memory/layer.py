"""The hetero-associative sequential memory: m = s ⊗ o, d = S₋₁ softmax(β Mᵀ q).

Notation: s is the code of the state, o the code of the observation, m their association, M the
stored associations as rows, S₋₁ the successors as rows, q = s ⊗ o the query, β the inverse
temperature and d the decision.

Source: Wang, Wang, Cheng, "A Hetero-Associative Sequential Memory Model Utilizing Neuromorphic
Signals", sections "Association Creation" and "Hetero-associative Sequential Memory".
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from hasm_torch.encoders.bipolar import binarise
from hasm_torch.encoders.rope3d import RoPE3D
from hasm_torch.memory.crowding import Crowding, crowding
from hasm_torch.memory.recall import (
    NORMALISED,
    Interaction,
    Recall,
    Stored,
    check_interaction,
    inspect_dense,
    inspect_packed,
    recall_dense,
    recall_packed,
    weights_dense,
    weights_packed,
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
        origins: (capacity,) int64, where each association comes from; -1 where it was not told.
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
        interaction: "softmax"; "sparsemax" or "entmax15", with which all but the best matches weigh
            nothing; "exponential" or a degree for a dense associative memory, whose weights are not
            normalised. See ``recall.interaction``.
        when_full: "error" refuses a write that does not fit; "overwrite" replaces the oldest;
            "grow" doubles the capacity.
        top_k: Only so many best matches weigh, and what matches exactly as well as the last of
            them; None for all.

    Raises:
        ValueError: If a size is below 1, an option is unknown, or two options exclude each other.
    """

    beta: Tensor
    _precise = ("successors", "beta")

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
        top_k: int | None = None,
    ) -> None:
        super().__init__(code_dim, value_dim, capacity, storage, learn_patterns, when_full)
        check_interaction(interaction, top_k)
        self.interaction, self.top_k = interaction, top_k
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

    def extra_repr(self) -> str:
        """Sizes and options, as printed."""
        return (
            f"code_dim={self.code_dim}, value_dim={self.value_dim}, capacity={self.capacity}, "
            f"storage={self.storage!r}, interaction={self.interaction!r}"
        )

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
        recall = recall_packed if self.storage == "bit" else recall_dense
        return recall(*self._asked(query, mask))

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
            ValueError: If a shape is off, or the weights of the interaction are not normalised.
            RuntimeError: If the memory is empty.
        """
        if self.interaction not in NORMALISED:
            raise ValueError(
                f"inspect needs normalised weights, interaction {' or '.join(NORMALISED)}, got "
                f"{self.interaction!r}"
            )
        inspect = inspect_packed if self.storage == "bit" else inspect_dense
        found = inspect(*self._asked(query, mask))
        if (scale := self._score_scale) != 1:
            found = found._replace(score=found.score / scale, margin=found.margin / scale)
        return found

    def weights(self, query: Tensor, mask: Tensor | None = None) -> Tensor:
        """Weight of every stored association in the decision.

        Args:
            query: q, (..., code_dim).
            mask: Rows that each query may recall, (..., capacity) bool.

        Returns:
            (..., capacity), 0 for rows that are empty or masked.
        """
        weigh = weights_packed if self.storage == "bit" else weights_dense
        weights = weigh(*self._asked(query, mask))
        unheld = self.capacity - weights.shape[-1]
        return torch.nn.functional.pad(weights, (0, unheld)) if unheld else weights

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

    def _asked(self, query: Tensor, mask: Tensor | None) -> tuple[Tensor, Stored]:
        """The query and the memory as the functions of ``recall`` take them."""
        if query.shape[-1] != self.code_dim:
            raise ValueError(f"expected query (..., {self.code_dim}), got {tuple(query.shape)}")
        fixed = torch.compiler.is_compiling()
        held = 0 if fixed else int(self.count)
        if not (fixed or held):
            raise RuntimeError("the memory is empty: write at least one association first")
        how = self.interaction, self.top_k
        if self.storage == "bit":
            memory = self.associations, self.successors, self.beta, self.count, mask
            return query, Stored(*memory, *how)
        # What is held is enough, but a fixed shape asks to look at all rows.
        rows = slice(self.capacity if fixed else held)
        mask = mask if mask is None else mask[..., rows]
        associations, beta = self.associations[rows], self.beta / self._score_scale
        if self.binarised:
            query, associations = binarise(query), binarise(associations)
        count = self.count if fixed else None
        return query, Stored(associations, self.successors[rows], beta, count, mask, *how)

    @property
    def _score_scale(self) -> int:
        """What a stored entry's integer steps multiply the inner products by."""
        return INT8_STEPS if self.storage == "int8" and not self.binarised else 1
