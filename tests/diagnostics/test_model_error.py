"""Size of the error of a model, against an error of known size."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.diagnostics.model_error import MODEL_ERROR, UP_TO, ErrorPart, in_words, model_errors

GAIN = bp.Model("gain", states=["w"], inputs=["u"], parameters=["a"], equations=["dw + w - u"], outputs={"y": "a*u"})
TIME = np.arange(10 * 64) / 64


def sizes(seed, error, lines=(3,), kept=10):
    """Return estimate and interval of the error of a gain, with harmonics that it lacks, and its true size."""
    u, wrong = np.cos(2 * np.pi * TIME), error * sum(np.cos(2 * np.pi * h * TIME + 0.3 * h) for h in lines)
    y = 2.0 * u + wrong + 0.1 * np.random.default_rng(seed).standard_normal(TIME.size)
    run = bp.Recording.from_arrays(TIME, {"y": y}, {"u": u}).fold(64, frequency=1.0, harmonics=kept and {"y": kept})
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


SPREAD = range(2, 13)


def test_an_error_spread_over_harmonics_that_fold_drops_is_seen():
    """1.1 % of the rms in eleven harmonics, each too weak to be kept: 40 data sets with default harmonics.

    The true error is above the upper end in 5 %: in more than six of 40 with a probability of 0.3 %. If only the
    harmonics kept counted, it would be in most.
    """
    found = np.array([sizes(seed, 0.011 * 2.0 / np.sqrt(len(SPREAD)), SPREAD, None) for seed in range(40)])
    assert found[0, 3] == pytest.approx(0.011, rel=0.01)
    assert np.sum(found[:, 2] < found[:, 3]) <= 6
    assert np.sum((found[:, 1] <= found[:, 3]) & (found[:, 3] <= found[:, 2])) >= 29


def test_harmonics_left_out_are_no_misfit_where_the_model_has_them():
    """A model with a weak ninth harmonic, of which `fold` keeps the first: its error is that of the noise."""
    model = bp.Model(
        "nine", states=["w"], inputs=["u"], parameters=["a"], equations=["dw + w - u"],
        outputs={"y": "a*u + 1e-3*(256*u**9 - 576*u**7 + 432*u**5 - 120*u**3 + 9*u)"},
    )  # fmt: skip
    u = np.cos(2 * np.pi * TIME)
    y = 2.0 * u + 1e-3 * np.cos(18 * np.pi * TIME) + 1e-5 * np.random.default_rng(1).standard_normal(TIME.size)
    run = bp.Recording.from_arrays(TIME, {"y": y}, {"u": u}).fold(64, frequency=1.0, harmonics={"y": 1})
    assert run.left_out["y"].harmonic[-1] == 31
    assert abs(run.left_out["y"].amplitude[run.left_out["y"].harmonic == 9][0]) == pytest.approx(1e-3, rel=0.01)
    problem = bp.Problem(model, [run], priors={"a": bp.Normal(1, 10)}, scheme="fourier", input_noise="exact")
    fit = bp.map_estimate(problem, checks=False, progress=False)
    here = problem.anchored(fit.theta).density().linearise(problem.vector(fit.theta))
    found = model_errors(problem, here, problem.noise_values(dict(fit.noise))).iloc[0]
    assert found[MODEL_ERROR[2]] < 1e-5 and found[UP_TO] == 31.0


def test_harmonics_left_out_are_none_at_the_points_of_a_mask():
    u = np.cos(2 * np.pi * TIME)
    y = 2.0 * u + 0.1 * np.random.default_rng(3).standard_normal(TIME.size)
    run = bp.Recording.from_arrays(TIME, {"y": y}, {"u": u}).fold(64, frequency=1.0, harmonics={"y": 1})
    assert "y" in run.left_out
    run = replace(run, mask=np.arange(64) % 4 == 0)
    problem = bp.Problem(GAIN, [run], priors={"a": bp.Normal(1, 10)}, scheme="fourier", input_noise="exact")
    fit = bp.map_estimate(problem, checks=False, progress=False)
    here = problem.anchored(fit.theta).density().linearise(problem.vector(fit.theta))
    found = model_errors(problem, here, problem.noise_values(dict(fit.noise))).iloc[0]
    assert np.isnan(found[UP_TO]) and found[MODEL_ERROR[2]] < 0.03


def test_the_words_say_up_to_which_harmonic_the_error_is_known():
    assert in_words([0.016, 0.013, 0.019], 31.0, 0.02) == (
        "the model is wrong by 1.60% of the rms up to harmonic 31 (90 %: 1.3 to 1.9 %), below the tolerance of 2 %"
    )
    assert "at most 1.90% of the rms at the measured points" in in_words([np.nan, 0.0, 0.019], np.nan, None)
