"""Estimates from response tables: the same from distant starts, and warnings about orbits that cannot be right."""

import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from tests.response_tables import TRUTH, noisy, problem_of, swept

F = np.linspace(0.1, 0.26, 24)


def estimate(problem, **more):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = bp.map_estimate(problem, checks=False, progress=False, **more)
    return fit, [str(one.message) for one in caught]


@pytest.mark.parametrize("start", [{"c": 0.2, "k": 0.85, "k3": 0.2}, {"c": 0.05, "k": 1.1, "k3": 0.6}])
@pytest.mark.parametrize("direction", ["up", "down"])
def test_estimates_from_distant_starts_are_those_from_the_truth(direction, start):
    problem = problem_of(F, noisy(swept(F, direction), 0.01, 2), direction)
    near, _ = estimate(problem, start={name: TRUTH[name] for name in problem.names})
    fit, texts = estimate(problem, start=start)
    assert not texts and fit.converged
    assert [*fit.theta.values()] == pytest.approx([*near.theta.values()], rel=1e-5)
    off = [(fit.theta[name] - TRUTH[name]) / fit.sd[name] for name in fit.theta]
    assert max(map(abs, off)) < 4.0  # exceeded by 0.02 % of the seeds


def test_a_sweep_of_the_other_direction_is_reported():
    problem = problem_of(F, noisy(swept(F, "up"), 0.01, 2), "down")
    _, texts = estimate(problem)
    assert len(texts) == 1 and "The sweep down" in texts[0] and "may have had the other direction" in texts[0]


def test_points_that_no_orbit_of_the_branch_reaches_are_reported():
    """The table goes on before the jump far beyond the fold, and the priors determine the parameters."""
    rows = np.append(F[F < 0.2], [0.225, 0.25])
    values = np.append(swept(F[F < 0.2], "up"), [-1.7j, -1.8j])
    priors = {"c": bp.LogNormal(0.1, 1e-6), "k": bp.LogNormal(1.0, 1e-6), "k3": bp.LogNormal(0.3, 1e-6)}
    fit, texts = estimate(problem_of(rows, noisy(values, 0.01, 2), "up", priors=priors))
    reached = {name: np.isclose(float(name.split()[0]), solution.frequency) for name, solution in fit.solutions.items()}
    lost = [name for name, close in reached.items() if not close]
    assert lost == ["0.225 Hz", "0.25 Hz"]
    assert any("2 points of response tables were measured where the model at the estimate has no" in t for t in texts)


def test_amplitudes_alone_tell_the_branch():
    table = {"f": F, "A": np.abs(noisy(swept(F, "up"), 0.01, 2))}
    columns = {"frequency": "f", "outputs": {"displacement": "A"}, "inputs": {"force": 0.2}}
    runs = bp.response_table(table, **columns, sweep="up", sd={"displacement": 0.01})
    priors = {"c": bp.LogNormal(0.1, 0.3), "k": bp.LogNormal(1.0, 0.1), "k3": bp.LogNormal(0.3, 0.3)}
    fit, texts = estimate(bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1.0}))
    assert fit.converged and not texts
    assert all(abs(fit.theta[name] - TRUTH[name]) < 4.0 * fit.sd[name] for name in fit.theta)
