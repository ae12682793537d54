"""Draws with the robust covariance: what a misspecified model still says of its parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic._linalg import covariance_eigh, scaled
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.problem.parameters import CHAIN, DRAW, column, places, support

if TYPE_CHECKING:
    import xarray as xr

# Group of the robust covariance in draws of a misspecified model; attribute of draws that have this covariance.
ROBUST, MISFIT = "robust", "misfit"

# Eigenvalues of the correlations of the draws, relative to the largest, below which a direction keeps its spread.
LEAST_SPREAD = 1e-12


def no_robust(fit: MapEstimate, optima: int) -> str:
    """Return why an estimate has no robust covariance of draws that belong to this number of optima; "" if it has."""
    if fit.checks is None or fit.robust_covariance is None:
        return "an estimate without it; give map_estimate(problem), with its checks"
    if optima > 1:
        return "draws that belong to several optima; give priors that exclude all but one"
    if np.isnan(np.diag(fit.robust_covariance)).any():
        return "NaN; see fit.undetermined, and fix what the data do not determine"
    return ""


def add_robust(tree: xr.DataTree, fit: MapEstimate, optima: int) -> None:
    """Add to draws of a misspecified model why it is, and the robust covariance of its estimate if it has one."""
    import xarray as xr

    if fit.misspecified:
        tree.attrs[MISFIT] = fit.misfit
        if not no_robust(fit, optima):
            tree[ROBUST] = xr.DataTree(robust_group(fit, tree["posterior"].to_dataset()))


def robust_group(fit: MapEstimate, posterior: xr.Dataset) -> xr.Dataset:
    """Return the robust covariance (names, names) in sampling coordinates as a dataset, with the names of the rows."""
    import xarray as xr

    names = [*fit.theta]
    slopes = [1.0 / fit.theta[n] if support(posterior, n) == (0.0, np.inf) else 1.0 for n in names]
    covariance = scaled(fit.robust_covariance.loc[names, names].to_numpy(), np.array(slopes))
    rows = "parameter", "other parameter"
    return xr.Dataset({"covariance": (rows, covariance)}, coords=dict.fromkeys(rows[:1], names) | {rows[1]: names})


def with_robust_covariance(posterior: xr.Dataset, robust: xr.Dataset) -> xr.Dataset:
    """Return draws with this covariance in sampling coordinates, see `Posterior.robust`."""
    names, shape = robust["parameter"].to_numpy().tolist(), (posterior.sizes[CHAIN], posterior.sizes[DRAW])
    ends = [support(posterior, name) for name in names]
    logs = np.array([end == (0.0, np.inf) for end in ends])
    points = np.stack([column(posterior, name).ravel() for name in names], axis=-1)
    points[:, logs] = np.log(points[:, logs])
    points = stretched(points, robust["covariance"].to_numpy())
    with np.errstate(over="ignore"):  # of parameters that the data leave open by hundreds of orders of magnitude
        points[:, logs] = np.exp(points[:, logs])
    result = posterior.copy(deep=True)
    for name, values, (low, high) in zip(names, points.T, ends, strict=True):
        variable, at = places(posterior)[name]
        result[variable].loc[at] = reflected(values, low, high).reshape(shape)
    return result


def stretched(points: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return points (draws, names) moved linearly about their mean, so that their covariance is the given one.

    The map is T = C^(−1/2) (C^(1/2) R C^(1/2))^(1/2) C^(−1/2), from covariance C to R, in units of the draws' sds:
    of all linear maps the one that moves normally distributed points least (I. Olkin, F. Pukelsheim, Linear Algebra
    Appl. 48 (1982) 257-263). Parameters without a finite variance in R keep their draws.
    """
    result = points.copy()
    known = np.isfinite(np.diag(covariance)) & (np.ptp(points, axis=0) > 0.0)
    if not known.any():
        return result
    mean = points[:, known].mean(axis=0)
    values, vectors, sd = covariance_eigh(np.atleast_2d(np.cov(points[:, known], rowvar=False)))
    kept = values > LEAST_SPREAD * values[-1]
    values, vectors = values[kept], vectors[:, kept]
    root, inverse = ((vectors * values**power) @ vectors.T for power in (0.5, -0.5))
    target = scaled(covariance[np.ix_(known, known)], 1.0 / sd)
    middle, turned = np.linalg.eigh(root @ target @ root)
    there = (turned * np.sqrt(np.maximum(middle, 0.0))) @ turned.T
    whole = inverse @ there @ inverse + np.eye(len(sd)) - vectors @ vectors.T
    result[:, known] = mean + ((points[:, known] - mean) / sd) @ whole * sd
    return result


def reflected(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return values with those beyond an end of the interval reflected at it."""
    if np.isfinite(low) and np.isfinite(high):
        width = high - low
        moved = low + np.abs((values - low + width) % (2.0 * width) - width)
    elif np.isfinite(low):
        moved = low + np.abs(values - low)
    elif np.isfinite(high):
        moved = high - np.abs(high - values)
    else:
        return values
    return np.where((values < low) | (values > high), moved, values)
