"""Frequency response of a linear structure between few places, with its derivatives by all parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType

import numpy as np
import scipy.linalg

from bayesperiodic._compile.cache import load
from bayesperiodic.models.structure import CONSTANT_PART, POWERS, Structure

# Largest error of a part in the eigenvectors' basis that counts as diagonal, relative to the diagonal.
DIAGONAL = 1e-10
# Part of a matrix that differs from a multiple of another one by no more is that multiple.
MULTIPLE = 1e-14
# Smallest ratio of the singular values of a stiffness matrix that counts as regular.
REGULAR = 1e-13


@dataclass(frozen=True)
class Response:
    """Frequency response at harmonics, (harmonics, rows, columns), and its derivatives, (directions, …)."""

    values: np.ndarray
    derivatives: np.ndarray


class Receptance:
    """Response R·(−(kω)² M + ikω C + K)⁻¹·S of displacements along rows R to forces along columns S.

    M, C and K are sums of parts times factors, which are parameters or 1. Where one basis of real modes diagonalises
    all parts, as with Rayleigh or modal damping, it is computed once; else one matrix is factorised per harmonic.

    Parameters
    ----------
    structure : Structure
    parameters : sequence of str
        Names of the model's parameters.
    rows, columns : array (…, n)
        Weights of the degrees of freedom.
    """

    def __init__(self, structure: Structure, parameters: Sequence[str], rows: np.ndarray, columns: np.ndarray):
        self._rows, self._columns = rows, columns
        parts = [(POWERS[kind], name, a) for kind, named in structure.parts.items() for name, a in named.items()]
        self._powers = np.array([power for power, _, _ in parts])
        self._factors = np.array([-1 if n == CONSTANT_PART else parameters.index(n) for _, n, _ in parts])
        self._matrices = np.stack([a for *_, a in parts])
        self._size = len(parameters)

    @cached_property
    def _modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Diagonals of the parts (parts, n), rows and columns in the modes' basis; None without such a basis."""
        if not all(np.array_equal(a, a.T) for a in self._matrices):
            return None
        mass, stiffness = (self._matrices[self._powers == power].sum(axis=0) for power in (2, 0))
        try:  # of the inverse problem, in which the lowest modes are the most accurate
            inverse, vectors = scipy.linalg.eigh(mass, stiffness)
        except np.linalg.LinAlgError:
            return None
        if not inverse.min() > 0.0:
            return None
        diagonals = np.stack([self._diagonal(a, (mass, inverse), (stiffness, np.ones_like(inverse)), vectors)
                              for a in self._matrices])
        if not np.isfinite(diagonals).all():
            return None
        return diagonals, self._rows @ vectors, self._columns @ vectors

    @staticmethod
    def _diagonal(
        part: np.ndarray, mass: tuple[np.ndarray, np.ndarray], stiffness: tuple[np.ndarray, np.ndarray], vectors: np.ndarray
    ) -> np.ndarray:
        """Return a part in the modes' basis; NaN if it is not diagonal there."""
        for matrix, values in (mass, stiffness):
            ratio = np.vdot(matrix, part) / np.vdot(matrix, matrix)
            if np.abs(part - ratio * matrix).max() <= MULTIPLE * np.abs(part).max():
                return ratio * values
        inside = vectors.T @ part @ vectors
        diagonal = np.diag(inside)
        sizes = np.sqrt(np.abs(diagonal))
        off = np.abs(inside - np.diag(diagonal))
        return diagonal if np.all(off <= DIAGONAL * np.outer(sizes, sizes)) else np.full(len(part), np.nan)

    @property
    def modal(self) -> bool:
        """Whether one basis of real modes diagonalises all parts."""
        return self._modes is not None

    def coefficients(self, parameters: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the factor of each part, (harmonics, parts), at the angular frequencies `rates` [1/s]."""
        factors = np.where(self._factors < 0, 1.0, parameters[self._factors])
        return (1j * rates[:, None]) ** self._powers * factors

    def __call__(
        self, parameters: np.ndarray, frequency: float, harmonics: np.ndarray, directions: Sequence[int] = ()
    ) -> Response:
        """Return the response at multiples of a frequency [Hz], and its derivatives.

        `directions` are indices of parameters, the number of parameters standing for the frequency.
        """
        rates = 2 * np.pi * frequency * harmonics
        factors = self.coefficients(parameters, rates)
        slopes = [self._slope(d, parameters, rates, factors, frequency) for d in directions]
        if self._modes is not None:
            diagonals, rows, columns = self._modes
            inverse = 1.0 / (factors @ diagonals)
            values = np.einsum("ar,kr,br->kab", rows, inverse, columns, optimize=True)
            changes = [-np.einsum("ar,kr,br->kab", rows, inverse**2 * (s @ diagonals), columns, optimize=True) for s in slopes]
        else:
            stiffness = np.tensordot(factors, self._matrices, (1, 0))
            right = np.linalg.solve(stiffness, np.broadcast_to(self._columns.T, (len(rates), *self._columns.T.shape)))
            values, changes = self._rows @ right, []
            if slopes:
                left = np.linalg.solve(stiffness.transpose(0, 2, 1), np.broadcast_to(self._rows.T, (len(rates), *self._rows.T.shape)))
                parts = np.einsum("kna,inj,kjb->kiab", left, self._matrices, right, optimize=True)
                changes = [-np.einsum("ki,kiab->kab", s, parts) for s in slopes]
        return Response(values, np.array(changes).reshape(len(slopes), *values.shape))

    def many(self, parameters: np.ndarray, frequency: float, harmonics: np.ndarray) -> np.ndarray:
        """Return the response (vectors, harmonics, rows, columns) for parameter vectors (vectors, parameters)."""
        if self._modes is None:
            return np.stack([self(theta, frequency, harmonics).values for theta in parameters])
        diagonals, rows, columns = self._modes
        factors = np.where(self._factors < 0, 1.0, parameters[:, self._factors])
        parts = [(factors * (self._powers == power)) @ diagonals for power in (2, 1, 0)]
        products = (rows[:, None] * columns).reshape(-1, diagonals.shape[1])
        result = np.empty((len(parameters), len(harmonics), len(products)), dtype=complex)
        compiled().modal_responses(np.ascontiguousarray(products), *parts, 2 * np.pi * frequency * harmonics, result)
        return result.reshape(*result.shape[:2], len(rows), len(columns))

    @property
    def factors(self) -> tuple[int, ...]:
        """Indices of the parameters that are factors of matrices."""
        return tuple(sorted({int(i) for i in self._factors if i >= 0}))

    def _slope(self, direction: int, parameters: np.ndarray, rates: np.ndarray, factors: np.ndarray, frequency: float) -> np.ndarray:
        """Return the derivative of `coefficients` by a parameter or by the frequency."""
        if direction == self._size:
            return factors * self._powers / frequency
        moved = np.where(self._factors == direction, 1.0, 0.0)
        return (1j * rates[:, None]) ** self._powers * moved


@cache
def compiled() -> ModuleType:
    """Return the compiled functions of condensed equations."""
    return load(Path(__file__).with_name("_kernels").joinpath("condensed.py").read_text(encoding="utf-8"))
