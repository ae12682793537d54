"""Local polynomial regression of the return map, unbiased by noise in its arguments."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
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


CENTRES = 600
ROUNDS = 8
# A linear return map must extend over so many standard deviations of the noise.
ROOM = 4.0


def noise_of(maps: LocalMaps, neighbours: int) -> np.ndarray:
    """Return the standard deviations (2,) of independent errors of the two coordinates, in the units of the maps.

    In a neighbourhood where the return map is a quadratic polynomial, what is left of an image has the variance of its
    own error and of the argument's, stretched by the map. The densest neighbourhoods are used, where curvature adds
    least; they are widened until the noise is small in them.
    """
    centres = maps.arguments[:: max(1, len(maps.arguments) // CENTRES)]
    noise, count = np.zeros(2), int(2.25 * neighbours)
    for _ in range(3):
        width = maps.nearest(centres, count)[0][:, -1]
        dense = centres[width <= np.median(width)]
        noise = _fitted(maps, dense, count)
        if np.median(width) / REACH > ROOM * noise.max() or count * 2 > len(maps.arguments) // 8:
            break
        count *= 2
    return noise


def _fitted(maps: LocalMaps, centres: np.ndarray, count: int) -> np.ndarray:
    fit = maps.fit(centres, count, 2, influence=False)
    left = maps.rest(centres, fit)
    rows = (np.eye(2) + fit.jacobian**2).reshape(-1, 2)
    target = left.reshape(-1)
    weight = 1.0 / np.maximum(target, 1e-30)
    solution = np.zeros(2)
    for _ in range(ROUNDS):
        solution, _ = nnls(rows * weight[:, None], target * weight)
        predicted = rows @ solution
        # Far larger than expected is curvature, not noise.
        weight = np.where(target < 4.0 * predicted, 1.0, 0.0) / np.maximum(predicted, 1e-30)
    return np.sqrt(solution)


LONGEST_PERIOD = 32
# Of the distance of two points taken at random.
SAME_POINT = 0.05
UNPREDICTED = 0.2
# Neighbours that part by less than this factor in so many steps do not part at all.
PARTED = 2.5
PARTING_STEPS = 6
PROBES = 400
NEIGHBOUR = 8


def check_chaos(maps: LocalMaps, section: np.ndarray) -> None:
    """Raise a ValueError for a section that holds no chaotic return map, and say what it seems to be.

    Parameters
    ----------
    maps : LocalMaps
    section : array (n, 2)
        All points in the order of time, in units of the attractor's size.
    """
    generator = np.random.default_rng(0)
    one, other = generator.integers(len(section), size=(2, 4 * PROBES))
    apart = np.median(_distance(maps, section[one], section[other]))
    for period in range(1, min(LONGEST_PERIOD, len(section) // 10) + 1):
        if np.median(_distance(maps, section[period:], section[:-period])) < SAME_POINT * apart:
            raise ValueError(
                f"section: a motion of period {period} is not allowed; its points come back to themselves every "
                f"{period} returns. Fold the recording with periods={period} instead."
            )
    centre = generator.choice(len(maps.arguments) - PARTING_STEPS, min(PROBES, len(section) // 4), replace=False)
    neighbour = _neighbours(maps, centre)
    now = np.median(_distance(maps, section[centre], section[neighbour]))
    images = _distance(maps, section[centre + 1], section[neighbour + 1])
    if np.median(images) > UNPREDICTED * apart:
        raise ValueError(
            f"section: images of neighbouring points {np.median(images) / apart:.0%} as far apart as any two points "
            "are not allowed; no return map is to be seen. A wrong frequency, or noise as large as the motion, is "
            "suspected."
        )
    later = np.median(_distance(maps, section[centre + PARTING_STEPS], section[neighbour + PARTING_STEPS]))
    if later < PARTED * now:
        raise ValueError(
            "section: a quasi-periodic motion is not allowed; neighbouring points stay together, so that it is not "
            "chaotic and shows no periodic orbits. Record it where it is chaotic."
        )


def _neighbours(maps: LocalMaps, centre: np.ndarray) -> np.ndarray:
    """Return a near neighbour of each point that is not its neighbour in time and has a future."""
    _, index = maps.nearest(maps.arguments[centre], NEIGHBOUR + 2 * PARTING_STEPS)
    far = (np.abs(index - centre[:, None]) > PARTING_STEPS) & (index < len(maps.arguments) - PARTING_STEPS)
    rank = np.cumsum(far, axis=1)
    column = np.argmax(rank >= np.minimum(NEIGHBOUR, rank[:, -1:]), axis=1)
    return index[np.arange(len(centre)), column]


def _distance(maps: LocalMaps, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(maps.wrap(one - other)).max(axis=1)


DEGREE = 2
# Neighbours of all fits together.
MOST_NEIGHBOURS = 6_000_000


class Atlas:
    """Quadratic polynomials of the return map about points of the section, each good as far as its neighbours lie.

    Parameters
    ----------
    maps : LocalMaps
    count : int
        Neighbours of each fit.
    """

    def __init__(self, maps: LocalMaps, count: int):
        self._maps, self._count = maps, count
        every = -(-len(maps.arguments) * count // MOST_NEIGHBOURS)
        self._centres = maps.arguments[::every]
        fit = maps.fit(self._centres, count, DEGREE, influence=False)
        self._value, self._jacobian, self._hessian = fit.value, fit.jacobian, fit.hessian
        self._bandwidth = fit.bandwidth
        box = np.where(np.isfinite(maps.turn), maps.turn, 0.0)
        self._tree = cKDTree(maps.inside(self._centres), boxsize=box)

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return images (m, 2), derivatives (m, image, argument) and the bandwidth of the polynomials at points (m, 2).

        The bandwidth is infinite where a point lies farther from the nearest centre than that.
        """
        _, nearest = self._tree.query(self._maps.inside(points))
        away = self._maps.wrap(points - self._centres[nearest])
        curved = np.einsum("mijk,mk->mij", self._hessian[nearest], away)
        jacobian = self._jacobian[nearest]
        image = self._value[nearest] + np.einsum("mij,mj->mi", jacobian + 0.5 * curved, away)
        bandwidth = self._bandwidth[nearest]
        outside = np.sqrt(np.sum(away**2, axis=-1)) > bandwidth
        return image, jacobian + curved, np.where(outside, np.inf, bandwidth)

    def exactly(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same from fits about the points themselves."""
        fit = self._maps.fit(points, self._count, DEGREE, influence=False)
        return fit.value, fit.jacobian, fit.bandwidth
