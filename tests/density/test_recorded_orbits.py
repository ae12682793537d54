"""`Problem.solve` finds the recorded orbit, also where that at the medians of the priors does not lead to it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.density.orbit_check import unexplained
from bayesperiodic.likelihood.observation import Response
from tests.known import grid
from tests.problems import CASES, SAMPLES, cycle_run, duffing, duffing_run

TRUTH = {"mu": 1.5, "omega": 1.0}
WELLS = {"m": 1.0, "c": 0.3, "k": -1.0, "k3": 1.0}


def van_der_pol(mu, *, guess, **changes):
    run = cycle_run(mu=TRUTH["mu"], turned=0.3)
    run = run if guess else replace(run, guess=None)
    arguments = {"priors": {"mu": mu, "omega": bp.Normal(1.3, 0.5)}, "scheme": "central4"}
    return bp.Problem(bp.models.van_der_pol, [run], **(arguments | changes))


@cache
def one_well(guess):
    """Return the period-two motion in one well of two, whose other well the equilibrium at the medians leads to."""
    frequency = 1.2 / (2 * np.pi)
    run = bp.simulate(
        bp.models.duffing, WELLS, {"force": 0.29 * np.cos(2 * np.pi * grid(32))}, frequency=frequency,
        duration=300 / frequency, sampling_rate=64 * frequency, noise={"displacement": 0.01}, seed=1,
    ).between(200 / frequency, 300 / frequency)  # fmt: skip
    experiment = run.fold(64, periods=2, frequency=frequency, guess=guess)
    priors = {"c": bp.LogNormal(0.3, 1.0), "k3": bp.LogNormal(1.2, 0.5)}
    return bp.Problem(bp.models.duffing, [experiment], priors=priors, fixed={"m": 1.0, "k": -1.0}, scheme="fourier")


@pytest.mark.parametrize("guess", [False, True], ids=["no guess", "guess"])
@pytest.mark.parametrize("mu", [bp.Normal(-0.5, 2.0), bp.LogNormal(100.0, 3.0)], ids=["no cycle", "far"])
def test_estimate_can_be_solved_where_the_medians_have_no_cycle(mu, guess):
    """At mu = −0.5 the equilibrium is stable; the start is the truth, without the delay that the problem adds."""
    problem = van_der_pol(mu, guess=guess)
    fit = bp.map_estimate(problem, start=TRUTH, progress=False)
    assert fit.converged and abs(fit.theta["mu"] - TRUTH["mu"]) < 4 * fit.sd["mu"]
    (solution,), (fitted,) = problem.solve(fit.theta).values(), fit.solutions.values()
    assert solution.status == "converged"
    assert solution.frequency == pytest.approx(fitted.frequency, rel=1e-8)
    for state in solution.states:  # The phase is free.
        sizes = [np.abs(np.fft.rfft(one.states[state])) for one in (solution, fitted)]
        assert np.allclose(*sizes, rtol=0.0, atol=1e-6 * sizes[0].max())
    assert problem.solve(TRUTH)["cycle"].status == "converged"


@pytest.mark.parametrize("guess", [None, "data"])
def test_solution_at_the_estimate_is_that_of_the_estimate_where_others_coexist(guess):
    problem = one_well(guess)
    fit = bp.map_estimate(problem, progress=False)
    (solution,), (fitted,) = problem.solve(fit.theta).values(), fit.solutions.values()
    x, measured = solution.outputs["displacement"], problem.experiments[0].outputs["displacement"]
    assert fit.converged and solution.status == "converged"
    assert np.allclose(x, fitted.outputs["displacement"], atol=1e-8)
    assert np.std(x - measured) < 0.02 * np.std(measured)


def test_orbits_at_the_anchors_are_taken_where_they_explain_the_data():
    for name in ("every sample", "angle of a rotation", "section and multiplier", "autonomous"):
        problem, theta = CASES[name]()
        theta = np.array(theta)
        followed = problem.density().solver.solutions(theta)
        for run, solution in problem.solve(theta).items():
            assert all(np.array_equal(values, solution.states[n]) for n, values in followed[run].states.items())


def test_unexplained_variance_is_that_of_the_measured_points():
    """The residual of no motion is all of the mean square; other points of a mask are no data."""
    for points, share in (([3], 1.0), ([3, 11, 40], None)):
        run = duffing_run(mask=np.isin(np.arange(SAMPLES), points))
        problem = duffing(run, noise=bp.noise.Independent(prior=bp.InverseGamma(3.0, 2.0)))
        (observation,) = problem.observations.values()
        still = Response(np.zeros((SAMPLES, 1)), np.array(0.1), np.empty(0), np.empty(0))
        y = observation.experiment.outputs["displacement"][points]
        expected = share or np.mean(y**2) / np.var(y)
        assert unexplained(observation, still)["displacement"] == pytest.approx(expected)


def test_failed_solves_keep_their_status():
    """ẋ = a − x² + u has no periodic solution for a < 0."""
    model = bp.Model(
        "saddle_node", states=["x"], inputs=["u"], parameters=["a"], equations=["dx - a + x**2 - u"], outputs={"y": "x"}
    )
    u = 0.1 * np.cos(2 * np.pi * grid(32))
    truth = bp.solve_periodic(model, {"a": 1.0}, {"u": u}, frequency=0.2, samples=32, guess={"x": np.ones(32)})
    y = truth.outputs["y"] + 0.001 * np.random.default_rng(1).standard_normal(32)
    for guess in (None, truth.states, "data"):
        run = bp.Experiment("run", 0.2, {"y": y}, {"u": u}, samples=32, guess=guess)
        problem = bp.Problem(model, [run], priors={"a": bp.Normal(1.0, 1.0)})
        assert problem.solve({"a": -1.0})["run"].status != "converged"


def test_a_start_may_leave_out_what_the_problem_adds_by_itself():
    problem = van_der_pol(bp.LogNormal(1.5, 0.3), guess=True)
    fits = [
        bp.map_estimate(problem, start=TRUTH | more, progress=False, checks=False)
        for more in ({}, {"shift[cycle]": 0.0})
    ]
    assert fits[0].theta == fits[1].theta
    with pytest.raises(ValueError, match="start: must have 'mu', 'omega', 'shift.cycle.', got no 'mu'"):
        bp.map_estimate(problem, start={"omega": 1.0}, progress=False)
    given = van_der_pol(
        bp.LogNormal(1.5, 0.3), guess=True,
        priors={"mu": bp.LogNormal(1.5, 0.3), "omega": bp.Normal(1.3, 0.5), "shift": bp.Normal(0.0, 0.1)},
    )  # fmt: skip
    with pytest.raises(ValueError, match="start: .* got no 'shift.cycle.'"):
        bp.map_estimate(given, start=TRUTH, progress=False)


def test_a_start_may_leave_out_the_errors_of_the_inputs():
    run = bp.simulate(
        bp.models.duffing, {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}, {"force": np.cos(2 * np.pi * grid(32))},
        frequency=0.12, duration=100 / 0.12, sampling_rate=32 * 0.12, seed=1,
        noise={"displacement": 0.02, "force": 0.05},
    ).between(50 / 0.12, 100 / 0.12)  # fmt: skip
    run = run.fold(32, frequency=0.12, harmonics={"displacement": 9, "force": 1})
    problem = bp.Problem(
        bp.models.duffing, [run], input_noise="joint", fixed={"m": 1.0, "k3": 0.5},
        priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1.0, 0.5)},
    )  # fmt: skip
    start = {"c": 0.2, "k": 1.0}
    assert len(problem.names) > 2 and set(problem.completed(start)) == set(problem.names)
    fit = bp.map_estimate(problem, start=start, progress=False, checks=False)
    assert fit.converged and problem.solve(start)[problem.experiments[0].name].status == "converged"
