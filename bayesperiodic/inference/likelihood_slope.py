"""The log-likelihood at one θ with its derivatives by θ and by the noise parameters."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bayesperiodic.inference.linearisation import Linearisation
from bayesperiodic.inference.noise.residuals import Squares
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES

if TYPE_CHECKING:
    from bayesperiodic.inference.problem import Problem


class LikelihoodSlope(NamedTuple):
    """A log-likelihood and its derivatives.

    Attributes
    ----------
    status : str
        How the worst of the periodic solves ended.
    value : float
        −inf where one has failed, or the value is not finite; the derivatives are then zero.
    by_theta : array (names,)
        NaN where a derivative does not exist.
    by_noise : array (noise_names,)
        By ln φ, of the log-likelihood plus the log-prior of φ.
    """

    status: str
    value: float
    by_theta: np.ndarray
    by_noise: np.ndarray


def likelihood_slope(
    problem: "Problem", theta: np.ndarray, noise: np.ndarray, *, forward: bool = False
) -> LikelihoodSlope:
    """Return the log-likelihood and its derivatives, by one transposed solve an experiment where that is possible.

    Parameters
    ----------
    problem : Problem
    theta : array (names,)
    noise : array (noise_names,)
    forward : bool
        Take one solve a parameter instead of one transposed solve.
    """
    if problem.flat_misfits and not forward:
        return _from_squares(problem, theta, noise)
    here = Linearisation(theta, problem.responses, problem.comparisons)
    if not here.converged:
        return _failed(problem, max(here.statuses.values(), key=STATUSES.index))
    value = float(problem.likelihood(here.residuals, noise))
    if not np.isfinite(value):
        return _failed(problem, STATUSES[CONVERGED])
    by_residual, by_noise = problem.likelihood.gradients(here.residuals, noise)
    return LikelihoodSlope(STATUSES[CONVERGED], value, problem.pulled(here, by_residual, forward=forward), by_noise)


def _from_squares(problem: "Problem", theta: np.ndarray, noise: np.ndarray) -> LikelihoodSlope:
    """Do it for experiments of which only the sums of squares count, without their components."""
    misfits, places = problem.flat_misfits, problem.flat_places
    orbits, worst = problem.responses.orbits(theta, misfits)
    if worst != CONVERGED:
        return _failed(problem, STATUSES[worst])
    squares = np.concatenate([o.squares for o in orbits])
    value = float(problem.likelihood(Squares(squares[places]), noise))
    if not np.isfinite(value):
        return _failed(problem, STATUSES[CONVERGED])
    by_square, by_noise = problem.likelihood.square_slopes(squares[places], noise)
    own = np.empty_like(by_square)
    own[places] = by_square
    weights, first = [], 0
    for group, orbit in zip(misfits, orbits, strict=True):
        weights.append(group.pulled(orbit.outputs, own[first : first + group.blocks]))
        first += group.blocks
    by_theta = problem.responses.pulled_outputs(orbits, weights)
    return LikelihoodSlope(STATUSES[CONVERGED], value, by_theta, by_noise)


def _failed(problem: "Problem", status: str) -> LikelihoodSlope:
    return LikelihoodSlope(status, -np.inf, np.zeros(len(problem.names)), np.zeros(len(problem.noise_names)))
