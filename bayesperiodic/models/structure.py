"""Matrices, places and elements of a model made by `Model.from_matrices`, without its symbolic equations."""

from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any

import numpy as np
import scipy.linalg

from bayesperiodic._expressions import Expression, parse_any

CONSTANT_PART = "1"
POWERS = {"mass": 2, "damping": 1, "stiffness": 0}  # of iω
# Largest entry beside the diagonal of a part in the modes' coordinates, relative to the diagonal.
OFF_DIAGONAL = 1e-10
# Largest difference from a multiple of another matrix, relative to the largest entry.
OFF_MULTIPLE = 1e-14
# Smallest ratio of the eigenvalues of a regular stiffness matrix.
LEAST_REGULAR = 1e-13


class Modes:
    """Real modes that diagonalise all parts of the matrices.

    `diagonals` (parts, modes) are the parts in their coordinates, `vectors` (n, modes) the modes, lowest first.
    """

    def __init__(self, diagonals: np.ndarray, vectors: np.ndarray):
        self.diagonals, self.vectors = diagonals, vectors


@dataclass(frozen=True, eq=False)
class Matrices:
    """Sums of parts times factors, which are expressions of parameters, such as "k", "2*zeta*omega" or "1"."""

    parts: dict[str, dict[str, np.ndarray]]  # by "mass", "damping", "stiffness" and factor, each (n, n)

    @cached_property
    def modes(self) -> Modes | None:
        """Modes that diagonalise all parts, as with Rayleigh or modal damping; None without such modes."""
        every = [a for named in self.parts.values() for a in named.values()]
        if not all(np.array_equal(a, a.T) for a in every):
            return None
        mass, stiffness = (np.sum([*self.parts[kind].values()], axis=0) for kind in ("mass", "stiffness"))
        try:  # of the inverse problem, in which the lowest modes are the most accurate
            root = np.linalg.cholesky(stiffness)
        except np.linalg.LinAlgError:
            return None
        half = scipy.linalg.solve_triangular(root, mass, lower=True)
        inverse, turned = np.linalg.eigh(scipy.linalg.solve_triangular(root, half.T, lower=True))
        vectors = scipy.linalg.solve_triangular(root.T, turned[:, ::-1], lower=False)
        if not inverse[0] > 0.0:
            return None
        known = (mass, inverse[::-1]), (stiffness, np.ones_like(inverse))
        diagonals = [_diagonal(a, known, vectors) for a in every]
        return None if any(d is None for d in diagonals) else Modes(np.array(diagonals), vectors)


def _diagonal(
    part: np.ndarray, known: tuple[tuple[np.ndarray, np.ndarray], ...], vectors: np.ndarray
) -> np.ndarray | None:
    """Return a part in the modes' coordinates (modes,); None if it is not diagonal there."""
    for matrix, values in known:
        ratio = np.vdot(matrix, part) / np.vdot(matrix, matrix)
        if np.abs(part - ratio * matrix).max() <= OFF_MULTIPLE * np.abs(part).max():
            return np.asarray(ratio * values)
    inside = vectors.T @ part @ vectors
    diagonal = np.diag(inside)
    sizes = np.sqrt(np.abs(diagonal))
    beside = np.abs(inside - np.diag(diagonal))
    return diagonal if np.all(beside <= OFF_DIAGONAL * np.outer(sizes, sizes)) else None


@dataclass(frozen=True)
class MatrixStructure:
    """What `Model.from_matrices` was given, checked: the matrices, the places, and the elements."""

    matrices: Matrices
    inputs: dict[str, np.ndarray]  # weights (n,) of the place of each input
    measured: dict[str, tuple[np.ndarray, int]]  # weights (n,) of each output, and the order of its derivative
    elements: tuple[Any, ...]
    weights: np.ndarray  # (elements, n)

    @property
    def parts(self) -> dict[str, dict[str, np.ndarray]]:
        """Parts of the matrices by kind and factor."""
        return self.matrices.parts

    @cached_property
    def factors(self) -> dict[str, Expression]:
        """The factors of the parts, by their text."""
        return {text: parse_any(kind, text) for kind, named in self.parts.items() for text in named}

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names in the factors."""
        return tuple(dict.fromkeys(name for factor in self.factors.values() for name in factor.names))

    @property
    def degrees(self) -> int:
        """Number of degrees of freedom."""
        return self.weights.shape[1]

    @property
    def of_motion(self) -> bool:
        """Whether the elements' forces follow from their displacements, velocities and internal states alone."""
        return all(e.states or "s" not in signature(e.force).parameters for e in self.elements)
