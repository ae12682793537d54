"""Rules for the steady part, by windows whose amplitudes are given: levels, ramps, rests of transients, slopes."""

import numpy as np
import pytest
from scipy.stats import t as student

from bayesperiodic import _fourier
from bayesperiodic.data import steadiness
from bayesperiodic.data.steadiness import Windows


def windows_of(sizes, overlap=1, slip=0.0, mean=0.0):
    """Return windows of channels (windows, channels) with these amplitudes of harmonic 1, and a mean value."""
    sizes = np.asarray(sizes, dtype=complex)
    sizes = sizes[:, None] if sizes.ndim == 1 else sizes
    amplitudes = np.zeros((*sizes.shape, 3), dtype=complex)
    amplitudes[:, :, 1], amplitudes[:, :, 0] = sizes, np.broadcast_to(mean, (len(sizes),))[:, None]
    place, slips = np.arange(len(sizes)), np.full(sizes.shape[1], slip)
    return Windows(5 * place, 5 * place + 5 * overlap, place, overlap, 1, amplitudes, slips, slips)


def test_windows_are_chosen_joined_and_turned():
    amplitudes = np.exp(0.3j * np.arange(8))[:, None] * np.array([1.0, 2.0])
    given = windows_of(amplitudes)
    given.amplitudes[:, 1, 2] = 5.0 * np.exp(0.6j * np.arange(8))
    assert given.strongest.tolist() == [1, 2] and given.sizes[0].tolist() == pytest.approx([1.0, 5.0])
    assert given.lines[3] == pytest.approx([np.exp(0.9j), 5.0 * np.exp(1.8j)])
    some = given.chosen(slice(2, 5))
    assert (
        some.first.tolist() == [10, 15, 20] and some.place.tolist() == [2, 3, 4] and some.last.tolist() == [15, 20, 25]
    )
    of_all = some.among(3 * np.arange(40) + 1)
    assert of_all.first.tolist() == [31, 46, 61] and of_all.last.tolist() == [44, 59, 74]
    # Each window is turned as a whole; harmonic 2 turns twice as much.
    turned = given.aligned().amplitudes
    np.testing.assert_allclose(np.angle(turned[:, 0, 1]), np.angle(turned[0, 0, 1]))
    np.testing.assert_allclose(np.angle(turned[:, 1, 2]), np.angle(turned[0, 1, 2]), atol=1e-12)
    np.testing.assert_allclose(np.abs(turned), np.abs(given.amplitudes))
    every = windows_of(np.ones(11), overlap=4)
    assert every.apart().place.tolist() == [2, 6, 10]
    assert every.chosen([0, 1, 5, 9, 10]).apart().place.tolist() == [1, 5, 10]


@pytest.mark.parametrize("overlap", [1, 4])
def test_windows_apart_are_the_overlap_apart_from_the_last_on(overlap):
    for seed in range(20):
        places = np.flatnonzero(np.random.default_rng(seed).random(60) < 0.6)
        given = windows_of(np.ones(60), overlap=overlap).chosen(list(places))
        expected = [places[-1]]
        for place in places[::-1]:
            if expected[-1] - place >= overlap:
                expected.append(place)
        assert given.apart().place.tolist() == expected[::-1]


@pytest.mark.parametrize("change, together", [(0.079, True), (0.081, False), (-0.079, True), (-0.081, False)])
def test_amplitudes_of_one_level_differ_by_eight_percent_at_most(change, together):
    """Relative to the amplitudes that nine tenths do not exceed, 1 here; the longest part counts."""
    sizes = np.ones(40)
    sizes[33:] += change
    sizes[:2] = 1.0  # of quantile 0.9
    level = np.quantile(sizes, 0.9)
    assert (abs(change) <= 0.08 * level) == (together if change < 0 else abs(change) <= 0.08 * level)
    found = steadiness.plateau(windows_of(sizes))
    assert found == ((0, 40) if abs(change) <= 0.08 * level else (0, 33))
    # Of two channels, both must be level; one more sample or less at jumps is added twice.
    both = np.column_stack([np.ones(40), sizes])
    assert steadiness.plateau(windows_of(both)) == found
    assert steadiness.plateau(windows_of(both, slip=0.01)) == (0, 40)


@pytest.mark.parametrize("low, part", [(0.51, (0, 30)), (0.49, (30, 40))])
def test_the_longest_part_is_steady_from_half_of_the_largest_amplitudes_on(low, part):
    sizes = np.ones(40)
    sizes[:30] = low
    assert steadiness.plateau(windows_of(sizes)) == part
    # Of two channels, one at its level is enough.
    assert steadiness.plateau(windows_of(np.column_stack([sizes, np.where(sizes < 1, 1.0, 0.5)]))) == (0, 30)


def test_of_two_parts_of_one_length_the_later_one_is_taken():
    sizes = np.r_[np.ones(10), np.full(10, 1.2)]
    assert steadiness.plateau(windows_of(sizes)) == (10, 20)
    assert steadiness.plateau(windows_of(np.r_[sizes[:11], sizes[10:]])) == (10, 21)
    assert steadiness.plateau(windows_of(np.r_[1.0, sizes])) == (0, 11)


@pytest.mark.parametrize("factor, found", [(0.95, (0, 60)), (1.05, None)])
def test_noise_widens_the_range_of_a_level(factor, found):
    """By 14 standard deviations of a cycle: the 15 % quantile of the differences of normal ones is 0.267 of these."""
    sizes = 1.0 + 0.02 * np.random.default_rng(1).standard_normal(60)
    noise = np.quantile(np.abs(np.diff(sizes)), 0.15) / 0.267
    sizes[41] = sizes[:41].min() + factor * 14.0 * noise
    inside = steadiness.plateau(windows_of(sizes))
    assert inside == (found or inside) and (inside == (0, 60)) == (found is not None)


@pytest.mark.parametrize("place", [0, 1, 18, 19])
def test_windows_at_the_ends_that_are_far_from_the_middle_are_left_out(place):
    """The third from an end is kept beside its neighbours only if three in a row are near."""
    generator = np.random.default_rng(5)
    sizes = 1.0 + 0.001 * (generator.standard_normal(20) + 1j * generator.standard_normal(20))
    first, last = steadiness._trimmed(windows_of(sizes))
    assert (first, last) == (0, 20)
    sizes[place] += 0.05
    first, last = steadiness._trimmed(windows_of(sizes))
    assert (first, last) == ((place + 1, 20) if place < 10 else (0, place))
    assert steadiness._trimmed(windows_of(sizes, slip=0.06)) == (0, 20)


def test_mean_values_far_from_the_middle_are_left_out_too():
    generator = np.random.default_rng(5)
    sizes, mean = 1.0 + 0.001 * generator.standard_normal(20), 0.001 * generator.standard_normal(20)
    usual = np.median(np.abs(mean[5:15] - np.median(mean[5:15])))
    for factor, first in ((11.0, 0), (13.0, 1)):
        mean[0] = np.median(mean[5:15]) + factor * usual
        assert steadiness._trimmed(windows_of(sizes, mean=mean))[0] == first


def test_three_cycles_are_always_left():
    sizes = np.array([9.0, 5.0, 1.0, 1.0001, 0.9999, 5.0, 9.0])
    first, last = steadiness._trimmed(windows_of(sizes), np.median)
    assert (first, last) == (2, 5)
    first, last = steadiness._trimmed(windows_of(np.repeat(sizes, 4), overlap=4), np.median)
    assert (first, last) == (8, 20)


@pytest.mark.parametrize("count", [3, 4, 12, 40])
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_change_is_the_slope_where_it_is_significant(count, factor):
    """By Student's t at 1e-4; residuals that alternate have no positive memory, and add nothing to the slope."""
    place = np.arange(count) - 0.5 * (count - 1)
    shape = np.resize([1.0, -1.0], count)
    shape = shape - shape.mean() - place * (place @ shape) / (place @ place)
    shape = 0.01 * shape / np.abs(shape).max()
    se = np.sqrt(np.sum(shape**2) / max(count - 2, 1) / (place @ place))
    slope = factor * se * student.isf(0.5e-4, count - 2)
    memory = max(0.0, np.sum(shape[1:] * shape[:-1]) / np.sum(shape**2))
    slope *= np.sqrt((1 + memory) / (1 - memory))
    sizes = 2.0 + slope * place + shape
    expected = slope * count / 2.0 if factor > 1 else 0.0
    assert steadiness._change(sizes[:, None])[0] == pytest.approx(expected, rel=1e-9)
    assert steadiness._change(np.column_stack([sizes, np.ones(count)])).tolist() == pytest.approx([expected, 0.0])


def test_change_of_two_windows_is_none_and_slow_noise_is_wider():
    """Residuals with a correlation r of neighbours widen the error by √((1 + r)/(1 − r)), with r up to 0.8."""
    assert steadiness._change(np.array([[1.0], [2.0]])).tolist() == [0.0]
    place = np.arange(60) - 29.5
    slow = np.cos(2 * np.pi * np.arange(60) / 20)
    slow = 0.01 * (slow - slow.mean() - place * (place @ slow) / (place @ place))
    r = np.sum(slow[1:] * slow[:-1]) / np.sum(slow**2)
    assert r > 0.8
    se = np.sqrt(np.sum(slow**2) / 58 / (place @ place)) * np.sqrt(1.8 / 0.2)
    for factor, seen in ((0.95, False), (1.05, True)):
        slope = factor * se * student.isf(0.5e-4, 58)
        assert (steadiness._change((1.0 + slope * place + slow)[:, None])[0] != 0.0) == seen


def test_components_are_parts_along_and_across_without_a_drift_of_the_phase():
    """A phase that drifts and bends, h times as fast in harmonic h, is taken out; amplitudes and means stay."""
    count, generator = 30, np.random.default_rng(2)
    place = np.arange(count) - 14.5
    phase = 0.02 * place + 0.001 * place**2
    size = np.array([[2.0, 0.5], [1.0, 0.25]])
    shape = np.zeros((count, 2, 3), dtype=complex)
    growth = 1.0 + 0.01 * generator.standard_normal((count, 2, 2))
    shape[:, :, 1:] = size * growth * np.exp(1j * (phase[:, None, None] * [1.0, 2.0] + [[0.4, 1.0], [2.0, 3.0]]))
    shape[:, :, 0] = [0.3, -0.7] + 0.01 * generator.standard_normal((count, 2))
    found = steadiness._components(shape).reshape(count, 2, 5)
    np.testing.assert_allclose(np.abs(found[:, :, 0]), np.abs(shape[:, :, 0].real), atol=1e-12)
    np.testing.assert_allclose(found[:, :, 1:3], size * growth, rtol=2e-3)
    assert np.abs(found[:, :, 3:]).max() < 0.02
    # A mean value of zero is kept as it is.
    shape[:, 0, 0] = 0.0
    assert np.array_equal(steadiness._components(shape).reshape(count, 2, 5)[:, 0, 0], np.zeros(count))


def test_jumps_make_windows_differ_by_a_sample():
    """Twice the median of the largest second differences; without those that smooth signals and noise have too."""
    values = np.zeros((2, 100))
    values[0, 10::20] = 3.0
    values[1] = np.arange(100.0) ** 2
    slip, jump = steadiness._slip(values, np.arange(0, 100, 20))
    assert slip.tolist() == [12.0, 4.0] and jump.tolist() == [12.0, 0.0]
    noise = np.random.default_rng(0).standard_normal((1, 10_000))
    slip, jump = steadiness._slip(noise, np.arange(0, 10_000, 100))
    assert slip[0] == pytest.approx(2 * 6**0.5 * 2.6, rel=0.1) and jump[0] == 0.0
    assert steadiness._slip(np.zeros((2, 2)), np.array([0]))[0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("chunk", [1, 7, 50, 1000])
def test_sums_over_blocks_do_not_depend_on_what_is_computed_at_once(monkeypatch, chunk):
    """Σ exp(−2πi h φ), and with two signals, from each edge to the next, some of them longer than a part."""
    generator = np.random.default_rng(1)
    phase, values = generator.uniform(0.0, 9.0, 200), generator.standard_normal((2, 200))
    edges = np.array([0, 3, 5, 20, 21, 22, 60, 61, 90, 150, 199])
    monkeypatch.setattr(_fourier, "CHUNK", chunk)
    sums = steadiness._block_sums(phase, values, edges, 7, 4)
    every = np.stack([np.ones(200), *values]) * np.exp(-2j * np.pi * np.arange(7)[:, None, None] * phase)
    expected = np.array([part.sum(axis=2) for part in np.split(every, edges[1:], axis=2)]).transpose(1, 2, 0)
    expected[4:, 1:] = 0.0
    np.testing.assert_allclose(sums, expected, atol=1e-11)


@pytest.mark.parametrize(
    "total, length, cycles, overlap, count",
    [
        (64, 1, 1, 8, 505), (65, 1, 1, 1, 65), (64, 3, 3, 8, 163), (511, 1, 1, 1, 511), (512, 1, 2, 1, 256),
        (770, 1, 3, 1, 256), (770, 5, 5, 1, 154),
    ],
)  # fmt: skip
def test_windows_are_of_whole_cycles_and_256_at_most(total, length, cycles, overlap, count):
    """Up to 64 cycles they begin at eighths of a window; the last one ends with the recording."""
    time = np.arange(total * 40) / 40.0
    every = steadiness.windows(time, np.cos(2 * np.pi * time + 0.3)[None], 1.0, length)
    assert (every.cycles, every.overlap, len(every.first)) == (cycles, overlap, count)
    assert (
        np.array_equal(np.diff(every.last), np.full(count - 1, 40 * cycles // overlap)) and every.last[-1] == 40 * total
    )
    assert np.array_equal((every.last - every.first)[1:], np.full(count - 1, 40 * cycles))
    assert every.amplitudes[:, 0, 1] == pytest.approx(np.sqrt(2) * np.exp(0.3j), abs=1e-9)


@pytest.mark.parametrize("holes", [0.2, 0.25, 0.3, 0.45])
def test_windows_are_longer_where_a_quarter_of_them_have_too_few_samples(holes):
    """A part of the cycles has a fifth of the samples; half of the median are enough. They are doubled until then."""
    time = np.arange(400 * 40) / 40.0
    thin = np.arange(400) % 20 < 20 * holes
    kept = ~thin[(time + 1e-9).astype(int)] | (np.arange(time.size) % 5 == 0)
    samples = np.bincount((time[kept] + 1e-9).astype(int))[::-1]
    sums = {cycles: samples[: 400 // cycles * cycles].reshape(-1, cycles).sum(axis=1) for cycles in (1, 2, 4, 8)}
    shares = {cycles: np.mean(each >= 0.5 * np.median(each)) for cycles, each in sums.items()}
    every = steadiness.windows(time[kept], np.cos(2 * np.pi * time[kept])[None], 1.0)
    assert every.cycles == next(cycles for cycles, share in shares.items() if share >= 0.75)


@pytest.mark.parametrize("driven", [True, False])
def test_steady_part_of_a_ramp_and_level_cycles(driven):
    """Windows of eighths of a cycle, of which those that do not overlap are kept; the ramp ends at window 40."""
    generator = np.random.default_rng(3)
    sizes = np.minimum(np.arange(200) / 40.0, 1.0) * (1.0 + 1e-4 * generator.standard_normal(200))
    every = windows_of(sizes * np.exp(1e-4j * generator.standard_normal(200)), overlap=8)
    steady = steadiness.steady_part(every, driven)
    places = steady.part.place
    assert np.all(np.diff(places) == 8) and places[-1] == 199 and 37 <= places[0] <= 52
    assert steady.samples == slice(5 * int(places[0]), 5 * 199 + 40) and steady.level == (
        steady.samples.start,
        5 * 199 + 40,
    )
    assert steady.change.shape == (2, 1) and np.all(np.abs(steady.change) < 1e-2)
    assert steady.squares.shape == (1, 3) and steady.changes is not None and steady.bias < 0.1
    of_all = steady.among(2 * np.arange(2000) + 1)
    assert of_all.samples == slice(2 * steady.samples.start + 1, 2 * (steady.samples.stop - 1) + 2)
    assert of_all.level == (2 * steady.level[0] + 1, 2 * (steady.level[1] - 1) + 2)


@pytest.mark.parametrize("count, steady", [(16, False), (17, True)])
def test_three_cycles_of_one_level_are_needed(count, steady):
    """Of windows of eighths of a cycle, the first and the last of three cycles are 16 windows apart."""
    assert (steadiness.steady_part(windows_of(np.ones(count), overlap=8), True) is not None) == steady
    few = steadiness.steady_part(windows_of(np.ones(4)), True)
    assert few.changes is None and few.squares.tolist() == [[0.0] * 3] and (few.bias, few.transient) == (0.0, 0.0)
    assert steadiness.steady_part(windows_of(np.ones(2)), True) is None


def test_rest_of_a_transient_is_left_out_where_its_bias_exceeds_the_noise():
    """Four times its squared bias plus the variance of the mean over the others is least."""
    cycle, generator = np.arange(60), np.random.default_rng(1)
    sizes = 1.0 + 0.05 * np.exp(-cycle / 4.0) + 1e-3 * generator.standard_normal(60)
    every = windows_of(sizes + 1e-3j * generator.standard_normal(60))
    steady = steadiness.steady_part(every, True)
    first = int(steady.part.place[0])
    later = 0.05 * np.array([np.exp(-cycle[k:] / 4.0).mean() for k in range(60)])
    error = (1.0 + 4.0 * (later / 1e-3) ** 2 * (60 - cycle)) / (60 - cycle)
    best = int(np.argmin(error[:57]))
    assert abs(first - best) <= 8 and steady.bias < 1.0 and steady.samples == slice(5 * first, 300)
