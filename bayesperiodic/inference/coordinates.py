"""The coordinates that sampling works in, and the posterior density in them."""

from collections import Counter

import numpy as np

from bayesperiodic.inference.estimate import MapEstimate
from bayesperiodic.inference.joint_laplace import logarithmic
from bayesperiodic.inference.problem import Problem
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES


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
        self.logarithmic = logarithmic(problem)
        self.labels = (*problem.names, *problem.free_noise)
        self.calls = 0
        self.failures: Counter[str] = Counter()

    @property
    def dimension(self) -> int:
        """Number of sampling coordinates."""
        return len(self.labels)

    def to_natural(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (…, names) and all noise parameters (…, noise_names) from coordinates (…, dimension)."""
        count = len(self.problem.names)
        theta = np.array(points[..., :count])
        with np.errstate(over="ignore"):
            theta[..., self.logarithmic] = np.exp(theta[..., self.logarithmic])
            return theta, self.problem.likelihood.complete(np.exp(points[..., count:]))

    def laplace(self, fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and covariance of the Laplace approximation in sampling coordinates."""
        mode = np.array([fit.joint_mode.get(label, np.nan) for label in self.labels])
        logs = np.concatenate([self.logarithmic, np.ones(len(self.problem.free_noise), dtype=bool)])
        mean = np.where(logs, np.log(np.where(logs, mode, 1.0)), mode)
        return mean, fit.joint_covariance.loc[[*self.labels], [*self.labels]].to_numpy()

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the log-density (points,) of coordinates (points, dimension); −inf where a solve fails."""
        theta, noise = self.to_natural(points)
        self.calls += len(points)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            values = np.asarray(self.problem.log_prior(theta)) + self.problem.likelihood.log_prior(noise)
        values = values + points[:, : len(self.problem.names)][:, self.logarithmic].sum(axis=1)
        inside = np.isfinite(values)
        if inside.any():
            likelihood, status = self.problem.likelihood_and_status(theta[inside], noise[inside], self.threads)
            for code in status[status != CONVERGED]:
                self.failures[STATUSES[code]] += 1
            values[inside] += likelihood
        return np.where(inside, values, -np.inf)
