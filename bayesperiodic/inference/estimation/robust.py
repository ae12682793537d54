"""Standard deviations that hold although the noise model does not: the sandwich with the residual's own spectrum."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.inference.estimation.gauss_newton import Iterate
from bayesperiodic.inference.noise.blocks import SPECTRAL, Block
from bayesperiodic.inference.noise.models import LENGTHSCALE
from bayesperiodic.inference.problem import Problem

# Correlation lengths tried, in response periods; white noise beside them has this prior probability.
LENGTHSCALES = np.geomspace(1e-3, 3.0, 40)
WHITE = 0.5
ROUNDS, SETTLED = 10, 1e-3
RIDGE = 1e-12


def robust_covariance(problem: Problem, estimate: Iterate, covariance: np.ndarray) -> np.ndarray:
    """Return C (J + P) C, with C the inverse of H of eq. (8), P the prior's curvature and J the scores' variance.

    J takes the variance of each Fourier component from the residual itself. A first-order autoregressive spectrum (or
    white noise) is fitted to it, the residual is divided by that (prewhitening, [1]_), and what is left is smoothed
    over neighbouring harmonics. Two things make the low harmonics, on which most outputs depend, honest: the fit takes
    out just these, so that the spectrum has the restricted likelihood [2]_, with the parameters integrated out; and
    the little that is left tells the correlation length poorly, so that J is averaged over its posterior, and raised
    for the few values behind each smoothed one. Components that are no Fourier components keep the model's variance.

    References
    ----------
    .. [1] D. W. K. Andrews, J. C. Monahan, An improved heteroskedasticity and autocorrelation consistent covariance
       matrix estimator, Econometrica 60 (1992) 953-966.
    .. [2] D. A. Harville, Maximum likelihood approaches to variance component estimation and to related problems,
       Journal of the American Statistical Association 72 (1977) 320-338.
    """
    likelihood, prior = problem.likelihood, problem.joint_prior.curvature(estimate.theta)
    ones = [np.ones(block.size) for block in likelihood.blocks]
    changes, residuals, units = (
        likelihood.whitened(vectors, estimate.noise)
        for vectors in (estimate.here.changes, estimate.here.residuals, ones)
    )
    information = prior + sum(s @ s.T for s in changes)
    if not np.isfinite(information).all():
        return np.full_like(covariance, np.nan)
    middle = prior
    for block, s, r, unit in zip(likelihood.blocks, changes, residuals, units, strict=True):
        variance = np.ones(block.size)
        if block.kind == SPECTRAL:
            variance = _Refits.of(block, s, r, unit, information).variance(block) if r.any() else np.zeros(block.size)
        middle = middle + (s * variance) @ s.T
    return covariance @ middle @ covariance


@dataclass(frozen=True)
class _Refits:
    """Least squares of one block's whitened residual, once for each spectrum that it may have.

    Attributes
    ----------
    spectrum : array (spectra, size)
        Of the whitened residual, with the scale that suits it best.
    square : array (spectra, size)
        Squared residuals of the fits in units of their spectra.
    left : array (spectra, size)
        What to expect of these: the independent values per component, less what the fit takes out.
    posterior : array (spectra,)
        Probabilities of the spectra.
    """

    spectrum: np.ndarray
    square: np.ndarray
    left: np.ndarray
    posterior: np.ndarray

    @classmethod
    def of(cls, block: Block, s: np.ndarray, r: np.ndarray, unit: np.ndarray, information: np.ndarray) -> "_Refits":
        """Return the fits; what other blocks and the prior say of θ stays as it is."""
        shape, log_prior = _shapes(block, unit)
        scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(information)), np.finfo(float).tiny))
        others = _positive((information - s @ s.T) * np.outer(scale, scale))
        s, score = s * scale[:, None], (s * scale[:, None]) @ r
        own = (s / shape[:, None, :]) @ s.T
        pull = (r / shape) @ s.T
        size = np.ones(len(shape))
        for _ in range(ROUNDS):
            total = own / size[:, None, None] + others
            step = np.linalg.solve(total, (pull / size[:, None] - score)[..., None])[..., 0]
            square = (r - step @ s) ** 2 / shape
            taken = np.einsum("am,gam->gm", s, np.linalg.solve(total, s / shape[:, None, :])) / size[:, None]
            left = np.maximum(block.weight - taken, 0.0)
            before = size
            size = np.maximum(square.sum(axis=1), np.finfo(float).tiny) / np.maximum(left.sum(axis=1), RIDGE)
            if np.allclose(size, before, rtol=SETTLED, atol=0.0):
                break
        misfit = square.sum(axis=1) / size + np.einsum("ga,ab,gb->g", step, others, step) + 2.0 * step @ score
        logarithms = block.weight * np.sum(np.log(size[:, None] * shape), axis=1) + np.linalg.slogdet(total)[1]
        log_posterior = log_prior - 0.5 * (misfit + logarithms)
        posterior = np.exp(log_posterior - log_posterior.max())
        return cls(size[:, None] * shape, square / size[:, None], left, posterior / posterior.sum())

    def variance(self, block: Block) -> np.ndarray:
        """Return the variance (size,) of the whitened residual's components, corrected and averaged."""
        corrected = [
            spectrum * _smoothed(block, square, left)
            for spectrum, square, left in zip(self.spectrum, self.square, self.left, strict=True)
        ]
        return self.posterior @ np.array(corrected)


def _shapes(block: Block, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return spectra (spectra, size) in units of the noise model, white and autoregressive, and their log-priors."""
    lengths = np.concatenate([[0.0], LENGTHSCALES])
    shape = unit**2 / (1.0 + (2 * np.pi * lengths[:, None] * block.harmonic) ** 2)
    weight = np.exp(LENGTHSCALE.log_prob(LENGTHSCALES)) * LENGTHSCALES
    weight = np.concatenate([[WHITE], (1.0 - WHITE) * weight / weight.sum()])
    return shape / shape.mean(axis=1, keepdims=True), np.log(weight)


def _positive(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix with its negative eigenvalues cut off."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, RIDGE)) @ vectors.T


def _smoothed(block: Block, square: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return squares over their expectation (size,), smoothed over harmonics, as the mean of an unknown variance."""
    highest = int(block.harmonic.max())
    half = int(np.ceil(np.sqrt(highest + 1.0)))
    window = 1.0 - (np.arange(-half, half + 1) / (half + 1.0)) ** 2
    middle = slice(half, half + highest + 1)
    power, expected, doubled = (
        np.convolve(np.bincount(block.harmonic, values, highest + 1), weights)[middle]
        for values, weights in ((square, window), (left, window), (left, window**2))
    )
    freedom = expected**2 / np.maximum(doubled, RIDGE)
    ratio = power / np.maximum(expected, RIDGE) * _excess(freedom) / _excess(np.sum(left))
    return ratio[block.harmonic]


def _excess(freedom: np.ndarray) -> np.ndarray:
    """Return the mean of a variance over its estimate, ν/(ν − 2), for estimates with ν degrees of freedom."""
    return np.maximum(freedom, 1.0) / np.maximum(freedom - 2.0, 1.0)
