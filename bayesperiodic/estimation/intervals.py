"""Intervals of Student's t between two ends, and covariances of derived quantities by the delta method."""

from itertools import product

import numpy as np
from scipy.special import stdtr, stdtrit

# Distance of the maxima of a density over the logarithm and over the value, in variances of the logarithm: 1 for a
# log-normal density, and at least 1.3 for normal ones near zero, where the maxima differ by half a standard deviation.
MOST_OF_LOG_NORMAL = 1.15


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


def log_normal_interval(
    freedom: float, probability: float, maxima: tuple[float, float], sd: float, factor: float
) -> tuple[float, float] | None:
    """Return the interval of a quantity whose density is nearer to a log-normal than to a normal one, otherwise None.

    `maxima` are those of the density over the value and over the logarithm, `sd` is that of the logarithm, and `factor`
    what it is multiplied by in the interval.
    """
    value, centre = maxima
    if np.log(centre / value) > MOST_OF_LOG_NORMAL * sd**2:
        return None
    ratio = float(np.exp(factor * sd * shortest_interval(freedom, probability, -np.inf, np.inf)[1]))
    return centre / ratio, centre * ratio


def carried_covariance(matrix: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Return the covariance of quantities with these gradients; parameters of gradient 0 may have an infinite sd."""
    result = np.zeros((len(gradients), len(gradients)))
    with np.errstate(invalid="ignore", over="ignore"):
        for (i, a), (j, b) in product(enumerate(gradients), repeat=2):
            result[i, j] = a[a != 0.0] @ matrix[np.ix_(a != 0.0, b != 0.0)] @ b[b != 0.0]
    return result
