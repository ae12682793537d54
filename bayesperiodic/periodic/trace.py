"""Pseudo-arclength continuation of a family of periodic equations in its first free scalar."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.family import Family, solve_family

MAX_POINTS = 2000
SMALLEST_STEP = 1e-6
LARGEST_TURN = 0.8
FEW_ITERATIONS, MANY_ITERATIONS = 3, 6
GROWTH = 1.5


class Point(NamedTuple):
    """A point of a branch: z (points, states), the free scalars, the unit tangent, how far along, what is special."""

    z: np.ndarray
    values: np.ndarray
    tangent: tuple[np.ndarray, np.ndarray]
    distance: float
    kind: str = ""


class Tracer:
    """The corrector of a continuation, with the scales that make lengths comparable.

    Parameters
    ----------
    family : Family
        Its first free scalar is the one varied; an autonomous model's second is the frequency.
    size : array (states,)
        What scales the states, such as the range of the starting orbit.
    values : array (scalars,)
    until : float
        Where the first scalar shall get to; the distance scales it.
    """

    def __init__(self, family: Family, size: np.ndarray, values: np.ndarray, until: float):
        self.family = family
        points = family.equations.grid.points
        self._size = np.where(size > 0, size, 1.0)
        self._weights = 1.0 / (self._size**2 * points * len(size))
        self._value_scales = np.maximum(np.abs(values), 1e-12)
        self._value_scales[0] = abs(until - values[0])

    def first_tangent(
        self, z: np.ndarray, values: np.ndarray, direction: float
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the unit tangent along which the first scalar goes in a direction (±1)."""
        plain = np.zeros_like(z), np.zeros_like(values)
        plain[1][0] = direction * self._value_scales[0]
        return self.tangent(z, values, plain)

    def tangent(
        self, z: np.ndarray, values: np.ndarray, before: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the unit tangent at a point that continues an earlier one; None if it is not unique."""
        equations, parameters = self.family.at(values)
        columns = equations.residual_jacobian(z, parameters)
        rows, corner = self._conditions(z, before)
        below = np.zeros((1, len(values)))
        below[0, 0] = 1.0
        solved = equations.factors(columns).solve_bordered(
            self.family.slopes(values, z, columns), rows, corner, np.zeros((1, *z.shape)), below
        )
        if solved is None:
            return None
        return self._unit((solved[0][0], solved[1][0]))

    def correct(self, start: Point, step: float) -> tuple[Point, int] | None:
        """Return the point of the branch a step along the tangent from another, and the iterations it took."""
        z, values = start.z + step * start.tangent[0], start.values + step * start.tangent[1]
        rows, corner = self._conditions(z, start.tangent)
        return self._solve(start, z, values, rows, corner, step)

    def stop_at(self, start: Point, end: Point, value: float) -> Point | None:
        """Return the point between two others where the first scalar has a value."""
        share = (value - start.values[0]) / (end.values[0] - start.values[0])
        z, values = start.z + share * (end.z - start.z), start.values + share * (end.values - start.values)
        rows, corner = self._conditions(z, start.tangent)
        rows[0], corner[0] = 0.0, 0.0
        corner[0, 0] = 1.0 / self._value_scales[0]
        solved = self._solve(start, z, values, rows, corner, share * (end.distance - start.distance))
        if solved is None:
            return None
        exact = solved[0].values.copy()
        exact[0] = value
        return solved[0]._replace(values=exact)

    def length(self, change: tuple[np.ndarray, np.ndarray]) -> float:
        """Return the length of a change of z and the scalars."""
        return float(np.sqrt(self._product(change, change)))

    def longest(self, point: Point, largest: float) -> float:
        """Return how long a step may be: longer for a larger orbit, but never above the largest in the first scalar."""
        grown = max(1.0, float((np.ptp(point.z, axis=0) / self._size).max()))
        share = abs(point.tangent[1][0]) / self._value_scales[0]
        return largest * min(grown, 1.0 / max(share, 1e-12))

    def _solve(
        self, start: Point, z: np.ndarray, values: np.ndarray, rows: np.ndarray, corner: np.ndarray, step: float
    ) -> tuple[Point, int] | None:
        targets = np.einsum("rps,ps->r", rows, z) + corner @ values
        found = solve_family(self.family, z, values, rows, corner, targets, self._value_scales)
        if found.code != CONVERGED:
            return None
        tangent = self.tangent(found.z, found.values, start.tangent)
        if tangent is None:
            return None
        return Point(found.z, found.values, tangent, start.distance + step), len(found.history)

    def _conditions(self, z: np.ndarray, tangent: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and corner of: distance along a tangent; for an autonomous model, the phase against z."""
        scalars = len(tangent[1])
        rows, corner = np.zeros((scalars, *z.shape)), np.zeros((scalars, scalars))
        rows[0], corner[0] = tangent[0] * self._weights, tangent[1] / self._value_scales**2
        if scalars > 1:
            rows[1] = self.family.equations.phase_row(z)
        return rows, corner

    def _product(self, a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
        return float(np.sum(a[0] * b[0] * self._weights) + np.sum(a[1] * b[1] / self._value_scales**2))

    def _unit(self, change: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        length = self.length(change)
        return change[0] / length, change[1] / length

    def turn(self, a: Point, b: Point) -> float:
        """Return the cosine of the angle between the tangents of two points."""
        return self._product(a.tangent, b.tangent)


def trace(
    family: Family,
    z: np.ndarray,
    values: np.ndarray,
    *,
    until: float,
    step: float,
    size: np.ndarray | None = None,
    refine: Callable[["Tracer", Point, Point], list[Point]] | None = None,
) -> Iterator[Point]:
    """Yield the points of a branch from a solution until the first scalar gets to a value or leaves on the other side.

    The solution alone is yielded where the branch has no unique tangent, or turns back there (at a fold).

    Parameters
    ----------
    family : Family
    z : array (points, states)
        A solution.
    values : array (scalars,)
    until : float
    step : float
        The largest step of the first scalar.
    size : array (states,), optional
        What scales the states; by default the range of z.
    refine : callable, optional
        Given the tracer and two neighbouring points, returns points to be yielded between them.
    """
    tracer = Tracer(family, np.ptp(z, axis=0) if size is None else size, values, until)
    origin = float(values[0])
    direction = 1.0 if until > origin else -1.0
    tangent = tracer.first_tangent(z, values, direction)
    here = Point(z, values, tangent or (np.zeros_like(z), np.zeros_like(values)), 0.0)
    yield here
    if tangent is None:
        return
    largest = step / abs(until - origin)
    length = largest / 4
    for _ in range(MAX_POINTS):
        corrected = tracer.correct(here, length)
        after, iterations, limit = None, 0, None
        if corrected is not None and _follows(tracer, here, corrected[0], length):
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
            length = min(length * GROWTH, tracer.longest(here, largest))
        elif iterations > MANY_ITERATIONS:
            length /= 2


def _passed(value: float, origin: float, until: float) -> float | None:
    """Return the end of the range that a value has passed, if any."""
    direction = 1.0 if until > origin else -1.0
    if direction * (value - until) >= 0.0:
        return until
    return origin if direction * (value - origin) < 0.0 else None


def _follows(tracer: Tracer, before: Point, after: Point, size: float) -> bool:
    """Return whether a corrected point continues the branch, and did not jump to another."""
    moved = tracer.length((after.z - before.z, after.values - before.values))
    return moved < 2.0 * size and tracer.turn(before, after) > LARGEST_TURN
