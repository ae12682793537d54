"""Points of one sheet of a table's branch at many θ, those beyond its folds included.

Where a solve from the anchor fails, the branch may have no orbit at that frequency. Its fold is solved from that of the
anchors, for all θ at once, and points beyond it get the orbit there. Where this does not explain all failures, and
for condensed models, the branch is followed from the nearest points that are solved.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.observation import GroupSolution
from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.compiled import CONVERGED, STALLED, SpecialSolution
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, null_vector
from bayesperiodic.periodic.harmonics import harmonics, sampled
from bayesperiodic.periodic.special import SpecialPoint
from bayesperiodic.periodic.special_batch import SpecialAnchor, SpecialBatch
from bayesperiodic.periodic.special_start import fold_equations
from bayesperiodic.periodic.table_branch import follow, input_change, input_slope, neighbour
from bayesperiodic.problem.description import Description
from bayesperiodic.problem.parameters import ParameterMaps


class SheetPoint(NamedTuple):
    """A point of a sheet."""

    row: int  # of its table
    group: int  # with the next, place among the solves of all experiments
    member: int
    anchor: Anchor

    @property
    def known(self) -> bool:
        """Whether the anchor is an orbit at the point's frequency."""
        return self.anchor.sensitivities is not None


# An end of a sheet, 1 or −1; the last point before its fold where the inputs depend on that.
Place = tuple[int, int | None]
# Solves from which on the folds are solved before the points.
MANY_SOLVES = 8


class FoldSolves:
    """Folds at the ends of a sheet at several θ, each solved once.

    Attributes
    ----------
    beyond : bool array (points, solves)
        Points that are known to be beyond a fold.
    """

    def __init__(self, parameters: np.ndarray, threads: int | None, beyond: np.ndarray):
        self.beyond = beyond
        self._parameters, self._threads = parameters, threads
        self._known: dict[Place, tuple[np.ndarray, SpecialSolution]] = {}

    def at(self, place: Place, batch: SpecialBatch, solves: np.ndarray) -> SpecialSolution:
        """Return the folds at an end for some of the solves (indices), arrays (solves, …)."""
        count = len(self._parameters)
        if place not in self._known:
            self._known[place] = np.zeros(count, dtype=bool), batch.empty(count)
        solved, solution = self._known[place]
        new = solves[~solved[solves]]
        if new.size:
            solved_now = batch.solve(self._parameters[None, new], self._threads, follow=False)
            for whole, part in zip(solution, solved_now, strict=True):
                whole[:, new] = part
            solved[new] = True
        return SpecialSolution(*(part[0, solves] for part in solution))


class Sheet:
    """Points of one sheet of a table, whose experiments and points are in the order of the sweep."""

    def __init__(self, problem: Description, table: Sequence[Experiment], points: Sequence[SheetPoint]):
        assert table[0].sweep is not None
        self.points, self._sign = list(points), table[0].sweep.sign
        self._table = [problem.equations[e.name] for e in table]
        self._frequencies = np.array([table[point.row].frequency for point in points])
        maps = [problem.parameter_maps[e.name] for e in table]
        of_model = [{n: (m.columns.get(n), m.fixed.get(n)) for n in m.parameters[: m.count]} for m in maps]
        self._alike = all(one == of_model[0] for one in of_model)
        self._moving = np.array(ParameterMaps(maps[:1]).moving, dtype=int)
        self._folds: dict[Place, SpecialBatch | None] = {}

    def beyond_folds(self, parameters: np.ndarray, threads: int | None) -> "FoldSolves":
        """Return the folds at parameters (solves, parameters) where the anchors predict that points are beyond them.

        For few solves they are not worth the search for the anchors' folds.
        """
        folds = FoldSolves(parameters, threads, np.zeros((len(self.points), len(parameters)), dtype=bool))
        for heading in (1, -1) if len(parameters) >= MANY_SOLVES and not self._inputs_change else ():
            batch = self._fold(heading, 0)
            if batch is None:
                continue
            solves = np.flatnonzero(self._beyond(batch.predicted(parameters[None])[0, :, 0], heading).any(axis=0))
            if solves.size:
                solution = folds.at((heading, None), batch, solves)
                folds.beyond[:, solves] |= self._beyond(solution.values[:, 0], heading) & (solution.status == CONVERGED)
        return folds

    def _beyond(self, fold: np.ndarray, heading: int) -> np.ndarray:
        """Return which points are beyond folds of these frequencies, (points, solves)."""
        return heading * self._sign * (self._frequencies[:, None] - fold) > 0.0

    def reach(self, groups: Sequence[GroupSolution], folds: "FoldSolves") -> None:
        """Solve the points whose solves have failed; the solutions are changed in place.

        Points beyond a fold get the orbit there, with its frequency.
        """
        for point in self.points:
            if not point.known:
                status = groups[point.group].status[point.member]
                np.maximum(status, STALLED, out=status)
        good = np.stack([groups[p.group].status[p.member] for p in self.points]) == CONVERGED
        missing = ~good & good.any(axis=0)
        if not missing.any():
            return
        for heading in (1, -1):
            missing &= ~self._reach_fold(groups, folds, _at_end(missing, heading), heading)
        for b in np.flatnonzero(missing.any(axis=0)).tolist():
            self._follow(groups, b, good[:, b].tolist())

    def _reach_fold(
        self, groups: Sequence[GroupSolution], folds: "FoldSolves", missing: np.ndarray, heading: int
    ) -> np.ndarray:
        """Return which missing points (points, solves) have been filled with the fold at an end of the sheet.

        That is where the points beyond the fold are the missing ones.
        """
        filled, place = np.zeros_like(missing), np.count_nonzero(missing, axis=0)
        for count in np.unique(place[place > 0]).tolist():
            solves = np.flatnonzero(place == count)
            last = len(self.points) - count - 1 if heading > 0 else count
            batch = self._fold(heading, last)
            if batch is None:
                continue
            solution = folds.at(self._place(heading, last), batch, solves)
            frequency = solution.values[:, 0]
            explained = np.all(self._beyond(frequency, heading) == missing[:, solves], axis=0)
            explained &= (solution.status == CONVERGED) & self._is_valid(frequency, heading, last)
            for k in np.flatnonzero(missing[:, solves[0]]).tolist():
                group, at = groups[self.points[k].group], (self.points[k].member, solves[explained])
                group.outputs[at], group.z[at] = solution.outputs[explained], solution.z[explained]
                group.frequency[at], group.status[at] = frequency[explained], CONVERGED
                filled[k, solves[explained]] = True
        return filled

    def _place(self, heading: int, last: int) -> "Place":
        return heading, last if self._inputs_change else None

    def _fold(self, heading: int, last: int) -> SpecialBatch | None:
        """Return the fold at an end of the sheet, with the inputs next to a point; None if it has none there."""
        place = self._place(heading, last)
        if place not in self._folds:
            with np.errstate(all="ignore"):
                self._folds[place] = self._found_fold(heading, last)
        return self._folds[place]

    def _found_fold(self, heading: int, last: int) -> SpecialBatch | None:
        known = [point for point in self.points if point.known]
        here, there = self._interval(heading, last)
        if not (known and self._alike) or isinstance(here, CondensedEquations) or here.frequency == there.frequency:
            return None
        start = known[-1 if heading > 0 else 0]
        parameters = start.anchor.parameters
        every = [parameters] * len(self._table)
        passages = follow(self._table, every, start.row, start.anchor.z, heading)
        fold = next((passage for passage in passages if passage.is_fold), None)
        if fold is None:
            return None
        direction = "up" if heading * self._sign > 0 else "down"
        special = fold_equations(here, FREQUENCY, direction, input_slope=input_slope(here, there))
        columns = fold.equations.residual_jacobian(fold.z, parameters)
        vector = null_vector(fold.equations.grid, columns, here.count, fold.equations.frequency)
        guess = SpecialPoint(fold.z, np.array([fold.equations.frequency]), vector)
        solved = special.newton(guess, parameters, special.row(vector))
        if solved.code != CONVERGED:
            return None
        return SpecialBatch([special], [SpecialAnchor.at(special, parameters, solved.point, self._moving)])

    def _interval(self, heading: int, last: int) -> tuple[PeriodicEquations, PeriodicEquations]:
        """Return the equations between which the inputs after a point are interpolated."""
        row = self.points[last].row
        return self._table[row], neighbour(self._table, row, heading)

    def _is_valid(self, frequency: np.ndarray, heading: int, last: int) -> np.ndarray:
        """Return whether folds have the interpolated inputs of the table at their frequencies."""
        low, high = sorted(here.frequency for here in self._interval(heading, last))
        return np.full(len(frequency), not self._inputs_change) | ((frequency >= low) & (frequency <= high))

    @cached_property
    def _inputs_change(self) -> bool:
        """Whether the inputs are not those of the first point in the whole table."""
        return any(input_change(self._table[0], here) is not None for here in self._table[1:])

    def _follow(self, groups: Sequence[GroupSolution], b: int, good: Sequence[bool]) -> None:
        """Fill in the missing points of one solve, from their neighbours."""
        equations = [self._table[point.row] for point in self.points]
        parameters = [groups[point.group].parameters[point.member, b] for point in self.points]
        first = good.index(True)
        starts = [(k, 1) for k in range(first, len(good) - 1) if good[k] and not good[k + 1]]
        for start, heading in [*starts, *([(first, -1)] if first else [])]:
            z = groups[self.points[start].group].z[self.points[start].member, b]
            for k, equations_there, orbit in _further(equations, parameters, start, z, heading, good):
                group, member = groups[self.points[k].group], self.points[k].member
                group.outputs[member, b] = equations_there.outputs(orbit, parameters[k])
                points = group.z.shape[2]  # those of a condensed model differ
                group.z[member, b] = orbit if len(orbit) == points else sampled(harmonics(orbit), points)
                group.frequency[member, b] = equations_there.frequency
                group.status[member, b] = CONVERGED


def _at_end(missing: np.ndarray, heading: int) -> np.ndarray:
    """Return which missing points (points, solves) have only missing ones after them, or before them."""
    towards = missing[::-heading]
    return np.logical_and.accumulate(towards, axis=0)[::-heading]


def _further(
    equations: Sequence[PeriodicEquations],
    parameters: Sequence[np.ndarray],
    start: int,
    z: np.ndarray,
    heading: int,
    good: Sequence[bool],
) -> Iterator[tuple[int, PeriodicEquations, np.ndarray]]:
    """Yield number, equations and orbit of the points next to a solved one that are not solved."""
    end = start + heading
    while 0 <= end < len(good) and not good[end]:
        end += heading
    low, high = sorted((start, end - heading))
    part: Any = slice(low, high + 1)
    at = start
    with np.errstate(all="ignore"):
        for passage in follow(equations[part], parameters[part], start - low, z, heading, further=False):
            if passage.is_fold:
                for k in range(at + heading, end, heading):
                    yield k, passage.equations, passage.z
                return
            assert passage.point is not None
            at = low + passage.point
            if at != start:
                yield at, passage.equations, passage.z
