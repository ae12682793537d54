import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import LINEAR, grid, linear_experiment, linear_regressors

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


def test_outside_the_prior_nothing_is_solved(problem):
    assert problem.log_posterior(np.array([870.0, 37.0, 60.0]), np.array([8.0])) == -np.inf


def test_value_does_not_depend_on_what_was_evaluated_before(problem):
    point, elsewhere = np.array([870.0, 37.0, 22.0]), np.array([300.0, 90.0, 45.0])
    before = problem.log_posterior(point, np.array([8.0]))
    problem.log_posterior(elsewhere, np.array([8.0]))
    assert problem.log_posterior(point, np.array([8.0])) == before


def test_projection_removes_what_the_fold_did_not_keep():
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
    assert problem.moments(TRUTH)[0] == pytest.approx(0.0, abs=1e-15)
    assert np.sum((clean - kept) ** 2) > 1.0


def test_prior_samples_have_the_names(problem):
    draws = problem.sample_prior(1000, seed=3)
    assert list(draws) == ["k", "c", "coulomb"]
    assert np.median(draws["c"]) == pytest.approx(30.0, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"priors": {"k": PRIORS["k"], "c": PRIORS["c"]}},
            "'coulomb' has neither a prior nor a value; a free parameter needs a prior",
        ),
        ({"priors": PRIORS | {"coulom": PRIORS["k"]}}, "priors: 'coulom' is not known.*Did you mean 'coulomb'"),
        ({"fixed": {"k": 1.0}}, "fixed: 'k' has a prior too"),
        ({"fixed": {"variance[forc]": 1.0}}, r"fixed: 'variance\[forc\]' is not known"),
        ({"fixed": {"variance[force]": 0.0}}, r"fixed\['variance\[force\]'\]: 0.0 is not allowed"),
        ({"experiments": []}, "at least one experiment"),
    ],
)
def test_bad_problems_are_refused_by_name(experiment, changes, message):
    with pytest.raises(ValueError, match=message):
        bp.Problem(LINEAR, **({"experiments": [experiment], "priors": PRIORS} | changes))


def test_experiments_must_fit_the_model(experiment):
    tau = grid(40)
    with pytest.raises(ValueError, match="inputs of experiment 'run': 'y' is not known; allowed: 'x'"):
        bp.Problem(LINEAR, [bp.Experiment("run", 2.0, {"force": tau}, {"y": tau}, samples=40)], priors=PRIORS)
    with pytest.raises(ValueError, match="outputs of experiment 'run': 'torque' is not known; allowed: 'force'"):
        bp.Problem(LINEAR, [bp.Experiment("run", 2.0, {"torque": tau}, {"x": tau}, samples=40)], priors=PRIORS)
    with pytest.raises(ValueError, match="the names .* must differ"):
        bp.Problem(LINEAR, [experiment, experiment], priors=PRIORS)


def test_fewer_independent_values_than_free_parameters_are_refused():
    few = linear_experiment(TRUTH, 3.0, seed=4, independent=3)
    with pytest.raises(
        ValueError, match=r"3 free parameters \(k, c, coulomb\) are not allowed; the channel 'force' has only 3"
    ):
        bp.Problem(LINEAR, [few], priors=PRIORS)
    bp.Problem(LINEAR, [few], priors=PRIORS, fixed={"variance[force]": 9.0})
