"""Whether the posterior of response tables is normal about its mode, as the Laplace approximation takes it to be.

Past the last point before a jump the density falls steeply, and on the other side it may fall slowly: the second
derivatives at the mode tell neither.
"""

from collections.abc import Iterator

import numpy as np

from bayesperiodic.density.log_posterior import RIDGE_COORDINATES
from bayesperiodic.density.sweeps import tables
from bayesperiodic.estimation.gauss_newton import Iterate, Objective
from bayesperiodic.estimation.laplace import JointLaplace

# Distances [standard deviations] at which the fall of the log-density is compared with that of the normal density;
# ratio from which on they differ, and the largest distance at which a steeper fall matters.
DISTANCES, NOTABLE_RATIO, MATTERS = (1.0, 2.0, 4.0), 4.0, 2.0


def shape_warnings(objective: Objective, iterate: Iterate, joint: JointLaplace | None) -> Iterator[str]:
    """Yield a warning if the density of response tables falls otherwise than its Laplace approximation.

    Each parameter moves up and down, and all others with it as the approximation has them.
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
