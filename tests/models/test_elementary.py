import math
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.models import code_generation as compilation
from bayesperiodic.models.cache import load

NAMES = ("exp", "tanh", "atan")
EXACT = {"exp": mpmath.exp, "tanh": mpmath.tanh, "atan": mpmath.atan}
SIZES = np.concatenate([np.geomspace(1e-300, 1e300, 1201), np.linspace(0.01, 40.0, 3001)])


@pytest.fixture(scope="module")
def functions():
    text = Path(compilation.__file__).with_name("_kernels").joinpath("elementary.py").read_text(encoding="utf-8")
    return vars(load(text))


@pytest.mark.parametrize("name", NAMES)
def test_errors_are_at_most_two_units_in_the_last_place(functions, name):
    function, exact, worst = functions[name], EXACT[name], 0.0
    for x in np.concatenate([-SIZES, SIZES]):
        if name == "exp" and not -700.0 < x < 709.0:
            continue
        true = exact(mpmath.mpf(float(x)))
        if abs(true) > 1e-290:
            worst = max(worst, float(abs(mpmath.mpf(function(x)) - true)) / np.spacing(abs(float(true))))
    assert worst <= 2.0


@pytest.mark.parametrize("name", NAMES)
def test_infinities_zero_and_nan_give_the_limits_and_nan(functions, name):
    ends = {"exp": (0.0, math.inf, 1.0), "tanh": (-1.0, 1.0, 0.0), "atan": (-math.pi / 2, math.pi / 2, 0.0)}[name]
    assert [functions[name](x) for x in (-math.inf, math.inf, 0.0)] == list(ends)
    assert math.isnan(functions[name](math.nan))


def test_exponential_is_exact_near_underflow_and_overflow(functions):
    for x in (-745.0, -720.0, 709.7, 710.0, 1000.0, -1000.0):
        with mpmath.workprec(200):
            true = float(mpmath.exp(mpmath.mpf(x)))
        assert functions["exp"](x) == pytest.approx(true, rel=1e-15, abs=5e-324)


def test_generated_code_agrees_with_the_expressions_of_the_model():
    """The generated code of all three against NumPy's functions."""
    model = bp.Model(
        "elementary",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.ddx + sp.tanh(p.a * s.dx) + sp.atan(s.x) + sp.exp(-s.x) - u.u],
        outputs=lambda s, p, u: {"out": sp.exp(s.dx)},
    )
    generator = np.random.default_rng(1)
    states, inputs = generator.standard_normal((50, 3)), generator.standard_normal((50, 3))
    tau, parameters = np.arange(50) / 50, np.array([3.0])
    found = model.kernels.evaluate("residual", states, inputs, parameters, tau, 1.0)[:, 0]
    both = model.kernels.evaluate("residual_jacobian", states, inputs, parameters, tau, 1.0)
    x, dx, ddx = states.T
    assert found == pytest.approx(
        ddx + np.tanh(3 * dx) + np.arctan(x) + np.exp(-x) - inputs[:, 0], rel=1e-14, abs=1e-14
    )
    assert both[:, 0] == pytest.approx(found, rel=1e-14, abs=1e-14)
    assert both[:, 2] == pytest.approx(3.0 / np.cosh(3 * dx) ** 2, rel=1e-12, abs=1e-14)
