"""Modes that walkers do not cross between: starting points and the convergence criterion."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.convergence import quantile_spread, stop_rule, unmet_criteria
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


CASES = {
    "equal": (lambda a: (a - 2.0) ** 2, bp.Normal(2.0, 3.0), 2.0),
    "unequal": (lambda a: (a - 2.0) ** 2, bp.Normal(5.81, 3.0), 2.0),
    "mirror image": (lambda a: a**2, bp.Normal(0.1, 1.0), 0.0),
}


@pytest.mark.filterwarnings("ignore:. separate optima")
@pytest.mark.parametrize("case", CASES)
def test_masses_of_two_modes_are_those_of_a_quadrature(case):
    """0.5 : 0.5, 0.7 : 0.3 and a mirror image under a prior off zero, within 5 Monte Carlo errors of 0.5 % or less."""
    size, prior, between = CASES[case]
    two = model(case.replace(" ", "_"), ["a"], lambda p: {"force": size(p.a)})
    problem = bp.Problem(two, [run(force=1.0)], priors={"a": prior}, fixed=known(force=0.05))
    fit = bp.map_estimate(problem, **QUIET)
    posterior = bp.sample(problem, fit, seed=1, **QUIET)
    a = np.linspace(between - 3.0, between + 3.0, 600_001)
    weight = np.exp(-0.5 * ((size(a) - 1.0) / 0.05) ** 2 + prior.log_prob(a))
    above = weight[a > between].sum() / weight.sum()
    modes = posterior.modes
    row = fit.modes.index[fit.modes["a"] > between].item()
    assert modes.loc[row, "a"] > between
    assert posterior.converged and len(modes) == 2
    assert modes.loc[row, "mcse_mass"] < 0.006
    assert abs(modes.loc[row, "mass"] - above) < 5.0 * modes.loc[row, "mcse_mass"]
    assert posterior.draws("a")[posterior.draws("a") > between].mean() == pytest.approx(modes.loc[row, "a"])
    assert posterior.summary(mode=row).loc["a", "sd"] == pytest.approx(0.025, rel=0.1)


def test_error_names_a_mode_without_draws():
    problem, fit = ridge({"a": bp.TruncatedNormal(1.0, 1.0, 0.0, np.inf), "b": bp.LogNormal(1.0, 0.5)})
    posterior = bp.sample(problem, fit, seed=1, ensembles=2, max_steps=100, **QUIET)
    assert posterior.modes.empty
    with pytest.raises(ValueError, match="mode: must be"):
        posterior.summary(mode=1)


def test_the_stop_rule_covers_the_fractions_of_draws_at_the_modes():
    """Ensembles that remain in one of two modes each, with the same draws otherwise."""
    generator = np.random.default_rng(1)
    kept, tau = generator.standard_normal((4, 2000, 32, 1)), np.ones(2)
    mixed = (generator.random(kept.shape[:3]) < 0.5).astype(int)
    assert stop_rule(kept, mixed, tau, ("a",))[1] == []
    apart = np.broadcast_to(np.array([0, 0, 1, 1])[:, None, None], kept.shape[:3])
    slow = np.repeat(generator.random((4, 10, 32)) < 0.5, 200, axis=1).astype(int)
    for modes in (apart, slow):
        assert stop_rule(kept, modes, tau, ("a",))[1][0].startswith("weights of modes: ")


def test_quantiles_of_ensembles_are_compared_also_where_the_median_lies_between_modes():
    """0.25 sd apart at the median, as two normal distributions are; half the draws at ±1 agree."""
    generator = np.random.default_rng(1)
    kept = generator.standard_normal((2, 5000, 32, 1))
    kept[1] += 0.25
    assert quantile_spread(kept) == pytest.approx(0.25, abs=0.03)
    halves = np.where(generator.random(kept.shape) < 0.5, 1.0, -1.0) + 0.01 * generator.standard_normal(kept.shape)
    assert quantile_spread(halves) < 0.05
