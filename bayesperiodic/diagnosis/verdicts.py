"""What is wrong with a normal approximation, in one of a few words, beyond tolerance and Monte Carlo error."""

from collections.abc import Callable

import numpy as np
from scipy.special import chdtri, ndtri

from bayesperiodic.diagnosis.distances import Sample, radii, wasserstein_distance
from bayesperiodic.diagnosis.modes import has_other_mode

FINE, NARROW, WIDE, SHAPE, MODE = "fine", "too narrow", "too wide", "wrong shape", "wrong mode"
UNCONVERGED = "not converged"
ERRORS = 3.0
TAIL, END_SHIFT = 0.05, 0.25
END = float(ndtri(1.0 - TAIL))
LEVELS = (0.5, 0.9, 0.95)
SCALE = 1.0 + END_SHIFT / END
PILED, EDGE = 0.05, 0.25
REACH, FEW = 3.0, 0.05
USABLE_K = 0.7


def marginal_verdict(sample: Sample, mean: float, sd: float, support: tuple[float, float], converged: bool) -> str:
    """Return the verdict on a normal approximation of one quantity.

    What counts are the ends of its 90 % interval: that more (or less) than 5 % of the draws lie beyond an end, still
    after it was moved by a quarter of the draws' sd, and by more than three Monte Carlo errors.

    Parameters
    ----------
    sample : Sample
    mean, sd : float
        Of the approximation.
    support : tuple of float
        Of the prior.
    converged : bool
        If the draws have not converged there is no verdict, unless every ensemble by itself shows another mode.
    """
    if not converged:
        return _unconverged(sample, mean)
    if not np.isfinite(sd):
        return WIDE
    if _elsewhere(sample, mean, sd) or has_other_mode(sample, mean):
        return MODE
    own = float(sample.whole.std())
    low = _end(sample, mean, sd, own)
    high = _end(sample.of_values(np.negative), -mean, sd, own)
    if low == high == FINE:
        distance, error = wasserstein_distance(sample, mean, sd)
        return SHAPE if distance - ERRORS * error > END_SHIFT else FINE
    if _piled(sample, support, own):
        return SHAPE
    quantiles = np.quantile(sample.whole, [TAIL, 1.0 - TAIL])
    outwards = np.array([mean - END * sd - quantiles[0], quantiles[1] - mean - END * sd]) / own
    if np.all(outwards > 0.5 * END_SHIFT):
        return NARROW
    return WIDE if np.all(outwards < -0.5 * END_SHIFT) else SHAPE


def _unconverged(sample: Sample, mean: float) -> str:
    every = all(has_other_mode(ensemble, mean) for ensemble in sample.by_ensemble())
    return MODE if every else UNCONVERGED


def _end(sample: Sample, mean: float, sd: float, own: float) -> str:
    """Return the verdict on the lower end of the 90 % interval; `own` is the sd of the draws."""
    end = mean - END * sd
    beyond, error = sample.share(lambda x: x < end - END_SHIFT * own, TAIL)
    if beyond > TAIL + ERRORS * error:
        return NARROW
    beyond, error = sample.share(lambda x: x < end + END_SHIFT * own, TAIL)
    return WIDE if beyond < TAIL - ERRORS * error else FINE


def _elsewhere(sample: Sample, mean: float, sd: float) -> bool:
    """Return whether less than 5 % of the draws lie on this side of either end of mean ± 3 sd."""
    for sign in (1.0, -1.0):
        within, error = sample.share(lambda x, s=sign: s * (x - mean) < REACH * sd, FEW)  # type: ignore[misc]
        if within < FEW - ERRORS * error:
            return True
    return False


def _piled(sample: Sample, support: tuple[float, float], own: float) -> bool:
    """Return whether more than 5 % of the draws lie within a quarter of their sd of an end of the support.

    They are 1.8 % of a normal posterior cut two sds from its centre, and 12 % of one cut at its centre.
    """
    for end in support:
        if np.isfinite(end):
            near, error = sample.share(lambda x, e=end: np.abs(x - e) < EDGE * own, PILED)  # type: ignore[misc]
            if near > PILED + ERRORS * error:
                return True
    return False


def joint_verdict(
    points: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    sampled: Callable[[np.ndarray], Sample],
    pareto_k: tuple[float, float],
    converged: bool,
) -> str:
    """Return the verdict on a normal approximation of all coordinates together.

    Ellipsoids of 50, 90 and 95 % hold too few draws if they still do after their radii grew by 15 % (as far as a
    quarter of a sd moves the ends of a 90 % interval), and too many accordingly; by more than three Monte Carlo errors.
    The approximation is then too narrow or too wide if a normal distribution with the draws' own mean and covariance
    would be fine and a shift of the mean alone is not what is wrong; otherwise, and where the Pareto k̂ is above 0.7 by
    its error, the shape is wrong.

    Parameters
    ----------
    points : array (draws, dimension)
    mean, covariance : array (dimension,), (dimension, dimension)
    sampled : callable
        Makes a Sample of values (draws,).
    pareto_k : tuple of float
        With its error.
    converged : bool
        See `marginal_verdict`.
    """
    own_mean, own_covariance = points.mean(axis=0), np.atleast_2d(np.cov(points.T))
    direction = _widest(own_covariance)
    along = sampled(points @ direction)
    if not converged:
        return _unconverged(along, float(mean @ direction))
    if not np.isfinite(covariance).all():
        return WIDE
    if has_other_mode(along, float(mean @ direction)):
        return MODE
    found = _ellipsoids(sampled(radii(points, mean, covariance)), mean.size)
    if found == FINE:
        return SHAPE if pareto_k[0] - pareto_k[1] > USABLE_K else FINE
    if _ellipsoids(sampled(radii(points, own_mean, own_covariance)), mean.size) != FINE:
        return SHAPE
    return SHAPE if _ellipsoids(sampled(radii(points, own_mean, covariance)), mean.size) == FINE else found


def ellipsoid_radii(levels: np.ndarray, dimension: int) -> np.ndarray:
    """Return the Mahalanobis radii of the ellipsoids that hold these probabilities."""
    return np.sqrt(chdtri(dimension, 1.0 - np.asarray(levels)))


def _ellipsoids(distances: Sample, dimension: int) -> str:
    """Return whether the ellipsoids hold as many draws as they should."""
    found = set()
    for level, radius in zip(LEVELS, ellipsoid_radii(np.array(LEVELS), dimension), strict=True):
        larger, error = distances.share(lambda r, R=radius: r < SCALE * R, level)  # type: ignore[misc]
        if larger < level - ERRORS * error:
            found.add(NARROW)
        smaller, error = distances.share(lambda r, R=radius: r < R / SCALE, level)  # type: ignore[misc]
        if smaller > level + ERRORS * error:
            found.add(WIDE)
    return found.pop() if len(found) == 1 else SHAPE if found else FINE


def _widest(covariance: np.ndarray) -> np.ndarray:
    """Return the direction along which draws, in units of their sds, spread most."""
    scale = np.sqrt(np.diag(covariance))
    safe = np.where(scale > 0.0, scale, 1.0)
    return np.linalg.eigh(covariance / np.outer(safe, safe))[1][:, -1] / safe
