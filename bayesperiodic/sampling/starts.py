"""Start points of the walkers, and Laplace approximation in sampling coordinates."""

from collections.abc import Callable

import numpy as np

from bayesperiodic._linalg import covariance_cholesky
from bayesperiodic.density.log_posterior import LogPosterior, SamplingCoordinates
from bayesperiodic.estimation.modes import Mode
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.noise_estimate import estimate_noise
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.sampling.proposals import HEAVY_TAILS, AffineTransform, CallCount, StudentMixture
from bayesperiodic.sampling.surrogate import Surrogate

FROM_LAPLACE, FROM_PRIOR, OVERDISPERSED = "laplace", "prior", "overdispersed"
STARTS = (FROM_LAPLACE, FROM_PRIOR, OVERDISPERSED)
SPREAD = {FROM_LAPLACE: 2.0, OVERDISPERSED: 5.0}
REDRAWS = 100
NOISE_SPREAD = 0.3
# Walkers of each ensemble that start at an optimum other than the estimate, at least; optima of less mass have none.
FEWEST_WALKERS, LEAST_MASS = 2, 1e-3


def laplace_approximation(density: SamplingCoordinates, fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance in sampling coordinates; raise a ValueError if the estimate has none."""
    laplace = _laplace(density, fit)
    if laplace is None:
        remedy = "run map_estimate from another start"
        if fit.checks and fit.undetermined:
            remedy = f"fix what the data do not determine ({'; '.join(fit.undetermined)})"
        elif fit.at_ends:
            remedy = f"widen the prior of {', '.join(map(repr, fit.at_ends))}, which is at the end of its support"
        elif fit.without_noise:
            remedy = f"give the variance of {', '.join(map(repr, fit.without_noise))}, whose data contain no noise"
        raise ValueError(
            "fit: its joint covariance must be finite, got none, so there is no Laplace approximation to start from; "
            f"{remedy}, or take start='prior'."
        )
    return laplace


def _laplace(density: SamplingCoordinates, mode: MapEstimate | Mode) -> tuple[np.ndarray, np.ndarray] | None:
    """Return mean and covariance in sampling coordinates at an optimum; None if there is no normal approximation."""
    labels = [*density.labels]
    mean = np.array([mode.joint_mode.get(label, np.nan) for label in labels])
    covariance = mode.joint_covariance.loc[labels, labels].to_numpy().copy()
    if not np.isfinite(mean).all() or not np.isfinite(covariance).all():
        return None
    always = density.problem.logarithmic
    slopes = np.where(always & ~density.logarithmic, mean[: always.size], 1.0)
    covariance[: always.size] *= slopes[:, None]
    covariance[:, : always.size] *= slopes
    logs = np.concatenate([density.logarithmic, np.ones(len(density.free), dtype=bool)])
    return np.where(logs, np.log(np.where(logs, mean, 1.0)), mean), covariance


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

    The first two start walkers at every optimum of the estimate, see `MapEstimate.modes`: in proportion to its mass, at
    least two at each, and at least two at the estimate.
    """
    calls = CallCount() if calls is None else calls
    if start == FROM_PRIOR:
        return _finite(density, calls, lambda count: _from_prior(density, count, generator), walkers, start)

    def drawn(mean: np.ndarray, covariance: np.ndarray) -> Callable[[int], np.ndarray]:
        factor = SPREAD[start] * covariance_cholesky(covariance)
        return lambda count: mean + generator.standard_normal((count, mean.size)) @ factor.T

    (_, _, first), *others = laplace_modes(density, fit)
    points = _finite(density, calls, drawn(*first), walkers, start)
    left = walkers
    for _, mass, laplace in others:
        count = min(max(FEWEST_WALKERS, round(mass * walkers)), left - FEWEST_WALKERS)
        if count > 0:
            there = _finite(density, calls, drawn(*laplace), count, start, needed=0)
            points[left - len(there) : left] = there
            left -= len(there)
    return points


def laplace_modes(
    density: SamplingCoordinates, fit: MapEstimate
) -> list[tuple[int, float, tuple[np.ndarray, np.ndarray]]]:
    """Return row in `MapEstimate.modes`, mass, and mean and covariance of the optima with a notable mass.

    The first one is the estimate. Raises a ValueError if it has no Laplace approximation.
    """
    modes = [(0, 1.0 - sum(mode.mass for mode in fit.other_modes), laplace_approximation(density, fit))]
    for row, mode in enumerate(fit.other_modes, 1):
        laplace = _laplace(density, mode)
        if laplace is not None and mode.mass > LEAST_MASS:
            modes.append((row, mode.mass, laplace))
    return modes


def laplace_mixture(density: SamplingCoordinates, fit: MapEstimate) -> tuple[StudentMixture, np.ndarray]:
    """Return Student t distributions at the optima, in sampling coordinates, and their rows in `MapEstimate.modes`.

    Raises a ValueError if the estimate has no Laplace approximation.
    """
    rows, masses, laplaces = zip(*laplace_modes(density, fit), strict=True)
    means, covariances = (np.stack(parts) for parts in zip(*laplaces, strict=True))
    known = np.isfinite(masses).all()
    factors = np.stack([covariance_cholesky(covariance) for covariance in covariances])
    weights = np.array(masses) / np.sum(masses) if known else np.full(len(rows), 1.0 / len(rows))
    return StudentMixture(weights, means, factors, np.full(len(rows), HEAVY_TAILS)), np.array(rows)


def surrogate_of(density: SamplingCoordinates, fit: MapEstimate) -> Surrogate | None:
    """Return the surrogate at the estimate; None without positive parameters, or where there is none."""
    laplace = _laplace(density, fit) if density.logarithmic.any() else None
    return laplace and Surrogate.of(density, *laplace)


def mode_of(density: SamplingCoordinates, fit: MapEstimate, points: np.ndarray) -> np.ndarray | None:
    """Return to which optimum points (…, dimension) belong, its row in `MapEstimate.modes` (…); None if there is one.

    It is the one whose Laplace approximation, with heavy tails, is the densest there.
    """
    if not fit.other_modes:
        return None
    try:
        mixture, rows = laplace_mixture(density, fit)
    except ValueError:
        return None
    nearest = mixture.log_components(points.reshape(-1, density.dimension)).argmax(axis=1)
    return np.asarray(rows[nearest].reshape(points.shape[:-1]))


def _finite(
    density: LogPosterior,
    calls: CallCount,
    drawn: Callable[[int], np.ndarray],
    wanted: int,
    start: str,
    needed: int | None = None,
) -> np.ndarray:
    """Return drawn points with a finite density, `wanted` of them; other draws are repeated.

    If there are fewer, raise a ValueError unless there are as many as `needed`, by default all.
    """
    points, tried = np.empty((0, density.dimension)), 0
    while len(points) < wanted and tried < REDRAWS * wanted:
        candidates = drawn(wanted)
        tried += wanted
        if len(candidates):
            evaluation = density.evaluate(candidates, threads=None)
            calls.add(evaluation.status)
            points = np.concatenate([points, candidates[np.isfinite(evaluation.log_prob)]])
    if len(points) < (wanted if needed is None else needed):
        other = "give a converged fit of this problem, or start='prior'"
        remedy = "narrow the priors, see prior_predictive(problem)" if start == FROM_PRIOR else other
        raise ValueError(
            f"start: must give points with a finite log-posterior, got {start!r}, where {1 - len(points) / tried:.1%} "
            f"of {tried} start points have none; {remedy}."
        )
    return points[:wanted]


def _from_prior(density: LogPosterior, size: int, generator: np.random.Generator) -> np.ndarray:
    """Return coordinates of draws from the priors whose periodic solves converge, (at most size, dimension)."""
    problem = density.problem
    theta = problem.joint_prior.sample(size, generator)
    simulation = density.solver.solve(theta, whole=True)
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
        if start != FROM_PRIOR:
            raise
    points = start_points(density, fit, start, 10 * density.dimension, generator)
    return AffineTransform(points.mean(axis=0), np.diag(points.std(axis=0)))
