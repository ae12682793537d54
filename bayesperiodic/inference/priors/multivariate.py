"""The joint prior of several parameters."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from bayesperiodic import checks
from bayesperiodic.inference.priors.univariate import LOG_ROOT_TWO_PI, Normal


@dataclass(frozen=True, repr=False, eq=False)
class MultivariateNormal:
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
    >>> import bayesperiodic as bp
    >>> prior = bp.MultivariateNormal(mean=[1.0, 2.0], covariance=[[4.0, 1.0], [1.0, 9.0]])
    >>> prior.marginal(1)
    Normal(mean=2.0, sd=3.0)
    >>> prior.gradient([1.0, 5.5]).round(6).tolist()
    [0.1, -0.4]

    An estimate of two parameters becomes the prior of the next experiment, ``fit`` being a `MapEstimate`::

        names = ("k", "c")
        known = bp.MultivariateNormal([fit.theta[n] for n in names], fit.covariance.loc[[*names], [*names]])
        problem = bp.Problem(model, [experiment], priors={names: known})
    """

    mean: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        mean = checks.finite_vector("mean", self.mean).copy()
        covariance = _covariance("covariance", self.covariance, mean.size)
        for name, array in (("mean", mean), ("covariance", covariance)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def dimension(self) -> int:
        """Number of parameters, n."""
        return self.mean.size

    @cached_property
    def _cholesky(self) -> np.ndarray:
        sd = np.sqrt(np.diag(self.covariance))
        return sd[:, None] * np.linalg.cholesky(self.covariance / np.outer(sd, sd))

    @cached_property
    def _whitening(self) -> np.ndarray:
        return solve_triangular(self._cholesky, np.eye(self.dimension), lower=True)

    @cached_property
    def _precision(self) -> np.ndarray:
        return self._whitening.T @ self._whitening

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the normalised log-density.

        Parameters
        ----------
        x : array (…, n)
            Points, each value in its parameter's unit.

        Returns
        -------
        array (…)

        Raises
        ------
        ValueError
            For another last axis.
        """
        x = self._points(x)
        finite = np.isfinite(x).all(axis=-1)
        offset = np.where(finite[..., None], x, self.mean) - self.mean
        # Point by point: the rounding of one product for all may depend on how many there are.
        score = (self._whitening @ offset[..., None])[..., 0]
        constant = np.log(np.diag(self._cholesky)).sum() + self.dimension * LOG_ROOT_TWO_PI
        return np.where(finite, -0.5 * np.sum(score**2, axis=-1) - constant, -np.inf)[()]

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return ∂ log p / ∂x.

        Parameters
        ----------
        x : array (…, n)
            Points, each value in its parameter's unit.

        Returns
        -------
        array (…, n)

        Raises
        ------
        ValueError
            For another last axis.
        """
        return (self.mean - self._points(x)) @ self._precision

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −∂² log p / ∂x², the inverse of the covariance.

        Parameters
        ----------
        x : array (…, n)
            Points, each value in its parameter's unit.

        Returns
        -------
        array (…, n, n)

        Raises
        ------
        ValueError
            For another last axis.
        """
        x = self._points(x)
        return np.broadcast_to(self._precision, (*x.shape[:-1], self.dimension, self.dimension)).copy()

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws.

        Parameters
        ----------
        size : int
        generator : numpy.random.Generator

        Returns
        -------
        array (size, n)
        """
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
            raise ValueError(f"x: shape {x.shape} is not allowed; the last axis must have {self.dimension} values.")
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
        raise ValueError(f"{argument}: {value!r} is not allowed; it must be a matrix of real numbers.") from None
    if matrix.shape != (size, size):
        raise ValueError(f"{argument}: shape {matrix.shape} is not allowed; the mean asks for {(size, size)}.")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{argument}: {matrix.tolist()} is not allowed; every entry must be finite.")
    variances = np.diag(matrix)
    if size and np.all(variances > 0.0):
        scale = np.outer(np.sqrt(variances), np.sqrt(variances))
        if np.any(np.abs(matrix - matrix.T) > 1e-8 * scale):
            raise ValueError(f"{argument}: {matrix.tolist()} is not allowed; it must be symmetric.")
        matrix = 0.5 * (matrix + matrix.T)
        if np.linalg.eigvalsh(matrix / scale).min() > size * np.finfo(float).eps:
            return matrix
    raise ValueError(f"{argument}: {matrix.tolist()} is not allowed; it must be positive definite.")
