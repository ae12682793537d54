"""The compiled code of `integrate`; loaded through the kernel cache, not imported."""

import numpy as np
from numba import njit

from bayesperiodic.models.compile import GRID_SIGNATURE

MATRIX, VECTOR = "float64[:,::1]", "float64[::1]"
FUNCTION = f"FunctionType({GRID_SIGNATURE})"
OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}


@njit(
    f"boolean({FUNCTION}, {VECTOR}, {MATRIX}, int64, float64, {VECTOR}, float64, int64[::1], {MATRIX}, {MATRIX}, "
    f"{MATRIX}, {MATRIX}, {VECTOR})",
    **OPTIONS,
)
def slope(
    residual_jacobian, y, inputs, index, time, parameters, frequency, orders, states, row, columns, tau, rate
):  # fmt: skip
    """Fill ẏ; the equations are solved for the highest derivatives, in which they are linear."""
    count = orders.size
    extra = count
    for s in range(count):
        states[0, s], states[0, count + s], states[0, 2 * count + s] = y[s], 0.0, 0.0
        if orders[s] == 2:
            states[0, count + s] = y[extra]
            extra += 1
    for u in range(inputs.shape[1]):
        row[0, u] = inputs[index % inputs.shape[0], u]
    tau[0, 0] = time
    residual_jacobian(states, row, parameters, tau[0], frequency, columns)
    g = np.empty(count)
    highest = np.empty((count, count))
    for e in range(count):
        g[e] = -columns[0, e]
        for s in range(count):
            highest[e, s] = columns[0, count + e * 3 * count + orders[s] * count + s]
    for j in range(count):
        pivot = j
        for e in range(j + 1, count):
            if abs(highest[e, j]) > abs(highest[pivot, j]):
                pivot = e
        if not (abs(highest[pivot, j]) > 0.0 and abs(highest[pivot, j]) < np.inf):
            return False
        if pivot != j:
            g[pivot], g[j] = g[j], g[pivot]
            for s in range(count):
                highest[pivot, s], highest[j, s] = highest[j, s], highest[pivot, s]
        for e in range(j + 1, count):
            multiplier = highest[e, j] / highest[j, j]
            g[e] -= multiplier * g[j]
            for s in range(j + 1, count):
                highest[e, s] -= multiplier * highest[j, s]
    for j in range(count - 1, -1, -1):
        for s in range(j + 1, count):
            g[j] -= highest[j, s] * g[s]
        g[j] /= highest[j, j]
    extra = count
    for s in range(count):
        rate[s] = g[s]
        if orders[s] == 2:
            rate[s], rate[extra] = y[extra], g[s]
            extra += 1
    return True


@njit(f"boolean({FUNCTION}, {VECTOR}, {MATRIX}, int64, {VECTOR}, float64, int64[::1], int64, {MATRIX})", **OPTIONS)
def runge_kutta(residual_jacobian, start, inputs, samples, parameters, frequency, orders, steps, path):
    """Take fixed steps of the classical fourth-order method and fill `path` with the states before the last steps.

    Parameters
    ----------
    start : array (size,)
        The states, then the rates of the second-order ones.
    inputs : array (2·samples·periods, 3·inputs)
        u, u̇, ü at half steps; repeated.
    samples : int
        Steps per forcing period.
    steps : int
    path : array (kept, size)

    Returns
    -------
    bool
        False if the states grew beyond all bounds or the equations cannot be solved for the highest derivatives.
    """
    size, count = start.size, orders.size
    states, row = np.empty((1, 3 * count)), np.empty((1, inputs.shape[1]))
    columns, tau = np.empty((1, count * (1 + 3 * count))), np.empty((1, 1))
    y, trial, rates = start.copy(), np.empty(size), np.empty((4, size))
    step = 1.0 / (samples * frequency)
    first = steps - path.shape[0]
    for k in range(steps):
        if k >= first:
            path[k - first] = y
        for stage in range(4):
            half = 2 * k + (stage + 1) // 2
            for i in range(size):
                trial[i] = y[i]
                if stage > 0:
                    trial[i] += step * (1.0 if stage == 3 else 0.5) * rates[stage - 1, i]
            time = 0.5 * half / samples
            if not slope(
                residual_jacobian, trial, inputs, half, time, parameters, frequency, orders, states, row, columns,
                tau, rates[stage],
            ):  # fmt: skip
                return False
        for i in range(size):
            y[i] += step / 6.0 * (rates[0, i] + 2.0 * rates[1, i] + 2.0 * rates[2, i] + rates[3, i])
            if not abs(y[i]) < 1e100:
                return False
    return True
