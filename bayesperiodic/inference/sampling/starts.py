"""Where the walkers start."""

import numpy as np

from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.noise.estimate import estimate_noise
from bayesperiodic.inference.sampling.coordinates import RidgeMap, SamplingDensity
from bayesperiodic.periodic.compiled import CONVERGED

LAPLACE, PRIOR, OVERDISPERSED = "laplace", "prior", "overdispersed"
STARTS = (LAPLACE, PRIOR, OVERDISPERSED)
SPREAD = {LAPLACE: 2.0, OVERDISPERSED: 5.0}
REDRAWS = 100
NOISE_SPREAD = 0.3


def start_points(
    density: SamplingDensity, fit: MapEstimate, start: str, walkers: int, generator: np.random.Generator
) -> np.ndarray:
    """Return start points (walkers, dimension) with a finite density, drawn again until there are enough.

    "laplace" and "overdispersed" draw from the Laplace approximation with twice and five times its standard deviations,
    "prior" draws the parameters from their priors, and the noise parameters around those that suit them best.

    Raises
    ------
    ValueError
        If after a hundred times as many draws there are too few.
    """
    points, drawn = np.empty((0, density.dimension)), 0
    while len(points) < walkers and drawn < REDRAWS * walkers:
        if start == PRIOR:
            candidates = _from_prior(density, walkers, generator)
        else:
            mean, covariance = density.laplace(fit)
            scale = np.sqrt(np.diag(covariance))
            factor = scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale))
            candidates = mean + SPREAD[start] * generator.standard_normal((walkers, mean.size)) @ factor.T
        drawn += walkers
        values = density(candidates) if len(candidates) else np.empty(0)
        points = np.concatenate([points, candidates[np.isfinite(values[:, 0] if values.ndim > 1 else values)]])
    if len(points) < walkers:
        raise ValueError(
            f"fit: of {drawn} start points drawn (start={start!r}) {1 - len(points) / drawn:.1%} have no finite "
            "log-posterior, so the walkers cannot start; check the priors' support and the fit's status."
        )
    return points[:walkers]


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
