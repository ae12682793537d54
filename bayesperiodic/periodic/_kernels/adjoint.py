"""The compiled code of gradients: transposed solves, and what they pull back to the parameters.

Loaded through the kernel cache together with the functions of `kernels` that it imports (see `compiled`).

The adjoint state λ of weights w on the outputs solves (∂g/∂z)ᵀ·λ = (∂ŷ/∂z)ᵀ·w; then Σ w·dŷ/dθ = Σ w·∂ŷ/∂θ − Σ λ·∂g/∂θ,
the implicit function theorem (de Kraker et al. 1997, eq. 4) read backwards.
"""

import numpy as np
from numba import njit

from bayesperiodic.models.code_generation import grid_function_at
from bayesperiodic.periodic._kernels.newton import (
    CUBE,
    FACTORS,
    FUNCTION,
    GRID,
    MATRIX,
    OPTIONS,
    PLACES,
    REACH,
    STATES,
    VECTOR,
    WIDTH,
    differentiate,
    factorise,
    largest,
    solve_transposed,
)


@njit(f"void({GRID}, {FACTORS}, {MATRIX})", **OPTIONS)
def back_substitute_transposed(grid, factors, right):
    """Solve (∂g/∂z)ᵀ·x = b in place, b (points, states), with the factors of `factorise`."""
    band, pivots, inverses, gains, transfer, ends, reduced, reduced_pivots = factors
    place, half_width, lead = grid[4], grid[5], grid[6]
    points, count = right.shape[0], STATES if STATES > 0 else right.shape[1]
    reach, segments = REACH if REACH > 0 else gains.shape[1], ends[0]
    if segments == 0:
        lower = half_width * count + count - 1
        folded = np.empty((1, points * count))
        for i in range(points):
            for s in range(count):
                folded[0, place[i] * count + s] = right[i, s]
        solve_transposed(band, lower, lower, pivots, folded)
        for i in range(points):
            for s in range(count):
                right[i, s] = folded[0, place[i] * count + s]
        return
    block = reach * count
    size = segments * block
    x = np.zeros((1, size))
    start = 0
    for q in range(segments):
        stop = ends[q + 1] + 1
        for c in range(block):
            total = 0.0
            for e in range(count):
                for j in range(start, stop):
                    total += transfer[e, c, j] * right[j, e]
            x[0, q * block + c] = total
        start = stop
    matrix = reduced[: size * (3 * size - 2)].reshape((size, 3 * size - 2))
    solve_transposed(matrix, size - 1, size - 1, reduced_pivots, x)
    forced = right.copy()
    for q in range(segments):
        for d in range(reach):
            for e in range(count):
                forced[ends[q + 1] - d, e] += x[0, (q + 1) % segments * block + d * count + e]
    start = 0
    for q in range(segments):
        stop = ends[q + 1] + 1
        for j in range(stop - 1, start, -1):
            for d in range(min(reach, j - start)):
                for s in range(count):
                    value = forced[j - 1 - d, s]
                    for e in range(count):
                        value += gains[j, d, e, s] * forced[j, e]
                    forced[j - 1 - d, s] = value
        start = stop
    for k in range(points):
        j = k + lead if k + lead < points else k + lead - points
        for s in range(count):
            value = 0.0
            for e in range(count):
                value += inverses[j, e, s] * forced[j, e]
            right[k, s] = value


@njit(f"void({MATRIX}, {MATRIX}, {MATRIX})", **OPTIONS)
def beside(states, others, both):
    """Fill `both` with the columns q, q̇, q̈ of `states`, then those of `others`."""
    first, second = 3 * STATES if STATES > 0 else states.shape[1], others.shape[1]
    one, other, out = states.reshape(states.size), others.reshape(others.size), both.reshape(both.size)
    for i in range(states.shape[0]):
        for s in range(first):
            out[np.uint64((first + second) * i + s)] = one[np.uint64(first * i + s)]
        for s in range(second):
            out[np.uint64((first + second) * i + first + s)] = other[np.uint64(second * i + s)]


@njit(
    f"boolean({FUNCTION}, {FUNCTION}, {FUNCTION}, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {MATRIX}, "
    f"{MATRIX}, Tuple(({MATRIX}, {MATRIX}, {MATRIX}, {VECTOR}, {MATRIX}, {MATRIX})), {FACTORS}, {VECTOR})",
    **OPTIONS,
)
def pull(
    residual_jacobian, outputs_vjp, equations_vjp, grid, inputs, parameters, tau, frequency, drift, z, weights,
    work, factors, gradient,
):  # fmt: skip
    """Fill Σ weights · ∂ŷ/∂θ (moving,) at a solution z; return False where ∂g/∂z is singular."""
    first, second, neighbours = grid[0], grid[1], grid[2]
    states, columns, weighed, slopes, adjoint, extended = work
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    squared, width = frequency**2, WIDTH if WIDTH > 0 else first.size
    differentiate(z, drift, grid, tau, frequency, states)
    residual_jacobian(states, inputs, parameters, tau, frequency, columns)
    amplitude = np.empty(count)
    largest(z, amplitude)
    for s in range(count):
        amplitude[s] = amplitude[s] if amplitude[s] > 0.0 else 1.0
    if not factorise(columns, grid, frequency, amplitude, factors):
        return False
    beside(states, weights, weighed)
    outputs_vjp(weighed, inputs, parameters, tau, frequency, slopes.reshape((1, slopes.size)))
    for i in range(points):
        for s in range(count):
            adjoint[i, s] = 0.0
    for i in range(points):
        for s in range(count):
            row = np.uint64(3 * count * i + s)
            rate = slopes[row + np.uint64(count)] * frequency
            acceleration = slopes[row + np.uint64(2 * count)] * squared
            if rate != 0.0 or acceleration != 0.0:
                for o in range(width):
                    adjoint[np.uint64(neighbours[i, o]), s] += first[o] * rate + second[o] * acceleration
            adjoint[i, s] += slopes[row]
    back_substitute_transposed(grid, factors, adjoint)
    beside(states, adjoint, extended)
    equations_vjp(extended, inputs, parameters, tau, frequency, gradient.reshape((1, gradient.size)))
    for p in range(gradient.size):
        gradient[p] += slopes[3 * count * points + p]
    return True


@njit(
    f"void({PLACES}, {GRID}, {CUBE}, {MATRIX}, {VECTOR}, {VECTOR}, {MATRIX}, {CUBE}, {CUBE}, "
    f"{FACTORS}, int64, int64, {MATRIX})",
    **OPTIONS,
)
def pull_many(
    functions, grid, inputs, parameters, tau, frequency, drift, z, weights, factors, start, stop, gradients
):  # fmt: skip
    """Fill the gradients (sets, moving) of the input sets start … stop at one solution each; NaN where singular.

    Parameters
    ----------
    functions : int array (3,)
        Addresses of the model's `residual_jacobian`, `outputs_vjp` and `equations_vjp`.
    inputs : array (sets, points, 3·inputs)
    parameters : array (sets, parameters)
    frequency : array (sets,)
    drift : array (sets, states)
    z : array (sets, points, states)
    weights : array (sets, points, channels)
    factors : work arrays, see `equations.empty_factors`
    """
    residual_jacobian, outputs_vjp = grid_function_at(functions[0]), grid_function_at(functions[1])
    equations_vjp = grid_function_at(functions[2])
    points, count, channels = z.shape[1], z.shape[2], weights.shape[2]
    work = (
        np.empty((points, 3 * count)), np.empty((points, count * (1 + 3 * count))),
        np.empty((points, 3 * count + channels)), np.empty(points * 3 * count + gradients.shape[1]),
        np.empty((points, count)), np.empty((points, 4 * count)),
    )  # fmt: skip
    for k in range(start, stop):
        regular = pull(
            residual_jacobian, outputs_vjp, equations_vjp, grid, inputs[k], parameters[k], tau, frequency[k],
            drift[k], z[k], weights[k], work, factors, gradients[k],
        )  # fmt: skip
        if not regular:
            for p in range(gradients.shape[1]):
                gradients[k, p] = np.nan
