"""Cycles that are not isolated, against motions integrated by SciPy."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp

POINTS = 64
CONSERVATIVE = {
    "lotka": (["x", "y"], {"a": 1.0, "b": 0.5}, ["dx - x*(a - b*y)", "dy - y*(0.2*x - 0.8)"], [8.0, 2.0]),
    "pendulum": (["x"], {"w": 1.3}, ["ddx + w**2*sin(x)"], [1.5, 0.0]),
    "duffing": (["x"], {"k": 1.0, "b": 0.5}, ["ddx + k*x + b*x**3"], [1.0, 0.0]),
    "linear": (["x"], {"k": 2.0}, ["ddx + k*x"], [1.0, 0.0]),
    "toda": (["x"], {"k": 1.5}, ["ddx + exp(x) - k"], [1.0, 0.0]),
}
RATES = {
    "lotka": lambda t, z: [z[0] * (1 - 0.5 * z[1]), z[1] * (0.2 * z[0] - 0.8)],
    "pendulum": lambda t, z: [z[1], -1.69 * np.sin(z[0])],
    "duffing": lambda t, z: [z[1], -z[0] - 0.5 * z[0] ** 3],
    "linear": lambda t, z: [z[1], -2.0 * z[0]],
    "toda": lambda t, z: [z[1], 1.5 - np.exp(z[0])],
}


def model_of(name):
    states, parameters, equations, _ = CONSERVATIVE[name]
    outputs = {s: s for s in states}
    return bp.Model(name, states=states, parameters=list(parameters), equations=equations, outputs=outputs), parameters


def cycle_of(name):
    """Return the states (size, POINTS) of the cycle through the start, and its period, by SciPy."""

    def passage(time, z):
        return RATES[name](time, z)[0]

    passage.direction = -1
    start = CONSERVATIVE[name][3]
    run = solve_ivp(
        RATES[name], (0, 60), start, method="DOP853", rtol=1e-11, atol=1e-12, events=passage, dense_output=True
    )
    first, second = run.t_events[0][1:3]
    return run.sol(first + (second - first) * np.arange(POINTS) / POINTS), second - first


@pytest.mark.parametrize("scheme", ["central2", "fourier"])
@pytest.mark.parametrize("name", CONSERVATIVE)
def test_a_solve_of_a_conservative_model_is_singular_with_the_reason(name, scheme):
    (model, parameters), (z, period) = model_of(name), cycle_of(name)
    for guess in ("static", dict(zip(model.states, z, strict=False))):
        with pytest.warns(UserWarning, match="are not isolated"):
            orbit = bp.solve_periodic(
                model, parameters, frequency=1 / period, samples=POINTS, scheme=scheme, guess=guess
            )
        assert orbit.status == "singular" and orbit.stable is None


@pytest.mark.parametrize("mu", [0.05, 1.0, 4.0])
def test_a_limit_cycle_is_isolated(mu):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        orbit = bp.solve_periodic(
            bp.models.van_der_pol, {"mu": mu, "omega": 1.0}, frequency=0.15, samples=201, scheme="fourier"
        )
    assert orbit.stable is True


def recorded(name):
    """Return an experiment of two channels or one, with noise, of twenty periods of the cycle."""
    model, _ = model_of(name)
    time = np.arange(0.0, 20 * cycle_of(name)[1], 0.05)
    run = solve_ivp(RATES[name], (0, time[-1]), CONSERVATIVE[name][3], rtol=1e-10, atol=1e-10, t_eval=time)
    noise = 0.02 * np.random.default_rng(1).standard_normal(run.y.shape)
    channels = dict(zip(model.outputs, run.y + noise, strict=False))
    return bp.Recording.from_arrays(time, channels)


@pytest.mark.parametrize("guessed", [False, True])
@pytest.mark.parametrize("name", ["lotka", "pendulum"])
def test_an_estimate_of_a_conservative_model_is_refused_at_the_true_values(name, guessed):
    model, parameters = model_of(name)
    experiment = recorded(name).fold(POINTS, origin="crossing")
    if guessed:
        experiment = recorded(name).fold(POINTS, origin="crossing", guess=dict(experiment.outputs))
    priors = {n: bp.LogNormal(value, 0.5) for n, value in parameters.items()}
    with pytest.raises(ValueError, match="must have isolated cycles.*give start={…} where"):
        bp.map_estimate(bp.Problem(model, [experiment], priors=priors, scheme="fourier"), progress=False)


def test_a_term_that_vanishes_on_one_energy_isolates_its_cycle_and_the_parameters_follow():
    """The how-to: damping by the difference from an energy, which is one more parameter of the experiment."""
    model = bp.Model(
        "pendulum_of_one_energy",
        states=["x"],
        parameters=["w", "energy"],
        equations=["ddx + w**2*sin(x) + 0.2*(0.5*dx**2 - w**2*cos(x) - energy)*dx"],
        outputs={"x": "x"},
    )
    (z, _), right = cycle_of("pendulum"), 1.69 * -np.cos(1.5)
    first = recorded("pendulum").fold(POINTS, origin="crossing")
    experiment = recorded("pendulum").fold(POINTS, origin="crossing", guess=dict(first.outputs))
    priors = {"w": bp.LogNormal(1.5, 0.3), "energy": bp.Normal(0.0, 1.0)}
    fit = bp.map_estimate(bp.Problem(model, [experiment], priors=priors, scheme="fourier"), progress=False)
    assert np.ptp(fit.solutions["recording"].states["x"]) == pytest.approx(np.ptp(z[0]), rel=0.01)
    for name, value in (("w", 1.3), ("energy", right)):
        assert abs(fit.theta[name] - value) < 4 * fit.sd[name] < 0.05 * abs(value) + 0.01
