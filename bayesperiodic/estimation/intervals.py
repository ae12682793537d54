"""Intervals of Student's t between two ends, and covariances of derived quantities by the delta method."""

from itertools import product

import numpy as np
from scipy.special import stdtr, stdtrit


def shortest_interval(freedom: float, probability: float, low: float, high: float) -> tuple[float, float]:
    """Return the shortest interval of Student's t between two ends, low ≤ 0 ≤ high."""
    below, inside = float(stdtr(freedom, low)), probability
    if low > -np.inf or high < np.inf:
        inside *= float(stdtr(freedom, high)) - below
    half = float(stdtrit(freedom, 0.5 + 0.5 * inside))
    if half <= min(-low, high):
        return -half, half
    if -low <= high:
        return low, float(stdtrit(freedom, below + inside))
    return -shortest_interval(freedom, probability, -high, -low)[1], high


def carried_covariance(matrix: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Return the covariance of quantities with these gradients; parameters of gradient 0 may have an infinite sd."""
    result = np.zeros((len(gradients), len(gradients)))
    with np.errstate(invalid="ignore", over="ignore"):
        for (i, a), (j, b) in product(enumerate(gradients), repeat=2):
            result[i, j] = a[a != 0.0] @ matrix[np.ix_(a != 0.0, b != 0.0)] @ b[b != 0.0]
    return result
