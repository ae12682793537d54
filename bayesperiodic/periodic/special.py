"""Equations of special points of driven models: folds, and points where an output lags the input by a given phase.

A fold in a quantity λ, the frequency or the scale of an input, is a solution of g(z, λ; θ) = 0, ∂g/∂z·v = 0, l·v = 1,
with a fixed row l ([1]_, [2]_). All linear systems are those of [∂g/∂z, ∂g/∂λ; l, 0], which is regular at a fold.
Second derivatives are differences of the Jacobian along the null vector v.

At a point of given phase the unknowns are z and the frequency, and if the amplitude is given too, the scale of the
input. The conditions are linear in the outputs: Im and Re of a complex amplitude, turned by the phase.

References
----------
.. [1] G. Moore, A. Spence, The calculation of turning points of nonlinear equations, SIAM Journal on Numerical Analysis
   17 (1980) 567-576.
.. [2] W. Govaerts, Numerical Methods for Bifurcations of Dynamical Equilibria, SIAM, 2000, chapter 3.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic.periodic.arclength import INPUTS, ParametrisedEquations
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, OTHER_ORBIT, SINGULAR, STALLED, STEP_TOLERANCE
from bayesperiodic.periodic.equations import (
    FREQUENCY,
    BorderedFactors,
    Derivatives,
    PeriodicEquations,
    along,
    frequency_derivatives,
)

# Steps of Newton's iteration, and those of them during which one may be longer than the one before.
MOST_SPECIAL_STEPS, FREE_STEPS = 15, 3
LONGEST_CHANGE = 0.5  # in units of the orbit; a longer one is shortened
BEND_DISTANCE = 1e-5  # of the differences along a direction, in units of the orbit
SMALLEST_SHARE_OF_WAY = 1.0 / 32.0  # of the way from an anchor
LARGEST_LEAP = 0.3  # largest error of a prediction, in units of the orbit and of the predicted change


class SpecialPoint(NamedTuple):
    """The unknowns of a special point, or a change of them."""

    z: np.ndarray  # (…, points, states)
    values: np.ndarray  # (…, unknowns): frequency [Hz], scale of an input
    vector: np.ndarray  # (…, points, states), v at a fold, zeros elsewhere

    def moved(self, change: "SpecialPoint", step: float = 1.0) -> "SpecialPoint":
        """Return the point a step along a change further."""
        return SpecialPoint(*(here + step * part for here, part in zip(self, change, strict=True)))


class SpecialSensitivities(NamedTuple):
    """Derivatives of a special point along several directions."""

    point: SpecialPoint
    outputs: np.ndarray  # (directions, points, channels)


class SolvedPoint(NamedTuple):
    """A special point and its status code, with the steps that it took."""

    point: SpecialPoint
    code: int
    steps: int


class _LinearPoint(NamedTuple):
    """The equations at a point, with the derivatives by the unknowns."""

    equations: PeriodicEquations
    columns: np.ndarray
    derivatives: Derivatives
    f_values: np.ndarray  # (unknowns, points, channels)
    factors: BorderedFactors


@dataclass(frozen=True)
class SpecialEquations:
    """Equations of a special point.

    The unknowns `free` are `FREQUENCY` and the name of an input, whose scale is 1 for the inputs of `equations`.
    """

    equations: PeriodicEquations
    free: tuple[str, ...]
    sign: float = 0.0  # of a fold: −1 where λ is largest along the branch, 1 where it is smallest
    rows: np.ndarray | None = None  # (unknowns, points, channels) of the conditions Σ rows·ŷ = targets; None for a fold
    targets: np.ndarray | None = None  # (unknowns,)
    forward: np.ndarray | None = None  # (points, channels), of the turned amplitude, positive at the lag
    input_slope: np.ndarray | None = None  # (points, 3·inputs), change of the inputs with a free frequency [per Hz]

    @property
    def is_fold(self) -> bool:
        """Whether the point is a fold."""
        return self.rows is None

    @cached_property
    def start_values(self) -> np.ndarray:
        """The unknowns (unknowns,) for the equations as they are."""
        return np.array([self.equations.frequency if name == FREQUENCY else 1.0 for name in self.free])

    @cached_property
    def scaled_inputs(self) -> np.ndarray:
        """The signals (points, 3·inputs) of the input whose scale is unknown, at the frequency of `equations`."""
        inputs, names = self.equations.inputs, self.equations.model.inputs
        width, change = len(names), np.zeros_like(inputs)
        for name in self.free:
            if name != FREQUENCY:
                change[:, names.index(name) :: width] = inputs[:, names.index(name) :: width]
        return change

    @property
    def inputs_at_zero(self) -> np.ndarray:
        """The inputs (points, 3·inputs) where all unknowns are zero, at the frequency of `equations`."""
        still = self.equations.inputs - self.scaled_inputs
        return still if self.input_slope is None else still - self.equations.frequency * self.input_slope

    def parametrised(self, parameters: np.ndarray) -> ParametrisedEquations:
        """Return the equations with the first unknown free, for a continuation."""
        if self.free[0] == FREQUENCY:
            return ParametrisedEquations(self.equations, parameters, (FREQUENCY,))
        base = replace(self.equations, inputs=self.equations.inputs - self.scaled_inputs)
        return ParametrisedEquations(base, parameters, (INPUTS,), self.scaled_inputs)

    def at(self, values: np.ndarray) -> PeriodicEquations:
        """Return the periodic equations at values of the unknowns."""
        here = self.equations
        for name, value in zip(self.free, values, strict=True):
            if name != FREQUENCY:
                here = replace(here, inputs=here.inputs + (value - 1.0) * self.scaled_inputs)
            elif self.input_slope is not None:
                here = replace(here, inputs=here.inputs + (value - here.frequency) * self.input_slope)
        return here.at_frequency(float(values[self.free.index(FREQUENCY)])) if FREQUENCY in self.free else here

    def row(self, vector: np.ndarray) -> np.ndarray:
        """Return the row l (points, states) of a null vector."""
        square = np.sum(vector**2)
        return vector / (square if square > 0.0 else 1.0)

    def null_vector(self, point: SpecialPoint, parameters: np.ndarray, row: np.ndarray) -> SpecialPoint:
        """Return a fold with the null vector v that has l·v = 1."""
        linear = self.linear(point, parameters, row)
        solved = linear.factors.solve_bordered(np.zeros((1, *point.z.shape)), np.ones((1, 1)))
        return point if solved is None else point._replace(vector=solved[0][0])

    def linear(self, point: SpecialPoint, parameters: np.ndarray, row: np.ndarray) -> _LinearPoint:
        """Return the equations linearised at a point, with the row l of a fold."""
        here = self.at(point.values)
        columns, d = here.residual_jacobian(point.z, parameters), here.derivatives(point.z, parameters)
        with np.errstate(all="ignore"):  # callers check that the steps are finite
            slopes = [self._slopes(name, here, point.z, columns, d) for name in self.free]
            g, f = (np.stack(parts) for parts in zip(*slopes, strict=True))
            if self.rows is None:
                factors = here.bordered(columns, g, row[None])
            else:
                corner = np.tensordot(self.rows, f, ((1, 2), (1, 2)))
                factors = here.bordered(columns, g, _pulled_back(here, d, self.rows), corner)
        return _LinearPoint(here, columns, d, f, factors)

    def _slopes(
        self, name: str, here: PeriodicEquations, z: np.ndarray, columns: np.ndarray, d: Derivatives
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ∂g (points, states) and ∂f (points, channels) by one of the unknowns."""
        change = self.scaled_inputs if name != FREQUENCY else self.input_slope
        by_inputs: tuple[Any, Any] = (0.0, 0.0)
        if change is not None:
            ratio = here.frequency / self.equations.frequency
            moved = (change * np.repeat([1.0, ratio, ratio**2], len(here.model.inputs)))[None]
            by_inputs = along(d.g_u, moved)[0], along(d.f_u, moved)[0]
        if name != FREQUENCY:
            return by_inputs
        g, f = frequency_derivatives(here, z, columns, d)
        return g + by_inputs[0], f + by_inputs[1]

    def missed(self, outputs: np.ndarray) -> np.ndarray:
        """Return by how much outputs (points, channels) miss the conditions, (unknowns,)."""
        assert self.rows is not None and self.targets is not None
        return np.tensordot(self.rows, outputs, ((1, 2), (0, 1))) - self.targets

    def newton(self, point: SpecialPoint, parameters: np.ndarray, row: np.ndarray) -> SolvedPoint:
        """Run Newton's iteration from a guess; a fold of the other direction is another orbit."""
        previous = np.inf
        for step in range(1, MOST_SPECIAL_STEPS + 1):
            linear = self.linear(point, parameters, row)
            taken = self._newton_step(linear, point, parameters) if np.isfinite(linear.columns).all() else None
            if taken is None:
                return SolvedPoint(point, SINGULAR if np.isfinite(linear.columns).all() else NOT_FINITE, step)
            change, curvature = taken
            size = self.size(change, point)
            if not size < np.inf:
                return SolvedPoint(point, NOT_FINITE, step)
            point = point.moved(change, min(1.0, LONGEST_CHANGE / max(size, LONGEST_CHANGE)))
            if not np.all(point.values > 0.0) or (step > FREE_STEPS and size > previous > STEP_TOLERANCE):
                return SolvedPoint(point, STALLED, step)
            previous = size
            if size <= STEP_TOLERANCE:
                return SolvedPoint(point, CONVERGED if curvature * self.sign >= 0.0 else OTHER_ORBIT, step)
        return SolvedPoint(point, STALLED, MOST_SPECIAL_STEPS)

    def _newton_step(
        self, linear: _LinearPoint, point: SpecialPoint, parameters: np.ndarray
    ) -> tuple[SpecialPoint, float] | None:
        """Return the Newton step, and d²λ/ds² of a fold; None where the system is singular."""
        count = linear.equations.count
        residual, below = -linear.columns[None, :, :count], np.zeros((1, len(self.free)))
        if not self.is_fold:
            below -= self.missed(linear.equations.outputs(point.z, parameters))
            solved = linear.factors.solve_bordered(residual, below)
            return solved and (SpecialPoint(solved[0][0], solved[1][0], np.zeros_like(point.z)), 0.0)
        right = np.concatenate([residual, np.zeros_like(residual)])
        solved = linear.factors.solve_bordered(right, np.array([[0.0], [1.0]]))
        if solved is None:
            return None
        (moved, tangent), (by, slope) = solved[0], solved[1]
        first, second = SpecialPoint(moved, by, moved), SpecialPoint(tangent, slope, tangent)
        bends = np.stack([self._bend(point, tangent, parameters, change) for change in (first, second)])
        bent = linear.factors.solve_bordered(-bends, np.zeros((2, 1)))
        if bent is None or bent[1][1, 0] == 0.0:
            return None
        share = -(slope[0] + bent[1][0, 0]) / bent[1][1, 0]
        vector = tangent - point.vector + bent[0][0] + share * bent[0][1]
        return SpecialPoint(moved + share * tangent, by + share * slope, vector), float(bent[1][1, 0])

    def _bend(
        self,
        point: SpecialPoint,
        vector: np.ndarray,
        parameters: np.ndarray,
        change: SpecialPoint,
        direction: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the derivative (points, states) of ∂g/∂z · vector along a change of z, values and parameters."""
        size = self.size(SpecialPoint(change.z, change.values, np.zeros_like(change.z)), point)
        if direction is not None:
            size = max(size, float(np.max(np.abs(direction) / np.where(parameters != 0.0, np.abs(parameters), 1.0))))
        if not 0.0 < size < np.inf:
            return np.zeros_like(point.z)
        step, ends = BEND_DISTANCE / size, []
        for by in (step, -step):
            here = self.at(point.values + by * change.values)
            moved = parameters if direction is None else parameters + by * direction
            columns = here.residual_jacobian(point.z + by * change.z, moved)[:, here.count :]
            states = here.changes(vector[None])[0]
            ends.append(np.einsum("neq,nq->ne", columns.reshape(len(columns), here.count, -1), states))
        return (ends[0] - ends[1]) / (2.0 * step)

    def bend_along(self, point: SpecialPoint, parameters: np.ndarray) -> np.ndarray:
        """Return the derivative (points, states) of ∂g/∂z · v along v at a fold."""
        null = SpecialPoint(point.vector, np.zeros(1), point.vector)
        return self._bend(point, point.vector, parameters, null)

    def bends(self, point: SpecialPoint, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives at a fold of `residual_jacobian` along v, and of ∂g/∂z · v by the value."""
        still, here = np.zeros_like(point.z), self.at(point.values)
        step = BEND_DISTANCE / self.size(SpecialPoint(point.vector, np.zeros(1), still), point)
        ends = [here.residual_jacobian(point.z + by * point.vector, parameters) for by in (step, -step)]
        by_value = self._bend(point, point.vector, parameters, SpecialPoint(still, np.ones(1), still))
        return (ends[0] - ends[1]) / (2.0 * step), by_value

    def size(self, change: SpecialPoint, point: SpecialPoint) -> float:
        """Return the largest change in units of each state's largest value, and of the values."""
        sizes = [np.max(np.abs(change.values) / np.abs(point.values))]
        for part, here in ((change.z, point.z), (change.vector, point.vector)):
            unit = np.abs(here).max(axis=0)
            sizes.append(np.max(np.abs(part).max(axis=0) / np.where(unit > 0.0, unit, 1.0)))
        return float(np.max(sizes))

    def sensitivities(
        self, point: SpecialPoint, parameters: np.ndarray, row: np.ndarray, directions: np.ndarray
    ) -> SpecialSensitivities | None:
        """Return the derivatives along directions (directions, parameters) of the parameters; None if singular."""
        linear = self.linear(point, parameters, row)
        d, below = linear.derivatives, np.zeros((len(directions), len(self.free)))
        g, f = (np.tensordot(directions, part, (1, 2)) for part in (d.g_theta, d.f_theta))
        if not self.is_fold:
            assert self.rows is not None
            below -= np.tensordot(f, self.rows, ((1, 2), (1, 2)))
        solved = linear.factors.solve_bordered(-g, below)
        if solved is None:
            return None
        z, values = solved
        vector = np.zeros_like(z)
        if self.is_fold:
            bends = [self.bend_along(point, parameters)]
            for one, by, direction in zip(z, values, directions, strict=True):
                bends.append(self._bend(point, point.vector, parameters, SpecialPoint(one, by, one), direction))
            bent = linear.factors.solve_bordered(-np.stack(bends), np.zeros((len(bends), 1)))
            if bent is None or bent[1][0, 0] == 0.0:
                return None
            share = (-bent[1][1:, 0] / bent[1][0, 0])[:, None, None]
            z, vector = z + share * point.vector, bent[0][1:] + share * bent[0][0]
        f = f + along(d.f_q, linear.equations.changes(z)) + np.tensordot(values, linear.f_values, (1, 0))
        return SpecialSensitivities(SpecialPoint(z, values, vector), f)

    def follow(self, start: SpecialPoint, before: np.ndarray, after: np.ndarray) -> SolvedPoint:
        """Follow a solved point from parameters `before` to `after`, in steps that are halved where one fails."""
        here, done, step, used, failed = start, 0.0, 1.0, 0, False
        row = self.row(start.vector) if self.is_fold else start.vector
        while done < 1.0:
            slope = self.sensitivities(here, before + done * (after - before), row, (after - before)[None])
            if slope is None:
                return SolvedPoint(here, SINGULAR, used)
            change, code, solved = SpecialPoint(*(part[0] for part in slope.point)), STALLED, None
            while step >= SMALLEST_SHARE_OF_WAY:
                guess = here.moved(change, step)
                if np.all(guess.values > 0.0):
                    solved = self.newton(guess, before + (done + step) * (after - before), row)
                    used, code = used + solved.steps, solved.code
                    if code == CONVERGED and not self.leapt(solved.point, guess, here):
                        break
                step, failed = 0.5 * step, True
            else:
                return SolvedPoint(here, OTHER_ORBIT if code == CONVERGED or code == STALLED else code, used)
            assert solved is not None
            here, done = solved.point, done + step
            row = self.row(here.vector) if self.is_fold else row
            if self.is_fold:
                here = here._replace(vector=here.vector / np.sum(row * here.vector))
            step = min(step if failed else 2.0 * step, 1.0 - done)
        return SolvedPoint(here, CONVERGED, used)

    def leapt(self, point: SpecialPoint, predicted: SpecialPoint, start: SpecialPoint) -> bool:
        """Return whether a point is too far from its prediction to be a continuation of `start`."""
        off = SpecialPoint(*(a - b for a, b in zip(point, predicted, strict=True)))
        change = SpecialPoint(*(a - b for a, b in zip(predicted, start, strict=True)))
        return self.size(off, start) > LARGEST_LEAP * max(1.0, self.size(change, start))


def _pulled_back(here: PeriodicEquations, d: Derivatives, rows: np.ndarray) -> np.ndarray:
    """Return the rows (unknowns, points, channels) over the outputs as rows (unknowns, points, states) over z."""
    weights = np.einsum("knc,ncq->knq", rows, d.f_q).reshape(*rows.shape[:2], 3, here.count)
    packed, result = here.grid.packed, weights[:, :, 0].copy()
    for order, scheme in ((1, packed.first), (2, packed.second)):
        for offset, weight in enumerate(scheme):
            if weight != 0.0:
                result[:, packed.neighbours[:, offset]] += here.frequency**order * weight * weights[:, :, order]
    return result
