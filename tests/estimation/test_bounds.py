"""Intervals and standard deviations of parameters at or near the end of their prior's support."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

import bayesperiodic as bp
from bayesperiodic.estimation.intervals import shortest_interval
from tests.known import LINEAR, linear_experiment

TRUTH = [900.0, 40.0, 25.0]
WIDE = {"k": bp.Normal(900.0, 1e5), "c": bp.Normal(40.0, 1e4)}


@pytest.mark.parametrize("freedom", [3.0, 20.0, 1e9])
@pytest.mark.parametrize(
    "ends", [(-np.inf, np.inf), (-0.5, np.inf), (-4.0, 0.3), (0.0, np.inf), (-1.0, 1.5), (-9.0, 0.0)]
)
def test_an_interval_is_the_shortest_of_students_t_restricted_to_the_support(freedom, ends):
    """Against a search for the lower end."""
    t, (low, high) = stats.t(freedom), ends
    mass = 0.9 * (t.cdf(high) - t.cdf(low))
    upper = lambda p: t.ppf(p + mass)  # noqa: E731
    length = lambda p: upper(p) - t.ppf(p)  # noqa: E731
    first, last = t.cdf(low) + 1e-12, t.cdf(high) - mass - 1e-12
    best = minimize_scalar(length, bounds=(first, last), method="bounded", options={"xatol": 1e-10}).x
    best = min((first, best, last), key=length)
    found = shortest_interval(freedom, 0.9, low, high)
    assert found == pytest.approx((t.ppf(best), upper(best)), abs=2e-4)
    assert t.cdf(found[1]) - t.cdf(found[0]) == pytest.approx(mass) and low <= found[0] < found[1] <= high


@pytest.mark.parametrize("prior", [bp.HalfNormal(50.0), bp.Uniform(0.0, 200.0), bp.LogNormal(5.0, 2.0)])
def test_the_interval_of_a_parameter_near_zero_ends_at_its_support(prior):
    run = linear_experiment([900.0, 40.0, 1.0], 60.0, seed=6)
    fit = bp.map_estimate(bp.Problem(LINEAR, [run], priors=WIDE | {"coulomb": prior}), starts=1, progress=False)
    for robust in (False, True):
        low, high = fit.interval(0.9, robust=robust)["coulomb"]
        assert low == 0.0 < fit.theta["coulomb"] < high
        k = fit.interval(0.9, robust=robust)["k"]
        assert (k[0] + k[1]) / 2 == pytest.approx(fit.theta["k"], rel=1e-9)
    far = fit.interval(0.2)["coulomb"]
    assert far[0] >= 0.0 and fit.supports["coulomb"] == prior.support


@pytest.mark.parametrize("low", [26.0, 30.0, 60.0])
def test_robust_sd_at_an_end_of_the_support_is_finite(low):
    """Beyond it lies the optimum, so that the residual is not that of a free fit; the others keep their sd too."""
    run = linear_experiment(TRUTH, 3.0, seed=1)
    priors = WIDE | {"coulomb": bp.Uniform(low, 500.0)}
    with pytest.warns(UserWarning, match=r"'coulomb'.*lies at the end"):
        fit = bp.map_estimate(bp.Problem(LINEAR, [run], priors=priors), starts=1, progress=False)
    assert fit.at_ends == ("coulomb",)
    for name, sd in fit.sd.items():
        assert 0.3 * sd < fit.robust_sd[name] < 4.0 * sd
    assert fit.interval(robust=True)["coulomb"][0] == low


def test_robust_sd_is_finite_if_ends_hold_all_parameters():
    run = linear_experiment(TRUTH, 3.0, seed=1)
    problem = bp.Problem(LINEAR, [run], priors={"coulomb": bp.Uniform(30.0, 500.0)}, fixed={"k": 900.0, "c": 40.0})
    with pytest.warns(UserWarning, match=r"'coulomb'.*lies at the end"):
        fit = bp.map_estimate(problem, starts=1, progress=False)
    assert 0.0 < fit.robust_sd["coulomb"] < 10.0 * fit.sd["coulomb"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The estimate of 'coulomb'")
def test_intervals_near_the_end_of_a_support_have_nominal_coverage():
    """Truths from a HalfNormal prior as wide as the likelihood, 300 data sets, 99 % binomial band.

    The limit above is that of 95 %: where the estimate is at the end, Student's t is centred there and not beyond it.
    """
    generator, held, one_sided = np.random.default_rng(7), 0, 0
    for seed in range(300):
        truth = abs(generator.normal(0.0, 8.0))
        run = linear_experiment([900.0, 40.0, truth], 30.0, seed=seed)
        problem = bp.Problem(LINEAR, [run], priors=WIDE | {"coulomb": bp.HalfNormal(8.0)})
        low, high = bp.map_estimate(problem, starts=1, checks=False, progress=False).interval(0.9)["coulomb"]
        held += low <= truth <= high
        one_sided += low == 0.0
    assert one_sided > 100
    assert stats.binom.ppf(0.005, 300, 0.9) <= held <= stats.binom.ppf(0.995, 300, 0.95)


IDLE = bp.Model(
    "contact",
    states=["w"],
    inputs=["u"],
    parameters=["a", "s"],
    equations=["dw + w - u"],
    outputs={"y": "a*u + w*s/(1 + s)"},
)


@pytest.mark.parametrize(("median", "spread", "named"), [(5000.0, 2.0, True), (1.0, 0.2, False)])
def test_an_estimate_that_depends_on_the_coordinate_is_printed_as_such(median, spread, named):
    """The data say only that s is large; the maximum over s is near the mode of its prior, median·exp(−spread²)."""
    tau = np.arange(64) / 64
    u, w = np.cos(2 * np.pi * tau), np.real(np.exp(2j * np.pi * tau) / (1 + 0.6j * np.pi))
    noise = 0.03 * np.random.default_rng(0).standard_normal(64)
    share = 1.0 if named else 0.5
    run = bp.Experiment("run", 0.3, {"y": 1.2 * u + share * w + noise}, {"u": u}, samples=64, harmonics={"y": 5})
    priors = {"a": bp.Normal(1.0, 10.0), "s": bp.LogNormal(median, spread)}
    fit = bp.map_estimate(bp.Problem(IDLE, [run], priors=priors, scheme="fourier"), starts=8, progress=False)
    assert ("Not determined to a single value: s. The density" in str(fit)) == named
    assert list(fit.over_logarithm) == ["s"] * named and len(fit.modes) == 1
    if named:
        assert fit.theta["s"] < 200.0 and fit.over_logarithm["s"] == pytest.approx(median, rel=0.1)


@pytest.mark.parametrize(("median", "spread"), [(5000.0, 2.0), (3.0, 1.0)])
def test_the_interval_of_a_parameter_without_influence_is_that_of_its_prior(median, spread):
    """90 % of LogNormal(median, s) are between median·exp(±1.645 s); about the mode of the density it would be less."""
    tau = np.arange(64) / 64
    u = np.cos(2 * np.pi * tau)
    y = 1.2 * u + 0.03 * np.random.default_rng(0).standard_normal(64)
    run = bp.Experiment("run", 0.3, {"y": y}, {"u": u}, samples=64, harmonics={"y": 5})
    model = bp.Model(
        "idle", states=["w"], inputs=["u"], parameters=["a", "s"], equations=["dw + w - u"],
        outputs={"y": "a*u + 1e-12*s*w"},
    )  # fmt: skip
    priors = {"a": bp.Normal(1.0, 10.0), "s": bp.LogNormal(median, spread)}
    fit = bp.map_estimate(bp.Problem(model, [run], priors=priors, scheme="fourier"), progress=False)
    for robust in (False, True):
        ends = fit.interval(0.9, robust=robust)["s"]
        assert ends == pytest.approx(priors["s"].quantile(np.array([0.05, 0.95])), rel=0.02)
