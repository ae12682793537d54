"""Optima of the models with and without candidate terms, and whether to believe them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesperiodic._linalg import TINY, hessian_scale, scaled
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.candidates import Term, lag_names
from bayesperiodic.estimation.gauss_newton import NO_CURVATURE, Iterate, Objective
from bayesperiodic.estimation.map_estimate import nearest_optimum
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import Model
from bayesperiodic.priors.single import LogNormal, Normal

# Standard deviations of the difference of two log-likelihoods from which on the data tell two terms apart.
DISTINCT = 2.0
# Fewest experiments of which one is left out at a time.
FEWEST_EXPERIMENTS = 3
# Where the search for an optimum ends by itself; "stalled" steps are limited by the accuracy of the periodic solutions.
ENDED = ("converged", "stalled")
# Robust standard deviations from zero of a coefficient.
SIGNIFICANT_COEFFICIENT = 2.0
# Fraction by which a coefficient may change on twice as many points.
COARSE = 0.5
# Standard deviation of the logarithm of a lag about where its estimation starts.
LAG_SPREAD = 1.5


def problem_of(
    problem: Problem, model: Model, terms: Mapping[str, tuple[Term, float]], zero: Mapping[str, Term]
) -> Problem:
    """Return the problem with another model, whose coefficients have normal priors of given widths or are zero."""
    priors, fixed = dict(problem.settings["priors"]), dict(problem.settings["fixed"])
    for name, (term, width) in terms.items():
        priors[name] = Normal(0.0, width)
        if term.force is not None:
            priors[lag_names(name)[0]] = LogNormal(term.lag, LAG_SPREAD)
    for name, term in zero.items():
        fixed |= {name: 0.0} | ({lag_names(name)[0]: term.lag} if term.force is not None else {})
    orbits = guesses_of(
        model, {e.name: e.guess for e in problem.experiments if e.guess and not isinstance(e.guess, str)}
    )
    experiments = [replace(e, guess=orbits.get(e.name, e.guess)) for e in problem.experiments]
    return problem.replace(model=model, experiments=experiments, priors=priors, fixed=fixed)


def guesses_of(model: Model, orbits: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """Return orbits of a model with other lags as guesses; new lags, which do not act on the others, start at zero."""
    return {
        name: {state: states.get(state, np.zeros_like(next(iter(states.values())))) for state in model.states}
        for name, states in orbits.items()
    }


@dataclass(frozen=True)
class Optimum:
    """A problem with some of the terms and the optimum of its density, errors of inputs fixed."""

    problem: Problem
    objective: Objective
    iterate: Iterate
    names: tuple[str, ...]  # of the terms' coefficients

    @cached_property
    def orbits(self) -> dict[str, dict[str, np.ndarray]]:
        """The states of the periodic solutions by experiment."""
        solutions = self.iterate.here.solver.solutions(self.iterate.theta)
        return {name: solution.states for name, solution in solutions.items()}

    @property
    def curved(self) -> bool:
        """Whether the Hessian matrix is positive definite, without which the evidence by Laplace has no meaning.

        It need not be where the data hardly determine a lag: the density of the lag's prior can be curved upwards, and
        the second derivatives of the outputs, which make it a maximum, are neglected.
        """
        values, _ = self._curvature()
        return bool(values[0] > NO_CURVATURE * values[-1])

    @property
    def evidence(self) -> float:
        """The logarithm of the evidence by Laplace, but for a constant."""
        values, scale = self._curvature()
        size = np.sum(np.log(np.maximum(values, TINY))) - 2.0 * np.sum(np.log(scale))
        return float(self.iterate.objective - 0.5 * size + 0.5 * scale.size * np.log(2.0 * np.pi))

    def _curvature(self) -> tuple[np.ndarray, np.ndarray]:
        """Return eigenvalues, sorted, of the Hessian matrix in the units in which it has a unit diagonal, and these."""
        hessian, _ = self.objective.hessian_and_gradient(self.iterate)
        scale = hessian_scale(hessian)
        return np.linalg.eigvalsh(scaled(hessian, scale)), scale

    def with_problem(self, problem: Problem, names: tuple[str, ...]) -> "Optimum | None":
        """Return the optimum of a problem with other terms; None if there is none.

        The search begins here. Data that determine a combination of parameters sharply, as the frequency of a cycle
        does, leave a narrow curved ridge, along which steps are short. If the search does not end, it is repeated from
        the medians of the priors, off the ridge.
        """
        known = dict(zip(self.problem.names, self.iterate.theta.tolist(), strict=True))
        known |= {n: float(problem.settings["priors"][n].quantile(0.5)) for n in problem.names if n not in known}
        orbits = guesses_of(problem.settings["model"], {e.name: self.orbits[e.name] for e in problem.experiments})
        for theta in (np.array([known[name] for name in problem.names]), problem.median()):
            nearest = nearest_optimum(problem, theta, orbits)
            if nearest is not None and nearest[1].status in ENDED:
                return Optimum(problem, nearest[0], nearest[1].iterate, names)
        return None


def distinct(one: Optimum, other: Optimum) -> bool:
    """Return whether the likelihood of one fit is significantly larger than that of another."""
    likelihood = one.problem.likelihood
    fits = (likelihood.whitened(state.iterate.here.residuals, one.iterate.noise) for state in (one, other))
    first, others = (np.concatenate(parts) for parts in fits)
    # |r + d|² − |r|² varies by 2 d·r, r being normal. Its scatter over the components, as Vuong has it, says nothing
    # where one of them, such as the frequency of a cycle, makes the whole difference.
    return bool(others @ others - first @ first > DISTINCT * 2.0 * np.linalg.norm(others - first))


def held_out_error(state: Optimum) -> float:
    """Return the mean fraction unexplained in experiments left out, one at a time; NaN for few or for tables."""
    problem = state.problem
    local = any(problem.plain_names[name] != name for name in problem.names)
    if local or len(problem.experiments) < FEWEST_EXPERIMENTS or not problem.channels:
        return np.nan
    whole, fractions = problem.anchored(state.iterate.theta, state.orbits), []
    for e in problem.experiments:
        errors = {name: wave for name, wave in problem.input_errors.items() if name != e.name}
        try:
            rest = problem.with_experiments([other for other in problem.experiments if other is not e])
        except ValueError:  # fewer values than the parameters need
            return np.nan
        optimum = state.with_problem(rest.with_input_errors(errors), state.names)
        if optimum is None:
            return np.inf
        outputs, converged = whole.outputs(optimum.iterate.theta[None])
        if not converged.all():
            return np.inf
        for channel, measured in e.outputs.items():
            left = measured - e.project(channel, outputs[e.name][channel][0])
            fractions.append(float(np.mean(left**2) / np.var(measured)))
    return float(np.mean(fractions))


def doubt(fit: MapEstimate, name: str, term: Term) -> str:
    """Return why the coefficient of a term is not believed, in words; "" if it is."""
    size, sd, robust = abs(fit.theta[name]), fit.sd[name], fit.robust_sd[name]
    if term.force is not None:
        # Of a short or a long lag, the data determine only its product with the coefficient, or the quotient.
        joint = fit.covariance.loc[[name, lag_names(name)[0]], [name, lag_names(name)[0]]].to_numpy()
        robust *= np.sqrt(max(1.0 - joint[0, 1] ** 2 / (joint[0, 0] * joint[1, 1]), 0.0))
    if size < SIGNIFICANT_COEFFICIENT * robust:
        return f"its coefficient is less than {SIGNIFICANT_COEFFICIENT:g} robust sds from zero"
    if (change := abs(fit.doubling_shift[name]) * sd / size) > COARSE:
        return (
            f"on twice as many points its coefficient changes by {change:.0%}: the error of the grid looks like this "
            "term. Take more samples in fold(), or a scheme of higher order"
        )
    return ""
