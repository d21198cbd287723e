"""Recall that is fed its own decision walks through every stored state."""

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import limits, make_body, smooth_path

from hasm_torch.config import HASMConfig, MemoryShape
from hasm_torch.memory.successors import distinct_links
from hasm_torch.model.patch_memory import PatchMemory

BODY = make_body(4)
MOVED = [0, 2, 3]
SPAN = np.subtract(*limits(BODY)[::-1])[MOVED]
DENSITY = torch.tensor(0.4)
VARIANTS = [
    HASMConfig(),
    HASMConfig(storage="float32"),
    HASMConfig(storage="float32", rebinarise=False),
    HASMConfig(bits=8, code="gray", resolution=1),
]


class Stored:
    """The memory of some episodes and the links that went into it."""

    def __init__(self, config: HASMConfig, paths: list[np.ndarray]) -> None:
        self.positions = torch.tensor(np.concatenate(paths)[:, MOVED], dtype=torch.float32)
        episodes = torch.tensor(np.repeat(np.arange(len(paths)), [len(path) for path in paths]))
        probe = PatchMemory(config, BODY, 0, MemoryShape(MOVED, 1, 0))
        codes = probe.place_code(self.positions)
        links = distinct_links(codes, episodes, config.resolution)
        self.state, self.successor = links.state.tolist(), links.successor.tolist()
        self.memory = PatchMemory(config, BODY, 0, MemoryShape(MOVED, len(self.state), 0))
        density = DENSITY.expand(len(self.state))
        pace = torch.arange(1.0, len(self.state) + 1)
        self.memory.write(
            self.positions[links.state], density, self.positions[links.successor], pace
        )
        self.memory.memory.beta.fill_(self.memory.memory.crowding().beta)
        self.codes = codes
        self.starts = np.searchsorted(episodes, np.arange(len(paths))).tolist()

    def nearest(self, sample: int) -> int:
        """The stored state whose code is most like that of a sample."""
        differing = (self.codes[self.state] != self.codes[sample]).sum(-1)
        return self.state[int(differing.argmin())]

    def walk(self, start: torch.Tensor, steps: int) -> torch.Tensor:
        """What recall decides when it is fed its own decisions, (steps, J)."""
        here, seen = start, []
        for _ in range(steps):
            here, _ = self.memory(here, DENSITY)
            seen.append(here)
        return torch.stack(seen)


def loops(seed: int, samples: int) -> np.ndarray:
    """A path that may cross itself and come back."""
    path = smooth_path(BODY, samples, seed, [1, *MOVED])
    path[:, 1] = 0.0
    return path


@pytest.mark.parametrize("config", VARIANTS, ids=["bit", "float32", "real", "gray"])
@pytest.mark.parametrize("seed", range(2))
def test_recall_visits_every_stored_state_in_order(config, seed):
    stored = Stored(config, [smooth_path(BODY, 700, seed, MOVED)])
    count = len(stored.state)
    assert count > 100
    seen = stored.walk(stored.positions[0], count + 5)
    expected = stored.positions[stored.state]
    torch.testing.assert_close(seen[: count - 1], expected[1:], rtol=0, atol=1e-5)
    torch.testing.assert_close(seen[count - 1 :], expected[-1:].expand(6, -1), rtol=0, atol=1e-5)


@given(seed=st.integers(0, 10_000), episodes=st.integers(1, 4), bit=st.booleans())
@settings(max_examples=8, deadline=None)
def test_recall_follows_the_links_of_episodes_that_cross_and_return(seed, episodes, bit):
    config = HASMConfig(storage="bit" if bit else "float32")
    stored = Stored(config, [loops(seed + i, 120) for i in range(episodes)])
    links = dict(zip(stored.state, stored.successor))
    # every stored state recalls the one that followed it ...
    recalled, pace = stored.memory(stored.positions[stored.state], DENSITY.expand(len(links)))
    torch.testing.assert_close(recalled, stored.positions[stored.successor], rtol=0, atol=1e-5)
    np.testing.assert_allclose(pace, np.arange(1, len(links) + 1), rtol=1e-4)
    # ... so that a walk from the start of an episode comes by all that follow and ends
    for start in stored.starts:
        here = stored.nearest(start)
        expected = []
        for _ in range(len(links)):
            here = links[here]
            expected.append(here)
        seen = stored.walk(stored.positions[start], len(links))
        torch.testing.assert_close(seen, stored.positions[expected], rtol=0, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_a_start_beside_the_walk_leads_to_its_end(seed):
    stored = Stored(HASMConfig(), [smooth_path(BODY, 500, seed, MOVED)])
    rng = np.random.default_rng(seed)
    sample = int(rng.integers(0, 250))
    noise = torch.tensor(rng.uniform(-0.03, 0.03, len(MOVED)) * SPAN, dtype=torch.float32)
    count = len(stored.state)
    seen = stored.walk(stored.positions[sample] + noise, count)
    end = stored.positions[stored.state[-1]]
    torch.testing.assert_close(seen[-1], end, rtol=0, atol=1e-5)
    # all stored states that come well after the start are on the way
    later = stored.positions[[s for s in stored.state if s >= sample + 50]]
    gap = torch.cdist(later / torch.tensor(SPAN), seen.double() / torch.tensor(SPAN)).amin(1)
    assert len(later) > 50
    assert gap.max() < 1e-3


def test_a_small_beta_would_not_walk():
    stored = Stored(HASMConfig(), [smooth_path(BODY, 700, 0, MOVED)])
    stored.memory.memory.beta.fill_(0.01)
    seen = stored.walk(stored.positions[0], len(stored.state))
    assert (seen[-1] - stored.positions[stored.state[-1]]).abs().max() > 0.1


def test_codes_have_the_papers_length_and_depend_on_the_touch():
    config = HASMConfig(neurons=7, bits=5)
    memory = PatchMemory(config, BODY, 0, MemoryShape(MOVED, 1, 0))
    state, touch = memory.codes(torch.zeros(2, 3, len(MOVED)), torch.rand(2, 3))
    assert state.shape == touch.shape == (2, 3, 5 * 7 * len(MOVED))
    soft = memory.codes(torch.zeros(len(MOVED)), torch.tensor(0.1))[1]
    hard = memory.codes(torch.zeros(len(MOVED)), torch.tensor(0.9))[1]
    assert (soft != hard).any()


@given(
    q=st.lists(st.floats(-3, 3, width=32), min_size=2, max_size=2),
    density=st.floats(0, 1, width=32),
    direction=st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda d: max(d) > 0.1),
    size=st.sampled_from([(10, 16, "thermometer"), (7, 4, "binary"), (5, 5, "gray")]),
    ranks=st.sampled_from(["all", "joint"]),
)
@settings(max_examples=40, deadline=None)
def test_codes_are_the_papers(q, density, direction, size, ranks):
    neurons, bits, code = size
    body = make_body(4)
    body.directions[1] = direction
    pair = [0, 3]  # code lengths that three does not divide
    lower, upper = (limit[pair] for limit in limits(body))
    config = HASMConfig(neurons=neurons, bits=bits, code=code, ranks=ranks, rebinarise=False)
    shape = MemoryShape(pair, 1, 0)
    state, touch = PatchMemory(config, body, 1, shape).codes(torch.tensor(q), torch.tensor(density))

    levels = reference.place_levels(q, lower, upper, neurons, bits, 1.0, code)
    np.testing.assert_array_equal(state, reference.place_bits(levels, bits, code))
    ranked = np.split(levels, 1 if ranks == "all" else len(pair))
    plain = np.concatenate([reference.tactile_embedding(density, part, bits) for part in ranked])
    axis = np.cross([0.0, 0.0, 1.0], direction)  # the smallest turn from z to the normal
    angle = np.arctan2(np.linalg.norm(axis), direction[2])
    expected = plain
    if np.linalg.norm(axis) > 1e-3 * np.linalg.norm(direction):
        expected = reference.rope3d_matrix(len(plain), axis, angle) @ plain
        np.testing.assert_allclose(touch, expected, atol=1e-4)

    config = HASMConfig(neurons=neurons, bits=bits, code=code, ranks=ranks)
    signs = PatchMemory(config, body, 1, shape).codes(torch.tensor(q), torch.tensor(density))[1]
    clear = np.abs(expected) > 1e-3
    np.testing.assert_array_equal(signs.numpy()[clear], np.sign(expected)[clear])


def test_a_query_is_moved_to_the_nearest_touch_level():
    memory = PatchMemory(HASMConfig(), BODY, 0, MemoryShape(MOVED, 1, 3))
    memory.touch_levels.copy_(torch.tensor([0.2, 0.5, 0.8]))
    positions = torch.zeros(len(MOVED))

    def touch(density: float) -> torch.Tensor:
        return memory.codes(positions, torch.tensor(density))[1]

    assert torch.equal(touch(0.0), touch(0.2))
    assert torch.equal(touch(0.34), touch(0.2))
    assert torch.equal(touch(0.36), touch(0.5))
    assert torch.equal(touch(1.0), touch(0.8))
    assert not torch.equal(touch(0.2), touch(0.5))


def test_patches_turn_the_same_touch_differently():
    shape = MemoryShape(MOVED, 1, 0)
    codes = [
        PatchMemory(HASMConfig(), BODY, patch, shape).codes(torch.zeros(len(MOVED)), DENSITY)[1]
        for patch in range(3)
    ]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert (codes[a] != codes[b]).any()


def test_weights_say_what_is_recalled():
    stored = Stored(HASMConfig(), [smooth_path(BODY, 300, 1, MOVED)])
    rows = stored.positions[stored.state]
    weights = stored.memory.weights(rows, DENSITY.expand(len(rows)))
    assert weights.shape == (len(rows), len(rows))
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(rows)))
    assert weights.argmax(-1).tolist() == list(range(len(rows)))


SHARED = MemoryShape(MOVED, 1, 3, list(BODY.patches))


@pytest.mark.parametrize("rebinarise", [True, False])
def test_both_ways_to_code_a_shared_memorys_query_agree(rebinarise):
    memory = PatchMemory(HASMConfig(rebinarise=rebinarise), BODY, 0, SHARED)
    memory.touch_levels.copy_(torch.tensor([0.2, 0.5, 0.8]))
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(40, len(MOVED), generator=generator)
    density = memory.touch_levels[torch.randint(3, (40,), generator=generator)]
    for patch in BODY.patches:
        fast = memory.codes(positions, density, None, patch)
        slow = memory.codes(positions.double(), density, None, patch)
        for one, other in zip(fast, slow):
            # Where a turned block is within rounding of zero its sign is open.
            assert (one.double() - other).abs().gt(1e-4).double().mean() < 1e-3


def test_touches_of_a_shared_memory_differ_by_the_angle_between_them():
    """Neighbours match less than the same touch, opposite ones less again, levels not at all."""
    memory = PatchMemory(HASMConfig(), BODY, 0, SHARED)
    memory.touch_levels.copy_(torch.tensor([0.2, 0.5, 0.8]))
    generator = torch.Generator().manual_seed(1)
    positions = torch.rand(50, len(MOVED), generator=generator)

    def touch(patch: str, level: float) -> torch.Tensor:
        return memory.codes(positions, torch.tensor(level).expand(50), None, patch)[1]

    def match(a: torch.Tensor, b: torch.Tensor) -> float:
        return float((a * b).mean())

    front = touch("front", 0.5)  # +x; side is +y, back is -x
    assert match(front, touch("front", 0.5)) == 1.0
    assert 0.0 < match(front, touch("side", 0.5)) < 0.75
    assert match(front, touch("back", 0.5)) < match(front, touch("side", 0.5))
    assert abs(match(front, touch("front", 0.8))) < 0.2


def test_without_rope3d_a_shared_memory_cannot_tell_patches_apart():
    memory = PatchMemory(HASMConfig(rope=False), BODY, 0, SHARED)
    positions, density = torch.rand(20, len(MOVED)), torch.full((20,), 0.5)
    first, *others = (memory.codes(positions, density, None, patch)[1] for patch in BODY.patches)
    assert all(torch.equal(first, other) for other in others)
