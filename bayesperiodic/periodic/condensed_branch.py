"""Condensed equations with one further unknown, for continuation."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from bayesperiodic._linalg import factors
from bayesperiodic.periodic.arclength import INPUTS, Change, ParametrisedEquations
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, NOT_RESOLVED, SINGULAR, STALLED
from bayesperiodic.periodic.condensed import (
    LARGEST_OUTPUT_CHANGE,
    MOST_ELEMENT_POINTS,
    RESOLVED_SHARE,
    CondensedEquations,
)
from bayesperiodic.periodic.element_forces import Forces, Preconditioner, ResponseMatrices, residual_of, times
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, Solved
from bayesperiodic.periodic.harmonics import harmonics, on_grid, resized

# Factor of the number of coupled harmonics where corrections do not contract, and size of these below which it is so.
MORE_COUPLED, SMALL_CORRECTION = 4, 1e-2
# Corrections of a point, their largest ratio, relative size of the last one, and that below which a matrix is reused.
MOST_BRANCH_CORRECTIONS, BRANCH_CONTRACTION, LAST_BRANCH_CORRECTION, REUSED = 15, 0.7, 1e-10, 0.1


class _Bordered:
    """Factors of the derivative by the low harmonics and one unknown, the higher harmonics being treated as uncoupled.

    The border is the `slope` (harmonics, elements) of the residual by the unknown, and the condition row·z +
    corner·value.
    """

    def __init__(
        self,
        given: tuple[Forces, np.ndarray, ResponseMatrices],
        slope: np.ndarray,
        row: np.ndarray,
        corner: float,
        times_low: int,
    ):
        (forces, rates, matrices), points = given, len(row)
        low = Preconditioner.strongly_coupled(forces, rates, matrices.d_f)
        inverse = Preconditioner(forces, rates, matrices.d_f, min(times_low * low, points // 2))
        self._low, self._slope = inverse.low, slope
        self._row = harmonics(row) * np.where(np.arange(points // 2) == 0, points, 2 * points)[:, None]
        size = len(inverse.matrix)
        matrix = np.empty((size + 1, size + 1))
        matrix[:size, :size] = inverse.matrix
        matrix[:size, size], matrix[size, :size] = _flat(slope[: self._low]), _flat(self._row[: self._low])
        matrix[size, size] = corner - self._high(slope)
        self._factors = factors(matrix)

    def _high(self, amplitudes: np.ndarray) -> float:
        return float(np.vdot(self._row[self._low :], amplitudes[self._low :]).real)

    def along_row(self, amplitudes: np.ndarray) -> float:
        """Return row·z for harmonics of z."""
        return float(np.vdot(self._row, amplitudes).real)

    def __call__(self, right: np.ndarray, below: float) -> tuple[np.ndarray, float]:
        """Return the change of the harmonics and of the unknown for a right-hand side."""
        flat = np.append(_flat(right[: self._low]), below - self._high(right))
        solved = scipy.linalg.lu_solve(self._factors, flat, check_finite=False)
        change = right - solved[-1] * self._slope
        real, imaginary = np.split(solved[:-1], 2)
        change[: self._low] = (real + 1j * imaginary).reshape(change[: self._low].shape)
        return change, float(solved[-1])


@dataclass(frozen=True)
class CondensedParametrised(ParametrisedEquations):
    """Condensed equations that depend on one unknown: the frequency, a parameter, or the factor of `input_change`.

    See `arclength.ParametrisedEquations`, also for inputs that depend on the frequency. z has any number of points that
    is a power of two.
    """

    equations: CondensedEquations

    @cached_property
    def _index(self) -> int:
        """Index of the parameter, their number standing for the frequency."""
        return (*self.equations.model.parameters, FREQUENCY).index(self.free[0])

    def at(self, values: np.ndarray) -> tuple[CondensedEquations, np.ndarray]:
        """Return equations and parameters at the value of the unknown (1,)."""
        value, equations = float(values[0]), self.equations
        if self.free[0] == INPUTS:
            return replace(equations, inputs=equations.inputs + value * self.input_change), self.parameters
        if self.free[0] == FREQUENCY:
            here = equations.at_frequency(value)
            if self.input_change.size:
                here = replace(here, inputs=here.inputs + value * self.input_change)
            return here, self.parameters
        return equations, np.where(np.arange(self.parameters.size) == self._index, value, self.parameters)

    @property
    def _directions(self) -> list[int]:
        """The parameter, see `CondensedEquations.slopes`."""
        return [] if self.free[0] == INPUTS else [self._index]

    def _residual(self, d: np.ndarray, values: np.ndarray, directions: list[int]) -> tuple[np.ndarray, float]:
        """Return the residual at harmonics d and the size of its terms; the directions are those to be used next."""
        equations, theta = self.at(values)
        matrices, load = equations.matrices(theta, 2 * len(d), directions)[0], equations.input_harmonics(2 * len(d))
        return residual_of(d, equations.forces(d, theta), matrices, times(matrices.d_u, load))

    def _bordered(
        self, d: np.ndarray, values: np.ndarray, row: np.ndarray, corner: float, times_low: int = 1
    ) -> _Bordered:
        """Return the factors of the linearised equations and a condition row·z + corner·value.

        `times_low` times as many harmonics as elsewhere are taken as coupled.
        """
        equations, theta = self.at(values)
        points = 2 * len(d)
        forces, matrices, of_d, _ = equations.slopes(d, theta, self._directions)
        slope = -of_d[0] if self._directions else np.zeros_like(d)
        if self.input_change.size:
            change = self.input_change[:, : len(equations.model.inputs)]
            slope = slope - times(matrices.d_u, equations.input_harmonics(points, change))
        return _Bordered((forces, equations.rates(points), matrices), slope, row, corner, times_low)

    def along(self, z: np.ndarray, values: np.ndarray, conditions: Change) -> Change | None:
        """Return the change along the branch for which the condition is 1; None if it is not unique."""
        d = harmonics(z)
        try:
            inverse = self._bordered(d, values, conditions[0][0], conditions[1][0, 0])
        except np.linalg.LinAlgError:
            return None
        x, y = inverse(np.zeros_like(d), 1.0)
        return (on_grid(x, len(z)), np.array([y])) if np.isfinite(x).all() else None

    def solve(
        self, z: np.ndarray, values: np.ndarray, conditions: Change, targets: np.ndarray, scales: np.ndarray
    ) -> Solved:
        """Solve for z and the unknown with a condition rows·z + corner·value = target; see `ParametrisedEquations`.

        The history is that of the steps with a matrix of their own, by whose number the branch adapts its steps.
        """
        d, value, target = harmonics(z), float(values[0]), float(targets[0])
        (row,), corner = conditions[0], float(conditions[1][0, 0])
        history: list[tuple[float, float, float]] = []
        before, inverse, code, times_low = np.inf, None, STALLED, 1
        for _ in range(MOST_BRANCH_CORRECTIONS):
            here = np.array([value])
            fresh = inverse is None
            residual, size = self._residual(d, here, self._directions if fresh else [])
            if not np.isfinite(residual).all():
                code = NOT_FINITE
                break
            try:
                inverse = inverse or self._bordered(d, here, row, corner, times_low)
            except np.linalg.LinAlgError:
                code = SINGULAR
                break
            left = inverse.along_row(d) + corner * value - target
            step, move = inverse(residual, left)
            d, value = d - step, value - move
            length = float(np.hypot(np.linalg.norm(step) / size, move / scales[0]))
            if fresh:
                history.append((float(np.linalg.norm(residual)) / size, length, 1.0))
            ratio = length / before
            if length <= LAST_BRANCH_CORRECTION or (before < np.inf and length * ratio <= LAST_BRANCH_CORRECTION):
                code = CONVERGED
                break
            if ratio > BRANCH_CONTRACTION:
                if times_low > 1 or before > SMALL_CORRECTION:
                    break
                # Close to a fold the coupling of the higher harmonics counts, however weak.
                times_low = MORE_COUPLED
            inverse, before = inverse if ratio < REUSED else None, length
        z = on_grid(d, len(z))
        if code == CONVERGED and len(z) >= MOST_ELEMENT_POINTS and not self._bound(z, value) <= LARGEST_OUTPUT_CHANGE:
            code = NOT_RESOLVED
        return Solved(z, code, np.array(history).reshape(-1, 3), np.array([value]))

    def _bound(self, z: np.ndarray, value: float) -> float:
        equations, theta = self.at(np.array([value]))
        return equations.error_bound(z, theta)

    def resolved(self, z: np.ndarray, values: np.ndarray) -> bool:
        """Return whether the points resolve the outputs, or are the most."""
        return len(z) >= MOST_ELEMENT_POINTS or self._bound(z, float(values[0])) <= RESOLVED_SHARE

    def on_twice_the_points(self, z: np.ndarray) -> np.ndarray:
        """Return the same series of harmonics on twice the points."""
        return on_grid(resized(harmonics(z), 2 * len(z)), 2 * len(z))


def with_unknowns(equations: PeriodicEquations, *given: Any, **settings: Any) -> ParametrisedEquations:
    """Return the equations with further unknowns, condensed or discretised; see `ParametrisedEquations`."""
    kind: Any = CondensedParametrised if isinstance(equations, CondensedEquations) else ParametrisedEquations
    return kind(equations, *given, **settings)


def _flat(amplitudes: np.ndarray) -> np.ndarray:
    return np.concatenate([amplitudes.real.ravel(), amplitudes.imag.ravel()])
