"""Tests of what a table of measured amplitudes, phases or sizes leaves unexplained, in the order of the frequencies."""

import numpy as np

from bayesperiodic._linalg import column_space
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.unexplained import NOT_TESTED, testable

# Simulated residuals to which the serial correlation is compared, and the fewest rows more than parameters.
SIMULATED_TABLES, SPARE_ROWS = 9999, 3


def rows_of(problem: Problem, quantity: str) -> list[int]:
    """Return the indices of the blocks of a measured quantity, in the order of frequencies."""
    frequencies = {e.name: e.frequency for e in problem.experiments}
    members = [b for b, block in enumerate(problem.likelihood.blocks) if block.channel == quantity]
    return sorted(members, key=lambda b: frequencies[problem.likelihood.blocks[b].experiment])


def serial_correlation(residual: np.ndarray, jacobian: np.ndarray) -> float:
    """Return p of the correlation of neighbours in whitened residuals (rows,) less what parameters take up of them.

    One-sided, as a wrong model leaves smooth residuals; the null distribution is simulated, so that p is exact for any
    number of rows. The derivatives are (parameters, rows).
    """
    if not testable(residual, jacobian):
        return NOT_TESTED
    basis = column_space(jacobian)
    if residual.size - basis.shape[1] < SPARE_ROWS:
        return NOT_TESTED
    noise = np.random.default_rng(0).standard_normal((SIMULATED_TABLES + 1, residual.size))
    noise[0] = residual
    left = noise - (noise @ basis) @ basis.T
    square = np.sum(left**2, axis=1)
    if not square[0] > 0.0:
        return NOT_TESTED
    statistic = np.sum(left[:, 1:] * left[:, :-1], axis=1) / square
    return float(np.mean(statistic >= statistic[0]))
