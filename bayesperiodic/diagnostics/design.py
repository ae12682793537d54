"""Fisher information of the data in prior units, and the expected gain of further experiments."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtr

from bayesperiodic import _checks
from bayesperiodic._linalg import hessian_eigh
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.problem.arguments import refuse_special_points

if TYPE_CHECKING:
    import pandas as pd

ONE_SD = float(ndtr(1.0))
SMALLEST_EIGENVALUE, NEGLIGIBLE_COMPONENT = 1e-12, 1e-3


@dataclass(frozen=True)
class Information:
    """The Fisher information matrix of the data at an estimate theta.

    Coordinates are the logarithms of positive parameters (`logarithmic`) and the values of signed ones; `prior_sd` is
    half the central 68 % interval of each prior in these coordinates.
    """

    names: tuple[str, ...]
    theta: np.ndarray
    logarithmic: np.ndarray
    matrix: np.ndarray
    prior_sd: np.ndarray

    @classmethod
    def of(cls, problem: Problem, fit: MapEstimate) -> Information:
        """Compute the information at an estimate with known noise parameters."""
        theta, logs = problem.vector({name: fit.theta[name] for name in problem.names}), problem.logarithmic
        guesses = {e.name: fit.solutions[e.name].states for e in problem.experiments}
        here = problem.anchored(theta, guesses).density().linearise(theta)
        noise = problem.noise_values({name: fit.noise[name] for name in problem.noise_names})
        jacobian = problem.likelihood.whitened(here.jacobian, noise)
        slopes = np.where(logs, theta, 1.0)
        design = np.concatenate(jacobian, axis=1) * slopes[:, None]
        ends = [
            marginal.quantile(np.array([1.0 - ONE_SD, ONE_SD])) for marginal in problem.joint_prior.marginals.values()
        ]
        widths = [np.log(high / low) if log else high - low for (low, high), log in zip(ends, logs, strict=True)]
        return cls(problem.names, theta, logs, design @ design.T, 0.5 * np.array(widths))

    @cached_property
    def _relative(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues, ascending, and eigenvectors of the information per unit of the prior's precision."""
        values, vectors, _ = hessian_eigh(self.matrix, self.prior_sd)
        return np.maximum(values, 0.0), vectors

    @property
    def gains(self) -> np.ndarray:
        """Information of the data over that of the prior along each direction, ascending."""
        return self._relative[0]

    @property
    def directions(self) -> np.ndarray:
        """The directions, in columns (names, directions), in the coordinates."""
        return self._relative[1] * self.prior_sd[:, None]

    @cached_property
    def spectrum(self) -> np.ndarray:
        """Eigenvalues of the information, descending, in units of the logarithm or of the prior sd if signed."""
        values = hessian_eigh(self.matrix, np.where(self.logarithmic, 1.0, self.prior_sd))[0][::-1]
        return np.where(values > SMALLEST_EIGENVALUE * values[0], values, 0.0)

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest of these."""
        return float(self.spectrum[0] / self.spectrum[-1]) if self.spectrum[-1] > 0.0 else np.inf

    @property
    def alone(self) -> np.ndarray:
        """Standard deviation left by the data alone if all other parameters are known, in prior sds."""
        with np.errstate(divide="ignore"):
            return 1.0 / (np.sqrt(np.diag(self.matrix)) * self.prior_sd)

    @property
    def together(self) -> np.ndarray:
        """The same if the others are unknown; infinite if a direction without information changes the parameter.

        A change below 0.1 % of the prior sd along a unit direction does not count.
        """
        values, vectors = self._relative
        informed = values > SMALLEST_EIGENVALUE * max(values[-1], np.finfo(float).tiny)
        variance = np.sum(vectors[:, informed] ** 2 / values[informed], axis=1)
        unseen = np.any(np.abs(vectors[:, ~informed]) > NEGLIGIBLE_COMPONENT, axis=1)
        return np.where(unseen, np.inf, np.sqrt(variance))

    @property
    def collinearity(self) -> np.ndarray:
        """Factor by which the unknown others increase each standard deviation; 1 without collinearity."""
        with np.errstate(invalid="ignore"):
            return self.together / self.alone

    def coordinates(self, values: np.ndarray) -> np.ndarray:
        """Return the coordinates of values (draws, names)."""
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)


FREQUENCY_FACTORS = (0.5, 1.0, 2.0)
MOST_RUNS = 5


class FurtherExperiment(NamedTuple):
    """A possible experiment: the inputs of a run with scaled variation at another frequency [Hz]."""

    run: str
    frequency: float
    scale: float


def default_candidates(problem: Problem) -> list[FurtherExperiment]:
    """Return half, once and twice the frequency and the amplitude of runs spread over the frequencies.

    These are all runs if some parameters are local; none for a free-running model, which has no drive to change.
    """
    if problem.model.autonomous or all(e.condition is not None for e in problem.experiments):
        return []
    runs = sorted((e for e in problem.experiments if e.condition is None), key=lambda e: e.frequency)
    most = len(runs) if any("[" in name for name in problem.names) else MOST_RUNS
    chosen = [runs[i] for i in sorted({round(k) for k in np.linspace(0, len(runs) - 1, most)})]
    scales = FREQUENCY_FACTORS if problem.model.inputs else (1.0,)
    return [FurtherExperiment(e.name, f * e.frequency, s) for e in chosen for f in FREQUENCY_FACTORS for s in scales]


def rank_candidates(
    problem: Problem, fit: MapEstimate, information: Information, candidates: Iterable[FurtherExperiment]
) -> pd.DataFrame:
    """Return the expected gain [nats] of each candidate and the ratio of each sd after it to the present one.

    A candidate is compared as its run is, within the same harmonics, with the same noise and as many independent
    values, so that a repeated run adds its present information; the orbit is the one found from that of the run as the
    initial guess. Candidates without an orbit have NaN. Columns: run, frequency, scale, gain and one per parameter; the
    most informative first.
    """
    import pandas as pd

    runs, unit = {e.name: e for e in problem.experiments}, np.outer(information.prior_sd, information.prior_sd)
    before = information.matrix * unit + np.eye(len(unit))
    now, rows = np.sqrt(np.diag(np.linalg.inv(before))), []
    for candidate in candidates:
        _checks.one_of("candidates", candidate.run, runs)
        refuse_special_points([runs[candidate.run]], "further experiments")
        after = before + _added(problem, fit, runs[candidate.run], candidate) * unit
        row: dict[str, object] = {**candidate._asdict(), "gain": np.nan}
        if np.isfinite(after).all():
            row["gain"] = 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1])
            row |= zip(problem.names, np.sqrt(np.diag(np.linalg.inv(after))) / now, strict=True)
        rows.append(row)
    table = pd.DataFrame(rows, columns=[*FurtherExperiment._fields, "gain", *problem.names])
    return table.sort_values("gain", ascending=False, na_position="last", ignore_index=True)


def _added(problem: Problem, fit: MapEstimate, run: Experiment, candidate: FurtherExperiment) -> np.ndarray:
    """Return the information of a candidate in the coordinates of `Information`; NaN without an orbit."""
    inputs = {name: u.mean() + candidate.scale * (u - u.mean()) for name, u in problem.true_inputs(run).items()}
    planned = problem.planned(replace(run, frequency=candidate.frequency, inputs=inputs), fit.noise)
    with warnings.catch_warnings():
        # The estimate has already warned about a coarse grid.
        warnings.simplefilter("ignore", UserWarning)
        added = Information.of(planned, fit).matrix
    result, acting = np.zeros((len(problem.names),) * 2), [problem.names.index(name) for name in planned.names]
    result[np.ix_(acting, acting)] = added
    return result
