"""Where the walkers start."""

from collections.abc import Callable
from functools import partial
from itertools import combinations

import numpy as np

from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.posterior.likelihood import estimate_noise
from bayesperiodic.sampling.coordinates import RidgeMap, SamplingDensity

LAPLACE, PRIOR, OVERDISPERSED = "laplace", "prior", "overdispersed"
STARTS = (LAPLACE, PRIOR, OVERDISPERSED)
SPREAD = {LAPLACE: 2.0, OVERDISPERSED: 5.0}
REDRAWS = 100
NOISE_SPREAD = 0.3
# A mirrored mode counts from this share of the first one's density on, and this many standard deviations away; how many
# signs are turned in all combinations.
CREDIBLE, SEPARATE, MOST_SIGNS = 1e-3, 3.0, 4
FEWEST = 2


def start_points(
    density: SamplingDensity, fit: MapEstimate, start: str, walkers: int, generator: np.random.Generator
) -> np.ndarray:
    """Return start points (walkers, dimension) with a finite density, drawn again until there are enough.

    "laplace" and "overdispersed" draw from the Laplace approximation with twice and five times its standard deviations,
    "prior" draws the parameters from their priors, and the noise parameters around those that suit them best.

    Where turning the signs of signed parameters leads to another mode, as in a·b with both negative, the first two of
    these also start walkers there: its share, but at least two, and no more than half of them in all such modes.

    Raises
    ------
    ValueError
        If after a hundred times as many draws there are too few.
    """
    if start == PRIOR:
        return _finite(density, lambda count: _from_prior(density, count, generator), walkers, start)
    mean, covariance = density.laplace(fit)
    scale = np.sqrt(np.diag(covariance))
    factor = SPREAD[start] * scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale))

    def drawn(count: int) -> np.ndarray:
        return mean + generator.standard_normal((count, mean.size)) @ factor.T

    points = _finite(density, drawn, walkers, start)
    left = walkers // 2
    for signs, share in mirrored_modes(density, mean, covariance):
        count = min(max(FEWEST, round(share * walkers)), left)
        points[left - count : left] = _finite(density, partial(_turned, signs, drawn), count, start)
        left -= count
    return points


def _turned(signs: np.ndarray, drawn: Callable[[int], np.ndarray], count: int) -> np.ndarray:
    return signs * drawn(count)


def mirrored_modes(
    density: SamplingDensity, mean: np.ndarray, covariance: np.ndarray
) -> list[tuple[np.ndarray, float]]:
    """Return the signs (dimension,) that lead from a mode to others, and the density there over its own; highest first.

    The signs of up to four signed parameters are turned in all combinations, those of more one by one and all together.
    """
    supports = density.problem.joint_prior.supports.values()
    signed = [i for i, (low, high) in enumerate(supports) if low < 0.0 < high]
    sizes = range(1, len(signed) + 1) if len(signed) <= MOST_SIGNS else (1, len(signed))
    turned = [list(columns) for size in sizes for columns in combinations(signed, size)]
    if not turned:
        return []
    signs = np.ones((len(turned), mean.size))
    for row, columns in zip(signs, turned, strict=True):
        row[columns] = -1.0
    values = density(np.concatenate([mean[None], signs * mean]))
    values = values[:, 0] if values.ndim > 1 else values
    with np.errstate(over="ignore"):
        shares = np.exp(values[1:] - values[0])
    steps = (signs - 1.0) * mean
    far = np.einsum("mi,mi->m", steps, np.linalg.solve(covariance, steps.T).T) > SEPARATE**2
    kept = [i for i in np.argsort(-shares) if far[i] and shares[i] > CREDIBLE]
    return [(signs[i], float(shares[i])) for i in kept]


def _finite(density: SamplingDensity, drawn: Callable[[int], np.ndarray], wanted: int, start: str) -> np.ndarray:
    """Return so many drawn points with a finite density, drawn again until there are enough."""
    points, tried = np.empty((0, density.dimension)), 0
    while len(points) < wanted and tried < REDRAWS * wanted:
        candidates = drawn(wanted)
        tried += wanted
        values = density(candidates) if len(candidates) else np.empty(0)
        points = np.concatenate([points, candidates[np.isfinite(values[:, 0] if values.ndim > 1 else values)]])
    if len(points) < wanted:
        other = "give a converged fit of this problem, or start='prior'"
        remedy = "narrow the priors, see prior_predictive(problem)" if start == PRIOR else other
        raise ValueError(
            f"start: {start!r} is not allowed; of {tried} start points drawn {1 - len(points) / tried:.1%} have no "
            f"finite log-posterior, so the walkers cannot start; {remedy}."
        )
    return points[:wanted]


def _from_prior(density: SamplingDensity, size: int, generator: np.random.Generator) -> np.ndarray:
    """Return coordinates of draws from the priors whose periodic solves converge, (at most size, dimension)."""
    problem = density.problem
    theta = problem.joint_prior.sample(size, generator)
    residuals, status = problem.residuals(theta, density.threads)
    likelihood, noise = problem.likelihood, []
    for i in range(len(residuals[0]) if residuals else 0):
        best = estimate_noise(likelihood, [r[i] for r in residuals], likelihood.guess(), 1.0)
        free = [likelihood.names.index(name) for name in likelihood.free]
        best[free] *= np.exp(NOISE_SPREAD * generator.standard_normal(len(free)))
        noise.append(best)
    return density.from_natural(theta[status == CONVERGED], np.array(noise).reshape(-1, len(likelihood.names)))


def walking_axes(density: SamplingDensity, fit: MapEstimate, start: str, generator: np.random.Generator) -> RidgeMap:
    """Return the axes of the walk: those of the Laplace approximation, or the spread of the start where it has none."""
    try:
        return RidgeMap.of(*density.laplace(fit))
    except ValueError:
        if start != PRIOR:
            raise
    points = start_points(density, fit, start, 10 * density.dimension, generator)
    return RidgeMap(points.mean(axis=0), np.diag(points.std(axis=0)))
