import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.model.control import RECALLS_A_STEP, SPEED_SHARE, Walk, advance, limit_speed

LOWER, UPPER = np.array([-1.0, 0.0]), np.array([1.0, 4.0])
DENSITY = 0.5


class Line:
    """A memory of a walk through some places; joints 0 and 2 of three."""

    def __init__(self, places: list[list[float]], pace: float) -> None:
        self.coded, self.span = np.array([0, 2]), UPPER - LOWER
        self.places, self.pace, self.recalls = np.array(places), pace, 0

    def touch_level(self, density, held=None):
        return density

    def follow(self, positions, density, link=None, patch=None):
        self.recalls += 1
        nearest = int(np.abs(self.places - positions).sum(-1).argmin())
        return self.places[min(nearest + 1, len(self.places) - 1)], self.pace, np.ones(2, bool)


def steps(memory: Line, spikes: list[float]) -> torch.Tensor:
    reference, walk = np.array([*memory.places[0, :1], 7.0, *memory.places[0, 1:]]), Walk()
    seen = []
    for count in spikes:
        reference = advance(reference, walk, "patch", memory, count, DENSITY)
        seen.append(reference)
    return torch.tensor(np.stack(seen)).float()


def test_a_spike_moves_the_fastest_joint_by_one_over_the_pace():
    memory = Line([[-1.0, 0.0], [1.0, 1.0]], pace=40.0)  # joint 0 over its range, joint 2 a quarter
    seen = steps(memory, [1, 0, 3, 6])
    torch.testing.assert_close(seen[:, 0], -1.0 + 2.0 * torch.tensor([1, 1, 4, 10]) / 40)
    torch.testing.assert_close(seen[:, 2], 1.0 * torch.tensor([1, 1, 4, 10]) / 40)
    assert (seen[:, 1] == 7.0).all()  # a joint that the memory does not code
    assert memory.recalls == 1  # the goal is kept until it is reached


@given(spikes=st.lists(st.integers(0, 4), min_size=1, max_size=12))
@settings(max_examples=30, deadline=None)
def test_the_way_depends_on_the_number_of_spikes_alone(spikes):
    places = [[-1.0, 0.0], [-0.6, 0.1], [-0.2, 0.9], [0.1, 2.2], [0.5, 1.6], [0.9, 3.9]]
    together = steps(Line(places, 30.0), [1] * sum(spikes) or [0])[-1]
    apart = steps(Line(places, 30.0), spikes)[-1]
    torch.testing.assert_close(apart, together, rtol=0, atol=1e-5)


def test_the_end_of_a_walk_is_held():
    memory = Line([[0.0, 1.0], [0.1, 1.0]], pace=50.0)
    seen = steps(memory, [100, 100, 100])
    torch.testing.assert_close(seen, torch.tensor([0.1, 7.0, 1.0]).expand(3, 3))


def test_the_recalls_of_a_step_are_bounded():
    memory = Line([[-1.0 + 0.01 * i, 0.0] for i in range(100)], pace=1.0)
    first = steps(memory, [1000])[-1]
    assert memory.recalls == RECALLS_A_STEP
    assert first[0] == pytest.approx(-1.0 + 0.01 * RECALLS_A_STEP)


vectors = st.lists(st.floats(-10, 10, width=32), min_size=3, max_size=3).map(torch.tensor)


@given(before=vectors, after=vectors, period=st.sampled_from([0.01, 0.02, 0.1]))
@settings(max_examples=60, deadline=None)
def test_limit_speed_shortens_a_step_to_the_limits(before, after, period):
    max_speed = torch.tensor([0.5, 2.0, 30.0])
    arrays = (tensor.double().numpy() for tensor in (before, after, max_speed))
    limited = torch.from_numpy(limit_speed(*arrays, period)).float()
    allowed = SPEED_SHARE * max_speed * period
    wanted, moved = after - before, limited - before
    assert (moved.abs() <= allowed + 1e-5).all()
    if (wanted.abs() <= allowed).all():
        torch.testing.assert_close(limited, after, rtol=0, atol=2e-6)
    else:
        assert ((moved.abs() / allowed).max() - 1).abs() < 2e-2  # no shorter than need be
        # and it points where the step pointed
        share = (moved * wanted).sum() / (wanted * wanted).sum()
        torch.testing.assert_close(moved, share * wanted, rtol=0, atol=1e-5)
