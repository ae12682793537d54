import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic._expressions import OPERATIONS
from bayesperiodic.diagnostics.identifiability import structure_of
from tests.known import LINEAR, grid, linear_experiment, linear_regressors, normal_posterior

PRIORS = {"k": bp.Normal(800.0, 60.0), "coulomb": bp.Normal(20.0, 10.0)}
VARIANCE = {"variance[force]": 9.0}


def problem(tied, priors=PRIORS, fixed=VARIANCE) -> bp.Problem:
    return bp.Problem(
        LINEAR, [linear_experiment([900.0, 45.0, 25.0], 3.0, seed=1)], priors=priors, fixed=fixed, tied=tied
    )


def test_tied_parameter_gives_the_closed_form_posterior():
    """C = k/20 + coulomb turns the linear model into one with two regressors, whose posterior is closed."""
    fit = bp.map_estimate(problem({"c": "k/20 + coulomb"}), progress=False)
    x = linear_regressors(0.05, 2.0, grid(40))
    regressors = np.stack([x[:, 0] + x[:, 1] / 20, x[:, 2] + x[:, 1]], axis=-1)
    data = linear_experiment([900.0, 45.0, 25.0], 3.0, seed=1).outputs["force"]
    mean, covariance = normal_posterior(regressors, data, 9.0, [800.0, 20.0], np.diag([60.0, 10.0]) ** 2)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-9)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-8)
    derived = fit.derive({"damping": "c", "sum": "c + k"})
    slopes = np.array([[1 / 20, 1.0], [21 / 20, 1.0]])
    assert derived["value"].to_numpy() == pytest.approx(slopes @ mean, rel=1e-9)
    exact = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    assert derived["sd"].to_numpy() == pytest.approx(exact, rel=1e-8)


def test_log_likelihood_uses_the_tied_value():
    tied, free = problem({"c": "0.05*k"}), problem({}, priors=PRIORS | {"c": bp.Normal(45.0, 1e3)})
    theta = {"k": np.array([850.0, 910.0]), "coulomb": np.array([20.0, 31.0])}
    expected = free.log_likelihood(theta | {"c": 0.05 * theta["k"]}, {})
    assert tied.log_likelihood(theta, {}) == pytest.approx(expected, rel=1e-12)


def test_chains_of_ties_and_nonlinear_ones_have_exact_slopes():
    chained = problem({"c": "sqrt(coulomb)*2", "coulomb": "k**2/1e5"}, priors={"k": PRIORS["k"]})
    at = chained.parameters(np.array([[800.0]]), "run")[0]
    assert at == pytest.approx([800.0, 2 * np.sqrt(6.4), 6.4])
    slopes = chained.parameter_maps["run"].slopes(np.array([800.0]))
    assert slopes[:, 0] == pytest.approx([1.0, 0.016 / np.sqrt(6.4), 0.016, 0.0], rel=1e-12)
    fit = bp.map_estimate(chained, progress=False)
    assert fit.converged and fit.tied["coulomb"]["k"] == pytest.approx(2 * fit.theta["k"] / 1e5)


def test_ties_are_part_of_the_fingerprint():
    from bayesperiodic.problem.fingerprint import fingerprint

    assert fingerprint(problem({"c": "0.05*k"})) != fingerprint(problem({"c": "0.06*k"}))


@pytest.mark.parametrize("function", [*OPERATIONS])
def test_every_function_of_a_tie_is_analysed_structurally(function):
    """The force depends on k and on a function of it, so that k is determined."""
    found = structure_of(problem({"c": f"30*{function}(k/800)"}))
    assert found.table["verdict"].to_dict() == {"k": "determined", "coulomb": "determined"}
    chained = {"c": f"{function}(coulomb)", "coulomb": f"{function}(k/800) + k/3"}
    found = structure_of(problem(chained, priors={"k": PRIORS["k"]}))
    assert found.table["verdict"].to_dict() == {"k": "determined"}


def test_degrees_of_chained_ties_multiply():
    with pytest.raises(ValueError, match=r"tied\['c'\]: must have .*of degree 36"):
        problem({"c": "(coulomb+1)**6", "coulomb": "(k+1)**6"}, priors={"k": PRIORS["k"]})


def test_report_of_a_tie_with_an_absolute_value(tmp_path):
    tied = problem({"c": "abs(k)/20"})
    fit = bp.map_estimate(tied, progress=False)
    assert bp.identifiability(tied, fit, profile=False).verdicts["k"] == "determined"
    assert bp.report(tied, fit, None, tmp_path / "report.html").is_file()


@pytest.mark.parametrize(
    ("tied", "fixed", "message"),
    [
        ({"c": "k2/20"}, {}, r"tied\['c'\].*got 'k2'.*Did you mean 'k'"),
        ({"c": "2*c"}, {}, "tied: must not be circular, got"),
        ({"damping": "k"}, {}, "tied: must be .*got 'damping'"),
        ({"c": "k", "k": "c"}, {}, "tied: 'k' is in priors too"),
        ({"c": "k"}, {"c": 1.0}, "tied: 'c' is in fixed too"),
        ({"c": "__import__('os')"}, {}, r"tied\['c'\]: functions in .*: must be one of"),
        ({"c": "(1+k)**1000"}, {}, r"tied\['c'\]: must have powers and products of a degree up to 20, got '\(1\+k"),
        ({"c": 3.0}, {}, r"tied\['c'\]: must be .*got 3.0"),
        ({}, {}, "'c' has neither a prior nor a value"),
    ],
)
def test_error_names_the_bad_tie(tied, fixed, message):
    with pytest.raises(ValueError, match=message):
        problem(tied, fixed=VARIANCE | fixed)
