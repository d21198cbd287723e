"""The local linear law of a recall, against a least squares problem."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.kernels.readout import first_order_of_one
from hasm_torch.model.readout import (
    OBSERVATION_RIDGE,
    RIDGE,
    covariates_of,
    first_order,
    ridge_of,
    stored_values,
)

NO_RANGE = np.zeros((0, 2))


def units(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def recalled(values: np.ndarray, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """What a memory with some weights recalls of the stored rows."""
    return weights @ stored_values(values, x)


@given(count=st.integers(3, 20), joints=st.integers(1, 5), seed=st.integers(0, 9999))
@settings(max_examples=40, deadline=None)
def test_a_linear_law_is_recovered_whatever_the_weights(count, joints, seed):
    rng = np.random.default_rng(seed)
    law, pushes = rng.normal(size=(joints, 3)), units(rng, count)
    pushes[:3] = np.eye(3)  # all three directions were taught
    weights = rng.dirichlet(np.ones(count)) * 0.5 + 0.5 / count
    means = recalled(pushes @ law.T, pushes, weights)
    toward = units(rng, 1)[0]
    found = first_order(means, toward, np.full(3, 1e-12))
    np.testing.assert_allclose(found, law @ toward, rtol=1e-6, atol=1e-6)


@given(count=st.integers(1, 12), value=st.sampled_from(["displacement", "goal"]),
       observations=st.integers(0, 3), seed=st.integers(0, 9999))  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_any_values_give_the_weighted_ridge_regression(count, value, observations, seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, 4))
    weights = rng.dirichlet(np.ones(count))
    observed = np.tile([-2.0, 3.0], (observations, 1))
    seen = rng.uniform(-2, 3, size=(count + 1, observations))
    x = covariates_of(value, units(rng, count + 1), seen, observed)
    ridge = ridge_of(value, observations)
    assert x.shape == (count + 1, len(ridge))
    found = first_order(recalled(values, x[1:], weights), x[0], ridge)
    expected = reference.linear_law(values, x[1:], weights, ridge) @ x[0]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@given(seed=st.integers(0, 9999), weights=st.lists(st.floats(0.05, 1), min_size=8, max_size=8))
@settings(max_examples=30, deadline=None)
def test_a_course_moves_along_with_what_is_observed(seed, weights):
    """An affine law, in metres, within the thousandth part that the ridge costs."""
    rng = np.random.default_rng(seed)
    offset, slope = rng.normal(size=5), rng.normal(size=(5, 2))
    observed = np.array([[0.1, 0.5], [-0.3, 0.3]])
    seen = np.vstack([[[0.1, -0.3], [0.5, -0.3], [0.1, 0.3]], rng.uniform(-1, 1, (6, 2)) * 0.3])
    x = covariates_of("goal", np.zeros((9, 3)), seen, observed)
    assert (x[:3, 0] == 1).all()
    np.testing.assert_allclose(x[:3, 1:], [[-1, -1], [1, -1], [-1, 1]])
    values = offset + seen @ slope.T
    means = recalled(values[:8], x[:8], np.array(weights) / sum(weights))
    for ridge, near in ((np.array([0.0, 1e-12, 1e-12]), 1e-6), (ridge_of("goal", 2), 0.05)):
        np.testing.assert_allclose(first_order(means, x[8], ridge), values[8], rtol=0, atol=near)


def test_a_constant_is_not_shrunk():
    """Of a course that nothing observed changes the law is the mean."""
    x = covariates_of("goal", np.zeros((4, 3)), np.zeros((4, 0)), NO_RANGE)
    values = np.random.default_rng(0).normal(size=(4, 2))
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    ridge = ridge_of("goal", 0)
    np.testing.assert_allclose(
        first_order(recalled(values, x, weights), np.ones(1), ridge), weights @ values
    )
    assert ridge_of("goal", 2).tolist() == [0.0, OBSERVATION_RIDGE, OBSERVATION_RIDGE]
    assert ridge_of("displacement", 2).tolist() == [RIDGE] * 3


def test_what_was_never_pushed_moves_nothing():
    """Pushes along x alone say nothing of y; along x they are met within the ridge."""
    pushes = np.tile([1.0, 0.0, 0.0], (5, 1))
    means = recalled(np.full((5, 1), 2.0), pushes, np.full(5, 0.2))
    ridge = ridge_of("displacement", 0)
    toward = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    found = first_order(np.tile(means, (3, 1)), toward, ridge)[:, 0]
    np.testing.assert_allclose(found, [2 / (1 + RIDGE), 0.0, -2 / (1 + RIDGE)])


def test_leading_dimensions_are_independent():
    rng = np.random.default_rng(1)
    means = recalled(rng.normal(size=(9, 2)), units(rng, 9), rng.dirichlet(np.ones(9), 6))
    toward, ridge = units(rng, 6), ridge_of("displacement", 0)
    found = first_order(means.reshape(2, 3, -1), toward.reshape(2, 3, 3), ridge)
    assert found.shape == (2, 3, 2)
    for i in range(6):
        np.testing.assert_allclose(
            found[i // 3, i % 3], first_order(means[i], toward[i], ridge), rtol=1e-9
        )


@given(value=st.sampled_from(["displacement", "goal"]), observations=st.integers(0, 4),
       count=st.integers(1, 9), seed=st.integers(0, 9999))  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_the_compiled_law_of_one_recall_is_the_same(value, observations, count, seed):
    rng = np.random.default_rng(seed)
    seen = rng.uniform(-1, 1, size=(count, observations))
    x = covariates_of(value, units(rng, count), seen, np.tile([-1.0, 1.0], (observations, 1)))
    ridge = ridge_of(value, observations)
    means = recalled(rng.normal(size=(count, 5)), x, rng.dirichlet(np.ones(count)))
    now, before = x[0].copy(), means.copy()
    found = first_order_of_one(means, now, ridge)
    np.testing.assert_allclose(found, first_order(means, now, ridge), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(means, before)  # what is recalled is left alone


def test_a_direction_is_its_own_covariates():
    toward = units(np.random.default_rng(2), 4)
    assert covariates_of("displacement", toward, np.ones((4, 2)), NO_RANGE) is toward
    with pytest.raises(np.linalg.LinAlgError):  # without a ridge, three directions are needed
        first_order(recalled(toward[:1], toward[:1] * 0, np.ones(1)), toward[0], np.zeros(3))
