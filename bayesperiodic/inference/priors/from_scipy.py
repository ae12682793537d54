"""Frozen distributions of scipy.stats as priors."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from bayesperiodic.inference.priors.univariate import Univariate


class FromScipy(Univariate):
    """A frozen continuous distribution of scipy.stats as a prior.

    `gradient` and `curvature` are central differences of its `logpdf` with steps halved seven times, extrapolated
    where the estimated error is least. Let w be the interquartile range. Where the density is smooth and SciPy's
    `logpdf` has full precision, between the quantiles 1e-6 and 1 − 1e-6, the error of the gradient is below 1e-10 of
    (its own size + 1/w), and that of the curvature below 1e-9 of (its own size + 1/w²). Steps stay within the support:
    at a distance d from its end the curvature loses 1e-13/d² more. At kinks and steps of a density there is nothing
    to trust.

    Parameters
    ----------
    distribution : frozen scipy.stats distribution
        Continuous and of one variable.

    Examples
    --------
    >>> from scipy import stats
    >>> from bayesperiodic.inference.priors.from_scipy import FromScipy
    >>> prior = FromScipy(stats.gamma(2.0, scale=3.0))
    >>> prior
    scipy.stats.gamma(2.0, scale=3.0)
    >>> prior.gradient([1.0, 3.0]).round(6).tolist()
    [0.666667, 0.0]
    """

    def __init__(self, distribution: Any):
        self.distribution = distribution

    @cached_property
    def support(self) -> tuple[float, float]:
        """The interval outside of which the density is zero."""
        low, high = self.distribution.support()
        return float(low), float(high)

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size,)."""
        return self.distribution.rvs(size=size, random_state=generator)

    def _log_density(self, x: np.ndarray) -> Any:
        with np.errstate(all="ignore"):
            return self.distribution.logpdf(x)

    def _gradient(self, x: np.ndarray) -> Any:
        return _derivatives(self._log_density, x, self._steps(x))[0]

    def _curvature(self, x: np.ndarray) -> Any:
        return -_derivatives(self._log_density, x, self._steps(x))[1]

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.distribution.ppf(p)

    def _steps(self, x: np.ndarray) -> np.ndarray:
        """Return the first step at each point: within the support, and a power of two to add without rounding."""
        low, high = self.support
        widest = np.minimum(self._width, np.minimum(x - low, high - x))
        return 2.0 ** np.floor(np.log2(0.5 * widest))

    @cached_property
    def _width(self) -> float:
        return float(self.distribution.ppf(0.75) - self.distribution.ppf(0.25))

    def __repr__(self) -> str:
        text = as_written(self.distribution)
        known = getattr(stats, self.distribution.dist.name or "", None)
        if type(known) is type(self.distribution.dist):
            return text
        # The numbers behind a histogram or a class of the user's own are not in its arguments.
        quantiles = self.distribution.ppf((np.arange(32) + 0.5) / 32).tolist()
        return f"{text} with quantiles {quantiles}"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FromScipy) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))


def as_written(distribution: Any) -> str:
    """Return a frozen distribution as it was written, with all digits."""
    arguments = [repr(np.asarray(a).tolist()) for a in distribution.args]
    arguments += [f"{name}={np.asarray(a).tolist()!r}" for name, a in sorted(distribution.kwds.items())]
    dist = distribution.dist
    known = type(getattr(stats, dist.name or "", None)) is type(dist)
    name = f"scipy.stats.{dist.name}" if known else type(dist).__name__
    return f"{name}({', '.join(arguments)})"


def _derivatives(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: np.ndarray, levels: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Return first and second derivative at points (…) by Richardson's extrapolation of central differences.

    Of all extrapolations the one that differs least from its neighbours is taken (Ridders 1982).
    """
    h = np.ravel(step) * 0.5 ** np.arange(levels)[:, None]
    values = function(np.concatenate([x.reshape(1, -1), x.ravel() + h, x.ravel() - h]))
    middle, above, below = values[0], values[1 : levels + 1], values[levels + 1 :]
    with np.errstate(all="ignore"):
        first = _extrapolate((above - below) / (2.0 * h))
        second = _extrapolate(((above - middle) - (middle - below)) / h**2)
    return first.reshape(x.shape), second.reshape(x.shape)


def _extrapolate(differences: np.ndarray) -> np.ndarray:
    best = differences[0].copy()
    error = np.full(best.shape, np.inf)
    column = differences
    for order in range(1, len(differences)):
        factor = 4.0**order
        following = (factor * column[1:] - column[:-1]) / (factor - 1.0)
        change = np.maximum(np.abs(following - column[1:]), np.abs(following - column[:-1]))
        for value, estimate in zip(following, change, strict=True):
            better = estimate < error
            best[better], error[better] = value[better], estimate[better]
        column = following
    return best
