"""The iteration on its own: where it ends, and residuals that it refuses."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.estimation.gauss_newton import Iterate, Objective, climb
from tests.known import LINEAR, linear_experiment


@dataclass
class Inexact:
    """The objective −θ²/2, whose value is lower by `error` wherever it is solved again, as by rounding errors."""

    error: float
    density = SimpleNamespace(
        problem=SimpleNamespace(
            joint_prior=SimpleNamespace(
                supports={"k": (-np.inf, np.inf)}, widths=np.array([1e3]), median=lambda: np.zeros(1)
            )
        )
    )

    def at(self, theta, near, noise):
        """Return the iterate at θ."""
        return Iterate(theta, near, noise, -0.5 * float(theta @ theta) - self.error)

    def moved(self, theta, step):
        """Return θ after a step."""
        return theta + step

    def longest(self, theta, step):
        """Return the whole step."""
        return 1.0

    def anchored(self, iterate):
        """Return the iterate itself."""
        return iterate

    def hessian_and_gradient(self, iterate):
        """Return those of the exact objective."""
        return np.eye(1), -iterate.theta


@pytest.mark.parametrize(
    ("error", "distance", "status"),
    [(1e-7, 3e-4, "converged"), (1e-7, 0.5, "converged"), (1.0, 0.5, "stalled"), (1e-3, 3e-3, "stalled")],
)
def test_a_gain_below_the_errors_of_the_objective_ends_the_iteration(error, distance, status):
    """A standard deviation is 1, so a step left out is `distance` of them; below 0.001 it is negligible."""
    start = Iterate(np.array([distance]), None, np.zeros(0), -0.5 * distance**2)
    end = climb(Inexact(error), start)
    assert end.status == status
    assert status == "stalled" or abs(end.iterate.theta[0]) < 1e-3


def test_residuals_whose_squares_overflow_are_refused():
    """A step of the estimate by the data alone may lead to them; noise parameters cannot be estimated there."""
    problem = bp.Problem(
        LINEAR, [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)], noise="circulant",
        priors={"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)},
    )  # fmt: skip
    objective = Objective(LogPosterior(problem, problem.density().linearise(problem.median()).solver))
    size = problem.density().linearise(problem.median()).residuals[0].size
    far = SimpleNamespace(converged=True, residuals=[np.full(size, 1e200)], theta=problem.median())
    assert objective.iterate(far, problem.likelihood.guess()) is None
