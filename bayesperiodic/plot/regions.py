"""Densities of draws of one or two quantities, and the levels of the regions of a given probability.

The kernel estimate is made in the coordinates of the sampler (logarithms of positive quantities), for pairs with the
linear correlation removed, and mapped back to natural values. Kernels are narrower where there are more draws
(Abramson, Ann. Stat. 10 (1982) 1217). Their width minimises the squared error that one half of the draws estimates for
the density of the other (least-squares cross-validation). The cosine transform reflects the kernels at the ends of the
support. The density at the level is exceeded by the density at exactly the fraction of the draws.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from scipy.fft import dctn, idctn
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates

Support = tuple[float, float]

# Nodes per axis: of the first mesh, and where kernels would be narrower than RESOLVED of its cells.
FIRST_NODES, FINE_2D, RESOLVED = 256, 1024, 3.0
FINE_1D = 8192
# Draws beyond these quantiles widen no mesh; half-widths of the kernels that are tried, in cells and in sds.
MESH_QUANTILES, MESH_ROOM, NARROWEST_KERNEL, WIDEST_KERNEL, KERNEL_WIDTHS = (0.0003, 0.9997), 0.08, 0.7, 0.6, 32
# Cross-validation is noisy: the widest kernel with an error larger by this fraction of ∫f² is as good, for n draws the
# larger one of the first number and the second times n to the power of the third.
SCORE_TOLERANCE = 0.001, 2.0, -0.8
# Factors on the width of the kernels, where the density is high and low.
KERNEL_FACTORS = np.geomspace(0.7, 10.0, 8)
# Half-width [sds] that no kernel in the tails exceeds, unless all do: wider ones would pile up at the ends of the mesh.
IN_TAILS = 0.3
# Ends of supports that are nearer than this many sds to a draw are edges of the mesh.
NEAR_EDGE = 0.5
# Quantiles, and their ratio below which the density of a positive quantity does not vanish at zero.
LOWEST_QUANTILES, VANISHING_RATIO, RIDGE_CORRELATION = (0.002, 0.02), 0.2, 0.9
# Points of the curve that is the trend of one quantity in the other, and the sd about it, relative to that about a
# line, below which it is removed; distance of the ends of its extrapolation.
KNOTS, CURVED_RATIO, FAR_KNOT = 48, 0.3, 100.0
SMALLEST_DENSITY, LEAST_ROOM = float(np.finfo(float).tiny), 1e-9


@dataclass(frozen=True)
class Density:
    """Density of draws (n, k), k ≤ 2, on a mesh that is rectangular in the sampling coordinates only.

    `nodes` are the natural values at its nodes, one array per quantity; `at_draws` is the interpolated density.
    """

    nodes: list[np.ndarray]
    values: np.ndarray
    at_draws: np.ndarray

    def levels(self, probabilities: Sequence[float]) -> np.ndarray:
        """Return the density at the edges of the regions that contain these fractions of the draws."""
        return np.quantile(self.at_draws, 1.0 - np.asarray(probabilities), method="inverted_cdf")


def density(draws: np.ndarray, supports: Sequence[Support]) -> Density:
    """Return the density of draws (n, k), k = 1 or 2, in natural values; order: chain by chain."""
    chart = Chart.of(draws, supports)
    points = chart.inward(draws)
    estimate = KernelEstimate.of(points, chart.edges, FIRST_NODES)
    if estimate.cells < RESOLVED:
        estimate = KernelEstimate.of(points, chart.edges, FINE_2D if points.shape[1] == 2 else FINE_1D)
    axes, values = estimate.on_nodes(max(1, int(estimate.cells / RESOLVED)))
    nodes = chart.outward(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    values = values * chart.jacobian(nodes)
    at_draws = estimate.interpolated(points) * chart.jacobian(draws)
    return Density([nodes[..., k] for k in range(nodes.shape[-1])], values, at_draws)


@dataclass(frozen=True)
class Chart:
    """Map from natural values to standardised coordinates: logarithms, without the trend of one in the other."""

    supports: Sequence[Support]
    logarithmic: list[bool]
    order: list[int]
    centre: np.ndarray
    scale: np.ndarray
    trend: Callable[[np.ndarray], np.ndarray]
    edges: list[Support]

    @classmethod
    def of(cls, draws: np.ndarray, supports: Sequence[Support]) -> "Chart":
        """Return the chart of draws (n, k); the first coordinate depends on one quantity only, and can have edges."""
        logarithmic = _logarithmic(draws, supports)
        u = np.stack([_logarithm(x) if log else x for x, log in zip(draws.T, logarithmic, strict=True)], axis=-1)
        centre, scale = u.mean(axis=0), u.std(axis=0)
        scale = np.where(scale > 0.0, scale, np.maximum(np.abs(centre), 1.0))
        v = (u - centre) / scale
        edges = [
            _edges(v[:, k], (-np.inf, np.inf) if logarithmic[k] else (np.array(supports[k]) - centre[k]) / scale[k])
            for k in range(len(supports))
        ]
        order = sorted(range(len(supports)), key=lambda k: not np.isfinite(edges[k]).any())
        trend: Callable[[np.ndarray], np.ndarray] = np.zeros_like
        if len(order) == 2 and not np.isfinite(edges[order[1]]).any():
            choices = [order] if np.isfinite(edges[order[0]]).any() else [order, order[::-1]]
            trends = [_trend(v[:, one], v[:, other]) for one, other in choices]
            best = int(np.argmin([rest for _, rest in trends]))
            order, (trend, rest) = choices[best], trends[best]
            scale[order[1]] *= rest
        return cls(supports, logarithmic, order, centre[order], scale[order], trend, [edges[k] for k in order])

    def inward(self, x: np.ndarray) -> np.ndarray:
        """Return the coordinates (…, k) of natural values."""
        u = np.stack([_logarithm(x[..., k]) if self.logarithmic[k] else x[..., k] for k in self.order], axis=-1)
        v = (u - self.centre) / self.scale
        if len(self.order) == 2:
            v[..., 1] -= self.trend(v[..., 0])
        return v

    def outward(self, v: np.ndarray) -> np.ndarray:
        """Return the natural values (…, k) at coordinates, within the support."""
        v, x = v.copy(), np.empty(v.shape)
        if len(self.order) == 2:
            v[..., 1] += self.trend(v[..., 0])
        u = v * self.scale + self.centre
        for place, k in enumerate(self.order):
            x[..., k] = np.exp(u[..., place]) if self.logarithmic[k] else u[..., place]
            x[..., k] = np.clip(x[..., k], *self.supports[k])
        return x

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return |dv/dx| at natural values (…, k)."""
        slope = np.full(x.shape[:-1], 1.0 / np.prod(self.scale))
        for k, logarithmic in enumerate(self.logarithmic):
            if logarithmic:
                slope = slope / np.maximum(x[..., k], SMALLEST_DENSITY)
        return slope


def _logarithm(x: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(x, SMALLEST_DENSITY))


def _logarithmic(draws: np.ndarray, supports: Sequence[Support]) -> list[bool]:
    """Return which quantities to take in logarithms: positive ones whose density vanishes at 0, or with a ridge."""
    positive = [support == (0.0, np.inf) for support in supports]
    if len(positive) == 2 and all(positive):
        logarithms = _logarithm(draws).T
        if logarithms.std(axis=1).all() and abs(np.corrcoef(logarithms)[0, 1]) > RIDGE_CORRELATION:
            return positive
    few, more = np.quantile(draws, LOWEST_QUANTILES, axis=0)
    return [p and bool(one > VANISHING_RATIO * other) for p, one, other in zip(positive, few, more, strict=True)]


def _edges(v: np.ndarray, support: Sequence[float]) -> Support:
    """Return the ends of a support that are near to draws, infinite otherwise."""
    low, high = map(float, support)
    return low if v.min() - low < NEAR_EDGE else -np.inf, high if high - v.max() < NEAR_EDGE else np.inf


def _trend(x: np.ndarray, y: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Return the mean of y given x over the sd of the rest, and that sd: a line unless a curve explains much more."""
    slope = float(x @ y / max(x @ x, SMALLEST_DENSITY))
    straight = float((y - slope * x).std())
    members = np.array_split(np.argsort(x), min(KNOTS, max(1, len(x) // 50)))
    knots = np.array([[x[m].mean(), y[m].mean()] for m in members]).T
    knots = knots[:, np.flatnonzero(np.diff(knots[0], prepend=-np.inf) > 1e-6)]
    if knots.shape[1] > 3:
        first, last = knots[:, 0] - knots[:, 1], knots[:, -1] - knots[:, -2]
        far = [knots[:, 0] + FAR_KNOT * first / abs(first[0]), knots[:, -1] + FAR_KNOT * last / last[0]]
        curve = PchipInterpolator(*np.column_stack([far[0], knots, far[1]]))
        curved = float((y - curve(x)).std())
        if 0.0 < curved < CURVED_RATIO * straight:
            return (lambda t: curve(t) / curved), curved
    rest = straight if straight > 0.0 else 1.0
    return (lambda t: slope * t / rest), rest


@dataclass(frozen=True)
class KernelEstimate:
    """Kernel estimate on the cells of a rectangular mesh, with the width of its kernels [cells]."""

    starts: np.ndarray
    steps: np.ndarray
    values: np.ndarray
    cells: float

    @classmethod
    def of(cls, points: np.ndarray, edges: Sequence[Support], nodes: int) -> "KernelEstimate":
        """Return the estimate from points (n, k) on so many cells per axis."""
        low, high = np.quantile(points, MESH_QUANTILES, axis=0)
        room, given = MESH_ROOM * (high - low) + LEAST_ROOM, np.array(edges)
        ends = np.where(np.isfinite(given), given, np.stack([low - room, high + room], axis=-1))
        steps = (ends[:, 1] - ends[:, 0]) / nodes
        places = np.floor((points - ends[:, 0]) / steps).astype(int)
        inside = np.all((places >= 0) & (places < nodes), axis=1)
        counter, middle = _Counter(nodes, ends[:, 1] - ends[:, 0]), len(points) // 2
        halves = [counter.spectrum(places[part][inside[part]]) for part in (slice(middle), slice(middle, None))]
        widths = np.geomspace(NARROWEST_KERNEL * steps.max(), WIDEST_KERNEL, KERNEL_WIDTHS)
        scores = np.array([counter.score(halves, width) for width in widths])
        tolerance = max(SCORE_TOLERANCE[0], SCORE_TOLERANCE[1] * len(points) ** SCORE_TOLERANCE[2])
        width = float(widths[scores >= scores.max() - tolerance * abs(scores.max())].max())
        pilot = counter.counts(0.5 * (halves[0] + halves[1]) * counter.kernel(width))
        places = places[inside]
        at = np.maximum(pilot[tuple(places.T)], 1e-9 * pilot.max())
        factor = np.minimum(np.sqrt(at.mean() / at), max(IN_TAILS / width, 1.0))
        group = np.interp(np.log(factor), np.log(KERNEL_FACTORS), np.arange(KERNEL_FACTORS.size))
        whole = np.zeros(pilot.shape)
        for number, multiple in enumerate(KERNEL_FACTORS):
            weight = np.maximum(1.0 - np.abs(group - number), 0.0) / len(points)
            if weight.any():
                whole += counter.spectrum(places, weight) * counter.kernel(width * multiple)
        return cls(ends[:, 0], steps, counter.counts(whole) / np.prod(steps), width * KERNEL_FACTORS[0] / steps.max())

    @cached_property
    def padded(self) -> np.ndarray:
        """Values at the middles of the cells and the edges of the mesh."""
        return np.pad(self.values, 1, mode="edge")

    def on_nodes(self, every: int) -> tuple[list[np.ndarray], np.ndarray]:
        """Return coordinates by axis, and the values there: at the edges of the mesh and some middles of cells."""
        axes, values = [], self.padded
        for axis, (start, step, count) in enumerate(zip(self.starts, self.steps, self.values.shape, strict=True)):
            kept = np.unique([*range(0, count + 2, every), count + 1])
            axes.append(start + step * np.clip(kept - 0.5, 0.0, count))
            values = np.take(values, kept, axis)
        return axes, values

    def interpolated(self, points: np.ndarray) -> np.ndarray:
        """Return the values at points (n, k), zero outside the mesh."""
        count = np.array(self.values.shape)
        at = (points - self.starts) / self.steps
        inside = np.all((at >= 0.0) & (at <= count), axis=1)
        place = np.clip(at + 0.5, 0.5, count + 0.5)
        return np.where(inside, map_coordinates(self.padded, place.T, order=1, mode="nearest"), 0.0)


class _Counter:
    """Histograms on a mesh, as coefficients of cosines, and their smoothing."""

    def __init__(self, nodes: int, lengths: np.ndarray):
        self._shape = (nodes,) * len(lengths)
        self._frequencies = [np.pi * np.arange(nodes) / length for length in lengths]

    def spectrum(self, places: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Return the coefficients of the sums of weights per cell, by default of the fractions of draws."""
        flat = np.ravel_multi_index(tuple(places.T), self._shape)
        counts = np.bincount(flat, weights, minlength=int(np.prod(self._shape))).reshape(self._shape)
        return dctn(counts / (max(len(places), 1) if weights is None else 1.0), norm="ortho")

    def kernel(self, width: float) -> np.ndarray:
        """Return the transform of a normal kernel."""
        return reduce(np.multiply.outer, [np.exp(-0.5 * (width * k) ** 2) for k in self._frequencies])

    def counts(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the fractions per cell of a smoothed histogram."""
        return np.maximum(idctn(spectrum, norm="ortho"), 0.0)

    def score(self, halves: Sequence[np.ndarray], width: float) -> float:
        """Return minus the squared error of both halves' estimates for the density of the other, but for a constant."""
        kernel, (one, other) = self.kernel(width), halves
        return float(np.sum(kernel * (4.0 * one * other - kernel * (one**2 + other**2))))
