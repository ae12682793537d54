"""Serial correlation of the rows of tables, against simulations and what parameters take up."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayesperiodic.estimation.table_tests import rows_of, serial_correlation

ROWS = np.arange(9.0)
LINE = np.stack([np.ones(9), ROWS])


def simulated(residual, jacobian, seed):
    """Return p by 20,000 other residuals; the fit is taken from each by least squares."""
    noise = np.vstack([residual, np.random.default_rng(seed).standard_normal((20_000, residual.size))])
    left = noise - (jacobian.T @ np.linalg.lstsq(jacobian.T, noise.T, rcond=None)[0]).T
    lag = [np.correlate(row[1:], row[:-1])[0] / (row @ row) for row in left]
    return np.mean(np.array(lag) >= lag[0])


@pytest.mark.parametrize("shape", ["parabola", "random", "alternating"])
@pytest.mark.parametrize("jacobian", [LINE, LINE[:1]])
def test_p_is_the_share_of_simulated_residuals_with_a_larger_correlation_of_neighbours(shape, jacobian):
    """Two standard deviations of the difference of two simulations at p = 1/2 are 0.012."""
    noise = 0.1 * np.random.default_rng(1).standard_normal(9)
    residual = {"parabola": (ROWS - 4) ** 2 / 9, "random": 10 * noise, "alternating": (-1.0) ** ROWS}[shape] + noise
    p = serial_correlation(residual, jacobian)
    assert p == pytest.approx(simulated(residual, jacobian, 2), abs=0.02)
    assert (p < 0.05) == (shape == "parabola") and (p > 0.9) == (shape == "alternating")
    # Neither its size nor what the parameters explain matters.
    assert serial_correlation(5.0 * residual, jacobian) == p
    assert serial_correlation(residual + np.array([3.0, -2.0])[: len(jacobian)] @ jacobian, jacobian) == p


def test_three_rows_more_than_parameters_are_needed():
    residual = np.array([1.0, -2.0, 0.5, 0.7, 1.0])
    assert np.isfinite(serial_correlation(residual, LINE[:, :5]))
    assert np.isnan(serial_correlation(residual[:4], LINE[:, :4]))
    assert np.isnan(serial_correlation(np.zeros(5), np.zeros((1, 5))))


def test_rows_of_a_quantity_are_in_the_order_of_frequencies():
    experiments = [SimpleNamespace(name=name, frequency=f) for name, f in (("a", 3.0), ("b", 1.0), ("c", 2.0))]
    blocks = [SimpleNamespace(experiment=e, channel=c) for e in "abc" for c in ("x", "y")]
    problem = SimpleNamespace(experiments=experiments, likelihood=SimpleNamespace(blocks=blocks))
    assert rows_of(problem, "y") == [3, 5, 1] and rows_of(problem, "x") == [2, 4, 0] and rows_of(problem, "z") == []
