"""Optima of the models with and without candidate terms, and how well they predict experiments that are left out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from bayesperiodic._linalg import TINY, hessian_scale, scaled
from bayesperiodic.estimation.gauss_newton import Iterate, Objective
from bayesperiodic.estimation.map_estimate import nearest_optimum
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.posterior.parameters import local_names
from bayesperiodic.posterior.priors import Normal
from bayesperiodic.posterior.problem import Problem

# Standard deviations of the difference of two log-likelihoods from which on the data tell two terms apart.
DISTINCT = 2.0
# Fewest experiments of which one is left out at a time.
FEWEST_EXPERIMENTS = 3
# Where the search for an optimum ends by itself; "stalled" steps are limited by the accuracy of the periodic solutions.
ENDED = ("converged", "stalled")


def problem_of(problem: Problem, model: Model, widths: Mapping[str, float], zero: Iterable[str] = ()) -> Problem:
    """Return the problem with another model, whose new coefficients have priors of these widths or are zero."""
    settings = dict(problem._given)
    settings["priors"] = settings["priors"] | {name: Normal(0.0, width) for name, width in widths.items()}
    settings["fixed"] = settings["fixed"] | dict.fromkeys(zero, 0.0)
    return Problem(experiments=problem.experiments, **settings | {"model": model})


@dataclass(frozen=True)
class Optimum:
    """A problem with some of the terms and the optimum of its density, errors of inputs fixed."""

    problem: Problem
    objective: Objective
    iterate: Iterate
    names: tuple[str, ...]  # of the terms' coefficients

    @property
    def solutions(self) -> dict[str, PeriodicSolution]:
        """The periodic solutions by experiment."""
        return self.iterate.here.simulator.solutions(self.iterate.theta)

    @property
    def evidence(self) -> float:
        """The logarithm of the evidence by Laplace, but for a constant."""
        hessian, _ = self.objective.hessian_and_gradient(self.iterate)
        scale = hessian_scale(hessian)
        values = np.linalg.eigvalsh(scaled(hessian, scale))
        size = np.sum(np.log(np.maximum(values, TINY))) - 2.0 * np.sum(np.log(scale))
        return float(self.iterate.objective - 0.5 * size + 0.5 * scale.size * np.log(2.0 * np.pi))

    def with_problem(self, problem: Problem, names: tuple[str, ...]) -> "Optimum | None":
        """Return the optimum of a problem with other terms, from here on; None if there is none."""
        known = dict(zip(self.problem.names, self.iterate.theta.tolist(), strict=True))
        theta = np.array([known.get(name, 0.0) for name in problem.names])
        guesses = {e.name: self.solutions[e.name].states for e in problem.experiments}
        found = nearest_optimum(problem, theta, guesses)
        if found is None or found[1].status not in ENDED:
            return None
        return Optimum(problem, found[0], found[1].iterate, names)


def distinct(one: Optimum, other: Optimum) -> bool:
    """Return whether the likelihood of one fit is significantly larger than that of another."""
    likelihood = one.problem.likelihood
    fits = (likelihood.whitened(state.iterate.here.residuals, one.iterate.noise) for state in (one, other))
    own, others = (np.concatenate(parts) for parts in fits)
    # |r + d|² − |r|² varies by 2 d·r, r being normal. Its scatter over the components, as Vuong has it, says nothing
    # where one of them, such as the frequency of a cycle, makes the whole difference.
    return bool(others @ others - own @ own > DISTINCT * 2.0 * np.linalg.norm(others - own))


def held_out_error(state: Optimum) -> float:
    """Return the mean fraction unexplained in experiments that are left out, one at a time; NaN for few experiments."""
    problem = state.problem
    if len(problem.experiments) < FEWEST_EXPERIMENTS or any(local_names(problem.names)):
        return np.nan
    guesses = {name: solution.states for name, solution in state.solutions.items()}
    whole, fractions = problem.anchored(state.iterate.theta, guesses), []
    for e in problem.experiments:
        errors = {name: own for name, own in problem.input_errors.items() if name != e.name}
        try:
            rest = problem.with_experiments([other for other in problem.experiments if other is not e])
        except ValueError:  # fewer values than the parameters need
            return np.nan
        found = state.with_problem(rest.with_input_errors(errors), state.names)
        if found is None:
            return np.inf
        outputs, converged = whole.outputs(found.iterate.theta[None])
        if not converged.all():
            return np.inf
        for channel, measured in e.outputs.items():
            left = measured - e.project(channel, outputs[e.name][channel][0])
            fractions.append(float(np.mean(left**2) / np.var(measured)))
    return float(np.mean(fractions))
