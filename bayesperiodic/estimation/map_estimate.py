"""Bayesian estimator of the paper: staged Gauss-Newton to the MAP point, and its Laplace covariance."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.measurements import Amplitude, Measurement
from bayesperiodic.density.initial_orbits import InitialEstimate, measured_orbits, simultaneous_fit
from bayesperiodic.density.log_posterior import NATURAL, RIDGE_COORDINATES, Linearisation, LogPosterior
from bayesperiodic.density.orbit_check import MOST_UNEXPLAINED
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.density.sweeps import tables
from bayesperiodic.estimation.check import check_warnings, checked
from bayesperiodic.estimation.covariance import (
    degrees_of_freedom,
    estimated_inputs,
    input_loadings,
    uncertainty,
)
from bayesperiodic.estimation.frequencies import updated_frequencies
from bayesperiodic.estimation.gauss_newton import (
    MAX_STEPS,
    End,
    Iterate,
    Objective,
    at_ends,
    climb,
    corrected,
    preference,
    resumed,
)
from bayesperiodic.estimation.laplace import joint_laplace
from bayesperiodic.estimation.modes import (
    SEPARATE_SDS,
    default_starts,
    notable,
    optimum_of,
    weighed,
    with_images,
)
from bayesperiodic.estimation.result import MapEstimate, NoiseEstimate, Search, TrueInputs
from bayesperiodic.estimation.second_order import second_order_warnings
from bayesperiodic.estimation.shape import shape_warnings
from bayesperiodic.estimation.table_orbits import table_warnings
from bayesperiodic.estimation.units import compared_with_data, not_isolated, singular_start, unit_error
from bayesperiodic.estimation.wide_tables import widened
from bayesperiodic.likelihood.noise import Relative
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.compiled import NOT_RESOLVED, OTHER_ORBIT, STATUSES
from bayesperiodic.problem.fingerprint import fingerprint
from bayesperiodic.problem.model_inputs import model_inputs

MOST_SHOWN_MODES = 3
# Standard deviations from which on an amplitude of a noisy harmonic is nearly normal.
LEAST_NORMAL = 4.0
# Standard deviation of a phase of which nothing is known [rad].
RANDOM_PHASE = np.pi / np.sqrt(3.0)
# Information of the data, relative to the prior's, below which an estimate at an end of the support is the prior's.
INFORMED = 0.01
# Most linearisations of errors of the inputs, the steps between two, and the change [sds] that ends them.
MOST_LINEARISATIONS, STEPS_BETWEEN, SETTLED_INPUTS = 40, 5, 1e-5
# Seconds after which the progress bar is shown.
SHOWN_AFTER = 2.0
# Choices of the sheets of tables' branches that are tried after the first.
MOST_SHEET_CHANGES = 5


@in_one_thread
def map_estimate(
    problem: Problem,
    *,
    start: Mapping[str, float] | None = None,
    starts: int | None = None,
    seed: int = 0,
    checks: bool = True,
    progress: bool = True,
) -> MapEstimate:
    r"""Find the MAP point by staged Gauss-Newton, and the Laplace covariance there.

    Each iteration solves the channel variances from eq. (7) of [1]_ with its bias correction,

    .. math::

        v_\beta = \frac{M_\beta}{n_\beta - p_\beta}, \qquad p_\beta = \mathrm{tr}(F_\beta C),

    with p the values that the estimate of θ takes up: F is the channel's part of the information, C the covariance of
    θ. Without priors Σp is the number of parameters l, and this is eq. (7), s·Σe²/(nNs − l), where all s channels have
    as many values and tell the same; a parameter that the prior determines takes up none. Then θ is updated by eq. (8).
    As printed, its right-hand side lacks the prior's gradient (θ̄ − θ)/σ², without which the iteration would not end at
    a maximum of eq. (6); it is added. The parameters of other noise models are found by maximising the same objective.
    Steps are halved until the objective, eq. (6) with n − p for n, increases; p is zero at first, and the iteration is
    repeated with the p of its end until they settle. Where convex log-priors outweigh the data, steps (not the
    covariance) take their curvature with the opposite sign.

    Where every experiment of a forced model has a guess of its orbit, orbits and parameters are first estimated
    together, from these guesses and `start`: the orbits need not exist at the start, and none is lost or exchanged.

    Prime period, turns of angles and order of the forcing periods of every fitted orbit are compared with those of the
    recording. If they differ, the fit is repeated from orbits that the measured outputs show; if an orbit remains
    another one, the status is "other orbit".

    Points of response tables are fitted on the sheets of the model's branch that fit them best at the estimate. Unless
    `start` is given, tables are first fitted with larger errors, a tenth of their largest value, and 2 % of their
    frequencies: with precise ones, iterations from distant starts end at other optima.

    The iteration starts at several points where its solves are cheap, and at the images of an optimum under changes of
    signs and exchanges of two parameters, if their density is at least a thousandth of the optimum's. Ends further
    apart than a standard deviation are separate optima, see `MapEstimate.modes`; the estimate is the highest.

    Parameters
    ----------
    problem : Problem
    start : mapping of str to float, optional
        First guess of every free parameter; those that the problem adds by itself may be left out, see
        `Problem.completed`. By default the medians of the priors.
    starts : int, optional
        Number of starts; those after the first are draws from the priors, solved from the orbits of the first. By
        default one if `start` is given, and otherwise up to eight, with at most 16 000 unknowns of all periodic solves
        together: eight for 2000 (states × points × experiments) or fewer, one for more than 8000; three for condensed
        models, whose draws are solved from rest where they are not reached.
    seed : int
        Of these draws.
    checks : bool
        Make the checks of `check` and the joint Laplace approximation, which take about as long as the iteration from
        a good start. Without them ``fit.checks`` is None, and ``fit.joint`` unless there are several optima; for
        repeated fits.
    progress : bool
        Show the iterations, with the objective and the step in standard deviations.

    Returns
    -------
    MapEstimate

    Raises
    ------
    ValueError
        If the log-posterior is not finite at the start, or a name is unknown.

    Warns
    -----
    UserWarning
        If an estimate lies at the end of its prior's support, if another optimum has more than 1 % of the posterior
        mass by its Laplace approximation, if data contain no noise, if the orbit of an experiment is not the measured
        one, if the branch of a response table does not reach a point or is unstable there, if the posterior of a
        table is not normal near the estimate, if the data depend on a parameter only to second order there, and as
        `check` does.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> estimate = bp.map_estimate(problem, start={"c": 0.3, "k": 1.2}, progress=False)
    >>> estimate.status, abs(estimate.theta["k"] - 1.0) < 3 * estimate.sd["k"]
    ('converged', True)
    """
    _checks.instance("problem", problem, Problem)
    if isinstance(start, Mapping):
        start = problem.completed(start)
        _checks.same_names("start", start, problem.names)
    theta = problem.median() if start is None else problem.vector(start)
    if starts is None:
        starts = default_starts(problem) if start is None else 1
    _checks.integer("starts", starts, 1)
    _checks.instance("checks", checks, bool)
    draws = problem.joint_prior.sample(starts - 1, np.random.default_rng(_checks.integer("seed", seed, 0)))
    near = _in_wide_tables(problem, theta, draws, progress) if start is None else []
    first = _first_iterate(problem, near[0]) if near else None
    first = first or _first_iterate(problem, theta)
    if first is None:
        raise ValueError(_not_finite(problem, theta, start is not None))
    objective = _objective(problem, first.here)
    end = _on_best_sheets(problem, _climb(objective, first, progress), progress)
    end = _on_measured_orbits(problem, theta, end, progress)
    ends: list[End | None] = [end]
    for draw in near[1:] or draws:
        if near and draw is near[0]:
            ends.append(end)
        else:
            ends.append(_from_draw(objective, [one for one in ends if one], draw, progress))
    best = max((end for end in ends if end), key=preference)
    noisy, moved = _with_noisy_inputs(problem, best, progress)
    if noisy is not problem:
        objective = _objective(noisy, moved.iterate.here)
        ends, problem = [moved if end is best else _moved(noisy, end) for end in ends], noisy
        best = moved
    objective, settled = corrected(objective, best)
    ends = [settled if end is best else end and resumed(objective, end) for end in ends]
    modes = with_images(objective, [end for end in ends if end], partial(_climb, objective, progress=progress))
    lost = {"objective": -np.inf} | dict.fromkeys(problem.names, np.nan)
    outcomes = [
        {"objective": end.iterate.objective} | _by_name(problem, end.iterate.theta) if end else lost for end in ends
    ]
    result = _describe(problem, objective, modes, tuple(outcomes), checks)
    beyond = second_order_warnings(objective, modes[0].iterate)
    shape = shape_warnings(objective, modes[0].iterate, result.joint)
    for text in (*estimation_warnings(problem, result), *beyond, *shape):
        warnings.warn(text, UserWarning, stacklevel=3)
    return result


@in_one_thread
def nearest_optimum(
    problem: Problem, theta: np.ndarray, guesses: Mapping[str, Mapping[str, np.ndarray]]
) -> tuple[Objective, End] | None:
    """Return objective and end of the iteration from θ and orbits near it, errors of inputs as the problem has them.

    None if there is no orbit or no finite density.
    """
    near = LogPosterior(problem, ResponseSolver.start(problem, theta, guesses)).linearise(theta)
    objective = _objective(problem, near)
    first = objective.iterate(near, problem.likelihood.guess())
    return None if first is None else (objective, climb(objective, first))


def _with_noisy_inputs(problem: Problem, end: End, progress: bool) -> tuple[Problem, End]:
    """Return problem and end of the climb with errors of inputs and frequencies, linearised about the estimate."""
    for _ in range(MOST_LINEARISATIONS if problem.noisy_inputs or problem.frequency_errors else 0):
        now, before = end.iterate, problem.input_errors
        loadings = input_loadings(problem, now.theta, now.here.solver.solutions(now.theta), problem.input_noise)
        errors = estimated_inputs(problem, now, loadings).errors
        problem = problem.with_input_errors(errors)
        objective, first = _of_problem(problem, now)
        if first is None:
            break
        end = _climb(objective, first, progress, STEPS_BETWEEN)
        step = end.iterate.theta - now.theta
        moved = [one.expected - (before[n].expected if n in before else np.inf) for n, one in errors.items()]
        still = all(np.abs(change).max(initial=0.0) < SETTLED_INPUTS for change in moved)
        with np.errstate(invalid="ignore"):  # of a Hessian that overflows: not settled
            size = step @ objective.hessian_and_gradient(end.iterate)[0] @ step
        if still and size < SETTLED_INPUTS**2:
            return problem, resumed(objective, end) or end
    if problem.noisy_inputs or problem.frequency_errors:
        names = " and ".join(["inputs"] * bool(problem.noisy_inputs) + ["frequencies"] * bool(problem.frequency_errors))
        joint = ", or take input_noise='joint', in which those of the inputs are parameters" * bool(
            problem.noisy_inputs
        )
        warnings.warn(
            f"The errors of the {names} could not be linearised: estimate or {names} still move when this is repeated, "
            f"by more than {SETTLED_INPUTS:g} of their standard deviations. Average more cycles{joint}.",
            UserWarning,
            stacklevel=4,
        )
    return problem, end


def _moved(problem: Problem, end: End | None) -> End | None:
    """Return an end as one of a problem with other errors of the inputs; None if that is not finite."""
    iterate = end and _of_problem(problem, end.iterate)[1]
    return End(iterate, end.status, end.history) if end and iterate else None


def _of_problem(problem: Problem, iterate: Iterate) -> tuple[Objective, Iterate | None]:
    """Return objective and iterate, solved from the same orbits, of a problem with other errors of the inputs."""
    if iterate.here.solver.problem is problem:
        return _objective(problem, iterate.here), iterate
    guesses = {name: solution.states for name, solution in iterate.here.solver.solutions(iterate.theta).items()}
    near = LogPosterior(problem, ResponseSolver.start(problem, iterate.theta, guesses)).linearise(iterate.theta)
    objective = _objective(problem, near)
    return objective, objective.iterate(near, iterate.noise)


def _objective(problem: Problem, near: Linearisation) -> Objective:
    return Objective(LogPosterior(problem, near.solver, coordinates=NATURAL), of_total=True)


def _first_iterate(problem: Problem, theta: np.ndarray) -> Iterate | None:
    """Return the anchored iterate at a start; None if the log-posterior is not finite there."""
    if not np.isfinite(problem.joint_prior.log_prob(theta)):
        return None
    initial = simultaneous_fit(problem, theta)
    if initial is not None and initial.states:
        near = _linearised(problem, theta, initial)
        iterate = _objective(problem, near).iterate(near, problem.likelihood.guess())
        if iterate is not None:
            return iterate
    if initial is not None and not any(o.whole for o in problem.observations.values()):
        return None
    near = _linearised(problem, theta, None)
    return _objective(problem, near).iterate(near, problem.likelihood.guess())


def _linearised(problem: Problem, theta: np.ndarray, initial: InitialEstimate | None) -> Linearisation:
    """Return residuals and Jacobian where orbits and parameters fit together, or else at θ."""
    if initial is None or not initial.states:
        return _on_sheets(problem, problem.density().linearise(theta))
    return LogPosterior(problem, ResponseSolver.start(problem, initial.theta, initial.states)).linearise(initial.theta)


def _on_sheets(problem: Problem, here: Linearisation) -> Linearisation:
    """Return the same with the points of tables on the sheets of their branches that fit the data best at this θ.

    Orbits that are followed from another θ, at which the branch has other folds, may be on others.
    """
    if not tables(problem):
        return here
    return LogPosterior(problem, here.solver.on_best_sheets(here.theta)).linearise(here.theta)


def _in_wide_tables(problem: Problem, theta: np.ndarray, draws: np.ndarray, progress: bool) -> list[np.ndarray]:
    """Return where climbs in tables with larger errors end, the best first, of each start; nothing without tables."""
    wide = widened(problem)
    first = wide and _first_iterate(wide, theta)
    if not (wide and first):
        return []
    objective = _objective(wide, first.here)
    ends: list[End] = [_on_best_sheets(wide, _climb(objective, first, progress), progress)]
    lost = []
    for draw in draws:
        end = _from_draw(objective, ends, draw, progress)
        if end:
            ends.append(end)
        else:
            lost.append(draw)
    return [*(end.iterate.theta for end in sorted(ends, key=preference, reverse=True)), *lost]


def _from_draw(objective: Objective, ends: Sequence[End], theta: np.ndarray, progress: bool) -> End | None:
    """Return the end of the iteration from a draw of the prior; None if there is no orbit or no finite density.

    It is solved from the orbits of the first end, a condensed model also from rest where that fails, and is one of the
    ends where it comes close to that.
    """
    first = ends[0].iterate
    problem: Any = objective.density.problem
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        other = objective.at(theta, first.here, problem.likelihood.guess())
        if other is None and isinstance(problem.model, CondensedModel):
            other = objective.iterate(problem.density().linearise(theta), problem.likelihood.guess())
        return None if other is None else _climb(objective, objective.anchored(other), progress, ends=ends)


def _climb(
    objective: Objective, first: Iterate, progress: bool, most: int = MAX_STEPS, ends: Sequence[End] = ()
) -> End:
    """Climb with a progress bar; where an iterate comes close to one of the ends, that is returned."""
    reached: list[End] = []
    with tqdm(desc="MAP", unit="iteration", leave=False, disable=not progress, delay=SHOWN_AFTER) as bar:

        def report(iterate: Iterate, size: float) -> bool:
            bar.set_postfix_str(f"objective {iterate.objective:.6g}, step {size:.2g} sd", refresh=False)
            bar.update()
            known = optimum_of(objective, iterate, ends) if size < SEPARATE_SDS else None
            reached.extend([known] if known else [])
            return known is not None

        end = climb(objective, first, report=report, most=most)
    return reached[0] if reached else end


def _on_best_sheets(problem: Problem, end: End, progress: bool) -> End:
    """Return the end of a climb; where tables fit better on other sheets of their branches, the best from there."""
    for _ in range(MOST_SHEET_CHANGES if tables(problem) else 0):
        theta = end.iterate.theta
        solver = end.iterate.here.solver.on_best_sheets(theta)
        if end.iterate.here.solver.on_same_orbits(solver):
            break
        near = LogPosterior(problem, solver).linearise(theta)
        objective = _objective(problem, near)
        first = objective.iterate(near, problem.likelihood.guess())
        if first is None:
            break
        other = _climb(objective, first, progress)
        if preference(other) <= preference(end):
            break
        end = other
    return end


def _on_measured_orbits(problem: Problem, start: np.ndarray, end: End, progress: bool) -> End:
    """Return the end of a climb; if its orbits are not the measured ones, the best of those from the measured orbits.

    They are not if they differ in kind, or leave most of the variance of a channel unexplained.
    """
    if not _doubtful(problem, end):
        return end
    for near in _near_measured_orbits(problem, end.iterate, start):
        objective = _objective(problem, near)
        first = objective.iterate(near, problem.likelihood.guess())
        if first is not None:
            end = max(end, _climb(objective, first, progress), key=preference)
        if not _doubtful(problem, end):
            break
    return end


def _doubtful(problem: Problem, end: End) -> bool:
    here = end.iterate.here
    left = _fractions_left(problem, here.compared()).values()
    return bool(here.other_orbits) or max(left, default=0.0) > MOST_UNEXPLAINED


def _near_measured_orbits(problem: Problem, end: Iterate, start: np.ndarray) -> Iterator[Linearisation]:
    """Yield where to start again: near orbits that give the measured outputs, and where simultaneous fits of them end.

    Orbits and parameters are looked for from the start and from the estimate.
    """
    unable = problem.model.autonomous or isinstance(problem.model, CondensedModel)
    if unable or not all(e.outputs for e in problem.experiments):
        return
    solutions = {name: solution.states for name, solution in end.here.solver.solutions(end.theta).items()}
    for theta in (start, end.theta):
        measured = measured_orbits(problem, theta, solutions)
        for initial in (measured, simultaneous_fit(problem, measured.theta, measured.states)):
            if initial is not None and initial.states:
                yield _linearised(problem, initial.theta, initial)


def _describe(
    problem: Problem, objective: Objective, modes: Sequence[End], starts: tuple[dict[str, float], ...], checks: bool
) -> MapEstimate:
    import pandas as pd

    best, status, history = modes[0]
    names, noise_names = problem.names, problem.likelihood.counts
    factor = objective.log_variance_factor
    uncertain = uncertainty(problem, best, factor)
    covariance, lost = uncertain.covariance.copy(), uncertain.lost
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    covariance[lost, lost] = np.inf
    acting = np.diag(uncertain.information) * problem.joint_prior.widths**2 > INFORMED
    sampled = objective.density.with_settings(coordinates=RIDGE_COORDINATES)
    joints = [joint_laplace(sampled, end.iterate) for end in modes] if checks or len(modes) > 1 else []
    residuals, solutions = best.here.compared(), best.here.solver.solutions(best.theta)
    fit = MapEstimate(
        status=STATUSES[OTHER_ORBIT] if best.here.other_orbits else status,
        theta=_by_name(problem, best.theta),
        covariance=pd.DataFrame(covariance, index=list(names), columns=list(names)),
        degrees_of_freedom=_by_name(problem, degrees_of_freedom(uncertain.inverse, uncertain.parts)),
        joint=joints[0] if joints else None,
        noise_estimate=NoiseEstimate(
            dict(zip(problem.noise_names, best.noise.tolist(), strict=True)),
            problem.noise.prior_text,
            {_short(name): count for name, count in noise_names.items()},
        ),
        solutions=solutions,
        residuals=residuals,
        rms={c: _pooled(problem, c, residuals) for c in (*problem.channels, *problem.quantities)},
        fvu=_fractions_left(problem, residuals),
        true_inputs=TrueInputs(
            {e.name: model_inputs(problem, e, best.theta) for e in problem.experiments},
            estimated_inputs(problem, best).sd,
            problem.input_errors,
            updated_frequencies(problem, best, solutions, covariance),
        ),
        search=Search(
            history,
            starts,
            tuple(np.array(names)[acting & (at_ends(objective, best) != 0.0)].tolist()),
            best.here.other_orbits,
            weighed(problem, modes, joints) if len(modes) > 1 else (),
            dict(problem.joint_prior.supports),
        ),
        tied=_tied_slopes(problem, best.theta),
        fingerprint=fingerprint(problem),
    )
    return replace(fit, checks=checked(objective, best, uncertain, fit)) if checks else fit


def _by_name(problem: Problem, values: np.ndarray) -> dict[str, float]:
    return dict(zip(problem.names, values.tolist(), strict=True))


def estimation_warnings(problem: Problem, fit: MapEstimate) -> Iterator[str]:
    """Yield the warnings about an estimate, and those about its checks if there are any."""
    for name, reason in fit.other_orbits.items():
        yield (
            f"Experiment {name!r} was fitted by another orbit than the recorded one: {reason}. The estimate is not "
            "valid. Give the experiment a guess of its states (Experiment.guess), start={…} nearer to the truth, or "
            "another model."
        )
    yield from table_warnings(problem, fit)
    for channel in fit.without_noise:
        named = [n for n in problem.free_noise if _short(n).partition(", ")[0] in (channel, Relative.pooled)]
        variance = (named or problem.noise_names)[0]
        yield (
            f"The data of {channel!r} contain no noise: the residual's rms of {fit.rms[channel]:.2g} is a rounding "
            "error, and standard deviations that follow from it mean nothing. Add noise to simulated data, or give its "
            f"variance, fixed={{{variance!r}: …}}."
        )
    for name in fit.at_ends:
        low, high = problem.joint_prior.supports[name]
        yield (
            f"The estimate of {name!r}, {fit.theta[name]:.6g}, lies at the end of its prior's support ({low:g}, "
            f"{high:g}); standard deviations do not describe the posterior there. Sample it, or widen the prior."
        )
    unknown = {one.label: one for e in problem.experiments for one in e.measurements if _is_unknown_amplitude(one)}
    for label in unknown:
        smallest = min(one.value for e in problem.experiments for one in e.measurements if one.label == label)
        if smallest < LEAST_NORMAL * fit.rms[label] and label not in fit.without_noise:
            yield (
                f"The smallest {label}, {smallest:.3g}, is {smallest / fit.rms[label]:.2g} times the rms of the "
                "residuals. Noise makes such amplitudes larger on average, which the normal distribution of unknown "
                "variance does not take into account; give their standard deviation, sd=…, or leave them out."
            )
    if others := notable(fit.other_modes):
        shown = "; ".join(map(repr, others[:MOST_SHOWN_MODES]))
        yield (
            f"{len(others) + 1} separate optima fit the data: the estimate, with {fit.modes['mass'].iloc[0]:.0%} of "
            f"the posterior mass by Laplace, and {shown}. Standard deviations describe the first one only. Sample the "
            "posterior, or give priors that exclude the others."
        )
    if fit.checks is not None:
        yield from check_warnings(problem, fit)


def _short(name: str) -> str:
    """Return a channel from ``variance[channel]``, other names as they are."""
    return name.removeprefix("variance[").removesuffix("]") if name.startswith("variance[") else name


def _tied_slopes(problem: Problem, theta: np.ndarray) -> dict[str, dict[str, float]]:
    each = np.array([parameter_map.slopes(theta) for parameter_map in problem.parameter_maps.values()])
    common = np.where(np.ptp(each, axis=0) == 0.0, each[0], np.nan)
    every = next(iter(problem.parameter_maps.values())).parameters
    slopes = dict(zip(every, common.tolist(), strict=True))
    return {name: dict(zip(problem.names, slopes[name], strict=True)) for name in problem.tied}


def _fractions_left(problem: Problem, residuals: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, float]:
    """Return the fraction of each channel's variance that is left in residuals, of quantities of their mean square."""
    measured = {e.name: {c: y - y.mean() for c, y in e.outputs.items()} | _scales(e) for e in problem.experiments}
    compared = (*problem.channels, *problem.quantities)
    power = {c: max(_pooled(problem, c, measured) ** 2, np.finfo(float).tiny) for c in compared}
    return {c: _pooled(problem, c, residuals) ** 2 / whole for c, whole in power.items()}


def _is_unknown_amplitude(one: Measurement) -> bool:
    return isinstance(one, Amplitude) and one.sd is None


def _scales(experiment: Experiment) -> dict[str, np.ndarray]:
    """Return what errors of measured quantities are compared with, by label: their values; of phases, any phase."""
    result: dict[str, list[float]] = {}
    for one in experiment.measurements:
        result.setdefault(one.label, []).append(RANDOM_PHASE if one.signed else one.value)
    return {label: np.array(values) for label, values in result.items()}


def _pooled(problem: Problem, channel: str, signals: Mapping[str, Mapping[str, np.ndarray]]) -> float:
    """Return the root mean square of a channel over the measured points of all experiments, or of a quantity."""
    having = [(e, signals[e.name][channel]) for e in problem.experiments if channel in signals[e.name]]
    values = [part[e.measured_points] if channel in e.outputs else part for e, part in having]
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2)))


def _not_finite(problem: Problem, theta: np.ndarray, given_start: bool) -> str:
    given = dict(zip(problem.names, theta, strict=True))
    values = ", ".join(f"{name} = {value:.6g}" for name, value in given.items())
    if names := problem.joint_prior.excluding(theta):
        low, high = problem.joint_prior.supports[names[0]]
        excluded = ", ".join(f"{name} = {given[name]:.6g}" for name in names)
        return (
            f"start: must be inside the prior's support ({low:g}, {high:g}), got {excluded}, where the log-posterior "
            "is not finite."
        )
    values += "" if given_start else " (the priors' medians)"
    initial = simultaneous_fit(problem, theta)
    if initial is not None and initial.blocked:
        where = "the other experiments' orbits are" if len(problem.experiments) > 1 else "it is an orbit"
        return (
            f"start: must be a point from which the orbits can be followed, got {values}; {initial.blocked!r} cannot "
            f"be followed from its guess to parameters at which {where}. Leave it out if it may be no orbit, or give "
            "start={…} nearer to the truth."
        )
    near = _linearised(problem, theta, initial)
    if text := not_isolated(problem, theta, near.statuses):
        return text
    failed = ", ".join(f"{name!r} ({status})" for name, status in near.statuses.items() if status != "converged")
    ended = f"without the orbit of {failed}" if failed else "well, but the outputs or the noise are not finite"
    cures = "start={…}, or priors with other medians, at which problem.solve(theta) converges."
    if term := singular_start(problem, theta, near.statuses):
        ended += f", because the equations contain {term}"
        cures = "guess={…} in fold, with states at which they are finite, or start={…}."
    if STATUSES[NOT_RESOLVED] in near.statuses.values():
        cures = "more samples, an odd number of them, or another scheme, such as Problem(scheme='backward2')."
    return (
        f"start: must have a finite log-posterior, got {values}, where the periodic solve ended {ended}. Give {cures} "
        f"{compared_with_data(problem, theta)} {unit_error(problem, theta)}"
    ).rstrip()
