"""How much a posterior changes when the prior or the likelihood is given a little more or less weight."""

import numpy as np

from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.coordinates import SamplingDensity
from bayesperiodic.inference.sampling.posterior import Posterior

POWER = 1.25
MOST_DRAWS = 20_000


def power_scaling(problem: Problem, posterior: Posterior) -> dict[str, tuple[float, float]]:
    """Return the sensitivity of each parameter's posterior to the prior and to the likelihood ([1]_).

    Draws are weighted by the prior of θ, or the likelihood, to the powers 0.25 and −0.2; the cumulative Jensen-Shannon
    distance between the weighted and the plain distribution, per doubling of the weight, is averaged over the two. A
    value above 0.05 is noticeable: of a normal distribution, a mean that moves by a sixth of its standard deviation as
    the weight doubles. Both large tell of a conflict; only that to the prior large, of data that say little.

    References
    ----------
    .. [1] N. Kallioinen, T. Paananen, P.-C. Bürkner, A. Vehtari, Detecting and diagnosing prior and likelihood
       sensitivity with power-scaling, Statistics and Computing 34 (2024) 57.
    """
    step = max(1, posterior.draws(problem.names[0]).size // MOST_DRAWS)
    theta = np.stack([posterior.draws(name)[::step] for name in problem.names], axis=-1)
    lp = posterior.data["sample_stats"]["lp"].transpose("chain", "draw").to_numpy().ravel()[::step]
    prior = np.asarray(problem.log_prior(theta))
    logs = SamplingDensity(problem).logarithmic
    free = [name for name in problem.free_noise]
    noise = problem.likelihood.complete(
        np.array([posterior.draws(name)[::step] for name in free]).reshape(len(free), -1).T
        if free
        else np.empty((len(theta), 0))
    )
    likelihood = lp - prior - problem.likelihood.log_prior(noise) - np.log(theta[:, logs]).sum(axis=1)
    return {
        name: (_sensitivity(theta[:, i], prior), _sensitivity(theta[:, i], likelihood))
        for i, name in enumerate(problem.names)
    }


def _sensitivity(values: np.ndarray, log_density: np.ndarray) -> float:
    """Return the mean distance per doubling between draws and draws weighted by a density to small powers."""
    distances = []
    for power in (POWER - 1.0, 1.0 / POWER - 1.0):
        logarithm = power * (log_density - log_density.max())
        weights = np.exp(logarithm - logarithm.max())
        distances.append(cumulative_jensen_shannon(values, weights / weights.sum()))
    return float(np.mean(distances) / np.log2(POWER))


def cumulative_jensen_shannon(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the distance, 0 to 1, of draws from the same draws with weights; the larger of both directions.

    The root of the cumulative Jensen-Shannon divergence of the distribution functions over its largest value.

    References
    ----------
    H.-V. Nguyen, J. Vreeken, Non-parametric Jensen-Shannon divergence, ECML PKDD 2015, 173-189.
    """
    order = np.argsort(values, kind="stable")
    x, plain, weighted = values[order], np.full(values.size, 1.0 / values.size), weights[order]
    return max(_one_sided(x, plain, weighted), _one_sided(-x[::-1], plain, weighted[::-1]))


def _one_sided(x: np.ndarray, plain: np.ndarray, weighted: np.ndarray) -> float:
    widths = np.diff(x)
    p, q = np.cumsum(plain)[:-1], np.cumsum(weighted)[:-1]
    total = np.sum((p + q) * widths)
    if total <= 0.0:
        return 0.0
    middle = 0.5 * (p + q)

    def against(own: np.ndarray, other: np.ndarray) -> float:
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = np.where(own > 0.0, own * np.log2(own / middle), 0.0)
        return float(np.sum(terms * widths) + np.sum((other - own) * widths) / (2.0 * np.log(2.0)))

    return float(np.sqrt(max(against(p, q) + against(q, p), 0.0) / total))
