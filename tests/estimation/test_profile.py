import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.special import ndtri

import bayesperiodic as bp
from bayesperiodic.estimation import profile as profiles
from bayesperiodic.estimation.profile import Ridge
from bayesperiodic.problem.fingerprint import fingerprint
from tests.known import LINEAR, formula_model, grid, linear_experiment, linear_regressors

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
WIDE = {name: bp.Uniform(-1e5, 1e5) for name in PRIORS}
WAVE, RATE = np.sin(2 * np.pi * grid(40)), 2 * np.pi * np.cos(2 * np.pi * grid(40))


def posed(model, y, variance, priors, *, wave=WAVE):
    run = bp.Experiment("run", 1.0, {"y": y}, {"x": wave}, samples=40)
    return bp.Problem(model, [run], priors=priors, fixed={"variance[y]": variance})


def fitted(problem, start=None):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return bp.map_estimate(problem, start=start, progress=False)


@pytest.fixture(scope="module")
def linear():
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS, fixed={"variance[force]": 9.0})
    fit = fitted(problem)
    return problem, fit, bp.profile(problem, fit)


def test_known_variance_gives_the_parabola_and_the_normal_interval(linear):
    _, fit, profile = linear
    assert profile.names == ("k", "c", "coulomb")
    for probability in (0.5, 0.9, 0.99):
        half, ends = ndtri(0.5 + probability / 2), profile.interval(probability)
        for name, sd in fit.sd.items():
            z = (profile.values[name] - fit.theta[name]) / sd
            assert profile.log_density[name] == pytest.approx(-0.5 * z**2, abs=1e-8)
            assert (np.array(ends[name]) - fit.theta[name]) / sd == pytest.approx([-half, half], abs=1e-8)
    assert set(profile.shape.values()) == {"closed"}


def test_other_parameters_follow_their_conditional_means(linear):
    _, fit, profile = linear
    slopes = fit.covariance["k"] / fit.covariance.loc["k", "k"]
    expected = np.array(list(fit.theta.values())) + np.outer(profile.values["k"] - fit.theta["k"], slopes)
    assert profile.paths["k"] == pytest.approx(expected, rel=1e-9)


def test_unknown_variance_gives_the_logarithm_of_the_misfit():
    """−½ (n − l) ln M along the profile, with M = M₀ (1 + z²/(n − l)) for a linear model and flat priors."""
    experiment = linear_experiment(TRUTH, 3.0, seed=2, independent=11)
    problem = bp.Problem(LINEAR, [experiment], priors=WIDE)
    fit = fitted(problem)
    profile = bp.profile(problem, fit)
    design = linear_regressors(0.05, 2.0, grid(40))
    best, misfit, *_ = np.linalg.lstsq(design, experiment.outputs["force"], rcond=None)
    sd = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * misfit[0] / (11 - 3))
    for i, name in enumerate(problem.names):
        z = (profile.values[name] - best[i]) / sd[i]
        assert profile.log_density[name] == pytest.approx(-0.5 * 8 * np.log1p(z**2 / 8), abs=1e-8)
        half = np.sqrt(8 * np.expm1(1.959964**2 / 8))
        ends = (np.array(profile.interval(0.95)[name]) - best[i]) / sd[i]
        assert ends == pytest.approx([-half, half], rel=1e-3)


def test_variances_stay_within_the_support_of_their_prior_along_a_profile():
    """−½ (M/v + (n − l) ln v) at the best v within bounds, and with flat priors M = M₀ (1 + z²/(n − l))."""
    experiment = linear_experiment(TRUTH, 3.0, seed=2, independent=11)
    design = linear_regressors(0.05, 2.0, grid(40))
    best, misfit, *_ = np.linalg.lstsq(design, experiment.outputs["force"], rcond=None)
    least, sd = misfit[0] * 11 / 40, np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * misfit[0] / 8)
    bounds = 1.05 * least / 8, 1.4 * least / 8
    problem = bp.Problem(LINEAR, [experiment], priors=WIDE, noise=bp.noise.Independent(prior=bp.LogUniform(*bounds)))
    profile = bp.profile(problem, fitted(problem))
    for i, name in enumerate(problem.names):
        square = least * (1.0 + ((profile.values[name] - best[i]) / sd[i]) ** 2 / 8)
        variance = np.clip(square / 8, *bounds)
        assert {*bounds} < {*variance}
        density = -0.5 * (square / variance + 8 * np.log(variance))
        assert profile.log_density[name] == pytest.approx(density - density.max(), abs=1e-8)


def test_profile_of_a_factor_of_a_determined_product_is_flat():
    """Only a·b is identifiable: the profiles of a and b are flat where their supports allow it."""
    model = formula_model("product", ["a", "b", "c"], lambda p, u, s: {"y": p.a * p.b * u.x + p.c * u.dx})
    priors = {"a": bp.LogUniform(0.1, 10.0), "b": bp.LogUniform(1e-4, 1e4), "c": bp.Normal(0.0, 10.0)}
    problem = posed(model, 2 * WAVE + 0.7 * RATE, 0.01, priors)
    fit = fitted(problem)
    profile = bp.profile(problem, fit)
    assert profile.shape == {"a": "flat", "b": "closed", "c": "closed"}
    assert profile.log_density["a"] == pytest.approx(0.0, abs=1e-9)
    assert profile.values["a"][[0, -1]] == pytest.approx([0.1, 10.0], rel=2e-2)
    assert profile.paths["a"][:, 0] * profile.paths["a"][:, 1] == pytest.approx(
        fit.theta["a"] * fit.theta["b"], rel=1e-9
    )
    assert profile.interval()["a"] == (-np.inf, np.inf)
    sd = 0.1 / np.linalg.norm(WAVE)
    assert profile.interval()["b"] == pytest.approx([0.2 - 0.1 * 1.645 * sd, 20 + 10 * 1.645 * sd], rel=5e-3)
    z = (profile.values["c"] - fit.theta["c"]) * np.hypot(np.linalg.norm(RATE) / 0.1, 1 / 10.0)
    assert profile.log_density["c"] == pytest.approx(-0.5 * z**2, abs=1e-8)


def test_a_saturating_parameter_is_bounded_on_one_side():
    """Y = a/(1 + a)·x measured as 0.98 ± 0.02: a ≥ 17.9 without an upper bound."""
    sd = 0.02
    model = formula_model("saturating", ["a"], lambda p, u, s: {"y": p.a / (1 + p.a) * u.x})
    problem = posed(model, 0.98 * WAVE, sd**2 * WAVE @ WAVE, {"a": bp.Uniform(0.0, 1e6)})
    profile = bp.profile(problem, fitted(problem, {"a": 40.0}))
    z = (profile.values["a"] / (1 + profile.values["a"]) - 0.98) / sd
    assert profile.log_density["a"] == pytest.approx(-0.5 * z**2, abs=1e-9)
    assert profile.shape == {"a": "one-sided"}
    gain = 0.98 - 1.644854 * sd
    assert profile.interval()["a"] == (pytest.approx(gain / (1 - gain), rel=3e-3), np.inf)


def test_skewed_profile_agrees_with_brute_force_maximisation():
    force = np.cos(2 * np.pi * grid(50))
    true = bp.solve_periodic(
        bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force}, frequency=0.1, samples=50
    )
    problem = bp.Problem(
        bp.models.duffing,
        [bp.Experiment("run", 0.1, true.outputs, {"force": force}, samples=50)],
        priors={"k": bp.LogNormal(1.0, 1.0), "k3": bp.Normal(0.5, 1.0)},
        fixed={"m": 1, "c": 0.2, "variance[displacement]": 1.0},
    )
    fit = fitted(problem)
    profile = bp.profile(problem, fit)
    for name, other, around in (("k", "k3", 0.0), ("k3", "k", 1.0)):
        best, width = np.full(profile.values[name].size, around), 2.5
        for _ in range(3):
            tried = best[:, None] + np.linspace(-width, width, 101)
            found = problem.log_posterior({name: profile.values[name][:, None], other: tried}, {})
            best, width = np.take_along_axis(tried, found.argmax(axis=1)[:, None], axis=1)[:, 0], 0.03 * width
        expected = found.max(axis=1) - float(problem.log_posterior(fit.theta, {}))
        # Between the prior medians and the outermost k3 the branch of orbits has a fold.
        reached = slice(1 if name == "k3" else 0, None)
        assert profile.log_density[name][reached] == pytest.approx(expected[reached], abs=1e-6)
        assert np.all(profile.log_density[name] > expected - 1e-6)
    low, high = profile.interval()["k"]
    assert abs((high - fit.theta["k"]) / (fit.theta["k"] - low) - 1) > 0.1


def over_all_b(problem, values, low, high):
    """Return the largest log-posterior at each value of a: the best of 1001 values of b, and of 201 around that one."""
    coarse = np.broadcast_to(np.linspace(low, high, 1001), (values.size, 1001))
    best = coarse[0, problem.log_posterior({"a": values[:, None], "b": coarse}, {}).argmax(axis=1)]
    near = best[:, None] + (high - low) / 1000 * np.linspace(-1.0, 1.0, 201)
    return problem.log_posterior({"a": values[:, None], "b": near}, {}).max(axis=1)


def double_well(mean):
    """Return a problem where b jumps from near 4 to near 2 as a grows, later on the way up than on the way down."""
    model = formula_model(
        "wells", ["a", "b"], lambda p, u, s: {"y": (p.b - 3) ** 2 * u.x + (p.a + p.b - 3) * u.dx / (2 * np.pi)}
    )
    wave = WAVE * np.sqrt(2 / 40)
    priors = {"a": bp.Normal(mean, 2.0), "b": bp.Normal(3.0, 5.0)}
    return posed(model, wave, 0.3, priors, wave=wave)


def test_return_sweep_finds_the_branch_that_the_first_sweep_misses(monkeypatch):
    problem = double_well(-0.5)
    fit = fitted(problem, {"a": -1.0, "b": 4.0})
    both = bp.profile(problem, fit, ["a"])
    monkeypatch.setattr(Ridge, "_swept", lambda self, points: points)
    out = bp.profile(problem, fit, ["a"])
    assert np.array_equal(both.values["a"], out.values["a"])
    gain = both.log_density["a"] - out.log_density["a"]
    assert gain.min() > -1e-9
    assert gain.max() > 1.0
    every = over_all_b(problem, both.values["a"], 0.0, 6.0)
    assert both.log_density["a"] == pytest.approx(every - problem.log_posterior(fit.theta, {}), abs=1e-6)


def test_profile_is_extended_where_another_branch_raises_its_end():
    """The first sweep stays in a narrow well of b; at its end it jumps into a wide one that passes the peak."""
    model = formula_model(
        "unlike_wells",
        ["a", "b"],
        lambda p, u, s: {"y": ((p.b - 3) ** 2 + 0.6 * p.a) * u.x + p.a * (1.5 * p.b - 2.5) * u.dx / (2 * np.pi)},
    )
    wave, priors = WAVE * np.sqrt(2 / 40), {"a": bp.Normal(0.0, 5.0), "b": bp.Normal(2.0, 2.0)}
    problem = posed(model, wave, 0.3, priors, wave=wave)
    fit = fitted(problem, {"a": 0.0, "b": 4.0})
    with pytest.warns(UserWarning, match="The log-density is higher by 0.49") as caught:
        profile = bp.profile(problem, fit, ["a"])
    assert caught[0].filename == __file__
    assert profile.values["a"][0] < -3.0 < -0.5 < fit.theta["a"] - 3 * fit.sd["a"]
    every = over_all_b(problem, profile.values["a"], -1.0, 7.0)
    assert profile.log_density["a"] == pytest.approx(every - problem.log_posterior(profile.best, {}), abs=1e-5)
    assert profile.shape == {"a": "closed"}


def test_the_way_back_climbs_only_where_it_does_not_meet_the_known_point(linear, monkeypatch):
    problem, fit, found = linear
    climbs, climb = [], profiles.climb
    monkeypatch.setattr(profiles, "climb", lambda *arguments: (climbs.append(arguments), climb(*arguments))[1])
    assert np.array_equal(bp.profile(problem, fit).log_density["k"], found.log_density["k"])
    assert len(climbs) == sum(values.size - 1 for values in found.values.values())


def test_a_known_point_is_met_by_the_same_parameters_and_residuals_that_are_not_better(linear):
    objective, peak = profiles.at_estimate(*linear[:2])
    ridge, sd = Ridge(objective, 0, peak), np.array(list(linear[1].sd.values()))
    near, far = (objective.at(peak.theta + np.array([0, s, 0]) * sd, peak.here, peak.noise) for s in (0.01, 2.0))
    assert ridge._meets(near, peak) and not ridge._meets(peak, near)
    assert not ridge._meets(far, peak)
    assert not ridge._meets(replace(near, here=far.here), peak)
    prior = objective.density.problem.joint_prior.widths
    assert not ridge._meets(replace(near, theta=peak.theta + np.array([0, 0.2, 0]) * prior), peak)


def test_point_better_than_the_estimate_is_reported_and_can_be_the_start():
    problem = double_well(0.5)
    fit = fitted(problem, {"a": -1.0, "b": 4.0})
    with pytest.warns(UserWarning, match=r"higher by 0.17 than .* b = 1.9.*start there, map_estimate\(problem, start="):
        profile = bp.profile(problem, fit, ["a"])
    assert profile.improvement == pytest.approx(0.1699, abs=1e-3)
    at_map = profile.log_density["a"][profile.values["a"] == fit.theta["a"]]
    assert at_map == pytest.approx(-profile.improvement)
    assert "higher by 0.17 at a = 1.15" in repr(profile)
    again = bp.profile(problem, fitted(problem, profile.best), ["a"])
    assert again.map["b"] < 3.0
    assert again.improvement == 0.0


@pytest.mark.filterwarnings("ignore:The log-density is higher")
@pytest.mark.parametrize("support", [(1.99, 2.01), (2.01, 2.05), (1.8, 1.99)])
def test_profile_with_a_parameter_at_its_bound_equals_bounded_least_squares(support):
    """Against bounded least squares: b reaches the bounds of its support as a varies."""
    model = formula_model(
        "bounded", ["a", "b", "c"], lambda p, u, s: {"y": p.a * u.x + p.b * (u.x + u.dx + u.x**2) + p.c * u.dx}
    )
    design = np.stack([WAVE, WAVE + RATE + WAVE**2, RATE], axis=-1) / 0.1
    y = design @ [1.0, 2.0, 0.5] + np.random.default_rng(3).standard_normal(40)
    priors = {"a": bp.Uniform(-10.0, 10.0), "b": bp.Uniform(*support), "c": bp.Uniform(-10.0, 10.0)}
    problem = posed(model, 0.1 * y, 0.01, priors)
    profile = bp.profile(problem, fitted(problem), ["a"])
    bounds = [support[0], -10.0], [support[1], 10.0]
    costs = [
        lsq_linear(design[:, 1:], y - design[:, 0] * a, bounds=bounds, tol=1e-13).cost for a in profile.values["a"]
    ]
    pressed = np.min(np.abs(profile.paths["a"][:, [1]] - support), axis=1) < 1e-6
    assert pressed.sum() > 5
    assert profile.log_density["a"] == pytest.approx(np.min(costs) - np.array(costs), abs=1e-5)


def test_interval_end_is_nan_where_solves_fail():
    """An equilibrium √a exists for a > 0 only, and the weak data allow a close to zero."""
    model = bp.Model(
        "saddle_node",
        states=["w"],
        inputs=["x"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dw + s.w**2 - p.a - u.x],
        outputs=lambda s, p, u: {"y": s.w},
    )
    wave = 0.1 * WAVE
    true = bp.solve_periodic(model, {"a": 1.0}, {"x": wave}, frequency=1.0, samples=40)
    problem = posed(model, true.outputs["y"], 50.0, {"a": bp.Normal(1.0, 1.0)}, wave=wave)
    profile = bp.profile(problem, fitted(problem, {"a": 1.0}))
    assert profile.failed["a"] == np.isnan(profile.log_density["a"]).sum() > 0
    assert np.isnan(profile.paths["a"][np.isnan(profile.log_density["a"])]).all()
    assert profile.values["a"][np.isfinite(profile.log_density["a"])].min() < 0.2
    low, high = profile.interval()["a"]
    assert np.isnan(low)
    assert np.isfinite(high)
    assert profile.shape == {"a": "one-sided"}


def test_the_profile_stays_on_the_branch_of_the_estimate():
    """Below its jump a hardening oscillator has two responses; the profile follows that of the estimate."""
    force, parameters = 0.6 * np.cos(2 * np.pi * grid(50)), {"m": 1.0, "c": 0.1, "k": 1.0, "k3": 0.5}
    start = bp.solve_periodic(bp.models.duffing, parameters, {"force": force}, frequency=0.1, samples=50)
    branch = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.3, step=0.01, progress=False)
    large = next(s for s in branch if abs(s.frequency - 0.3) < 0.005)
    runs = [
        bp.Experiment("run", large.frequency, large.outputs, {"force": force}, samples=50, guess=guess)
        for guess in (large.states, {})
    ]
    guided, plain = (
        bp.Problem(
            bp.models.duffing,
            [run],
            priors={"k3": bp.Uniform(0.4, 0.6)},
            fixed={"m": 1, "c": 0.1, "k": 1, "variance[displacement]": 0.01},
        )
        for run in runs
    )
    fit = fitted(guided)
    assert float(plain.log_posterior(fit.theta, {})) < float(guided.log_posterior(fit.theta, {})) - 100
    expected, found = (bp.profile(p, replace(fit, fingerprint=fingerprint(p))) for p in (guided, plain))
    assert found.improvement < 1e-6
    assert found.log_density["k3"] == pytest.approx(expected.log_density["k3"], abs=1e-6)


def test_local_parameters_have_their_units():
    runs = [linear_experiment(TRUTH, 3.0, seed=s, name=f"run {s}") for s in (4, 5)]
    problem = bp.Problem(LINEAR, runs, priors=PRIORS, local=["coulomb"], fixed={"variance[force]": 9.0})
    profile = bp.profile(problem, fitted(problem), ["coulomb[run 5]"])
    assert profile.names == ("coulomb[run 5]",)
    assert profile.units["coulomb[run 5]"] == "N"
    assert profile.paths["coulomb[run 5]"].shape == (13, 4)


def test_saved_profile_reads_back_and_prints_the_same(linear, tmp_path):
    _, _, profile = linear
    profile.save(tmp_path / "profile.h5")
    loaded = bp.load(tmp_path / "profile.h5")
    assert isinstance(loaded, bp.Profile)
    assert repr(loaded) == repr(profile)
    assert loaded.interval(0.95) == profile.interval(0.95)
    assert np.array_equal(loaded.paths["c"], profile.paths["c"])


def test_the_table_holds_both_intervals(linear):
    _, fit, profile = linear
    row = profile.table.loc["k"]
    assert row["laplace_low"] == pytest.approx(fit.theta["k"] - 1.644854 * fit.sd["k"])
    assert row["low"] == pytest.approx(row["laplace_low"])
    assert (row["shape"], row["points"], row["failed"]) == ("closed", 13, 0)
    assert "laplace_low" in repr(profile)


def test_error_names_what_cannot_be_profiled(linear):
    problem, fit, profile = linear
    with pytest.raises(ValueError, match="names: must be .*got 'kk'.*Did you mean 'k'"):
        bp.profile(problem, fit, ["kk"])
    for names in ("k", []):
        with pytest.raises(ValueError, match="names: must be a sequence of names .*, got"):
            bp.profile(problem, fit, names)
    with pytest.raises(ValueError, match=r"probability: must be above 0 and at most 0.99, got 0.999"):
        profile.interval(0.999)
    run = linear_experiment(TRUTH, 3.0, seed=1)
    other = bp.Problem(LINEAR, [run], priors=PRIORS | {"c": bp.Uniform(0.0, 1.0)}, fixed={"variance[force]": 9.0})
    with pytest.raises(ValueError, match=r"fit: must be a result of this problem, got .* other priors; give"):
        bp.profile(other, fit)
    fewer = bp.Problem(LINEAR, [run], priors={"k": PRIORS["k"]}, fixed={"c": 40.0, "coulomb": 25.0})
    with pytest.raises(ValueError, match="fit: must be a result of this problem, got .* other .*priors, constants"):
        bp.profile(fewer, fit)
