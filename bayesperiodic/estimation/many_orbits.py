"""estimate_orbits: an estimate from many orbits of a chaotic motion, taken in one after the other."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._printing import Printed, progress_bar
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.initial_orbits import experiments_guesses
from bayesperiodic.density.orbit_check import MOST_UNEXPLAINED
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.climbs import first_iterate
from bayesperiodic.estimation.map_estimate import end_from, map_estimate
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.section_points import SCALE
from bayesperiodic.orbits.polish import REAL
from bayesperiodic.periodic.solution import PeriodicSolution

if TYPE_CHECKING:
    import pandas as pd

# Fewest values of a channel of which the unexplained variance is judged.
FEWEST_JUDGED = 3


@dataclass(frozen=True, repr=False)
class OrbitsEstimate(Printed):
    """Estimate from those of many orbits that the model has near the measured ones.

    Attributes
    ----------
    problem : Problem
        With the experiments included, the first solve of each at its solution.
    fit : MapEstimate
        Of this problem.
    dropped : dict of str to str
        Experiments left out, and why.

    Examples
    --------
    >>> known = {name: value for name, value in pendulum_parameters.items() if name != "l"}
    >>> runs = [orbit.experiment(samples=1600, states={"phi": "angle"}) for orbit in pendulum_orbits[:2]]
    >>> given = bp.Problem(bp.models.pendulum, runs, priors={"l": bp.LogNormal(0.27, 0.3)}, fixed=known)
    >>> estimate = bp.estimate_orbits(given, progress=False)
    >>> len(estimate.problem.experiments), list(estimate.table.columns)
    (2, ['periods', 'multiplier', 'rms[angle]', 'rms[rate]', 'rms/sd'])
    """

    problem: Problem
    fit: MapEstimate
    dropped: dict[str, str]

    @property
    def table(self) -> "pd.DataFrame":
        """One row per orbit included: periods, largest multiplier by the model as text, rms of each residual.

        For orbits with a covariance also ``rms/sd``, the root mean square of their residuals in standard errors.
        """
        import pandas as pd

        rows = {}
        for one in self.problem.experiments:
            solution, residuals, values = self.fit.solutions[one.name], self.fit.residuals[one.name], _compared(one)
            large = complex(solution.multipliers[0])
            shown = f"{large.real:.5g}" if abs(large.imag) < REAL * abs(large) else f"{large:.4g}"
            rows[one.name] = {"periods": one.periods, "multiplier": shown} | {
                f"rms[{channel}]": float(np.sqrt(np.mean(r[values] ** 2))) for channel, r in residuals.items()
            }
            if one.covariance is not None:
                rows[one.name]["rms/sd"] = _in_standard_errors(one, residuals)
        return pd.DataFrame.from_dict(rows, orient="index")

    def __repr__(self) -> str:
        lines = [f"OrbitsEstimate from {len(self.problem.experiments)} orbits", self.table.to_string()]
        lines += [f"Dropped {name!r}: {reason}." for name, reason in self.dropped.items()]
        return "\n".join([*lines, repr(self.fit)])


@in_one_thread
def estimate_orbits(
    problem: Problem, *, start: Mapping[str, float] | None = None, progress: bool = True
) -> OrbitsEstimate:
    """Estimate parameters from many orbits, which are included one after the other.

    Where orbits have covariances, a first estimate has an unknown variance per channel in their place, and the second
    one starts from it. Errors that are strongly correlated, as those of waveforms, leave combinations of the values
    nearly without error, which would need accurate start values.

    Strongly unstable orbits exist only near the parameters at which they were measured: from a distant start, one of
    many turns into another orbit or is lost, and with it the estimate. With one orbit more at a time, each is solved at
    parameters that the others have determined. One with which the estimate does not converge, or with which an orbit
    turns into another one (then more than half of the variance of a channel may be unexplained), is dropped and tried
    once more at the end.

    Parameters
    ----------
    problem : Problem
        Its experiments are the orbits, the most reliable first: those of short periods and small multipliers, such as
        ``sorted(orbits, key=lambda orbit: (orbit.period, abs(orbit.eigenvalues[0])))``, from `Orbit.experiment`.
    start : mapping of str to float, optional
        Parameters; by default the priors' medians.
    progress : bool
        Show a progress bar.

    Returns
    -------
    OrbitsEstimate
        Sample the posterior of its ``problem``. Intervals of its ``fit`` are those of the robust standard deviations
        where the model is misspecified.

    Raises
    ------
    ValueError
        As `map_estimate`, and if no orbit can be included.

    Warns
    -----
    UserWarning
        As `map_estimate` for the final estimate.

    See Also
    --------
    map_estimate : Includes all experiments at once.

    Examples
    --------
    `pendulum_orbits` as in `polish_orbits`:

    >>> orbits = [orbit for orbit in pendulum_orbits if abs(orbit.eigenvalues[0]) < 50]
    >>> known = {name: value for name, value in pendulum_parameters.items() if name != "l"}
    >>> runs = [orbit.experiment(samples=1600, states={"phi": "angle"}) for orbit in orbits]
    >>> wide = bp.Problem(bp.models.pendulum, runs, priors={"l": bp.LogNormal(0.27, 0.3)}, fixed=known)
    >>> estimate = bp.estimate_orbits(wide, progress=False)
    >>> estimate.dropped, abs(estimate.fit.theta["l"] / pendulum_parameters["l"] - 1.0) < 0.01
    ({}, True)
    """
    _checks.instance("problem", problem, Problem)
    _checks.instance("progress", progress, bool)
    for name in start or {}:
        _checks.one_of("start", name, problem.names)
    loose = _without_covariances(problem)
    first = None if loose is None else _one_after_the_other(loose, start, progress)
    reached = None if first is None else _together(problem, first)
    if reached is None:
        reached = _one_after_the_other(problem, first.theta if first and first.included else start, progress)
    if not reached.included:
        reasons = "; ".join(f"{name!r}: {reason}" for name, reason in reached.dropped.items())
        raise ValueError(
            f"problem: must have an orbit that the model has near the start, got none: {reasons}. Give start={{…}} "
            "nearer to the truth."
        )
    used = problem.with_experiments(reached.included)
    assert reached.theta is not None
    fit = map_estimate(used, start=_of(used, reached.theta), progress=False)
    return OrbitsEstimate(used, fit, reached.dropped)


class _Fitted(NamedTuple):
    """Those attributes of a `MapEstimate` that are needed while orbits are included."""

    theta: Mapping[str, float]
    status: str
    other_orbits: Mapping[str, str]
    residuals: Mapping[str, Mapping[str, np.ndarray]]
    solutions: Mapping[str, PeriodicSolution]


class _Reached(NamedTuple):
    """Parameters by name, experiments that start at their solutions, and those left out, with the reason."""

    theta: Mapping[str, float] | None
    included: list[Experiment]
    dropped: dict[str, str]


def _without_covariances(problem: Problem) -> Problem | None:
    """Return the problem with one unknown variance a channel in place of covariances; None without or if it is none.

    Errors that are strongly correlated leave some combinations of the values nearly without error. From a distant start
    these rule the climb, which ends far from the optimum.
    """
    if all(one.covariance is None for one in problem.experiments):
        return None
    runs = [
        one if one.covariance is None else replace(one.without_multipliers(), covariance=None)
        for one in problem.experiments
    ]
    known = {name: v for name, v in problem.settings["fixed"].items() if name.partition("[")[0] != SCALE}
    try:
        return problem.replace(experiments=runs, fixed=known)
    except ValueError:  # too few values for the variances
        return None


def _together(problem: Problem, first: _Reached) -> _Reached | None:
    """Return the estimate from all experiments of a first one, now with their covariances; None if there is none."""
    given = {one.name: one for one in problem.experiments}
    runs = [replace(given[one.name], guess=one.guess) for one in first.included]
    fit = _with_more(problem, runs, first.theta) if runs else ""
    return None if isinstance(fit, str) else _Reached(fit.theta, _at_solutions(runs, fit), first.dropped)


def _one_after_the_other(problem: Problem, theta: Mapping[str, float] | None, progress: bool) -> _Reached:
    """Return the estimate from the experiments that are included one after the other."""
    included: list[Experiment] = []
    dropped: dict[str, str] = {}
    waiting, again, fewest = list(problem.experiments), [], _fewest(problem)
    with progress_bar(total=len(waiting), desc="orbits", disable=not progress) as bar:
        for last in (False, True):
            while waiting:
                # The first ones determine the parameters and the noise only together.
                more = waiting[: 1 if included else fewest]
                fit = _with_more(problem, [*included, *more], theta)
                if isinstance(fit, str):
                    dropped[more[0].name] = fit
                    again.append(waiting.pop(0))
                    bar.update(last)
                    continue
                theta, included = fit.theta, _at_solutions([*included, *more], fit)
                for one in more:
                    dropped.pop(one.name, None)
                    waiting.remove(one)
                    bar.update()
            waiting, again = again, []
    return _Reached(theta, included, dropped)


def _fewest(problem: Problem) -> int:
    """Return how many of the first experiments are a problem, with enough values for its parameters."""
    for count in range(1, len(problem.experiments)):
        try:
            problem.with_experiments(problem.experiments[:count])
        except ValueError:
            continue
        return count
    return len(problem.experiments)


def _with_more(problem: Problem, experiments: list[Experiment], theta: Mapping[str, float] | None) -> _Fitted | str:
    """Return the estimate from these experiments, or why there is none with the last ones."""
    try:
        used = problem.with_experiments(experiments)
    except ValueError as error:
        return str(error)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        fit = _fitted(used, theta)
    if fit is None:
        return "the model has no such orbit near the estimate from the others"
    if fit.other_orbits:
        name, reason = next(iter(fit.other_orbits.items()))
        return f"{name!r} turns into another orbit ({reason})"
    if fit.status != "converged":
        return f"the estimate with it ends {fit.status!r}"
    for one in experiments:
        if (share := _unexplained(one, fit.residuals[one.name])) > MOST_UNEXPLAINED:
            return f"{one.name!r} turns into another orbit, which leaves {share:.0%} of the measured one unexplained"
    return fit


def _fitted(problem: Problem, theta: Mapping[str, float] | None) -> _Fitted | None:
    """Return the estimate from parameters near it, without other optima, or from the priors; None without orbits."""
    start = problem.vector(_of(problem, theta or {}))
    problem = _with_guesses(problem, start)
    if theta is not None:
        end = end_from(problem, start)
        if end is None:
            return None
        here, values = end.iterate.here, dict(zip(problem.names, end.iterate.theta.tolist(), strict=True))
        solutions = here.solver.solutions(end.iterate.theta, sensitivities=False)
        return _Fitted(values, end.status, here.other_orbits, here.compared(), solutions)
    if first_iterate(problem, start) is None:
        return None
    fit = map_estimate(problem, checks=False, progress=False)
    return _Fitted(fit.theta, fit.status, fit.other_orbits, fit.residuals, fit.solutions)


def _compared(experiment: Experiment) -> np.ndarray:
    """Return at which points of the grid outputs are compared, (samples·periods,)."""
    points = experiment.samples * experiment.periods
    return np.ones(points, dtype=bool) if experiment.mask is None else experiment.mask


def _in_standard_errors(experiment: Experiment, residuals: Mapping[str, np.ndarray]) -> float:
    """Return the root mean square of the residuals, whitened by the covariance."""
    values = np.stack([residuals[name][_compared(experiment)] for name in experiment.outputs], axis=-1).ravel()
    covariance = np.asarray(experiment.covariance)[: values.size, : values.size]
    return float(np.sqrt(values @ np.linalg.solve(covariance, values) / values.size))


def _unexplained(experiment: Experiment, residuals: Mapping[str, np.ndarray]) -> float:
    """Return the largest fraction of the variance of an output over the orbit that is not explained."""
    values = _compared(experiment)
    shares = [0.0]
    for name, residual in residuals.items():
        seen = experiment.outputs[name][values]
        if seen.size >= FEWEST_JUDGED and np.ptp(seen) > 0.0 and not experiment.winding:
            shares.append(float(np.mean(residual[values] ** 2) / np.var(seen)))
    return max(shares)


def _of(problem: Problem, theta: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of a problem, at the priors' medians where they are not known yet."""
    return {**dict(zip(problem.names, problem.median().tolist(), strict=True)), **theta}


def _with_guesses(problem: Problem, theta: np.ndarray) -> Problem:
    """Return the problem with the guesses that follow from the data at θ (names,), which cost more than the solves."""
    if not np.isfinite(problem.joint_prior.log_prob(theta)):
        return problem
    guesses = experiments_guesses(problem, theta)
    return problem.with_experiments([replace(one, guess=guesses[one.name]) for one in problem.experiments])


def _at_solutions(experiments: list[Experiment], fit: _Fitted) -> list[Experiment]:
    """Return experiments whose first solve starts from their solutions."""
    return [replace(one, guess=dict(fit.solutions[one.name].states)) for one in experiments]
