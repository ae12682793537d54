"""Which further experiment would tell most: the information of candidates, from the sensitivities at the estimate."""

import warnings
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pandas as pd

from bayesperiodic import checks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.diagnosis.information import Information
from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.problem import Problem
from bayesperiodic.periodic.solve import solve_periodic

FACTORS = (0.5, 1.0, 2.0)
MOST_RUNS = 5


class Candidate(NamedTuple):
    """An experiment that might be done: a run's inputs, their variation scaled, at another frequency [Hz]."""

    run: str
    frequency: float
    scale: float


def default_candidates(problem: Problem) -> list[Candidate]:
    """Return half, the same and twice the frequency and the amplitude of a few runs, those least alike in frequency.

    Of all runs if some parameters are local to them.
    """
    runs = sorted(problem.experiments, key=lambda e: e.frequency)
    most = len(runs) if any("[" in name for name in problem.names) else MOST_RUNS
    chosen = [runs[i] for i in sorted({round(k) for k in np.linspace(0, len(runs) - 1, most)})]
    scales = FACTORS if problem.model.inputs else (1.0,)
    return [Candidate(e.name, f * e.frequency, s) for e in chosen for f in FACTORS for s in scales]


def rank_candidates(
    problem: Problem, fit: MapEstimate, information: Information, candidates: Iterable[Candidate]
) -> pd.DataFrame:
    """Return what each candidate would add: nats of information in all, and each parameter's sd over today's.

    The noise is taken as white with today's variances, the number of independent values as that of the run, and the
    orbit as the one that follows from the run's; a candidate whose orbit cannot be found has NaN.

    Returns
    -------
    DataFrame
        Columns run, frequency, scale, gain and one a parameter; most informative first.
    """
    runs = {e.name: e for e in problem.experiments}
    scale = information.prior_sd
    before = information.matrix * np.outer(scale, scale) + np.eye(scale.size)
    now, rows = np.sqrt(np.diag(np.linalg.inv(before))), []
    for candidate in candidates:
        checks.one_of("candidates", candidate.run, runs)
        added = _added(problem, fit, information, runs[candidate.run], candidate)
        after = before + added * np.outer(scale, scale)
        row: dict[str, object] = {**candidate._asdict(), "gain": np.nan}
        if np.isfinite(after).all():
            row["gain"] = 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1])
            row |= dict(zip(problem.names, np.sqrt(np.diag(np.linalg.inv(after))) / now, strict=True))
        rows.append(row)
    table = pd.DataFrame(rows, columns=[*Candidate._fields, "gain", *problem.names])
    return table.sort_values("gain", ascending=False, na_position="last", ignore_index=True)


def _added(
    problem: Problem, fit: MapEstimate, information: Information, run: Experiment, candidate: Candidate
) -> np.ndarray:
    """Return the information of a candidate in the coordinates of `information`; NaN where it has no orbit."""
    theta = problem.vector(fit.theta)
    parameter_map = problem.parameter_maps[run.name]
    values = parameter_map.values(theta[None])[0]
    inputs = {name: u.mean() + candidate.scale * (u - u.mean()) for name, u in run.inputs.items()}
    with warnings.catch_warnings():
        # The grid is the run's, and how fine it is has been said of the run.
        warnings.simplefilter("ignore", UserWarning)
        solution = solve_periodic(
            problem.model,
            dict(zip(problem.model.parameters, values.tolist(), strict=False)),
            inputs,
            frequency=candidate.frequency,
            samples=run.samples,
            scheme=problem.scheme,
            periods=run.periods,
            winding=run.winding,
            guess=fit.solutions[run.name].states,
        )
    if not solution.converged:
        return np.full((theta.size, theta.size), np.nan)
    slopes = parameter_map.slopes(theta)[:-1] * np.where(information.logarithmic, information.theta, 1.0)
    noise = np.array([[fit.noise[name] for name in problem.noise_names]])
    variances = problem.likelihood.value_variances(noise)
    total = np.zeros((theta.size, theta.size))
    for channel in run.outputs:
        if (run.name, channel) in variances:
            by_parameter = np.stack([solution.sensitivities[channel][n] for n in problem.model.parameters])
            changes = slopes.T @ by_parameter
            weight = run.independent[channel] / changes.shape[1] / float(variances[run.name, channel][0])
            total += weight * changes @ changes.T
    return total
