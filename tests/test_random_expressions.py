"""Random expressions against Python's own evaluation, complex steps and SymPy; any other text is one error."""

import ast
import cmath
import math
import string

import numpy as np
import pytest
import sympy as sp
from hypothesis import assume, example, given
from hypothesis import strategies as st

from bayesperiodic import _expressions
from bayesperiodic._expressions import OPERATIONS, parse
from tests.test__expressions import counted_operations

NAMES = ("k", "m", "l_2", "μ", "exp_")
PYTHON = {name: getattr(math, name) for name in OPERATIONS if name != "abs"} | {"abs": abs, "pi": math.pi}
COMPLEX = {name: getattr(cmath, name) for name in OPERATIONS if name != "abs"} | {"pi": math.pi}

numbers = st.one_of(
    st.integers(0, 12).map(str),
    st.floats(0.05, 20.0).map(lambda x: f"{x:.3g}"),
    st.sampled_from(["1e-3", "0x10", "1_0", "2.", ".5", "pi"]),
)
atoms = numbers | st.sampled_from(NAMES)


def larger(parts):
    return st.one_of(
        st.tuples(parts, st.sampled_from(["+", " - ", "*", " /"]), parts).map("".join),
        st.tuples(parts, parts).map(lambda pair: f"({pair[0]})*({pair[1]})"),
        st.tuples(parts, st.sampled_from(["2", "3", "-1", "0.5", "-2", "k", "0"])).map(lambda p: f"({p[0]})**{p[1]}"),
        st.tuples(st.sampled_from(["-", "+", "--"]), parts).map("".join),
        st.tuples(st.sampled_from([*OPERATIONS]), parts).map(lambda pair: f"{pair[0]}({pair[1]})"),
    )


expressions = st.recursive(atoms, larger, max_leaves=12).filter(lambda text: len(text) < 400)
points = st.fixed_dictionaries({name: st.floats(0.1, 3.0) for name in NAMES})


def and_each_function(test):
    """Add an example of each function to a property."""
    for name in PYTHON.keys() & COMPLEX.keys() - {"pi"}:
        test = example(f"{name}(k) + {name}(0.3*m)", {name: 0.7 for name in NAMES})(test)
    return test


def evaluated(text, values, functions):
    """Return Python's own value of the expression; skip those that it cannot compute."""
    try:
        result = eval(text, {"__builtins__": {}}, functions | values)
    except (ValueError, ArithmeticError, TypeError):
        assume(False)
    assume(abs(result) < 1e60 and (functions is COMPLEX or not isinstance(result, complex)))
    return result


@and_each_function
@given(expressions, points)
def test_value_is_that_of_python(text, values):
    exact = evaluated(text, values, PYTHON)
    try:
        expression = parse("e", text, NAMES)
    except ValueError as error:
        assert "exponent" in str(error) or "part without names is not finite" in str(error)
        return
    scale = max(abs(exact), 1e-3)
    found = float(expression.value(values))
    # Python's powers, sines and exponentials of large numbers may differ by a unit in the last place.
    assert found == pytest.approx(exact, rel=1e-9, abs=1e-9 * scale) or sensitive(text, values, exact)


def sensitive(text, values, exact):
    """Return whether rounding of the values by one unit changes the value as much."""
    moved = {name: np.nextafter(value, 9.0) for name, value in values.items()}
    return not evaluated(text, moved, PYTHON) == pytest.approx(exact, rel=1e-10, abs=1e-12)


@and_each_function
@given(expressions.filter(lambda text: "abs" not in text), points)
def test_derivatives_are_those_by_complex_steps(text, values):
    evaluated(text, values, PYTHON)
    expression = parse("e", text, NAMES)
    gradient = expression.gradient(values, by=NAMES)
    for name in NAMES:
        step = 1e-25
        moved = values | {name: complex(values[name], step)}
        exact = evaluated(text, moved, COMPLEX)
        slope = exact.imag / step if isinstance(exact, complex) else 0.0
        assume(abs(slope) < 1e40)
        if not np.isfinite(gradient[name]):  # a root or power of 0 has no derivative
            assert "sqrt" in text or "**" in text
            continue
        assert float(gradient[name]) == pytest.approx(slope, rel=1e-6, abs=1e-9)


@and_each_function
@given(expressions, points)
def test_symbolic_form_has_the_same_value(text, values):
    exact = evaluated(text, values, PYTHON)
    expression = parse("e", text, NAMES)
    symbols = {name: sp.Symbol(name, real=True) for name in NAMES}
    try:
        symbolic, degree = expression.symbolic("e", symbols)
    except ValueError as error:
        assert "of a degree up to 20, got" in str(error)
        return
    assert 0.0 <= degree <= _expressions.MAX_DEGREE or not expression.names
    found = complex(symbolic.subs({symbols[name]: value for name, value in values.items()}))
    assert found == pytest.approx(exact, rel=1e-6, abs=1e-9)


PIECES = """( ) ** * + - / 9 sin exp . , [ ] lambda : 1e if else k.real __class__ = := ' \\ # @ ~ None True 1j"""
junk = st.one_of(
    st.text(max_size=60),
    st.text(string.punctuation + string.digits + " \n\tkmeEjxinf_", max_size=40),
    st.lists(
        st.sampled_from([*NAMES, *PIECES.split(), "9" * 30]),
        max_size=25,
    ).map(" ".join),
)


@given(junk)
def test_any_other_text_is_one_error_after_little_work(text):
    """The work is counted in nodes of the syntax tree, at most as many as characters, and in numbers computed."""
    with pytest.MonkeyPatch.context() as patch:
        operations = counted_operations(patch)
        patch.setattr(ast, "literal_eval", None)
        patch.setattr("builtins.eval", None)
        try:
            expression = parse("tied", text, NAMES)
        except ValueError as error:
            assert str(error).startswith("tied: ") and "must" in str(error) and len(str(error)) < 900
        else:
            assert {*expression.names} <= {*NAMES}
            assert len(expression.steps) <= 2 * len(text)
    assert len(operations) <= len(text)
