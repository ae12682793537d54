"""Chains and their diagnostics: the one place that knows ArviZ (0.23 and 1.x)."""

import warnings
from types import ModuleType

import emcee
import numpy as np
import xarray as xr


def arviz() -> ModuleType:
    """Return the arviz module, imported without the notice that its 0.23 series prints."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
        import arviz as module
    return module


def rhat(chains: np.ndarray) -> np.ndarray:
    """Return the rank-normalised split R-hat of each coordinate from independent ensembles.

    Parameters
    ----------
    chains : array (ensembles, steps, walkers, coordinates)
        The walkers of an ensemble depend on each other, so an ensemble is one chain here, its steps in order.
    """
    ensembles, steps, walkers, count = chains.shape
    pooled = chains.reshape(ensembles, steps * walkers, count)
    data = xr.Dataset({str(i): (("chain", "draw"), pooled[:, :, i]) for i in range(count)})
    result = arviz().rhat(data, method="rank")
    return np.array([float(result[str(i)]) for i in range(count)])


def autocorrelation_time(chains: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation time of each coordinate in steps, the mean over the ensembles."""
    return np.mean(
        [emcee.autocorr.integrated_time(ensemble, tol=0, quiet=True, has_walkers=True) for ensemble in chains], axis=0
    )


def quantile_spread(chains: np.ndarray) -> np.ndarray:
    """Return the largest difference between ensembles of the 5, 50 and 95 % quantiles, in pooled sds."""
    ensembles, steps, walkers, count = chains.shape
    pooled = chains.reshape(ensembles, steps * walkers, count)
    quantiles = np.quantile(pooled, [0.05, 0.5, 0.95], axis=1)
    return np.ptp(quantiles, axis=1).max(axis=0) / pooled.reshape(-1, count).std(axis=0)
