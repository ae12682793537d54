"""Regions of corner plots contain their share of the draws, and are as large as those of the true density."""

import warnings
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.contour import ContourSet
from scipy.stats import multivariate_normal, norm

import bayesperiodic as bp
from bayesperiodic.plot import regions
from bayesperiodic.posterior.parameters import support

COUNT = 20_000
REAL, POSITIVE = (-np.inf, np.inf), (0.0, np.inf)


def posterior_of(draws, supports=None, modes=None, units=None):
    """Return a posterior of given draws, by name, and their supports."""
    group = {}
    for name, values in draws.items():
        attributes = {"units": (units or {}).get(name, "m")}
        if supports is not None:
            attributes[f"support of {name}"] = list(supports[name])
        group[name] = (("chain", "draw"), np.reshape(values, (2, -1)), attributes)
    size = {"step": ("draw", np.arange(COUNT // 2) // 10), "walker": ("draw", np.arange(COUNT // 2) % 10)}
    data = xr.Dataset(group, coords={name: (dim, index[: data_size(group)]) for name, (dim, index) in size.items()})
    stats = {} if modes is None else {"mode": (("chain", "draw"), np.reshape(modes, (2, -1)))}
    numbers = dict.fromkeys(draws, 1.0)
    tree = xr.DataTree.from_dict({"posterior": data, "sample_stats": xr.Dataset(stats)})
    return bp.Posterior(tree, True, "made for a test", numbers, numbers, numbers, 0.5, {}, 1, 1)


def data_size(group):
    return next(iter(group.values()))[1].shape[1]


def quadrature_area(density, x, y, probability):
    """Return the area of the region of highest density with this probability, by the midpoint rule."""
    cell = (x[1] - x[0]) * (y[1] - y[0])
    values = np.sort(density(*np.meshgrid(x, y, indexing="ij")), axis=None)[::-1]
    shares = np.cumsum(values) * cell
    assert shares[-1] == pytest.approx(1.0, abs=1e-3)
    return np.searchsorted(shares, probability) * cell


def product_ridge(generator, spread, width):
    """Return a = exp(s), b = exp(w − s) for normal s and w; dA = exp(w) ds dw."""
    s, w = spread * generator.standard_normal(COUNT), width * generator.standard_normal(COUNT)
    x, y = np.linspace(-6 * spread, 6 * spread, 1501), np.linspace(-6 * width, 6 * width, 1501)
    across, along = np.meshgrid(x, y, indexing="ij")
    density = norm.pdf(across, scale=spread) * norm.pdf(along, scale=width) * np.exp(-along)
    order, cell = np.argsort(density, axis=None)[::-1], (x[1] - x[0]) * (y[1] - y[0])
    areas = np.exp(along).ravel()[order] * cell
    shares = np.cumsum(density.ravel()[order] * areas)

    def area(probability):
        return areas[: np.searchsorted(shares, probability)].sum()

    return np.stack([np.exp(s), np.exp(w - s)], axis=-1), area


def banana(generator, width):
    """Return x and y = x² + w; the map from the normal x and w keeps areas."""
    x, w = generator.standard_normal((2, COUNT))
    return np.stack([x, x**2 + width * w], axis=-1), lambda p: -2.0 * np.log(1.0 - p) * np.pi * width


def two_normals(generator, centres, sds):
    """Return draws of two normal distributions with round contours, each with half of the mass."""
    which = generator.integers(2, size=COUNT)
    points = np.array(centres)[which] + np.array(sds)[which, None] * generator.standard_normal((COUNT, 2))

    def density(x, y):
        at = np.stack([x, y], axis=-1)
        return sum(0.5 * multivariate_normal(c, s**2).pdf(at) for c, s in zip(centres, sds, strict=True))

    reach = [np.linspace(*ends, 1201) for ends in ((-6.0, 11.0), (-6.0, 6.0))]
    return points, lambda p: quadrature_area(density, *reach, p)


def mirrored(generator, sd):
    """Return two small normal distributions at (1, 1) and (−1, −1)."""
    sign = np.where(generator.integers(2, size=COUNT) == 1, 1.0, -1.0)
    points = sign[:, None] * (1.0 + sd * generator.standard_normal((COUNT, 2)))
    return points, lambda p: 2.0 * -2.0 * np.log(1.0 - p) * np.pi * sd**2


def truncated(generator, both):
    """Return half or a quarter of a normal distribution."""
    x, y = generator.standard_normal((2, COUNT))
    points = np.stack([np.abs(x), np.abs(y) if both else y + 0.5 * np.abs(x)], axis=-1)
    return points, lambda p: -2.0 * np.log(1.0 - p) * np.pi / (4 if both else 2)


def exponential(generator):
    """Return two exponential variables: the region is x + y < c, with 1 − (1 + c)·exp(−c) = p."""
    edges = {0.5: 1.678346990016661, 0.9: 3.889720169867429}
    return generator.exponential(size=(COUNT, 2)), lambda p: 0.5 * edges[p] ** 2


def correlated(generator, correlation):
    x, y = generator.standard_normal((2, COUNT))
    width = np.sqrt(1.0 - correlation**2)
    points = 5.0 + np.stack([x, correlation * x + width * y], axis=-1)
    return points, lambda p: -2.0 * np.log(1.0 - p) * np.pi * width


CASES = {
    "product ridge over one decade": (lambda g: product_ridge(g, 0.5, 0.02), POSITIVE, POSITIVE),
    "product ridge over three decades": (lambda g: product_ridge(g, 1.5, 0.002), POSITIVE, POSITIVE),
    "product ridge sampled in natural values": (lambda g: product_ridge(g, 0.5, 0.02), REAL, REAL),
    "banana": (lambda g: banana(g, 0.2), REAL, REAL),
    "thin banana": (lambda g: banana(g, 0.02), REAL, REAL),
    "two modes": (lambda g: two_normals(g, [(0.0, 0.0), (5.0, 1.0)], (1.0, 1.0)), REAL, REAL),
    "two modes of different widths": (lambda g: two_normals(g, [(0.0, 0.0), (5.0, 0.0)], (1.0, 0.2)), REAL, REAL),
    "mirrored sign": (lambda g: mirrored(g, 0.05), REAL, REAL),
    "mirrored sign, narrow": (lambda g: mirrored(g, 0.01), REAL, REAL),
    "truncated": (lambda g: truncated(g, both=False), (0.0, 9.0), REAL),
    "truncated twice": (lambda g: truncated(g, both=True), (0.0, np.inf), (0.0, 9.0)),
    "exponential": (exponential, POSITIVE, POSITIVE),
    "round": (lambda g: correlated(g, 0.0), REAL, REAL),
    "straight ridge": (lambda g: correlated(g, 0.9999), POSITIVE, POSITIVE),
}


def shoelace(polygon):
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


@pytest.mark.parametrize("case", CASES)
def test_regions_contain_their_share_of_the_draws_and_have_the_true_area(case):
    make, *supports = CASES[case]
    draws, area = make(np.random.default_rng(7))
    names = dict(zip("ab", draws.T, strict=True))
    figure = bp.plot.corner(posterior_of(names, dict(zip("ab", supports, strict=True))))
    filled = [c for c in figure.axes[2].collections if isinstance(c, ContourSet) and c.filled]
    for contours, probability, room in zip(filled, (0.9, 0.5), (0.15, 0.25), strict=True):
        (path,) = contours.get_paths()
        assert path.contains_points(draws).mean() == pytest.approx(probability, abs=0.01)
        found = abs(sum(map(shoelace, path.to_polygons())))
        print(
            f"MEASURED {case}: {probability:.0%}: inside {path.contains_points(draws).mean():.4f}, area {found / area(probability) - 1:+.3f}"
        )
        assert found == pytest.approx(area(probability), rel=room)


@pytest.mark.parametrize("case", ["truncated twice", "exponential", "round"])
def test_marginal_densities_reach_the_end_of_the_support(case):
    make, first, _ = CASES[case]
    draws, _ = make(np.random.default_rng(3))
    found = regions.density(draws[:, :1], [first])
    exact = {"truncated twice": lambda x: 2.0 * norm.pdf(x), "exponential": lambda x: np.exp(-x)}
    density = exact.get(case, lambda x: norm.pdf(x, 5.0))(found.nodes[0])
    assert np.abs(found.values - density).max() < 0.08 * density.max()
    assert np.trapezoid(found.values, found.nodes[0]) == pytest.approx(1.0, abs=0.01)
