"""Fixed parameters that differ between experiments."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import LINEAR, grid, linear_experiment, linear_regressors, normal_posterior

COULOMB = {"light": 10.0, "heavy": 40.0}
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(40.0, 20.0)}


def experiments() -> list[bp.Experiment]:
    return [
        linear_experiment([900.0, 45.0, coulomb], 3.0, seed=seed, name=name)
        for seed, (name, coulomb) in enumerate(COULOMB.items())
    ]


def problem(coulomb, **changes) -> bp.Problem:
    fixed = {"variance[force]": 9.0, "coulomb": coulomb}
    return bp.Problem(LINEAR, experiments(), **({"priors": PRIORS, "fixed": fixed} | changes))


def test_each_experiment_has_its_own_constant():
    """The closed-form posterior of k and c after subtracting each run's own friction."""
    fit = bp.map_estimate(problem(COULOMB), progress=False)
    x = linear_regressors(0.05, 2.0, grid(40))
    values = np.concatenate([e.outputs["force"] - COULOMB[e.name] * x[:, 2] for e in experiments()])
    prior = np.diag([60.0, 20.0]) ** 2
    mean, covariance = normal_posterior(np.tile(x[:, :2], (2, 1)), values, 9.0, [800.0, 40.0], prior)
    assert list(fit.theta.values()) == pytest.approx(mean, rel=1e-9)
    assert fit.covariance.to_numpy() == pytest.approx(covariance, rel=1e-8)
    assert {name: s.parameters["coulomb"] for name, s in fit.solutions.items()} == COULOMB
    with pytest.raises(ValueError, match="got 'coulomb'"):
        fit.derive({"share": "coulomb/k"})


def test_density_agrees_with_one_problem_an_experiment():
    theta = {"k": np.array([850.0, 910.0]), "c": np.array([30.0, 52.0])}
    together = problem(COULOMB).log_likelihood(theta, {})
    apart = [
        bp.Problem(LINEAR, [e], priors=PRIORS, fixed={"variance[force]": 9.0, "coulomb": COULOMB[e.name]})
        for e in experiments()
    ]
    assert together == pytest.approx(sum(p.log_likelihood(theta, {}) for p in apart), rel=1e-12)


def test_tie_may_use_a_constant_that_differs_between_experiments():
    """Damping = coulomb · k/900 with k as the only free parameter; the slope differs between experiments."""
    tied = problem(COULOMB, tied={"c": "coulomb*k/900"}, priors={"k": PRIORS["k"]})
    assert tied.parameters(np.array([[450.0]]), "heavy")[0] == pytest.approx([450.0, 20.0, 40.0])
    fit = bp.map_estimate(tied, progress=False)
    x = linear_regressors(0.05, 2.0, grid(40))
    design = np.concatenate([x[:, 0] + x[:, 1] * coulomb / 900 for coulomb in COULOMB.values()])[:, None]
    values = np.concatenate([e.outputs["force"] - COULOMB[e.name] * x[:, 2] for e in experiments()])
    (mean,), ((variance,),) = normal_posterior(design, values, 9.0, [800.0], np.array([[60.0**2]]))
    assert fit.theta["k"] == pytest.approx(mean, rel=1e-9)
    assert fit.sd["k"] == pytest.approx(np.sqrt(variance), rel=1e-8)
    assert np.isnan(fit.tied["c"]["k"])


def test_one_constant_for_all_experiments_equals_equal_constants():
    both = {"k": 900.0, "c": 45.0}
    one, each = problem(25.0), problem(dict.fromkeys(COULOMB, 25.0))
    assert one.log_likelihood(both, {}) == each.log_likelihood(both, {})


@pytest.mark.parametrize(
    ("coulomb", "message"),
    [
        ({"light": 1.0}, r"fixed\['coulomb'\]: must have .*got no 'heavy'"),
        ({"light": 1.0, "heavi": 2.0}, r"fixed\['coulomb'\]: must be .*got 'heavi'.*Did you mean 'heavy'"),
        ({"light": 1.0, "heavy": np.nan}, r"fixed\['coulomb'\]\['heavy'\]: must be .*got nan"),
        ("25 N", r"fixed\['coulomb'\]: must be a real number, got '25 N'"),
    ],
)
def test_error_names_the_bad_constant(coulomb, message):
    with pytest.raises(ValueError, match=message):
        problem(coulomb)


def test_problem_restricted_to_some_experiments_is_the_same_problem():
    """Settings of removed experiments are dropped; constants for all experiments hold for new data too."""
    runs = [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=i, name=f"run {i}") for i in (1, 2)]
    k, c, other = bp.Normal(800.0, 60.0), bp.LogNormal(30.0, 0.5), bp.LogNormal(50.0, 0.5)
    whole = bp.Problem(
        LINEAR, runs, priors={"k": k, "c": c, "c[run 2]": other}, fixed={"coulomb": {"run 1": 20.0, "run 2": 25.0}},
        local=["c"],
    )  # fmt: skip
    alone = whole.with_experiments(runs[:1])
    stated = bp.Problem(LINEAR, runs[:1], priors={"k": k, "c": c}, fixed={"coulomb": 20.0}, local=["c"])
    at = {"k": 850.0, "c[run 1]": 35.0}, {"force": 9.0}
    assert alone.names == stated.names == ("k", "c[run 1]")
    assert alone.log_posterior(*at) == stated.log_posterior(*at)
    renamed = stated.with_experiments([replace(runs[0], name="run 3")])
    assert renamed.names == ("k", "c[run 3]")
    assert renamed.log_posterior({"k": 850.0, "c[run 3]": 35.0}, at[1]) == stated.log_posterior(*at)
    with pytest.raises(ValueError, match="'run 3'"):
        whole.with_experiments([replace(runs[0], name="run 3")])
