"""Populations of few units, whose spreads are open by orders of magnitude, against the normal linear model."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.population_chains import sample_chains
from bayesperiodic.sampling.population_coordinates import Decoupled
from bayesperiodic.sampling.population_density import Hierarchy, PopulationDensity
from tests.sampling.gaussian_units import closed_form, gaussian_units

SD = 3e-3


def few_units(count, names, prior, seed, *, spread=SD, correlation=False, slopes=False):
    """Return the density of a population of normal units, their estimates and their standard deviations."""
    generator = np.random.default_rng([seed, count, len(names)])
    sds = SD * generator.uniform(0.5, 1.5, (count, len(names)))
    estimates = 1.0 + generator.standard_normal(sds.shape) * np.hypot(spread, sds)
    scales = dict.fromkeys(names, prior.scale) if slopes else {}
    day = ("day",) if slopes else ()
    hierarchy = Hierarchy(names, day, dict.fromkeys(names, prior), scales, correlation, np.inf)
    covariates = generator.standard_normal((count, len(day)))
    units = [*gaussian_units(estimates, sds, seed).values()]
    return PopulationDensity(hierarchy, units, covariates), estimates, sds


@pytest.fixture(scope="module")
def correlated():
    """Return the coordinates of two parameters with slopes and a correlation."""
    return Decoupled(few_units(5, ("a", "b"), bp.HalfNormal(0.2), 1, correlation=True, slopes=True)[0])


def test_coordinates_can_be_inverted_and_their_determinant_is_that_of_differences(correlated):
    points = 2.0 * np.random.default_rng(0).standard_normal((20, correlated.dimension))
    natural, log_det = correlated.natural(points)
    np.testing.assert_allclose(correlated.decoupled(natural), points, atol=1e-10)
    step = 1e-5 * np.eye(correlated.dimension)
    for point, expected in zip(points[:5], log_det, strict=False):
        columns = correlated.natural(point + step)[0] - correlated.natural(point - step)[0]
        assert abs(np.linalg.slogdet(columns / 2e-5)[1] - expected) < 1e-7


@pytest.mark.parametrize("width", [5.0, 40.0])
def test_points_far_from_all_units_have_a_density_or_none(correlated, width):
    """Also where the covariance between units is singular in double precision."""
    points = width * np.random.default_rng(0).standard_normal((2000, correlated.dimension))
    log = correlated.evaluate(points).log_prob
    assert np.isneginf(log).any()
    assert np.isfinite(log).any()
    assert not np.isnan(log).any()


@pytest.mark.parametrize("spread", [0.0, SD])
def test_three_units_under_a_wide_prior_have_the_spread_of_the_linear_model(spread):
    """The prior is a hundred times as wide as the units' standard deviations.

    Probabilities are within 0.03: 2000 draws of each unit leave 0.02 at these spreads, the chains 0.01.
    """
    prior, edges = bp.HalfNormal(0.5), np.log(np.geomspace(1e-6, 3.0, 1501))
    for seed in (1, 2):
        density, estimates, sds = few_units(3, ("a",), prior, seed, spread=spread)
        chains = sample_chains(density, seed, progress=False)
        assert chains.converged, chains.reason
        assert chains.draws.shape[1] <= 600
        model = estimates, (sds**2)[:, :, None], np.ones((3, 1, 1)), np.zeros(1)
        middle = 0.5 * (edges[1:] + edges[:-1])
        log = closed_form(*model, np.exp(2.0 * middle)[:, None, None])[0] + prior.log_prob(np.exp(middle)) + middle
        mass = np.exp(log - log.max())
        below = np.cumsum(mass) / mass.sum()
        drawn = [np.mean(chains.draws[..., 1] < edge) for edge in edges[1:]]
        assert np.abs(below - drawn).max() < 0.03


def test_four_units_with_five_parameters_converge():
    chains = sample_chains(few_units(4, tuple("abcde"), bp.HalfNormal(0.2), 1)[0], 1, progress=False)
    assert chains.converged, chains.reason
    assert chains.draws.shape[1] <= 800
