"""Densities over sampling coordinates: which variances are integrated out, and the integral by quadrature."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

import bayesperiodic as bp
from bayesperiodic import noise
from bayesperiodic.density import log_posterior
from bayesperiodic.density.log_posterior import LogPosterior, SamplingCoordinates, collapsible
from bayesperiodic.likelihood.likelihood import Residuals
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers
from bayesperiodic.likelihood.samples import Samples
from tests.known import LINEAR, SADDLE_NODE, linear_experiment

PRIORS = {"k": bp.LogNormal(800.0, 0.1), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}

HARMONIC = {MeanPeriod: [np.array([0, 1, 2, 3, 4, 1, 2, 3, 4])], Samples: [], Multipliers: []}


def description(model, free=("variance[y]",), counts=("variance[y]",), kinds=(MeanPeriod,)):
    likelihood = SimpleNamespace(
        counts=dict.fromkeys(counts, 9.0),
        blocks=[kind("run", "y", 9.0, 9, *HARMONIC[kind]) for kind in kinds],
        shared=[],
    )
    return SimpleNamespace(noise=model, likelihood=likelihood, free_noise=free)


BOTH = ("variance[y]", "lengthscale[y]")


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (description(noise.Independent()), ("variance[y]",)),
        (description(noise.Independent(prior="flat"), kinds=(Samples,)), ("variance[y]",)),
        (description(noise.Independent(prior=bp.InverseGamma(2.0, 1.0))), ()),
        (description(noise.Independent(), free=("variance[y]", "other")), ("variance[y]",)),
        (description(noise.Independent(), free=()), ()),
        (description(noise.Measured()), ()),
        (description(noise.Circulant()), ("variance[y]",)),
        (description(noise.Circulant(), kinds=(MeanPeriod, Multipliers)), ("variance[y]",)),
        (description(noise.Circulant(), kinds=(MeanPeriod, Samples)), ()),
        (description(noise.Circulant(), free=BOTH), ()),
        (description(noise.Circulant(prior="flat")), ("variance[y]",)),
        (description(noise.Circulant(prior=bp.InverseGamma(2.0, 1.0))), ()),
    ],
)
def test_variances_are_integrated_out_where_the_integral_has_a_closed_form(problem, expected):
    assert collapsible(problem) == expected


@pytest.mark.parametrize("prior", ["jeffreys", "flat"])
def test_a_collapsed_density_is_the_integral_over_the_variance(prior):
    data = linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)
    problem = bp.Problem(LINEAR, [data], priors=PRIORS, noise=noise.Independent(prior=prior))
    sampled = problem.density()
    collapsed = sampled.with_settings(variances="collapsed")
    assert (collapsed.collapsed, collapsed.free, collapsed.dimension) == (("variance[force]",), (), 3)
    assert collapsed.with_settings(solver=collapsed.solver).collapsed == collapsed.collapsed
    assert sampled.with_settings(coordinates="natural").collapsed == ()
    for k in (880.0, 905.0):
        theta = np.array([np.log(k), 41.0, 24.0])
        density = lambda log_v, t=theta: float(sampled.evaluate(np.array([[*t, log_v]])).log_prob[0])  # noqa: E731
        peak = max(density(x) for x in np.linspace(0.0, 6.0, 61))
        integral = quad(lambda x, peak=peak, f=density: np.exp(f(x) - peak), -4.0, 12.0, limit=200)[0]
        found = collapsed.evaluate(theta[None])
        assert found.log_prob[0] == pytest.approx(peak + np.log(integral), abs=1e-6)
    # Drawn variances have the conditional distribution, and complete the density.
    columns, log_prob = collapsed.with_variances(
        np.tile(theta, (4000, 1)),
        np.full(4000, found.log_prob[0]),
        np.tile(found.moments, (4000, 1)),
        np.random.default_rng(0),
    )
    points = np.stack(columns, axis=-1)
    assert log_prob[:5] == pytest.approx(sampled.evaluate(points[:5]).log_prob, abs=1e-9)
    shape = 0.5 * problem.likelihood.counts["variance[force]"] - (prior == "flat")
    gamma = 0.5 * found.moments[0, 0] / np.exp(points[:, 3])
    assert stats.kstest(gamma, stats.gamma(shape).cdf).pvalue > 1e-3


GAIN = bp.Model("gain", states=["w"], inputs=["u"], parameters=["a"], equations=["dw + w - u"], outputs={"y": "a*u"})
DRIVE = np.cos(2 * np.pi * np.arange(32) / 32)
SIGNAL = 1.2 * DRIVE + 0.02 * np.sin(2 * np.pi * np.arange(32) / 32) + 0.03 * np.cos(6 * np.pi * np.arange(32) / 32)


def gain(unit):
    run = bp.Experiment("run", 0.3, {"y": unit * SIGNAL}, {"u": DRIVE}, samples=32, harmonics={"y": 3})
    return bp.Problem(GAIN, [run], priors={"a": bp.LogNormal(unit, 2.0)}, scheme="fourier")


@settings(deadline=None)
@given(first=st.floats(-300.0, 300.0), second=st.floats(-300.0, 300.0))
def test_a_collapsed_likelihood_falls_as_a_power_of_the_sum_of_squares_however_large_it_is(first, second):
    """∫ v^(−n/2) exp(−M/2v) dv/v ∝ M^(−n/2), with n = 7 values, for M from 1e-300 to 1e300."""
    density = gain(1.0).density(variances="collapsed")
    sizes = 10.0 ** np.array([[first / 2.0], [second / 2.0]])
    residuals = SimpleNamespace(residuals=lambda *_: Residuals.of([sizes * np.linspace(-1.0, 1.0, 7)]))
    density = LogPosterior(density.problem, density.solver, variances="collapsed", comparisons=residuals)
    found = density.log_likelihood(np.ones((2, 1)), np.ones((2, 1)))[0]
    assert found[0] - found[1] == pytest.approx(-3.5 * (first - second) * np.log(10.0), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("unit", [1e-90, 1e-6, 1.0, 1e3, 1e90])
@pytest.mark.parametrize("a", [1e-30, 0.5, 1e3, 1e10, 1e15, 1e50])
def test_a_collapsed_density_of_a_gain_has_its_closed_form(unit, a):
    problem = gain(unit)
    density = problem.density(variances="collapsed")
    found = density.log_likelihood(unit * np.array([[a], [1.25]]), np.ones((2, 1)))[0]
    moments = np.sum((SIGNAL[:, None] - DRIVE[:, None] * [a, 1.25]) ** 2, axis=0)
    assert found[0] - found[1] == pytest.approx(-3.5 * np.log(moments[0] / moments[1]), rel=1e-9)


def test_collapsed_draws_are_the_same_in_all_units():
    """Newton, kilonewton, and a pressure of 1e-6 m²; the prior reaches to where the residual is 1e6 times the noise."""
    draws = []
    for unit in (1.0, 1e-3, 1e6):
        problem = gain(unit)
        fit = bp.map_estimate(problem, progress=False, starts=1)
        kept = {"ensembles": 2, "walkers": 8, "max_steps": 60, "variances": "collapsed", "start": "prior"}
        draws.append(bp.sample(problem, fit, seed=1, progress=False, **kept).draws("a") / unit)
    for other in draws[1:]:
        assert other == pytest.approx(draws[0], rel=1e-6)


def test_coordinates_are_logarithms_of_positive_parameters_and_free_noise():
    data = linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)
    free = SamplingCoordinates(bp.Problem(LINEAR, [data], priors=PRIORS))
    assert free.labels == ("k", "c", "coulomb", "variance[force]")
    theta, values = free.to_natural(np.array([[np.log(7.0), -3.0, 2.0, np.log(5.0)]]))
    assert theta == pytest.approx(np.array([[7.0, -3.0, 2.0]])) and values == pytest.approx(np.array([[5.0]]))
    assert free.from_natural(theta, values) == pytest.approx(np.array([[np.log(7.0), -3.0, 2.0, np.log(5.0)]]))
    known = bp.Problem(LINEAR, [data], priors=PRIORS, fixed={"variance[force]": 9.0})
    natural = SamplingCoordinates(known, coordinates="natural")
    theta, values = natural.to_natural(np.array([7.0, -3.0, 2.0]))
    assert (theta.tolist(), values.tolist(), natural.dimension) == ([7.0, -3.0, 2.0], [9.0], 3)
    assert natural.from_natural(theta, values).tolist() == [7.0, -3.0, 2.0]


def test_log_prior_and_its_derivatives_are_those_over_the_coordinates():
    data = linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)
    density = bp.Problem(LINEAR, [data], priors=PRIORS).density()
    theta, noise_values = np.array([850.0, 33.0, 18.0]), np.array([[7.0]])

    def log_prior(at):
        logs = stats.norm.logpdf(np.log(at[0]), np.log(800.0), 0.1)
        return logs + stats.norm.logpdf(at[1], 30.0, 20.0) + stats.norm.logpdf(at[2], 20.0, 10.0)

    assert density.log_prior(theta[None], noise_values)[0] == pytest.approx(log_prior(theta))
    steps = np.diag([1e-2, 1e-3, 1e-3])
    slopes = [(log_prior(theta + e) - log_prior(theta - e)) / (2 * e.sum()) for e in steps]
    bends = [(log_prior(theta + e) - 2 * log_prior(theta) + log_prior(theta - e)) / e.sum() ** 2 for e in steps * 100]
    gradient, curvature = density.add_prior(theta, np.array([1.0, 2.0, 3.0]), np.eye(3))
    assert gradient == pytest.approx(np.array([1.0, 2.0, 3.0]) + slopes, rel=1e-6)
    assert np.diag(curvature) == pytest.approx(1.0 - np.array(bends), rel=1e-5)
    assert density.add_prior(theta, np.zeros(3))[1] is None


def test_a_point_outside_the_support_has_no_density_and_is_not_solved():
    data = linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)
    bounded = PRIORS | {"c": bp.Uniform(0.0, 100.0)}
    density = bp.Problem(LINEAR, [data], priors=bounded).density()
    points = np.array([[np.log(900.0), 40.0, 25.0, 2.0], [np.log(900.0), -1.0, 25.0, 2.0]])
    both, one = density.evaluate(points), density.evaluate(points[:1])
    assert both.log_prob.tolist() == [one.log_prob[0], -np.inf]
    assert density.evaluate(points[1:]).log_prob.tolist() == [-np.inf]
    value, gradient, status = density.value_and_gradient(points[1])
    assert (value, gradient.tolist(), status) == (-np.inf, [0.0] * 4, both.status[1])
    value, gradient, _ = density.value_and_gradient(points[0])
    assert value == pytest.approx(one.log_prob[0], rel=1e-9)
    steps = 1e-5 * np.eye(4)
    slopes = [
        (density.evaluate((points[0] + e)[None]).log_prob[0] - density.evaluate((points[0] - e)[None]).log_prob[0])
        / 2e-5
        for e in steps
    ]
    assert gradient == pytest.approx(np.array(slopes), rel=1e-4, abs=1e-4)


def test_points_beside_failed_solves_have_their_own_values():
    """ẋ = a − x² + u has no periodic solution for a < 0; variances differ, and (2π)^(−n/2) is left out."""
    tau = np.arange(64) / 64
    data = bp.Experiment(
        "synthetic", 0.1, {"x": 1.0 + 0.3 * np.cos(2 * np.pi * tau)}, {"u": 0.1 * np.cos(2 * np.pi * tau)}, samples=64
    )
    problem = bp.Problem(SADDLE_NODE, [data], priors={"a": bp.Normal(0.5, 1.0)}, scheme="central4")
    theta, variance = np.array([[1.0], [-0.5], [0.8], [1.2]]), np.array([[0.01], [0.02], [0.03], [0.04]])
    found = problem.log_likelihood(theta, variance)
    assert np.isneginf(found).tolist() == [False, True, False, False]
    for i in (0, 2, 3):
        x = bp.solve_periodic(
            SADDLE_NODE, {"a": theta[i, 0]}, dict(data.inputs), frequency=0.1, samples=64, scheme="central4"
        ).states["x"]
        expected = stats.norm.logpdf(data.outputs["x"] - x, scale=np.sqrt(variance[i, 0])).sum() + 32 * np.log(
            2 * np.pi
        )
        assert found[i] == pytest.approx(expected, rel=1e-8)


def test_densities_start_at_anchors_or_where_orbits_and_parameters_fit_together(monkeypatch):
    """Those of `LogPosterior.start`."""
    made = []

    class Solver:
        def __init__(self, problem, anchors):
            made.append(("anchors", anchors))

        @classmethod
        def start(cls, problem, theta, states=None):
            """Note from where the solves start."""
            made.append((theta, states))

    class Density(LogPosterior):
        def __init__(self, problem, solver):
            pass

    monkeypatch.setattr(log_posterior, "ResponseSolver", Solver)
    answers = iter([SimpleNamespace(theta="fitted", states={"run": 1}), SimpleNamespace(theta="f", states={}), None])
    monkeypatch.setattr(log_posterior, "simultaneous_fit", lambda problem, theta: next(answers))
    problem = SimpleNamespace(anchors={}, median=lambda: "median")
    for expected in (("fitted", {"run": 1}), ("median", None), ("median", None)):
        Density.start(problem)
        assert made.pop() == expected
    problem.anchors = {"run": "orbit"}
    Density.start(problem)
    assert made == [("anchors", {"run": "orbit"})]
