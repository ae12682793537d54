"""Special points at many parameter vectors: predicted from anchors, by compiled Broyden steps or else followed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic.periodic.batch import SMALLEST_BLOCK, in_blocks
from bayesperiodic.periodic.compiled import (
    CONVERGED,
    NOT_RESOLVED,
    STALLED,
    Border,
    Sets,
    SpecialAnchors,
    SpecialSolution,
    kernels,
)
from bayesperiodic.periodic.equations import FREQUENCY
from bayesperiodic.periodic.special import SpecialEquations, SpecialPoint, SpecialSensitivities

# Change of a special point, in units of the point, from one further anchor to the next.
LATTICE = 0.1


@dataclass(frozen=True)
class SpecialAnchor:
    """A solved special point from which others are predicted; or, without sensitivities, a failed solve."""

    parameters: np.ndarray  # (parameters,)
    point: SpecialPoint
    code: int
    sensitivities: SpecialSensitivities | None = None  # by all parameters

    @classmethod
    def at(
        cls, special: SpecialEquations, parameters: np.ndarray, point: SpecialPoint, moving: np.ndarray
    ) -> "SpecialAnchor":
        """Return the anchor at a solution, with derivatives by the parameters `moving` (indices), zero by others."""
        row = special.row(point.vector) if special.is_fold else point.vector
        if special.is_fold:
            point = point._replace(vector=point.vector / np.sum(row * point.vector))
        directions = np.eye(parameters.size)[moving]
        some = special.sensitivities(point, parameters, row, directions)
        if some is None:
            return cls(parameters, point, CONVERGED)
        every = (np.tensordot(directions.T, part, (1, 0)) for part in (*some.point, some.outputs))
        z, values, vector, outputs = every
        return cls(parameters, point, CONVERGED, SpecialSensitivities(SpecialPoint(z, values, vector), outputs))


class _Anchored(NamedTuple):
    """What the compiled functions need of one anchor."""

    band: np.ndarray
    pivots: np.ndarray
    border: Border
    bends: np.ndarray
    bend: np.ndarray
    bent: np.ndarray
    curvature: float
    known: bool


class SpecialBatch:
    """Special points of one model and one kind on one grid with an anchor each, solved for many parameter vectors."""

    def __init__(self, specials: Sequence[SpecialEquations], anchors: Sequence[SpecialAnchor]):
        self._specials, self._anchors = list(specials), list(anchors)
        self._further: dict[tuple[int, ...], SpecialBatch | None] = {}
        first = specials[0]
        self._first, free = first.equations, first.free
        parts = [_anchored(special, anchor) for special, anchor in zip(specials, anchors, strict=True)]
        shape = len(free), self._first.grid.points
        rows = np.zeros((len(specials), *shape, self._first.model.kernels.channels))
        targets, inputs = np.zeros((len(specials), len(free))), []
        self._frequency = free.index(FREQUENCY) if FREQUENCY in free else -1
        for e, special in enumerate(specials):
            if special.rows is not None and special.targets is not None:
                rows[e], targets[e] = special.rows, special.targets
            by_frequency = 0.0 * special.scaled_inputs if special.input_slope is None else special.input_slope
            inputs.append(np.stack([by_frequency if n == FREQUENCY else special.scaled_inputs for n in free]))
        of_points = [a.point for a in anchors]
        slopes = [_slopes(anchor) for anchor in anchors]
        border = Border(*(np.stack(each) for each in zip(*(part.border for part in parts), strict=True)))
        # The order is that of the fields: point, its slopes, factors of the equations, bends of a fold, conditions.
        stacked: list[Any] = [np.stack([a.parameters for a in anchors])]
        stacked += [np.stack([point[k] for point in of_points]) for k in range(3)]
        stacked += [np.stack([slope[k] for slope in slopes]) for k in range(3)]
        stacked += [np.stack([part.band for part in parts]), np.stack([part.pivots for part in parts]), border]
        stacked += [
            np.stack(each) for each in zip(*((part.bends, part.bend, part.bent) for part in parts), strict=True)
        ]
        stacked += [np.array([part.curvature for part in parts]), rows, targets, np.stack(inputs)]
        stacked += [np.array([int(part.known) for part in parts])]
        self._packed = SpecialAnchors(*stacked)
        self._sets = Sets(
            np.stack([s.inputs_at_zero for s in specials]),
            np.array([s.equations.frequency for s in specials]),
            np.stack([s.equations.drift for s in specials]),
        )

    def solve(self, parameters: np.ndarray, threads: int | None = None, *, follow: bool = True) -> SpecialSolution:
        """Solve every point for parameters (sets, solves, parameters); the result does not depend on the threads.

        With `follow` those that are far from their anchors are followed in steps.
        """
        first, (sets, solves) = self._first, parameters.shape[:2]
        solution = self.empty(solves)
        reach_many = kernels("special", first.count, first.grid.stencil).reach_many
        given = first.functions, first.grid.packed, self._sets, self._packed, self._frequency
        every = np.ascontiguousarray(parameters)

        def part(block: tuple[int, int]) -> None:
            reach_many(*given, every, *block, solution)
            for index in range(*block):
                e, b = index // solves, index % solves
                if follow and solution.status[e, b] == STALLED:
                    self._follow(e, b, every[e, b], solution)

        in_blocks(part, sets * solves, SMALLEST_BLOCK, threads)
        return solution

    def empty(self, solves: int) -> SpecialSolution:
        """Return arrays for the solutions, with the values of the anchors."""
        first, sets = self._first, len(self._specials)
        points, channels = first.grid.points, first.model.kernels.channels
        z, outputs = np.zeros((sets, solves, points, first.count)), np.zeros((sets, solves, points, channels))
        values = np.tile(self._packed.values[:, None], (1, solves, 1))
        return SpecialSolution(z, outputs, values, *np.zeros((2, sets, solves), dtype=int))

    def predicted(self, parameters: np.ndarray) -> np.ndarray:
        """Return the linear predictions of the unknowns (sets, solves, unknowns) for parameters as in `solve`."""
        changes = parameters - self._packed.parameters[:, None]
        return self._packed.values[:, None] + np.einsum("ebp,epk->ebk", changes, self._packed.value_slopes)

    def frequency(self, solution: SpecialSolution) -> np.ndarray:
        """Return the frequencies (sets, solves) of solutions [Hz]."""
        if self._frequency >= 0:
            return solution.values[..., self._frequency]
        return np.tile(self._sets.frequency[:, None], (1, solution.values.shape[1]))

    def scale(self, solution: SpecialSolution) -> np.ndarray:
        """Return the scales (sets, solves) of the input whose level is unknown; 1 where there is none."""
        scaled = [k for k in range(solution.values.shape[2]) if k != self._frequency]
        return solution.values[..., scaled[0]] if scaled else np.ones(solution.values.shape[:2])

    def _follow(self, e: int, b: int, parameters: np.ndarray, solution: SpecialSolution) -> None:
        """Fill in the solution that follows from the anchor in steps."""
        special, anchor = self._specials[e], self._anchors[e]
        if anchor.sensitivities is None:
            solution.status[e, b] = anchor.code or STALLED
            return
        further = self._further_anchor(e, parameters)
        if further is not None:
            near = further.solve(parameters[None, None], 1, follow=False)
            if near.status[0, 0] != STALLED:
                for whole, part in zip(solution, near, strict=True):
                    whole[e, b] = part[0, 0]
                return
        solved = special.follow(anchor.point, anchor.parameters, parameters)
        point, here = solved.point, special.at(solved.point.values)
        solution.z[e, b], solution.values[e, b] = point.z, point.values
        solution.outputs[e, b] = here.outputs(point.z, parameters)
        jagged = solved.code == CONVERGED and here.kernels.is_jagged(np.ascontiguousarray(point.z), here.inputs)
        solution.status[e, b] = NOT_RESOLVED if jagged else solved.code
        solution.iterations[e, b] += solved.steps

    def _further_anchor(self, e: int, parameters: np.ndarray) -> "SpecialBatch | None":
        """Return the solver anchored at the node of a lattice of parameters next to some, None if it has no point.

        Its edges are changes of parameters that change the point by `LATTICE`. So the anchor depends on the parameters
        alone; it is kept for others near the same node.
        """
        special, anchor = self._specials[e], self._anchors[e]
        slopes = _slopes(anchor)
        each = [SpecialPoint(*(part[p] for part in slopes)) for p in range(parameters.size)]
        rates = np.array([special.size(slope, anchor.point) for slope in each])
        place = np.rint((parameters - anchor.parameters) * rates / LATTICE).astype(int)
        key = (e, *place.tolist())
        if key not in self._further:
            node = anchor.parameters + np.divide(place * LATTICE, rates, out=np.zeros_like(rates), where=rates > 0.0)
            solved, self._further[key] = special.follow(anchor.point, anchor.parameters, node), None
            if solved.code == CONVERGED:
                there = SpecialAnchor.at(special, node, solved.point, np.flatnonzero(rates > 0.0))
                self._further[key] = SpecialBatch([special], [there])
        return self._further[key]


def _anchored(special: SpecialEquations, anchor: SpecialAnchor) -> _Anchored:
    """Return the factors at an anchor, and how the null vector and the unknown of a fold bend along the branch."""
    point, known = anchor.point, anchor.sensitivities is not None
    row = special.row(point.vector) if special.is_fold else point.vector
    linear = special.linear(point, anchor.parameters, row)
    factors, bent, curvature = linear.factors, np.zeros_like(point.z), 0.0
    bends, bend = np.zeros_like(linear.columns), np.zeros_like(point.z)
    if special.is_fold and known:
        bends, bend = special.bends(point, anchor.parameters)
        solved = factors.solve_bordered(-special.bend_along(point, anchor.parameters)[None], np.zeros((1, 1)))
        known = solved is not None and solved[1][0, 0] != 0.0
        if solved is not None:
            bent, curvature = solved[0][0], float(solved[1][0, 0])
    return _Anchored(
        factors.band, factors.pivots, factors.border, bends, bend, bent, curvature, known and factors.regular
    )


def _slopes(anchor: SpecialAnchor) -> SpecialPoint:
    """Return the sensitivities of an anchor, zeros if it has none."""
    if anchor.sensitivities is not None:
        return anchor.sensitivities.point
    return SpecialPoint(*(np.zeros((anchor.parameters.size, *part.shape)) for part in anchor.point))
