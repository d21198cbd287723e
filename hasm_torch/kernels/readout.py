"""The first-order read-out of one query in a compiled pass; ``model.readout`` has the equation."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hasm_torch.kernels.compiling import compile_kernel

Array = NDArray[np.float64]


def first_order_of_one(recalled: Array, covariates: Array, ridge: Array) -> Array:
    """⟨d xᵀ⟩ (⟨x xᵀ⟩ + Λ)⁻¹ x.

    Args:
        recalled: (V·X + X·X,) ⟨d xᵀ⟩ and ⟨x xᵀ⟩, row by row.
        covariates: (X,).
        ridge: (X,) Λ.

    Returns:
        (V,).
    """
    count = len(ridge)
    values: Array = np.empty(len(recalled) // count - count)
    _compiled()(recalled, covariates, ridge, values)
    return values


@functools.cache
def _compiled() -> Callable[..., None]:
    """The pass, compiled on first use and then cached on disk."""

    def kernel(recalled: Any, covariates: Any, ridge: Any, values: Any) -> None:
        count, first = len(ridge), len(values) * len(ridge)
        lower = np.zeros((count, count))  # Cholesky factor of ⟨x xᵀ⟩ + Λ
        for i in range(count):
            for j in range(i + 1):
                total = recalled[first + i * count + j]
                if i == j:
                    total += ridge[i]
                for k in range(j):
                    total -= lower[i, k] * lower[j, k]
                lower[i, j] = np.sqrt(total) if i == j else total / lower[j, j]
        solved = covariates.copy()
        for i in range(count):
            for k in range(i):
                solved[i] -= lower[i, k] * solved[k]
            solved[i] /= lower[i, i]
        for back in range(count):
            i = count - 1 - back
            for k in range(i + 1, count):
                solved[i] -= lower[k, i] * solved[k]
            solved[i] /= lower[i, i]
        for v in range(len(values)):
            total = 0.0
            for k in range(count):
                total += recalled[v * count + k] * solved[k]
            values[v] = total

    return compile_kernel(kernel)
