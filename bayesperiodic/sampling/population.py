"""Populations: how parameters differ between units that were identified one by one."""

import gc
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._parallel import TaskPool, checked_executor
from bayesperiodic.density.problem import Problem
from bayesperiodic.priors.single import HalfNormal, Uniform
from bayesperiodic.sampling.membership import FEWEST_EFFECTIVE, USABLE_WEIGHTS, Expected, estimate
from bayesperiodic.sampling.population_chains import Chains, sample_chains
from bayesperiodic.sampling.population_density import Hierarchy, PopulationDensity
from bayesperiodic.sampling.population_evidence import evidence_for_spread
from bayesperiodic.sampling.population_result import Population, coordinate_prior, gather_population
from bayesperiodic.sampling.population_units import UnitDraws, carried_out, checked_names, task_of, unit_draws
from bayesperiodic.sampling.shrinkage import Shrunken, outside, shrink

# Prior scale of the spread of a parameter that is sampled in its logarithm.
LOG_SPREAD = 0.5
# Spread of a common parameter, relative to the smallest standard deviation of a unit.
COMMON_SPREAD = 0.2
SPREADS, COVARIATES = "{'k': bp.HalfNormal(0.1)}", "{'temperature': {'unit 1': 20.0}}"
FEWEST_UNITS, FEWEST_DEGREES, MOST_TURNS, WIDER_PRIOR = 3, 2.0, 5, 1.5


@in_one_thread
def population(
    units: Any,
    names: Sequence[str],
    *,
    spread: Mapping[str, Any] | None = None,
    common: Sequence[str] = (),
    covariates: Mapping[str, Mapping[str, float]] | None = None,
    correlation: bool = False,
    degrees: float = np.inf,
    seed: int,
    executor: Any = None,
    progress: bool = True,
) -> Population:
    """Infer how parameters differ between units (specimens, days, runs) from their separate posteriors.

    In sampling coordinates (logarithms of positive parameters) the parameters of a unit follow a normal distribution
    whose mean is linear in the covariates; all other parameters remain free in each unit, with the unit's own prior.
    Each unit is sampled alone. Its draws, with its prior divided out, are an importance sample of its likelihood under
    any population [1]_ [2]_, so that the mean, the spread and the slopes are all that is sampled then, by emcee with
    proposals from a mixture. The posterior is that of the joint hierarchical model, up to the Monte Carlo error of 2000
    draws a unit, which are smoothed by a kernel that keeps their mean and covariance; so a spread of zero is no special
    case. The prior of the mean is flat. A unit whose weights have a Pareto k̂ above 0.7 [3]_, or fewer than 50 effective
    draws, is sampled again, with the present population as its prior, if its problem was given; otherwise a warning
    names it.

    Parameters
    ----------
    units : mapping of str to unit
        By label: a Problem, which is sampled here, a Posterior, ``(problem, posterior)``, or the path of a saved
        Posterior, which is read when needed. Or one of these alone, whose experiments have local parameters `names`:
        its experiments are then the units, and all other parameters are common to them. At least three units. Draws of
        a misspecified model are replaced by the robust ones, see `Posterior.headline`.
    names : sequence of str
        Parameters of the population.
    spread : mapping of str to HalfNormal, Uniform or float, optional
        Prior of the standard deviation of a parameter between units, in sampling coordinates; a number is a known
        spread. By default ``HalfNormal(0.5)`` for a parameter that is sampled in its logarithm (a factor of 1.65);
        required for any other. Give the size that you expect: few units leave the spread to its prior.
    common : sequence of str
        Those of `names` with the same value in all units. They have a spread of a fifth of the smallest standard
        deviation of a unit, which widens their intervals by at most 2 %.
    covariates : mapping of str to mapping of str to float, optional
        By name (temperature, amplitude, day), the value for each unit. The prior of a slope, per standard deviation of
        the covariate, is normal about zero, with the 68 % quantile of the spread's prior as its standard deviation.
    correlation : bool
        Whether the parameters may be correlated between units; all correlation matrices are equally probable [4]_.
    degrees : float
        Degrees of freedom of a Student t population, > 2, for which a few units may be far from the others; infinite
        for a normal one.
    seed : int
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        Workers that sample the units given as problems and read those given as paths, one task a unit, see `sample`.
    progress : bool

    Returns
    -------
    Population

    Raises
    ------
    ValueError
        For fewer than three units, an unknown name, draws that have not converged or that lack their prior, parameters
        with another support or unit in some units, a missing prior of a spread, or covariates that miss a unit.

    Warns
    -----
    UserWarning
        If a unit could not be sampled and is left out, if draws of a unit are no importance sample of the population,
        or if the chains have not converged.

    References
    ----------
    .. [1] D. W. Hogg, A. D. Myers, J. Bovy, Inferring the eccentricity distribution, Astrophysical Journal 725 (2010)
       2166-2175.
    .. [2] D. Lunn, J. Barrett, M. Sweeting, S. Thompson, Fully Bayesian hierarchical modelling in two stages, with
       application to meta-analysis, Journal of the Royal Statistical Society C 62 (2013) 551-572.
    .. [3] A. Vehtari et al., Pareto smoothed importance sampling, Journal of Machine Learning Research 25 (2024) 1-58.
    .. [4] D. Lewandowski, D. Kurowicka, H. Joe, Generating random correlation matrices based on vines and extended
       onion method, Journal of Multivariate Analysis 100 (2009) 1989-2001.

    Examples
    --------
    >>> three = {"unit 1": posterior, "unit 2": posterior, "unit 3": posterior}
    >>> gears = bp.population(three, ["k"], spread={"k": bp.HalfNormal(0.01)}, seed=1, progress=False)
    >>> gears.converged, gears.labels
    (True, ('mean[k]', 'spread[k]'))
    >>> gears.test(posterior).member
    True
    """
    _checks.integer("seed", seed, 0)
    names, single = checked_names(names), not isinstance(units, Mapping)
    given = {"": units} if single else dict(units)
    for argument, mapping, example in (("spread", spread, SPREADS), ("covariates", covariates, COVARIATES)):
        _checks.mapping(argument, mapping or {}, example)
    if isinstance(common, str):
        raise ValueError(f"common: must be a list of names, got {common!r}; give [{common!r}].")
    settings = Settings(names, spread or {}, tuple(common), correlation, _checked_degrees(degrees))
    workers = checked_executor(executor)
    drawn, left_out = _draw(given, names, single, seed, workers)
    result = fitted(drawn, settings, covariates or {}, seed, progress, Redraws(given, names, single, seed, workers))
    return replace(result, left_out=left_out)


class Settings:
    """What kind of population; `structure` completes it by what the units have."""

    def __init__(
        self,
        names: tuple[str, ...],
        spread: Mapping[str, Any],
        common: tuple[str, ...],
        correlation: bool,
        degrees: float,
    ):
        self.names, self.spread, self.common = names, spread, common
        self.correlation, self.degrees = correlation, degrees
        for name in (*spread, *common):
            _checks.one_of("spread" if name in spread else "common", name, names)
        if both := [name for name in common if name in spread]:
            raise ValueError(f"common: must have no spread, got {', '.join(both)} in both.")

    def structure(self, units: Sequence[UnitDraws], covariates: tuple[str, ...]) -> Hierarchy:
        """Return the structure."""
        size, spreads = len(self.names), dict[str, Any]()
        sds = np.concatenate([np.sqrt(np.diag(unit.covariance)).reshape(-1, size) for unit in units])
        for place, name in enumerate(self.names):
            if name in self.common:
                spreads[name] = COMMON_SPREAD * float(sds[:, place].min())
            else:
                spreads[name] = _checked_spread(name, self.spread.get(name), units[0].coordinates[place].logarithmic)
        scales = {
            name: float(prior.quantile(np.array(0.6827)))
            for name, prior in spreads.items()
            if not isinstance(prior, float)
        }
        return Hierarchy(self.names, covariates, spreads, scales, self.correlation, self.degrees)


def _checked_degrees(degrees: Any) -> float:
    if degrees != np.inf and not _checks.positive("degrees", degrees) > FEWEST_DEGREES:
        raise ValueError(f"degrees: must be > {FEWEST_DEGREES:g}, got {degrees!r}.")
    return float(degrees)


def _checked_spread(name: str, prior: Any, logarithmic: bool) -> Any:
    if prior is None and logarithmic:
        return HalfNormal(LOG_SPREAD)
    if isinstance(prior, HalfNormal) or (isinstance(prior, Uniform) and prior.low == 0.0):
        return prior
    if isinstance(prior, int | float) and not isinstance(prior, bool):
        return _checks.positive(f"spread[{name!r}]", prior)
    raise ValueError(
        f"spread[{name!r}]: must be HalfNormal(scale), Uniform(0, high) or a number, got {prior!r}. The scale is that "
        "of the differences between units that you expect, in the parameter's unit"
        f"{' of its logarithm' if logarithmic else ''}."
    )


def _draw(
    given: Mapping[str, Any], names: tuple[str, ...], single: bool, seed: int, executor: Any
) -> tuple[dict[str, UnitDraws], dict[str, str]]:
    """Return the draws of all units, one of them in memory at a time, and why some have none."""
    tasks = {name: unit for name, unit in given.items() if isinstance(unit, Problem | str | Path)}
    result = _carried_out(tasks, names, single, seed, executor)
    gc.collect()  # the trees of draws that were read contain reference cycles
    for name, unit in given.items():
        if name not in result:
            result[name] = unit_draws(name, unit, names, single)
    left_out = {name: draws for name, draws in result.items() if isinstance(draws, str)}
    for name, reason in left_out.items():
        warnings.warn(f"Unit {name!r} is left out: {reason}.", stacklevel=4)
    return {name: result[name] for name in given if name not in left_out}, left_out


def _carried_out(
    units: Mapping[str, Any], names: tuple[str, ...], single: bool, seed: int, executor: Any
) -> dict[str, Any]:
    """Return the draws of problems and of files, or why there are none, by name; each has a seed of its own."""
    if not units:
        return {}
    labels = list(units)
    tasks = (task_of(name, unit, single, seed + 1 + k) for k, (name, unit) in enumerate(units.items()))
    workers = ThreadPoolExecutor(1) if executor is None else nullcontext(executor)
    with workers as executor, TaskPool(executor, names) as pool:
        return {labels[number]: draws for number, draws in pool.run(carried_out, tasks)}


class Redraws:
    """Units that can be sampled again, with the population as their prior."""

    def __init__(self, given: Mapping[str, Any], names: tuple[str, ...], single: bool, seed: int, executor: Any):
        problems = {n: u[0] if isinstance(u, tuple) and len(u) == 2 else u for n, u in given.items()}
        self._problems = {name: unit for name, unit in problems.items() if isinstance(unit, Problem)}
        self._names, self._single, self._seed, self._executor = names, single, seed, executor

    def again(self, wanted: Mapping[str, UnitDraws], expected: Mapping[str, Expected], turn: int) -> dict[str, Any]:
        """Return new draws of those of the units that can be sampled; `expected` is by member."""
        changed = {}
        for name, unit in wanted.items():
            problem = self._problems.get(name)
            joint = [key for key in (problem.priors if problem else {}) if isinstance(key, tuple)]
            if problem is not None and not any(self._parameters(unit) & {*key} for key in joint):
                changed[name] = problem.replace(priors=dict(problem.priors) | self._priors(unit, expected))
        seed = self._seed + 1_000_000 * turn
        drawn = _carried_out(changed, self._names, self._single, seed, self._executor)
        return {name: draws for name, draws in drawn.items() if isinstance(draws, UnitDraws)}

    def _full(self, unit: UnitDraws, member: str, name: str) -> str:
        if len(unit.members) == 1 and not self._single:
            return name
        return f"{name}[{member if self._single else member.partition(': ')[2]}]"

    def _parameters(self, unit: UnitDraws) -> set[str]:
        return {self._full(unit, member, name) for member in unit.members for name in self._names}

    def _priors(self, unit: UnitDraws, expected: Mapping[str, Expected]) -> dict[str, Any]:
        """Return the population as independent priors, wider than it."""
        priors: dict[str, Any] = {}
        for member in unit.members:
            centre, scales = expected[member].centre, np.sqrt(np.diag(expected[member].covariance))
            for name, at, mean, sd in zip(self._names, unit.coordinates, centre, WIDER_PRIOR * scales, strict=True):
                priors[self._full(unit, member, name)] = coordinate_prior(at, float(mean), float(sd))
        return priors


class _Fit(NamedTuple):
    density: PopulationDensity
    chains: Chains
    shrunken: Shrunken
    calls: int  # evaluations of the density of the population, those before units were sampled again included


def fitted(
    units: dict[str, UnitDraws],
    settings: Settings,
    covariates: Mapping[str, Mapping[str, float]],
    seed: int,
    progress: bool,
    redraws: Redraws | None = None,
) -> Population:
    """Return the population of units that have been drawn."""
    _check_alike(units, settings.names)
    members = [member for unit in units.values() for member in unit.members]
    if len(members) < FEWEST_UNITS:
        raise ValueError(f"units: must be at least {FEWEST_UNITS}, got {len(members)}.")
    values, scaling = _checked_covariates(covariates, members)
    # Made before any unit is sampled under the population, which then is its prior.
    estimates = [estimate(unit) for unit in units.values()]
    structure, turn, calls = settings.structure([*units.values()], tuple(covariates)), 0, 0
    again: frozenset[str] = frozenset()
    while True:
        density = PopulationDensity(structure, [*units.values()], values)
        chains = sample_chains(density, seed, progress=progress)
        shrunken = shrink(density, chains, seed)
        calls += chains.calls
        usable = (shrunken.pareto_k <= USABLE_WEIGHTS) & (shrunken.effective >= FEWEST_EFFECTIVE)
        bad = {member for member, enough in zip(members, usable, strict=True) if not enough}
        wanted = {name: unit for name, unit in units.items() if bad & {*unit.members}}
        if not wanted or redraws is None or turn == MOST_TURNS:
            break
        turn += 1
        new = redraws.again(wanted, _expected(density, shrunken, members), turn)
        if not new:
            break
        units = units | {
            name: replace(unit, calls=unit.calls + units[name].calls, quantiles=units[name].quantiles)
            for name, unit in new.items()
        }
        again = again.union(*(unit.members for unit in new.values()))
    _warn(chains, sorted(bad))
    return gather_population(
        _Fit(density, chains, shrunken, calls),
        evidence_for_spread(density, chains, seed),
        outside(density, shrunken, estimates),
        scaling,
        again,
        seed,
    )


def _expected(density: PopulationDensity, shrunken: Shrunken, members: Sequence[str]) -> dict[str, Expected]:
    parameters = density.structure.parameters(shrunken.points)
    return {
        member: Expected.of(parameters, covariates, density.structure.degrees)
        for member, covariates in zip(members, density.covariates, strict=True)
    }


def _warn(chains: Chains, bad: Sequence[str]) -> None:
    if not chains.converged:
        warnings.warn(f"The population has not converged ({chains.reason}).", stacklevel=4)
    if bad:
        warnings.warn(
            f"Draws of {', '.join(bad)} are no importance sample of the population (Pareto k > {USABLE_WEIGHTS} or "
            f"fewer than {FEWEST_EFFECTIVE:.0f} effective draws). Units given as (problem, posterior), with single "
            "priors, are sampled again; where that does not help, the units contradict `common`, or the population.",
            stacklevel=4,
        )


def _check_alike(units: Mapping[str, UnitDraws], names: Sequence[str]) -> None:
    """Raise a ValueError unless parameters have the same support and unit in all units."""
    first: UnitDraws | None = None
    for label, unit in units.items():
        first = first or unit
        for name, here, there in zip(names, unit.coordinates, first.coordinates, strict=True):
            if here != there:
                raise ValueError(
                    f"units[{label!r}]: {name!r} must have the same support and unit in all units, got "
                    f"{here.support} and {here.unit!r} beside {there.support} and {there.unit!r}."
                )


def _checked_covariates(
    covariates: Mapping[str, Mapping[str, float]], members: Sequence[str]
) -> tuple[np.ndarray, dict[str, tuple[float, float]]]:
    """Return standardised covariates (members, covariates), and mean and standard deviation of each."""
    columns, scaling = [], {}
    for name, by_member in covariates.items():
        _checks.same_names(f"covariates[{name!r}]", by_member, members)
        values = np.array([_checks.finite_number(f"covariates[{name!r}]", by_member[member]) for member in members])
        mean, sd = float(values.mean()), float(values.std())
        if not sd > 0.0:
            raise ValueError(f"covariates[{name!r}]: must differ between units, got {values[0]:g} for all.")
        columns.append((values - mean) / sd)
        scaling[name] = mean, sd
    return np.array(columns).T.reshape(len(members), -1), scaling
