"""The paper's formulas in float64 NumPy, to test the library against.

Written from the paper alone and for reading: loops and dense matrices, one sample at a time, none
of the library's shortcuts.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def place_levels(
    q: ArrayLike, lower: ArrayLike, upper: ArrayLike, neurons: int, bits: int, width: float,
    code: str,
) -> NDArray[np.int64]:  # fmt: skip
    """Quantised rates of the place neurons of one joint state (J,) -> (J * neurons,)."""
    levels = []
    for phi, low, high in zip(np.asarray(q), np.asarray(lower), np.asarray(upper), strict=True):
        preferred = np.linspace(low, high, neurons)
        sigma = width * (preferred[1] - preferred[0])
        phi = min(max(phi, low), high)
        for phi_i in preferred:
            rate = math.exp(-((phi - phi_i) ** 2) / (2 * sigma**2))  # eq. tuning_curve
            if code == "thermometer":
                levels.append(round(rate * bits))
            else:
                levels.append(round(rate * 255) // 2 ** (8 - bits))
    return np.array(levels)


def place_bits(levels: ArrayLike, bits: int, code: str) -> Array:
    """Levels (M,) as bipolar bits (M * bits,)."""
    out = []
    for level in np.asarray(levels).tolist():
        if code == "thermometer":
            word = "1" * level + "0" * (bits - level)
        elif code == "gray":
            word = format(level ^ (level // 2), f"0{bits}b")
        else:
            word = format(level, f"0{bits}b")
        out += [1.0 if digit == "1" else -1.0 for digit in word]
    return np.array(out)


def effective_force(forces: ArrayLike, threshold: float, window: int) -> Array:
    """F_total of one patch: (T, cells, 3) -> (T,)."""
    forces = np.asarray(forces, dtype=np.float64)
    total = np.zeros(len(forces))
    for now in range(len(forces)):
        for then in range(max(0, now - window + 1), now + 1):
            for cell in forces[then]:
                total[now] += max(0.0, sum(abs(f) for f in cell) - threshold)
    return total


def tactile_embedding(rho: float, levels: ArrayLike, bits: int) -> Array:
    """F of one touch, expanded: levels (M,) -> (M * bits,)."""
    levels = np.asarray(levels)
    order = sorted(range(len(levels)), key=lambda i: (-levels[i], i))
    force = -np.ones(len(levels))
    force[order[: round(rho * len(levels))]] = 1.0
    return np.repeat(force, bits)


def closest_spikes(sample_times: ArrayLike, spike_times: ArrayLike, window: float) -> list[int]:
    """Index of the closest spike of each sample, -1 where none lies within the window."""
    spikes = np.asarray(spike_times, dtype=np.float64)
    pairs = []
    for time in np.asarray(sample_times, dtype=np.float64):
        distances = np.abs(spikes - time)
        near = len(spikes) > 0 and distances.min() <= window
        pairs.append(int(distances.argmin()) if near else -1)
    return pairs


def rodrigues(axis: ArrayLike, angle: float) -> Array:
    """R(n, angle) of a unit axis (eq. rope3d2)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew


def rope3d_matrix(dim: int, axis: ArrayLike, angle: float) -> Array:
    """The block-diagonal matrix of RoPE3D (eq. rope3d1) about one axis of any length."""
    axis = np.asarray(axis, dtype=np.float64)
    matrix = np.eye(dim)
    for i in range(1, dim // 3 + 1):
        omega = 10 ** (-i / dim)
        block = slice(3 * (i - 1), 3 * i)
        matrix[block, block] = rodrigues(axis / np.linalg.norm(axis), omega * angle)
    return matrix


def rope3d_literal(q: ArrayLike, angle: float) -> Array:
    """RoPE3D with every block turned about itself, as the paper's sentence can be read."""
    q = np.asarray(q, dtype=np.float64)
    out = q.copy()
    for i in range(1, len(q) // 3 + 1):
        block = slice(3 * (i - 1), 3 * i)
        axis = q[block] / np.linalg.norm(q[block])
        out[block] = rodrigues(axis, 10 ** (-i / len(q)) * angle) @ q[block]
    return out


def link_rotation(rows: ArrayLike, q: ArrayLike) -> Array:
    """Rotation of a link in the base frame: the product of R_fixed · Rot(axis, m q[j] + o)."""
    whole = np.eye(3)
    for *entries, joint, multiplier, offset in np.asarray(rows, dtype=np.float64).reshape(-1, 15):
        angle = offset + (multiplier * np.asarray(q)[int(joint)] if joint >= 0 else 0.0)
        whole = whole @ np.reshape(entries[:9], (3, 3)) @ rodrigues(entries[9:], angle)
    return whole


def push(forces: ArrayLike, normals: ArrayLike, threshold: float, window: int) -> Array:
    """What a touch exerts on one patch, a mean over the window: (T, cells, 3) -> (T, 3)."""
    forces = np.asarray(forces, dtype=np.float64)
    total = np.zeros((len(forces), 3))
    for now in range(len(forces)):
        for then in range(max(0, now - window + 1), now + 1):
            for cell, normal in zip(forces[then], np.asarray(normals), strict=True):
                total[now] -= max(0.0, sum(abs(f) for f in cell) - threshold) * normal
    return total / window


def touch_code(
    rho: float, levels: ArrayLike, bits: int, key: ArrayLike, axis: ArrayLike, angle: float,
    mixing: ArrayLike,
) -> Array:  # fmt: skip
    """o = Q · RoPE3D(k ⊗ F; n, angle) of one touch; an axis of zero turns and mixes nothing."""
    touch = np.asarray(key) * tactile_embedding(rho, levels, bits)
    if not angle or not np.any(axis):
        return touch
    mixed = np.eye(len(touch))  # the last one or two entries stay
    for i, block in enumerate(np.asarray(mixing, dtype=np.float64)):
        mixed[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    return mixed @ rope3d_matrix(len(touch), axis, angle) @ touch


def linear_law(values: ArrayLike, x: ArrayLike, weights: ArrayLike, ridge: ArrayLike) -> Array:
    """C of the law d = C x with the least Σ w |d − C x|² + Σ λ_i |C_i|², (V, X).

    Values (K, V), covariates (K, X), weights (K,) and λ (X,), one a column C_i of C: a least
    squares problem with a row more a covariate.
    """
    values, x = np.asarray(values, dtype=np.float64), np.asarray(x, dtype=np.float64)
    root = np.sqrt(np.asarray(weights, dtype=np.float64))[:, None]
    rows = np.vstack([root * x, np.diag(np.sqrt(ridge))])
    wanted = np.vstack([root * values, np.zeros((len(ridge), values.shape[1]))])
    return np.linalg.lstsq(rows, wanted, rcond=None)[0].T


def izhikevich(
    current: ArrayLike, duration: float, step: float,
    a: float = 0.02, b: float = 0.2, c: float = -50.0, d: float = 0.5, v_th: float = 30.0,
) -> tuple[list[list[float]], Array, Array]:  # fmt: skip
    """Neurons under constant currents (N,), by Runge-Kutta steps with interpolated crossings.

    Returns:
        The spike times of each neuron in ms, and v and u at the end, (N,) each.
    """
    drive = np.asarray(current, dtype=np.float64)

    def derivative(y: Array) -> Array:
        v, u = y
        return np.stack([0.04 * v**2 + 5 * v + 140 - u + drive, a * (b * v - u)])

    y = np.stack([np.full(len(drive), -70.0), np.full(len(drive), -70.0 * b)])
    times: list[list[float]] = [[] for _ in drive]
    for k in range(round(duration / step)):
        k1 = derivative(y)
        k2 = derivative(y + step / 2 * k1)
        k3 = derivative(y + step / 2 * k2)
        k4 = derivative(y + step * k3)
        after = y + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        fired = after[0] >= v_th
        if fired.any():
            part = np.where(fired, (v_th - y[0]) / (after[0] - y[0]), 1.0)
            reset = np.stack([np.full_like(y[0], c), y[1] + part * (after[1] - y[1]) + d])
            reset += (1 - part) * step * derivative(reset)
            after = np.where(fired, reset, after)
            for neuron in np.flatnonzero(fired):
                times[neuron].append((k + part[neuron]) * step)
        y = after
    return times, y[0], y[1]


def softmax_recall(
    memory: ArrayLike, successors: ArrayLike, query: ArrayLike, beta: float
) -> Array:
    """d = S_-1 softmax(beta M^T q): memory (D, K), successors (J, K), query (D,) -> (J,)."""
    scores = beta * (np.asarray(memory).T @ np.asarray(query))
    weights = np.exp(scores - scores.max())
    return np.asarray(successors) @ (weights / weights.sum())
