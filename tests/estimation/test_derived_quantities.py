"""Quantities derived from an estimate, and its normal approximation as a prior, against the delta method by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation.intervals import carried_covariance
from tests.known import LINEAR, linear_experiment

PRIORS = {"k": bp.Normal(800.0, 60.0), "coulomb": bp.Normal(20.0, 10.0)}


@pytest.fixture(scope="module")
def fit():
    """Return a fit of k in common, coulomb of each of two runs, c tied to k, and a known variance."""
    runs = [
        linear_experiment(np.array([900.0, 45.0, f]), 3.0, seed=1, name=name) for name, f in (("a", 25.0), ("b", 15.0))
    ]
    problem = bp.Problem(
        LINEAR, runs, priors=PRIORS, fixed={"variance[force]": 9.0}, tied={"c": "k/20"}, local=("coulomb",)
    )
    return bp.map_estimate(problem, progress=False)


def test_deviations_follow_the_gradient_by_free_parameters(fit):
    """Of k + c = 1.05 k, and of a ratio by its two parts; in one run the local parameter has its plain name."""
    assert [*fit.theta] == ["k", "coulomb[a]", "coulomb[b]"]
    covariance, k = fit.covariance.to_numpy(), fit.theta["k"]
    table = fit.derive({"total": "k + c", "twice": "c*2", "seven": "7", "again": "3*c + k"})
    assert table["value"].tolist() == pytest.approx([1.05 * k, 0.1 * k, 7.0, 1.15 * k])
    assert table["sd"].tolist() == pytest.approx([1.05 * fit.sd["k"], 0.1 * fit.sd["k"], 0.0, 1.15 * fit.sd["k"]])
    for run, place in (("a", 1), ("b", 2)):
        f = fit.theta[f"coulomb[{run}]"]
        table = fit.derive({"ratio": "coulomb/k", "sum": "coulomb + k"}, experiment=run)
        gradient = np.zeros((2, 3))
        gradient[0, [0, place]] = -f / k**2, 1.0 / k
        gradient[1, [0, place]] = 1.0, 1.0
        expected = gradient @ covariance @ gradient.T
        assert table["value"].tolist() == pytest.approx([f / k, f + k])
        assert table["sd"].tolist() == pytest.approx(np.sqrt(np.diag(expected)))
        joint = table.attrs["covariance"]
        assert [[joint[x][y] for y in ("ratio", "sum")] for x in ("ratio", "sum")] == pytest.approx(expected)
        assert [*joint] == [*joint["ratio"]] == ["ratio", "sum"] and table.columns.tolist() == ["value", "sd"]


def test_a_gradient_adds_what_goes_through_tied_parameters():
    """Of a quantity with slopes 2 by c and 3 by a, where c depends on a and on b; d is fixed, e tied to b alone."""
    slopes = {"c": 2.0, "a": 3.0, "d": 7.0, "e": 5.0}
    quantity = SimpleNamespace(gradient=lambda values: slopes if values == "values" else None)
    fit = SimpleNamespace(theta={"a[run]": 1.0, "b": 2.0}, tied={"c": {"a[run]": 10.0, "b": 0.5}, "e": {"b": 4.0}})
    found = bp.MapEstimate._gradient(fit, quantity, "values", {"a": "a[run]", "b": "b"})
    assert found.tolist() == [2.0 * 10.0 + 3.0, 2.0 * 0.5 + 5.0 * 4.0]


def test_names_that_are_not_shared_need_the_experiment(fit):
    with pytest.raises(ValueError, match="got 'coulomb'.*experiment="):
        fit.derive({"x": "2*coulomb"})
    with pytest.raises(ValueError, match="experiment: must be one of 'a', 'b', got 'd'"):
        fit.derive({"x": "2*coulomb"}, experiment="d")
    with pytest.raises(
        ValueError, match=r"expressions\['x'\]: must be finite at the estimate, got nan for 'log\(-k\)'.$"
    ):
        fit.derive({"x": "log(-k)"})
    with pytest.raises(ValueError, match="got 'k'"):
        fit.derive({"k": "2*c"})
    assert fit.derive({}).empty


def test_infinite_variances_of_other_parameters_do_not_matter():
    matrix = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 2.0], [0.5, 2.0, np.inf]])
    found = carried_covariance(
        matrix, [np.array([1.0, 0.0, 0.0]), np.array([2.0, -1.0, 0.0]), np.array([0.0, 0.0, 3.0])]
    )
    assert found.tolist() == [[4.0, 7.0, 1.5], [7.0, 21.0, -3.0], [1.5, -3.0, np.inf]]


def test_part_of_the_covariance_is_a_prior(fit):
    names = ("coulomb[b]", "k")
    prior = fit.as_prior(names)
    part = fit.covariance.loc[[*names], [*names]].to_numpy()
    at = np.array([14.0, 870.0])
    mean = np.array([fit.theta[name] for name in names])
    expected = -0.5 * (at - mean) @ np.linalg.solve(part, at - mean) - 0.5 * np.log(np.linalg.det(2 * np.pi * part))
    assert float(prior.log_prob(at)) == pytest.approx(expected)
    for wrong in (["k", "c"], ("k", "k"), ("k", "c"), "k"):
        with pytest.raises(ValueError, match="names: must"):
            fit.as_prior(wrong)


def test_a_prior_needs_a_converged_estimate_and_finite_deviations(fit):
    with pytest.warns(
        UserWarning, match=r"The estimate has not converged \(max_steps\), and the prior is unreliable. Try"
    ) as caught:
        replace(fit, status="max_steps").as_prior(("k", "coulomb[a]"))
    assert caught[0].filename == __file__
    lost = fit.covariance.copy()
    lost.loc["k", "k"] = np.inf
    with pytest.raises(
        ValueError, match="names: must be parameters with a finite standard deviation, got 'k', which the"
    ):
        replace(fit, covariance=lost).as_prior(("k", "coulomb[a]"))
    assert replace(fit, covariance=lost).as_prior(("coulomb[b]", "coulomb[a]")).log_prob(np.array([15.0, 25.0])) > -50


def test_what_was_not_computed_is_named_with_the_call_that_does():
    run = linear_experiment(np.array([900.0, 45.0, 25.0]), 3.0, seed=1)
    problem = bp.Problem(LINEAR, [run], priors=PRIORS, fixed={"c": 45.0})
    bare = bp.map_estimate(problem, progress=False, checks=False)
    with pytest.raises(
        ValueError,
        match="checks: must be computed before 'misfit' is used, got an estimate with checks=False; take map_est",
    ):
        bare.misfit  # noqa: B018
