"""Modes that walkers do not cross between: starting points and the convergence criterion."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.convergence import unmet_criteria
from bayesperiodic.sampling.starts import start_points
from tests.sampling.test_targets import known, model, ridge, run

QUIET = {"progress": False}
UNCUT = bp.Normal(1.0, 1.0)


@pytest.mark.filterwarnings("ignore:The data do not change under", "ignore:2 separate optima")
def test_walkers_start_at_both_optima_of_a_product():
    """With both signs negative the likelihood is the same and the prior density lower by e^-4 at the mode."""
    problem, fit = ridge({"a": UNCUT, "b": UNCUT})
    assert fit.modes["a"][1] < 0.0 and fit.modes["b"][1] < 0.0
    points = start_points(problem.density(), fit, "laplace", 32, np.random.default_rng(1))
    product = points.prod(axis=1)
    assert np.sum(np.all(points < 0.0, axis=1) & (product > 0.0)) >= 2


@pytest.mark.filterwarnings("ignore:. separate optima")
@pytest.mark.parametrize("start", ["laplace", "overdispersed"])
def test_walkers_start_in_proportion_to_the_masses(start):
    """a³ − 3a = 1 ± 0.001 at −1.53, −0.35 and 1.88, with masses in proportion to 1/|3a² − 3| and the prior."""
    cubic = model("cubic", ["a"], lambda p: {"force": p.a**3 - 3 * p.a})
    problem = bp.Problem(cubic, [run(force=1.0)], priors={"a": bp.Normal(0.0, 3.0)}, fixed=known(force=0.001))
    fit = bp.map_estimate(problem, **QUIET)
    points = start_points(problem.density(), fit, start, 64, np.random.default_rng(1))
    roots = np.sort(np.roots([1.0, 0.0, -3.0, -1.0]).real)
    mass = np.exp(-(roots**2) / 18) / np.abs(3 * roots**2 - 3)
    counts = [np.sum(np.abs(points - root) < 0.1) for root in roots]
    assert np.array(counts) == pytest.approx(64 * mass / mass.sum(), abs=1.0) and sum(counts) == 64


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
