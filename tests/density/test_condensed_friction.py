"""Problems of condensed models with friction: density, gradient and estimate."""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from tests.periodic.test_condensed_memory import SAMPLES, VALUES, force, model

TRUTH = VALUES["jenkins"]
NOISE = {"variance[x]": 1e-4, "variance[a]": 1e-6}


def run(frequency, seed):
    """Return a synthetic experiment of a chain of 30 masses with 1 % noise."""
    truth = bp.solve_periodic(
        model(30, "jenkins"), TRUTH, {"force": force()}, frequency=frequency, samples=SAMPLES
    ).outputs
    random = np.random.default_rng(seed)
    outputs = {n: y + 0.01 * np.ptp(y) * random.standard_normal(SAMPLES) for n, y in truth.items()}
    return bp.Experiment(f"run {frequency}", frequency, outputs, {"force": force()}, samples=SAMPLES)


@cache
def problem():
    priors = {n: bp.LogNormal(1.2 * v, 0.3) for n, v in TRUTH.items() if n != "beta"}
    return bp.Problem(model(30, "jenkins"), [run(0.045, 1), run(0.06, 2)], priors=priors, fixed={"beta": TRUTH["beta"]})


@pytest.mark.parametrize("method", ["adjoint", "forward"])
def test_gradient_is_that_of_finite_differences(method):
    theta = {n: 1.01 * TRUTH[n] for n in problem().names}
    gradient = problem().gradient(theta, NOISE, method=method)
    for i, (name, value) in enumerate(theta.items()):
        ends = [problem().log_posterior(theta | {name: value * (1 + sign * 1e-5)}, NOISE) for sign in (1, -1)]
        assert gradient[i] == pytest.approx((ends[0] - ends[1]) / (2e-5 * value), rel=1e-3)


def test_density_does_not_depend_on_the_anchors():
    """To the error of the grid, which the anchors choose."""
    theta = np.array([TRUTH[n] for n in problem().names])
    theta = theta * np.exp(0.05 * np.random.default_rng(0).standard_normal((3, theta.size)))
    values = problem().log_likelihood(theta, NOISE)
    assert np.isfinite(values).all()
    there = problem().anchored(1.1 * theta[0])
    np.testing.assert_allclose(there.log_likelihood(theta, NOISE), values, rtol=1e-4)


@pytest.mark.slow
def test_estimate_recovers_the_parameters():
    """Each is within 4 standard deviations: by chance, one in 4000 runs with another seed is not."""
    fit = bp.map_estimate(problem())
    assert fit.converged
    sd = np.sqrt(np.diag(fit.covariance))
    for name, error in zip(problem().names, sd, strict=True):
        assert abs(fit.theta[name] - TRUTH[name]) < 4 * error < 0.4 * TRUTH[name]
