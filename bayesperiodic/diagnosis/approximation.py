"""The Laplace approximations that an estimate carries, and how good they are as importance proposals."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.diagnosis.distances import normal_draws
from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling import chains
from bayesperiodic.inference.sampling.coordinates import COLLAPSED, NATURAL, SamplingDensity
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.parallel import available_cores

SAMPLING = "sampling"
PROPOSALS, SEED = 8000, 1


@dataclass(frozen=True)
class Approximation:
    """A normal distribution over coordinates.

    Attributes
    ----------
    names : tuple of str
        What the coordinates stand for.
    logarithmic : bool array (names,)
        Of which the coordinate is the logarithm.
    mean, covariance : array (names,), (names, names)
    supports : tuple of tuple of float
        Of the priors, in coordinates.
    """

    names: tuple[str, ...]
    logarithmic: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    supports: tuple[tuple[float, float], ...]

    @property
    def sds(self) -> np.ndarray:
        """Standard deviations (names,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def coordinates(self) -> tuple[str, ...]:
        """What the coordinates are called, such as "ln k"."""
        return tuple(f"ln {n}" if log else n for n, log in zip(self.names, self.logarithmic, strict=True))

    def points(self, posterior: Posterior) -> np.ndarray:
        """Return all draws in these coordinates, (draws, names)."""
        columns = [posterior.draws(name) for name in self.names]
        return np.stack([np.log(x) if log else x for x, log in zip(columns, self.logarithmic, strict=True)], axis=-1)


def approximation(problem: Problem, fit: MapEstimate, coordinates: str) -> Approximation | None:
    """Return the Laplace approximation in "natural" or "sampling" coordinates; None if there is none."""
    every = tuple(problem.joint_prior.supports.values())
    if coordinates == NATURAL:
        names, covariance = [*problem.names], fit.covariance.loc[[*problem.names], [*problem.names]].to_numpy()
        plain = np.zeros(len(names), dtype=bool)
        return Approximation(problem.names, plain, problem.vector(fit.theta), covariance, every)
    density = SamplingDensity(problem)
    try:
        mean, covariance = density.laplace(fit)
    except ValueError:
        return None
    logarithmic = np.concatenate([density.logarithmic, np.ones(len(density.free), dtype=bool)])
    supports = [*every, *[(0.0, np.inf)] * len(density.free)]
    whole = (-np.inf, np.inf)
    own = tuple(whole if log else support for support, log in zip(supports, logarithmic, strict=True))
    return Approximation(density.labels, logarithmic, mean, covariance, own)


def importance_k(problem: Problem, fit: MapEstimate, coordinates: str) -> tuple[float, float, float]:
    """Return the Pareto k̂ of Laplace as an importance proposal, the error of fitting the tail, and the efficiency.

    The efficiency is 1 for equal weights: the effective share of the draws, (Σw)²/(nΣw²).

    In natural coordinates unknown variances are integrated out where that is possible in closed form. Other noise
    parameters have the joint Laplace approximation of their logarithms, there independent of the parameters. A draw
    outside the support, or without a periodic solution, has weight zero. NaN without a finite covariance.
    """
    anchored = problem.anchored(problem.vector(fit.theta), {run: s.states for run, s in fit.solutions.items()})
    cores = available_cores()
    natural = coordinates == NATURAL
    density = SamplingDensity(anchored, cores, NATURAL, COLLAPSED) if natural else SamplingDensity(anchored, cores)
    mean, covariance = _proposal(density, fit, natural)
    if not np.isfinite(covariance).all():
        return np.nan, np.nan, np.nan
    points, log_proposal = normal_draws(mean, covariance, PROPOSALS, np.random.default_rng(SEED))
    values = density(points)
    log_weights = (values[:, 0] if values.ndim > 1 else values) - log_proposal
    k, top = chains.pareto_k(log_weights), log_weights.max()
    weights = np.exp(log_weights - top) if np.isfinite(top) else np.ones(1)
    efficiency = float(weights.sum() ** 2 / np.sum(weights**2) / PROPOSALS)
    tail = min(0.2 * PROPOSALS, 3.0 * np.sqrt(PROPOSALS))
    return k, float((1.0 + max(k, 0.0)) / np.sqrt(tail)) if np.isfinite(k) else 0.0, efficiency


def _proposal(density: SamplingDensity, fit: MapEstimate, natural: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance over the coordinates of a density; not finite where there are none."""
    names = [*density.problem.names]
    try:
        mean, covariance = density.laplace(fit) if density.free or not natural else (np.empty(0), np.empty((0, 0)))
    except ValueError:
        return np.full(density.dimension, np.nan), np.full((density.dimension,) * 2, np.nan)
    if not natural:
        return mean, covariance
    noise, count = slice(len(names), None), len(names)
    whole = np.zeros((density.dimension,) * 2)
    whole[:count, :count] = fit.covariance.loc[names, names]
    whole[count:, count:] = covariance[noise, noise]
    return np.concatenate([density.problem.vector(fit.theta), mean[noise]]), whole
