"""Checks of an estimate that take time: noise model, prior, grid, noise of inputs, undetermined parameters."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._printing import written
from bayesperiodic.density.log_posterior import NATURAL, RIDGE_COORDINATES, Linearisation, LogPosterior
from bayesperiodic.density.orbit_check import MOST_UNEXPLAINED
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.estimation.adequacy import misfit_at
from bayesperiodic.estimation.conflict import prior_conflict
from bayesperiodic.estimation.covariance import (
    Uncertainty,
    caused_by_inputs,
    doubling_shift,
    estimated_inputs,
    input_loadings,
    input_nonlinearity,
    robust_covariance,
    uncertainty,
)
from bayesperiodic.estimation.gauss_newton import Iterate, Objective, at_ends, bias_correction
from bayesperiodic.estimation.laplace import IN_COMBINATION, SILENT, joint_laplace, sds, undetermined
from bayesperiodic.estimation.result import FitCheck, MapEstimate, NoiseSplit, Whiteness
from bayesperiodic.estimation.unexplained import Unexplained, testable, used
from bayesperiodic.estimation.units import unit_error
from bayesperiodic.likelihood.input_noise import EXACT, FEWEST_CYCLES, ROUGH
from bayesperiodic.periodic.isolation import MANY_CYCLES
from bayesperiodic.periodic.solution import equations_of, resolution_warning
from bayesperiodic.periodic.solve import is_one_of_many
from bayesperiodic.problem.fingerprint import check_results

# Part of a residual that noise of inputs taken as exact may cause, and changes [sds] by the grid and by what is not
# linear in the errors of the inputs, above which there is a warning.
LARGEST_INPUT_SHARE, LARGEST_SHIFT, LARGEST_NONLINEARITY = 0.1, 0.1, 0.3
# Standard deviations that twice as many points would move an estimate, from which on the grid may look like a misfit.
SHIFT_OF_MISFIT = 1.0
MOST_DIRECTIONS = 3


@in_one_thread
def check(problem: Problem, fit: MapEstimate) -> FitCheck:
    """Check an estimate: noise model, prior, grid, noise of the inputs, and what the data do not determine.

    `map_estimate` does this unless ``checks=False`` is given.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
        An estimate of this problem.

    Returns
    -------
    FitCheck

    Raises
    ------
    ValueError
        If the estimate is that of another problem, or its log-posterior is not finite.

    Warns
    -----
    UserWarning
        If the noise of the measured inputs causes more than a tenth of an output's residual, if twice as many points
        would move an estimate by more than a tenth of its standard deviation, if the trivial multiplier shows that the
        grid does not resolve an orbit of an autonomous model, if the prior and the data are in
        conflict, if more than half of a channel's variance is unexplained, and if the data do not determine a parameter
        or a combination of parameters.

    Examples
    --------
    >>> quick = bp.map_estimate(problem, checks=False, progress=False)
    >>> checks = bp.check(problem, quick)
    >>> abs(checks.doubling_shift["k"]) < 0.1, checks.prior_conflict.members
    (True, ())
    """
    _checks.instance("problem", problem, Problem)
    problem = check_results(problem, fit=fit)
    objective, peak = at_estimate(problem, fit)
    estimate = replace(peak, noise=np.array([fit.noise[name] for name in problem.noise_names]))
    uncertain = uncertainty(problem, estimate, objective.log_variance_factor)
    checks = checked(objective, estimate, uncertain, fit)
    for text in check_warnings(problem, replace(fit, checks=checks)):
        warnings.warn(text, UserWarning, stacklevel=3)
    return checks


def at_estimate(problem: Problem, fit: MapEstimate) -> tuple[Objective, Iterate]:
    """Return the objective and its iterate at the estimate, anchored at the estimate's solutions."""
    problem = check_results(problem, fit=fit)
    theta, noise = problem.vector(fit.theta), np.array([fit.noise[name] for name in problem.noise_names])
    guesses = {name: s.states for name, s in fit.solutions.items()}
    density = LogPosterior(problem, ResponseSolver.start(problem, theta, guesses), coordinates=NATURAL)
    here = Linearisation(theta, density.solver, density.comparisons)
    factor = bias_correction(problem, Iterate(theta, here, noise, np.nan)) if here.converged else 1.0
    objective = Objective(density, factor, of_total=True)
    peak = objective.iterate(here, noise)
    if peak is None:
        raise ValueError(
            f"fit: must have a finite log-posterior, got {written(fit.theta)}, where it is not. Give an estimate of "
            "this problem."
        )
    return objective, objective.anchored(peak)


def with_joint(problem: Problem, fit: MapEstimate) -> MapEstimate:
    """Return the estimate with its joint Laplace approximation, which is computed if there is none yet."""
    if fit.joint is not None:
        return fit
    objective, peak = at_estimate(problem, fit)
    sampled = objective.density.with_settings(coordinates=RIDGE_COORDINATES)
    return replace(fit, joint=joint_laplace(sampled, peak))


def checked(objective: Objective, estimate: Iterate, uncertain: Uncertainty, fit: MapEstimate) -> FitCheck:
    """Return the checks of an estimate."""
    import pandas as pd

    problem: Any = objective.density.problem
    solutions = fit.solutions
    names, lost, inverse, covariance = list(problem.names), uncertain.lost, uncertain.inverse, uncertain.covariance
    shift = doubling_shift(problem, estimate, solutions, covariance)
    shift[lost] = np.nan
    robust = robust_covariance(problem, estimate, inverse, at_ends(objective, estimate) != 0.0)
    robust[lost, lost] = np.inf
    robust_table = pd.DataFrame(robust, index=names, columns=names)
    conflict, alone = prior_conflict(problem, estimate)
    split = noise_split(problem, estimated_inputs(problem, estimate).residuals, objective.log_variance_factor)
    loadings = problem.likelihood.loadings
    if not (problem.noisy_inputs and loadings):
        loadings = input_loadings(problem, estimate.theta, solutions, ROUGH)
    curved = input_nonlinearity(problem, estimate, solutions, covariance)
    change = partial(_data_change, problem, estimate)
    return FitCheck(
        robust_sd=sds(robust_table),
        whiteness=channel_whiteness(problem, estimate),
        noise_split=split,
        input_noise=caused_by_inputs(problem, loadings),
        input_nonlinearity=dict(zip(names, curved.tolist(), strict=True)),
        doubling_shift=dict(zip(names, shift.tolist(), strict=True)),
        prior_conflict=conflict,
        undetermined=undetermined(uncertain.information, estimate.theta, names, problem.logarithmic, change),
        robust_covariance=robust_table,
        # The prior must not count as misfit of the model, which is tested where the data alone are fitted best.
        misfit=_of_grid(misfit_at(problem, alone if conflict.text else estimate, len(fit.starts)), names, shift),
    )


def _of_grid(misfit: str, names: Sequence[str], shift: np.ndarray) -> str:
    """Return a misfit in words, with a sentence on the error of the grid if this may be the cause of it."""
    largest = int(np.argmax(np.abs(np.nan_to_num(shift))))
    if not misfit or not abs(shift[largest]) > SHIFT_OF_MISFIT:
        return misfit
    return (
        f"{misfit}. The error of the grid may be the cause: twice as many points would move {names[largest]!r} by "
        f"{shift[largest]:.2g} of its standard deviation; first take more samples, or a scheme of higher order"
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


def noise_split(
    problem: Problem, residuals: Sequence[np.ndarray], log_variance_factor: float | np.ndarray
) -> dict[str, NoiseSplit]:
    """Return the split of every channel with compared time histories; the factor is 1 − p/n of eq. (7)."""
    sums = {channel: np.zeros(4) for channel in problem.channels}
    blocks = problem.likelihood.blocks
    factors = np.broadcast_to(log_variance_factor, len(blocks))
    for block, r, one in zip(blocks, residuals, factors, strict=True):
        if block.timed:
            square = block.weight * float(r @ r)
            sums[block.channel] += [block.count, block.count * one, square, block.count * block.measured]
    result = {}
    for channel, (count, left, square, measured) in sums.items():
        if count:
            total, measurement = square / left, measured / count
            result[channel] = NoiseSplit(*np.sqrt([measurement, max(total - measurement, 0.0), total]).tolist())
    return result


def channel_whiteness(problem: Problem, estimate: Iterate) -> dict[str, Whiteness]:
    """Return `MapEstimate.whiteness`; NaN where no experiment has two harmonics that the parameters leave."""
    likelihood = problem.likelihood
    white = (likelihood.whitened(part, estimate.noise) for part in (estimate.here.residuals, estimate.here.jacobian))
    tests: dict[str, list[Whiteness]] = {channel: [] for channel in problem.channels}
    for block, r, j in zip(likelihood.blocks, *white, strict=True):
        if block.spectral and testable(r, j):
            test = Unexplained(*used(block, r, j)).whiteness()
            tests[block.channel] += [test] if np.isfinite(test.p) else []
    return {
        channel: Whiteness(min(1.0, len(each) * min(t.p for t in each)), float(np.mean([t.lag1 for t in each])))
        if each
        else Whiteness(np.nan, np.nan)
        for channel, each in tests.items()
    }


def check_warnings(problem: Problem, fit: MapEstimate) -> Iterator[str]:
    """Yield the warnings about the checks of an estimate."""
    yield from _input_noise(problem, fit)
    for name, solution in fit.solutions.items():
        if text := resolution_warning(solution, f"The orbit of experiment {name!r}"):
            yield text
        elif solution.autonomous and solution.converged and solution.stable is None:
            equations, theta, _ = equations_of(problem.model, solution)
            if is_one_of_many(equations, theta, solution):
                yield f"The cycles of {solution.model!r} are not isolated: {MANY_CYCLES}"
    shifts = {name: shift for name, shift in fit.doubling_shift.items() if abs(shift) > LARGEST_SHIFT}
    shifts = {} if fit.without_noise else shifts
    if shifts:
        worst = max(shifts, key=lambda name: abs(shifts[name]))
        yield (
            f"Twice as many points would move {worst!r} by {shifts[worst]:.2g} of its standard deviation; take more "
            f"samples than {max(e.samples for e in problem.experiments)}, or a scheme of higher order."
        )
    if fit.prior_conflict.text:
        yield (
            f"{fit.prior_conflict.text}. The estimate is a compromise that neither supports; its standard deviation "
            "does not show it. Check units, prior and data, try map_estimate(starts=8), or widen the prior."
        )
    yield from _unexplained(fit)
    if (not fit.converged or max(fit.fvu.values(), default=0.0) > MOST_UNEXPLAINED) and (text := unit_error(problem)):
        yield text
    silent = [text for text in fit.undetermined if text.endswith(SILENT)]
    if silent:
        named = ", ".join(repr(text.removesuffix(f": {SILENT}")) for text in silent)
        yield f"The data do not depend on {named}; its posterior equals its prior. Fix it."
    yield from _combined(problem, [text for text in fit.undetermined if text not in silent])


def _input_noise(problem: Problem, fit: MapEstimate) -> Iterator[str]:
    """Yield the warnings about inputs that are taken as exact, and about errors of inputs that are too large."""
    rates = max(problem.model.input_derivatives().values(), default=0)
    for channel, noise in fit.input_noise.items() if problem.input_noise == EXACT else ():
        if noise > LARGEST_INPUT_SHARE * fit.rms[channel]:
            yield (
                f"The noise of the measured inputs{', differentiated,' if rates else ''} causes {noise:.3g} in "
                f"{channel!r}, {noise / fit.rms[channel]:.0%} of the residual's {fit.rms[channel]:.3g}, but the inputs "
                f"are taken as exact. Take input_noise='measured', which needs at least {FEWEST_CYCLES} cycles, or "
                "give the noise in input_noise={…}."
            )
    if curved := {n: size for n, size in fit.input_nonlinearity.items() if not size < LARGEST_NONLINEARITY}:
        worst = max(curved, key=lambda name: np.nan_to_num(curved[name], nan=np.inf))
        yield (
            "The errors of the inputs are too large to be linearised: what is not linear in them changes "
            f"{worst!r} by {curved[worst]:.2g} of its standard deviation. Average more cycles, or compare with "
            "input_noise='joint', in which they are parameters."
        )


def _combined(problem: Problem, texts: Sequence[str]) -> Iterator[str]:
    """Yield the warnings about parameters that the data determine only together with others."""
    for text in texts:
        if text.startswith(IN_COMBINATION):
            yield (
                f"The data do not determine {text}: near the estimate, a joint change of these leaves the outputs as "
                "they are to first order. Fix one of the parameters, or give priors that determine it."
            )
    directions = [text for text in texts if not text.startswith(IN_COMBINATION)]
    if directions:
        more = len(directions) - MOST_DIRECTIONS
        scaled = {part.partition(" -> ")[0] for text in directions for part in text.split(", ") if "·t" in part}
        signed = [n for n, log in zip(problem.names, problem.logarithmic, strict=True) if n in scaled and not log]
        shown = "; or under ".join(directions[:MOST_DIRECTIONS]) + (f"; and {more} more" if more > 0 else "")
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
