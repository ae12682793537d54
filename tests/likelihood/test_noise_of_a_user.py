"""Noise models that a user writes with `spectrum` alone: densities from the formula, with and without a mask."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.likelihood.noise_estimate import estimate_noise
from tests.known import LINEAR, grid, linear_experiment, linear_regressors

POINT = np.array([870.0, 37.0, 22.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
MASK = np.arange(40) % 4 == 0


class Falling(bp.noise.Noise):
    """Variances v/(1 + h)."""

    name = "falling"

    def spectrum(self, block, values):
        """Return variances and slopes."""
        variances = values[..., :1] / (1.0 + block.harmonic)
        return variances, np.ones((*variances.shape, 1))


class Twice(bp.noise.Noise):
    """White noise of the variance 2v."""

    name = "twice"

    def spectrum(self, block, values):
        """Return variances and slopes."""
        return 2.0 * values, np.ones((1, 1))


class EachItsOwn(bp.noise.Noise):
    """White noise, in run 2 four times the variance of run 1."""

    name = "each its own"

    def spectrum(self, block, values):
        """Return variances and slopes."""
        return (4.0 if block.experiment == "run 2" else 1.0) * values, np.ones((1, 1))


class Alternating(Falling):
    """`Falling` with a given covariance of the points of a mask."""

    def covariance(self, block, values):
        """Return the covariance and its slope."""
        matrix = values[0] * 0.5 ** np.abs(np.subtract.outer(np.arange(block.size), np.arange(block.size)))
        return matrix, matrix[None]


def run(name: str = "run 1", **changes) -> bp.Experiment:
    """Return an experiment of LINEAR whose residual at POINT is known, see `error`."""
    e = linear_experiment(POINT, 0.0, seed=1, samples=40)
    exact = linear_regressors(0.05, 2.0, grid(40)) @ POINT
    return replace(e, name=name, outputs={"force": exact + error()}, **({"independent": {}} | changes))


def error() -> np.ndarray:
    """Return 2 + 3 cos(2πτ) − 4 sin(2π·3τ) on 40 points."""
    tau = grid(40)
    return 2.0 + 3.0 * np.cos(2 * np.pi * tau) - 4.0 * np.sin(6 * np.pi * tau)


def log_likelihood(noise, *experiments: bp.Experiment, variance: float = 0.7) -> float:
    problem = bp.Problem(LINEAR, list(experiments), priors=PRIORS, noise=noise, input_noise="exact")
    return float(problem.log_likelihood(POINT, {"variance[force]": variance}))


def test_whole_periods_have_the_density_of_the_formula():
    """With N = 2·5 + 1 components r² is N·2², N·3²/2 and N·4²/2 in the harmonics 0, 1 and 3."""
    found = log_likelihood(Falling(), run(harmonics={"force": 5}))
    harmonic = np.array([0, 1, 2, 3, 4, 5, 1, 2, 3, 4, 5])
    variances = 0.7 / (1.0 + harmonic)
    squares = 11 * (4.0 / variances[0] + 4.5 / variances[1] + 8.0 / variances[3])
    assert found == pytest.approx(-0.5 * (np.log(variances).sum() + squares), rel=1e-10)


def test_white_noise_of_a_user_is_right_for_periods_and_for_points_of_a_mask():
    expected = -0.5 * (40 * np.log(1.4) + np.sum(error() ** 2) / 1.4)
    assert log_likelihood(Twice(), run()) == pytest.approx(expected, rel=1e-10)
    expected = -0.5 * (10 * np.log(1.4) + np.sum(error()[MASK] ** 2) / 1.4)
    assert log_likelihood(Twice(), run(mask=MASK)) == pytest.approx(expected, rel=1e-10)


def test_experiments_of_equal_layout_may_have_different_spectra():
    square = np.sum(error() ** 2)
    expected = -0.5 * (40 * np.log(0.7) + square / 0.7 + 40 * np.log(2.8) + square / 2.8)
    assert log_likelihood(EachItsOwn(), run(), run("run 2")) == pytest.approx(expected, rel=1e-10)


def test_points_of_a_mask_are_refused_without_their_covariance():
    with pytest.raises(ValueError, match="^noise: must have a method `covariance` for the points of a mask"):
        log_likelihood(Falling(), run(mask=MASK))


def test_points_of_a_mask_take_the_covariance_of_the_model():
    matrix = 0.7 * 0.5 ** np.abs(np.subtract.outer(np.arange(10), np.arange(10)))
    e = error()[MASK]
    expected = -0.5 * (np.linalg.slogdet(matrix)[1] + e @ np.linalg.solve(matrix, e))
    assert log_likelihood(Alternating(), run(mask=MASK)) == pytest.approx(expected, rel=1e-10)


def test_a_spectrum_of_a_wrong_shape_is_refused():
    class Wrong(Falling):
        name = "wrong"

        def spectrum(self, block, values):
            """Return variances and slopes."""
            return np.ones((*values.shape[:-1], 3)), np.ones((1, 1))

    with pytest.raises(ValueError, match=r"^noise: must have a spectrum of shapes \(…, 1\) or \(…, 11\).*got \(3,\)"):
        log_likelihood(Wrong(), run(harmonics={"force": 5}))


def test_the_estimated_variance_is_the_mean_of_the_squares_in_units_of_the_spectrum():
    """It is v = Σ (1 + h)·r²/n, with n = 11 values, and its logarithm has the prior 1/v."""
    problem = bp.Problem(LINEAR, [run(harmonics={"force": 5})], priors=PRIORS, noise=Falling(), input_noise="exact")
    likelihood = problem.likelihood
    r = np.zeros(11)
    r[[0, 1, 8]] = np.sqrt(11 * np.array([4.0, 4.5, 8.0]))
    found = estimate_noise(likelihood, [r], np.ones(1), 1.0)
    assert found[0] == pytest.approx(4.0 + 2 * 4.5 + 4 * 8.0, rel=1e-7)
    assert likelihood.value_and_gradients([r], found)[2] == pytest.approx([0.0], abs=1e-6)
