"""Simulation-based calibration: replicates, coverage of the intervals, and tests of uniformity."""

from __future__ import annotations

import hashlib
import importlib.metadata
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import Generator
from scipy.special import chdtr, chdtrc, ndtr, ndtri, stdtr

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._parallel import checkpointed_tasks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.recording import Recording
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.verdicts import NARROW, WIDE
from bayesperiodic.estimation.adequacy import holm
from bayesperiodic.estimation.check import with_joint
from bayesperiodic.estimation.map_estimate import map_estimate
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.input_noise import FROM_CYCLES, JOINT, error_waves, noisy_inputs
from bayesperiodic.likelihood.noise import PER_EXPERIMENT, VARIANCE, Independent
from bayesperiodic.likelihood.observation import Response
from bayesperiodic.priors.joint import as_prior
from bayesperiodic.problem.arguments import refuse_special_points
from bayesperiodic.problem.fingerprint import fingerprint
from bayesperiodic.sampling.draws import Posterior
from bayesperiodic.sampling.sample import sample
from bayesperiodic.simulation import NotSettled, steady_cycle

if TYPE_CHECKING:
    import pandas as pd

ECDF_POINTS, SIMULATED, SIMULATION_SEED = 100, 20_000, 0
FEWEST_IN_BIN, MOST_BINS = 20, 20
SMALLEST_RANK = 1e-12


def normal_scores(values: np.ndarray) -> np.ndarray:
    """Return the standard normal quantiles of values in [0, 1], clipped to 1e-12 from the ends."""
    return ndtri(np.clip(values, SMALLEST_RANK, 1.0 - SMALLEST_RANK))


def dispersion_test(values: np.ndarray) -> tuple[float, float]:
    """Return the mean square of the normal scores, of expectation 1, and the two-sided p-value of its χ² distribution.

    If variances are a fifth too small its expectation is 1.25; with 1000 values the power against this alternative at
    a level of 1 % is 99.2 %, that of `ecdf_test` 76 %, of Kolmogorov's test 20 %.
    """
    square, size = float(np.sum(normal_scores(values) ** 2)), values.size
    return square / size, float(min(1.0, 2.0 * min(chdtr(size, square), chdtrc(size, square))))


def chi_square_test(values: np.ndarray) -> float:
    """Return p of the χ² test on the histogram; NaN for fewer than 100 values."""
    from scipy import stats

    bins = bin_count(values.size)
    if bins * FEWEST_IN_BIN > values.size:
        return np.nan
    return float(stats.chisquare(np.histogram(values, bins, (0.0, 1.0))[0]).pvalue)


def bin_count(size: int) -> int:
    """Return the number of bins of a histogram."""
    return int(np.clip(size // FEWEST_IN_BIN, 5, MOST_BINS))


def ecdf_test(values: np.ndarray) -> float:
    """Return p of the smallest pointwise binomial tail of the empirical distribution function.

    This is the test of Säilynoja, Bürkner and Vehtari, Statistics and Computing 32 (2022) 32, section 3. The null
    distribution is simulated once for every number of values, with a fixed seed.
    """
    table, null = _null(values.size)
    counts = np.searchsorted(np.sort(values), evaluation_points(), side="right")
    smallest = table[counts, np.arange(counts.size)].min()
    return float((1 + np.sum(null <= smallest * (1.0 + 1e-9))) / (1 + null.size))


def ecdf_band(size: int, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the simultaneous band of the empirical distribution function of `size` values, at `evaluation_points`."""
    return binomial_band(size, evaluation_points(), float(np.quantile(_null(size)[1], 1.0 - level)))


def binomial_band(size: int, probabilities: np.ndarray, tail: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the central 1 − `tail` intervals of binomial frequencies in `size` trials."""
    from scipy import stats

    low, high = (np.asarray(stats.binom.ppf(q, size, probabilities)) for q in (0.5 * tail, 1.0 - 0.5 * tail))
    return low / size, high / size


def evaluation_points() -> np.ndarray:
    """Return the points (points,) at which empirical distribution functions are evaluated."""
    return np.arange(1, ECDF_POINTS) / ECDF_POINTS


@cache
def _null(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pointwise two-sided tails (size + 1, points) of each count, and simulated minima over the points."""
    from scipy import stats

    counts, points = np.arange(size + 1)[:, None], evaluation_points()
    table = 2.0 * np.minimum(stats.binom.cdf(counts, size, points), stats.binom.sf(counts - 1, size, points))
    generator = np.random.default_rng(SIMULATION_SEED)
    drawn = generator.multinomial(size, np.full(ECDF_POINTS, 1.0 / ECDF_POINTS), SIMULATED).cumsum(axis=1)[:, :-1]
    return table, table[drawn, np.arange(ECDF_POINTS - 1)].min(axis=1)


MCMC, LAPLACE = "mcmc", "laplace"
CALIBRATED_METHODS = (MCMC, LAPLACE)
DONE, NO_STEADY_STATE = "done", "no steady state"
SIMULATED_CYCLES = 3
# Steps between draws taken as independent, in autocorrelation times (which short chains underestimate), the least
# number of these draws, and the largest R-hat.
DRAW_SPACING, FEWEST_DRAWS, LARGEST_RHAT = 5.0, 20, 1.1
FILE = "replicates.jsonl"
COVERAGE_LEVELS = (0.5, 0.8, 0.9, 0.95)
FALSE_ALARMS = 0.01
CALIBRATED, NOT_UNIFORM, TOO_FEW = "calibrated", "not uniform", "too few replicates"
FEWEST_REPLICATES = 20
P_VALUES = ("p_dispersion", "p_ecdf", "p_chi_square")


@dataclass(frozen=True)
class Calibration(Result):
    """Calibration of MCMC and of the Laplace approximation over simulated campaigns.

    Attributes
    ----------
    table : DataFrame
        One row per quantity and method ("mcmc" or "laplace"): number of replicates; dispersion, the mean square of the
        normal scores, above 1 if intervals are too narrow; shift, their mean; p of the dispersion test, the ECDF test
        and the χ² test of the histogram, each adjusted by Holm's method for the quantities of the method; coverage of
        the central 50, 80, 90 and 95 % intervals; verdict: "calibrated", "too narrow", "too wide", "not uniform", or
        "too few replicates" below 20. The probability of a false verdict for any quantity is at most 1 % per test.
    positions : dict of str to dict of str to array (replicates,)
        By method and quantity, between 0 and 1, uniformly distributed if calibrated: for "mcmc" the randomised
        normalised rank of the truth among independent draws; for "laplace" the distribution function at the truth.
        Variances are those of the folded mean.
    failures : dict of str to int
        Number of failed replicates by reason: "no steady state" (of the simulated truth), "fold failed", "no estimate",
        "estimate not converged" (excluded for Laplace), "no draws", "draws not usable" (fewer than 20 independent ones,
        or R-hat above 1.1; excluded for MCMC).
    replicates, stop_rule : int
        Total number, and number of chains that passed the stop rule of `sample`. Most chains end before it can be
        passed, which takes 500 steps and 50 autocorrelation times; ranks need only independent draws.
    draws, rhat, failed_solves : float
        What the ranks rest on: median number of independent draws per rank, at steps five autocorrelation times apart,
        and largest R-hat of the chains in use; mean fraction of proposals whose periodic solve failed.
    synthetic : bool
        Always True.

    Examples
    --------
    >>> calibration.positions["laplace"]["k"].shape, calibration.replicates, calibration.table["method"].tolist()
    ((2,), 2, ['mcmc', 'laplace'])
    """

    table: pd.DataFrame
    positions: dict[str, dict[str, np.ndarray]]
    failures: dict[str, int]
    replicates: int
    stop_rule: int
    draws: float
    rhat: float
    failed_solves: float
    synthetic: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities: parameters, then free variances."""
        return tuple(self.positions[MCMC])

    def __repr__(self) -> str:
        failed = ", ".join(f"{kind} {count}" for kind, count in self.failures.items()) or "none"
        return (
            f"Calibration over {self.replicates} synthetic campaigns\n"
            f"{self.table.to_string(float_format='{:.3g}'.format, index=False)}\n"
            f"Failed campaigns: {failed}. The ranks are among {self.draws:.0f} independent draws, with R-hat at most "
            f"{self.rhat:.3f}.\n"
            f"The stop rule of sample was passed by {self.stop_rule}; {self.failed_solves:.2%} of the solves failed."
        )


@in_one_thread
def calibrate(
    problem: Problem,
    *,
    replicates: int,
    seed: int,
    folder: str | Path | None = None,
    executor: Any = None,
    ensembles: int = 2,
    walkers: int | None = None,
    max_steps: int = 500,
    progress: bool = True,
) -> Calibration:
    """Test the calibration of the posterior by simulation-based calibration (Talts et al., arXiv:1804.06788, 2018).

    Each replicate draws θ and the variances from the prior, integrates the model in time to its steady state, records
    as many cycles as the experiment has (at least three) with as many samples per cycle as its grid, adds white noise,
    folds with the harmonics and the frequency of the experiment, and computes the MAP estimate, the Laplace
    approximation and draws of emcee. The periodic solver is not used for the recording, so that its errors are
    detected. Inputs have the noise that `Problem.input_noise` gives them: white, with the measured variance, or given.
    A frequency with a standard error is missed by a normal error when the recording is folded.

    A likelihood that counts too many independent values, or a grid that is too coarse, results in "too narrow" or "not
    uniform". A wrong model is not detected: truths are drawn from the model.

    Parameters
    ----------
    problem : Problem
        Forced, with whole histories of one forcing period, `bayesperiodic.noise.Independent` with a proper prior or
        known variances. Of its data only the settings are used.
    replicates : int
    seed : int
        Replicate k depends on the seed and k only, not on the executor.
    folder : path, optional
        Each replicate is appended to ``replicates.jsonl`` there; a repeated call computes only the missing ones.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        None computes serially. After the loss of workers, except of Dask, repeat the call with the same folder.
    ensembles, walkers, max_steps
        Arguments of `sample` in each replicate. Short chains suffice, because ranks use draws five autocorrelation
        times apart. Too few walkers bias the result: with eight in four dimensions, the dispersion of exact ranks was 5
        to 10 % too large.
    progress : bool

    Returns
    -------
    Calibration

    Raises
    ------
    ValueError
        For an improper prior, or a problem whose recordings cannot be simulated; if the folder is in use.
    RuntimeError
        If the workers of the executor died; finished replicates are in the folder.

    Examples
    --------
    >>> known = bp.Problem(bp.models.duffing, [run], priors={"k": bp.LogNormal(1, 0.1)}, scheme="fourier",
    ...                    fixed={"m": 1, "c": 0.2, "k3": 0.5, "variance[displacement]": 1e-4})
    >>> found = bp.calibrate(known, replicates=2, seed=1, max_steps=250, progress=False)
    >>> found.failures, found.names, found.table["verdict"].tolist()
    ({}, ('k',), ['too few replicates', 'too few replicates'])
    """
    _checks.instance("problem", problem, Problem)
    _checks.integer("replicates", replicates, 1)
    _checks.integer("seed", seed, 0)
    check_supported(problem)
    settings = (
        f"{importlib.metadata.version('bayesperiodic')}, {fingerprint(problem)}, seed {seed}, {ensembles} x {walkers} "
        f"walkers, {max_steps} steps, {DRAW_SPACING} apart"
    )
    source = hashlib.sha256(settings.encode()).hexdigest()[:16]
    lines = checkpointed_tasks(
        None if folder is None else Path(folder) / FILE,
        range(replicates),
        replicate,
        lambda line: line["number"],
        source,
        shared=Campaign(problem, seed, source, {"ensembles": ensembles, "walkers": walkers, "max_steps": max_steps}),
        executor=executor,
        progress=progress,
    )
    return summary(lines, (*problem.names, *problem.free_noise))


def summary(lines: Sequence[dict[str, Any]], names: Sequence[str]) -> Calibration:
    """Summarise the results of all replicates for these quantities."""
    import pandas as pd

    finished = {method: [line[method] for line in lines if method in line] for method in CALIBRATED_METHODS}
    positions = {m: {name: np.array([line[name] for line in each]) for name in names} for m, each in finished.items()}
    failures = Counter(line["status"] for line in lines if line["status"] != DONE)
    if unconverged := sum("map" in line and LAPLACE not in line for line in lines):
        failures["estimate not converged"] = unconverged
    return Calibration(
        table=pd.concat([_table(*item) for item in positions.items()], ignore_index=True),
        positions=positions,
        failures=dict(sorted(failures.items())),
        replicates=len(lines),
        stop_rule=sum(line.get("stop_rule", False) for line in lines),
        draws=float(np.median([line["draws"] for line in lines if "draws" in line] or [0])),
        rhat=max((line["rhat"] for line in lines if "draws" in line), default=np.nan),
        failed_solves=float(np.mean([line["failed"] for line in lines if "failed" in line] or [0.0])),
    )


def _table(method: str, positions: dict[str, np.ndarray]) -> pd.DataFrame:
    import pandas as pd

    rows = []
    for name, values in positions.items():
        finite = values[np.isfinite(values)]
        row: dict[str, Any] = {"quantity": name, "method": method, "replicates": finite.size}
        row |= dict.fromkeys(("dispersion", "shift", *P_VALUES), np.nan)
        if finite.size >= FEWEST_REPLICATES:
            row["dispersion"], row["p_dispersion"] = dispersion_test(finite)
            row["shift"] = float(normal_scores(finite).mean())
            row["p_ecdf"], row["p_chi_square"] = ecdf_test(finite), chi_square_test(finite)
        rows.append(row | {f"coverage_{100 * level:.0f}": coverage(finite, level) for level in COVERAGE_LEVELS})
    table = pd.DataFrame(rows)
    for test in P_VALUES:
        table[test] = holm(table[test].to_numpy(dtype=float))
    rejected = table[[*P_VALUES]] < FALSE_ALARMS
    off = np.where(table["dispersion"] > 1.0, NARROW, WIDE)
    cases = [table["replicates"] < FEWEST_REPLICATES, rejected["p_dispersion"], rejected.any(axis=1)]
    table["verdict"] = np.select(cases, [TOO_FEW, off, NOT_UNIFORM], CALIBRATED)
    return table


def coverage(positions: np.ndarray, level: float) -> float:
    """Return the fraction of truths inside the central intervals of this probability."""
    return float(np.mean(np.abs(positions - 0.5) <= 0.5 * level)) if positions.size else np.nan


@dataclass(frozen=True)
class Campaign:
    """Settings of all replicates."""

    problem: Problem
    seed: int
    source: str
    sampler: dict[str, Any]


def check_supported(problem: Problem) -> None:
    """Raise a ValueError for an improper prior, or a problem whose recordings cannot be simulated."""
    noise = problem.noise
    if not isinstance(noise, Independent):
        raise ValueError(
            f"problem: must have the noise model noise.Independent, got {noise.name!r}. Recordings are simulated with "
            "independent errors: give noise.Independent(prior=…)."
        )
    if problem.free_noise and not noise.proper:
        raise ValueError(
            f"problem: must have proper priors, got the {noise.prior_text} of {problem.free_noise[0]!r}. Give "
            "noise.Independent(prior=bp.InverseGamma(…)) or another proper prior, or fix the variance."
        )
    if problem.input_noise == JOINT:
        raise ValueError("problem: must have another input_noise than 'joint', whose errors are no parameters to draw.")
    if problem.model.autonomous:
        raise ValueError(f"problem: must have a forced model, got the autonomous {problem.model.name!r}.")
    refuse_special_points(problem.experiments, "simulated recordings")
    for e in problem.experiments:
        turns = [e.winding] if isinstance(e.winding, int) else [*e.winding.values()]
        excluded = {
            **{block.description: not block.spectral for block in problem.observations[e.name].blocks},
            f"periods = {e.periods}": e.periods > 1,
            "a winding number": any(turns),
        }
        if what := next((what for what, applies in excluded.items() if applies), ""):
            raise ValueError(
                f"problem: experiments must have whole histories of one forcing period, got {e.name!r} with {what}."
            )


def replicate(campaign: Campaign, number: int) -> dict[str, Any]:
    """Return one replicate as a JSON object: its status, its truth, and the rank of the truth in each estimate.

    A replicate depends on the seed of the campaign and on its number only.
    """
    seeds = np.random.SeedSequence([campaign.seed, number]).spawn(4)
    truths, noise, chain, ties = (np.random.default_rng(seed) for seed in seeds)
    problem = campaign.problem
    theta = dict(zip(problem.names, problem.joint_prior.sample(1, truths)[0].tolist(), strict=True))
    prior = problem.noise.prior
    drawn = {name: float(as_prior("prior", prior).sample(1, truths)[0]) for name in problem.free_noise}
    variances = problem.likelihood.fixed | drawn
    line: dict[str, Any] = {"source": campaign.source, "number": number, "theta": theta}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            measured = [_measured(problem, e, theta, variances, noise) for e in problem.experiments]
        except NotSettled:
            return line | {"status": NO_STEADY_STATE}
        except ValueError as error:
            return line | {"status": "fold failed", "error": str(error)}
        truth = theta | drawn
        return line | {"truth": truth} | _ranks(campaign, measured, truth, chain, ties)


def _measured(
    problem: Problem, e: Experiment, theta: dict[str, float], variances: dict[str, float], generator: Generator
) -> Experiment:
    """Return a simulated repetition of an experiment."""
    model, (row,) = problem.model, problem.parameters(problem.vector(theta)[None], e.name).tolist()
    values, start = dict(zip(model.parameters, row, strict=True)), _first_state(problem, e, theta)
    inputs = problem.sensors.corrected(e, e.inputs)
    cycle = steady_cycle(model, values, inputs, frequency=e.frequency, samples=e.samples, start=start)
    sensors = problem.parameter_maps[e.name].split(problem.vector(theta))[1]
    signals = np.stack([cycle[channel] for channel in model.outputs], axis=-1)
    shown = problem.observations[e.name].predicted(Response(signals, np.array(e.frequency), np.empty(0), sensors))
    limit, cycles = _fourier.highest_harmonic(e.samples), max(e.cycles, SIMULATED_CYCLES)
    size = cycles * e.samples
    kept = {channel: e.harmonics.get(channel, limit) for channel in (*e.inputs, *e.outputs)}
    outputs = {}
    for channel in e.outputs:
        place = f"{channel}, {e.name}" if problem.noise.per == PER_EXPERIMENT else channel
        noise = np.sqrt(variances[f"{VARIANCE}[{place}]"]) * generator.standard_normal(size)
        outputs[channel] = np.tile(shown[channel], cycles) + noise
    time = np.arange(size) / (e.samples * e.frequency)
    inputs = {name: np.tile(signal, cycles) for name, signal in e.inputs.items()}
    for name in noisy_inputs(e, problem.input_noise):
        inputs[name] = inputs[name] + _input_noise(problem, e, name, size, generator)
    recording = Recording(time, outputs, inputs, name=e.name, synthetic=True)
    frequency: float | tuple[float, float] = e.frequency
    if (error := problem.frequency_errors.get(e.name)) is not None:
        frequency = e.frequency + error.se * float(generator.standard_normal()), error.se
    again = recording.fold(e.samples, frequency=frequency, harmonics=kept)
    return replace(again, independent=e.independent, guess=e.guess)


def _input_noise(problem: Problem, e: Experiment, name: str, size: int, generator: Generator) -> np.ndarray:
    """Return noise of an input (size,): white with the measured variance, or of given covariance in all cycles."""
    if problem.input_noise == FROM_CYCLES:
        variance = e.amplitude_variance[name]
        total = variance[0] + 0.5 * variance[1:].sum()
        return np.sqrt(total / (2 * variance.size - 1) * size) * generator.standard_normal(size)
    where, waves = error_waves(e, problem.input_noise)
    errors = generator.standard_normal(len(where)) * (np.array(where) == name)
    return np.tile(_fourier.on_grid(errors @ waves, e.samples), size // e.samples)


def _first_state(problem: Problem, e: Experiment, theta: dict[str, float]) -> dict[str, float]:
    """Return the states and rates at τ = 0 of the guess of an experiment; empty without a guess."""
    state_values: dict[str, float] = {}
    solved = problem.density().solver.solutions(problem.vector(theta)) if isinstance(e.guess, str) else {}
    states = e.guess if not isinstance(e.guess, str) else solved[e.name].states
    for state, values in states.items():
        state_values[state] = float(values[0])
        if problem.model.orders[state] == 2:
            rate = _fourier.derivative(_fourier.coefficients(values), e.frequency)
            state_values[f"d{state}"] = float(_fourier.on_grid(rate, values.size)[0])
    return state_values


def _ranks(
    campaign: Campaign, experiments: list[Experiment], truth: dict[str, float], chain: Generator, ties: Generator
) -> dict[str, Any]:
    """Return the ranks of the truth in the Laplace approximation and among the draws."""
    problem = campaign.problem.with_experiments(experiments)
    try:
        fit = with_joint(problem, map_estimate(problem, checks=False, progress=False))
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        return {"status": "no estimate", "error": str(error)}
    result: dict[str, Any] = {"map": fit.status, "stop_rule": False}
    if fit.converged:
        result[LAPLACE] = _laplace_cdf(fit, truth)
    try:
        posterior = sample(problem, fit, seed=int(chain.integers(2**32)), progress=False, **campaign.sampler)
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        return result | {"status": "no draws", "error": str(error)}
    rhat, failed = max(posterior.rhat.values()), sum(posterior.failures.values())
    result |= {"stop_rule": posterior.converged, "rhat": rhat, "failed": failed}
    draws = independent_draws(posterior)
    if not rhat <= LARGEST_RHAT or draws is None:
        return result | {"status": "draws not usable"}
    result["draws"] = len(next(iter(draws.values())))
    return result | {"status": DONE, MCMC: {name: position(draws[name], value, ties) for name, value in truth.items()}}


def independent_draws(posterior: Posterior) -> dict[str, np.ndarray] | None:
    """Return draws of every quantity at steps five autocorrelation times apart; None for fewer than 20."""
    tau = max(posterior.tau.values())
    if not np.isfinite(tau):
        return None
    apart = int(np.ceil(DRAW_SPACING * tau))
    draws = {name: posterior.by_step(posterior.draws(name))[:, ::-1][:, ::apart].ravel() for name in posterior.names}
    return draws if min(map(len, draws.values())) >= FEWEST_DRAWS else None


def position(draws: np.ndarray, truth: float, generator: Generator) -> float:
    """Return the randomised normalised rank of the truth, uniform on (0, 1) if draws and truth are exchangeable."""
    rank = np.sum(draws < truth) + generator.integers(np.sum(draws == truth) + 1)
    return float((rank + generator.uniform()) / (draws.size + 1))


def _laplace_cdf(fit: MapEstimate, truth: dict[str, float]) -> dict[str, float]:
    """Return the distribution functions of the Laplace approximation at the truth.

    Student's t of `MapEstimate.interval` for parameters, the joint approximation of the logarithm for variances.
    """
    probabilities = {}
    with np.errstate(invalid="ignore", divide="ignore"):
        for name, value in truth.items():
            if name in fit.theta:
                distance = (value - fit.theta[name]) / fit.sd[name]
                probabilities[name] = float(stdtr(min(fit.degrees_of_freedom[name], 1e9), distance))
            else:
                sd = np.sqrt(fit.joint_covariance[name].to_dict()[name])
                probabilities[name] = float(ndtr(np.log(value / fit.joint_mode[name]) / sd))
    return probabilities
