"""The coordinates that sampling works in, and the posterior density in them."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from bayesperiodic.estimation.laplace import logarithmic
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.posterior.density import likelihood_slope
from bayesperiodic.posterior.noise import FLAT, JEFFREYS, KNOWN, SPECTRAL, Circulant, Independent
from bayesperiodic.posterior.problem import Problem

RIDGE, NATURAL = "ridge", "natural"
SAMPLED, COLLAPSED = "sampled", "collapsed"


class SamplingDensity:
    """The log-posterior over sampling coordinates, many points at a time.

    A parameter whose prior's support is (0, ∞) is replaced by its logarithm, any other stays as it is; then follow the
    logarithms of the free noise parameters. Densities carry the Jacobian. The value depends on the point alone.

    Parameters
    ----------
    problem : Problem
        With its anchors set.
    threads : int
        Shared by the points of one call.
    coordinates : "ridge" or "natural"
        "natural" leaves positive parameters as they are.
    variances : "sampled" or "collapsed"
        "collapsed" integrates the variances out, where that can be done in closed form.

    Attributes
    ----------
    labels : tuple of str
        What the coordinates stand for.
    collapsed : tuple of str
        Variances that were integrated out.
    calls : int
        Points evaluated so far.
    failures : Counter
        Points with a failed periodic solve, by status.
    """

    def __init__(self, problem: Problem, threads: int = 1, coordinates: str = RIDGE, variances: str = SAMPLED):
        self.problem = problem
        self.threads = threads
        self.coordinates = coordinates
        self.logarithmic = logarithmic(problem) & (coordinates == RIDGE)
        self.collapsed = collapsible(problem) if variances == COLLAPSED else ()
        self.free = tuple(name for name in problem.free_noise if name not in self.collapsed)
        self.labels = (*problem.names, *self.free)
        self.calls = 0
        self.failures: Counter[str] = Counter()

    @property
    def dimension(self) -> int:
        """Number of sampling coordinates."""
        return len(self.labels)

    def to_natural(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (…, names) and all noise parameters (…, noise_names), those integrated out as 1."""
        likelihood, count = self.problem.likelihood, len(self.problem.names)
        theta = np.array(points[..., :count])
        with np.errstate(over="ignore"):
            theta[..., self.logarithmic] = np.exp(theta[..., self.logarithmic])
            free = np.ones((*points.shape[:-1], len(likelihood.free)))
            free[..., [likelihood.free.index(name) for name in self.free]] = np.exp(points[..., count:])
        return theta, likelihood.complete(free)

    def from_natural(self, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return coordinates (…, dimension) from θ (…, names) and all noise parameters (…, noise_names)."""
        points = np.array(theta)
        points[..., self.logarithmic] = np.log(points[..., self.logarithmic])
        own = [self.problem.noise_names.index(name) for name in self.free]
        return np.concatenate([points, np.log(noise[..., own])], axis=-1)

    def laplace(self, fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and covariance of the Laplace approximation in sampling coordinates.

        Raises
        ------
        ValueError
            If the estimate has none.
        """
        labels = [*self.labels]
        mode = np.array([fit.joint_mode.get(label, np.nan) for label in labels])
        covariance = fit.joint_covariance.loc[labels, labels].to_numpy().copy()
        if not np.isfinite(mode).all() or not np.isfinite(covariance).all():
            remedy = "run map_estimate from another start"
            if fit.undetermined:
                remedy = f"fix what the data do not determine ({'; '.join(fit.undetermined)})"
            elif fit.at_ends:
                remedy = f"widen the prior of {', '.join(map(repr, fit.at_ends))}, which is at the end of its support"
            raise ValueError(
                "fit: its joint covariance is not finite, so there is no Laplace approximation to start from; "
                f"{remedy}, or take start='prior'."
            )
        always = logarithmic(self.problem)
        slopes = np.where(always & ~self.logarithmic, mode[: always.size], 1.0)
        covariance[: always.size] *= slopes[:, None]
        covariance[:, : always.size] *= slopes
        logs = np.concatenate([self.logarithmic, np.ones(len(self.free), dtype=bool)])
        return np.where(logs, np.log(np.where(logs, mode, 1.0)), mode), covariance

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the log-density as `evaluate` does, and count points and failures."""
        values, status = self.evaluate(points)
        self.calls += len(points)
        self.failures.update(counted(status))
        return values

    def evaluate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density and how the solves ended, each of its point alone.

        Parameters
        ----------
        points : array (points, dimension)

        Returns
        -------
        values : array (points,), or (points, 1 + collapsed)
            The log-density, −inf where a solve fails; then, with variances integrated out, M of each of them.
        status : int array (points,)
            The worst of all experiments; converged where nothing was solved.
        """
        theta, noise = self.to_natural(points)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            values = np.asarray(self.problem.log_prior(theta)) + self.problem.likelihood.log_prior(noise)
        values = values + points[:, : len(self.problem.names)][:, self.logarithmic].sum(axis=1)
        inside, moments = np.isfinite(values), np.full((len(points), len(self.collapsed)), np.nan)
        ended = np.full(len(points), CONVERGED)
        if inside.any():
            residuals, status = self.problem.misfits(theta[inside], self.threads)
            ended[inside] = status
            good = np.flatnonzero(inside)[status == CONVERGED]
            values[inside] = np.where(status == CONVERGED, values[inside], -np.inf)
            if good.size:
                values[good] += self.problem.likelihood(residuals, noise[good])
                if self.collapsed:
                    by_name = self.problem.likelihood.moments(residuals)
                    moments[good] = np.stack([by_name[name] for name in self.collapsed], axis=-1)
                    values[good] += np.sum(0.5 * moments[good] + self._integrals(moments[good]), axis=-1)
        values = np.where(inside & np.isfinite(values), values, -np.inf)
        return (np.concatenate([values[:, None], moments], axis=1) if self.collapsed else values), ended

    def value_and_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log-density of one point (dimension,) and its gradient there, variances not integrated out.

        The value is that of `__call__`. A forced model takes one periodic solve and one transposed one. Where a solve
        fails, or a derivative does not exist, which counts as "singular", the value is −inf and the gradient zero.
        """
        theta, noise = self.to_natural(point)
        self.calls += 1
        nothing, likelihood = (-np.inf, np.zeros(self.dimension)), self.problem.likelihood
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            value = float(self.problem.log_prior(theta) + likelihood.log_prior(noise))
            value += float(point[: theta.size][self.logarithmic].sum())
            if not np.isfinite(value):
                return nothing
            slope = likelihood_slope(self.problem, theta, noise)
            if slope.status != STATUSES[CONVERGED]:
                self.failures[slope.status] += 1
            value += slope.value
            if not np.isfinite(value):
                return nothing
            by_theta = slope.by_theta + self.problem.joint_prior.gradient(theta)
        by_theta[self.logarithmic] = by_theta[self.logarithmic] * theta[self.logarithmic] + 1.0
        free = [self.problem.noise_names.index(name) for name in self.free]
        gradient = np.concatenate([by_theta, slope.by_noise[free]])
        if not np.isfinite(gradient).all():
            self.failures[STATUSES[SINGULAR]] += 1
            return nothing
        return value, gradient

    def _integrals(self, moments: np.ndarray) -> np.ndarray:
        """Return ln ∫ exp(−½ [n ln v + M/v]) p(v) dv of each collapsed variance."""
        shape = self._shapes
        with np.errstate(divide="ignore"):
            return gammaln(shape) - shape * np.log(0.5 * moments)

    @property
    def _shapes(self) -> np.ndarray:
        counts = np.array([self.problem.likelihood.counts[name] for name in self.collapsed])
        return 0.5 * counts - (1.0 if self.problem.noise.prior == FLAT else 0.0)

    def expanded(
        self, points: np.ndarray, log_density: np.ndarray, moments: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the coordinates of the full density and its values, for points of the one without variances.

        The variances are drawn from what was integrated out, InvGamma(n/2, M/2), or with the flat prior of shape
        n/2 − 1.

        Parameters
        ----------
        points : array (…, dimension)
        log_density : array (…,)
        moments : array (…, collapsed)
            M behind each variance.
        """
        variances = 0.5 * moments / generator.gamma(self._shapes, size=moments.shape)
        joint = -self._shapes * np.log(variances) - 0.5 * moments / variances
        log_density = log_density + np.sum(joint - self._integrals(moments), axis=-1)
        count = len(self.problem.names)
        columns = {name: points[..., count + i] for i, name in enumerate(self.free)}
        columns |= {name: np.log(variances[..., i]) for i, name in enumerate(self.collapsed)}
        noise = np.stack([columns[name] for name in self.problem.free_noise], axis=-1)
        return np.concatenate([points[..., :count], noise], axis=-1), log_density


def counted(status: np.ndarray) -> Counter[str]:
    """Return how many solves ended in each of the ways that are failures."""
    return Counter(STATUSES[code] for code in status[status != CONVERGED])


def collapsible(problem: Problem) -> tuple[str, ...]:
    """Return the free variances that can be integrated out in closed form, those with the prior 1/v or a flat one.

    The errors are independent, or of whole periods with a spectrum of known shape.
    """
    noise, counts = problem.noise, problem.likelihood.counts
    shaped = isinstance(noise, Circulant) and all(b.kind in (SPECTRAL, KNOWN) for b in problem.likelihood.blocks)
    closed = (isinstance(noise, Independent) or shaped) and noise.prior in (JEFFREYS, FLAT)
    known = all(name in counts for name in problem.free_noise)
    return tuple(name for name in problem.free_noise if closed and name in counts and (known or not shaped))


@dataclass(frozen=True)
class RidgeMap:
    """Sampling coordinates x = origin + axes·u, in which the Laplace approximation is a unit sphere.

    emcee's moves do not care about linear maps, but for the small jitter that differential evolution adds to every
    proposal: in coordinates whose scales differ by powers of ten it would stop the narrow ones.

    Attributes
    ----------
    origin : array (dimension,)
    axes : array (dimension, dimension)
        Columns are the eigenvectors of the Laplace covariance, times the standard deviations along them.
    """

    origin: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray, covariance: np.ndarray) -> "RidgeMap":
        """Return the map of a normal distribution."""
        scale = np.sqrt(np.diag(covariance))
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        return cls(mean, scale[:, None] * vectors * np.sqrt(np.maximum(values, np.finfo(float).eps)))

    def outwards(self, u: np.ndarray) -> np.ndarray:
        """Return x (…, dimension)."""
        return self.origin + u @ self.axes.T

    def inwards(self, x: np.ndarray) -> np.ndarray:
        """Return u (…, dimension)."""
        return np.linalg.solve(self.axes, (x - self.origin).reshape(-1, self.origin.size).T).T.reshape(x.shape)
