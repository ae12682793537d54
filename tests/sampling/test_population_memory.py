"""Populations of stored units: memory of one unit's draws and 2000 of each, and the posterior of the linear model."""

import time
import tracemalloc
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.priors.stored import PRIORS, as_text
from bayesperiodic.sampling.population_units import KEPT_DRAWS
from bayesperiodic.sampling.shrinkage import SHRUNKEN_DRAWS
from studies.population.springs import DAMPING_SPREAD, SPRING_TRUTH
from studies.population.stored import SLOPE, STORED_DRAWS, StoredUnits, stored_population, stored_units
from tests.drawn import posterior_of
from tests.sampling.gaussian_units import closed_form, with_prior
from tests.sampling.test_population_structure import moments, total_moments

FILES, STORED, PRIOR, SPREAD = 20, 40_000, bp.Normal(1.0, 0.5), bp.HalfNormal(0.3)
SPREADS = np.geomspace(0.01, 1.0, 400)


@cache
def estimates():
    """Return estimates (20, 1) and their covariances."""
    generator = np.random.default_rng(6)
    covariances = generator.uniform(0.05, 0.15, (FILES, 1, 1)) ** 2
    truth = 1.0 + 0.2 * generator.standard_normal((FILES, 1))
    return truth + np.sqrt(covariances[:, 0]) * generator.standard_normal((FILES, 1)), covariances


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Return the files of twenty units with 40,000 draws each of the parameter and of two others."""
    folder, generator, paths = tmp_path_factory.mktemp("units"), np.random.default_rng(7), []
    for number, (estimate, covariance) in enumerate(zip(*estimates(), strict=True)):
        mean, variance = with_prior(estimate, covariance, PRIOR.mean, PRIOR.sd)
        draws = {"a": mean[0] + np.sqrt(variance[0, 0]) * generator.standard_normal(STORED)}
        draws |= {name: generator.standard_normal(STORED) for name in ("c", "d")}
        posterior = posterior_of(draws, dict.fromkeys(draws, (-np.inf, np.inf)))
        posterior.ess.update(dict.fromkeys(draws, float(STORED)))
        posterior.tree.attrs[PRIORS] = as_text({"a": PRIOR})
        paths.append(folder / f"{number}.h5")
        posterior.save(paths[-1])
    return paths


def traced(function):
    """Return what a function returns, and its peak of allocated memory [bytes]."""
    tracemalloc.start()
    try:
        return function(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("count", [40])
def test_stored_units_take_the_memory_of_one_and_2000_draws_of_each(stored, count):
    """The files are read several times; mean and spread are those of the linear model with as many units.

    Memory beyond that of three units; the first population imports what is missing.
    """

    def fit(number):
        units = {f"unit {k}": stored[k % FILES] for k in range(number)}
        return bp.population(units, ["a"], spread={"a": SPREAD}, seed=1, progress=False)

    fit(3)
    few, start = traced(lambda: fit(3))[1], time.process_time()
    result, peak = traced(lambda: fit(count))
    seconds = time.process_time() - start
    # Coordinate and weight of each draw; weight, coordinate and square in the density, twice while it is made.
    kept, reading = 8 * KEPT_DRAWS * count * (2 + 2 * 3), 8 * STORED * 3
    print(
        f"{count} stored units of {STORED} draws: peak {peak / 1e6:.0f} MB, {few / 1e6:.0f} MB for three units; "
        f"a unit's draws {reading / 1e6:.1f} MB, 2000 kept ones {8e-6 * KEPT_DRAWS:.3f} MB; {seconds:.0f} s, "
        f"{result.calls} evaluations"
    )
    assert peak < few + kept + 5e6 < few + count * reading

    repeated = [np.resize(values, (count, *values.shape[1:])) for values in estimates()]
    log, mean, variance = closed_form(*repeated, np.ones((count, 1, 1)), np.zeros(1), SPREADS[:, None, None] ** 2)
    log = log + SPREAD.log_prob(SPREADS) + np.log(SPREADS)
    reference = np.array([total_moments(log, mean[:, 0], variance[:, 0, 0]), moments(log, SPREADS)[0]])
    here = result.summary()[["mean", "sd"]].to_numpy()
    print(here, reference, sep="\n")
    assert result.converged
    np.testing.assert_array_less(abs(here[:, 0] - reference[:, 0]), 0.5 * reference[:, 1])
    np.testing.assert_allclose(here[:, 1], reference[:, 1], rtol=0.1)


@pytest.mark.parametrize(
    "count", [pytest.param(100, marks=pytest.mark.slow), pytest.param(1000, marks=pytest.mark.campaign)]
)
def test_stored_units_have_the_mean_slope_and_spread_of_the_linear_model(count, tmp_path):
    """Their memory is that of 2000 draws of each. Files are removed.

    The truth is within 3.5 standard deviations, which fails once in 700 by chance.
    """
    units = stored_units(tmp_path, count, 2)
    few = traced(lambda: stored_population(StoredUnits(*(first_of(part, 10) for part in units)), 1))[1]
    result, peak = traced(lambda: stored_population(units, 1))
    for path in units.paths.values():
        path.unlink()
    # As above, and draws and densities of the units under the population.
    kept, reading = 8 * count * (KEPT_DRAWS * (2 + 2 * 3) + 4 * SHRUNKEN_DRAWS), 8 * STORED_DRAWS * 3
    print(f"{count} stored units: peak {peak / 1e6:.0f} MB, {few / 1e6:.0f} MB for ten, {result.calls} evaluations")
    assert peak < few + kept + 5e6 < few + count * reading

    temperatures = np.array([*units.temperatures.values()])
    unit_sd = temperatures.std()
    design = np.stack([np.ones(count), (temperatures - temperatures.mean()) / unit_sd], axis=-1)[:, None]
    prior = bp.HalfNormal(0.5)
    precision = np.array([0.0, float(prior.quantile(np.array(0.6827))) ** -2])
    spreads = np.linspace(0.2, 0.4, 400)
    log, means, covariance = closed_form(
        units.estimates[:, None], units.errors[:, None, None] ** 2, design, precision, spreads[:, None, None] ** 2
    )
    log = log + prior.log_prob(spreads)
    lines = [total_moments(log, means[:, k], covariance[:, k, k]) for k in range(2)]
    reference = np.array([*lines, moments(log, spreads)[0]])
    draws = np.log(result.draws("mean[c]") / SPRING_TRUTH["c"]), unit_sd * result.draws("slope[c, temperature]")
    draws = np.stack([*draws, result.draws("spread[c]")])
    print(draws.mean(axis=1), draws.std(axis=1), reference, sep="\n")
    assert result.converged and (result.units["pareto_k"] < 0.7).all()
    np.testing.assert_array_less(abs(draws.mean(axis=1) - reference[:, 0]), 0.5 * reference[:, 1])
    np.testing.assert_allclose(draws.std(axis=1), reference[:, 1], rtol=0.1)
    truth = np.array([0.0, unit_sd * SLOPE, DAMPING_SPREAD])
    np.testing.assert_array_less(abs(draws.mean(axis=1) - truth), 3.5 * draws.std(axis=1))


def first_of(values, count):
    """Return the first entries of an array or of a mapping."""
    return dict(list(values.items())[:count]) if isinstance(values, dict) else values[:count]
