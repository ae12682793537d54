"""Multipliers of models with algebraic equations, against closed forms and equations reduced by hand."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp

POINTS, PERIOD = 128, 5.0
TAU = np.arange(POINTS) / POINTS
DRIVE = np.cos(2 * np.pi * TAU)


def model(name, states, parameters, equations):
    return bp.Model(name, states=states, inputs=["u"], parameters=parameters, equations=equations, outputs={"x": "x"})


def solved(system, parameters, scheme="fourier", drive=DRIVE):
    return bp.solve_periodic(system, parameters, {"u": drive}, frequency=1 / PERIOD, samples=POINTS, scheme=scheme)


@pytest.mark.parametrize("scheme", ["central4", "backward2", "fourier"])
@pytest.mark.parametrize("a", [1.0, 0.3])
@pytest.mark.parametrize(("first", "second"), [(1.0, 1.0), (0.1, 0.7), (1e-3, 3e2)])
def test_the_finite_multiplier_of_two_sums_of_derivatives_is_its_closed_form(a, first, second, scheme):
    """(1 + a) dx + a x = u − du is left, in any scaling of the equations."""
    system = model("sums", ["x", "y"], ["a", "b", "c"], ["b*(dx + dy + a*x - u)", "c*dx + c*dy + c*(y - 2*u)"])
    orbit = solved(system, {"a": a, "b": first, "c": second}, scheme)
    assert orbit.stable is True
    assert orbit.multipliers == pytest.approx([np.exp(-a * PERIOD / (1 + a))], rel=1e-9)


def test_states_in_other_units_have_the_same_multiplier():
    system = model("units", ["x", "y"], ["a"], ["1e-8*dx + 1e5*dy + 1e-8*a*x - u", "1e-8*dx + 1e5*dy + 1e5*y - 2*u"])
    assert solved(system, {"a": 0.5}).multipliers == pytest.approx([np.exp(-0.5 * PERIOD / 1.5)], rel=1e-9)


@pytest.mark.parametrize("scheme", ["central4", "fourier"])
def test_multipliers_of_a_nonlinear_model_are_those_of_the_equation_reduced_by_hand(scheme):
    """The derivative matrix depends on y; the second equation less twice the first is solved for x."""
    a, b = 0.5, 2.0
    system = model("nonlinear", ["x", "y"], ["a", "b"], ["dx + y*dy + a*x - u", "2*dx + 2*y*dy + b*y + y**3 - u"])

    def rate(t, y):
        angle = 2 * np.pi * t / PERIOD
        u, du = 2 * np.cos(angle), -4 * np.pi / PERIOD * np.sin(angle)
        x = (b * y + y**3 + u) / (2 * a)
        return (u - a * x - du / (2 * a)) / ((b + 3 * y**2) / (2 * a) + y)

    def after(start, periods):
        run = solve_ivp(rate, (0.0, periods * PERIOD), start, method="DOP853", rtol=1e-11, atol=1e-12)
        return run.y[:, -1]

    settled = after([0.0], 60)[0]
    right = np.diff(after([settled - 1e-4, settled + 1e-4], 1))[0] / 2e-4
    orbit = solved(system, {"a": a, "b": b}, scheme, 2 * DRIVE)
    assert orbit.states["y"][0] == pytest.approx(settled, abs=1e-4) and orbit.stable is True
    assert orbit.multipliers == pytest.approx([right], rel=1e-4)


def test_an_unstable_finite_multiplier_is_unstable():
    orbit = solved(model("grows", ["x", "y"], ["a"], ["dx + dy - a*x - u", "dx + dy + y - 2*u"]), {"a": 0.2})
    assert orbit.stable is False
    assert orbit.multipliers == pytest.approx([np.exp(0.2 * PERIOD / 0.8)], rel=1e-9)


@pytest.mark.parametrize("small", [1e-3, 1e-6, 1e-9, 1e-11])
def test_a_small_mass_is_no_algebraic_equation(small):
    """M ddx + dx + x = u: two multipliers, of the roots of m s² + s + 1; the fast one vanishes or is left out."""
    orbit = solved(model("light", ["x"], ["m"], ["m*ddx + dx + x - u"]), {"m": small})
    slow = (np.sqrt(1 - 4 * small) - 1) / (2 * small) if small > 1e-8 else -1.0 - small
    assert orbit.multipliers.size == (2 if small > 1e-8 else 1) and orbit.stable is True
    assert orbit.multipliers[0] == pytest.approx(np.exp(slow * PERIOD), rel=1e-5)


def test_a_massless_node_has_the_multipliers_of_the_two_springs_in_series():
    system = bp.Model(
        "node",
        states=["x", "y"],
        inputs=["u"],
        parameters=["k", "m"],
        equations=["ddx + 0.1*dx + k*(x - y) - u", "m*ddy + 0.5*dy + k*(y - x) + k*y"],
        outputs={"x": "x"},
    )
    matrix = np.array([[0, 0, 1], [2.0, -4.0, 0], [-1.0, 1.0, -0.1]])  # y' = (k x − 2 k y)/0.5
    right = np.exp(PERIOD * np.linalg.eigvals(matrix))
    orbit = solved(system, {"k": 1.0, "m": 0.0})
    assert orbit.stable is True
    assert np.sort_complex(orbit.multipliers) == pytest.approx(np.sort_complex(right), rel=1e-7)


def test_a_higher_index_has_unknown_stability_with_the_reason():
    """The input gives x, whose equation gives y only by the derivative of x."""
    system = model("index_2", ["x", "y"], ["a", "zero"], ["dx + a*x - y", "x - u + zero*dy"])
    orbit = solved(system, {"a": 1.0, "zero": 0.0})
    assert orbit.converged and orbit.stable is None and not orbit.multipliers.size
    assert "index" in orbit.stability_unknown and "stability unknown" in repr(orbit)


def test_sensitivities_of_multipliers_are_refused():
    system = model("sums", ["x", "y"], ["a"], ["dx + dy + a*x - u", "dx + dy + y - 2*u"])
    with pytest.raises(ValueError, match="algebraic"):
        bp.multiplier_sensitivities(system, solved(system, {"a": 1.0}))


def test_a_negative_small_mass_is_not_called_stable():
    """M ddx + dx + x = u with m < 0 has a motion that grows with the rate 1/|m|."""
    for small in (1e-3, 1e-9):
        orbit = solved(model("grows_fast", ["x"], ["m"], ["m*ddx + dx + x - u"]), {"m": -small})
        assert orbit.converged and orbit.stable is not True


def test_a_driven_relaxation_on_a_coarse_grid_has_unknown_stability():
    """By SciPy (LSODA, the monodromy of van der Pol's driven equation) the multiplier is 0.0234: it is stable."""
    system = model("relaxation", ["x"], ["mu"], ["ddx - mu*(1 - x**2)*dx + x - u"])

    def rate(t, y):
        x, v, dx, dv = y
        spring = -20 * x * v - 1
        return [v, 10 * (1 - x**2) * v - x + 3 * np.cos(2 * np.pi * t / 18), dv, 10 * (1 - x**2) * dv + spring * dx]

    settled = solve_ivp(rate, (0, 360), [2, 0, 1, 0], method="LSODA", rtol=1e-9, atol=1e-10).y[:2, -1]
    columns = []
    for direction in np.eye(2):
        run = solve_ivp(
            rate, (0, 18), [*settled, *direction], method="LSODA", rtol=1e-10, atol=1e-12, dense_output=True
        )
        columns.append(run.y[2:, -1])
    right = np.max(np.abs(np.linalg.eigvals(np.array(columns).T)))
    assert right == pytest.approx(0.0234, rel=0.01)
    for scheme, samples in (("central2", 800), ("central4", 400), ("central4", 1600)):
        tau = np.arange(samples) / samples
        guess = {"x": run.sol(18 * tau)[0]}
        orbit = bp.solve_periodic(
            system, {"mu": 10.0}, {"u": 3 * np.cos(2 * np.pi * tau)}, frequency=1 / 18, samples=samples, scheme=scheme,
            guess=guess,
        )  # fmt: skip
        assert orbit.converged
        assert orbit.stable is (True if samples == 1600 else None)
    assert np.abs(orbit.multipliers[0]) == pytest.approx(right, rel=0.1)
