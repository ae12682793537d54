"""Flat tops of mean periods: intervals of the cycle, their means, and levels that cut a series of few harmonics."""

import numpy as np
import pytest

from bayesperiodic import _fourier
from bayesperiodic.data import saturation
from bayesperiodic.data.saturation import Means, Saturation


def test_samples_are_counted_in_intervals_of_even_and_odd_cycles():
    """Of 10 samples a cycle in 40 intervals about their phases; in every cycle the same ten are used."""
    phase = np.arange(60) / 10
    bins = saturation.phase_bins(phase)
    number = bins.centre.size
    assert number == min(4 * np.ceil(60 / 5.9), 512, 60 // 4) == 15
    for k, (p, place) in enumerate(zip(phase, bins.place, strict=True)):
        near = np.floor((p + 0.5 / number) % 1.0 * number)
        assert place % number == near and place // number == int(np.floor(p + 0.5 / number)) % 2, k
    assert bins.count.shape == (2, 15) and bins.count.sum() == 60
    assert np.array_equal(bins.count.ravel(), np.bincount(bins.place, minlength=30))
    known = bins.count.sum(axis=0) > 0
    mean = [np.mean((phase[bins.place % 15 == k] + 0.5 / 15) % 1.0) - 0.5 / 15 for k in np.flatnonzero(known)]
    np.testing.assert_allclose(bins.centre[known], mean, atol=1e-12)


@pytest.mark.parametrize(
    "samples, cycles, number",
    [(1000, 100.0, 40), (1001, 100.0, 44), (100_000, 100.0, 512), (80, 2.0, 20), (7, 1.0, 1), (40, 0.5, 10)],
)
def test_number_of_intervals(samples, cycles, number):
    """Four for each sample of a cycle, 512 at most, and of four samples each; of less than a cycle as of one."""
    phase = np.linspace(0.0, cycles, samples)
    assert saturation.phase_bins(phase).centre.size == number


def example(noise, count=8000, slow=0.0):
    generator = np.random.default_rng(3)
    phase = np.sort(generator.uniform(0.0, 80.0, count))
    wave = np.array([0.3, 2.0 + 0j, 0.0, 0.4j, 0.0, 0.0, 0.0])
    residuals = noise * generator.standard_normal(count)
    if slow:
        cycles = np.repeat(generator.standard_normal(80), np.bincount(phase.astype(int), minlength=80))
        residuals += slow * cycles * np.cos(2 * np.pi * phase)
    return saturation.phase_bins(phase), phase, wave, residuals


def test_means_are_those_of_the_samples_with_their_variances():
    bins, phase, wave, residuals = example(0.1)
    means = saturation.means_of(bins, residuals, wave, 0.0)
    number = bins.centre.size
    each = [residuals[bins.place % number == k] for k in range(number)]
    expected = [
        _fourier.at_times(wave[None], np.array([c]))[0][0] + r.mean() for c, r in zip(bins.centre, each, strict=True)
    ]
    np.testing.assert_allclose(means.values, expected, rtol=1e-9)
    np.testing.assert_allclose(means.phase, bins.centre)
    within = sum(((r - r.mean()) ** 2).sum() for r in each) / (residuals.size - number)
    exact = (1e-3 * means.values.std()) ** 2
    ratio = (1.0 / means.weights - exact) * [r.size for r in each] / within
    assert (
        np.ptp(ratio) < 1e-6 and 1.0 - 1e-9 < ratio[0] < 2.0
    )  # the noise is white, and slow harmonics have no more of it
    assert means.error == pytest.approx(np.sqrt(within / residuals.size)) and means.order == 3
    rest = means.values - _fourier.at_times(wave[None, :4], means.phase)[0]
    assert means.misfit == pytest.approx(means.weights @ rest**2 + 7.0 * np.log(number))
    coarse = saturation.means_of(bins, residuals, wave, 0.6)
    np.testing.assert_allclose(1.0 / coarse.weights - 1.0 / means.weights, 0.6**2 / 12)


def test_noise_that_differs_from_cycle_to_cycle_widens_the_variances():
    """Even and odd cycles differ by what is slower than a cycle's details."""
    bins, _, wave, residuals = example(0.1, slow=0.3)
    first = saturation.means_of(bins, residuals, wave, 0.0)
    number = bins.centre.size
    half = [
        0.5 * (residuals[bins.place == k + number].mean() - residuals[bins.place == k].mean()) for k in range(number)
    ]
    power = np.abs(np.exp(-2j * np.pi * np.outer(np.arange(1, 9), bins.centre)) @ half) ** 2
    within = sum(r.size * r.var() for r in (residuals[bins.place % number == k] for k in range(number)))
    within /= residuals.size - number
    slower = max(power.mean() / (0.25 * within * (1.0 / bins.count).sum()), 1.0)
    assert slower > 2.0
    exact = (1e-3 * first.values.std()) ** 2
    np.testing.assert_allclose(1.0 / first.weights, slower * within / bins.count.sum(axis=0) + exact, rtol=1e-9)


@pytest.mark.parametrize("size, order", [(0.0, 1), (0.5, 1), (2.0, 4)])
def test_order_is_that_of_harmonics_beyond_noise(size, order):
    """Of power a²/2·Σw beyond 2 for each harmonic, and 2·ln(n) for each more."""
    bins, phase, wave, residuals = example(0.1)
    number = bins.centre.size
    clean = saturation.means_of(bins, residuals, np.array([0.0, 1.0 + 0j]), 0.0)
    wave = np.zeros(8, dtype=complex)
    wave[1] = 1.0
    needed = 3 * 2.0 * np.log(number) + 3 * 2.0
    wave[4] = size * np.sqrt(2.0 * needed / clean.weights.sum())
    means = saturation.means_of(bins, residuals, wave, 0.0)
    assert means.order == order


def cut(level, share=0.0, harmonics=1, count=256, noise=0.001, low=None):
    """Return means of a series that a level cuts, with noise of known variance."""
    phase = np.arange(count) / count
    series = np.cos(2 * np.pi * phase) + (0.2 * np.cos(6 * np.pi * phase + 0.5) if harmonics > 1 else 0.0)
    values = np.clip(series, -np.inf if low is None else low, level)
    values = values + noise * np.random.default_rng(1).standard_normal(count)
    weights = np.full(count, noise**-2.0)
    amplitudes = np.fft.rfft(values)[:40] / count * np.r_[1.0, np.full(39, 2.0)]
    rest = values - _fourier.at_times(amplitudes[None], phase)[0]
    return Means(phase, values, weights, noise / 10.0, 39, weights @ rest**2 + 79 * np.log(count)), series


@pytest.mark.parametrize("harmonics", [1, 3])
@pytest.mark.parametrize("level, low", [(0.8, None), (0.3, None), (0.6, -0.7)])
def test_levels_that_cut_a_series_are_found(level, low, harmonics):
    means, series = cut(level, harmonics=harmonics, low=low)
    seen = saturation.saturation_of(means)
    assert seen.high == pytest.approx(level, abs=1e-3) and seen.order == harmonics
    assert seen.low == (-np.inf if low is None else pytest.approx(low, abs=1e-3))
    np.testing.assert_allclose(seen.beyond, series, atol=0.02)
    np.testing.assert_allclose(seen.excess, series - np.clip(series, low or -np.inf, level), atol=0.02)
    far = np.abs(series - level) > 0.01
    assert np.array_equal(seen.flat[1][far], (series > level)[far])
    assert seen.share == pytest.approx(
        np.mean((series > level) | (series < (-np.inf if low is None else low))), abs=0.02
    )
    assert seen.like_a_sensor
    assert np.array_equal(seen.holds(means.phase + 3.0), seen.flat.any(axis=0))
    assert seen.holds(np.array([0.0, 0.5]))[0]
    waves = np.abs(np.fft.rfft(seen.excess)[: harmonics + 1]) / 256
    expected = np.sqrt(waves[0] ** 2 + 2.0 * np.sum(waves[1:] ** 2)) / 0.01
    assert seen.bias(0.01) == pytest.approx(expected)


def test_smooth_series_have_no_levels():
    for noise in (0.001, 0.05):
        means, _ = cut(9.0, noise=noise)
        assert saturation.saturation_of(means) is None
        few = Means(means.phase, means.values, means.weights, means.error, 1, means.misfit)
        assert saturation.saturation_of(few) is None


def seen(flat, values, beyond, low=-np.inf, high=1.0, order=1):
    phase = np.arange(len(values)) / len(values)
    beyond, values = np.asarray(beyond, dtype=float), np.asarray(values, dtype=float)
    return Saturation(low, high, np.asarray(flat), phase, beyond, beyond - values, 0.0, order)


def test_overload_is_the_ratio_of_the_ranges_and_skew_that_of_the_slopes():
    """A top from point 3 to 5 of ten, that the series enters with a slope of 10 and leaves with 4 a cycle."""
    beyond = [0.0, 0.5, 1.0, 2.0, 3.0, 2.2, 1.8, 1.2, 0.6, 0.2]
    values = [0.0, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.2, 0.6, 0.2]
    flat = np.zeros((2, 10), dtype=bool)
    flat[1, 3:6] = True
    top = seen(flat, values, beyond)
    assert top.overload == pytest.approx(3.0 / 1.2)
    assert top.skew == pytest.approx(10.0 / 4.0)
    # The same around the end of the cycle, and the widest of two tops.
    for shift in (3, 5, 8):
        turned = seen(np.roll(flat, shift, axis=1), np.roll(values, shift), np.roll(beyond, shift))
        assert turned.skew == pytest.approx(2.5)
    two = flat.copy()
    two[1, 8] = True
    assert seen(two, values, beyond).skew == pytest.approx(2.5)
    assert seen(np.zeros((2, 10), dtype=bool), values, beyond).skew == 1.0
    for start, sensor in ((1.02, True), (0.98, False)):  # slopes of 9.8 and 10.2 against 4
        beyond[2] = start
        assert seen(top.flat, values, beyond).like_a_sensor == sensor


@pytest.mark.parametrize(
    "changes, sensor",
    [
        ({}, True), ({"order": 5}, True), ({"order": 6}, False), ({"high": 0.009}, False), ({"high": 0.011}, True),
        ({"low": -0.009}, False), ({"low": -0.011}, True), ({"scale": 4.9}, True), ({"scale": 5.1}, False),
    ],
)  # fmt: skip
def test_sensors_cut_few_harmonics_by_little_at_no_zero(changes, sensor):
    """A level of less than a hundredth of the range is the zero of a force of one sign."""
    values = np.array([0.0, 0.5, 1.0, 1.0, 1.0, 0.5])
    scale = changes.pop("scale", 2.0)
    beyond = np.array([0.0, 0.5, 0.5 + 0.5, scale, 1.0, 0.5])
    flat = np.zeros((2, 6), dtype=bool)
    flat[1, 3] = True
    assert seen(flat, values, beyond, **changes).like_a_sensor == sensor


@pytest.mark.parametrize("chi, level", [(29.9, True), (30.1, False)])
@pytest.mark.parametrize("count", [2, 10])
def test_means_are_level_up_to_thirty_for_each(chi, level, count):
    """saturation._level: their weighted squares about the weighted mean; one interval is no level."""
    values = np.resize([0.0, 1.0], count)
    weights = np.resize([1.0, 3.0], count)
    weights *= chi * count / (weights @ (values - np.average(values, weights=weights)) ** 2)
    inside = np.arange(40) >= 40 - count
    other = np.arange(40.0 - count)
    means = Means(np.arange(40) / 40, np.append(other, values), np.append(other + 1.0, weights), 0.1, 3, 0.0)
    assert saturation._level(means, inside) == level
    assert not saturation._level(means, np.arange(40) == 39) and not saturation._level(means, np.arange(40) > 40)


def searched(count=64, low=None, high=0.6, noise=0.001, share=0.1, misfit=1.0):
    """Return means of a cosine that levels cut with noise of known weight, its basis, and first flat tops."""
    phase = np.arange(count) / count
    basis = np.column_stack([np.ones(count), np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)])
    series = 0.1 + np.cos(2 * np.pi * phase + 0.3)
    values = np.clip(series, low, high) + noise * np.resize([1.0, -1.0, -1.0, 1.0, 1.0], count)
    weights = (1.0 + 0.5 * np.cos(np.arange(count))) / (misfit * noise) ** 2
    rank = np.argsort(values)
    ends = np.zeros((2, count), dtype=bool)
    ends[0, rank[: int(share * count)]] = low is not None
    ends[1, rank[count - int(share * count) :]] = high is not None
    return Means(phase, values, weights, 0.1, 9, 0.0), basis, ends, series


@pytest.mark.parametrize("low, high", [(None, 0.6), (-0.4, None), (-0.4, 0.6)])
@pytest.mark.parametrize("share", [0.05, 0.3])
def test_search_for_levels_ends_at_weighted_least_squares_of_the_others(low, high, share):
    """saturation._saturated: each end is where the series exceeds the weighted mean of the values there."""
    means, basis, ends, series = searched(low=low, high=high, share=share)
    given = ends.copy()
    seen = saturation._saturated(means, basis, ends)
    assert np.array_equal(ends, given)
    free = ~seen.flat.any(axis=0)
    root = np.sqrt(means.weights[free])
    size = np.linalg.lstsq(basis[free] * root[:, None], means.values[free] * root, rcond=None)[0]
    np.testing.assert_allclose(seen.beyond, basis @ size, rtol=1e-9)
    np.testing.assert_allclose(seen.beyond, series, atol=0.02)
    levels = [
        np.average(means.values[end], weights=means.weights[end]) if limit is not None else infinite
        for end, limit, infinite in zip(seen.flat, (low, high), (-np.inf, np.inf), strict=True)
    ]
    assert [seen.low, seen.high] == pytest.approx(levels)
    assert np.array_equal(seen.flat, [seen.beyond < seen.low, seen.beyond > seen.high])
    model = np.minimum(np.maximum(seen.beyond, seen.low), seen.high)
    np.testing.assert_allclose(seen.excess, seen.beyond - model, atol=1e-12)
    parameters = 3 + 2 * (low is not None) + 2 * (high is not None)
    square = np.sum(means.weights * (means.values - model) ** 2)
    assert seen.misfit == pytest.approx(square + parameters * np.log(64)) and seen.order == 1
    assert seen.phase is means.phase


@pytest.mark.parametrize("factor, good", [(1.02, True), (0.98, False)])
@pytest.mark.parametrize("low, parameters", [(None, 5), (-0.4, 7)])
def test_a_saturated_series_fits_up_to_four_standard_deviations(factor, good, low, parameters):
    """saturation._saturated: χ² at most f + 4 √(2 f) for f values beyond the parameters."""
    means, basis, ends, _ = searched(low=low)
    seen = saturation._saturated(means, basis, ends)
    square = seen.misfit - parameters * np.log(64)
    freedom = 64 - parameters
    scale = (freedom + 4.0 * np.sqrt(2.0 * freedom)) / square / factor
    other = Means(means.phase, means.values, scale * means.weights, 0.1, 9, 0.0)
    assert (saturation._saturated(other, basis, ends) is not None) == good


def test_a_series_needs_twice_as_many_free_means_as_unknowns_and_all_phases():
    """saturation._saturated: six of them here; without free ones about half of the cycle the series is not known."""
    means, basis, ends, _ = searched(count=20, high=0.6)
    for free, known in ((6, True), (5, False)):
        most = np.zeros((2, 20), dtype=bool)
        most[1] = np.arange(20) >= free
        calls = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(saturation, "MOST_SEARCHES", 1)
            patch.setattr(saturation, "LARGEST_SERIES_CONDITION", 1e12)
            patch.setattr(np.linalg, "eigvalsh", lambda m, c=calls: c.append(m) or np.ones(3))
            saturation._saturated(means, basis, most)
        assert bool(calls) == known
    # The condition number of the normal equations is 1e4 at most.
    for largest, known in ((0.99e4, True), (1.01e4, False)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(np.linalg, "eigvalsh", lambda _, largest=largest: np.array([1.0, 5.0, largest]))
            assert (saturation._saturated(means, basis, ends) is not None) == known


def test_a_search_that_finds_no_level_has_no_series():
    """saturation._saturated: the first flat tops are above all of the series, and then there are none."""
    phase = np.arange(64) / 64
    basis = np.column_stack([np.ones(64), np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)])
    means = Means(phase, np.where(np.arange(64) < 2, 3.0, basis[:, 1]), np.ones(64), 0.1, 9, 0.0)
    ends = np.zeros((2, 64), dtype=bool)
    ends[1, :2] = True  # a level of 3 that the series does not reach
    assert saturation._saturated(means, basis, ends) is None


def test_best_of_all_series_is_clearly_better_than_the_mean_period():
    """saturation_of: by 25 of χ², parameters included."""
    means, _ = cut(0.6, harmonics=3)
    best = saturation.saturation_of(means)
    for margin, known in ((25.1, True), (24.9, False)):
        other = Means(means.phase, means.values, means.weights, means.error, 39, best.misfit + margin)
        assert (saturation.saturation_of(other) is not None) == known
    # Only series of fewer harmonics than the mean period.
    for order, known in ((3, False), (4, True)):
        few = Means(means.phase, means.values, means.weights, means.error, order, means.misfit)
        seen = saturation.saturation_of(few)
        assert (seen is not None and seen.order == 3) == known


@pytest.mark.parametrize("chunk", [1, 37, 200, 1000])
def test_intervals_do_not_depend_on_how_many_samples_are_counted_at_once(chunk, monkeypatch):
    phase = np.sort(np.random.default_rng(1).uniform(-3.0, 20.0, 200))
    expected = saturation.phase_bins(phase)
    monkeypatch.setattr(_fourier, "CHUNK", chunk)
    bins = saturation.phase_bins(phase)
    assert np.array_equal(bins.place, expected.place) and np.array_equal(bins.count, expected.count)
    np.testing.assert_allclose(bins.centre, expected.centre, atol=1e-12)


@pytest.mark.parametrize("size, step", [(0.0, 0.0), (0.0, 0.3), (1e-13, 0.0), (0.2, 0.1)])
def test_means_of_intervals_that_have_samples(size, step):
    """means_of: of 0.6 of the cycle; without noise errors are a thousandth of the means, and of rounding alone."""
    generator = np.random.default_rng(2)
    phase = np.sort(np.floor(40 * generator.uniform(0.0, 1.0, 900)) + generator.uniform(0.0, 0.6, 900))
    bins = saturation.phase_bins(phase)
    wave = np.array([0.5, 1.0 - 0.3j, 0.2j])
    residuals = size * generator.standard_normal(900)
    means = saturation.means_of(bins, residuals, wave, step)
    number = bins.centre.size
    some = [k for k in range(number) if np.any(bins.place % number == k)]
    each = [residuals[bins.place % number == k] for k in some]
    assert len(some) < number and np.array_equal(means.phase, bins.centre[some])
    turned = np.real(np.exp(2j * np.pi * np.outer(means.phase, np.arange(3))) @ wave)
    np.testing.assert_allclose(means.values, turned + [one.mean() for one in each], atol=1e-12)
    variance = sum(np.sum((one - one.mean()) ** 2) for one in each) / (900 - len(some))
    exact = (1e-3 * means.values.std()) ** 2 + step**2 / 12.0
    both = [k for k in range(number) if np.all(bins.count[:, k])]
    half = [0.5 * (residuals[bins.place == k + number].mean() - residuals[bins.place == k].mean()) for k in both]
    power = np.abs(np.exp(-2j * np.pi * np.outer(np.arange(1, 9), bins.centre[both])) @ half) ** 2
    usual = 0.25 * variance * np.sum(1.0 / bins.count[:, both])
    slower = max(power.mean() / usual, 1.0) if size else 1.0
    np.testing.assert_allclose(1.0 / means.weights, slower * variance / [one.size for one in each] + exact, rtol=1e-6)
    least = 1e-9 * np.abs(means.values).max()
    assert means.error == pytest.approx(max(np.sqrt(variance), least) / 30.0, rel=1e-6)


@pytest.mark.parametrize("beyond, order", [(0, 2), (1, 3)])
def test_order_counts_harmonics_whose_power_is_more_than_their_parameters(beyond, order):
    """means_of: of a third harmonic whose χ² is above or below 2 + 2 ln n, beside two clear ones."""
    phase = np.arange(4000) / 40.0 + 1e-6
    bins, residuals = saturation.phase_bins(phase), 0.1 * np.resize([1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0], 4000)
    wave = np.array([0.5, 1.0, 0.5j, 0.0])
    first = saturation.means_of(bins, residuals, wave, 0.0)
    needed = 2.0 + 2.0 * np.log(first.weights.size)
    wave[3] = np.sqrt(2.0 * (needed + (0.5 if beyond else -0.5)) / first.weights.sum())
    assert saturation.means_of(bins, residuals, wave, 0.0).order == order == 2 + beyond
    rest = first.values - _fourier.at_times(wave[None, :3], first.phase)[0]
    assert first.misfit == pytest.approx(first.weights @ rest**2 + 5.0 * np.log(first.weights.size))
