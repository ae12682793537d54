"""What not knowing the correlation of the noise adds to the covariance of the parameters."""

import numpy as np

from bayesperiodic.inference.estimation.gauss_newton import Iterate, information
from bayesperiodic.inference.noise.blocks import SPECTRAL, Block
from bayesperiodic.inference.problem import Problem

# Quantiles of the priors of a spectrum's shape that are tried: many of the first parameter, few of any other.
MANY, FEW = 60, 9
TAIL = 0.005
ROUNDS, RIDGE = 3, 1e-12


def with_uncertain_noise(problem: Problem, estimate: Iterate, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance of θ (names, names) with the noise parameters integrated out instead of held.

    Models without a shape, whose variances alone are unknown, keep their covariance; intervals by Student's t are all
    they need. A spectrum's shape is known poorly from the low harmonics, on which most outputs depend and which the fit
    takes out. So θ is estimated again, by linear least squares, for shapes from all over their prior; their posterior
    is that of the restricted likelihood [1]_, with θ integrated out, and the covariance is that of the mixture about
    the estimate. With several channels the changes that each brings by itself are added.

    Parameters
    ----------
    problem : Problem
    estimate : Iterate
    covariance : array (names, names)
        Inverse of H of eq. (8) at the estimate.

    References
    ----------
    .. [1] D. A. Harville, Maximum likelihood approaches to variance component estimation and to related problems,
       Journal of the American Statistical Association 72 (1977) 320-338.
    """
    shaped = [(group, members) for group, members in problem.likelihood.groups() if _is_shaped(problem, group, members)]
    if not shaped or not np.all(np.diag(covariance) > 0.0):
        return covariance
    total = information(problem, estimate)[0] + problem.joint_prior.curvature(estimate.theta)
    result = covariance.copy()
    for group, members in shaped:
        result += _mixture(problem, estimate, total, covariance, group, members) - covariance
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(result / np.outer(scale, scale))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale)


def _is_shaped(problem: Problem, group: tuple[str, ...], members: list[int]) -> bool:
    """Return whether a group of noise parameters, all unknown, has a shape beside its variance, over whole periods."""
    shaped = any(name.partition("[")[0] in problem.noise.shape_priors for name in group)
    spectral = all(problem.likelihood.blocks[b].kind == SPECTRAL for b in members)
    return shaped and spectral and set(group) <= set(problem.free_noise)


def _mixture(
    problem: Problem,
    estimate: Iterate,
    hessian: np.ndarray,
    covariance: np.ndarray,
    group: tuple[str, ...],
    members: list[int],
) -> np.ndarray:
    """Return the covariance of the mixture over the noise parameters of one group, the others held."""
    likelihood, blocks = problem.likelihood, [problem.likelihood.blocks[b] for b in members]
    scale = np.sqrt(np.diag(covariance))
    s = np.concatenate([estimate.here.changes[b] for b in members], axis=1) * scale[:, None]
    r = np.concatenate([estimate.here.residuals[b] for b in members])
    weight = np.concatenate([np.full(block.size, block.weight) for block in blocks])
    here = estimate.noise[[likelihood.names.index(name) for name in group]]
    now = weight / _spectra(problem, blocks, here)
    others = hessian * np.outer(scale, scale) - (s * now) @ s.T + RIDGE * np.eye(scale.size)
    pull, freedom = -(s * now) @ r, max(float(weight.sum()) - len(problem.names), 1.0)
    points, log_prior = _points(problem)
    log_posterior, found = np.empty(len(points)), np.empty((len(points), *covariance.shape))
    spectra = _spectra(problem, blocks, np.column_stack([np.ones(len(points)), points]))
    for i in range(len(points)):
        shape = spectra[i]
        own = weight / shape
        left, variance = r, float(np.sum(own * r**2)) / freedom
        for _ in range(ROUNDS):
            total = (s * own) @ s.T / variance + others
            step = np.linalg.solve(total, s @ (own * r) / variance + pull)
            left = r - step @ s
            variance = max(float(np.sum(own * left**2)) / freedom, np.finfo(float).tiny)
        misfit = np.sum(own * left**2) / variance + step @ others @ step - 2.0 * step @ pull
        logarithms = float(np.sum(weight * np.log(variance * shape))) + np.linalg.slogdet(total)[1]
        log_posterior[i] = log_prior[i] - 0.5 * (misfit + logarithms)
        found[i] = np.linalg.inv(total) + np.outer(step, step)
    posterior = np.exp(log_posterior - log_posterior.max())
    return np.tensordot(posterior / posterior.sum(), found, 1) * np.outer(scale, scale)


def _spectra(problem: Problem, blocks: list[Block], values: np.ndarray) -> np.ndarray:
    """Return the variances of the components of all blocks one after the other, (…, components)."""
    return np.concatenate([problem.noise.spectrum(block, values)[0] for block in blocks], axis=-1)


def _points(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return shape parameters (points, parameters) spread over their priors, and their log-weights."""
    axes, weights = [], []
    for number, prior in enumerate(problem.noise.shape_priors.values()):
        ends = np.log(prior.quantile(np.array([TAIL, 1.0 - TAIL])))
        values = np.exp(np.linspace(ends[0], ends[1], MANY if number == 0 else FEW))
        axes.append(values)
        weights.append(prior.log_prob(values) + np.log(values))
    grid = np.meshgrid(*axes, indexing="ij")
    log_prior = sum(np.meshgrid(*weights, indexing="ij"))
    return np.stack([axis.ravel() for axis in grid], axis=-1), np.asarray(log_prior).ravel()
