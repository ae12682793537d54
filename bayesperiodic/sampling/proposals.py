"""Proposals of the sampler: mixtures of Student t distributions fitted to draws, and the coordinates they are in."""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from scipy.special import gammaln, logsumexp

from bayesperiodic._linalg import TINY, covariance_eigh, in_one_thread
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES

# Numbers of components and degrees of freedom that are tried; a larger mixture must raise the mean log-density of the
# draws left out by more than LEAST_SCORE_GAIN.
COMPONENT_NUMBERS, HEAVY_TAILS, LIGHT_TAILS, LEAST_SCORE_GAIN = (1, 2, 3, 4, 6, 8), 5.0, 30.0, 0.01
WIDER_WEIGHT, WIDER_FACTOR = 0.1, 2.0
# The same of a component that is wider along the heaviest tails only.
TAIL_WEIGHT, TAIL_FACTOR = 0.1, 3.0
# Most draws used in a fit, and draws needed per coordinate and component.
MOST_FITTED_DRAWS, PER_COMPONENT = 6000, 20
REGULAR = 1e-6
# Points whose densities are computed together.
POINTS_TOGETHER = 8192
# Iterations of a fit, and the gain in mean log-density at which it ends.
FIT_ITERATIONS, ENOUGH_GAIN = 100, 1e-2
# Most coordinates whose products describe curvature, and ridge of that regression, relative to the mean square.
MOST_CURVED, CURVATURE_RIDGE = 20, 1e-6


@dataclass(frozen=True)
class StudentMixture:
    """Mixture of multivariate Student t distributions.

    `weights` (components,) sum to 1; `means` (components, dimension); `factors` (components, dimension, dimension) are
    lower triangular, factor·factorᵀ being the scale matrix; `degrees` (components,) are degrees of freedom.

    With `curvature` (bent, products) these describe straightened coordinates: from each of the first coordinates a
    quadratic form of the others is subtracted, see `_products`. The determinant of that map is 1.
    """

    weights: np.ndarray
    means: np.ndarray
    factors: np.ndarray
    degrees: np.ndarray
    curvature: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    def straightened(self, points: np.ndarray, sign: float = -1.0) -> np.ndarray:
        """Return the coordinates that the components describe, of points (points, dimension); `sign` 1 inverts it."""
        bent = len(self.curvature)
        if not bent:
            return points
        straight = points[:, :bent] + sign * _products(points[:, bent:]) @ self.curvature.T
        return np.hstack([straight, points[:, bent:]])

    def mapped(self, origin: np.ndarray, axes: np.ndarray) -> "StudentMixture":
        """Return the mixture of origin + axes·x, without curvature."""
        turned = np.linalg.qr((axes @ self.factors).swapaxes(1, 2))[1].swapaxes(1, 2)
        signs = np.sign(np.diagonal(turned, axis1=1, axis2=2))
        return StudentMixture(self.weights, origin + self.means @ axes.T, turned * signs[:, None, :], self.degrees)

    def as_lists(self) -> dict[str, Any]:
        """Return the arguments as numbers and lists."""
        return {one.name: getattr(self, one.name).tolist() for one in fields(self)}

    @classmethod
    def from_lists(cls, lists: dict[str, Any]) -> "StudentMixture":
        """Return the mixture of `as_lists`."""
        return cls(*(np.array(lists[one.name]) for one in fields(cls)))

    def log_components(self, points: np.ndarray) -> np.ndarray:
        """Return the log of weight times density of every component at points (points, dimension), one row a point."""
        half, columns, points = 0.5 * points.shape[1], [], self.straightened(points)
        for weight, mean, factor, degrees in zip(self.weights, self.means, self.factors, self.degrees, strict=True):
            squared = np.sum(np.linalg.solve(factor, (points - mean).T) ** 2, axis=0)
            total = gammaln(0.5 * degrees + half) - gammaln(0.5 * degrees) - half * np.log(degrees * np.pi)
            tails = (0.5 * degrees + half) * np.log1p(squared / degrees)
            columns.append(np.log(weight) + total - np.log(np.diag(factor)).sum() - tails)
        return np.stack(columns, axis=1)

    def log_density(self, points: Any) -> np.ndarray:
        """Return the log-density at points (points, dimension), an array or `Points`."""
        return np.concatenate([logsumexp(self.log_components(points[p]), axis=1) for p in parts(len(points))])

    def draw(self, count: int, random: np.random.RandomState | np.random.Generator) -> np.ndarray:
        """Return draws (count, dimension)."""
        component = random.choice(len(self.weights), count, p=self.weights)
        normal = random.standard_normal((count, self.means.shape[1]))
        degrees = self.degrees[component]
        wide = np.sqrt(degrees / random.chisquare(degrees))
        drawn = self.means[component] + wide[:, None] * np.einsum("nij,nj->ni", self.factors[component], normal)
        return self.straightened(drawn, 1.0)


def parts(count: int) -> list[slice]:
    """Return slices of POINTS_TOGETHER points, at least one."""
    return [slice(k, k + POINTS_TOGETHER) for k in range(0, max(count, 1), POINTS_TOGETHER)]


def expected_time(mixture: StudentMixture, points: Any, log_density: np.ndarray, fraction: float) -> float:
    """Return the autocorrelation time [steps] of proposals from a mixture, the worst of any coordinate.

    `points` (draws, dimension), an array or `Points`, follow the density, known up to a factor. The probability to
    leave each of them is the mean acceptance there, from the ratios of both densities (J. S. Liu, Metropolized
    independent sampling, Statistics and Computing 6 (1996) 113-119), times the fraction of such steps; differential
    evolution, with a time of four steps a dimension, makes the others. Draws count by their square distance from the
    mean.
    """
    ratios = log_density - mixture.log_density(points)
    order = np.argsort(ratios)
    inverse = np.exp(ratios.min() - ratios[order])
    accepted = np.empty(len(order))
    later = inverse.sum() - np.cumsum(inverse)
    accepted[order] = (np.arange(1, len(order) + 1) * inverse + later) / inverse.sum()
    dimension = mixture.means.shape[1]
    leaving = fraction * accepted + (1.0 - fraction) * 2.0 / (4.0 * dimension + 1.0)
    middle, times, total = np.zeros(dimension), np.zeros(dimension), np.zeros(dimension)
    for part in parts(len(points)):
        middle += points[part].sum(axis=0) / len(points)
    for part in parts(len(points)):
        squared = (points[part] - middle) ** 2
        times += (2.0 / leaving[part] - 1.0) @ squared
        total += squared.sum(axis=0)
    return float(np.max(times / total))


def fit_mixture(draws: np.ndarray, candidates: Sequence[StudentMixture] = ()) -> StudentMixture:
    """Return the mixture that describes draws (ensembles, draws, dimension) best, with wider components.

    Curvature, numbers of components and of degrees of freedom are those with the largest mean log-density at the last
    ensemble, if the others are fitted; the mixture is then fitted to all. `candidates` are other mixtures to compare
    with. Coordinates should be ordered by their widths, the narrowest first. WIDER_WEIGHT of the weight is moved to
    components of WIDER_FACTOR times the width with heavy tails, for what the draws lack.
    """
    each = max(1, draws.shape[0] * draws.shape[1] // MOST_FITTED_DRAWS)
    draws = draws[:, ::each]
    points, train, test = draws.reshape(-1, draws.shape[2]), draws[:-1].reshape(-1, draws.shape[2]), draws[-1]
    best, size, degrees, chosen = -np.inf, 0, HEAVY_TAILS, None
    for candidate in candidates:
        if (score := float(_with_wider(candidate).log_density(test).mean())) > best:
            best, chosen = score, candidate
    bent = _bent(train, test)
    worse, curvature = 0, _curvature(train, bent)
    for count in COMPONENT_NUMBERS:
        if count > 1 and len(train) < PER_COMPONENT * count * draws.shape[2]:
            break
        fitted = _fitted(train, count, curvature)
        scores = {nu: float(_with_wider(fitted, nu).log_density(test).mean()) for nu in (HEAVY_TAILS, LIGHT_TAILS)}
        if (score := max(scores.values())) > best + (LEAST_SCORE_GAIN if size else 0.0):
            best, size, degrees, chosen, worse = score, count, max(scores, key=scores.__getitem__), None, 0
        elif (worse := worse + 1) == 2:
            break
    return _with_wider(chosen) if chosen else _with_wider(_fitted(points, size, _curvature(points, bent)), degrees)


def _products(points: np.ndarray) -> np.ndarray:
    """Return squares and products (points, products) of the last coordinates of points, at most MOST_CURVED."""
    wide = points[:, -MOST_CURVED:]
    first, second = np.triu_indices(wide.shape[1])
    return wide[:, first] * wide[:, second]


def _terms(points: np.ndarray, bent: int) -> np.ndarray:
    return np.column_stack([np.ones(len(points)), points[:, bent:], _products(points[:, bent:])])


def _coefficients(terms: np.ndarray, values: np.ndarray) -> np.ndarray:
    square = terms.T @ terms
    return np.linalg.solve(square + CURVATURE_RIDGE * np.diag(np.diag(square)), terms.T @ values)


def _bent(train: np.ndarray, test: np.ndarray) -> int:
    """Return how many of the first coordinates are curved: where products reduce the variance at the test points."""
    dimension, gains = train.shape[1], {0: LEAST_SCORE_GAIN}
    for bent in sorted({1, 2, 3, dimension // 4, dimension // 2} & set(range(1, dimension))):
        known, new = _terms(train, bent), _terms(test, bent)
        straight, curved = (
            (test[:, :bent] - new[:, :count] @ _coefficients(known[:, :count], train[:, :bent])).var(axis=0)
            for count in (1 + dimension - bent, None)
        )
        gains[bent] = 0.5 * float(np.sum(np.log(straight / curved)))
    return max(gains, key=gains.__getitem__)


def _curvature(points: np.ndarray, bent: int) -> np.ndarray:
    """Return the coefficients (bent, products) of the products."""
    linear = 1 + points.shape[1] - bent
    return _coefficients(_terms(points, bent), points[:, :bent])[linear:].T if bent else np.empty((0, 0))


def _fitted(draws: np.ndarray, count: int, curvature: np.ndarray) -> StudentMixture:
    """Return Student t distributions with weights, means and scale matrices of normal distributions fitted to draws."""
    none = np.empty(0)
    draws = StudentMixture(none, none, none, none, curvature).straightened(draws)
    weights, means, covariances = normal_mixture(draws, count)
    return StudentMixture(weights, means, np.linalg.cholesky(covariances), np.full(count, HEAVY_TAILS), curvature)


@in_one_thread  # the sums of several threads depend on their order
def normal_mixture(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights, means and covariances of normal distributions, fitted to points by expectation maximisation.

    The first members are clusters of k-means. It ends where the mean log-density rises by less than ENOUGH_GAIN: a
    mixture that is not the best one is a proposal too. From A. P. Dempster, N. M. Laird, D. B. Rubin, Journal of the
    Royal Statistical Society B 39 (1977) 1-38.

    Parameters
    ----------
    points : array (points, dimension)
    count : int
        Number of normal distributions.

    Returns
    -------
    weights : array (count,)
    means : array (count, dimension)
    covariances : array (count, dimension, dimension)
        With REGULAR times the smallest variance of the points added to the diagonal.
    """
    from scipy.cluster.vq import kmeans2

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of clusters without points, which have no weight
        _, labels = kmeans2(points, count, 30, minit="++", seed=np.random.default_rng(0))
    members, score = np.eye(count)[labels], -np.inf
    regular = REGULAR * points.var(axis=0).min() * np.eye(points.shape[1])
    for _ in range(FIT_ITERATIONS):
        sizes = members.sum(axis=0) + TINY
        means = members.T @ points / sizes[:, None]
        # One member after the other, which takes less memory.
        away = ((k, points - mean) for k, mean in enumerate(means))
        covariances = np.stack([(members[:, k, None] * x).T @ x / sizes[k] + regular for k, x in away])
        factors = np.linalg.cholesky(covariances)
        whitening = zip(means, np.linalg.inv(factors), strict=True)
        squares = np.stack([np.sum(((points - mean) @ inverse.T) ** 2, axis=1) for mean, inverse in whitening])
        roots = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        logs = (np.log(sizes / sizes.sum()) - roots)[:, None] - 0.5 * squares
        total = logsumexp(logs, axis=0)
        members, before, score = np.exp(logs - total).T, score, float(total.mean())
        if score - before < ENOUGH_GAIN:
            break
    return sizes / sizes.sum(), means, covariances


def _with_wider(mixture: StudentMixture, degrees: float | None = None) -> StudentMixture:
    """Return a mixture, with `degrees` if given, and wider components."""
    count = len(mixture.weights)
    weights = np.concatenate([(1.0 - WIDER_WEIGHT) * mixture.weights, WIDER_WEIGHT * mixture.weights])
    factors, means = np.concatenate([mixture.factors, WIDER_FACTOR * mixture.factors]), np.tile(mixture.means, (2, 1))
    tails = mixture.degrees if degrees is None else np.full(count, degrees)
    return StudentMixture(weights, means, factors, np.append(tails, np.full(count, HEAVY_TAILS)), mixture.curvature)


def with_tail(mixture: StudentMixture, points: np.ndarray) -> StudentMixture:
    """Return a mixture with a component that is wider along the heaviest tails of points (points, dimension) only.

    In many dimensions a component that is wider along all of them hardly covers one long tail. The direction is the
    eigenvector of Σ|z|²zzᵀ of the whitened points z with the largest eigenvalue: fourth-order blind identification
    (J.-F. Cardoso, Source separation using higher order moments, ICASSP 1989, 2109-2112).
    """
    straight = mixture.straightened(points)
    _, mean, covariance = normal_mixture(straight, 1)
    factor = np.linalg.cholesky(covariance[0])
    white = np.linalg.solve(factor, (straight - mean).T)
    heaviest = np.linalg.eigh((white * np.sum(white**2, axis=0)) @ white.T)[1][:, -1]
    wider = factor @ (np.eye(len(factor)) + (TAIL_FACTOR - 1.0) * np.outer(heaviest, heaviest))
    triangular = np.linalg.qr(wider.T)[1].T
    return StudentMixture(
        np.append((1.0 - TAIL_WEIGHT) * mixture.weights, TAIL_WEIGHT),
        np.vstack([mixture.means, mean]),
        np.concatenate([mixture.factors, triangular[None] * np.sign(np.diag(triangular))]),
        np.append(mixture.degrees, HEAVY_TAILS),
        mixture.curvature,
    )


# Fraction of the steps that propose from the mixture, if there is one; the other steps move within the ensembles.
MIXTURE_STEPS = 0.8


@dataclass(frozen=True)
class AffineTransform:
    """Sampling coordinates x = origin + axes·u, in which the Laplace approximation is a standard normal distribution.

    The columns of `axes` are the eigenvectors of the Laplace covariance times the standard deviations along them.
    emcee's moves are invariant under linear maps, but fits of mixtures are regularised in proportion to the scales.
    """

    origin: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray, covariance: np.ndarray) -> "AffineTransform":
        """Return the transform of a normal distribution."""
        values, vectors, sd = covariance_eigh(covariance)
        return cls(mean, sd[:, None] * vectors * np.sqrt(np.maximum(values, np.finfo(float).eps)))

    def unwhiten(self, u: np.ndarray) -> np.ndarray:
        """Return x (…, dimension)."""
        x = np.asarray(u @ self.axes.T)
        x += self.origin
        return x

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Return u (…, dimension)."""
        return np.linalg.solve(self.axes, (x - self.origin).reshape(-1, self.origin.size).T).T.reshape(x.shape)


@dataclass
class CallCount:
    """Number of evaluated points, and of failed periodic solves by status."""

    points: int = 0
    failures: Counter[str] = field(default_factory=Counter)

    def add(self, status: np.ndarray) -> None:
        """Count points with these status codes."""
        self.points += len(status)
        self.failures.update(STATUSES[code] for code in status[status != CONVERGED])

    def __add__(self, other: "CallCount") -> "CallCount":
        return CallCount(self.points + other.points, self.failures + other.failures)
