"""The stored associations: writing, forgetting and merging them in buffers of fixed shape."""

from collections.abc import Callable
from typing import Literal, Self, get_args

import torch
from torch import Tensor, nn

from hasm_torch.memory import functional
from hasm_torch.memory.recall import ROWS, pack, store, unpack
from hasm_torch.memory.successors import distinct_links, shifted_links

Storage = Literal["float32", "bfloat16", "int8", "bit"]
WhenFull = Literal["error", "overwrite"]

# An int8 entry holds 1/64 steps: ±1 is exact, and ±√3, the most a rotated block of three ±1
# entries can reach, still fits.
INT8_STEPS = 64

# Left out, the storage is float32 while the associations take at most so many bytes.
FLOAT32_BYTES = 256 * 1024**2


class AssociationStore(nn.Module):
    """Associations M and successors S₋₁ as rows of buffers that are filled from the first on.

    Attributes:
        associations: M, (capacity, code_dim); with ``storage="bit"`` packed by ``recall.pack``.
        successors: S₋₁, (capacity, value_dim), float32 or better.
        count: () int64, number of associations held.
        oldest: () int64, row of the oldest association.

    Args:
        code_dim: Entries of a code, D.
        value_dim: Entries of a successor.
        capacity: Associations that fit.
        storage: "float32", "bfloat16", "int8" or "bit"; None chooses, see
            ``HeteroAssociativeMemory``.
        learn_patterns: Whether associations and successors are parameters (float32 only).
        when_full: "error" or "overwrite".

    Raises:
        ValueError: If a size is below 1, an option is unknown, or two options exclude each other.
    """

    associations: Tensor
    successors: Tensor
    count: Tensor
    oldest: Tensor

    def __init__(
        self,
        code_dim: int,
        value_dim: int,
        capacity: int,
        storage: Storage | None,
        learn_patterns: bool,
        when_full: WhenFull,
    ) -> None:
        super().__init__()
        sizes = {"code_dim": code_dim, "value_dim": value_dim, "capacity": capacity}
        for name, size in sizes.items():
            if size < 1:
                raise ValueError(f"{name} must be at least 1, got {size}")
        small = learn_patterns or 4 * capacity * code_dim <= FLOAT32_BYTES
        self.storage: Storage = storage or ("float32" if small else "bit")
        _check_options(self.storage, learn_patterns, when_full)
        self.code_dim, self.value_dim, self.capacity = code_dim, value_dim, capacity
        self.when_full = when_full
        if self.storage == "bit":
            block = pack(torch.empty(1, code_dim))
            associations = block.new_zeros(-(-capacity // ROWS), *block.shape[1:])
        else:
            associations = torch.zeros(capacity, code_dim, dtype=getattr(torch, self.storage))
        patterns = {"associations": associations, "successors": torch.zeros(capacity, value_dim)}
        for name, tensor in patterns.items():
            if learn_patterns:
                setattr(self, name, nn.Parameter(tensor))
            else:
                self.register_buffer(name, tensor)
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        self.register_buffer("oldest", torch.zeros((), dtype=torch.int64))

    @property
    def _precise(self) -> tuple[str, ...]:
        """Tensors that keep float32 or better whatever the dtype of the codes."""
        return ("successors",)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Joint positions and temperatures keep float32 or better, whatever the dtype of the codes.
        before = {name: getattr(self, name).data for name in self._precise}
        super()._apply(fn, recurse)
        for name, tensor in before.items():
            now = getattr(self, name)
            if now.dtype in (torch.float16, torch.bfloat16):
                now.data = tensor.to(now.device)
        return self

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
            axis: Rotation axis of the touch, (..., 3).
            angle: Rotation angle of the touch, (...,), rad.

        Raises:
            ValueError: If a shape is off or a value is not finite; nothing is stored then.
            RuntimeError: If they do not fit and ``when_full`` is "error"; nothing is stored then.
        """
        for name, code in (("state", state), ("observation", observation)):
            if code.shape[-1] != self.code_dim:
                raise ValueError(
                    f"expected {name} code (..., {self.code_dim}), got {tuple(code.shape)}"
                )
        association = functional.associate(state, observation, axis, angle)
        if successor.shape != (*association.shape[:-1], self.value_dim):
            raise ValueError(
                f"expected successor {(*association.shape[:-1], self.value_dim)}, "
                f"got {tuple(successor.shape)}"
            )
        if not (torch.isfinite(association).all() and torch.isfinite(successor).all()):
            raise ValueError("codes and successors must be finite, got NaN or infinity")
        association = association.reshape(-1, self.code_dim)
        successor = successor.reshape(-1, self.value_dim)
        held, oldest, new = int(self.count), int(self.oldest), len(association)
        if held + new > self.capacity and self.when_full == "error":
            raise RuntimeError(
                f"the memory is full: it holds {held} of {self.capacity} associations and {new} "
                "more were to be written; build it with a larger capacity, remove some, or "
                'use when_full="overwrite"'
            )
        kept = min(new, self.capacity)  # of more than fit, the last ones stay
        first = (oldest + held + new - kept) % self.capacity
        rows = (first + torch.arange(kept, device=self.count.device)) % self.capacity
        self._put(rows, association[new - kept :], successor[new - kept :])
        lost = max(0, held + new - self.capacity)
        self.oldest.copy_((self.oldest + lost) % self.capacity)
        self.count.copy_(torch.clamp(self.count + new, max=self.capacity))

    def write_episodes(
        self,
        state: Tensor,
        observation: Tensor,
        values: Tensor,
        episodes: Tensor | None = None,
        horizon: int = 1,
        resolution: int | None = None,
    ) -> None:
        """Store whole episodes; no link ever crosses from one into another.

        Args:
            state: s of every sample, (T, code_dim).
            observation: o of every sample, (T, code_dim), already rotated.
            values: What is recalled, (T, value_dim): sample k is stored with the value of the
                sample that follows it.
            episodes: (T,) integers, the episode of each sample, contiguous; by default all one.
            horizon: How many samples later the follower comes.
            resolution: Store only where the association changes by at least so many entries, the
                follower being the next distinct one; then ``horizon`` is not used. See
                ``successors.distinct_links``.

        Raises:
            ValueError: If a shape is off or a value is not finite; nothing is stored then.
            RuntimeError: If they do not fit and ``when_full`` is "error"; nothing is stored then.
        """
        if episodes is None:
            episodes = torch.zeros(len(state), dtype=torch.int64, device=state.device)
        if resolution is None:
            source, target = shifted_links(episodes, horizon)
        else:
            links = distinct_links(functional.associate(state, observation), episodes, resolution)
            source, target = links.state, links.successor
        self.write(state[source], observation[source], values[target])

    @torch.no_grad()
    def remove(self, rows: Tensor) -> None:
        """Forget some associations; the others move up and keep their order of age.

        Args:
            rows: (n,) indices, or (capacity,) bool, of the rows to forget.

        Raises:
            ValueError: If a row is not held.
        """
        rows = torch.nonzero(rows).flatten() if rows.dtype == torch.bool else rows
        held = self._held_rows()
        if not torch.isin(rows, held).all():
            raise ValueError(f"expected rows among the {len(held)} held, got {rows.tolist()}")
        self._refill(held[~torch.isin(held, rows)])

    @torch.no_grad()
    def merge(self, tolerance: int = 0) -> int:
        """Make one of associations whose signs differ in few entries; successors are averaged.

        Args:
            tolerance: Most entries in which merged associations may differ from the oldest of
                them.

        Returns:
            How many associations were merged away.
        """
        held = self._held_rows()
        codes = self._codes()[held].sign()
        left = torch.ones(len(held), dtype=torch.bool, device=held.device)
        keep = []
        for i in range(len(held)):
            if left[i]:
                differing = (self.code_dim - codes @ codes[i]) / 2
                group = left & (differing <= tolerance)
                self.successors.data[held[i]] = self.successors[held[group]].mean(0)
                left &= ~group
                keep.append(i)
        self._refill(held[torch.tensor(keep, dtype=torch.int64, device=held.device)])
        return len(held) - len(keep)

    def clear(self) -> None:
        """Forget every association."""
        self.count.zero_()
        self.oldest.zero_()

    @torch.no_grad()
    def initialise(self, generator: torch.Generator, scale: float = 0.1) -> None:
        """Fill the memory with random ±1 associations and small successors, to be learned.

        Args:
            generator: Source of the random numbers.
            scale: Standard deviation of the successors.
        """
        shape = (self.capacity, self.code_dim)
        signs = torch.randint(0, 2, shape, generator=generator, dtype=torch.float32) * 2 - 1
        values = scale * torch.randn(self.capacity, self.value_dim, generator=generator)
        rows = torch.arange(self.capacity, device=self.count.device)
        self._put(rows, signs.to(self.count.device), values.to(self.count.device))
        self.count.fill_(self.capacity)
        self.oldest.zero_()

    def stored(self) -> Tensor:
        """The associations held, oldest first, (count, code_dim), as real numbers."""
        return self._codes()[self._held_rows()]

    def memory_bytes(self) -> int:
        """Resident bytes of associations and successors."""
        return self.associations.nbytes + self.successors.nbytes

    def _put(self, rows: Tensor, codes: Tensor, successors: Tensor) -> None:
        if self.storage == "bit":
            store(self.associations, rows, codes)
        elif self.storage == "int8":
            steps = (codes * INT8_STEPS).round().clamp(-127, 127)
            self.associations[rows] = steps.to(torch.int8)
        else:
            self.associations.data[rows] = codes.to(self.associations.dtype)
        self.successors.data[rows] = successors.to(self.successors.dtype)

    def _refill(self, rows: Tensor) -> None:
        codes, successors = self._codes()[rows], self.successors[rows].clone()
        self._put(torch.arange(len(rows), device=rows.device), codes, successors)
        self.count.fill_(len(rows))
        self.oldest.zero_()

    def _held_rows(self) -> Tensor:
        """Rows in use, oldest first."""
        order = torch.arange(int(self.count), device=self.count.device)
        return (self.oldest + order) % self.capacity

    def _codes(self) -> Tensor:
        """All rows as real numbers, (capacity, code_dim)."""
        if self.storage == "bit":
            return unpack(self.associations, self.code_dim)[: self.capacity]
        codes = self.associations
        return codes.float() / INT8_STEPS if self.storage == "int8" else codes


def _check_options(storage: Storage, learn_patterns: bool, when_full: WhenFull) -> None:
    if storage not in get_args(Storage):
        raise ValueError(f"unknown storage {storage!r}, valid: {', '.join(get_args(Storage))}")
    if learn_patterns and storage != "float32":
        raise ValueError(f"learned patterns need storage 'float32', got {storage!r}")
    if when_full not in get_args(WhenFull):
        raise ValueError(f"unknown when_full {when_full!r}, valid: {', '.join(get_args(WhenFull))}")
