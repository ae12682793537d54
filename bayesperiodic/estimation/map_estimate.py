"""Bayesian estimator of the paper: staged Gauss-Newton to the MAP point, and its Laplace covariance."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.data.measurements import Amplitude, Measurement
from bayesperiodic.density.initial_orbits import simultaneous_fit
from bayesperiodic.density.log_posterior import RIDGE_COORDINATES, LogPosterior
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.estimation.check import check_warnings, checked
from bayesperiodic.estimation.climbs import (
    climbed,
    coarsely,
    first_iterate,
    fractions_left,
    from_draws,
    in_wide_tables,
    linearised,
    objective_near,
    of_problem,
    on_best_sheets,
    on_fewer_points,
    on_measured_orbits,
    pooled,
    rough,
)
from bayesperiodic.estimation.covariance import (
    degrees_of_freedom,
    estimated_inputs,
    input_loadings,
    uncertainty,
)
from bayesperiodic.estimation.fit_warnings import second_order_warnings, shape_warnings, table_warnings
from bayesperiodic.estimation.gauss_newton import (
    MAX_STEP_HALVINGS,
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
    LOWEST_OBJECTIVE,
    SEPARATE_SDS,
    default_starts,
    notable,
    weighed,
    with_images,
)
from bayesperiodic.estimation.result import MapEstimate, NoiseEstimate, Search, TrueInputs
from bayesperiodic.estimation.units import compared_with_data, not_isolated, singular_start, unit_error
from bayesperiodic.likelihood.noise import Relative
from bayesperiodic.likelihood.orbit_frequency import FREQUENCY
from bayesperiodic.periodic.compiled import NOT_RESOLVED, OTHER_ORBIT, STATUSES
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.problem.fingerprint import fingerprint
from bayesperiodic.problem.model_inputs import model_inputs

if TYPE_CHECKING:
    import pandas as pd

MOST_SHOWN_MODES = 3
# Standard deviations from which on an amplitude of a noisy harmonic is nearly normal.
LEAST_NORMAL = 4.0
# Information of the data, relative to the prior's, below which an estimate at an end of the support is the prior's.
INFORMED = 0.01
# Most linearisations of errors of the inputs, the steps between two, and the change [sds] that ends them.
MOST_LINEARISATIONS, STEPS_BETWEEN, SETTLED_INPUTS = 40, 5, 1e-5
# Ratio of the moves of two linearisations below which one step is taken between the next two.
QUICKLY_SMALLER = 0.5
# Halvings of a step to an estimate that is near: shorter ones lead to parameters at which an orbit ends.
FEWER_HALVINGS = 8


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

    Climbs of condensed models begin on the orbits that the measured outputs show: from these and the inputs follow the
    forces of the elements by the frequency response of the linear structure, whatever their laws.

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
        Number of starts; those after the first are draws from the priors, solved from the orbits of the first. Where
        the density is not finite at the first, a given number begins at the first draw where it is. By
        default one if `start` is given, and otherwise up to eight, with at most 16 000 unknowns of all periodic solves
        together: eight for 2000 (states × points × experiments) or fewer, one for more than 8000; of condensed models
        up to eight while the tests of `predict` reject the model at the best end. Their solves begin at the motion that
        the measured outputs show, or at rest.
    seed : int
        Of these draws.
    checks : bool
        Make the checks of `check` and the joint Laplace approximation, which take about as long as the iteration from
        a good start. Without them ``fit.checks`` is None, and ``fit.joint`` unless there are several optima; for
        repeated fits.
    progress : bool
        Show the iterations, with the objective and the step in standard deviations, and the images that are solved.

    Returns
    -------
    MapEstimate

    Raises
    ------
    ValueError
        If the log-posterior is not finite at the start, nor at the draws of a given `starts`, or a name is unknown.

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
    if starts is not None:
        fewest = most = _checks.integer("starts", starts, 1)
    else:
        fewest, most = (1, 1) if start is not None else default_starts(problem)
    _checks.instance("checks", checks, bool)
    draws = problem.joint_prior.sample(most - 1, np.random.default_rng(_checks.integer("seed", seed, 0)))
    near = in_wide_tables(problem, theta, draws[: fewest - 1], progress) if start is None else []
    first = first_iterate(problem, near[0]) if near else None
    coarse, precise = (None, None) if first else on_fewer_points(problem, theta)
    near_optimum = coarsely(problem, coarse, theta, progress)
    first = first or near_optimum or precise or first_iterate(problem, theta)
    if first is None and starts is not None:
        first = next(filter(None, (first_iterate(problem, draw) for draw in draws)), None)
    if first is None:
        raise ValueError(_not_finite(problem, theta, start is not None))
    objective = objective_near(problem, first.here)
    fewest = 1 if near_optimum and precise and starts is None else fewest
    end = _first_end(objective, first, near_optimum is not None, fewest, progress)
    end = on_measured_orbits(problem, theta, end, progress)
    starting = [*(near or [theta, *draws[: fewest - 1]]), *draws[fewest - 1 :]]
    ends = from_draws(objective, starting, end, fewest, progress, coarse if near_optimum else None)
    best = max((end for end in ends if end), key=preference)
    if near_optimum:
        top = climbed(objective_near(problem, best.iterate.here), best.iterate, progress)
        ends, best = [top if end is best else end for end in ends], top
    noisy, moved = _with_noisy_inputs(problem, best, progress)
    if noisy is not problem:
        objective = objective_near(noisy, moved.iterate.here)
        ends, problem = [moved if end is best else _moved(noisy, end) for end in ends], noisy
        best = moved
    objective, settled = corrected(objective, best)
    least = best.iterate.objective - LOWEST_OBJECTIVE
    ends = [settled if end is best else end and _restated(objective, end, least) for end in ends]
    modes = with_images(
        objective, [end for end in ends if end], partial(climbed, objective, progress=progress), progress
    )
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
def end_from(problem: Problem, theta: np.ndarray) -> End | None:
    """Return the end of the climb from a start (names,); None if the density is not finite.

    It is near the estimate: without the bias correction of the variances, and without other optima. A climb that needs
    short steps ends as "stalled": it leads away from the orbits.
    """
    coarse, precise = on_fewer_points(problem, theta)
    near_optimum = coarsely(problem, coarse, theta, False)
    first = near_optimum or precise or first_iterate(problem, theta)
    if first is None:
        return None
    end = _first_end(objective_near(problem, first.here), first, near_optimum is not None, 1, False, FEWER_HALVINGS)
    end = on_measured_orbits(problem, theta, end, False)
    if near_optimum:
        end = climbed(objective_near(problem, end.iterate.here), end.iterate, False)
    return _with_noisy_inputs(problem, end, False)[1]


@in_one_thread
def nearest_optimum(
    problem: Problem, theta: np.ndarray, guesses: Mapping[str, Mapping[str, np.ndarray]]
) -> tuple[Objective, End] | None:
    """Return objective and end of the iteration from θ and orbits near it, errors of inputs as the problem has them.

    None if there is no orbit or no finite density.
    """
    near = LogPosterior(problem, ResponseSolver.start(problem, theta, guesses)).linearise(theta)
    objective = objective_near(problem, near)
    first = objective.iterate(near, problem.likelihood.guess())
    return None if first is None else (objective, climb(objective, first))


def _first_end(
    objective: Objective, first: Iterate, near_optimum: bool, fewest: int, progress: bool,
    halvings: int = MAX_STEP_HALVINGS,
) -> End:  # fmt: skip
    """Return the end of the climb from the first start, of condensed models `near_optimum`, where that is enough.

    Where tests decide on more starts, they are of this neighbourhood; without such tests none is needed.
    """
    if near_optimum and fewest > 1:
        return rough(first)
    least = SEPARATE_SDS if near_optimum else 0.0
    end = climbed(objective, first, progress, halvings=halvings, least=least)
    problem: Any = objective.density.problem
    return on_best_sheets(problem, end, progress)


def _with_noisy_inputs(problem: Problem, end: End, progress: bool) -> tuple[Problem, End]:
    """Return problem and end of the climb with errors of inputs and frequencies, linearised about the estimate."""
    most, sizes = STEPS_BETWEEN, [np.inf]
    for _ in range(MOST_LINEARISATIONS if problem.noisy_inputs or problem.frequency_errors else 0):
        now, before = end.iterate, problem.input_errors
        orbits = now.here.solver.solutions(now.theta, sensitivities=False)
        loadings = input_loadings(problem, now.theta, orbits, problem.input_noise)
        errors = estimated_inputs(problem, now, loadings).errors
        problem = problem.with_input_errors(errors)
        objective, first = of_problem(problem, now)
        if first is None:
            break
        end = climbed(objective, first, progress, most)
        step = end.iterate.theta - now.theta
        moved = [one.expected - (before[n].expected if n in before else np.inf) for n, one in errors.items()]
        still = all(np.abs(change).max(initial=0.0) < SETTLED_INPUTS for change in moved)
        with np.errstate(invalid="ignore"):  # of a Hessian that overflows: not settled
            size = step @ objective.hessian_and_gradient(end.iterate)[0] @ step
        # Further steps of a climb are not worth it as long as the next linearisation moves the estimate by more.
        sizes.append(size)
        most = 1 if size < QUICKLY_SMALLER**2 * sizes[-2] else STEPS_BETWEEN
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
    iterate = end and of_problem(problem, end.iterate)[1]
    return End(iterate, end.status, end.history) if end and iterate else None


def _restated(objective: Objective, end: End, least: float) -> End | None:
    """Return an end with another objective, climbed on to where it is not below the least and may be a mode."""
    return resumed(objective, end, most=MAX_STEPS if end.iterate.objective >= least else 0)


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
        rms={c: pooled(problem, c, residuals) for c in (*problem.channels, *problem.quantities)},
        fvu=fractions_left(problem, residuals),
        true_inputs=TrueInputs(
            {e.name: model_inputs(problem, e, best.theta) for e in problem.experiments},
            estimated_inputs(problem, best).sd,
            problem.input_errors,
            _updated_frequencies(problem, best, solutions, covariance),
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


def _is_unknown_amplitude(one: Measurement) -> bool:
    return isinstance(one, Amplitude) and one.sd is None


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
    near = linearised(problem, theta, initial)
    if text := not_isolated(problem, theta, near.statuses):
        return text
    failed = ", ".join(f"{name!r} ({status})" for name, status in near.statuses.items() if status != "converged")
    ended = f"without the orbit of {failed}" if failed else "well, but the outputs or the noise are not finite"
    cures = "start={…}, or priors with other medians, at which problem.solve(theta) converges, or try draws of the "
    cures += "priors by starts=8."
    if term := singular_start(problem, theta, near.statuses):
        ended += f", because the equations contain {term}"
        cures = "guess={…} in fold, with states at which they are finite, or start={…}."
    if STATUSES[NOT_RESOLVED] in near.statuses.values():
        cures = "more samples, an odd number of them, or another scheme, such as Problem(scheme='backward2')."
    return (
        f"start: must have a finite log-posterior, got {values}, where the periodic solve ended {ended}. Give {cures} "
        f"{compared_with_data(problem, theta)} {unit_error(problem, theta)}"
    ).rstrip()


def _updated_frequencies(
    problem: Problem, estimate: Iterate, solutions: Mapping[str, PeriodicSolution], covariance: np.ndarray
) -> "pd.DataFrame":
    """Return measured and estimated frequencies of experiments whose frequency is uncertain, see `MapEstimate`."""
    import pandas as pd

    likelihood, given, rows = problem.likelihood, estimated_inputs(problem, estimate).covariances, {}
    spread = np.nan_to_num(covariance, posinf=0.0)
    for e in problem.experiments:
        members = [b for b, block in enumerate(likelihood.blocks) if block.experiment == e.name]
        if not e.frequency_se > 0.0:
            continue
        if problem.model.autonomous:
            (block,) = [b for b in members if likelihood.blocks[b].channel == FREQUENCY]
            slope = estimate.here.jacobian[block][:, 0]
            sd = np.sqrt(slope @ spread @ slope)
        elif e.name in given:
            # The expected errors given θ are −S⁻¹·Lᵀ·p·r, and change by S⁻¹·Lᵀ·p·∂ŷ/∂θ.
            precisions = likelihood.precisions(members, estimate.noise)
            weighed = np.concatenate(
                [np.broadcast_to(p, likelihood.blocks[b].size) for b, p in zip(members, precisions, strict=True)]
            )
            jacobian = np.concatenate([estimate.here.jacobian[b] for b in members], axis=1)
            slope = jacobian @ (weighed * (likelihood.loadings[e.name] @ given[e.name][-1]))
            sd = np.sqrt(given[e.name][-1, -1] + slope @ spread @ slope)
        else:
            sd = 1.0
        rows[e.name] = (e.frequency, e.frequency_se, solutions[e.name].frequency, e.frequency_se * min(float(sd), 1.0))
    return pd.DataFrame.from_dict(rows, orient="index", columns=["measured", "se", "estimate", "sd"], dtype=float)
