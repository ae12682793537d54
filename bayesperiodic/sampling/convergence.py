"""Convergence diagnostics of chains; calls of ArviZ (0.23 and 1.x).

A chain, in the sense of ArviZ, is an independent ensemble. Its draws are those of the first half of the steps, walker
by walker, then those of the second half. So the halves that R-hat compares are early and late, and the autocorrelation
from which ArviZ counts effective draws is that along the walkers. Step by step it would see different walkers in
neighbouring draws and count ten times too many.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtri

from bayesperiodic.problem.parameters import CHAIN, DRAW

if TYPE_CHECKING:
    import xarray as xr

FEWEST_WEIGHTS, EQUAL_WEIGHTS, LARGEST_LOG_RATIO = 0.25, 1e-6, 700.0
WINDOW = 5.0  # of the sum of autocorrelations, in autocorrelation times
QUANTILE_LEVELS = np.array([0.05, 0.5, 0.95])


def arviz() -> ModuleType:
    """Return the arviz module, imported without the notice of version 0.23, also if no cache folder can be written."""
    from unittest import mock

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
        with suppress(OSError):  # version 0.23 keeps the date of its notice in the cache folder of the user
            import arviz as module

            return module
        with tempfile.TemporaryDirectory() as folder, mock.patch("platformdirs.user_cache_dir", return_value=folder):
            import arviz as module
    return module


def for_arviz(tree: xr.DataTree) -> Any:
    """Return a tree as the installed ArviZ takes it, in version 0.23 as InferenceData."""
    module = arviz()
    return module.from_datatree(tree) if module.__version__.startswith("0.") else tree


def as_chains(values: np.ndarray) -> np.ndarray:
    """Return values (ensembles, steps, walkers, …) as (chains, draws, …)."""
    halves = np.split(values, [values.shape[1] // 2], axis=1)
    return np.concatenate([h.swapaxes(1, 2).reshape(len(h), -1, *h.shape[3:]) for h in halves], axis=1)


def rhat(values: np.ndarray) -> float:
    """Return ArviZ's rank-normalised split R-hat of values (chains, draws)."""
    return _of_arviz("rhat", values, "rank")


def effective_size(values: np.ndarray) -> float:
    """Return ArviZ's effective sample size of values (chains, draws), "ess_bulk"; NaN if they do not vary."""
    return _of_arviz("ess", values, "bulk") if np.ptp(values) > 0.0 else np.nan


def mean_error(values: np.ndarray) -> float:
    """Return ArviZ's Monte Carlo error of the mean of values (chains, draws), "mcse_mean"; NaN if they do not vary.

    In units of their sd: ArviZ takes values within 1e-15 of each other for constant.
    """
    sd = values.std()
    return float(sd * _of_arviz("mcse", (values - values.mean()) / sd, "mean")) if np.ptp(values) > 0.0 else np.nan


def _of_arviz(statistic: str, values: np.ndarray, method: str) -> float:
    import xarray as xr

    data = xr.Dataset({"x": ((CHAIN, DRAW), values)})
    return float(getattr(arviz(), statistic)(data, method=method)["x"])


def autocorrelation_time(chains: Any) -> np.ndarray:
    """Return the integrated autocorrelation time of each coordinate in steps, the mean over the ensembles.

    emcee subtracts the mean of each walker, which makes its estimate too small, however many walkers there are: by 18 %
    at 50 autocorrelation times. The factor 1 + (2·window + 1)/steps corrects that to first order (U. Wolff, Monte Carlo
    errors with less errors, Computer Physics Communications 156 (2004) 143-153).
    """
    from emcee.autocorr import integrated_time

    with np.errstate(invalid="ignore"):  # a walker that has not moved yet
        times = [
            [integrated_time(e[..., None], c=WINDOW, tol=0, quiet=True, has_walkers=True)[0] for e in chains[..., k]]
            for k in range(chains.shape[-1])
        ]
    mean = np.mean(times, axis=1)
    return mean * (1.0 + (2.0 * WINDOW * mean + 1.0) / chains.shape[1])


def quantile_spread(chains: Any) -> np.ndarray:
    """Return the largest difference between ensembles of the 5, 50 and 95 % quantiles, in sds of a normal distribution.

    It is that of the fractions of draws up to the pooled quantiles, over the normal density there: between two modes a
    quantile is nowhere certain, but the fraction is.
    """
    density = np.exp(-0.5 * ndtri(QUANTILE_LEVELS) ** 2) / np.sqrt(2.0 * np.pi)

    def spread(values: np.ndarray) -> float:
        pooled = np.quantile(values, QUANTILE_LEVELS)
        below = np.stack([np.mean(values <= quantile, axis=(1, 2)) for quantile in pooled])
        return float(np.max(np.ptp(below, axis=1) / density))

    # One after the other: each takes as much memory as its draws.
    return np.array([spread(chains[..., i]) for i in range(chains.shape[-1])])


def pareto_k(log_weights: np.ndarray) -> float:
    """Return the Pareto shape k̂ of the upper tail of importance weights; ∞ if less than a quarter are positive.

    Equal weights, to within a millionth, have no tail: 0. The logarithm of a weight of zero is −∞. From A. Vehtari et
    al., Pareto smoothed importance sampling, Journal of Machine Learning Research 25 (2024) 1-58.
    """
    import xarray as xr

    positive = np.isfinite(log_weights)
    if positive.mean() < FEWEST_WEIGHTS:
        return np.inf
    if np.ptp(log_weights[positive]) < EQUAL_WEIGHTS:
        return 0.0
    top = log_weights[positive].max()
    weights = np.maximum(log_weights, top - LARGEST_LOG_RATIO)
    module = arviz()
    if hasattr(module, "psislw"):
        return float(module.psislw(weights)[1])
    # ArviZ 1.x expects the negative, as of a log-likelihood that is left out.
    return float(xr.DataArray(-weights, dims="draw").azstats.psislw(dim="draw")[1])


# Number of passes of the stop rule in succession after which sampling ends.
PASSES = 2
LENGTHS = 50.0
LENGTHS_ALONE = 500.0
TAU_CHANGE = 0.05
RHAT = 1.005
QUANTILE_SPREAD = 0.25
STUCK_DISTANCE = 8.0


def stop_rule(
    kept: Any, modes: np.ndarray | None, last: np.ndarray, labels: Sequence[str]
) -> tuple[np.ndarray, list[str]]:
    """Return autocorrelation times [steps], now, and the criteria of the stop rule that are not met, in words.

    `kept` are chains (ensembles, steps, walkers, coordinates), an array or `StoredChains`, `last` the times at the
    previous check, empty at the first one. If there are several optima, `modes` (ensembles, steps, walkers) contains
    that of each draw: the fractions of those that are visited must meet the criteria too, and their times follow those
    of the coordinates.
    """
    tau, count = autocorrelation_time(kept), kept.shape[-1]
    missing = unmet_criteria(kept, tau, last[:count] if last.size else np.full(count, np.inf), labels)
    if modes is None or len(visited := np.unique(modes)) < 2:
        return tau, missing
    inside = (modes[..., None] == visited[1:]).astype(float)
    of_modes = autocorrelation_time(inside)
    before = last[count:] if last.size == count + of_modes.size else np.full(of_modes.size, np.inf)
    names = [f"mode {row}" for row in visited[1:]]
    weights = [f"weights of modes: {text}" for text in unmet_criteria(inside, of_modes, before, names)]
    return np.concatenate([tau, of_modes]), missing + weights


def unmet_criteria(kept: Any, tau: np.ndarray, last: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Return the criteria of the stop rule that are not met, in words.

    An ensemble of 32 walkers that is 50 autocorrelation times long contains 1600 independent draws, a single walker
    would contain 50; therefore it must be 500 autocorrelation times long. The mean of a walker scatters by its standard
    deviation over √(steps/tau); one that is eight times as far off remains in a mode of its own.

    `kept` are chains (ensembles, steps, walkers, coordinates); `tau` and `last` are autocorrelation times [steps] of
    the coordinates, now and at the previous check; `labels` are the names of the coordinates.
    """
    unmet = []
    if not np.isfinite(tau).all():
        still = [label for label, time in zip(labels, tau, strict=True) if not np.isfinite(time)]
        return [f"{', '.join(map(repr, still))} not moving, as every proposal is refused"]
    needed = LENGTHS if kept.shape[2] > 1 else LENGTHS_ALONE
    if (lengths := kept.shape[1] / tau.max()) < needed:
        unmet.append(f"length only {lengths:.0f} tau")
    # Only of the longest one: the largest change of twenty times exceeds the limit by chance alone.
    if (change := abs(tau.max() - last.max()) / tau.max()) > TAU_CHANGE:
        unmet.append(f"tau changed by {change:.0%}" if np.isfinite(change) else "tau known from one check alone")
    if (spread := quantile_spread(kept).max()) > QUANTILE_SPREAD:
        unmet.append(f"quantiles of the ensembles {spread:.2f} sd apart")
    if not unmet and (alone := _furthest(kept, tau)) > STUCK_DISTANCE:
        unmet.append(f"walkers that stay apart, by {alone:.0f} standard errors")
    if not unmet and (worst := max(rhat(as_chains(kept[..., i])) for i in range(kept.shape[-1]))) > RHAT:
        unmet.append(f"R-hat {worst:.3f}")
    return unmet


def _furthest(kept: Any, tau: np.ndarray) -> float:
    """Return the largest distance of a walker's mean from the mean of all, in standard errors of such a mean."""
    columns = (kept[..., i] for i in range(kept.shape[-1]))
    off = [float(np.max(np.abs(c.mean(axis=1) - c.mean()) / c.std())) for c in columns]
    return float(np.max(off / np.sqrt(tau / kept.shape[1])))
