from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp


def with_draws(posterior, name, change):
    data = posterior.data.copy(deep=True)
    group = data["posterior"].to_dataset()
    group[name] = change(group[name])
    data["posterior"] = type(data)(group)
    return replace(posterior, data=data)


def test_a_normal_posterior_is_fine(solved):
    problem, fit, posterior = solved
    table = bp.compare(problem, fit, posterior).table
    assert list(table["verdict"]) == ["fine"] * 3
    assert table.loc["k", "sd_ratio"] == pytest.approx(1.0, abs=0.1)
    assert table.loc["k", "laplace_q95"] - table.loc["k", "laplace_q05"] == pytest.approx(
        2 * 1.6448536269514722 * fit.sd["k"]
    )


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda x: x.mean() + 2.0 * (x - x.mean()), "too narrow"),
        (lambda x: x.mean() + 0.5 * (x - x.mean()), "too wide"),
        (lambda x: x + 2.0 * x.std(), "wrong shape"),
        (lambda x: x.mean() + x.std() * (np.exp((x - x.mean()) / x.std()) - np.exp(0.5)) / 2.16, "wrong shape"),
    ],
)
def test_departures_are_named(solved, change, verdict):
    problem, fit, posterior = solved
    assert bp.compare(problem, fit, with_draws(posterior, "k", change)).table.loc["k", "verdict"] == verdict


def test_draws_that_have_not_converged_are_no_verdict(solved):
    problem, fit, posterior = solved
    table = bp.compare(problem, fit, replace(posterior, converged=False)).table
    assert set(table["verdict"]) == {"not converged"}
