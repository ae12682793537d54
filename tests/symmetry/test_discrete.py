"""Discrete symmetries from the equations."""

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from tests.known import formula_model

TWO_FILTERS = bp.Model(
    "two_filters",
    states=["x", "z"],
    inputs=["u"],
    parameters=["a", "b"],
    equations=lambda s, p, u: [s.dx + p.a * s.x - u.u, s.dz + p.b * s.z - u.u],
    outputs=lambda s, p, u: {"y": s.x + s.z},
)
HIDDEN = bp.Model(
    "hidden",
    states=["x", "z"],
    inputs=["u"],
    parameters=["a", "b"],
    equations=lambda s, p, u: [s.dx + s.x - p.a * s.z - u.u, s.dz + s.z + s.z**3 - p.b * s.x],
    outputs=lambda s, p, u: {"x": s.x},
)


def found(model, **settings):
    structure = bp.structure(model, **settings)
    return structure, [(one.kind, one.transformation) for one in structure.discrete]


@pytest.mark.parametrize(
    ("parameters", "output", "kind", "images"),
    [
        (["a"], lambda p, u: p.a**2 * u.x, "sign change", {"a": "-a"}),
        (["a", "b"], lambda p, u: p.a * sp.tanh(p.b * u.x), "sign change", {"a": "-a", "b": "-b"}),
        (["a", "b"], lambda p, u: p.b * sp.cos(p.a * u.x), "sign change", {"a": "-a"}),
        (["a", "b"], lambda p, u: (p.a + p.b) * u.x + p.a * p.b * u.x**2, "exchange", {"a": "b", "b": "a"}),
    ],
    ids=["square", "odd function", "even function", "sum and product"],
)
def test_symmetries_of_formulas_are_found(parameters, output, kind, images):
    structure, discrete = found(formula_model("formula", parameters, lambda p, u, s: {"y": output(p, u)}))
    assert discrete == [(kind, images)]
    assert f"{kind}: {', '.join(f'{n} -> {i}' for n, i in images.items())}" in repr(structure)
    assert set(structure.table["verdict"]) == {"determined"}


@pytest.mark.parametrize(
    "output",
    [
        lambda p, u: p.a**2 * u.x + p.a * u.dx,
        lambda p, u: p.a * u.x + p.b * u.dx,
        lambda p, u: p.a * p.b * u.x,
        lambda p, u: (p.a + p.b) * u.x,
    ],
    ids=["odd and even", "separate", "scaling", "shift"],
)
def test_other_formulas_have_none_beside_continuous_symmetries(output):
    assert found(formula_model("formula", ["a", "b"], lambda p, u, s: {"y": output(p, u)}))[1] == []


def test_states_that_are_not_measured_change_with_the_parameters():
    assert found(TWO_FILTERS)[1] == [("exchange", {"a": "b", "b": "a", "x": "z", "z": "x"})]
    assert found(HIDDEN)[1] == [("sign change", {"a": "-a", "b": "-b", "z": "-z"})]
    assert found(TWO_FILTERS, fixed=["a"])[1] == []


def test_model_answers_equally_at_the_image():
    """The hidden state's solution of the image is that of the parameters, with the other sign."""
    wave = {"u": np.cos(2 * np.pi * np.arange(64) / 64)}
    one, other = (
        bp.solve_periodic(HIDDEN, {"a": sign * 0.7, "b": sign * 1.3}, wave, frequency=0.2, samples=64)
        for sign in (1.0, -1.0)
    )
    assert other.outputs["x"] == pytest.approx(one.outputs["x"], abs=1e-12)
    assert other.states["z"] == pytest.approx(-one.states["z"], abs=1e-12)


def test_dry_friction_of_the_pendulum_allows_two_signs():
    fixed = ["a", "g", "m"]
    assert found(bp.models.pendulum, fixed=fixed)[1] == [("sign change", {"k1": "-k1", "v0": "-v0"})]
    assert found(bp.models.pendulum, fixed=[*fixed, "v0"])[1] == []
