"""Does the speed follow the force?"""

import numpy as np

from hasm_torch.evaluation.rollout import Array

SPEED_WINDOW = 0.1  # s over which the speed within a rollout is taken
LARGEST_LAG = 0.2  # s between force and speed


def tracking(force: Array, position: Array, period: float) -> float:
    """Correlation of force and speed at the best lag of the speed, 0 to 0.2 s.

    Args:
        force: (T,) N.
        position: (T,) rad.
        period: Time between rows, s.

    Returns:
        The correlation; NaN where force or speed does not change.
    """
    width = max(1, round(SPEED_WINDOW / period))
    kernel = np.ones(width) / width
    if len(force) < 4 * width:
        return float("nan")
    speed = np.convolve(np.diff(position) / period, kernel, mode="valid")
    smooth = np.convolve(force[1:], kernel, mode="valid")
    best = -1.0
    for lag in range(round(LARGEST_LAG / period) + 1):
        a, b = smooth[: len(smooth) - lag], speed[lag:]
        if np.ptp(a) < 1e-9 or np.ptp(b) < 1e-9:
            return float("nan")
        best = max(best, float(np.corrcoef(a, b)[0, 1]))
    return best


def spearman(x: Array, y: Array) -> float:
    """Rank correlation with mean ranks for ties; 0 where one side does not change."""
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(_ranks(np.asarray(x)), _ranks(np.asarray(y)))[0, 1])


def r_squared(x: Array, y: Array) -> float:
    """Share of the variance of y that a straight line through (x, y) explains."""
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1] ** 2)


def _ranks(values: Array) -> Array:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[inverse]
