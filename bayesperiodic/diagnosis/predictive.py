"""Posterior predictive checks: bands, on periods and on transients, and whether the model explains the data at all."""

from dataclasses import dataclass, fields

import numpy as np
import pandas as pd

from bayesperiodic import checks
from bayesperiodic.blas import in_one_thread
from bayesperiodic.diagnosis.adequacy import ALL, LEVEL, TESTS, UNTESTED, adequacy, adjusted_p
from bayesperiodic.diagnosis.bands import Bands, bands
from bayesperiodic.diagnosis.transients import Run, Transient, transient
from bayesperiodic.inference.labels import CHAIN, DRAW
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.periodic.compiled import CONVERGED

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
    count = checks.integer("draws", draws, 20)
    if experiment is not None and run is None:
        raise ValueError(f"experiment: {experiment!r} is not allowed without run, whose parameters it chooses.")
    every = (*problem.names, *problem.free_noise)
    checks.holds("posterior", posterior.names, every, "give draws of this problem, sample(problem, fit)")
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
