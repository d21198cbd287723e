"""What the weights of a recall make of the stored values: their mean, or a local linear law.

With w the weights of the recall, ⟨·⟩ their mean over the stored associations, d a stored value and
x its covariates,

    mean          ⟨d⟩
    first order   ⟨d xᵀ⟩ (⟨x xᵀ⟩ + Λ)⁻¹ x,

the value at the present covariates x of the linear law d = C x that fits the recalled associations
best, Λ being a small ridge. Of a displacement the covariates are the direction of the force, x = f̂,
and C is the recalled local compliance; of a course they are (1, observation), so that its points
move along with what is observed. Both read-outs are means over the weights of one stored row, so a
single recall gives them.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Ridge on the covariates, which have length 1 (a direction) or lie within ±1 (an observation).
# Smaller is noisier where few directions were taught, larger shrinks the law: 0.01 loses 1 %.
RIDGE = 0.01
OBSERVATION_RIDGE = 0.001  # a goal must be met: 10 cm times 0.1 % is 0.1 mm


def ridge_of(value: str, observations: int) -> Array:
    """Λ, one entry a covariate.

    Args:
        value: "displacement", whose covariates are the direction of the force; else they are a
            constant, which is not shrunk, and the observations.
        observations: Number of their entries.

    Returns:
        (X,).
    """
    if value == "displacement":
        return np.full(3, RIDGE)
    return np.array([0.0] + [OBSERVATION_RIDGE] * observations)


def covariates_of(value: str, direction: Array, observation: Array, observed: Array) -> Array:
    """x, as ``ridge_of`` describes them.

    Args:
        value: What is recalled.
        direction: (..., 3) direction of the force.
        observation: (..., N) further observations.
        observed: (N, 2) range of each, which becomes ±1.

    Returns:
        (..., X).
    """
    if value == "displacement":
        return direction
    low, high = observed[:, 0], observed[:, 1]
    scaled = 2.0 * (observation - low) / (high - low) - 1.0
    return np.concatenate([np.ones((*scaled.shape[:-1], 1)), scaled], axis=-1)


def stored_values(values: Array, covariates: Array) -> Array:
    """Rows for the first-order read-out.

    Args:
        values: (K, V) what is to be recalled.
        covariates: (K, X).

    Returns:
        (K, V·X + X·X): d xᵀ and x xᵀ, row by row.
    """
    products = values[:, :, None] * covariates[:, None]
    squares = covariates[:, :, None] * covariates[:, None]
    count = len(values)
    return np.concatenate([products.reshape(count, -1), squares.reshape(count, -1)], axis=1)


def first_order(recalled: Array, covariates: Array, ridge: Array) -> Array:
    """The value that a recall means at some covariates.

    Args:
        recalled: (..., V·X + X·X) weighted mean of rows of ``stored_values``.
        covariates: (..., X) of the query.
        ridge: (X,) Λ.

    Returns:
        (..., V).
    """
    count = len(ridge)
    squares = recalled[..., -count * count :].reshape(*recalled.shape[:-1], count, count)
    products = recalled[..., : -count * count].reshape(*recalled.shape[:-1], -1, count)
    solved = np.linalg.solve(squares + np.diag(ridge), covariates[..., None])
    law: Array = (products @ solved)[..., 0]
    return law
