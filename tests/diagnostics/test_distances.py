"""Distances from a normal distribution, against closed forms."""

import numpy as np
import pytest
from scipy import stats

from bayesperiodic.diagnostics.verdicts import (
    Sample,
    ellipsoid_radii,
    normal_draws,
    radii,
    wasserstein,
    wasserstein_distance,
)
from bayesperiodic.sampling.convergence import pareto_k

EXACT = stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)


def sample(draws, size=None):
    return Sample.of(draws.reshape(4, -1, 8), size or draws.size)


@pytest.mark.parametrize("shift", [0.3, -2.0])
def test_distance_of_normals_with_equal_sd_is_their_shift(shift):
    assert wasserstein(5.0 + 2.0 * EXACT, 5.0 - 2.0 * shift, 2.0) / 2.0 == pytest.approx(abs(shift), rel=1e-9)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
def test_centred_normals_are_apart_by_the_mean_of_the_half_normal_times_the_difference_of_their_sds(ratio):
    expected = abs(ratio - 1.0) * np.sqrt(2 / np.pi)
    assert wasserstein(EXACT, 0.0, ratio) == pytest.approx(expected, rel=1e-3, abs=1e-12)


def test_the_distance_of_normal_draws_from_their_own_distribution_is_within_its_error():
    """The bias that the error includes is the expected distance: it agrees within 10 % over 50 sets of 6400 draws."""
    generator = np.random.default_rng(1)
    found = np.array([wasserstein_distance(sample(generator.standard_normal(6400)), 0.0, 1.0) for _ in range(50)])
    assert found[:, 0].mean() == pytest.approx(1.288 / np.sqrt(6400), rel=0.1)
    assert np.all(found[:, 0] < 3.0 * found[:, 1])


def test_monte_carlo_errors_are_those_of_repeated_chains():
    """AR(1) chains of tau 9, 54 tau long: the errors of mean, sd and 5 % quantile agree with the spread of 400 runs.

    Spreads of 400 runs are known within 4 %, batches of six tau fall short by up to 8 %: 15 % is allowed.
    """
    generator, rho, steps = np.random.default_rng(2), 0.8, 490
    noise = np.sqrt(1 - rho**2) * generator.standard_normal((400, 4, steps, 8))
    noise[:, :, 0] = generator.standard_normal((400, 4, 8))
    for i in range(1, steps):
        noise[:, :, i] += rho * noise[:, :, i - 1]
    for statistic in (
        lambda x: x.mean(axis=-1),
        lambda x: x.std(axis=-1),
        lambda x: np.quantile(x, 0.05, axis=-1),
        lambda x: np.mean(x < -1.0, axis=-1),
    ):
        found = np.array([sample(run).estimate(statistic) for run in noise])
        assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.15)


def test_batches_are_contiguous_draws_of_one_ensemble():
    draws = (np.arange(32).reshape(4, 8, 1) * 1000 + np.arange(83)).swapaxes(1, 2)
    batches = Sample.of(draws, 100.0).batches
    assert batches.shape == (32, 80)
    assert [set(row // 8000) for row in batches] == [{e} for e in range(4) for _ in range(8)]
    assert all(np.ptp(row % 1000) == 9 for row in batches)


def test_the_error_of_a_fraction_is_at_least_that_of_independent_draws():
    none, error = sample(EXACT[:3200], size=400.0).fraction(lambda x: x > 10.0, 0.05)
    assert (none, error) == (0.0, pytest.approx(np.sqrt(0.05 * 0.95 / 400)))


@pytest.mark.parametrize("dimension", [1, 3, 8])
@pytest.mark.parametrize("widened", [1.0, 1.5])
def test_a_widened_normal_fills_ellipsoids_as_chi_squared_says(dimension, widened):
    """Within 4 binomial errors of 40,000 draws; false alarms below 1e-3 over all six."""
    generator = np.random.default_rng(dimension)
    root = generator.standard_normal((dimension, dimension)) * np.geomspace(1e-6, 1e3, dimension)[:, None]
    mean, covariance = np.full(dimension, 7.0), root @ root.T
    points, log_density = normal_draws(mean, covariance * widened**2, 40_000, generator)
    distances, levels = radii(points, mean, covariance), np.array([0.5, 0.9, 0.95])
    np.testing.assert_allclose(log_density, -0.5 * (distances / widened) ** 2, rtol=1e-5, atol=1e-6)
    expected = stats.chi2.cdf(stats.chi2.ppf(levels, dimension) / widened**2, dimension)
    shares = np.mean(distances[:, None] < ellipsoid_radii(levels, dimension), axis=0)
    assert shares == pytest.approx(expected, abs=4 * 0.5 / np.sqrt(40_000))


@pytest.mark.parametrize("k", [0.2, 0.7, 1.2])
def test_pareto_k_of_pareto_weights_is_their_shape(k):
    """The weights U^(−k) have exactly this shape; three errors of a fit to 300 of them, with its prior at 0.5."""
    log_weights = k * np.random.default_rng(3).exponential(size=10_000)
    assert pareto_k(log_weights) == pytest.approx((300 * k + 10 * 0.5) / 310, abs=3 * (1 + k) / np.sqrt(300))
    zeros = np.concatenate([log_weights, np.full(10_000, -np.inf)])
    assert pareto_k(zeros) == pytest.approx((300 * k + 10 * 0.5) / 310, abs=3 * (1 + k) / np.sqrt(300))


def test_pareto_k_of_equal_weights_is_zero_and_of_missing_weights_infinite():
    assert pareto_k(1e-9 * np.random.default_rng(4).standard_normal(1000)) == 0.0
    assert pareto_k(np.where(np.arange(1000) < 100, 0.0, -np.inf)) == np.inf
    assert pareto_k(np.full(1000, -np.inf)) == np.inf
