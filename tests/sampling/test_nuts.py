"""NUTS samples the same density as emcee, by its gradient."""

import importlib.util
import os
import signal
import sys
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.sampling import convergence, nuts
from studies.damper import run as damper
from tests.known import EIGHTH_ORDER, LINEAR, RUNAWAY, grid, linear_experiment, linear_regressors
from tests.problems import CASES

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
NUTS = {"sampler": "nuts", "progress": False}
needs_nutpie = pytest.mark.skipif(importlib.util.find_spec("nutpie") is None, reason="nutpie is not installed")


@pytest.fixture(scope="module")
def linear():
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS)
    return problem, bp.map_estimate(problem, progress=False)


@pytest.fixture
def briefly(monkeypatch):
    """Let two chains tune themselves over a few draws."""
    monkeypatch.setattr(nuts, "TUNE", 100)
    return NUTS | {"ensembles": 2, "max_steps": 250}


@pytest.fixture(scope="module")
def edge():
    """Return a problem whose solutions end in a fold amid the posterior: x' = a(1 + x²) − 1 needs a < 1."""
    tau, generator = grid(60), np.random.default_rng(2)
    force = -1.0 + 0.1 * np.cos(2 * np.pi * tau)
    truth = bp.solve_periodic(RUNAWAY, {"a": 0.9}, {"u": force}, frequency=0.5, samples=60, guess={"x": 0 * tau - 0.3})
    outputs = {"x": truth.outputs["x"] + 0.3 * generator.standard_normal(60)}
    run = bp.Experiment("run", 0.5, outputs, {"u": force}, samples=60, guess=truth.states)
    problem = bp.Problem(RUNAWAY, [run], priors={"a": bp.LogNormal(0.9, 0.3)}, fixed={"variance[x]": 1.0})
    return problem, bp.map_estimate(problem, progress=False)


def by_ensemble(posterior: bp.Posterior, name: str) -> np.ndarray:
    """Return the draws (ensembles, steps, walkers) of what has this name."""
    return posterior.by_step(posterior.draws(name))


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of values (ensembles, steps, walkers) and its Monte Carlo error."""
    tau = float(convergence.autocorrelation_time(values[..., None])[0])
    return float(values.mean()), float(values.std() * np.sqrt(tau / values.size))


def sd_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the standard deviation and its Monte Carlo error."""
    variance, error = mean_and_error((values - values.mean()) ** 2)
    return np.sqrt(variance), 0.5 * error / np.sqrt(variance)


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("coordinates", ["ridge", "natural"])
@pytest.mark.parametrize("case", CASES)
def test_gradient_equals_differences_of_the_sampling_density(case, coordinates):
    problem, theta = CASES[case]()
    noise = problem.likelihood.guess()
    noise[[name.startswith("variance") for name in problem.noise_names]] = 0.01
    density = problem.anchored(np.array(theta)).density(coordinates=coordinates)
    point = density.from_natural(np.array(theta), noise)
    value, gradient, _ = density.value_and_gradient(point)
    assert value == pytest.approx(density.evaluate(point[None]).log_prob[0], rel=1e-12)
    steps = np.append(np.full(len(theta), 1e-3) * np.where(density.logarithmic, 1.0, np.abs(theta)), 1e-2 * noise**0)
    numerical = np.zeros(density.dimension)
    for i, step in enumerate(steps[: density.dimension]):
        for k, weight in EIGHTH_ORDER.items():
            moved = point + k * step * np.eye(density.dimension)[i] * np.array([[1.0], [-1.0]])
            numerical[i] += weight * -np.diff(density.evaluate(moved).log_prob)[0] / step
    scale = np.abs(numerical) + 1e-3 * np.abs(numerical).max()
    assert (gradient - numerical) / scale == pytest.approx(np.zeros_like(gradient), abs=1e-7)


def test_value_and_gradient_outside_the_support_are_minus_infinity_and_zero(edge):
    problem, fit = edge
    anchored = problem.anchored(problem.vector(fit.theta))
    value, _, status = anchored.density().value_and_gradient(np.log([1.5]))
    assert value == -np.inf and status != CONVERGED
    value, gradient, status = anchored.density(coordinates="natural").value_and_gradient(np.array([-1.0]))
    assert value == -np.inf and gradient == 0.0 and status == CONVERGED


@needs_nutpie
def test_nuts_matches_the_closed_form_within_monte_carlo_error(monkeypatch):
    """Mean, variance and three quantiles of three parameters within 4 Monte Carlo errors: false alarms below 0.1 %."""
    for name, looser in {"TAU_CHANGE": 0.2, "QUANTILE_SPREAD": 0.5, "RHAT": 1.02}.items():
        monkeypatch.setattr(convergence, name, looser)
    priors = PRIORS | {"c": bp.Normal(30.0, 20.0)}
    experiment = linear_experiment(TRUTH, 3.0, seed=1)
    problem = bp.Problem(LINEAR, [experiment], priors=priors, fixed={"variance[force]": 9.0})
    posterior = bp.sample(problem, bp.map_estimate(problem, progress=False), seed=1, ensembles=2, **NUTS)
    design = linear_regressors(0.05, 2.0, grid(40))
    precision = np.diag([60.0**-2, 20.0**-2, 10.0**-2])
    covariance = np.linalg.inv(design.T @ design / 9.0 + precision)
    means = covariance @ (design.T @ experiment.outputs["force"] / 9.0 + precision @ [800.0, 30.0, 20.0])
    assert posterior.converged and posterior.reason.endswith("draws of 2 chains")
    assert min(posterior.ess.values()) > 4 * convergence.LENGTHS_ALONE
    assert posterior.failures == {}
    for name, mean, sd in zip(problem.names, means, np.sqrt(np.diag(covariance)), strict=True):
        unit = (by_ensemble(posterior, name) - mean) / sd
        facts = [(unit, 0.0), (unit**2, 1.0)] + [(unit < stats.norm.ppf(p), p) for p in (0.05, 0.5, 0.95)]
        for values, expected in facts:
            found, error = mean_and_error(values.astype(float))
            assert abs(found - expected) < 4 * error


@pytest.mark.slow
@needs_nutpie
@pytest.mark.filterwarnings("ignore:The noise of the measured inputs", "ignore:Twice as many points")
def test_nuts_and_emcee_agree_on_the_damper():
    """Mean and sd of all six within 4 Monte Carlo errors of the difference: false alarms below 0.1 %."""
    recording, _ = damper.read_recording(None, 1)
    problem = bp.Problem(bp.models.dahl, [recording.fold(200)], priors=damper.PRIORS)
    fit = bp.map_estimate(problem, progress=False)
    emcee = bp.sample(problem, fit, seed=1, progress=False)
    other = bp.sample(problem, fit, seed=2, max_steps=750, **NUTS)
    assert emcee.converged and list(emcee.ess) == list(other.ess)
    for name in emcee.names:
        one, two = by_ensemble(emcee, name), by_ensemble(other, name)
        for statistic in (mean_and_error, sd_and_error):
            (a, error_a), (b, error_b) = statistic(one), statistic(two)
            assert abs(a - b) < 4 * np.hypot(error_a, error_b)
            assert np.hypot(error_a, error_b) < 0.05 * one.std()


@pytest.mark.slow
@needs_nutpie
def test_same_seed_gives_identical_draws_and_another_seed_others(linear, briefly):
    first, again, other = (bp.sample(*linear, seed=s, **briefly) for s in (5, 5, 6))
    for name in first.names:
        assert np.array_equal(first.draws(name), again.draws(name))
        assert not np.array_equal(first.draws(name), other.draws(name))
    assert first.log_posterior_calls == again.log_posterior_calls
    assert first.reason == again.reason


@needs_nutpie
def test_fewer_draws_than_a_block_are_kept_and_not_converged(linear, briefly):
    posterior = bp.sample(*linear, seed=1, **(briefly | {"max_steps": 60}))
    assert not posterior.converged and posterior.draws("k").size == 2 * 60
    assert "max_steps = 60 reached with" in posterior.reason


@needs_nutpie
def test_too_few_draws_are_not_converged_and_nuts_statistics_are_kept(linear, briefly, tmp_path):
    problem, fit = linear
    posterior = bp.sample(problem, fit, seed=1, start="overdispersed", **briefly)
    assert not posterior.converged
    assert "max_steps = 250 reached with" in posterior.reason
    posterior.save(tmp_path / "draws")
    known = bp.load(tmp_path / "draws").tree
    assert known.attrs["nutpie"]
    group = known["sample_stats"]
    assert dict(group.sizes) == {"chain": 2, "draw": 250}
    assert {"lp", "status", "diverging", "energy", "tree_depth", "n_steps", "step_size", "acceptance_rate"} == set(
        group.data_vars
    )
    assert group["diverging"].dtype == bool
    assert posterior.acceptance == pytest.approx(float(group["acceptance_rate"].mean()))
    assert 0.6 < posterior.acceptance < 0.97
    assert posterior.log_posterior_calls > int(group["n_steps"].sum())
    last = [posterior.draws(name)[-1] for name in posterior.names]
    log_density = float(problem.log_posterior(last[:3], last[3:])) + np.log(last[1])
    assert float(group["lp"][-1, -1]) == pytest.approx(log_density, abs=1e-8)


def test_single_nuts_chain_needs_as_many_draws_as_an_ensemble():
    draws = np.random.default_rng(3).standard_normal((4, 400, 8, 1))
    nearly = convergence.unmet_criteria(draws[:, :, :1], np.ones(1), np.ones(1), ("k",))
    assert nearly[0] == "length only 400 tau"
    assert convergence.unmet_criteria(draws, np.ones(1), np.ones(1), ("k",)) == []


@needs_nutpie
def test_failed_solves_and_trajectories_that_end_in_them_are_counted(edge, briefly):
    with pytest.warns(UserWarning, match=r"\d+ of 500 trajectories diverged: .* compare them with") as caught:
        posterior = bp.sample(*edge, seed=1, **briefly)
    assert caught[0].filename == __file__
    diverged = int(posterior.data["sample_stats"]["diverging"].sum())
    assert diverged > 0
    assert posterior.reason.endswith(f", {diverged} of 500 trajectories diverged")
    failed = sum(posterior.failures.values()) * posterior.log_posterior_calls
    assert failed == pytest.approx(round(failed)) and failed >= diverged
    assert posterior.draws("a").max() < 1.1


@needs_nutpie
def test_interrupted_run_returns_its_draws(linear, briefly, monkeypatch):
    monkeypatch.setattr(nuts, "DRAWS_BETWEEN_CHECKS", 50)
    monkeypatch.setattr(nuts, "stop_rule", interrupting_at(50))
    posterior = bp.sample(*linear, seed=1, **(briefly | {"max_steps": 5000}))
    assert not posterior.converged
    assert posterior.reason == f"interrupted after {posterior.data['posterior'].sizes['draw']} draws"
    assert posterior.data["posterior"].sizes["draw"] >= 50


def interrupting_at(draws: int) -> Callable[..., tuple]:
    def check(kept: np.ndarray, *_: np.ndarray) -> tuple:
        if kept.shape[1] == draws:
            raise KeyboardInterrupt
        return np.empty(0), ["nothing"]

    return check


@needs_nutpie
def test_terminated_run_returns_no_draws(linear, briefly, monkeypatch):
    """The process ends by the signal; here it has no effect, and the exception is seen."""

    def terminate(kept: np.ndarray, *_: np.ndarray) -> tuple:
        os.kill(os.getpid(), signal.SIGTERM)
        return np.empty(0), ["nothing"]

    monkeypatch.setattr(nuts, "DRAWS_BETWEEN_CHECKS", 50)
    monkeypatch.setattr(nuts, "stop_rule", terminate)
    ends = []
    monkeypatch.setattr(signal, "raise_signal", ends.append)
    with pytest.raises(KeyboardInterrupt):
        bp.sample(*linear, seed=1, **(briefly | {"max_steps": 5000}))
    assert ends == [signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@needs_nutpie
def test_exception_in_the_density_stops_all_chains(linear, monkeypatch):
    def broken(self: LogPosterior, point: np.ndarray) -> tuple[float, np.ndarray]:
        raise ZeroDivisionError("in a thread")

    monkeypatch.setattr(LogPosterior, "value_and_gradient", broken)
    with pytest.raises(ZeroDivisionError, match="in a thread"):
        bp.sample(*linear, seed=1, **NUTS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sampler": "hmc"}, "sampler: must be one of 'emcee', 'nuts', got 'hmc'"),
        ({"walkers": 32}, "walkers: must be None with sampler='nuts', got 32; a chain has no walkers"),
        ({"variances": "collapsed"}, "variances: must be 'sampled' with sampler='nuts', got 'collapsed'"),
        ({"checkpoint": "run.h5"}, "checkpoint: must be None with sampler='nuts', got 'run.h5'; its chains cannot be"),
        ({"executor": 2}, "executor: must be None with sampler='nuts', got 2; its chains run in threads"),
        ({"ensembles": 1}, "ensembles: must be .*got 1"),
        ({"max_steps": 10}, "max_steps: must be .*got 10"),
    ],
)
def test_error_names_the_option_that_nuts_does_not_support(linear, arguments, message):
    with pytest.raises(ValueError, match=message):
        bp.sample(*linear, **({"seed": 1} | NUTS | arguments))


def test_error_without_nutpie_names_the_extra_to_install(linear, monkeypatch):
    monkeypatch.setitem(sys.modules, "nutpie", None)
    with pytest.raises(ImportError, match=r'sampler: \'nuts\' needs .* pip install "bayesperiodic\[nuts\]"'):
        bp.sample(*linear, seed=1, **NUTS)
