"""Local polynomial regression of the return map, unbiased by noise in its arguments."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

# Powers of the two coordinates, degree by degree, and the factorials that make the coefficients derivatives.
POWERS = np.array([(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)])
FACTORIALS = np.array([1.0, 1.0, 1.0, 2.0, 1.0, 2.0, 6.0, 2.0, 2.0, 6.0])
TERMS = {1: 3, 2: 6, 3: 10}
# Neighbours are taken up to so many bandwidths: beyond, their weight is under 1.2 %.
REACH = 3.0
# Of a bandwidth: with more noise than that, deconvolution leaves nothing to fit to.
MOST_NOISE = 0.75
MOST_LEVERAGE = 0.9
BLOCK = 4_000_000


@dataclass(frozen=True)
class LocalFit:
    """Polynomials of the return map about m centres, in units of the attractor's size.

    Attributes
    ----------
    value : array (m, 2)
        Image of the centre, angles running on from the centre.
    derivatives : array (m, terms, 2)
        Of the image: itself (relative), by u, v, uu, uv, vv, …
    bandwidth : array (m,)
    index : array (m, n)
        The neighbours' positions among the arguments.
    influence : array (m, n, terms, 2)
        What each neighbour contributes to the error of `derivatives`.
    effective : array (m,)
        Effective number of neighbours.
    """

    value: np.ndarray
    derivatives: np.ndarray
    bandwidth: np.ndarray
    index: np.ndarray
    influence: np.ndarray
    effective: np.ndarray

    @property
    def jacobian(self) -> np.ndarray:
        """Derivatives of the image by the argument, (m, image, argument)."""
        return self.derivatives[:, 1:3].transpose(0, 2, 1)

    @property
    def hessian(self) -> np.ndarray:
        """Second derivatives (m, image, argument, argument); zero for linear fits."""
        result = np.zeros((len(self.derivatives), 2, 2, 2))
        if self.derivatives.shape[1] > 3:
            for term, (row, column) in zip((3, 4, 4, 5), ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
                result[:, :, row, column] = self.derivatives[:, term]
        return result


class LocalMaps:
    """The return map of a section, fitted where it is asked for.

    The fits weigh the neighbours with a Gaussian kernel. Their normal equations are sums of kernel times powers of the
    noise-free arguments. With normal noise in the arguments, of known variance below the kernel's, there are functions
    of the noisy arguments whose mean over the noise is just that (a narrower Gaussian times Hermite polynomials): the
    deconvoluting kernels of [1]_. With them the equations are unbiased, and so there is no attenuation.

    Parameters
    ----------
    arguments : array (n, 2)
        Points with an image, in units of the attractor's size.
    increments : array (n, 2)
        Image minus argument; of angles the whole way, or modulo a turn.
    turn : array (2,)
        One turn in these units, infinite for coordinates that are no angles.
    noise : array (2,)
        Standard deviation of the arguments.

    References
    ----------
    .. [1] J. Fan, Y. K. Truong, Nonparametric regression with errors in variables, Annals of Statistics 21, 1993.
    """

    def __init__(self, arguments: np.ndarray, increments: np.ndarray, turn: np.ndarray, winds: bool, noise: np.ndarray):
        self.arguments, self.increments, self.turn, self.winds, self.noise = arguments, increments, turn, winds, noise
        box = np.where(np.isfinite(turn), turn, 0.0)
        self._tree = cKDTree(self.inside(arguments), boxsize=box)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return points with angles in one turn from zero on."""
        angle = np.isfinite(self.turn)
        result = np.array(points)
        result[:, angle] %= self.turn[angle]
        # The remainder of a tiny negative number is the turn itself, which the tree refuses.
        result[:, angle] = np.where(result[:, angle] >= self.turn[angle], 0.0, result[:, angle])
        return result

    def wrap(self, difference: np.ndarray) -> np.ndarray:
        """Return differences with angles in half a turn either way."""
        result = np.array(difference)
        for column in np.flatnonzero(np.isfinite(self.turn)):
            turn = self.turn[column]
            result[..., column] -= turn * np.round(result[..., column] / turn)
        return result

    def nearest(self, centres: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and positions of the nearest arguments, (m, count) each."""
        distance, index = self._tree.query(self.inside(centres), np.arange(1, count + 1))
        return np.asarray(distance), np.asarray(index)

    def within(self, centres: np.ndarray, bandwidths: np.ndarray) -> np.ndarray:
        """Return how many arguments a fit of each bandwidth (m,) about the centres (m, 2) takes in."""
        return np.asarray(self._tree.query_ball_point(self.inside(centres), REACH * bandwidths, return_length=True))

    def fit(self, centres: np.ndarray, count: int, degree: int, *, influence: bool = True) -> LocalFit:
        """Fit polynomials about the centres (m, 2) to their `count` nearest neighbours; without `influence` quicker."""
        rows = max(1, BLOCK // (count * TERMS[degree] ** 2))
        parts = [self._fit(centres[k : k + rows], count, degree, influence) for k in range(0, len(centres), rows)]
        return LocalFit(*(np.concatenate([getattr(p, name) for p in parts]) for name in LocalFit.__dataclass_fields__))

    @staticmethod
    def predict(fit: LocalFit, away: np.ndarray) -> np.ndarray:
        """Return images (m, …, 2) at distances (m, …, 2) from the centres."""
        terms = fit.derivatives.shape[1]
        monomials = np.stack([away[..., 0] ** a * away[..., 1] ** b for a, b in POWERS[1:terms]], axis=-1)
        slopes = fit.derivatives[:, 1:] / FACTORIALS[1:terms, None]
        shape = (len(away), *(1,) * (away.ndim - 2), 2)
        return fit.value.reshape(shape) + np.einsum("m...t,mtc->m...c", monomials, slopes)

    def rest(self, centres: np.ndarray, fit: LocalFit) -> np.ndarray:
        """Return the variance (m, 2) that fits leave of their neighbours' images, with the fit's weights."""
        away = self.wrap(self.arguments[fit.index] - centres[:, None])
        left = away + self.increments[fit.index] + centres[:, None] - self.predict(fit, away)
        left = left if self.winds else self.wrap(left)
        weight = np.exp(-0.5 * np.sum(away**2, axis=-1) / fit.bandwidth[:, None] ** 2)
        room = np.maximum(fit.effective - fit.derivatives.shape[1], 1.0) / fit.effective
        return np.einsum("mn,mnc->mc", weight, left**2) / weight.sum(1)[:, None] / room[:, None]

    def _fit(self, centres: np.ndarray, count: int, degree: int, wants_influence: bool) -> LocalFit:
        distance, index = self.nearest(centres, count)
        bandwidth = np.maximum(distance[:, -1] / REACH, np.max(self.noise) / MOST_NOISE)
        away = self.wrap(self.arguments[index] - centres[:, None])
        image = away + self.increments[index]
        reference = image[:, :1]
        image = image - reference
        if not self.winds:
            image = self.wrap(image)
        moments, weight = _deconvoluted(away / bandwidth[:, None, None], self.noise / bandwidth[:, None], 2 * degree)
        powers = POWERS[: TERMS[degree]]
        sums = powers[:, None] + powers[None]
        weighted = weight[..., None] * moments[0]
        normal = (weighted.transpose(0, 2, 1) @ moments[1])[:, sums[..., 0], sums[..., 1]]
        regressors = weighted[..., powers[:, 0]] * moments[1][..., powers[:, 1]]
        inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
        solution = inverse @ (regressors.transpose(0, 2, 1) @ image)
        effective = weight.sum(1) ** 2 / (weight**2).sum(1)
        scale = (FACTORIALS[: len(powers)] / bandwidth[:, None] ** powers.sum(1))[..., None]
        influence = np.empty((len(centres), 0, len(powers), 2))
        if wants_influence:
            # What each neighbour leaves over in the normal equations, at the solution.
            product = weighted[..., sums[..., 0]] * moments[1][..., sums[..., 1]]
            residual = regressors[..., None] * image[:, :, None] - product @ solution[:, None]
            # A neighbour with leverage draws the fit to itself; what it would leave without that is more.
            leverage = np.clip(np.einsum("mab,mnab->mn", inverse, product), 0.0, MOST_LEVERAGE)
            influence = (inverse[:, None] @ residual) * scale[:, None] / (1.0 - leverage)[..., None, None]
        derivatives = solution * scale
        value = centres + reference[:, 0] + derivatives[:, 0]
        return LocalFit(value, derivatives, bandwidth, index, influence, effective)


def _deconvoluted(
    away: np.ndarray, noise: np.ndarray, highest: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return, by coordinate, functions whose mean over the noise is (kernel ×) power, and the kernel; unit bandwidth.

    x^a exp(−x²/2) is the mean over noise of variance s² of the narrower Gaussian of variance 1 − s² times the a-th
    moment of a normal distribution with mean x/(1 − s²) and the negative variance −s²/(1 − s²).
    """
    left = 1.0 - noise[:, None] ** 2
    weight = np.exp(-0.5 * np.sum(away**2 / left, axis=-1)) / np.sqrt(left.prod(-1))
    moments = []
    for k in range(2):
        mean, variance = away[..., k] / left[..., k], -(1.0 - left[..., k]) / left[..., k]
        rows = [np.ones_like(mean), mean]
        for order in range(2, highest + 1):
            rows.append(mean * rows[-1] + (order - 1) * variance * rows[-2])
        moments.append(np.stack(rows[: highest + 1], axis=-1))
    return (moments[0], moments[1]), weight
