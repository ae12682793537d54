"""Populations against closed forms, quadrature, and the joint posterior."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import emcee
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student

import bayesperiodic as bp
from bayesperiodic.priors.stored import as_text, from_text
from bayesperiodic.problem.parameters import support, unit
from bayesperiodic.sampling.membership import Expected, UnitEstimate
from bayesperiodic.sampling.population import Redraws, Settings, fitted
from bayesperiodic.sampling.population_density import Hierarchy, Parameters, PopulationDensity
from bayesperiodic.sampling.population_units import unit_draws
from tests.known import grid
from tests.sampling.gaussian_units import gaussian_units

SPREAD = bp.HalfNormal(0.3)
ESTIMATES = 1.0 + np.array([-0.21, 0.05, 0.12, -0.08, 0.3, 0.02, -0.11, 0.17])[:, None]
SDS = np.array([0.1, 0.05, 0.1, 0.12, 0.08, 0.1, 0.07, 0.1])[:, None]


def one_name(estimates=ESTIMATES, sds=SDS, *, degrees=np.inf, seed=1, prior_sd=0.5):
    """Return the density of a population with one parameter."""
    units = gaussian_units(estimates, sds, seed, prior_sd=prior_sd)
    hierarchy = Hierarchy(("a",), (), {"a": SPREAD}, {"a": 0.3}, False, degrees)
    return PopulationDensity(hierarchy, [*units.values()], np.zeros((len(units), 0)))


def exact(points):
    """Return the log-density of mean and ln spread for normal units: the normal-normal hierarchical model."""
    mean, spread = points[:, :1], np.exp(points[:, 1:])
    likelihood = norm.logpdf(ESTIMATES[:, 0], mean, np.hypot(spread, SDS[:, 0])).sum(axis=1)
    return likelihood + SPREAD.log_prob(spread[:, 0]) + points[:, 1]


def grid_points():
    """Return a grid over mean and ln spread, from 0.003 to 1."""
    axes = np.linspace(0.75, 1.3, 56), np.log(np.geomspace(3e-3, 1.0, 60))
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=-1)


def moments(log, points):
    """Return means and standard deviations of mean and spread, of a log-density on the grid."""
    weights, values = np.exp(log - log.max()), np.column_stack([points[:, 0], np.exp(points[:, 1])])
    weights /= weights.sum()
    mean = weights @ values
    return mean, np.sqrt(weights @ (values - mean) ** 2)


@pytest.mark.parametrize("prior_sd", [0.5, 0.15])
def test_density_is_that_of_the_normal_normal_model_also_at_a_spread_near_zero(prior_sd):
    points = grid_points()
    mean, sd = moments(exact(points), points)
    for seed in (1, 2):
        here, width = moments(one_name(seed=seed, prior_sd=prior_sd).evaluate(points).log_prob, points)
        np.testing.assert_allclose(here, mean, atol=0.2 * sd.min())
        np.testing.assert_allclose(width, sd, rtol=0.06)


def test_the_prior_of_the_units_is_divided_out():
    points, estimates = grid_points(), []
    for prior_mean in (0.6, 1.4):
        units = [*gaussian_units(ESTIMATES, SDS, 1, prior_mean=prior_mean, prior_sd=0.2).values()]
        density = PopulationDensity(one_name().structure, units, np.zeros((len(units), 0)))
        estimates.append(moments(density.evaluate(points).log_prob, points)[0])
    np.testing.assert_allclose(*estimates, atol=0.02)


def test_student_population_is_the_integral_over_the_unit():
    density = one_name(ESTIMATES[:1], SDS[:1], degrees=4.0)
    points = np.array([[0.9, np.log(0.2)], [1.2, np.log(0.1)], [0.2, np.log(0.1)], [0.8, np.log(1e-3)]])

    def value(mean, spread):
        def integrand(x):
            return norm.pdf(x, ESTIMATES[0, 0], SDS[0, 0]) * student.pdf((x - mean) / spread, 4.0) / spread

        total = quad(integrand, -3.0, 5.0, points=[mean, ESTIMATES[0, 0]], limit=200)[0]
        return np.log(total) + SPREAD.log_prob(spread) + np.log(spread)

    expected = [value(mean, np.exp(log)) for mean, log in points]
    here = density.evaluate(points).log_prob
    np.testing.assert_allclose(here - here[0], np.array(expected) - expected[0], atol=0.15)


@pytest.mark.parametrize("draws", [2000, 333])
def test_compiled_means_over_the_draws_are_those_of_numpy(draws):
    """Also 3000 standard deviations from the population, where the exponentials of all terms are zero."""
    estimates = np.append(ESTIMATES, [[300.0]], axis=0)
    units = [*gaussian_units(estimates, np.append(SDS, [[0.1]], axis=0), 1, draws=draws).values()]
    density = PopulationDensity(one_name().structure, units, np.zeros((len(units), 0)))
    points = np.array([[0.9, np.log(0.2)], [1.2, np.log(1e-3)], [1.0, np.log(30.0)]])
    (group,), parameters = density.groups, density.structure.parameters(points)
    terms, constant = density.log_terms(group, parameters, slice(None))
    expected = logsumexp(terms, axis=1) - np.log(draws) + constant
    here = density.evaluate(points).log_prob - density.structure.log_prior(points)
    assert np.exp(terms[-1, :, 0] + constant[-1, 0]).max() == 0.0
    np.testing.assert_allclose(here, expected.sum(axis=0), rtol=1e-13)


@cache
def two_names():
    """Return hierarchy, estimates and density of correlated parameters with a covariate."""
    generator = np.random.default_rng(5)
    estimates, sds = 1.0 + 0.2 * generator.standard_normal((6, 2)), np.full((6, 2), 0.1)
    covariates = np.array([-1.5, -1.0, -0.2, 0.4, 0.8, 1.5])[:, None]
    hierarchy = Hierarchy(
        ("a", "b"), ("day",), {"a": SPREAD, "b": bp.Uniform(0.0, 1.0)}, {"a": 0.3, "b": 0.3}, True, np.inf
    )
    units = gaussian_units(estimates, sds, 3)
    return hierarchy, estimates, sds, covariates, PopulationDensity(hierarchy, [*units.values()], covariates)


def test_correlations_and_slopes_enter_as_in_the_closed_form():
    hierarchy, estimates, sds, covariates, density = two_names()
    assert hierarchy.labels == (
        "mean[a]", "mean[b]", "slope[a, day]", "slope[b, day]", "spread[a]", "spread[b]", "correlation[a, b]",
    )  # fmt: skip
    point = np.array([1.05, 0.95, 0.05, -0.1, np.log(0.2), np.log(0.15), np.arctanh(0.6)])
    other = np.array([0.95, 1.0, 0.0, 0.02, np.log(0.3), np.log(0.25), np.arctanh(-0.3)])

    def value(p):
        spread = np.exp(p[4:6])
        covariance = np.outer(spread, spread) * np.where(np.eye(2) == 1.0, 1.0, np.tanh(p[6]))
        total = norm.logpdf(p[2:4], 0.0, 0.3).sum() + SPREAD.log_prob(spread[0]) + p[4] + p[5]
        total += np.log(0.5 / np.cosh(p[6]) ** 2)  # uniform over (−1, 1)
        for y, sd, z in zip(estimates, sds, covariates, strict=True):
            total += multivariate_normal.logpdf(y, p[:2] + p[2:4] * z, covariance + np.diag(sd**2))
        return total

    here = density.evaluate(np.stack([point, other])).log_prob
    assert here[0] - here[1] == pytest.approx(value(point) - value(other), abs=0.4)


def test_correlation_matrices_are_equally_probable():
    """The density of partial correlations times their Jacobian is that of the matrices: 3 × 3, in closed form."""
    names = ("a", "b", "c")
    hierarchy = Hierarchy(names, (), dict.fromkeys(names, SPREAD), {}, True, np.inf)
    generator = np.random.default_rng(1)
    points = np.column_stack([np.zeros((2, 6)), generator.normal(size=(2, 3))])
    log = hierarchy.log_prior(points)

    def entries(u):
        matrix = hierarchy.parameters(np.append(np.zeros(6), u)[None]).covariance[0]
        return matrix[[1, 2, 2], [0, 0, 1]]

    steps = 1e-6 * np.eye(3)
    jacobians = [np.stack([(entries(p[6:] + s) - entries(p[6:] - s)) / 2e-6 for s in steps]) for p in points]
    determinants = [np.log(abs(np.linalg.det(jacobian))) for jacobian in jacobians]
    assert log[0] - log[1] == pytest.approx(determinants[0] - determinants[1], abs=1e-5)
    matrix = hierarchy.parameters(points).covariance
    assert np.linalg.eigvalsh(matrix).min() > 0.0


@cache
def normal_population():
    """Return the population of the eight normal units."""
    settings = Settings(("a",), {"a": SPREAD}, (), False, np.inf)
    return fitted(gaussian_units(ESTIMATES, SDS, 1), settings, {}, 1, False)


def test_draws_evidence_and_shrunken_units_are_those_of_the_normal_normal_model():
    result, points = normal_population(), grid_points()
    mean, sd = moments(exact(points), points)
    summary = result.summary()
    assert result.converged
    np.testing.assert_allclose(summary["mean"], mean, atol=0.25 * sd.min())
    np.testing.assert_allclose(summary["sd"], sd, rtol=0.08)

    weights = np.exp(exact(points) - exact(points).max())
    precision = 1.0 / SDS[:, 0] ** 2 + np.exp(-2.0 * points[:, 1:])
    conditional = (ESTIMATES[:, 0] / SDS[:, 0] ** 2 + points[:, :1] * np.exp(-2.0 * points[:, 1:])) / precision
    shrunken = weights @ conditional / weights.sum()
    drawn = [result.shrunken(unit, "a").mean() for unit in dict.fromkeys(result.units["unit"])]
    np.testing.assert_allclose(drawn, shrunken, atol=0.015)
    assert (result.units["pareto_k"] < 0.7).all()

    # Evidence by quadrature: flat mean, spread from its prior, against none.
    mus = np.linspace(0.5, 1.5, 2001)
    none = np.exp(norm.logpdf(ESTIMATES[:, 0], mus[:, None], SDS[:, 0]).sum(axis=1)).sum() * (mus[1] - mus[0])
    areas = np.diff(np.unique(points[:, 0]))[0] * np.diff(np.unique(points[:, 1]))[0]
    some = np.exp(exact(points)).sum() * areas
    row = result.evidence.loc["a"]
    assert abs(row["log_bayes_factor"] - np.log(some / none)) < 3.0 * row["error"] < 3.0
    assert row["bridge"] == pytest.approx(row["log_bayes_factor"], abs=0.5)  # from the same draws


def test_result_can_be_saved_and_is_printed(tmp_path):
    result = normal_population()
    result.save(tmp_path / "population.h5")
    loaded = bp.load(tmp_path / "population.h5")
    assert repr(loaded) == repr(result) and "Population of 8 units, normal (converged)" in repr(result)
    group = loaded.tree["posterior"].to_dataset()
    assert [(unit(group, label), support(group, label)) for label in loaded.labels] == [
        ("m", (-np.inf, np.inf)), ("m", (0.0, np.inf)),
    ]  # fmt: skip
    assert loaded.as_prior() == result.as_prior()
    np.testing.assert_array_equal(loaded.predict()["a"], result.predict()["a"])


def test_prediction_has_the_spread_and_the_error_of_the_mean():
    result = normal_population()
    expected = np.sqrt(np.mean(result.draws("spread[a]") ** 2) + result.draws("mean[a]").var())
    assert result.predict()["a"].std() == pytest.approx(expected, rel=0.05)
    assert result.as_prior()["a"].sd == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_a_unit_that_is_apart_lies_outside():
    estimates = np.append(1.0 + 0.02 * np.array([-1.0, 0.5, 1.2, -0.4, 0.1, -1.1, 0.7, 0.2, -0.3, 0.6]), 3.0)
    sds = np.full((11, 1), 0.02)
    settings = Settings(("a",), {"a": SPREAD}, (), False, 4.0)
    result = fitted(gaussian_units(estimates[:, None], sds, 1), settings, {}, 1, False)
    assert list(result.outside) == ["unit 11"]


def test_p_values_of_members_are_uniform_and_joint_ones_agree_with_the_chi_square_law():
    """Kolmogorov-Smirnov at a level of 1e-3, fixed seed."""
    from scipy.stats import chi2, kstest

    generator = np.random.default_rng(1)
    covariance, noise = np.array([[0.04, 0.01], [0.01, 0.09]]), np.diag([0.01, 0.02])
    expected = Expected.of(
        Parameters(np.ones((1, 2)), np.zeros((1, 2, 0)), covariance[None]), np.zeros(0), np.inf
    )  # fmt: skip
    estimates = generator.multivariate_normal([1.0, 1.0], covariance + noise, 2000)
    p = np.array([expected.single(UnitEstimate(y, noise, 0.0)) for y in estimates])
    assert min(kstest(column, "uniform").pvalue for column in p.T) > 1e-3
    offset = estimates[0] - 1.0
    law = chi2(2).sf(offset @ np.linalg.inv(covariance + noise) @ offset)
    assert expected.joint(UnitEstimate(estimates[0], noise, 0.0), generator) == pytest.approx(law, abs=0.015)


def test_stored_priors_come_back_and_unknown_ones_are_left_out():
    joint = bp.MultivariateNormal([1.0, 2.0], [[1.0, 0.2], [0.2, 2.0]])
    priors = {"a": bp.LogNormal(2.0, 0.1), "b": bp.TruncatedNormal(0.0, 1.0, -1.0, np.inf), ("c", "d"): joint}
    assert from_text(as_text({**priors, "e": object()})) == priors


def test_bad_arguments_are_refused():
    units = gaussian_units(ESTIMATES, SDS, 1)
    settings = Settings(("a",), {"a": SPREAD}, (), False, np.inf)
    with pytest.raises(ValueError, match="at least 3"):
        fitted(dict(list(units.items())[:2]), settings, {}, 1, False)
    with pytest.raises(ValueError, match=r"covariates\['day'\]: must have"):
        fitted(units, settings, {"day": {"unit 1": 1.0}}, 1, False)
    with pytest.raises(ValueError, match="must differ between units"):
        fitted(units, settings, {"day": dict.fromkeys(units, 1.0)}, 1, False)
    with pytest.raises(ValueError, match=r"spread\['a'\]: must be HalfNormal"):
        fitted(units, Settings(("a",), {}, (), False, np.inf), {}, 1, False)
    other = replace(units["unit 1"], coordinates=(units["unit 1"].coordinates[0]._replace(unit="mm"),))
    with pytest.raises(ValueError, match="same support and unit"):
        fitted(units | {"unit 1": other}, settings, {}, 1, False)
    with pytest.raises(ValueError, match="names: must be a sequence"):
        bp.population(units, "a", seed=1)
    with pytest.raises(ValueError, match=r"units\['x'\]: must be a Problem"):
        bp.population({"x": 3.0}, ["a"], seed=1)
    with pytest.raises(ValueError, match="spread: must be a mapping"):
        bp.population({}, ["a"], spread=0.5, seed=1)
    with pytest.raises(ValueError, match="covariates: must be a mapping"):
        bp.population({}, ["a"], covariates=["day"], seed=1)
    with pytest.raises(ValueError, match="common: must be a list of names, got 'b'"):
        bp.population(units, ["a"], common="b", seed=1)
    with pytest.raises(ValueError, match="degrees: must be > 2"):
        bp.population({}, ["a"], degrees=1.0, seed=1)


SAMPLES, NOISE = 32, 0.02


@cache
def gears(count=5):
    """Return Duffing problems whose damping and stiffness differ, of known noise."""
    generator, problems = np.random.default_rng(2), {}
    force = np.cos(2 * np.pi * grid(SAMPLES))
    for number in range(count):
        truth = {"m": 1.0, "k3": 0.5, "c": 0.2 * np.exp(0.2 * generator.standard_normal())}
        truth["k"] = np.exp(0.05 * generator.standard_normal())
        solution = bp.solve_periodic(
            bp.models.duffing, truth, {"force": force}, frequency=0.1, samples=SAMPLES, scheme="fourier"
        )
        x = solution.outputs["displacement"] + NOISE * generator.standard_normal(SAMPLES)
        run = bp.Experiment("run", 0.1, {"displacement": x}, {"force": force}, samples=SAMPLES, synthetic=True)
        problems[f"gear {number + 1}"] = bp.Problem(
            bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1.0, 0.3)},
            fixed={"m": 1.0, "k3": 0.5, "variance[displacement]": NOISE**2}, scheme="fourier",
        )  # fmt: skip
    return problems


@cache
def gear_posteriors():
    """Return the gears with their draws."""
    return {
        name: (problem, bp.sample(problem, bp.map_estimate(problem, progress=False), seed=1, progress=False))
        for name, problem in gears().items()
    }


def joint_draws(problems, spreads, steps):
    """Return draws (…, 4) of means and ln spreads of ln c and ln k from the joint density of population and units."""
    densities = [problem.density() for problem in problems.values()]
    count = len(densities)

    def log_prob(points):
        means, logs, units = points[:, :2], points[:, 2:4], points[:, 4:].reshape(-1, count, 2)
        total = sum(spreads[k].log_prob(np.exp(logs[:, k])) + logs[:, k] for k in range(2))
        scores = (units - means[:, None]) / np.exp(logs)[:, None]
        total = total + np.sum(-0.5 * scores**2 - logs[:, None], axis=(1, 2))
        for k, density in enumerate(densities):
            theta, noise = density.to_natural(units[:, k])
            total = total + density.log_likelihood(theta, noise).log_prob
        return np.where(np.isfinite(total), total, -np.inf)

    generator = np.random.default_rng(4)
    start = np.concatenate([[np.log(0.2), 0.0, np.log(0.2), np.log(0.05)], np.tile([np.log(0.2), 0.0], count)])
    walkers = start + 0.02 * generator.standard_normal((96, start.size))
    sampler = emcee.EnsembleSampler(
        *walkers.shape, log_prob, vectorize=True,
        moves=[(emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)],
    )  # fmt: skip
    sampler.run_mcmc(emcee.State(walkers, random_state=np.random.RandomState(4).get_state()), steps)
    return sampler.get_chain(discard=steps // 4, flat=True)[:, :4]


@pytest.mark.slow
def test_equals_the_joint_posterior_of_five_gears():
    """Means and standard deviations, within the errors of both chains (five units, two parameters)."""
    spreads = bp.HalfNormal(0.5), bp.HalfNormal(0.2)
    joint = joint_draws(gears(), spreads, 3000)
    result = bp.population(
        gear_posteriors(), ["c", "k"], spread={"c": spreads[0], "k": spreads[1]}, seed=1, progress=False
    )
    labels = "mean[c]", "mean[k]", "spread[c]", "spread[k]"
    here = np.log(np.stack([result.draws(label) for label in labels], axis=-1))
    for k, label in enumerate(labels):
        reference = joint[:, k] if k < 2 else np.exp(joint[:, k])
        values = here[:, k] if k < 2 else np.exp(here[:, k])
        print(label, reference.mean(), values.mean(), reference.std(), values.std())
        assert abs(values.mean() - reference.mean()) < 0.15 * reference.std()
        assert values.std() == pytest.approx(reference.std(), rel=0.12)


@pytest.mark.slow
def test_stored_draws_read_here_or_by_workers_and_problems_with_draws_give_the_same_population(tmp_path):
    pairs = gear_posteriors()
    paths = {}
    for name, (_, posterior) in pairs.items():
        paths[name] = tmp_path / f"{name}.h5"
        posterior.save(paths[name])
    first, second, third = (
        bp.population(units, ["k"], spread={"k": bp.HalfNormal(0.2)}, seed=1, executor=executor, progress=False)
        for units, executor in ((pairs, None), (paths, None), (paths, 2))
    )
    assert repr(first) == repr(second) == repr(third)
    assert first.unit_calls == sum(posterior.log_posterior_calls for _, posterior in pairs.values())


@cache
def three_gears(executor=None):
    """Return the population of three gears, sampled by these workers."""
    return bp.population(gears(3), ["k"], spread={"k": bp.HalfNormal(0.2)}, seed=1, executor=executor, progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["processes", "dask", "threads"])
def test_populations_are_identical_for_any_executor(which, request):
    """Three gears, sampled by workers, which also return their draws in any order."""
    with ThreadPoolExecutor(2) as threads:
        result = three_gears(threads if which == "threads" else request.getfixturevalue(which))
    serial = three_gears()
    for label in serial.labels:
        np.testing.assert_array_equal(result.draws(label), serial.draws(label))
    assert result.units.equals(serial.units) and result.unit_calls == serial.unit_calls > 0


@pytest.mark.slow
def test_draws_without_their_prior_are_refused():
    problem, posterior = gear_posteriors()["gear 1"]
    tree = posterior.tree.copy()
    tree.attrs = {key: value for key, value in tree.attrs.items() if key != "priors"}
    old = replace(posterior, tree=tree)
    with pytest.raises(ValueError, match="draws without the prior of k"):
        bp.population(dict.fromkeys("abc", old), ["k"], seed=1)
    again = bp.population(
        dict.fromkeys("abc", (problem, old)), ["k"], spread={"k": bp.HalfNormal(0.01)}, seed=1, progress=False
    )
    assert again.names == ("k",)


@pytest.mark.slow
def test_a_unit_that_is_sampled_again_has_the_population_as_its_prior():
    problem = gears()["gear 1"]
    posterior = bp.sample(problem, bp.map_estimate(problem, progress=False), seed=1, progress=False)
    unit, sd = unit_draws("gear 1", (problem, posterior), ("k",)), 0.002
    narrow = Parameters(np.zeros((1, 1)), np.zeros((1, 1, 0)), np.full((1, 1, 1), sd**2))
    expected = Expected.of(narrow, np.zeros(0), np.inf)
    again = Redraws({"gear 1": (problem, posterior)}, ("k",), False, 1, None).again(
        {"gear 1": unit}, {"gear 1": expected}, 1
    )
    precision = 1.0 / unit.covariance[0, 0] - 1.0 / 0.3**2 + 1.0 / (1.5 * sd) ** 2
    assert again["gear 1"].covariance[0, 0] * precision == pytest.approx(1.0, abs=0.15)
