"""Compiled solution of small dense systems; loaded through the kernel cache, not imported."""

import numpy as np
from numba import njit

DENSE_OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}


@njit("boolean(float64[:,::1], float64[:,::1])", **DENSE_OPTIONS)
def solve(matrix, right):
    """Solve in place for the columns of `right`, with pivoting; return False if a pivot is zero or not finite."""
    size, columns = matrix.shape[0], right.shape[1]
    for j in range(size):
        pivot = j
        for i in range(j + 1, size):
            if abs(matrix[i, j]) > abs(matrix[pivot, j]):
                pivot = i
        if not (abs(matrix[pivot, j]) > 0.0 and abs(matrix[pivot, j]) < np.inf):
            return False
        if pivot != j:
            for k in range(j, size):
                matrix[pivot, k], matrix[j, k] = matrix[j, k], matrix[pivot, k]
            for c in range(columns):
                right[pivot, c], right[j, c] = right[j, c], right[pivot, c]
        for i in range(j + 1, size):
            factor = matrix[i, j] / matrix[j, j]
            if factor != 0.0:
                for k in range(j + 1, size):
                    matrix[i, k] -= factor * matrix[j, k]
                for c in range(columns):
                    right[i, c] -= factor * right[j, c]
    for j in range(size - 1, -1, -1):
        for c in range(columns):
            total = right[j, c]
            for k in range(j + 1, size):
                total -= matrix[j, k] * right[k, c]
            right[j, c] = total / matrix[j, j]
    return True
