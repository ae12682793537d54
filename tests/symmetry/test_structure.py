"""Structural identifiability, confirmed by independent substitution and by periodic solutions."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic._expressions import parse
from bayesperiodic.symmetry.determining import Generator, system_of
from bayesperiodic.symmetry.invariants import Flow, verified
from bayesperiodic.symmetry.structure import analyse_structure

GEAR = {
    "theta1": 1.0, "theta2": 0.5, "theta3": 0.6, "theta4": 1.0, "theta5": 1.2, "theta6": -0.5, "theta7": 0.3,
    "theta8": 0.2, "theta9": 0.3, "theta10": 1.5, "theta11": -0.4, "theta12": 0.1, "theta15": 1.0, "theta16": 0.7,
    "theta17": -1.5,
}  # fmt: skip
PENDULUM = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 1.0}
SHIFT = {
    "theta5": "theta5/(1 + theta6*delta)",
    "theta6": "theta6/(1 + theta6*delta)",
    "theta7": "theta7/(1 + theta6*delta)",
    "theta12": "theta12 + delta",
    "theta16": "theta16*(1 + theta6*delta)",
    "q": "q - delta",
}
TEMPERATURE = {"theta5", "theta7", "theta15", "theta16", "theta17"}


def small(states, parameters, equations, outputs, inputs=("u",)):
    """Return a model of a few lines."""
    return bp.Model("small", states=states, inputs=inputs, parameters=parameters, equations=equations, outputs=outputs)


def compartments(outputs=lambda s, p, u: {"y": s.x1}):
    """Return two compartments that exchange and both leak, input into the first one, which is measured."""
    return small(
        ["x1", "x2"],
        ["k01", "k21", "k12", "k02"],
        lambda s, p, u: [
            s.dx1 + (p.k01 + p.k21) * s.x1 - p.k12 * s.x2 - u.u,
            s.dx2 - p.k21 * s.x1 + (p.k12 + p.k02) * s.x2,
        ],
        outputs,
    )


def offset_silverbox():
    """Return the library's Silverbox with an offset of the response besides that of the input."""
    given = bp.models.silverbox
    return bp.Model(
        "offset_silverbox",
        states=given.states,
        inputs=given.inputs,
        parameters=[*given.parameters, "y0"],
        equations=lambda s, p, u: [
            s.ddy / p.w0**2 + p.c * s.dy / p.w0 + p.k1 * s.y + p.k2 * s.y**2 + p.k3 * s.y**3 - p.g * u.drive - p.u0
        ],
        outputs=lambda s, p, u: {"response": s.y + p.y0},
    )


def change_of(model, outputs, symmetry):
    """Return g(image) − factor · g and y(image) − y; derivatives of the states' images by the chain rule."""
    symbols = model.state_symbols | model.input_symbols | model.parameter_symbols
    words = symbols | {"t": sp.Symbol("t", positive=True), "delta": sp.Symbol("delta", real=True)}
    jets = model.state_symbols | model.input_symbols
    rates = {s: jets[f"d{n}"] for n, s in jets.items() if f"d{n}" in jets}
    images = {}
    for name, text in symmetry.transformation.items():
        image = sp.sympify(text, locals=words)
        images[symbols[name]] = image
        for prefix in ("d", "dd") if name in model.states else ():
            image = sum(sp.diff(image, s) * rate for s, rate in rates.items())
            images[symbols[prefix + name]] = image
    factor = sp.Matrix([[sp.sympify(e, locals=words) for e in row] for row in symmetry.factor])
    measured = [e for n, e in zip(model.outputs, model.output_expressions, strict=True) if n in outputs]
    moved = sp.Matrix(model.equations).subs(images, simultaneous=True) - factor * sp.Matrix(model.equations)
    return [*moved, *(y.subs(images, simultaneous=True) - y for y in measured)]


def unchanged(model, outputs, symmetry):
    return all(map(vanishes, change_of(model, outputs, symmetry)))


def vanishes(expression):
    """Return whether an expression is zero: a rational one is, if its numerator is."""
    numerator = sp.expand(sp.numer(sp.together(expression)))
    return numerator == 0 or (not numerator.is_polynomial() and sp.simplify(numerator) == 0)


LIBRARY = {
    "pendulum": (lambda: bp.models.pendulum, None, 8, 2),
    "silverbox": (lambda: bp.models.silverbox, None, 7, 1),
    "offset_silverbox": (offset_silverbox, None, 8, 2),
    "duffing": (lambda: bp.models.duffing, None, 4, 0),
    "dahl": (lambda: bp.models.dahl, None, 5, 0),
    "van_der_pol": (lambda: bp.models.van_der_pol, None, 2, 0),
    "chain": (lambda: bp.models.chain(3), None, 4, 0),
    "force": (lambda: bp.models.landing_gear("force"), ("displacement", "pressure"), 15, 2),
    "force, displacement": (lambda: bp.models.landing_gear("force"), ("displacement",), 15, 3),
    "force, pressure": (lambda: bp.models.landing_gear("force"), ("pressure",), 14, 3),
    "displacement": (lambda: bp.models.landing_gear("displacement"), ("force", "pressure"), 15, 2),
    "displacement, force": (lambda: bp.models.landing_gear("displacement"), ("force",), 15, 3),
    "displacement, pressure": (lambda: bp.models.landing_gear("displacement"), ("pressure",), 9, 3),
}


@pytest.fixture(scope="module")
def found():
    """Return name -> (model, measured outputs, structure), each computed at its first use."""
    known = {}

    def get(name):
        if name not in known:
            make, outputs, _, _ = LIBRARY[name]
            model = make()
            known[name] = (model, outputs or model.outputs, bp.structure(model, outputs=outputs))
        return known[name]

    return get


@pytest.mark.parametrize("name", LIBRARY)
def test_every_transformation_leaves_the_symbolic_equations_and_outputs_unchanged(name, found):
    model, outputs, structure = found(name)
    assert len(structure.symmetries) == LIBRARY[name][3]
    for symmetry in structure.symmetries:
        assert symmetry.transformation
        assert unchanged(model, outputs, symmetry)


@pytest.mark.parametrize("name", LIBRARY)
def test_rank_and_number_of_symmetries_add_up_to_the_number_of_parameters(name, found):
    _, _, structure = found(name)
    _, _, appearing, symmetries = LIBRARY[name]
    assert (structure.table.verdict != "does not appear").sum() == appearing
    assert structure.rank == appearing - symmetries
    assert structure.complete


def sensitivities(name, model, outputs):
    """Return sensitivities of periodic outputs to the logarithms of the parameters, each column of length 1."""
    tau = np.arange(128) / 128
    wave = np.cos(2 * np.pi * tau) + 0.6 * np.cos(4 * np.pi * tau + 1.0) + 0.3 * np.sin(6 * np.pi * tau)
    runs = [(0.05, 0.3, 0.3), (0.1, 0.4, 0.1), (0.2, 0.5, -0.2), (0.4, 0.8, 0.1)]
    theta = GEAR
    extra = {}
    if name == "pendulum":
        runs, theta, extra = [(f, 0, 0) for f in (1.99, 2.07, 2.2)], PENDULUM, {"winding": 1}
    elif name == "van_der_pol":
        runs, theta, extra = [(0.6, 0, 0)], {"mu": 1.3, "omega": 4.0}, {"guess": {"x": 2 * np.cos(2 * np.pi * tau)}}
    elif name.startswith("force"):
        runs = [(frequency, amplitude, 1.3 + mean) for frequency, amplitude, mean in runs]
    elif not name.startswith("displacement"):
        theta = {n: 0.4 + 0.35 * (k % 3) for k, n in enumerate(model.parameters)}
    rows = []
    for frequency, amplitude, mean in runs:
        inputs = {n: mean + amplitude * wave for n in model.inputs} or None
        solved = bp.solve_periodic(model, theta, inputs, frequency=frequency, samples=128, **extra)
        assert solved.converged
        rows += [np.stack([solved.sensitivities[y][n] * theta[n] for n in model.parameters], 1) for y in outputs]
    columns = np.concatenate(rows)
    size = np.linalg.norm(columns, axis=0)
    return columns[:, size > 0.0] / size[size > 0.0]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n == "chain")) for n in LIBRARY])
def test_sensitivities_of_periodic_solutions_have_the_same_rank(name, found):
    model, outputs, structure = found(name)
    size = np.linalg.svd(sensitivities(name, model, outputs))[1]
    assert size.size == LIBRARY[name][2]
    assert np.count_nonzero(size > 1e-9 * size[0]) == structure.rank


def test_pendulum_determines_three_friction_ratios_and_the_arm_length_through_the_drive():
    structure = bp.structure(bp.models.pendulum, fixed=["a", "g", "v0"])
    assert structure.combinations == ("k1/(m*l**2)", "k2/(m*l**2)", "k3/(m*l**2)")
    assert dict(structure.table.verdict) == {"l": "determined"} | dict.fromkeys(
        ["m", "k1", "k2", "k3"], "only in combination"
    )
    (scaling,) = structure.symmetries
    assert scaling.transformation == {n: f"{n}*t" for n in ("m", "k1", "k2", "k3")}
    said = repr(structure)
    assert "m, k1, k2, k3, which enter only by k1/(m*l**2), k2/(m*l**2), k3/(m*l**2)" in said
    assert "l through a/l (in the drive) and g/l" in said
    assert "Fix one of m, k1, k2, k3; fixing l does not help" in said


def test_pendulum_without_fixed_parameters_determines_only_length_ratios(found):
    _, _, structure = found("pendulum")
    assert set(structure.combinations) == {"k1/(m*l**2)", "k2/(m*l**2)", "k3/(m*l**2)", "a/l", "g/l"}
    assert structure.table.partners["l"] == "a, g"
    assert structure.table.verdict["v0"] == "determined"


@pytest.mark.parametrize("known", [["m"], ["k1"], ["k2"], ["k3"]])
def test_fixing_one_of_the_scaled_parameters_determines_all_others(known):
    structure = bp.structure(bp.models.pendulum, fixed=["a", "g", "v0", *known])
    assert set(structure.table.verdict) == {"determined"}
    assert structure.rank == 4


def test_fixing_the_arm_length_does_not_remove_the_scaling_symmetry():
    assert len(bp.structure(bp.models.pendulum, fixed=["a", "g", "v0", "l"]).symmetries) == 1


def test_the_landing_gear_has_the_temperature_scaling_and_the_exact_shift(found):
    for name in ("force", "displacement"):
        _, _, structure = found(name)
        scaling, shift = structure.symmetries
        assert (scaling.kind, shift.kind) == ("scaling", "shift")
        assert set(scaling.parameters) == TEMPERATURE
        assert shift.transformation == {n: e for n, e in SHIFT.items() if name == "force" or n != "q"}
        separate = {f"theta{k}" for k in (1, 2, 3, 4, 8, 9, 10, 11)}
        assert set(structure.table.index[structure.table.verdict == "determined"]) == separate


def test_the_shift_is_exact_only_with_the_conduction(found):
    model, outputs, structure = found("force")
    shift = structure.symmetries[1]
    assert unchanged(model, outputs, shift)
    for left_out in SHIFT:
        partial = {n: e for n, e in SHIFT.items() if n != left_out}
        assert not unchanged(model, outputs, SimpleNamespace(transformation=partial, factor=shift.factor))


@pytest.mark.parametrize(
    ("name", "groups"),
    [
        ("force, displacement", [{"theta4", "theta5", "theta9"}, TEMPERATURE, set(SHIFT) - {"q"}]),
        ("displacement, force", [{"theta4", "theta5", "theta9"}, TEMPERATURE, set(SHIFT) - {"q"}]),
        (
            "force, pressure",
            [
                TEMPERATURE,
                {"theta1", "theta2", "theta3", "theta6", "theta10", "theta15", "theta16"},
                {"theta5", "theta6", "theta7", "theta16"},
            ],
        ),
    ],
)
def test_landing_gear_with_one_output_has_a_third_symmetry(name, groups, found):
    _, _, structure = found(name)
    assert [set(symmetry.parameters) for symmetry in structure.symmetries] == groups


def test_parameters_of_unmeasured_outputs_do_not_appear(found):
    _, _, by_force = found("force, pressure")
    _, _, by_displacement = found("displacement, pressure")
    assert list(by_force.table.index[by_force.table.verdict == "does not appear"]) == ["theta12"]
    absent = by_displacement.table.index[by_displacement.table.verdict == "does not appear"]
    assert list(absent) == [f"theta{k}" for k in (1, 2, 3, 8, 9, 10)]


@pytest.mark.parametrize(("which", "amount"), [(0, 1.7), (1, 0.2)])
def test_transformed_parameters_give_the_same_periodic_outputs(which, amount, found):
    model, _, structure = found("force")
    symmetry = structure.symmetries[which]
    force = {"force": 1.5 + 0.5 * np.cos(2 * np.pi * np.arange(128) / 128)}
    values = GEAR | {symmetry.amount: amount}
    moved = {n: float(parse("n", symmetry.transformation.get(n, n), values).value(values)) for n in GEAR}
    before, after = (bp.solve_periodic(model, p, force, frequency=0.1, samples=128) for p in (GEAR, moved))
    assert moved["theta5"] != GEAR["theta5"]
    for name in model.outputs:
        np.testing.assert_allclose(after.outputs[name], before.outputs[name], rtol=1e-8)


def test_output_offset_of_the_silverbox_is_equivalent_to_changed_stiffness_and_input_offset(found):
    _, _, structure = found("offset_silverbox")
    scaling, shift = structure.symmetries
    assert set(scaling.parameters) == {"w0", "c", "k1", "k2", "k3", "g", "u0"}
    assert shift.kind == "shift"
    assert shift.transformation == {
        "k1": "k1 + 2*k2*delta + 3*k3*delta**2",
        "k2": "k2 + 3*k3*delta",
        "u0": "u0 - k1*delta - k2*delta**2 - k3*delta**3",
        "y0": "y0 + delta",
        "y": "y - delta",
    }


@pytest.mark.parametrize("name", [name for name, (*_, symmetries) in LIBRARY.items() if symmetries])
def test_combinations_are_complete_independent_and_invariant(name, found):
    _, _, structure = found(name)
    moved = [n for n in structure.table.index if structure.table.fix[n]]
    assert len(structure.combinations) == len(moved) - len(structure.symmetries)
    values = {n: 0.4 + 0.13 * k for k, n in enumerate(structure.table.index)}
    expressions = [parse("combination", text, values) for text in structure.combinations]
    slopes = np.array([[e.gradient(values, moved)[n] for n in moved] for e in expressions])
    assert np.linalg.matrix_rank(slopes) == len(structure.combinations)
    for symmetry in structure.symmetries:
        amount = {symmetry.amount: 1.3 if symmetry.amount == "t" else 0.2}
        images = {n: symmetry.transformation.get(n, n) for n in values}
        there = {n: float(parse("n", e, [*values, *amount]).value(values | amount)) for n, e in images.items()}
        assert there != values
        for expression in expressions:
            np.testing.assert_allclose(expression.value(there), expression.value(values), rtol=1e-12)


@pytest.mark.parametrize(
    ("coefficient", "combination", "kind"),
    [
        (lambda p: p.a * p.b, "a*b", "scaling"),
        (lambda p: p.a + p.b, "a + b", "shift"),
        (lambda p: p.a**2 + p.b**2, "a**2 + b**2", "other"),
        (lambda p: sp.sqrt(p.a / p.b), "a/b", "scaling"),
        (lambda p: p.a * sp.exp(p.b), "a*exp(b)", "shift"),
    ],
)
def test_two_parameters_in_one_coefficient_are_only_in_combination(coefficient, combination, kind):
    model = small(["x"], ["a", "b"], lambda s, p, u: [s.dx + coefficient(p) * s.x - u.u], lambda s, p, u: {"y": s.x})
    structure = bp.structure(model)
    (symmetry,) = structure.symmetries
    names = model.parameter_symbols
    slopes = [sp.diff(sp.sympify(text, locals=names), names["a"]) for text in structure.combinations]
    wanted = sp.sympify(combination, locals=names)
    (text,) = structure.combinations
    given = sp.sympify(text, locals=names)
    cross = slopes[0] * sp.diff(wanted, names["b"]) - sp.diff(given, names["b"]) * sp.diff(wanted, names["a"])
    assert sp.simplify(cross) == 0
    assert symmetry.kind == kind
    assert structure.complete


def test_a_state_that_is_not_measured_may_be_scaled():
    model = small(
        ["x"], ["a", "b", "c"], lambda s, p, u: [s.dx + p.a * s.x - p.b * u.u], lambda s, p, u: {"y": p.c * s.x}
    )
    structure = bp.structure(model)
    assert structure.combinations == ("b*c",)
    assert structure.symmetries[0].transformation == {"b": "b*t", "c": "c/t", "x": "x*t"}


def test_two_compartments_with_both_leaks_give_three_numbers_for_four_rates():
    """R. Bellman, K. J. Åström, On structural identifiability, Mathematical Biosciences 7, 1970, 329-339.

    The transfer function (s + k12 + k02)/(s² + (k01 + k21 + k12 + k02) s + …) holds only the two sums and k12 k21.
    """
    model = compartments()
    structure = bp.structure(model)
    assert set(structure.combinations) == {"k01 + k21", "k12 + k02", "k21*k12"}
    assert unchanged(model, ["y"], structure.symmetries[0])
    assert structure.complete


@pytest.mark.parametrize("leak", ["k01", "k02"])
def test_two_compartments_with_one_leak_are_determined(leak):
    """The same source: without one of the leaks the three numbers give the three rates."""
    structure = bp.structure(compartments(), fixed={leak: 0.0})
    assert set(structure.table.verdict) == {"determined"}
    assert structure.known == (leak,)
    assert structure.rank == 3


def test_without_its_mass_an_oscillator_is_of_first_order():
    structure = bp.structure(bp.models.duffing, fixed={"m": 0.0})
    assert dict(structure.table.verdict) == dict.fromkeys(["c", "k", "k3"], "determined")
    assert structure.complete


def test_without_heat_capacity_the_scaling_and_the_shift_remain():
    """The scaling of T and the shift remain."""
    structure = bp.structure(bp.models.landing_gear("displacement"), fixed={"theta15": 0.0})
    assert structure.complete
    assert structure.rank == 12
    assert {symmetry.kind for symmetry in structure.symmetries} == {"scaling", "shift"}


def test_the_feedthrough_of_an_input_moves_into_the_state():
    """X' = a x + b u + c u', y = x + d u has the transfer function (b + a c + (c + d)(s − a))/(s − a)."""
    model = small(
        ["x"],
        ["a", "b", "c", "d"],
        lambda s, p, u: [s.dx - p.a * s.x - p.b * u.u - p.c * u.du],
        lambda s, p, u: {"y": s.x + p.d * u.u},
    )
    structure = bp.structure(model)
    assert structure.table.verdict["a"] == "determined"
    assert set(structure.combinations) == {"c + d", "b + a*c"}
    assert unchanged(model, ["y"], structure.symmetries[0])


def test_symmetries_of_equations_with_corners_are_found():
    """Only gap + offset is identifiable; the offset alone would move the corner."""
    model = small(
        ["x"],
        ["k", "gap", "y0"],
        lambda s, p, u: [s.ddx + s.dx + p.k * sp.Max(0, s.x - p.gap) - u.u],
        lambda s, p, u: {"y": s.x + p.y0},
    )
    structure = bp.structure(model)
    assert structure.combinations == ("gap + y0",)
    assert structure.complete
    assert set(bp.structure(model, fixed=["y0"]).table.verdict) == {"determined"}


def test_position_of_a_jump_is_not_reported_as_undetermined():
    """Derivatives do not detect it, so that no rank is given."""
    step = lambda s, p: sp.Piecewise((1, s.x > p.place), (0, True))  # noqa: E731
    model = small(
        ["x"],
        ["size", "place"],
        lambda s, p, u: [s.ddx + s.x + p.size * step(s, p) - u.u],
        lambda s, p, u: {"y": s.x},
    )
    structure = bp.structure(model)
    assert not structure.symmetries
    assert structure.rank is None
    assert not structure.complete
    assert "not ruled out" in repr(structure)


def test_a_parameter_that_a_hidden_state_absorbs_is_not_determined():
    model = small(
        ["x", "z"],
        ["a", "b"],
        lambda s, p, u: [s.dx + p.a * s.x - s.dz - u.u, s.dz + s.z - p.b],
        lambda s, p, u: {"y": s.x},
    )
    assert dict(bp.structure(model).table.verdict) == {"a": "determined", "b": "not determined"}


def test_rank_detects_what_the_symmetries_miss():
    """Y = z/(1 + b z) has y' = a u for every b; the change of z that absorbs b is a Möbius map, not an affine one."""
    model = small(
        ["z"],
        ["a", "b"],
        lambda s, p, u: [s.dz - p.a * u.u * (1 + p.b * s.z) ** 2],
        lambda s, p, u: {"y": s.z / (1 + p.b * s.z)},
    )
    structure = bp.structure(model)
    assert structure.unexplained == ("b",)
    assert dict(structure.table.verdict) == {"a": "determined", "b": "not determined"}
    assert not structure.complete


def test_absent_parameters_and_unobserved_states_are_reported():
    model = small(
        ["x", "z"],
        ["a", "b", "k"],
        lambda s, p, u: [s.dx + p.a * s.x - u.u, s.dz + p.k * s.z - s.x],
        lambda s, p, u: {"y": s.x, "z_out": s.z},
    )
    verdicts = dict(bp.structure(model, outputs=["y"]).table.verdict)
    assert verdicts == {"a": "determined", "b": "does not appear", "k": "does not appear"}
    assert bp.structure(model).table.verdict["k"] == "determined"


def test_outputs_of_inputs_alone_need_no_state():
    model = small(["x"], ["a", "b", "k"], lambda s, p, u: [s.dx + p.k * s.x], lambda s, p, u: {"y": p.a * p.b * u.u})
    structure = bp.structure(model)
    assert structure.combinations == ("a*b",)
    assert structure.table.verdict["k"] == "does not appear"


def test_amount_of_a_symmetry_avoids_the_names_of_the_model():
    model = small(["x"], ["t", "scale"], lambda s, p, u: [s.dx + p.t * p.scale * s.x - u.u], lambda s, p, u: {"y": s.x})
    (symmetry,) = bp.structure(model).symmetries
    assert symmetry.amount == "scale_factor"
    assert symmetry.transformation["t"] in ("t*scale_factor", "t/scale_factor")


@pytest.mark.parametrize(
    ("images", "confirmed"),
    [
        ({"a": "a + delta", "b": "b - delta"}, True),
        ({"a": "a + delta", "b": "b - 2*delta"}, False),
        ({"a": "a + delta"}, False),
        ({"c": "c + delta"}, False),
    ],
)
def test_transformation_that_changes_an_equation_or_an_output_is_rejected(images, confirmed):
    model = small(
        ["x"], ["a", "b", "c"], lambda s, p, u: [s.dx + (p.a + p.b) * s.x - u.u], lambda s, p, u: {"y": s.x + p.c}
    )
    symbols, delta = model.parameter_symbols, sp.Symbol("delta", real=True)
    moved = {symbols[n]: sp.sympify(e, locals=symbols | {"delta": delta}) for n, e in images.items()}
    flow = Flow(Generator({}), delta, moved)
    assert (verified(system_of(model, ["y"]), flow) is not None) == confirmed


def test_tied_parameters_enter_as_expressions():
    model = small(["x"], ["a", "b"], lambda s, p, u: [s.dx + p.a * p.b * s.x - u.u], lambda s, p, u: {"y": s.x})
    a, b = model.parameter_symbols.values()
    whole = system_of(model, model.outputs)
    assert analyse_structure("tied", whole.given((), {b: 2 * a}), ()).table.verdict["a"] == "determined"
    assert analyse_structure("tied", whole.given((), {b: 2 / a}), ()).table.verdict["a"] == "does not appear"


def test_a_structure_saves_and_loads(tmp_path, found):
    _, _, structure = found("force")
    structure.save(tmp_path / "structure.h5")
    loaded = bp.load(tmp_path / "structure.h5")
    assert repr(loaded) == repr(structure)
    assert loaded.symmetries == structure.symmetries


def test_error_names_the_bad_argument():
    with pytest.raises(ValueError, match="outputs: must be .*got 'angel'.*'angle'"):
        bp.structure(bp.models.pendulum, outputs=["angel"])
    with pytest.raises(ValueError, match="outputs: must have at least one name"):
        bp.structure(bp.models.pendulum, outputs=[])
    with pytest.raises(ValueError, match="fixed: must be .*got 'mass'"):
        bp.structure(bp.models.pendulum, fixed=["mass"])
    with pytest.raises(ValueError, match="fixed: must not be zero if the equations divide by it, got m = 0"):
        bp.structure(bp.models.pendulum, fixed={"m": 0.0})


@pytest.mark.parametrize("power", [3, 99])
def test_large_effect_of_one_parameter_does_not_hide_the_others(power):
    """The coefficients c, k and (1 + a)**power of x, ẋ and x³ are determined, and with them a."""
    model = small(
        ["x"],
        ["c", "k", "a"],
        lambda s, p, u: [s.ddx + p.c * s.dx + p.k * s.x + (1 + p.a) ** power * s.x**3 - u.u],
        lambda s, p, u: {"x": s.x},
    )
    found = bp.structure(model)
    assert found.complete and found.rank == 3
    assert set(found.table["verdict"]) == {"determined"}


@pytest.mark.slow
def test_memory_of_many_outputs_and_parameters_is_moderate():
    """Six masses, 18 parameters: 122 MB; a square matrix of all sensitivities takes 327 MB, of ten masses 4.4 GB."""
    links = [f"k{i}*(x{i} - x{i - 1}) + c{i}*(dx{i} - dx{i - 1})" if i else "k0*x0 + c0*dx0" for i in range(6)]
    model = bp.Model(
        "masses",
        states=[f"x{i}" for i in range(6)],
        inputs=["force"],
        parameters=[f"{kind}{i}" for kind in "mck" for i in range(6)],
        equations=[
            f"m{i}*ddx{i} + {link} - ({after})"
            for i, (link, after) in enumerate(zip(links, [*links[1:], "force"], strict=True))
        ],
        outputs={f"y{i}": f"x{i}" for i in range(6)},
    )
    tracemalloc.start()
    try:
        assert bp.structure(model).rank == 18
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()
