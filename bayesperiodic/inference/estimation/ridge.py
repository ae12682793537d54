"""The ridge of the objective along one parameter: its best points over all others, outwards from a peak and back."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bayesperiodic.inference.estimation.gauss_newton import PRESSED, Iterate, Objective, climb
from bayesperiodic.inference.priors.univariate import Prior

# How far apart points lie, as changes of the root of the drop; how steps grow, are cut, and when they are short.
SPACING, GROWTH, SHORTENED, SMALLEST = 0.5, 3.0, 0.25, 0.01
# Beyond the root that belongs to 99 %, 2.576, so that the end of that interval lies between two points.
FURTHEST = 2.8
# A step leaves a tenth of the distance to the support's end; the last point leaves a millionth of the peak's, so that
# priors that vanish at the end are seen to, or lies at the outermost thousandth of the prior if that is closer.
NEARER, NEAREST, TAIL = 0.1, 1e-6, 1e-3
MOST_POINTS, MOST_FAILURES, MOST_ROUNDS = 60, 5, 5
GAIN, CUT = 1e-6, 1e-12


class Point(NamedTuple):
    """A value of the parameter and the best iterate found there; None without a finite log-posterior."""

    value: float
    iterate: Iterate | None


@dataclass(frozen=True)
class Ridge:
    """The best points of an objective for every value of one parameter.

    Attributes
    ----------
    objective : Objective
    column : int
        The parameter's place in θ.
    peak : Iterate
        Where to start, anchored.
    """

    objective: Objective
    column: int
    peak: Iterate

    @property
    def at(self) -> float:
        """The parameter at the peak."""
        return float(self.peak.theta[self.column])

    @property
    def _prior(self) -> Prior:
        joint = self.objective.problem.joint_prior
        return joint.marginals[joint.names[self.column]]

    def limits(self) -> tuple[float, float]:
        """Return the outermost values that are tried: close to the ends of the prior's support, or infinite."""
        tails = self._prior.quantile(np.array([TAIL, 1.0 - TAIL]))
        below, above = (self._limit(end, tail) for end, tail in zip(self._prior.support, tails, strict=True))
        return below, above

    def _limit(self, end: float, tail: float) -> float:
        if np.isinf(end):
            return end
        if abs(end - self.at) < PRESSED * self._size():
            return self.at
        nearest = end + NEAREST * (self.at - end)
        return float(tail) if abs(tail - end) < abs(nearest - end) else nearest

    def followed(self) -> list[Point]:
        """Return points, ascending, found from the peak outwards and back from both ends.

        Where the way back finds that an end is too high, the profile goes on from there.
        """
        step, points = SPACING * self._size(), [Point(self.at, self.peak)]
        for _ in range(MOST_ROUNDS):
            top = max(point.iterate.objective for point in points if point.iterate is not None)
            below, above = self._outwards(points[0], -step, top), self._outwards(points[-1], step, top)
            if not below and not above:
                break
            points = sorted([*below, *points, *above], key=lambda point: point.value)
            points = self._swept(self._swept(points)[::-1])[::-1]
        return points

    def _size(self) -> float:
        """Return the standard deviation that the ridge's curvature at the peak tells, or what the prior allows."""
        quartiles = self._prior.quantile(np.array([0.25, 0.75]))
        width = float(quartiles[1] - quartiles[0])
        _, curvature = self._tangent(self.peak)
        if curvature > 0.0:
            return min(curvature**-0.5, width)
        return min(width, *(abs(self.at - end) for end in self._prior.support))

    def _outwards(self, start: Point, step: float, top: float) -> list[Point]:
        """Return points from one on in one direction, each started from the one before.

        The root of twice the drop from the top changes by about `SPACING` from point to point; a step that changes it
        by more than twice that is shortened, unless it is short already and so across a jump.
        """
        end, limit = self._prior.support[step > 0.0], self.limits()[step > 0.0]
        points: list[Point] = []
        (now, here), first, overshot, failures = start, step, end, 0
        while here is not None and now != limit and _root(top, here) <= FURTHEST and len(points) < MOST_POINTS:
            value = _next(now, step, end, limit)
            step, there = value - now, self._climbed(here, value)
            if there is None:
                points.append(Point(value, None))
                step, failures = SHORTENED * step, failures + 1
                if failures == MOST_FAILURES:
                    break
                continue
            ratio = SPACING / max(abs(_root(top, there) - _root(top, here)), SPACING / GROWTH)
            if ratio < 0.5 and abs(step) > SMALLEST * min(abs(first), abs(now - end)):
                step, overshot = step * max(ratio, SHORTENED), value
                continue
            points.append(Point(value, there))
            now, here, top = value, there, max(top, there.objective)
            if ratio < 0.5:
                step, overshot = first, end
                continue
            widest = max(1.0, 0.5 * (overshot - now) / step) if overshot * step > now * step else GROWTH
            step *= min(ratio, widest)
        return points

    def _swept(self, points: list[Point]) -> list[Point]:
        """Return the points from an end on, each started from the one before too, and the better iterates kept.

        Beyond the peak that has been done, and is repeated only as long as it improves.
        """
        kept, improved, side = points[:1], False, np.sign(points[0].value - self.at)
        for point in points[1:]:
            inwards = side != 0.0 and side * (point.value - self.at) >= 0.0
            before = next((p.iterate for p in kept[::-1] if p.iterate is not None), None)
            other = self._climbed(before, point.value) if before is not None and (inwards or improved) else None
            improved = other is not None and (point.iterate is None or other.objective > point.iterate.objective + GAIN)
            kept.append(Point(point.value, other) if improved else point)
        return kept

    def _climbed(self, start: Iterate, value: float) -> Iterate | None:
        """Return the best iterate with the parameter at a value, climbed from a neighbour."""
        held = self._held
        plain = np.where(held, value, start.theta)
        tangent = start.theta + (value - start.theta[self.column]) * self._tangent(start)[0]
        found = [self.objective.at(theta, start.here, start.noise) for theta in (tangent, plain)]
        finite = [iterate for iterate in found if iterate is not None]
        if not finite:
            return None
        first = max(finite, key=lambda iterate: iterate.objective)
        return climb(self.objective, self.objective.anchored(first), held)[0]

    @property
    def _held(self) -> np.ndarray:
        return np.arange(self.peak.theta.size) == self.column

    def _tangent(self, iterate: Iterate) -> tuple[np.ndarray, float]:
        """Return ∂θ/∂parameter along the ridge, (names,), and the curvature −∂²objective/∂parameter² along it.

        Directions of the other parameters without curvature stay where they are.
        """
        hessian, _ = self.objective.hessian_and_gradient(iterate)
        held, slope = self._held, self._held.astype(float)
        if not np.isfinite(hessian).all():
            return slope, 0.0
        scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(hessian)), np.finfo(float).tiny))
        scaled = hessian * np.outer(scale, scale)
        others = np.linalg.pinv(scaled[np.ix_(~held, ~held)], rcond=CUT, hermitian=True) @ scaled[~held, self.column]
        curvature = scaled[self.column, self.column] - others @ scaled[~held, self.column]
        slope[~held] = -scale[~held] * others / scale[self.column]
        return slope, float(curvature / scale[self.column] ** 2) if curvature > CUT else 0.0


def _root(top: float, iterate: Iterate) -> float:
    """Return how many standard deviations the drop from the top is worth."""
    return float(np.sqrt(2.0 * max(top - iterate.objective, 0.0)))


def _next(now: float, step: float, end: float, limit: float) -> float:
    """Return the value a step further, but no further than a limit and most of the way to the support's end."""
    if np.isinf(end):
        return now + step
    inside = min if step > 0.0 else max
    return inside(now + step, end + NEARER * (now - end), limit)
