"""Posterior: draws with their convergence diagnostics."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._expressions import parse_all
from bayesperiodic._io import Result
from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.input_noise import InputErrors
from bayesperiodic.priors.joint import MultivariateNormal
from bayesperiodic.priors.stored import PRIORS, as_text
from bayesperiodic.problem.fingerprint import check_fingerprint
from bayesperiodic.problem.parameters import (
    CHAIN,
    EXPERIMENT,
    NOISE,
    checked_key,
    column,
    in_experiment,
    local_hint,
    places,
)
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.chains import StoredChains
from bayesperiodic.sampling.groups import (
    CAUSED,
    EXPECTED,
    INPUT_NOISE,
    LOADINGS,
    LOG_LIKELIHOOD,
    MODE,
    POSTERIOR_PREDICTIVE,
    STEP,
    WALKER,
    tree,
)
from bayesperiodic.sampling.proposals import CallCount
from bayesperiodic.sampling.robust import MISFIT, ROBUST, no_robust, robust_group, with_robust_covariance

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

ROBUST_DRAWS = (
    "sd and interval are robust; draws_sd, that of the draws, takes the error of the model for noise that is "
    "independent from value to value."
)
SAMPLED_ONLY = "Only sampled parameters are part of the draws; write the value of a fixed one as a number."


@dataclass(frozen=True)
class Posterior(Result):
    """Draws from the posterior of θ and the noise parameters.

    Every quantity has a full name, as in the problem: ``k``, ``theta16[run 7]``, ``variance[force]``, or
    ``variance[force, run 7]`` where the noise model has its own parameters for each experiment.

    Attributes
    ----------
    tree : DataTree
        In the schema of ArviZ. Group ``posterior``: variables with dims (chain, draw) first. A chain is an independent
        ensemble; its draws are those of the first half of the steps, walker by walker, then those of the second half,
        with the coordinates ``walker`` and ``step``. A local parameter is one variable with the dim ``experiment``,
        with its fixed value where it is not free. ``variance``, ``lengthscale`` and ``floor`` have the dim ``channel``,
        then ``experiment`` if each has its own; ``scale`` has at most the latter. Known noise parameters are included
        with their values; NaN marks missing ones, such as the variance of a channel in an experiment without it.
        Attributes: ``units``, or ``units of <channel>`` of ``variance``; ``support of <full name>``, that of the prior;
        ``noise``, the name of the noise model, on its parameters. Group ``sample_stats``: lp, the log-density in
        sampling coordinates; the status of the draw's solves; acceptance_rate, with emcee 1 where the proposal of the
        step was accepted, else 0; mode, the row of `MapEstimate.modes` whose Laplace approximation is the densest
        there, if there are several. Group ``proposal``: the mixture from which emcee proposed, in sampling coordinates:
        weight, degrees of freedom, mean and scale matrix of its Student t components; attributes acceptance and burn_in
        [steps]. Group ``log_likelihood``, for ``arviz.loo``: at some draws, the terms of independent observations,
        which sum to the log-likelihood without the factor (2π)^(−n/2) and other constants of the data: values of the
        mean period at equally spaced instants, or its harmonics if the noise is coloured; with the coordinates
        experiment, channel, harmonic (NaN at an instant) and weight, the independent values per value. Group
        ``posterior_predictive``: for some draws, replicates of the measured outputs, noise included, and
        largest_multiplier, the modulus of each orbit's largest Floquet multiplier. Group ``orbits``: states of every
        experiment, turns included, at the draw with the highest density. Groups ``observed_data`` and
        ``constant_data``: outputs and inputs.
    converged : bool
        True if the stop rule was met.
    reason : str
        Why sampling stopped.
    tau, ess, rhat : dict of str to float
        By full name: the integrated autocorrelation time of the stop rule [steps], in sampling coordinates; ArviZ's
        effective sample size (ess_bulk) and R-hat (r_hat) between the halves of all ensembles.
    acceptance : float
        Mean fraction of accepted proposals.
    failures : dict of str to float
        Fraction of proposals whose periodic solve failed, by status.
    log_posterior_calls : int
        Proposals, each with one solve of every experiment.
    seed : int

    Examples
    --------
    >>> posterior.converged, posterior.names
    (True, ('c', 'k', 'variance[displacement]'))
    >>> summary = posterior.summary()
    >>> bool(summary.loc["k", "q05"] < 1.0 < summary.loc["k", "q95"])
    True
    >>> posterior.data["posterior"]["k"].dims, posterior.draws("k").size == posterior.data["posterior"]["k"].size
    (('chain', 'draw'), True)
    >>> import arviz as az
    >>> float(az.rhat(posterior.data)["k"]) == posterior.rhat["k"]
    True
    >>> list(posterior.derive({"damping_ratio": "c/(2*sqrt(k))"}).index)
    ['damping_ratio']
    """

    tree: xr.DataTree
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
        """Full names of the sampled quantities, parameters first, in the order of the summary."""
        return tuple(self.tau)

    @property
    def fingerprint(self) -> str:
        """Digests of the parts of the problem (model, experiments, priors, constants, noise, scheme)."""
        return str(self.tree.attrs.get("fingerprint", ""))

    @property
    def input_errors(self) -> dict[str, InputErrors]:
        """Errors of the inputs by experiment, as `MapEstimate.input_errors`; empty for exact inputs."""
        if INPUT_NOISE not in self.tree.children:
            return {}
        group = self.tree[INPUT_NOISE].to_dataset()
        names = [str(name).removesuffix(f" {EXPECTED}") for name in group if str(name).endswith(f" {EXPECTED}")]
        return {
            n: InputErrors(*(group[f"{n} {kind}"].to_numpy() for kind in (EXPECTED, LOADINGS, CAUSED))) for n in names
        }

    @property
    def modes(self) -> pd.DataFrame:
        """Optima that draws belong to, by the rows of `MapEstimate.modes`; empty if the estimate has one optimum.

        Columns: mass, the fraction of the draws, its Monte Carlo error mcse_mass, and the mean of every quantity there.
        """
        import pandas as pd

        stats = self.tree["sample_stats"].to_dataset()
        if MODE not in stats:
            return pd.DataFrame()
        mode, rows = stats[MODE].to_numpy(), {}
        for row in np.unique(mode):
            inside = (mode == row).astype(float)
            error = 0.0 if inside.all() else convergence.mean_error(inside)
            means = {name: float(self.draws(name)[mode.ravel() == row].mean()) for name in self.names}
            rows[int(row)] = {"mass": float(inside.mean()), "mcse_mass": error} | means
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis(MODE)

    @property
    def data(self) -> Any:
        """`tree` as the functions of the installed ArviZ take it: itself, or with ArviZ 0.23 as InferenceData."""
        return convergence.for_arviz(self.tree)

    def draws(self, name: str) -> np.ndarray:
        """Return all draws of a quantity, chain by chain; `by_step` arranges them by steps and walkers.

        Parameters
        ----------
        name : str
            Full name, such as "k", "theta16[run 7]" or "variance[force]"; see `names`.

        Returns
        -------
        array (chains·draws,)
            In its unit.

        Raises
        ------
        ValueError
            For an unknown name.
        """
        return column(self._group, name).ravel()

    def by_step(self, values: np.ndarray) -> np.ndarray:
        """Return values at all draws by the steps and walkers of the ensembles.

        Parameters
        ----------
        values : array (draws,)
            In the order of `draws`.

        Returns
        -------
        array (ensembles, steps, walkers)
        """
        step, walker = (self._group[name].to_numpy() for name in (STEP, WALKER))
        shape = self._group.sizes[CHAIN], int(step.max()) + 1, int(walker.max()) + 1
        return values.reshape(shape[0], -1)[:, np.lexsort((walker, step))].reshape(shape)

    def guesses(self, experiments: Iterable[str], states: Iterable[str]) -> dict[str, dict[str, np.ndarray]]:
        """Return the states at the draw with the highest density, as guesses for further solves.

        Parameters
        ----------
        experiments : iterable of str
        states : iterable of str

        Returns
        -------
        dict of str to dict of str to array (samples·periods,)
            By experiment and state, turns of angles included.
        """
        group, states = self.tree["orbits"].to_dataset(), tuple(states)
        return {run: {state: group[f"{run} {state}"].to_numpy() for state in states} for run in experiments}

    @property
    def _group(self) -> xr.Dataset:
        return self.tree["posterior"].to_dataset()

    @property
    def _noise(self) -> list[str]:
        """Full names of the noise parameters."""
        return [n for n, (variable, _) in places(self._group).items() if NOISE in self._group[variable].attrs]

    @property
    def misfit(self) -> str:
        """Why the model is misspecified at the estimate from which was sampled, see ``FitCheck.misfit``; or ""."""
        return str(self.tree.attrs.get(MISFIT, ""))

    @property
    def is_robust(self) -> bool:
        """Whether these are draws by `robust`, which no density describes."""
        return ROBUST in self.tree.attrs

    @cached_property
    def headline(self) -> Posterior:
        """The draws whose intervals are valid: of a misspecified model those by `robust`, otherwise these."""
        if ROBUST not in self.tree.children:
            return self
        return self._stretched(self.tree[ROBUST].to_dataset())

    def robust(self, fit: MapEstimate) -> Posterior:
        """Return draws whose covariance in sampling coordinates is the robust one of an estimate.

        Use them for quantities that depend on the parameters (`derive`, `predict_branch`, `as_prior`) where the model
        is misspecified: the covariance of the posterior then takes the error of the model for independent noise. The
        draws of the parameters are moved linearly about their mean, as in the open-faced sandwich adjustment (B. A.
        Shaby, J. Comput. Graph. Stat. 23 (2014) 853-876), by the linear map that moves them least; logarithms are moved
        where parameters are sampled by them, with the covariance at the estimate (delta method).

        Mean, skewness and tails in sampling coordinates remain those of the posterior: an estimate that is biased by
        the error of the model remains biased. Noise parameters, and parameters without a finite robust standard
        deviation, keep their draws. Draws that would leave the support of a prior are reflected at its end. No density
        belongs to these draws: diagnostics that need one refuse them, and `tau` is that of the posterior.

        Parameters
        ----------
        fit : MapEstimate
            Of the same problem, with checks.

        Returns
        -------
        Posterior

        Raises
        ------
        ValueError
            For an estimate of another problem, without checks or with a robust covariance that is NaN, for draws that
            belong to several optima, or for draws that are robust already.

        Examples
        --------
        >>> robust = posterior.robust(fit)
        >>> bool(abs(robust.draws("k").std() / fit.robust_sd["k"] - 1) < 0.01)
        True
        """
        check_fingerprint("fit", fit, self.fingerprint)
        refuse_robust(self)
        if reason := no_robust(fit, len(self.modes)):
            raise ValueError(f"fit: must describe these draws by a robust covariance, got {reason}.")
        return self._stretched(robust_group(fit, self._group))

    def _stretched(self, robust: xr.Dataset) -> Posterior:
        """Return the draws with a robust covariance; groups of the posterior density are left out."""
        import xarray as xr

        group = with_robust_covariance(self._group, robust)
        tree = self.tree.drop_nodes([ROBUST, LOG_LIKELIHOOD, POSTERIOR_PREDICTIVE], errors="ignore")
        tree["posterior"], tree.attrs = xr.DataTree(group), self.tree.attrs | {ROBUST: 1}
        ess, rhat = (
            {n: of(column(group, n)) for n in self.names} for of in (convergence.effective_size, convergence.rhat)
        )
        return replace(self, tree=tree, ess=ess, rhat=rhat)

    def summary(self, *, mode: int | None = None, robust: bool | None = None) -> pd.DataFrame:
        """Return mean, sd, 90 % equal-tailed interval, Monte Carlo error, ESS, tau and R-hat, one row per parameter.

        mcse_mean, ess and rhat are mcse_mean, ess_bulk and r_hat of ``arviz.summary``. Its ``attrs`` contain interval,
        converged, reason and failures. If the model is misspecified at the estimate from which was sampled, all this is
        that of the draws by `robust`, and draws_sd is the standard deviation of the draws themselves.

        Parameters
        ----------
        mode : int, optional
            Row of `modes`: only mean, sd and interval of the draws that belong to this optimum.
        robust : bool, optional
            False for that of the draws themselves.

        Returns
        -------
        DataFrame

        Raises
        ------
        ValueError
            For a mode without draws.
        """
        import pandas as pd

        if mode is not None:
            _checks.one_of("mode", mode, self.modes.index.tolist())
            inside = self.tree["sample_stats"][MODE].to_numpy().ravel() == mode
            return _table({name: _moments(self.draws(name)[inside]) for name in self.names})
        shown = self if robust is False else self.headline
        rows = {name: _described(column(shown._group, name), shown.ess[name]) for name in self.names}
        table = _table(rows).assign(tau=pd.Series(self.tau), rhat=pd.Series(shown.rhat))
        if shown is not self:
            table.insert(2, "draws_sd", [self.draws(name).std(ddof=1) for name in self.names])
            table.attrs["interval"] += f", robust: {self.misfit}"
        table.attrs |= {"converged": self.converged, "reason": self.reason, "failures": dict(self.failures)}
        return table

    def derive(self, expressions: Mapping[str, str], *, experiment: str | None = None) -> pd.DataFrame:
        """Return quantities derived from the sampled parameters, evaluated at every draw.

        Parameters
        ----------
        expressions : mapping of str to str
            By new name, such as ``{"damping_ratio": "c/(2*sqrt(k*1.5))"}``, as in `MapEstimate.derive`. Values of fixed
            parameters, which the draws do not contain, are written as numbers.
        experiment : str, optional
            Its local parameters are named without brackets: with "run 7" ``theta16`` is ``theta16[run 7]``. Without it,
            expressions contain shared parameters only.

        Returns
        -------
        DataFrame
            Mean, sd, 90 % equal-tailed interval, Monte Carlo error and ESS, one row per quantity, as in `summary`; the
            ESS is that of the quantity, NaN if it does not vary.

        Raises
        ------
        ValueError
            For an invalid expression or one that is not finite at some draw, a new name that is no identifier or the
            name of a parameter, an unknown experiment.
        """
        group, noise = self._group, self._noise
        if experiment is not None:
            _checks.one_of("experiment", experiment, group[EXPERIMENT].values.tolist())
        kept = [name for name in places(group) if name not in noise]
        named = in_experiment(kept, experiment)
        note = f"{SAMPLED_ONLY} {local_hint(kept, group[EXPERIMENT].values.tolist(), experiment)}".strip()
        quantities = parse_all("expressions", expressions, named, ["variance", *map(str, group.data_vars)], note)
        values = {plain: column(group, name) for plain, name in named.items()}
        rows = {}
        for name, quantity in quantities.items():
            draws = np.broadcast_to(quantity.value(values), (group.sizes["chain"], group.sizes["draw"]))
            if bad := int(np.sum(~np.isfinite(draws))):
                raise ValueError(
                    f"expressions[{name!r}]: must be finite at all draws, got NaN or infinity at {bad} of {draws.size} "
                    f"for {quantity.text!r}."
                )
            rows[name] = _described(draws, convergence.effective_size(draws))
        return _table(rows)

    def as_prior(self, names: tuple[str, ...]) -> MultivariateNormal:
        """Return the normal distribution with the mean and covariance of the draws, as the prior of another problem.

        Use it as ``priors={names: posterior.as_prior(names)}``. It is a distribution of natural values, so that
        positive parameters are no longer restricted to positive values; it contains no noise parameters, and no tails
        or further modes of the draws, see `compare`.

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
        key = checked_key(names, [name for name in self.names if name not in noise], noise)
        if not self.converged:
            warnings.warn(
                f"The draws have not converged ({self.reason}), and the prior is unreliable. Sample longer, see "
                "max_steps.",
                stacklevel=2,
            )
        draws = np.stack([self.draws(name) for name in key])
        return MultivariateNormal(draws.mean(axis=1), np.cov(draws).reshape(len(key), len(key)))

    @property
    def remarks(self) -> list[str]:
        """Sentences on which intervals are shown, where the model is misspecified."""
        if not self.misfit:
            return []
        if ROBUST in self.tree.children:
            return [f"{ROBUST_DRAWS} {self.misfit}."]
        kind = "These are robust draws" if self.is_robust else "The intervals take the model for right"
        return [f"{kind}. {self.misfit}."]

    def __repr__(self) -> str:
        failed = ", ".join(f"{share:.2%} {status}" for status, share in self.failures.items())
        tables = [self.summary(), self.modes]
        return "\n".join(
            [
                f"Posterior ({'converged' if self.converged else 'NOT CONVERGED'})",
                *(t.to_string(float_format="{:.5g}".format) for t in tables if not t.empty),
                *self.remarks,
                f"Sampling ended: {self.reason}.",
                f"Failed solves of {self.log_posterior_calls} proposals: {failed or 'none'}.",
            ]
        )


def _described(draws: np.ndarray, ess: float) -> dict[str, float]:
    return _moments(draws) | {"mcse_mean": convergence.mean_error(draws), "ess": ess}


def _moments(draws: np.ndarray) -> dict[str, float]:
    low, median, high = np.quantile(draws, [0.05, 0.5, 0.95])
    return {"mean": draws.mean(), "sd": draws.std(ddof=1), "q05": low, "q50": median, "q95": high}


def _table(rows: dict[str, dict[str, float]]) -> pd.DataFrame:
    import pandas as pd

    table = pd.DataFrame.from_dict(rows, orient="index")
    table.attrs["interval"] = "90 % equal-tailed: q05 to q95"
    return table


def refuse_robust(posterior: Posterior) -> None:
    """Raise a ValueError for draws that no density describes."""
    if posterior.is_robust:
        raise ValueError(
            "posterior: must be draws from the posterior density, got those of robust(fit), which have another "
            "covariance; give sample(problem, fit)."
        )


def gather(
    density: LogPosterior,
    kept: StoredChains,
    log_density: np.ndarray,
    calls: CallCount,
    *,
    converged: bool,
    reason: str,
    acceptance: float,
    seed: int,
    modes: np.ndarray | None = None,
) -> Posterior:
    """Return the posterior of chains in sampling coordinates, which gives back their memory.

    `log_density` and `modes`, the optimum to which each draw belongs, are (ensembles, steps, walkers).
    """
    names = density.labels
    tau = convergence.autocorrelation_time(kept)
    columns = density.natural_columns(lambda k: convergence.as_chains(kept[..., k]))
    ess = {name: convergence.effective_size(np.asarray(columns[name]())) for name in names}
    rhat = {name: convergence.rhat(np.asarray(columns[name]())) for name in names}
    data = tree(density, kept, log_density, seed, modes)
    data.attrs |= {"seed": seed, "converged": int(converged), "reason": reason, PRIORS: as_text(density.problem.priors)}
    return Posterior(
        tree=data,
        converged=converged,
        reason=reason,
        tau=dict(zip(names, tau.tolist(), strict=True)),
        ess=ess,
        rhat=rhat,
        acceptance=acceptance,
        failures={status: count / calls.points for status, count in calls.failures.items()},
        log_posterior_calls=calls.points,
        seed=seed,
    )
