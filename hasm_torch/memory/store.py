"""The stored associations: writing, forgetting and merging them in buffers of fixed shape."""

from collections.abc import Callable
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor, nn

from hasm_torch.memory import functional
from hasm_torch.memory.recall import ROWS, pack, store, unpack
from hasm_torch.memory.successors import distinct_links, shifted_links

Storage = Literal["float32", "bfloat16", "int8", "bit"]
WhenFull = Literal["error", "overwrite", "grow"]

# An int8 entry holds 1/64 steps: ±1 is exact, and ±√3, the most a rotated block of three ±1
# entries can reach, still fits.
INT8_STEPS = 64

# Left out, the storage is float32 while the associations take at most so many bytes.
FLOAT32_BYTES = 256 * 1024**2

# What has a row an association, and what stands in a row that was never used.
_ROWS = {"associations": 0, "successors": 0, "origins": -1}


class AssociationStore(nn.Module):
    """Associations M and successors S₋₁ as rows of buffers that are filled from the first on.

    Attributes and arguments are those of ``HeteroAssociativeMemory``.
    """

    associations: Tensor
    successors: Tensor
    origins: Tensor
    count: Tensor
    oldest: Tensor
    _precise: tuple[str, ...] = ("successors",)  # these keep float32 or better, whatever the codes

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
        for name, option, valid in (
            ("storage", self.storage, get_args(Storage)),
            ("when_full", when_full, get_args(WhenFull)),
        ):
            if option not in valid:
                raise ValueError(f"unknown {name} {option!r}, valid: {', '.join(valid)}")
        if learn_patterns and self.storage != "float32":
            raise ValueError(f"learned patterns need storage 'float32', got {self.storage!r}")
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
        self.register_buffer("origins", torch.full((capacity,), -1))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        self.register_buffer("oldest", torch.zeros((), dtype=torch.int64))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        before = {name: getattr(self, name).data for name in self._precise}
        super()._apply(fn, recurse)
        for name, tensor in before.items():
            now = getattr(self, name)
            if now.dtype in (torch.float16, torch.bfloat16):
                now.data = tensor.to(now.device)
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        # The checkpoint's capacity counts; those without origins are of an older version.
        successors = state_dict.get(prefix + "successors")
        if successors is not None and successors.ndim == 2:
            if len(successors) != self.capacity and not self._learned:
                self._resize(len(successors))
            state_dict.setdefault(prefix + "origins", torch.full((len(successors),), -1))
        super()._load_from_state_dict(state_dict, prefix, *rest)

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

    @torch.no_grad()
    def write(
        self,
        state: Tensor,
        observation: Tensor,
        successor: Tensor,
        axis: Tensor | None = None,
        angle: Tensor | None = None,
        origin: Tensor | int | None = None,
    ) -> None:
        """Store what followed a state under an observation.

        Args:
            state: s, (..., code_dim).
            observation: o, (..., code_dim).
            successor: What followed, (..., value_dim), finite.
            axis: Rotation axis of the touch, (..., 3).
            angle: Rotation angle of the touch, (...,), rad.
            origin: Where it comes from, for example the number of an episode: an integer or
                (...,) integers; ``remove`` takes it. Left out, -1.

        Raises:
            ValueError: If a shape is off or a value is not finite; nothing is stored then.
            RuntimeError: If they do not fit and ``when_full`` is "error"; nothing is stored then.
        """
        association = self.associate(state, observation, axis, angle)
        if successor.shape != (*association.shape[:-1], self.value_dim):
            raise ValueError(
                f"expected successor {(*association.shape[:-1], self.value_dim)}, "
                f"got {tuple(successor.shape)}"
            )
        if not (torch.isfinite(association).all() and torch.isfinite(successor).all()):
            raise ValueError("codes and successors must be finite, got NaN or infinity")
        origins = self._origins(origin, association.shape[:-1])
        association = association.reshape(-1, self.code_dim)
        successor = successor.reshape(-1, self.value_dim)
        held, new = int(self.count), len(association)
        if held + new > self.capacity:
            self._make_room(held + new)
        kept = min(new, self.capacity)  # of more than fit, the last ones stay
        first = (int(self.oldest) + held + new - kept) % self.capacity
        rows = (first + torch.arange(kept, device=self.count.device)) % self.capacity
        self._put(rows, association[new - kept :], successor[new - kept :])
        self.origins[rows] = origins[new - kept :]
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
            episodes: (T,) integers, the episode of each sample, contiguous, and the origin of
                its association; by default all one, of no origin.
            horizon: How many samples later the follower comes.
            resolution: Store only where the association changes by at least so many entries, the
                follower being the next distinct one; then ``horizon`` is not used. See
                ``successors.distinct_links``.

        Raises:
            ValueError: If a shape is off or a value is not finite; nothing is stored then.
            RuntimeError: If they do not fit and ``when_full`` is "error"; nothing is stored then.
        """
        if episodes is None:
            episodes = torch.full((len(state),), -1, device=state.device)
        if resolution is None:
            source, target = shifted_links(episodes, horizon)
        else:
            links = distinct_links(self.associate(state, observation), episodes, resolution)
            source, target = links.state, links.successor
        self.write(state[source], observation[source], values[target], origin=episodes[source])

    @torch.no_grad()
    def remove(self, rows: Tensor | None = None, origin: Tensor | int | None = None) -> int:
        """Forget some associations; what is left is as if they had never been written.

        The others move up and keep their order of age.

        Args:
            rows: (n,) indices, or (capacity,) bool, of the rows to forget.
            origin: An origin, or several, all of whose associations are forgotten.

        Returns:
            How many associations were forgotten.

        Raises:
            ValueError: If a row is not held.
        """
        held = self._held_rows()
        leave = torch.zeros_like(held, dtype=torch.bool)
        if origin is not None:
            leave |= torch.isin(self.origins[held], torch.as_tensor(origin, device=held.device))
        if rows is not None:
            rows = torch.nonzero(rows).flatten() if rows.dtype == torch.bool else rows
            if not torch.isin(rows, held).all():
                raise ValueError(f"expected rows among the {len(held)} held, got {rows.tolist()}")
            leave |= torch.isin(held, rows)
        self._refill(held[~leave])
        return int(leave.sum())

    @torch.no_grad()
    def grow(self, capacity: int) -> None:
        """Make room for more associations; what is recalled stays the same.

        Args:
            capacity: Associations that are to fit, at least as many as now.

        Raises:
            ValueError: If the capacity is smaller than it is, or the patterns are learned, whose
                number the optimiser knows.
        """
        if capacity < self.capacity or self._learned:
            kind = "learned patterns" if self._learned else "associations"
            raise ValueError(
                f"expected a capacity of at least {self.capacity} and patterns that are not "
                f"learned, got {capacity} for {kind}"
            )
        self._refill(self._held_rows())
        self._resize(capacity)

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
        self._refill(self.oldest.new_empty(0))

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
        self.origins.fill_(-1)
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

    @torch.no_grad()
    def _refill(self, rows: Tensor) -> None:
        """Keep some rows, in this order, as they are stored; all others become as if never used."""
        for name, empty in _ROWS.items():
            stored = getattr(self, name).data
            if name == "associations" and self.storage == "bit":
                kept, places = stored[rows // ROWS, :, rows % ROWS], torch.arange(len(rows))
                stored.zero_()
                stored[places // ROWS, :, places % ROWS] = kept
            else:
                kept = stored[rows]
                stored[: len(rows)] = kept
                stored[len(rows) :] = empty
        self.count.fill_(len(rows))
        self.oldest.zero_()

    def _make_room(self, wanted: int) -> None:
        """What ``when_full`` says about a write after which more associations would be held."""
        if self.when_full == "grow":
            self.grow(max(wanted, 2 * self.capacity))
        elif self.when_full == "error":
            raise RuntimeError(
                f"the memory is full: it holds {int(self.count)} of {self.capacity} associations "
                f"and {wanted - int(self.count)} more were to be written; build it with a larger "
                'capacity, remove some, or use when_full="grow" or "overwrite"'
            )

    def _resize(self, capacity: int) -> None:
        """Change the number of rows; what lies in the first of them stays."""
        for name, empty in _ROWS.items():
            tensor = getattr(self, name)
            packed = name == "associations" and self.storage == "bit"
            rows = -(-capacity // ROWS) if packed else capacity
            resized = tensor.new_full((rows, *tensor.shape[1:]), empty)
            kept = min(rows, len(tensor))
            resized[:kept] = tensor[:kept]
            setattr(self, name, resized)
        self.capacity = capacity

    def _origins(self, origin: Tensor | int | None, shape: torch.Size) -> Tensor:
        """Origins of the associations to be written, (n,) int64."""
        origins = torch.as_tensor(-1 if origin is None else origin, device=self.count.device)
        if origins.is_floating_point() or (origins.ndim and origins.shape != shape):
            raise ValueError(
                f"expected an origin that is an integer or {tuple(shape)} integers, got "
                f"{origins.dtype} {tuple(origins.shape)}"
            )
        return origins.expand(shape).reshape(-1)

    @property
    def _learned(self) -> bool:
        return isinstance(self.associations, nn.Parameter)

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
