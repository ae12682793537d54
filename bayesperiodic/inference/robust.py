"""Standard deviations that hold although the noise model does not: the sandwich with a smoothed residual spectrum."""

import numpy as np

from bayesperiodic.inference.blocks import SPECTRAL, Block
from bayesperiodic.inference.gauss_newton import Iterate
from bayesperiodic.inference.problem import Problem

# Correlation lengths tried, in response periods.
LENGTHSCALES = np.geomspace(1e-4, 3.0, 60)


def robust_covariance(problem: Problem, estimate: Iterate, covariance: np.ndarray) -> np.ndarray:
    """Return C (J + P) C, with C the inverse of H of eq. (8), P the prior's curvature and J the scores' variance.

    J takes the variance of each Fourier component from the residual itself: its spectrum is smoothed over neighbouring
    harmonics after it was divided by that of a first-order autoregressive process fitted to it (prewhitening, [1]_),
    and corrected for what the fit took out of it. Components that are no Fourier components keep the model's variance.

    References
    ----------
    .. [1] D. W. K. Andrews, J. C. Monahan, An improved heteroskedasticity and autocorrelation consistent covariance
       matrix estimator, Econometrica 60 (1992) 953-966.
    """
    likelihood = problem.likelihood
    changes = likelihood.whitened(estimate.here.changes, estimate.noise)
    residuals = likelihood.whitened(estimate.here.residuals, estimate.noise)
    middle = problem.joint_prior.curvature(estimate.theta)
    for block, s, r in zip(likelihood.blocks, changes, residuals, strict=True):
        leverage = np.einsum("am,ab,bm->m", s, covariance, s)
        variance = _smoothed(block, r, leverage) if block.kind == SPECTRAL else np.ones(block.size)
        middle = middle + (s * variance) @ s.T
    return covariance @ middle @ covariance


def _smoothed(block: Block, r: np.ndarray, leverage: np.ndarray) -> np.ndarray:
    """Return the smoothed spectrum (size,) of whitened residual components."""
    if not np.any(r):
        return np.zeros_like(r)
    inverse = 1.0 / np.sqrt(_autoregressive(block.harmonic, r))
    highest = int(block.harmonic.max())
    power = np.bincount(block.harmonic, (inverse * r) ** 2, highest + 1)
    left = np.bincount(block.harmonic, np.maximum(1.0 - leverage, 0.0), highest + 1)
    half = int(np.ceil(np.sqrt(highest + 1.0)))
    window = 1.0 - (np.arange(-half, half + 1) / (half + 1.0)) ** 2
    middle = slice(half, half + highest + 1)
    smooth = np.convolve(power, window)[middle] / np.maximum(np.convolve(left, window)[middle], 1e-6)
    return smooth[block.harmonic] / inverse**2 / block.weight


def _autoregressive(harmonic: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the spectrum (size,), up to a factor, of the first-order autoregressive process that suits r best."""
    spectra = 1.0 / (1.0 + (2 * np.pi * LENGTHSCALES[:, None] * harmonic) ** 2)
    likelihood = -0.5 * (r.size * np.log(np.mean(r**2 / spectra, axis=1)) + np.sum(np.log(spectra), axis=1))
    return spectra[np.argmax(likelihood)]
