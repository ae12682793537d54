"""Frequency response of a linear structure between few places, with its derivatives by all parameters."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from bayesperiodic._compile.cache import load
from bayesperiodic._expressions import Expression
from bayesperiodic.models.structure import CONSTANT_PART, LEAST_REGULAR, POWERS, MatrixStructure

# Arrays at the same point that are not computed again, and rows beyond which they are not kept.
REMEMBERED_ARRAYS, MOST_REMEMBERED_ROWS = 8, 16


@dataclass(frozen=True)
class LinearResponse:
    """Frequency response at harmonics, (harmonics, rows, columns), and its derivatives, (directions, …)."""

    values: np.ndarray
    derivatives: np.ndarray


class LowestModes(NamedTuple):
    """Linear equations in the coordinates of the lowest modes, of unit modal mass."""

    stiffness: np.ndarray  # (modes, modes)
    damping: np.ndarray
    at: np.ndarray  # (elements, modes), displacements of the elements
    compliance: np.ndarray  # (elements, elements), static one of the other modes


class Receptance:
    """LinearResponse R·(−(kω)² M + ikω C + K)⁻¹·S of displacements along rows R to forces along columns S.

    Behind the columns given are those of the motions of the base, −M r times the acceleration. M, C and K are sums of
    parts times factors, which are expressions of parameters. Where one basis of real modes diagonalises all parts, as
    with Rayleigh or modal damping, it is computed once; else one matrix is factorised per harmonic.

    Parameters
    ----------
    structure : MatrixStructure
    parameters : sequence of str
        Names of the model's parameters.
    rows, columns : array (…, n)
        Weights of the degrees of freedom; the columns without those of the base.
    """

    def __init__(self, structure: MatrixStructure, parameters: Sequence[str], rows: np.ndarray, columns: np.ndarray):
        self._structure, self._rows, self._columns = structure, rows, columns
        parts = [(POWERS[kind], name, a) for kind, named in structure.parts.items() for name, a in named.items()]
        self._powers = np.array([power for power, _, _ in parts])
        # Factors that are parameters, or 1 (−1), are taken by their place, others by their expression.
        expressions = [structure.factors[n] for _, n, _ in parts]
        self._factors = np.array([parameters.index(e.text) if e.text in parameters else -1 for e in expressions])
        self._expressions = {
            k: e for k, e in enumerate(expressions) if e.text not in parameters and e.text != CONSTANT_PART
        }
        self._names = tuple(parameters)
        self._matrices = np.stack([a for *_, a in parts])
        self._size, self._regular = len(parameters), False
        if structure.bases:
            self._add_bases([name for _, name, _ in parts])
        self._recent: dict[tuple[Any, ...], Any] = {}

    def _add_bases(self, names: list[str]) -> None:
        """Add a column −M_i r for each base and part of the mass; their sums times factors are those of the bases.

        `_mixing` (parts + 1, columns with parts, columns) are the weights of these sums by factor, and without one.
        """
        given, bases = len(self._columns), [*self._structure.bases.values()]
        loads = [(number, factor, load) for number, base in enumerate(bases) for factor, load in base.loads.items()]
        self._columns = np.array([*self._columns, *(-load for *_, load in loads)])
        self._mixing = np.zeros((len(names) + 1, len(self._columns), given + len(bases)))
        self._mixing[-1, :given, :given] = np.eye(given)
        for place, (number, factor, _) in enumerate(loads, given):
            self._mixing[names.index(factor), place, given + number] = 1.0
        self._orders = np.array([0] * given + [2 - base.order for base in bases])

    def _mixed(self, factors: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the weights of the columns with parts in all columns, (…, harmonics, columns with parts, columns)."""
        weights = np.tensordot(factors, self._mixing[:-1], (-1, 0)) + self._mixing[-1]
        return np.asarray(weights[..., None, :, :] * (1j * rates[:, None, None]) ** self._orders)

    def recent(self, key: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        """Return arrays that are computed, or were so recently with the same key."""
        known = self._recent.get(key)
        if known is None:
            known = compute()
            if len(self._rows) <= MOST_REMEMBERED_ROWS:
                if len(self._recent) >= REMEMBERED_ARRAYS:
                    self._recent = dict([*self._recent.items()][-REMEMBERED_ARRAYS // 2 :])
                self._recent[key] = known
        return known

    @cached_property
    def _modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Diagonals of the parts (parts, n), rows and columns in the modes' coordinates; None without modes."""
        modes = self._structure.matrices.modes
        if modes is None:
            return None
        return modes.diagonals, self._rows @ modes.vectors, self._columns @ modes.vectors

    @cached_property
    def _products(self) -> np.ndarray:
        """Products of the modes at a row and a column, complex (modes, rows·columns)."""
        assert self._modes is not None
        _, rows, columns = self._modes
        return np.ascontiguousarray((rows[:, None] * columns).reshape(-1, rows.shape[1]).T.astype(complex))

    def displacements(
        self, parameters: np.ndarray, frequency: float, harmonics: np.ndarray, forces: np.ndarray
    ) -> np.ndarray:
        """Return the displacements (…, harmonics, n) for forces (…, harmonics, columns)."""
        rates = 2 * np.pi * frequency * harmonics
        factors = self.coefficients(parameters, rates)
        if self._structure.bases:
            forces = (self._mixed(self._values(parameters), rates) @ forces[..., None])[..., 0]
        if self._modes is not None:
            diagonals, _, columns = self._modes
            modes = self._structure.matrices.modes
            assert modes is not None
            return np.asarray((forces @ columns) / (factors @ diagonals) @ modes.vectors.T)
        stiffness, right = np.tensordot(factors, self._matrices, (1, 0)), np.moveaxis(forces @ self._columns, -2, 0)
        sides = right.reshape(len(stiffness), -1, right.shape[-1]).transpose(0, 2, 1)
        solved = np.linalg.solve(stiffness, sides).transpose(0, 2, 1).reshape(right.shape)
        return np.moveaxis(solved, 0, -2)

    def lowest(self, parameters: np.ndarray, count: int, places: np.ndarray) -> "LowestModes":
        """Return the equations in the lowest undamped modes of unit mass; places are rows of weights."""
        modes = self._structure.matrices.modes
        if modes is not None:
            factors = self._values(parameters)
            mass, damping, stiffness = ((factors * (self._powers == power)) @ modes.diagonals for power in (2, 1, 0))
            at, squares, rates = places @ modes.vectors / np.sqrt(mass), stiffness / mass, damping / mass
            order = np.argsort(squares)  # factors may change it
            low, high = order[:count], order[count:]
            compliance = at[:, high] / squares[high] @ at[:, high].T
            within = np.ascontiguousarray(at[:, low])
            return LowestModes(np.diag(squares[low]), np.diag(rates[low]), within, np.ascontiguousarray(compliance))
        vectors, (mass, damping, stiffness) = self.lowest_modes(parameters, count), self.sums(parameters)
        vectors = vectors / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
        inverse = np.linalg.inv(vectors.T @ mass @ vectors)
        at, within = places @ vectors, vectors.T @ stiffness @ vectors
        compliance = places @ np.linalg.solve(stiffness, places.T) - at @ np.linalg.solve(within, at.T)
        return LowestModes(inverse @ within, inverse @ vectors.T @ damping @ vectors, at, compliance)

    @property
    def modal(self) -> bool:
        """Whether one basis of real modes diagonalises all parts."""
        return self._modes is not None

    def lowest_modes(self, parameters: np.ndarray, count: int) -> np.ndarray:
        """Return the lowest undamped modes (n, modes)."""
        mass, _, stiffness = self.sums(parameters)
        given = 0.5 * (stiffness + stiffness.T), 0.5 * (mass + mass.T)
        return np.asarray(scipy.linalg.eigh(*given, subset_by_index=(0, min(count, len(mass)) - 1))[1])

    def sums(self, parameters: np.ndarray) -> list[np.ndarray]:
        """Return mass, damping and stiffness matrix."""
        factors = self._values(parameters)
        return [np.tensordot(factors * (self._powers == power), self._matrices, (0, 0)) for power in (2, 1, 0)]

    def _values(self, parameters: np.ndarray) -> np.ndarray:
        """Return the factors (…, parts) of the parts at parameters (…, parameters)."""
        constant = np.ones((*parameters.shape[:-1], 1))
        result = np.concatenate([parameters, constant], axis=-1)[..., self._factors]
        for place, expression in self._expressions.items():
            result[..., place] = expression.value(self._named(parameters, expression))
        return np.asarray(result)

    def _named(self, parameters: np.ndarray, expression: Expression) -> dict[str, np.ndarray]:
        return {name: parameters[..., self._names.index(name)] for name in expression.names}

    def coefficients(self, parameters: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the factor of each part, (harmonics, parts), at the angular frequencies `rates` [1/s]."""
        factors = self._values(parameters)
        return (1j * rates[:, None]) ** self._powers * factors

    def __call__(
        self, parameters: np.ndarray, frequency: float, harmonics: np.ndarray, directions: Sequence[int] = ()
    ) -> LinearResponse:
        """Return the response at multiples of a frequency [Hz], and its derivatives.

        `directions` are indices of parameters, the number of parameters standing for the frequency.
        """
        self._check_regular(parameters)
        if self._modes is not None and not len(directions):
            values = self.many(parameters[None], frequency, harmonics)[0]
            return LinearResponse(values, np.zeros((0, *values.shape)))
        rates = 2 * np.pi * frequency * harmonics
        factors = self.coefficients(parameters, rates)
        slopes = [self._slope(d, parameters, rates, factors, frequency) for d in directions]
        if self._modes is not None:
            diagonals, rows, columns = self._modes
            inverse, shape = 1.0 / (factors @ diagonals), (len(rates), len(rows), len(columns))
            values = (inverse @ self._products).reshape(shape)
            changes = [
                -(inverse**2 * (s @ diagonals) @ self._products).reshape(shape) if s.any() else np.zeros(shape, complex)
                for s in slopes
            ]
        else:
            stiffness = np.tensordot(factors, self._matrices, (1, 0))
            right = np.linalg.solve(stiffness, np.broadcast_to(self._columns.T, (len(rates), *self._columns.T.shape)))
            values, changes = self._rows @ right, []
            if slopes:
                left = np.linalg.solve(
                    stiffness.transpose(0, 2, 1), np.broadcast_to(self._rows.T, (len(rates), *self._rows.T.shape))
                )
                parts = np.einsum("kna,inj,kjb->kiab", left, self._matrices, right, optimize=True)
                changes = [-np.einsum("ki,kiab->kab", s, parts) for s in slopes]
        if self._structure.bases:
            mixed = self._mixed(self._values(parameters), rates)
            changes = [
                change @ mixed + values @ self._mixed_slope(d, parameters, rates, frequency, mixed)
                for d, change in zip(directions, changes, strict=True)
            ]
            values = values @ mixed
        return LinearResponse(values, np.array(changes).reshape(len(slopes), *values.shape))

    def _mixed_slope(
        self, direction: int, parameters: np.ndarray, rates: np.ndarray, frequency: float, mixed: np.ndarray
    ) -> np.ndarray:
        """Return the derivative of the weights of columns by a parameter or by the frequency."""
        if direction == self._size:
            return mixed * self._orders / frequency
        moved = self._factor_slope(direction, parameters)
        return self._mixed(moved, rates) - self._mixed(np.zeros_like(moved), rates)

    def carried(self, frequency: float, harmonics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the base itself adds to outputs, (harmonics, outputs, inputs), and its slope by the frequency."""
        given = self._structure
        size, orders = np.zeros((2, len(given.measured), len(given.drives)))
        for i, (output, (_, order)) in enumerate(given.measured.items()):
            for name, weight in given.carried.get(output, {}).items():
                j = given.drives.index(name)
                size[i, j], orders[i, j] = weight, order - given.bases[name].order
        values = size * (2j * np.pi * frequency * harmonics[:, None, None]) ** orders
        return values, values * orders / frequency

    def _check_regular(self, parameters: np.ndarray) -> None:
        """Raise a ValueError for a structure that can move without being deformed."""
        if self._modes is None and not self._regular:
            stiffness = self.sums(parameters)[2]
            sizes = np.linalg.svd(stiffness, compute_uv=False)
            if not sizes[-1] > LEAST_REGULAR * sizes[0]:
                raise ValueError(
                    "stiffness: must be regular in a condensed model, got a singular matrix; support the structure, "
                    "such as by soft springs, or take condensed=False."
                )
            self._regular = True

    def many(self, parameters: np.ndarray, frequency: float, harmonics: np.ndarray) -> np.ndarray:
        """Return the response (vectors, harmonics, rows, columns) for parameter vectors (vectors, parameters)."""
        if self._modes is None:
            return np.stack([self(theta, frequency, harmonics).values for theta in parameters])
        diagonals, rows, columns = self._modes
        factors = self._values(parameters)
        parts = [(factors * (self._powers == power)) @ diagonals for power in (2, 1, 0)]
        products = np.ascontiguousarray(self._products.real.T)
        result = np.empty((len(parameters), len(harmonics), len(products)), dtype=complex)
        rates = 2 * np.pi * frequency * harmonics
        compiled().modal_responses(products, *parts, rates, result)
        values = result.reshape(*result.shape[:2], len(rows), len(columns))
        return values @ self._mixed(factors, rates) if self._structure.bases else values

    @property
    def matrix_parameters(self) -> tuple[int, ...]:
        """Indices of the parameters that are factors of matrices."""
        return tuple(sorted(map(self._names.index, self._structure.parameters)))

    def _slope(
        self, direction: int, parameters: np.ndarray, rates: np.ndarray, factors: np.ndarray, frequency: float
    ) -> np.ndarray:
        """Return the derivative of `coefficients` by a parameter or by the frequency."""
        if direction == self._size:
            return factors * self._powers / frequency
        return (1j * rates[:, None]) ** self._powers * self._factor_slope(direction, parameters)

    def _factor_slope(self, direction: int, parameters: np.ndarray) -> np.ndarray:
        """Return the derivatives of the factors by a parameter, (parts,)."""
        moved, name = np.where(self._factors == direction, 1.0, 0.0), self._names[direction]
        for place, expression in self._expressions.items():
            if name in expression.names:
                moved[place] = expression.gradient(self._named(parameters, expression), [name])[name]
        return moved


def unresolved(largest: np.ndarray, f: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a bound of the relative error of the outputs by the number of points, (…).

    Sampled forces f (…, harmonics, elements) have the harmonics beyond half the points added to the low ones. They are
    smaller than the largest of the upper half of the harmonics, which is taken to act at that where the frequency
    response to it is `largest` (outputs, elements). Outputs y are (…, harmonics, outputs).
    """
    upper = f[..., f.shape[-2] // 2 :, :]
    above = np.sqrt(np.max(upper.real**2 + upper.imag**2, axis=-2))
    size = np.sqrt(np.einsum("...kc,...kc->...c", y.real, y.real) + np.einsum("...kc,...kc->...c", y.imag, y.imag))
    return np.asarray(np.max(above @ largest.T / np.maximum(size, np.finfo(float).tiny), axis=-1))


@cache
def compiled() -> ModuleType:
    """Return the compiled functions of condensed equations."""
    memory, condensed = (
        Path(__file__).with_name("_kernels").joinpath(f"{name}.py").read_text(encoding="utf-8")
        for name in ("memory", "condensed")
    )
    return load(condensed, shared=load(memory))
