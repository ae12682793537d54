"""Starts of the estimates of condensed models: while tests reject the model, from draws of the priors."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation import climbs

COUNT, SAMPLES, FREQUENCY, NOISE = 130, 64, 0.03, 0.01
TRUTH = {"alpha": 0.05, "stop_k": 0.5, "stop_clearance": 0.5}


@pytest.fixture(scope="module")
def problem() -> bp.Problem:
    """Return a chain with a stop at its end that the motion of 1.4 m would not touch at the medians of the priors."""
    springs = 2.0 * np.eye(COUNT) - np.eye(COUNT, k=1) - np.eye(COUNT, k=-1) + 0.05 * np.eye(COUNT)
    model = bp.Model.from_matrices(
        "chain", mass=np.eye(COUNT), stiffness=springs, damping={"alpha": np.eye(COUNT)},
        forces={"force": COUNT - 1}, outputs={"end": (COUNT - 1, "displacement")},
        elements=[bp.elements.Element("stop", bp.elements.gap, COUNT - 1, {"width": 0.01})], condensed=True,
    )  # fmt: skip
    force = 1.5 * np.cos(2.0 * np.pi * np.arange(SAMPLES) / SAMPLES)
    solved = bp.solve_periodic(model, TRUTH, {"force": force}, frequency=FREQUENCY, samples=SAMPLES)
    end = solved.outputs["end"]
    assert end.max() > 1.5 * TRUTH["stop_clearance"] and -end.min() < 1.5
    noisy = end + NOISE * np.random.default_rng(1).standard_normal(SAMPLES)
    experiment = bp.Experiment("run", FREQUENCY, {"end": noisy}, {"force": force}, samples=SAMPLES)
    priors = {
        "alpha": bp.LogNormal(0.05, 0.5),
        "stop_k": bp.LogNormal(0.5, 0.5),
        "stop_clearance": bp.Uniform(0.2, 4.0),
    }
    return bp.Problem(model, [experiment], priors=priors)


def test_draws_are_starts_while_the_model_is_rejected(problem):
    """Without contact the stop has no gradient; draws with smaller clearances lead to the truth (fixed seed).

    Each parameter is within three standard deviations: 1 % of false alarms.
    """
    with pytest.warns(UserWarning, match="do not depend on 'stop_k', 'stop_clearance'|only to second order"):
        once = bp.map_estimate(problem, starts=1, progress=False)
    assert once.misspecified and "one start was tried" in repr(once) and once.theta["stop_clearance"] > 1.4
    fit = bp.map_estimate(problem, progress=False)
    assert 1 < len(fit.starts) < 8 and not fit.misspecified and "one start" not in repr(fit)
    assert fit.starts[0]["objective"] < fit.starts[-1]["objective"] - 30.0
    assert all(abs(fit.theta[name] - value) < 3.0 * fit.sd[name] for name, value in TRUTH.items())


def test_a_model_that_is_not_rejected_has_one_start(problem):
    near = problem.replace(priors=dict(problem.priors) | {"stop_clearance": bp.Uniform(0.1, 1.0)})
    assert len(bp.map_estimate(near, progress=False).starts) == 1


def test_climbs_on_fewer_points_end_at_the_same_optimum(monkeypatch):
    """With a joint that sticks and slides, the optimum is that of climbs whose solves are precise from the start."""
    springs, wave = 2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1), np.cos(2.0 * np.pi * np.arange(64) / 64)
    model = bp.Model.from_matrices(
        "chain", mass=np.eye(3), stiffness=springs, damping={"alpha": np.eye(3)}, forces={"force": 0},
        outputs={"end": (2, "displacement")}, condensed=True,
        elements=[bp.elements.Element("joint", bp.elements.jenkins, 2, {"width": 0.1})],
    )  # fmt: skip
    truth, how = {"alpha": 0.1, "joint_stiffness": 0.5, "joint_limit": 0.05}, {"frequency": 0.11, "samples": 64}
    end = bp.solve_periodic(model, truth, {"force": 0.2 * wave}, **how).outputs["end"]
    noisy = end + 0.01 * end.std() * np.random.default_rng(2).standard_normal(64)
    run = bp.Experiment("run", 0.11, {"end": noisy}, {"force": 0.2 * wave}, samples=64)
    problem = bp.Problem(model, [run], priors={n: bp.LogNormal(1.2 * value, 0.5) for n, value in truth.items()})
    fit = bp.map_estimate(problem, starts=1, checks=False, progress=False)
    monkeypatch.setattr(climbs, "COARSENESS", 1.0)
    precise = bp.map_estimate(problem, starts=1, checks=False, progress=False)
    assert fit.status == precise.status == "converged"
    for name, value in truth.items():
        assert abs(fit.theta[name] - precise.theta[name]) < 0.02 * precise.sd[name]
        assert abs(fit.theta[name] - value) < 4.0 * fit.sd[name]
