"""Warnings about an estimate: orbits of response tables, and posteriors that are not normal about their mode."""

from collections.abc import Iterator

import numpy as np

from bayesperiodic.density.log_posterior import RIDGE_COORDINATES
from bayesperiodic.density.sweeps import early_jumps, places, tables, without_folds
from bayesperiodic.estimation.gauss_newton import Iterate, Objective, information
from bayesperiodic.estimation.laplace import JointLaplace
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.solution import PeriodicSolution, as_guess
from bayesperiodic.problem.description import Description

MOST_NAMED = 4
# Points of a sweep that may have jumped before the fold without a warning.
MOST_EARLY = 1
# Distance of a multiplier from 1 within which a point is close to a fold.
NEAR_FOLD = 0.1
# Derivative along one width of the prior, in standard deviations of the data, below which it vanishes; change of the
# residuals within that width from which on it is no approximation; parts of the width that are tried.
VANISHING_RATE, NOTABLE_CHANGE, WIDTH_PARTS = 0.1, 1.0, (1.0, 0.5, 0.25)
# Distances [standard deviations] at which the fall of the log-density is compared with that of the normal density;
# ratio from which on they differ, and the largest distance at which a steeper fall matters.
DISTANCES, NOTABLE_RATIO, MATTERS = (1.0, 2.0, 4.0), 4.0, 2.0


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


def second_order(objective: Objective, iterate: Iterate) -> list[str]:
    """Return the parameters that change the residuals within their priors, although the derivative by them vanishes.

    Amplitudes of a harmonic depend on the coefficient of an even term by its square: at zero their derivative vanishes,
    and the normal approximation has the variance of the prior, without correlation, although the data exclude most of
    it.
    """
    problem = objective.density.problem
    widths = problem.joint_prior.widths
    rates = np.sqrt(np.diag(information(problem, iterate)[0])) * widths
    result = []
    for i in np.flatnonzero(rates < VANISHING_RATE).tolist():
        changes = [_change(objective, iterate, sign * widths * (np.arange(widths.size) == i)) for sign in (1.0, -1.0)]
        if max(changes) > NOTABLE_CHANGE:
            result.append(problem.names[i])
    return result


def _change(objective: Objective, iterate: Iterate, width: np.ndarray) -> float:
    """Return by how much a width changes the residuals, in standard deviations; 0 where no part of it can be solved."""
    likelihood = objective.density.problem.likelihood
    before = np.concatenate(likelihood.whitened(iterate.here.residuals, iterate.noise))
    for part in WIDTH_PARTS:
        there = objective.at(iterate.theta + part * width, iterate.here, iterate.noise)
        if there is not None:
            after = np.concatenate(likelihood.whitened(there.here.residuals, iterate.noise))
            return float(np.linalg.norm(after - before))
    return 0.0


def second_order_warnings(objective: Objective, iterate: Iterate) -> Iterator[str]:
    """Yield a warning about parameters that the data determine to second order only."""
    names = second_order(objective, iterate)
    if names:
        yield (
            f"The data depend on {', '.join(map(repr, names))} only to second order at the estimate: their first "
            "derivative vanishes there, as that of amplitudes by the coefficient of an even term at zero. Standard "
            "deviations, also those of other parameters, do not describe the posterior. Sample it, or give start={…} "
            "away from the estimate."
        )


def shape_warnings(objective: Objective, iterate: Iterate, joint: JointLaplace | None) -> Iterator[str]:
    """Yield a warning if the density of response tables falls otherwise than its Laplace approximation.

    Past the last point before a jump the density falls steeply, and on the other side it may fall slowly: the second
    derivatives at the mode tell neither. Each parameter moves up and down, and all others with it as the approximation
    has them.
    """
    problem = objective.density.problem
    if joint is None or not np.isfinite(joint.covariance).all(axis=None) or not tables(problem):
        return
    density = objective.density.with_settings(solver=iterate.here.solver, coordinates=RIDGE_COORDINATES)
    noise = np.array([joint.mode.get(name, problem.likelihood.fixed.get(name, 1.0)) for name in problem.noise_names])
    mode = density.from_natural(problem.vector({name: joint.mode[name] for name in problem.names}), noise)
    covariance, count = joint.covariance.to_numpy(), len(problem.names)
    moves = covariance[:count] / np.sqrt(np.diag(covariance)[:count, None])
    steps = np.array([sign * distance for distance in DISTANCES for sign in (1.0, -1.0)])
    points = mode + steps[:, None, None] * moves
    values = density.evaluate(np.concatenate([mode[None], points.reshape(-1, mode.size)])).log_prob
    falls = (values[0] - values[1:]).reshape(len(steps), count)
    ratios = falls / (0.5 * steps[:, None] ** 2)
    steep = (ratios > NOTABLE_RATIO) & (np.abs(steps) <= MATTERS)[:, None]
    if not np.any(steep | (ratios < 1.0 / NOTABLE_RATIO)):
        return
    worst = np.where(steep, ratios, np.where(ratios < 1.0 / NOTABLE_RATIO, 1.0 / np.maximum(ratios, 1e-3), 0.0))
    at, name = np.unravel_index(np.argmax(worst), worst.shape)
    yield (
        f"The posterior is not normal about the estimate: where {problem.names[name]!r} moves by {steps[at]:+g} "
        f"standard deviations, and the others with it, its logarithm falls by {falls[at, name]:.3g} instead of "
        f"{0.5 * steps[at] ** 2:g}, as it does next to a jump. Standard deviations may be several times too small or "
        "too large; sample the posterior."
    )
