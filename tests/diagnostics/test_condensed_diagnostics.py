"""Identifiability, missing terms and the report of condensed models, against symbolic ones and finite differences."""

import re
from functools import cache

import matplotlib.pyplot as plt
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.diagnostics.candidates import Term, extended, of_elements
from bayesperiodic.estimation.units import compared_with_data, unit_error
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.reporting.html import equations

Element = bp.elements.Element
SAMPLES = 64
WAVE = np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
VALUES = {"alpha": 0.05, "k_tip": 5.0, "spring_k3": 30.0}
PRIORS = {name: bp.LogNormal(value, 0.3) for name, value in VALUES.items()}
SPRING = Element("spring", bp.elements.cubic, 2)


def chain(condensed, *elements):
    """Return a chain of three masses on the ground, driven at its end."""
    stiffness = 40.0 * (2 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1))
    return bp.Model.from_matrices(
        "chain", mass=np.eye(3), stiffness={"1": stiffness, "k_tip": np.diag([0.0, 0.0, 1.0])},
        damping={"alpha": np.eye(3)}, forces={"force": 2}, condensed=condensed, elements=list(elements),
        outputs={"x": (2, "displacement"), "a": (1, "acceleration")},
    )  # fmt: skip


def quadratic(v, drag):
    """Return a damping force that is quadratic in the velocity."""
    return drag * v * abs(v)


def runs(model, values, error=0.003):
    """Return synthetic experiments at four frequencies."""
    result = []
    for seed, (frequency, force) in enumerate([(0.4, 6.0), (0.6, 3.0), (0.75, 6.0), (0.9, 3.0)]):
        inputs, random = {"force": force * WAVE}, np.random.default_rng(seed)
        truth = bp.solve_periodic(model, values, inputs, frequency=frequency, samples=SAMPLES).outputs
        outputs = {n: y + error * np.ptp(y) * random.standard_normal(SAMPLES) for n, y in truth.items()}
        result.append(bp.Experiment(f"run {seed}", frequency, outputs, inputs, samples=SAMPLES))
    return result


@cache
def fitted(condensed):
    """Return a problem of the chain, condensed or not, and its estimate from the same data."""
    data = runs(chain(True, SPRING), VALUES)
    problem = bp.Problem(chain(condensed, SPRING), data, priors=PRIORS, scheme="fourier")
    return problem, bp.map_estimate(problem, progress=False)


@cache
def lacking():
    """Return a problem whose model lacks a damper at an element without force, and its estimate."""
    truth = chain(True, SPRING, Element("air", quadratic, (1, 0)))
    model = chain(True, SPRING, Element("probe", lambda: 0, (1, 0)))
    problem = bp.Problem(model, runs(truth, VALUES | {"air_drag": 1.0}), priors=PRIORS)
    return problem, bp.map_estimate(problem, progress=False)


def test_identifiability_is_that_of_the_symbolic_model_but_for_structural_symmetries():
    ours, other = (bp.identifiability(*fitted(condensed), profile=False) for condensed in (True, False))
    for column in ("contraction", "alone", "together", "collinearity"):
        np.testing.assert_allclose(ours.table[column], other.table[column], rtol=2e-3)
    assert ours.verdicts == other.verdicts
    assert ours.structure is None and other.structure is not None
    assert "structural symmetries" in repr(ours) and "were not searched" in repr(ours)
    assert "were not searched" not in repr(other)


def test_stored_identifiability_is_read_again(tmp_path):
    ours = bp.identifiability(*fitted(True), profile=False)
    ours.save(tmp_path / "identifiability.h5")
    assert repr(bp.load(tmp_path / "identifiability.h5")) == repr(ours)


RUBBING = {"joint_stiffness": 10.0, "joint_limit": 1.0}


def rubbing():
    """Return the chain with an internal state beside the spring and an element without force."""
    joint = Element("joint", bp.elements.jenkins, (1, 0), {"width": 0.1})
    return chain(True, joint, SPRING, Element("probe", lambda: 0, (1, 0)))


@pytest.mark.parametrize(("model", "more"), [(lambda: lacking()[0].model, {}), (rubbing, RUBBING)])
def test_effects_of_forces_are_differences_of_solutions_of_the_model_with_the_term(model, more):
    """On the same points."""
    model, values, step = model(), VALUES | more, 1e-3
    known = of_elements(model).state_symbols
    terms = {
        "c_0": Term("force of probe", "dprobe*probe**2", known["dprobe"] * known["probe"] ** 2),
        "c_1": Term("force of spring", "spring**2", known["spring"] ** 2),
    }
    extension = extended(model, terms)
    how = {"inputs": {"force": 6.0 * WAVE}, "frequency": 0.75, "samples": SAMPLES}
    built = CondensedEquations.build(model, **how)
    theta = np.array([values[name] for name in model.parameters])
    z = built.find(theta, None)[0].z
    count, states = len(model.element_names), built.states(z)
    d, v = states[:, :count], states[:, count : 2 * count]
    change = np.zeros((2, len(z), count))
    spring, probe = (model.element_names.index(name) for name in ("spring", "probe"))
    change[0, :, probe], change[1, :, spring] = v[:, probe] * d[:, probe] ** 2, d[:, spring] ** 2
    moved = built.moved_by_forces(z, theta, change)
    extended_equations = CondensedEquations.build(extension, **how)
    for row, name in enumerate(terms):
        ends = []
        for sign in (1, -1):
            given = values | dict.fromkeys(terms, 0.0) | {name: sign * step}
            there = np.array([given[n] for n in extension.parameters])
            ends.append(extended_equations.outputs(extended_equations.solve(there, z).z, there))
        for column in range(len(model.outputs)):
            difference = (ends[0][:, column] - ends[1][:, column]) / (2 * step)
            np.testing.assert_allclose(moved.outputs[row, :, column], difference, atol=1e-5 * np.abs(difference).max())


@pytest.fixture(scope="module")
def found():
    return bp.missing_terms(*lacking(), max_terms=2)


def test_missing_damper_is_found_at_the_element_without_force(found):
    """The coefficient is within 4 standard deviations: by chance, one in 16000 runs with another seed is not."""
    (step,) = found.steps
    assert (step.term, step.place) == ("dprobe*abs(dprobe)", "force of probe")
    assert abs(step.coefficient - 1.0) < 4 * step.sd + 0.02  # the absolute value is rounded
    assert step.verdict == "adequate" and found.before.verdict == "misspecified"
    assert found.problem().model.parameters[-1] == step.name
    assert bp.missing_terms(*lacking(), equations=False, max_terms=1).steps == ()


def test_missing_term_is_drawn_over_the_motion_of_the_element(found):
    problem, fit = lacking()
    figure = bp.plot.missing_terms(problem, fit, found)
    labels = {axes.get_xlabel() for axes in figure.axes}
    assert "rate of probe [1/s]" in labels
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for axes in figure.axes for text in axes.texts]
    assert len(boxes) == 4 and not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    plt.close(figure)


@pytest.mark.parametrize(
    ("place", "term", "message"),
    [
        ("equation of x0", "x0**2", "candidates: must be one of"),
        ("x", "x0**2", "candidates: must be one of"),
        ("force of probe", "spring*dprobe", r"must contain only probe and dprobe and parameters"),
        ("force of probe", "ddprobe", "must contain derivatives that the equations contain"),
        ("force of probe", "force", "must be one of .*got 'force'"),
        ("force of probe", "tau*probe", r"must contain only probe and dprobe and parameters"),
        ("force of probe", "lag(probe)", "must be without memory for 'chain', which is condensed"),
    ],
)
def test_terms_that_condensed_models_cannot_have_are_refused(place, term, message):
    with pytest.raises(ValueError, match=message):
        bp.missing_terms(*lacking(), {place: [term]}, max_terms=0)


def test_report_shows_matrices_places_and_forces(found, tmp_path):
    problem, fit = lacking()
    text = bp.report(problem, fit, None, tmp_path / "report.html", missing=found).read_text(encoding="utf-8")
    plain = re.sub(r"<[^>]*>", "", text)
    assert "has 3 degrees of freedom x, from x0 to x2" in plain and "2 elements: spring, probe, in this order" in plain
    assert "M0x¨+αC0x˙+K0x+ktipK1x+WTf=Bu" in plain
    assert "d1=x2" in plain and re.search("d2=.*x1.*−.*x0", plain) and "f2=0" in plain
    assert "x=x2" in plain and "a=x¨1" in plain
    assert "Structural symmetries were not searched" in plain
    assert "dprobe*abs(dprobe)" in plain


def test_equations_of_internal_states_are_shown():
    plain = re.sub(r"<[^>]*>|\u2062", "", "".join(equations(rubbing())))
    assert "f1=jointlimitw1" in plain and "w˙1=" in plain and "f3=0" in plain


def test_elements_of_the_same_name_are_refused():
    with pytest.raises(ValueError, match="elements: .*probe"):
        chain(True, *(Element("probe", lambda: 0, place) for place in (0, 1)))


def test_wrong_unit_is_told_by_the_linear_response():
    """Of condensed models as of symbolic ones, whose frequencies and amplitudes are the same."""
    data = [
        bp.Experiment(e.name, e.frequency, {n: 1e3 * y for n, y in e.outputs.items()}, e.inputs, samples=SAMPLES)
        for e in runs(chain(True, SPRING), VALUES)
    ]
    problem = bp.Problem(chain(True, SPRING), data, priors=PRIORS)
    symbolic = bp.Problem(chain(False, SPRING), data, priors=PRIORS, scheme="fourier")
    ours, theirs = (compared_with_data(p, p.median()) for p in (problem, symbolic))
    assert "frequency [Hz] 0.4 against 0.79" in ours and ours == theirs
    assert "amplitude of 'x' is 1e+3 times that of the linearised model" in unit_error(problem)
