"""Result of a population: its parameters, its units, and what it predicts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.density.problem import Problem
from bayesperiodic.priors.single import LogNormal, Normal, TruncatedNormal
from bayesperiodic.problem.parameters import CHAIN, DRAW
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.convergence import QUANTILE_LEVELS
from bayesperiodic.sampling.membership import FEWEST_EFFECTIVE, USABLE_WEIGHTS, Expected, MembershipTest, membership
from bayesperiodic.sampling.population_density import Parameters
from bayesperiodic.sampling.population_units import Coordinate, carried_out, task_of, unit_draws

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

POPULATION_UNIT, PARAMETER, UNIT_GROUP = "unit", "parameter", "units"
# Draws of the population in results.
KEPT_STEPS = 8000
# Log Bayes factors of strong (20 to 1) and of positive evidence (3 to 1); p-value of all units together, below which
# units are outside.
STRONG, POSITIVE, OUTSIDE = 3.0, 1.1, 0.01
# Difference of two estimates of a log Bayes factor beyond their errors.
LARGEST_DIFFERENCE = 0.7
FALSE_ALARM = 0.01
QUANTILES = "q05", "q50", "q95"


@dataclass(frozen=True)
class Population(Result):
    """Draws of the parameters of a population, and of its units, by `population`.

    Attributes
    ----------
    tree : DataTree
        Group ``posterior``, for ArviZ: ``mean[k]`` is the mean of a parameter at the mean covariates, of one that is
        sampled in its logarithm the median in its unit; ``spread[k]``, the standard deviation between units, that of
        the logarithm (dimensionless), or in the parameter's unit; ``slope[k, temperature]``, the change of the mean, or
        of its logarithm, per unit of the covariate; ``correlation[k, c]``. Group ``units``: ``shrunken`` (unit, draw,
        parameter), draws of the units' parameters under the population, in their units.
    names : tuple of str
        Parameters.
    coordinates : dict of str to dict
        By parameter: logarithmic, unit and support.
    covariates : dict of str to tuple of float
        Mean and standard deviation of every covariate.
    degrees : float
        Degrees of freedom; infinite for a normal population.
    priors : dict of str to str
        Priors of the spreads, or their known values.
    units : DataFrame
        One row per unit and parameter. ``q05``, ``q50`` and ``q95``, quantiles of its own posterior, ``shrunken_q05``
        and so on, those under the population, in the parameter's unit; ``pareto_k`` and ``effective``, the k̂ of the
        weights and the effective number of the unit's draws; ``p``, the probability that a member deviates at least as
        much from the population of the others, NaN if that cannot be computed from the draws; ``again``, 1 if it was
        sampled under the population; ``robust``, 1 if its draws are robust, as the model is misspecified; and the
        covariates.
    evidence : DataFrame
        One row per parameter with a free spread: ``log_bayes_factor`` of a spread against none, by the ratio of the
        densities at zero, and its ``error``; ``bridge`` and ``bridge_error``, the same by bridge sampling where the
        first is within ±5.
    converged : bool
    reason : str
    tau : dict of str to float
        Autocorrelation times [steps].
    calls : int
        Evaluations of the density of the population.
    unit_calls : int
        Evaluations of densities of units, each with its periodic solves.
    seed : int
    left_out : dict of str to str
        Units without draws, and why.

    Examples
    --------
    >>> units, spread = dict.fromkeys(["1", "2", "3"], posterior), {"k": bp.HalfNormal(0.01)}
    >>> springs = bp.population(units, ["k"], spread=spread, seed=1, progress=False)
    >>> springs.labels
    ('mean[k]', 'spread[k]')
    >>> prior = springs.as_prior()["k"]
    >>> bool(0.9 < prior.median < 1.1)
    True
    """

    tree: xr.DataTree
    names: tuple[str, ...]
    coordinates: dict[str, dict[str, Any]]
    covariates: dict[str, tuple[float, float]]
    degrees: float
    priors: dict[str, str]
    units: pd.DataFrame
    evidence: pd.DataFrame
    converged: bool
    reason: str
    tau: dict[str, float]
    calls: int
    unit_calls: int
    seed: int
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the parameters of the population."""
        return tuple(self.tau)

    @property
    def data(self) -> Any:
        """`tree` as the functions of the installed ArviZ take it."""
        return convergence.for_arviz(self.tree)

    def draws(self, label: str) -> np.ndarray:
        """Return all draws of a parameter of the population, such as "spread[k]".

        Parameters
        ----------
        label : str

        Returns
        -------
        array (draws,)

        Raises
        ------
        ValueError
            For an unknown label.
        """
        _checks.one_of("label", label, self.labels)
        return self.tree["posterior"][label].to_numpy().ravel()

    def shrunken(self, unit: str, name: str) -> np.ndarray:
        """Return draws of a unit's parameter under the population.

        Parameters
        ----------
        unit, name : str

        Returns
        -------
        array (draws,)
            In the parameter's unit.

        Raises
        ------
        ValueError
            For an unknown unit or parameter.
        """
        values = self.tree[UNIT_GROUP]["shrunken"]
        _checks.one_of("unit", unit, values[POPULATION_UNIT].to_numpy().tolist())
        _checks.one_of("name", name, self.names)
        return values.sel({POPULATION_UNIT: unit, PARAMETER: name}).to_numpy()

    def summary(self) -> pd.DataFrame:
        """Return mean, sd and 90 % equal-tailed interval of the parameters of the population.

        Returns
        -------
        DataFrame
        """
        import pandas as pd

        rows = {}
        for label in self.labels:
            values = self.draws(label)
            low, median, high = np.quantile(values, [0.05, 0.5, 0.95])
            rows[label] = {"mean": values.mean(), "sd": values.std(ddof=1), "q05": low, "q50": median, "q95": high}
        return pd.DataFrame.from_dict(rows, orient="index")

    def predict(self, covariates: Mapping[str, float] | None = None) -> dict[str, np.ndarray]:
        """Return draws of the parameters of a new unit.

        Parameters
        ----------
        covariates : mapping of str to float, optional
            By name; by default the means of the units'.

        Returns
        -------
        dict of str to array (draws,)
            In the parameters' units.

        Raises
        ------
        ValueError
            For covariates with other names.
        """
        expected, generator = self._expected(covariates), np.random.default_rng(self.seed)
        values, vectors = np.linalg.eigh(expected.covariances)
        noise = np.sqrt(np.maximum(values, 0.0)) * generator.standard_normal(values.shape)
        if np.isfinite(self.degrees):
            noise /= np.sqrt(generator.chisquare(self.degrees, len(noise)) / self.degrees)[:, None]
        points = expected.means + np.einsum("kab,kb->ka", vectors, noise)
        return {name: self._natural(name, points[:, k]) for k, name in enumerate(self.names)}

    def as_prior(self, covariates: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Return the prior of each parameter in a problem of a new unit, in sampling coordinates normal.

        It has the mean and the standard deviation of `predict`; correlations between the parameters are left out. Use
        it as ``priors={**priors, **population.as_prior()}``.

        Parameters
        ----------
        covariates : mapping of str to float, optional
            By name; by default the means of the units'.

        Returns
        -------
        dict of str to LogNormal, Normal or TruncatedNormal

        Raises
        ------
        ValueError
            For covariates with other names.
        """
        expected = self._expected(covariates)
        wider = np.sqrt(self.degrees / (self.degrees - 2.0)) if np.isfinite(self.degrees) else 1.0
        sds = wider * np.sqrt(np.diag(expected.covariance))
        return {
            name: coordinate_prior(self._coordinate(name), float(expected.centre[k]), float(sds[k]))
            for k, name in enumerate(self.names)
        }

    def test(
        self, new: Any, *, covariates: Mapping[str, float] | None = None, false_alarm: float = FALSE_ALARM
    ) -> MembershipTest:
        """Test whether a unit that is none of the population's units is a member, and in which parameters it is not.

        The estimate of the unit by its data alone, a normal approximation in sampling coordinates with its prior
        divided out, is compared with estimates of such a unit that the population predicts, its own uncertainty
        included. Each parameter has a p-value, and all together another; their levels sum to `false_alarm`. For units
        that are drawn like those of the population that is at most the rate of false alarms, on average over
        populations that are as probable as the draws say.

        Parameters
        ----------
        new : Problem, Posterior, (problem, posterior), or path of a saved Posterior
            With parameters of the population that all its experiments share.
        covariates : mapping of str to float, optional
            By name; by default the means of the units'.
        false_alarm : float
            Between 0 and 1.

        Returns
        -------
        MembershipTest

        Raises
        ------
        ValueError
            For draws without their prior or that have not converged, or whose prior is as narrow as the data.
        RuntimeError
            If a problem cannot be sampled.

        Warns
        -----
        UserWarning
            If the draws of the population have not converged.
        """
        if not 0.0 < _checks.finite_number("false_alarm", false_alarm) < 1.0:
            raise ValueError(f"false_alarm: must be between 0 and 1, got {false_alarm!r}.")
        if not self.converged:
            warnings.warn(
                f"The population has not converged ({self.reason}), so that the false-alarm rate is not known.",
                stacklevel=2,
            )
        if isinstance(new, Problem):
            unit = carried_out(self.names, task_of("new", new, False, self.seed))
            if isinstance(unit, str):
                raise RuntimeError(f"new: cannot be sampled, {unit}.")
        else:
            unit = unit_draws("new", new, self.names)
        if len(unit.members) != 1 or list(unit.coordinates) != [self._coordinate(name) for name in self.names]:
            raise ValueError(
                f"new: must have {', '.join(self.names)} shared by its experiments, with the supports and units of the "
                "population, got others."
            )
        return membership("new", unit, self.names, self._expected(covariates), false_alarm, self.seed)

    def _coordinate(self, name: str) -> Coordinate:
        at = self.coordinates[name]
        return Coordinate(bool(at["logarithmic"]), str(at["unit"]), (float(at["low"]), float(at["high"])))

    def _natural(self, name: str, values: np.ndarray) -> np.ndarray:
        return np.exp(values) if self.coordinates[name]["logarithmic"] else values

    def _expected(self, covariates: Mapping[str, float] | None) -> Expected:
        """Return what is expected of a new unit, by the draws of the population."""
        if covariates is not None:
            _checks.same_names("covariates", covariates, self.covariates)
        given = {name: mean for name, (mean, _) in self.covariates.items()} | dict(covariates or {})
        offset = [_checks.finite_number("covariates", given[n]) - self.covariates[n][0] for n in self.covariates]
        return Expected.of(self._parameters(), np.array(offset), self.degrees)

    def _parameters(self) -> Parameters:
        """Return the draws in sampling coordinates; slopes per unit of the covariate."""
        size, count = len(self.names), self.draws(self.labels[0]).size
        means = np.stack([self.draws(f"mean[{name}]") for name in self.names], axis=-1)
        logs = [bool(self.coordinates[name]["logarithmic"]) for name in self.names]
        means[:, logs] = np.log(means[:, logs])
        slopes, spread = np.zeros((count, size, len(self.covariates))), np.empty((count, size))
        correlation = np.broadcast_to(np.eye(size), (count, size, size)).copy()
        for i, name in enumerate(self.names):
            free = f"spread[{name}]" in self.labels
            spread[:, i] = self.draws(f"spread[{name}]") if free else float(self.priors[name])
            for c, covariate in enumerate(self.covariates):
                if (label := f"slope[{name}, {covariate}]") in self.labels:
                    slopes[:, i, c] = self.draws(label)
            for j, other in enumerate(self.names):
                if (label := f"correlation[{name}, {other}]") in self.labels:
                    correlation[:, i, j] = correlation[:, j, i] = self.draws(label)
        return Parameters(means, slopes, correlation * spread[:, :, None] * spread[:, None])

    @property
    def outside(self) -> dict[str, float]:
        """Units that lie outside the population of the others, and the smallest p-value of each.

        By Bonferroni's correction 1 % of populations have one by chance. A unit may still belong to a Student t
        population, see `degrees`.
        """
        p = self.units.groupby(POPULATION_UNIT, sort=False)["p"].min()
        limit = OUTSIDE / max(int(self.units["p"].notna().sum()), 1)
        return {str(unit): float(value) for unit, value in p.items() if value < limit}

    @property
    def verdicts(self) -> dict[str, str]:
        """Whether each parameter differs between the units, in words."""
        return {str(name): self._verdict(str(name)) for name in self.evidence.index}

    def _verdict(self, name: str) -> str:
        row, values = self.evidence.loc[name].to_dict(), self.draws(f"spread[{name}]")
        unit = self.coordinates[name]["unit"]
        suffix, scale = (
            (" %", 100.0) if self.coordinates[name]["logarithmic"] else (f" {unit}" * (unit not in ("", "1")), 1.0)
        )
        size = f"{scale * values.mean():.2g} ± {scale * values.std(ddof=1):.1g}{suffix}"
        below = f"{scale * np.quantile(values, 0.95):.2g}{suffix}"
        log, known = row["log_bayes_factor"], " beyond the covariates" if self.covariates else ""
        undecided, below = f"Whether {name} differs between units is undecided", f"below {below} with 95 % probability"
        if not self.converged:
            return f"{undecided}: the chains have not converged ({self.reason})."
        if abs(log - row["bridge"]) > 3.0 * row["bridge_error"] + LARGEST_DIFFERENCE:
            pair = f"{log:.1f} and {row['bridge']:.1f}"
            return f"{undecided}: two estimates of the evidence disagree ({pair}); spread {size}."
        # Twice the errors, so that few draws in the tails decide nothing.
        estimates = [(log, row["error"])] + [(row["bridge"], row["bridge_error"])] * bool(np.isfinite(row["bridge"]))
        least, most = min(x - 2.0 * e for x, e in estimates), max(x + 2.0 * e for x, e in estimates)
        if least > STRONG:
            cause = ", but perhaps by the error of the model" if (self.units["robust"] > 0).any() else ""
            factor = _factor(least)
            return f"{name} differs between units{known}: spread {size}, not explained by noise{cause} ({factor})."
        if most < -POSITIVE:
            return f"No spread of {name} is seen{known}: {below} ({_factor(most)})."
        return f"{undecided}{known}: spread {below} (log Bayes factor for a spread between {least:.1f} and {most:.1f})."

    @property
    def remarks(self) -> list[str]:
        """What limits these results, in words."""
        lines = [f"{unit} lies outside the population of the others, p = {p:.2g}." for unit, p in self.outside.items()]
        if wrong := sorted({*self.units[POPULATION_UNIT][self.units["robust"] > 0]}):
            lines.append(
                f"The model is misspecified in {len(wrong)} of {self.units[POPULATION_UNIT].nunique()} units, whose "
                "draws are robust; the spread includes the part of the error of the model that differs between units."
            )
        poor = ~(self.units["pareto_k"] <= USABLE_WEIGHTS) | (self.units["effective"] < FEWEST_EFFECTIVE)
        if bad := sorted({*self.units[POPULATION_UNIT][poor]}):
            lines.append(f"Unreliable: the draws of {', '.join(bad)} are no importance sample of the population.")
        lines += [f"{unit} is left out: {reason}." for unit, reason in self.left_out.items()]
        return lines

    def __repr__(self) -> str:
        priors = ", ".join(f"{name} {prior}" for name, prior in self.priors.items())
        kind = "normal" if np.isinf(self.degrees) else f"Student t ({self.degrees:g} degrees of freedom)"
        logs = [name for name in self.names if self.coordinates[name]["logarithmic"]]
        lines = [
            f"Population of {self.units[POPULATION_UNIT].nunique()} units, {kind} "
            f"({'converged' if self.converged else 'NOT CONVERGED'})",
            self.summary().to_string(float_format="{:.4g}".format),
            f"Spread of {', '.join(logs)}: standard deviation of the logarithm." if logs else "",
            f"Priors of the spreads, or known values: {priors}; flat priors of the means.",
            *self.verdicts.values(),
            *self.remarks,
        ]
        return "\n".join(line for line in lines if line)


def _factor(log: float) -> str:
    """Return the smallest Bayes factor within its error in words."""
    kind = "a spread" if log > 0.0 else "no spread"
    size = "1e6" if abs(log) > np.log(1e6) else f"{np.exp(abs(log)):.2g}"
    return f"Bayes factor for {kind} at least {size}"


def coordinate_prior(at: Coordinate, mean: float, sd: float) -> Any:
    """Return a prior that is normal in a sampling coordinate, within the support."""
    if at.logarithmic:
        return LogNormal(float(np.exp(mean)), sd)
    return Normal(mean, sd) if np.isinf(at.support).all() else TruncatedNormal(mean, sd, *at.support)


def gather_population(
    fit: Any,
    evidence: pd.DataFrame,
    p: np.ndarray,
    scaling: Mapping[str, tuple[float, float]],
    again: frozenset[str],
    seed: int,
) -> Population:
    """Return the result of chains and shrunken units; see `population.fitted`."""
    import xarray as xr

    density, chains, shrunken = fit.density, fit.chains, fit.shrunken
    structure, first = density.structure, density.units[0]
    logs = np.array([at.logarithmic for at in first.coordinates])
    thin = max(1, -(-chains.draws[..., 0].size // KEPT_STEPS))
    values = convergence.as_chains(chains.draws[:, ::thin])
    every = _variables(structure, values, logs, scaling)
    members = [member for unit in density.units for member in unit.members]
    natural = np.exp(shrunken.draws, out=shrunken.draws.copy(), where=logs)
    dims = (POPULATION_UNIT, DRAW, PARAMETER)
    coords = {POPULATION_UNIT: members, PARAMETER: list(structure.names)}
    tree = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset(
                {
                    label: ((CHAIN, DRAW), x, parameter_attributes(structure, first.coordinates, label))
                    for label, x in every.items()
                }
            ),
            UNIT_GROUP: xr.Dataset({"shrunken": (dims, natural)}, coords=coords),
        }
    )
    return Population(
        tree=tree,
        names=structure.names,
        coordinates={
            name: {"logarithmic": at.logarithmic, "unit": at.unit, "low": at.support[0], "high": at.support[1]}
            for name, at in zip(structure.names, first.coordinates, strict=True)
        },
        covariates=dict(scaling),
        degrees=structure.degrees,
        priors={name: repr(prior) for name, prior in structure.spread.items()},
        units=_unit_table(density, shrunken, natural, p, scaling, again),
        evidence=evidence,
        converged=chains.converged,
        reason=chains.reason,
        tau=chains.tau,
        calls=fit.calls,
        unit_calls=sum(unit.calls for unit in density.units),
        seed=seed,
    )


def parameter_attributes(structure: Any, coordinates: Sequence[Coordinate], label: str) -> dict[str, Any]:
    """Return unit and support of a parameter of the population, as the attributes of `Posterior.tree`."""
    kind, _, inner = label.removesuffix("]").partition("[")
    name, _, covariate = inner.partition(", ")
    at = dict(zip(structure.names, coordinates, strict=True))[name]
    of_spread = "1" if at.logarithmic else at.unit
    units, support = {
        "mean": (at.unit, (0.0 if at.logarithmic else -np.inf, np.inf)),
        "slope": (f"{of_spread or '1'} per {covariate}", (-np.inf, np.inf)),
        "spread": (of_spread, getattr(structure.spread[name], "support", (0.0, np.inf))),
        "correlation": ("1", (-1.0, 1.0)),
    }[kind]
    return {"units": units, f"support of {label}": list(support)}


def _variables(
    structure: Any, values: np.ndarray, logs: np.ndarray, scaling: Mapping[str, tuple[float, float]]
) -> dict[str, np.ndarray]:
    """Return the parameters (chains, draws) by label, in their units."""
    shape = values.shape[:2]
    parameters = structure.parameters(values.reshape(-1, values.shape[-1]))
    result = {}
    for k, name in enumerate(structure.names):
        result[f"mean[{name}]"] = np.exp(parameters.means[:, k]) if logs[k] else parameters.means[:, k]
    for name, covariate in structure.sloped:
        at = structure.names.index(name), structure.covariates.index(covariate)
        result[f"slope[{name}, {covariate}]"] = parameters.slopes[:, at[0], at[1]] / scaling[covariate][1]
    sds = np.sqrt(np.diagonal(parameters.covariance, axis1=1, axis2=2))
    for name in structure.free:
        result[f"spread[{name}]"] = sds[:, structure.names.index(name)]
    for i, j in structure.pairs:
        a, b = (structure.names.index(structure.free[k]) for k in (j, i))
        label = f"correlation[{structure.free[j]}, {structure.free[i]}]"
        result[label] = parameters.covariance[:, a, b] / (sds[:, a] * sds[:, b])
    return {label: x.reshape(shape) for label, x in result.items()}


def _unit_table(
    density: Any, shrunken: Any, natural: np.ndarray, p: np.ndarray, scaling: Mapping[str, tuple[float, float]],
    again: frozenset[str],
) -> pd.DataFrame:  # fmt: skip
    """Return the table of units."""
    import pandas as pd

    rows, member, size = [], 0, len(density.structure.names)
    for unit in density.units:
        for place, label in enumerate(unit.members):
            given = density.covariates[member]
            for k, name in enumerate(density.structure.names):
                at, log = place * size + k, unit.coordinates[k].logarithmic
                alone = np.exp(unit.quantiles[:, at]) if log else unit.quantiles[:, at]
                under = np.quantile(natural[member, :, k], QUANTILE_LEVELS)
                rows.append(
                    {POPULATION_UNIT: label, PARAMETER: name}
                    | dict(zip(QUANTILES, alone.tolist(), strict=True))
                    | {f"shrunken_{q}": x for q, x in zip(QUANTILES, under.tolist(), strict=True)}
                    | {
                        "pareto_k": float(shrunken.pareto_k[member]), "effective": float(shrunken.effective[member]),
                        "p": float(p[member, k]), "again": int(label in again), "robust": int(bool(unit.misfit)),
                    }
                    | {c: scaling[c][0] + scaling[c][1] * float(x) for c, x in zip(scaling, given, strict=True)}
                )  # fmt: skip
            member += 1
    return pd.DataFrame(rows)
