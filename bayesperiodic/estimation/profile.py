"""Profiles: the maximum of the log-density for every value of one parameter, followed from the estimate."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import hessian_scale, in_one_thread, scaled
from bayesperiodic._parallel import TaskPool, checked_executor
from bayesperiodic._printing import written
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.check import at_estimate
from bayesperiodic.estimation.gauss_newton import PRESSED, Iterate, Objective, climb
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.priors.single import Prior

if TYPE_CHECKING:
    import pandas as pd

# Distance of points, as the change of the root of the drop; growth, shortening and smallest size of steps.
ROOT_SPACING, STEP_WIDENING, SHORTENED, SHORTEST_STEP = 0.5, 3.0, 0.25, 0.01
# Above the root 2.576 of a 99 % interval, so that the end of this interval lies between two points.
FURTHEST = 2.8
# A step leaves a tenth of the distance to the support's end. The last point leaves a millionth of the peak's distance,
# because priors may vanish at the end, or is the outermost thousandth of the prior if that is closer.
NEARER, NEAREST, OUTERMOST = 0.1, 1e-6, 1e-3
MOST_PROFILE_POINTS, MOST_FAILURES, MOST_IMPROVEMENTS = 60, 5, 5
# Gain of an improved point; curvature that is none; distance from a known iterate within which a climb leads to it.
LEAST_IMPROVEMENT, CUT, MET = 1e-6, 1e-12, 0.1


class Point(NamedTuple):
    """Value of the parameter, and the best iterate there; None without a finite log-posterior."""

    value: float
    iterate: Iterate | None


@dataclass(frozen=True)
class Ridge:
    """The maxima of an objective for every value of the parameter in one column of θ, from an anchored peak on."""

    objective: Objective
    column: int
    peak: Iterate

    @property
    def at(self) -> float:
        """The parameter at the peak."""
        return float(self.peak.theta[self.column])

    @property
    def _prior(self) -> Prior:
        joint = self.objective.density.problem.joint_prior
        return joint.marginals[joint.names[self.column]]

    def limits(self) -> tuple[float, float]:
        """Return the outermost values: close to the ends of the prior's support, or infinite."""
        tails = self._prior.quantile(np.array([OUTERMOST, 1.0 - OUTERMOST]))
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

        If the way back raises an end, the profile is extended from there.
        """
        step, points = ROOT_SPACING * self._size(), [Point(self.at, self.peak)]
        for _ in range(MOST_IMPROVEMENTS):
            top = max(point.iterate.objective for point in points if point.iterate is not None)
            below, above = self._outwards(points[0], -step, top), self._outwards(points[-1], step, top)
            if not below and not above:
                break
            points = sorted([*below, *points, *above], key=lambda point: point.value)
            points = self._swept(self._swept(points)[::-1])[::-1]
        return points

    def _size(self) -> float:
        """Return the standard deviation by the ridge's curvature at the peak, at most the width of the prior."""
        width = float(np.ptp(self._prior.quantile(np.array([0.25, 0.75]))))
        _, curvature = self._tangent(self.peak)
        if curvature > 0.0:
            return min(curvature**-0.5, width)
        return min(width, *(abs(self.at - end) for end in self._prior.support))

    def _outwards(self, start: Point, step: float, top: float) -> list[Point]:
        """Return points in one direction, each started from the previous one.

        The root of twice the drop from the top changes by about `ROOT_SPACING` from point to point; a step that changes
        it by more than twice that is shortened, unless it is short already, which means that the density jumps.
        """
        end, limit = self._prior.support[step > 0.0], self.limits()[step > 0.0]
        points: list[Point] = []
        (now, here), first, overshot, failures = start, step, end, 0
        while here is not None and now != limit and _root(top, here) <= FURTHEST and len(points) < MOST_PROFILE_POINTS:
            value = _next(now, step, end, limit)
            step, there = value - now, self._climbed(here, value)
            if there is None:
                points.append(Point(value, None))
                step, failures = SHORTENED * step, failures + 1
                if failures == MOST_FAILURES:
                    break
                continue
            ratio = ROOT_SPACING / max(abs(_root(top, there) - _root(top, here)), ROOT_SPACING / STEP_WIDENING)
            if ratio < 0.5 and abs(step) > SHORTEST_STEP * min(abs(first), abs(now - end)):
                step, overshot = step * max(ratio, SHORTENED), value
                continue
            points.append(Point(value, there))
            now, here, top = value, there, max(top, there.objective)
            if ratio < 0.5:
                step, overshot = first, end
                continue
            widest = max(1.0, 0.5 * (overshot - now) / step) if overshot * step > now * step else STEP_WIDENING
            step *= min(ratio, widest)
        return points

    def _swept(self, points: list[Point]) -> list[Point]:
        """Return the points from an end on, each also started from the previous one, with the better iterates.

        Beyond the peak this repeats `_outwards`, and ends when it does not improve.
        """
        kept, improved, side = points[:1], False, np.sign(points[0].value - self.at)
        for point in points[1:]:
            inwards = side != 0.0 and side * (point.value - self.at) >= 0.0
            before = next((p.iterate for p in kept[::-1] if p.iterate is not None), None)
            other = None
            if before is not None and (inwards or improved):
                other = self._climbed(before, point.value, point.iterate)
            improved = other is not None and (
                point.iterate is None or other.objective > point.iterate.objective + LEAST_IMPROVEMENT
            )
            kept.append(Point(point.value, other) if improved else point)
        return kept

    def _climbed(self, start: Iterate, value: float, known: Iterate | None = None) -> Iterate | None:
        """Return the best iterate with the parameter at a value, climbed from a neighbour; a known one if it is met."""
        plain = np.where(self._held, value, start.theta)
        tangent = start.theta + (value - start.theta[self.column]) * self._tangent(start)[0]
        trials = [self.objective.at(theta, start.here, start.noise) for theta in (tangent, plain)]
        first = max(filter(None, trials), key=lambda iterate: iterate.objective, default=None)
        if first is None or (known is not None and self._meets(first, known)):
            return known
        return climb(self.objective, self.objective.anchored(first), self._held).iterate

    def _meets(self, iterate: Iterate, known: Iterate) -> bool:
        """Return whether parameters and residuals are those of a known iterate, which is not worse."""
        likelihood, prior = self.objective.density.problem.likelihood, self.objective.density.problem.joint_prior
        one, other = (np.concatenate(likelihood.whitened(i.here.residuals, known.noise)) for i in (iterate, known))
        off = np.concatenate([one - other, (iterate.theta - known.theta) / prior.widths])
        return bool(iterate.objective <= known.objective and off @ off < MET**2)

    @property
    def _held(self) -> np.ndarray:
        return np.arange(self.peak.theta.size) == self.column

    def _tangent(self, iterate: Iterate) -> tuple[np.ndarray, float]:
        """Return ∂θ/∂parameter along the ridge, (names,), and the curvature −∂²objective/∂parameter² along it.

        Directions of the other parameters without curvature are left out.
        """
        hessian, _ = self.objective.hessian_and_gradient(iterate)
        held, slope = self._held, self._held.astype(float)
        if not np.isfinite(hessian).all():
            return slope, 0.0
        scale = hessian_scale(hessian)
        hessian = scaled(hessian, scale)
        others = np.linalg.pinv(hessian[np.ix_(~held, ~held)], rcond=CUT, hermitian=True) @ hessian[~held, self.column]
        curvature = hessian[self.column, self.column] - others @ hessian[~held, self.column]
        slope[~held] = -scale[~held] * others / scale[self.column]
        return slope, float(curvature / scale[self.column] ** 2) if curvature > CUT else 0.0


def _root(top: float, iterate: Iterate) -> float:
    """Return the drop from the top in standard deviations, √(2·drop)."""
    return float(np.sqrt(2.0 * max(top - iterate.objective, 0.0)))


def _next(now: float, step: float, end: float, limit: float) -> float:
    """Return the value after a step, at most a limit and nine tenths of the way to the support's end."""
    inside = min if step > 0.0 else max
    return now + step if np.isinf(end) else inside(now + step, end + NEARER * (now - end), limit)


WIDEST_INTERVAL = 0.99
BETTER = 1e-4
CLOSED, ONE_SIDED, FLAT_PROFILE = "closed", "one-sided", "flat"


@dataclass(frozen=True)
class Profile(Result):
    """Maximum of the log-density over all other parameters and the noise parameters, for every value of a parameter.

    Attributes
    ----------
    map, sd : dict of str to float
        Estimate and Laplace standard deviations of all free parameters. The Laplace approximation of a profile is
        −improvement − ½((values − map)/sd)².
    values : dict of str to array (points,)
        By profiled parameter, ascending, in its unit.
    log_density : dict of str to array (points,)
        The profile relative to its maximum over all profiles; NaN where no finite log-posterior was found.
    paths : dict of str to array (points, names)
        All free parameters along the profile, in the order of `map`; NaN like the profile.
    limits : dict of str to (float, float)
        Limits of the values, close to the ends of the prior's support, or infinite.
    best : dict of str to float
        Point of that maximum: the estimate, unless a profile finds a better one.
    improvement : float
        Log-density at `best` minus that at the estimate.
    units : dict of str to str
        Of all free parameters.

    Examples
    --------
    >>> found = bp.profile(problem, fit, ["k"])
    >>> found.shape, found.failed
    ({'k': 'closed'}, {'k': 0})
    >>> low, high = found.interval(0.95)["k"]
    >>> low < found.map["k"] < high
    True
    """

    map: dict[str, float]
    sd: dict[str, float]
    values: dict[str, np.ndarray]
    log_density: dict[str, np.ndarray]
    paths: dict[str, np.ndarray]
    limits: dict[str, tuple[float, float]]
    best: dict[str, float]
    improvement: float
    units: dict[str, str]

    @property
    def names(self) -> tuple[str, ...]:
        """The profiled parameters."""
        return tuple(self.values)

    @property
    def failed(self) -> dict[str, int]:
        """Number of points of each profile without a finite log-posterior."""
        return {name: int(np.isnan(density).sum()) for name, density in self.log_density.items()}

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return the outermost values where each profile has dropped by ½χ² with one degree of freedom.

        Between points the root of the drop, a straight line for a parabola, is interpolated monotonically.

        Parameters
        ----------
        probability : float
            Above 0 and at most 0.99, the limit of the profiles.

        Returns
        -------
        dict of str to (float, float)
            Likelihood-ratio intervals. An end is −∞ or ∞ if the profile does not drop so far before the prior's support
            ends, NaN if solves fail before.

        Raises
        ------
        ValueError
            For any other probability.
        """
        if not 0.0 < _checks.finite_number("probability", probability) <= WIDEST_INTERVAL:
            raise ValueError(f"probability: must be above 0 and at most {WIDEST_INTERVAL}, got {probability!r}.")
        level = float(ndtri(0.5 + 0.5 * probability))
        result = {}
        for name, values in self.values.items():
            roots, (low, high) = np.sqrt(np.maximum(-2.0 * self.log_density[name], 0.0)), self.limits[name]
            below = -_crossing(-values[::-1], roots[::-1], level, -low)
            result[name] = below, _crossing(values, roots, level, high)
        return result

    @property
    def shape(self) -> dict[str, str]:
        """Finite ends of the 99 % interval: "closed" (both), "one-sided" or "flat" (none).

        An informative prior also closes a profile.
        """
        named = (FLAT_PROFILE, ONE_SIDED, CLOSED)
        return {name: named[int(np.isfinite(ends).sum())] for name, ends in self.interval(WIDEST_INTERVAL).items()}

    @property
    def table(self) -> pd.DataFrame:
        """One row per profile: map, sd, the 90 % intervals of Laplace and of the profile, shape, points and failed."""
        import pandas as pd

        half = float(ndtri(0.95))
        rows: dict[str, dict[str, object]] = {}
        for name, (low, high) in self.interval(0.9).items():
            at, sd = self.map[name], self.sd[name]
            rows[name] = {
                "map": at, "sd": sd, "laplace_low": at - half * sd, "laplace_high": at + half * sd,
                "low": low, "high": high, "shape": self.shape[name],
                "points": self.values[name].size, "failed": self.failed[name],
            }  # fmt: skip
        return pd.DataFrame.from_dict(rows, orient="index")

    def __repr__(self) -> str:
        text = f"Profile, 90 % intervals:\n{self.table.to_string(float_format='{:.5g}'.format)}"
        if self.improvement > BETTER:
            text += f"\nThe log-density is higher by {self.improvement:.3g} at {written(self.best)}."
        return text


def _crossing(values: np.ndarray, roots: np.ndarray, level: float, limit: float) -> float:
    """Return the last value, right of the lowest root, at which the roots cross a level.

    Infinite if they stay below it up to the limit; NaN if solves fail before, or no root is below the level.
    """
    from scipy.interpolate import PchipInterpolator
    from scipy.optimize import brentq

    top = int(np.nanargmin(roots))
    finite = top + np.flatnonzero(np.isfinite(roots[top:]))
    values, roots = values[finite], roots[finite]
    inside = np.flatnonzero(roots <= level)
    if not inside.size:
        return np.nan
    last = int(inside[-1])
    if last == values.size - 1:
        return np.inf if values[last] == limit else np.nan
    curve = PchipInterpolator(values, roots)
    return float(brentq(lambda x: float(curve(x)) - level, values[last], values[last + 1], xtol=1e-300, rtol=1e-14))


@in_one_thread
def profile(problem: Problem, fit: MapEstimate, names: Sequence[str] | None = None, *, executor: Any = None) -> Profile:
    """Follow the maximum of the log-density from the estimate along every parameter, outwards and back.

    The objective is that of `map_estimate`: eq. (6) with the bias correction of eq. (7), the priors included.
    For every value of a parameter the staged iteration estimates all others, started from the neighbouring point.
    Points are spaced by about half a standard deviation of the drop, until the profile has dropped below the level of a
    99 % interval, the prior's support ends, or solves fail. Then every point is also started from its outer neighbour,
    and the better value is kept, because the way out may have missed a branch that crosses the first one.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
        Of this problem.
    names : sequence of str, optional
        Parameters to profile; by default all that are free.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        Runs one task per parameter, as in `sample`; by default threads of this process. It does not change the result.

    Returns
    -------
    Profile

    Raises
    ------
    ValueError
        For an unknown name, an estimate without a finite log-posterior in this problem, or an invalid executor.
    WorkersLost
        If the executor's workers died (a RuntimeError).

    Warns
    -----
    UserWarning
        If a profile finds a better point than the estimate.

    Examples
    --------
    >>> profile = bp.profile(problem, fit)
    >>> profile.shape
    {'c': 'closed', 'k': 'closed'}
    >>> profile.table[["laplace_low", "low", "laplace_high", "high"]].round(4)
       laplace_low     low  laplace_high    high
    c       0.1982  0.1981        0.2004  0.2005
    k       0.9993  0.9992        1.0019  1.0020
    """
    _checks.instance("problem", problem, Problem)
    chosen, executor = _checked_names(problem, names), checked_executor(executor)
    objective, peak = at_estimate(problem, fit)
    with TaskPool(executor, (objective, peak)) as pool:
        followed = dict(pool.run(_followed, [problem.names.index(name) for name in chosen]))
    top, best, units = peak.objective, peak.theta, problem.units
    values, density, paths, limits = {}, {}, {}, {}
    for number, name in enumerate(chosen):
        limits[name], values[name], density[name], paths[name] = followed[number]
        if np.nanmax(density[name]) > top:
            top, best = np.nanmax(density[name]), paths[name][np.nanargmax(density[name])]
    result = Profile(
        map=dict(fit.theta),
        sd=dict(fit.sd),
        values=values,
        log_density={name: value - top for name, value in density.items()},
        paths=paths,
        limits=limits,
        best=dict(zip(problem.names, best.tolist(), strict=True)),
        improvement=float(top - peak.objective),
        units={name: units.get(problem.plain_names[name], "") for name in problem.names},
    )
    if result.improvement > BETTER:
        warnings.warn(
            f"The log-density is higher by {result.improvement:.3g} than at the estimate where "
            f"{written(result.best)}; start there, map_estimate(problem, start=profile.best), and profile again.",
            UserWarning,
            stacklevel=3,
        )
    return result


def _checked_names(problem: Problem, names: Sequence[str] | None) -> tuple[str, ...]:
    if names is None:
        return problem.names
    if isinstance(names, str) or not _checks.several("names", names):
        raise ValueError(f"names: must be a sequence of names such as {problem.names!r}, got {names!r}.")
    for name in names:
        _checks.one_of("names", name, problem.names)
    return tuple(dict.fromkeys(names))


def _followed(
    start: tuple[Objective, Iterate], column: int
) -> tuple[tuple[float, float], np.ndarray, np.ndarray, np.ndarray]:
    """Return the limits of the parameter in a column of θ, and the values, the objective and θ along its profile."""
    objective, peak = start
    ridge, missing = Ridge(objective, column, peak), np.full(peak.theta.size, np.nan)
    values, iterates = zip(*ridge.followed(), strict=True)
    density = [np.nan if iterate is None else iterate.objective for iterate in iterates]
    paths = [missing if iterate is None else iterate.theta for iterate in iterates]
    return ridge.limits(), np.array(values), np.array(density), np.array(paths)
