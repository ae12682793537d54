"""Memory that sampling takes beside its draws: each step works on one part of them after the other."""

import tracemalloc

import emcee
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.chains import StoredChains
from bayesperiodic.sampling.checkpoint import ColumnBackend
from bayesperiodic.sampling.convergence import stop_rule
from bayesperiodic.sampling.draws import gather
from bayesperiodic.sampling.proposals import AffineTransform, CallCount, StudentMixture, expected_time

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


def steps():
    """Return a backend with the draws, walker by walker, stored in pieces."""
    backend = ColumnBackend()
    backend.reset(200, len(NAMES))
    for k in range(0, 400, 100):
        backend.grow(100, None)
        for step in range(k, k + 100):
            coords = DRAWS[:, step].reshape(200, -1)
            state = emcee.State(coords, log_prob=coords[:, 0], random_state=None)
            backend.save_step(state, np.ones(200, dtype=bool))
    return backend


def of_growth(density):
    backend = steps()
    backend.forget(40)
    return backend


def of_posterior(density):
    backend, identity = steps(), AffineTransform(np.zeros(20), np.eye(20))
    chains = StoredChains(backend.columns_since(0), 2, identity)
    backend.reset(200, len(NAMES))
    chains.unwhiten()
    return gather(density, chains, DRAWS[..., 0], CallCount(), converged=True, reason="", acceptance=1.0, seed=1)


def of_stop_rule(density):
    return stop_rule(DRAWS, None, np.empty(0), NAMES)


def of_mixture(density):
    one = np.ones(1)
    mixture = StudentMixture(one, np.zeros((1, len(NAMES))), np.eye(len(NAMES))[None], 5.0 * one)
    return expected_time(mixture, DRAWS.reshape(-1, len(NAMES)), DRAWS[..., 0].ravel(), 0.8)


@pytest.mark.parametrize(
    ("work", "most"), [(of_growth, 1.2), (of_posterior, 1.7), (of_stop_rule, 0.5), (of_mixture, 0.9)]
)
def test_memory_beside_the_draws(density, work, most):
    """Peak relative to the draws; of a chain that grows and of the posterior, 1 are those that they keep."""
    work(density)
    tracemalloc.start()
    try:
        kept = work(density)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert kept is not None and peak < most * DRAWS.nbytes, peak / DRAWS.nbytes
