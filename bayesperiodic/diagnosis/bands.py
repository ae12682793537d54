"""Predictive bands on the measured periods."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from bayesperiodic.inference.problem import Problem
from bayesperiodic.store import Result

PROBABILITY = 0.9
NOISE_LEVELS = 21


@dataclass(frozen=True)
class Bands(Result):
    """What is expected of the mean period of each experiment.

    Attributes
    ----------
    median, low, high : dict of str to dict of str to array (points,)
        By experiment and channel: the median and the central 90 % band of the mean period, residual variance included
        and taken as normal at each point, within the harmonics kept. Section values with a covariance of their own have
        the band of the model alone.
    probability : float
        Of the band.
    draws : int
        Draws used.
    failed : int
        Of these, how many had no periodic solution.
    """

    median: dict[str, dict[str, np.ndarray]]
    low: dict[str, dict[str, np.ndarray]]
    high: dict[str, dict[str, np.ndarray]]
    probability: float
    draws: int
    failed: int


def quantiles() -> tuple[float, float, float]:
    """Return the levels of the median and of the ends of the central band."""
    return 0.5, 0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY


def bands(
    problem: Problem,
    outputs: dict[str, dict[str, np.ndarray]],
    converged: np.ndarray,
    variances: dict[tuple[str, str], np.ndarray],
) -> Bands:
    """Return the bands of outputs (draws, points), by experiment and channel, at the draws that converged.

    Parameters
    ----------
    problem : Problem
    outputs : dict of str to dict of str to array (draws, points)
    converged : bool array (draws,)
    variances : dict of (str, str) to array (draws,)
        Of the residual, by experiment and channel; zero where there is none.
    """
    count = converged.size
    scores = ndtri((np.arange(NOISE_LEVELS) + 0.5) / NOISE_LEVELS)
    found: list[dict[str, dict[str, np.ndarray]]] = [{}, {}, {}]
    for e in problem.experiments:
        for channel in e.outputs:
            variance = variances.get((e.name, channel), np.zeros(count))
            expected = e.project(channel, outputs[e.name][channel])
            noise = np.sqrt(variance)[:, None, None] * scores[:, None]
            values = (expected[:, None] + noise)[converged].reshape(-1, expected.shape[1])
            for band, q in zip(found, quantiles(), strict=True):
                level = np.median(expected[converged], axis=0) if q == 0.5 else np.quantile(values, q, axis=0)
                band.setdefault(e.name, {})[channel] = level
    median, low, high = found
    return Bands(median, low, high, PROBABILITY, count, int(count - converged.sum()))
