"""Simulation-based calibration: coverage of the intervals, and tests of uniformity."""

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
from bayesperiodic._parallel import checkpointed_tasks
from bayesperiodic.diagnostics.adequacy import holm
from bayesperiodic.diagnostics.campaigns import (
    DONE,
    LAPLACE,
    MCMC,
    METHODS,
    SPACING,
    Campaign,
    check_supported,
    replicate,
)
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling.checkpoint import fingerprint

POINTS, SIMULATED, SIMULATION_SEED = 100, 20_000, 0
FEWEST_IN_BIN, MOST_BINS = 20, 20
EDGE = 1e-12


def normal_scores(values: np.ndarray) -> np.ndarray:
    """Return the standard normal quantiles of values in [0, 1], clipped to 1e-12 from the ends."""
    return ndtri(np.clip(values, EDGE, 1.0 - EDGE))


def dispersion_test(values: np.ndarray) -> tuple[float, float]:
    """Return the mean square of the normal scores, of expectation 1, and the two-sided p-value of its χ² distribution.

    If variances are a fifth too small its expectation is 1.25; with 1000 values the power against this alternative at
    a level of 1 % is 99.7 %, that of `ecdf_test` 76 %, of Kolmogorov's test 20 %.
    """
    square = float(np.sum(normal_scores(values) ** 2))
    low, high = stats.chi2.cdf(square, values.size), stats.chi2.sf(square, values.size)
    return square / values.size, float(min(1.0, 2.0 * min(low, high)))


def chi_square_test(values: np.ndarray) -> float:
    """Return p of the χ² test on the histogram; NaN for fewer than 100 values."""
    bins = bin_count(values.size)
    if bins * FEWEST_IN_BIN > values.size:
        return np.nan
    return float(stats.chisquare(np.histogram(values, bins, (0.0, 1.0))[0]).pvalue)


def bin_count(size: int) -> int:
    """Return the number of bins of a histogram."""
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
    """Return the simultaneous band of the empirical distribution function of `size` values, at `evaluation_points`."""
    tail = float(np.quantile(_null(size)[1], 1.0 - level))
    points = evaluation_points()
    return binomial_band(size, points, tail)


def binomial_band(size: int, probabilities: np.ndarray, tail: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the central 1 − `tail` intervals of binomial frequencies in `size` trials."""
    low, high = (np.asarray(stats.binom.ppf(q, size, probabilities)) for q in (0.5 * tail, 1.0 - 0.5 * tail))
    return low / size, high / size


def evaluation_points() -> np.ndarray:
    """Return the points (points,) at which empirical distribution functions are evaluated."""
    return np.arange(1, POINTS) / POINTS


@cache
def _null(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pointwise two-sided tails (size + 1, points) of each count, and simulated minima over the points."""
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
    """Calibration of MCMC and of the Laplace approximation over simulated campaigns.

    Attributes
    ----------
    table : DataFrame
        One row per quantity and method ("mcmc" or "laplace"): number of replicates; dispersion, the mean square of the
        normal scores, above 1 if intervals are too narrow; shift, their mean; p of the dispersion test, the ECDF test
        and the χ² test of the histogram, each adjusted by Holm's method for the quantities of the method; coverage of
        the central 50, 80, 90 and 95 % intervals; verdict: "calibrated", "too narrow", "too wide", "not uniform", or
        "too few replicates" below 20. The probability that a calibrated method gets another verdict for any quantity is
        at most 1 % per test.
    positions : dict of str to dict of str to array (replicates,)
        By method and quantity, between 0 and 1, uniformly distributed if calibrated: for "mcmc" the randomised
        normalised rank of the truth among independent draws; for "laplace" the distribution function at the truth.
        Variances are those of the folded mean.
    failures : dict of str to int
        Number of failed replicates by reason: "no steady state" (of the simulated truth), "fold failed", "no estimate",
        "estimate not converged" (excluded for Laplace), "no draws", "draws not usable" (fewer than 20 independent ones,
        or R-hat above 1.1; excluded for MCMC).
    replicates : int
        Total number.
    stop_rule : int
        Number of chains that passed the stop rule of `sample`.
    draws : float
        Median number of independent draws per rank.
    failed_solves : float
        Mean fraction of proposals whose periodic solve failed.
    synthetic : bool
        Always True.

    Examples
    --------
    Two replicates are too few for a verdict; a thousand reveal miscalibrations of a few per cent:

    >>> calibration.positions["laplace"]["k"].shape, calibration.replicates, calibration.synthetic
    ((2,), 2, True)
    >>> calibration.table[["quantity", "method", "replicates"]]
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
            f"draws per rank, stop rule passed by {self.stop_rule}, failed solves {self.failed_solves:.2%})"
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
    """Test the calibration of the posterior by simulation-based calibration [1]_.

    Each replicate draws θ and the variances from the prior, integrates the model in time to its steady state, records
    as many cycles as the experiment has (at least three) with as many samples per cycle as its grid, adds white noise,
    folds with the harmonics and the frequency of the experiment, and computes the MAP estimate, the Laplace
    approximation and draws of emcee. The periodic solver is not used for the recording, so that its errors are
    detected. Inputs are recorded without noise, as the likelihood assumes.

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
        None computes serially. Replicates of a lost Dask worker are repeated by others; after the loss of workers of
        other executors, repeat the call with the same folder.
    ensembles, walkers, max_steps
        Arguments of `sample` in each replicate. Short chains suffice, because ranks use draws five autocorrelation
        times apart. Too few walkers bias the result: with eight in four dimensions this time was underestimated, and
        the dispersion of exact ranks was 5 to 10 % too large.
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
    check_supported(problem)
    settings = (
        f"{fingerprint(problem)}, seed {seed}, {ensembles} x {walkers} walkers, {max_steps} steps, {SPACING} apart"
    )
    source = hashlib.sha256(f"{importlib.metadata.version('bayesperiodic')}, {settings}".encode()).hexdigest()[:16]
    campaign = Campaign(problem, seed, source, ensembles, walkers, max_steps)
    lines = checkpointed_tasks(
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
    """Summarise the results of all replicates for these quantities."""
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
    """Return the fraction of truths inside the central intervals of this probability."""
    return float(np.mean(np.abs(positions - 0.5) <= 0.5 * level)) if positions.size else np.nan


def _verdict(row: Mapping[Any, Any]) -> str:
    if row["replicates"] < FEWEST:
        return FEW
    if row["p_dispersion"] < FALSE_ALARMS:
        return NARROW if row["dispersion"] > 1.0 else WIDE
    return SHAPE if min(row["p_ecdf"], row["p_chi_square"]) < FALSE_ALARMS else CALIBRATED
