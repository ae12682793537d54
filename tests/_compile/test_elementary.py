import math

import mpmath
import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic._compile.code_generation import _function, grid_functions
from tests.known import formula_model

NAMES = ("exp", "tanh", "atan")
EXACT = {"exp": mpmath.exp, "tanh": mpmath.tanh, "atan": mpmath.atan}
SIZES = np.concatenate([np.geomspace(1e-300, 1e300, 1201), np.linspace(0.01, 40.0, 3001)])


@pytest.fixture(scope="module")
def functions():
    """Return the compiled functions, of arrays."""
    model = formula_model("elementary", ["a"], lambda p, u, s: {n: getattr(sp, n)(p.a * u.x) for n in NAMES})

    def values(x):
        inputs = np.stack([x, x, x], axis=-1)
        return model.kernels.evaluate("outputs", np.zeros((x.size, 3)), inputs, np.ones(1), np.zeros(x.size), 1.0)

    return {name: lambda x, k=k: values(np.array(x, dtype=float))[:, k] for k, name in enumerate(NAMES)}


@pytest.mark.parametrize("name", NAMES)
def test_errors_are_at_most_two_units_in_the_last_place(functions, name):
    function, exact, worst = functions[name], EXACT[name], 0.0
    every = np.concatenate([-SIZES, SIZES])
    for x, found in zip(every, function(every), strict=True):
        if name == "exp" and not -700.0 < x < 709.0:
            continue
        true = exact(mpmath.mpf(float(x)))
        if abs(true) > 1e-290:
            worst = max(worst, float(abs(mpmath.mpf(float(found)) - true)) / np.spacing(abs(float(true))))
    assert worst <= 2.0


@pytest.mark.parametrize("name", NAMES)
def test_infinities_zero_and_nan_give_the_limits_and_nan(functions, name):
    ends = {"exp": (0.0, math.inf, 1.0), "tanh": (-1.0, 1.0, 0.0), "atan": (-math.pi / 2, math.pi / 2, 0.0)}[name]
    assert functions[name]([-math.inf, math.inf, 0.0]).tolist() == list(ends)
    assert np.isnan(functions[name]([math.nan])).all()


def test_exponential_is_exact_near_underflow_and_overflow(functions):
    for x in (-745.0, -720.0, 709.7, 710.0, 1000.0, -1000.0):
        with mpmath.workprec(200):
            true = float(mpmath.exp(mpmath.mpf(x)))
        assert functions["exp"]([x])[0] == pytest.approx(true, rel=1e-15, abs=5e-324)


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


X, Y = sp.symbols("x y", real=True)
CONDITIONS = sp.Piecewise(
    (X, (X > 0.2) & ~(Y > X)), (Y, (X < -0.3) | (Y > 1)), (X * Y, sp.Eq(sp.sign(X), 1)), (2, True)
)
EXPRESSIONS = [
    *(
        function(X)
        for function in (sp.sin, sp.cos, sp.tan, sp.sinh, sp.cosh, sp.asinh, sp.erf, sp.erfc, sp.exp, sp.tanh)
    ),
    *(function(X / 3) for function in (sp.asin, sp.acos, sp.atanh)),
    *(sp.acosh(2 + X**2), sp.log(Y + 3), sp.log(Y + 3, 10), sp.sqrt(X**2 + 1), sp.gamma(Y + 3.5), sp.loggamma(Y + 3.5)),
    *(sp.atan2(X, Y), sp.Abs(X), sp.sign(X), sp.Heaviside(X), sp.Min(X, Y, 0.1), sp.Max(X, Y, 0.1), sp.Mod(X, 0.7)),
    *(sp.Mod(X, -0.7), sp.Mod(2, Y), sp.floor(X), sp.ceiling(X), sp.frac(X), CONDITIONS, sp.Piecewise((X, X > 0))),
    *(X**3, X**-2, X**7 - X**-5, X**70, (X**2) ** 1.3, (Y + 3) ** X, 2**X, 1 / X, X / 3 + sp.Rational(1, 7), sp.pi * X),
    *(sp.sin(1) * X, sp.DiracDelta(X) + X, sp.Integer(3), sp.nan, sp.oo),
]


def test_compiled_expressions_have_the_values_of_exact_arithmetic():
    states, out = np.random.default_rng(3).uniform(-2.5, 2.5, (15, 2)), np.empty((15, len(EXPRESSIONS)))
    source = _function("values", EXPRESSIONS, {X: "states[0]", Y: "states[1]"})
    (values,) = grid_functions(source, ["values"])
    values(states, np.empty((15, 0)), np.empty(0), np.zeros(15), 1.0, out)
    for column, expression in zip(out.T, EXPRESSIONS, strict=True):
        exact = [complex(expression.subs({X: x, Y: y}, simultaneous=True).evalf(30)) for x, y in states]
        real = np.array([value.real if value.imag == 0.0 else np.nan for value in exact])
        assert column == pytest.approx(real, rel=1e-13, abs=1e-14, nan_ok=True), expression


def test_values_at_jumps_and_of_nan_are_those_of_the_definitions():
    expressions = [sp.sign(X), sp.Heaviside(X), sp.Mod(X + 1.5, -0.75), sp.Piecewise((1, sp.Ne(X, Y)), (2, True))]
    out = np.empty((2, 4))
    (values,) = grid_functions(_function("values", expressions, {X: "states[0]", Y: "states[1]"}), ["values"])
    values(np.array([[0.0, 0.0], [0.0, math.nan]]), np.empty((2, 0)), np.empty(0), np.zeros(2), 1.0, out)
    assert out.tolist() == [[0.0, 0.5, 0.0, 2.0], [0.0, 0.5, 0.0, 1.0]]


def test_functions_without_a_compiled_counterpart_are_refused():
    source = _function("values", [sp.factorial(X)], {X: "states[0]"})
    with pytest.raises(ValueError, match="must be elementary functions, got factorial, which cannot be compiled"):
        grid_functions(source, ["values"])
