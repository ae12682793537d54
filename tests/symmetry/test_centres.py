"""Models whose cycles are not isolated, by what is known of them."""

import pytest

import bayesperiodic as bp
from bayesperiodic.symmetry.centres import has_centres


def model(states, parameters, equations):
    return bp.Model("m", states=states, parameters=parameters, equations=equations, outputs={states[0]: states[0]})


CENTRES = {
    "Lotka and Volterra": model(["x", "y"], ["a", "b"], ["dx - x*(a - b*y)", "dy - y*(x - b)"]),
    "pendulum": model(["x"], ["w"], ["ddx + w*sin(x)"]),
    "two masses": model(["x", "y"], ["k", "m"], ["m*ddx + k*x + (x - y)**3 + k*(x - y)", "m*ddy + k*(y - x)"]),
    "radial Kepler problem": model(["r"], ["k", "h"], ["ddr - h**2/r**3 + k/r**2"]),
    "free bubble": model(["R"], ["k"], ["R*ddR + 1.5*dR**2 + k - R**(-3)"]),
}
NONE = {
    "linear damping": model(["x"], ["c", "k"], ["ddx + c*dx + k*sin(x)"]),
    "cubic damping": model(["x"], ["c", "k"], ["ddx + c*dx**3 + k*x"]),
    "quadratic damping": model(["x"], ["c", "k"], ["ddx + c*dx*abs(dx) + k*x"]),
    "van der Pol": bp.models.van_der_pol,
    "flutter": bp.models.flutter,
    "driven without damping": bp.Model(
        "d", states=["x"], inputs=["u"], parameters=["k"], equations=["ddx + k*x + x**3 - u"], outputs={"x": "x"}
    ),
}


@pytest.mark.parametrize("name", CENTRES)
def test_conservative_models_have_centres(name):
    assert has_centres(CENTRES[name])


@pytest.mark.parametrize("name", NONE)
def test_other_models_have_none(name):
    assert not has_centres(NONE[name])


def test_structure_says_it_also_of_a_damping_that_is_fixed_to_zero():
    conservative, damped = CENTRES["pendulum"], NONE["linear damping"]
    assert bp.structure(conservative).centres and "Cycles are not isolated" in repr(bp.structure(conservative))
    assert not bp.structure(damped).centres and "isolated" not in repr(bp.structure(damped))
    assert bp.structure(damped, fixed={"c": 0.0}).centres
