"""Rows of the memory: where they come from, forgetting by origin, and growing."""

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import assert_same

from hasm_torch import HeteroAssociativeMemory

STORAGES = ("float32", "bfloat16", "int8", "bit")


def drawn(rows: int, seed: int, dim: int = 37) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    codes = torch.randn(rows, dim, generator=generator).clamp(-1.7, 1.7)
    return codes, torch.randn(rows, 3, generator=generator)


def put(memory, codes, values, **options):
    memory.write(codes, torch.ones_like(codes), values, **options)


@settings(max_examples=30, deadline=None)
@given(
    storage=st.sampled_from(STORAGES),
    lengths=st.lists(st.tuples(st.integers(0, 90), st.integers(0, 3)), min_size=1, max_size=6),
    seed=st.integers(0, 99),
)
def test_an_origin_removed_is_as_if_it_had_never_been_written(storage, lengths, seed):
    memory, never = (HeteroAssociativeMemory(37, 3, 600, storage=storage) for _ in range(2))
    removed = 0
    for part, (length, origin) in enumerate(lengths):
        codes, values = drawn(length, seed + part)
        put(memory, codes, values, origin=origin)
        if origin == 1:
            removed += length
        else:
            put(never, codes, values, origin=torch.full((length,), origin))
    assert memory.remove(origin=1) == removed
    assert_same(memory, never)
    memory.remove(origin=torch.tensor([0, 2, 3]))
    assert_same(memory, HeteroAssociativeMemory(37, 3, 600, storage=storage))


@pytest.mark.parametrize("storage", STORAGES)
def test_origins_follow_their_rows(storage):
    ring = HeteroAssociativeMemory(37, 3, 10, storage=storage, when_full="overwrite")
    codes, values = drawn(23, 0)
    for part in torch.arange(23).split([4, 5, 14]):
        put(ring, codes[part], values[part], origin=part)
    held = ring._held_rows()
    assert ring.origins[held].tolist() == list(range(13, 23))
    assert torch.equal(ring.successors[held], values[13:])
    ring.remove(ring.origins == 15)
    assert ring.origins.tolist() == [13, 14, *range(16, 23), -1]
    put(ring, codes[16], values[0], origin=99)
    assert ring.merge() == 1
    assert ring.origins.tolist() == [13, 14, *range(16, 23), -1]
    torch.testing.assert_close(ring.successors[2], (values[16] + values[0]) / 2)
    assert copy.deepcopy(ring).remove(rows=torch.tensor([0, 1]), origin=16) == 3
    ring.clear()
    assert_same(ring, HeteroAssociativeMemory(37, 3, 10, storage=storage))


def test_the_origin_of_an_episode_is_its_number():
    codes, values = drawn(6, 0)
    memory = HeteroAssociativeMemory(37, 3, 10)
    memory.write_episodes(
        codes, torch.ones_like(codes), values, episodes=torch.tensor([4, 4, 4, 7, 7, 2])
    )
    assert memory.origins.tolist() == [4, 4, 7] + [-1] * 7
    memory.write_episodes(codes[:2], torch.ones(2, 37), values[:2])
    assert memory.origins[3] == -1


def test_a_wrong_origin_stores_nothing():
    memory = HeteroAssociativeMemory(37, 3, 10)
    codes, values = drawn(4, 0)
    for origin in (0.5, torch.arange(3), torch.zeros(4)):
        with pytest.raises(ValueError, match=r"an integer or \(4,\) integers"):
            put(memory, codes, values, origin=origin)
    assert memory.count == 0


@settings(max_examples=20, deadline=None)
@given(
    storage=st.sampled_from(STORAGES),
    rows=st.integers(1, 150),
    more=st.integers(0, 200),
    interaction=st.sampled_from(["softmax", "entmax15"]),
)
def test_growing_changes_no_recall(storage, rows, more, interaction):
    options = {"storage": storage, "beta": 0.3, "interaction": interaction}
    memory = HeteroAssociativeMemory(37, 3, rows, when_full="overwrite", **options)
    codes, values = drawn(rows + 5, rows)
    put(memory, codes, values, origin=torch.arange(rows + 5))
    query = drawn(3, 1)[0]
    before = memory.inspect(query)
    memory.grow(rows + more)
    assert memory.capacity == len(memory.successors) == len(memory.origins) == rows + more
    assert memory.origins[:rows].tolist() == list(range(5, rows + 5))
    ordered = HeteroAssociativeMemory(37, 3, rows, **options)
    put(ordered, codes[5:], values[5:])
    for left, right in zip(memory.inspect(query), ordered.inspect(query), strict=True):
        assert torch.equal(left, right)
    torch.testing.assert_close(memory.inspect(query).score, before.score)
    torch.testing.assert_close(memory.recall(query), before.decision)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_memory_that_grows_as_it_is_written(storage):
    memory = HeteroAssociativeMemory(37, 3, 2, storage=storage, beta=0.4, when_full="grow")
    codes, values = drawn(200, 5)
    for part in torch.arange(200).split([1, 1, 1, 70, 127]):
        put(memory, codes[part], values[part], origin=part)
    assert memory.capacity >= 200
    whole = HeteroAssociativeMemory(37, 3, 200, storage=storage, beta=0.4)
    put(whole, codes, values, origin=torch.arange(200))
    query = drawn(4, 6)[0]
    assert torch.equal(memory.recall(query), whole.recall(query))
    memory.remove(origin=torch.arange(150, 200))
    whole.remove(torch.arange(150, 200))
    assert torch.equal(memory.recall(query), whole.recall(query))


@pytest.mark.parametrize("storage", STORAGES)
def test_a_checkpoint_brings_its_capacity(storage):
    memory = HeteroAssociativeMemory(37, 3, 80, storage=storage, beta=0.4)
    put(memory, *drawn(75, 0), origin=3)
    query = drawn(4, 6)[0]
    for capacity in (5, 80, 300):
        other = HeteroAssociativeMemory(37, 3, capacity, storage=storage)
        other.load_state_dict(memory.state_dict())
        assert other.capacity == 80
        assert_same(other, memory)
        assert torch.equal(other.recall(query), memory.recall(query))
    old = {name: tensor for name, tensor in memory.state_dict().items() if name != "origins"}
    other.load_state_dict(old)
    assert (other.origins == -1).all()
    assert torch.equal(other.recall(query), memory.recall(query))


def test_what_cannot_grow_says_so():
    with pytest.raises(ValueError, match="capacity of at least 5"):
        HeteroAssociativeMemory(4, 1, 5).grow(4)
    learned = HeteroAssociativeMemory(4, 1, 5, learn_patterns=True)
    with pytest.raises(ValueError, match="learned"):
        learned.grow(9)
    with pytest.raises(RuntimeError, match="size mismatch"):
        learned.load_state_dict(HeteroAssociativeMemory(4, 1, 6).state_dict())
