from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.likelihood import observation
from bayesperiodic.periodic import batch
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling import sample as sample_module
from tests.known import LINEAR, grid, linear_experiment, linear_regressors, normal_posterior

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
QUIET = {"progress": False}
PAIR = QUIET | {"ensembles": 2}
# Tuned proposals from step 100 on.
SHORT = PAIR | {"walkers": 8, "max_steps": 150}


@pytest.fixture(scope="module")
def known_variance():
    experiment = linear_experiment(TRUTH, 3.0, seed=1)
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS, fixed={"variance[force]": 9.0})
    return problem, bp.map_estimate(problem)


@pytest.fixture(scope="module")
def posterior(known_variance):
    return bp.sample(*known_variance, seed=1, **QUIET)


def test_emcee_matches_the_closed_form_within_monte_carlo_error(known_variance, posterior):
    """Means, sds and covariances within 4 Monte Carlo errors: false-alarm rate below 0.1 % over the nine figures."""
    problem, _ = known_variance
    design = linear_regressors(0.05, 2.0, grid(40))
    values, prior = problem.experiments[0].outputs["force"], np.diag([60.0, 20.0, 10.0]) ** 2
    mean, covariance = normal_posterior(design, values, 9.0, [800.0, 30.0, 20.0], prior)
    sd = np.sqrt(np.diag(covariance))
    assert posterior.converged
    draws = np.stack([posterior.draws(name) for name in problem.names], axis=-1)
    error = 4 / np.sqrt(min(posterior.ess.values()))
    assert (draws.mean(axis=0) - mean) / sd == pytest.approx(np.zeros(3), abs=error)
    assert np.cov(draws.T) / np.outer(sd, sd) == pytest.approx(covariance / np.outer(sd, sd), abs=np.sqrt(2) * error)


@pytest.mark.parametrize(
    ("variances", "prior", "lost"), [("sampled", "jeffreys", 0), ("collapsed", "jeffreys", 0), ("collapsed", "flat", 2)]
)
def test_unknown_variance_follows_its_closed_form(variances, prior, lost):
    """Flat priors on θ and 1/v (or flat) on v: M/v is χ² with n − l (− 2) degrees of freedom and θ is Student's t."""
    flat = {"k": bp.Normal(900.0, 1e6), "coulomb": bp.Normal(25.0, 1e6)}
    noise = bp.noise.Independent(prior=prior)
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=2)], priors=flat, fixed={"c": 40.0}, noise=noise)
    fit = bp.map_estimate(problem)
    posterior = bp.sample(problem, fit, seed=2, variances=variances, **PAIR)
    moment, degrees = fit.rms["force"] ** 2 * 40, 38 - lost
    assert list(posterior.ess) == ["k", "coulomb", "variance[force]"]
    error = 4 / np.sqrt(min(posterior.ess.values()))
    variance = posterior.draws("variance[force]")
    expected = moment / (degrees - 2)
    assert variance.mean() == pytest.approx(expected, rel=error * np.sqrt(2 / (degrees - 4)))
    assert variance.var() == pytest.approx(2 * expected**2 / (degrees - 4), rel=2.5 * error)
    student = np.sqrt(moment * np.linalg.inv(regressors().T @ regressors())[1, 1] / (degrees - 2))
    assert posterior.draws("coulomb").std() == pytest.approx(student, rel=error)
    values = [
        float(problem.log_posterior(posterior_point(posterior, problem, i), {"force": variance[i]})) for i in (0, 7)
    ]
    lp = posterior.data["sample_stats"]["lp"].transpose("chain", "draw").to_numpy().ravel()[[0, 7]]
    assert values[0] - values[1] == pytest.approx(lp[0] - lp[1], abs=1e-8)


@pytest.mark.parametrize("prior", ["jeffreys", "flat"])
@pytest.mark.parametrize("two", [False, True])
def test_collapsed_density_of_errors_with_a_known_spectrum_is_the_integral_over_the_variance(prior, two):
    """By quadrature over ln v, of one experiment and of two that share the variance."""
    runs = [linear_experiment(TRUTH, 3.0, seed=2)] + [
        replace(linear_experiment(TRUTH, 3.0, seed=3), name="other")
    ] * two
    shape = {"lengthscale[force]": 0.05, "floor[force]": 0.1}
    noise = bp.noise.Circulant(prior=prior)
    problem = bp.Problem(LINEAR, runs, priors=PRIORS, fixed=shape, noise=noise)
    problem = problem.anchored(TRUTH)
    whole, collapsed = (problem.density(variances=v) for v in ("sampled", "collapsed"))
    assert collapsed.labels == problem.names and collapsed.collapsed == ("variance[force]",)
    points = TRUTH * (1.0 + 0.02 * np.random.default_rng(1).standard_normal((4, 3)))
    found = collapsed.evaluate(points).log_prob
    logarithms = np.linspace(-6.0, 16.0, 4001)
    for point, value in zip(points, found, strict=True):
        every = whole.evaluate(np.column_stack([np.tile(point, (logarithms.size, 1)), logarithms])).log_prob
        integral = np.log(np.trapezoid(np.exp(every - every.max()), logarithms)) + every.max()
        assert value == pytest.approx(integral, abs=1e-8)


def test_variances_of_a_spectrum_of_unknown_shape_cannot_be_collapsed():
    noise = bp.noise.Circulant()
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=2)], priors=PRIORS, noise=noise)
    with pytest.raises(ValueError, match="or of circulant ones with a fixed shape"):
        bp.sample(problem, bp.map_estimate(problem, starts=1, **QUIET), seed=1, variances="collapsed", **PAIR)


def regressors() -> np.ndarray:
    return linear_regressors(0.05, 2.0, grid(40))[:, [0, 2]]


def posterior_point(posterior: bp.Posterior, problem: bp.Problem, index: int) -> np.ndarray:
    return np.array([posterior.draws(name)[index] for name in problem.names])


@pytest.mark.parametrize("start", ["prior", "overdispersed"])
def test_posterior_does_not_depend_on_the_start(known_variance, posterior, start):
    """Means within 4 Monte Carlo errors of both runs."""
    other = bp.sample(*known_variance, seed=3, start=start, **PAIR)
    assert other.converged
    for name in ("k", "c", "coulomb"):
        error = 4 * np.sqrt(1 / posterior.ess[name] + 1 / other.ess[name])
        assert abs(other.draws(name).mean() - posterior.draws(name).mean()) < error * posterior.draws(name).std()


def test_positive_parameter_sampled_in_its_logarithm_keeps_its_natural_density():
    """With almost no data the draws follow the prior."""
    priors = PRIORS | {"c": bp.LogNormal(30.0, 0.5)}
    experiment = linear_experiment(TRUTH, 3.0, seed=3)
    problem = bp.Problem(LINEAR, [experiment], priors=priors, fixed={"variance[force]": 1e12})
    posterior = bp.sample(problem, bp.map_estimate(problem), seed=3, **PAIR)
    logarithm = np.log(posterior.draws("c") / 30.0) / 0.5
    error = 4 / np.sqrt(posterior.ess["c"])
    assert logarithm.mean() == pytest.approx(0.0, abs=error)
    assert logarithm.std() == pytest.approx(1.0, abs=error)


def test_same_seed_gives_identical_draws_and_another_seed_others(known_variance):
    first, again, other = (bp.sample(*known_variance, seed=s, **SHORT) for s in (5, 5, 6))
    assert np.array_equal(first.draws("k"), again.draws("k"))
    assert not np.array_equal(first.draws("k"), other.draws("k"))


def test_draws_do_not_depend_on_the_number_of_cores(known_variance, monkeypatch):
    two = bp.sample(*known_variance, seed=5, **SHORT)
    for module in (observation, batch):
        monkeypatch.setattr(module, "available_cores", lambda: 1)
    assert np.array_equal(two.draws("k"), bp.sample(*known_variance, seed=5, **SHORT).draws("k"))


def test_reaching_max_steps_is_reported(known_variance):
    posterior = bp.sample(*known_variance, seed=1, **SHORT)
    assert not posterior.converged
    assert posterior.reason.startswith("max_steps = 150 reached with ")
    assert "NOT CONVERGED" in repr(posterior)


def test_resumed_run_gives_the_same_chain(known_variance, tmp_path):
    whole = bp.sample(*known_variance, seed=5, **(SHORT | {"max_steps": 250}))
    bp.sample(*known_variance, seed=5, checkpoint=tmp_path / "run.h5", **SHORT)
    resumed = bp.sample(*known_variance, seed=5, checkpoint=tmp_path / "run.h5", **(SHORT | {"max_steps": 250}))
    assert np.array_equal(whole.draws("k"), resumed.draws("k"))


def test_finished_run_comes_back_from_its_checkpoint(known_variance, tmp_path, monkeypatch):
    monkeypatch.setattr(convergence, "LENGTHS", 5.0)
    monkeypatch.setattr(convergence, "TAU_CHANGE", 1.0)
    monkeypatch.setattr(convergence, "RHAT", 1.1)
    first = bp.sample(*known_variance, seed=5, checkpoint=tmp_path / "run.h5", **PAIR)
    again = bp.sample(*known_variance, seed=5, checkpoint=tmp_path / "run.h5", **PAIR)
    assert first.converged and again.reason == first.reason
    assert np.array_equal(first.draws("k"), again.draws("k"))


def test_checkpoint_of_another_run_is_refused(known_variance, tmp_path):
    bp.sample(*known_variance, seed=5, checkpoint=tmp_path / "run.h5", **SHORT)
    with pytest.raises(ValueError, match="must be a file of this run"):
        bp.sample(*known_variance, seed=6, checkpoint=tmp_path / "run.h5", **SHORT)
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(ValueError, match="checkpoint: must be an intact file, got"):
        bp.sample(*known_variance, seed=6, checkpoint=tmp_path / "text.h5", **SHORT)


def test_draws_pass_into_arviz_and_carry_units(posterior):
    group = posterior.data["posterior"]
    assert group["k"].dims == ("chain", "draw")
    assert group["k"].attrs["units"] == "N/m"
    assert group["variance"].dims == ("chain", "draw", "channel")
    assert group["chain"].values.tolist() == [0, 1, 2, 3]


def test_rhat_exceeds_one_if_ensembles_disagree():
    generator = np.random.default_rng(4)
    agreeing = convergence.as_chains(generator.standard_normal((4, 100, 8)))
    assert convergence.rhat(agreeing) < 1.01
    assert convergence.rhat(agreeing + np.arange(4)[:, None]) > 1.3


def test_summary_names_its_interval(posterior):
    table = posterior.summary()
    assert list(table.columns) == ["mean", "sd", "q05", "q50", "q95", "mcse_mean", "ess", "tau", "rhat"]
    assert table.attrs["interval"] == "90 % equal-tailed: q05 to q95"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"walkers": 4},
            "walkers: must be even and at least twice the dimension, 6 for k, c, coulomb.*, got 4",
        ),
        ({"walkers": 9}, "walkers: must be even .*, got 9"),
        ({"ensembles": 1}, "ensembles: must be .*got 1"),
        ({"max_steps": 10}, "max_steps: must be .*got 10"),
        ({"seed": -1}, "seed: must be .*got -1"),
        ({"start": "laplac"}, "start: must be one of 'laplace', 'prior', 'overdispersed', got 'laplac'"),
        ({"coordinates": "log"}, "coordinates: must be one of 'ridge', 'natural', got 'log'"),
        (
            {"variances": "collapsed"},
            "variances: must be 'sampled' for this problem, got 'collapsed'; it needs an unknown variance",
        ),
    ],
)
def test_error_names_the_bad_argument(known_variance, arguments, message):
    with pytest.raises(ValueError, match=message):
        bp.sample(*known_variance, **({"seed": 1, "progress": False} | arguments))


def test_start_without_finite_log_posterior_raises(known_variance):
    problem, fit = known_variance
    other = bp.Problem(
        LINEAR, problem.experiments, priors=PRIORS | {"k": bp.Uniform(0.0, 1.0)}, fixed={"variance[force]": 9.0}
    )
    with pytest.raises(ValueError, match=r"100\.0% of .* start points have none; give a converged fit"):
        bp.sample(other, fit, seed=1, **PAIR)


def test_estimate_of_another_problem_is_rejected(known_variance):
    problem, fit = known_variance
    others = [replace(e, name="other") for e in problem.experiments]
    other = bp.Problem(LINEAR, others, priors=PRIORS, fixed={"variance[force]": 9.0})
    with pytest.raises(ValueError, match="fit: must have 'other', got only .*; give the estimate of this problem"):
        bp.sample(other, fit, seed=1, **PAIR)
    with pytest.raises(ValueError, match="fit: must have .*got no 'k'"):
        bp.sample(problem, replace(fit, theta={n: v for n, v in fit.theta.items() if n != "k"}), seed=1, **PAIR)


def test_error_without_a_laplace_approximation_names_the_alternative(known_variance):
    problem, fit = known_variance
    for known, step in (
        (
            {"checks": replace(fit.checks, undetermined=("k -> k·t, c -> c·t",))},
            r"fix what the data do not determine \(k -> k·t, c -> c·t\)",
        ),
        ({"search": replace(fit.search, at_ends=("k",))}, "widen the prior of 'k', which is at the end of its support"),
        ({}, "run map_estimate from another start"),
        ({"checks": None}, "run map_estimate from another start"),
    ):
        lost = replace(fit, joint=replace(fit.joint, covariance=fit.joint_covariance * np.nan), **known)
        with pytest.raises(ValueError, match=f"no Laplace approximation .*{step}, or take start='prior'"):
            bp.sample(problem, lost, seed=1, **PAIR)


@pytest.mark.parametrize(("slow", "burn_in"), [(None, 50), (10, 100), (13, 250)])
def test_burn_in_starts_again_if_slow_moves_are_expected_at_the_draws_kept(known_variance, monkeypatch, slow, burn_in):
    """Times expected of the mixture are stated: the checks at 100, 150, 200 and 250 steps are the 10th to the 13th."""
    asked = []

    def stated(*_):
        asked.append(1)
        return 10.0 if len(asked) == slow else 2.0

    monkeypatch.setattr(sample_module, "expected_time", stated)
    monkeypatch.setattr(sample_module, "PASSES", 100)
    posterior = bp.sample(*known_variance, seed=1, **(SHORT | {"max_steps": 350}))
    assert posterior.tree["proposal"].attrs["burn_in"] == burn_in
    assert posterior.by_step(posterior.draws("k")).shape[1] == 350 - max(burn_in, 350 // 5)


@pytest.mark.parametrize(("expected", "burn_in"), [(3.0, 50), (3.1, 175), (6.0, 300)])
def test_burn_in_ends_when_it_is_as_long_as_the_chain_that_follows(known_variance, monkeypatch, expected, burn_in):
    """The stop rule needs 50 autocorrelation times; a round has 25 steps."""
    monkeypatch.setattr(sample_module, "expected_time", lambda *_: expected)
    monkeypatch.setattr(sample_module, "PASSES", 100)
    posterior = bp.sample(*known_variance, seed=1, **(SHORT | {"max_steps": 350}))
    assert posterior.tree["proposal"].attrs["burn_in"] == burn_in


@pytest.mark.parametrize(("later", "burn_in"), [(11.9, 300), (12.1, 375)])
def test_burn_in_starts_again_at_twice_the_time_that_was_expected_at_its_end(
    known_variance, monkeypatch, later, burn_in
):
    """A time of 6 is expected until the burn-in ends at 300 steps, another one while it is over, and 6 again."""
    run, ends = sample_module._EnsembleRun, [0]
    adapted = run._adapt

    def adapt(self):
        adapted(self)
        ends.append(self.state["burnt"])

    monkeypatch.setattr(run, "_adapt", adapt)
    monkeypatch.setattr(sample_module, "expected_time", lambda *_: later if ends[-1] else 6.0)
    monkeypatch.setattr(sample_module, "PASSES", 100)
    posterior = bp.sample(*known_variance, seed=1, **(SHORT | {"max_steps": 400}))
    assert posterior.tree["proposal"].attrs["burn_in"] == burn_in
