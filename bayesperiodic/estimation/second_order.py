"""Parameters on which the data depend only to second order at an estimate, so that its covariance misses them.

Amplitudes of a harmonic depend on the coefficient of an even term by its square: at zero their derivative vanishes, and
the normal approximation has the variance of the prior, without correlation, although the data exclude most of it.
"""

from collections.abc import Iterator

import numpy as np

from bayesperiodic.estimation.gauss_newton import Iterate, Objective, information

# Derivative along one width of the prior, in standard deviations of the data, below which it vanishes; change of the
# residuals within that width from which on it is no approximation; parts of the width that are tried.
VANISHING_RATE, NOTABLE_CHANGE, WIDTH_PARTS = 0.1, 1.0, (1.0, 0.5, 0.25)


def second_order(objective: Objective, iterate: Iterate) -> list[str]:
    """Return the parameters that change the residuals within their priors, although the derivative by them vanishes."""
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
