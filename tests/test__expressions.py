from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from bayesperiodic import _expressions
from bayesperiodic._expressions import MAX_LENGTH, OPERATIONS, parse, parse_all

VALUES = {"k": 0.7, "m": 1.3, "b": 0.4}
# Each text with the same in Python, which also takes complex numbers.
TEXTS = {
    "k/(m*b**2)": lambda k, m, b: k / (m * b**2),
    "-k + +m - 2*b": lambda k, m, b: -k + m - 2 * b,
    "-k**2**b": lambda k, m, b: -(k ** (2**b)),
    "2**-k": lambda k, m, b: 2**-k,
    "k**m/b**-1.5": lambda k, m, b: k**m / b**-1.5,
    "sqrt(k/m)/(2*pi)": lambda k, m, b: np.sqrt(k / m) / (2 * np.pi),
    "exp(-b*k)*sin(m) + cos(k*m)": lambda k, m, b: np.exp(-b * k) * np.sin(m) + np.cos(k * m),
    "log(k)*tan(b) - atan(m/k)": lambda k, m, b: np.log(k) * np.tan(b) - np.arctan(m / k),
    "sinh(k)+cosh(b*b)*tanh(m)": lambda k, m, b: np.sinh(k) + np.cosh(b * b) * np.tanh(m),
    " 1e-3*(k\n+ m*0x10) ": lambda k, m, b: 1e-3 * (k + m * 16),
    "k**float(0.5) - 2*float(-0.5)*m/float(3)": lambda k, m, b: k**0.5 + m / 3.0,
}
SILLY = [
    "__import__('os').system('x')",
    "().__class__",
    "x if y else z",
    "9**9**9**9",
    "k**9**9**9**9",
    "(9**9)**(9**9)*k",
    "10.0**300*10.0**300",
    "(" * 100_000 + "k" + ")" * 100_000,
    "(" * 400 + "k" + ")" * 400,
    "-" * 999 + "?",
    "lambda: 0",
    "k1; k2",
    "k\nm",
    "",
    "   ",
    "k[0]",
    "k.real",
    "True",
    "None",
    "...",
    "1j",
    "'a'",
    "b'a'",
    "f'{k}'",
    "k\0",
    "1e999",
    "9" * 500,
    "9" * 5000,
    "1/0",
    "log(0)",
    "sqrt(-1)*k",
    "k**1001",
    "k == m",
    "k < m",
    "k and m",
    "float(k)",
    "float(0.5, 2)",
    "float('1')",
    "not k",
    "~k",
    "k ^ 2",
    "k // m",
    "k % m",
    "k @ m",
    "k << 999999999",
    "(k, m)",
    "[k]",
    "{k}",
    "{k: m}",
    "[k for k in m]",
    "(k := 1)",
    "k = 1",
    "sin",
    "sin()",
    "sin(k, m)",
    "sin(*k)",
    "sin(x=k)",
    "sin(k, x=m)",
    "sin(sin)",
    "k(m)",
    "eval('1')",
    "eval(k)",
    "open(k)",
    "(sin)(k)(k)",
    "sin.__call__(k)",
    "import os",
    "await k",
    "yield k",
    "nan",
    "inf",
    "__builtins__",
    None,
    3.0,
    b"k",
]


@pytest.mark.parametrize("text", TEXTS)
def test_value_and_derivatives_against_complex_steps(text):
    expression = parse("e", text, VALUES)
    assert float(expression.value(VALUES)) == pytest.approx(TEXTS[text](**VALUES), rel=1e-14)
    gradient = expression.gradient(VALUES, by=VALUES)
    for name in VALUES:
        stepped = TEXTS[text](**(VALUES | {name: VALUES[name] + 1e-30j})).imag / 1e-30
        assert float(gradient[name]) == pytest.approx(stepped, rel=1e-13, abs=1e-16)


@pytest.mark.parametrize("name", OPERATIONS)
def test_every_function_has_its_derivative(name):
    expression = parse("e", f"{name}(k)", ["k"])
    k, step = np.array([0.3, 1.1, 2.5]), 1e-6
    function = {"atan": np.arctan}.get(name) or getattr(np, name)
    assert np.array_equal(expression.value({"k": k}), function(k))
    assert expression.gradient({"k": k})["k"] == pytest.approx(
        (function(k + step) - function(k - step)) / (2 * step), rel=1e-8
    )


def test_absolute_value_has_no_derivative_at_zero():
    slopes = parse("e", "abs(k)", ["k"]).gradient({"k": np.array([-2.0, 0.0, 3.0])})["k"]
    assert np.array_equal(slopes, [-1.0, np.nan, 1.0], equal_nan=True)


def test_powers_of_zero_and_of_negative_numbers_follow_numpy():
    square, zeroth, variable = (parse("e", text, ["k", "m"]) for text in ("k**2", "k**0", "k**m"))
    assert square.gradient({"k": [-3.0, 0.0]})["k"].tolist() == [-6.0, 0.0]
    assert zeroth.gradient({"k": [0.0]})["k"].tolist() == [0.0]
    assert variable.gradient({"k": -3.0, "m": 2.0}, by=["k"])["k"] == -6.0
    assert variable.gradient({"k": 0.0, "m": 2.0})["m"] == 0.0


def test_arrays_broadcast_and_inputs_are_not_modified():
    k, m = np.arange(1.0, 4.0)[:, None], np.arange(1, 3)
    expression = parse("e", "k/m", ["k", "m", "l"])
    assert expression.names == ("k", "m")
    assert np.array_equal(expression.value({"k": k, "m": m}), k / m)
    gradient = expression.gradient({"k": k, "m": m}, by=["l", "m"])
    assert np.array_equal(gradient["m"], -k / m**2) and np.array_equal(gradient["l"], np.zeros((3, 2)))
    alone = parse("e", "k", ["k"]).value({"k": k})
    alone[:] = 0.0
    assert k.ravel().tolist() == [1.0, 2.0, 3.0]


def test_constant_parts_are_folded_into_numbers():
    assert parse("e", "2*pi*sqrt(4)**-1", []).steps == (np.pi,)
    assert parse("e", "9**9", []).steps == (9.0**9,)


def test_names_may_shadow_pi_and_functions_and_be_unicode():
    assert parse("e", "pi*2", ["pi"]).value({"pi": 3.0}) == 6.0
    assert parse("e", "exp + exp(exp)", ["exp"]).value({"exp": 0.0}) == 1.0
    micro = "\N{MICRO SIGN}"
    assert parse("e", f"2*{micro}", [micro]).value({micro: 3.0}) == 6.0


def test_long_sums_are_parsed():
    text = "+".join(["k"] * (MAX_LENGTH // 2))
    assert parse("e", text, ["k"]).value({"k": 1.0}) == MAX_LENGTH // 2
    assert parse("e", "-" * 150 + "k", ["k"]).gradient({"k": 1.0})["k"] == 1.0


def counted_operations(patch):
    """Return a list that gets an entry for each operation on numbers while a text is parsed."""
    done = []

    def counted(value):
        def evaluate(*operands):
            done.append(value)
            return value(*operands)

        return evaluate

    for table in (_expressions.OPERATORS, _expressions.OPERATIONS):
        for key, operation in list(table.items()):
            patch.setitem(table, key, replace(operation, value=counted(operation.value)))
    return done


@pytest.mark.parametrize("text", SILLY, ids=lambda text: repr(text)[:30])
def test_other_syntax_raises_value_error_on_parsing(text, monkeypatch):
    operations = counted_operations(monkeypatch)
    with pytest.raises(ValueError, match="^tied: ") as caught:
        parse("tied", text, ["k", "m", "k1", "k2"])
    assert len(operations) <= 3
    assert len(str(caught.value)) < 600 and "must" in str(caught.value)


def test_error_names_the_text_and_the_allowed_names():
    with pytest.raises(ValueError, match=r"^c1: must consist of .*, got 'k\.real', which contains an attribute"):
        parse("c1", "k.real", ["k"])
    with pytest.raises(
        ValueError, match=r"^c1: names in 'stifness/m': must be .*got 'stifness'.*Did you mean 'stiffness'\?$"
    ):
        parse("c1", "stifness/m", ["stiffness", "m"])
    with pytest.raises(ValueError, match=r"^c1: functions in 'sinus\(k\)': must be .*got 'sinus'.* mean 'sin'\?$"):
        parse("c1", "sinus(k)", ["k"])
    with pytest.raises(ValueError, match="powers are written"):
        parse("c1", "k^2", ["k"])
    with pytest.raises(ValueError, match="exponent 3.8742e.08 is beyond"):
        parse("c1", "k**9**9", ["k"])
    with pytest.raises(ValueError, match="must be one of 'k', 'pi', got 'm'. Only k.$"):
        parse("c1", "k*m", ["k"], note="Only k.")


@pytest.mark.parametrize("text", [*TEXTS, "abs(k - m)", "1/3*k", "k**20", "(k + 1)**-20"], ids=str)
def test_sympy_expression_has_the_same_value(text):
    expression = parse("tied", text, VALUES)
    symbols = {name: sp.Symbol(name, real=True) for name in VALUES}
    symbolic, _ = expression.symbolic("tied", symbols)
    numbers = {symbols[name]: value for name, value in VALUES.items()}
    assert float(symbolic.subs(numbers)) == pytest.approx(float(expression.value(VALUES)), rel=1e-12)


@pytest.mark.parametrize("text", ["(1+k)**1000", "(k**5)**5", "k**12*m**12", "(k/(1+m)**11)**2"])
def test_high_degrees_are_refused_where_they_are_analysed(text):
    with pytest.raises(ValueError, match="^tied: must have powers and products of a degree up to 20, got .* of degree"):
        parse("tied", text, VALUES).symbolic("tied", {name: sp.Symbol(name) for name in VALUES})


def test_number_called_a_float_is_no_fraction_in_sympy():
    k = sp.Symbol("k")
    for text, expected in {
        "0.5*k": k / 2,
        "float(0.5)*k": 0.5 * k,
        "-float(0.1)*k - float(3.0)": -0.1 * k - 3.0,
        "k**float(2.0)": k**2.0,
        "2*float(0.25)*k": 0.5 * k,
        "k/float(0.3)": k / sp.Float(0.3),
    }.items():
        assert sp.srepr(parse("e", text, ["k"]).symbolic("e", {"k": k})[0]) == sp.srepr(expected)


def test_sympy_never_reads_a_text():
    """Names of SymPy's own objects are ordinary names, and constants that SymPy would expand are floats."""
    names = ["Float", "exp", "S", "Q", "beta"]
    symbols = {name: sp.Symbol(name) for name in names}
    symbolic, _ = parse("tied", "Float + exp(S)*Q/beta", names).symbolic("tied", symbols)
    assert symbolic == symbols["Float"] + sp.exp(symbols["S"]) * symbols["Q"] / symbols["beta"]
    assert parse("tied", "((2**-1000)**1000)**1000", names).symbolic("tied", symbols) == (0, 0.0)


def test_names_equal_to_python_are_refused():
    with pytest.raises(ValueError, match="is the same name as another one to Python; rename it"):
        parse("tied", "2*K", ["K", "\u212a"])


def test_new_names_are_unused_identifiers():
    assert list(parse_all("derived", {"a": "k", "b": "k*2"}, ["k"])) == ["a", "b"]
    with pytest.raises(ValueError, match="derived: must be neither reserved nor used elsewhere .*got 'k'"):
        parse_all("derived", {"k": "2*k"}, ["k"])
    with pytest.raises(ValueError, match="derived: must be Python identifiers .*got 'a b'"):
        parse_all("derived", {"a b": "2*k"}, ["k"])
    with pytest.raises(ValueError, match=r"derived\['b'\]: names in 'a': must be .*got 'a'"):
        parse_all("derived", {"a": "k", "b": "a"}, ["k"])
    with pytest.raises(ValueError, match="derived: must be a mapping, .*got 'k'"):
        parse_all("derived", "k", ["k"])


def test_error_names_the_missing_value():
    with pytest.raises(ValueError, match="values: must have .*for 'k/m', got no \\['m'\\]"):
        parse("e", "k/m", ["k", "m"]).value({"k": 1.0})
