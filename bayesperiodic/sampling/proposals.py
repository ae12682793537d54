"""Mixtures of Student t distributions fitted to draws: proposals of the sampler, and reference of the evidence."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.special import gammaln, logsumexp
from threadpoolctl import threadpool_limits

# Numbers of components and degrees of freedom that are tried; a larger mixture must raise the mean log-density of the
# draws left out by more than GAIN.
SIZES, HEAVY, LIGHT, GAIN = (1, 2, 3, 4, 6, 8), 5.0, 30.0, 0.01
WIDE, WIDER = 0.1, 2.0
# Most draws used in a fit, and draws needed per coordinate and component.
MOST_DRAWS, PER_COMPONENT = 6000, 20
REGULAR = 1e-6


@dataclass(frozen=True)
class StudentMixture:
    """Mixture of multivariate Student t distributions.

    `weights` (components,) sum to 1; `means` (components, dimension); `factors` (components, dimension, dimension) are
    lower triangular, factor·factorᵀ being the scale matrix; `degrees` (components,) are degrees of freedom.
    """

    weights: np.ndarray
    means: np.ndarray
    factors: np.ndarray
    degrees: np.ndarray

    def mapped(self, origin: np.ndarray, axes: np.ndarray) -> "StudentMixture":
        """Return the mixture of origin + axes·x."""
        turned = np.linalg.qr((axes @ self.factors).swapaxes(1, 2))[1].swapaxes(1, 2)
        signs = np.sign(np.diagonal(turned, axis1=1, axis2=2))
        return StudentMixture(self.weights, origin + self.means @ axes.T, turned * signs[:, None, :], self.degrees)

    def as_lists(self) -> dict[str, Any]:
        """Return the arguments as numbers and lists."""
        return {field.name: getattr(self, field.name).tolist() for field in fields(self)}

    @classmethod
    def from_lists(cls, lists: dict[str, Any]) -> "StudentMixture":
        """Return the mixture of `as_lists`."""
        return cls(*(np.array(lists[field.name]) for field in fields(cls)))

    def log_components(self, points: np.ndarray) -> np.ndarray:
        """Return the log of weight times density of every component at points (points, dimension), one row a point."""
        half, columns = 0.5 * points.shape[1], []
        for weight, mean, factor, degrees in zip(self.weights, self.means, self.factors, self.degrees, strict=True):
            squared = np.sum(np.linalg.solve(factor, (points - mean).T) ** 2, axis=0)
            total = gammaln(0.5 * degrees + half) - gammaln(0.5 * degrees) - half * np.log(degrees * np.pi)
            tails = (0.5 * degrees + half) * np.log1p(squared / degrees)
            columns.append(np.log(weight) + total - np.log(np.diag(factor)).sum() - tails)
        return np.stack(columns, axis=1)

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Return the log-density at points (points, dimension)."""
        return np.asarray(logsumexp(self.log_components(points), axis=1))

    def draw(self, count: int, random: np.random.RandomState | np.random.Generator) -> np.ndarray:
        """Return draws (count, dimension)."""
        component = random.choice(len(self.weights), count, p=self.weights)
        normal = random.standard_normal((count, self.means.shape[1]))
        degrees = self.degrees[component]
        wide = np.sqrt(degrees / random.chisquare(degrees))
        return self.means[component] + wide[:, None] * np.einsum("nij,nj->ni", self.factors[component], normal)


def expected_time(mixture: StudentMixture, points: np.ndarray, log_density: np.ndarray, fraction: float) -> float:
    """Return the autocorrelation time [steps] of proposals from a mixture, the worst of any coordinate.

    `points` (draws, dimension) follow the density, known up to a factor. The probability to leave each of them is the
    mean acceptance there, from the ratios of both densities (J. S. Liu, Metropolized independent sampling, Statistics
    and Computing 6 (1996) 113-119), times the fraction of such steps; differential evolution, with a time of four steps
    a dimension, makes the others. Draws count by their square distance from the mean.
    """
    ratios = log_density - mixture.log_density(points)
    order = np.argsort(ratios)
    inverse = np.exp(ratios.min() - ratios[order])
    accepted = np.empty(len(order))
    later = inverse.sum() - np.cumsum(inverse)
    accepted[order] = (np.arange(1, len(order) + 1) * inverse + later) / inverse.sum()
    leaving = fraction * accepted + (1.0 - fraction) * 2.0 / (4.0 * points.shape[1] + 1.0)
    squared = (points - points.mean(axis=0)) ** 2
    return float(np.max((2.0 / leaving - 1.0) @ squared / squared.sum(axis=0)))


def fit_mixture(draws: np.ndarray, candidates: Sequence[StudentMixture] = ()) -> StudentMixture:
    """Return the mixture that describes draws (ensembles, draws, dimension) best, with wider components.

    Numbers of components and of degrees of freedom are those with the largest mean log-density at the last ensemble, if
    the others are fitted; the mixture is then fitted to all. `candidates` are other mixtures to compare with. A part of
    the weight, WIDE, is moved to components of WIDER times the width with heavy tails, for what the draws lack.
    """
    each = max(1, draws.shape[0] * draws.shape[1] // MOST_DRAWS)
    draws = draws[:, ::each]
    train, test = draws[:-1].reshape(-1, draws.shape[2]), draws[-1]
    best, size, degrees, chosen = -np.inf, 0, HEAVY, None
    for candidate in candidates:
        if (score := float(_with_wider(candidate).log_density(test).mean())) > best:
            best, chosen = score, candidate
    worse = 0
    for count in SIZES:
        if count > 1 and len(train) < PER_COMPONENT * count * draws.shape[2]:
            break
        fitted = _fitted(train, count)
        found = {nu: float(_with_wider(_of_degrees(fitted, nu)).log_density(test).mean()) for nu in (HEAVY, LIGHT)}
        if (score := max(found.values())) > best + (GAIN if size else 0.0):
            best, size, degrees, chosen, worse = score, count, max(found, key=found.__getitem__), None, 0
        elif (worse := worse + 1) == 2:
            break
    return _with_wider(chosen or _of_degrees(_fitted(draws.reshape(-1, draws.shape[2]), size), degrees))


def _fitted(draws: np.ndarray, count: int) -> StudentMixture:
    """Return Student t distributions with weights, means and scale matrices of normal distributions fitted to draws.

    In one thread: the sums of several depend on their order.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    fit = GaussianMixture(count, reg_covar=REGULAR * draws.var(axis=0).min(), random_state=0, tol=1e-2).fit
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a mixture that is not the best one is a proposal too
        found = fit(draws)
    return StudentMixture(found.weights_, found.means_, np.linalg.cholesky(found.covariances_), np.full(count, HEAVY))


def _of_degrees(mixture: StudentMixture, degrees: float) -> StudentMixture:
    return replace(mixture, degrees=np.full(len(mixture.weights), degrees))


def _with_wider(mixture: StudentMixture) -> StudentMixture:
    weights = np.concatenate([(1.0 - WIDE) * mixture.weights, WIDE * mixture.weights])
    factors, means = np.concatenate([mixture.factors, WIDER * mixture.factors]), np.tile(mixture.means, (2, 1))
    return StudentMixture(weights, means, factors, np.append(mixture.degrees, np.full(len(mixture.weights), HEAVY)))
