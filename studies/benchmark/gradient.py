"""How right a gradient of the log-posterior is."""

from __future__ import annotations

import numpy as np

import bayesperiodic as bp

STEP = 0.05


def gradient_error(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> float:
    """Return the error of the gradient by θ against five-point differences of log-posteriors, of its largest component.

    Components count, and steps are taken, in standard deviations of one parameter with the others known.

    Parameters
    ----------
    warm : Problem
        The one that the gradient is of; the differences are of the problem anchored at θ.
    theta : array (names,)
    noise : array (noise_names,)
    """
    sd = _conditional_sd(warm, theta, noise)
    given = warm.gradient(theta, noise)[: theta.size] * sd
    shifts = np.concatenate([np.diag(k * STEP * sd) for k in (-2.0, -1.0, 1.0, 2.0)])
    two, one, minus_one, minus_two = warm.anchored(theta).log_posterior(theta - shifts, noise).reshape(4, -1)
    differences = (minus_two - 8.0 * minus_one + 8.0 * one - two) / (12.0 * STEP)
    return float(np.abs(given - differences).max() / np.abs(given).max())


def _conditional_sd(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    changes = warm.likelihood.whitened(warm.linearised(theta).changes, noise)
    information = sum((own**2).sum(axis=-1) for own in changes)
    return 1.0 / np.sqrt(information + np.diag(warm.joint_prior.curvature(theta)))
