"""Models whose equations are singular at rest, against SciPy."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp

POINTS, PERIOD = 64, 10.0
TAU = np.arange(POINTS) / POINTS
DRIVE = np.cos(2 * np.pi * TAU)


def model(state, parameters, equation):
    return bp.Model(
        "singular", states=[state], inputs=["u"], parameters=parameters, equations=[equation], outputs={state: state}
    )


def drive(t):
    return np.cos(2 * np.pi * t / PERIOD)


BUBBLE = model("R", ["a"], "R*ddR + 1.5*dR**2 + 1 - R**(-3) + a*dR/R + 0.2*u")
CASES = {  # model, parameters, rates of (state, rate), start
    "bubble": (
        BUBBLE,
        {"a": 0.4},
        lambda t, y: [y[1], (-1.5 * y[1] ** 2 - 1 + y[0] ** -3 - 0.4 * y[1] / y[0] - 0.2 * drive(t)) / y[0]],
        [1.0, 0.0],
    ),
    "small bubble": (
        model("R", ["R0"], "R*ddR + 1.5*dR**2 - 1e-4*((R0/R)**4 - 1) + 0.01*dR + 2e-5*u"),
        {"R0": 2.3e-3},
        lambda t, y: [
            y[1],
            (-1.5 * y[1] ** 2 + 1e-4 * ((2.3e-3 / y[0]) ** 4 - 1) - 0.01 * y[1] - 2e-5 * drive(t)) / y[0],
        ],
        [2.3e-3, 0.0],
    ),
    "levitated": (
        model("x", ["k"], "ddx + 0.3*dx + 1 - k/x**2*(1 + 0.3*u)"),
        {"k": 4.0},
        lambda t, y: [y[1], -0.3 * y[1] - 1 + 4 / y[0] ** 2 * (1 + 0.3 * drive(t))],
        [2.0, 0.0],
    ),
    "logarithm": (
        model("x", ["k"], "dx + k*log(x) - 0.5*u"),
        {"k": 2.0},
        lambda t, y: [-2 * np.log(y[0]) + 0.5 * drive(t), 0.0],
        [1.0, 0.0],
    ),
}


def settled(name):
    *_, rates, start = CASES[name]
    run = solve_ivp(rates, (0, 61 * PERIOD), start, method="LSODA", rtol=1e-10, atol=1e-13, dense_output=True)
    return run.sol


@pytest.mark.parametrize("guess", ["static", "integration"])
@pytest.mark.parametrize("name", CASES)
def test_the_solve_starts_where_the_equations_are_finite(name, guess):
    system, parameters, *_ = CASES[name]
    orbit = bp.solve_periodic(
        system, parameters, {"u": DRIVE}, frequency=1 / PERIOD, samples=POINTS, scheme="fourier", guess=guess
    )
    right = settled(name)(60 * PERIOD + PERIOD * TAU)[0]
    assert orbit.converged
    assert orbit.outputs[system.outputs[0]] == pytest.approx(right, abs=1e-6 * np.ptp(right))


@pytest.mark.parametrize("guess", [None, "data"])
def test_a_bubble_is_fitted_without_a_guess(guess):
    time = np.arange(0, 300, 0.1)
    radius = settled("bubble")(300 + time)[0] + 1e-3 * np.random.default_rng(0).standard_normal(time.size)
    experiment = bp.Recording.from_arrays(time, {"R": radius}, {"u": drive(time)}).fold(POINTS, guess=guess)
    problem = bp.Problem(BUBBLE, [experiment], priors={"a": bp.LogNormal(0.3, 1.0)}, scheme="fourier")
    fit = bp.map_estimate(problem, progress=False)
    assert abs(fit.theta["a"] - 0.4) < 4 * fit.sd["a"]


AT_REST = model("x", ["a"], "ddx + a/dx + x - u")


def test_a_model_that_is_singular_at_every_rest_names_its_term_and_the_guess():
    with pytest.warns(UserWarning, match=r"1/dx at dx = 0\. Give guess="):
        orbit = bp.solve_periodic(AT_REST, {"a": 0.2}, {"u": DRIVE}, frequency=1 / PERIOD, samples=POINTS)
    assert orbit.status == "not finite"
    time = np.arange(0, 200, 0.1)
    noise = 0.01 * np.random.default_rng(0).standard_normal(time.size)
    recording = bp.Recording.from_arrays(time, {"x": drive(time - 1) + noise}, {"u": drive(time)})
    problem = bp.Problem(AT_REST, [recording.fold(POINTS)], priors={"a": bp.LogNormal(0.2, 1.0)})
    with pytest.raises(ValueError, match=r"the equations contain 1/dx at dx = 0\. Give guess=") as refused:
        bp.map_estimate(problem, progress=False)
    assert "fold" in str(refused.value)


def test_a_regular_model_is_solved_from_zero_as_before():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        orbit = bp.solve_periodic(
            bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.1}, {"force": DRIVE}, frequency=0.1, samples=POINTS
        )
    assert orbit.converged and orbit.found_by == "newton"
