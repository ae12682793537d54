"""The directions of the parameters to which no output reacts, at one general value: what is determined, what not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from bayesperiodic.models.structure.generators import Generator
from bayesperiodic.models.structure.rank import silent_directions
from bayesperiodic.models.structure.system import System

SMALL = 1e-7


@dataclass(frozen=True)
class Directions:
    """Directions to which no output reacts.

    Attributes
    ----------
    rows : array (directions, parameters)
        Orthonormal, relative to the values of the parameters.
    names : tuple of str
        The parameters.
    values : dict
        Symbol -> value, of known parameters too.
    points : int
        Number of values at which sensitivities were computed; 0 if the rows are those of the symmetries.
    unexplained : tuple of str
        Parameters in directions that no symmetry explains.
    """

    rows: np.ndarray
    names: tuple[str, ...]
    values: dict[sp.Symbol, float]
    points: int = 0
    unexplained: tuple[str, ...] = ()

    @property
    def moved(self) -> list[str]:
        """The parameters that are not determined."""
        return [n for n, column in zip(self.names, self.rows.T, strict=True) if np.any(np.abs(column) > SMALL)]

    def alone(self, name: str) -> bool:
        """Return whether a parameter moves by itself."""
        column = self.names.index(name)
        return _rank(np.delete(self.rows, column, axis=1)) < len(self.rows)

    def partners(self, name: str) -> list[str]:
        """Return the other parameters that stand still whenever one does."""
        columns = dict(zip(self.names, self.rows.T, strict=True))
        return [n for n in self.moved if n != name and _rank(np.array([columns[name], columns[n]])) == 1]

    def smallest_set(self) -> tuple[str, ...]:
        """Return the first parameters that, once known, leave no direction."""
        chosen: list[int] = []
        for column in range(len(self.names)):
            if _rank(self.rows[:, [*chosen, column]]) > len(chosen):
                chosen.append(column)
        return tuple(self.names[column] for column in chosen)

    def slope(self, expression: sp.Expr, symbols: Sequence[sp.Symbol]) -> np.ndarray:
        """Return the derivatives of an expression by the logarithms of parameters, its largest one ±1."""
        slope = np.array([float((s * sp.diff(expression, s)).subs(self.values)) for s in symbols])
        return slope / max(np.abs(slope).max(initial=0.0), np.finfo(float).tiny)

    def leave(self, expression: sp.Expr, symbols: Sequence[sp.Symbol]) -> bool:
        """Return whether an expression of the parameters does not change along any direction."""
        return bool(np.all(np.abs(self.rows @ self.slope(expression, symbols)) < SMALL))


def directions_of(system: System, generators: Sequence[Generator]) -> Directions:
    """Return the directions of the fewest sensitivities, or those of the symmetries where there are none."""
    symbols = (*system.parameters.values(), *system.known.values())
    general = {s: 0.5 + (0.618 * k) % 1 for k, s in enumerate(symbols, 1)}
    names = tuple(system.parameters)
    found = silent_directions(system) if names else []
    if not found:
        return Directions(_explained(system, generators, general), names, general)
    values, rows = min(found, key=lambda pair: len(pair[1]))
    explained = _explained(system, generators, values)
    rest = rows - rows @ explained.T @ explained
    unexplained = tuple(n for n, size in zip(names, np.abs(rest).max(axis=0, initial=0.0), strict=True) if size > SMALL)
    if unexplained and _has_moving_switches(system):
        return Directions(explained, names, values)
    return Directions(rows, names, values, len(found), unexplained)


def _explained(system: System, generators: Sequence[Generator], values: dict[sp.Symbol, float]) -> np.ndarray:
    moves = [[g.parameters.get(n, sp.S.Zero) / s for n, s in system.parameters.items()] for g in generators]
    slopes = np.array([[float(move.subs(values)) for move in row] for row in moves])
    return np.linalg.qr(slopes.reshape(len(generators), len(system.parameters)).T)[0].T


def _has_moving_switches(system: System) -> bool:
    """Return whether a jump may depend on a parameter in a way that derivatives do not see."""
    switches = set().union(*(e.atoms(sp.sign) for e in (*system.equations, *system.outputs.values())))
    return any(switch.free_symbols & set(system.parameters.values()) for switch in switches)


def _rank(matrix: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=SMALL)) if matrix.size else 0
