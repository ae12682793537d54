"""Modes that walkers do not cross between: starting points and the convergence criterion."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.convergence import unmet_criteria
from bayesperiodic.sampling.starts import laplace_approximation, mirrored_modes, start_points
from tests.sampling.test_targets import known, model, ridge, run

QUIET = {"progress": False}
UNCUT = bp.Normal(1.0, 1.0)


@pytest.mark.filterwarnings("ignore:The data do not change under")
def test_the_product_of_two_signed_numbers_has_a_mirrored_mode():
    """With both signs negative the likelihood is the same and the prior density lower by e^-4 at the mode."""
    problem, fit = ridge({"a": UNCUT, "b": UNCUT})
    density = problem.density()
    mean, covariance = laplace_approximation(density, fit)
    ((signs, share),) = mirrored_modes(density, mean, covariance)
    assert signs.tolist() == [-1.0, -1.0]
    assert share == pytest.approx(np.exp(-2.0 * mean.sum()), rel=1e-6) and share == pytest.approx(np.exp(-4.0), rel=0.1)
    points = start_points(density, fit, "laplace", 32, np.random.default_rng(1))
    product = points.prod(axis=1)
    assert np.sum(np.all(points < 0.0, axis=1) & (product > 0.0)) >= 2


def test_modes_that_are_close_or_improbable_are_not_reported():
    """A parameter measured near zero has one mode that covers both signs; one at 1 ± 0.1 has no mode at -1."""
    for value in (0.05, 1.0):
        problem = bp.Problem(
            model("number", ["a"], lambda p: {"force": p.a}), [run(force=value)], priors={"a": bp.Normal(0.0, 2.0)},
            fixed=known(force=0.1),
        )  # fmt: skip
        density = problem.density()
        assert mirrored_modes(density, *laplace_approximation(density, bp.map_estimate(problem, **QUIET))) == []


def test_positive_parameters_have_no_mirrored_modes():
    cut = bp.TruncatedNormal(1.0, 1.0, 0.0, np.inf)
    problem = bp.Problem(
        model("number", ["a"], lambda p: {"force": p.a}), [run(force=1.0)], priors={"a": cut}, fixed=known(force=0.1)
    )
    density = problem.density()
    assert mirrored_modes(density, *laplace_approximation(density, bp.map_estimate(problem, **QUIET))) == []


def test_one_separate_walker_prevents_convergence():
    """One of 128 independent walkers that is off by one sd hardly changes any quantile."""
    kept = np.random.default_rng(1).standard_normal((4, 2000, 32, 2))
    tau = np.ones(2)
    assert unmet_criteria(kept, tau, tau, ("a", "b")) == []
    kept[2, :, 5, 1] += 1.0
    assert [text[:22] for text in unmet_criteria(kept, tau, tau, ("a", "b"))] == ["walkers that stay apar"]


def test_error_names_the_coordinate_that_does_not_move():
    kept = np.zeros((4, 2000, 32, 2))
    still = unmet_criteria(kept, np.array([1.0, np.inf]), np.ones(2), ("a", "b"))
    assert still == ["'b' not moving, as every proposal is refused"]
