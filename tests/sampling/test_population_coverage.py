"""Coverage of populations of normal units, and error rates of the membership test: simulation-based calibration."""

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

import bayesperiodic as bp
from bayesperiodic.sampling.membership import Expected, membership
from bayesperiodic.sampling.population_density import Hierarchy, PopulationDensity
from tests.sampling.gaussian_units import gaussian_units

SCALE = 0.2
PRIOR = bp.HalfNormal(SCALE)
# Units of a population; a hundred take minutes.
COUNTS = [
    *(pytest.param(count, marks=pytest.mark.slow) for count in (5, 20)),
    pytest.param(100, marks=pytest.mark.campaign),
]


def grid_draws(density, count, generator):
    """Return draws (count, 2) of mean and ln spread from splines of their log-density, located on a coarse grid."""
    centre, width = density.start[0][0], density.start[1][0]
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
