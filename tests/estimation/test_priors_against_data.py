"""The test of priors against data, direction by direction, against the closed form of linear regression."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.estimation import conflict
from bayesperiodic.estimation.gauss_newton import Iterate
from tests.known import LINEAR, grid, linear_experiment, linear_regressors

TRUTH = np.array([900.0, 40.0, 25.0])
SD = 3.0
DESIGN = linear_regressors(0.05, 2.0, grid(40)) / SD
INFORMATION = DESIGN.T @ DESIGN
DATA_SD = np.sqrt(np.diag(np.linalg.inv(INFORMATION)))
CORRELATION = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 1.0]])


def posed(mean, width, joint=False, known=True, **settings):
    run = linear_experiment(TRUTH, SD, seed=1)
    names = ("k", "c", "coulomb")
    priors = {name: bp.Normal(m, w) for name, m, w in zip(names, mean, width, strict=True)}
    if joint:
        priors = {names: bp.MultivariateNormal(mean, np.outer(width, width) * CORRELATION)}
    fixed = {"variance[force]": SD**2} if known else {}
    return bp.Problem(LINEAR, [run], priors=priors, fixed=fixed, **settings)


def at(problem, theta, variance=SD**2):
    theta = np.asarray(theta, dtype=float)
    noise = np.full(len(problem.noise_names), variance)
    here = problem.anchored(theta).density().linearise(theta)
    return Iterate(theta, here, noise, 0.0)


def best(problem):
    return np.linalg.lstsq(DESIGN, problem.experiments[0].outputs["force"] / SD, rcond=None)[0]


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("relative", [(3.0, 0.02, 5.0), (0.5, 2.0, 0.05), (0.03, 0.04, 0.05), (30.0, 20.0, 9.0)])
@pytest.mark.parametrize("off", [(1.0, -2.0, 0.5), (-3.0, 0.1, 2.0)])
def test_directions_of_a_hundredth_of_the_prior_s_information_are_tested(joint, relative, off):
    """Eigenvectors of the information in units of the prior; the others keep the prior's mean and ten of its widths."""
    width = np.array(relative) * DATA_SD
    problem = posed(TRUTH + 1.0 * width * off, width, joint)
    mean = problem.joint_prior.median()
    estimate = at(problem, mean + 0.3 * width)
    with np.errstate(invalid="ignore"):
        seen = conflict._tested(problem, estimate)
    prior = np.outer(width, width) * (CORRELATION if joint else np.eye(3))
    values, axes = np.linalg.eigh(prior)
    root = axes * np.sqrt(values) @ axes.T
    information, vectors = np.linalg.eigh(root @ INFORMATION @ root)
    used = information > 0.01
    turned = root @ vectors
    z0 = np.linalg.solve(root, estimate.theta - mean)
    gain = vectors.T @ root @ INFORMATION @ (best(problem) - estimate.theta)
    z = z0 + vectors[:, used] @ (gain[used] / information[used])
    alone = root @ z
    sd = np.sqrt(turned[:, used] ** 2 @ (1 / information[used]) + 100.0 * np.sum(turned[:, ~used] ** 2, axis=1))
    p = 2 * stats.norm.sf(np.abs(alone) / np.hypot(width, sd))
    p = np.where(sd < 10 * width, p, np.nan)
    assert seen.table["p"].to_numpy() == pytest.approx(p, rel=0.03, nan_ok=True)
    parts = (vectors[:, used].T @ z) ** 2 / (1 + 1 / information[used])
    assert seen.joint == pytest.approx(stats.chi2.sf(parts.sum(), used.sum()), rel=0.04)
    ends = (mean + alone)[:, None] + np.outer(sd, stats.norm.ppf([0.05, 0.95]))
    assert seen.table[["data_low", "data_high"]].to_numpy() == pytest.approx(ends, rel=1e-6, abs=1e-6 * sd.max())
    expected = mean[:, None] + np.outer(width, stats.norm.ppf([0.05, 0.95]))
    assert seen.table[["prior_low", "prior_high"]].to_numpy() == pytest.approx(expected, rel=1e-9)
    smallest = min(1.0, 2 * seen.joint, *(2 * np.sum(~np.isnan(p)) * p[~np.isnan(p)]))
    assert seen.p == pytest.approx(smallest, rel=0.03)


def test_the_order_of_parameters_does_not_change_the_test():
    """The priors are given in another order."""
    width = np.array([0.5, 2.0, 1.0]) * DATA_SD
    mean = TRUTH + 2.0 * width
    one = posed(mean, width)
    table = conflict._tested(one, at(one, mean))
    names = ("coulomb", "k", "c")
    order = [2, 0, 1]
    priors = {name: bp.Normal(mean[i], width[i]) for name, i in zip(names, order, strict=True)}
    other = bp.Problem(LINEAR, one.experiments, priors=priors, fixed={"variance[force]": SD**2})
    turned = conflict._tested(other, at(other, mean[[*map(["k", "c", "coulomb"].index, other.names)]]))
    assert turned.joint == pytest.approx(table.joint, rel=1e-6)
    assert turned.table.loc[[*table.table.index]].to_numpy() == pytest.approx(table.table.to_numpy(), rel=1e-6)


def test_positive_parameters_are_tested_by_their_logarithms():
    """With a log-normal prior of c the interval of the data is symmetric in ln c; p is that of the sum of variances."""
    width = 0.2
    run = linear_experiment(TRUTH, SD, seed=1)
    priors = {"c": bp.LogNormal(60.0, width)}
    fixed = {"k": TRUTH[0], "coulomb": TRUTH[2], "variance[force]": SD**2}
    problem = bp.Problem(LINEAR, [run], priors=priors, fixed=fixed)
    design = DESIGN[:, 1]
    target = run.outputs["force"] / SD - DESIGN[:, [0, 2]] @ TRUTH[[0, 2]]
    value = design @ target / (design @ design)
    seen = conflict._tested(problem, at(problem, [value]))
    sd = 1.0 / (value * np.linalg.norm(design))
    row = seen.table.loc["c"]
    assert row["data_low"] == pytest.approx(value * np.exp(-1.644854 * sd), rel=1e-6)
    assert row["data_high"] == pytest.approx(value * np.exp(1.644854 * sd), rel=1e-6)
    expected = 2 * stats.norm.sf(abs(np.log(value / 60.0)) / np.hypot(width, sd))
    assert row["p"] == pytest.approx(expected, rel=0.03) and seen.joint == pytest.approx(expected, rel=0.03)
    assert row["prior_low"] == pytest.approx(60.0 * np.exp(-1.644854 * width))


def test_unknown_variances_give_student_s_t_by_the_mean_over_their_distribution():
    """The mean of p over v/χ², of the values less the parameters; the interval is that of Student's t."""
    run = linear_experiment(TRUTH, SD, seed=1)
    fixed = {"k": TRUTH[0], "coulomb": TRUTH[2]}
    design = DESIGN[:, 1] * SD
    target = run.outputs["force"] - SD * DESIGN[:, [0, 2]] @ TRUTH[[0, 2]]
    value = design @ target / (design @ design)
    for score in (1.0, 2.5, -2.0):
        sd = SD / np.linalg.norm(design)
        problem = bp.Problem(LINEAR, [run], priors={"c": bp.Normal(value - score * sd, 0.5 * sd)}, fixed=fixed)
        seen = conflict._tested(problem, at(problem, [value]))
        freedom = problem.counted - 1.0
        variances = freedom / stats.chi2.ppf((np.arange(4000) + 0.5) / 4000, freedom)
        expected = np.mean(2 * stats.norm.sf(abs(score) / np.sqrt(0.25 + variances)))
        assert seen.table.loc["c", "p"] == pytest.approx(expected, rel=0.03)
        assert seen.joint == pytest.approx(expected, rel=0.03)
        reach = stats.t.ppf(0.95, freedom) * sd
        assert seen.table.loc["c", ["data_low", "data_high"]].tolist() == pytest.approx([value - reach, value + reach])


def test_priors_are_widened_by_their_kind():
    """The same object where nothing is widened; a joint prior by the largest factor of its members."""
    names = ("a", "b", "c", "d", "e", "f")
    joint = bp.MultivariateNormal([1.0, 2.0], [[0.5, 0.1], [0.1, 0.3]])
    blocks = {
        "a": bp.Normal(1.0, 2.0), "b": bp.LogNormal(3.0, 0.4), "c": bp.Uniform(-1.0, 5.0), ("d", "e"): joint,
        "f": bp.HalfNormal(2.0),
    }  # fmt: skip
    wave = np.sin(2 * np.pi * grid(8))
    run = bp.Experiment("run", 1.0, {"y": wave}, {"x": wave}, samples=8)
    model = bp.Model(
        "many", states=["w"], inputs=["x"], parameters=[*names], equations=["dw + w - x"],
        outputs={"y": "a + b + c + d + e + f"},
    )  # fmt: skip
    problem = bp.Problem(model, [run], priors=blocks)
    prior, places = problem.joint_prior, {name: i for i, name in enumerate(problem.names)}
    same = conflict._widened(problem, np.ones(6))
    assert all(same[key] is block for key, block in prior.blocks.items())
    factor = np.ones(6)
    for name, value in {"a": 100.0, "b": 7.0, "c": 3.0, "e": 4.0, "d": 2.0, "f": 5.0}.items():
        factor[places[name]] = value
    wide = conflict._widened(problem, factor)
    assert wide["a"].quantile(np.array([0.5])) == pytest.approx([1.0])
    assert wide["a"].log_prob(1.0) - wide["a"].log_prob(201.0) == pytest.approx(0.5)
    ratio = wide["b"].log_prob(3.0) - wide["b"].log_prob(3.0 * np.exp(2.8)) - 2.8
    assert ratio == pytest.approx(0.5, rel=1e-6)
    assert wide["c"].support == (-1.0, 5.0) and wide["f"].support == (0.0, np.inf)
    for name in ("c", "f"):
        i = places[name]
        if problem.logarithmic[i]:
            centre, spread = np.log(prior.median()[i]), factor[i] * prior.log_widths[i]
            drop = wide[name].log_prob(np.exp(centre)) - wide[name].log_prob(np.exp(centre + spread)) - spread
        else:
            centre, spread = prior.median()[i], factor[i] * prior.widths[i]
            step = 0.2 * spread
            drop = 25.0 * (wide[name].log_prob(centre) - wide[name].log_prob(centre + step))
        assert drop == pytest.approx(0.5, rel=1e-5)
    key = next(one for one in wide if isinstance(one, tuple))
    assert wide[key].covariance == pytest.approx(16.0 * np.array(joint.covariance))
    assert np.array(wide[key].mean) == pytest.approx([1.0, 2.0])


@pytest.mark.parametrize("factor, moved", [(0.99, False), (1.01, True)])
def test_the_estimate_is_that_of_the_data_where_the_prior_moves_it_by_half_in_two_log_likelihoods(factor, moved):
    """One parameter: the gain (θ̂ − θ)² F²/(F + 1/(100 w²)) of the step is half."""
    run = linear_experiment(TRUTH, SD, seed=1)
    fixed = {"k": TRUTH[0], "coulomb": TRUTH[2], "variance[force]": SD**2}
    f = DESIGN[:, 1] @ DESIGN[:, 1]
    value = DESIGN[:, 1] @ (run.outputs["force"] / SD - DESIGN[:, [0, 2]] @ TRUTH[[0, 2]]) / f
    width = 0.7 / np.sqrt(f)
    off = np.sqrt(factor * 0.5 * (f + 1 / (100 * width**2))) / f
    problem = bp.Problem(LINEAR, [run], priors={"c": bp.Normal(value + 2 * off, width)}, fixed=fixed)
    estimate = at(problem, [value + off])
    seen = conflict._by_the_data(problem, estimate)
    assert (seen is not estimate) == moved
    if moved:
        precision = 1.0 / (100.0 * width) ** 2
        assert seen.theta == pytest.approx([(f * value + precision * (value + 2 * off)) / (f + precision)], rel=1e-9)


@pytest.mark.parametrize("known", [True, False])
def test_priors_are_widened_a_hundredfold_where_the_data_have_information(known):
    """Parameters with less than a hundredth keep their prior; the estimate is that of regression."""
    width = np.array([0.3, 0.05, 2.0]) * DATA_SD
    mean = TRUTH + np.array([40.0, 0.0, 3.0]) * width
    problem = posed(mean, width, known=known)
    start = np.linalg.solve(INFORMATION + np.diag(width**-2.0), INFORMATION @ best(problem) + mean / width**2)
    seen = conflict._by_the_data(problem, at(problem, start))
    information = np.diag(INFORMATION) * width**2
    step = np.linalg.solve(
        np.outer(width, width) * INFORMATION + 0.01 * np.eye(3), width * (INFORMATION @ (best(problem) - start))
    )
    if known:
        wide = width * np.where(information > 0.01, np.maximum(100.0, 10.0 * np.abs(step)), 1.0)
        expected = np.linalg.solve(INFORMATION + np.diag(wide**-2.0), INFORMATION @ best(problem) + mean / wide**2)
        assert seen.theta == pytest.approx(expected, rel=1e-6)
    assert np.all(np.abs(seen.theta - best(problem)) < 0.05 * DATA_SD)


def test_other_starts_are_drawn_for_parameters_in_conflict_only(monkeypatch):
    """From 3 to 100 widths, six of them, beside the estimate that was found; the others from their prior."""
    width = np.array([0.3, 0.5, 2.0]) * DATA_SD
    problem = posed(TRUTH, width)
    alone, started = at(problem, TRUTH), []

    def climb(objective, first):
        started.append(first)
        return SimpleNamespace(iterate=first)

    monkeypatch.setattr(conflict, "climb", climb)
    seen = [*conflict._from_elsewhere(problem, alone, ("k",))]
    assert len(seen) == 7 and seen[0].theta is alone.theta and len(started) == 6
    off = np.array([(one.theta - TRUTH) / width for one in started])
    assert np.abs(off[:, 1:]).max() < 4.5
    scaled = off[:, 0] / np.array([3.0, 10.0, 30.0, 100.0, 30.0, 10.0])
    assert np.abs(scaled).max() < 4.5 and np.abs(off[:, 0]).max() > 6.0
    # The objective is that of the widened prior at the estimate that was found.
    flat = np.where(np.array(problem.names) == "k", 100.0, 1.0) * width
    lower = seen[1]
    residual = problem.experiments[0].outputs["force"] / SD
    one, other = (
        -0.5 * np.sum((residual - DESIGN @ theta) ** 2) - 0.5 * np.sum(((theta - TRUTH) / flat) ** 2)
        for theta in (TRUTH, lower.theta)
    )
    assert seen[0].objective - lower.objective == pytest.approx(one - other, rel=1e-6)
