"""The recorded orbits at any θ, also where those at the anchors of a density do not lead to them.

The density follows the orbits from its anchors, by default those at the medians of the priors, where the model may have
no orbit, or the recorded one may be on another branch.
"""

from collections.abc import Iterator

import numpy as np

from bayesperiodic.density.initial_orbits import measured_orbits
from bayesperiodic.density.orbit_check import MOST_UNEXPLAINED, other_orbit, unexplained
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.problem.description import Description


def recorded_orbits(problem: Description, solver: ResponseSolver, theta: np.ndarray) -> dict[str, PeriodicSolution]:
    """Return the solution of every experiment at θ (names,) that explains the recording best.

    Solutions followed from the solver's anchors are taken if they are of the recorded kind and explain half of the
    variance of each channel. Otherwise those from the experiments' guesses, or from the measured outputs, are solved
    too. Where none converges it is the first.
    """
    first = solver.solutions(theta)
    chosen = {name: (solution, _misfit(problem, solver, theta, name)) for name, solution in first.items()}
    for other in _others(problem, solver, theta, first):
        if all(misfit <= MOST_UNEXPLAINED for _, misfit in chosen.values()):
            break
        solutions = other.solutions(theta)
        for name, (_, least) in chosen.items():
            if least > MOST_UNEXPLAINED and (misfit := _misfit(problem, other, theta, name)) < least:
                chosen[name] = solutions[name], misfit
    return {name: solution for name, (solution, _) in chosen.items()}


def _others(
    problem: Description, solver: ResponseSolver, theta: np.ndarray, first: dict[str, PeriodicSolution]
) -> Iterator[ResponseSolver]:
    yield solver.anchored(theta)
    unable = problem.model.autonomous or isinstance(problem.model, CondensedModel)
    if not unable and all(np.isfinite([*s.states.values()]).all() for s in first.values()):
        near = {name: solution.states for name, solution in first.items()}
        yield ResponseSolver.start(problem, theta, measured_orbits(problem, theta, near, 1).states)


def _misfit(problem: Description, solver: ResponseSolver, theta: np.ndarray, name: str) -> float:
    """Return the largest unexplained fraction of a channel's variance, 1 more for an orbit of another kind.

    Infinite where the solve failed.
    """
    simulation = solver.solve(theta[None], keep=True, polish=True)
    if simulation.statuses(name)[0] != CONVERGED:
        return np.inf
    response, observation = simulation.at(0).response(name), problem.observations[name]
    return max(unexplained(observation, response).values(), default=0.0) + bool(other_orbit(observation, response))
