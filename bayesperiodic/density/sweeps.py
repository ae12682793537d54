"""Periodic orbits of the points of response tables, from the branch that leads through them.

The branch of a table is followed once from its first point through all frequencies and round the folds, see
`periodic.table_branch`; if the response from rest at the last point is not on it, as where the folds between them are
far outside the table, the branch through that one too. Each point is on one of the stable sheets: in a sweep the sheet
does not change but at jumps, from one sheet to a later one. Among these choices the one is taken that the measured
values fit best.

In solves at other θ a sheet may end at a fold before a measured frequency. The orbit of such a point is that at the
fold, see `sheets` and `likelihood.reach`.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.sweep import Sweep
from bayesperiodic.likelihood.observation import Response
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.harmonics import harmonics, sampled
from bayesperiodic.periodic.solve import solve_driven
from bayesperiodic.periodic.table_branch import Passage, follow
from bayesperiodic.problem.description import Description

# Share of the misfit of all sheets below which a smaller one does not matter.
SMALL_SHARE = 1e-4
# Square of the distance, relative to that of the orbit's range, within which an orbit is the one of a guess.
SAME_ORBIT = 1e-2


class Place(NamedTuple):
    """Orbit of a point of a table on the branch."""

    sheet: int
    equations: PeriodicEquations  # at its frequency, that of the fold if the branch does not reach the point
    z: np.ndarray  # (points, states)
    reached: bool


def tables(problem: Description) -> dict[Sweep, list[Experiment]]:
    """Return the points of each table of a driven model, in the order of the sweep; not those with a guess."""
    result: dict[Sweep, list[Experiment]] = {}
    for e in () if problem.model.autonomous else problem.experiments:
        if e.sweep is not None and not e.guess and e.periods == 1:
            result.setdefault(e.sweep, []).append(e)
    return {sweep: sorted(table, key=lambda e: sweep.sign * e.frequency) for sweep, table in result.items()}


def places(problem: Description, theta: np.ndarray, near: Mapping[str, np.ndarray] | None = None) -> dict[str, Place]:
    """Return the orbits of all points of tables at θ (names,) that the branches lead to.

    They are those that fit the data best or, with the z of other orbits `near`, the nearest to these, if near enough.
    """
    result: dict[str, Place] = {}
    for sweep, table in tables(problem).items():
        choices = _all_choices(problem, theta, table)
        if not all(choices):
            continue
        if near is not None:
            for e, places_of in zip(table, choices, strict=True):
                if e.name not in near:
                    continue
                distances = [distance(place.z, near[e.name]) for place in places_of]
                if min(distances) < SAME_ORBIT:
                    result[e.name] = places_of[int(np.argmin(distances))]
            continue
        costs = [_costs(problem, theta, e, places_of) for e, places_of in zip(table, choices, strict=True)]
        best = _sheets(choices, costs, jumps=sweep.direction is not None)
        result |= {e.name: places_of[b] for e, places_of, b in zip(table, choices, best, strict=True)}
    return result


def early_jumps(problem: Description, theta: np.ndarray, sheets: Mapping[str, int]) -> dict[Sweep, list[str]]:
    """Return the points of each sweep after a jump, on `sheets`, at which the sheet before it still exists at θ."""
    result: dict[Sweep, list[str]] = {}
    for sweep, table in tables(problem).items():
        if sweep.direction is None or len({sheets.get(e.name) for e in table}) == 1:
            continue
        for e, choices in zip(table, _all_choices(problem, theta, table), strict=True):
            now = sheets.get(e.name)
            if now is not None and any(place.sheet < now and place.reached for place in choices):
                result.setdefault(sweep, []).append(e.name)
    return result


def without_folds(problem: Description, theta: np.ndarray) -> list[str]:
    """Return the points of the tables through which no branch at θ has a fold."""
    result: list[str] = []
    for table in tables(problem).values():
        with np.errstate(all="ignore"):
            branches = _branches(problem, theta, table)
        if branches and not any(p.is_fold for branch in branches for p in branch):
            result += [e.name for e in table]
    return result


def _all_choices(problem: Description, theta: np.ndarray, table: Sequence[Experiment]) -> list[list[Place]]:
    """Return the choices of every point of a table."""
    with np.errstate(all="ignore"):
        branches = _branches(problem, theta, table)
    return [_choices(branches, k) for k in range(len(table))]


def _branches(problem: Description, theta: np.ndarray, table: Sequence[Experiment]) -> list[list[Passage]]:
    """Return the branch through a table from its first point, which is solved from rest, and perhaps from its last."""
    equations = [problem.equations[e.name] for e in table]
    parameters = [problem.parameters(theta[None], e.name)[0] for e in table]
    branches: list[list[Passage]] = []
    for start, heading in ((0, 1), (len(table) - 1, -1)):
        rest, _ = solve_driven(equations[start], parameters[start], "static")
        known = [p.z for branch in branches for p in branch if p.point == start]
        if rest.code == CONVERGED and not any(distance(z, rest.z) < SAME_ORBIT for z in known):
            branches.append(list(follow(equations, parameters, start, rest.z, heading)))
    return branches


def _choices(branches: Sequence[Sequence[Passage]], point: int) -> list[Place]:
    """Return the place of a point on each stable sheet: its orbit, or the fold of the sheet that is nearest to it.

    Sheets of a second branch come after those of the first.
    """
    result, count = [], 0
    for passages in branches:
        forwards = passages[0].point == 0
        for sheet in sorted({p.sheet for p in passages if p.sheet % 2 == 0}):
            at = [p for p in passages if p.sheet == sheet and p.point == point]
            if at:
                result.append(Place(count + sheet, at[0].equations, at[0].z, True))
                continue
            points = [p.point for p in passages if p.sheet == sheet and p.point is not None]
            ends_before = bool(points) and max(points) < point
            fold = [p for p in passages if p.is_fold and p.sheet == (sheet if ends_before == forwards else sheet - 1)]
            if points and fold:
                result.append(Place(count + sheet, fold[0].equations, fold[0].z, False))
        count += 2 + 2 * (passages[-1].sheet // 2)
    return result


def _costs(problem: Description, theta: np.ndarray, experiment: Experiment, choices: Sequence[Place]) -> np.ndarray:
    """Return how badly each choice fits the data, (choices,): the sum over the kinds of data of ln(share of misfit)."""
    parameters, sensors = problem.parameter_maps[experiment.name].split(theta)
    none, frequency = np.zeros(0), np.array(experiment.frequency)
    observation, squares = problem.observations[experiment.name], []
    for place in choices:
        outputs = place.equations.outputs(place.z, parameters)
        residuals = observation.residuals(Response(outputs, frequency, none, sensors))
        squares.append([float(r @ r) for r in residuals])
    total = np.array(squares)
    share = total / np.maximum(total.sum(axis=0), np.finfo(float).tiny)
    return np.log(SMALL_SHARE + share).sum(axis=1)


def _sheets(choices: Sequence[Sequence[Place]], costs: Sequence[np.ndarray], *, jumps: bool) -> list[int]:
    """Return the index of the best choice of every point; in a sweep later points are on the same or a later sheet."""
    if not jumps:
        return [int(np.argmin(cost)) for cost in costs]
    total, came = [costs[0]], []
    for before, now, cost in zip(choices, choices[1:], costs[1:], strict=False):
        allowed = np.array([[a.sheet <= b.sheet for a in before] for b in now])
        reached = np.where(allowed, total[-1], np.inf)
        came.append(np.argmin(reached, axis=1))
        total.append(cost + reached.min(axis=1))
    best = [int(np.argmin(total[-1]))]
    for back in reversed(came):
        best.append(int(back[best[-1]]))
    return best[::-1]


def distance(z: np.ndarray, other: np.ndarray) -> float:
    """Return the largest square of the distance of two orbits (points, states), in units of their ranges."""
    if len(z) != len(other):  # of a condensed model
        other = sampled(harmonics(other), len(z))
    size = np.maximum(np.ptp(z, axis=0), np.finfo(float).tiny)
    with np.errstate(over="ignore"):  # orbits of extreme parameters are infinitely far apart
        return float(np.max(np.square((z - other) / size), initial=0.0))
