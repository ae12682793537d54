"""Problems whose experiments have no time history: tables of amplitudes, and jumps."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic import plot
from tests.response_tables import FORCE, PRIORS, TRUTH, swept

FREQUENCIES = np.linspace(0.13, 0.2, 8)


@pytest.fixture(scope="module")
def problem():
    amplitudes = np.abs(swept(FREQUENCIES, "up")) * (1 + 0.01 * np.random.default_rng(1).standard_normal(8))
    runs = bp.response_table(
        {"f": FREQUENCIES, "A": amplitudes},
        frequency="f",
        outputs={"displacement": "A"},
        inputs={"force": FORCE},
        sd={"displacement": "1%"},
        sweep="up",
    )
    return bp.Problem(bp.models.duffing, runs, priors=PRIORS, fixed={"m": 1.0}, scheme="central4")


@pytest.fixture(scope="module")
def fit(problem):
    return bp.map_estimate(problem, progress=False)


def test_number_of_values_is_that_of_the_table(problem):
    assert "data: amplitude of displacement with 8 independent values" in repr(problem)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("factor", [1e-300, 1e-12, -1.0, 1e150])
def test_solves_at_extreme_parameters_are_silent(problem, factor):
    for place in range(len(problem.names)):
        theta = problem.median()
        theta[place] *= factor
        assert {solution.status for solution in problem.solve(theta).values()}


def test_report_has_the_table_and_no_periods(problem, fit, tmp_path):
    text = bp.report(problem, fit, None, tmp_path / "table.html").read_text(encoding="utf-8")
    assert "figure-response" in text and "figure-fit-1" not in text and "figure-loops" not in text


def test_check_without_tests_of_channels_prints_no_empty_table(problem, fit):
    assert "Empty" not in repr(bp.check(problem, fit)) and "Empty" not in repr(fit)


def test_prior_predictive_has_no_share_inside_without_a_time_history(problem):
    assert bp.prior_predictive(problem, draws=20, progress=False).table["inside"].isna().all()


@pytest.mark.parametrize("draw", [plot.fit, plot.loops])
def test_figures_of_time_histories_name_that_of_tables(problem, fit, draw):
    with pytest.raises(ValueError, match=r"must have time histories, .* bp\.plot\.response"):
        draw(problem, fit)
    plt.close("all")


@pytest.mark.filterwarnings("error")
def test_missing_cubic_spring_is_found_in_a_table_with_phases(problem):
    """The coefficient is within 4 robust standard deviations of the true one, which 1 of 10,000 seeds is not."""
    c = swept(FREQUENCIES, "up") * (1 + 0.01 * np.random.default_rng(2).standard_normal((8, 2)) @ [1.0, 1j])
    runs = bp.response_table(
        {"f": FREQUENCIES, "c": c},
        frequency="f",
        outputs={"displacement": "c"},
        inputs={"force": FORCE},
        sd={"displacement": "1%"},
    )
    priors = {name: PRIORS[name] for name in ("c", "k")}
    linear = problem.replace(experiments=runs, priors=priors, fixed={"m": 1.0, "k3": 0.0})
    with pytest.warns(UserWarning, match="Prior and data disagree"):
        start = bp.map_estimate(linear, progress=False)
    terms = {"equation of x": ["x**3", "x**2"]}
    found = bp.missing_terms(linear, start, terms, equations=False, outputs=False, max_terms=1)
    (step,) = found.steps
    assert step.term == "x**3" and np.isnan(step.held_out)
    assert step.coefficient == pytest.approx(TRUTH["k3"], abs=4 * step.robust_sd)


def test_problem_of_jumps_says_so():
    jumps = [
        bp.jump(way, f, {"force": 0.2}, direction=way, sd=1e-3) for way, f in (("up", 0.216), ("down", 0.191))
    ]  # fmt: skip
    problem = bp.Problem(bp.models.duffing, jumps, priors=PRIORS, fixed={"m": 1.0})
    assert "data: jumps in frequency with 2 independent values" in repr(problem)


@pytest.mark.parametrize("way", ["up", "down"])
def test_jumps_of_a_softening_spring_are_solved(way):
    """By the balance of one harmonic; the third one is below 1 % of it and moves the folds by less than 0.1 %."""
    theta, force = {"m": 0.5, "c": 0.03, "k": 20.0, "k3": -2.0}, 0.2
    a = np.linspace(0.05, 1.105, 200_001)
    stiffness, m, c = theta["k"] + 0.75 * theta["k3"] * a**2, theta["m"], theta["c"]
    b = 2 * m * stiffness - c**2
    f = np.sqrt((b - np.sqrt(b**2 - 4 * m**2 * (stiffness**2 - (force / a) ** 2))) / (2 * m**2)) / (2 * np.pi)
    upper, lower = f[1:-1][np.diff(np.sign(np.diff(f))) != 0]
    expected = {"up": upper, "down": lower}[way]
    run = bp.jump(way, 0.98 if way == "up" else 0.96, {"force": force}, direction=way, sd=1e-3)
    problem = bp.Problem(bp.models.duffing, [run], priors=PRIORS | {"k3": bp.Normal(-2, 1)}, fixed={"m": 0.5})
    (orbit,) = problem.solve({name: theta[name] for name in problem.names}).values()
    assert orbit.frequency == pytest.approx(expected, rel=1e-3)
