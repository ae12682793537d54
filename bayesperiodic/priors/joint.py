"""The prior of all free parameters of a problem, from what the user gave for each name or tuple of names."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special
from scipy.linalg import solve_triangular

from bayesperiodic import _checks
from bayesperiodic._linalg import asymmetric_entry, covariance_cholesky
from bayesperiodic.priors.single import LOG_ROOT_TWO_PI, LogDensity, Normal, Prior, Univariate


@dataclass(frozen=True, repr=False, eq=False)
class MultivariateNormal(LogDensity):
    """The joint normal distribution of several parameters: one posterior becomes the next prior.

    Parameters
    ----------
    mean : array (n,)
    covariance : array (n, n)
        Symmetric, positive definite. A table of an estimate must have its rows in the order of the names that the
        prior is given for.

    Raises
    ------
    ValueError
        For a mean or a covariance that is not finite, or a covariance of another size than the mean, not symmetric or
        not positive definite.

    Examples
    --------
    >>> prior = bp.MultivariateNormal(mean=[1.0, 2.0], covariance=[[4.0, 1.0], [1.0, 9.0]])
    >>> prior.marginal(1)
    Normal(mean=2.0, sd=3.0)
    >>> prior.gradient([1.0, 5.5]).round(6).tolist()
    [0.1, -0.4]
    """

    mean: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        mean = _checks.finite_vector("mean", self.mean)
        object.__setattr__(self, "mean", _checks.read_only(mean))
        object.__setattr__(self, "covariance", _checks.read_only(_covariance("covariance", self.covariance, mean.size)))

    @property
    def dimension(self) -> int:
        """Number of parameters, n."""
        return self.mean.size

    @cached_property
    def _cholesky(self) -> np.ndarray:
        return covariance_cholesky(self.covariance)

    @cached_property
    def _whitening(self) -> np.ndarray:
        return solve_triangular(self._cholesky, np.eye(self.dimension), lower=True)

    @cached_property
    def _precision(self) -> np.ndarray:
        return self._whitening.T @ self._whitening

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the log-density (…,) at points (…, n), each value in its parameter's unit."""
        x = self._points(x)
        finite = np.isfinite(x).all(axis=-1)
        offset = np.where(finite[..., None], x, self.mean) - self.mean
        # Point by point: the rounding of one product for all may depend on how many there are.
        score = (self._whitening @ offset[..., None])[..., 0]
        constant = np.log(np.diag(self._cholesky)).sum() + self.dimension * LOG_ROOT_TWO_PI
        return np.where(finite, -0.5 * np.sum(score**2, axis=-1) - constant, -np.inf)[()]

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return ∂ log p/∂x, (…, n)."""
        return (self.mean - self._points(x)) @ self._precision

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −∂² log p/∂x², the inverse of the covariance, (…, n, n)."""
        x = self._points(x)
        return np.broadcast_to(self._precision, (*x.shape[:-1], self.dimension, self.dimension)).copy()

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size, n)."""
        return self.mean + generator.standard_normal((size, self.dimension)) @ self._cholesky.T

    def marginal(self, index: int) -> Normal:
        """Return the distribution of one parameter by itself.

        Parameters
        ----------
        index : int
            Its place among the parameters, from 0.

        Returns
        -------
        Normal
        """
        return Normal(self.mean[index], math.sqrt(self.covariance[index, index]))

    def _points(self, x: np.ndarray) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        if x.shape[-1:] != (self.dimension,):
            raise ValueError(f"x: last axis must have {self.dimension} values, got shape {x.shape}.")
        return x

    def __repr__(self) -> str:
        return f"MultivariateNormal(mean={self.mean.tolist()}, covariance={self.covariance.tolist()})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MultivariateNormal) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))


def _covariance(argument: str, value: Any, size: int) -> np.ndarray:
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{argument}: must be a matrix of real numbers, got {value!r}.") from None
    if matrix.shape != (size, size):
        raise ValueError(f"{argument}: must have the shape {(size, size)} of the mean, got {matrix.shape}.")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{argument}: must be finite, got {matrix.tolist()}.")
    variances = np.diag(matrix)
    if size and np.all(variances > 0.0):
        scale = np.outer(np.sqrt(variances), np.sqrt(variances))
        if asymmetric_entry(matrix):
            raise ValueError(f"{argument}: must be symmetric, got {matrix.tolist()}.")
        matrix = 0.5 * (matrix + matrix.T)
        if np.linalg.eigvalsh(matrix / scale).min() > size * np.finfo(float).eps:
            return matrix
    raise ValueError(f"{argument}: must be positive definite, got {matrix.tolist()}.")


class FromScipy(Univariate):
    """A frozen continuous distribution of scipy.stats as a prior.

    `gradient` and `curvature` are central differences of its `logpdf` with steps halved seven times, extrapolated
    where the estimated error is least. Let w be the interquartile range. Where the density is smooth and SciPy's
    `logpdf` has full precision, between the quantiles 1e-6 and 1 − 1e-6, the error of the gradient is below 1e-10 of
    (its own size + 1/w), and that of the curvature below 1e-9 of (its own size + 1/w²). Steps stay within the support:
    at a distance d from its end the curvature loses 1e-13/d² more. At kinks and steps of a density both are wrong.
    """

    def __init__(self, distribution: Any):
        self.distribution = distribution

    @cached_property
    def support(self) -> tuple[float, float]:
        """The interval outside of which the density is zero."""
        low, high = self.distribution.support()
        return float(low), float(high)

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws."""
        return self.distribution.rvs(size=size, random_state=generator)

    def _log_density(self, x: np.ndarray) -> Any:
        with np.errstate(all="ignore"):
            return self.distribution.logpdf(x)

    def _gradient(self, x: np.ndarray) -> Any:
        return _derivatives(self._log_density, x, self._steps(x))[0]

    def _curvature(self, x: np.ndarray) -> Any:
        return -_derivatives(self._log_density, x, self._steps(x))[1]

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.distribution.ppf(p)

    def _steps(self, x: np.ndarray) -> np.ndarray:
        """Return the first step at each point: within the support, and a power of two to add without rounding."""
        low, high = self.support
        widest = np.minimum(self._width, np.minimum(x - low, high - x))
        return 2.0 ** np.floor(np.log2(0.5 * widest))

    @cached_property
    def _width(self) -> float:
        return float(self.distribution.ppf(0.75) - self.distribution.ppf(0.25))

    def __repr__(self) -> str:
        from scipy import stats

        text = as_written(self.distribution)
        known = getattr(stats, self.distribution.dist.name or "", None)
        if type(known) is type(self.distribution.dist):
            return text
        # The numbers behind a histogram or a class of the user's own are not in its arguments.
        quantiles = self.distribution.ppf((np.arange(32) + 0.5) / 32).tolist()
        return f"{text} with quantiles {quantiles}"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FromScipy) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))


def as_written(distribution: Any) -> str:
    """Return a frozen distribution as it was written, with all digits."""
    from scipy import stats

    arguments = [repr(np.asarray(a).tolist()) for a in distribution.args]
    arguments += [f"{name}={np.asarray(a).tolist()!r}" for name, a in sorted(distribution.kwds.items())]
    dist = distribution.dist
    known = type(getattr(stats, dist.name or "", None)) is type(dist)
    name = f"scipy.stats.{dist.name}" if known else type(dist).__name__
    return f"{name}({', '.join(arguments)})"


def _derivatives(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: np.ndarray, levels: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Return first and second derivative at points (…) by Richardson's extrapolation of central differences.

    Of all extrapolations the one that differs least from its neighbours is taken (Ridders 1982).
    """
    h = np.ravel(step) * 0.5 ** np.arange(levels)[:, None]
    values = function(np.concatenate([x.reshape(1, -1), x.ravel() + h, x.ravel() - h]))
    middle, above, below = values[0], values[1 : levels + 1], values[levels + 1 :]
    with np.errstate(all="ignore"):
        first = _extrapolate((above - below) / (2.0 * h))
        second = _extrapolate(((above - middle) - (middle - below)) / h**2)
    return first.reshape(x.shape), second.reshape(x.shape)


def _extrapolate(differences: np.ndarray) -> np.ndarray:
    best = differences[0].copy()
    error = np.full(best.shape, np.inf)
    column = differences
    for order in range(1, len(differences)):
        factor = 4.0**order
        following = (factor * column[1:] - column[:-1]) / (factor - 1.0)
        change = np.maximum(np.abs(following - column[1:]), np.abs(following - column[:-1]))
        for value, estimate in zip(following, change, strict=True):
            better = estimate < error
            best[better], error[better] = value[better], estimate[better]
        column = following
    return best


ALLOWED_PRIOR = "a prior such as Normal(mean, sd), or a frozen continuous distribution of scipy.stats"


@dataclass(frozen=True)
class JointPrior:
    """Prior of all free parameters: independent blocks, each of one parameter or of several jointly."""

    names: tuple[str, ...]  # the free parameters, in the order of the last axis of θ
    blocks: dict[str | tuple[str, ...], Any]  # in the order of their first names

    @classmethod
    def of(cls, priors: Mapping[Any, Any], known: Iterable[str]) -> "JointPrior":
        """Return the checked prior; the names are ordered as in `known`."""
        known = list(known)
        keys: dict[str, str | tuple[str, ...]] = {}
        blocks = {}
        for key, value in priors.items():
            members = key if isinstance(key, tuple) else (key,)
            if not members:
                raise ValueError("priors: key must be a tuple of names, such as ('k', 'c'), got ().")
            for name in members:
                if str(name).startswith("variance["):
                    raise ValueError(
                        f"priors: must be of parameters of the model, got the noise parameter {name!r}. Give its prior "
                        "as noise=noise.Independent(prior=…), or its value in `fixed`."
                    )
                _checks.one_of("priors", name, known)
                if name in keys:
                    both = f"{keys[name]!r} and {key!r}" if keys[name] != key else f"twice in {key!r}"
                    raise ValueError(f"priors: {name!r} is in two keys, {both}; give every parameter one prior.")
                keys[name] = key
            blocks[key] = _joint(key, value) if isinstance(key, tuple) else as_prior(f"priors[{key!r}]", value)
        names = tuple(name for name in known if name in keys)
        ordered = dict.fromkeys(keys[name] for name in names)
        return cls(names, _checks.read_only({key: blocks[key] for key in ordered}))

    @cached_property
    def _columns(self) -> dict[str | tuple[str, ...], Any]:
        """Where each block is on the last axis of θ."""
        return {
            key: [self.names.index(name) for name in key] if isinstance(key, tuple) else self.names.index(key)
            for key in self.blocks
        }

    @cached_property
    def marginals(self) -> dict[str, Prior]:
        """The distribution of each parameter by itself."""
        by_name: dict[str, Prior] = {}
        for key, prior in self.blocks.items():
            by_name |= {n: prior.marginal(i) for i, n in enumerate(key)} if isinstance(key, tuple) else {key: prior}
        return {name: by_name[name] for name in self.names}

    @property
    def supports(self) -> dict[str, tuple[float, float]]:
        """The open interval of each parameter outside of which the density is zero."""
        return {name: prior.support for name, prior in self.marginals.items()}

    def median(self) -> np.ndarray:
        """Return the median of each parameter by itself, (names,)."""
        return np.array([float(prior.quantile(np.array(0.5))) for prior in self.marginals.values()])

    @cached_property
    def _central(self) -> np.ndarray:
        """Ends of the central 68 % interval of each parameter by itself, (2, names)."""
        ends = special.ndtr(np.array([-1.0, 1.0]))
        return np.array([prior.quantile(ends) for prior in self.marginals.values()]).T

    @property
    def widths(self) -> np.ndarray:
        """Half the central 68 % interval of each parameter by itself, (names,)."""
        return 0.5 * (self._central[1] - self._central[0])

    @property
    def log_widths(self) -> np.ndarray:
        """The same of the logarithm, (names,); NaN if parameters may be negative."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return 0.5 * np.log(self._central[1] / self._central[0])

    @cached_property
    def correlation_root(self) -> np.ndarray:
        """Lower Cholesky factor of the prior's correlations, (names, names)."""
        result = np.eye(len(self.names))
        for key, prior in self.blocks.items():
            if isinstance(key, tuple):
                columns = np.array(self._columns[key])
                root = prior._cholesky / np.sqrt(np.diag(prior.covariance))[:, None]
                result[columns[:, None], columns] = root
        return result

    def log_prob(self, theta: np.ndarray) -> np.ndarray:
        """Return Σ ln p over the blocks at θ (…, names), shape (…); −inf outside the support."""
        if theta.ndim > 1 and theta.size == len(self.names):
            # One point: operations on numbers take less time than those on arrays of one element.
            return np.asarray(self.log_prob(theta.reshape(-1))).reshape(theta.shape[:-1])
        total: Any = 0.0
        for prior, columns in self._alone:
            total = total + prior.log_prob(theta[..., columns])
        for prior, columns in self._alike:
            total = total + prior.log_prob(theta[..., columns]).sum(axis=-1)
        return total

    @cached_property
    def _alike(self) -> list[tuple[Univariate, list[int]]]:
        """Priors that several parameters have, with where these are on the last axis of θ."""
        columns: dict[Univariate, list[int]] = {}
        for key, prior in self.blocks.items():
            if isinstance(prior, Univariate):
                columns.setdefault(prior, []).append(self._columns[key])
        return [(prior, places) for prior, places in columns.items() if len(places) > 1]

    @cached_property
    def _alone(self) -> list[tuple[Prior | MultivariateNormal, Any]]:
        """The priors that no other block has, with where their parameters are on the last axis of θ."""
        shared = {column for _, columns in self._alike for column in columns}
        places = ((prior, self._columns[key]) for key, prior in self.blocks.items())
        return [(prior, place) for prior, place in places if isinstance(place, list) or place not in shared]

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        """Return ∂ log p / ∂θ at θ (…, names), shape (…, names)."""
        result = np.empty(theta.shape)
        for key, prior in self.blocks.items():
            result[..., self._columns[key]] = prior.gradient(theta[..., self._columns[key]])
        return result

    def curvature(self, theta: np.ndarray) -> np.ndarray:
        """Return −∂² log p / ∂θ² at θ (…, names), shape (…, names, names)."""
        result = np.zeros((*theta.shape, theta.shape[-1]))
        for key, prior in self.blocks.items():
            columns = self._columns[key]
            rows = np.array(columns)[:, None] if isinstance(key, tuple) else columns
            result[..., rows, columns] = prior.curvature(theta[..., columns])
        return result

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size, names)."""
        result = np.empty((size, len(self.names)))
        for key, prior in self.blocks.items():
            result[:, self._columns[key]] = prior.sample(size, generator)
        return result

    def excluding(self, theta: np.ndarray) -> tuple[str, ...]:
        """Return the names of the first block whose density is zero at one θ (names,), or nothing."""
        for key in self.blocks:
            if not np.isfinite(self._log_prob(key, theta)):
                return key if isinstance(key, tuple) else (key,)
        return ()

    def _log_prob(self, key: str | tuple[str, ...], theta: np.ndarray) -> np.ndarray:
        return self.blocks[key].log_prob(theta[..., self._columns[key]])


def as_prior(argument: str, value: Any) -> Prior:
    """Return a prior or a frozen scipy.stats distribution as a prior of one parameter; messages call it `argument`.

    Raises
    ------
    ValueError
        If it is neither, or a distribution that is discrete, of several variables, or has parameters out of range.
    """
    if isinstance(value, MultivariateNormal):
        raise ValueError(
            f"{argument}: must be a prior of one parameter, got {value!r}. Give a tuple of names as its key."
        )
    if isinstance(value, Prior) and not isinstance(value, type):
        return value
    from scipy import stats  # takes longer to import than most models to compile
    from scipy.stats.distributions import rv_frozen

    if isinstance(value, rv_frozen):
        text = as_written(value)
        if not isinstance(value.dist, stats.rv_continuous):
            raise ValueError(f"{argument}: must be continuous, got the discrete {text}.")
        if np.shape(value.support()[0]) or np.shape(value.ppf(0.5)):
            raise ValueError(f"{argument}: must be of one variable, without arrays, got {text}.")
        if not np.isfinite(value.ppf(0.5)):
            raise ValueError(f"{argument}: parameters must be in the range of scipy.stats, got {text}.")
        return FromScipy(value)
    if isinstance(value, stats.rv_continuous):
        raise ValueError(f"{argument}: must be frozen, got scipy.stats.{value.name}. Give scipy.stats.{value.name}(…).")
    raise ValueError(f"{argument}: must be {ALLOWED_PRIOR}, got {value!r}.")


def _joint(key: tuple[str, ...], value: Any) -> MultivariateNormal:
    if not isinstance(value, MultivariateNormal):
        from scipy.stats.distributions import rv_frozen

        text = as_written(value) if isinstance(value, rv_frozen) else repr(value)
        raise ValueError(
            f"priors[{key!r}]: must be MultivariateNormal(mean, covariance) for a tuple of names, got {text}."
        )
    if value.dimension != len(key):
        raise ValueError(
            f"priors[{key!r}]: must be a MultivariateNormal of {len(key)} parameters, one per name, "
            f"got {value.dimension}."
        )
    return value
