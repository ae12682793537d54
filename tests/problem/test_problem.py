from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.problem.fingerprint import fingerprint
from tests.known import LINEAR, grid, linear_experiment, linear_regressors, normal_posterior

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.4), "coulomb": bp.Uniform(0.0, 50.0)}


@pytest.fixture(scope="module")
def experiment():
    return linear_experiment(TRUTH, 3.0, seed=1)


@pytest.fixture(scope="module")
def problem(experiment):
    return bp.Problem(LINEAR, [experiment], priors=PRIORS)


def test_log_posterior_is_equation_6_over_theta_and_log_variance(problem, experiment):
    theta, v = np.array([870.0, 37.0, 22.0]), 7.0
    residual = experiment.outputs["force"] - linear_regressors(0.05, 2.0, grid(40)) @ theta
    likelihood = -0.5 * (40 * np.log(v) + np.sum(residual**2) / v)
    prior = -0.5 * (70 / 60) ** 2 - np.log(60 * np.sqrt(2 * np.pi))
    prior += -0.5 * (np.log(37 / 30) / 0.4) ** 2 - np.log(37 * 0.4 * np.sqrt(2 * np.pi)) - np.log(50)
    given = {"k": 870.0, "c": 37.0, "coulomb": 22.0}
    assert problem.log_likelihood(given, {"force": v}) == pytest.approx(likelihood, rel=1e-10)
    assert problem.log_prior(given) == pytest.approx(prior, rel=1e-12)
    assert problem.log_posterior(theta, np.array([v])) == pytest.approx(likelihood + prior, rel=1e-10)


def test_many_points_at_once_equal_one_by_one(problem):
    theta = np.random.default_rng(2).normal([870, 37, 22], [20, 3, 3], size=(5, 3))
    together = problem.log_posterior(theta, np.full((5, 1), 8.0))
    assert together == pytest.approx([float(problem.log_posterior(t, np.array([8.0]))) for t in theta], rel=1e-12)


def test_log_posterior_outside_the_prior_is_minus_infinity(problem):
    assert problem.log_posterior(np.array([870.0, 37.0, 60.0]), np.array([8.0])) == -np.inf


def test_log_posterior_does_not_depend_on_earlier_evaluations(problem):
    point, elsewhere = np.array([870.0, 37.0, 22.0]), np.array([300.0, 90.0, 45.0])
    before = problem.log_posterior(point, np.array([8.0]))
    problem.log_posterior(elsewhere, np.array([8.0]))
    assert problem.log_posterior(point, np.array([8.0])) == before


def test_residual_ignores_harmonics_that_the_fold_removed():
    tau = grid(200)
    clean = linear_regressors(0.05, 2.0, tau) @ TRUTH
    spectrum = np.fft.rfft(clean)
    spectrum[4:] = 0
    kept = np.fft.irfft(spectrum, 200)
    experiment = bp.Experiment(
        "run",
        2.0,
        {"force": kept},
        {"x": 0.05 * np.sin(2 * np.pi * tau)},
        samples=200,
        harmonics={"force": 3},
        independent={"force": 7},
    )
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS)
    assert problem.log_likelihood(TRUTH, {"force": 200 / 7}) == pytest.approx(0.0, abs=1e-14)
    assert np.sum((clean - kept) ** 2) > 1.0


@pytest.mark.parametrize("kept", [{40: [None, None]}, {40: [3, None, 19]}, {41: [5, 20]}, {40: [None, 4], 63: [8]}])
def test_each_experiment_counts_with_the_harmonics_that_it_keeps(kept):
    """The squares of eq. (6), against least-squares projections onto cosines and sines; v is that of one sample."""
    generator, experiments, expected = np.random.default_rng(4), [], 0.0
    theta, v = np.array([870.0, 37.0, 22.0]), 7.0
    for samples, highest in kept.items():
        tau = grid(samples)
        for count in highest:
            waves = np.arange(1 + (samples // 2 if count is None else count))
            basis = np.column_stack([f(2 * np.pi * np.outer(tau, waves)) for f in (np.cos, np.sin)])
            values = basis @ np.linalg.lstsq(basis, 1e3 * generator.standard_normal(samples), rcond=None)[0]
            difference = values - linear_regressors(0.05, 2.0, tau) @ theta
            projected = basis @ np.linalg.lstsq(basis, difference, rcond=None)[0]
            independent = samples if count is None else 2 * count + 1
            own = v * independent / samples
            expected -= 0.5 * independent * (np.log(own) + np.mean(projected**2) / own)
            harmonics = {} if count is None else {"force": count}
            x, name = 0.05 * np.sin(2 * np.pi * tau), f"run {len(experiments)}"
            experiments.append(
                bp.Experiment(name, 2.0, {"force": values}, {"x": x}, samples=samples, harmonics=harmonics)
            )
    problem = bp.Problem(LINEAR, experiments, priors=PRIORS)
    assert problem.log_likelihood(theta, {"force": v}) == pytest.approx(expected, rel=1e-9)
    many = problem.log_likelihood(np.tile(theta, (3, 1)), np.full((3, 1), v))
    assert (many == problem.log_likelihood(theta, {"force": v})).all()


def test_prior_samples_have_the_names(problem):
    draws = problem.sample_prior(1000, seed=3)
    assert list(draws) == ["k", "c", "coulomb"]
    assert np.median(draws["c"]) == pytest.approx(30.0, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"priors": {"k": PRIORS["k"], "c": PRIORS["c"]}},
            "'coulomb' has neither a prior nor a value in experiment 'run'; a free parameter needs a prior",
        ),
        ({"priors": PRIORS | {"coulom": PRIORS["k"]}}, "priors: must be .*got 'coulom'.*Did you mean 'coulomb'"),
        ({"fixed": {"k": 1.0}}, "fixed: 'k' has a prior too"),
        ({"fixed": {"variance[forc]": 1.0}}, r"fixed: must be .*got 'variance\[forc\]'"),
        ({"fixed": {"variance[force]": 0.0}}, r"fixed\['variance\[force\]'\]: must be .*got 0.0"),
        ({"experiments": []}, "at least one experiment"),
        ({"experiments": ["run"]}, "experiments: must each be an Experiment, got 'run'"),
        (
            {"priors": PRIORS | {"variance[force]": PRIORS["k"]}},
            r"priors: must be .*got the noise parameter 'variance.force.'",
        ),
    ],
)
def test_error_names_the_bad_part_of_a_problem(experiment, changes, message):
    with pytest.raises(ValueError, match=message):
        bp.Problem(LINEAR, **({"experiments": [experiment], "priors": PRIORS} | changes))


def test_experiments_must_fit_the_model(experiment):
    tau = grid(40)
    with pytest.raises(ValueError, match="inputs of experiment 'run': must be 'x', got 'y'"):
        bp.Problem(LINEAR, [bp.Experiment("run", 2.0, {"force": tau}, {"y": tau}, samples=40)], priors=PRIORS)
    with pytest.raises(ValueError, match=r"^inputs of experiment 'run': must be 'x', got none. .*waveforms=True"):
        bp.Problem(LINEAR, [bp.Experiment("run", 2.0, {"force": tau}, {}, samples=40)], priors=PRIORS)
    with pytest.raises(ValueError, match="outputs of experiment 'run': must be 'force', got 'torque'"):
        bp.Problem(LINEAR, [bp.Experiment("run", 2.0, {"torque": tau}, {"x": tau}, samples=40)], priors=PRIORS)
    with pytest.raises(ValueError, match="experiments: names must differ, got"):
        bp.Problem(LINEAR, [experiment, experiment], priors=PRIORS)
    with pytest.raises(ValueError, match="guess of experiment 'run': must be .*got 'y'"):
        bp.Problem(LINEAR, [replace(experiment, guess={"y": np.zeros(experiment.samples)})], priors=PRIORS)


def test_error_for_a_recording_asks_to_fold_it():
    recording = bp.Recording.from_arrays(np.arange(9.0), {"force": np.sin(np.arange(9.0))})
    with pytest.raises(ValueError, match=r"experiments: must be .*got the recording 'recording'. Fold it, see fold"):
        bp.Problem(LINEAR, [recording], priors=PRIORS)


def test_fewer_independent_values_than_free_parameters_are_refused():
    few = linear_experiment(TRUTH, 3.0, seed=4, independent=3)
    with pytest.raises(
        ValueError, match=r"unknown 'variance\[force\]' .* for 3 free parameters \(k, c, coulomb\), got only 3"
    ):
        bp.Problem(LINEAR, [few], priors=PRIORS)
    bp.Problem(LINEAR, [few], priors=PRIORS, fixed={"variance[force]": 9.0})


JOINT = bp.MultivariateNormal([30.0, 800.0], [[16.0, 60.0], [60.0, 900.0]])
TRUNCATED = bp.TruncatedNormal(20.0, 10.0, 0.0, np.inf)


def test_a_joint_prior_goes_by_the_names_of_its_key(experiment):
    """The covariance follows the order of the key, the problem that of the model."""
    problem = bp.Problem(LINEAR, [experiment], priors={"coulomb": TRUNCATED, ("c", "k"): JOINT})
    assert problem.names == ("k", "c", "coulomb")
    assert problem.priors == {("c", "k"): JOINT, "coulomb": TRUNCATED}
    assert list(problem.priors) == [("c", "k"), "coulomb"]
    assert problem.median() == pytest.approx([800.0, 30.0, float(TRUNCATED.quantile(0.5))])
    theta = np.array([[850.0, 37.0, 22.0], [760.0, 33.0, 11.0]])
    expected = JOINT.log_prob(theta[:, [1, 0]]) + TRUNCATED.log_prob(theta[:, 2])
    assert problem.log_prior(theta) == pytest.approx(expected, rel=1e-12)
    assert problem.log_prior({"k": 850.0, "c": 37.0, "coulomb": 22.0}) == pytest.approx(expected[0], rel=1e-12)


def test_samples_of_a_joint_prior_are_correlated(experiment):
    """Correlation of 5000 draws within 4 standard errors, false-alarm rate 0.006 %."""
    draws = bp.Problem(LINEAR, [experiment], priors={"coulomb": TRUNCATED, ("c", "k"): JOINT}).sample_prior(5000, 3)
    assert list(draws) == ["k", "c", "coulomb"]
    assert abs(np.corrcoef(draws["c"], draws["k"])[0, 1] - 0.5) < 4 * 0.75 / np.sqrt(5000)
    assert draws["k"].mean() == pytest.approx(800.0, abs=4 * 30.0 / np.sqrt(5000))
    assert draws["coulomb"].min() > 0.0


def test_only_parameters_on_the_positive_half_line_are_sampled_in_their_logarithm(experiment):
    priors = {"coulomb": TRUNCATED, ("c", "k"): JOINT}
    problem = bp.Problem(LINEAR, [experiment], priors=priors)
    assert problem.logarithmic.tolist() == [False, False, True]
    priors = {"coulomb": bp.LogUniform(1.0, 50.0), "c": stats.gamma(3.0, scale=10.0), "k": bp.InverseGamma(3.0, 1e3)}
    problem = bp.Problem(LINEAR, [experiment], priors=priors)
    assert problem.logarithmic.tolist() == [True, True, False]


def test_a_frozen_scipy_distribution_is_a_prior(experiment):
    """The values equal those of the package's own normal distribution."""
    given = bp.Problem(LINEAR, [experiment], priors=PRIORS | {"k": stats.norm(800.0, 60.0)})
    own = bp.Problem(LINEAR, [experiment], priors=PRIORS)
    theta = np.array([870.0, 37.0, 22.0])
    assert given.log_prior(theta) == pytest.approx(own.log_prior(theta), rel=1e-13)
    assert given.median() == pytest.approx(own.median())
    assert repr(given.priors["k"]) == "scipy.stats.norm(800.0, 60.0)"


def test_fingerprint_distinguishes_priors_but_not_their_order(experiment):
    def mark(**changes):
        priors = {("c", "k"): JOINT, "coulomb": stats.gamma(3.0, scale=10.0)} | changes.pop("priors", {})
        return fingerprint(bp.Problem(LINEAR, [experiment], priors=priors, **changes))

    assert mark() == mark()
    assert mark() == mark(priors={"coulomb": stats.gamma(3.0, scale=10.0)})
    assert mark() != mark(priors={"coulomb": stats.gamma(3.0, scale=10.001)})
    assert mark() != mark(priors={("c", "k"): bp.MultivariateNormal(JOINT.mean, JOINT.covariance + np.eye(2) * 1e-9)})
    ordered = bp.Problem(LINEAR, [experiment], priors={"coulomb": stats.gamma(3.0, scale=10.0), ("c", "k"): JOINT})
    assert mark() == fingerprint(ordered)


@pytest.mark.parametrize(
    ("priors", "fixed", "message"),
    [
        ({("k", "c"): bp.Normal(0, 1)}, {}, r"priors\[\('k', 'c'\)\]: must be MultivariateNormal.*got Normal\(.*\)"),
        ({("k", "c"): stats.norm(0, 1)}, {}, r"priors\[\('k', 'c'\)\]: must be .*got scipy.stats.norm\(0, 1\)"),
        ({("k",): JOINT}, {"c": 1.0}, r"priors\[\('k',\)\]: must be a MultivariateNormal of 1 parameters.*got 2"),
        ({"k": JOINT}, {"c": 1.0}, r"priors\['k'\]: .*got MultivariateNormal.* Give a tuple of names"),
        ({"k": PRIORS["k"], ("k", "c"): JOINT}, {}, r"priors: 'k' is in two keys, 'k' and \('k', 'c'\); give every"),
        ({("k", "k"): JOINT}, {"c": 1.0}, r"priors: 'k' is in two keys, twice in \('k', 'k'\)"),
        ({("k", "cc"): JOINT}, {"c": 1.0}, "priors: must be one of 'k', 'c', 'coulomb', .*got 'cc'.*Did you mean 'c'"),
        ({("k", "c"): JOINT, (): JOINT}, {}, r"priors: key must be a tuple of names.*got \(\)"),
        ({("k", "c"): JOINT}, {"c": 1.0}, "fixed: 'c' has a prior too; give a prior or a value"),
        ({("k", "c"): JOINT, 3: JOINT}, {}, "priors: must be .*got 3"),
        ({"k": 800.0, "c": PRIORS["c"]}, {}, r"priors\['k'\]: must be a prior such as Normal.*got 800.0"),
        ({"k": stats.poisson(3), "c": PRIORS["c"]}, {}, r"priors\['k'\]: must be continuous, got .*poisson\(3\)"),
    ],
)
def test_error_names_the_prior_that_does_not_fit(experiment, priors, fixed, message):
    with pytest.raises(ValueError, match=message):
        bp.Problem(LINEAR, [experiment], priors={"coulomb": PRIORS["coulomb"]} | priors, fixed=fixed)


def test_priors_must_be_a_mapping(experiment):
    with pytest.raises(ValueError, match=r"priors: must be a mapping, such as .*, got \['k'\]"):
        bp.Problem(LINEAR, [experiment], priors=["k"])


def closed_form(experiments, covariance):
    """Return mean and covariance of the posterior with a joint normal prior and the noise variance 9."""
    design = np.tile(linear_regressors(0.05, 2.0, grid(40)), (len(experiments), 1))
    return normal_posterior(design, np.concatenate([e.outputs["force"] for e in experiments]), 9.0, MEAN, covariance)


NAMES = ("k", "c", "coulomb")
MEAN = np.array([800.0, 30.0, 20.0])
COVARIANCE = np.array([[3600.0, 600.0, -300.0], [600.0, 400.0, 20.0], [-300.0, 20.0, 100.0]])


def test_a_correlated_prior_gives_the_closed_form(experiment):
    problem = bp.Problem(
        LINEAR, [experiment], priors={NAMES: bp.MultivariateNormal(MEAN, COVARIANCE)}, fixed={"variance[force]": 9.0}
    )
    fit = bp.map_estimate(problem, progress=False)
    mean, covariance = closed_form([experiment], COVARIANCE)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-10)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-9)
    uncorrelated, _ = closed_form([experiment], np.diag(np.diag(COVARIANCE)))
    assert not np.allclose(mean, uncorrelated, rtol=1e-4)


def test_one_posterior_is_the_next_prior():
    """Two experiments in sequence, with another order of the names, give the same posterior as both together."""
    experiments = [replace(linear_experiment(TRUTH, 3.0, seed=s), name=f"run {s}") for s in (11, 12)]
    settings = {"fixed": {"variance[force]": 9.0}}
    prior = {NAMES: bp.MultivariateNormal(MEAN, COVARIANCE)}
    first = bp.map_estimate(bp.Problem(LINEAR, experiments[:1], priors=prior, **settings), progress=False)
    key = ("coulomb", "k", "c")
    between = bp.MultivariateNormal([first.theta[n] for n in key], first.covariance.loc[[*key], [*key]])
    second = bp.map_estimate(bp.Problem(LINEAR, experiments[1:], priors={key: between}, **settings), progress=False)
    together = bp.map_estimate(bp.Problem(LINEAR, experiments, priors=prior, **settings), progress=False)
    mean, covariance = closed_form(experiments, COVARIANCE)
    for fit in (second, together):
        assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-9)
        assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-8)


@pytest.mark.parametrize(
    "prior",
    [
        bp.StudentT(500.0, 10.0, 3.0),
        bp.TruncatedNormal(800.0, 60.0, 0.0, 1000.0),
        bp.HalfNormal(1000.0),
        bp.LogUniform(1.0, 1e5),
        bp.InverseGamma(3.0, 2000.0),
        stats.gamma(4.0, scale=200.0),
    ],
    ids=lambda prior: type(prior).__name__,
)
def test_every_prior_leads_to_the_mode_of_the_density(experiment, prior):
    """The gradient at the estimate vanishes and the covariance is the inverse of the curvature, in closed form."""
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS | {"k": prior}, fixed={"variance[force]": 9.0})
    fit = bp.map_estimate(problem, progress=False)
    assert fit.converged
    theta, design = np.array(list(fit.theta.values())), linear_regressors(0.05, 2.0, grid(40))
    gradient = design.T @ (experiment.outputs["force"] - design @ theta) / 9.0 + problem.joint_prior.gradient(theta)
    curvature = design.T @ design / 9.0 + problem.joint_prior.curvature(theta)
    assert np.all(np.abs(gradient) * np.array(list(fit.sd.values())) < 1e-6)
    assert fit.covariance.to_numpy() @ curvature == pytest.approx(np.eye(3), abs=1e-9)


@pytest.mark.parametrize("start", [1500.0, 850.0, 300.0])
def test_estimate_converges_where_the_log_prior_is_convex(start):
    """Far from its centre a Student's t prior is log-convex, more than the likelihood is concave."""
    weak = linear_experiment(TRUTH, 100.0, seed=1)
    priors = {"k": bp.StudentT(500.0, 10.0, 3.0)}
    problem = bp.Problem(LINEAR, [weak], priors=priors, fixed={"c": 40.0, "coulomb": 25.0, "variance[force]": 1e4})
    assert problem.joint_prior.curvature(np.array([start])) < 0.0
    fit = bp.map_estimate(problem, start={"k": start}, progress=False)
    assert fit.converged
    grid_of_k = np.linspace(1.0, 2000.0, 4001)[:, None]
    best = grid_of_k[np.argmax(problem.log_posterior(grid_of_k, np.full((4001, 1), 1e4)))]
    assert fit.theta["k"] == pytest.approx(float(best[0]), abs=0.5)


def test_error_names_the_parameter_whose_start_is_outside_the_support(experiment):
    problem = bp.Problem(LINEAR, [experiment], priors={("c", "k"): JOINT, "coulomb": TRUNCATED})
    with pytest.raises(ValueError, match=r"start: must be inside the prior's support \(0, inf\), got coulomb = -1"):
        bp.map_estimate(problem, start={"k": 800.0, "c": 30.0, "coulomb": -1.0})
    with pytest.raises(ValueError, match=r"start: must be inside the prior's support .*, got c = 30, k = inf"):
        bp.map_estimate(problem, start={"k": np.inf, "c": 30.0, "coulomb": 1.0})


def test_an_experiment_that_is_not_in_a_list_is_refused():
    experiment = linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)
    with pytest.raises(
        ValueError, match=r"experiments: must be a sequence, got '.*'. Give a list of one, \[experiment\]"
    ):
        bp.Problem(LINEAR, experiment, priors={"k": bp.Normal(900.0, 1e5)}, fixed={"c": 40.0, "coulomb": 25.0})


def test_a_problem_of_a_saved_experiment_is_the_same(tmp_path):
    """A checkpoint can therefore be resumed with an experiment that was loaded."""
    time = np.arange(400) / 40
    run = bp.Recording.from_arrays(time, {"displacement": np.sin(6 * time)}, {"force": np.cos(6 * time)}).fold(32)
    run.save(tmp_path / "run.h5")
    problems = [
        bp.Problem(bp.models.duffing, [e], priors={"c": bp.LogNormal(0.2, 0.5)}, fixed={"m": 1, "k": 1, "k3": 0.5})
        for e in (run, bp.load(tmp_path / "run.h5"))
    ]
    assert fingerprint(problems[0]) == fingerprint(problems[1])
