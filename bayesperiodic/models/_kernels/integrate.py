"""The compiled code of `integrate`; loaded through the kernel cache, not imported."""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from bayesperiodic._compile.grid_function import grid_function_at

if TYPE_CHECKING:  # defined in this module by `integration.dense_kernels`
    from bayesperiodic.models._kernels.dense import solve

ARRAY_2D, ARRAY_1D = "float64[:,::1]", "float64[::1]"
OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


@njit(
    f"boolean(int64, {ARRAY_1D}, float64, {ARRAY_1D}, float64, int64[::1], {ARRAY_2D}, {ARRAY_2D}, "
    f"{ARRAY_2D}, {ARRAY_2D}, {ARRAY_2D}, {ARRAY_2D}, {ARRAY_1D})",
    **OPTIONS,
)
def slope(residual_jacobian, y, time, parameters, frequency, orders, states, row, columns, tau, highest, g, rate):
    """Fill ẏ; the equations are solved for the highest derivatives, in which they are linear."""
    count = orders.size
    extra = count
    for s in range(count):
        states[0, s], states[0, count + s], states[0, 2 * count + s] = y[s], 0.0, 0.0
        if orders[s] == 2:
            states[0, count + s] = y[extra]
            extra += 1
    tau[0, 0] = time
    grid_function_at(residual_jacobian)(states, row, parameters, tau[0], frequency, columns)
    for e in range(count):
        g[e, 0] = -columns[0, e]
        for s in range(count):
            highest[e, s] = columns[0, count + e * 3 * count + orders[s] * count + s]
    if not solve(highest, g):
        return False
    extra = count
    for s in range(count):
        rate[s] = g[s, 0]
        if orders[s] == 2:
            rate[s], rate[extra] = y[extra], g[s, 0]
            extra += 1
    return True


@njit(f"boolean(int64, {ARRAY_1D}, {ARRAY_2D}, int64, {ARRAY_1D}, float64, int64[::1], int64, {ARRAY_2D})", **OPTIONS)
def runge_kutta(residual_jacobian, start, inputs, samples, parameters, frequency, orders, steps, path):
    """Fill `path` (kept, size) with the states before the last of the steps; see `periodic.solve.integrate`.

    Return False if the states overflow or the equations cannot be solved for the highest derivatives.
    """
    size, count = start.size, orders.size
    states, row = np.empty((1, 3 * count)), np.empty((1, inputs.shape[1]))
    columns, tau = np.empty((1, count * (1 + 3 * count))), np.empty((1, 1))
    highest, g = np.empty((count, count)), np.empty((count, 1))
    y, trial, rates = start.copy(), np.empty(size), np.empty((4, size))
    step = 1.0 / (samples * frequency)
    first = steps - path.shape[0]
    for k in range(steps):
        if k >= first:
            for i in range(size):
                path[k - first, i] = y[i]
        for stage in range(4):
            half = 2 * k + (stage + 1) // 2
            for i in range(size):
                trial[i] = y[i]
                if stage > 0:
                    trial[i] += step * (1.0 if stage == 3 else 0.5) * rates[stage - 1, i]
            for u in range(inputs.shape[1]):
                row[0, u] = inputs[half % inputs.shape[0], u]
            time = 0.5 * half / samples
            if not slope(
                residual_jacobian, trial, time, parameters, frequency, orders, states, row, columns, tau, highest, g,
                rates[stage],
            ):  # fmt: skip
                return False
        for i in range(size):
            y[i] += step / 6.0 * (rates[0, i] + 2.0 * rates[1, i] + 2.0 * rates[2, i] + rates[3, i])
            if not abs(y[i]) < 1e100:
                return False
    return True


@njit(f"void(complex128[:,::1], float64, {ARRAY_2D})", **OPTIONS)
def fill_inputs(amplitudes, time, row):
    """Fill u, u̇, ü (1, 3·inputs) at a time in forcing periods, from amplitudes (harmonics, 3·inputs)."""
    if row.size == 0:
        return
    turn = np.exp(2j * np.pi * (time - np.floor(time)))
    wave = 1.0 + 0.0j
    row[0, :] = 0.0
    for h in range(amplitudes.shape[0]):
        for u in range(amplitudes.shape[1]):
            row[0, u] += (amplitudes[h, u] * wave).real
        wave *= turn


@njit(
    f"int64(int64, complex128[:,::1], {ARRAY_1D}, float64, int64[::1], {ARRAY_1D}, {ARRAY_2D}, {ARRAY_2D}, "
    f"{ARRAY_1D}, {ARRAY_2D}, {ARRAY_1D}, {ARRAY_1D}, int64)",
    **OPTIONS,
)
def dormand_prince(
    residual_jacobian, amplitudes, parameters, frequency, orders, time, path, a, c, errors, absolute, relative, trials
):  # fmt: skip
    """Fill `path` (times, size) from its first row by the Runge-Kutta method of order 8; return the number of rows.

    The amplitudes (harmonics, 3·inputs) are those of u, u̇, ü, from harmonic 0 on; `time` is in forcing periods. The
    last row of `a` (stages + 1, stages) contains the weights of a step, `errors` (2, stages + 1) those of the error
    estimates of orders 5 and 3, `trials` limits the steps between two output times.
    """
    size, count, stages = path.shape[1], orders.size, c.size - 1
    states, row = np.empty((1, 3 * count)), np.empty((1, amplitudes.shape[1]))
    columns, tau = np.empty((1, count * (1 + 3 * count))), np.empty((1, 1))
    highest, g = np.empty((count, count)), np.empty((count, 1))
    y, trial, rates = path[0].copy(), np.empty(size), np.empty((stages + 1, size))
    step = 1e-3
    fill_inputs(amplitudes, time[0], row)
    if not slope(
        residual_jacobian, y, time[0], parameters, frequency, orders, states, row, columns, tau, highest, g, rates[0]
    ):
        return 1
    for k in range(1, time.size):
        now, left = time[k - 1], trials
        while now < time[k]:
            left -= 1
            remaining = time[k] - now
            # A last step that would be tiny is avoided by halving the one before.
            used = remaining if remaining <= step else min(step, max(0.5 * remaining, 0.5 * step))
            if left < 0 or not used > 1e-15 * max(1.0, now):
                return k
            finite = True
            for stage in range(1, stages + 1):
                for i in range(size):
                    total = 0.0
                    for j in range(stage):
                        total += a[stage, j] * rates[j, i]
                    trial[i] = y[i] + used / frequency * total
                at = now + c[stage] * used
                fill_inputs(amplitudes, at, row)
                if not slope(
                    residual_jacobian, trial, at, parameters, frequency, orders, states, row, columns, tau, highest, g,
                    rates[stage],
                ):  # fmt: skip
                    finite = False
                    break
            high, low = 0.0, 0.0
            for i in range(size if finite else 0):
                scale = absolute[i] + relative[i] * max(abs(y[i]), abs(trial[i]))
                fifth, third = 0.0, 0.0
                for j in range(stages + 1):
                    fifth += errors[0, j] * rates[j, i]
                    third += errors[1, j] * rates[j, i]
                high += (fifth / scale) ** 2
                low += (third / scale) ** 2
            error = 0.0
            if high > 0.0 or low > 0.0:
                error = used / frequency * high / np.sqrt((high + 0.01 * low) * size)
            if finite and error <= 1.0:
                now = time[k] if used == remaining else now + used
                for i in range(size):
                    y[i], rates[0, i] = trial[i], rates[stages, i]
                # A step shortened by an output time does not reduce the next one.
                growth = 10.0 if error == 0.0 else min(10.0, 0.9 * error ** (-0.125))
                step = max(step, used * growth) if used < step and growth >= 1.0 else used * growth
            elif finite and error < np.inf:
                step = used * max(0.2, 0.9 * error ** (-0.125))
            else:
                step = 0.2 * used
        for i in range(size):
            path[k, i] = y[i]
    return time.size
