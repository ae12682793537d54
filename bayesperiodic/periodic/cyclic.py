"""Factor and solve banded systems with partial pivoting, by compiled code that holds no lock.

A cyclic band becomes an ordinary one in the folded order of `schemes.CyclicGrid`; pivoting then keeps the solution
accurate however stable or unstable the orbit is, which one march through the period would not.

Rows are stored side by side: entry (i, j) of the matrix is ``band[i, j - i + lower]``, the width is
2·lower + upper + 1 and leaves room for the fill-in of row exchanges.
"""

import numpy as np
from numba import njit

BAND = "float64[:,::1]"


@njit(f"boolean({BAND}, int64, int64, int64[::1])", cache=True, nogil=True, error_model="numpy")
def factor(band, lower, upper, pivots):
    """Factor in place, P·A = L·U, the pivots kept as their inverses; return False for one that is zero or not finite.

    Parameters
    ----------
    band : array (size, 2·lower + upper + 1)
    lower, upper : int
        Half-widths below and above the diagonal.
    pivots : int array (size,)
        Filled with the row exchanged with each row.
    """
    size = band.shape[0]
    last = 0
    for j in range(size):
        end = min(j + lower, size - 1)
        pivot, largest = j, abs(band[j, lower])
        for i in range(j + 1, end + 1):
            value = abs(band[i, j - i + lower])
            if value > largest:
                pivot, largest = i, value
        if not (largest > 0.0 and largest < np.inf):
            return False
        pivots[j] = pivot
        last = max(last, min(pivot + upper, size - 1))
        if pivot != j:
            for column in range(j, last + 1):
                here, there = column - j + lower, column - pivot + lower
                band[j, here], band[pivot, there] = band[pivot, there], band[j, here]
        inverse = 1.0 / band[j, lower]
        band[j, lower] = inverse
        width = last - j
        for i in range(j + 1, end + 1):
            start = j - i + lower
            multiplier = band[i, start] * inverse
            band[i, start] = multiplier
            if multiplier != 0.0:
                for k in range(1, width + 1):
                    band[i, start + k] -= multiplier * band[j, lower + k]
    return True


@njit(f"void({BAND}, int64, int64, int64[::1], {BAND})", cache=True, nogil=True, error_model="numpy")
def solve(band, lower, upper, pivots, right):
    """Solve A·x = b in place for right-hand sides (count, size), with the factors of `factor`."""
    size = right.shape[1]
    for c in range(right.shape[0]):
        x = right[c]
        for j in range(size):
            pivot = pivots[j]
            value = x[pivot]
            x[pivot] = x[j]
            x[j] = value
            for i in range(j + 1, min(j + lower, size - 1) + 1):
                x[i] -= band[i, j - i + lower] * value
        for i in range(size - 1, -1, -1):
            value = x[i]
            for j in range(1, min(lower + upper, size - 1 - i) + 1):
                value -= band[i, j + lower] * x[i + j]
            x[i] = value * band[i, lower]
