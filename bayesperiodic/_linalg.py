"""Decompositions of matrices whose rows have different units, and a limit of one BLAS thread.

The entries of Hessians and covariances of parameters differ by many orders of magnitude, because the parameters have
different units. All decompositions here are those of the matrix scaled to a unit diagonal.
"""

import os
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
from scipy.linalg import orth
from scipy.linalg.lapack import dgetrf
from threadpoolctl import ThreadpoolController

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")

# What overflows or is not defined in an iteration is not finite, and ends it.
unwarned = np.errstate(over="ignore", invalid="ignore", divide="ignore")
TINY = np.finfo(float).tiny
RANK, ASYMMETRY = 1e-6, 1e-8


def scaled(matrix: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Return M_ij u_i u_j of a matrix (n, n) and units (n,)."""
    return matrix * np.outer(units, units)


def hessian_scale(hessian: np.ndarray) -> np.ndarray:
    """Return 1/√|H_ii|, the units in which a Hessian H has a unit diagonal."""
    return 1.0 / np.sqrt(np.maximum(np.abs(np.diag(hessian)), TINY))


def hessian_eigh(hessian: np.ndarray, scale: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return eigenvalues w, eigenvectors V of H_ij s_i s_j, and s; H⁻¹ = ``scaled((V / w) @ V.T, s)``."""
    scale = hessian_scale(hessian) if scale is None else scale
    return *np.linalg.eigh(scaled(hessian, scale)), scale


def covariance_eigh(covariance: np.ndarray, sd: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return eigenvalues w, eigenvectors V of the correlation C_ij / (sd_i sd_j), and sd, by default √C_ii."""
    sd = _standard_deviations(covariance) if sd is None else sd
    return *np.linalg.eigh(covariance / np.outer(sd, sd)), sd


def covariance_cholesky(covariance: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of a covariance; raise a LinAlgError unless it is positive definite."""
    sd = _standard_deviations(covariance)
    return sd[:, None] * np.linalg.cholesky(covariance / np.outer(sd, sd))


def factors(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return LU factors and pivots of a matrix for `scipy.linalg.lu_solve`; raise a LinAlgError if it is singular."""
    lu, pivots, zero = dgetrf(matrix)
    if zero:
        raise np.linalg.LinAlgError("the matrix is singular")
    return lu, pivots


def column_space(jacobian: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (size, rank) of the span of rows (parameters, size), normalised to unit length."""
    length = np.linalg.norm(jacobian, axis=1)
    rows = jacobian[length > 0.0] / length[length > 0.0, None]
    if not rows.size:
        return np.empty((jacobian.shape[1], 0))
    return orth(rows.T, rcond=RANK)


@unwarned
def asymmetric_entry(covariance: np.ndarray) -> tuple[int, int] | None:
    """Return where a covariance (n, n) differs most from its transpose in units of the sds; None if by rounding."""
    sd = _standard_deviations(covariance)
    difference = np.abs(covariance - covariance.T) / np.outer(sd, sd)
    row, column = divmod(int(np.argmax(difference)), len(sd))
    return (row, column) if difference[row, column] > ASYMMETRY else None


def _standard_deviations(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.abs(np.diag(covariance)), TINY))


def in_one_thread(function: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """Return the function with BLAS limited to one thread while it runs.

    The matrices of an identification are small. With several threads, which wait in a loop that occupies a core, a step
    of SciPy's L-BFGS-B on 60 unknowns takes a hundred times as long on a busy machine.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        with one_thread():
            return function(*args, **kwargs)

    return limited


class _OneThread:
    """The limit of one BLAS thread, which ends when the last of the threads that hold it has left it.

    The number of threads belongs to the process: a block that restored what it saw at its start would restore the limit
    of another one that began before. Where each thread has its own number (OpenMP), it restores that one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: dict[int, list[list[int]]] = {}  # by thread: the numbers at each entry
        self._before: list[int] = []

    def __enter__(self) -> None:
        libraries, thread = _libraries(), threading.get_ident()
        with self._lock:
            numbers = [library.get_num_threads() for library in libraries]
            if not self._held:
                self._before = numbers
            self._held.setdefault(thread, []).append(numbers)
            for library in libraries:
                _set_threads(library, 1)

    def __exit__(self, *_: object) -> None:
        libraries, thread = _libraries(), threading.get_ident()
        with self._lock:
            numbers = self._held[thread].pop()
            if not self._held[thread]:
                del self._held[thread]
            for library, local, shared in zip(libraries, numbers, self._before, strict=True):
                if getattr(library, "threading_layer", None) == "openmp":
                    _set_threads(library, local)
                elif not self._held:
                    _set_threads(library, shared)

    def after_fork(self) -> None:
        """Forget the holders that the new process does not have."""
        self._lock, thread = threading.Lock(), threading.get_ident()
        others = [holder for holder in self._held if holder != thread]
        for holder in others:
            del self._held[holder]
        if others and not self._held:
            for library, shared in zip(_libraries(), self._before, strict=True):
                _set_threads(library, shared)


def _set_threads(library: Any, number: int) -> None:
    release = getattr(library, "clear_controlling_thread", None)  # newer versions let one thread alone set the number
    if release:
        release(force=True)
    library.set_num_threads(number)
    if release:
        release(force=True)


_ONE_THREAD = _OneThread()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_ONE_THREAD.after_fork)


def one_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread, see `in_one_thread`, without a frame of its own where warnings name the caller's."""
    return _ONE_THREAD


@cache
def _libraries() -> list[Any]:
    """Return the loaded libraries of linear algebra; looking for them takes some milliseconds."""
    return [*ThreadpoolController().select(user_api="blas").lib_controllers]
