"""The examples do what they show."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

PATH = Path(__file__).parent.parent / "examples" / "train_in_network.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("train_in_network", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the matrices are small
    yield module
    torch.set_num_threads(threads)
    del sys.modules[spec.name]


def test_what_follows_a_known_pair_is_what_followed_it_before(example):
    state, touch, known = example.Walks(example.Options(), seed=3).draw()
    for walk in range(len(state)):
        seen: dict[tuple[int, int], int] = {}
        for step in range(touch.shape[1]):
            pair = (int(state[walk, step]), int(touch[walk, step]))
            assert bool(known[walk, step]) == (pair in seen)
            assert seen.setdefault(pair, int(state[walk, step + 1])) == state[walk, step + 1]


def test_nothing_after_a_step_reaches_its_prediction(example):
    options = example.Options()
    state, touch, _ = example.Walks(options, seed=0).draw()
    for with_memory in (True, False):
        torch.manual_seed(0)
        network = example.Predictor(options, with_memory)
        changed_state, changed_touch = state.clone(), touch.clone()
        changed_state[:, 11:] = (state[:, 11:] + 1) % options.states
        changed_touch[:, 11:] = 1 - touch[:, 11:]
        before, after = network(state, touch), network(changed_state, changed_touch)
        torch.testing.assert_close(before[:, :10], after[:, :10])
        assert not torch.allclose(before[:, 10:], after[:, 10:])


def test_the_memory_wins_against_more_parameters(example):
    options = example.Options(steps=60)
    with_memory, share = example.train(options, True, seed=0)
    without, share_without = example.train(options, False, seed=0)
    assert example.parameters(without) > 2 * example.parameters(with_memory)
    # some 12,000 predictions: guessing spreads by 0.003
    assert share > share_without + 0.5
    assert with_memory.beta.item() != pytest.approx(0.1)
