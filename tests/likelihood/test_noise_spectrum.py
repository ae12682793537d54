"""Smoothing of measured variances of noise: power laws, peaks, and the distribution of what it returns."""

import numpy as np
import pytest
from scipy import stats

from bayesperiodic.likelihood.noise_spectrum import smoothed

HARMONIC = np.arange(1.0, 16.0)


def measured(true: np.ndarray, freedom: float, seed: int, count: int) -> np.ndarray:
    """Return measured variances (count, harmonics + 1)."""
    return true * np.random.default_rng(seed).chisquare(freedom, (count, true.size)) / freedom


def test_a_power_law_remains_and_the_mean_keeps_its_own_variance():
    variance = np.concatenate([[7.0], 3.0 * HARMONIC**-2.0])
    freedom = np.full(16, 40.0)
    found = smoothed(variance, freedom)
    # Many degrees of freedom behind few harmonics of a line: the means of ln χ² and χ² differ by 1/ν.
    assert found.variance[1:] == pytest.approx(variance[1:], rel=0.03)
    assert found.variance[0] == 7.0 and found.mixing[0].tolist() == [1.0] + 15 * [0.0]
    assert found.mixing[1:, 1:].sum(axis=1) == pytest.approx(np.ones(15))


@pytest.mark.parametrize("slope", [0.0, -2.0])
def test_variances_have_the_mean_of_their_truth_and_the_stated_uncertainty(slope):
    """False alarms below 1 in 1000: 2000 sets, six standard errors of the mean, a fifth of the variance."""
    true, freedom = np.concatenate([[1.0], HARMONIC**slope]), 4.0
    each = [smoothed(one, np.full(16, freedom)) for one in measured(true, freedom, 3, 2000)]
    ratio = np.array([one.variance for one in each])[:, 1:] / true[1:]
    assert np.abs(ratio.mean(axis=0) - 1.0).max() < 0.06
    # In the middle a line through five variances has the variance of their mean, at the ends three times as much.
    alone = 2.0 / freedom
    assert np.var(ratio[:, 2:-2], axis=0).max() < 0.4 * alone and np.var(ratio, axis=0).max() < alone
    stated = np.mean([(one.mixing[1:, 1:] ** 2).sum(axis=1) for one in each], axis=0) * alone
    assert np.abs(np.log(np.var(ratio, axis=0) / stated)).max() < 0.5


def test_a_line_of_the_noise_at_one_harmonic_is_not_smoothed_away():
    true, count = np.ones(16), 200
    true[6] = 100.0
    found = np.array([smoothed(one, np.full(16, 20.0)).variance[6] for one in measured(true, 20.0, 4, count)])
    alone = stats.chi2.ppf([0.005, 0.995], 20.0) / 20.0
    assert np.median(found) == pytest.approx(100.0, rel=0.35)
    assert np.mean((found > 0.6 * alone[0] * 100.0) & (found < alone[1] * 100.0)) > 0.98


@pytest.mark.parametrize("harmonics", [3, 4])
def test_a_line_of_the_noise_remains_among_few_harmonics_too(harmonics):
    true = np.ones(harmonics + 1)
    true[2] = 100.0
    found = smoothed(true, np.full(true.size, 200.0)).variance
    assert found == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize("variance", [[1.0, 2.0, 3.0], [1.0, 2.0, 0.0, 3.0, 1.0, 2.0]])
def test_few_harmonics_and_harmonics_without_noise_are_left_as_they_are(variance):
    found = smoothed(np.array(variance), np.full(len(variance), 8.0))
    assert found.variance.tolist() == variance
    assert found.mixing.tolist() == np.eye(len(variance)).tolist()


def test_known_variances_are_left_as_they_are():
    variance = np.array([1.0, 2.0, 5.0, 3.0, 1.0, 2.0])
    assert smoothed(variance, np.full(6, np.inf)).variance.tolist() == variance.tolist()
