"""Decompositions of matrices whose rows have different units, and a limit of one BLAS thread.

The entries of Hessians and covariances of parameters differ by many orders of magnitude, because the parameters have
different units. All decompositions here are those of the matrix scaled to a unit diagonal.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")

TINY = np.finfo(float).tiny


def hessian_scale(hessian: np.ndarray) -> np.ndarray:
    """Return 1/√|H_ii|, the units in which a Hessian H has a unit diagonal."""
    return 1.0 / np.sqrt(np.maximum(np.abs(np.diag(hessian)), TINY))


def hessian_eigh(hessian: np.ndarray, scale: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose a Hessian or information matrix H into the eigenpairs of H_ij s_i s_j.

    Parameters
    ----------
    hessian : array (n, n)
        Symmetric.
    scale : array (n,), optional
        The units s; by default `hessian_scale`.

    Returns
    -------
    values : array (n,)
        Ascending eigenvalues w.
    vectors : array (n, n)
        Eigenvectors V, in columns. The inverse is H⁻¹ = (V / w) Vᵀ s_i s_j.
    scale : array (n,)

    Examples
    --------
    >>> import numpy as np
    >>> values, vectors, scale = hessian_eigh(np.array([[4e12, 1e6], [1e6, 1.0]]))
    >>> values.round(12).tolist(), scale.tolist()
    ([0.5, 1.5], [5e-07, 1.0])
    """
    scale = hessian_scale(hessian) if scale is None else scale
    return *np.linalg.eigh(hessian * np.outer(scale, scale)), scale


def covariance_eigh(covariance: np.ndarray, sd: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose a covariance C into the eigenpairs of the correlation C_ij / (sd_i sd_j).

    Parameters
    ----------
    covariance : array (n, n)
        Symmetric.
    sd : array (n,), optional
        By default the standard deviations √C_ii.

    Returns
    -------
    values : array (n,)
        Ascending eigenvalues w.
    vectors : array (n, n)
        Eigenvectors V, in columns. The covariance is C = V w Vᵀ sd_i sd_j.
    sd : array (n,)
    """
    sd = _standard_deviations(covariance) if sd is None else sd
    return *np.linalg.eigh(covariance / np.outer(sd, sd)), sd


def covariance_cholesky(covariance: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of a covariance; raise a LinAlgError unless it is positive definite."""
    sd = _standard_deviations(covariance)
    return sd[:, None] * np.linalg.cholesky(covariance / np.outer(sd, sd))


def _standard_deviations(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.abs(np.diag(covariance)), TINY))


def in_one_thread(function: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """Return the function with BLAS limited to one thread while it runs.

    The matrices of an identification are small. With several threads, which wait in a loop that occupies a core, a step
    of SciPy's L-BFGS-B on 60 unknowns takes a hundred times as long on a busy machine.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
