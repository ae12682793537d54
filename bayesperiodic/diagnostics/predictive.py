"""Posterior predictions of periods and transients, and tests of the model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._verdicts import GOOD, with_tone
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.recording import Recording
from bayesperiodic.density.log_posterior import NATURAL
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.model_error import MODEL_ERROR, UP_TO, in_words, model_errors, with_model_error
from bayesperiodic.estimation.adequacy import (
    ADEQUACY_LEVEL,
    ALL,
    MISSPECIFIED,
    SEARCH,
    UNSOUND,
    UNTESTED,
    adequacy,
    concerns_noise,
    faulty,
    rejections,
)
from bayesperiodic.estimation.conflict import prior_conflict
from bayesperiodic.estimation.gauss_newton import Objective, bias_correction
from bayesperiodic.periodic import arclength
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.problem.parameters import CHAIN, DRAW
from bayesperiodic.sampling.draws import Posterior, refuse_robust

if TYPE_CHECKING:
    import pandas as pd

PROBABILITY = 0.9
# Of the median and of the ends of the central band.
BAND_QUANTILES = (0.5, 0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY)
NOISE_LEVELS = 21


@dataclass(frozen=True)
class Bands(Result):
    """Predictive bands of the mean period by experiment and channel, see `Prediction`."""

    median: dict[str, dict[str, np.ndarray]]
    low: dict[str, dict[str, np.ndarray]]
    high: dict[str, dict[str, np.ndarray]]
    probability: float
    draws: int
    failed: int


def bands(
    problem: Problem,
    outputs: dict[str, dict[str, np.ndarray]],
    converged: np.ndarray,
    variances: dict[tuple[str, str], np.ndarray],
) -> Bands:
    """Return the bands of outputs (draws, points) and residual variances (draws,) at the draws that converged."""
    count = converged.size
    scores = ndtri((np.arange(NOISE_LEVELS) + 0.5) / NOISE_LEVELS)
    limits: list[dict[str, dict[str, np.ndarray]]] = [{e.name: {} for e in problem.experiments} for _ in BAND_QUANTILES]
    for e in problem.experiments:
        for channel in e.outputs:
            variance = variances.get((e.name, channel), np.zeros(count))
            expected = e.project(channel, outputs[e.name][channel])
            noise = np.sqrt(variance)[:, None, None] * scores[:, None]
            values = (expected[:, None] + noise)[converged].reshape(-1, expected.shape[1])
            levels = np.median(expected[converged], axis=0), *np.quantile(values, BAND_QUANTILES[1:], axis=0)
            for band, level in zip(limits, levels, strict=True):
                band[e.name][channel] = level
    median, low, high = limits
    return Bands(median, low, high, PROBABILITY, count, int(count - converged.sum()))


def draws_of(
    problem: Problem, posterior: Posterior, places: slice | np.ndarray | list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return some draws of θ (draws, names) and of all noise parameters (draws, noise_names)."""
    every = (*problem.names, *problem.free_noise)
    values = np.stack([posterior.draws(name)[places] for name in every], axis=-1)
    theta, free = np.split(values, [len(problem.names)], axis=1)
    return np.ascontiguousarray(theta), problem.likelihood.complete(free)


Run = Callable[[dict[str, float]], Recording]


@dataclass(frozen=True)
class Transient(Result):
    """Predictive bands of a transient recording, over time (samples,) [s].

    By output, the pointwise median (samples,) and the central 90 % band of the signals for the uncertainty of the
    parameters alone, without measurement noise unless `run` adds it. There is one run per draw; failed ones are
    excluded, and counted by reason.
    """

    time: np.ndarray
    median: dict[str, np.ndarray]
    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]
    probability: float
    draws: int
    failures: dict[str, int]

    @property
    def failed(self) -> int:
        """Number of failed runs."""
        return sum(self.failures.values())

    def __repr__(self) -> str:
        reasons = "".join(f"\n  {count} times: {reason}" for reason, count in self.failures.items())
        return (
            f"Transient of {', '.join(self.median)} over {self.time[0]:g} to {self.time[-1]:g} s: "
            f"{self.probability:.0%} band of the signal without measurement noise from {self.draws} runs, "
            f"{self.failed} failed{reasons}"
        )


def _transient(problem: Problem, theta: np.ndarray, run: Run, experiment: str | None) -> Transient:
    """Return the bands of the recordings that `run` returns at draws θ (draws, names)."""
    time, signals, failures = np.empty(0), dict[str, list[np.ndarray]](), Counter[str]()
    for row in problem.parameters(theta, _experiment_of(problem, experiment)):
        try:
            recording = run(dict(zip(problem.sensors.plain_model.parameters, row.tolist(), strict=False)))
        # Raised by integrators that fail, and by recordings of values that are not finite.
        except (RuntimeError, ArithmeticError, ValueError) as error:
            failures[f"{type(error).__name__}: {error}"] += 1
            last = error
            continue
        if not isinstance(recording, Recording):
            raise ValueError(f"run: must return a Recording, got a {type(recording).__name__}.")
        if not signals:
            time, signals = recording.time, {output: [] for output in recording.outputs}
        _checks.same_names("run: outputs of the recordings", recording.outputs, signals)
        other = recording.time
        if other.size != time.size or not np.allclose(other, time, rtol=1e-9, atol=0.0):
            raise ValueError(
                f"run: all recordings must have the same times, got {time.size} and {other.size} samples, from "
                f"{time[0]:g} to {time[-1]:g} s and from {other[0]:g} to {other[-1]:g} s."
            )
        for output, values in recording.outputs.items():
            signals[output].append(values)
    if not signals:
        raise RuntimeError(f"run: failed at all {len(theta)} draws, last with: {last}") from last
    levels = {output: np.quantile(values, BAND_QUANTILES, axis=0) for output, values in signals.items()}
    median, low, high = ({output: quantiles[i] for output, quantiles in levels.items()} for i in range(3))
    return Transient(time, median, low, high, PROBABILITY, len(theta), dict(failures))


def _experiment_of(problem: Problem, experiment: str | None) -> str:
    """Return the experiment whose parameters the runs use; raise a ValueError if it is ambiguous."""
    names = [e.name for e in problem.experiments]
    if experiment is not None:
        _checks.one_of("experiment", experiment, names)
        return experiment
    for parameter in problem.model.parameters:
        maps = problem.parameter_maps.values()
        if len({(m.columns.get(parameter), m.fixed.get(parameter)) for m in maps}) > 1:
            raise ValueError(
                f"experiment: must be one of {', '.join(map(repr, names))} with `run`, got None. The experiments "
                f"differ in {parameter!r}."
            )
    return names[0]


# What the verdicts that are neither for nor against the model mean.
# In place of "misspecified" where the error of the model is shown to be smaller than the user tolerates.
TOLERATED = with_tone("adequate within tolerance", GOOD)
SENTENCES = {
    TOLERATED: "Up to the harmonic stated, the error of the model is below the tolerance, whatever other tests find.",
    UNTESTED: "There are too few values to test the model.",
    UNSOUND: "No test contradicts the model, but a recording is not sound (see the findings of its experiment), and "
    "its faults count as noise in these tests.",
}


@dataclass(frozen=True)
class Prediction(Bands):
    """Posterior prediction of the mean period of each experiment, and tests of the model.

    The verdict concerns the model, not the identifiability of its parameters: undetermined parameters can fit the data
    ("adequate"), and precisely determined ones can belong to a wrong model ("misspecified").

    Attributes
    ----------
    median, low, high : dict of str to dict of str to array (points,)
        By experiment and channel, in the unit of the channel: median and central 90 % band of the mean period within
        the kept harmonics, including the residual variance, assumed normal at each point. Section values with a
        covariance of their own have the band of the model alone.
    probability : float
        Of the band.
    draws, failed : int
        Number of draws, and of those without a periodic solution.
    table : DataFrame
        One row per experiment and channel, and the row "all". p-values, NaN if a test is not possible: ``whiteness``
        and ``harmonics`` of the residual along the period, in units of the noise; ``size``, the residual variance
        against the measured scatter of the cycles (assumed exact for one cycle) or a given variance; ``amplitude``, the
        rms of the period against replicates; ``consistency`` (row "all"), common parameters against separate ones for
        each experiment and channel. The noise of the inputs, where it is integrated out, is part of that noise.
        ``harmonic``: the one with the largest residual power in units of the noise (the index of the cosine wave for
        masked data). ``model_error_share``: the fraction of the residual variance beyond that of ``size``, NaN if
        unknown. ``spectrum``: "measured" if whiteness and harmonics are tested in units of the noise that was measured
        between the harmonics, "assumed" if in those of the noise model. ``p``: the smallest of the row, adjusted by
        Holm's method for all tests of the table; ``verdict``: "misspecified" if it is below 1 %, "adequate", "not
        tested", or "recording not sound" in place of "adequate" where ``Experiment.findings`` has more than harmless
        ones, which count as noise. ``model_error``, ``model_error_low`` and ``model_error_high``: the rms error of the
        model with the parameters that fit all experiments best, relative to the rms of the measured period about its
        mean, and the ends of its 90 % interval. It contains all harmonics up to ``model_error_up_to``: those that the
        experiment keeps, and those that its recording resolves beyond (``Experiment.left_out``). Where the noise is
        unknown there is only the upper end, as if all of the residual were error of the model; in the row "all" the
        largest. With a ``tolerance``, "adequate within tolerance" is the verdict in place of "misspecified" and "not
        tested" where the upper end is below it, if there is neither another orbit nor a conflict of the prior.
    tolerance : float, optional
        That of `predict`.
    transient : Transient or None
        Bands of the recordings of `run`.
    prior_conflict : str
        Conflict of the prior with the data, in words, "" if there is none. If there is one, the model is tested where
        the data alone are fitted best, and the amplitude is not tested.
    note : str
        Limitations: misfit that the noise model absorbs, draws that have not converged; and that the covariance of the
        residual includes the noise of the inputs, where it does.
    other_orbits : dict of str to str
        Experiments in which the model's orbit is not the measured one, with the reason, see `MapEstimate`; their
        verdict is "misspecified", whatever the tests say.

    Examples
    --------
    >>> found = bp.predict(problem, posterior, draws=50)
    >>> found.verdict, found.failed, found.median["synthetic duffing"]["displacement"].shape
    ('adequate', 0, (32,))
    """

    table: pd.DataFrame
    transient: Transient | None
    note: str
    other_orbits: dict[str, str]
    prior_conflict: str
    tolerance: float | None = None

    @property
    def model_errors(self) -> dict[str, str]:
        """Error of the model in words, and how it compares with the tolerance, by row of the table."""
        if MODEL_ERROR[0] not in self.table:
            return {}
        table = self.table.assign(**{UP_TO: self.table.get(UP_TO, np.nan)})
        rows = table.loc[table[MODEL_ERROR[2]].notna(), [*MODEL_ERROR, UP_TO]].drop(ALL, errors="ignore")
        return {str(label): in_words(row[:-1], row[-1], self.tolerance) for label, *row in rows.itertuples()}

    @property
    def verdict(self) -> str:
        """Verdict on the model as a whole."""
        return str(self.table.loc[ALL, "verdict"])

    @property
    def findings(self) -> dict[str, str]:
        """Rejections in words, by row of the table; other orbits by experiment; the conflict of prior and data."""
        texts = {f"experiment {name}": reason for name, reason in self.other_orbits.items()}
        return texts | rejections(self.table) | ({"prior conflict": self.prior_conflict} if self.prior_conflict else {})

    @property
    def concerns_noise(self) -> bool:
        """Whether a wrong noise model would explain the rejections as well as a wrong model."""
        return concerns_noise(self.table)

    @property
    def remedy(self) -> str:
        """What finds the error of a misspecified model; "" where noise model, prior or orbit may be what is wrong."""
        elsewhere = self.concerns_noise or self.other_orbits or self.prior_conflict
        return "" if self.verdict != MISSPECIFIED or elsewhere else f"{SEARCH}."

    def __repr__(self) -> str:
        subject = "model or the noise model" if self.concerns_noise else "model"
        verdict = f"The {subject} is {self.verdict} (overall false alarm rate {ADEQUACY_LEVEL:.0%})."
        shown = {} if self.tolerance is None and self.verdict != MISSPECIFIED else self.model_errors
        tests = self.table.drop(columns=[*MODEL_ERROR, UP_TO], errors="ignore")
        lines = [
            f"Tests of the model from {self.draws} draws, {self.failed} without a periodic solution",
            tests.to_string(float_format="{:.2g}".format, na_rep="-"),
            SENTENCES.get(self.verdict, verdict),
            *(f"{label}: {text}." for label, text in self.findings.items()),
            *(f"{label}: {text}." for label, text in shown.items()),
            self.remedy,
            self.note,
            repr(self.transient) if self.transient else "",
        ]
        return "\n".join(filter(None, lines))


@in_one_thread
def predict(
    problem: Problem,
    posterior: Posterior,
    *,
    draws: int = 200,
    run: Run | None = None,
    experiment: str | None = None,
    tolerance: float | None = None,
) -> Prediction:
    """Predict the mean period of every experiment, and test the model against the measured one.

    The tests use the residual at the draw with the highest density, projected orthogonally to its changes under the
    parameters of that experiment and channel, so that their null distributions are known. They are exact for models
    linear in the parameters, for any prior, and independent of the identifiability of the parameters. The amplitude is
    compared with replicates whose parameters were fitted to the data (Gelman, Meng, Stern, Statistica Sinica 6 (1996)
    733-807): its p is conservative (Meng, Annals of Statistics 22 (1994) 1142-1160).

    Whiteness and harmonics are tested against the spectrum of the noise that `Recording.fold` measured between the
    harmonics, under every noise model, so that slow noise, 1/f noise and hum are no misfit. Other experiments are
    tested against the spectrum that the noise model assumes; a rejection may then mean a wrong noise model.
    Quantisation errors that repeat in every cycle are part of that spectrum (see `Recording.fold`); other errors that
    repeat in every cycle, as those of a sensor that is not linear, are taken for model errors. What the noise of inputs
    causes (``Problem(input_noise=…)``) is part of the covariance in all tests.

    The noise model determines which misfit is detectable. With unknown variance, misfit of any size is taken as noise,
    and only its shape along the period or the scatter of the measured cycles reveals it; circulant noise also absorbs
    correlated misfit. A conflict of the prior with the data is reported by itself, not as a misfit of the model.

    Parameters
    ----------
    problem : Problem
    posterior : Posterior
    draws : int
        Equally spaced posterior draws, at least 20.
    run : callable, optional
        Returns the recording of a transient for a mapping of all parameters of the model, such as
        ``lambda p: bp.simulate(model, p, inputs, frequency=1.0, duration=30.0, sampling_rate=100.0)``, once per draw;
        all recordings must have the same times and outputs. Sensors are not applied to them.
    experiment : str, optional
        The experiment whose parameters `run` gets; required if experiments differ in some.
    tolerance : float, optional
        Error of the model that is small enough for its use, as a fraction of the rms of a measured period about its
        mean: 0.02 for 2 %.

    Returns
    -------
    Prediction

    Raises
    ------
    ValueError
        For too few draws, a posterior of another problem, an `experiment` that is missing, unknown or given without
        `run`, recordings that differ in their times or outputs, or a tolerance that is not between 0 and 1.
    RuntimeError
        If no draw or not the one with the highest density has a periodic solution, or if all runs fail.

    Examples
    --------
    Data of a hardening spring, and a model without that term:

    >>> linear = bp.Problem(bp.models.duffing, [run], priors=problem.priors, fixed={"m": 1, "k3": 0}, scheme="fourier")
    >>> draws = bp.sample(linear, bp.map_estimate(linear, progress=False), seed=1, max_steps=250, progress=False)
    >>> bp.predict(linear, draws, draws=50).verdict
    'misspecified'
    >>> bp.predict(linear, draws, draws=50, tolerance=0.3).verdict
    'adequate within tolerance'
    """
    _checks.instance("problem", problem, Problem)
    if tolerance is not None and not 0.0 < _checks.finite_number("tolerance", tolerance) < 1.0:
        raise ValueError(f"tolerance: must be between 0 and 1, got {tolerance!r}; give 0.02 for 2 % of the rms.")
    if run is not None and not callable(run):
        raise ValueError(f"run: must be a function, got {_checks.shortened(run)}.")
    count = _checks.integer("draws", draws, 20)
    if experiment is not None and run is None:
        raise ValueError(f"experiment: must be given together with `run`, got {experiment!r} without `run`.")
    problem = check_results(problem, posterior=posterior)
    refuse_robust(posterior)
    lp = posterior.tree["sample_stats"]["lp"].transpose(CHAIN, DRAW).to_numpy()
    points, noise = draws_of(problem, posterior, np.linspace(0, lp.size - 1, count).astype(int))
    peak = draws_of(problem, posterior, [int(np.argmax(lp))])[0][0]
    guesses = posterior.guesses([*problem.observations], problem.model.states)
    anchored = problem.anchored(peak, guesses).density()
    solved = anchored.solver.solve(points)
    converged = solved.status == CONVERGED
    if not converged.any():
        raise RuntimeError("posterior: none of its draws has a periodic solution. Give draws of this problem.")
    outputs = {name: o.predicted(solved.response(name)) for name, o in problem.observations.items()}
    predicted = bands(problem, outputs, converged, problem.likelihood.value_variances(noise))
    components = iter(problem.likelihood.simulate(noise, np.random.default_rng(posterior.seed)))
    replicates = {}
    for name, observation in problem.observations.items():
        parts = list(islice(components, len(observation.blocks)))
        for channel, values in observation.replicates(solved.response(name), parts).items():
            replicates[name, channel] = values[converged]
    here = anchored.linearise(peak)
    if not here.converged:
        raise RuntimeError(
            "posterior: its draw of highest density has no periodic solution. Give draws of this problem."
        )
    objective, conflict = Objective(anchored.with_settings(coordinates=NATURAL), of_total=True), ""
    estimate = objective.iterate(here, np.median(noise, axis=0))
    if estimate is not None:
        objective = replace(objective, log_variance_factor=bias_correction(problem, estimate))
        estimate = objective.iterate(here, estimate.noise)
    if estimate is not None:
        conflicting, alone = prior_conflict(problem, estimate)
        conflict = conflicting.text
        if conflict:
            # The prior must not count as misfit of the model, which is tested where the data alone are fitted best.
            here, noise, replicates = alone.here, alone.noise[None], {}
    table = adequacy(problem, here, noise, replicates)
    others = here.other_orbits
    table.loc[table["experiment"].isin([*others, *([ALL] if others else [])]), "verdict"] = MISSPECIFIED
    table = with_model_error(table, model_errors(problem, here, np.median(noise, axis=0)))
    if tolerance is not None and not others and not conflict:
        table["verdict"] = tolerated(table, tolerance, faulty(problem))
    recorded = None if run is None else _transient(problem, points, run, experiment)
    note = _note(problem, posterior, table)
    return Prediction(
        **vars(predicted),
        table=table,
        transient=recorded,
        note=note,
        other_orbits=others,
        prior_conflict=conflict,
        tolerance=tolerance,
    )


def tolerated(table: pd.DataFrame, tolerance: float, unsound: set[str]) -> pd.Series:
    """Return the verdicts of a table where errors of the model below a tolerance are accepted."""
    below, verdict = table[MODEL_ERROR[2]] < tolerance, table["verdict"].copy()
    accepted = below & verdict.isin([MISSPECIFIED, UNTESTED]) & (table.index != ALL)
    faults = table["experiment"].isin(unsound)
    verdict[accepted] = np.where(faults[accepted], UNSOUND, TOLERATED)
    rest = verdict.drop(ALL)
    if below[ALL] and verdict[ALL] in (MISSPECIFIED, UNTESTED) and not rest.isin([MISSPECIFIED]).any():
        verdict[ALL] = UNSOUND if unsound else TOLERATED
    return verdict


def _note(problem: Problem, posterior: Posterior, table: pd.DataFrame) -> str:
    """Return the limitations of the tests."""
    notes = []
    if not posterior.converged:
        notes.append(f"The draws have not converged ({posterior.reason}), so bands and p-values are provisional.")
    if problem.input_errors:
        names = ["noise of the inputs"] * bool(problem.noisy_inputs) + ["error of the frequency"] * bool(
            problem.frequency_errors
        )
        notes.append(
            f"What the {' and the '.join(names)} can cause is part of the covariance of the residual, and no misfit."
        )
    if not problem.likelihood.white and table["size"].drop(ALL).isna().any():
        notes.append(
            f"{problem.noise.name.capitalize()} noise takes a correlated misfit as noise; only the scatter of the "
            "measured cycles would reveal it, and it is not known for all channels."
        )
    return " ".join(notes)


NO_ORBIT, ANOTHER_ORBIT, FAILED = "no orbit", "other orbit", "solver failed"
PATH_VERDICTS = {
    arclength.FOLDED: (NO_ORBIT, "the branch ends in a fold"),
    arclength.EQUILIBRIUM: (NO_ORBIT, "the cycle shrinks to an equilibrium"),
    arclength.SHORTER: (NO_ORBIT, "the orbit merges with one of a shorter period"),
    arclength.ROUND_FOLDS: (ANOTHER_ORBIT, "the branch folds back to another orbit at the same parameters"),
    arclength.ARRIVED: (FAILED, "the orbit exists"),
    arclength.PATH_LOST: (FAILED, "the branch cannot be followed"),
}


@dataclass(frozen=True)
class PriorPredictive(Result):
    """Periodic solves and outputs over the prior.

    Attributes
    ----------
    table : DataFrame
        One row per experiment: the fractions of draws whose solve converged, with another orbit than the one that
        continues the orbit at the prior medians, without an orbit, and with a failed solve although no reason for the
        absence of an orbit was found; and the fraction of the measured values ``inside`` the central 90 % of the
        outputs of the draws. In the row "all" a draw counts by its worst experiment, in this order.
    causes : dict of str to float
        Fraction of all solves (draws times experiments) by cause of failure.
    outputs : Bands
        Median and central 90 % band of the outputs over the draws, without noise.
    draws : int

    Examples
    --------
    >>> expected = bp.prior_predictive(problem, draws=50, progress=False)
    >>> expected.table.loc["all", ["converged", "other orbit", "no orbit"]].to_dict(), expected.causes
    ({'converged': 1.0, 'other orbit': 0.0, 'no orbit': 0.0}, {})
    """

    table: pd.DataFrame
    causes: dict[str, float]
    outputs: Bands
    draws: int

    def __repr__(self) -> str:
        causes = "".join(f"\n  {fraction:.1%}: {cause}" for cause, fraction in self.causes.items())
        table = self.table.to_string(float_format="{:.1%}".format)
        head = f"Periodic solves and outputs for {self.draws} draws from the prior"
        return f"{head}\n{table}" + (f"\nfailed solves:{causes}" if causes else "")


@in_one_thread
def prior_predictive(problem: Problem, *, draws: int = 200, seed: int = 0, progress: bool = True) -> PriorPredictive:
    """Solve every experiment for draws from the prior, and classify failed solves.

    The solves start from the orbits at the prior medians. After a failure, the branch of orbits is continued by
    arclength along the straight line to the draw: if it ends in a fold, shrinks to an equilibrium or merges with an
    orbit of a shorter period, the model has no such orbit at the draw; if it reaches the draw, the solver has failed.
    The sampler assigns zero density in both cases, correctly in the first and wrongly in the second.

    Parameters
    ----------
    problem : Problem
    draws : int
        At least 20.
    seed : int
    progress : bool
        Show a progress bar over the failed solves.

    Returns
    -------
    PriorPredictive

    Raises
    ------
    ValueError
        For fewer than 20 draws, or a negative seed.
    RuntimeError
        If no draw has a periodic solution.

    Examples
    --------
    >>> expected = bp.prior_predictive(problem, draws=50, progress=False)
    >>> float(expected.table.loc["synthetic duffing", "inside"])
    1.0
    """
    import pandas as pd

    _checks.instance("problem", problem, Problem)
    count = _checks.integer("draws", draws, 20)
    theta = problem.joint_prior.sample(count, np.random.default_rng(_checks.integer("seed", seed, 0)))
    density, runs = problem.density(), [e.name for e in problem.experiments]
    solved, causes = density.solver.solve(theta), Counter[str]()
    verdicts = {name: np.full(count, STATUSES[CONVERGED], dtype=object) for name in runs}
    failed = [(name, i) for name in runs for i in np.flatnonzero(solved.statuses(name) != CONVERGED)]
    for name, i in tqdm(failed, desc="failed solves", disable=not (progress and failed)):
        verdicts[name][i], why = PATH_VERDICTS[density.solver.path_outcome(theta[i], name)]
        causes[f"{verdicts[name][i]} ({STATUSES[solved.statuses(name)[i]]}): {why}"] += 1
    outputs, converged = density.outputs(theta)
    if not converged.any():
        raise RuntimeError(
            f"problem: none of {count} draws from its priors has a periodic solution in all experiments. Narrow the "
            "priors around values at which problem.solve(theta) converges."
        )
    prediction = bands(problem, outputs, converged, {})
    order = [STATUSES[CONVERGED], ANOTHER_ORBIT, NO_ORBIT, FAILED]
    worst = np.max([[order.index(v) for v in row] for row in verdicts.values()], axis=0)
    verdicts["all"] = np.array(order, dtype=object)[worst]
    shares = {what: [np.mean(row == what) for row in verdicts.values()] for what in order}
    inside = [*(_inside(e, prediction) for e in problem.experiments), np.nan]
    fractions = {cause: number / (count * len(runs)) for cause, number in causes.most_common()}
    return PriorPredictive(pd.DataFrame(shares | {"inside": inside}, [*verdicts]), fractions, prediction, count)


def _inside(e: Experiment, prediction: Bands) -> float:
    """Return the fraction of the measured values within the band; NaN without a time history."""
    if not e.outputs:
        return np.nan
    within = [
        (values >= prediction.low[e.name][channel]) & (values <= prediction.high[e.name][channel])
        for channel, values in e.outputs.items()
    ]
    return float(np.mean(np.array(within)[:, e.measured_points]))
