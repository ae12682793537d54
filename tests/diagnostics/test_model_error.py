"""Size of the error of a model, against an error of known size."""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.diagnostics.model_error import MODEL_ERROR, ErrorPart, model_errors

GAIN = bp.Model("gain", states=["w"], inputs=["u"], parameters=["a"], equations=["dw + w - u"], outputs={"y": "a*u"})
TIME = np.arange(10 * 64) / 64


def sizes(seed, error):
    """Return estimate and interval of the error of a gain, with a third harmonic that it lacks, and its true size."""
    u, wrong = np.cos(2 * np.pi * TIME), error * np.cos(6 * np.pi * TIME + 0.3)
    y = 2.0 * u + wrong + 0.1 * np.random.default_rng(seed).standard_normal(TIME.size)
    run = bp.Recording.from_arrays(TIME, {"y": y}, {"u": u}).fold(frequency=1.0, harmonics={"y": 10})
    problem = bp.Problem(GAIN, [run], priors={"a": bp.Normal(1, 10)}, scheme="fourier", input_noise="exact")
    fit = bp.map_estimate(problem, checks=False, progress=False)
    here = problem.anchored(fit.theta).density().linearise(problem.vector(fit.theta))
    found = model_errors(problem, here, problem.noise_values(dict(fit.noise))).iloc[0]
    return *found[[*MODEL_ERROR]], float(np.std(wrong) / np.std(2.0 * u + wrong))


def test_ends_are_those_of_the_noncentral_distribution_where_the_noise_is_known():
    """P(χ² ≤ S) = 5 % at the upper end, 95 % at the lower one; the two moments agree within 3 %."""
    count, square, variance = 20, 90.0, 1.0
    error, low, high = ErrorPart(square, count * variance, 2.0 * count * variance**2, variance, np.inf, np.inf).error()
    assert error == square - count
    assert stats.ncx2.cdf(square, count, high) == pytest.approx(0.05, abs=0.005)
    assert stats.ncx2.cdf(square, count, low) == pytest.approx(0.95, abs=0.005)


def test_a_residual_smaller_than_the_noise_shows_no_more_than_one_of_its_size():
    known = [ErrorPart(square, 20.0, 40.0, 1.0, np.inf, np.inf).error() for square in (2.0, 20.0)]
    assert known[0][2] == known[1][2] > 0.0 and known[0][:2] == (0.0, 0.0)


def test_the_interval_contains_the_true_error():
    """30 data sets at 90 %: fewer than 21 would contain it with a probability of 0.05 %."""
    found = np.array([sizes(seed, 0.3) for seed in range(30)])
    assert np.sum((found[:, 1] <= found[:, 3]) & (found[:, 3] <= found[:, 2])) >= 21
    assert np.median(found[:, 0]) == pytest.approx(found[0, 3], rel=0.03)
