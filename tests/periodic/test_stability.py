"""Sensitivities against differences of order 8 over solutions that are solved again."""

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from studies import shooting
from tests.known import EIGHTH_ORDER, grid
from tests.pendulum import ROTATIONS, pendulum_solution
from tests.periodic.test_autonomous import LORENZ
from tests.shooting import trajectory, van_der_pol_cycle

DUFFING = {"m": 1.1, "c": 0.1, "k": 1.2, "k3": 0.9}
MIXED = bp.Model(
    "mixed_orders",
    states=["x", "T"],
    inputs=["force"],
    parameters=["m", "b", "c", "k", "h", "e"],
    equations=lambda s, p, u: [
        (p.m + p.b * s.x**2) * s.ddx
        + p.c * s.dx * sp.sqrt(1 + s.dx**2)
        + p.k * sp.sinh(s.x)
        - p.e * s.T
        + (0.1 * u.dforce + 0.01 * u.ddforce) * s.x
        - u.force,
        s.dT * (1 + 0.2 * s.x**2) + p.h * s.T * (1 + s.x**2) - s.x * s.dx - u.dforce / 10 + 0.1 * s.ddx,
    ],
    outputs=lambda s, p, u: {"x": s.x, "power": p.c * s.dx**2 + s.frequency * s.T},
)
# Van der Pol's equation with outputs in which the frequency, which is found, appears directly and through a rate.
CYCLE = bp.Model(
    "cycle",
    states=["x"],
    parameters=["mu", "omega"],
    equations=lambda s, p, u: [s.ddx - p.mu * p.omega * (1 - s.x**2) * s.dx + p.omega**2 * s.x],
    outputs=lambda s, p, u: {"rate": s.dx, "slope": s.dx / s.frequency, "power": p.mu * s.frequency * s.x**2},
)
MIXED_AT = {"m": 1.2, "b": 0.3, "c": 0.4, "k": 30.0, "h": 2.0, "e": 0.7}


def duffing(case: str) -> tuple[bp.PeriodicSolution, dict]:
    """Return a solution and the arguments that lead to it."""
    parameters, frequency, guess = {
        "complex pair": (DUFFING, 0.25, "static"),
        "real pair": (DUFFING | {"c": 2.9}, 0.2, "static"),
        "unstable": (DUFFING, 0.22, {"x": -np.cos(2 * np.pi * grid(96))}),
    }[case]
    arguments = {
        "inputs": {"force": 0.3 * np.cos(2 * np.pi * grid(96)) + 0.05 * np.sin(4 * np.pi * grid(96))},
        "frequency": frequency,
        "samples": 96,
        "scheme": "fourier",
    }
    return bp.solve_periodic(bp.models.duffing, parameters, **arguments, guess=guess), arguments


def neighbours(
    model: bp.Model, solution: bp.PeriodicSolution, name: str, step: float, arguments: dict
) -> dict[int, bp.PeriodicSolution]:
    """Return solutions where one parameter or the frequency is changed by k steps, k = −4 … 4 without 0."""
    found = {}
    for k in (-4, -3, -2, -1, 1, 2, 3, 4):
        parameters, changed = dict(solution.parameters), dict(arguments)
        if name == "frequency":
            changed["frequency"] = solution.frequency + k * step
        else:
            parameters[name] += k * step
        found[k] = bp.solve_periodic(model, parameters, **changed, guess=solution)
        assert found[k].converged
    return found


def difference(near: dict[int, bp.PeriodicSolution], step: float, quantity):
    return sum(w * (quantity(near[k]) - quantity(near[-k])) for k, w in EIGHTH_ORDER.items()) / step


def largest(values: np.ndarray) -> float:
    return float(np.max(np.abs(values)))


def compare(
    model: bp.Model,
    solution: bp.PeriodicSolution,
    arguments: dict,
    *,
    amount: float = 1.5e-3,
    multipliers: slice = slice(None),
    without: tuple[str, ...] = (),
) -> None:
    """Compare all sensitivities of a solution: multipliers to 1e-6, outputs and states to 1e-8.

    `amount` is the size of the steps in changes of the orbit, relative to its own size.
    """
    values = solution.parameters | ({} if solution.autonomous else {"frequency": solution.frequency})
    by_name = bp.multiplier_sensitivities(model, solution)
    assert set(by_name) == set(values)
    own = solution.multipliers

    def matched(other: bp.PeriodicSolution) -> np.ndarray:
        return np.array([other.multipliers[np.argmin(abs(other.multipliers - mu))] for mu in own])

    for name, value in values.items():
        if name in without:
            continue
        change = max(largest(by[name]) / np.ptp(solution.outputs[c]) for c, by in solution.sensitivities.items())
        step = min(amount / change, 0.5 * abs(value))
        near = neighbours(model, solution, name, step, arguments)
        expected = difference(near, step, matched)
        assert by_name[name][multipliers] == pytest.approx(expected[multipliers], rel=1e-6), name
        for channel, by_parameter in solution.sensitivities.items():
            expected = difference(near, step, lambda s, channel=channel: s.outputs[channel])
            assert largest(by_parameter[name] - expected) <= 1e-8 * largest(expected), (channel, name)
        for state, by_parameter in solution.state_sensitivities.items():
            expected = difference(near, step, lambda s, state=state: s.states[state])
            assert largest(by_parameter[name] - expected) <= 1e-8 * largest(expected), (state, name)
        if solution.autonomous:
            expected = difference(near, step, lambda s: s.frequency)
            assert solution.frequency_sensitivities[name] == pytest.approx(expected, rel=1e-8), name


@pytest.mark.parametrize(
    ("case", "expected"), [("complex pair", "pair"), ("real pair", "stable"), ("unstable", "unstable")]
)
def test_multiplier_sensitivities_of_a_forced_oscillator_equal_differences(case, expected):
    solution, arguments = duffing(case)
    mu = solution.multipliers
    kind = "pair" if abs(mu[0].imag) > 0.1 else "unstable" if abs(mu[0]) > 1 else "stable"
    assert kind == expected and solution.stable == (kind != "unstable")
    compare(bp.models.duffing, solution, arguments)


@pytest.mark.parametrize("case", ["complex pair", "real pair", "unstable"])
def test_multipliers_obey_liouville_in_closed_form(case):
    """log(μ1 μ2) = −c/(m frequency)."""
    solution, _ = duffing(case)
    m, c, frequency = solution.parameters["m"], solution.parameters["c"], solution.frequency
    logarithmic = {
        name: np.sum(values / solution.multipliers)
        for name, values in bp.multiplier_sensitivities(bp.models.duffing, solution).items()
    }
    assert np.prod(solution.multipliers) == pytest.approx(np.exp(-c / m / frequency), rel=1e-8)
    assert logarithmic["c"] == pytest.approx(-1 / (m * frequency), rel=1e-8)
    assert logarithmic["m"] == pytest.approx(c / (m**2 * frequency), rel=1e-8)
    assert logarithmic["frequency"] == pytest.approx(c / (m * frequency**2), rel=1e-8)
    assert logarithmic["k"] == pytest.approx(0.0, abs=1e-8)
    assert logarithmic["k3"] == pytest.approx(0.0, abs=1e-8)


def test_multiplier_sensitivities_with_mixed_orders_equal_differences():
    force = 4.0 * np.cos(2 * np.pi * grid(96)) + 1.0
    arguments = {"inputs": {"force": force}, "frequency": 0.6, "samples": 96, "scheme": "fourier"}
    solution = bp.solve_periodic(MIXED, MIXED_AT, **arguments)
    assert solution.converged and len(solution.multipliers) == 3
    compare(MIXED, solution, arguments)


@pytest.mark.parametrize("known", ROTATIONS, ids=lambda k: f"multiplier {k.multipliers[0]:.3f}")
def test_multiplier_sensitivities_of_unstable_rotations_equal_differences(known):
    solution = pendulum_solution(known, 400, "central4")
    arguments = {"frequency": solution.frequency, "samples": 400, "scheme": "central4", "winding": 1}
    compare(bp.models.pendulum, solution, arguments, without=("v0",))
    # Friction is saturated all along these orbits.
    assert bp.multiplier_sensitivities(bp.models.pendulum, solution)["v0"] == pytest.approx(np.zeros(2), abs=1e-9)


def test_multiplier_sensitivities_of_a_period_two_orbit_equal_differences():
    solution = pendulum_solution(shooting.STABLE[1], 200, "central4")
    arguments = {"frequency": solution.frequency, "samples": 200, "scheme": "central4", "winding": 2, "periods": 2}
    compare(bp.models.pendulum, solution, arguments, without=("v0",))


@pytest.mark.parametrize("mu", [0.3, 1.0])
def test_multiplier_sensitivities_of_a_limit_cycle_equal_differences(mu):
    """Of the multipliers all but the trivial one, which stays 1."""
    arguments = {"frequency": 0.3, "samples": 128, "scheme": "fourier"}
    solution = bp.solve_periodic(CYCLE, {"mu": mu, "omega": 2.0}, **arguments)
    assert solution.multipliers[0] == pytest.approx(1.0, abs=1e-6)
    compare(CYCLE, solution, arguments, multipliers=slice(1, 2), without=("omega",))
    by_name = bp.multiplier_sensitivities(CYCLE, solution)
    assert by_name["mu"][0] == pytest.approx(0.0, abs=1e-6)
    # Time is only scaled by omega.
    assert by_name["omega"] / by_name["mu"][1] == pytest.approx(np.zeros(2), abs=1e-6)
    assert solution.frequency_sensitivities["omega"] == pytest.approx(solution.frequency / 2.0, rel=1e-10)
    assert solution.state_sensitivities["x"]["omega"] == pytest.approx(np.zeros(128), abs=1e-9)


def test_sensitivity_of_a_limit_cycles_multiplier_to_its_parameter_agrees_with_shooting():
    solution = bp.solve_periodic(
        bp.models.van_der_pol, {"mu": 0.5, "omega": 1.0}, frequency=0.15, samples=128, scheme="fourier"
    )
    h = 0.01
    low, high, lower, higher = (van_der_pol_cycle(0.5 + k * h, parts=6) for k in (-1, 1, -2, 2))
    expected = (8 * np.subtract(high, low) - np.subtract(higher, lower)) / (12 * h)
    by_mu = bp.multiplier_sensitivities(bp.models.van_der_pol, solution)["mu"][1]
    assert by_mu == pytest.approx(expected[2], rel=1e-6)
    assert -solution.frequency_sensitivities["mu"] / solution.frequency**2 == pytest.approx(expected[0], rel=1e-6)


@pytest.mark.slow
def test_multiplier_sensitivities_of_an_unstable_cycle_of_three_states_equal_differences():
    """The solution is the guess of its neighbours, so that their phases are fixed as the sensitivities assume."""
    period, start = 1.5586522107162, np.array([-13.763610682134, -19.578751942452, 27.0])

    def slope(t, y):
        return np.array([10 * (y[1] - y[0]), 28 * y[0] - y[1] - y[0] * y[2], y[0] * y[1] - 8 / 3 * y[2]])

    path = trajectory(slope, np.array([0.0, period]), [start], period * grid(400))
    arguments = {"frequency": 0.64, "samples": 400, "scheme": "central4"}
    parameters = {"sigma": 10.0, "r": 28.0, "b": 8 / 3}
    solution = bp.solve_periodic(
        LORENZ, parameters, **arguments, guess={name: path[:, k] for k, name in enumerate("xyz")}
    )
    by_name = bp.multiplier_sensitivities(LORENZ, solution)
    for name, value in parameters.items():
        step = 1e-3 * value
        near = neighbours(LORENZ, solution, name, step, arguments)
        expected = difference(near, step, lambda s: s.frequency)
        assert solution.frequency_sensitivities[name] == pytest.approx(expected, rel=1e-8)
        expected = difference(near, step, lambda s: s.multipliers[[0, 2]])
        assert by_name[name][[0, 2]] == pytest.approx(expected, rel=1e-6)
        expected = difference(near, step, lambda s: np.concatenate(list(s.states.values())))
        error = np.concatenate([solution.state_sensitivities[state][name] for state in "xyz"]) - expected
        assert largest(error) <= 1e-6 * largest(expected)


def test_another_model_or_an_unconverged_solution_is_refused():
    solution, _ = duffing("complex pair")
    with pytest.raises(ValueError, match="model: must be 'duffing', as of the solution, got 'van_der_pol'"):
        bp.multiplier_sensitivities(bp.models.van_der_pol, solution)
    wrong = replace(solution, status="stalled")
    with pytest.raises(ValueError, match="solution: must have converged, got status 'stalled'"):
        bp.multiplier_sensitivities(bp.models.duffing, wrong)
