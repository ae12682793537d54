"""What an estimate says about the orbits of points of response tables."""

from collections.abc import Iterator

import numpy as np

from bayesperiodic.density.sweeps import early_jumps, places, tables, without_folds
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.solution import PeriodicSolution, as_guess
from bayesperiodic.problem.description import Description

MOST_NAMED = 4
# Points of a sweep that may have jumped before the fold without a warning.
MOST_EARLY = 1
# Distance of a multiplier from 1 within which a point is close to a fold.
NEAR_FOLD = 0.1


def table_warnings(problem: Description, fit: MapEstimate) -> Iterator[str]:
    """Yield warnings about points that the model's branch does not reach, and about orbits that are unstable."""
    points = [(e, fit.solutions[e.name]) for table in tables(problem).values() for e in table]
    beyond = [(e.name, s.frequency) for e, s in points if s.frequency != e.frequency]
    unstable = [e.name for e, s in points if s.frequency == e.frequency and s.converged and s.stable is False]
    if beyond:
        name, fold = beyond[0]
        yield (
            f"{len(beyond)} points of response tables were measured where the model at the estimate has no orbit of "
            f"their branch: {_listed([name for name, _ in beyond])}; the branch of {name!r} ends at a fold at "
            f"{fold:.6g} Hz. The model may lack a term, or sweep and resolution may not be those of the measurement."
        )
    if points:
        theta = problem.vector(fit.theta)
        near = {e.name: as_guess(problem.equations[e.name], s) for e, s in points}
        sheets = {name: place.sheet for name, place in places(problem, theta, near).items()}
        for sweep, names in early_jumps(problem, theta, sheets).items():
            if len(names) > MOST_EARLY:
                yield (
                    f"The sweep {sweep.direction} of {sweep.table!r} has jumped at {names[0]!r}, {len(names)} points "
                    "before the branch ends at the estimate. The sweep may have had the other direction, or a "
                    "disturbance ended it early."
                )
    close = [e.name for e, s in points if e.name not in unstable and s.frequency == e.frequency and _is_near_fold(s)]
    if close and isinstance(problem.model, CondensedModel) and problem.model.state_owners:
        # An element that sticks remembers where it does so, and its multiplier is close to 1 as well.
        smooth = without_folds(problem, problem.vector(fit.theta))
        close = [name for name in close if name not in smooth]
    if close:
        yield (
            f"{len(close)} points of response tables are close to a fold of the model at the estimate: "
            f"{_listed(close)}. "
            "The posterior may end there, which standard deviations do not describe; sample it, or take profiles."
        )
    if unstable:
        yield (
            f"{len(unstable)} points of response tables are fitted by unstable orbits: {_listed(unstable)}. They "
            "cannot be measured without control. Look at bp.plot.response(problem, fit); the model may lack a term, or "
            "the sweep may have had another direction."
        )


def _is_near_fold(solution: PeriodicSolution) -> bool:
    """Return whether a multiplier is close to 1."""
    multipliers = solution.multipliers
    return bool(solution.converged and np.any(np.abs(multipliers - 1.0) < NEAR_FOLD))


def _listed(names: list[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(map(repr, names[:MOST_NAMED])) + (f" and {more} more" if more > 0 else "")
