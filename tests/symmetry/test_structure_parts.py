"""The tools of `structure`: exact algebra, power series, linear algebra modulo a prime, text."""

import numpy as np
import pytest
import sympy as sp

from bayesperiodic._expressions import parse
from bayesperiodic.symmetry import determining
from bayesperiodic.symmetry.determining import Algebra
from bayesperiodic.symmetry.invariants import differentiated, series
from bayesperiodic.symmetry.structure import written

x, y, a, b = sp.symbols("x y a b", real=True)


@pytest.mark.parametrize(
    "zero",
    [
        sp.sin(a * x) ** 2 + sp.cos(a * x) ** 2 - 1,
        sp.cosh(x) ** 2 - sp.sinh(x) ** 2 - 1,
        sp.sqrt(x**2 + a**2) ** 3 - (x**2 + a**2) * sp.sqrt(x**2 + a**2),
        sp.sqrt(a / b) * sp.sqrt(a * b) ** 3 - sp.sqrt(a / b) * a * b * sp.sqrt(a * b),
        sp.sign(x) ** 3 - sp.sign(x),
        sp.exp(2 * x - a) * sp.exp(a) - sp.exp(x) ** 2,
        sp.tanh((x + x * y) / a) - sp.tanh(x * (1 + y) / a),
        1 / (1 + a * x) - (1 - a * x) / (1 - a**2 * x**2),
        sp.pi * x - x * sp.pi,
    ],
)
def test_identities_are_recognised(zero):
    algebra = Algebra([zero, a * x], [x, y])
    assert algebra.is_zero(zero)
    assert not algebra.is_zero(zero + a * x)


@pytest.mark.parametrize("other", [sp.tanh(x) - sp.tanh(2 * x), sp.sqrt(x) - sp.sqrt(a), sp.sign(x) - 1])
def test_nonzero_expressions_are_not_identified_as_zero(other):
    assert not Algebra([other], [x, y]).is_zero(other)


@pytest.mark.parametrize(
    "expression",
    [
        sp.tanh(x * y) / (1 + x**2),
        sp.exp(x) * sp.sqrt(2 + y),
        sp.atan(3 * x) - y**3,
        (2 + x) ** y,
        sp.sign(x - 1) * x**2,
        sp.log(3 + x) * sp.cos(sp.pi * y),
    ],
)
def test_power_series_are_taylor_series(expression):
    t = sp.Symbol("t")
    along = {x: sp.Rational(3, 10) + 2 * t - t**2, y: sp.Rational(-1, 5) + t / 3 + t**3}
    order = 5
    coefficients = {
        s: np.array([[complex(sp.Poly(e, t).coeff_monomial(t**k))] for k in range(order)]) for s, e in along.items()
    }
    # The sign is constant near t = 0.
    exact = expression.subs(sp.sign(x - 1), -1).subs(along)
    wanted = [float(sp.diff(exact, t, k).subs(t, 0)) / float(sp.factorial(k)) for k in range(order)]
    np.testing.assert_allclose(series(expression, coefficients)[:, 0].real, wanted, rtol=1e-12, atol=1e-13)


def test_power_series_propagate_complex_steps():
    values = {x: np.array([[0.4 + 1e-30j], [1.0]]), y: np.array([[2.0 + 0j], [0.0]])}
    found = series(sp.sin(x * y), values)[:, 0].imag / 1e-30
    np.testing.assert_allclose(found, [2 * np.cos(0.8), -4 * np.sin(0.8)], rtol=1e-14)


def test_unknown_functions_of_two_arguments_raise():
    with pytest.raises(TypeError):
        series(sp.Function("f")(x, y), {x: np.ones((2, 1), complex), y: np.ones((2, 1), complex)})


def test_differentiated_power_series_has_the_exact_coefficients():
    np.testing.assert_array_equal(differentiated(np.array([1.0, 2.0, 3.0, 4.0])), [2.0, 6.0, 12.0, 0.0])


def test_the_modulus_is_prime():
    assert sp.isprime(determining.PRIME)


def test_null_spaces_modulo_the_prime_are_exact():
    random = np.random.default_rng(3)
    matrix = random.integers(-9, 9, (4, 7)) @ random.integers(-9, 9, (7, 9))
    vectors = determining.nullspace(matrix)
    assert len(vectors) == 9 - np.linalg.matrix_rank(matrix)
    assert not (matrix.astype(object) @ vectors.T.astype(object) % determining.PRIME).any()


def test_circuits_of_a_plane_are_the_vectors_with_a_zero():
    """Each combination of the two rows that has a zero entry has no smaller support."""
    rows = np.array([[1, 0, 1, 1], [0, 1, 1, 2]])
    found = determining.integer_circuits(rows, np.ones(4, dtype=int))
    assert {tuple(v) for v in found} == {(1, 0, 1, 1), (0, 1, 1, 2), (-1, 1, 0, 1), (2, -1, 1, 0)}


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (b / (a * x**2), "b/(x**2*a)"),
        (-a / (a * b - 1), "a/(1 - a*b)"),
        (a - b / 2, "a - b/2"),
        (-(a + b) * x, "-x*(a + b)"),
        (sp.Rational(-3, 2) / a, "-3/(2*a)"),
        ((a + b) ** 2 / (a - b), "(a + b)**2/(a - b)"),
        (sp.sqrt(a + b), "(a + b)**(1/2)"),
        (sp.exp(-a * b) * x, "x*exp(-a*b)"),
        (1 / a, "1/a"),
        (sp.S.One, "1"),
        (sp.pi * a, "a*pi"),
        (a * (b - 1) * (x - 1), "a*(1 - x)*(1 - b)"),
    ],
)
def test_expression_text_follows_the_order_of_the_names_and_parses_to_the_same_value(expression, text):
    names = {x: "x", y: "y", a: "a", b: "b"}
    assert written(expression, names) == text
    values = {"x": 0.3, "y": 0.8, "a": 1.7, "b": 0.4}
    exact = float(expression.subs({s: values[n] for s, n in names.items()}))
    np.testing.assert_allclose(parse("text", text, values).value(values), exact, rtol=1e-14)
