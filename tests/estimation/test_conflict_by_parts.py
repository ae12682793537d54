"""The estimate by the data alone, the starts that look for it, and the test itself, against regressions by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.estimation import conflict
from bayesperiodic.estimation.conflict import PriorConflict
from bayesperiodic.estimation.gauss_newton import Iterate
from tests.estimation.test_conflict import DESIGN, problem_of

SD, COUNT = 0.1, 11
KNOWN = {"variance[y]": SD**2}


def at(problem, *theta, variance=SD**2):
    theta = np.array(theta)
    return Iterate(theta, problem.density().linearise(theta), np.array([variance]), 0.0)


def regression(problem, columns=2):
    """Return the estimate by least squares, its covariance per variance, and the sum of squares that is left."""
    x, y = DESIGN[:, :columns], problem.experiments[0].outputs["y"]
    best = np.linalg.lstsq(x, y, rcond=None)[0]
    return best, np.linalg.inv(x.T @ x), np.sum((y - x @ best) ** 2)


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("known", [True, False])
def test_p_and_intervals_at_the_estimate_by_the_data(logarithmic, known):
    """Offset² over (prior + error)², the error in midpoints of 32 equal parts of its unknown size; t for the data."""
    priors = {"a": bp.LogNormal(0.9, 0.1) if logarithmic else bp.Normal(0.9, 0.1), "b": bp.Normal(2.0, 0.3)}
    problem = problem_of(priors, (1.1, 1.8), SD, np.random.default_rng(2), fixed=KNOWN if known else {})
    best, inverse, _ = regression(problem)
    result = conflict._tested(problem, at(problem, *best))
    slope = np.array([best[0] if logarithmic else 1.0, 1.0])
    offset = np.array([np.log(best[0] / 0.9) if logarithmic else best[0] - 0.9, best[1] - 2.0])
    error = SD**2 * inverse / np.outer(slope, slope)
    freedom = COUNT - 2
    ratio = np.ones(1) if known else freedom / stats.chi2.isf((np.arange(32) + 0.5) / 32, freedom)
    prior = np.diag([0.1**2, 0.3**2])
    each = [2 * stats.norm.sf(np.abs(offset) / np.sqrt(np.diag(prior + r * error))) for r in ratio]
    assert result.table["p"].to_numpy() == pytest.approx(np.mean(each, axis=0), rel=0.03)
    squares = [offset @ np.linalg.solve(prior + r * error, offset) for r in ratio]
    assert result.joint == pytest.approx(np.mean(stats.chi2.sf(squares, 2)), rel=0.06)
    quantile = stats.norm.ppf(0.95) if known else stats.t.ppf(0.95, freedom)
    half = quantile * np.sqrt(np.diag(error))
    low, high = offset - half, offset + half
    if logarithmic:
        expected = [[0.9 * np.exp(low[0]), 2.0 + low[1]], [0.9 * np.exp(high[0]), 2.0 + high[1]]]
    else:
        expected = [[0.9, 2.0] + low, [0.9, 2.0] + high]
    assert result.table[["data_low", "data_high"]].to_numpy().T == pytest.approx(np.array(expected), rel=1e-4)
    ends = [priors["a"].quantile(np.array([0.05, 0.95])), 2.0 + 0.3 * stats.norm.ppf([0.05, 0.95])]
    assert result.table[["prior_low", "prior_high"]].to_numpy() == pytest.approx(np.array(ends))
    assert result.p == pytest.approx(min(1.0, 2 * result.joint, *(4 * result.table["p"])))


@pytest.mark.parametrize(("error", "tested"), [(9.5, True), (10.5, False)])
def test_a_direction_is_tested_if_the_data_have_a_hundredth_of_the_priors_information(error, tested):
    """Its error is at most ten widths of the prior; one that is not tested is left out of the joint p too."""
    problem = problem_of({"a": bp.Normal(1.0, 1.0)}, (1.0, 0.0), SD, np.random.default_rng(2), fixed={"b": 0.0} | KNOWN)
    _, inverse, _ = regression(problem, 1)
    variance = error**2 / inverse[0, 0]
    result = conflict._tested(problem, at(problem, 1.0, variance=variance))
    assert np.isfinite([result.joint, result.p, result.table["p"].iloc[0]]).tolist() == [tested] * 3
    assert result.members == ()


def test_members_of_a_conflict_are_those_of_the_direction_with_the_largest_deviation():
    """The sum of a and b contradicts the priors by 3.6 sds; each alone has an error of 10/√2."""
    x = np.ones((2, COUNT)) / np.sqrt(COUNT)
    problem = problem_of({"a": bp.Normal(0.0, 1.0), "b": bp.Normal(0.0, 1.0)}, (1.0, 1.0), SD,
                         np.random.default_rng(2), fixed=KNOWN)  # fmt: skip
    here = SimpleNamespace(jacobian=[x], residuals=[np.zeros(COUNT)])
    estimate = SimpleNamespace(theta=np.array([2.55, 2.55]), here=here, noise=np.array([SD**2]))
    result = conflict._tested(problem, estimate)
    assert result.table["p"].to_numpy() == pytest.approx(2 * stats.norm.sf(2.55 / np.sqrt(51.0)), rel=0.02)
    assert result.joint == pytest.approx(2 * stats.norm.sf(5.1 / np.sqrt(2)), rel=0.1)
    assert result.members == ("a", "b")


@pytest.mark.parametrize(("gain", "moved"), [(0.48, False), (0.52, True)])
@pytest.mark.parametrize("known", [True, False])
def test_the_estimate_is_that_of_the_data_unless_a_step_gains_half(gain, moved, known):
    """(d/s)² for the distance d to least squares, in units of its error s at the variance of the estimate."""
    problem = problem_of({"a": bp.Normal(1.0, 1.0)}, (1.0, 0.0), SD, np.random.default_rng(2),
                         fixed={"b": 0.0} | (KNOWN if known else {}))  # fmt: skip
    best, inverse, left = regression(problem, 1)
    variance = SD**2 if known else left / (COUNT - 1)
    error = np.sqrt(inverse[0, 0] * variance)
    estimate = at(problem, best[0] - np.sqrt(gain) * error, variance=variance)
    alone = conflict._by_the_data(problem, estimate)
    assert (alone is estimate) != moved
    if moved:
        assert alone.theta[0] == pytest.approx(best[0], abs=1e-3 * error)


@pytest.mark.parametrize("known", [True, False])
def test_an_unknown_variance_is_that_without_the_misfit_which_the_prior_causes(known):
    """With it, 250 prior sds away, the data would have 2e-4 of the prior's information, and not move the estimate."""
    problem = problem_of({"a": bp.Normal(-4.0, 0.02)}, (1.0, 0.0), SD, np.random.default_rng(2),
                         fixed={"b": 0.0} | (KNOWN if known else {}))  # fmt: skip
    best, inverse, left = regression(problem, 1)
    variance = (left + (best[0] + 4.0) ** 2 / inverse[0, 0]) / COUNT
    assert 0.02**2 / inverse[0, 0] / variance < 3e-4
    alone = conflict._by_the_data(problem, at(problem, -4.0, variance=variance))
    assert alone.theta[0] == pytest.approx(-4.0 if known else best[0], abs=0.05)


def test_far_from_the_prior_the_estimate_is_that_of_least_squares():
    priors = {"a": bp.LogNormal(0.5, 0.02), "b": bp.Normal(1.0, 0.02)}
    problem = problem_of(priors, (1.1, 1.8), SD, np.random.default_rng(2))
    best, inverse, left = regression(problem)
    alone = conflict._by_the_data(problem, at(problem, 0.6, 1.2, variance=0.5))
    assert np.abs(alone.theta - best) == pytest.approx(0.0, abs=0.05 * SD * np.sqrt(inverse.diagonal().max()))
    assert alone.noise[0] == pytest.approx(left / (COUNT - 2), rel=0.02)
    exact = at(problem, 0.6, 1.2)
    exact.here.residuals = [np.zeros(COUNT)]
    assert conflict._by_the_data(problem, exact) is exact


def test_starts_from_elsewhere_are_draws_of_the_prior_which_is_wider_for_members(monkeypatch):
    """Three widths: 400 draws whose standard deviations are within five of their errors, 1/√800."""
    priors = {"a": bp.LogNormal(0.5, 0.02), "b": bp.Normal(1.0, 0.3)}
    problem = problem_of(priors, (1.1, 1.8), SD, np.random.default_rng(2))
    alone, tried, factors = at(problem, 1.1, 1.8), [], []
    almost_flat = conflict._almost_flat

    def flat(one, near, factor):
        factors.append(factor.tolist())
        wide = almost_flat(one, near, factor)
        density = SimpleNamespace(
            problem=wide.density.problem, linearise=lambda theta: theta, objective=lambda *_, of_total: -3.0
        )
        return SimpleNamespace(
            density=density, iterate=lambda here, noise: here if here[1] > 1.0 else None,
            log_variance_factor=wide.log_variance_factor, of_total=True,
        )  # fmt: skip

    monkeypatch.setattr(conflict, "_almost_flat", flat)
    monkeypatch.setattr(
        conflict, "climb", lambda objective, first: SimpleNamespace(iterate=tried.append(first.copy()) or len(tried))
    )
    monkeypatch.setattr(conflict, "START_WIDTHS", (3.0,) * 800)
    first, *others = conflict._from_elsewhere(problem, alone, ("a",))
    assert first.theta is alone.theta and first.objective == -3.0 and factors == [[100.0, 1.0]]
    assert others == list(range(1, len(tried) + 1)) and 300 < len(tried) < 500, "half of the draws have no density"
    a, b = np.transpose(tried)
    assert np.std(np.log(a / 0.5) / (3.0 * 0.02)) == pytest.approx(1.0, abs=0.18)
    assert abs(np.mean(np.log(a / 0.5) / 0.06)) < 0.25
    # Those above the median of b, a half-normal distribution.
    assert np.mean((b - 1.0) / 0.3) == pytest.approx(np.sqrt(2 / np.pi), abs=0.15)
    tried.clear()
    list(conflict._from_elsewhere(problem, alone, ("b",)))
    a, b = np.transpose(tried)
    assert np.std(np.log(a / 0.5) / 0.02) == pytest.approx(1.0, abs=0.18)
    assert np.mean((b - 1.0) / 0.9) == pytest.approx(np.sqrt(2 / np.pi), abs=0.15)


def test_widened_priors_have_the_median_and_the_support_of_the_given_ones():
    covariance = np.array([[0.01, 0.008], [0.008, 0.02]])
    model = bp.Model("four", states=["w"], inputs=["x"], parameters=["a", "b", "c", "d", "e"],
                     equations=["dw + w - x"], outputs={"y": "a*x + b*w + c*dx + d*x*w + e*x**2"})  # fmt: skip
    given = {
        ("a", "b"): bp.MultivariateNormal([1.0, 2.0], covariance), "c": bp.LogNormal(2.0, 0.3),
        "d": bp.Uniform(-1.0, 3.0), "e": bp.Normal(4.0, 0.5),
    }  # fmt: skip
    run = problem_of({"a": bp.Normal(1.0, 1.0), "b": bp.Normal(1.0, 1.0)}, (1.0, 2.0), SD, np.random.default_rng(2))
    problem = bp.Problem(model, run.experiments, priors=given, scheme="fourier")
    wider = conflict._widened(problem, np.array([1.0, 7.0, 5.0, 3.0, 1.0]))
    assert list(wider) == list(given) and wider["e"] is given["e"]
    assert wider["a", "b"].covariance == pytest.approx(49.0 * covariance)
    assert wider["a", "b"].mean == pytest.approx([1.0, 2.0])
    assert np.log(wider["c"].quantile(np.array([0.5, stats.norm.cdf(1.0)]))) == pytest.approx(np.log(2.0) + [0.0, 1.5])
    assert wider["d"].support == (-1.0, 3.0)
    same = conflict._widened(problem, np.ones(5))
    assert all(same[key] is given[key] for key in given)


@pytest.mark.parametrize(("p", "said"), [(0.00123, "p = 0.0012"), (2e-9, "p = 2e-09"), (9e-10, "p < 1e-9")])
def test_a_conflict_in_words(p, said):
    table = pd.DataFrame({"data_low": [1.0, 2.00006], "data_high": [3.0, 4.0], "prior_low": [5.0, 6.0],
                          "prior_high": [7.0, 8.0], "p": [0.5, p]}, index=["a", "b"])  # fmt: skip
    found = PriorConflict(table, p, p, ("b",))
    assert found.text == (
        f"Prior and data disagree ({said}; 90 % intervals): 'b': the data alone give 2 to 4, the prior 6 to 8"
    )
    both = replace(found, members=("a", "b")).text
    assert "): 'a': the data alone give 1 to 3, the prior 5 to 7; 'b': the data" in both
    assert replace(found, members=()).text == ""


@pytest.mark.parametrize("members", [(), ("a",)])
def test_a_conflict_is_tested_again_at_the_best_of_several_estimates(monkeypatch, members):
    """The maximum next to the prior may be a local one."""
    ends = [SimpleNamespace(name="near", objective=-5.0), SimpleNamespace(name="best", objective=-2.0)]
    monkeypatch.setattr(conflict, "_by_the_data", lambda problem, estimate: ends[0])
    monkeypatch.setattr(conflict, "_from_elsewhere", lambda problem, alone, names: iter(ends * (names == members)))
    monkeypatch.setattr(conflict, "_tested", lambda problem, one: SimpleNamespace(members=members, at=one.name))
    tested, alone = conflict.prior_conflict("problem", "estimate")
    assert (tested.at, alone.name) == (("best", "best") if members else ("near", "near"))
