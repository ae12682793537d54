"""Diagnostics of an estimate: joint Laplace, discretisation, undetermined directions, starts, orbit identity."""

import pickle
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.estimation.laplace import undetermined
from bayesperiodic.sampling.starts import laplace_approximation
from tests.known import LINEAR, formula_model, grid, linear_experiment, linear_regressors
from tests.problems import DUFFING, DUFFING_PRIORS, duffing_run

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
PRODUCT = formula_model(
    "product",
    ["a", "b", "shift_a", "shift_b", "idle"],
    lambda p, u, s: {"force": p.a * p.b**2 * u.x + (p.shift_a + 2 * p.shift_b) * u.dx},
)
WELLS = formula_model("wells", ["a"], lambda p, u, s: {"force": (p.a - 3) ** 2 * u.x + 0.05 * (p.a - 3) * u.dx})


def sine_run(force) -> bp.Experiment:
    """Return an experiment of x = sin 2πτ at 1 Hz with 1 % noise; `force` takes x and its rate."""
    tau = grid(60)
    clean = force(np.sin(2 * np.pi * tau), 2 * np.pi * np.cos(2 * np.pi * tau))
    noise = 0.01 * np.ptp(clean) * np.random.default_rng(1).standard_normal(60)
    return bp.Experiment("run", 1.0, {"force": clean + noise}, {"x": np.sin(2 * np.pi * tau)}, samples=60)


def second_differences(density: LogPosterior, mode: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the Hessian of the sampled density by central differences of fourth order."""
    weights = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    hessian = np.empty((mode.size, mode.size))
    for i in range(mode.size):
        for j in range(mode.size):
            points, factors = [], []
            for a, wa in weights.items():
                for b, wb in weights.items():
                    point = mode.copy()
                    point[i] += a * steps[i]
                    point[j] += b * steps[j]
                    points.append(point)
                    factors.append(wa * wb)
            hessian[i, j] = np.dot(factors, density.evaluate(np.array(points)).log_prob) / steps[i] / steps[j]
    return hessian


@pytest.mark.filterwarnings("ignore:Twice as many points")
@pytest.mark.parametrize(
    ("noise", "known"), [("independent", {}), ("circulant", {}), ("independent", {"variance[displacement]": 3.0})]
)
def test_joint_laplace_equals_mode_and_hessian_of_the_sampled_density(noise, known):
    """Its mode is where the density of the sampling coordinates is stationary, its covariance the inverse Hessian."""
    runs = [duffing_run(harmonics={"displacement": 9}), duffing_run("run 2", 0.13, 2, harmonics={"displacement": 9})]
    problem = bp.Problem(
        bp.models.duffing, runs, priors=DUFFING_PRIORS, fixed={"m": 1.0} | known, local=["c"], noise=noise
    )
    fit = bp.map_estimate(problem, progress=False)
    density = problem.anchored(fit.theta).density()
    mode, covariance = laplace_approximation(density, fit)
    sd = np.sqrt(np.diag(covariance))
    ends = mode + np.concatenate([np.diag(step * sd) for step in (0.02, -0.02, 0.04, -0.04)])
    values = density.evaluate(ends).log_prob.reshape(4, -1)
    slopes = (8.0 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * 0.02)
    assert slopes == pytest.approx(0.0, abs=2e-4)
    hessian = -second_differences(density, mode, 0.05 * sd)
    scaled = np.linalg.inv(covariance) * np.outer(sd, sd)
    assert scaled == pytest.approx(hessian * np.outer(sd, sd), abs=3e-4 * np.abs(scaled).max())


@pytest.mark.filterwarnings("ignore:Twice as many points")
def test_doubling_shift_predicts_the_change_on_twice_as_many_points():
    """The announced shift against the estimate on the finer grid, the data being the same Fourier series."""
    fits = []
    for samples in (60, 120):
        force = np.cos(2 * np.pi * grid(samples))
        noise = np.random.default_rng(2).standard_normal(5) * 0.001
        truth = bp.solve_periodic(
            bp.models.duffing, DUFFING, {"force": force}, frequency=0.1, samples=samples, scheme="fourier"
        )
        spectrum = np.fft.rfft(truth.outputs["displacement"])[:10] / samples
        spectrum[:5] += noise
        kept = {"harmonics": {"displacement": 9}, "independent": {"displacement": 19}}
        full = np.zeros(samples // 2 + 1, dtype=complex)
        full[:10] = spectrum * samples
        run = bp.Experiment(
            "run", 0.1, {"displacement": np.fft.irfft(full, samples)}, {"force": force}, samples=samples, **kept
        )
        problem = bp.Problem(bp.models.duffing, [run], priors=DUFFING_PRIORS, fixed={"m": 1.0})
        fits.append(bp.map_estimate(problem, progress=False))
    moved = [(fits[1].theta[n] - fits[0].theta[n]) / fits[0].sd[n] for n in fits[0].theta]
    assert max(abs(m) for m in moved) > 0.2
    assert list(fits[0].doubling_shift.values()) == pytest.approx(moved, rel=0.1, abs=2e-2)


@pytest.mark.slow
def test_grid_too_coarse_for_the_posterior_gives_a_warning():
    run = duffing_run(harmonics={"displacement": 9})
    quiet = replace(run, outputs={"displacement": run.outputs["displacement"]})
    problem = bp.Problem(
        bp.models.duffing,
        [quiet],
        priors=DUFFING_PRIORS,
        fixed={"m": 1.0, "variance[displacement]": 1e-8},
        scheme="backward2",
    )
    with pytest.warns(UserWarning, match=r"Twice as many points would move '.*' by .* take more samples than 200"):
        fit = bp.map_estimate(problem, progress=False)
    assert max(abs(shift) for shift in fit.doubling_shift.values()) > 0.1


def test_directions_without_information_are_named():
    """Only a·b² and shift_a + 2·shift_b are identifiable, and one parameter has no effect; the rest is the prior's."""
    run = sine_run(lambda x, rate: 12.0 * x + 0.5 * rate)
    priors = {
        "a": bp.LogNormal(3.0, 0.3),
        "b": bp.LogNormal(2.0, 0.3),
        "shift_a": bp.Normal(0.1, 0.2),
        "shift_b": bp.Normal(0.2, 0.2),
        "idle": bp.Normal(5.0, 2.0),
    }
    with pytest.warns(UserWarning, match="The data do not depend on 'idle'; .* Fix it"):
        fit = bp.map_estimate(bp.Problem(PRODUCT, [run], priors=priors), progress=False)
    assert fit.converged
    assert set(fit.undetermined) == {
        "idle: no output depends on it",
        "a -> a·t, b -> b·t^-0.5",
        "shift_a -> shift_a + t, shift_b -> shift_b - 0.5·t",
    }
    assert fit.theta["idle"] == pytest.approx(5.0) and fit.sd["idle"] == pytest.approx(2.0)
    assert "Not determined by the data: idle" in repr(fit)
    assert fit.correlations.loc["shift_a", "shift_b"] == pytest.approx(-1.0, abs=0.05)


def test_fit_ends_on_a_ridge_with_uniform_priors():
    """Uniform priors leave H singular; the estimate is on the ridge, and the ridge is named."""
    run = sine_run(lambda x, rate: 12.0 * x)
    priors = {"a": bp.Uniform(0.0, 50.0), "b": bp.Uniform(0.0, 50.0)}
    fixed = {"shift_a": 0.0, "shift_b": 0.0, "idle": 0.0}
    with pytest.warns(UserWarning, match="The data do not change under"):
        fit = bp.map_estimate(bp.Problem(PRODUCT, [run], priors=priors, fixed=fixed), progress=False)
    assert fit.theta["a"] * fit.theta["b"] ** 2 == pytest.approx(12.0, rel=0.02)
    assert len(fit.undetermined) == 1


def test_several_undetermined_directions_are_named_separately():
    """Of a sum of four only the sum is known: three directions, each named by one parameter and the last."""
    row = np.ones(4)

    def found(total):
        def change(theta):
            return abs(total(theta) - total(np.ones(4)))

        return undetermined(np.outer(row, row), np.ones(4), list("abcd"), np.ones(4, dtype=bool), change)

    assert found(lambda x: np.log(x).sum()) == (
        "a -> a·t, d -> d·t^-1",
        "b -> b·t, d -> d·t^-1",
        "c -> c·t, d -> d·t^-1",
    )
    assert found(np.sum) == ("a -> a + t, d -> d - t", "b -> b + t, d -> d - t", "c -> c + t, d -> d - t")
    assert found(lambda x: np.sum(x**3) / 3) == tuple(f"a combination of {x} and d" for x in "abc")


def test_a_scale_that_all_parameters_share_is_named_completely():
    """Signed and positive parameters of very different size scale together; a part of them alone changes the data."""
    priors = {
        "m": bp.LogNormal(1.2, 0.1), "c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1.0, 0.5),
        "k3": bp.Normal(900.0, 500.0),
    }  # fmt: skip
    scale = 1e-2
    model = bp.Model(
        "scaled",
        states=["x"],
        inputs=["force"],
        parameters=["m", "c", "k", "k3", "h"],
        equations=["m*ddx + c*dx + k*x + k3*x**3 - h*force"],
        outputs={"y": "x"},
    )
    tau, truth = grid(64), {"m": 1.2, "c": 0.2, "k": 1.0, "k3": 900.0, "h": 0.1}
    force = {"force": scale * np.cos(2 * np.pi * tau)}
    response = bp.solve_periodic(model, truth, force, frequency=0.1, samples=64).outputs["y"]
    noise = 0.01 * np.std(response) * np.random.default_rng(1).normal(size=64)
    run = bp.Experiment("run", 0.1, {"y": response + noise}, force, samples=64, harmonics={"y": 9})
    problem = bp.Problem(model, [run], priors=priors | {"h": bp.Normal(0.1, 0.05)})
    with pytest.warns(UserWarning, match="The data do not change under .*k3, h: LogNormal priors, if the signs are kn"):
        fit = bp.map_estimate(problem, progress=False)
    assert fit.undetermined == ("m -> m·t, c -> c·t, k -> k·t, k3 -> k3·t, h -> h·t",)


def test_a_difference_seen_at_one_frequency_is_named_as_such():
    """At one frequency only k − m·ω² and c·ω act on a linear oscillator; a power law would be false."""
    tau, omega = grid(64), 2 * np.pi * 0.2
    parameters = {"m": 1.0, "c": 0.3, "k": 2.0, "k3": 0.0}
    force = {"force": np.cos(2 * np.pi * tau)}
    response = bp.solve_periodic(
        bp.models.duffing, parameters, force, frequency=0.2, samples=64, scheme="fourier"
    ).outputs["displacement"]
    noise = 0.01 * np.random.default_rng(2).normal(size=64)
    run = bp.Experiment(
        "run", 0.2, {"displacement": response + noise}, force, samples=64, harmonics={"displacement": 3}
    )
    priors = {name: bp.LogNormal(parameters[name], 0.3) for name in "mck"}
    problem = bp.Problem(bp.models.duffing, [run], priors=priors, fixed={"k3": 0.0}, scheme="fourier")
    with pytest.warns(UserWarning, match="The data do not change under"):
        (text,) = bp.map_estimate(problem, progress=False).undetermined
    coefficient = float(re.fullmatch(r"m -> m \+ t, k -> k \+ ([0-9.]+)·t", text)[1])
    assert coefficient == pytest.approx(omega**2, rel=1e-4)


@pytest.mark.filterwarnings("ignore:Twice as many points")
def test_residuals_contain_only_kept_harmonics():
    run = duffing_run(harmonics={"displacement": 3})
    problem = bp.Problem(bp.models.duffing, [run], priors=DUFFING_PRIORS, fixed={"m": 1.0})
    residual = bp.map_estimate(problem, progress=False).residuals["run 1"]["displacement"]
    spectrum = np.abs(np.fft.rfft(residual))
    assert spectrum[4:].max() < 1e-12 < spectrum[:4].max()


def test_determined_parameter_keeps_its_sd_beside_undetermined_ones():
    """With uniform priors only a·b² is identifiable; shift_a has the sd that it would have alone."""
    run = sine_run(lambda x, rate: 12.0 * x + 0.5 * rate)
    priors = {"a": bp.Uniform(0.0, 50.0), "b": bp.Uniform(0.0, 50.0), "shift_a": bp.Uniform(-5.0, 5.0)}
    fixed = {"shift_b": 0.0, "idle": 0.0, "variance[force]": 0.25}
    with pytest.warns(UserWarning, match="The data do not change under"):
        fit = bp.map_estimate(bp.Problem(PRODUCT, [run], priors=priors, fixed=fixed), progress=False)
    rate = 2 * np.pi * np.cos(2 * np.pi * grid(60))
    assert fit.sd["shift_a"] == pytest.approx(np.sqrt(0.25 / np.sum(rate**2)), rel=1e-6)
    assert fit.sd["a"] == fit.sd["b"] == fit.robust_sd["a"] == fit.robust_sd["b"] == np.inf
    assert 0.0 < fit.robust_sd["shift_a"] < fit.sd["shift_a"]  # the noise is smaller than the fixed variance


def test_estimate_at_a_bound_is_the_bounded_least_squares_solution():
    """Bounded least squares in closed form, with the active bound as a fixed value."""
    run = linear_experiment(TRUTH, 3.0, seed=1)
    wide = {"k": bp.Normal(800.0, 1e6), "c": bp.Normal(30.0, 1e6), "coulomb": bp.Uniform(0.0, 20.0)}
    with pytest.warns(UserWarning, match=r"'coulomb', 20, lies at the end of its prior's support \(0, 20\)"):
        fit = bp.map_estimate(
            bp.Problem(LINEAR, [run], priors=wide, fixed={"variance[force]": 9.0}),
            start={"k": 100.0, "c": 400.0, "coulomb": 1.0},
            progress=False,
        )
    x = linear_regressors(0.05, 2.0, grid(40))
    best = np.linalg.lstsq(x[:, :2], run.outputs["force"] - 20.0 * x[:, 2], rcond=None)[0]
    assert fit.converged and fit.at_ends == ("coulomb",)
    assert [fit.theta["k"], fit.theta["c"]] == pytest.approx(best, rel=1e-4)
    assert fit.theta["coulomb"] == pytest.approx(20.0, abs=0.01)


def test_directions_without_information_do_not_stop_the_iteration():
    """Collinear columns: from a distant start the sum is found to 1e-5 of its standard deviation."""
    run = sine_run(lambda x, rate: 12.0 * x + 0.5 * rate)
    priors = {"shift_a": bp.Normal(400.0, 1e9), "shift_b": bp.Normal(900.0, 1e9)}
    fixed = {"a": 12.0, "b": 1.0, "idle": 0.0, "variance[force]": 0.25}
    with pytest.warns(UserWarning, match="The data do not change under"):
        fit = bp.map_estimate(bp.Problem(PRODUCT, [run], priors=priors, fixed=fixed), progress=False)
    x, rate = np.sin(2 * np.pi * grid(60)), 2 * np.pi * np.cos(2 * np.pi * grid(60))
    best = rate @ (run.outputs["force"] - 12.0 * x) / (rate @ rate)
    found = fit.theta["shift_a"] + 2 * fit.theta["shift_b"]
    assert fit.converged
    assert found == pytest.approx(best, abs=1e-5 * np.sqrt(0.25 / (rate @ rate)))


def test_determined_problem_has_no_undetermined_directions():
    fit = bp.map_estimate(bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS), progress=False)
    assert fit.undetermined == ()


@pytest.mark.filterwarnings("ignore:Twice as many points")
def test_objective_increases_in_every_iteration():
    problem = bp.Problem(bp.models.duffing, [duffing_run()], priors=DUFFING_PRIORS, fixed={"m": 1.0})
    fit = bp.map_estimate(problem, start={"c": 0.6, "k": 0.5, "k3": 1.5}, progress=False)
    assert fit.converged and len(fit.history) > 3
    assert np.all(np.diff(fit.history) > 0.0)


def test_further_starts_find_the_better_mode():
    """With d = a − 3, force = d²·x + 0.05·d·ẋ: a start at d = −1.5 ends near −2, one of eight draws finds 2."""
    problem = bp.Problem(WELLS, [sine_run(lambda x, rate: 4.0 * x + 0.1 * rate)], priors={"a": bp.Normal(3.0, 3.0)})
    one = bp.map_estimate(problem, start={"a": 1.5}, progress=False)
    many = bp.map_estimate(problem, start={"a": 1.5}, starts=8, seed=1, progress=False)
    assert one.converged and one.theta["a"] < 2.0
    assert many.theta["a"] == pytest.approx(5.0, rel=0.01)
    assert len(many.starts) == 8
    assert many.starts[0]["objective"] == pytest.approx(one.history[-1])
    assert max(s["objective"] for s in many.starts) == many.history[-1]
    with pytest.raises(ValueError, match="starts: must be .*got 0"):
        bp.map_estimate(problem, starts=0)


def test_no_step_slips_to_another_periodic_solution():
    """Near Duffing's fold a full step would lose the upper branch; the estimate stays on it."""
    tau, theta = grid(200), {"m": 1.0, "c": 0.1, "k": 1.0, "k3": 0.5}
    force = {"force": 0.4 * np.cos(2 * np.pi * tau)}
    settings = {"frequency": 0.22, "samples": 200, "scheme": "central4"}
    upper = bp.solve_periodic(bp.models.duffing, theta, force, guess={"x": 2.0 * np.cos(2 * np.pi * tau)}, **settings)
    lower = bp.solve_periodic(bp.models.duffing, theta, force, guess={"x": -0.4 * np.cos(2 * np.pi * tau)}, **settings)
    assert np.ptp(upper.states["x"]) > 2.5 * np.ptp(lower.states["x"])
    noise = 0.01 * np.random.default_rng(3).standard_normal(200)
    run = bp.Experiment(
        "upper", 0.22, {"displacement": upper.states["x"] + noise}, force, samples=200, guess=upper.states
    )
    problem = bp.Problem(
        bp.models.duffing,
        [run],
        priors={"c": bp.LogNormal(0.1, 0.5), "k3": bp.LogNormal(0.5, 0.3)},
        fixed={"m": 1.0, "k": 1.0},
        scheme="central4",
    )
    fit = bp.map_estimate(problem, start={"c": 0.02, "k3": 0.52}, progress=False)
    assert fit.converged
    assert np.ptp(fit.solutions["upper"].states["x"]) == pytest.approx(np.ptp(upper.states["x"]), rel=0.02)
    assert abs(fit.theta["c"] - 0.1) < 4 * fit.sd["c"] and abs(fit.theta["k3"] - 0.5) < 4 * fit.sd["k3"]


def test_noise_is_split_into_measurement_noise_and_model_error():
    """A scatter of 6 N in 4 cycles gives 3 N in the mean; with a residual of 5 N (eq. 7) the model error is 4 N."""
    run = linear_experiment(TRUTH, 5.0, seed=4)
    fit = bp.map_estimate(bp.Problem(LINEAR, [replace(run, scatter={"force": 6.0}, cycles=4)], priors=PRIORS))
    x = linear_regressors(0.05, 2.0, grid(40))
    # The variance is that of one sample; four cycles are averaged.
    residual, information = run.outputs["force"] - x @ list(fit.theta.values()), x.T @ x / (fit.variances["force"] / 4)
    c, spread = fit.theta["c"], 0.5
    of_c = ((1.0 - np.log(c / 30.0)) / spread**2 - 1.0) / c**2  # −d²/dc² of the density of LogNormal(30, 0.5)
    precision = np.diag([60.0**-2, of_c, 10.0**-2])
    total = np.sum(residual**2) / (40 - np.trace(np.linalg.solve(information + precision, information)))
    split = fit.noise_split["force"]
    assert split.measurement == pytest.approx(3.0)
    assert split.total == pytest.approx(np.sqrt(total), rel=1e-6)
    assert split.model == pytest.approx(np.sqrt(total - 9.0), rel=1e-6)


def test_estimate_is_pickled_with_all_its_values():
    fit = bp.map_estimate(bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS), progress=False)
    again = pickle.loads(pickle.dumps(fit))
    assert again.robust_sd == fit.robust_sd and again.joint_mode == fit.joint_mode
    assert again.joint_covariance.equals(fit.joint_covariance)


def test_estimate_is_read_back_from_its_file(tmp_path):
    fit = bp.map_estimate(bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS), progress=False)
    fit.save(tmp_path / "fit.h5")
    again = bp.load(tmp_path / "fit.h5")
    assert again.theta == fit.theta and again.noise == fit.noise
    assert again.joint_covariance.equals(fit.joint_covariance)
    assert repr(again) == repr(fit)


def test_a_parameter_without_influence_is_at_the_mode_of_its_prior_and_at_no_end():
    """LogNormal(1, 1) has no curvature at its median, where the iteration starts; its mode is exp(−1)."""
    tau = np.arange(32) / 32
    model = bp.Model(
        "mute",
        states=["w"],
        inputs=["x"],
        parameters=["a", "b"],
        equations=lambda s, p, u: [s.dw + s.w - u.x],
        outputs=lambda s, p, u: {"y": p.a * u.x + 1e-9 * p.b * s.w},
    )
    x, noise = np.cos(2 * np.pi * tau), 0.02 * np.random.default_rng(1).standard_normal(32)
    run = bp.Experiment("run", 0.2, {"y": x + noise}, {"x": x}, samples=32)
    for prior, mode in ((bp.LogNormal(1.0, 1.0), np.exp(-1.0)), (bp.HalfNormal(1.0), 0.0)):
        priors = {"a": bp.LogNormal(1.0, 1.0), "b": prior}
        fit = bp.map_estimate(bp.Problem(model, [run], priors=priors, scheme="fourier"), progress=False)
        assert fit.converged and fit.at_ends == ()
        assert fit.theta["b"] == pytest.approx(mode, abs=1e-5)


def test_exact_data_are_named_instead_of_standard_deviations_of_rounding():
    force, parameters = {"force": np.cos(2 * np.pi * grid(100))}, {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
    exact = bp.solve_periodic(bp.models.duffing, parameters, force, frequency=0.15, samples=100).outputs
    run = bp.Experiment("run", 0.15, exact, force, samples=100)
    priors = {"c": bp.LogNormal(0.3, 0.5), "k": bp.LogNormal(1.3, 0.5)}
    settings = {"priors": priors, "fixed": {"m": 1.0, "k3": 0.5}}
    problem = bp.Problem(bp.models.duffing, [run], **settings)
    with pytest.warns(UserWarning, match="The data of 'displacement' contain no noise.*give its variance") as caught:
        fit = bp.map_estimate(problem, progress=False)
    assert fit.theta["k"] == pytest.approx(1.0, rel=1e-9) and fit.without_noise == ("displacement",)
    assert "displacement without noise" in repr(fit)
    assert not [w for w in caught if "Twice as many points" in str(w.message)]
    settings["fixed"] |= {"variance[displacement]": 1e-2}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known = bp.map_estimate(bp.Problem(bp.models.duffing, [run], **settings), progress=False)
    assert known.without_noise == () and known.converged
