"""The Laplace approximations that an estimate carries, and how good they are as importance proposals."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesperiodic._parallel import available_cores
from bayesperiodic.diagnostics.verdicts import (
    FINE,
    LEVELS,
    MODE,
    NARROW,
    SHAPE,
    USABLE_K,
    WIDE,
    Sample,
    ellipsoid_radii,
    joint_verdict,
    marginal_verdict,
    normal_draws,
    radii,
    skewness,
    wasserstein_distance,
)
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.coordinates import COLLAPSED, NATURAL, SamplingDensity
from bayesperiodic.sampling.posterior import Posterior

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
    k, top = convergence.pareto_k(log_weights), log_weights.max()
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


# A share of 5 % under Laplace is then off by at most √((1/0.98 − 1)·0.05·0.95) = 3 % (Cauchy-Schwarz), as far as a
# quarter of a sd moves it. How the tail of such even weights falls off, which is all that k̂ tells, does not matter.
EVEN, NO_TAIL = 0.98, (0.0, 0.0)
QUANTILES = {"q05": (0.05, -1.6448536269514722), "q50": (0.5, 0.0), "q95": (0.95, 1.6448536269514722)}


@dataclass(frozen=True)
class Scores:
    """A Laplace approximation, the draws in its coordinates, and what is to be said of the two.

    Attributes
    ----------
    laplace : Approximation
    samples : dict of str to Sample
        By name.
    distances : Sample
        Mahalanobis distances from Laplace's centre; NaN without a finite covariance.
    verdicts : dict of str to str
        By name.
    pareto_k : tuple of float
        With its error.
    efficiency : float
        Of Laplace as an importance proposal, see `importance_k`.
    joint : str
        The verdict on all together.
    """

    laplace: Approximation
    samples: dict[str, Sample]
    distances: Sample
    verdicts: dict[str, str]
    pareto_k: tuple[float, float]
    efficiency: float
    joint: str

    @property
    def usable_as_proposal(self) -> bool:
        """False if the importance weights have a heavy tail that matters."""
        return self.efficiency > EVEN or not self.pareto_k[0] > USABLE_K

    @property
    def fine(self) -> bool:
        """True if every verdict is "fine"."""
        return {self.joint, *self.verdicts.values()} == {FINE}

    def inside(self, levels: np.ndarray) -> np.ndarray:
        """Return the shares of draws in the ellipsoids that hold these probabilities, and their errors, (2, levels)."""
        if not np.isfinite(self.laplace.covariance).all():
            return np.full((2, levels.size), np.nan)
        limits = ellipsoid_radii(levels, self.laplace.mean.size)
        pairs = [
            self.distances.share(lambda r, R=limit: r < R, level)  # type: ignore[misc]
            for limit, level in zip(limits, levels, strict=True)
        ]
        return np.array(pairs).T


def scores(
    problem: Problem, fit: MapEstimate, posterior: Posterior, laplace: Approximation, coordinates: str
) -> Scores:
    """Return the scores of a Laplace approximation."""
    points = laplace.points(posterior)
    ensemble = posterior.data["posterior"]["ensemble"].to_numpy()
    samples = {name: Sample.of(points[:, i], ensemble, posterior.ess[name]) for i, name in enumerate(laplace.names)}
    jointly = partial(Sample.of, ensemble=ensemble, size=min(posterior.ess[name] for name in laplace.names))
    verdicts = {
        name: marginal_verdict(
            samples[name], float(laplace.mean[i]), float(laplace.sds[i]), laplace.supports[i], posterior.converged
        )
        for i, name in enumerate(laplace.names)
    }
    finite = np.isfinite(laplace.covariance).all()
    distances = radii(points, laplace.mean, laplace.covariance) if finite else np.full(len(points), np.nan)
    *k, efficiency = importance_k(problem, fit, coordinates)
    tail = NO_TAIL if efficiency > EVEN else (k[0], k[1])
    joint = joint_verdict(points, laplace.mean, laplace.covariance, jointly, tail, posterior.converged)
    joint = _reconciled(joint, set(verdicts.values()))
    return Scores(laplace, samples, jointly(distances), verdicts, (k[0], k[1]), efficiency, joint)


def _reconciled(joint: str, rows: set[str]) -> str:
    """Return the joint verdict in the light of those on the rows: it is not better than all, nor milder than shape."""
    if MODE in rows:
        return MODE
    if joint in (NARROW, WIDE) and SHAPE in rows:
        return SHAPE
    if joint == FINE and FINE not in rows:
        return rows.pop() if len(rows) == 1 else SHAPE
    return joint


def row(sample: Sample, mean: float, sd: float) -> dict[str, float]:
    """Return the figures of one quantity and their Monte Carlo errors, see `Comparison.table`."""
    own_mean, own = float(sample.whole.mean()), float(sample.whole.std(ddof=1))
    spread = sample.error(lambda x: np.std(x, axis=-1, ddof=1))
    found = {"map": mean, "laplace_sd": sd, "mean": own_mean, "sd": own}
    found |= {"shift": (own_mean - mean) / own, "shift_mcse": sample.error(lambda x: x.mean(axis=-1)) / own}
    found |= {"sd_ratio": sd / own, "sd_ratio_mcse": sd / own * spread / own}
    found["skewness"], found["skewness_mcse"] = sample.estimate(skewness)
    for label, (probability, z) in QUANTILES.items():
        value, error = sample.estimate(lambda x, p=probability: np.quantile(x, p, axis=-1))  # type: ignore[misc]
        end = mean + z * sd if z else mean
        found |= {f"laplace_{label}": end, label: value}
        found |= {f"{label}_difference": (value - end) / own, f"{label}_difference_mcse": error / own}
    found["wasserstein"], found["wasserstein_mcse"] = wasserstein_distance(sample, mean, sd)
    return found


def joint_row(scored: Scores) -> dict[str, float]:
    """Return the figures of all coordinates together, see `Comparison.joint`."""
    found: dict[str, float] = {"dimension": scored.laplace.mean.size}
    for level, share, error in zip(LEVELS, *scored.inside(np.array(LEVELS)), strict=True):
        key = f"share_{100 * level:.0f}"
        found |= {key: float(share), f"{key}_mcse": float(error)}
    return found | {
        "pareto_k": scored.pareto_k[0],
        "pareto_k_mcse": scored.pareto_k[1],
        "efficiency": scored.efficiency,
    }
