"""Posterior predictive checks: bands, on periods and on transients, and whether the model explains the data at all."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
from scipy.special import ndtri

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.data.recording import Recording
from bayesperiodic.diagnostics.adequacy import ALL, LEVEL, TESTS, UNTESTED, adequacy, adjusted_p
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.posterior.labels import CHAIN, DRAW
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling.posterior import Posterior

PROBABILITY = 0.9
NOISE_LEVELS = 21


@dataclass(frozen=True)
class Bands(Result):
    """What is expected of the mean period of each experiment.

    Attributes
    ----------
    median, low, high : dict of str to dict of str to array (points,)
        By experiment and channel: the median and the central 90 % band of the mean period, residual variance included
        and taken as normal at each point, within the harmonics kept. Section values with a covariance of their own have
        the band of the model alone.
    probability : float
        Of the band.
    draws : int
        Draws used.
    failed : int
        Of these, how many had no periodic solution.
    """

    median: dict[str, dict[str, np.ndarray]]
    low: dict[str, dict[str, np.ndarray]]
    high: dict[str, dict[str, np.ndarray]]
    probability: float
    draws: int
    failed: int


def quantiles() -> tuple[float, float, float]:
    """Return the levels of the median and of the ends of the central band."""
    return 0.5, 0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY


def bands(
    problem: Problem,
    outputs: dict[str, dict[str, np.ndarray]],
    converged: np.ndarray,
    variances: dict[tuple[str, str], np.ndarray],
) -> Bands:
    """Return the bands of outputs (draws, points), by experiment and channel, at the draws that converged.

    Parameters
    ----------
    problem : Problem
    outputs : dict of str to dict of str to array (draws, points)
    converged : bool array (draws,)
    variances : dict of (str, str) to array (draws,)
        Of the residual, by experiment and channel; zero where there is none.
    """
    count = converged.size
    scores = ndtri((np.arange(NOISE_LEVELS) + 0.5) / NOISE_LEVELS)
    found: list[dict[str, dict[str, np.ndarray]]] = [{}, {}, {}]
    for e in problem.experiments:
        for channel in e.outputs:
            variance = variances.get((e.name, channel), np.zeros(count))
            expected = e.project(channel, outputs[e.name][channel])
            noise = np.sqrt(variance)[:, None, None] * scores[:, None]
            values = (expected[:, None] + noise)[converged].reshape(-1, expected.shape[1])
            for band, q in zip(found, quantiles(), strict=True):
                level = np.median(expected[converged], axis=0) if q == 0.5 else np.quantile(values, q, axis=0)
                band.setdefault(e.name, {})[channel] = level
    median, low, high = found
    return Bands(median, low, high, PROBABILITY, count, int(count - converged.sum()))


Run = Callable[[dict[str, float]], Recording]


@dataclass(frozen=True)
class Transient(Result):
    """What the posterior expects of a recording that is not periodic.

    Attributes
    ----------
    time : array (samples,)
        [s].
    median, low, high : dict of str to array (samples,)
        By output: the median and the central 90 % band, point by point, of the signals themselves: of the uncertainty
        of the parameters alone, without measurement noise, unless `run` adds some.
    probability : float
        Of the band.
    draws : int
        Runs made, one a draw.
    failures : dict of str to int
        How many of them failed, by reason; they are left out.
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
        """How many runs failed."""
        return sum(self.failures.values())

    def __repr__(self) -> str:
        reasons = "".join(f"\n  {count} times: {reason}" for reason, count in self.failures.items())
        return (
            f"Transient of {', '.join(self.median)} over {self.time[0]:g} to {self.time[-1]:g} s: "
            f"{self.probability:.0%} band of the signal without measurement noise from {self.draws} runs, "
            f"{self.failed} failed{reasons}"
        )


def transient(problem: Problem, theta: np.ndarray, run: Run, experiment: str | None) -> Transient:
    """Return the bands over time of the recordings that `run` makes at draws θ (draws, names).

    Raises
    ------
    ValueError
        If experiments differ in their parameters and none is named, an unknown experiment, anything else than a
        recording, recordings whose times or outputs differ.
    RuntimeError
        If every run fails.
    """
    name = _whose(problem, experiment)
    names, time = problem.model.parameters, np.empty(0)
    signals: dict[str, list[np.ndarray]] = {}
    failures: Counter[str] = Counter()
    for row in problem.parameters(theta, name):
        try:
            recording = run(dict(zip(names, row.tolist(), strict=True)))
        # An integrator that gives up raises one of these, and so does a recording of values that are not finite.
        except (RuntimeError, ArithmeticError, ValueError) as error:
            failures[f"{type(error).__name__}: {error}"] += 1
            last = error
            continue
        if not isinstance(recording, Recording):
            raise ValueError(f"run: it returned a {type(recording).__name__}; it must return a Recording.")
        if not signals:
            time, signals = recording.time, {output: [] for output in recording.outputs}
        _check_same(recording, time, signals)
        for output, values in recording.outputs.items():
            signals[output].append(values)
    if not signals:
        raise RuntimeError(f"run: it failed at all {len(theta)} draws, last with: {last}") from last
    levels = {output: np.quantile(values, quantiles(), axis=0) for output, values in signals.items()}
    median, low, high = ({output: found[i] for output, found in levels.items()} for i in range(3))
    return Transient(time, median, low, high, PROBABILITY, len(theta), dict(failures))


def _whose(problem: Problem, experiment: str | None) -> str:
    """Return the experiment whose parameters the runs get; a ValueError where it matters and is not given."""
    names = [e.name for e in problem.experiments]
    if experiment is not None:
        _checks.one_of("experiment", experiment, names)
        return experiment
    maps = [problem.parameter_maps[name] for name in names]
    for parameter in problem.model.parameters:
        sources = {(m.columns.get(parameter), m.fixed.get(parameter)) for m in maps}
        if len(sources) > 1:
            raise ValueError(
                f"experiment: None is not allowed with run; experiments differ in {parameter!r}, so name the one whose "
                f"value the runs take: {', '.join(map(repr, names))}."
            )
    return names[0]


def _check_same(recording: Recording, time: np.ndarray, outputs: Mapping[str, list[np.ndarray]]) -> None:
    _checks.same_names("run: outputs of the recordings", recording.outputs, outputs)
    if recording.time.size != time.size or not np.allclose(recording.time, time, rtol=1e-9, atol=0.0):
        raise ValueError(
            f"run: recordings of {time.size} and {recording.time.size} samples, from {time[0]:g} to {time[-1]:g} s and "
            f"from {recording.time[0]:g} to {recording.time[-1]:g} s, are not allowed; all must have the same times."
        )


SAID = {
    "whiteness": "its residual is not white",
    "harmonics": "its residual has too much power in some harmonics",
    "size": "its residual is larger than the measured noise",
    "amplitude": "its amplitude is not what the posterior expects",
    "consistency": "no common parameters explain what each experiment and channel allows on its own",
}


@dataclass(frozen=True)
class Prediction(Bands):
    """What the posterior expects of the mean period of each experiment, and whether that is what was measured.

    The verdict is on the model, not on how much the data determine: parameters that the data leave open can still fit
    them ("adequate"), and parameters known to many digits can belong to a model that does not ("misspecified").

    Attributes
    ----------
    median, low, high : dict of str to dict of str to array (points,)
        By experiment and channel, in the channel's unit: the median and the central 90 % band of the mean period,
        residual variance included and taken as normal at each point, within the harmonics kept. Section values with a
        covariance of their own have the band of the model alone.
    probability : float
        Of the band.
    draws, failed : int
        Draws used, and how many of these had no periodic solution.
    table : DataFrame
        A row for every experiment and channel, and the row "all". p-values, NaN where a test is not possible:
        ``whiteness`` and ``harmonics`` of the residual along the period, in units of the noise model; ``size``, the
        residual's variance against the measured scatter of the cycles (taken as exact with one cycle) or a variance
        that was given; ``amplitude``, the rms of the period against replicates; ``consistency`` (row "all"), one set of
        parameters against one for each experiment and channel. ``harmonic``: where the residual has most power in units
        of the noise; of a mask's points it counts cosine waves. ``model_error_share``: the fraction of the residual's
        variance beyond that of ``size``, NaN where none is known. ``p``: the row's smallest, adjusted by Holm's method
        for all tests of the table; ``verdict``: "misspecified" where it is below 1 %, "adequate", or "not tested".
    transient : Transient or None
        Bands on the recordings that `run` makes.
    note : str
        What the noise model hides from the tests, and whether the draws have not converged; "" if nothing.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> found = bp.predict(problem, posterior, draws=50)
    >>> found.verdict, found.failed, found.median["synthetic duffing"]["displacement"].shape
    ('adequate', 0, (32,))
    >>> bool(found.table.loc["all", "p"] > 0.01)
    True
    """

    table: pd.DataFrame
    transient: Transient | None
    note: str

    @property
    def verdict(self) -> str:
        """The verdict on the model as a whole."""
        return str(self.table.loc[ALL, "verdict"])

    @property
    def findings(self) -> dict[str, str]:
        """What the tests found, in words, by the rows of the table; without those that found nothing."""
        found = {}
        for (label, row), small in zip(self.table.iterrows(), adjusted_p(self.table) < LEVEL, strict=True):
            said = [
                f"{SAID[test]} (p = {row[test]:.2g})" for test, is_small in zip(TESTS, small, strict=True) if is_small
            ]
            if said:
                share = row["model_error_share"]
                error = "" if np.isnan(share) else f"; {share:.1%} of its variance is model error"
                found[str(label)] = f"{', '.join(said)}{error}"
        return found

    def __repr__(self) -> str:
        head = f"Prediction from {self.draws} draws, {self.failed} without a periodic solution: "
        if self.verdict == UNTESTED:
            head += "too few values to test the model."
        else:
            head += f"the model is {self.verdict} (all tests together give a false alarm in {LEVEL:.0%})."
        lines = [head, *(f"  {label}: {text}" for label, text in self.findings.items())]
        lines += [self.note] if self.note else []
        lines += [repr(self.transient)] if self.transient else []
        return "\n".join([*lines, self.table.to_string(float_format="{:.2g}".format, na_rep="-")])


@in_one_thread
def predict(
    problem: Problem,
    posterior: Posterior,
    *,
    draws: int = 200,
    run: Run | None = None,
    experiment: str | None = None,
) -> Prediction:
    """Predict the mean period of every experiment, and test whether the measured one could have come from the model.

    The tests are made where their p-values are known: on the residual at the draw with the highest density, without all
    that a change of the parameters, in that experiment and channel alone, could explain. They are exact for models
    linear in the parameters, whatever the priors, and do not depend on how well the data determine the parameters. The
    amplitude is compared with replicates [1]_, whose parameters were fitted to the data: its p is conservative [2]_.

    What is meant by noise decides what can be seen. Noise of unknown variance takes a misfit of any size as noise, so
    only its shape along the period, or the scatter of the measured cycles, gives it away. Circulant noise takes a
    correlated misfit as noise too, and then only the scatter does. A wrong prior is not a wrong model; only the
    amplitude responds to it.

    Parameters
    ----------
    problem : Problem
    posterior : Posterior
    draws : int
        Equally spaced posterior draws, at least 20.
    run : callable, optional
        Makes the recording of a transient from the value of every parameter of the model at one draw, such as
        ``lambda p: bp.simulate(model, p, inputs, frequency=1.0, duration=30.0, sampling_rate=100.0)``. Called once a
        draw; all recordings must have the same times and outputs.
    experiment : str, optional
        Whose parameters `run` gets, where experiments differ in some.

    Returns
    -------
    Prediction

    Raises
    ------
    ValueError
        For too few draws, a posterior of another problem, an `experiment` that is needed and not given, or without
        `run`, recordings that differ in their times or outputs.
    RuntimeError
        If no draw, or not the one with the highest density, has a periodic solution, or no run succeeds.

    References
    ----------
    .. [1] A. Gelman, X.-L. Meng, H. Stern, Posterior predictive assessment of model fitness via realized discrepancies,
       Statistica Sinica 6 (1996) 733-807.
    .. [2] X.-L. Meng, Posterior predictive p-values, Annals of Statistics 22 (1994) 1142-1160.

    Examples
    --------
    A spring that hardens, and a model without that term:

    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> bp.predict(problem, posterior, draws=50).verdict
    'misspecified'
    """
    count = _checks.integer("draws", draws, 20)
    if experiment is not None and run is None:
        raise ValueError(f"experiment: {experiment!r} is not allowed without run, whose parameters it chooses.")
    every = (*problem.names, *problem.free_noise)
    _checks.contains("posterior", posterior.names, every, "give draws of this problem, sample(problem, fit)")
    columns = {name: posterior.draws(name) for name in posterior.names}
    chosen = np.linspace(0, next(iter(columns.values())).size - 1, count).astype(int)
    best = int(np.argmax(posterior.data["sample_stats"]["lp"].transpose(CHAIN, DRAW).to_numpy()))
    free = (
        np.stack([columns[n][chosen] for n in problem.free_noise], -1) if problem.free_noise else np.empty((count, 0))
    )
    noise = problem.likelihood.complete(free)
    points = np.stack([columns[name][chosen] for name in problem.names], axis=-1)
    peak = np.array([columns[name][best] for name in problem.names])
    runs = [e.name for e in problem.experiments]
    anchored = problem.anchored(peak, posterior.guesses(runs, problem.model.states))
    solved = anchored.responses.solve(points)
    converged = np.all([s.status == CONVERGED for s in solved.values()], axis=0)
    if not converged.any():
        raise RuntimeError(
            "posterior: none of its draws has a periodic solution, so nothing can be predicted. Give draws of this "
            "problem."
        )
    outputs = {name: o.predicted(solved[name].response) for name, o in problem.observations.items()}
    predicted = bands(problem, outputs, converged, problem.likelihood.value_variances(noise))
    components = problem.likelihood.simulate(noise, np.random.default_rng(posterior.seed))
    replicates = {}
    for e in problem.experiments:
        observation = problem.observations[e.name]
        own, components = components[: len(observation.blocks)], components[len(observation.blocks) :]
        for channel, values in observation.replicates(solved[e.name].response, own).items():
            replicates[e.name, channel] = values[converged]
    here = anchored.linearised(peak)
    if not here.converged:
        raise RuntimeError(
            "posterior: its draw of the highest density has no periodic solution, so nothing is tested. Give draws of "
            "this problem."
        )
    table = adequacy(problem, here, noise, replicates)
    recorded = None if run is None else transient(problem, points, run, experiment)
    given = {f.name: getattr(predicted, f.name) for f in fields(predicted)}
    return Prediction(**given, table=table, transient=recorded, note=_note(problem, posterior, table))


def _note(problem: Problem, posterior: Posterior, table: pd.DataFrame) -> str:
    """Return what the noise model hides, and whether the draws can be trusted."""
    said = []
    if not posterior.converged:
        said.append(f"The draws have not converged ({posterior.reason}), so bands and p-values are provisional.")
    if not problem.noise.flat and table["size"].drop(ALL).isna().any():
        said.append(
            f"{problem.noise.name.capitalize()} noise takes a correlated misfit as noise; only the scatter of the "
            "measured cycles would give it away, and it is not known everywhere."
        )
    return " ".join(said)
