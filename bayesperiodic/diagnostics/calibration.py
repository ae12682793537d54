"""Simulation-based calibration: is a 90 % interval a 90 % interval."""

import hashlib
import importlib.metadata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.special import ndtri

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._parallel import resumed
from bayesperiodic.diagnostics.adequacy import holm
from bayesperiodic.diagnostics.campaigns import APART, DONE, LAPLACE, MCMC, METHODS, Campaign, refuse, replicate
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling.checkpoint import fingerprint

POINTS, SIMULATED, SIMULATION_SEED = 100, 20_000, 0
FEWEST_IN_BIN, MOST_BINS = 20, 20
EDGE = 1e-12


def normal_scores(values: np.ndarray) -> np.ndarray:
    """Return the standard normal quantiles of values in (0, 1); those at the ends count as 1e-12 from them."""
    return ndtri(np.clip(values, EDGE, 1.0 - EDGE))


def dispersion_test(values: np.ndarray) -> tuple[float, float]:
    """Return the mean square of the normal scores, 1 on average, and the two-sided p-value of its χ² distribution.

    Intervals that are too narrow put the truth into their tails and raise it, to 1.25 if variances are a fifth too
    small. With 1000 values a level of 1 % sees that in 99.7 % of cases, `ecdf_test` in 76 %, Kolmogorov's in 20 %.
    """
    square = float(np.sum(normal_scores(values) ** 2))
    low, high = stats.chi2.cdf(square, values.size), stats.chi2.sf(square, values.size)
    return square / values.size, float(min(1.0, 2.0 * min(low, high)))


def chi_square_test(values: np.ndarray) -> float:
    """Return p of the χ² test on the histogram; NaN for too few values for five bins."""
    bins = bin_count(values.size)
    if bins * FEWEST_IN_BIN > values.size:
        return np.nan
    return float(stats.chisquare(np.histogram(values, bins, (0.0, 1.0))[0]).pvalue)


def bin_count(size: int) -> int:
    """Return how many bins a histogram of so many values has."""
    return int(np.clip(size // FEWEST_IN_BIN, 5, MOST_BINS))


def ecdf_test(values: np.ndarray) -> float:
    """Return p of the empirical distribution function's smallest pointwise binomial tail ([1]_, section 3).

    The null distribution is simulated once for every number of values, with a fixed seed.

    References
    ----------
    .. [1] T. Säilynoja, P.-C. Bürkner, A. Vehtari, Graphical test for discrete uniformity and its applications in
       goodness-of-fit evaluation and multiple sample comparison, Statistics and Computing 32 (2022) 32.
    """
    table, null = _null(values.size)
    counts = np.searchsorted(np.sort(values), evaluation_points(), side="right")
    smallest = table[counts, np.arange(counts.size)].min()
    return float((1 + np.sum(null <= smallest * (1.0 + 1e-9))) / (1 + null.size))


def ecdf_band(size: int, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the band that holds the whole empirical distribution function of so many values with a probability.

    Parameters
    ----------
    size : int
        Number of values.
    level : float
        The probability.

    Returns
    -------
    low, high : array (points,)
        At `evaluation_points`.
    """
    tail = float(np.quantile(_null(size)[1], 1.0 - level))
    points = evaluation_points()
    return binomial_band(size, points, tail)


def binomial_band(size: int, probabilities: np.ndarray, tail: float) -> tuple[np.ndarray, np.ndarray]:
    """Return between which shares of `size` trials all but a share `tail` of outcomes lie, at each probability."""
    low, high = (np.asarray(stats.binom.ppf(q, size, probabilities)) for q in (0.5 * tail, 1.0 - 0.5 * tail))
    return low / size, high / size


def evaluation_points() -> np.ndarray:
    """Return where the empirical distribution function is looked at, (points,)."""
    return np.arange(1, POINTS) / POINTS


@cache
def _null(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pointwise two-sided tails (size + 1, points) of each count, and simulated smallest ones."""
    counts, points = np.arange(size + 1)[:, None], evaluation_points()
    table = 2.0 * np.minimum(stats.binom.cdf(counts, size, points), stats.binom.sf(counts - 1, size, points))
    generator = np.random.default_rng(SIMULATION_SEED)
    drawn = generator.multinomial(size, np.full(POINTS, 1.0 / POINTS), SIMULATED).cumsum(axis=1)[:, :-1]
    return table, table[drawn, np.arange(POINTS - 1)].min(axis=1)


FILE = "replicates.jsonl"
LEVELS = (0.5, 0.8, 0.9, 0.95)
FALSE_ALARMS = 0.01
CALIBRATED, NARROW, WIDE, SHAPE, FEW = "calibrated", "too narrow", "too wide", "not uniform", "too few replicates"
FEWEST = 20
TESTS = ("p_dispersion", "p_ecdf", "p_chi_square")


@dataclass(frozen=True)
class Calibration(Result):
    """Where the truth lay among the answers, over many simulated campaigns.

    Attributes
    ----------
    table : DataFrame
        A row a quantity and method ("mcmc" or "laplace"): replicates counted; dispersion, the mean square of the normal
        scores, above 1 where intervals are too narrow; shift, their mean; p of the dispersion test, of the ECDF test
        and of the χ² test of the histogram, each adjusted by Holm's method for the quantities of the method; coverage
        of the central 50, 80, 90 and 95 % intervals; verdict: "calibrated", "too narrow", "too wide", "not uniform", or
        "too few replicates" below 20. A well calibrated method gets another verdict than the first for some quantity
        with a probability of at most 1 % a test.
    positions : dict of str to dict of str to array (replicates,)
        By method and quantity, between 0 and 1: for "mcmc" the rank of the truth among independent draws with ties at
        random, plus a uniform share of one; for "laplace" its distribution function at the truth. Uniform if
        calibrated. A variance is that of the folded mean.
    failures : dict of str to int
        Replicates by what they failed of: "no steady state" (the truth has none, so that nothing can be recorded),
        "fold failed", "no estimate", "estimate not converged" (without Laplace), "no draws", "draws not usable" (fewer
        than 20 independent ones, or R-hat above 1.1; without MCMC).
    replicates : int
        All of them, failed or not.
    stop_rule : int
        How many chains passed the stop rule of `sample` too.
    draws : float
        Median number of independent draws behind a rank.
    failed_solves : float
        Mean share of proposals whose periodic solve failed.
    synthetic : bool
        Always True.

    Examples
    --------
    Two replicates are too few for a verdict, but show what is there; a thousand tell miscalibrations of a few per cent:

    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(32) / 32)
    >>> run = bp.Experiment("run", 0.1, {"displacement": force}, {"force": force}, samples=32, cycles=4,
    ...                     harmonics={"displacement": 5, "force": 5})
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"k": bp.LogNormal(1, 0.1)}, scheme="fourier",
    ...                      fixed={"m": 1, "c": 0.2, "k3": 0.5, "variance[displacement]": 1e-4})
    >>> found = bp.calibrate(problem, replicates=2, seed=1, max_steps=250, progress=False)
    >>> found.positions["laplace"]["k"].shape, found.replicates, found.synthetic
    ((2,), 2, True)
    >>> found.table[["quantity", "method", "replicates"]]
      quantity   method  replicates
    0        k     mcmc           2
    1        k  laplace           2
    """

    table: pd.DataFrame
    positions: dict[str, dict[str, np.ndarray]]
    failures: dict[str, int]
    replicates: int
    stop_rule: int
    draws: float
    failed_solves: float
    synthetic: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities: parameters, then free variances."""
        return tuple(self.positions[MCMC])

    def __repr__(self) -> str:
        failed = ", ".join(f"{kind} {count}" for kind, count in self.failures.items()) or "none"
        head = (
            f"Calibration over {self.replicates} synthetic campaigns (failed: {failed}; {self.draws:.0f} independent "
            f"draws a rank, stop rule passed by {self.stop_rule}, failed solves {self.failed_solves:.2%})"
        )
        return f"{head}\n{self.table.to_string(float_format='{:.3g}'.format, index=False)}"


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
    """Simulate campaigns with truths from the prior, analyse each, and test where the truths lie.

    This is simulation-based calibration [1]_. Each replicate draws θ and the variances, integrates the model in time
    until it is steady, records as many cycles as the experiment has (three at least) with as many samples a cycle as
    its grid, adds white noise, folds with the experiment's harmonics and frequency, and finds the MAP point, the
    Laplace approximation and draws of emcee. The periodic solver has no part in the recording, so that its errors show.
    Inputs are recorded without noise, as the likelihood takes them.

    A likelihood that counts more independent values than the harmonics have, or a grid that is too coarse, comes out
    as "too narrow" or "not uniform". A wrong model does not: truths are drawn from the model.

    Parameters
    ----------
    problem : Problem
        Forced, with whole histories of one forcing period, `bayesperiodic.noise.Independent` with a proper prior or
        known variances. Of its data only the settings count.
    replicates : int
    seed : int
        Replicate k depends on the seed and k alone, whoever computes it.
    folder : path, optional
        Each replicate is written to ``replicates.jsonl`` there as it ends; the same call does only the missing ones,
        and one with more replicates those that are new.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        None does one replicate after the other. Those of a lost Dask worker are done again by others; where other
        executors lose their workers, the same call goes on from the folder.
    ensembles, walkers, max_steps
        Of each replicate's `sample`. Short chains are enough, because a rank takes only draws at steps five
        autocorrelation times apart; but not few walkers: with eight in four dimensions the ensemble as a whole moved
        more slowly than that time tells, and the dispersion of exact ranks came out 5 to 10 % too large.
    progress : bool

    Returns
    -------
    Calibration

    Raises
    ------
    ValueError
        For an improper prior, or a problem whose recordings are not simulated here; if the folder is in use.
    RuntimeError
        If the executor's workers died; what was done is in the folder.

    References
    ----------
    .. [1] S. Talts, M. Betancourt, D. Simpson, A. Vehtari, A. Gelman, Validating Bayesian inference algorithms with
       simulation-based calibration, arXiv:1804.06788, 2018.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(32) / 32)
    >>> run = bp.Experiment("run", 0.1, {"displacement": force}, {"force": force}, samples=32, cycles=4,
    ...                     harmonics={"displacement": 5, "force": 5})
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"k": bp.LogNormal(1, 0.1)}, scheme="fourier",
    ...                      fixed={"m": 1, "c": 0.2, "k3": 0.5, "variance[displacement]": 1e-4})
    >>> found = bp.calibrate(problem, replicates=2, seed=1, max_steps=250, progress=False)
    >>> found.failures, found.names, found.table["verdict"].tolist()
    ({}, ('k',), ['too few replicates', 'too few replicates'])
    """
    _checks.integer("replicates", replicates, 1)
    _checks.integer("seed", seed, 0)
    refuse(problem)
    settings = f"{fingerprint(problem)}, seed {seed}, {ensembles} x {walkers} walkers, {max_steps} steps, {APART} apart"
    source = hashlib.sha256(f"{importlib.metadata.version('bayesperiodic')}, {settings}".encode()).hexdigest()[:16]
    campaign = Campaign(problem, seed, source, ensembles, walkers, max_steps)
    lines = resumed(
        None if folder is None else Path(folder) / FILE,
        range(replicates),
        replicate,
        lambda line: line["number"],
        source,
        shared=campaign,
        executor=executor,
        progress=progress,
    )
    return summary(lines, (*problem.names, *problem.free_noise))


def summary(lines: Sequence[dict[str, Any]], names: Sequence[str]) -> Calibration:
    """Return what the lines of all replicates say of these quantities."""
    positions = {
        method: {name: np.array([line[method][name] for line in lines if method in line]) for name in names}
        for method in METHODS
    }
    failures = Counter(line["status"] for line in lines if line["status"] != DONE)
    if unconverged := sum("map" in line and LAPLACE not in line for line in lines):
        failures["estimate not converged"] = unconverged
    tables = [_table(method, positions[method]) for method in METHODS]
    return Calibration(
        table=pd.concat(tables, ignore_index=True),
        positions=positions,
        failures=dict(sorted(failures.items())),
        replicates=len(lines),
        stop_rule=sum(line.get("stop_rule", False) for line in lines),
        draws=float(np.median([line["draws"] for line in lines if "draws" in line] or [0])),
        failed_solves=float(np.mean([line["failed"] for line in lines if "failed" in line] or [0.0])),
    )


def _table(method: str, positions: dict[str, np.ndarray]) -> pd.DataFrame:
    rows = []
    for name, values in positions.items():
        finite = values[np.isfinite(values)]
        row: dict[str, Any] = {"quantity": name, "method": method, "replicates": finite.size}
        row |= dict.fromkeys(("dispersion", "shift", *TESTS), np.nan)
        if finite.size >= FEWEST:
            row["dispersion"], row["p_dispersion"] = dispersion_test(finite)
            row["shift"] = float(normal_scores(finite).mean())
            row["p_ecdf"], row["p_chi_square"] = ecdf_test(finite), chi_square_test(finite)
        row |= {f"coverage_{100 * level:.0f}": coverage(finite, level) for level in LEVELS}
        rows.append(row)
    table = pd.DataFrame(rows)
    for test in TESTS:
        table[test] = holm(table[test].to_numpy(dtype=float))
    table["verdict"] = [_verdict(row) for row in table.to_dict("records")]
    return table


def coverage(positions: np.ndarray, level: float) -> float:
    """Return the share of truths inside the central interval that should hold them with this probability."""
    return float(np.mean(np.abs(positions - 0.5) <= 0.5 * level)) if positions.size else np.nan


def _verdict(row: Mapping[Any, Any]) -> str:
    if row["replicates"] < FEWEST:
        return FEW
    if row["p_dispersion"] < FALSE_ALARMS:
        return NARROW if row["dispersion"] > 1.0 else WIDE
    return SHAPE if min(row["p_ecdf"], row["p_chi_square"]) < FALSE_ALARMS else CALIBRATED
