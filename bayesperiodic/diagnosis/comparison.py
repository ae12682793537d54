"""Laplace against MCMC, parameter by parameter."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from bayesperiodic.inference.map_estimate import MapEstimate
from bayesperiodic.inference.posterior import Posterior
from bayesperiodic.inference.problem import Problem
from bayesperiodic.store import Result

SHIFT = 0.25
NARROW, WIDE = 0.85, 1.18
SKEWNESS = 0.5
SIGMAS = 3.0


@dataclass(frozen=True)
class Comparison(Result):
    """Where the Laplace approximation and the posterior draws disagree.

    Attributes
    ----------
    table : DataFrame
        A row a parameter: map, laplace_sd, mean, sd, shift (mean − map in posterior sds), sd_ratio (Laplace over
        posterior), skewness, the 5 and 95 % quantiles of both, and the verdict: "fine", "too narrow", "too wide",
        "wrong shape", or "not converged" where the draws cannot be trusted.
    """

    table: pd.DataFrame

    def __repr__(self) -> str:
        return self.table.to_string(float_format="{:.4g}".format)


def compare(problem: Problem, fit: MapEstimate, posterior: Posterior) -> Comparison:
    """Compare the Laplace approximation of every parameter with its posterior draws.

    A departure counts when it is large enough to matter and larger than three Monte Carlo errors: a shift of the mean
    by 0.25 sd or a skewness of 0.5 is a wrong shape; Laplace's sd below 0.85 or above 1.18 of the posterior's is too
    narrow or too wide.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior

    Returns
    -------
    Comparison
    """
    rows = {}
    for name in problem.names:
        draws, size = posterior.draws(name), posterior.ess[name]
        mean, sd = float(draws.mean()), float(draws.std(ddof=1))
        row = {
            "map": fit.theta[name],
            "laplace_sd": fit.sd[name],
            "mean": mean,
            "sd": sd,
            "shift": (mean - fit.theta[name]) / sd,
            "sd_ratio": fit.sd[name] / sd,
            "skewness": float(np.mean(((draws - mean) / sd) ** 3)),
            "laplace_q05": fit.theta[name] - 1.6449 * fit.sd[name],
            "q05": float(np.quantile(draws, 0.05)),
            "laplace_q95": fit.theta[name] + 1.6449 * fit.sd[name],
            "q95": float(np.quantile(draws, 0.95)),
        }
        rows[name] = {**row, "verdict": _verdict(row, size) if posterior.converged else "not converged"}
    return Comparison(pd.DataFrame.from_dict(rows, orient="index"))


def _verdict(row: dict[str, float], size: float) -> str:
    error = SIGMAS / np.sqrt(size)
    if not np.isfinite(row["laplace_sd"]):
        return "too wide"
    if abs(row["shift"]) > SHIFT + error or abs(row["skewness"]) > SKEWNESS + np.sqrt(6.0) * error:
        return "wrong shape"
    if row["sd_ratio"] < NARROW * (1.0 - error):
        return "too narrow"
    if row["sd_ratio"] > WIDE * (1.0 + error):
        return "too wide"
    return "fine"
