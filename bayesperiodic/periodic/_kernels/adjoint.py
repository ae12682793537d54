"""Compiled vector-Jacobian products of driven orbits, by transposed solves.

The adjoint state λ of weights w on the outputs solves (∂g/∂z)ᵀ·λ = (∂ŷ/∂z)ᵀ·w; then Σ w·dŷ/dθ = Σ w·∂ŷ/∂θ − Σ λ·∂g/∂θ,
by the implicit function theorem (de Kraker et al. 1997, eq. 4).
"""

from typing import TYPE_CHECKING

import numpy as np
from numba import types

from bayesperiodic._compile.functions import as_vector, grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.batch import *


@kernel(types.void(GRID, FACTORS, MATRIX), **OPTIONS)
def back_substitute_transposed(grid, factors, right):
    """Solve (∂g/∂z)ᵀ·x = b in place, b (points, states), with the factors of `factorise`."""
    inverses, gains, transfer, ends, lead = factors.inverses, factors.gains, factors.transfer, factors.ends, grid.lead
    points, count = right.shape[0], STATES if STATES > 0 else right.shape[1]
    reach, segments = REACH if REACH > 0 else gains.shape[1], ends[0]
    if segments == 0:
        lower = grid.half_width * count + count - 1
        folded = np.empty((1, points * count))
        fold(right, grid, folded[0])
        solve_transposed(factors.band, lower, lower, factors.pivots, folded)
        unfold(folded[0], grid, right)
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
    matrix = factors.interface[: size * (3 * size - 2)].reshape((size, 3 * size - 2))
    solve_transposed(matrix, size - 1, size - 1, factors.interface_pivots, x)
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


@inlined(types.void(MATRIX, MATRIX, MATRIX), **INNER)
def concatenate(states, others, both):
    """Fill `both` with the columns of `states` (q, q̇, q̈), then those of `others`."""
    first, second = 3 * STATES if STATES > 0 else states.shape[1], others.shape[1]
    one, other, out = as_vector(states), as_vector(others), as_vector(both)
    for i in range(states.shape[0]):
        for s in range(first):
            out[np.uint64((first + second) * i + s)] = one[np.uint64(first * i + s)]
        for s in range(second):
            out[np.uint64((first + second) * i + first + s)] = other[np.uint64(second * i + s)]


@kernel(types.void(PLACES, GRID, SETS, MATRIX, CUBE, CUBE, FACTORS, COUNT, COUNT, MATRIX), **OPTIONS)
def vjp_many(addresses, grid, sets, parameters, z, weights, factors, start, stop, gradients):
    """Fill Σ weights · ∂ŷ/∂θ (sets, moving) of the input sets start … stop at one solution each; NaN where singular.

    `addresses` are those of the model's `residual_jacobian`, `outputs_vjp` and `equations_vjp`; `weights` is (sets,
    points, channels); the factors are work arrays.
    """
    residual_jacobian, outputs_vjp = grid_function_at(addresses[0]), grid_function_at(addresses[1])
    equations_vjp, tau = grid_function_at(addresses[2]), grid.tau
    points, count, channels = z.shape[1], STATES if STATES > 0 else z.shape[2], weights.shape[2]
    states, columns = np.empty((points, 3 * count)), np.empty((points, count * (1 + 3 * count)))
    weighed, slopes = np.empty((points, 3 * count + channels)), np.empty(points * 3 * count + gradients.shape[1])
    adjoint, extended, amplitude = np.empty((points, count)), np.empty((points, 4 * count)), np.empty(count)
    width = WIDTH if WIDTH > 0 else grid.first.size
    for k in range(start, stop):
        inputs, theta, frequency, gradient = sets.inputs[k], parameters[k], sets.frequency[k], gradients[k]
        squared = frequency**2
        differentiate(z[k], sets.drift[k], grid, frequency, states)
        residual_jacobian(states, inputs, theta, tau, frequency, columns)
        largest(z[k], amplitude)
        for s in range(count):
            amplitude[s] = amplitude[s] if amplitude[s] > 0.0 else 1.0
        if not factorise(columns, grid, frequency, amplitude, factors):
            for p in range(gradient.size):
                gradient[p] = np.nan
            continue
        concatenate(states, weights[k], weighed)
        outputs_vjp(weighed, inputs, theta, tau, frequency, slopes.reshape((1, slopes.size)))
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
                        weight = grid.first[o] * rate + grid.second[o] * acceleration
                        adjoint[np.uint64(grid.neighbours[i, o]), s] += weight
                adjoint[i, s] += slopes[row]
        back_substitute_transposed(grid, factors, adjoint)
        concatenate(states, adjoint, extended)
        equations_vjp(extended, inputs, theta, tau, frequency, gradient.reshape((1, gradient.size)))
        for p in range(gradient.size):
            gradient[p] += slopes[3 * count * points + p]
