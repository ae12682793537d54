"""Missing terms with memory, terms that are not believed, and results of the search in files. Data are synthetic."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic import _fourier
from bayesperiodic.diagnostics import missing_terms
from bayesperiodic.diagnostics.candidates import coefficient_names, coefficient_unit, extended, generated, given
from bayesperiodic.diagnostics.optima import Optimum
from bayesperiodic.diagnostics.score_tests import lags_to_try
from tests.known import LINEAR, grid, linear_experiment
from tests.problems import DUFFING, DUFFING_PRIORS, quadratic_damping

SPRING, LAG = 0.3, 1.5
RUNS = ((0.10, 0.6), (0.17, 1.0), (0.24, 1.4))


def problem_of(model, truth, samples, **settings):
    """Return three recordings of a truth, and the Duffing problem."""
    runs = []
    for number, (frequency, size) in enumerate(RUNS):
        recording = bp.simulate(
            model, truth, {"force": size * np.cos(2 * np.pi * grid(64))}, frequency=frequency,
            duration=24 / frequency, sampling_rate=40 * frequency, noise={"displacement": 0.002}, seed=number,
        ).between(12 / frequency, 24 / frequency)  # fmt: skip
        runs.append(replace(recording.fold(samples), name=f"run {number}"))
    priors = DUFFING_PRIORS | {"c": bp.LogNormal(0.4, 1.0)}
    return bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1.0}, **settings)


@pytest.fixture(scope="module")
def relaxing():
    """Return a Duffing problem of an oscillator with a spring and a damper in series, and its estimate."""
    truth = bp.Model(
        "duffing_and_maxwell", states=["x", "z"], inputs=["force"],
        parameters=["m", "c", "k", "k3", "spring", "time"],
        equations=["m*ddx + c*dx + k*x + k3*x**3 + spring*(x - z) - force", "time*dz + z - x"],
        outputs={"displacement": "x"},
    )  # fmt: skip
    problem = problem_of(truth, DUFFING | {"spring": SPRING, "time": LAG}, 64, scheme="fourier")
    return problem, bp.map_estimate(problem, progress=False)


@pytest.fixture(scope="module")
def found(relaxing):
    return bp.missing_terms(*relaxing)


@pytest.mark.slow
def test_a_relaxing_spring_is_found_with_stiffness_and_lag(relaxing, found):
    """The state z lags x by 1.5 s: spring·(x − z) is −spring·(lag(x) − x); with c and k free, lag(dx) is the same."""
    (step,) = found.steps
    assert (step.term, step.place) == ("lag(x) - x", "equation of x")
    assert step.alternatives == ("lag(dx) - dx in equation of x",)
    assert abs(step.coefficient + SPRING) < 4 * step.sd and step.sd < 0.02 * SPRING
    assert abs(step.lag - LAG) < 4 * step.lag_sd and step.lag_sd < 0.02 * LAG
    assert found.before.verdict == "misspecified" and step.verdict == "adequate"
    assert step.held_out < 1e-3 * found.before.held_out
    truth = {"c": DUFFING["c"], "k": DUFFING["k"], "k3": DUFFING["k3"]}
    fit = found.fit()
    assert all(abs(fit.theta[name] - value) < 4 * fit.sd[name] for name, value in truth.items())
    assert f"Its lag is {step.lag:.3g} ± {step.lag_sd:.2g} s." in repr(found)
    assert f"{step.name}·(lag(x) - x) in equation of x" in repr(found) and "the product" not in repr(found)
    best = found.ranking[found.ranking["term"] == "lag(x) - x"].iloc[0]
    assert best["lag"] in lags_to_try(relaxing[1]) and LAG / 3 < best["lag"] < 3 * LAG
    vague = repr(replace(found, steps=(replace(step, robust_sd=1.0),)))
    assert "The data determine the product of coefficient and lag, but not both." in vague


@pytest.mark.slow
def test_the_model_with_memory_has_the_lag_as_a_state_and_can_be_fitted(relaxing, found):
    (step,) = found.steps
    model, better = found.model(), found.problem()
    lag, state = step.name.replace("c_", "tau_", 1), step.name.replace("c_", "m_", 1)
    assert model.states == ("x", state) and model.parameters[-2:] == (step.name, lag)
    assert model.units[lag] == "s" and model.units[state] == "m" and model.units[step.name] == "N/m"
    again = bp.map_estimate(better, progress=False)
    assert again.theta == pytest.approx(found.fit().theta, rel=1e-6)
    solution = again.solutions["run 1"]
    x, m, period = solution.states["x"], solution.states[state], 1 / solution.frequency
    assert m == pytest.approx(_fourier.lagged(x[None], np.array([again.theta[lag] / period]))[0], abs=1e-6)
    assert found.model(0).states == ("x",)


def test_the_lag_of_a_sine_is_that_of_a_first_order_filter():
    """lag·ṁ + m = cos has the amplitude 1/√(1 + r²) and the phase −atan r, r being the lag in radians."""
    turn, ratio = 2 * np.pi * grid(64), np.array([0.05, 2.0])
    expected = [np.cos(turn - np.arctan(r)) / np.hypot(1, r) for r in 2 * np.pi * ratio]
    assert _fourier.lagged(np.stack([np.cos(turn)] * 2), ratio) == pytest.approx(np.array(expected), abs=1e-12)


def test_lags_cover_the_periods_of_all_experiments(relaxing):
    """From 0.3 rad at 0.24 Hz to 3 rad at 0.10 Hz."""
    lags = lags_to_try(relaxing[1])
    assert [lags[0], lags[-1]] == pytest.approx([0.3 / (2 * np.pi * 0.24), 3.0 / (2 * np.pi * 0.10)])
    assert np.all(np.diff(np.log(lags)) <= np.log(3.5)) and len(lags) == 4


def test_candidates_with_memory_are_variables_summands_and_whole_outputs():
    texts = {str(c) for c in generated(bp.models.duffing, ["equation of x", "displacement"], {}) if "lag" in c.text}
    assert {f"lag({n}) - {n} in equation of x" for n in ("x", "dx", "force", "x**3")} <= texts
    assert "lag(x) - x in displacement" in texts and not any("ddx" in text or "ddforce" in text for text in texts)
    texts = {c.text for c in generated(bp.models.landing_gear("displacement"), ["force", "pressure"], {})}
    assert {"lag(pressure) - pressure", "lag(force) - force"} <= texts


def test_lags_are_given_as_texts():
    one, other, scaled = given(bp.models.duffing, {"equation of x": ["lag(x**2)", "lag(x*dx) - x*dx", "lag((x)) + x"]})
    assert [coefficient_unit(bp.models.duffing, term) for term in (one, other, scaled)] == ["N/m^2", "N s/m^2", "N/m"]
    names = coefficient_names(bp.models.duffing, [one, other])
    assert names == ["c_lag_x_2", "c_lag_x_dx"]
    model = extended(bp.models.duffing, dict(zip(names, (one, other), strict=True)))
    x, dx = (model.state_symbols[name] for name in ("x", "dx"))
    m, rate, tau = model.state_symbols["m_lag_x_2"], model.state_symbols["dm_lag_x_2"], "tau_lag_x_2"
    assert model.equations[1] - (model.parameter_symbols[tau] * rate + m - x**2) == 0
    c, product = model.parameter_symbols["c_lag_x_dx"], model.state_symbols["m_lag_x_dx"]
    assert model.equations[0].diff(c) - (product - x * dx) == 0
    assert model.orders == {"x": 2, "m_lag_x_2": 1, "m_lag_x_dx": 1}
    for text in ("x + lag(x)", "2*lag(x)", "lag(lag(x))", "lag(x) - lag(dx)", "lag(x)*x", "lag(x", "lag(y)", "lag()"):
        with pytest.raises(ValueError, match=r"candidates\['equation of x'\]"):
            given(bp.models.duffing, {"equation of x": [text]})


@pytest.fixture(scope="module")
def rubbing():
    """Return a problem that lacks dry friction, and its estimate; a long lag of the friction is its mean."""
    run = linear_experiment([900.0, 40.0, 25.0], 1.0, seed=2)
    priors = {"k": bp.Normal(900, 300), "c": bp.LogNormal(40, 1)}
    problem = bp.Problem(LINEAR, [run], priors=priors, fixed={"coulomb": 0})
    return problem, bp.map_estimate(problem, progress=False)


FRICTION = {"force": ["lag(tanh(10*dx)) - tanh(10*dx)", "tanh(10*dx)"]}


@pytest.mark.slow
def test_a_term_without_memory_comes_before_one_of_the_same_fit(rubbing, monkeypatch):
    """Of the difference, friction is left; its evidence seems larger, but see the next test."""
    monkeypatch.setattr(Optimum, "curved", True)
    found = bp.missing_terms(*rubbing, FRICTION, equations=False, outputs=False, max_terms=1)
    assert found.steps[0].term == "tanh(10*dx)" and np.isnan(found.steps[0].lag)
    assert found.steps[0].alternatives == ("lag(tanh(10*dx)) - tanh(10*dx) in force",)


def test_a_lag_that_the_data_hardly_determine_is_refused(rubbing):
    """Its clipped eigenvalue would add 354 to the logarithm of the evidence."""
    found = bp.missing_terms(*rubbing, FRICTION, equations=False, outputs=False, max_terms=1)
    assert [step.term for step in found.steps] == ["tanh(10*dx)"] and found.steps[0].alternatives == ()
    assert "evidence cannot be approximated" in found.refused["lag(tanh(10*dx)) - tanh(10*dx) in force"]


@pytest.mark.filterwarnings("ignore:Twice as many points")
def test_a_term_for_the_error_of_the_grid_is_refused():
    """24 points a period, differences of second order: significant, but on 48 points it would be a quarter."""
    problem = problem_of(bp.models.duffing, DUFFING, 24, scheme="central2")
    fit = bp.map_estimate(problem, progress=False)
    found = bp.missing_terms(problem, fit)
    assert (found.ranking["p_adjusted"] < 0.01).any() and found.steps == ()
    assert "on twice as many points its coefficient changes by 7" in found.stopped
    assert "Take more samples in fold(), or a scheme of higher order" in found.stopped
    finer = problem_of(bp.models.duffing, DUFFING, 24, scheme="fourier")
    assert bp.missing_terms(finer, bp.map_estimate(finer, progress=False)).before.verdict == "adequate"


@pytest.mark.slow
def test_results_are_saved_and_read_without_their_models(relaxing, found, tmp_path):
    problem, fit = relaxing
    found.save(tmp_path / "found.h5")
    read = bp.load(tmp_path / "found.h5")
    assert read.steps == found.steps and repr(read) == repr(found) and read.refused == found.refused
    pd.testing.assert_frame_equal(read.ranking, found.ranking)
    pd.testing.assert_frame_equal(read.table, found.table)
    assert read.fit().theta == found.fit().theta and read.fit(0).theta == fit.theta
    for get in (read.model, read.problem):
        with pytest.raises(ValueError, match="found: must be what missing_terms has returned"):
            get(1)
    left, before, _ = bp.plot.missing_terms(problem, fit, read).axes
    assert before.get_xlabel() == "time in the period [s]"
    assert [t.get_text() for t in left.get_yticklabels()][1] == "+ lag(x) - x\nin equation of x"
    assert bp.plot.missing_terms(problem, fit, found).axes[1].get_xlabel() == "x [m]"


def test_terms_that_only_left_out_experiments_exclude_are_named(monkeypatch):
    problem, fit = quadratic_damping()
    monkeypatch.setattr(missing_terms, "distinct", lambda one, other: False)

    def error(state):
        terms = [name for name in state.names if state.iterate.theta[state.problem.names.index(name)] != 0.0]
        return np.inf if not terms else 1e-7 if "3" in terms[0] else 2.1e-7

    monkeypatch.setattr(missing_terms, "held_out_error", error)
    wanted = {"equation of x": ["dx*abs(dx)", "dx**3"]}
    found = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False, max_terms=1)
    (step,) = found.steps
    assert step.term == "dx**3" and step.alternatives == () and step.worse == ("dx*abs(dx) in equation of x",)
    assert "As good a fit, but worse in experiments left out: dx*abs(dx) in equation of x." in repr(found)
    assert "no prediction" in repr(found) and "inf" not in repr(found) and found.before.held_out == np.inf


@pytest.mark.parametrize(("coupling", "curved"), [(0.9, True), (1.0, False), (1.1, False)])
def test_only_a_positive_definite_hessian_matrix_has_an_evidence(coupling, curved):
    hessian = np.array([[1.0, coupling * 1e3], [coupling * 1e3, 1e6]])
    objective = SimpleNamespace(hessian_and_gradient=lambda iterate: (hessian, np.zeros(2)))
    assert Optimum(None, objective, None, ()).curved is curved


def test_the_next_candidate_takes_the_place_of_one_without_an_evidence(monkeypatch):
    monkeypatch.setattr(Optimum, "curved", property(lambda state: "c_dx_abs_dx" not in state.names))
    wanted = {"equation of x": ["dx*abs(dx)", "dx**3"]}
    found = bp.missing_terms(*quadratic_damping(), wanted, equations=False, outputs=False, max_terms=1, keep=1)
    assert "evidence cannot be approximated" in found.refused["dx*abs(dx) in equation of x"]
    assert [step.term for step in found.steps] == ["dx**3"]
    monkeypatch.setattr(Optimum, "curved", False)  # not even of the given model: all are compared as they are
    found = bp.missing_terms(*quadratic_damping(), wanted, equations=False, outputs=False, max_terms=1, keep=1)
    assert [step.term for step in found.steps] == ["dx*abs(dx)"] and found.refused == {}
