"""Posterior: draws, and how far they can be trusted."""

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from bayesperiodic import checks
from bayesperiodic.expressions import parse_all
from bayesperiodic.inference import labels
from bayesperiodic.inference.priors.multivariate import MultivariateNormal
from bayesperiodic.inference.sampling import chains
from bayesperiodic.store import Result

SAMPLED_ONLY = "Only sampled parameters are kept with the draws; write the value of a fixed one as a number."


@dataclass(frozen=True)
class Posterior(Result):
    """Draws from the posterior of θ and the noise parameters.

    Every quantity has a full name, as in the problem: ``k``, ``theta16[run 7]``, ``variance[force]``, or
    ``variance[force, run 7]`` where the noise model has its own parameters for each experiment.

    Attributes
    ----------
    data : DataTree
        Group ``posterior``: variables with dims (chain, draw) first; a chain is a walker, the coordinate ``ensemble``
        tells to which ensemble it belongs. A parameter that experiments have their own of is one variable with the dim
        ``experiment``, which holds its fixed value where it is not free. ``variance``, ``lengthscale`` and ``floor``
        have the dim ``channel``, then ``experiment`` where each has its own; ``scale`` has at most the latter. Known
        noise parameters are kept with the others, with their values; NaN stands where there is none, such as the
        variance of a channel in an experiment that lacks it. Attributes: ``units``, or ``units of <channel>`` of
        ``variance``; ``noise``, the noise model's name, on its parameters alone. Group ``sample_stats``: lp, the
        log-density in sampling coordinates, and the status of the draw's solves. Group ``posterior_predictive``: at a
        few draws, replicates of the measured outputs, noise included, and largest_multiplier, the modulus of each
        orbit's largest Floquet multiplier. Group ``orbits``: every experiment's states, turns included, at the draw
        with the highest density. Groups ``observed_data`` and ``constant_data``: outputs and inputs.
    converged : bool
        True if the stop rule was passed.
    reason : str
        Why sampling stopped.
    tau, ess, rhat : dict of str to float
        Integrated autocorrelation time [steps], effective sample size (draws / tau), R-hat between ensembles; in
        sampling coordinates, by full name.
    acceptance : float
        Mean fraction of accepted proposals.
    failures : dict of str to float
        Fraction of proposals whose periodic solve failed, by status.
    log_posterior_calls : int
        Proposals, each with one solve of every experiment.
    seed : int

    Examples
    --------
    A short run, which the stop rule does not pass:

    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> posterior.converged, posterior.names
    (False, ('c', 'k', 'variance[displacement]'))
    >>> summary = posterior.summary()
    >>> bool(summary.loc["k", "q05"] < 1.0 < summary.loc["k", "q95"])
    True
    >>> posterior.data["posterior"]["k"].dims, posterior.draws("k").size == 16 * 200
    (('chain', 'draw'), True)
    >>> list(posterior.derive({"damping_ratio": "c/(2*sqrt(k))"}).index)
    ['damping_ratio']
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
        """Full names of all that was sampled, parameters first, in the order of the summary."""
        return tuple(self.tau)

    def draws(self, name: str) -> np.ndarray:
        """Return all draws of what has this full name, chains one after the other.

        Parameters
        ----------
        name : str
            Such as "k", "theta16[run 7]" or "variance[force]"; see `names`.

        Returns
        -------
        array (chains·draws,)
            In its unit.

        Raises
        ------
        ValueError
            For an unknown name.
        """
        return labels.column(self._group, name).ravel()

    def guesses(self, experiments: Iterable[str], states: Iterable[str]) -> dict[str, dict[str, np.ndarray]]:
        """Return the states at the draw with the highest density, from which to solve again.

        Parameters
        ----------
        experiments : iterable of str
        states : iterable of str

        Returns
        -------
        dict of str to dict of str to array (samples·periods,)
            By experiment and state, turns of angles included.
        """
        group, states = self.data["orbits"].to_dataset(), tuple(states)
        return {run: {state: group[f"{run} {state}"].to_numpy() for state in states} for run in experiments}

    @property
    def _group(self) -> xr.Dataset:
        return self.data["posterior"].to_dataset()

    @property
    def _noise(self) -> list[str]:
        """Full names of the noise parameters."""
        return [n for n, (variable, _) in labels.places(self._group).items() if labels.is_noise(self._group, variable)]

    def summary(self) -> pd.DataFrame:
        """Return mean, sd, 90 % equal-tailed interval, Monte Carlo error, ESS, tau and R-hat, a row a parameter.

        Its ``attrs`` tell the interval, whether the draws converged and why, and the failed solves by status.
        """
        table = _table(
            {
                name: _described(self.draws(name), self.ess[name]) | {"tau": self.tau[name], "rhat": self.rhat[name]}
                for name in self.names
            }
        )
        table.attrs |= {"converged": self.converged, "reason": self.reason, "failures": dict(self.failures)}
        return table

    def derive(self, expressions: Mapping[str, str], *, experiment: str | None = None) -> pd.DataFrame:
        """Return quantities derived from the sampled parameters, evaluated at every draw.

        Parameters
        ----------
        expressions : mapping of str to str
            By new name, such as ``{"damping_ratio": "c/(2*sqrt(k*1.5))"}``: numbers, names of sampled parameters, pi,
            + - * / ** and sqrt, exp, log, sin, cos, tan, atan, sinh, cosh, tanh, abs. Fixed parameters are not kept
            with the draws; their values are written as numbers.
        experiment : str, optional
            Whose local parameters the expressions mean, by their plain names: with "run 7" ``theta16`` is
            ``theta16[run 7]``. Without it they can name shared parameters only.

        Returns
        -------
        DataFrame
            Mean, sd, 90 % equal-tailed interval, Monte Carlo error and ESS, a row a quantity, as in `summary`; the ESS
            is that of the quantity itself, NaN for one that does not vary.

        Raises
        ------
        ValueError
            For an expression that is not allowed or not finite at some draw, a new name that is no identifier or that a
            parameter has, an unknown experiment.
        """
        group, noise = self._group, self._noise
        if experiment is not None:
            checks.one_of("experiment", experiment, group[labels.EXPERIMENT].values.tolist())
        kept = [name for name in labels.places(group) if name not in noise]
        named = labels.in_experiment(kept, experiment)
        note = f"{SAMPLED_ONLY} {labels.local_hint(kept, experiment)}".strip()
        quantities = parse_all("expressions", expressions, named, ["variance", *map(str, group.data_vars)], note)
        values = {plain: labels.column(group, name) for plain, name in named.items()}
        rows = {}
        for name, quantity in quantities.items():
            draws = np.broadcast_to(quantity.value(values), (group.sizes["chain"], group.sizes["draw"]))
            if bad := int(np.sum(~np.isfinite(draws))):
                raise ValueError(
                    f"expressions[{name!r}]: {quantity.text!r} is not allowed; it is NaN or infinite at {bad} of "
                    f"{draws.size} draws and must be finite at all of them."
                )
            rows[name] = _described(draws.ravel(), self._effective_size(draws))
        return _table(rows)

    def as_prior(self, names: tuple[str, ...]) -> MultivariateNormal:
        """Return the normal distribution with the mean and covariance of the draws: the prior of the next problem.

        It is given for the same names, ``priors={names: posterior.as_prior(names)}``. It is over natural values, so
        that a parameter that was positive is no longer kept positive, and noise parameters are left out. A tail or a
        second mode of the draws does not survive; see `compare`.

        Parameters
        ----------
        names : tuple of str
            Free parameters, local ones as ``theta16[run 7]``, in the order of the prior's.

        Returns
        -------
        MultivariateNormal

        Raises
        ------
        ValueError
            For anything else than a tuple of different free parameters.

        Warns
        -----
        UserWarning
            If the draws have not converged.
        """
        noise = self._noise
        key = labels.checked_key(names, [name for name in self.names if name not in noise], noise)
        if not self.converged:
            warnings.warn(
                f"The draws have not converged ({self.reason}), nor has this prior. Sample longer, see max_steps.",
                stacklevel=2,
            )
        draws = np.stack([self.draws(name) for name in key])
        return MultivariateNormal(draws.mean(axis=1), np.cov(draws).reshape(len(key), len(key)))

    def _effective_size(self, draws: np.ndarray) -> float:
        """Return the effective sample size of values (chains, draws); NaN if they do not vary."""
        if np.ptp(draws) == 0.0:
            return np.nan
        ensemble = self._group["ensemble"].to_numpy()
        ensembles = np.stack([draws[ensemble == e].T[:, :, None] for e in np.unique(ensemble)])
        return draws.size / float(chains.autocorrelation_time(ensembles)[0])

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        failed = ", ".join(f"{status} {share:.2%}" for status, share in self.failures.items())
        solves = f"; failed solves of {self.log_posterior_calls} proposals: {failed or 'none'}"
        table = self.summary().to_string(float_format="{:.5g}".format)
        return f"Posterior ({state}: {self.reason}{solves})\n{table}"


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
