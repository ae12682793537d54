"""Bayesian estimator of the paper: staged Gauss-Newton to the MAP point, and its Laplace covariance."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.density.initial_orbits import InitialEstimate, measured_orbits, simultaneous_fit
from bayesperiodic.density.log_posterior import NATURAL, RIDGE, Linearisation, LogPosterior
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import Simulator
from bayesperiodic.estimation.conflict import prior_conflict
from bayesperiodic.estimation.covariance import (
    caused_by_inputs,
    degrees_of_freedom,
    doubling_shift,
    estimated_inputs,
    input_loadings,
    input_nonlinearity,
    robust_covariance,
    variance_parts,
    with_uncertain_noise,
)
from bayesperiodic.estimation.gauss_newton import (
    MAX_ITERATIONS,
    End,
    Iterate,
    Objective,
    at_ends,
    climb,
    corrected,
    information,
    inverse_hessian,
    preference,
    resumed,
)
from bayesperiodic.estimation.laplace import COMBINED, SILENT, joint_laplace, undetermined
from bayesperiodic.estimation.modes import default_starts, notable, weighed, with_images
from bayesperiodic.estimation.result import MapEstimate, channel_whiteness, noise_split
from bayesperiodic.estimation.units import compared_with_data, unit_error
from bayesperiodic.likelihood.input_noise import EXACT, FEWEST_CYCLES, ROUGH
from bayesperiodic.periodic.compiled import NOT_RESOLVED, OTHER_ORBIT, STATUSES
from bayesperiodic.problem.description import fingerprint

NOISE_SHARE = 0.1
LARGEST_SHIFT, LARGEST_NONLINEARITY = 0.1, 0.3
SHOWN = 3
# Information of the data, relative to the prior's, below which an estimate at an end of the support is the prior's.
INFORMED = 0.01
MOST_UNEXPLAINED = 0.5
# Most linearisations of errors of the inputs, the steps between two, and the change [sds] that ends them.
MOST_ROUNDS, BETWEEN, SETTLED = 40, 5, 1e-5
# Seconds after which the progress bar is shown.
SHOWN_AFTER = 2.0
# Value of a field of MapEstimate that is computed at its first use.
deferred: Any = partial


@in_one_thread
def map_estimate(
    problem: Problem,
    *,
    start: Mapping[str, float] | None = None,
    starts: int | None = None,
    seed: int = 0,
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

    The iteration starts at several points where its solves are cheap, and at the images of an optimum under changes of
    signs and exchanges of two parameters, if their density is at least a thousandth of the optimum's. Ends further
    apart than a standard deviation are separate optima, see `MapEstimate.modes`; the estimate is the highest.

    Parameters
    ----------
    problem : Problem
    start : mapping of str to float, optional
        First guess of every free parameter; by default the medians of the priors.
    starts : int, optional
        Number of starts; those after the first are draws from the priors, solved from the orbits of the first. By
        default one if `start` is given, and otherwise up to eight, with at most 16 000 unknowns of all periodic solves
        together: eight for 2000 (states × points × experiments) or fewer, one for more than 8000.
    seed : int
        Of these draws.
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
        If the noise of the measured inputs causes more than a tenth of an output's residual, if twice as many points
        would move an estimate by more than a tenth of its standard deviation, if an estimate lies at the end of its
        prior's support, if the prior and the data are in conflict, if another optimum has more than 1 % of the
        posterior mass by its Laplace approximation, if more than half of a channel's variance is unexplained, if the
        data do not determine a parameter or a combination of parameters, and if the orbit of an experiment is not the
        measured one.

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
        _checks.same_names("start", start, problem.names)
    theta = problem.median() if start is None else problem.vector(start)
    if starts is None:
        starts = default_starts(problem) if start is None else 1
    _checks.integer("starts", starts, 1)
    first = _first_iterate(problem, theta)
    if first is None:
        raise ValueError(_not_finite(problem, theta, start is not None))
    objective = _objective(problem, first.here)
    end = _on_measured_orbits(problem, theta, _climb(objective, first, progress), progress)
    ends: list[End | None] = [end]
    for draw in problem.joint_prior.sample(starts - 1, np.random.default_rng(_checks.integer("seed", seed, 0))):
        ends.append(_from_draw(objective, end.iterate, draw, progress))
    best = max((end for end in ends if end), key=preference)
    noisy, moved = _with_noisy_inputs(problem, best, progress)
    if noisy is not problem:
        objective = _objective(noisy, moved.iterate.here)
        ends, problem = [moved if end is best else _moved(noisy, end) for end in ends], noisy
        best = moved
    objective, found = corrected(objective, best)
    ends = [found if end is best else end and resumed(objective, end) for end in ends]
    modes = with_images(objective, [end for end in ends if end], partial(_climb, objective, progress=progress))
    result = _describe(problem, objective, modes, tuple(_outcome(problem, end) for end in ends))
    for text in estimation_warnings(problem, result):
        warnings.warn(text, UserWarning, stacklevel=3)
    return result


@in_one_thread
def nearest_optimum(
    problem: Problem, theta: np.ndarray, guesses: Mapping[str, Mapping[str, np.ndarray]]
) -> tuple[Objective, End] | None:
    """Return objective and end of the iteration from θ and orbits near it, errors of inputs as the problem has them.

    None if there is no orbit or no finite density.
    """
    near = LogPosterior(problem, Simulator.start(problem, theta, guesses)).linearise(theta)
    objective = _objective(problem, near)
    first = objective.iterate(near, problem.likelihood.guess())
    return None if first is None else (objective, climb(objective, first))


def _with_noisy_inputs(problem: Problem, end: End, progress: bool) -> tuple[Problem, End]:
    """Return problem and end of the climb with the errors of the inputs, linearised about the estimate."""
    for _ in range(MOST_ROUNDS if problem.noisy_inputs else 0):
        now, before = end.iterate, problem.input_errors
        loadings = input_loadings(problem, now.theta, now.here.simulator.solutions(now.theta), problem.input_noise)
        errors = estimated_inputs(problem, now, loadings).errors
        problem = problem.with_input_errors(errors)
        objective, first = _of_problem(problem, now)
        if first is None:
            break
        end = _climb(objective, first, progress, BETWEEN)
        step = end.iterate.theta - now.theta
        moved = [own.expected - (before[n].expected if n in before else np.inf) for n, own in errors.items()]
        still = all(np.abs(own).max(initial=0.0) < SETTLED for own in moved)
        if still and step @ objective.hessian_and_gradient(end.iterate)[0] @ step < SETTLED**2:
            return problem, resumed(objective, end) or end
    if problem.noisy_inputs:
        warnings.warn(
            "The errors of the inputs could not be linearised: estimate or inputs still move when this is repeated, by "
            f"more than {SETTLED:g} of their standard deviations. Average more cycles, or take input_noise='joint', in "
            "which they are parameters.",
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
    if iterate.here.simulator.problem is problem:
        return _objective(problem, iterate.here), iterate
    guesses = {name: solution.states for name, solution in iterate.here.simulator.solutions(iterate.theta).items()}
    near = LogPosterior(problem, Simulator.start(problem, iterate.theta, guesses)).linearise(iterate.theta)
    objective = _objective(problem, near)
    return objective, objective.iterate(near, iterate.noise)


def _objective(problem: Problem, near: Linearisation) -> Objective:
    return Objective(LogPosterior(problem, near.simulator, coordinates=NATURAL))


def _first_iterate(problem: Problem, theta: np.ndarray) -> Iterate | None:
    """Return the anchored iterate at a start; None if the log-posterior is not finite there."""
    if not np.isfinite(problem.joint_prior.log_prob(theta)):
        return None
    found = simultaneous_fit(problem, theta)
    if found is not None and found.states:
        near = _linearised(problem, theta, found)
        iterate = _objective(problem, near).iterate(near, problem.likelihood.guess())
        if iterate is not None:
            return iterate
    if found is not None and not any(o.whole for o in problem.observations.values()):
        return None
    near = _linearised(problem, theta, None)
    return _objective(problem, near).iterate(near, problem.likelihood.guess())


def _linearised(problem: Problem, theta: np.ndarray, found: InitialEstimate | None) -> Linearisation:
    """Return residuals and Jacobian where orbits and parameters fit together, or else at θ."""
    if found is None or not found.states:
        return problem.density().linearise(theta)
    return LogPosterior(problem, Simulator.start(problem, found.theta, found.states)).linearise(found.theta)


def _from_draw(objective: Objective, first: Iterate, theta: np.ndarray, progress: bool) -> End | None:
    """Return the end of the iteration from a draw of the prior; None if there is no orbit or no finite density."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        other = objective.at(theta, first.here, objective.density.problem.likelihood.guess())
        return None if other is None else _climb(objective, objective.anchored(other), progress)


def _climb(objective: Objective, first: Iterate, progress: bool, most: int = MAX_ITERATIONS) -> End:
    with tqdm(desc="MAP", unit="iteration", leave=False, disable=not progress, delay=SHOWN_AFTER) as bar:

        def report(iterate: Iterate, size: float) -> None:
            bar.set_postfix_str(f"objective {iterate.objective:.6g}, step {size:.2g} sd", refresh=False)
            bar.update()

        return climb(objective, first, report=report, most=most)


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
    if problem.model.autonomous:
        return
    solutions = {name: solution.states for name, solution in end.here.simulator.solutions(end.theta).items()}
    for theta in (start, end.theta):
        guessed, measured = measured_orbits(problem, theta, solutions)
        for found in (measured, simultaneous_fit(guessed, measured.theta)):
            if found is not None and found.states:
                yield _linearised(problem, found.theta, found)


def _outcome(problem: Problem, end: End | None) -> dict[str, float]:
    if end is None:
        return {"objective": -np.inf} | dict.fromkeys(problem.names, np.nan)
    return {"objective": end.iterate.objective} | dict(zip(problem.names, end.iterate.theta.tolist(), strict=True))


def _describe(
    problem: Problem, objective: Objective, modes: Sequence[End], starts: tuple[dict[str, float], ...]
) -> MapEstimate:
    best, status, history = modes[0]
    names, likelihood = problem.names, problem.likelihood
    data, _ = information(problem, best)
    solutions = best.here.simulator.solutions(best.theta)
    acting = np.diag(data) * problem.joint_prior.widths**2 > INFORMED
    conflict, _ = prior_conflict(problem, best)
    inverse, lost = inverse_hessian(data + problem.joint_prior.curvature(best.theta))
    parts = variance_parts(problem, best, inverse, objective.log_variance_factor)
    covariance = with_uncertain_noise(problem, best, inverse, parts).copy()
    shift = doubling_shift(problem, best, solutions, covariance)
    shift[lost] = np.nan
    curved = input_nonlinearity(problem, best, solutions, covariance)
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    covariance[lost, lost] = np.inf
    found, residuals = estimated_inputs(problem, best), best.here.compared()
    loadings = problem.likelihood.loadings or input_loadings(problem, best.theta, solutions, ROUGH)
    sampled = objective.density.with_settings(coordinates=RIDGE)
    joint = cache(partial(in_one_thread(joint_laplace), sampled, best))
    others = [joint_laplace(sampled, end.iterate) for end in modes[1:]]
    noise = dict(zip(problem.noise_names, best.noise.tolist(), strict=True))
    rms = {c: _pooled(problem, c, residuals) for c in problem.channels}
    return MapEstimate(
        status=STATUSES[OTHER_ORBIT] if best.here.other_orbits else status,
        theta=dict(zip(names, best.theta.tolist(), strict=True)),
        sd=_sd(problem, covariance),
        robust_sd=deferred(_robust_sd, problem, best, inverse, lost),
        variances={_short(name): noise[name] for name in likelihood.counts},
        noise=noise,
        noise_prior=problem.noise.prior_text,
        covariance=pd.DataFrame(covariance, index=list(names), columns=list(names)),
        joint_mode=deferred(lambda: joint().mode),
        joint_covariance=deferred(lambda: joint().covariance),
        degrees_of_freedom=dict(zip(names, degrees_of_freedom(inverse, parts).tolist(), strict=True)),
        independent={_short(name): count for name, count in likelihood.counts.items()},
        solutions=solutions,
        residuals=residuals,
        rms=rms,
        fvu=_fractions_left(problem, residuals),
        whiteness=channel_whiteness(problem, best),
        noise_split=noise_split(problem, found.residuals, objective.log_variance_factor),
        input_noise=caused_by_inputs(problem, loadings),
        inputs={e.name: problem.true_inputs(e) for e in problem.experiments},
        input_sd=found.sd,
        input_errors=problem.input_errors,
        input_nonlinearity=dict(zip(names, curved.tolist(), strict=True)),
        doubling_shift=dict(zip(names, shift.tolist(), strict=True)),
        other_orbits=best.here.other_orbits,
        at_ends=tuple(np.array(names)[acting & (at_ends(objective, best) != 0.0)].tolist()),
        prior_conflict=conflict,
        undetermined=undetermined(data, best.theta, names, problem.logarithmic, partial(_data_change, problem, best)),
        history=history,
        starts=starts,
        other_modes=weighed(problem, modes, [joint(), *others]) if others else (),
        fingerprint=fingerprint(problem),
        tied=_tied_slopes(problem, best.theta),
    )


def _data_change(problem: Problem, estimate: Iterate, theta: np.ndarray) -> float:
    """Return the norm of the residuals' change at another θ, in units of the noise; infinite without a solution."""
    there = estimate.here.moved(theta)
    if problem.model.autonomous:
        there = there.anchored()
    if not there.converged:
        return np.inf
    change = [there - here for there, here in zip(there.residuals, estimate.here.residuals, strict=True)]
    return float(np.linalg.norm(np.concatenate(problem.likelihood.whitened(change, estimate.noise))))


def _sd(problem: Problem, covariance: np.ndarray) -> dict[str, float]:
    with np.errstate(invalid="ignore"):
        return dict(zip(problem.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))


@in_one_thread
def _robust_sd(problem: Problem, estimate: Iterate, inverse: np.ndarray, lost: np.ndarray) -> dict[str, float]:
    robust = robust_covariance(problem, estimate, inverse)
    robust[lost, lost] = np.inf
    return _sd(problem, robust)


def estimation_warnings(problem: Problem, fit: MapEstimate) -> Iterator[str]:
    """Yield the warnings about an estimate."""
    for name, reason in fit.other_orbits.items():
        yield (
            f"Experiment {name!r} was fitted by another orbit than the recorded one: {reason}. The estimate is not "
            "valid. Give the experiment a guess of its states (Experiment.guess), start={…} nearer to the truth, or "
            "another model."
        )
    yield from _input_noise(problem, fit)
    for channel in fit.without_noise:
        yield (
            f"The data of {channel!r} contain no noise: the residual's rms of {fit.rms[channel]:.2g} is a rounding "
            "error, and standard deviations that follow from it mean nothing. Add noise to simulated data, or give its "
            f"variance, fixed={{'variance[{channel}]': …}}."
        )
    shifts = {name: shift for name, shift in fit.doubling_shift.items() if abs(shift) > LARGEST_SHIFT}
    shifts = {} if fit.without_noise else shifts
    if shifts:
        worst = max(shifts, key=lambda name: abs(shifts[name]))
        yield (
            f"Twice as many points would move {worst!r} by {shifts[worst]:.2g} of its standard deviation; take more "
            f"samples than {max(e.samples for e in problem.experiments)}, or a scheme of higher order."
        )
    for name in fit.at_ends:
        low, high = problem.joint_prior.supports[name]
        yield (
            f"The estimate of {name!r}, {fit.theta[name]:.6g}, lies at the end of its prior's support ({low:g}, "
            f"{high:g}); standard deviations do not describe the posterior there. Sample it, or widen the prior."
        )
    if fit.prior_conflict.text:
        yield (
            f"{fit.prior_conflict.text}. The estimate is a compromise that neither supports; its standard deviation "
            "does not show it. Check units, prior and data, try map_estimate(starts=8), or widen the prior."
        )
    yield from _unexplained(fit)
    if (not fit.converged or max(fit.fvu.values()) > MOST_UNEXPLAINED) and (text := unit_error(problem)):
        yield text
    if others := notable(fit.other_modes):
        yield (
            f"{len(others) + 1} separate optima fit the data: the estimate, with {fit.modes['mass'].iloc[0]:.0%} of "
            f"the posterior mass by Laplace, and {'; '.join(map(repr, others[:SHOWN]))}. Standard deviations describe "
            "the first one only. Sample the posterior, or give priors that exclude the others."
        )
    silent = [text for text in fit.undetermined if text.endswith(SILENT)]
    if silent:
        named = ", ".join(repr(text.removesuffix(f": {SILENT}")) for text in silent)
        yield f"The data do not depend on {named}; its posterior equals its prior. Fix it."
    yield from _combined(problem, [text for text in fit.undetermined if text not in silent])


def _input_noise(problem: Problem, fit: MapEstimate) -> Iterator[str]:
    """Yield the warnings about inputs that are taken as exact, and about errors of inputs that are too large."""
    rates = max(problem.model.input_derivatives().values(), default=0)
    for channel, noise in fit.input_noise.items() if problem.input_noise == EXACT else ():
        if noise > NOISE_SHARE * fit.rms[channel]:
            yield (
                f"The noise of the measured inputs{', differentiated,' if rates else ''} causes {noise:.3g} in "
                f"{channel!r}, {noise / fit.rms[channel]:.0%} of the residual's {fit.rms[channel]:.3g}, but the inputs "
                f"are taken as exact. Fold at least {FEWEST_CYCLES} cycles, and take input_noise='measured', or give "
                "the noise in input_noise={…}."
            )
    if curved := {n: own for n, own in fit.input_nonlinearity.items() if not own < LARGEST_NONLINEARITY}:
        worst = max(curved, key=lambda name: np.nan_to_num(curved[name], nan=np.inf))
        yield (
            "The errors of the inputs are too large to be linearised: what is not linear in them changes "
            f"{worst!r} by {curved[worst]:.2g} of its standard deviation. Average more cycles, or compare with "
            "input_noise='joint', in which they are parameters."
        )


def _combined(problem: Problem, found: Sequence[str]) -> Iterator[str]:
    """Yield the warnings about parameters that the data determine only together with others."""
    for text in found:
        if text.startswith(COMBINED):
            yield (
                f"The data do not determine {text}: near the estimate, a joint change of these leaves the outputs as "
                "they are to first order. Fix one of the parameters, or give priors that determine it."
            )
    directions = [text for text in found if not text.startswith(COMBINED)]
    if directions:
        more = len(directions) - SHOWN
        scaled = {part.partition(" → ")[0] for text in directions for part in text.split(", ") if "·t" in part}
        signed = [n for n, log in zip(problem.names, problem.logarithmic, strict=True) if n in scaled and not log]
        shown = "; or under ".join(directions[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
        yield (
            f"The data do not change under {shown}, for any t. In these directions the posterior equals the prior; fix "
            "one of the parameters, or report the combination that does not change."
            + f" {', '.join(signed)}: LogNormal priors, if the signs are known, make sampling easier."
            * bool(signed)
        )


def _unexplained(fit: MapEstimate) -> Iterator[str]:
    """Yield a warning about channels that the estimate does not explain, unless most of it is measured noise."""
    for channel, fraction in fit.fvu.items():
        split = fit.noise_split.get(channel)
        if fraction > MOST_UNEXPLAINED and not (split is not None and split.measurement > split.model):
            yield (
                f"The estimate leaves {fraction:.1%} of the variance of {channel!r} unexplained. If this is not noise, "
                "try other starts (starts=8) and check the units and the priors."
            )


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
    """Return the fraction of each channel's variance that is left in residuals."""
    measured = {e.name: {c: y - y.mean() for c, y in e.outputs.items()} for e in problem.experiments}
    power = {c: max(_pooled(problem, c, measured) ** 2, np.finfo(float).tiny) for c in problem.channels}
    return {c: _pooled(problem, c, residuals) ** 2 / whole for c, whole in power.items()}


def _pooled(problem: Problem, channel: str, signals: Mapping[str, Mapping[str, np.ndarray]]) -> float:
    """Return the root mean square of a channel over the measured points of all experiments."""
    values = [signals[e.name][channel][e.measured_points] for e in problem.experiments if channel in e.outputs]
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
    found = simultaneous_fit(problem, theta)
    if found is not None and found.blocked:
        where = "the other experiments' orbits are" if len(problem.experiments) > 1 else "it is an orbit"
        return (
            f"start: must be a point from which the orbits can be followed, got {values}; {found.blocked!r} cannot be "
            f"followed from its guess to parameters at which {where}. Leave it out if it may be no orbit, or give "
            "start={…} nearer to the truth."
        )
    near = _linearised(problem, theta, found)
    failed = ", ".join(f"{name!r} ({status})" for name, status in near.statuses.items() if status != "converged")
    ended = f"without the orbit of {failed}" if failed else "well, but the outputs or the noise are not finite"
    cures = "start={…}, or priors with other medians, at which problem.solve(theta) converges."
    if STATUSES[NOT_RESOLVED] in near.statuses.values():
        cures = "more samples, an odd number of them, or another scheme, such as Problem(scheme='backward2')."
    return (
        f"start: must have a finite log-posterior, got {values}, where the periodic solve ended {ended}. Give {cures} "
        f"{compared_with_data(problem, theta)} {unit_error(problem, theta)}"
    ).rstrip()
