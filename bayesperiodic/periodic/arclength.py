"""Pseudo-arclength continuation of periodic equations with further scalar unknowns."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice

import numpy as np

from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.compiled import CONVERGED, Border, Unknowns
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, Solved

INPUTS, PARAMETERS = "all inputs", "all parameters"  # no model's parameter has a name with a space
Change = tuple[np.ndarray, np.ndarray]  # parts for z (…, points, states) and for the unknowns' values (…, unknowns)


@dataclass(frozen=True)
class ParametrisedEquations:
    """Periodic equations that depend on further scalar unknowns.

    The unknowns `free` are `FREQUENCY`, names of parameters, `INPUTS`, the factor of `input_change` (points, 3·inputs)
    that is added to the inputs of `equations`, or `PARAMETERS`, that of `parameter_change` (parameters,). Without
    `INPUTS`, `input_change` is that per Hz, and the inputs of `equations` are those at zero frequency, as functions of
    τ with the time derivatives at the frequency of `equations`.
    """

    equations: PeriodicEquations
    parameters: np.ndarray
    free: tuple[str, ...]
    input_change: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    parameter_change: np.ndarray = field(default_factory=lambda: np.empty(0))

    @cached_property
    def _base(self) -> np.ndarray:
        """The parameters where all unknowns are zero."""
        return np.where([name in self.free for name in self.equations.model.parameters], 0.0, self.parameters)

    def _unknowns(self, values: np.ndarray, targets: np.ndarray, scales: np.ndarray) -> Unknowns:
        parameters = np.zeros((len(self.free), self.parameters.size))
        moving = INPUTS if INPUTS in self.free else FREQUENCY
        inputs = np.zeros((len(self.free), *self.input_change.shape))
        for k, name in enumerate(self.free):
            if name == moving:
                inputs[k] = self.input_change
            if name == PARAMETERS:
                parameters[k] = self.parameter_change
            elif name not in (INPUTS, FREQUENCY):
                parameters[k, self.equations.model.parameters.index(name)] = 1.0
        frequency = self.free.index(FREQUENCY) if FREQUENCY in self.free else -1
        return Unknowns(values.copy(), targets, scales, parameters, inputs, frequency)

    def at(self, values: np.ndarray) -> tuple[PeriodicEquations, np.ndarray]:
        """Return equations and parameters at values of the unknowns."""
        equations, unknowns = self.equations, self._unknowns(values, values, values)
        inputs, parameters = np.empty_like(equations.inputs), np.empty_like(self.parameters)
        fill, setting = equations.bordered_kernels.fill_setting, equations.setting(self._base)
        frequency = fill(setting, unknowns, values, inputs, parameters)
        return replace(equations, frequency=frequency, inputs=inputs), parameters

    def slopes(self, values: np.ndarray, z: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return ∂g/∂(unknowns), (unknowns, points, states)."""
        equations, parameters = self.at(values)
        unknowns, folded = self._unknowns(values, values, values), np.empty((len(self.free), z.size))
        given = equations.functions, equations.grid.packed, equations.setting(parameters), unknowns, equations.states(z)
        table = np.empty((len(z), equations.model.kernels.columns("derivatives")))
        equations.bordered_kernels.fill_slopes(*given, columns, table, folded)
        return np.ascontiguousarray(folded.reshape(-1, *z.shape)[:, equations.grid.packed.place])

    def along(self, z: np.ndarray, values: np.ndarray, conditions: Change) -> Change | None:
        """Return the change along the branch for which the first condition is 1; None if it is not unique."""
        equations, parameters = self.at(values)
        columns = equations.residual_jacobian(z, parameters)
        factors = equations.bordered(columns, self.slopes(values, z, columns), *conditions)
        solved = factors.solve_bordered(np.zeros((1, *z.shape)), np.eye(1, len(values)))
        return solved and (solved[0][0], solved[1][0])

    def resolved(self, z: np.ndarray, values: np.ndarray) -> bool:
        """Return True: the grid is given."""
        return True

    def on_twice_the_points(self, z: np.ndarray) -> np.ndarray:
        """Return z on twice the points, where it may have more of them."""
        raise NotImplementedError

    def solve(
        self, z: np.ndarray, values: np.ndarray, conditions: Change, targets: np.ndarray, scales: np.ndarray
    ) -> Solved:
        """Solve g(z, values) = 0 and rows·z + corner·values = targets from a guess of z and values.

        The conditions are rows (unknowns, points, states) and corner (unknowns, unknowns); for the scales see
        `compiled.Unknowns`.
        """
        (rows, corner), border = conditions, Border.empty(len(values), z.size)
        border.rows.reshape(rows.shape)[:, self.equations.grid.packed.place] = rows
        border.corner[:] = corner
        return self.equations.solve(self._base, z, self._unknowns(values, targets, scales), border)


def solve_autonomous(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray, frequency: float) -> Solved:
    """Solve for an orbit of unknown frequency with the phase condition ∫ q_guess'·(q − q_guess) dτ = 0."""
    free, start = ParametrisedEquations(equations, parameters, (FREQUENCY,)), np.array([frequency])
    row = equations.phase_row(z)
    return free.solve(z, start, (row[None], np.zeros((1, 1))), np.array([np.sum(row * z)]), start)


MAX_POINTS = 2000
SMALLEST_SIZE = 1e-100  # of a state, below which it is zero
SMALLEST_STEP = 1e-6
LARGEST_TURN = 0.8
FEW_ITERATIONS, MANY_ITERATIONS = 3, 6
STEP_GROWTH = 1.5


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of a branch: z, the unknowns' values, the unit tangent, the arclength, the kind."""

    z: np.ndarray
    values: np.ndarray
    tangent: Change
    distance: float
    kind: str = ""


class Tracer:
    """Predictor and corrector of a continuation, with the scales of arclength.

    The first of the unknowns, which are `values` at the start, is varied, and its distance to `until` is its scale; an
    autonomous model's second unknown is the frequency. `size` (states,) holds the scales of the states.
    """

    def __init__(self, equations: ParametrisedEquations, size: np.ndarray, values: np.ndarray, until: float):
        self.parametrised = equations
        self._size = np.where(size > SMALLEST_SIZE, np.minimum(size, 1.0 / SMALLEST_SIZE), 1.0)
        self._weights = 1.0 / (self._size**2 * len(size))  # a point's are these over their number
        self._value_scales = np.maximum(np.abs(values), 1e-12)
        self._value_scales[0] = abs(until - values[0])

    def first_tangent(self, z: np.ndarray, values: np.ndarray, direction: float) -> Change | None:
        """Return the unit tangent along which the first unknown moves in a direction (±1)."""
        plain = np.zeros_like(z), np.zeros_like(values)
        plain[1][0] = direction * self._value_scales[0]
        return self.tangent(z, values, plain)

    def tangent(self, z: np.ndarray, values: np.ndarray, before: Change) -> Change | None:
        """Return the unit tangent at a point that continues an earlier one; None if it is not unique."""
        change = self.parametrised.along(z, values, self._conditions(z, before))
        return change and self.unit(change)

    def correct(self, start: BranchPoint, step: float) -> tuple[BranchPoint, int] | None:
        """Return the point of the branch a step along the tangent from another, and the iterations it took."""
        z, values = start.z + step * start.tangent[0], start.values + step * start.tangent[1]
        return self._solve(start, z, values, self._conditions(z, start.tangent), step)

    def stop_at(self, start: BranchPoint, end: BranchPoint, value: float) -> BranchPoint | None:
        """Return the point between two others where the first unknown has a value."""
        share = (value - start.values[0]) / (end.values[0] - start.values[0])
        z, values = start.z + share * (end.z - start.z), start.values + share * (end.values - start.values)
        rows, corner = self._conditions(z, start.tangent)
        rows[0], corner[0] = 0.0, 0.0
        corner[0, 0] = 1.0 / self._value_scales[0]
        solved = self._solve(start, z, values, (rows, corner), share * (end.distance - start.distance))
        return solved and replace(solved[0], values=np.concatenate([[value], solved[0].values[1:]]))

    def resolved(self, point: BranchPoint) -> bool:
        """Return whether the points of the grid resolve a point of the branch."""
        return self.parametrised.resolved(point.z, point.values)

    def refined(self, point: BranchPoint) -> BranchPoint | None:
        """Return a point of the branch on twice the points of the grid; None if its correction fails."""
        z, tangent = (self.parametrised.on_twice_the_points(part) for part in (point.z, point.tangent[0]))
        corrected = self.correct(replace(point, z=z, tangent=(tangent, point.tangent[1])), 0.0)
        return corrected and corrected[0]

    def length(self, change: Change) -> float:
        """Return the length of a change of z and the values."""
        return float(np.sqrt(self._product(change, change)))

    def longest(self, point: BranchPoint, largest: float) -> float:
        """Return the largest step: longer for a larger orbit, but never above the largest in the first unknown."""
        grown = max(1.0, float((np.ptp(point.z, axis=0) / self._size).max()))
        share = abs(point.tangent[1][0]) / self._value_scales[0]
        return largest * min(grown, 1.0 / max(share, 1e-12))

    def _solve(
        self, start: BranchPoint, z: np.ndarray, values: np.ndarray, conditions: Change, step: float
    ) -> tuple[BranchPoint, int] | None:
        targets = np.einsum("rps,ps->r", conditions[0], z) + conditions[1] @ values
        solved = self.parametrised.solve(z, values, conditions, targets, self._value_scales)
        tangent = self.tangent(solved.z, solved.values, start.tangent) if solved.code == CONVERGED else None
        return tangent and (BranchPoint(solved.z, solved.values, tangent, start.distance + step), len(solved.history))

    def _conditions(self, z: np.ndarray, tangent: Change) -> Change:
        """Return rows and corner of: distance along a tangent; for an autonomous model, the phase against z."""
        unknowns = len(tangent[1])
        rows, corner = np.zeros((unknowns, *z.shape)), np.zeros((unknowns, unknowns))
        rows[0], corner[0] = tangent[0] * (self._weights / len(z)), tangent[1] / self._value_scales**2
        if unknowns > 1:
            rows[1] = self.parametrised.equations.phase_row(z)
        return rows, corner

    def _product(self, a: Change, b: Change) -> float:
        return float(np.sum(a[0] * b[0] * self._weights) / len(a[0]) + np.sum(a[1] * b[1] / self._value_scales**2))

    def unit(self, change: Change) -> Change:
        """Return a change divided by its length."""
        length = self.length(change)
        return change[0] / length, change[1] / length

    def follows(self, before: BranchPoint, after: BranchPoint, step: float) -> bool:
        """Return whether a corrected point continues the branch, and did not jump to another."""
        moved = self.length((after.z - before.z, after.values - before.values))
        return moved < 2.0 * step and self._product(before.tangent, after.tangent) > LARGEST_TURN


def trace(
    equations: ParametrisedEquations,
    z: np.ndarray,
    values: np.ndarray,
    *,
    until: float,
    step: float,
    size: np.ndarray | None = None,
    refine: Callable[["Tracer", BranchPoint, BranchPoint], list[BranchPoint]] | None = None,
) -> Iterator[BranchPoint]:
    """Yield the points of a branch from a solution until the first unknown reaches a value or passes its start.

    Only the solution is yielded if the branch has no unique tangent there or turns back (at a fold). `step` is the
    largest step of the first unknown; `size` (states,) the scales of the states, by default the range of z; `refine`
    returns the points to be yielded between two neighbouring ones.
    """
    tracer = Tracer(equations, np.ptp(z, axis=0) if size is None else size, values, until)
    origin = float(values[0])
    tangent = tracer.first_tangent(z, values, np.sign(until - origin))
    here = BranchPoint(z, values, tangent or (np.zeros_like(z), np.zeros_like(values)), 0.0)
    yield here
    if tangent is None:
        return
    largest = step / abs(until - origin)
    length = largest / 4
    for _ in range(MAX_POINTS):
        corrected = tracer.correct(here, length)
        after, iterations, limit = None, 0, None
        blurred = corrected is not None and not tracer.resolved(corrected[0])
        if blurred and (finer := tracer.refined(here)) is not None:
            here = finer
            continue
        if not blurred and corrected is not None and tracer.follows(here, corrected[0], length):
            after, iterations = corrected
            limit = _passed(after.values[0], origin, until)
            if limit == origin and here.distance == 0.0:
                return
            if limit is not None:
                after = tracer.stop_at(here, after, limit)
        if after is None:
            length /= 2
            if length < SMALLEST_STEP * largest:
                return
            continue
        yield from refine(tracer, here, after) if refine else []
        yield after
        if limit is not None:
            return
        here = after
        if iterations <= FEW_ITERATIONS:
            length = min(length * STEP_GROWTH, tracer.longest(here, largest))
        elif iterations > MANY_ITERATIONS:
            length /= 2


def _passed(value: float, origin: float, until: float) -> float | None:
    """Return the end of the range that a value has passed, if any."""
    if (until - origin) * (value - until) >= 0.0:
        return until
    return origin if (until - origin) * (value - origin) < 0.0 else None


ARRIVED, ROUND_FOLDS, FOLDED = "arrived", "round folds", "fold"
EQUILIBRIUM, SHORTER, PATH_LOST = "equilibrium", "shorter period", "lost"
PATH_STEP, MOST_PATH_POINTS = 0.1, 300


def path_outcome(equations: PeriodicEquations, anchor: Anchor, parameters: np.ndarray) -> str:
    """Return how the branch through an anchor ends on the straight path from its parameters to others.

    "arrived": it leads to an orbit at the other parameters; "round folds": it does so after folds, so that it is not
    the orbit that small steps follow; "fold": it turns back and does not return, or passes its start; "equilibrium":
    the cycle of an autonomous model shrinks to nothing (a Hopf point); "shorter period": the orbit merges with one of
    fewer forcing periods (a period doubling); "lost": the continuation fails.
    """
    change = parameters - anchor.parameters
    autonomous = equations.model.autonomous
    free = (PARAMETERS, FREQUENCY) if autonomous else (PARAMETERS,)
    here = equations.at_frequency(anchor.frequency) if autonomous else equations
    values = np.array([0.0, anchor.frequency]) if autonomous else np.zeros(1)
    parametrised = ParametrisedEquations(here, anchor.parameters, free, parameter_change=change)
    once, folded = equations.kernels.repetitions(anchor.z, equations.grid.periods), False
    before = anchor.z
    with np.errstate(all="ignore"):
        for point in islice(trace(parametrised, anchor.z, values, until=1.0, step=PATH_STEP), MOST_PATH_POINTS):
            # Beyond a Hopf point the cycle is the same one half a period later.
            if autonomous and np.sum((point.z - point.z.mean(axis=0)) * (before - before.mean(axis=0))) <= 0.0:
                return EQUILIBRIUM
            if equations.kernels.repetitions(point.z, equations.grid.periods) > once:
                return SHORTER
            if point.values[0] == 1.0:
                return ROUND_FOLDS if folded else ARRIVED
            folded |= bool(point.tangent[1][0] < 0.0)
            before = point.z
    return FOLDED if folded else PATH_LOST
