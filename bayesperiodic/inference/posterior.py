"""Posterior: draws, and how far they can be trusted."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from bayesperiodic.store import Result


@dataclass(frozen=True)
class Posterior(Result):
    """Draws from the posterior of θ and the channel variances.

    Attributes
    ----------
    data : DataTree
        Group ``posterior``: every parameter with dims (chain, draw), ``variance`` with dims (chain, draw, channel); a
        chain is a walker, the coordinate ``ensemble`` tells to which ensemble it belongs. Group ``sample_stats``: lp,
        the log-density in sampling coordinates. Groups ``observed_data`` and ``constant_data``.
    converged : bool
        True if the stop rule was passed.
    reason : str
        Why sampling stopped.
    tau, ess, rhat : dict of str to float
        Integrated autocorrelation time [steps], effective sample size (draws / tau), R-hat between ensembles; in
        sampling coordinates, by parameter and ``variance[channel]``.
    acceptance : float
        Mean fraction of accepted proposals.
    failures : dict of str to float
        Fraction of proposals whose periodic solve failed, by status.
    log_posterior_calls : int
    seed : int
    """

    data: xr.DataTree
    converged: bool
    reason: str
    tau: dict[str, float]
    ess: dict[str, float]
    rhat: dict[str, float]
    acceptance: float
    failures: dict[str, float]
    log_posterior_calls: int
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters and ``variance[channel]``, in the order of the summary."""
        return tuple(self.tau)

    def draws(self, name: str) -> np.ndarray:
        """Return all draws of a parameter or ``variance[channel]``, chains one after the other."""
        posterior = self.data["posterior"]
        if name.startswith("variance["):
            values = posterior["variance"].sel(channel=name[len("variance[") : -1])
        else:
            values = posterior[name]
        return values.transpose("chain", "draw").to_numpy().ravel()

    def summary(self) -> pd.DataFrame:
        """Return mean, sd, 90 % equal-tailed interval, Monte Carlo error, ESS, tau and R-hat, a row a parameter."""
        rows = {}
        for name in self.names:
            draws = self.draws(name)
            low, median, high = np.quantile(draws, [0.05, 0.5, 0.95])
            rows[name] = {
                "mean": draws.mean(),
                "sd": draws.std(ddof=1),
                "q05": low,
                "q50": median,
                "q95": high,
                "mcse_mean": draws.std(ddof=1) / np.sqrt(self.ess[name]),
                "ess": self.ess[name],
                "tau": self.tau[name],
                "rhat": self.rhat[name],
            }
        table = pd.DataFrame.from_dict(rows, orient="index")
        table.attrs["interval"] = "90 % equal-tailed: q05 to q95"
        return table

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return f"Posterior ({state}: {self.reason})\n{self.summary().to_string(float_format='{:.5g}'.format)}"
