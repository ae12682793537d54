"""The tests of uniformity: false alarm rates and power."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from bayesperiodic.diagnostics.calibration import (
    chi_square_test,
    dispersion_test,
    ecdf_band,
    ecdf_test,
    evaluation_points,
    normal_scores,
)

TESTS = {"dispersion": lambda u: dispersion_test(u)[1], "ecdf": ecdf_test, "chi square": chi_square_test}


@pytest.mark.parametrize("which", TESTS)
def test_false_alarm_rate_is_the_nominal_one(which):
    """Of 1000 uniform samples of 200, within the two-sided 99.9 % binomial band of 5 %."""
    samples = np.random.default_rng(1).uniform(size=(1000, 200))
    alarms = sum(TESTS[which](u) < 0.05 for u in samples)
    low, high = stats.binom.ppf([0.0005, 0.9995], 1000, 0.05)
    assert low <= alarms <= high


def test_dispersion_test_has_more_power_against_small_variances():
    """1000 values, level 1 %: the exact power is that of χ² scaled by 1/0.8; 200 samples, five standard errors."""
    scores = np.random.default_rng(2).standard_normal((200, 1000)) / np.sqrt(0.8)
    seen = {name: np.mean([test(ndtr(z)) < 0.01 for z in scores]) for name, test in TESTS.items()}
    low, high = stats.chi2.ppf([0.005, 0.995], 1000)
    power = stats.chi2.sf(0.8 * high, 1000) + stats.chi2.cdf(0.8 * low, 1000)
    assert power > 0.97
    assert seen["dispersion"] == pytest.approx(power, abs=5 * np.sqrt(power * (1 - power) / 200))
    assert seen["ecdf"] < seen["dispersion"] and seen["chi square"] < seen["dispersion"]


def test_dispersion_is_the_mean_square_of_the_normal_scores():
    u = np.array([0.5, ndtr(2.0), ndtr(-1.0)])
    assert dispersion_test(u)[0] == pytest.approx(5.0 / 3.0)
    assert np.isfinite(normal_scores(np.array([0.0, 1.0]))).all()


def test_ecdf_band_covers_the_whole_distribution_function():
    """Of 20,000 samples of 150, 95 % within the band: five standard errors."""
    low, high = ecdf_band(150, 0.95)
    cells = np.diff(evaluation_points(), prepend=0.0, append=1.0)
    steps = np.random.default_rng(3).multinomial(150, cells, 20_000).cumsum(axis=1)[:, :-1] / 150
    held = np.mean(np.all((steps >= low) & (steps <= high), axis=1))
    assert held == pytest.approx(0.95, abs=5 * np.sqrt(0.95 * 0.05 / 20_000))


def test_ecdf_band_detects_a_shift():
    assert ecdf_test(ndtr(np.random.default_rng(4).standard_normal(500) + 0.3)) < 1e-3
