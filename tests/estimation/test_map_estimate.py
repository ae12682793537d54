import re
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.estimation.unexplained import of_periodogram
from bayesperiodic.estimation.units import unit_error
from tests.known import LINEAR, RUNAWAY, formula_model, grid, linear_experiment, linear_regressors, normal_posterior

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
MEAN, COVARIANCE = np.array([800.0, 30.0, 20.0]), np.diag([60.0, 20.0, 10.0]) ** 2
DESIGN = linear_regressors(0.05, 2.0, grid(40))


def test_known_variance_gives_the_closed_form():
    experiment = linear_experiment(TRUTH, 3.0, seed=1)
    fit = bp.map_estimate(bp.Problem(LINEAR, [experiment], priors=PRIORS, fixed={"variance[force]": 9.0}))
    mean, covariance = normal_posterior(DESIGN, experiment.outputs["force"], 9.0, MEAN, COVARIANCE)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-10)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-10)
    assert list(fit.sd.values()) == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-10)
    assert fit.variances == {"force": 9.0}
    assert fit.converged


def test_progress_is_shown_unless_disabled(capsys, monkeypatch):
    monkeypatch.setattr("bayesperiodic.estimation.climbs.SHOWN_AFTER", 0.0)
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS)
    bp.map_estimate(problem, progress=False)
    assert capsys.readouterr().err == ""
    bp.map_estimate(problem)
    assert "MAP" in capsys.readouterr().err


def test_independent_values_set_the_weight_of_the_samples():
    experiment = linear_experiment(TRUTH, 3.0, seed=2, independent=11)
    fit = bp.map_estimate(bp.Problem(LINEAR, [experiment], priors=PRIORS, fixed={"variance[force]": 9.0}))
    mean, covariance = normal_posterior(DESIGN, experiment.outputs["force"], 9.0 * 40 / 11, MEAN, COVARIANCE)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-10)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-10)


def test_experiments_of_unequal_length_weigh_as_their_numbers_of_samples():
    """The mean periods of 1 and 25 cycles have the variances 9 and 9/25."""
    one, long = (
        replace(linear_experiment(TRUTH, sd, seed=seed), name=f"{cycles} cycles", cycles=cycles)
        for seed, (cycles, sd) in enumerate([(1, 3.0), (25, 0.6)])
    )
    fit = bp.map_estimate(bp.Problem(LINEAR, [one, long], priors=PRIORS, fixed={"variance[force]": 9.0}))
    weight = np.repeat([1.0, 5.0], 40)
    values = weight * np.concatenate([e.outputs["force"] for e in (one, long)])
    mean, covariance = normal_posterior(weight[:, None] * np.tile(DESIGN, (2, 1)), values, 9.0, MEAN, COVARIANCE)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-10)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-10)


def taken(design: np.ndarray, variance: float) -> float:
    """Return tr(XᵀX C)/v with C = (XᵀX/v + P)⁻¹: the values that parameters with the priors PRIORS take up."""
    return float(np.trace(np.linalg.solve(design.T @ design + variance * np.linalg.inv(COVARIANCE), design.T @ design)))


def test_unknown_variance_follows_equation_7():
    """V = s Σe² / (nNs − l) with s = 1 channel, N = 2 experiments, n = 40 samples, l = 3 parameters without priors.

    Parameters that are partly determined by their priors count less than 3.
    """
    experiments = [replace(linear_experiment(TRUTH, 3.0, seed=s), name=f"run {s}") for s in (3, 4)]
    design, values = np.tile(DESIGN, (2, 1)), np.concatenate([e.outputs["force"] for e in experiments])
    for priors in ({name: bp.Normal(prior.mean, 1e7) for name, prior in PRIORS.items()}, PRIORS):
        fit = bp.map_estimate(bp.Problem(LINEAR, experiments, priors=priors), progress=False)
        total = np.sum((values - design @ list(fit.theta.values())) ** 2)
        count = taken(design, fit.variances["force"]) if priors is PRIORS else 3
        assert fit.variances["force"] == pytest.approx(total / (40 * 2 - count), rel=1e-6)
    assert 2.9 < count < 3.0
    mean, _ = normal_posterior(design, values, fit.variances["force"], MEAN, COVARIANCE)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-7)


def test_estimate_maximises_equation_6_with_the_corrected_count():
    """With eq. (7) the staged iteration ends at the maximum of −½ (n − p) ln M + ln p(θ), p the values taken up."""
    experiment = linear_experiment(TRUTH, 3.0, seed=5)
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS)
    fit = bp.map_estimate(problem)
    left = 40 - taken(DESIGN, fit.variances["force"])
    best = np.array(list(fit.theta.values()))

    def objective(theta):
        residual = experiment.outputs["force"] - DESIGN @ theta
        return -0.5 * left * np.log(np.sum(residual**2)) + problem.log_prior(theta)

    for direction in np.eye(3) * np.array(list(fit.sd.values())):
        for step in (-0.05, 0.05):
            assert objective(best + step * direction) < objective(best)


def test_positive_parameter_is_estimated_at_the_mode_of_its_natural_density():
    priors = PRIORS | {"c": bp.LogNormal(30.0, 0.5)}
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=6)], priors=priors, fixed={"variance[force]": 9.0})
    fit = bp.map_estimate(problem)
    best = np.array(list(fit.theta.values()))
    step = np.array([0.0, 1e-3, 0.0])
    values = problem.log_posterior(np.stack([best - step, best, best + step]), np.full((3, 1), 9.0))
    assert values[1] > max(values[0], values[2])


def test_intervals_follow_students_t():
    priors = {name: bp.Normal(prior.mean, 1e7) for name, prior in PRIORS.items()}
    fit = bp.map_estimate(bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=7, independent=7)], priors=priors))
    low, high = fit.interval(0.9)["k"]
    assert list(fit.degrees_of_freedom.values()) == pytest.approx([4.0] * 3, rel=1e-6)
    assert (high - low) / 2 / fit.sd["k"] == pytest.approx(2.1318, rel=1e-4)
    with pytest.raises(ValueError, match="probability: must be .*got 1.2"):
        fit.interval(1.2)


def test_white_residuals_pass_and_smooth_ones_do_not():
    """Uniform p for white noise (1000 series, KS at 0.1 %), tiny p and large lag1 for a random walk."""
    from scipy import stats

    generator = np.random.default_rng(8)
    p = [of_periodogram(np.abs(np.fft.rfft(generator.standard_normal(200))[1:31]) ** 2).p for _ in range(1000)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    walk = np.cumsum(generator.standard_normal(400)) - np.linspace(0, 1, 400)
    smooth = of_periodogram(np.abs(np.fft.rfft(walk)[1:61]) ** 2)
    assert smooth.p < 1e-6 and smooth.lag1 > 0.5


def test_residuals_of_right_models_with_few_values_are_white():
    """7 values, 2 parameters that harmonic 1 determines: p < 1 % in at most 5 of 40, more by chance in 4e-6."""
    harmonics, generator, tau, rejected = 3, np.random.default_rng(9), 2 * np.pi * grid(64), 0
    lines = np.arange(harmonics + 1)[:, None] * tau
    for _ in range(40):
        cosine, sine = generator.standard_normal((2, harmonics + 1))
        noise = cosine @ np.cos(lines) + sine @ np.sin(lines) - cosine[0] * (1.0 - np.sqrt(0.5))
        force = 45.0 * np.sin(tau) + 25.0 * np.cos(tau) + noise
        run = bp.Experiment(
            "run", 2.0, {"force": force}, {"x": 0.05 * np.sin(tau)}, samples=64, harmonics={"force": harmonics}
        )
        priors = {"k": bp.Normal(900.0, 1e5), "c": bp.Normal(40.0, 1e5)}
        problem = bp.Problem(LINEAR, [run], priors=priors, fixed={"coulomb": 0.0})
        p = bp.map_estimate(problem, starts=1, progress=False).whiteness["force"].p
        rejected += p < 0.01
        assert np.isfinite(p)
    assert rejected <= 5


def test_whiteness_is_not_tested_where_the_parameters_leave_one_harmonic():
    tau = 2 * np.pi * grid(64)
    noise = np.cos(tau + 1.0) + 0.6 * np.cos(2 * tau + 0.3) + 0.2
    run = bp.Experiment(
        "run", 2.0, {"force": 45.0 * np.sin(tau) + noise}, {"x": 0.05 * np.sin(tau)}, samples=64, harmonics={"force": 2}
    )
    priors = {"k": bp.Normal(900.0, 1e5), "c": bp.Normal(40.0, 1e5)}
    problem = bp.Problem(LINEAR, [run], priors=priors, fixed={"coulomb": 0.0})
    fit = bp.map_estimate(problem, starts=1, progress=False)
    assert np.isnan(fit.whiteness["force"].p)
    assert "Whiteness of 'force' is not tested: the parameters leave fewer than two harmonics." in str(fit)


def test_noise_of_differentiated_inputs_is_propagated_to_the_output():
    """Force = c·ẋ with x of known amplitude noise: sd of the force from its closed form, and the warning."""
    model = formula_model("dashpot", ["c"], lambda p, u, s: {"force": p.c * u.dx + s.w})
    tau = grid(200)
    x = np.sin(2 * np.pi * tau)
    variance = np.array([0.0, 1e-4, 4e-4])
    rate = 2j * np.pi * 1.5 * np.arange(3)
    noise = np.random.default_rng(9).standard_normal(200) * 0.05
    experiment = bp.Experiment(
        "run",
        1.5,
        {"force": 2 * 2 * np.pi * 1.5 * np.cos(2 * np.pi * tau) + noise},
        {"x": x},
        samples=200,
        amplitude_variance={"x": variance},
    )
    with pytest.warns(UserWarning, match="noise of the measured inputs, differentiated, causes") as caught:
        fit = bp.map_estimate(bp.Problem(model, [experiment], priors={"c": bp.Normal(0, 10)}))
    assert caught[0].filename == __file__
    gain = fit.theta["c"] * rate + 1 / (1 + rate)
    expected = np.sqrt(np.sum(0.5 * np.abs(gain) ** 2 * variance))
    assert fit.input_noise["force"] == pytest.approx(expected, rel=2e-3)


def test_start_outside_the_support_is_refused():
    problem = bp.Problem(
        LINEAR, [linear_experiment(TRUTH, 3.0, seed=10)], priors=PRIORS | {"k": bp.Uniform(0.0, 1000.0)}
    )
    with pytest.raises(ValueError, match=r"start: must be inside the prior's support \(0, 1000\), got k = 2000"):
        bp.map_estimate(problem, start={"k": 2000.0, "c": 1.0, "coulomb": 1.0})
    with pytest.raises(ValueError, match="start: must be .*got 'kk'.*Did you mean 'k'"):
        bp.map_estimate(problem, start={"kk": 2000.0, "c": 1.0, "coulomb": 1.0})


def test_start_without_periodic_solution_is_refused():
    experiment = bp.Experiment(
        "run", 1.0, {"x": np.cos(2 * np.pi * grid(50))}, {"u": np.sin(2 * np.pi * grid(50))}, samples=50
    )
    with pytest.raises(
        ValueError,
        match=r"start: must have .*, got a = 1 \(the priors' medians\), where .* ended without the orbit of 'run'",
    ):
        bp.map_estimate(bp.Problem(RUNAWAY, [experiment], priors={"a": bp.LogNormal(1.0, 0.1)}))


def test_noise_of_inputs_that_are_not_differentiated_is_called_so():
    """Force = c·x + filtered x with one noisy harmonic of x: no derivative to measure."""
    model = formula_model("spring", ["c"], lambda p, u, s: {"force": p.c * u.x + s.w})
    wave = 2 * np.pi * grid(200)
    filtered = np.real(np.exp(1j * (wave - 0.5 * np.pi)) / (1 + 2j * np.pi * 1.5))
    noise = np.random.default_rng(9).standard_normal(200) * 0.02
    experiment = bp.Experiment(
        "run",
        1.5,
        {"force": 2 * np.sin(wave) + filtered + noise},
        {"x": np.sin(wave)},
        samples=200,
        amplitude_variance={"x": np.array([0.0, 1e-3])},
    )
    with pytest.warns(UserWarning, match="noise of the measured inputs causes .* taken as exact"):
        bp.map_estimate(bp.Problem(model, [experiment], priors={"c": bp.Normal(0, 10)}))


STIFFNESS = 900.0
OSCILLATOR = {"m": 1.0, "c": 3.0, "k3": 0.0}


def oscillation(frequency: float, length: float, *, samples: int = 64) -> bp.Experiment:
    """Return the response of the linear oscillator (closed form) to 2 N near 4.8 Hz, in units of `length` [m]."""
    omega, drive = 2 * np.pi * 4.5, 2.0 * np.exp(2j * np.pi * grid(samples))
    x = np.real(drive / (STIFFNESS - omega**2 + 3j * omega)) / length
    noise = 0.01 * np.std(x) * np.random.default_rng(1).standard_normal(samples)
    return bp.Experiment("run", frequency, {"displacement": x + noise}, {"force": drive.real}, samples=samples)


@pytest.mark.parametrize(
    ("frequency", "length", "sentence"),
    [
        (4.5, 1e-3, r"the measured amplitude of 'displacement' is 1e\+3 times that of the linearised model"),
        (4.5e-3, 1.0, r"the measured frequency .Hz. is 1e-3 times that of the linearised model"),
    ],
    ids=["mm for m", "ms for s"],
)
def test_wrong_units_are_named_where_the_fit_fails(frequency, length, sentence):
    problem = bp.Problem(
        bp.models.duffing,
        [oscillation(frequency, length)],
        priors={"k": bp.LogNormal(STIFFNESS, 0.05)},
        fixed=OSCILLATOR,
    )
    with pytest.warns(UserWarning) as caught:
        bp.map_estimate(problem, progress=False)
    texts = [str(one.message) for one in caught]
    assert any(re.search(f"Check the units, such as mm for m or ms for s: .*{sentence}", text) for text in texts)


def test_right_units_are_not_blamed():
    problem = bp.Problem(
        bp.models.duffing, [oscillation(4.5, 1.0)], priors={"k": bp.LogNormal(800.0, 0.2)}, fixed=OSCILLATOR
    )
    assert unit_error(problem) == ""
    fit = bp.map_estimate(problem, progress=False)
    assert fit.theta["k"] == pytest.approx(STIFFNESS, rel=0.01)


def test_failed_start_compares_measured_and_modelled_sizes():
    """ẋ = −a x + u with a = 2 rad/s has the amplitude |û/(a + iω)|; the density is not finite as k overflows."""
    model = bp.Model(
        "relaxation",
        states=["x"],
        inputs=["u"],
        parameters=["a", "k"],
        equations=lambda s, p, u: [s.dx + p.a * s.x - u.u],
        outputs=lambda s, p, u: {"x": s.x, "big": sp.exp(p.k) * s.x},
    )
    wave = np.cos(2 * np.pi * grid(40))
    experiment = bp.Experiment("run", 1.0, {"x": wave, "big": wave}, {"u": wave}, samples=40)
    problem = bp.Problem(model, [experiment], priors={"k": bp.Normal(800.0, 1.0)}, fixed={"a": 2.0})
    size = abs(1 / (2 + 2j * np.pi))
    with pytest.raises(ValueError, match=f"frequency .Hz. 1 against 0.318, amplitude of 'x' 1 against {size:.3g}"):
        bp.map_estimate(problem, progress=False)


def test_draws_of_the_priors_replace_a_start_without_a_cycle():
    """Only for μ > 0 the model oscillates, with the amplitude 2√μ and, to first order, the frequency ω/2π."""
    model = bp.Model(
        "growing", states=["x"], inputs=[], parameters=["mu", "omega"],
        equations=["ddx - (mu - x**2)*dx + omega**2*x"], outputs={"x": "x"},
    )  # fmt: skip
    truth, test = {"mu": 0.5, "omega": 6.0}, {"frequency": 0.95, "duration": 80, "sampling_rate": 40, "seed": 1}
    run = bp.simulate(model, truth, start={"x": 1.0}, noise={"x": 0.02}, **test).between(40, 80)
    cycle = run.fold(64, origin="crossing")
    priors = {"mu": bp.Normal(-0.3, 0.6), "omega": bp.LogNormal(6, 0.1)}
    problem = bp.Problem(model, [cycle], priors=priors, scheme="fourier")
    with pytest.raises(ValueError, match="mu = -0.3, .* or try draws of the priors by starts=8"):
        bp.map_estimate(problem, progress=False)
    fit = bp.map_estimate(problem, starts=8, progress=False)
    for name, value in truth.items():
        assert abs(fit.theta[name] - value) < 4.0 * fit.sd[name], name


def test_an_estimate_without_a_joint_mode_is_printed():
    fit = bp.map_estimate(
        bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS | {"k": bp.LogNormal(800, 0.1)}),
        progress=False,
    )
    lost = replace(fit, joint=replace(fit.joint, mode={}))
    assert lost.over_logarithm == {} and "k" in str(lost)
