import math
import pickle

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.diagnostics.candidates import Term, extended, of_elements


def spring(**changes):
    arguments = {
        "states": ["x"],
        "inputs": ["force"],
        "parameters": {"m": "kg", "k": "N/m"},
        "equations": lambda s, p, u: [p.m * s.ddx + p.k * s.x - u.force],
        "outputs": lambda s, p, u: {"displacement": s.x},
    }
    return bp.Model("spring", **(arguments | changes))


def test_order_of_each_state_is_recognised_by_its_derivatives():
    model = spring(states=["x", "T"], equations=lambda s, p, u: [p.m * s.ddx + s.T - u.force, s.dT + p.k * s.x])
    assert model.orders == {"x": 2, "T": 1}


def test_input_derivatives_are_recognised():
    model = spring(outputs=lambda s, p, u: {"displacement": s.x + u.ddforce})
    assert model.input_derivatives() == {"force": 2}
    assert spring().input_derivatives() == {"force": 0}


def test_autonomous_means_neither_inputs_nor_time():
    assert spring(inputs=[], equations=lambda s, p, u: [p.m * s.ddx + p.k * s.x]).autonomous
    assert not spring().autonomous
    assert not spring(inputs=[], equations=lambda s, p, u: [p.m * s.ddx + p.k * s.x * sp.cos(s.tau)]).autonomous


@pytest.mark.parametrize("condensed", [False, True])
def test_copies_keep_nothing_that_was_computed_from_the_equations(condensed):
    """A model with a further term is another one, also if the definition of the first was computed before."""
    model = bp.Model.from_matrices(
        "spring", mass=np.eye(1), stiffness=np.eye(1), forces={"force": 0}, outputs={"x": (0, "displacement")},
        elements=[bp.elements.Element("stop", bp.elements.cubic, 0)], condensed=condensed,
    )  # fmt: skip
    before, symbols = model.definition, (of_elements(model) if condensed else model).state_symbols
    place, name = ("force of stop", "stop") if condensed else ("equation of x0", "x0")
    other = extended(model, {"c": Term(place, f"{name}**2", symbols[name] ** 2)})
    assert other.definition != before == model.definition
    assert pickle.loads(pickle.dumps(other)).definition == other.definition


def test_latex_writes_dots_and_greek():
    text = bp.models.dahl.latex()
    assert r"\dot{w}" in text and r"\rho" in text and r"\dot{\mathrm{displacement}}" in text


def test_model_can_be_pickled():
    copy = pickle.loads(pickle.dumps(spring()))
    assert copy.equations == spring().equations


def test_piecewise_min_and_sign_compile_and_agree_with_sympy():
    model = bp.Model(
        "kinks",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dx + sp.sign(s.x) + sp.Max(s.x, p.a) + abs(s.x) * s.x - u.u],
        outputs=lambda s, p, u: {"y": sp.Piecewise((s.x, s.x > 0), (p.a * s.x, True))},
    )
    states = np.array([[0.3, 0.1, 0.0], [-0.4, 0.2, 0.0]])
    kernels = model.kernels
    columns = kernels.evaluate("residual_jacobian", states, np.zeros((2, 3)), np.array([0.1]), np.zeros(2), 1.0)
    assert columns[:, 0] == pytest.approx([0.1 + 1 + 0.3 + 0.09, 0.2 - 1 + 0.1 - 0.16])
    assert columns[:, 1] == pytest.approx([1 + 0.6, 0.8])
    y = kernels.evaluate("outputs", states, np.zeros((2, 3)), np.array([0.1]), np.zeros(2), 1.0)
    assert y[:, 0] == pytest.approx([0.3, -0.04])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": ["tau"]}, "states: must be neither reserved nor used elsewhere .*'tau'.*got 'tau'"),
        ({"parameters": ["m", "m", "k"]}, "must differ, got 'm' twice"),
        ({"inputs": ["x"]}, "neither reserved nor used elsewhere .*got 'x'"),
        ({"states": ["x", "dx"]}, "states: must not contain derivatives, got 'dx' and 'x'; .* write s.dx"),
        ({"inputs": ["u", "ddu"]}, "inputs: must not contain derivatives, got 'ddu' and 'u'; .* write u.ddu"),
        (
            {"equations": lambda s, p, u: [p.k * s.x - u.force]},
            "states: must have a derivative in an equation, got 'x'",
        ),
        (
            {"equations": lambda s, p, u: [s.ddx, s.dx]},
            "equations: must be 1, one for each of the states .'x'., got 2",
        ),
        (
            {"equations": lambda s, p, u: [s.ddx + sp.Symbol("stranger")]},
            "must contain only symbols of s, p and u, got stranger",
        ),
        ({"equations": lambda s, p, u: ["s.ddx"]}, "equations: must consist of .*, got 's.ddx', .* attribute"),
        ({"equations": ["m*ddx = force"]}, r"without '=', got 'm\*ddx = force'; write left = right as left - \(right"),
        ({"equations": "m*ddx - force"}, "equations: must return a list, .* alone"),
        ({"equations": lambda s, p, u: [s.ddx + sp.I * s.x]}, "equations: must be real and finite, got .*I"),
        ({"outputs": lambda s, p, u: {"y": s.x * sp.Integer(10) ** 400}}, "outputs: must be real and finite"),
        ({"equations": lambda s, p, u: [s.ddx + np.cos(s.x)]}, r"must use SymPy's functions .*sp\.cos\(s\.x\)"),
        ({"equations": lambda s, p, u: [s.ddx + np.sign(s.dx)]}, "must use SymPy's functions .*sp.sign"),
        ({"equations": lambda s, p, u: [s.ddx + math.cos(s.x)]}, "must use SymPy's functions"),
        ({"equations": lambda s, p, u: [s.ddx + np.exp(2 * s.x)]}, "must use SymPy's functions"),
        ({"equations": lambda s, p, u: [s.ddx if s.x > 0 else s.dx]}, "sp.Piecewise instead of if"),
        ({"parameters": ["m", "K", "\u212a"]}, r"normal form NFKC.* \(U\+212A\); write 'K' \(U\+004B\)"),
        ({"parameters": ["m", "k", "\uff4b"]}, r"parameters: .*normal form.*U\+FF4B"),
        ({"states": ["\u00b5"]}, r"states: .*got '\u00b5' \(U\+00B5\); write '\u03bc' \(U\+03BC\)"),
        ({"outputs": lambda s, p, u: {"y\u2170": s.x}}, "outputs: .*normal form"),
        ({"parameters": ["m", "k", "\ud800"]}, "parameters: must be Python identifiers"),
        ({"parameters": ["m", "k", "a" * 5000]}, "parameters: must have at most 200 letters, got 5000 in 'aa"),
        ({"units": {"x": "\ud800"}}, r"units\['x'\]: must be a text of Unicode characters"),
        ({"equations": lambda s, p, u: [sp.Eq(s.ddx, u.force)]}, "an equation left = right as left - right"),
        ({"equations": lambda s, p, u: s.ddx + p.k * s.x}, "equations: must return a list, .* alone"),
        ({"outputs": lambda s, p, u: [s.x]}, "outputs: must be a mapping, such as .*"),
        ({"outputs": lambda s, p, u: {}}, "at least one output"),
        ({"angles": ["phi"]}, "angles: must be one of 'x', 'displacement', got 'phi'"),
        ({"units": {"mass": "kg"}}, "units: must be .*got 'mass'"),
    ],
)
def test_error_names_the_invalid_part_of_the_model(changes, message):
    with pytest.raises(ValueError, match=message):
        spring(**changes)


def test_equations_and_outputs_may_be_texts():
    written = spring(parameters=["m", "k"], equations=["m*ddx + k*x**3/8 - force"], outputs={"y": "2*dx"})
    other = spring(
        parameters=["m", "k"],
        equations=lambda s, p, u: [p["m"] * s.ddx + p["k"] * s["x"] ** 3 / 8 - u.force],
        outputs=lambda s, p, u: {"y": 2 * s.dx},
    )
    assert written.equations == other.equations and written.output_expressions == other.output_expressions
    with pytest.raises(ValueError, match="equations: must have a single meaning of 'x'"):
        spring(parameters=["x", "m"], equations=["m*ddx + x - force"])


def test_names_that_python_writes_differently_are_different_parameters():
    """In code, k and a full-width k are one name; with two stiffnesses named so, half of the force would be lost."""
    model = spring(parameters=["m", "k", "\u03bc"], equations=["m*ddx + (k + \u00b5)*x - force"])
    assert {str(s) for s in model.equations[0].free_symbols} >= {"p_k", "p_\u03bc"}


def test_unknown_parameter_error_suggests_the_nearest_name():
    with pytest.raises(AttributeError, match=r"parameters: must be one of 'm', 'k', got 'mm'\. Did you mean 'm'\?"):
        spring(equations=lambda s, p, u: [p.mm * s.ddx])


def test_unknown_input_error_suggests_the_nearest_name():
    with pytest.raises(AttributeError, match="inputs: must be .*got 'forces'.*Did you mean 'force'"):
        spring(equations=lambda s, p, u: [s.ddx - u.forces])


def test_error_names_a_function_that_cannot_be_compiled():
    model = spring(equations=lambda s, p, u: [s.ddx + sp.Function("mystery")(s.x) - u.force])
    with pytest.raises(ValueError, match=r"mystery\(s__x\).*cannot be compiled"):
        model.kernels  # noqa: B018


def test_smooth_sign_and_absolute_value_have_the_stated_width():
    x = sp.Symbol("x")
    assert float(bp.smooth_sign(x, 0.2).subs(x, 0.2)) == pytest.approx(np.tanh(1))
    assert float(bp.smooth_abs(x, 0.2).subs(x, 20)) == pytest.approx(19.8, abs=2e-3)
    assert float(sp.diff(bp.smooth_abs(x, 0.2), x, 2).subs(x, 0)) == pytest.approx(5)
    with pytest.raises(ValueError, match="width: must be .*got -1"):
        bp.smooth_sign(x, -1)


@pytest.mark.parametrize(
    "changed",
    [
        {"equations": lambda s: [s.dx]},
        {"equations": lambda s, p, u, t: [s.dx]},
        {"outputs": lambda s, p: {"x": s.x}},
    ],
)
def test_functions_of_other_arguments_are_refused(changed):
    given = {"equations": lambda s, p, u: [s.dx], "outputs": lambda s, p, u: {"x": s.x}} | changed
    with pytest.raises(ValueError, match=rf"{next(iter(changed))}: must be a function of \(s, p, u\), got"):
        bp.Model("m", states=["x"], parameters=[], **given)


@pytest.mark.parametrize("written", [None, 5])
def test_equations_that_are_no_list_are_refused(written):
    with pytest.raises(ValueError, match=f"equations: must return a list, one expression per state, got {written}"):
        bp.Model("m", states=["x"], parameters=[], equations=lambda s, p, u: written, outputs={"x": "x"})


def test_parameter_in_no_equation_is_named_in_a_warning():
    with pytest.warns(UserWarning, match="no equation and no output of 'm' contains 'b', 'd', so that no data"):
        bp.Model("m", states=["x"], parameters=["a", "b", "c", "d"], equations=["dx + a*x"], outputs={"x": "c*x"})
