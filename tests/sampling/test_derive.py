import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling import convergence
from tests.known import LINEAR, linear_experiment

TRUTH = np.array([900.0, 40.0, 25.0])


@pytest.fixture(scope="module")
def fixed_c():
    """Return a fit with c fixed, k and coulomb free."""
    priors = {"k": bp.Normal(800.0, 60.0), "coulomb": bp.Normal(20.0, 10.0)}
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=priors, fixed={"c": 40.0})
    return bp.map_estimate(problem, progress=False)


def test_linear_combination_has_its_exact_sd(solved):
    fit = solved[1]
    weights = np.array([2.0, -0.5, 3.0])
    table = fit.derive({"force_limit": "2*k - c/2 + 3*coulomb + 7"})
    assert list(table.columns) == ["value", "sd"] and list(table.index) == ["force_limit"]
    assert table.loc["force_limit", "value"] == pytest.approx(weights @ list(fit.theta.values()) + 7, rel=1e-13)
    variance = weights @ fit.covariance.to_numpy() @ weights
    assert table.loc["force_limit", "sd"] == pytest.approx(np.sqrt(variance), rel=1e-13)


def test_ratio_and_product_follow_the_delta_method_and_their_covariance_is_there(solved):
    """Relative variance of c·F: sC + sF + 2 sCF, of c/F: sC + sF − 2 sCF; their relative covariance: sC − sF."""
    fit = solved[1]
    c, f = fit.theta["c"], fit.theta["coulomb"]
    covariance = fit.covariance.to_numpy()[1:, 1:] / np.outer([c, f], [c, f])
    assert abs(covariance[0, 1]) > 0.3 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    table = fit.derive({"product": "c*coulomb", "ratio": "c/coulomb", "k_again": "k"})
    total = covariance[0, 0] + covariance[1, 1]
    assert table["value"].tolist() == pytest.approx([c * f, c / f, fit.theta["k"]])
    assert table.loc["product", "sd"] == pytest.approx(c * f * np.sqrt(total + 2 * covariance[0, 1]), rel=1e-11)
    assert table.loc["ratio", "sd"] == pytest.approx(c / f * np.sqrt(total - 2 * covariance[0, 1]), rel=1e-11)
    assert table.loc["k_again", "sd"] == pytest.approx(fit.sd["k"], rel=1e-13)
    joint = table.attrs["covariance"]
    assert joint["product"]["ratio"] == pytest.approx(c**2 * (covariance[0, 0] - covariance[1, 1]), rel=1e-10)
    assert joint["ratio"]["product"] == pytest.approx(joint["product"]["ratio"], rel=1e-12)
    assert joint["ratio"]["ratio"] == pytest.approx(table.loc["ratio", "sd"] ** 2)
    assert all(type(x) is float for row in joint.values() for x in row.values())


def test_fixed_parameters_enter_with_their_values_and_no_uncertainty(fixed_c):
    table = fixed_c.derive({"rate": "k/c", "c_twice": "2*c", "four": "4"})
    assert table.loc["rate"].tolist() == pytest.approx([fixed_c.theta["k"] / 40.0, fixed_c.sd["k"] / 40.0])
    assert table.loc["c_twice"].tolist() == [80.0, 0.0]
    assert table.loc["four"].tolist() == [4.0, 0.0]


def test_an_infinite_covariance_gives_no_finite_sd(fixed_c):
    from dataclasses import replace

    singular = replace(fixed_c, covariance=fixed_c.covariance * np.inf)
    table = singular.derive({"a": "2*k", "b": "c*3"})
    assert table["sd"].tolist() == [np.inf, 0.0]


def test_error_names_the_bad_expression_for_an_estimate(fixed_c):
    with pytest.raises(ValueError, match=r"expressions\['a'\]: names in 'kk/c': must be .*got 'kk'.*Did you mean 'k'"):
        fixed_c.derive({"a": "kk/c"})
    for name in ("k", "c"):
        with pytest.raises(
            ValueError, match=f"expressions: must be neither reserved nor used elsewhere .*got '{name}'"
        ):
            fixed_c.derive({name: "2*coulomb"})
    with pytest.raises(
        ValueError, match=r"expressions\['a'\]: must be finite at the estimate, got nan for 'log\(-k\)'"
    ):
        fixed_c.derive({"a": "log(-k)"})
    with pytest.raises(ValueError, match="which contains an attribute"):
        fixed_c.derive({"a": "k.__class__"})
    with pytest.raises(ValueError, match="expressions: must be a mapping, .*got 'k'"):
        fixed_c.derive("k")


def test_no_expressions_give_an_empty_table(solved):
    assert solved[1].derive({}).empty and solved[2].derive({}).empty


def test_derived_posterior_statistics_equal_those_of_numpy(solved):
    posterior = solved[2]
    k, c, coulomb = (posterior.draws(name) for name in ("k", "c", "coulomb"))
    table = posterior.derive({"ratio": "c/(2*sqrt(k*1.5))", "product": "c*coulomb", "half": "1/2"})
    for name, draws in {"ratio": c / (2 * np.sqrt(k * 1.5)), "product": c * coulomb}.items():
        row = table.loc[name]
        assert row[["mean", "sd"]].tolist() == pytest.approx([draws.mean(), draws.std(ddof=1)], rel=1e-12)
        assert row[["q05", "q50", "q95"]].tolist() == pytest.approx(np.quantile(draws, [0.05, 0.5, 0.95]), rel=1e-12)
        assert row["mcse_mean"] == pytest.approx(row["sd"] / np.sqrt(row["ess"]), rel=0.1)
    assert table.loc["half", ["mean", "sd", "q95"]].tolist() == [0.5, 0.0, 0.5] and np.isnan(table.loc["half", "ess"])
    assert table.attrs["interval"] == posterior.summary().attrs["interval"]
    assert set(table.columns) < set(posterior.summary().columns)


def test_ess_of_a_derived_quantity_is_its_own(solved):
    """It counts ranks, which increasing functions keep; the stop rule's count along walkers is about the same."""
    posterior = solved[2]
    table = posterior.derive({"k_scaled": "3 - 2*k", "log_c": "log(c)"})
    assert table.loc["k_scaled", "ess"] == pytest.approx(posterior.ess["k"], rel=1e-9)
    assert table.loc["log_c", "ess"] == pytest.approx(posterior.ess["c"], rel=1e-9)
    draws = posterior.draws("c")
    tau = convergence.autocorrelation_time(posterior.by_step(draws)[..., None])[0]
    assert posterior.derive({"a": "c*1"}).loc["a", "ess"] == pytest.approx(draws.size / tau, rel=0.25)


def test_posterior_and_estimate_agree_where_both_are_normal(solved):
    _, fit, posterior = solved
    expressions = {"sum": "k + c", "ratio": "coulomb/c"}
    linear, drawn = fit.derive(expressions), posterior.derive(expressions)
    assert (drawn["mean"] - linear["value"]).abs().max() < 0.2 * linear["sd"].max()
    assert drawn.loc["sum", "sd"] == pytest.approx(linear.loc["sum", "sd"], rel=0.1)


def test_error_names_the_bad_expression_for_a_posterior(solved):
    posterior = solved[2]
    with pytest.raises(ValueError, match="must be one of 'k', 'c', 'coulomb', 'pi', got 'm'.*Only sampled parameters"):
        posterior.derive({"a": "k/m"})
    with pytest.raises(ValueError, match="which contains a subscript"):
        posterior.derive({"a": "variance[force]"})
    for name in ("k", "variance"):
        with pytest.raises(
            ValueError, match=f"expressions: must be neither reserved nor used elsewhere .*got '{name}'"
        ):
            posterior.derive({name: "2*c"})
    median = np.median(posterior.draws("k"))
    with pytest.raises(
        ValueError, match=r"must be finite at all draws, got NaN or infinity at \d+ of \d+ for 'log\(k - "
    ):
        posterior.derive({"a": f"log(k - {median})"})


def test_results_read_from_a_file_derive_the_same_table(solved, tmp_path):
    _, fit, posterior = solved
    for result in (fit, posterior):
        before = result.derive({"ratio": "c/k"})
        result.save(tmp_path / "result.h5")
        after = bp.load(tmp_path / "result.h5").derive({"ratio": "c/k"})
        assert after.equals(before) and after.attrs == before.attrs
