"""Posterior: draws, and how far they can be trusted."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from bayesperiodic.expressions import parse_all
from bayesperiodic.inference import chains
from bayesperiodic.store import Result

SAMPLED_ONLY = "Only sampled parameters are kept with the draws; write the value of a fixed one as a number."


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
        return _table(
            {
                name: _described(self.draws(name), self.ess[name]) | {"tau": self.tau[name], "rhat": self.rhat[name]}
                for name in self.names
            }
        )

    def derive(self, expressions: Mapping[str, str]) -> pd.DataFrame:
        """Return quantities derived from the sampled parameters, evaluated at every draw.

        Parameters
        ----------
        expressions : mapping of str to str
            By new name, such as ``{"damping_ratio": "c/(2*sqrt(k*1.5))"}``: numbers, names of sampled parameters, pi,
            + - * / ** and sqrt, exp, log, sin, cos, tan, atan, sinh, cosh, tanh, abs. Fixed parameters are not kept
            with the draws; their values are written as numbers.

        Returns
        -------
        DataFrame
            Mean, sd, 90 % equal-tailed interval, Monte Carlo error and ESS, a row a quantity, as in `summary`; the ESS
            is that of the quantity itself, NaN for one that does not vary.

        Raises
        ------
        ValueError
            For an expression that is not allowed or not finite at some draw, a new name that is no identifier or that a
            parameter has.
        """
        names = [name for name in self.names if not name.startswith("variance[")]
        posterior = self.data["posterior"]
        values = {name: posterior[name].transpose("chain", "draw").to_numpy() for name in names}
        shape = posterior.sizes["chain"], posterior.sizes["draw"]
        rows = {}
        for name, quantity in parse_all("expressions", expressions, names, ["variance"], SAMPLED_ONLY).items():
            draws = np.broadcast_to(quantity.value(values), shape)
            if bad := int(np.sum(~np.isfinite(draws))):
                raise ValueError(
                    f"expressions[{name!r}]: {quantity.text!r} is not allowed; it is NaN or infinite at {bad} of "
                    f"{draws.size} draws and must be finite at all of them."
                )
            rows[name] = _described(draws.ravel(), self._effective_size(draws))
        return _table(rows)

    def _effective_size(self, draws: np.ndarray) -> float:
        """Return the effective sample size of values (chains, draws); NaN if they do not vary."""
        if np.ptp(draws) == 0.0:
            return np.nan
        ensemble = self.data["posterior"]["ensemble"].to_numpy()
        ensembles = np.stack([draws[ensemble == e].T[:, :, None] for e in np.unique(ensemble)])
        return draws.size / float(chains.autocorrelation_time(ensembles)[0])

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return f"Posterior ({state}: {self.reason})\n{self.summary().to_string(float_format='{:.5g}'.format)}"


def _described(draws: np.ndarray, ess: float) -> dict[str, float]:
    low, median, high = np.quantile(draws, [0.05, 0.5, 0.95])
    sd = draws.std(ddof=1)
    return {
        "mean": draws.mean(),
        "sd": sd,
        "q05": low,
        "q50": median,
        "q95": high,
        "mcse_mean": sd / np.sqrt(ess),
        "ess": ess,
    }


def _table(rows: dict[str, dict[str, float]]) -> pd.DataFrame:
    table = pd.DataFrame.from_dict(rows, orient="index")
    table.attrs["interval"] = "90 % equal-tailed: q05 to q95"
    return table
