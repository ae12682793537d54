"""Common and local parameters, correlations and slopes, against normal linear models in closed form.

Given the covariance between units, means and slopes are normal (`closed_form`); the covariance has a quadrature grid.
"""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.population import Settings, fitted
from bayesperiodic.sampling.population_density import PopulationDensity
from bayesperiodic.sampling.population_units import unit_draws
from tests.sampling.gaussian_units import closed_form, correlated_units

SPREAD = bp.HalfNormal(0.3)
SPREADS = np.geomspace(0.002, 1.2, 120)
COUNT = 8


def moments(log, *values):
    """Return mean and standard deviation of values (points,) under a log-density on a grid."""
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    means = [weights @ value for value in values]
    return np.array([(m, np.sqrt(weights @ (value - m) ** 2)) for m, value in zip(means, values, strict=True)])


def total_moments(log, means, variances):
    """Return mean and standard deviation of a mixture of distributions with these means and variances (points,)."""
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    mean = weights @ means
    return np.array([mean, np.sqrt(weights @ (variances + (means - mean) ** 2))])


@cache
def two_names():
    """Return estimates (8, 2) and covariances of a parameter that differs and of one that does not."""
    generator = np.random.default_rng(8)
    covariances = np.array([[0.01, 0.006], [0.006, 0.0064]]) * generator.uniform(0.5, 1.5, COUNT)[:, None, None]
    truth = np.column_stack([1.0 + 0.15 * generator.standard_normal(COUNT), np.full(COUNT, 0.8)])
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), generator.standard_normal((COUNT, 2)))
    return truth + noise, covariances


def common_reference():
    """Return mean and sd of mean[a], mean[b] and spread[a] where b has one value in all units."""
    estimates, covariances = two_names()
    between = np.zeros((SPREADS.size, 2, 2))
    between[:, 0, 0] = SPREADS**2
    log, means, covariance = closed_form(
        estimates, covariances, np.broadcast_to(np.eye(2), (COUNT, 2, 2)), np.zeros(2), between
    )
    log = log + SPREAD.log_prob(SPREADS) + np.log(SPREADS)
    each = [total_moments(log, means[:, k], covariance[:, k, k]) for k in range(2)]
    return np.array([*each, moments(log, SPREADS)[0]])


COMMON = Settings(("a", "b"), {"a": SPREAD}, ("b",), False, np.inf)


def test_a_common_parameter_has_the_weighted_mean_of_all_units():
    """Its uncertainty is that of one value in all units, at most 2 % wider; on a grid of the density."""
    units = correlated_units(*two_names(), seed=1)
    density = PopulationDensity(COMMON.structure([*units.values()], ()), [*units.values()], np.zeros((COUNT, 0)))
    assert density.labels == ("mean[a]", "mean[b]", "spread[a]")
    reference = common_reference()
    grids = [mean + sd * np.linspace(-3.2, 3.2, 13) for mean, sd in reference[:2]]
    grids.append(np.log(np.geomspace(0.005, 0.6, 14)))
    points = np.stack([axis.ravel() for axis in np.meshgrid(*grids, indexing="ij")], axis=-1)
    here = moments(density.evaluate(points).log_prob, points[:, 0], points[:, 1], np.exp(points[:, 2]))
    np.testing.assert_allclose(here[:, 0], reference[:, 0], atol=0.2 * reference[:, 1].min())
    np.testing.assert_allclose(here[:, 1], reference[:, 1], rtol=0.08)
    assert here[1, 1] < 0.6 * np.sqrt(two_names()[1][:, 1, 1].min())


@pytest.mark.slow
def test_the_population_with_a_common_parameter_is_that_of_the_linear_model():
    result = fitted(correlated_units(*two_names(), seed=1), COMMON, {}, 1, False)
    summary, reference = result.summary(), common_reference()
    np.testing.assert_allclose(summary["mean"], reference[:, 0], atol=0.2 * reference[:, 1].min())
    np.testing.assert_allclose(summary["sd"], reference[:, 1], rtol=0.1)
    assert list(result.evidence.index) == ["a"]


SAMPLES, NOISE, RUNS = 32, 0.3, 5


@cache
def local_problem():
    """Return a problem y = a + c·u whose runs have their own a, its least squares, and its estimates by run."""
    model = bp.Model(
        "offset", states=["w"], inputs=["u"], parameters=["a", "c"], equations=["dw + w - u"], outputs={"y": "a + c*u"}
    )
    generator, runs, rows, values = np.random.default_rng(3), [], [], []
    for number in range(RUNS):
        u = 1.5 + 0.3 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
        y = 1.0 + 0.2 * generator.standard_normal() + 0.7 * u + NOISE * generator.standard_normal(SAMPLES)
        runs.append(bp.Experiment(f"day {number + 1}", 0.1, {"y": y}, {"u": u}, samples=SAMPLES, synthetic=True))
        row = np.zeros((SAMPLES, RUNS + 1))
        row[:, number], row[:, -1] = 1.0, u
        rows.append(row)
        values.append(y)
    problem = bp.Problem(
        model, runs, priors={"a": bp.Normal(1.0, 0.6), "c": bp.Normal(0.5, 0.5)}, local=["a"],
        fixed={"variance[y]": NOISE**2}, scheme="fourier", input_noise="exact",
    )  # fmt: skip
    rows, values = np.concatenate(rows) / NOISE, np.concatenate(values) / NOISE
    # The prior of c remains, that of a is the population's.
    precision = rows.T @ rows + np.diag([*np.zeros(RUNS), 1.0 / 0.5**2])
    right = rows.T @ values + np.array([*np.zeros(RUNS), 0.5 / 0.5**2])
    covariance = np.linalg.inv(precision)
    return problem, (covariance @ right)[:RUNS], covariance[:RUNS, :RUNS]


def local_reference(estimate, covariance):
    """Return mean and sd of mean[a] and spread[a], the runs being correlated by what is common to them."""
    between = SPREADS[:, None, None] ** 2 * np.eye(RUNS)
    log, mean, variance = closed_form(
        estimate[None], covariance[None], np.ones((1, RUNS, 1)), np.zeros(1), between
    )  # fmt: skip
    log = log + SPREAD.log_prob(SPREADS) + np.log(SPREADS)
    return np.array([total_moments(log, mean[:, 0], variance[:, 0, 0]), moments(log, SPREADS)[0]])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The estimate leaves")  # which is noise
def test_runs_with_a_local_parameter_are_units_correlated_by_the_common_ones():
    """Without the correlation by the common slope, the error of the mean would be little more than half."""
    problem, estimate, covariance = local_problem()
    posterior = bp.sample(problem, bp.map_estimate(problem, progress=False), seed=1, progress=False)
    unit = unit_draws("", posterior, ("a",), alone=True)
    assert unit.members == tuple(f"day {k + 1}" for k in range(RUNS))
    reference = local_reference(estimate, covariance)
    alone = local_reference(estimate, np.diag(np.diag(covariance)))
    assert alone[0, 1] < 0.75 * reference[0, 1]
    for given in (posterior, problem, (problem, posterior)):
        result = bp.population(given, ["a"], spread={"a": SPREAD}, seed=1, progress=False)
        assert result.labels == ("mean[a]", "spread[a]")
        summary = result.summary()
        np.testing.assert_allclose(summary["mean"], reference[:, 0], atol=0.2 * reference[:, 1].min())
        np.testing.assert_allclose(summary["sd"], reference[:, 1], rtol=0.1)


DAYS = np.linspace(-1.5, 1.5, COUNT)
SCALE = float(SPREAD.quantile(np.array(0.6827)))


@cache
def correlated():
    """Return estimates (8, 2) and covariances of parameters that move with the day and are correlated."""
    generator = np.random.default_rng(4)
    covariances = np.broadcast_to(np.diag([0.0036, 0.0025]), (COUNT, 2, 2))
    between = np.array([[0.04, 0.027], [0.027, 0.0225]])
    estimates = 1.0 + DAYS[:, None] * [0.2, -0.1]
    estimates = estimates + generator.multivariate_normal(np.zeros(2), between + covariances[0], COUNT)
    return estimates, covariances


def correlated_reference():
    """Return mean and sd of means, slopes per standard deviation, spreads and the correlation."""
    estimates, covariances = correlated()
    z = (DAYS - DAYS.mean()) / DAYS.std()
    design = np.stack([np.concatenate([np.eye(2), x * np.eye(2)], axis=1) for x in z])
    axes = np.geomspace(0.01, 1.2, 40), np.geomspace(0.01, 1.2, 40), (np.arange(60) + 0.5) / 30.0 - 1.0
    first, second, correlation = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    between = np.empty((first.size, 2, 2))
    between[:, 0, 0], between[:, 1, 1] = first**2, second**2
    between[:, 0, 1] = between[:, 1, 0] = correlation * first * second
    precision = np.array([0.0, 0.0, SCALE**-2, SCALE**-2])
    log, coefficients, covariance = closed_form(estimates, covariances, design, precision, between)
    log = log + SPREAD.log_prob(first) + SPREAD.log_prob(second) + np.log(first * second)
    linear = [total_moments(log, coefficients[:, k], covariance[:, k, k]) for k in range(4)]
    return np.array([*linear, *moments(log, first, second, correlation)])


@pytest.mark.slow
def test_slopes_and_correlation_are_those_of_the_linear_model():
    units = correlated_units(*correlated(), seed=2)
    days = {"day": dict(zip(units, 300.0 + 10.0 * DAYS, strict=True))}
    settings = Settings(("a", "b"), {"a": SPREAD, "b": SPREAD}, (), True, np.inf)
    result = fitted(units, settings, days, 1, False)
    reference = correlated_reference()
    here = result.summary()[["mean", "sd"]].to_numpy(copy=True)
    here[2:4] *= 10.0 * DAYS.std()  # slopes are per unit of the covariate
    assert result.labels[2:] == (
        "slope[a, day]", "slope[b, day]", "spread[a]", "spread[b]", "correlation[a, b]",
    )  # fmt: skip
    np.testing.assert_array_less(abs(here[:, 0] - reference[:, 0]), 0.15 * reference[:, 1])
    np.testing.assert_allclose(here[:, 1], reference[:, 1], rtol=0.1)
    predicted = result.predict({"day": 315.0})["a"].mean()
    assert predicted == pytest.approx(reference[0, 0] + reference[2, 0] * 1.5 / DAYS.std(), abs=0.03)
