import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.memory.successors import distinct_links, shifted_links

ENTRIES = 12

# Walks over eight places; staying, coming back, joining an earlier walk and loops all occur.
walks = st.lists(st.lists(st.integers(0, 7), min_size=1, max_size=14), min_size=1, max_size=5)


def places(kind: str, seed: int) -> np.ndarray:
    """Codes of the eight places: unrelated ones, or neighbours two entries apart."""
    if kind == "line":
        return np.where(np.arange(ENTRIES) < 2 * np.arange(8)[:, None] - 2, 1.0, -1.0)
    return np.random.default_rng(seed).choice([-1.0, 1.0], (8, ENTRIES))


def code_walks(walks: list[list[int]], kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    codes = places(kind, seed)[np.concatenate(walks)]
    flips = np.random.default_rng(seed + 1).random(codes.shape) < 0.03  # a sensor's noise
    episodes = np.repeat(np.arange(len(walks)) % 3 + 5, [len(walk) for walk in walks])
    return np.where(flips, -codes, codes), episodes


def link(walks: list[str], resolution: int = 1):
    """Links of walks over letters, as "A>B" strings, sorted."""
    letters = sorted(set("".join(walks)))
    codes = np.array([[1.0 if a == b else -1.0 for b in letters] for a in "".join(walks)])
    episodes = np.repeat(np.arange(len(walks)), [len(walk) for walk in walks])
    links = distinct_links(torch.tensor(codes), torch.tensor(episodes), resolution)
    letter = "".join(walks)
    return sorted(f"{letter[a]}>{letter[b]}" for a, b in zip(links.state, links.successor))


def distance(codes: np.ndarray, a: int, b: int) -> int:
    return int((codes[a] != codes[b]).sum())


@given(walks=walks, kind=st.sampled_from(["line", "random"]), seed=st.integers(0, 99),
       resolution=st.integers(1, 5))  # fmt: skip
@settings(max_examples=150, deadline=None)
def test_links_hold_what_the_walks_did(walks, kind, seed, resolution):
    codes, episodes = code_walks(walks, kind, seed)
    links = distinct_links(torch.tensor(codes), torch.tensor(episodes), resolution)
    state, successor, left, entered = (column.tolist() for column in links)

    # the states are samples in order of time, and all of them differ
    assert state == sorted(set(state))
    for i, a in enumerate(state):
        assert all(distance(codes, a, b) >= resolution for b in state[:i])
    # and no sample differs from all of them
    for sample in range(len(codes)):
        assert any(distance(codes, sample, a) < resolution for a in state)

    for here, after, out, into in zip(state, successor, left, entered):
        assert after in state
        if here == after:
            assert out == into
            continue
        # no link is made up: the episode was at `here` from `out` on, and at `after` next
        assert out < into
        assert (episodes[out : into + 1] == episodes[out]).all()
        assert all(distance(codes, here, k) < resolution for k in range(out, into))
        assert distance(codes, after, into) < resolution

    # following the links passes through distinct states to one that is its own successor
    following = dict(zip(state, successor))
    for start in state:
        passed = [start]
        while following[passed[-1]] != passed[-1]:
            passed.append(following[passed[-1]])
            assert len(passed) <= len(state), "the links run in a circle"
        assert len(set(passed)) == len(passed)


@given(walk=st.lists(st.integers(0, 7), min_size=1, max_size=30))
@settings(max_examples=100, deadline=None)
def test_one_episode_leads_from_every_state_to_its_end(walk):
    codes = places("random", 4)[walk]
    links = distinct_links(torch.tensor(codes), torch.zeros(len(walk), dtype=torch.int64))
    following = dict(zip(links.state.tolist(), links.successor.tolist()))
    for state in following:
        for _ in following:
            state = following[state]
        assert walk[state] == walk[-1]


@pytest.mark.parametrize(
    ("walks", "expected"),
    [
        (["A"], ["A>A"]),
        (["AAABBC"], ["A>B", "B>C", "C>C"]),
        (["ABAC"], ["A>C", "B>A", "C>C"]),  # the last exit counts
        (["ABCA"], ["A>A", "B>C", "C>A"]),  # the walk ended in A for good
        (["ABC", "DBE"], ["A>B", "B>C", "C>C", "D>B", "E>E"]),  # a join redirects nothing
        (["AB", "BC"], ["A>B", "B>C", "C>C"]),  # an end that is continued
        (["AB", "BA"], ["A>B", "B>B"]),  # but not into a circle
        (["AB", "BCA"], ["A>B", "B>B", "C>A"]),  # nor into a longer one
    ],
)
def test_links_of_small_walks(walks, expected):
    assert link(walks) == expected


def test_equal_labels_of_neighbours_are_one_episode_and_others_are_not():
    codes = torch.tensor([[1.0, 1], [1, -1], [-1, -1], [-1, 1]])
    apart = distinct_links(codes, torch.tensor([0, 0, 1, 1]))
    assert apart.successor.tolist() == [1, 1, 3, 3]
    together = distinct_links(codes, torch.tensor([0, 0, 0, 0]))
    assert together.successor.tolist() == [1, 2, 3, 3]


def test_a_flickering_sample_does_not_leave_the_state():
    on = [0, 1, 2, 1, 2, 3, 4]  # entries that are +1, going up with a flicker
    codes = torch.tensor([[1.0 if i < n else -1.0 for i in range(8)] for n in on])
    links = distinct_links(codes, torch.zeros(7, dtype=torch.int64), resolution=2)
    assert [on[i] for i in links.state] == [0, 2, 4]
    assert links.successor.tolist() == [*links.state[1:].tolist(), links.state[-1].item()]


@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=5), horizon=st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_shifted_links_stay_in_their_episode(lengths, horizon):
    episodes = np.repeat(np.arange(len(lengths)) % 2, lengths)  # labels come again, apart
    if horizon > min(lengths):
        episodes = np.repeat(np.arange(len(lengths)), lengths)
    source, target = shifted_links(torch.tensor(episodes), horizon)
    expected = [
        (k, k + horizon)
        for k in range(len(episodes))
        if k + horizon < len(episodes) and episodes[k] == episodes[k + horizon]
    ]
    assert list(zip(source.tolist(), target.tolist())) == expected


def test_bad_arguments_are_named():
    codes, episodes = torch.ones(3, 4), torch.zeros(3, dtype=torch.int64)
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        shifted_links(episodes, 0)
    with pytest.raises(ValueError, match=r"episodes must be \(T,\)"):
        shifted_links(torch.zeros(3, 2))
    with pytest.raises(ValueError, match=r"codes \(T, D\) and episodes \(T,\)"):
        distinct_links(codes, episodes[:2])
    with pytest.raises(ValueError, match="resolution must be at least 1"):
        distinct_links(codes, episodes, 0)
    with pytest.raises(ValueError, match="no sample"):
        distinct_links(codes[:0], episodes[:0])
