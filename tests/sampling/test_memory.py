"""Memory that sampling takes beside its draws: each step works on one part of them after the other."""

import tracemalloc

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.convergence import stop_rule
from bayesperiodic.sampling.draws import gather
from bayesperiodic.sampling.proposals import CallCount, StudentMixture, expected_time

NAMES = [f"k{i}" for i in range(20)]
DRAWS = np.random.default_rng(0).standard_normal((2, 400, 100, len(NAMES)))


@pytest.fixture(scope="module")
def density():
    """Return the log-posterior of the amplitudes of twenty terms."""
    terms = " + ".join(f"{name}*cos({i}*u)" for i, name in enumerate(NAMES))
    model = bp.Model(
        "terms", states=["w"], inputs=["u"], parameters=NAMES, equations=["dw + w - u"], outputs={"y": terms}
    )
    u = np.pi * np.cos(2 * np.pi * np.arange(64) / 64)
    run = bp.Experiment("run", 0.3, {"y": sum(np.cos(i * u) for i in range(20))}, {"u": u}, samples=64)
    priors = dict.fromkeys(NAMES, bp.Normal(0.0, 1.0))
    problem = bp.Problem(model, [run], priors=priors, fixed={"variance[y]": 0.01})
    return problem.anchored(np.zeros(len(NAMES)), {"run": {"w": np.zeros(64)}}).density()


def of_posterior(density):
    converged = {"converged": True, "reason": "", "acceptance": 1.0, "seed": 1}
    return gather(density, DRAWS, DRAWS[..., 0], CallCount(), **converged)


def of_stop_rule(density):
    return stop_rule(DRAWS, None, np.empty(0), NAMES)


def of_mixture(density):
    one = np.ones(1)
    mixture = StudentMixture(one, np.zeros((1, len(NAMES))), np.eye(len(NAMES))[None], 5.0 * one)
    return expected_time(mixture, DRAWS.reshape(-1, len(NAMES)), DRAWS[..., 0].ravel(), 0.8)


@pytest.mark.parametrize(("work", "most"), [(of_posterior, 2.0), (of_stop_rule, 0.5), (of_mixture, 0.9)])
def test_memory_beside_the_draws(density, work, most):
    """Peak relative to the draws; of the posterior, 1 are those that it keeps."""
    work(density)
    tracemalloc.start()
    try:
        kept = work(density)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert kept is not None and peak < most * DRAWS.nbytes, peak / DRAWS.nbytes
