import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.reporting import html


def shown(markup: str) -> str:
    """Return what a reader sees, without invisible signs."""
    return "".join(ElementTree.fromstring(markup).itertext()).replace("\u2062", "")


def equations(*expressions):
    model = bp.Model(
        "printed",
        states=["x"],
        inputs=["force"],
        parameters=["a", "mu", "theta4", "omega0"],
        equations=lambda s, p, u: [s.ddx - u.force],
        outputs=lambda s, p, u: {f"y{i}": e(s, p, u) for i, e in enumerate(expressions)},
    )
    return [shown(row).partition("=")[2] for row in html.outputs(model)]


@pytest.mark.parametrize(
    "name, written",
    [
        ("theta4", "<msub><mi>θ</mi><mn>4</mn></msub>"),
        ("mu", "<mi>μ</mi>"),
        ("omega0", "<msub><mi>ω</mi><mn>0</mn></msub>"),
        ("k_alpha2", "<msub><mi>k</mi><mrow><mi>α</mi><mn>2</mn></mrow></msub>"),
        ("m_T", "<msub><mi>m</mi><mi>T</mi></msub>"),
        ("Kx", "<mi>Kx</mi>"),
        ("gain_heave", "<msub><mi>gain</mi><mi>heave</mi></msub>"),
    ],
)
def test_names_are_typeset_with_greek_letters_and_subscripts(name, written):
    assert html.symbol(name) == f"<math>{written}</math>"


def test_derivatives_are_dots_over_the_letter_alone():
    (row,) = html.equations(bp.models.duffing)
    assert shown(row) == "mx¨+cx˙+kx+k3x3=force"
    assert '<mover accent="true"><mi>x</mi><mo>¨</mo></mover>' in row
    assert (
        '<msub><mover accent="true"><mi>x</mi><mo>¨</mo></mover><mn>1</mn></msub>'
        in html.equations(bp.models.chain(2))[0]
    )


def test_terms_without_states_are_on_the_right_hand_side():
    assert shown(html.equations(bp.models.silverbox)[0]).endswith("=gdrive+u0")
    assert shown(html.equations(bp.models.van_der_pol)[0]) == "x¨−μωx˙(1−x2)+ω2x=0"
    assert shown(html.equations(bp.models.landing_gear())[0]).endswith("=force−θ11")


def test_functions_and_numbers_print_as_they_are_read():
    printed = equations(
        lambda s, p, u: sp.sign(s.dx) * p.a,
        lambda s, p, u: bp.smooth_sign(s.dx, p.a) * abs(s.dx),
        lambda s, p, u: sp.Piecewise((s.x, s.x > p.mu), (0, True)),
        lambda s, p, u: 2.5e-7 * s.x + 0.1 * u.force,
        lambda s, p, u: p.theta4 * sp.cos(2 * sp.pi * s.tau) / s.frequency,
    )
    assert printed[0] == "asgn(x˙)"
    assert printed[1] == "tanh(x˙a)|x˙|"
    assert printed[2] in ("{xif\u00a0x>μ0otherwise", "{xif\u00a0μ<x0otherwise")
    assert printed[3] == "2.5×10−7x+0.1force"
    assert printed[4] == "θ4cos(2πτ)f"


@pytest.mark.parametrize("model", [bp.models.pendulum, bp.models.landing_gear(), bp.models.flutter, bp.models.dahl])
def test_every_model_gives_sound_markup_that_names_all_its_parameters(model):
    rows = [*html.equations(model), *html.outputs(model)]
    assert not re.search(r"p_|s_d|u_|NaN|&\w+;", "".join(rows).replace("&lt;", "").replace("&gt;", ""))
    whole = "".join(rows)
    used = set().union(*(e.free_symbols for e in (*model.equations, *model.output_expressions)))
    for name, symbol in model.parameter_symbols.items():
        inner = html.symbol(name).removeprefix("<math>").removesuffix("</math>")
        assert (inner in whole) == (symbol in used)


@pytest.mark.parametrize(
    "value, sd", [(768.123, 4.5678), (-3e-9, 2e-11), (2.5e8, 3e6), (0.0, 1e-4), (1e-3, 1e-9), (5.0, 700.0)]
)
def test_rounding_loses_less_than_a_hundredth_of_a_standard_deviation(value, sd):
    rounding = html.Rounding.of(value, sd)
    for x in (value, value + 1.7 * sd, sd):
        mantissa, _, power = rounding.text(x).replace("−", "-").partition("×10")
        power = power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
        assert float(mantissa) * 10.0 ** int(power or 0) == pytest.approx(x, abs=0.0051 * sd + 1e-15 * abs(x))


def test_numbers_units_and_intervals_have_raised_powers():
    assert [html.number(x) for x in (-0.5, 1.2345e-9, float("nan"))] == ["−0.5", "1.23×10⁻⁹", "–"]
    assert [html.unit(text) for text in ("m/s^2", "")] == ["m/s²", "–"]
    rounding = html.Rounding.of(768.123, 4.5678)
    assert [rounding.text(768.123), rounding.text(-4.5678)] == ["768.12", "−4.57"]
    assert html.Rounding.of(5e-3, 2e-6).text(5e-3) == "5.00000×10⁻³"
    assert html.Rounding(-3, 1).interval(4e-3, 5.1e-3) == "(4.0 … 5.1)×10⁻³"
    assert html.Rounding(0, 1).interval(-1.0, 2.0) == "−1.0 … 2.0"


def test_base_of_a_condensed_model_is_shown():
    """The load is −M·r times the acceleration, and an absolute motion is the relative one and that of the base."""
    model = bp.Model.from_matrices(
        "tower",
        mass={"m": np.eye(2)},
        stiffness=np.eye(2),
        base={"table": (np.array([1.0, 0.5]), "velocity")},
        outputs={"top": (1, "absolute acceleration"), "drift": (0, "relative displacement")},
        condensed=True,
    )
    (motion,) = html.equations(model)
    assert shown(motion) == "mM0x¨+K0x=−mM0r0table˙"
    assert [shown(row) for row in html.outputs(model)] == ["top=x¨1+0.5table˙", "drift=x0"]
