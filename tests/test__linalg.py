import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits

import bayesperiodic as bp
from bayesperiodic._linalg import in_one_thread
from tests.known import LINEAR


def threads():
    return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]


@pytest.fixture
def two_threads():
    scipy.linalg.norm(np.eye(2))
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        assert set(before) == {2}
        yield
        assert threads() == before


def test_linear_algebra_has_one_thread_inside_and_as_many_as_before_outside(two_threads):
    assert set(in_one_thread(threads)()) == {1}
    with pytest.raises(ZeroDivisionError):
        in_one_thread(lambda: 1 / 0)()


def test_estimates_and_draws_are_computed_with_one_thread(two_threads):
    found = set()

    class Watching(bp.Normal):
        def log_prob(self, x):
            found.update(threads())
            return super().log_prob(x)

    tau = 2 * np.pi * np.arange(32) / 32
    force = 2.0 * np.sin(tau) + 0.01 * np.cos(5 * tau)
    e = bp.Experiment("run", 1.0, {"force": force}, inputs={"x": np.sin(tau)}, samples=32)
    priors = {"k": Watching(1.0, 1.0), "c": bp.Normal(0.0, 1.0), "coulomb": bp.Normal(0.0, 1.0)}
    problem = bp.Problem(LINEAR, [e], priors=priors)
    fit = bp.map_estimate(problem, progress=False)
    assert found == {1}
    found.clear()
    bp.sample(problem, fit, seed=1, walkers=8, ensembles=2, max_steps=250, progress=False)
    assert found == {1}
