"""Priors of one parameter, one vocabulary for all methods.

Every prior has `log_prob`, its first derivative `gradient`, its negative second derivative `curvature`, `sample`,
`quantile` and `support`. A support of (0, ∞) means that the parameter is sampled in its logarithm.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import ndtri

from bayesperiodic import checks

LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class Prior(Protocol):
    """What the estimator and the sampler ask of a prior; all functions take and return arrays of any shape."""

    @property
    def support(self) -> tuple[float, float]:
        """The open interval outside of which the density is zero."""

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the normalised log-density, −inf outside the support."""

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return d log p / dx."""

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −d² log p / dx²."""

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the inverse of the distribution function."""

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size,)."""


class _Sampled:
    def quantile(self, probability: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size,)."""
        return self.quantile(generator.uniform(size=size))


@dataclass(frozen=True)
class Normal(_Sampled):
    """The normal distribution, the paper's prior (de Kraker et al. 1997, section 3).

    Parameters
    ----------
    mean : float
    sd : float
        > 0.
    """

    mean: float
    sd: float

    def __post_init__(self) -> None:
        checks.finite_number("mean", self.mean)
        checks.positive("sd", self.sd)

    @property
    def support(self) -> tuple[float, float]:
        """The whole line."""
        return -np.inf, np.inf

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the log-density."""
        return -0.5 * ((x - self.mean) / self.sd) ** 2 - (math.log(self.sd) + LOG_ROOT_TWO_PI)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return d log p / dx."""
        return -(x - self.mean) / self.sd**2

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −d² log p / dx²."""
        return np.full_like(np.asarray(x, dtype=float), 1.0 / self.sd**2)

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the inverse of the distribution function."""
        return self.mean + self.sd * ndtri(probability)


@dataclass(frozen=True)
class LogNormal(_Sampled):
    """The distribution of a positive number whose logarithm is normal.

    Parameters
    ----------
    median : float
        > 0.
    spread : float
        Standard deviation of the logarithm, > 0.
    """

    median: float
    spread: float

    def __post_init__(self) -> None:
        checks.positive("median", self.median)
        checks.positive("spread", self.spread)

    @property
    def support(self) -> tuple[float, float]:
        """The positive half-line."""
        return 0.0, np.inf

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the log-density, −inf for x ≤ 0."""
        x = np.asarray(x, dtype=float)
        inside = (x > 0.0) & (x < np.inf)
        logarithm = np.log(np.where(inside, x, 1.0))
        score = (logarithm - math.log(self.median)) / self.spread
        value = -0.5 * score**2 - logarithm - (math.log(self.spread) + LOG_ROOT_TWO_PI)
        return np.where(inside, value, -np.inf)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return d log p / dx."""
        return -(1.0 + self._score(x) / self.spread) / x

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −d² log p / dx²; negative beyond the inflection point."""
        return (1.0 / self.spread**2 - 1.0 - self._score(x) / self.spread) / np.square(x)

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the inverse of the distribution function."""
        return self.median * np.exp(self.spread * ndtri(probability))

    def _score(self, x: np.ndarray) -> np.ndarray:
        return (np.log(x) - np.log(self.median)) / self.spread


@dataclass(frozen=True)
class Uniform(_Sampled):
    """The uniform distribution on an interval.

    Parameters
    ----------
    low, high : float
        low < high.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        checks.finite_number("low", self.low)
        checks.finite_number("high", self.high)
        if not self.low < self.high:
            raise ValueError(f"low: {self.low!r} is not allowed; it must be less than high = {self.high!r}.")

    @property
    def support(self) -> tuple[float, float]:
        """The interval."""
        return self.low, self.high

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the log-density, −inf outside the interval."""
        inside = (np.asarray(x) > self.low) & (np.asarray(x) < self.high)
        return np.where(inside, -np.log(self.high - self.low), -np.inf)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return zero."""
        return np.zeros_like(np.asarray(x, dtype=float))

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return zero."""
        return np.zeros_like(np.asarray(x, dtype=float))

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the inverse of the distribution function."""
        return self.low + (self.high - self.low) * np.asarray(probability)
