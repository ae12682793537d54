"""Exact posterior draws, without a sampler, shared by the tests of the diagnoses."""

import numpy as np

import bayesperiodic as bp
from bayesperiodic.sampling.posterior import tree

CHAINS = 4


def posterior_of(problem: bp.Problem, theta: np.ndarray, noise: np.ndarray, seed: int = 0) -> bp.Posterior:
    """Return draws θ (draws, names) and noise parameters (draws, noise_names) as a Posterior."""
    theta, noise = (v.reshape(1, CHAINS, -1, v.shape[-1]).transpose(0, 2, 1, 3) for v in (theta, noise))
    anchored = problem.anchored(np.median(theta, axis=(0, 1, 2)))
    density = anchored.log_posterior(theta, noise)
    names = [*problem.names, *problem.free_noise]
    return bp.Posterior(
        data=tree(anchored, theta, noise, density, seed),
        converged=True,
        reason="independent draws",
        tau=dict.fromkeys(names, 1.0),
        ess=dict.fromkeys(names, float(density.size)),
        rhat=dict.fromkeys(names, 1.0),
        acceptance=1.0,
        failures={},
        log_posterior_calls=density.size,
        seed=seed,
    )


def draw(problem: bp.Problem, fit: bp.MapEstimate, seed: int, draws: int = 200) -> bp.Posterior:
    """Return draws about an estimate: each variance from its inverse gamma distribution, θ normal given them.

    Exact for a model linear in θ, independent errors in one channel with the prior 1/v, and priors without weight.
    """
    generator = np.random.default_rng(seed)
    names = list(problem.names)
    variances = np.array([fit.noise[name] for name in problem.noise_names])
    freedom = fit.degrees_of_freedom
    scale = freedom / generator.chisquare(freedom, draws)
    centre = np.array([fit.theta[name] for name in names])
    spread = generator.multivariate_normal(np.zeros(len(names)), fit.covariance.to_numpy(), draws)
    free = [name in problem.free_noise for name in problem.noise_names]
    noise = np.where(free, variances * scale[:, None], variances)
    return posterior_of(problem, centre + np.sqrt(scale[:, None]) * spread, noise, seed)
