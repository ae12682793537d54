"""Start points of the walkers, and Laplace approximation in sampling coordinates."""

from collections.abc import Callable
from functools import partial
from itertools import combinations

import numpy as np

from bayesperiodic._linalg import covariance_cholesky
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.posterior.density import LogPosterior, SamplingCoordinates
from bayesperiodic.posterior.likelihood import estimate_noise
from bayesperiodic.sampling.ensemble import AffineTransform, CallCount

LAPLACE, PRIOR, OVERDISPERSED = "laplace", "prior", "overdispersed"
STARTS = (LAPLACE, PRIOR, OVERDISPERSED)
SPREAD = {LAPLACE: 2.0, OVERDISPERSED: 5.0}
REDRAWS = 100
NOISE_SPREAD = 0.3
# Smallest density of a mirrored mode, as a share of the first one's, its smallest distance in standard deviations, and
# the largest number of parameters whose signs are changed in all combinations.
CREDIBLE, SEPARATE, MOST_SIGNS = 1e-3, 3.0, 4
FEWEST = 2


def laplace_approximation(density: SamplingCoordinates, fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance in sampling coordinates; raise a ValueError if the estimate has none."""
    labels = [*density.labels]
    mode = np.array([fit.joint_mode.get(label, np.nan) for label in labels])
    covariance = fit.joint_covariance.loc[labels, labels].to_numpy().copy()
    if not np.isfinite(mode).all() or not np.isfinite(covariance).all():
        remedy = "run map_estimate from another start"
        if fit.undetermined:
            remedy = f"fix what the data do not determine ({'; '.join(fit.undetermined)})"
        elif fit.at_ends:
            remedy = f"widen the prior of {', '.join(map(repr, fit.at_ends))}, which is at the end of its support"
        raise ValueError(
            "fit: its joint covariance must be finite, got none, so there is no Laplace approximation to start from; "
            f"{remedy}, or take start='prior'."
        )
    always = density.problem.logarithmic
    slopes = np.where(always & ~density.logarithmic, mode[: always.size], 1.0)
    covariance[: always.size] *= slopes[:, None]
    covariance[:, : always.size] *= slopes
    logs = np.concatenate([density.logarithmic, np.ones(len(density.free), dtype=bool)])
    return np.where(logs, np.log(np.where(logs, mode, 1.0)), mode), covariance


def start_points(
    density: LogPosterior,
    fit: MapEstimate,
    start: str,
    walkers: int,
    generator: np.random.Generator,
    calls: CallCount | None = None,
) -> np.ndarray:
    """Return start points (walkers, dimension) with a finite density; raise a ValueError if too few draws have one.

    "laplace" and "overdispersed" draw from the Laplace approximation with twice and five times its standard deviations,
    "prior" draws the parameters from their priors, and the noise parameters around their best values.

    If a change of signs of signed parameters leads to another mode, as in a·b with both negative, the first two also
    start walkers there: a part according to its density, at least two, and at most half of them in all such modes.
    """
    calls = CallCount() if calls is None else calls
    if start == PRIOR:
        return _finite(density, calls, lambda count: _from_prior(density, count, generator), walkers, start)
    mean, covariance = laplace_approximation(density, fit)
    factor = SPREAD[start] * covariance_cholesky(covariance)

    def drawn(count: int, signs: np.ndarray | float = 1.0) -> np.ndarray:
        return signs * (mean + generator.standard_normal((count, mean.size)) @ factor.T)

    points = _finite(density, calls, drawn, walkers, start)
    left = walkers // 2
    for signs, share in mirrored_modes(density, mean, covariance, calls):
        count = min(max(FEWEST, round(share * walkers)), left)
        points[left - count : left] = _finite(density, calls, partial(drawn, signs=signs), count, start)
        left -= count
    return points


def mirrored_modes(
    density: LogPosterior, mean: np.ndarray, covariance: np.ndarray, calls: CallCount | None = None
) -> list[tuple[np.ndarray, float]]:
    """Return the signs (dimension,) that lead to other modes, and their relative densities; highest first.

    Up to four signs are changed in all combinations, more than four one by one and all together.
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
    found = density.evaluate(np.concatenate([mean[None], signs * mean]), threads=None)
    if calls is not None:
        calls.add(found.status)
    values = found.log_prob
    with np.errstate(over="ignore"):
        shares = np.exp(values[1:] - values[0])
    steps = (signs - 1.0) * mean
    far = np.einsum("mi,mi->m", steps, np.linalg.solve(covariance, steps.T).T) > SEPARATE**2
    kept = [i for i in np.argsort(-shares) if far[i] and shares[i] > CREDIBLE]
    return [(signs[i], float(shares[i])) for i in kept]


def _finite(
    density: LogPosterior, calls: CallCount, drawn: Callable[[int], np.ndarray], wanted: int, start: str
) -> np.ndarray:
    """Return drawn points with a finite density, `wanted` of them; other draws are repeated."""
    points, tried = np.empty((0, density.dimension)), 0
    while len(points) < wanted and tried < REDRAWS * wanted:
        candidates = drawn(wanted)
        tried += wanted
        if len(candidates):
            found = density.evaluate(candidates, threads=None)
            calls.add(found.status)
            points = np.concatenate([points, candidates[np.isfinite(found.log_prob)]])
    if len(points) < wanted:
        other = "give a converged fit of this problem, or start='prior'"
        remedy = "narrow the priors, see prior_predictive(problem)" if start == PRIOR else other
        raise ValueError(
            f"start: must give points with a finite log-posterior, got {start!r}, where {1 - len(points) / tried:.1%} "
            f"of {tried} start points have none; {remedy}."
        )
    return points[:wanted]


def _from_prior(density: LogPosterior, size: int, generator: np.random.Generator) -> np.ndarray:
    """Return coordinates of draws from the priors whose periodic solves converge, (at most size, dimension)."""
    problem = density.problem
    theta = problem.joint_prior.sample(size, generator)
    simulation = density.simulator.solve(theta, whole=True)
    good = simulation.status == CONVERGED
    residuals = density.comparisons.residuals(simulation.at(good), threads=None)
    likelihood, noise = problem.likelihood, []
    for i in range(int(good.sum())):
        best = estimate_noise(likelihood, [r[i] for r in residuals], likelihood.guess(), 1.0)
        free = [likelihood.names.index(name) for name in likelihood.free]
        best[free] *= np.exp(NOISE_SPREAD * generator.standard_normal(len(free)))
        noise.append(best)
    return density.from_natural(theta[good], np.array(noise).reshape(-1, len(likelihood.names)))


def sampling_axes(
    density: LogPosterior, fit: MapEstimate, start: str, generator: np.random.Generator
) -> AffineTransform:
    """Return the transform by the Laplace approximation, or by the spread of the start points where there is none."""
    try:
        return AffineTransform.of(*laplace_approximation(density, fit))
    except ValueError:
        if start != PRIOR:
            raise
    points = start_points(density, fit, start, 10 * density.dimension, generator)
    return AffineTransform(points.mean(axis=0), np.diag(points.std(axis=0)))
