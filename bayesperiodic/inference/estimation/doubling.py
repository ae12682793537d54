"""What a grid of twice as many points would change: the discretisation judged against the posterior."""

from collections.abc import Mapping

import numpy as np

from bayesperiodic import fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.inference.estimation.gauss_newton import Iterate
from bayesperiodic.inference.observation import Response
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.responses import leading_multipliers
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.periodic.solve import solve_forced, solve_free


def doubling_shift(
    problem: Problem, estimate: Iterate, solutions: Mapping[str, PeriodicSolution], covariance: np.ndarray
) -> np.ndarray:
    """Return by how many standard deviations the estimate would move on twice as many points, (names,).

    Every experiment is solved again on the finer grid at the estimate; a Gauss-Newton step turns the change of the
    residuals into that of the parameters. NaN if a solve fails.

    Parameters
    ----------
    problem : Problem
    estimate : Iterate
    solutions : mapping of str to PeriodicSolution
        At the estimate.
    covariance : array (names, names)
    """
    finer: list[np.ndarray] = []
    for e in problem.experiments:
        response = _on_twice_the_points(problem, estimate.theta, e, solutions[e.name])
        if response is None:
            return np.full(estimate.theta.size, np.nan)
        finer += problem.observations[e.name].residuals(response)
    moved = [there - here for there, here in zip(finer, estimate.here.residuals, strict=True)]
    changes = problem.likelihood.whitened(estimate.here.changes, estimate.noise)
    white = problem.likelihood.whitened(moved, estimate.noise)
    right = np.sum([s @ r for s, r in zip(changes, white, strict=True)], axis=0)
    with np.errstate(invalid="ignore"):
        return covariance @ right / np.sqrt(np.diag(covariance))


def _on_twice_the_points(
    problem: Problem, theta: np.ndarray, experiment: Experiment, coarse: PeriodicSolution
) -> Response | None:
    """Return the response on a grid of twice as many points, at every second of them; None if the solve fails."""
    points = 2 * experiment.samples * experiment.periods
    equations = PeriodicEquations.build(
        problem.model,
        {n: fourier.on_grid(fourier.coefficients(u), points) for n, u in experiment.inputs.items()},
        frequency=coarse.frequency,
        samples=2 * experiment.samples,
        scheme=problem.scheme,
        periods=experiment.periods,
        winding=experiment.winding,
    )
    values = problem.parameter_maps[experiment.name].values(theta[None])[0]
    parameters, delay = np.ascontiguousarray(values[:-1]), values[-1]
    if problem.model.autonomous:
        equations, solved, _ = solve_free(equations, parameters, coarse)
    else:
        solved, _ = solve_forced(equations, parameters, coarse)
    if solved.code != CONVERGED:
        return None
    count = 0 if experiment.multipliers is None else experiment.multipliers.size
    found = leading_multipliers(equations, parameters, solved.z, count)
    outputs = equations.outputs(solved.z, parameters)[::2]
    return Response(outputs, np.array(equations.frequency), np.log(np.abs(found)), np.array(delay))
