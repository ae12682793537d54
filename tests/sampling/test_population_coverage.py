"""Coverage of populations of normal units, and error rates of the membership test: simulation-based calibration."""

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from scipy.stats import binom

import bayesperiodic as bp
from bayesperiodic.sampling.membership import Expected, membership
from bayesperiodic.sampling.population_density import Hierarchy, PopulationDensity
from tests.sampling.gaussian_units import closed_form, gaussian_units

SCALE = 0.2
PRIOR = bp.HalfNormal(SCALE)
# Units of a population; a hundred take minutes.
COUNTS = [
    *(pytest.param(count, marks=pytest.mark.slow) for count in (5, 20)),
    pytest.param(100, marks=pytest.mark.campaign),
]


def grid_draws(density, count, generator):
    """Return draws (count, 2) of mean and ln spread from splines of their log-density, located on a coarse grid."""
    means = np.array([unit.mean[0] for unit in density.units])
    centre, width = means.mean(), (means.std() + 0.05) / np.sqrt(len(means))
    ends = np.array([[centre - 6.0 * width, centre + 6.0 * width], np.log([1e-3, 1.0])])
    for sizes in ((13, 11), (13, 13)):
        axes = [np.linspace(*pair, size) for pair, size in zip(ends, sizes, strict=True)]
        points = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=-1)
        log = density.evaluate(points).log_prob
        steps, inside = np.array([axis[1] - axis[0] for axis in axes]), points[log > log.max() - 11.0]
        ends = np.stack([inside.min(axis=0) - steps, inside.max(axis=0) + steps], axis=-1)
    spline = RectBivariateSpline(*axes, log.reshape(13, 13))
    fine = [np.linspace(axis[0], axis[-1], 97) for axis in axes]
    values = spline(*fine).ravel()
    points = np.stack([axis.ravel() for axis in np.meshgrid(*fine, indexing="ij")], axis=-1)
    weights = np.exp(values - values.max())
    chosen = generator.choice(len(points), count, p=weights / weights.sum())
    steps = np.array([axis[1] - axis[0] for axis in fine])
    return points[chosen] + steps * generator.uniform(-0.5, 0.5, (count, 2))


def one_population(count, seed, spread=None):
    """Return the ranks of true mean and spread among their draws, and p-values of a member and of a stranger."""
    generator = np.random.default_rng([seed, count])
    spread = float(PRIOR.sample(1, generator)[0]) if spread is None else spread
    sds = generator.uniform(0.05, 0.2, (count, 1))
    truths = 1.0 + spread * generator.standard_normal((count, 1))
    units = gaussian_units(truths + sds * generator.standard_normal(sds.shape), sds, seed)
    hierarchy = Hierarchy(("a",), (), {"a": PRIOR}, {"a": SCALE}, False, np.inf)
    density = PopulationDensity(hierarchy, [*units.values()], np.zeros((count, 0)))
    draws = grid_draws(density, 2000, generator)
    ranks = np.mean(draws[:, 0] < 1.0), np.mean(np.exp(draws[:, 1]) < spread)
    expected = Expected.of(hierarchy.parameters(draws), np.zeros(0), np.inf)
    p = []
    for shift in (0.0, 4.0):
        truth = 1.0 + spread * generator.standard_normal() + shift * np.hypot(spread, 0.1)
        new = gaussian_units(np.array([[truth + 0.1 * generator.standard_normal()]]), np.array([[0.1]]), seed + 7)
        test = membership("new", new["unit 1"], ("a",), expected, 0.05, seed)
        p.append(test.table.loc["a", "p"])
    return *ranks, *p


@pytest.mark.parametrize("count", COUNTS)
def test_coverage_and_false_alarms_over_200_populations(count):
    """The spread is drawn from its prior, so that 90 % intervals contain the truth in 90 % of the cases.

    Members are called different in 5 %. Of 200, each count leaves its 99.9 % band once in 1000.
    """
    mean, spread, member, stranger = np.array([one_population(count, seed) for seed in range(200)]).T
    for name, ranks in (("mean", mean), ("spread", spread)):
        inside = int(np.sum((ranks > 0.05) & (ranks < 0.95)))
        print(count, name, inside, int(np.sum((ranks > 0.25) & (ranks < 0.75))))
        assert 166 <= inside <= 193  # scipy.stats.binom(200, 0.9).ppf([5e-4, 0.9995])
        assert 77 <= np.sum((ranks > 0.25) & (ranks < 0.75)) <= 123
    print(count, "false alarms", int(np.sum(member < 0.05)), "power", float(np.mean(stranger < 0.05)))
    assert np.sum(member < 0.05) <= 22
    assert np.mean(stranger < 0.05) > (0.3 if count == 5 else 0.8)


@pytest.mark.parametrize("count", COUNTS)
def test_no_spread_leaves_the_mean_unbiased_and_the_spread_bounded(count):
    """Without any spread, 90 % intervals of the mean are at least as wide as they should be."""
    mean, spread, *_ = np.array([one_population(count, seed, 0.0) for seed in range(100)]).T
    print(count, "no spread", int(np.sum((mean > 0.05) & (mean < 0.95))))
    assert np.sum((mean > 0.05) & (mean < 0.95)) >= 80  # below once in 1000 at 90 %
    assert abs(np.mean(mean) - 0.5) < 0.11


NAMES, TRUE_MEAN, DRAWS = ("a", "b"), 1.0, 1000
SLOPE_SCALE = float(PRIOR.quantile(np.array(0.6827)))
HIERARCHY = Hierarchy(NAMES, ("day",), dict.fromkeys(NAMES, PRIOR), dict.fromkeys(NAMES, SLOPE_SCALE), True, np.inf)
# Edges of the cells of ln spread and of the correlation.
CELLS = np.linspace(*np.log([1e-3, 1.2]), 25), np.linspace(*np.log([1e-3, 1.2]), 25), np.linspace(-1.0, 1.0, 17)


def covariances(values):
    """Return matrices (g, 2, 2) of ln spreads and correlations (g, 3)."""
    first, second = np.exp(values[:, :2]).T
    off = values[:, 2] * first * second
    return np.moveaxis(np.array([[first**2, off], [off, second**2]]), -1, 0)


def weighted_draws(density, estimates, variances, days, generator):
    """Return draws (draws, coordinates) of the normal linear model, and weights by which they are of the density.

    Spreads and correlation are drawn from cells that have their probability at the centre, means and slopes then from
    their normal distribution.
    """
    design = np.stack([np.concatenate([np.eye(2), day * np.eye(2)], axis=1) for day in days])
    model = estimates, variances, design, np.array([0.0, 0.0, SLOPE_SCALE**-2, SLOPE_SCALE**-2])
    centres = [0.5 * (edges[1:] + edges[:-1]) for edges in CELLS]
    cells = np.stack([axis.ravel() for axis in np.meshgrid(*centres, indexing="ij")], axis=-1)
    log = closed_form(*model, covariances(cells))[0]
    log += np.sum(PRIOR.log_prob(np.exp(cells[:, :2])) + cells[:, :2], axis=1)
    share = np.exp(log - log.max())
    row = generator.choice(len(cells), DRAWS, p=share / share.sum())
    steps = np.array([edges[1] - edges[0] for edges in CELLS])
    values = cells[row] + steps * generator.uniform(-0.5, 0.5, (DRAWS, 3))
    _, mean, covariance = closed_form(*model, covariances(values))
    noise = generator.standard_normal((DRAWS, 4))
    root = np.linalg.cholesky(covariance)
    points = np.column_stack(
        [mean + np.einsum("gij,gj->gi", root, noise), values[:, :2], np.arctanh(values[:, 2])]
    )  # fmt: skip
    proposed = np.log(share[row]) - 0.5 * np.sum(noise**2, axis=1) - np.log(np.linalg.det(root))
    log = density.evaluate(points).log_prob - proposed - np.log(1.0 - values[:, 2] ** 2)
    weights = np.exp(log - log.max())
    return points, weights / weights.sum()


def one_structure(count, seed, *, without_spread=False):
    """Return the ranks (coordinates,) of the true means, slopes, spreads and correlation, and the effective draws.

    All but the means are drawn from their priors; the spreads are zero if there is none.
    """
    generator = np.random.default_rng([seed, count, 2])
    slopes, correlation = SLOPE_SCALE * generator.standard_normal(2), generator.uniform(-1.0, 1.0)
    spreads = np.zeros(2) if without_spread else PRIOR.sample(2, generator)
    between = np.outer(spreads, spreads) * [[1.0, correlation], [correlation, 1.0]]
    days = np.linspace(-1.0, 1.0, count)
    days /= days.std()
    sds = generator.uniform(0.05, 0.2, (count, 2))
    truths = TRUE_MEAN + days[:, None] * slopes + generator.multivariate_normal(np.zeros(2), between, count)
    estimates = truths + sds * generator.standard_normal(sds.shape)
    density = PopulationDensity(HIERARCHY, [*gaussian_units(estimates, sds, seed).values()], days[:, None])
    variances = sds[:, :, None] ** 2 * np.eye(2)
    points, weights = weighted_draws(density, estimates, variances, days, generator)
    with np.errstate(divide="ignore"):
        truth = np.array([TRUE_MEAN, TRUE_MEAN, *slopes, *np.log(spreads), np.arctanh(correlation)])
    return weights @ (points < truth), 1.0 / np.sum(weights**2)


@pytest.mark.parametrize(
    ("count", "populations"),
    [
        pytest.param(5, 50, marks=pytest.mark.slow),
        *(pytest.param(count, 200, marks=pytest.mark.campaign) for count in (5, 20, 100)),
    ],
)
def test_coverage_of_slopes_spreads_and_correlation(count, populations):
    """Intervals of 90 and 50 % contain the truth as often as they should: simulation-based calibration.

    One of the 14 counts leaves its band by chance once in 100; the seeds are fixed.
    """
    results = [one_structure(count, seed) for seed in range(populations)]
    ranks, effective = np.array([rank for rank, _ in results]), [number for _, number in results]
    print(f"{count} units, {populations} populations; effective draws {min(effective):.0f} to {max(effective):.0f}")
    assert np.quantile(effective, 0.05) > 50
    for level in (0.9, 0.5):
        inside = np.sum(abs(ranks - 0.5) < 0.5 * level, axis=0)
        low, high = binom(populations, level).ppf(np.array([0.0, 1.0]) + np.array([0.5, -0.5]) * 0.01 / 14)
        single = binom(populations, level).ppf([0.005, 0.995])
        counts = ", ".join(f"{label} {number}" for label, number in zip(HIERARCHY.labels, inside, strict=True))
        print(f"  {100 * level:.0f} % intervals (99 % band {single[0]:.0f} to {single[1]:.0f}): {counts}")
        assert low <= inside.min() and inside.max() <= high


@pytest.mark.campaign
@pytest.mark.parametrize("count", [5, 20])
def test_without_spread_intervals_of_means_and_slopes_contain_the_truth_at_least_as_often(count):
    """One of the four counts is lower than nominal by chance once in 100."""
    ranks = np.array([one_structure(count, seed, without_spread=True)[0] for seed in range(200)])[:, :4]
    inside, low = np.sum(abs(ranks - 0.5) < 0.45, axis=0), binom(200, 0.9).ppf(0.01 / 4)
    print(f"{count} units without spread, 90 % intervals (at least {low:.0f}): {inside.tolist()}")
    assert inside.min() >= low
