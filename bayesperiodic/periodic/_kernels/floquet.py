"""The compiled code of `floquet`; loaded through the kernel cache, not imported."""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:  # defined in this module by `integration.dense_kernels`
    from bayesperiodic.models._kernels.dense import solve

STAGES = 3
ARRAY_2D, ARRAY_3D = "float64[:,::1]", "float64[:,:,::1]"
FLOQUET_OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}


@njit(f"void({ARRAY_3D}, {ARRAY_3D}, int64, float64, {ARRAY_2D}, float64[::1], {ARRAY_3D})", **FLOQUET_OPTIONS)
def transfer_matrices(matrix, weights, first, step, gauss, sums, result):
    """Fill the transfer matrices (points, size, size) from each grid point to the next; NaN where singular.

    `matrix` is A of ẏ = A y on the grid. The weights (parts, 3, width) interpolate it at the Gauss points of each part
    of a step, of length `step`, from the grid points `first`, first + 1, …; `gauss` (3, 3) and `sums` (3,) are the
    coefficients of the collocation.
    """
    points, size, _ = matrix.shape
    stages, slopes = np.empty((STAGES, size, size)), np.empty((STAGES * size, size))
    coupled, total, product = np.empty((STAGES * size, STAGES * size)), np.empty((size, size)), np.empty((size, size))
    for point in range(points):
        for p in range(size):
            for q in range(size):
                result[point, p, q] = 1.0 if p == q else 0.0
        for part in range(weights.shape[0]):
            stages[:] = 0.0
            for offset in range(weights.shape[2]):
                near = (point + first + offset) % points
                for stage in range(STAGES):
                    w = weights[part, stage, offset]
                    for p in range(size):
                        for q in range(size):
                            stages[stage, p, q] += w * matrix[near, p, q]
            for stage in range(STAGES):
                for p in range(size):
                    for q in range(size):
                        slopes[stage * size + p, q] = stages[stage, p, q]
                        for other in range(STAGES):
                            unit = 1.0 if stage == other and p == q else 0.0
                            coupled[stage * size + p, other * size + q] = (
                                unit - step * gauss[stage, other] * stages[stage, p, q]
                            )
            regular = solve(coupled, slopes)
            for p in range(size):
                for q in range(size):
                    total[p, q] = 1.0 if p == q else 0.0
                    for stage in range(STAGES):
                        total[p, q] += step * sums[stage] * slopes[stage * size + p, q]
                    if not regular:
                        total[p, q] = np.nan
            for p in range(size):
                for q in range(size):
                    product[p, q] = 0.0
                    for k in range(size):
                        product[p, q] += total[p, k] * result[point, k, q]
            for p in range(size):
                for q in range(size):
                    result[point, p, q] = product[p, q]


@njit(f"float64({ARRAY_3D}, float64)", **FLOQUET_OPTIONS)
def largest_condition(matrices, in_range):
    """Return the largest condition number, in Frobenius norms; infinite if a norm, or an inverse's, is not in range."""
    count, size, _ = matrices.shape
    work, inverse, result = np.empty((size, size)), np.empty((size, size)), 0.0
    for k in range(count):
        there, back = 0.0, 0.0
        for p in range(size):
            for q in range(size):
                work[p, q], inverse[p, q] = matrices[k, p, q], 1.0 if p == q else 0.0
                there += matrices[k, p, q] ** 2
        if not solve(work, inverse):
            return np.inf
        for p in range(size):
            for q in range(size):
                back += inverse[p, q] ** 2
        if not (np.sqrt(there) < in_range and np.sqrt(back) < in_range):
            return np.inf
        result = max(result, np.sqrt(there * back))
    return result


@njit(f"void({ARRAY_2D}, {ARRAY_2D})", **FLOQUET_OPTIONS)
def orthogonalise(matrix, basis):
    """Fill the orthogonal factor of QR by Householder's reflections; the matrix is overwritten."""
    size = matrix.shape[0]
    for p in range(size):
        for q in range(size):
            basis[p, q] = 1.0 if p == q else 0.0
    mirror = np.empty(size)
    for j in range(size - 1):
        square = 0.0
        for p in range(j, size):
            mirror[p] = matrix[p, j]
            square += mirror[p] ** 2
        if not square > 0.0:
            continue
        length = np.sqrt(square)
        mirror[j] += length if mirror[j] >= 0.0 else -length
        factor = 1.0 / (length * abs(mirror[j]))
        for q in range(j, size):
            along = 0.0
            for p in range(j, size):
                along += mirror[p] * matrix[p, q]
            for p in range(j, size):
                matrix[p, q] -= factor * along * mirror[p]
        for q in range(size):
            along = 0.0
            for p in range(j, size):
                along += basis[q, p] * mirror[p]
            for p in range(j, size):
                basis[q, p] -= factor * along * mirror[p]


@njit(f"void({ARRAY_3D}, {ARRAY_2D}, {ARRAY_3D})", **FLOQUET_OPTIONS)
def sweep(factors, basis, before):
    """Carry an orthogonal basis (size, size) through the factors, in place; fill the basis before each factor."""
    count, size, _ = factors.shape
    product = np.empty((size, size))
    for k in range(count):
        for p in range(size):
            for q in range(size):
                before[k, p, q] = basis[p, q]
                product[p, q] = 0.0
        largest = 0.0
        for p in range(size):
            for q in range(size):
                for other in range(size):
                    product[p, q] += factors[k, p, other] * basis[other, q]
                largest = max(largest, abs(product[p, q]))
        if largest > 0.0:
            for p in range(size):
                for q in range(size):
                    product[p, q] /= largest
        orthogonalise(product, basis)


@njit(f"void({ARRAY_3D}, complex128[:,::1], int64, boolean, complex128[:,::1])", **FLOQUET_OPTIONS)
def eigenfunction(steps, at, length, adjoint, result):
    """Fill an eigenfunction (points, size) of unit length from its values `at` every `length`-th point.

    An eigenfunction of the adjoint is filled backwards.
    """
    points, size = result.shape
    for j in range(points):
        k, before = ((points - j) % points, (points - j + 1) % points) if adjoint else (j, j - 1)
        square = 0.0
        for p in range(size):
            if k % length == 0:
                result[k, p] = at[k // length, p]
            else:
                result[k, p] = 0.0
                for q in range(size):
                    result[k, p] += (steps[k, q, p] if adjoint else steps[before, p, q]) * result[before, q]
            square += result[k, p].real ** 2 + result[k, p].imag ** 2
        norm = np.sqrt(square)
        for p in range(size):
            result[k, p] /= norm


@njit(f"Tuple((boolean, float64, float64))({ARRAY_3D}, float64[::1], int64, float64)", **FLOQUET_OPTIONS)
def dominant_multiplier(steps, vector, sweeps, tolerance):
    """Iterate a vector over the period until its direction is constant; return whether it is, log|μ|, the sign of μ."""
    points, size, _ = steps.shape
    start, after = np.empty(size), np.empty(size)
    for _ in range(sweeps):
        growth = 0.0
        for p in range(size):
            start[p] = vector[p]
        for k in range(points):
            square = 0.0
            for p in range(size):
                after[p] = 0.0
                for q in range(size):
                    after[p] += steps[k, p, q] * vector[q]
                square += after[p] ** 2
            length = np.sqrt(square)
            growth += np.log(length)
            for p in range(size):
                vector[p] = after[p] / length
        along = 0.0
        for p in range(size):
            along += vector[p] * start[p]
        sign = 1.0 if along > 0.0 else -1.0
        off = 0.0
        for p in range(size):
            off = max(off, abs(vector[p] - sign * start[p]))
        if off < tolerance:
            return True, growth, sign
    return False, 0.0, 0.0
