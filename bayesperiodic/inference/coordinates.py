"""The coordinates that sampling works in, and the posterior density in them."""

from collections import Counter

import numpy as np

from bayesperiodic.inference.map_estimate import MapEstimate
from bayesperiodic.inference.problem import Problem
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES


class SamplingDensity:
    """The log-posterior over sampling coordinates, many points at a time.

    A parameter whose prior's support is (0, ∞) is replaced by its logarithm, any other stays as it is; then follow the
    logarithms of the unknown variances. Densities carry the Jacobian. The value depends on the point alone.

    Parameters
    ----------
    problem : Problem
        With its anchors set.
    threads : int
        Shared by the points of one call.

    Attributes
    ----------
    calls : int
        Points evaluated so far.
    failures : Counter
        Points with a failed periodic solve, by status.
    """

    def __init__(self, problem: Problem, threads: int = 1):
        self.problem = problem
        self.threads = threads
        self.logarithmic = np.array([s == (0.0, np.inf) for s in problem.joint_prior.supports.values()])
        self.labels = (*problem.names, *(f"variance[{c}]" for c in problem.free_variances))
        self._free = [problem.channels.index(c) for c in problem.free_variances]
        self._fixed = np.array([problem.fixed_variances.get(c, np.nan) for c in problem.channels])
        self.calls = 0
        self.failures: Counter[str] = Counter()

    @property
    def dimension(self) -> int:
        """Number of sampling coordinates."""
        return len(self.labels)

    def to_natural(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (…, names) and v (…, channels) from coordinates (…, dimension)."""
        count = len(self.problem.names)
        theta = np.array(points[..., :count])
        with np.errstate(over="ignore"):
            theta[..., self.logarithmic] = np.exp(theta[..., self.logarithmic])
            variances = np.broadcast_to(self._fixed, (*points.shape[:-1], self._fixed.size)).copy()
            variances[..., self._free] = np.exp(points[..., count:])
        return theta, variances

    def laplace(self, fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Return the Laplace mean and covariance in sampling coordinates, θ and log v taken as independent."""
        problem = self.problem
        theta = np.array([fit.theta[name] for name in problem.names])
        scale = np.where(self.logarithmic, 1.0 / theta, 1.0)
        covariance = np.zeros((self.dimension, self.dimension))
        count = len(problem.names)
        covariance[:count, :count] = fit.covariance.to_numpy() * np.outer(scale, scale)
        mean = np.concatenate(
            [
                np.where(self.logarithmic, np.log(np.where(self.logarithmic, theta, 1.0)), theta),
                [np.log(fit.variances[c]) for c in problem.free_variances],
            ]
        )
        for i, channel in enumerate(problem.free_variances):
            covariance[count + i, count + i] = 2.0 / fit.independent[channel]
        return mean, covariance

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the log-density (points,) of coordinates (points, dimension); −inf where a solve fails."""
        theta, variances = self.to_natural(points)
        self.calls += len(points)
        values = np.asarray(self.problem.log_prior(theta))
        values = values + points[:, : len(self.problem.names)][:, self.logarithmic].sum(axis=1)
        inside = np.isfinite(values)
        if inside.any():
            moments, status = self.problem.moments(theta[inside], self.threads)
            for code in status[status != CONVERGED]:
                self.failures[STATUSES[code]] += 1
            values[inside] += self.problem.likelihood_from_moments(moments, variances[inside])
        return np.where(inside, values, -np.inf)
