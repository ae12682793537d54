"""Laplace against draws whose posterior is known in closed form, drawn exactly."""

from dataclasses import replace
from functools import cache
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.diagnostics.comparison import importance_k
from bayesperiodic.diagnostics.verdicts import Sample, joint_verdict, marginal_verdict
from bayesperiodic.sampling.chains import StoredChains
from bayesperiodic.sampling.draws import gather
from bayesperiodic.sampling.groups import tree
from bayesperiodic.sampling.proposals import CallCount
from tests.known import LINEAR, grid, linear_experiment, linear_regressors
from tests.sampling.test_targets import known, model, run

SHAPE = (4, 80, 20)
SEEDS = range(8)
QUIET = {"progress": False}
END = 1.6448536269514722


def sample(draws):
    """Return 6400 independent draws as a Sample."""
    return Sample.of(draws.reshape(SHAPE), 6400.0)


def with_draws(posterior, name, change):
    data = posterior.tree.copy(deep=True)
    group = data["posterior"].to_dataset()
    group[name] = change(group[name])
    data["posterior"] = type(data)(group)
    return replace(posterior, tree=data)


def test_a_normal_posterior_is_fine(solved):
    problem, fit, posterior = solved
    table = bp.compare(problem, fit, posterior).table
    assert list(table["verdict"]) == ["fine"] * 3
    assert table.loc["k", "sd_ratio"] == pytest.approx(1.0, abs=0.1)
    assert table.loc["k", "laplace_q95"] - table.loc["k", "laplace_q05"] == pytest.approx(
        2 * 1.6448536269514722 * fit.sd["k"]
    )


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda x: x.mean() + 2.0 * (x - x.mean()), "too narrow"),
        (lambda x: x.mean() + 0.5 * (x - x.mean()), "too wide"),
        (lambda x: x + 2.0 * x.std(), "wrong shape"),
        (lambda x: x.mean() + x.std() * (np.exp((x - x.mean()) / x.std()) - np.exp(0.5)) / 2.16, "wrong shape"),
    ],
)
def test_departures_from_normality_are_named(solved, change, verdict):
    problem, fit, posterior = solved
    assert bp.compare(problem, fit, with_draws(posterior, "k", change)).table.loc["k", "verdict"] == verdict


def test_unconverged_draws_give_no_verdict(solved):
    problem, fit, posterior = solved
    table = bp.compare(problem, fit, replace(posterior, converged=False)).table
    assert set(table["verdict"]) == {"not converged"}


def test_every_number_in_the_table_is_that_of_the_draws(solved):
    problem, fit, posterior = solved
    found = bp.compare(problem, fit, posterior).table.loc["c"]
    draws = posterior.draws("c")
    sd = draws.std(ddof=1)
    assert found["coordinate"] == "c"
    assert found["shift"] == pytest.approx((draws.mean() - fit.theta["c"]) / sd)
    assert found["sd_ratio"] == pytest.approx(fit.sd["c"] / sd)
    assert found["skewness"] == pytest.approx(stats.skew(draws))
    for name, z in (("q05", -END), ("q50", 0.0), ("q95", END)):
        value = np.quantile(draws, {"q05": 0.05, "q50": 0.5, "q95": 0.95}[name])
        assert found[name] == pytest.approx(value)
        assert found[f"{name}_difference"] == pytest.approx((value - fit.theta["c"] - z * fit.sd["c"]) / sd)
    distance = stats.wasserstein_distance(
        draws, fit.theta["c"] + fit.sd["c"] * stats.norm.ppf(np.linspace(1e-5, 1 - 1e-5, 50001))
    )
    assert found["wasserstein"] == pytest.approx(distance / sd, rel=0.02)
    error = 1.0 / np.sqrt(posterior.ess["c"])
    assert found["shift_mcse"] == pytest.approx(error, rel=0.5)
    assert found["sd_ratio_mcse"] == pytest.approx(found["sd_ratio"] * error / np.sqrt(2), rel=0.6)


def test_sampling_coordinates_are_logarithms_of_positive_parameters_and_of_variances(solved):
    problem, fit, posterior = solved
    found = bp.compare(problem, fit, posterior, coordinates="sampling").table
    assert list(found["coordinate"]) == ["k", "ln c", "coulomb", "ln variance[force]"]
    for name in ("c", "variance[force]"):
        assert found.loc[name, "map"] == pytest.approx(np.log(fit.joint_mode[name]))
        assert found.loc[name, "laplace_sd"] == pytest.approx(np.sqrt(fit.joint_covariance.loc[name, name]))
        assert found.loc[name, "mean"] == pytest.approx(np.log(posterior.draws(name)).mean())
    assert found.loc["k", "map"] == fit.joint_mode["k"]


def posterior_of(problem, points):
    """Return the posterior of independent draws in sampling coordinates (4, 80, 20, dimension)."""
    return gather(
        problem.density(),
        StoredChains.of(points),
        points[..., 0],
        CallCount(1),
        converged=True,
        reason="drawn exactly",
        acceptance=1.0,
        seed=0,
    )


def redrawn(problem, posterior, points):
    density = problem.density()
    return replace(posterior, tree=tree(density, StoredChains.of(points), points[..., 0], 0))


def by_inversion(log_density, values, generator):
    """Return draws of a density on a fine grid."""
    weights = np.exp(log_density - log_density.max())
    cdf = np.concatenate([[0.0], np.cumsum(0.5 * (weights[1:] + weights[:-1]))])
    return np.interp(generator.uniform(size=SHAPE), cdf / cdf[-1], values)


def ridge_points(generator):
    """Sum and difference of ln a and ln b are independent a priori, and only their sum is measured."""
    total = np.linspace(-0.2, 0.2, 20_001)
    log_density = -0.5 * total**2 / 0.98 - 0.5 * ((np.exp(total) - 1.0) / 0.02) ** 2
    s, d = by_inversion(log_density, total, generator), np.sqrt(0.98) * generator.standard_normal(SHAPE)
    return np.stack([0.5 * (s + d), 0.5 * (s - d)], axis=-1)


def square_points(generator):
    a = np.linspace(-2.0, 2.0, 40_001)
    return by_inversion(-0.5 * (a / 2.0) ** 2 - 0.5 * ((a**2 - 1.0) / 0.1) ** 2, a, generator)[..., None]


def edge_points(generator):
    return stats.truncnorm(-10.0, -1.0, loc=1.0, scale=0.1).rvs(size=(*SHAPE, 1), random_state=generator)


CASES = {
    "ridge": (ridge_points, ["a", "b"], lambda p: {"force": p.a * p.b}, bp.LogNormal(1.0, 0.7), 0.02),
    "square": (square_points, ["a"], lambda p: {"force": p.a**2}, bp.Normal(0.0, 2.0), 0.1),
    "edge": (edge_points, ["a"], lambda p: {"force": p.a}, bp.Uniform(0.0, 0.9), 0.1),
}


MODES = "report each mode by itself; see fit.modes, map_estimate(starts=…)"


@cache
def case(name):
    """Return problem, estimate, posterior of exact draws, and a function that draws again."""
    draw, parameters, output, prior, sd = CASES[name]
    problem = bp.Problem(
        model(name, parameters, output),
        [run(force=1.0)],
        priors=dict.fromkeys(parameters, prior),
        fixed=known(force=sd),
    )
    fit = bp.map_estimate(problem, start={"a": 0.8} | dict.fromkeys(parameters[1:], 0.8), **QUIET)
    return problem, fit, posterior_of(problem, draw(np.random.default_rng(100))), draw


pytestmark = pytest.mark.filterwarnings(
    "ignore:The data do not change under", "ignore:The estimate of 'a', 0.9", "ignore:2 separate optima"
)


def test_optimum_without_draws_is_not_called_fine():
    """All draws are near a = 3, where the only start of one estimate ended; a = 1 has half of the mass."""
    two = model("two", ["a"], lambda p: {"force": (p.a - 2) ** 2})
    problem = bp.Problem(two, [run(force=1.0)], priors={"a": bp.Uniform(0.001, 5.0)}, fixed=known(force=0.02))
    posterior = posterior_of(problem, 3.0 + 0.01 * np.random.default_rng(1).standard_normal((*SHAPE, 1)))
    one = bp.map_estimate(problem, start={"a": 2.9}, **QUIET)
    assert set(bp.compare(problem, one, posterior).table["verdict"]) == {"fine"}
    found = bp.compare(problem, bp.map_estimate(problem, **QUIET), posterior)
    assert set(found.table["verdict"]) == {found.joint["verdict"]} == {"wrong mode"}
    assert set(found.table["recommendation"]) == {MODES}


@pytest.mark.parametrize(
    ("name", "coordinates", "verdict", "joint", "advice"),
    [
        ("ridge", "natural", "wrong shape", "wrong shape", "logarithms cure it: use Laplace in sampling coordinates"),
        ("ridge", "sampling", "fine", "fine", "use Laplace"),
        ("square", "natural", "wrong mode", "wrong mode", MODES),
        ("edge", "natural", "wrong shape", "wrong shape", "report the MCMC quantiles"),
    ],
)
def test_verdicts_are_right_and_do_not_depend_on_the_draws(name, coordinates, verdict, joint, advice):
    """On 8 sets of 6400 exact draws each."""
    problem, fit, posterior, draw = case(name)
    for seed in SEEDS:
        again = redrawn(problem, posterior, draw(np.random.default_rng(seed)))
        found = bp.compare(problem, fit, again, coordinates=coordinates)
        assert set(found.table["verdict"]) == {verdict}
        assert set(found.table["recommendation"]) == {advice}
        assert (found.joint["verdict"], found.joint["recommendation"]) == (joint, advice)


def test_fewer_than_one_in_twenty_well_determined_linear_problems_has_a_warning():
    """Of 200 problems with 40 values, three parameters and an unknown variance; draws from normal-inverse-gamma."""
    design, generator, warned = linear_regressors(0.05, 2.0, grid(40)), np.random.default_rng(8), 0
    inverse = np.linalg.inv(design.T @ design)
    root = np.linalg.cholesky(inverse)
    for _ in range(200):
        data = design @ [900.0, 40.0, 25.0] + 3.0 * generator.standard_normal(40)
        mean = inverse @ design.T @ data
        rest = float(np.sum((data - design @ mean) ** 2))
        variances = 0.5 * rest / generator.gamma(0.5 * 37, size=(6400, 1))
        points = mean + np.sqrt(variances) * (generator.standard_normal((6400, 3)) @ root.T)
        covariance = rest / 37 * inverse
        sampled = [sample(points[:, i]) for i in range(3)]
        found = {
            marginal_verdict(sampled[i], mean[i], float(np.sqrt(covariance[i, i])), (-np.inf, np.inf), True)
            for i in range(3)
        }
        found.add(joint_verdict(points, mean, covariance, sample, (0.3, 0.1), True))
        warned += found != {"fine"}
    assert warned < 10


def linear_case(seed=1, **fixed):
    priors = {"k": bp.Normal(0.0, 1e6), "c": bp.Normal(0.0, 1e6), "coulomb": bp.Normal(0.0, 1e6)}
    problem = bp.Problem(LINEAR, [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=seed)], priors=priors, fixed=fixed)
    return problem, bp.map_estimate(problem, **QUIET)


def linear_points(fit, generator):
    root = np.linalg.cholesky(fit.covariance.to_numpy())
    return np.array([*fit.theta.values()]) + generator.standard_normal((*SHAPE, 3)) @ root.T


def test_laplace_is_the_posterior_of_a_linear_problem_with_known_variance():
    """Ellipsoids have their nominal probability within 4 errors, and all importance weights are equal."""
    problem, fit = linear_case(**{"variance[force]": 9.0})
    posterior = posterior_of(problem, linear_points(fit, np.random.default_rng(9)))
    for coordinates in ("natural", "sampling"):
        found = bp.compare(problem, fit, posterior, coordinates=coordinates)
        assert {*found.table["verdict"], found.joint["verdict"]} == {"fine"}
        assert found.joint["pareto_k"] == 0.0
        for level in (50, 90, 95):
            error = found.joint[f"share_{level}_mcse"]
            assert found.joint[f"share_{level}"] == pytest.approx(level / 100, abs=4 * error)
            assert error == pytest.approx(np.sqrt(level / 100 * (1 - level / 100) / 6400), rel=0.6)
        assert found.shares == pytest.approx(found.probabilities, abs=0.03)


def test_laplace_with_unknown_variance_is_a_good_proposal():
    """Student's t with 37 degrees of freedom in three dimensions."""
    problem, fit = linear_case()
    generator = np.random.default_rng(10)
    variance = 0.5 * 37 * fit.variances["force"] / generator.gamma(0.5 * 37, size=(*SHAPE, 1))
    centre = np.array([*fit.theta.values()])
    theta = centre + np.sqrt(variance / fit.variances["force"]) * (linear_points(fit, generator) - centre)
    found = bp.compare(problem, fit, posterior_of(problem, np.concatenate([theta, np.log(variance)], axis=-1)))
    assert {*found.table["verdict"], found.joint["verdict"]} == {"fine"}
    assert found.joint["pareto_k"] < 0.5


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda x, centre, g: centre + 1.6 * (x - centre), "too narrow"),
        (lambda x, centre, g: centre + (x - centre) / 1.6, "too wide"),
        (lambda x, centre, g: x + 1.5 * x.std(axis=(0, 1, 2)), "wrong shape"),
        (lambda x, centre, g: centre + (x - centre) / np.sqrt(g.gamma(1.0, size=(*SHAPE, 1))), "wrong shape"),
        (lambda x, centre, g: x + 12.0 * x.std(axis=(0, 1, 2)), "wrong mode"),
        (lambda x, centre, g: x + 8.0 * x.std(axis=(0, 1, 2)) * (g.uniform(size=(*SHAPE, 1)) < 0.2), "wrong mode"),
    ],
)
def test_joint_departures_from_normality_are_named(change, verdict):
    """Scaled, shifted, of Student's t with two degrees of freedom, and with a second mode."""
    problem, fit = linear_case(**{"variance[force]": 9.0})
    generator = np.random.default_rng(11)
    points = change(linear_points(fit, generator), np.array([*fit.theta.values()]), generator)
    assert bp.compare(problem, fit, posterior_of(problem, points)).joint["verdict"] == verdict


@pytest.mark.parametrize(
    ("scale", "shift", "k", "verdict"),
    [
        (1.0, 0.0, 0.3, "fine"),
        (1.0, 1.0, 0.3, "wrong shape"),
        (1.4, 0.0, 0.3, "too narrow"),
        (0.7, 0.0, 0.3, "too wide"),
        (1.0, 0.0, 0.9, "wrong shape"),
        (1.0, 0.0, 0.75, "fine"),
    ],
)
def test_joint_verdict_distinguishes_shift_and_scale_and_uses_pareto_k(scale, shift, k, verdict):
    points = shift + scale * np.random.default_rng(14).standard_normal((6400, 3))
    assert joint_verdict(points, np.zeros(3), np.eye(3), sample, (k, 0.1), True) == verdict


def test_a_heavy_tailed_posterior_has_a_large_pareto_k():
    """A Cauchy prior that the data hardly change."""
    faint = model("edge", ["a"], lambda p: {"force": p.a})
    problem = bp.Problem(faint, [run(force=1.0)], priors={"a": bp.StudentT(0.0, 1.0, 1.0)}, fixed=known(force=1e3))
    fit = bp.map_estimate(problem, **QUIET)
    draws = np.random.default_rng(12).standard_cauchy(size=(*SHAPE, 1))
    found = bp.compare(problem, fit, posterior_of(problem, draws)).joint
    assert found["pareto_k"] > 0.7
    assert found["verdict"] == "wrong shape"


def test_the_tail_of_even_importance_weights_does_not_count():
    """A prior as wide as the likelihood: weights are almost even, and k̂ of their tail is above 0.7."""
    data = linear_experiment([900.0, 40.0, 25.0], 300.0, seed=8)
    priors = {"k": bp.Normal(900.0, 1500.0), "c": bp.Normal(40.0, 4.0)}
    problem = bp.Problem(LINEAR, [data], priors=priors, fixed={"coulomb": 25.0})
    fit = bp.map_estimate(problem, **QUIET)
    k, error, efficiency = importance_k(problem, fit, "natural")
    assert k - error > 0.7 and efficiency > 0.98
    posterior = bp.sample(problem, fit, seed=1, variances="collapsed", **QUIET)
    found = bp.compare(problem, fit, posterior)
    assert (found.joint["verdict"], found.joint["recommendation"]) == ("fine", "use Laplace")
    assert found.joint["efficiency"] == efficiency


def test_modes_are_reported_before_convergence_only_if_every_ensemble_has_them():
    problem, fit, posterior, draw = case("square")
    points = draw(np.random.default_rng(13))
    stuck = np.abs(points)
    stuck[0] = points[0]
    for values, verdict in ((points, "wrong mode"), (stuck, "not converged")):
        found = bp.compare(problem, fit, replace(redrawn(problem, posterior, values), converged=False))
        assert (found.table.loc["a", "verdict"], found.joint["verdict"]) == (verdict, verdict)


def test_undetermined_parameters_get_the_verdict_too_wide(solved):
    problem, fit, posterior = solved
    covariance = fit.covariance.copy()
    covariance.loc["k"], covariance["k"] = np.nan, np.nan
    covariance.loc["k", "k"] = np.inf
    blind = replace(fit, covariance=covariance, joint=replace(fit.joint, covariance=fit.joint_covariance * np.nan))
    found = bp.compare(problem, blind, posterior)
    assert found.table["verdict"].to_dict() == {"k": "too wide", "c": "fine", "coulomb": "fine"}
    assert found.table.loc["k", "recommendation"] == "report a combination that the data determine"
    assert found.joint["verdict"] == "too wide"
    assert np.isnan([found.joint["share_90"], found.joint["pareto_k"]]).all()
    with pytest.raises(ValueError, match="coordinates: must be 'natural' for an estimate without a joint Laplace"):
        bp.compare(problem, blind, posterior, coordinates="sampling")


def test_error_names_the_bad_argument(solved):
    problem, fit, posterior = solved
    with pytest.raises(ValueError, match="coordinates: must be one of 'natural', 'sampling', got 'ridge'"):
        bp.compare(problem, fit, posterior, coordinates="ridge")
    with pytest.raises(ValueError, match="posterior: must be a result of this problem"):
        bp.compare(case("edge")[0], case("edge")[1], posterior)


def test_comparison_has_text_and_html_representations(solved):
    problem, fit, posterior = solved
    found = bp.compare(problem, fit, posterior)
    text = repr(found)
    assert "Laplace against MCMC in natural coordinates" in text
    assert "The 50, 90 and 95% Laplace ellipsoids contain" in text and "Pareto k" in text
    table = found.table.rename(index={"k": "theta[<b>]"}).replace({"coordinate": {"k": "theta[<b>]"}})
    page = replace(found, table=table)._repr_html_()
    tree_ = ElementTree.fromstring(f"<div>{page}</div>")
    assert [row.find("th").text for row in tree_.iter("tr")][1:] == ["theta[<b>]", "c", "coulomb"]
    assert [span.text for span in tree_.iter("span")] == ["fine"] * 4
    assert "http" not in page and "<script" not in page
