"""Checks of an estimate: made by `map_estimate` or afterwards, and what an estimate without them says."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation import check as checks_of
from bayesperiodic.estimation import map_estimate as estimates
from bayesperiodic.estimation.gauss_newton import Iterate
from bayesperiodic.estimation.result import FitCheck
from tests.known import LINEAR, grid, linear_experiment, linear_regressors
from tests.problems import DUFFING_PRIORS, duffing_run

LINES = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}


def problems() -> dict[str, bp.Problem]:
    """Return a linear problem, one in conflict with its prior, and an oscillator with noisy inputs of folded cycles."""
    run = linear_experiment(np.array([900.0, 40.0, 25.0]), 3.0, seed=1)
    recording = bp.simulate(
        bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5},
        {"force": lambda t: np.cos(2 * np.pi * 0.1 * t)}, frequency=0.1, duration=300, sampling_rate=4,
        noise={"displacement": 0.01, "force": 0.02}, seed=1,
    )  # fmt: skip
    return {
        "linear": bp.Problem(LINEAR, [run], priors=LINES),
        "conflict": bp.Problem(LINEAR, [run], priors=LINES | {"k": bp.Normal(100.0, 10.0)}),
        "noisy inputs": bp.Problem(
            bp.models.duffing, [recording.fold(32)], priors=DUFFING_PRIORS, fixed={"m": 1.0}, scheme="fourier"
        ),
    }


def values(result) -> dict[str, float]:
    """Return all numbers of a result by name."""
    found = {}
    for field in fields(result):
        value = getattr(result, field.name)
        items = value.items() if isinstance(value, dict) else [("", value)]
        for name, item in items:
            path = f"{field.name} {name}"
            if isinstance(item, pd.DataFrame):
                found |= {f"{path} {i}": number for i, number in enumerate(item.to_numpy(dtype=float).ravel())}
            elif hasattr(item, "__dataclass_fields__"):
                found |= {f"{path} {key}": number for key, number in values(item).items()}
            elif isinstance(item, float):
                found[path] = item
    return found


def test_an_estimate_has_at_most_fifteen_fields_of_plain_data():
    assert len(fields(bp.MapEstimate)) <= 15
    assert "__getattribute__" not in vars(bp.MapEstimate)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["linear", "conflict", "noisy inputs"])
def test_checks_made_afterwards_equal_those_of_the_estimate(name):
    problem = problems()[name]
    whole, quick = (bp.map_estimate(problem, checks=made, progress=False) for made in (True, False))
    assert quick.checks is None and quick.theta == whole.theta and quick.covariance.equals(whole.covariance)
    assert quick.joint is None
    joint = checks_of.with_joint(problem, quick)
    assert joint.joint_mode == pytest.approx(whole.joint_mode, rel=1e-4)
    assert joint.joint_covariance.to_numpy() == pytest.approx(whole.joint_covariance.to_numpy(), rel=1e-4, abs=1e-12)
    checks = bp.check(problem, quick)
    assert values(checks) == pytest.approx(values(whole.checks), rel=1e-4, abs=1e-8, nan_ok=True)
    assert checks.undetermined == whole.checks.undetermined
    assert checks.prior_conflict.members == whole.prior_conflict.members == (("k",) if name == "conflict" else ())
    assert replace(quick, checks=checks).robust_sd == checks.robust_sd


def test_without_checks_none_is_computed_and_no_warning_of_theirs_is_given(monkeypatch, recwarn):
    problem = problems()["conflict"]
    for name in ("prior_conflict", "robust_covariance", "doubling_shift", "input_nonlinearity", "undetermined"):
        monkeypatch.setattr(checks_of, name, None)
    monkeypatch.setattr(estimates, "joint_laplace", None)
    quick = bp.map_estimate(problem, checks=False, progress=False)
    assert not recwarn.list and "Not checked" in str(quick) and "robust" not in str(quick)
    monkeypatch.undo()
    with pytest.warns(UserWarning, match="Prior and data disagree"):
        bp.check(problem, quick)


@pytest.mark.parametrize(
    ("name", "group"),
    [*((field.name, "checks") for field in fields(FitCheck)), ("mode", "joint"), ("covariance", "joint")],
)
def test_reading_what_was_not_computed_names_the_function(name, group):
    quick = bp.map_estimate(problems()["linear"], checks=False, progress=False)
    with pytest.raises(ValueError, match=rf"{group}: must be computed before '{name}' is used.* map_estimate\("):
        getattr(quick, f"joint_{name}" if group == "joint" else name)


def test_an_estimate_of_another_problem_is_not_checked():
    fit = bp.map_estimate(problems()["linear"], progress=False)
    other = bp.Problem(bp.models.duffing, [duffing_run()], priors=DUFFING_PRIORS, fixed={"m": 1.0})
    with pytest.raises(ValueError, match="fit: must be a result of this problem"):
        bp.check(other, fit)
    with pytest.raises(ValueError, match="checks: must be "):
        bp.map_estimate(problems()["linear"], checks=1, progress=False)


@pytest.mark.parametrize("made", [True, False])
def test_an_estimate_is_read_back_with_and_without_checks(tmp_path, made):
    fit = bp.map_estimate(problems()["linear"], checks=made, progress=False)
    fit.save(tmp_path / "fit.h5")
    again = bp.load(tmp_path / "fit.h5")
    assert again.theta == fit.theta and (again.checks is None) != made and str(again) == str(fit)


def test_change_of_the_residuals_is_in_units_of_the_noise():
    """Of a model that is linear in its parameters |X Δθ|/σ; infinite where a solve fails."""
    run = linear_experiment(np.array([900.0, 40.0, 25.0]), 3.0, seed=1)
    problem = bp.Problem(LINEAR, [run], priors=LINES, fixed={"variance[force]": 9.0})
    theta, step = np.array([850.0, 30.0, 20.0]), np.array([-20.0, 3.0, 1.0])
    here = problem.anchored(theta).density().linearise(theta)
    design = linear_regressors(0.05, 2.0, grid(40))
    change = checks_of._data_change(problem, Iterate(theta, here, np.array([9.0]), 0.0), theta + step)
    assert change == pytest.approx(np.linalg.norm(design @ step) / 3.0, rel=1e-6)
    failed = SimpleNamespace(here=SimpleNamespace(moved=lambda _: SimpleNamespace(converged=False)))
    assert checks_of._data_change(problem, failed, theta) == np.inf
