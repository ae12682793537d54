"""Comparison with the data: masks, angles, delays, multipliers, frequencies, and local parameters."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from tests.known import LINEAR, grid, linear_experiment, linear_regressors, normal_posterior
from tests.problems import (
    DUFFING,
    DUFFING_PRIORS,
    PENDULUM_PRIORS,
    ROTATION,
    SAMPLES,
    cycle_run,
    duffing_run,
    pendulum_problem,
    pendulum_run,
    rotation,
    section_run,
)

PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
MEAN, SD = np.array([800.0, 30.0, 20.0]), np.array([60.0, 20.0, 10.0])
TRUTH = np.array([900.0, 40.0, 25.0])
KNOWN = {"variance[force]": 9.0}
UNSTABLE = {"l": 0.3, "k3": 4.5e-4}


def linear_runs(*coulomb: float) -> list[bp.Experiment]:
    return [
        linear_experiment([900.0, 40.0, value], 3.0, seed=seed, name=f"run {seed}")
        for seed, value in enumerate(coulomb, 1)
    ]


def test_local_parameters_give_the_closed_form_of_the_enlarged_problem():
    """Stiffness and damping shared, Coulomb friction of each run its own: a design of 2 + 3 columns."""
    runs = linear_runs(10.0, 25.0, 40.0)
    problem = bp.Problem(LINEAR, runs, priors=PRIORS, fixed=KNOWN, local=["coulomb"])
    names = ("k", "c", "coulomb[run 1]", "coulomb[run 2]", "coulomb[run 3]")
    assert problem.names == names
    fit = bp.map_estimate(problem, progress=False)
    x = linear_regressors(0.05, 2.0, grid(40))
    design = np.zeros((120, 5))
    for i in range(3):
        design[40 * i : 40 * (i + 1), [0, 1, 2 + i]] = x
    prior = np.diag([60.0, 20.0, 10.0, 10.0, 10.0]) ** 2
    values = np.concatenate([e.outputs["force"] for e in runs])
    mean, covariance = normal_posterior(design, values, 9.0, [800.0, 30.0, 20.0, 20.0, 20.0], prior)
    assert [fit.theta[name] for name in names] == pytest.approx(mean, rel=1e-10)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-9)
    assert fit.joint_covariance.to_numpy() == pytest.approx(covariance, rel=1e-6, abs=1e-9)


def test_a_local_parameter_may_have_its_own_prior_or_a_value_in_single_runs():
    runs = linear_runs(10.0, 25.0, 40.0)
    problem = bp.Problem(
        LINEAR,
        runs,
        priors={"coulomb[run 2]": bp.Uniform(0.0, 50.0)} | PRIORS,
        fixed=KNOWN | {"coulomb": {"run 3": 40.0}},
        local=["coulomb"],
    )
    assert problem.names == ("k", "c", "coulomb[run 1]", "coulomb[run 2]")
    assert problem.priors["coulomb[run 2]"] == bp.Uniform(0.0, 50.0)
    assert problem.parameters(np.array([[1.0, 2.0, 3.0, 4.0]]), "run 3")[0] == pytest.approx([1.0, 2.0, 40.0])
    assert problem.parameters(np.array([[1.0, 2.0, 3.0, 4.0]]), "run 2")[0] == pytest.approx([1.0, 2.0, 4.0])


def test_a_joint_prior_may_name_local_parameters():
    runs = linear_runs(10.0, 25.0)
    key = ("coulomb[run 2]", "k", "coulomb[run 1]")
    joint = bp.MultivariateNormal([25.0, 900.0, 10.0], np.diag([1.0, 4.0, 9.0]) + 0.1)
    problem = bp.Problem(LINEAR, runs, priors={key: joint, "c": PRIORS["c"]}, fixed=KNOWN, local=["coulomb"])
    theta = {"k": 899.0, "c": 30.0, "coulomb[run 1]": 9.0, "coulomb[run 2]": 26.0}
    expected = stats.multivariate_normal(joint.mean, joint.covariance).logpdf([26.0, 899.0, 9.0])
    assert problem.log_prior(theta) == pytest.approx(expected + stats.norm(30.0, 20.0).logpdf(30.0), rel=1e-12)


def test_a_tie_to_a_local_parameter_is_local():
    runs = linear_runs(10.0, 25.0)
    problem = bp.Problem(
        LINEAR,
        runs,
        priors={"k": PRIORS["k"], "coulomb": PRIORS["coulomb"]},
        tied={"c": "coulomb*2"},
        local=["coulomb"],
    )
    theta = np.array([[900.0, 10.0, 25.0]])
    assert problem.parameters(theta, "run 1")[0] == pytest.approx([900.0, 20.0, 10.0])
    assert problem.parameters(theta, "run 2")[0] == pytest.approx([900.0, 50.0, 25.0])


def test_variances_of_each_run_follow_equation_7():
    """V = M/(n − p) with n = 40 in each run, p = tr(F C) of its regressors."""
    runs = [linear_experiment(TRUTH, sd, seed=seed, name=f"run {seed}") for seed, sd in ((1, 1.0), (2, 9.0))]
    fit = bp.map_estimate(
        bp.Problem(LINEAR, runs, priors=PRIORS, noise=bp.noise.Independent(per="experiment")), progress=False
    )
    x = linear_regressors(0.05, 2.0, grid(40))
    information = {name: x.T @ x / variance for name, variance in fit.variances.items()}
    covariance = np.linalg.inv(sum(information.values()) + np.diag(SD**-2.0))
    for run in runs:
        name = f"force, {run.name}"
        square = np.sum((run.outputs["force"] - x @ list(fit.theta.values())) ** 2)
        expected = square / (40 - np.trace(information[name] @ covariance))
        assert fit.variances[name] == pytest.approx(expected, rel=1e-6)


def test_mask_excludes_unmeasured_points():
    """The estimate is the closed form on the points of the mask; values elsewhere may be NaN."""
    run, mask = linear_experiment(TRUTH, 3.0, seed=5), np.arange(40) % 5 == 1
    values = np.where(mask, run.outputs["force"], np.nan)
    masked = replace(run, outputs={"force": values}, mask=mask, independent={})
    assert masked.independent == {"force": 8}
    fit = bp.map_estimate(bp.Problem(LINEAR, [masked], priors=PRIORS, fixed=KNOWN), progress=False)
    x = linear_regressors(0.05, 2.0, grid(40))[mask]
    mean, _ = normal_posterior(x, values[mask], 9.0, MEAN, np.diag(SD**2))
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-9)
    assert np.isnan(fit.whiteness["force"].p)


def test_angles_are_compared_modulo_a_turn():
    wrapped = pendulum_run()
    turned = replace(wrapped, outputs=dict(wrapped.outputs) | {"angle": wrapped.outputs["angle"] + 6 * np.pi})
    unwrapped = replace(wrapped, outputs=dict(wrapped.outputs) | {"angle": np.unwrap(wrapped.outputs["angle"])})
    values = [
        float(pendulum_problem([e]).log_likelihood(UNSTABLE, {"angle": 1e-4, "rate": 2.5e-3}))
        for e in (wrapped, turned, unwrapped)
    ]
    assert values[0] == pytest.approx(values[1], rel=1e-12) == pytest.approx(values[2], rel=1e-12)
    noise = np.random.default_rng(1).standard_normal((2, SAMPLES))
    expected = -0.5 * (SAMPLES * (np.log(1e-4) + np.log(2.5e-3)) + np.sum(noise**2))
    assert values[0] == pytest.approx(expected, rel=1e-9)


def test_section_values_with_their_covariance_are_a_normal_density():
    """Values ~ N(·, scale·C), and log|μ| ~ N(·, C22) given them, out of eq. (7)'s count."""
    run, truth = section_run(), rotation()
    problem = pendulum_problem([run], noise=bp.noise.Independent(prior=bp.InverseGamma(3.0, 2.0)))
    assert problem.noise_names == ("scale",) and problem.counted == 2.0
    difference = [run.outputs[c][0] - truth.outputs[c][0] for c in ("angle", "rate")]
    difference[0] = (difference[0] + np.pi) % (2 * np.pi) - np.pi
    difference = np.array([*difference, np.log(1.05)])
    one = stats.multivariate_normal(np.zeros(3), run.covariance).logpdf(difference)
    constant = 1.5 * np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(run.covariance)[1]
    assert problem.log_likelihood(UNSTABLE, {"scale": 1.0}) == pytest.approx(one + constant, abs=1e-6)
    values, slopes = run.covariance[:2, :2], run.covariance[2, :2] @ np.linalg.inv(run.covariance[:2, :2])
    left = difference[2] - slopes @ difference[:2]
    variance = run.covariance[2, 2] - slopes @ run.covariance[:2, 2]
    scaled = -0.5 * (
        2 * np.log(4.0) + difference[:2] @ np.linalg.solve(values, difference[:2]) / 4 + left**2 / variance
    )
    assert problem.log_likelihood(UNSTABLE, {"scale": 4.0}) == pytest.approx(scaled, abs=1e-6)


def test_covariance_is_in_the_order_of_the_outputs_whatever_the_order_of_the_model():
    """Three values of two outputs, given in another order than the model has them, against a normal density."""
    root = np.random.default_rng(4).normal(size=(7, 7))
    covariance, mask = 1e-3 * root @ root.T, np.isin(np.arange(SAMPLES), [3, 70, 150])
    run, truth = section_run(mask=mask, covariance=covariance), rotation()
    run = replace(run, outputs={name: run.outputs[name] for name in ("rate", "angle")})
    problem = pendulum_problem([run], fixed={n: v for n, v in truth.parameters.items() if n not in UNSTABLE})
    away = np.stack([run.outputs[name][mask] - truth.outputs[name][mask] for name in ("rate", "angle")], axis=1)
    away[:, 1] = (away[:, 1] + np.pi) % (2 * np.pi) - np.pi
    away = np.append(away.ravel(), np.log(1.05))
    expected = -0.5 * away @ np.linalg.solve(covariance, away)
    theta = {name: truth.parameters[name] for name in UNSTABLE}
    assert problem.log_likelihood(theta, {"scale": 1.0}) == pytest.approx(expected, rel=1e-6)
    assert tuple(problem.experiments[0].outputs) == ("angle", "rate")
    # Outputs in the model's order later on keep their errors.
    again = replace(problem.experiments[0], outputs={n: run.outputs[n] for n in ("angle", "rate")})
    assert problem.with_experiments([again]).log_likelihood(theta, {"scale": 1.0}) == pytest.approx(expected, rel=1e-6)


def test_measured_multipliers_add_the_expected_information_on_friction():
    """The information of log|μ|, known to 1 %, on k3 is that of its derivative."""
    mask, covariance = np.arange(SAMPLES) == 0, np.diag([1e-4, 4e-3])
    known = {"fixed": {n: v for n, v in rotation().parameters.items() if n != "k3"} | {"scale": 1.0}}
    prior = {"priors": {"k3": PENDULUM_PRIORS["k3"]}}
    without = pendulum_problem([section_run(mask=mask, covariance=covariance, multipliers=None)], **known, **prior)
    multiplier = {"multipliers": [ROTATION.multipliers[0].real], "multiplier_sd": [0.01]}
    with_it = pendulum_problem([section_run(mask=mask, covariance=covariance, **multiplier)], **known, **prior)
    fits = [bp.map_estimate(p, progress=False) for p in (without, with_it)]
    at = fits[1].solutions["rotation"]
    slope = (bp.multiplier_sensitivities(bp.models.pendulum, at)["k3"] / at.multipliers)[0].real
    points = [at.sensitivities[c]["k3"][0] for c in ("angle", "rate")]
    k3 = fits[1].theta["k3"]
    precision = points[0] ** 2 / 1e-4 + points[1] ** 2 / 4e-3 + PENDULUM_PRIORS["k3"].curvature(np.array(k3))
    assert fits[1].sd["k3"] ** -2 == pytest.approx(precision + (slope / 0.01) ** 2, rel=1e-6)
    assert fits[0].sd["k3"] ** -2 < 0.6 * fits[1].sd["k3"] ** -2


def test_multiplier_of_the_other_sign_identifies_another_orbit():
    problem = pendulum_problem(
        [section_run(multipliers=[1.7])], noise=bp.noise.Independent(prior=bp.InverseGamma(3, 2))
    )
    assert problem.log_likelihood(UNSTABLE, {"scale": 1.0}) == -np.inf
    with pytest.raises(
        ValueError, match="the periodic solve ended without the orbit of 'rotation' .other orbit.. Give start="
    ):
        bp.map_estimate(problem, start=UNSTABLE, progress=False)


@pytest.mark.filterwarnings("ignore:Twice as many points")
def test_a_delay_of_the_outputs_is_found():
    """Outputs 0.37 s late are found to be 0.37 s late, within 4 standard deviations (false-alarm rate 0.006 %)."""
    run = duffing_run()
    spectrum = np.fft.rfft(run.outputs["displacement"])
    late = np.fft.irfft(spectrum * np.exp(-2j * np.pi * np.arange(spectrum.size) * 0.37 * run.frequency), SAMPLES)
    problem = bp.Problem(
        bp.models.duffing,
        [replace(run, outputs={"displacement": late})],
        priors=DUFFING_PRIORS | {"shift": bp.Normal(0.0, 1.0)},
        fixed={"m": 1.0},
    )
    assert problem.names == ("c", "k", "k3", "shift[run 1]")
    fit = bp.map_estimate(problem, progress=False)
    assert abs(fit.theta["shift[run 1]"] - 0.37) < 4 * fit.sd["shift[run 1]"] < 0.2
    known = bp.Problem(
        bp.models.duffing,
        [replace(run, outputs={"displacement": late})],
        priors=DUFFING_PRIORS,
        fixed={"m": 1.0, "shift": 0.37},
    )
    plain = bp.Problem(bp.models.duffing, [run], priors=DUFFING_PRIORS, fixed={"m": 1.0})
    theta = {"c": 0.2, "k": 1.0, "k3": 0.5}
    of_nyquist = 1e-4
    assert known.log_likelihood(theta, [0.01]) == pytest.approx(plain.log_likelihood(theta, [0.01]), rel=of_nyquist)


def test_delay_of_a_rotating_angle_leaves_no_jump():
    """A rotation delayed by 0.05 s has the same density as without delay, the trend of the angle included."""
    truth, delay = rotation(), 0.05
    fraction = delay * truth.frequency
    late = {}
    for channel, values in truth.outputs.items():
        trend = 2 * np.pi * grid(SAMPLES) * (channel == "angle")
        waves = np.exp(-2j * np.pi * np.arange(SAMPLES // 2 + 1) * fraction)
        late[channel] = np.fft.irfft(np.fft.rfft(values - trend) * waves, SAMPLES) + trend
        late[channel] -= 2 * np.pi * fraction * (channel == "angle")
    run = pendulum_run(sd=0.0)
    problem = pendulum_problem([replace(run, outputs=late)], priors=PENDULUM_PRIORS | {"shift": bp.Normal(0, 1)})
    value = problem.log_likelihood(UNSTABLE | {"shift[rotation]": delay}, {"angle": 1.0, "rate": 1.0})
    assert value == pytest.approx(0.0, abs=1e-9)


def test_autonomous_cycle_is_identified_for_any_phase():
    """The shape determines mu, the frequency omega; within 4 sds (false-alarm rate 0.01 %)."""
    fits = []
    for turned in (0.2, 0.55):
        problem = bp.Problem(
            bp.models.van_der_pol,
            [cycle_run(turned=turned)],
            priors={"mu": bp.LogNormal(1.0, 0.5), "omega": bp.Normal(1.2, 0.5)},
            scheme="central4",
        )
        assert problem.names == ("mu", "omega", "shift[cycle]")
        fits.append(bp.map_estimate(problem, progress=False))
    for fit in fits:
        assert fit.converged
        assert abs(fit.theta["mu"] - 1.5) < 4 * fit.sd["mu"] < 0.1
        assert fit.solutions["cycle"].frequency == pytest.approx(cycle_run().frequency, rel=1e-3)
        assert abs(fit.theta["omega"] - 1.0) < 4 * fit.sd["omega"] < 0.02
        assert abs(fit.theta["shift[cycle]"]) < 4 * fit.sd["shift[cycle]"]
    assert fits[0].theta["mu"] == pytest.approx(fits[1].theta["mu"], abs=2 * fits[0].sd["mu"])


def test_the_phase_of_a_cycle_is_the_likeliest_one_of_all_channels():
    """The phase is within one sd of the maximum; that of the noisy channel alone is ten sds off."""
    model = bp.Model(
        "two_sensors",
        states=["x"],
        parameters=["mu"],
        equations=lambda s, p, u: [s.ddx - p.mu * (1 - s.x**2) * s.dx + s.x],
        outputs=lambda s, p, u: {"position": s.x, "rate": s.dx},
    )
    truth = bp.solve_periodic(model, {"mu": 0.3}, frequency=0.16, samples=SAMPLES, scheme="central4")
    sds = {"position": 0.1, "rate": 0.005}
    for seed in range(3):
        generator = np.random.default_rng(seed)
        outputs = {c: truth.outputs[c] + sd * generator.standard_normal(SAMPLES) for c, sd in sds.items()}
        run = bp.Experiment(
            "run", truth.frequency, outputs, samples=SAMPLES, frequency_se=1e-4, guess=truth.states, scatter=sds
        )
        fixed = {f"variance[{c}]": sd**2 for c, sd in sds.items()}
        priors = {"mu": bp.LogNormal(0.3, 0.5), "shift": bp.Normal(0.0, 1.0)}
        problem = bp.Problem(model, [run], priors=priors, fixed=fixed, scheme="central4")
        shifts = np.linspace(-2e-3, 2e-3, 9)
        theta = np.stack([np.full(9, 0.3), shifts], axis=-1)
        curve = np.polyfit(shifts, problem.anchored(theta[4]).log_likelihood(theta, {}), 2)
        assert abs(curve[1] / (2.0 * curve[0])) < 1.0 / np.sqrt(-2.0 * curve[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"local": ["coulom"]}, "local: must be .*got 'coulom'.*Did you mean 'coulomb'"),
        (
            {"local": "coulomb"},
            r"local: must be a sequence of names, got 'coulomb'. Give \['coulomb'\]",
        ),
        ({"priors": PRIORS | {"coulomb[run 1]": PRIORS["k"]}}, r"priors: must be .*got 'coulomb\[run 1\]'"),
        ({"local": ["k"], "fixed": {"k": {"run 1": 1.0}}, "priors": PRIORS | {"k[run 1]": PRIORS["k"]}}, "fixed: 'k"),
        ({"local": ["k"], "priors": {k: v for k, v in PRIORS.items() if k != "k"}}, "'k' has neither a prior nor"),
        (
            {"local": ["k"], "priors": {("k", "c"): bp.MultivariateNormal([1, 1], np.eye(2)), "coulomb": PRIORS["k"]}},
            r"'k' is local; a joint prior needs the names of single experiments, such as 'k\[run\]'",
        ),
        (
            {"local": ["c"], "tied": {"c": "k/20"}, "priors": {k: v for k, v in PRIORS.items() if k != "c"}},
            "local: 'c' is tied; it follows what it is tied to",
        ),
        ({"noise": "white"}, "noise: must be one of 'independent', 'measured', 'relative', 'circulant', got 'white'"),
        ({"fixed": {"lengthscale[force]": 1.0}}, r"fixed: must be .*got 'lengthscale\[force\]'"),
    ],
)
def test_error_names_the_argument_that_does_not_fit(changes, message):
    with pytest.raises(ValueError, match=message):
        bp.Problem(LINEAR, linear_runs(10.0, 25.0), **({"priors": PRIORS} | changes))


def test_circulant_noise_shared_by_different_grids_is_rejected():
    runs = [linear_experiment(TRUTH, 3.0, seed=1), linear_experiment(TRUTH, 3.0, seed=2, samples=60, name="fine")]
    with pytest.raises(ValueError, match="noise: must have .*, got 'circulant'; experiments with 40 and 60 points"):
        bp.Problem(LINEAR, runs, priors=PRIORS, noise="circulant")
    bp.Problem(LINEAR, runs, priors=PRIORS, noise=bp.noise.Circulant(per="experiment"))
    bp.Problem(LINEAR, runs, priors=PRIORS)


def test_data_without_information_are_rejected():
    run = linear_experiment(TRUTH, 3.0, seed=5)
    with pytest.raises(ValueError, match=r"outputs of experiment 'run': 'force' is constant \(1\)"):
        bp.Problem(LINEAR, [replace(run, outputs={"force": np.ones(40)})], priors=PRIORS)
    few = replace(run, mask=np.arange(40) < 3, independent={})
    with pytest.raises(ValueError, match=r"unknown 'variance\[force\]' with the Jeffreys prior 1/v .* got only 3"):
        bp.Problem(LINEAR, [few], priors=PRIORS)
    bp.Problem(LINEAR, [few], priors=PRIORS, noise=bp.noise.Independent(prior=bp.InverseGamma(3.0, 20.0)))
    with pytest.raises(ValueError, match="frequency_se must be > 0, got 0; .* autonomous, .* Fold without `frequency`"):
        bp.Problem(bp.models.van_der_pol, [replace(cycle_run(), frequency_se=0.0)], priors={"mu": PRIORS["k"]})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mask": np.zeros(SAMPLES, dtype=bool)}, "mask: must be a bool array .* got bool of shape .* with 0 points"),
        ({"mask": np.ones(3, dtype=bool)}, "mask: must be a bool array .* got bool of shape .3,. with 3 points"),
        ({"covariance": np.eye(2)}, r"covariance: must have shape \(3, 3\), for 2 measured .*got \(2, 2\)"),
        ({"covariance": -np.eye(3)}, "covariance: must be positive definite"),
        (
            {"covariance": np.triu(np.ones((3, 3)))},
            r"covariance: must be finite and symmetric, got 1 in entry \[0, 1\] and 0 in entry \[1, 0\]",
        ),
        (
            {"covariance": [[1e-18, 5e-19, 0.0], [4e-19, 1e-18, 0.0], [0.0, 0.0, 1e6]]},
            r"covariance: must be finite and symmetric, got 5e-19 in entry \[0, 1\] and 4e-19 in entry \[1, 0\]",
        ),
        ({"covariance": np.full((3, 3), np.nan)}, "covariance: must be finite and symmetric, got 9 entries"),
        ({"multipliers": [0.0]}, r"multipliers: must be real, not zero, .*got \[0.0\]"),
        ({"multipliers": [1.0, -2.0]}, r"multipliers: must be .* ordered by descending modulus, got \[1.0, -2.0\]"),
        ({"multiplier_sd": [0.0], "covariance": np.eye(2)}, r"multiplier_sd: must be > 0, got \[0.0\]"),
        ({"covariance": None}, "multipliers: must have standard deviations; give multiplier_sd"),
        (
            {"multipliers": None, "covariance": np.eye(2), "multiplier_sd": [1.0]},
            "multiplier_sd: requires `multipliers`",
        ),
    ],
)
def test_error_names_the_bad_section_data(changes, message):
    with pytest.raises(ValueError, match=message):
        section_run(**changes)


def test_residual_of_exact_data_vanishes_only_without_delay():
    """With the true parameters and no noise the residual vanishes at shift = 0 alone."""
    assert DUFFING["m"] == 1.0
    run = duffing_run()
    truth = bp.solve_periodic(bp.models.duffing, DUFFING, run.inputs, frequency=run.frequency, samples=SAMPLES)
    clean = replace(run, outputs={"displacement": truth.outputs["displacement"]})
    problem = bp.Problem(
        bp.models.duffing,
        [clean],
        priors={"shift": bp.Normal(0.0, 1.0)},
        fixed=dict(DUFFING) | {"variance[displacement]": 1.0},
    )
    values = problem.log_likelihood(np.array([[-0.1], [0.0], [0.1]]), {})
    assert values[1] == pytest.approx(0.0, abs=1e-15) and max(values[0], values[2]) < -1e-3
