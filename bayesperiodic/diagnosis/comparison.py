"""Laplace against MCMC, parameter by parameter."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.store import Result

END_SHIFT = 0.25
MONTE_CARLO_ERRORS = 3.0
QUANTILE_ERROR = float(np.sqrt(0.05 * 0.95) / 0.1031)


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

    What counts are the ends of the 90 % interval: Laplace is fine where both agree with those of the draws within a
    quarter of the posterior sd and three Monte Carlo errors (of a normal quantile with the same ESS). Otherwise its
    interval is too narrow or too wide where both ends are off in opposite directions, and of the wrong shape (shifted
    or skewed) where they are not.

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
    if not np.isfinite(row["laplace_sd"]):
        return "too wide"
    tolerance = END_SHIFT + MONTE_CARLO_ERRORS * QUANTILE_ERROR / np.sqrt(size)
    low = (row["q05"] - row["laplace_q05"]) / row["sd"]
    high = (row["q95"] - row["laplace_q95"]) / row["sd"]
    if max(abs(low), abs(high)) <= tolerance:
        return "fine"
    if low < -0.5 * tolerance and high > 0.5 * tolerance:
        return "too narrow"
    if low > 0.5 * tolerance and high < -0.5 * tolerance:
        return "too wide"
    return "wrong shape"
