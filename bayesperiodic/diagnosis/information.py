"""What the data say at the estimate, measured against what the prior says: Fisher information in prior units."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.estimation.joint_laplace import logarithmic
from bayesperiodic.inference.problem import Problem

ONE_SD = float(ndtr(1.0))
SMALLEST, HARDLY = 1e-12, 1e-3


@dataclass(frozen=True)
class Information:
    """The Fisher information of the data in the logarithms of positive parameters and in signed ones as they are.

    Attributes
    ----------
    names : tuple of str
    theta : array (names,)
        The estimate.
    logarithmic : bool array (names,)
    matrix : array (names, names)
        −∂² log-likelihood, its expectation, by these coordinates.
    prior_sd : array (names,)
        Half the central 68 % interval of each prior, in these coordinates.
    """

    names: tuple[str, ...]
    theta: np.ndarray
    logarithmic: np.ndarray
    matrix: np.ndarray
    prior_sd: np.ndarray

    @classmethod
    def of(cls, problem: Problem, fit: MapEstimate) -> "Information":
        """Return the information at an estimate, its noise parameters taken as known."""
        theta, logs = problem.vector(fit.theta), logarithmic(problem)
        guesses = {name: solution.states for name, solution in fit.solutions.items()}
        here = problem.anchored(theta, guesses).linearised(theta)
        changes = problem.likelihood.whitened(here.changes, problem.noise_values(fit.noise))
        slopes = np.where(logs, theta, 1.0)
        design = np.concatenate(changes, axis=1) * slopes[:, None]
        return cls(problem.names, theta, logs, design @ design.T, prior_sds(problem, logs))

    @cached_property
    def _relative(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues, ascending, and eigenvectors of the information per unit of the prior's precision."""
        scaled = self.matrix * np.outer(self.prior_sd, self.prior_sd)
        values, vectors = np.linalg.eigh(scaled)
        return np.maximum(values, 0.0), vectors

    @property
    def gains(self) -> np.ndarray:
        """Information of the data over that of the prior along each direction, ascending."""
        return self._relative[0]

    @property
    def directions(self) -> np.ndarray:
        """The directions, columns, in the coordinates themselves (names, directions)."""
        return self._relative[1] * self.prior_sd[:, None]

    @property
    def spectrum(self) -> np.ndarray:
        """Eigenvalues of the information, descending: per unit of the logarithm, or of the prior's sd if signed."""
        return self._scaled_eigenvalues[::-1]

    @property
    def condition(self) -> float:
        """The largest over the smallest of these."""
        values = self._scaled_eigenvalues
        return float(values[-1] / values[0]) if values[0] > 0.0 else np.inf

    @cached_property
    def _scaled_eigenvalues(self) -> np.ndarray:
        scale = np.where(self.logarithmic, 1.0, self.prior_sd)
        values = np.linalg.eigvalsh(self.matrix * np.outer(scale, scale))
        return np.where(values > SMALLEST * values[-1], values, 0.0)

    @property
    def alone(self) -> np.ndarray:
        """Standard deviation that the data alone leave each parameter if all others are known, in prior sds."""
        with np.errstate(divide="ignore"):
            return 1.0 / (np.sqrt(np.diag(self.matrix)) * self.prior_sd)

    @property
    def together(self) -> np.ndarray:
        """The same if the others are unknown too; infinite for what a direction without information moves.

        It does not move a parameter that changes by less than 0.1 % of its prior's sd where others do by all of theirs.
        """
        values, vectors = self._relative
        told = values > SMALLEST * max(values[-1], np.finfo(float).tiny)
        known = np.sum(vectors[:, told] ** 2 / values[told], axis=1)
        unseen = np.any(np.abs(vectors[:, ~told]) > HARDLY, axis=1)
        return np.where(unseen, np.inf, np.sqrt(known))

    @property
    def collinearity(self) -> np.ndarray:
        """By how much the others make each standard deviation longer; 1 for a parameter that none is like."""
        with np.errstate(invalid="ignore"):
            return self.together / self.alone

    def coordinate(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return values of a parameter in its coordinate."""
        return np.log(values) if self.logarithmic[self.names.index(name)] else values


def prior_sds(problem: Problem, logs: np.ndarray) -> np.ndarray:
    """Return half the central 68 % interval of each prior, of the logarithm where that is the coordinate."""
    result = np.empty(len(problem.names))
    for i, name in enumerate(problem.names):
        low, high = problem.joint_prior.marginals[name].quantile(np.array([1.0 - ONE_SD, ONE_SD]))
        result[i] = 0.5 * (np.log(high / low) if logs[i] else high - low)
    return result
