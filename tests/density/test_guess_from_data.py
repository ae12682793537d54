"""Guesses of the states from measured channels: subharmonic orbits of Duffing oscillators."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp

SAMPLES = 200
# Amplitude and angular frequency of the force, c, k and k3, response period: one well of two, and a hardening spring.
CASES = {"two": (0.28, 1.2, 0.3, -1.0, 1.0, 2), "three": (6.0, 1.0, 0.1, 0.0, 1.0, 3)}
MODELS = {
    measured: bp.Model(
        f"duffing_{measured}",
        states=["x"],
        inputs=["force"],
        parameters={"c": "1/s", "k": "1/s^2", "k3": "1/(m^2 s^2)"},
        equations=lambda s, p, u: [s.ddx + p.c * s.dx + p.k * s.x + p.k3 * s.x**3 - u.force],
        outputs=lambda s, p, u, own=measured: {"y": s.x if own == "displacement" else s.dx},
    )
    for measured in ("displacement", "velocity")
}


@cache
def motion(case):
    """Return displacement and velocity over 36 drive periods, after 300."""
    force, omega, c, k, k3, _ = CASES[case]
    step = 2 * np.pi / omega / SAMPLES

    def slope(n, z):
        return np.array([z[1], force * np.cos(2 * np.pi * n / SAMPLES) - c * z[1] - k * z[0] - k3 * z[0] ** 3])

    z, found = np.array([0.1, 0.0]), []
    for n in range(336 * SAMPLES):
        found.append(z)
        first = slope(n, z)
        second = slope(n + 0.5, z + 0.5 * step * first)
        third = slope(n + 0.5, z + 0.5 * step * second)
        z = z + step / 6 * (first + 2 * second + 2 * third + slope(n + 1, z + step * third))
    return dict(zip(MODELS, np.array(found[300 * SAMPLES :]).T, strict=True))


def problem(case, measured):
    """Return the problem of the motion with 1 % noise, with the medians of the priors off by 20 %."""
    force, omega, c, k, k3, periods = CASES[case]
    y = motion(case)[measured]
    y = y + 0.01 * y.std() * np.random.default_rng(0).standard_normal(y.size)
    time = np.arange(y.size) * (2 * np.pi / omega / SAMPLES)
    run = bp.Recording.from_arrays(time, {"y": y}, {"force": force * np.cos(omega * time)}, name="run")
    run = run.fold(SAMPLES, frequency=omega / 2 / np.pi, periods="auto", guess="data")
    assert run.periods == periods
    priors = {"c": bp.LogNormal(1.2 * c, 0.5), "k3": bp.LogNormal(k3 / 1.2, 0.5)}
    return bp.Problem(MODELS[measured], [run], priors=priors, fixed={"k": k}), {"c": c, "k3": k3}


def subharmonic(states, periods):
    cycles = states["x"].reshape(periods, -1)
    return np.std(cycles - cycles.mean(axis=0)) / np.std(states["x"])


@pytest.mark.filterwarnings("ignore:Twice as many points")
@pytest.mark.parametrize("measured", [*MODELS])
@pytest.mark.parametrize("case", [*CASES])
def test_estimate_is_on_the_measured_orbit(case, measured):
    given, truth = problem(case, measured)
    fit = bp.map_estimate(given, progress=False)
    assert fit.theta == pytest.approx(truth, rel=5e-3)
    assert subharmonic(fit.solutions["run"].states, CASES[case][-1]) > 0.05


def test_density_without_the_data_follows_an_orbit_of_period_one_but_solve_finds_the_recorded_one():
    given, truth = problem("two", "displacement")
    without = given.with_experiments([replace(given.experiments[0], guess={})])
    near = {"c": bp.LogNormal(truth["c"], 0.5), "k3": bp.LogNormal(truth["k3"], 0.5)}
    followed, found = [], []
    for run in (given.experiments[0], without.experiments[0]):
        one = bp.Problem(given.model, [run], priors=near, fixed={"k": -1.0})
        followed.append(subharmonic(one.density().solver.solutions(one.vector(truth))["run"].states, 2))
        found.append(subharmonic(one.solve(truth)["run"].states, 2))
    assert followed[0] > 0.05
    assert followed[1] < 1e-6
    assert np.allclose(found, followed[0], rtol=1e-6)


def test_mean_of_a_state_whose_rate_is_measured_is_found_and_not_without_the_data():
    """Velocity alone: from the equilibrium between the wells the estimate ends on an orbit about it."""
    given, truth = problem("two", "velocity")
    without = given.with_experiments([replace(given.experiments[0], guess={})])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lost = bp.map_estimate(without, progress=False)
    assert abs(lost.theta["k3"] / truth["k3"] - 1) > 1.0
    assert abs(given.solve(truth)["run"].states["x"].mean()) > 0.5


def test_other_texts_and_autonomous_models_are_refused():
    run = bp.Experiment("run", 0.1, {"x": np.cos(2 * np.pi * np.arange(64) / 64)}, samples=64, frequency_se=1e-4)
    with pytest.raises(ValueError, match="guess: must be"):
        replace(run, guess="measured")
    model = bp.Model(
        "free",
        states=["x"],
        parameters={"c": "1/s"},
        equations=lambda s, p, u: [s.ddx - p.c * (1 - s.x**2) * s.dx + s.x],
        outputs=lambda s, p, u: {"x": s.x},
    )
    said = r"^guess of experiment 'run': must be states for 'free', which is autonomous, .* take dataclasses\.replace"
    with pytest.raises(ValueError, match=said):
        bp.Problem(model, [replace(run, guess="data")], priors={"c": bp.LogNormal(1, 1)})
    given = replace(run, guess={"x": 2.0 * run.outputs["x"]})
    assert bp.Problem(model, [given], priors={"c": bp.LogNormal(1, 1)}).solve({"c": 1.0})["run"].converged
