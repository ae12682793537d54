"""The gradient of the log-posterior for every kind of observation, against eighth-order differences."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Batch
from tests.known import EIGHTH_ORDER
from tests.problems import CASES, duffing, duffing_run


def differences(problem: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the gradient of the log-posterior by θ and the logarithms of the free noise parameters.

    Every point is solved to rounding, as an anchor is: chord steps end when the next one would be below 1e-9, which
    shows in differences.
    """
    columns = [problem.noise_names.index(name) for name in problem.free_noise]
    result = []
    for i in range(len(problem.names) + len(columns)):
        parameter = i < len(problem.names)
        step, total = 1e-3 * abs(theta[i]) if parameter else 1e-2, 0.0
        for k, weight in EIGHTH_ORDER.items():
            for sign in (1, -1):
                moved, loud = theta.copy(), noise.copy()
                if parameter:
                    moved[i] += sign * k * step
                else:
                    loud[columns[i - len(problem.names)]] *= np.exp(sign * k * step)
                total += sign * weight * float(problem.anchored(moved).log_posterior(moved, loud))
        result.append(total / step)
    return np.array(result)


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("case", CASES)
def test_gradient_equals_differences_of_the_log_posterior(case):
    problem, theta = CASES[case]()
    theta, noise = np.array(theta), problem.likelihood.guess()
    noise[[name.startswith("variance") for name in problem.noise_names]] = 0.01
    problem = problem.anchored(theta)
    adjoint, forward = (problem.gradient(theta, noise, method=m) for m in ("adjoint", "forward"))
    numerical = differences(problem, theta, noise)
    scale = np.abs(numerical) + 1e-3 * np.abs(numerical).max()
    assert np.abs(forward - numerical) / scale == pytest.approx(0.0, abs=1e-8)
    assert adjoint == pytest.approx(forward, rel=1e-10, abs=1e-10 * np.abs(forward).max())


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("case", CASES)
def test_value_and_gradient_away_from_the_anchors_equal_those_of_an_exact_solve(case):
    """Against a solve to rounding at the same point."""
    problem, theta = CASES[case]()
    theta, noise = np.array(theta), problem.likelihood.guess()
    problem = problem.anchored(theta)
    moved = theta * (1.0 + 1e-3 * np.random.default_rng(1).standard_normal(theta.size))
    exact = problem.anchored(moved)
    value, gradient = problem.value_and_gradient(moved, noise)
    assert value == pytest.approx(float(problem.log_posterior(moved, noise)), abs=1e-5)
    assert value == pytest.approx(float(exact.log_posterior(moved, noise)), rel=1e-9, abs=1e-7)
    expected = exact.gradient(moved, noise, method="forward")
    assert gradient == pytest.approx(expected, rel=1e-6, abs=1e-8 * np.abs(expected).max())


def test_value_and_gradient_outside_the_support_are_minus_infinity_and_zero():
    value, gradient = duffing(duffing_run()).value_and_gradient(
        {"c": -1.0, "k": 1.0, "k3": 0.5}, {"displacement": 0.01}
    )
    assert value == -np.inf
    assert gradient.tolist() == [0.0] * 4


def test_singular_transposed_solve_gives_minus_infinity_and_zero_gradient(monkeypatch):
    problem = duffing(duffing_run())
    theta, noise = {"c": 0.2, "k": 1.0, "k3": 0.5}, {"displacement": 0.01}
    assert np.isfinite(problem.value_and_gradient(theta, noise)[0])
    monkeypatch.setattr(Batch, "vjp", lambda self, p, z, weights, moving: np.full((len(p), len(moving)), np.nan))
    value, gradient = problem.value_and_gradient(theta, noise)
    assert value == -np.inf
    assert gradient.tolist() == [0.0] * 4


def test_gradient_needs_a_point_inside_the_support():
    problem = duffing(duffing_run())
    with pytest.raises(ValueError, match="theta: the log-posterior must be finite, got -inf at"):
        problem.gradient({"c": -1.0, "k": 1.0, "k3": 0.5}, {"displacement": 0.01})
    with pytest.raises(ValueError, match="method: must be one of 'adjoint', 'forward', got 'reverse'"):
        problem.gradient({"c": 0.2, "k": 1.0, "k3": 0.5}, {"displacement": 0.01}, method="reverse")
