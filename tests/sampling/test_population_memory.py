"""Populations of stored units: memory of one unit's draws and 2000 of each, and the posterior of the linear model."""

import time
import tracemalloc
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.priors.stored import PRIORS, as_text
from bayesperiodic.sampling.population_units import KEPT_DRAWS
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
