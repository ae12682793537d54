"""Are values uniform on (0, 1): three tests, and simultaneous bands of their empirical distribution."""

from functools import cache

import numpy as np
from scipy import stats
from scipy.special import ndtri

POINTS, SIMULATED, SIMULATION_SEED = 100, 20_000, 0
FEWEST_IN_BIN, MOST_BINS = 20, 20
EDGE = 1e-12


def normal_scores(values: np.ndarray) -> np.ndarray:
    """Return the standard normal quantiles of values in (0, 1); those at the ends count as 1e-12 from them."""
    return ndtri(np.clip(values, EDGE, 1.0 - EDGE))


def dispersion_test(values: np.ndarray) -> tuple[float, float]:
    """Return the mean square of the normal scores, 1 on average, and the two-sided p-value of its χ² distribution.

    Intervals that are too narrow put the truth into their tails and raise it, to 1.25 if variances are a fifth too
    small. With 1000 values a level of 1 % sees that in 99.7 % of cases, `ecdf_test` in 76 %, Kolmogorov's in 20 %.
    """
    square = float(np.sum(normal_scores(values) ** 2))
    low, high = stats.chi2.cdf(square, values.size), stats.chi2.sf(square, values.size)
    return square / values.size, float(min(1.0, 2.0 * min(low, high)))


def chi_square_test(values: np.ndarray) -> float:
    """Return p of the χ² test on the histogram; NaN for too few values for five bins."""
    bins = bin_count(values.size)
    if bins * FEWEST_IN_BIN > values.size:
        return np.nan
    return float(stats.chisquare(np.histogram(values, bins, (0.0, 1.0))[0]).pvalue)


def bin_count(size: int) -> int:
    """Return how many bins a histogram of so many values has."""
    return int(np.clip(size // FEWEST_IN_BIN, 5, MOST_BINS))


def ecdf_test(values: np.ndarray) -> float:
    """Return p of the empirical distribution function's smallest pointwise binomial tail ([1]_, section 3).

    The null distribution is simulated once for every number of values, with a fixed seed.

    References
    ----------
    .. [1] T. Säilynoja, P.-C. Bürkner, A. Vehtari, Graphical test for discrete uniformity and its applications in
       goodness-of-fit evaluation and multiple sample comparison, Statistics and Computing 32 (2022) 32.
    """
    table, null = _null(values.size)
    counts = np.searchsorted(np.sort(values), evaluation_points(), side="right")
    smallest = table[counts, np.arange(counts.size)].min()
    return float((1 + np.sum(null <= smallest * (1.0 + 1e-9))) / (1 + null.size))


def ecdf_band(size: int, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the band that holds the whole empirical distribution function of so many values with a probability.

    Parameters
    ----------
    size : int
        Number of values.
    level : float
        The probability.

    Returns
    -------
    low, high : array (points,)
        At `evaluation_points`.
    """
    tail = float(np.quantile(_null(size)[1], 1.0 - level))
    points = evaluation_points()
    return binomial_band(size, points, tail)


def binomial_band(size: int, probabilities: np.ndarray, tail: float) -> tuple[np.ndarray, np.ndarray]:
    """Return between which shares of `size` trials all but a share `tail` of outcomes lie, at each probability."""
    low, high = (np.asarray(stats.binom.ppf(q, size, probabilities)) for q in (0.5 * tail, 1.0 - 0.5 * tail))
    return low / size, high / size


def evaluation_points() -> np.ndarray:
    """Return where the empirical distribution function is looked at, (points,)."""
    return np.arange(1, POINTS) / POINTS


@cache
def _null(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pointwise two-sided tails (size + 1, points) of each count, and simulated smallest ones."""
    counts, points = np.arange(size + 1)[:, None], evaluation_points()
    table = 2.0 * np.minimum(stats.binom.cdf(counts, size, points), stats.binom.sf(counts - 1, size, points))
    generator = np.random.default_rng(SIMULATION_SEED)
    drawn = generator.multinomial(size, np.full(POINTS, 1.0 / POINTS), SIMULATED).cumsum(axis=1)[:, :-1]
    return table, table[drawn, np.arange(POINTS - 1)].min(axis=1)
