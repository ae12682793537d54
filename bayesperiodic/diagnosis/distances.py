"""How far draws are from a normal distribution, with Monte Carlo errors: functions of arrays."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import quad
from scipy.special import ndtr, ndtri

BATCHES = 8
# Expected Wasserstein distance of n independent standard normal draws from their own distribution, times √n.
WASSERSTEIN_FLOOR = float(np.sqrt(2 / np.pi) * quad(lambda z: np.sqrt(ndtr(z) * ndtr(-z)), -20.0, 20.0)[0])


@dataclass(frozen=True)
class Sample:
    """Draws of one quantity, whole and in batches.

    The Monte Carlo error of a statistic is the standard deviation of its values in the batches over √batches. A batch
    is an eighth of the steps of one independent ensemble, several autocorrelation times where the sampler converged.

    Attributes
    ----------
    whole : array (draws,)
    batches : array (batches, size)
    size : float
        Effective sample size.
    ensembles : int
        Whose batches come one after the other.
    """

    whole: np.ndarray
    batches: np.ndarray
    size: float
    ensembles: int

    @classmethod
    def of(cls, draws: np.ndarray, ensemble: np.ndarray, size: float) -> "Sample":
        """Return the sample of draws (chains·steps,), one chain after the other, by their ensembles (chains,)."""
        chains = draws.reshape(ensemble.size, -1)[np.argsort(ensemble, kind="stable")]
        count, steps = np.unique(ensemble).size, chains.shape[1]
        parts = min(BATCHES, steps)
        used = steps // parts * parts
        shaped = chains[:, steps - used :].reshape(count, -1, parts, used // parts)
        batches = shaped.transpose(0, 2, 1, 3).reshape(count * parts, -1)
        return cls(draws, batches, max(size, 1.0) if np.isfinite(size) else 1.0, count)

    def by_ensemble(self) -> list["Sample"]:
        """Return the sample that each ensemble is by itself."""
        parts = np.split(self.batches, self.ensembles)
        return [Sample(part.ravel(), part, max(self.size / self.ensembles, 1.0), 1) for part in parts]

    def of_values(self, function: Callable[[np.ndarray], np.ndarray]) -> "Sample":
        """Return the sample of a function of the quantity."""
        return Sample(function(self.whole), function(self.batches), self.size, self.ensembles)

    def error(self, statistic: Callable[[np.ndarray], np.ndarray]) -> float:
        """Return the Monte Carlo error of a statistic, which acts along the last axis."""
        values = statistic(self.batches)
        return float(np.std(values, ddof=1) / np.sqrt(len(values)))

    def estimate(self, statistic: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
        """Return a statistic of all draws and its Monte Carlo error."""
        return float(statistic(self.whole)), self.error(statistic)

    def share(self, inside: Callable[[np.ndarray], np.ndarray], expected: float) -> tuple[float, float]:
        """Return the share of draws for which a condition holds, and its Monte Carlo error.

        The error is at least that of `expected` in as many independent draws as the effective sample size.
        """
        share, error = self.estimate(lambda x: np.mean(inside(x), axis=-1))
        return share, max(error, float(np.sqrt(expected * (1.0 - expected) / self.size)))


def skewness(x: np.ndarray) -> np.ndarray:
    """Return the skewness (…,) of draws (…, n)."""
    z = x - x.mean(axis=-1, keepdims=True)
    return np.mean(z**3, axis=-1) / np.mean(z**2, axis=-1) ** 1.5


def wasserstein(x: np.ndarray, mean: float, sd: float) -> np.ndarray:
    """Return the first Wasserstein distance (…,) between draws (…, n) and a normal distribution, by its quantiles."""
    count = x.shape[-1]
    return np.mean(np.abs(np.sort(x, axis=-1) - mean - sd * ndtri((np.arange(count) + 0.5) / count)), axis=-1)


def wasserstein_distance(sample: Sample, mean: float, sd: float) -> tuple[float, float]:
    """Return the Wasserstein distance from a normal distribution in sds of the draws, and its Monte Carlo error.

    A distance is biased upwards: draws of the normal distribution itself are 1.3/√ESS sds away from it. The error is
    the root of the squares of the spread between batches and of this bias.
    """
    if not np.isfinite(sd):
        return np.inf, np.nan
    own = float(sample.whole.std())
    value, spread = sample.estimate(lambda x: wasserstein(x, mean, sd))
    return value / own, float(np.hypot(spread / own, WASSERSTEIN_FLOOR / np.sqrt(sample.size)))


def radii(points: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the Mahalanobis distances (n,) of points (n, dimension) from the centre of a normal distribution."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    floor = np.finfo(float).eps * values.size * values.max()
    z = ((points - mean) / scale) @ (vectors / np.sqrt(np.maximum(values, floor)))
    return np.sqrt(np.sum(z**2, axis=1))


def normal_draws(
    mean: np.ndarray, covariance: np.ndarray, size: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return draws (size, dimension) of a normal distribution and their log-densities (size,), but for a constant."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    z = generator.standard_normal((size, mean.size))
    return mean + scale * ((z * np.sqrt(np.maximum(values, 0.0))) @ vectors.T), -0.5 * np.sum(z**2, axis=1)
