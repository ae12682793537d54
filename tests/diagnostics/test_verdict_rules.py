"""Rules of the verdicts at their limits, on the quantiles of known distributions, whose batches do not differ."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

from bayesperiodic.diagnostics import verdicts
from bayesperiodic.diagnostics.verdicts import Sample, has_other_mode, marginal_verdict

MIDPOINTS = (np.arange(8000) + 0.5) / 8000
NORMAL = stats.norm.ppf(MIDPOINTS)
LINE = (-np.inf, np.inf)


def exact(values, size=1e9, batches=8):
    """Return a sample whose batches are all like the whole."""
    return Sample(values, np.tile(values, (batches, 1)), size, 2)


def verdict(mean=0.0, sd=1.0, support=LINE, size=1e6, draws=NORMAL, converged=True):
    """Return the verdict for draws in other units than those of the arguments."""
    ends = tuple(10.0 + 3.0 * end for end in support)
    return marginal_verdict(exact(10.0 + 3.0 * draws, size), 10.0 + 3.0 * mean, 3.0 * sd, ends, converged)


@pytest.mark.parametrize(
    ("mean", "sd", "expected"),
    [
        # An end at 1.645 sd is shifted by a quarter of the sd of the draws.
        (0.0, 1.0 - 0.26 / 1.645, "too narrow"),
        (0.0, 1.0 - 0.24 / 1.645, "fine"),
        (0.0, 1.0 + 0.24 / 1.645, "fine"),
        (0.0, 1.0 + 0.26 / 1.645, "too wide"),
        (0.24, 1.0, "fine"),
        (-0.24, 1.0, "fine"),
        (0.26, 1.0, "wrong shape"),
        (-0.26, 1.0, "wrong shape"),
        # Both ends by at least an eighth: 1.645 · 0.16 = 0.263.
        (0.135, 0.84, "too narrow"),
        (-0.135, 0.84, "too narrow"),
        (0.141, 0.84, "wrong shape"),
        (-0.141, 0.84, "wrong shape"),
        (0.135, 1.16, "too wide"),
        (-0.141, 1.16, "wrong shape"),
        (0.0, np.inf, "too wide"),
        (0.0, np.nan, "too wide"),
    ],
)
def test_verdict_on_a_normal_posterior(mean, sd, expected):
    assert verdict(mean, sd) == expected


@pytest.mark.parametrize(("distance", "expected"), [(4.73, "wrong mode"), (4.69, "wrong shape")])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_approximation_is_elsewhere_if_less_than_five_percent_are_within_three_sds(distance, sign, expected):
    """Φ(3 − 4.712) = 0.05 − 3 √(0.05 · 0.95/10⁴)."""
    assert stats.norm.cdf(3 - 4.712) == pytest.approx(0.05 - 3 * np.sqrt(0.05 * 0.95 / 1e4), abs=5e-5)
    assert verdict(mean=sign * distance, size=1e4) == expected


@pytest.mark.parametrize(("size", "expected"), [(5500.0, "fine"), (5900.0, "too narrow")])
def test_an_end_must_be_wrong_by_three_standard_errors(size, expected):
    """Φ(−1.645 · 0.8 − 0.25) = 0.0587, more than 0.05 by three errors √(0.05 · 0.95/n) from n = 5700 on."""
    beyond = stats.norm.cdf(-1.6448536 * 0.8 - 0.25)
    assert 5500 < 9 * 0.05 * 0.95 / (beyond - 0.05) ** 2 < 5900
    assert verdict(sd=0.8, size=size) == expected


@pytest.mark.parametrize(("size", "expected"), [(7000.0, "fine"), (7800.0, "too wide")])
def test_an_end_too_far_out_must_be_wrong_by_three_standard_errors(size, expected):
    """Φ(−1.645 · 1.2 + 0.25) = 0.0424, less than 0.05 by three errors √(0.05 · 0.95/n) from n = 7400 on."""
    beyond = stats.norm.cdf(-1.6448536 * 1.2 + 0.25)
    assert 7200 < 9 * 0.05 * 0.95 / (beyond - 0.05) ** 2 < 7600
    assert verdict(sd=1.2, size=size) == expected


@pytest.mark.parametrize(("end", "expected"), [(1.66, "wrong shape"), (1.69, "too narrow")])
@pytest.mark.parametrize("sign", [1, -1])
def test_draws_are_piled_up_if_five_percent_are_within_a_quarter_sd_of_an_end(end, sign, expected):
    share = stats.norm.cdf(end + 0.25) - stats.norm.cdf(end - 0.25)
    assert (share > 0.05) == (expected == "wrong shape")
    assert verdict(sd=0.84, support=(-np.inf, end) if sign > 0 else (-end, np.inf)) == expected


def test_equal_ends_of_another_shape_are_seen_by_the_distance():
    """Between the ends of the interval a uniform density with a spike; the distance is about a third of the sd."""
    inner = np.abs(NORMAL) < 1.6
    draws = np.where(inner, 0.05 * NORMAL, NORMAL)
    distance = np.mean(np.abs(draws - NORMAL)) / draws.std()
    assert distance > 0.3
    assert verdict(draws=draws) in ("wrong shape", "wrong mode")
    assert verdict(draws=NORMAL + 0.1 * np.sin(NORMAL)) == "fine"


def test_unconverged_draws_have_no_verdict():
    assert verdict(converged=False) == "not converged"
    assert verdict(sd=np.inf, converged=False) == "not converged"
    apart = np.sort(np.concatenate([NORMAL[::2], NORMAL[::2] + 20.0]))
    assert verdict(draws=apart, converged=False) == "wrong mode"


@pytest.mark.parametrize(("share", "found"), [(0.052, True), (0.048, False)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_another_mode_has_more_than_five_percent_beyond_a_deep_valley(share, found, side):
    count = round(8000 * share)
    draws = side * np.concatenate([NORMAL[: 8000 - count], 12.0 + 0.5 * NORMAL[:count]])
    assert has_other_mode(exact(draws), side * 0.1) == found
    # From the small mode the large one is seen in any case.
    assert has_other_mode(exact(draws), side * 10.0)


@pytest.mark.parametrize("size", [300.0, 1e5])
def test_a_valley_is_deep_below_seven_tenths_of_the_lower_peak(size):
    """Two normal components, smoothed with Silverman's bandwidth 0.9 s n^(−1/5), s the smaller of sd and IQR/1.349."""

    def mixed(function, x, distance, scale=1.0):
        return 0.4 * function(x, scale=scale) + 0.6 * function(x - distance, scale=scale)

    def draws(distance):
        fine = np.linspace(NORMAL[0] - 1.0, distance + NORMAL[-1] + 1.0, 20_001)
        return np.interp(MIDPOINTS, mixed(stats.norm.cdf, fine, distance), fine)

    def depth(distance):
        values = draws(distance)
        quartiles = np.quantile(values, [0.25, 0.75])
        spread = min(values.std(), (quartiles[1] - quartiles[0]) / 1.349)
        width = np.hypot(1.0, 0.9 * spread * size**-0.2)
        x = np.linspace(-1.0, distance, 5001)
        density = mixed(stats.norm.pdf, x, distance, width)
        peak = int(np.argmax(density[x < 0.3 * distance]))
        return density[peak:].min() / density[peak] - 0.7

    limit = brentq(depth, 2.6, 5.0, xtol=1e-3)
    assert not has_other_mode(exact(draws(limit - 0.06), size), 0.0)
    assert has_other_mode(exact(draws(limit + 0.06), size), 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("place", [4.5, 6.0, 7.5])
def test_a_point_in_an_empty_valley_is_separated_from_the_modes_on_both_sides(side, place):
    """The smaller mode, at 12, has 4 %; the larger one, at 0, is beyond the valley for each point within it."""
    draws = side * np.concatenate([0.5 * NORMAL[:7680], 12.0 + 0.5 * NORMAL[:320]])
    assert has_other_mode(exact(draws), side * place)


def test_a_constant_has_no_other_mode():
    assert has_other_mode(exact(np.full(800, 3.0)), 3.0) is False


def test_a_second_mode_must_exceed_three_standard_errors_of_the_batches():
    """Far shares of 4 batches, about 0.05 + δ: the mean exceeds 0.05 by three errors if δ > 3 s/2."""
    for spread, found in ((0.009, True), (0.013, False)):
        shares = 0.066 + spread * np.array([1.0, -1.0, 1.0, -1.0]) * np.sqrt(0.75)
        parts = [np.where(MIDPOINTS < share, 12.0, NORMAL) for share in shares]
        sample = Sample(np.concatenate(parts), np.array(parts), 1e4, 1)
        assert has_other_mode(sample, 0.0) == found


@pytest.mark.parametrize(
    ("values", "expected"),
    [([0.0, 0.0], False), ([1.0, 1.0], True), ([-1.0, -1.0], False), ([2.01, 4.0], True), ([1.99, 4.0], False)],
)
def test_a_mean_is_above_zero_by_more_than_three_standard_errors(values, expected):
    """Of two values a and b the mean is (a + b)/2 and its error (b − a)/2: b = 2 a is the limit."""
    assert verdicts._beyond_errors(np.array(values)) is expected


@pytest.mark.parametrize(
    ("factor", "expected"),
    [(1.157, "too narrow"), (1.147, "fine"), (1.0, "fine"), (1 / 1.147, "fine"), (1 / 1.157, "too wide")],
)
@pytest.mark.parametrize("dimension", [1, 4])
def test_radii_may_be_wrong_by_a_quarter_of_the_end_of_an_interval(factor, expected, dimension):
    distances = np.sqrt(stats.chi2.ppf(MIDPOINTS, dimension))
    assert verdicts._ellipsoids(exact(factor * distances), dimension) == expected


def test_ellipsoids_too_full_and_too_empty_have_the_wrong_shape():
    distances = np.sqrt(stats.chi2.ppf(MIDPOINTS, 2))
    assert verdicts._ellipsoids(exact(np.where(MIDPOINTS < 0.7, 0.5, 2.0) * distances), 2) == "wrong shape"


def test_an_ellipsoid_must_be_wrong_by_three_standard_errors():
    """Draws with 1.3 times the radii, in one dimension: the ellipsoid of 90 % differs most in errors of 1/√n."""
    distances = np.abs(NORMAL) * 1.3
    levels, scale = np.array([0.5, 0.9, 0.95]), 1.0 + 0.25 / 1.6448536
    inside = 2 * stats.norm.cdf(scale * stats.norm.ppf(0.5 + 0.5 * levels) / 1.3) - 1
    size = np.min(9 * levels * (1 - levels) / (levels - inside) ** 2)
    assert verdicts._ellipsoids(exact(distances, 0.96 * size), 1) == "fine"
    assert verdicts._ellipsoids(exact(distances, 1.04 * size), 1) == "too narrow"


def test_a_sample_is_split_into_eighths_of_the_steps_of_each_ensemble():
    draws = np.arange(4 * 19.0).reshape(2, 19, 2)
    own = Sample.of(draws, 50.0)
    expected = [draws[e, 3 + 2 * i : 5 + 2 * i].ravel() for e in range(2) for i in range(8)]
    assert own.batches.tolist() == np.array(expected).tolist()
    assert (own.size, own.ensembles, own.whole.tolist()) == (50.0, 2, draws.ravel().tolist())
    first, second = own.by_ensemble()
    assert first.batches.tolist() == np.array(expected[:8]).tolist()
    assert second.batches.tolist() == np.array(expected[8:]).tolist()
    assert sorted(first.whole) == sorted(np.concatenate(expected[:8]))
    assert (first.size, first.ensembles) == (25.0, 1)
    short = Sample.of(np.arange(6.0).reshape(2, 3, 1), 0.5)
    assert short.batches.shape == (6, 1) and short.size == 1.0 and short.by_ensemble()[0].size == 1.0
    assert Sample.of(draws, np.inf).size == 1.0


def test_monte_carlo_errors_are_those_of_the_mean_over_batches():
    sample = Sample(np.array([1.0, 2.0, 6.0]), np.array([[1.0, 3.0], [5.0, 7.0], [0.0, 2.0]]), 16.0, 1)
    assert sample.estimate(lambda x: x.mean(axis=-1)) == pytest.approx((3.0, np.std([2, 6, 1], ddof=1) / np.sqrt(3)))
    share, error = sample.below(2.5, 0.5)
    assert (share, error) == pytest.approx((2 / 3, max(np.std([0.5, 0, 1], ddof=1) / np.sqrt(3), np.sqrt(0.25 / 16))))
    assert sample.below(2.0, 0.1)[0] == pytest.approx(1 / 3)
    assert sample.below(100.0, 0.2) == pytest.approx((1.0, 0.1))


def test_distance_in_sds_of_the_draws_has_the_error_of_their_spread_and_number():
    batches = np.array([NORMAL[::2], 0.4 + NORMAL[::2]])
    sample = Sample(2.0 * NORMAL, batches, 400.0, 1)
    distance, error = verdicts.wasserstein_distance(sample, 1.0, 2.0)
    spread = np.std([np.mean(np.abs(b - 1.0 - 2.0 * NORMAL[::2])) for b in batches], ddof=1) / np.sqrt(2) / 2.0
    assert distance == pytest.approx(0.5, rel=1e-3)
    assert error == pytest.approx(np.hypot(spread, 1.2879 / 20), rel=2e-3)
    assert verdicts.wasserstein_distance(sample, 1.0, np.inf)[0] == np.inf


def test_distances_within_a_singular_covariance_are_finite():
    points = np.array([[1.0, 2.0], [3.0, 6.0]])
    found = verdicts.radii(points, np.zeros(2), np.array([[1.0, 2.0], [2.0, 4.0]]))
    assert found == pytest.approx([1.0, 3.0], rel=1e-6)
