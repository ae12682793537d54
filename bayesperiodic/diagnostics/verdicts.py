"""Verdicts on normal approximations of draws, with tolerances and Monte Carlo errors."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter1d
from scipy.special import chdtri, ndtr, ndtri

from bayesperiodic._linalg import covariance_eigh
from bayesperiodic._verdicts import BAD, GOOD, with_tone

BATCHES = 8
# Expected Wasserstein distance of n independent standard normal draws from their own distribution, times √n.
WASSERSTEIN_FLOOR = float(np.sqrt(2 / np.pi) * quad(lambda z: np.sqrt(ndtr(z) * ndtr(-z)), -20.0, 20.0)[0])


@dataclass(frozen=True)
class Sample:
    """Draws (draws,) of one quantity, as a whole and in batches (batches, size), with the effective sample size.

    The Monte Carlo error of a statistic is the standard deviation of its values in the batches over √batches. A batch
    is an eighth of the steps of one independent ensemble, several autocorrelation times where the sampler converged.
    The batches of one ensemble follow those of the other.
    """

    whole: np.ndarray
    batches: np.ndarray
    size: float
    ensembles: int

    @classmethod
    def of(cls, draws: np.ndarray, size: float) -> "Sample":
        """Return the sample of draws (ensembles, steps, walkers)."""
        count, steps = draws.shape[:2]
        parts = min(BATCHES, steps)
        batches = draws[:, steps % parts :].reshape(count * parts, -1)
        return cls(draws.ravel(), batches, max(size, 1.0) if np.isfinite(size) else 1.0, count)

    def by_ensemble(self) -> list["Sample"]:
        """Return the sample of each ensemble."""
        parts = np.split(self.batches, self.ensembles)
        return [Sample(part.ravel(), part, max(self.size / self.ensembles, 1.0), 1) for part in parts]

    def estimate(self, statistic: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
        """Return a statistic of all draws, which acts along the last axis, and its Monte Carlo error."""
        values = statistic(self.batches)
        return float(statistic(self.whole)), float(np.std(values, ddof=1) / np.sqrt(len(values)))

    def fraction(self, inside: Callable[[np.ndarray], np.ndarray], expected: float) -> tuple[float, float]:
        """Return the fraction of draws that satisfy a condition, and its Monte Carlo error.

        The error is at least that of `expected` in as many independent draws as the effective sample size.
        """
        fraction, error = self.estimate(lambda x: np.mean(inside(x), axis=-1))
        return fraction, max(error, float(np.sqrt(expected * (1.0 - expected) / self.size)))

    def below(self, bound: float, expected: float) -> tuple[float, float]:
        """Return the fraction of draws below a bound, and its Monte Carlo error."""
        return self.fraction(lambda x: x < bound, expected)


def wasserstein(x: np.ndarray, mean: float, sd: float) -> np.ndarray:
    """Return the first Wasserstein distance (…,) between draws (…, n) and a normal distribution, by its quantiles."""
    count = x.shape[-1]
    return np.mean(np.abs(np.sort(x, axis=-1) - mean - sd * ndtri((np.arange(count) + 0.5) / count)), axis=-1)


def wasserstein_distance(sample: Sample, mean: float, sd: float) -> tuple[float, float]:
    """Return the Wasserstein distance from a normal distribution in sds of the draws, and its Monte Carlo error.

    Draws of the normal distribution itself have a distance of 1.3/√ESS sds. The error is the root of the sum of squares
    of the spread between batches and of this bias.
    """
    if not np.isfinite(sd):
        return np.inf, np.nan
    draws_sd = float(sample.whole.std())
    value, spread = sample.estimate(lambda x: wasserstein(x, mean, sd))
    return value / draws_sd, float(np.hypot(spread / draws_sd, WASSERSTEIN_FLOOR / np.sqrt(sample.size)))


def radii(points: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the Mahalanobis distances (n,) of points (n, dimension) from the mean of a normal distribution."""
    values, vectors, scale = covariance_eigh(covariance)
    floor = np.finfo(float).eps * values.size * values.max()
    z = ((points - mean) / scale) @ (vectors / np.sqrt(np.maximum(values, floor)))
    return np.sqrt(np.sum(z**2, axis=1))


def normal_draws(
    mean: np.ndarray, covariance: np.ndarray, size: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return draws (size, dimension) of a normal distribution and their log-densities (size,) up to a constant."""
    values, vectors, scale = covariance_eigh(covariance)
    z = generator.standard_normal((size, mean.size))
    return mean + scale * ((z * np.sqrt(np.maximum(values, 0.0))) @ vectors.T), -0.5 * np.sum(z**2, axis=1)


# A second mode: least probability beyond the valley, and depth of the valley relative to the lower peak.
MASS, DEPTH = 0.05, 0.7
MODE_GRID, MODE_GRID_RANGE = 256, (0.001, 0.999)


def has_other_mode(sample: Sample, point: float) -> bool:
    """Return whether more than 5 % of the draws are separated from a point by a valley of their density.

    The density is a kernel estimate with Silverman's bandwidth for the effective sample size, in every batch. A valley
    is lower than 0.7 of the lower of the peaks on its two sides. Both criteria must hold by three Monte Carlo errors,
    so that neither skewness nor the noise of a flat density is taken for a mode.
    """
    x = sample.whole
    spread = min(x.std(), float(np.subtract(*np.quantile(x, [0.75, 0.25]))) / 1.349) or x.std()
    if not spread > 0.0:
        return False
    bandwidth = 0.9 * spread * sample.size**-0.2
    low, high = np.quantile(x, MODE_GRID_RANGE)
    edges = np.linspace(low - 3 * bandwidth, high + 3 * bandwidth, MODE_GRID + 1)
    width = edges[1] - edges[0]
    inside = np.clip(((sample.batches - edges[0]) / width).astype(int), 0, MODE_GRID - 1)
    batches = len(inside)
    counts = np.bincount((inside + MODE_GRID * np.arange(batches)[:, None]).ravel(), minlength=batches * MODE_GRID)
    mass = counts.reshape(batches, MODE_GRID) / inside.shape[1]
    density = gaussian_filter1d(mass, bandwidth / width, mode="constant")
    slope = np.diff(density.mean(axis=0))
    valleys = np.flatnonzero((slope[:-1] <= 0.0) & (slope[1:] >= 0.0)) + 1  # all points of a flat one
    return any(_separates(density, mass, int(at), point > edges[at] + 0.5 * width) for at in valleys)


def _separates(density: np.ndarray, mass: np.ndarray, valley: int, point_above: bool) -> bool:
    """Return whether a valley is deep enough and the mass beyond it large enough, by the batches (batches, grid)."""
    mean = density.mean(axis=0)
    peaks = int(np.argmax(mean[:valley])), valley + int(np.argmax(mean[valley:]))
    peak = min(peaks, key=lambda place: mean[place])
    far = mass[:, :valley] if point_above else mass[:, valley:]
    return _beyond_errors(far.sum(axis=1) - MASS) and _beyond_errors(DEPTH * density[:, peak] - density[:, valley])


def _beyond_errors(values: np.ndarray) -> bool:
    """Return whether the mean over batches is above zero by three standard errors."""
    return bool(values.mean() > ERRORS * values.std(ddof=1) / np.sqrt(len(values)))


FINE, WRONG_MODE = with_tone("fine", GOOD), with_tone("wrong mode", BAD)
NARROW, WIDE, WRONG_SHAPE = "too narrow", "too wide", "wrong shape"
UNCONVERGED = with_tone("not converged", BAD)
ERRORS = 3.0
END_PROBABILITY, END_SHIFT = 0.05, 0.25
END = float(ndtri(1.0 - END_PROBABILITY))
ELLIPSOID_LEVELS = (0.5, 0.9, 0.95)
RADIUS_FACTOR = 1.0 + END_SHIFT / END
# Accumulation at an end of the support: probability within a distance in sds of the draws.
PILED, AT_END = 0.05, 0.25
# Another mode: probability on one side of the mean ± 3 sd of the approximation.
OTHER_MODE_DISTANCE, OTHER_MODE_PROBABILITY = 3.0, 0.05
USABLE_K = 0.7


def marginal_verdict(sample: Sample, mean: float, sd: float, support: tuple[float, float], converged: bool) -> str:
    """Return the verdict on a normal approximation of one quantity.

    An end of its 90 % interval is wrong if more (or less) than 5 % of the draws lie beyond it by more than three Monte
    Carlo errors, even after moving it by a quarter of the sd of the draws. `support` is that of the prior. Draws that
    have not converged get no verdict, unless every ensemble by itself shows another mode.
    """
    if not converged:
        return _unconverged(sample, mean)
    if not np.isfinite(sd):
        return WIDE
    if _elsewhere(sample, mean, sd) or has_other_mode(sample, mean):
        return WRONG_MODE
    draws_sd = float(sample.whole.std())
    low = _end(sample, mean, sd, draws_sd)
    high = _end(Sample(-sample.whole, -sample.batches, sample.size, sample.ensembles), -mean, sd, draws_sd)
    if low == high == FINE:
        distance, error = wasserstein_distance(sample, mean, sd)
        return WRONG_SHAPE if distance - ERRORS * error > END_SHIFT else FINE
    if _piled(sample, support, draws_sd):
        return WRONG_SHAPE
    quantiles = np.quantile(sample.whole, [END_PROBABILITY, 1.0 - END_PROBABILITY])
    outwards = np.array([mean - END * sd - quantiles[0], quantiles[1] - mean - END * sd]) / draws_sd
    if np.all(outwards > 0.5 * END_SHIFT):
        return NARROW
    return WIDE if np.all(outwards < -0.5 * END_SHIFT) else WRONG_SHAPE


def _unconverged(sample: Sample, mean: float) -> str:
    return WRONG_MODE if all(has_other_mode(ensemble, mean) for ensemble in sample.by_ensemble()) else UNCONVERGED


def _end(sample: Sample, mean: float, sd: float, draws_sd: float) -> str:
    """Return the verdict on the lower end of the 90 % interval."""
    end = mean - END * sd
    beyond, error = sample.below(end - END_SHIFT * draws_sd, END_PROBABILITY)
    if beyond > END_PROBABILITY + ERRORS * error:
        return NARROW
    beyond, error = sample.below(end + END_SHIFT * draws_sd, END_PROBABILITY)
    return WIDE if beyond < END_PROBABILITY - ERRORS * error else FINE


def _elsewhere(sample: Sample, mean: float, sd: float) -> bool:
    """Return whether fewer than 5 % of the draws lie below mean + 3 sd, or above mean − 3 sd."""
    low = sample.below(mean + OTHER_MODE_DISTANCE * sd, OTHER_MODE_PROBABILITY)
    high = sample.fraction(lambda x: x > mean - OTHER_MODE_DISTANCE * sd, OTHER_MODE_PROBABILITY)
    return any(within < OTHER_MODE_PROBABILITY - ERRORS * error for within, error in (low, high))


def _piled(sample: Sample, support: tuple[float, float], draws_sd: float) -> bool:
    """Return whether more than 5 % of the draws lie within a quarter of their sd of an end of the support.

    A normal posterior truncated two sds from its centre has 1.8 % there, one truncated at its centre 12 %.
    """
    bounds = [end for end in support if np.isfinite(end)]
    near = [sample.fraction(lambda x, e=end: np.abs(x - e) < AT_END * draws_sd, PILED) for end in bounds]  # type: ignore[misc]
    return any(fraction > PILED + ERRORS * error for fraction, error in near)


def joint_verdict(
    points: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    sampled: Callable[[np.ndarray], Sample],
    pareto_k: tuple[float, float],
    converged: bool,
) -> str:
    """Return the verdict on a normal approximation of all coordinates jointly.

    An ellipsoid of 50, 90 or 95 % contains too few draws if it still does, by more than three Monte Carlo errors, after
    its radius is increased by 15 % (which corresponds to a shift of the end of a 90 % interval by a quarter of a sd);
    too many accordingly. The approximation is then "too narrow" or "too wide" if a normal distribution with the mean
    and covariance of the draws is fine and correcting the mean alone is not sufficient; otherwise, and where the Pareto
    k̂ exceeds 0.7 by its error, it has the "wrong shape". `sampled` makes a Sample of values (draws,).
    """
    own_mean, own_covariance = points.mean(axis=0), np.atleast_2d(np.cov(points.T))
    scale = np.sqrt(np.diag(own_covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    # The direction of largest spread, in units of the sds.
    direction = covariance_eigh(own_covariance, scale)[1][:, -1] / scale
    along = sampled(points @ direction)
    if not converged:
        return _unconverged(along, float(mean @ direction))
    if not np.isfinite(covariance).all():
        return WIDE
    if has_other_mode(along, float(mean @ direction)):
        return WRONG_MODE
    verdict = _ellipsoids(sampled(radii(points, mean, covariance)), mean.size)
    if verdict == FINE:
        return WRONG_SHAPE if pareto_k[0] - pareto_k[1] > USABLE_K else FINE
    if _ellipsoids(sampled(radii(points, own_mean, own_covariance)), mean.size) != FINE:
        return WRONG_SHAPE
    return WRONG_SHAPE if _ellipsoids(sampled(radii(points, own_mean, covariance)), mean.size) == FINE else verdict


def ellipsoid_radii(levels: np.ndarray, dimension: int) -> np.ndarray:
    """Return the Mahalanobis radii of the ellipsoids of given probabilities."""
    return np.sqrt(chdtri(dimension, 1.0 - np.asarray(levels)))


def _ellipsoids(distances: Sample, dimension: int) -> str:
    """Return whether the ellipsoids contain as many draws as expected."""
    verdicts = set()
    for level, radius in zip(ELLIPSOID_LEVELS, ellipsoid_radii(np.array(ELLIPSOID_LEVELS), dimension), strict=True):
        larger, error = distances.below(RADIUS_FACTOR * radius, level)
        verdicts |= {NARROW} if larger < level - ERRORS * error else set()
        smaller, error = distances.below(radius / RADIUS_FACTOR, level)
        verdicts |= {WIDE} if smaller > level + ERRORS * error else set()
    return verdicts.pop() if len(verdicts) == 1 else WRONG_SHAPE if verdicts else FINE
