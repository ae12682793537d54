"""Matrices, places and elements of a model made by `Model.from_matrices`, without its symbolic equations."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from inspect import signature
from typing import Any

import numpy as np
import scipy.linalg
import sympy as sp

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


@dataclass(frozen=True, eq=False)
class Base:
    """Motion of all supports together along a direction r; displacements are relative to it.

    The equation of motion has the forces −M r times the acceleration, `loads` being M_i r (n,) by the factor of the
    part of the mass. The input is the derivative of this order of the displacement.
    """

    loads: dict[str, np.ndarray]
    order: int


@dataclass(frozen=True)
class MatrixStructure:
    """What `Model.from_matrices` was given, checked: the matrices, the places, and the elements."""

    matrices: Matrices
    inputs: dict[str, np.ndarray]  # weights (n,) of the place of each force
    bases: dict[str, Base]
    measured: dict[str, tuple[np.ndarray, int]]  # weights (n,) of each output, and the order of its derivative
    carried: dict[str, dict[str, float]]  # of absolute outputs, what a unit displacement of each base adds
    elements: tuple[Any, ...]
    weights: np.ndarray  # (elements, n)

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the inputs, forces before motions of the base."""
        return (*self.inputs, *self.bases)

    @property
    def parts(self) -> dict[str, dict[str, np.ndarray]]:
        """Parts of the matrices by kind and factor."""
        return self.matrices.parts

    @cached_property
    def factors(self) -> dict[str, Expression]:
        """The factors of the parts, by their text."""
        return {text: parse_any(kind, text) for kind, named in self.parts.items() for text in named}

    def linear_terms(self, symbols: Mapping[str, sp.Symbol]) -> Iterator[tuple[sp.Expr, str, int, int]]:
        """Yield the linear terms: factor, letter and number of the matrix, and the derivative of x."""
        for (kind, order), letter in zip(POWERS.items(), "MCK", strict=True):
            for number, factor in enumerate(self.parts[kind]):
                yield self.factors[factor].symbolic(kind, symbols)[0], letter, number, order

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

    @property
    def digest(self) -> str:
        """Text that is equal for equal matrices, places and outputs."""
        arrays = [m for named in self.parts.values() for m in named.values()]
        arrays += [*self.inputs.values(), *(at for at, _ in self.measured.values()), self.weights]
        arrays += [load for base in self.bases.values() for load in base.loads.values()]
        factors = {kind: [*named] for kind, named in self.parts.items()}
        orders = [order for _, order in self.measured.values()]
        bases = {name: base.order for name, base in self.bases.items()}
        content = sha256(b"".join(a.tobytes() for a in arrays)).hexdigest()
        return "\n".join([repr(factors), repr(orders), repr(bases), repr(self.carried), content])

    def latex(self, parameters: dict[str, sp.Symbol], written: dict[sp.Symbol, str]) -> str:
        """Return the equation of motion in LaTeX; symbols of the parameters by name, and how symbols are written."""
        sums, masses, moved = [], [], ("x", r"\dot{x}", r"\ddot{x}")
        for factor, letter, number, order in self.linear_terms(parameters):
            scale = sp.latex(factor, symbol_names=written)
            scale = rf"\left({scale}\right)" if factor.is_Add else scale
            matrix = f"{letter}_{{{number}}}" if factor == 1 else rf"{scale}\,{letter}_{{{number}}}"
            sums.append(f"{matrix} {moved[order]}")
            masses += [matrix] if order == POWERS["mass"] else []
        mass = masses[0] if len(masses) == 1 else rf"\left({' + '.join(masses)}\right)"
        right = ["B u"] if self.inputs or not self.bases else []
        for number, (name, base) in enumerate(self.bases.items()):
            dots = {0: r"\ddot", 1: r"\dot", 2: ""}[base.order]
            right.append(rf"- {mass} r_{{{number}}} {dots}{{\mathrm{{{name}}}}}")
        return " + ".join([*sums, *(["W^T f"] if len(self.weights) else [])]) + f" &= {' '.join(right)}"
