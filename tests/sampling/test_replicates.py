"""Predictive replicates of the data, and the multipliers of the orbits."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.likelihood.observation import Response
from tests.known import LINEAR, grid, linear_experiment, linear_regressors
from tests.problems import CASES, pendulum_problem, pendulum_run, rotation

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(900.0, 60.0), "c": bp.Normal(40.0, 20.0), "coulomb": bp.Normal(25.0, 10.0)}


SHORT = {"seed": 1, "walkers": 8, "progress": False}


@pytest.fixture(scope="module")
def rotating():
    """Return the problem of an unstable rotation of the pendulum, and draws."""
    problem = pendulum_problem([pendulum_run()])
    return problem, bp.sample(problem, bp.map_estimate(problem, progress=False), max_steps=100, **SHORT)


@pytest.mark.parametrize("case", [name for name in CASES if name != "autonomous"])
def test_residual_of_a_replicate_equals_its_simulated_noise(case):
    """The residual components of a simulated experiment equal those of its noise, within the kept harmonics."""
    problem, theta = CASES[case]()
    values = problem.likelihood.complete(np.full((1, len(problem.free_noise)), 1e-4))
    components = problem.likelihood.simulate(values, np.random.default_rng(3))
    solved, left = problem.density().solver.solve(np.array([theta])), list(components)
    for e in problem.experiments:
        observation = problem.observations[e.name]
        own, left = left[: len(observation.blocks)], left[len(observation.blocks) :]
        outputs = observation.replicates(solved.response(e.name), own)
        kept = e.mask if e.mask is not None else slice(None)
        assert all(np.isfinite(y[0, kept]).all() for y in outputs.values())
        again = replace(e, outputs={channel: np.nan_to_num(y[0]) for channel, y in outputs.items()})
        response = Response(*(part[0] for part in solved.response(e.name)))
        sensors = problem.sensors.parameters(problem.parameter_maps[e.name].delayed)
        residuals = type(observation)(again, problem.model, sensors).residuals(response)
        for block, found, given in zip(observation.blocks, residuals, own, strict=True):
            if block.channel in e.outputs or block.channel == "scale":
                assert found == pytest.approx(given[0], abs=1e-9 * np.abs(given).max())


@pytest.mark.parametrize("case", ["circulant", "masked, correlated", "measured", "section and multiplier"])
def test_simulated_noise_has_the_covariance_of_the_likelihood(case):
    """Whitened, 4000 draws have mean 0 and variance 1 (over their weight), each within 5 standard errors."""
    problem, _ = CASES[case]()
    likelihood = problem.likelihood
    values = likelihood.guess()
    noise = likelihood.simulate(np.tile(values, (4000, 1)), np.random.default_rng(1))
    for block, white in zip(likelihood.blocks, likelihood.whitened(noise, values), strict=True):
        white = white / (np.sqrt(block.weight) if block.counted else 1.0)
        assert white.mean(axis=0) == pytest.approx(np.zeros(block.size), abs=5 / np.sqrt(4000))
        covariance = np.cov(white.T).reshape(block.size, block.size)
        assert covariance == pytest.approx(np.eye(block.size), abs=5 * np.sqrt(2 / 4000))


def test_replicates_scatter_about_the_draws_own_curves_by_their_own_variances():
    """100 draws of a linear model: the squared distance is χ² per sample, its mean within 4 standard errors."""
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS)
    posterior = bp.sample(problem, bp.map_estimate(problem, progress=False), max_steps=250, **SHORT)
    replicates = posterior.tree["posterior_predictive"].to_dataset()
    draws = posterior.tree["posterior"].to_dataset().sel(chain=replicates["chain"], draw=replicates["draw"])
    theta = np.stack([draws[name].to_numpy() for name in problem.names], axis=-1)
    variance = draws["variance"].sel(channel="force").to_numpy()
    squared = (replicates["run force"].to_numpy() - theta @ linear_regressors(0.05, 2.0, grid(40)).T) ** 2
    assert squared.shape == (4, 25, 40)
    assert np.mean(squared / variance[..., None]) == pytest.approx(1.0, abs=4 * np.sqrt(2 / squared.size))
    assert replicates["run force"].dims[:2] == ("chain", "draw")
    assert set(replicates.data_vars) == {"run force", "largest_multiplier"}
    assert replicates["run force"].dims[2] in posterior.data["observed_data"].dims
    assert np.all(posterior.data["sample_stats"]["status"] == 0)


def test_predictive_multipliers_are_reported_without_rejecting_draws(rotating):
    """The pendulum's rotation is unstable at every draw, and its multiplier is the solver's."""
    problem, posterior = rotating
    group = posterior.tree["posterior_predictive"].to_dataset()
    largest = group["largest_multiplier"].sel(experiment="rotation")
    assert largest.shape == (4, 25) and np.all(largest > 1.0) and not posterior.failures
    at = {"chain": group["chain"][3], "draw": group["draw"][2]}
    draw = posterior.tree["posterior"].to_dataset().sel(at)
    solution = problem.solve({name: float(draw[name]) for name in problem.names})["rotation"]
    assert float(largest.sel(at)) == pytest.approx(abs(solution.multipliers[0]), rel=1e-8)
    data = problem.experiments[0].outputs["angle"]
    assert np.all(np.abs(group["rotation angle"] - data) <= np.pi)


def test_predictions_start_from_the_orbits_of_the_draws(rotating):
    """With the problem anchored elsewhere the prediction stays on the rotation that was sampled."""
    problem, posterior = rotating
    states = posterior.guesses(["rotation"], ["phi"])["rotation"]
    assert states["phi"][-1] - states["phi"][0] == pytest.approx(2 * np.pi, abs=0.2)
    middle = {name: float(np.median(posterior.draws(name))) for name in problem.names}
    astray = problem.anchored(middle, {"rotation": {"phi": rotation().states["phi"] + np.pi}})
    median = bp.predict(astray, posterior, draws=20).median["rotation"]["rate"]
    assert median == pytest.approx(rotation().outputs["rate"], abs=0.5)
