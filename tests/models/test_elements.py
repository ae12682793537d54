"""Elements against their closed forms."""

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import bayesperiodic as bp

X = sp.Symbol("x", real=True)


def test_ramp_is_exact_outside_its_transition_and_continuous_with_its_slope_inside():
    width = 0.25
    ramp = bp.elements.ramp(X, width)
    value, slope = sp.lambdify(X, ramp), sp.lambdify(X, sp.diff(ramp, X))
    for x in (-3.0, -0.126, 0.126, 0.5, 7.0):
        assert value(x) == max(x, 0.0) and slope(x) == float(x > 0.0)
    inside = np.linspace(-width / 2, width / 2, 51)
    expected = (inside + width / 2) ** 2 / (2 * width)
    np.testing.assert_allclose([value(x) for x in inside], expected, atol=1e-15)
    np.testing.assert_allclose([slope(x) for x in inside], (inside + width / 2) / width, atol=1e-14)


def test_gap_has_no_force_out_of_contact():
    force = sp.lambdify(X, bp.elements.gap(X, 20.0, 0.5, 0.01))
    assert [force(x) for x in (-10.0, 0.0, 0.494)] == [0.0, 0.0, 0.0]
    assert force(0.75) == 5.0


def test_width_must_be_positive():
    with pytest.raises(ValueError, match="width: must be"):
        bp.elements.ramp(X, 0.0)


@pytest.mark.parametrize(("rate", "amplitude"), [(0.6, 0.3), (1.2, 0.4)])
def test_motion_against_a_stop_is_that_of_the_exact_contact(rate, amplitude):
    stop, stiffness, points, period = 0.5, 20.0, 200, 2 * np.pi / rate
    model = bp.Model(
        "stop", states=["x"], inputs=["force"], parameters=["c", "k", "kg"],
        equations=lambda s, p, u: [
            s.ddx + p.c * s.dx + p.k * s.x + bp.elements.gap(s.x, p.kg, stop, 0.01) - u.force
        ],
        outputs=lambda s, p, u: {"x": s.x},
    )  # fmt: skip

    def rates(t, y):
        contact = stiffness * max(y[0] - stop, 0.0)
        return [y[1], -0.1 * y[1] - y[0] - contact + amplitude * np.cos(rate * t)]

    motion = solve_ivp(
        rates, (0, 130 * period), [0, 0], rtol=1e-8, atol=1e-10, max_step=period / 50, dense_output=True
    ).sol(129 * period + np.arange(points) / points * period)[0]
    force = amplitude * np.cos(2 * np.pi * np.arange(points) / points)
    solution = bp.solve_periodic(
        model, {"c": 0.1, "k": 1.0, "kg": stiffness}, {"force": force}, frequency=rate / (2 * np.pi), samples=points,
        scheme="central4", guess={"x": motion},
    )  # fmt: skip
    assert solution.status == "converged"
    np.testing.assert_allclose(solution.states["x"], motion, atol=2e-3 * np.abs(motion).max())
