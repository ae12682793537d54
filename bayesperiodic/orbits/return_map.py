"""Local polynomial regression of the return map, corrected for noise in its arguments.

All coordinates are in units of the attractor's size.
"""

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaincc

from bayesperiodic.orbits.normal_equations import (
    NormalEquations,
    deconvoluted,
    monomials,
    terms_of,
)

# Fewest neighbours of a fit of given bandwidth.
FEWEST_FITTED = 30
# Neighbours are used up to this many bandwidths, where the kernel is 1.1 % of its maximum.
KERNEL_REACH = 3.0
# Largest noise as a fraction of the bandwidth; deconvolution needs less than one.
MOST_NOISE = 0.75
# Prior standard deviation of slopes, in more than two coordinates: there the attractor is thin in some directions, and
# does not determine all coefficients. From so many coordinates on, that of a map over a part of a return is the root:
# it stretches less, and the motion needs no steep slopes where coordinates are redundant. Three delays do need them.
STEEPEST_SLOPE, REDUNDANT = 10.0, 4
# Largest distance from the nearest centre of an atlas, in bandwidths, with up to two coordinates and with more.
FARTHEST_FROM_CENTRE = {2: 1.0, 3: 2.0}
# Distance of two phases in a search tree, in units of the attractor's size.
APART = 1e3
# What follows neighbours (n, values): of their positions (n,) among the arguments and the points (n, d) themselves.
Signals = Callable[[np.ndarray, np.ndarray], np.ndarray]
# Limits of memory: products of regressors in one call, neighbours of all fits of an atlas.
MOST_PRODUCTS, MOST_NEIGHBOURS = 4_000_000, 6_000_000


def for_coordinates(values: dict[int, float], coordinates: int) -> float:
    """Return the value for the number of coordinates."""
    return values[min(max(coordinates, 2), 3)]


class LocalFit(NamedTuple):
    """Polynomials of the return map about m centres, in d coordinates."""

    value: np.ndarray  # image of the centre, angles continuous from the centre, (m, d)
    derivatives: np.ndarray  # of the image by the argument: order 0 (relative), u, v, …, uu, uv, …, (m, terms, d)
    bandwidth: np.ndarray  # (m,)
    neighbours: np.ndarray  # positions among the arguments, (m, n)
    influence: np.ndarray  # contribution of each neighbour to the error of the value and slopes, (m, n, 1 + d, d)
    effective: np.ndarray  # effective number of neighbours, (m,)

    @property
    def jacobian(self) -> np.ndarray:
        """Derivatives of the image by the argument, (m, image, argument)."""
        return self.derivatives[:, 1 : 1 + self.value.shape[1]].transpose(0, 2, 1)

    @property
    def hessian(self) -> np.ndarray:
        """Second derivatives (m, image, argument, argument); zero for linear fits."""
        m, terms, d = self.derivatives.shape
        if terms <= 1 + d:
            return np.zeros((m, d, d, d))
        one, other = np.triu_indices(d)
        place = np.empty((d, d), dtype=int)
        place[one, other] = place[other, one] = 1 + d + np.arange(one.size)
        return np.ascontiguousarray(self.derivatives[:, place].transpose(0, 3, 1, 2))


class Regression(NamedTuple):
    """Channels that follow a point, fitted to what follows its n neighbours, in d coordinates."""

    value: np.ndarray  # (times, channels)
    slopes: np.ndarray  # by the coordinates, (d, times, channels)
    influence: np.ndarray  # contribution of each neighbour to the error of `value`, (n, times, channels)
    weights: np.ndarray  # of each neighbour in `value`, (n, channels)
    neighbours: np.ndarray  # positions among the arguments, (n,)


def _regression(
    system: NormalEquations, reference: np.ndarray, target: np.ndarray, influence: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return value, slopes, influence and weights of a channel, targets (1, n, times) less a reference (times,)."""
    solution, times, d = system.solve(target), target.shape[2], system.terms.powers.shape[1]
    derivatives = (solution * system.scale)[0]
    weights = (system.inverse @ system.regressors)[0, 0]
    errors = np.empty((0, times))
    if influence:
        errors = system.influence(target, solution, np.ones((times, 1)), np.eye(times))[0].T
    return reference + derivatives[0], derivatives[1 : 1 + d], errors, weights


class ReturnMap:
    """The return map of a section, fitted locally on request.

    It may consist of several steps a return, each from one phase to the next: a map that stretches less is closer to a
    polynomial. Position n belongs to the phase n modulo the number of steps.

    Neighbours are weighted by a Gaussian kernel. The normal equations are sums of the kernel times powers of noise-free
    arguments. For normal noise in the arguments, of known variance below the kernel's, there are functions of the noisy
    arguments with exactly these expectations: a narrower Gaussian times Hermite polynomials, the deconvoluting kernels
    of J. Fan, Y. K. Truong, Nonparametric regression with errors in variables, Annals of Statistics 21, 1993. They make
    the normal equations unbiased and so remove the attenuation of the slopes.
    """

    def __init__(
        self, points: np.ndarray, increments: np.ndarray, turn: np.ndarray, winds: bool, noise: np.ndarray,
        stretches: np.ndarray | None = None, steps: int = 1, noises: np.ndarray | None = None,
    ):  # fmt: skip
        self.steps = steps
        self._steepest = STEEPEST_SLOPE ** (1.0 / steps if len(turn) >= REDUNDANT else 1.0)
        self.points = points  # in the order of time, (count, d)
        # Number of each point's unbroken stretch, (count,).
        self.stretches = np.zeros(len(points), dtype=np.int64) if stretches is None else stretches
        # Images are unknown where increments are NaN or missing at the end.
        self.positions = np.flatnonzero(np.isfinite(increments).all(axis=1))  # of points with a known image, (n,)
        self.arguments = points[self.positions]  # points with a known image, (n, d)
        self.increments = increments[self.positions]  # image minus argument, (n, d)
        self.turn = turn  # one turn in these units; infinite for coordinates that are not angles, (d,)
        self.winds = winds  # whether the increments of angles include whole turns
        self.noise = noise  # standard deviation of the arguments, (d,)
        self._noises = None if noises is None else noises[self.positions]  # of each, where they differ, (n, d)
        self.angle = np.isfinite(turn)
        self._angles = np.flatnonzero(self.angle).tolist()
        self.count = len(self.arguments) // steps  # of points of each phase
        self._tree = self.tree(self.arguments, self.phases(self.positions))

    def without(self, left_out: np.ndarray) -> "ReturnMap":
        """Return the map without some of the arguments (n,)."""
        kept, noises = self.positions[~left_out], None
        increments = np.full((len(self.points) - 1, self.points.shape[1]), np.nan)
        increments[kept] = self.increments[~left_out]
        if self._noises is not None:
            noises = np.full(self.points.shape, np.nan)
            noises[kept] = self._noises[~left_out]
        return ReturnMap(self.points, increments, self.turn, self.winds, self.noise, self.stretches, self.steps, noises)

    def followed(self, steps: int) -> np.ndarray:
        """Return the positions of the points whose stretch contains the point `steps` later."""
        return np.flatnonzero(self.stretches[steps:] == self.stretches[:-steps])

    def phases(self, positions: np.ndarray) -> np.ndarray:
        """Return the phases (n,) of the points at these positions (n,)."""
        return positions % self.steps

    def tree(self, points: np.ndarray, phases: np.ndarray) -> cKDTree:
        """Return a search tree of points (n, d) at phases (n,), periodic in the angles."""
        return cKDTree(self.places(points, phases), boxsize=np.append(np.where(self.angle, self.turn, 0.0), 0.0))

    def places(self, points: np.ndarray, phases: np.ndarray) -> np.ndarray:
        """Return points (n, d) at phases (n,) as they are in a search tree, (n, d + 1)."""
        return np.column_stack([self.wrap_points(points), APART * phases])

    def wrap_points(self, points: np.ndarray) -> np.ndarray:
        """Return points with angles in [0, turn)."""
        inside = points % self.turn
        # The remainder of a tiny negative number is the turn itself, which the tree does not accept.
        return np.where(self.angle, np.where(inside >= self.turn, 0.0, inside), points)

    def wrap(self, difference: np.ndarray) -> np.ndarray:
        """Return differences (…, d) with angles in half a turn either way."""
        result = np.array(difference)
        for k in self._angles:
            column = result[..., k]
            column -= self.turn[k] * np.round(column / self.turn[k])
        return result

    def distance(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the largest coordinate differences (n,) of points (n, d)."""
        return np.abs(self.wrap(one - other)).max(axis=1)

    def nearest(self, centres: np.ndarray, phases: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and positions of the nearest arguments, (m, count) each."""
        distance, index = self._tree.query(self.places(centres, phases), np.arange(1, min(count, self.count) + 1))
        return np.asarray(distance), np.asarray(index)

    def as_wide_as_two(self, count: int) -> int:
        """Return how many neighbours have about the width that `count` neighbours have in two coordinates or more."""
        return count if len(self.turn) > 1 else max(count, int(np.sqrt(count * self.count)))

    def count_within(self, centres: np.ndarray, phases: np.ndarray, bandwidths: np.ndarray) -> np.ndarray:
        """Return the number of neighbours (m,) of fits about the centres (m, d) with the bandwidths (m,)."""
        radii = KERNEL_REACH * bandwidths
        return np.asarray(self._tree.query_ball_point(self.places(centres, phases), radii, return_length=True))

    def fit(
        self, centres: np.ndarray, phases: np.ndarray, count: int, degree: int, *, influence: bool = True,
        shrunk: bool = False,
    ) -> LocalFit:  # fmt: skip
        """Fit polynomials about the centres (m, d) to their `count` nearest neighbours; faster without `influence`.

        With more than two coordinates, `shrunk` reduces coefficients that the neighbours do not determine.
        """
        parts, size = [], max(1, MOST_PRODUCTS // (count * comb(len(self.turn) + 2 * degree, 2 * degree)))
        for k in range(0, len(centres), size):
            block = centres[k : k + size]
            distance, index = self.nearest(block, phases[k : k + size], count)
            bandwidths = distance[:, -1] / KERNEL_REACH
            parts.append(self._fit(block, bandwidths, index, np.array([True]), degree, influence, shrunk))
        return LocalFit(*map(np.concatenate, zip(*parts, strict=True)))

    def fit_within(
        self, centres: np.ndarray, phases: np.ndarray, bandwidths: np.ndarray, degree: int, *, influence: bool = True
    ) -> LocalFit:
        """Fit polynomials about the centres (m, d) with the bandwidths (m,), or larger ones where points are few.

        The neighbours are repeated to equal numbers, without influence.
        """
        index, inside, bandwidths = self._within(centres, phases, bandwidths, degree)
        return self._fit(centres, bandwidths, index, inside, degree, influence, shrunk=True)

    def _within(
        self, centres: np.ndarray, phases: np.ndarray, bandwidths: np.ndarray, degree: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the neighbours (m, n) of fits of given bandwidths, which are used, and the bandwidths (m,)."""
        fewest = max(FEWEST_FITTED, comb(len(self.turn) + degree, degree) * 3 // 2)
        distance, nearest = self.nearest(centres, phases, fewest)
        bandwidths = np.maximum(bandwidths, distance[:, -1] / KERNEL_REACH)
        near = self._tree.query_ball_point(self.places(centres, phases), KERNEL_REACH * bandwidths)
        counts = np.array([len(members) for members in near])[:, None]
        position = np.arange(counts.max() + 1)
        # The nearest comes first, and again in its place.
        inside = (position > 0) & (position <= counts)
        index = np.repeat(nearest[:, :1], len(position), axis=1)
        index[inside] = np.concatenate(near)
        return index, inside, np.maximum(bandwidths, np.max(self.noise) / MOST_NOISE)

    @staticmethod
    def predict(fit: LocalFit, away: np.ndarray) -> np.ndarray:
        """Return images (m, …, d) at displacements (m, …, d) from the centres."""
        _, terms, d = fit.derivatives.shape
        polynomials = terms_of(d, next(n for n in range(terms) if comb(d + n, n) == terms))
        products = np.stack([np.prod(away**power, axis=-1) for power in polynomials.powers[1:]], axis=-1)
        slopes = fit.derivatives[:, 1:] / polynomials.factorials[1:, None]
        shape = (len(away), *(1,) * (away.ndim - 2), d)
        return fit.value.reshape(shape) + np.einsum("m...t,mtc->m...c", products, slopes)

    def residual_variance(self, centres: np.ndarray, fit: LocalFit) -> np.ndarray:
        """Return the weighted residual variances (m, d) of the neighbours' images."""
        away = self.wrap(self.arguments[fit.neighbours] - centres[:, None])
        residual = away + self.increments[fit.neighbours] + centres[:, None] - self.predict(fit, away)
        residual = residual if self.winds else self.wrap(residual)
        weight = np.exp(-0.5 * np.sum(away**2, axis=-1) / fit.bandwidth[:, None] ** 2)
        free = np.maximum(fit.effective - fit.derivatives.shape[1], 1.0) / fit.effective
        return np.einsum("mn,mnc->mc", weight, residual**2) / weight.sum(1)[:, None] / free[:, None]

    def fit_to(
        self, centres: np.ndarray, bandwidths: np.ndarray, index: np.ndarray, inside: np.ndarray, degree: int
    ) -> LocalFit:
        """Fit polynomials about the centres (m, d) to those arguments of `index` (m, n) that are `inside` (m, n)."""
        return self._fit(centres, bandwidths, index, inside, degree, False, shrunk=True)

    def _fit(
        self, centres: np.ndarray, bandwidth: np.ndarray, index: np.ndarray, inside: np.ndarray, degree: int,
        wants_influence: bool, shrunk: bool = False,
    ) -> LocalFit:  # fmt: skip
        bandwidth = np.maximum(bandwidth, np.max(self.noise) / MOST_NOISE)
        away = self._away(centres, index)
        image, reference = self._images(away, index)
        system = self._system(away, bandwidth, index, inside, degree)
        system = system.shrunk(image, bandwidth, self._steepest) if shrunk else system
        solution, d = system.solve(image), away.shape[2]
        influence = np.empty((len(centres), 0, 1 + d, d))
        if wants_influence:
            each = np.repeat(np.eye(1 + d), d, axis=0), np.tile(np.eye(d), (1 + d, 1))
            influence = system.influence(image, solution, *each).reshape(len(centres), 1 + d, d, -1)
            influence = influence.transpose(0, 3, 1, 2)
        derivatives = solution * system.scale
        value = centres + reference + derivatives[:, 0]
        return LocalFit(value, derivatives, bandwidth, index, influence, system.effective)

    def regress(
        self, centres: np.ndarray, phases: np.ndarray, bandwidths: np.ndarray, degree: int, signals: Signals,
        sizes: np.ndarray, *, influence: bool = True,
    ) -> list["Regression"]:  # fmt: skip
        """Fit what follows the neighbours, as `fit_within` fits their images: the same neighbours and weights.

        `signals` returns it, (n, times, channels), for positions (n,) among the arguments and these points (n, d) near
        a centre. Residuals of each channel, in units of its size (channels,), determine its shrinkage, because a
        channel may have much more noise than the images. Faster without `influence`.
        """
        results = []
        for centre, phase, width in zip(centres[:, None], phases[:, None], bandwidths[:, None], strict=True):
            index, inside, bandwidth = self._within(centre, phase, width, degree)
            index, inside = index[:, inside[0]], inside[:, inside[0]]
            away = self._away(centre, index)
            system = self._system(away, bandwidth, index, inside, degree)
            motion = signals(index[0], centre + away[0])
            parts = []
            for channel, size in zip(np.moveaxis(motion, -1, 0), sizes, strict=True):
                reference, target = channel[0], (channel - channel[0])[None]
                part = system.shrunk(target / size, bandwidth, STEEPEST_SLOPE)
                parts.append(_regression(part, reference, target, influence))
            value, slopes, errors, weights = (np.stack(each, axis=-1) for each in zip(*parts, strict=True))
            results.append(Regression(value, slopes, errors, weights, index[0]))
        return results

    def _away(self, centres: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Return the displacements of arguments (m, n, d) from the centres (m, d)."""
        return self.wrap(self.arguments.take(index, axis=0) - centres[:, None])

    def _images(self, away: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return images of arguments (m, n, d) relative to one of them, and that one (m, d) relative to the centre."""
        image = self.increments.take(index, axis=0)
        image += away
        reference = image[:, :1].copy()
        image -= reference
        return image if self.winds else self.wrap(image), reference[:, 0]

    def _system(
        self, away: np.ndarray, bandwidth: np.ndarray, index: np.ndarray, inside: np.ndarray, degree: int
    ) -> NormalEquations:
        """Return the normal equations of fits."""
        width = bandwidth[:, None, None]
        noise = self.noise if self._noises is None else np.minimum(self._noises[index], MOST_NOISE * width)
        by_coordinate = deconvoluted(away / width, noise / width, 2 * degree)
        by_coordinate[0] *= inside[:, None]
        return NormalEquations.of(by_coordinate, bandwidth, degree)


class Atlas:
    """Quadratic polynomials of the return map about points of the section, from `count` neighbours each."""

    def __init__(self, maps: ReturnMap, count: int):
        self._maps, self._count = maps, count
        every = -(-len(maps.arguments) * count // MOST_NEIGHBOURS)
        kept = maps.positions // maps.steps % every == 0
        self._centres, phases = maps.arguments[kept], maps.phases(maps.positions[kept])
        self._fit = maps.fit(self._centres, phases, count, 2, influence=False, shrunk=True)
        self._hessian = self._fit.hessian
        self._tree = maps.tree(self._centres, phases)

    def at(self, points: np.ndarray, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return images (m, d), derivatives (m, image, argument) and bandwidths (m,) at points (m, d).

        The bandwidth is infinite where a point is farther from the nearest centre than that.
        """
        _, nearest = self._tree.query(self._maps.places(points, phases))
        away = self._maps.wrap(points - self._centres[nearest])
        curved = np.einsum("mijk,mk->mij", self._hessian[nearest], away)
        jacobian = self._fit.jacobian[nearest]
        image = self._fit.value[nearest] + np.einsum("mij,mj->mi", jacobian + 0.5 * curved, away)
        bandwidth = self._fit.bandwidth[nearest]
        outside = np.sqrt(np.sum(away**2, axis=-1)) > for_coordinates(FARTHEST_FROM_CENTRE, points.shape[1]) * bandwidth
        return image, jacobian + curved, np.where(outside, np.inf, bandwidth)

    def exactly(self, points: np.ndarray, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same from fits about the points themselves."""
        fit = self._maps.fit(points, phases, self._count, 2, influence=False, shrunk=True)
        return fit.value, fit.jacobian, fit.bandwidth


NOISE_CENTRES, NOISE_ROUNDS = 600, 8
# Smallest bandwidth of a quadratic return map, in standard deviations of the noise.
SMALLEST_BANDWIDTH = 4.0


def estimate_noise(maps: ReturnMap, neighbours: int) -> np.ndarray:
    """Return the standard deviations (d,) of independent errors of the coordinates, from maps of one step.

    Where the return map is quadratic, the residual variance of an image is the variance of its own error plus the
    propagated one of the argument's error. The densest neighbourhoods are used, where curvature matters least, and
    widened until they are large compared with the noise.
    """
    from scipy.optimize import nnls

    centres = maps.arguments[:: max(1, len(maps.arguments) // NOISE_CENTRES)]
    d = maps.points.shape[1]
    noise, count = np.zeros(d), int(2.25 * neighbours)
    for _ in range(3):
        width = maps.nearest(centres, np.zeros(len(centres)), count)[0][:, -1]
        dense = centres[width <= np.median(width)]
        fit = maps.fit(dense, np.zeros(len(dense)), count, 2, influence=False)
        rows = (np.eye(d) + fit.jacobian**2).reshape(-1, d)
        target = maps.residual_variance(dense, fit).reshape(-1)
        weight = 1.0 / np.maximum(target, 1e-30)
        for _ in range(NOISE_ROUNDS):
            variance, _ = nnls(rows * weight[:, None], target * weight)
            predicted = rows @ variance
            # Residuals far above the prediction are curvature, not noise.
            weight = np.where(target < 4.0 * predicted, 1.0, 0.0) / np.maximum(predicted, 1e-30)
        noise = np.sqrt(variance)
        if np.median(width) / KERNEL_REACH > SMALLEST_BANDWIDTH * noise.max() or count * 2 > len(maps.arguments) // 8:
            break
        count *= 2
    return noise


LONGEST_PERIOD = 32
# As fractions of the median distance between two random points: points that coincide, unpredictable images. Points also
# coincide within this many standard deviations of the noise.
SAME_POINT, UNPREDICTED, SAME_NOISE = 0.05, 0.08, 2.0
# Noise of this part of the error of predictions explains it.
NOISE_EXPLAINS = 0.75
# Neighbours of a prediction, as a multiple of the number of terms.
PREDICTING = 1.5
# Median of the absolute value of a standard normal number.
NORMAL_MEDIAN = 0.6745
# Neighbours that diverge by less than this factor in this many steps show no chaos.
DIVERGED, DIVERGING_STEPS = 2.5, 6
DIVERGING_PROBES = 400
NEIGHBOUR = 8
# Points of a cell of the test for a trend in time, as a multiple of the number of terms; relative size of columns that
# depend on others.
POINTS_OF_TREND, DEPENDENT = 15, 1e-9
# Fewest points from which as many returns as needed are in their stretch.
FEWEST_FOLLOWED = 100


def check_chaos(maps: ReturnMap, remedy: Callable[[float], str]) -> tuple[float, float]:
    """Raise a ValueError, which names the kind of motion, unless the points show a chaotic return map.

    Returns the error of predictions by local maps and the part of noise in it, as fractions of the distance of random
    points. `remedy` returns which coordinate to add where the points do not determine the next ones.
    """
    section, d, generator = maps.points, maps.points.shape[1], np.random.default_rng(0)
    starts = maps.followed(DIVERGING_STEPS + 1)
    if starts.size < FEWEST_FOLLOWED:
        raise ValueError(
            f"section: must have at least {FEWEST_FOLLOWED} points with {DIVERGING_STEPS + 1} returns in their "
            f"unbroken stretch, to show whether neighbours diverge, got {starts.size}. Record longer pieces, or "
            "without gaps."
        )
    one, other = generator.integers(len(section), size=(2, 4 * DIVERGING_PROBES))
    apart = maps.distance(section[one], section[other])
    # Half of the distances of a motion of period 2 are zero, so that their median may be.
    coincide = SAME_POINT * max(np.median(apart), np.mean(apart))
    same = max(coincide, SAME_NOISE * float(maps.noise.max()))
    for period in range(1, min(LONGEST_PERIOD, len(section) // 10) + 1):
        back = maps.followed(period)
        if back.size < FEWEST_FOLLOWED:
            break
        if (away := np.median(maps.distance(section[back + period], section[back]))) < same:
            noisy, choose = "", ""
            if away > coincide:
                noisy = ", or points that differ by little more than their noise"
                choose = ", or coordinates that vary more, by other delays or another level"
            raise ValueError(
                f"section: must be of a chaotic motion, got one of period {period}{noisy}. Use recording.fold with "
                f"periods={period} instead{choose}."
            )
    probes = min(DIVERGING_PROBES, len(section) // 4, starts.size)
    centre, neighbour = _neighbours(maps, starts[generator.choice(starts.size, probes, replace=False)])
    now = np.median(maps.distance(section[centre], section[neighbour]))
    error, from_noise = prediction_error(maps)
    if error > UNPREDICTED:
        advice = (
            f"{remedy(error)} Otherwise check for a wrong frequency or level, and for noise as large as the motion."
        )
        if from_noise > NOISE_EXPLAINS * error:
            advice = (
                "The noise is too large: sample faster, record with less noise, or choose coordinates with less, such "
                "as a delay at which the channel is near a maximum or, of crossings, the interval."
            )
        raise ValueError(
            f"section: must show a return map, got images that local maps of {d} coordinate{'s' * (d > 1)} "
            f"predict with errors of {error:.0%} of the distance of random points, {from_noise:.1%} from known noise. "
            f"{advice}"
        )
    later = np.median(maps.distance(section[centre + DIVERGING_STEPS], section[neighbour + DIVERGING_STEPS]))
    if later < DIVERGED * now:
        raise ValueError(
            "section: must be of a chaotic motion, got a quasi-periodic one, whose neighbouring points do not diverge. "
            "Record the system where it is chaotic."
        )
    return error, from_noise


def prediction_error(maps: ReturnMap) -> tuple[float, float]:
    """Return the median error with which local maps predict images, and what known noise contributes to it.

    Both as fractions of the median distance of random points. Maps are linear or quadratic, whichever predicts better,
    from neighbours distant in time. Where the coordinates determine the next point, errors fall to the noise as
    neighbours come closer; where they do not, they are as large as the effect of the unknown states.
    """
    generator, d = np.random.default_rng(0), maps.points.shape[1]
    one, other = generator.integers(len(maps.arguments), size=(2, 4 * DIVERGING_PROBES))
    random = np.median(maps.distance(maps.arguments[one], maps.arguments[other]))
    some = generator.choice(len(maps.arguments), min(DIVERGING_PROBES, len(maps.arguments)), replace=False)
    centres, positions, phases = maps.arguments[some], maps.positions[some], np.zeros(some.size)
    results = []
    for degree in (1, 2):
        count = maps.as_wide_as_two(int(PREDICTING * comb(d + degree, degree)) + 2 * DIVERGING_STEPS + 1)
        distance, index = maps.nearest(centres, phases, count)
        away = np.abs(maps.positions[index] - positions[:, None]) > DIVERGING_STEPS
        fit = maps.fit_to(centres, distance[:, -1] / KERNEL_REACH, index, away, degree)
        error = maps.distance(fit.value, centres + maps.increments[some])
        variance = maps.noise**2 + np.einsum("mij,j->mi", fit.jacobian**2, maps.noise**2)
        expected = NORMAL_MEDIAN * np.median(np.sqrt(variance.max(1)))
        results.append((float(np.median(error) / random), float(expected / random)))
    return min(results)


def change_in_time(maps: ReturnMap) -> float:
    """Return the p-value of a test of maps of one step for a trend in time, which drifting parameters cause.

    The arguments are divided into cells. In each, time is a further regressor of the images beside a quadratic
    polynomial. The fraction of its variance that goes with the residuals has a beta distribution without a trend; the
    sum over all cells is compared with a gamma distribution of its mean and variance. Points of a cell are distant in
    time from each other. A map that is not quadratic in the cells leaves residuals, but none that go with time.
    """
    powers = monomials(maps.points.shape[1], 2)
    total = mean = variance = 0.0
    for cell in _cells(maps.wrap_points(maps.arguments), 2 * POINTS_OF_TREND * len(powers)):
        time = maps.positions[cell]
        kept = [0]
        for k in range(1, time.size):
            if time[k] - time[kept[-1]] > DIVERGING_STEPS:
                kept.append(k)
        members, time = cell[None, kept], time[kept]
        away = maps._away(maps.arguments[members[0, :1]], members)
        image = maps._images(away, members)[0][0]
        near = away[0] - away[0].mean(axis=0)
        near /= np.maximum(np.abs(near).max(axis=0), np.finfo(float).tiny)
        terms = _orthonormal(np.stack([np.prod(near**power, axis=1) for power in powers], axis=1))
        late = time - terms @ (terms.T @ time)
        residual = _orthonormal(image - terms @ (terms.T @ image))
        free, count = time.size - terms.shape[1], residual.shape[1]
        if free <= count + 2 or not count:
            continue
        total += free * float(np.sum((residual.T @ late) ** 2) / np.sum(late**2))
        mean, variance = mean + count, variance + 2.0 * count * (free - count) / (free + 2.0)
    return float(gammaincc(mean**2 / variance, total * mean / variance)) if variance else 1.0


def _cells(points: np.ndarray, most: int) -> list[np.ndarray]:
    """Return the positions of points (n, d) in cells of less than so many, halved along the widest coordinate."""
    done, waiting = [], [np.arange(len(points))]
    while waiting:
        cell = waiting.pop()
        if cell.size < most:
            done.append(np.sort(cell))
            continue
        inside = points[cell]
        order = np.argsort(inside[:, np.argmax(np.ptp(inside, axis=0))], kind="stable")
        waiting += [cell[order[: cell.size // 2]], cell[order[cell.size // 2 :]]]
    return done


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of columns (n, k), those that depend on others left out."""
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return basis[:, sizes > DEPENDENT * sizes[0]]


def _neighbours(maps: ReturnMap, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points and a neighbour of each that is distant in time and has later points, where there is one."""
    _, index = maps.nearest(maps.points[centre], np.zeros(len(centre)), NEIGHBOUR + 2 * DIVERGING_STEPS)
    near = maps.positions[index]
    far = (np.abs(near - centre[:, None]) > DIVERGING_STEPS) & np.isin(near, maps.followed(DIVERGING_STEPS + 1))
    rank = np.cumsum(far, axis=1)
    column = np.argmax(rank >= np.minimum(NEIGHBOUR, rank[:, -1:]), axis=1)
    some = far.any(axis=1)
    return centre[some], near[some, column[some]]
