"""The branch of periodic solutions through the points of a table of responses, round its folds.

Between neighbouring points the inputs are interpolated linearly in the frequency, as functions of τ, so that the branch
meets the equations of every point. It is divided into sheets by its folds: sheet 0 from the first point to the first
fold, and so on. Sheets of odd number are unstable where the branch begins with a stable solution, unless other
bifurcations change that.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesperiodic.periodic.arclength import BranchPoint, ParametrisedEquations, Tracer, trace
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.condensed_branch import with_unknowns
from bayesperiodic.periodic.continuation import FOLD, located
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations

# Frequencies, relative to those of the ends of the table, up to which the branch is followed beyond them, and steps.
BEYOND, BEYOND_STEPS = 2.0, 20
# Points of the branch for each of the table: three passages of a bent peak, four of two of them.
MOST_PASSAGES = 8


@dataclass(frozen=True, eq=False)
class Passage:
    """The branch at a point of the table, or at a fold."""

    sheet: int  # of a fold the sheet that ends there
    z: np.ndarray  # (points, states)
    equations: PeriodicEquations  # at its frequency
    point: int | None = None  # index in the table; None for a fold

    @property
    def is_fold(self) -> bool:
        """Whether the branch turns back here."""
        return self.point is None


def follow(
    table: Sequence[PeriodicEquations],
    parameters: Sequence[np.ndarray],
    start: int,
    z: np.ndarray,
    heading: int = 1,
    *,
    further: bool = True,
) -> Iterator[Passage]:
    """Yield the branch from a solution z at the point `start`, in the order of the branch.

    Parameters
    ----------
    table : sequence of PeriodicEquations
        Of the points, in the order of their frequencies, up or down.
    parameters : sequence of array (parameters,)
        Of each point.
    start : int
    z : array (points, states)
    heading : 1 or -1
        Towards the end or the beginning of the table.
    further : bool
        Follow the branch beyond the ends of the table.
    """
    at, sheet, end = start, 0, len(table) - 1
    yield Passage(sheet, z, table[at], at)
    for _ in range(MOST_PASSAGES * len(table)):
        inside = 0 <= at + heading <= end
        if not inside and not further:
            return
        here = table[at]
        there = neighbour(table, at, heading)
        arrived: np.ndarray | None = z
        back = False
        if there.frequency != here.frequency:
            arrived = None
            for point in _between(here, there, parameters[at], z, 1 if inside else BEYOND_STEPS):
                if point.kind == FOLD:
                    yield Passage(sheet, point.z, _equations_at(here, there, parameters[at], point))
                    sheet += 1
                elif point.distance > 0.0:
                    back = bool(point.values[0] == here.frequency)
                    arrived = point.z if back or point.values[0] == there.frequency else None
        if arrived is None or not (inside or back):
            return
        if back:
            heading = -heading
        else:
            at += heading
        polished = _polished(table[at], parameters[at], arrived)
        if polished is None:
            return
        z = polished
        yield Passage(sheet, z, table[at], at)


def between(here: PeriodicEquations, there: PeriodicEquations, share: float) -> PeriodicEquations:
    """Return the equations of a further point, a share of the way from a point of the table to another."""
    frequency = here.frequency + share * (there.frequency - here.frequency)
    inputs = here.inputs + share * (there.at_frequency(here.frequency).inputs - here.inputs)
    return replace(here, inputs=inputs).at_frequency(frequency)


def input_change(here: PeriodicEquations, there: PeriodicEquations) -> np.ndarray | None:
    """Return the change of the inputs between two points of the table, (points, 3·inputs), at the frequency of `here`.

    None if the inputs are the same.
    """
    change, width = there.at_frequency(here.frequency).inputs - here.inputs, len(here.model.inputs)
    # Of equal inputs the rates, which are converted, differ by rounding errors.
    return change if change[:, :width].any() else None


def input_slope(here: PeriodicEquations, there: PeriodicEquations) -> np.ndarray | None:
    """Return `input_change` per Hz, between points of different frequencies."""
    change = input_change(here, there)
    return None if change is None else change / (there.frequency - here.frequency)


def neighbour(table: Sequence[PeriodicEquations], at: int, heading: int) -> PeriodicEquations:
    """Return the equations of the next point of the table, or at a frequency beyond its end."""
    return table[at + heading] if 0 <= at + heading < len(table) else _beyond(table, at, heading)


def _equations_at(
    here: PeriodicEquations, there: PeriodicEquations, parameters: np.ndarray, point: BranchPoint
) -> PeriodicEquations:
    """Return the equations at a point of the branch between two points of the table."""
    return _interpolated(here, there, parameters).at(point.values)[0]


def _interpolated(here: PeriodicEquations, there: PeriodicEquations, parameters: np.ndarray) -> ParametrisedEquations:
    """Return the equations between two points of the table, whose unknown is the frequency."""
    slope = input_slope(here, there)
    if slope is None:
        return with_unknowns(here, parameters, (FREQUENCY,))
    base = replace(here, inputs=here.inputs - here.frequency * slope)
    return with_unknowns(base, parameters, (FREQUENCY,), input_change=slope)


def _between(
    here: PeriodicEquations, there: PeriodicEquations, parameters: np.ndarray, z: np.ndarray, steps: int
) -> Iterator[BranchPoint]:
    """Yield the points of the branch from a point of the table until it arrives at another, or comes back."""
    yield from trace(
        _interpolated(here, there, parameters),
        z,
        np.array([here.frequency]),
        until=there.frequency,
        step=abs(there.frequency - here.frequency) / steps,
        refine=_folds,
    )


def _folds(tracer: Tracer, before: BranchPoint, after: BranchPoint) -> list[BranchPoint]:
    if before.tangent[1][0] * after.tangent[1][0] >= 0.0:
        return []
    return located(tracer, before, after, FOLD, lambda point: float(point.tangent[1][0]))


def _beyond(table: Sequence[PeriodicEquations], at: int, heading: int) -> PeriodicEquations:
    """Return the equations of the end of the table at a frequency beyond it."""
    rises = table[-1].frequency >= table[0].frequency
    upwards = rises == (heading > 0)
    return table[at].at_frequency(table[at].frequency * (BEYOND if upwards else 1.0 / BEYOND))


def _polished(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> np.ndarray | None:
    """Return the solution at a point of the table itself; None if the solve fails."""
    if isinstance(equations, CondensedEquations):  # on as many points as it takes there
        solved = equations.find(parameters, z)[0]
    else:
        solved = equations.checked(equations.solve(parameters, z))
    return solved.z if solved.code == CONVERGED else None
