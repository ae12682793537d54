"""Convergence diagnostics of chains; calls of ArviZ (0.23 and 1.x)."""

import tempfile
import warnings
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType
from unittest import mock

import emcee
import numpy as np
import xarray as xr

FEWEST_WEIGHTS, EQUAL, SMALLEST = 0.25, 1e-6, 700.0


def arviz() -> ModuleType:
    """Return the arviz module, imported without the notice of version 0.23, also if no cache folder can be written."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
        with suppress(OSError):  # version 0.23 keeps the date of its notice in the cache folder of the user
            import arviz as module

            return module
        with tempfile.TemporaryDirectory() as folder, mock.patch("platformdirs.user_cache_dir", return_value=folder):
            import arviz as module
    return module


def rhat(chains: np.ndarray) -> np.ndarray:
    """Return the rank-normalised split R-hat of each coordinate of chains (ensembles, steps, walkers, coordinates).

    The walkers of an ensemble depend on each other; therefore an ensemble is one chain here, its steps in order.
    """
    count = chains.shape[-1]
    pooled = chains.reshape(len(chains), -1, count)
    data = xr.Dataset({str(i): (("chain", "draw"), pooled[:, :, i]) for i in range(count)})
    result = arviz().rhat(data, method="rank")
    return np.array([float(result[str(i)]) for i in range(count)])


def autocorrelation_time(chains: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation time of each coordinate in steps, the mean over the ensembles."""
    with np.errstate(invalid="ignore"):  # a walker that has not moved yet
        times = [emcee.autocorr.integrated_time(e, tol=0, quiet=True, has_walkers=True) for e in chains]
    return np.mean(times, axis=0)


def quantile_spread(chains: np.ndarray) -> np.ndarray:
    """Return the largest difference between ensembles of the 5, 50 and 95 % quantiles, in pooled sds."""
    pooled = chains.reshape(len(chains), -1, chains.shape[-1])
    quantiles = np.quantile(pooled, [0.05, 0.5, 0.95], axis=1)
    return np.ptp(quantiles, axis=1).max(axis=0) / pooled.reshape(-1, pooled.shape[-1]).std(axis=0)


def pareto_k(log_weights: np.ndarray) -> float:
    """Return the Pareto shape k̂ of the upper tail of importance weights; ∞ if less than a quarter are positive.

    Equal weights, to within a millionth, have no tail: 0. The logarithm of a weight of zero is −∞. From A. Vehtari et
    al., Pareto smoothed importance sampling, Journal of Machine Learning Research 25 (2024) 1-58.
    """
    positive = np.isfinite(log_weights)
    if positive.mean() < FEWEST_WEIGHTS:
        return np.inf
    if np.ptp(log_weights[positive]) < EQUAL:
        return 0.0
    top = log_weights[positive].max()
    weights = np.maximum(log_weights, top - SMALLEST)
    module = arviz()
    if hasattr(module, "psislw"):
        return float(module.psislw(weights)[1])
    # ArviZ 1.x expects the negative, as of a log-likelihood that is left out.
    return float(xr.DataArray(-weights, dims="draw").azstats.psislw(dim="draw")[1])


# Steps between checks of the stop rule, and the number of passes in succession after which sampling ends.
BLOCK, PASSES = 250, 2
LENGTHS = 50.0
LENGTHS_ALONE = 500.0
TAU_CHANGE = 0.05
RHAT = 1.005
QUANTILE_SPREAD = 0.25
APART = 8.0


def unmet_criteria(kept: np.ndarray, tau: np.ndarray, last: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Return the criteria of the stop rule that are not met, in words.

    An ensemble of 32 walkers that is 50 autocorrelation times long contains 1600 independent draws, a single walker
    would contain 50; therefore it must be 500 autocorrelation times long. The mean of a walker scatters by its standard
    deviation over √(steps/tau); one that is eight times as far off remains in a mode of its own.

    `kept` are chains (ensembles, steps, walkers, coordinates); `tau` and `last` are autocorrelation times [steps] of
    the coordinates, now and at the previous check; `labels` are the names of the coordinates.
    """
    found = []
    if not np.isfinite(tau).all():
        still = [label for label, time in zip(labels, tau, strict=True) if not np.isfinite(time)]
        return [f"{', '.join(map(repr, still))} not moving, as every proposal is refused"]
    needed = LENGTHS if kept.shape[2] > 1 else LENGTHS_ALONE
    if (lengths := kept.shape[1] / tau.max()) < needed:
        found.append(f"length only {lengths:.0f} tau")
    if (change := np.max(np.abs(tau - last) / tau)) > TAU_CHANGE:
        found.append(f"tau changed by {change:.0%}" if np.isfinite(change) else "tau known from one check alone")
    if (spread := quantile_spread(kept).max()) > QUANTILE_SPREAD:
        found.append(f"quantiles of the ensembles {spread:.2f} sd apart")
    if not found and (alone := _furthest(kept, tau)) > APART:
        found.append(f"walkers that stay apart, by {alone:.0f} standard errors")
    if not found and (worst := rhat(kept).max()) > RHAT:
        found.append(f"R-hat {worst:.3f}")
    return found


def _furthest(kept: np.ndarray, tau: np.ndarray) -> float:
    """Return the largest distance of a walker's mean from the mean of all, in standard errors of such a mean."""
    off = np.abs(kept.mean(axis=1) - kept.mean(axis=(0, 1, 2)))
    return float(np.max(off / (kept.std(axis=(0, 1, 2)) * np.sqrt(tau / kept.shape[1]))))
