"""Factors of ∂g/∂z, for right-hand sides, their transpose, and systems bordered by further unknowns."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np

from bayesperiodic.periodic.compiled import kernels
from bayesperiodic.periodic.schemes import CyclicGrid


class CyclicFactors:
    """The folded band of ∂g/∂z, factored with pivoting.

    Parameters
    ----------
    grid : CyclicGrid
    columns : array (points, states·(1 + 3·states))
        g and ∂g/∂(q, q̇, q̈), as the model's grid function gives them.
    states : int
    frequency : float
        [Hz].

    Attributes
    ----------
    regular : bool
        False if a pivot is zero or not finite; then only `solve_bordered` may work.
    """

    def __init__(self, grid: CyclicGrid, columns: np.ndarray, states: int, frequency: float):
        self._grid, self._states = grid, states
        self._compiled: SimpleNamespace = kernels(states, grid.stencil)
        self._lower = grid.half_width * states + states - 1
        size = grid.points * states
        self._band = np.empty((size, 3 * self._lower + 1))
        self._pivots = np.full(size, -1)
        self._compiled.assemble(columns, grid.packed, states, frequency, self._band)
        self.regular = bool(self._compiled.factor(self._band, self._lower, self._lower, self._pivots))
        self._complete = self.regular or bool(np.all(self._pivots >= 0) and np.isfinite(self._band[-1, self._lower]))
        self._deflation: tuple[float, int] | None = None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return x (…, points, states) of ∂g/∂z·x = right."""
        return self._substitute(self._compiled.solve, right)

    def solve_transposed(self, right: np.ndarray) -> np.ndarray:
        """Return x (…, points, states) of (∂g/∂z)ᵀ·x = right."""
        return self._substitute(self._compiled.solve_transposed, right)

    def solve_bordered(
        self, columns: np.ndarray, rows: np.ndarray, corner: np.ndarray, right: np.ndarray, below: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Solve [∂g/∂z, B; C, D]·(x, y) = (right, below), also where ∂g/∂z alone is singular; None if all is.

        The last pivot, where the singularity of a cyclic system gathers, is replaced by one of ordinary size; what this
        changes is undone as one more bordering unknown.

        Parameters
        ----------
        columns, rows : array (borders, points, states)
            B and C.
        corner : array (borders, borders)
            D.
        right : array (sides, points, states)
        below : array (sides, borders)

        Returns
        -------
        x : array (sides, points, states)
        y : array (sides, borders)
        """
        if not self._complete:
            return None
        size, row = self._deflate()
        unit = np.zeros((1, self._grid.points, self._states))
        unit[0, row // self._states, row % self._states] = size
        borders, sides = len(columns), len(right)
        x = self._substitute(self._compiled.solve, np.concatenate([right, columns, unit]), deflated=True)
        plain, bordering, undone = x[:sides], x[sides : sides + borders], x[-1]
        last = (*np.argwhere(self._grid.place == self._grid.points - 1)[0], self._states - 1)
        small = np.empty((borders + 1, borders + 1))
        small[:borders, :borders] = corner - np.einsum("cps,bps->cb", rows, bordering)
        small[:borders, borders] = np.einsum("cps,ps->c", rows, undone)
        small[borders, :borders] = -bordering[:, last[0], last[1]]
        small[borders, borders] = undone[last] - 1.0
        known = np.empty((sides, borders + 1))
        known[:, :borders] = below - np.einsum("cps,rps->rc", rows, plain)
        known[:, borders] = -plain[:, last[0], last[1]]
        try:
            y = np.linalg.solve(small, known.T).T
        except np.linalg.LinAlgError:
            return None
        x = plain - np.einsum("rb,bps->rps", y[:, :borders], bordering) + y[:, borders, None, None] * undone
        return (x, y[:, :borders]) if np.isfinite(x).all() else None

    def null_vector(self) -> np.ndarray:
        """Return the vector (points, states) of unit length that ∂g/∂z makes smallest, where it is nearly singular."""
        size, row = self._deflate()
        unit = np.zeros((1, self._grid.points, self._states))
        unit[0, row // self._states, row % self._states] = size
        vector = self._substitute(self._compiled.solve, unit, deflated=True)[0]
        return vector / np.linalg.norm(vector)

    def _deflate(self) -> tuple[float, int]:
        """Give the last pivot an ordinary size; return by how much, and the row (natural order) where this acts."""
        if self._deflation is None:
            pivots = self._band[:, self._lower]
            last = 1.0 / pivots[-1] if self.regular else 0.0
            size = float(np.median(1.0 / np.abs(pivots[:-1])))
            self._last_pivots = pivots[-1], 1.0 / size
            row = len(self._pivots) - 1
            for j in range(len(self._pivots) - 2, -1, -1):
                if self._pivots[j] == row:
                    row = j
                elif row == j:
                    row = int(self._pivots[j])
            point = int(np.flatnonzero(self._grid.place == row // self._states)[0])
            self._deflation = size - last, point * self._states + row % self._states
        return self._deflation

    def _substitute(self, routine: Callable[..., None], right: np.ndarray, deflated: bool = False) -> np.ndarray:
        if self._deflation is not None:
            self._band[-1, self._lower] = self._last_pivots[deflated]
        flat = np.empty((right.size // self._band.shape[0], *right.shape[-2:]))
        flat[:, self._grid.place] = right.reshape(flat.shape)
        routine(self._band, self._lower, self._lower, self._pivots, flat.reshape(len(flat), len(self._band)))
        return np.ascontiguousarray(flat[:, self._grid.place]).reshape(right.shape)
