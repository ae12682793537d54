"""Posterior predictive bands on the measured periods."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from bayesperiodic import checks
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.store import Result

PROBABILITY = 0.9
NOISE_LEVELS = 21


@dataclass(frozen=True)
class Prediction(Result):
    """What the posterior expects of the mean period of each experiment.

    Attributes
    ----------
    median, low, high : dict of str to dict of str to array (points,)
        By experiment and channel: the median and the central 90 % band of the mean period, residual variance included
        and taken as normal at each point, within the harmonics kept. Section values with a covariance of their own have
        the band of the model alone.
    probability : float
        Of the band.
    draws : int
        Posterior draws used.
    failed : int
        Of these, how many had no periodic solution.
    """

    median: dict[str, dict[str, np.ndarray]]
    low: dict[str, dict[str, np.ndarray]]
    high: dict[str, dict[str, np.ndarray]]
    probability: float
    draws: int
    failed: int


def predict(problem: Problem, posterior: Posterior, *, draws: int = 200) -> Prediction:
    """Predict the mean period of every experiment from equally spaced posterior draws.

    Parameters
    ----------
    problem : Problem
    posterior : Posterior
    draws : int
        At least 20.

    Raises
    ------
    RuntimeError
        If no draw has a periodic solution.
    """
    count = checks.integer("draws", draws, 20)
    columns = {name: posterior.draws(name) for name in posterior.names}
    chosen = np.linspace(0, next(iter(columns.values())).size - 1, count).astype(int)
    free = (
        np.stack([columns[n][chosen] for n in problem.free_noise], -1) if problem.free_noise else np.empty((count, 0))
    )
    variances = problem.likelihood.value_variances(problem.likelihood.complete(free))
    theta = {name: float(np.median(columns[name])) for name in problem.names}
    anchored = problem.anchored(theta)
    points = np.stack([columns[name][chosen] for name in problem.names], axis=-1)
    outputs, converged = anchored.outputs(points)
    if not converged.any():
        raise RuntimeError("posterior: none of its draws has a periodic solution, so nothing can be predicted.")
    return bands(problem, outputs, converged, variances)


def bands(
    problem: Problem,
    outputs: dict[str, dict[str, np.ndarray]],
    converged: np.ndarray,
    variances: dict[tuple[str, str], np.ndarray],
) -> Prediction:
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
    quantiles = [0.5, 0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY]
    scores = ndtri((np.arange(NOISE_LEVELS) + 0.5) / NOISE_LEVELS)
    found: list[dict[str, dict[str, np.ndarray]]] = [{}, {}, {}]
    for e in problem.experiments:
        for channel in e.outputs:
            variance = variances.get((e.name, channel), np.zeros(count))
            expected = e.project(channel, outputs[e.name][channel])
            noise = np.sqrt(variance)[:, None, None] * scores[:, None]
            values = (expected[:, None] + noise)[converged].reshape(-1, expected.shape[1])
            for band, q in zip(found, quantiles, strict=True):
                level = np.median(expected[converged], axis=0) if q == 0.5 else np.quantile(values, q, axis=0)
                band.setdefault(e.name, {})[channel] = level
    median, low, high = found
    return Prediction(median, low, high, PROBABILITY, count, int(count - converged.sum()))
