"""Search for missing terms: effects against finite differences, known truths, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.diagnostics import missing_terms
from bayesperiodic.diagnostics.candidates import (
    Term,
    _expressions,
    coefficient_names,
    coefficient_unit,
    extended,
    factors,
    generated,
    given,
    lag_names,
    places,
)
from bayesperiodic.diagnostics.optima import guesses_of, problem_of
from bayesperiodic.diagnostics.score_tests import ScoreTests, _effects
from bayesperiodic.estimation.map_estimate import nearest_optimum
from bayesperiodic.models import units
from tests.known import LINEAR, linear_experiment
from tests.problems import C2, quadratic_damping

DAMPING = {"equation of x": ["dx*abs(dx)", "x**5"]}


@pytest.fixture(scope="module")
def damped():
    """Return a Duffing problem without its quadratic damping, and its estimate."""
    return quadratic_damping()


@pytest.fixture(scope="module")
def found(damped):
    return bp.missing_terms(*damped)


@pytest.fixture(scope="module")
def right(found):
    """Return the problem with the term that was missing, and its estimate."""
    problem = found.problem(1)
    return problem, bp.map_estimate(problem, progress=False)


def effects_by_differences(problem, fit, terms):
    """Return the derivatives of all predicted components by the coefficients, from solutions of the extended model."""
    names = coefficient_names(problem.model, terms)
    model, step, each = extended(problem.model, dict(zip(names, terms, strict=True))), 1e-4, []
    known = {"m": 1.0} | fit.theta | dict.fromkeys(names, 0.0)
    known |= {lag_names(n)[0]: term.lag for n, term in zip(names, terms, strict=True) if term.force is not None}
    guesses = guesses_of(model, {name: solution.states for name, solution in fit.solutions.items()})
    for e in problem.experiments:
        ends = []
        for name in names:
            for sign in (1.0, -1.0):
                solution = bp.solve_periodic(
                    model, known | {name: sign * step}, e.inputs, frequency=e.frequency, samples=e.samples,
                    scheme="fourier", guess=guesses[e.name],
                )  # fmt: skip
                assert solution.converged
                values = np.stack([solution.outputs[channel] for channel in e.outputs], axis=-1)
                ends.append(problem.observations[e.name].errors(values))
        each += [(np.array(ends[::2])[:, i] - np.array(ends[1::2])[:, i]) / (2 * step) for i in range(len(ends[0]))]
    return each


def test_effects_are_the_derivatives_of_the_outputs_by_the_coefficients(damped):
    """Terms in equation and output, with highest derivatives, rates of the input, and lags short and long."""
    problem, fit = damped
    model = problem.model
    wanted = {"x*abs(dx)", "dx*abs(dx)", "ddx", "x**2*force", "x**2", "force", "1"}
    terms = [c for c in generated(model, places(model), {}) if c.text in wanted]
    assert len(terms) == 2 * len(wanted)
    lags = [c for c in generated(model, places(model), {}) if c.text in {"lag(dx) - dx", "lag(x**3) - x**3"}]
    terms += [replace(c, lag=lag) for c in lags for lag in (0.2, 5.0)]
    assert len(lags) == 3
    theta = problem.vector(fit.theta)
    effects = _effects(problem, theta, fit.solutions, terms)
    for one, other in zip(effects, effects_by_differences(problem, fit, terms), strict=True):
        assert one == pytest.approx(other, abs=2e-5 * np.abs(other).max())


def test_what_a_term_explains_is_what_is_left_without_it(damped):
    """Of a term in the output the model is linear: the sum of squares drops by what the score test says."""
    problem, fit = damped
    guesses = {name: solution.states for name, solution in fit.solutions.items()}
    theta = problem.vector(fit.theta)
    optimum = nearest_optimum(problem, theta, guesses)[1].iterate
    terms = [
        Term("displacement", "force**2", problem.model.input_symbols["force"] ** 2),
        Term("equation of x", "x", problem.model.state_symbols["x"]),
    ]
    tests = ScoreTests(problem, optimum, terms)
    assert tests.identifiable.tolist() == [True, False] and tests.p[1] == 1.0
    here, whitened = optimum.here, problem.likelihood.whitened
    r, j, c = (
        np.concatenate(whitened(part, optimum.noise), axis=-1)
        for part in (here.residuals, here.jacobian, _effects(problem, theta, fit.solutions, terms[:1]))
    )
    count = [min(b.size, round(b.count)) for b in problem.likelihood.blocks]
    starts = np.cumsum([0, *(b.size for b in problem.likelihood.blocks)])
    kept = np.concatenate([start + np.arange(n) for start, n in zip(starts, count, strict=False)])
    assert kept.size == r.size
    without, with_it = (
        np.sum((r - np.linalg.lstsq(basis.T, r, rcond=None)[0] @ basis) ** 2) for basis in (j, np.concatenate([j, c]))
    )
    assert tests.explained[0] == pytest.approx(1.0 - with_it / without, rel=1e-6)


def test_quadratic_damping_is_found_with_its_coefficient(damped, found):
    (step,) = found.steps
    assert (step.term, step.place, step.alternatives) == ("dx*abs(dx)", "equation of x", ())
    assert abs(step.coefficient - C2) < 4 * step.sd and step.sd < 0.01 * C2
    assert found.before.verdict == "misspecified" and step.verdict == "adequate"
    assert step.unexplained["displacement"] < 1e-3 * damped[1].fvu["displacement"]
    assert step.held_out < 1e-3 * found.before.held_out and step.p_white["displacement"] > 0.01
    assert step.p < 1e-10 and step.evidence_gain > np.log(found.tested)
    assert step.shifts["c"] < -10.0
    assert found.ranking["explains"].is_monotonic_decreasing and len(found.ranking) == found.tested
    assert (found.ranking["p_adjusted"] >= found.ranking["p"]).all()
    assert found.table["term"].tolist() == ["", "dx*abs(dx)"] and found.table.loc[1, "robust sd"] == step.robust_sd


def test_the_printed_result_says_what_was_found(found):
    said = repr(found)
    (step,) = found.steps
    assert f"Missing terms, of {found.tested} candidates" in said
    assert (
        f"1. {step.name}·dx*abs(dx) in equation of x, {step.name} = 0.3 ± " in said
        and "of its standard deviations." in said
    )
    assert "No further candidate is significant at a false discovery rate of 0.01" in said
    dropped = replace(found, dropped=("x in displacement",), refused={"x**5 in equation of x": "it is unwanted"})
    assert "Removed again: x in displacement." in repr(dropped)
    assert "x**5 in equation of x: left out, it is unwanted." in repr(dropped)
    alike = replace(found, steps=(replace(step, alternatives=("x in y", "z in y")),))
    assert "; the data do not tell it from x in y, z in y. It moves c by" in repr(alike)


def test_of_the_right_model_nothing_is_missing(right):
    problem, fit = right
    again = bp.missing_terms(problem, fit)
    assert again.steps == () and again.before.verdict == "adequate" and again.table["term"].tolist() == [""]
    assert "No further candidate is significant" in repr(again)


def test_the_models_found_can_be_fitted(damped, found, right):
    problem, fit = damped
    (step,) = found.steps
    extended_problem, estimate = right
    assert estimate.theta[step.name] == pytest.approx(step.coefficient, abs=0.01 * step.sd)
    assert estimate.fvu["displacement"] == pytest.approx(step.unexplained["displacement"], rel=1e-3)
    assert found.model().parameters == (*problem.model.parameters, step.name) == extended_problem.model.parameters
    assert found.model(0).parameters == problem.model.parameters
    assert bp.map_estimate(found.problem(0), progress=False).theta == pytest.approx(fit.theta, rel=1e-6)
    for k in (2, -1, 0.5):
        with pytest.raises(ValueError, match="k: must be"):
            found.model(k)
        with pytest.raises(ValueError, match="k: must be"):
            found.problem(k)


@pytest.mark.parametrize(
    "term", ["dx*abs(dx)", lambda s, p, u: s.dx * abs(s.dx), lambda s, p, u: p.k * s.dx * abs(s.dx) / p.m]
)
def test_given_candidates_are_texts_or_functions(damped, term):
    problem, fit = damped
    found = bp.missing_terms(problem, fit, {"equation of x": [term, "x**5"]}, equations=False, outputs=False)
    (step,) = found.steps
    assert step.place == "equation of x" and "dx*" in step.term and found.tested == 2
    scale = fit.theta["k"] if "k" in step.term else 1.0
    assert abs(step.coefficient * scale - C2) < 0.4 * C2


@pytest.mark.slow
def test_terms_and_places_are_left_out(damped):
    problem, fit = damped
    quiet = {"max_terms": 0}
    every = bp.missing_terms(problem, fit, **quiet)
    assert every.steps == () and "The search ended after 0 terms" in every.stopped
    pairs = set(zip(every.ranking["place"], every.ranking["term"], strict=True))
    assert {place for place, _ in pairs} == {"equation of x", "displacement"}
    for change, place in (({"equations": False}, "displacement"), ({"outputs": False}, "equation of x")):
        assert set(bp.missing_terms(problem, fit, **change, **quiet).ranking["place"]) == {place}
    assert set(bp.missing_terms(problem, fit, exclude="displacement", **quiet).ranking["place"]) == {"equation of x"}
    left = bp.missing_terms(problem, fit, exclude=["x**5", "dx**3 in equation of x"], **quiet).ranking
    left = set(zip(left["place"], left["term"], strict=True))
    assert pairs - left == {(p, t) for p, t in pairs if t == "x**5" or (p, t) == ("equation of x", "dx**3")}
    without = bp.missing_terms(problem, fit, exclude=["dx*abs(dx)"], max_terms=1)
    assert without.steps == () or without.steps[0].term != "dx*abs(dx)"


def test_no_candidates_are_nothing_found(damped):
    none = bp.missing_terms(*damped, equations=False, outputs=False)
    assert none.steps == () and none.tested == 0 and len(none.ranking) == 0


def test_wrong_arguments_are_refused(damped, solved):
    problem, fit = damped
    for candidates, message in (
        ({"torque": ["x"]}, "candidates: must be one of .*got 'torque'"),
        ({"equation of x": "x"}, "must be a list of texts or functions"),
        ({"equation of x": ["y"]}, "candidates.*'y'"),
        ({"equation of x": ["dddx"]}, "candidates"),
        (["x"], "candidates: must be a mapping"),
    ):
        with pytest.raises(ValueError, match=message):
            bp.missing_terms(problem, fit, candidates)
    for change, message in (
        ({"max_terms": -1}, "max_terms"), ({"keep": 0}, "keep"), ({"false_discovery_rate": 1.0}, "between 0 and 1"),
        ({"false_discovery_rate": 0.0}, "false_discovery_rate"), ({"exclude": 3}, "exclude: must be a sequence"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            bp.missing_terms(problem, fit, **change)
    with pytest.raises(ValueError, match="fit: must be a result of this problem"):
        bp.missing_terms(problem, solved[1])
    static, estimate = solved[:2]
    with pytest.raises(ValueError, match="must contain derivatives that the equations contain, got 'ddw' in 'ddw'"):
        bp.missing_terms(static, estimate, {"force": ["ddw"]})


def test_terms_of_the_same_effect_are_one_candidate(damped):
    """On the measured orbits abs(−ẋ)·ẋ is ẋ·abs(ẋ)."""
    problem, fit = damped
    same = {"equation of x": ["dx*abs(dx)", "2*dx*abs(-dx)", "x**5"]}
    found = bp.missing_terms(problem, fit, same, equations=False, outputs=False)
    assert found.tested == 2
    (step,) = found.steps
    assert {step.term, step.alternatives[0].removesuffix(" in equation of x")} == {"dx*abs(dx)", "2*dx*abs(-dx)"}
    assert found.ranking["same"].map(len).tolist()[0] == 1


def test_effects_of_the_parameters_are_refused(found):
    assert "x in equation of x" in found.refused and "x**3 in equation of x" in found.refused
    assert "x in equation of x" not in repr(found)


def test_a_coefficient_of_zero_does_not_change_the_model(damped):
    problem, fit = damped
    term = Term("displacement", "force", problem.model.input_symbols["force"])
    other = problem_of(problem, extended(problem.model, {"c9": term}), {}, zero={"c9": term})
    assert other.names == problem.names
    theta = problem.vector(fit.theta)
    one, two = (p.outputs(theta[None])[0]["run 0"]["displacement"] for p in (problem, other))
    assert one == pytest.approx(two, abs=1e-10)


def test_candidates_of_angles_are_sines_and_cosines():
    smooth, steepest = factors(bp.models.pendulum)
    assert {"sin(phi)", "cos(phi)", "dphi"} <= {*smooth} and "phi" not in smooth and "ddphi" in steepest
    texts = {c.text for c in generated(bp.models.pendulum, ["equation of phi"], {})}
    assert {"sin(phi)**2", "sin(phi)*cos(phi)", "dphi*abs(dphi)", "sign(dphi)"} <= texts and "phi**2" not in texts
    assert not any(isinstance(c.expression, sp.Abs) for c in generated(LINEAR, ["force"], {}))


def test_names_of_coefficients_are_new():
    model = bp.Model(
        "named", states=["w"], inputs=["x"], parameters=["c_w", "c3"],
        equations=lambda s, p, u: [s.dw + p.c_w * s.w - u.x],
        outputs=lambda s, p, u: {"c2": p.c3 * s.w},
    )  # fmt: skip
    assert coefficient_names(model, generated(model, ["c2"], {})[:3]) == ["c_1", "c_w_in_c2", "c_x"]


def test_a_missing_output_term_of_one_static_record_is_found():
    """One record: nothing is left out, and the error in experiments left out is not known."""
    run = linear_experiment([900.0, 40.0, 25.0], 1.0, seed=2)
    problem = bp.Problem(
        LINEAR, [run], priors={"k": bp.Normal(900, 300), "c": bp.LogNormal(40, 1)}, fixed={"coulomb": 0}
    )
    fit = bp.map_estimate(problem, progress=False)
    found = bp.missing_terms(problem, fit, {"force": ["tanh(dx/0.1)"]}, equations=False, max_terms=1)
    (step,) = found.steps
    assert step.place == "force" and np.isnan(step.held_out) and np.isnan(found.before.held_out)
    assert step.term == "tanh(dx/0.1)" or "tanh(dx/0.1) in force" in step.alternatives
    assert step.verdict == "adequate" and found.before.verdict == "misspecified"


@pytest.mark.parametrize(
    ("text", "unit"),
    [("N s/m^2", "N s/m^2"), ("J/(kg K)", "J/(kg K)"), ("1/V²", "1/V^2"), ("rad·m", "rad m"), ("1", "1")],
)
def test_units_are_read_and_written(text, unit):
    assert units.written(units.parsed(text)) == unit


def test_units_are_compared_in_base_units():
    assert units.same(units.parsed("N m"), units.parsed("J")) and units.same(units.parsed("V A"), units.parsed("W"))
    assert not units.same(units.parsed("N"), units.parsed("J"))
    assert units.parsed("") is None and units.parsed("m/s/s") is None


def test_coefficients_have_units_and_sums_of_different_dimensions_are_refused():
    place = {"force": ["w*displacement**2", "tanh(ddisplacement/0.01)"], "equation of w": ["w*ddisplacement"]}
    found = given(bp.models.dahl, place)
    assert [coefficient_unit(bp.models.dahl, term) for term in found] == ["N/m^2", "N", "1/m"]
    assert extended(bp.models.dahl, {"c": found[0]}).units["c"] == "N/m^2"
    for text, what in (
        ("displacement + ddisplacement", "a sum of m and m/s"),
        ("exp(displacement)", "exp of a .* in m"),
    ):
        with pytest.raises(ValueError, match=rf"candidates\['force'\]: must add quantities of the same unit, .*{what}"):
            given(bp.models.dahl, {"force": [text]})


def test_an_estimate_on_another_orbit_is_refused(damped):
    problem, fit = damped
    with pytest.raises(ValueError, match="fit: must be an estimate on the measured orbits, .* 'run 0', see"):
        bp.missing_terms(
            problem, replace(fit, search=replace(fit.search, other_orbits={"run 0": "it has another period"}))
        )


def test_prediction_of_experiments_left_out_decides_between_terms_that_fit_alike(monkeypatch, damped):
    """Of fits that are not distinct, one with twice the error in left-out experiments is no alternative."""
    problem, fit = damped
    errors = {"dx*abs(dx)": 2.1e-7, "dx**3": 1e-7}
    wanted = {"equation of x": list(errors)}
    monkeypatch.setattr(missing_terms, "distinct", lambda one, other: False)

    def error(state):
        terms = [name for name in state.names if state.iterate.theta[state.problem.names.index(name)] != 0.0]
        return 1.0 if not terms else errors["dx**3" if "3" in terms[0] else "dx*abs(dx)"]

    monkeypatch.setattr(missing_terms, "held_out_error", error)
    found = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False, max_terms=1)
    assert found.steps[0].term == "dx**3" and found.steps[0].alternatives == ()
    errors["dx*abs(dx)"] = 1.9e-7
    found = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False, max_terms=1)
    assert found.steps[0].term == "dx*abs(dx)" and found.steps[0].alternatives == ("dx**3 in equation of x",)


def test_a_term_whose_estimate_is_lost_is_refused_and_the_next_one_taken(monkeypatch, damped):
    problem, fit = damped
    estimate = missing_terms._Search.estimate

    def lost(self, terms, near):
        return None if any(term.text == "dx*abs(dx)" for term in terms.values()) else estimate(self, terms, near)

    monkeypatch.setattr(missing_terms._Search, "estimate", lost)
    wanted = {"equation of x": ["dx*abs(dx)", "dx**3"]}
    found = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False, max_terms=1)
    assert [step.term for step in found.steps] == ["dx**3"]
    assert "no periodic solution" in found.refused["dx*abs(dx) in equation of x"]


def test_generated_absolute_values_have_no_offset():
    """At 1 and −2 standard deviations terms with abs differ from |x| by less than 1 %; an offset would bias others."""
    x, y = sp.symbols("x y", real=True)
    _, expressions = _expressions({"x": x, "dx": y}, {}, {"x": 0.5, "dx": 3.0})
    for value, other in ((0.5, 3.0), (-1.0, -6.0)):
        at = {x: value, y: other}
        assert float(expressions["abs(dx)"].subs(at)) == pytest.approx(abs(other), rel=0.01)
        assert float(expressions["dx*abs(dx)"].subs(at)) == pytest.approx(other * abs(other), rel=0.01)
        assert float(expressions["dx*abs(x)"].subs(at)) == pytest.approx(other * abs(value), rel=0.01)


def test_stiffness_of_a_cycle_is_found_although_its_frequency_is_sharp():
    """The frequency of an asymmetric cycle ties `omega` to the coefficient, on a ridge that is curved and narrow."""
    parameters = ["a", "b", "omega"]
    equation = "ddx - (a - b*dx**2)*dx + omega**2*x"
    settings = {"states": ["x"], "inputs": [], "outputs": {"velocity": "dx"}}
    given = bp.Model("symmetric", parameters=parameters, equations=[equation], **settings)
    right = bp.Model("asymmetric", parameters=[*parameters, "q"], equations=[f"{equation} + q*x**2"], **settings)
    truth = {"a": 2.2, "b": 120.0, "omega": 19.5, "q": 18_000.0}
    test = {"frequency": 2.9, "duration": 30, "sampling_rate": 200, "start": {"x": 0.005}, "seed": 1}
    run = bp.simulate(right, truth, noise={"velocity": 2e-3}, **test)
    cycle = run.between(5, 30).fold(100, origin="crossing")
    priors = {"a": bp.LogNormal(1, 1), "b": bp.LogNormal(100, 1), "omega": bp.LogNormal(19, 0.5)}
    problem = bp.Problem(given, [cycle], priors=priors, scheme="central4")
    fit = bp.map_estimate(problem, progress=False)
    found = bp.missing_terms(problem, fit, outputs=False, max_terms=1)
    (step,) = found.steps
    assert (step.term, step.verdict) == ("x**2", "adequate")
    estimate = found.fit()
    for name, value in (truth | {step.name: truth["q"]}).items():
        if name != "q":
            assert abs(estimate.theta[name] - value) < 4.0 * estimate.sd[name], name
