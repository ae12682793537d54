"""Faults of single sensors by their samples: each kind is found exactly, and signals without it have none."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data import faults
from bayesperiodic.data.recording_check import Effect, clipped_effect

TIME = np.arange(4000) / 100.0
PHASE = 2 * np.pi * TIME


def quantised(values, step):
    return step * np.round(values / step)


def square(phase):
    return np.sign(np.sin(phase))


# Motions and forces that no sensor has spoiled.
SOUND = {
    "sine": np.sin(PHASE + 0.2),
    "harmonics": np.sin(PHASE) + 0.3 * np.sin(3 * PHASE + 1) + 0.1 * np.cos(7 * PHASE),
    "8 bits": quantised(np.sin(PHASE + 0.2), 2 / 255),
    "8 bits, slow": quantised(np.sin(PHASE / 20), 2 / 255),
    "6 bits with dither": quantised(
        np.sin(PHASE + 0.2) + np.random.default_rng(0).uniform(-0.02, 0.02, PHASE.size), 2 / 63
    ),
    "square wave": square(PHASE + 0.2),
    "square wave of 1": 0.5 + 0.5 * square(PHASE + 0.2),
    "square wave of 2 pi with noise": np.pi * square(PHASE + 0.2) + np.random.default_rng(1).normal(0, 0.01, 4000),
    "pulses": np.where(PHASE / (2 * np.pi) % 1.0 < 0.1, 5.0, 0.0),
    "dry friction": np.sign(np.cos(PHASE)) * (1 + 0.05 * np.abs(np.cos(PHASE))),
    "friction with noise": np.tanh(np.cos(PHASE) / 0.02) + np.random.default_rng(2).normal(0, 0.01, 4000),
    "impacts": np.abs(np.sin(PHASE / 2)),
    "impulses": 1 / (1 + ((PHASE / (2 * np.pi) % 1.0 - 0.503) / 0.01) ** 2),
    "noise": np.random.default_rng(3).standard_normal(4000),
    "random walk": np.cumsum(np.random.default_rng(4).standard_normal(4000)),
}


@pytest.mark.parametrize("values", SOUND.values(), ids=[*SOUND])
def test_sound_signals_do_not_wrap(values):
    assert faults.wrap_of(values, faults.resolution(values))[0] == 0.0


@pytest.mark.parametrize("values", SOUND.values(), ids=[*SOUND])
def test_sound_signals_are_neither_stuck_nor_clipped_for_one_period_alone(values):
    """A relay and pulses rest in every period, as long as in the others."""
    stuck = faults.stuck_of(values)
    assert stuck == []
    low, high = faults.clipped_of(values, stuck)
    assert low.size == high.size == 0


@pytest.mark.parametrize("turn", [2 * np.pi, 360.0, 1.0])
@pytest.mark.parametrize("rate", [0.11, -0.11])
def test_wraps_of_an_angle_are_found_with_their_samples_and_removed(turn, rate):
    """A rotation with an oscillation; the jumps are where the whole number of turns changes."""
    angle = turn * (0.2 + rate * TIME + 0.05 * np.sin(PHASE)) + 1e-3 * turn * np.random.default_rng(0).normal(size=4000)
    wrapped = angle % turn
    found, places = faults.wrap_of(wrapped, 0.0)
    assert found == turn
    assert places.tolist() == (np.flatnonzero(np.diff(np.floor(angle / turn))) + 1).tolist()
    np.testing.assert_allclose(np.diff(np.unwrap(wrapped, period=turn)), np.diff(angle), atol=1e-9 * turn)


@pytest.mark.parametrize("bits", [8, 12])
def test_a_counter_that_overflows_wraps_at_a_power_of_two_of_its_steps(bits):
    step = 0.0025
    counts = np.round(2**bits * (0.3 + 0.13 * TIME + 0.05 * np.sin(PHASE)))
    values = step * (counts % 2**bits)
    resolved = faults.resolution(values)
    found, places = faults.wrap_of(values, resolved)
    assert resolved == pytest.approx(step)
    assert found == pytest.approx(step * 2**bits)
    assert places.tolist() == (np.flatnonzero(np.diff(counts // 2**bits)) + 1).tolist()


def test_a_counter_with_nearly_the_range_of_an_angle_wraps_at_its_own():
    """Of 5.8 V; a turn of 2π within the same tenth has no jumps of its size."""
    counts = np.round(2**10 * (0.3 + 0.13 * TIME + 0.05 * np.sin(PHASE)))
    values = 5.8 / 2**10 * (counts % 2**10)
    found, places = faults.wrap_of(values, 5.8 / 2**10)
    assert found == pytest.approx(5.8)
    assert places.tolist() == (np.flatnonzero(np.diff(counts // 2**10)) + 1).tolist()


SIGNS = np.tile([1.0, -1.0], 10)
SIZES = np.geomspace(10.0, 60.0, 20)


@pytest.mark.parametrize(
    "sizes, noise",
    [
        (SIGNS * SIZES, True), (SIGNS[:10] * SIZES[::2], True), (SIGNS[:9] * SIZES[::2][:9], False), (SIZES, False),
        (-SIZES, False), (SIGNS * 30.0, False), (SIGNS * np.geomspace(10.0, 24.0, 20), False),
        (SIGNS * np.geomspace(10.0, 40.0, 20), True),
    ],
)  # fmt: skip
def test_impulses_of_random_size_and_sign_are_noise(sizes, noise):
    """At least ten, of both signs, nine tenths of which differ by a factor of 2.5 at least; beside normal noise."""
    residuals = np.clip(np.random.default_rng(2).standard_normal(4000), -3.5, 3.5)
    places = np.arange(sizes.size) * 190 + 50
    residuals[places] = sizes
    predicted = np.cos(0.3 * np.arange(4000.0))
    for offset in (0.0, 5.0):
        assert faults.heavy_tails(residuals + offset, places, predicted).tolist() == [noise] * sizes.size
    # Values that replace the signal, as zero does, follow it.
    assert not faults.heavy_tails(residuals, places, np.where(np.isin(np.arange(4000), places), -residuals, 0.0)).any()


def test_power_laws_are_noise_up_to_the_size_of_which_a_thousandth_is_expected():
    """|x| of n samples exceeds x in n x⁻² of 4000; the sizes are the quantiles, so that the tail has an index of 2."""
    count = 4000
    sizes = np.sqrt(count / (np.arange(count) + 0.5))
    signs = np.random.default_rng(3).choice([-1.0, 1.0], count)
    residuals = np.random.default_rng(4).permutation(sizes * signs)
    distance = np.abs(residuals - np.median(residuals))
    scale = 1.4826 * np.median(distance)
    far = np.flatnonzero(distance > 8.0 * scale)
    assert faults.heavy_tails(residuals, far, residuals).all() and far.size > 5
    beyond = distance[distance > 4.0 * scale] / (4.0 * scale)
    largest = 4.0 * scale * (beyond.size / 1e-3) ** (np.median(np.log(beyond)) / np.log(2.0))
    for factor, noise in ((0.9, True), (1.1, False)):
        # The index is that of the median of the sizes beyond four standard deviations, one of which is changed.
        other = residuals.copy()
        other[far[0]] = np.median(residuals) + factor * largest
        assert faults.heavy_tails(other, far[:1], other).tolist() == [noise]
    assert faults.heavy_tails(residuals, far[:0], residuals).size == 0
    assert not faults.heavy_tails(np.r_[np.zeros(50), 3.0], np.array([50]), np.ones(51)).any()


@pytest.mark.parametrize("per_cycle", [20, 50, 200])
@pytest.mark.parametrize("turn", [2 * np.pi, 360.0, 1.0, 2.0])
def test_sawtooth_drives_are_no_wraps_unless_their_range_is_a_turn(per_cycle, turn):
    """A sawtooth of a range of 2.5 volts, or of another number, is no angle."""
    saw = 2.5 * (np.arange(50 * per_cycle) / per_cycle % 1.0)
    assert faults.wrap_of(saw, 0.0)[0] == 0.0
    assert faults.wrap_of(1.3 * turn * saw / 2.5, 0.0)[0] == 0.0


@pytest.mark.parametrize(("first", "length"), [(300, 10), (1710, 60), (3500, 500), (0, 40)])
def test_a_stuck_sensor_is_found_from_its_first_to_its_last_sample(first, length):
    values = np.sin(PHASE) + np.random.default_rng(0).normal(0, 1e-3, 4000)
    values[first : first + length] = values[first]
    assert faults.stuck_of(values) == [slice(first, first + length)]


def test_several_stuck_stretches_are_found_in_a_quantised_signal():
    """A sine of 8 bits rests at its peaks for several samples in a row."""
    values = quantised(np.sin(PHASE / 2), 2 / 255)
    longest = max(faults.runs(values)[1])
    assert 3 <= longest < 10
    values[1000:1100] = values[1000]
    values[2210:2290] = values[2210]
    found = faults.stuck_of(values)
    assert [(part.start, part.stop) for part in found] == [
        (int(np.flatnonzero(values[:1050] != values[1000])[-1]) + 1, found[0].stop),
        (int(np.flatnonzero(values[:2250] != values[2210])[-1]) + 1, found[1].stop),
    ]
    assert found[0].stop >= 1100 and found[1].stop >= 2290


@pytest.mark.parametrize("low", [-2.0, -0.8])
@pytest.mark.parametrize("step", [0.0, 2 / 4095])
def test_clipped_samples_are_those_at_the_limit(low, step):
    clean = np.sin(PHASE + 0.2) + 0.1 * np.sin(3 * PHASE)
    clean = clean + np.random.default_rng(0).normal(0, 5e-3, 4000)
    high = 0.75
    values = np.clip(quantised(clean, step) if step else clean, low, high)
    lower, upper = faults.clipped_of(values, [])
    assert upper.tolist() == np.flatnonzero(values == high).tolist()
    assert lower.tolist() == (np.flatnonzero(values == low).tolist() if low > -1.0 else [])


def test_outliers_are_samples_far_from_the_mean_period_that_do_not_return():
    """Residuals of sd 1; jumps of 6 standard deviations are none, those of 12 and more are."""
    generator = np.random.default_rng(0)
    noise = 0.01 * generator.standard_normal(4000)
    place = generator.choice(4000, 30, replace=False)
    residuals = noise.copy()
    residuals[place] += 0.5 * np.sign(generator.standard_normal(30))
    residuals[17 if 17 not in place else 18] = 0.06
    values = np.sin(PHASE) + residuals
    assert faults.outliers_of(residuals, TIME, values, 0.0).tolist() == sorted(place)
    assert faults.outliers_of(noise, TIME, np.sin(PHASE) + noise, 0.0).size == 0


@pytest.mark.parametrize("width", [1, 3])
def test_spikes_of_every_period_are_part_of_the_signal(width):
    """Impacts that a series of few harmonics does not follow: always at the same phase, within a sample."""
    generator = np.random.default_rng(0)
    residuals = 0.01 * generator.standard_normal(4000)
    for k in range(40):
        start = 100 * k + 37 + generator.integers(0, 2)
        residuals[start : start + width] += 1.0
    values = np.sin(PHASE) + residuals
    assert faults.outliers_of(residuals, TIME, values, 0.0).size == 0


def test_heavy_tails_are_no_outliers_where_the_signal_is_smooth():
    """A slow swelling of the residuals has no jumps into and out of it."""
    residuals = 0.01 * np.random.default_rng(0).standard_normal(4000)
    residuals += np.exp(-0.5 * ((TIME - 20) / 0.5) ** 2)
    assert faults.outliers_of(residuals, TIME, np.sin(PHASE) + residuals, 0.0).size == 0


def test_resolution_is_the_step():
    assert faults.resolution(quantised(np.sin(PHASE + 0.1), 2 / 255)) == pytest.approx(2 / 255)
    assert faults.resolution(np.random.default_rng(0).standard_normal(4000)) == 0.0


@pytest.mark.parametrize("repeats", [2, 3, 8])
def test_a_slower_logger_repeats_each_value(repeats):
    """Of the first value, whose run is cut, no sample is at the time of a change."""
    values = np.repeat(np.random.default_rng(1).standard_normal(100), repeats)
    found, repeated = faults.held_of(values[1:])
    assert found == repeats and repeated.size == 100 * (repeats - 1)
    assert faults.held_of(np.random.default_rng(1).standard_normal(100))[0] == 1


@pytest.mark.parametrize("levels", [2, 5])
def test_a_relay_is_no_slower_logger(levels):
    assert faults.held_of(np.repeat(np.arange(400) % levels, 5).astype(float))[0] == 1


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_dropouts_within_the_range_of_the_signal_are_outliers_by_their_value(share):
    """Of 4000 samples with noise none other is zero; a sample whose value is zero is a dropout."""
    rng, phase = np.random.default_rng(2), np.arange(4000) / 50
    values = np.cos(2 * np.pi * phase) + 0.01 * rng.standard_normal(phase.size)
    values[rng.random(phase.size) < share] = 0.0
    residuals = values - (1.0 - share) * np.cos(2 * np.pi * phase)
    assert np.array_equal(faults.outliers_of(residuals, phase, values, 0.0), np.flatnonzero(values == 0.0))


def test_many_impacts_of_every_period_are_no_outliers():
    """Twelve peaks of three samples a period, which the mean period does not resolve."""
    phase = np.arange(33 * 1000) / 1000
    far = np.isin(np.arange(phase.size) % 1000, np.add.outer(np.arange(12) * 80, np.arange(3)))
    rng = np.random.default_rng(3)
    values = -20.0 * far * rng.uniform(0.8, 1.2, phase.size) + 0.05 * rng.standard_normal(phase.size)
    assert not faults.outliers_of(values, phase, values, 0.0).size


def test_few_clipped_samples_a_cycle_are_found_by_their_equal_values():
    """Noise fills the values below the limit; 1 % of the samples are at it, and seldom two of them in a row."""
    generator = np.random.default_rng(0)
    time = np.arange(3000) / 50
    clean = np.cos(2 * np.pi * time) + 0.2 * np.cos(6 * np.pi * time + 0.4)
    values = clean + 0.02 * generator.standard_normal(3000)
    limit = np.quantile(values, 0.99)
    clipped = np.minimum(values, limit)
    low, high = faults.clipped_of(clipped, [])
    assert low.size == 0 and high.tolist() == np.flatnonzero(clipped == limit).tolist()
    assert not faults.in_rows(high)
    recording = bp.Recording.from_arrays(time, {"x": clipped})
    (finding,) = recording.check(frequency=1.0).findings
    assert (finding.kind, finding.count) == ("clipped", 30) and finding.severity != "harmless"
    for sound in (np.cos(2 * np.pi * time), values):  # the highest values of the signal without noise are equal
        assert [end.size for end in faults.clipped_of(sound, [])] == [0, 0]


@pytest.mark.parametrize("size", [0.01, 0.04])
def test_bias_by_clipping_is_that_of_the_mean_of_many_recordings(size):
    """Least squares of a sine whose upper part is limited, against the stated root sum of squares: within 15 %."""
    generator = np.random.default_rng(1)
    time = np.arange(3000) / 50
    clean = np.cos(2 * np.pi * time + 0.3)
    limit = float(np.quantile(clean + 0.02 * generator.standard_normal(3000), 1.0 - size))
    waves = np.exp(-2j * np.pi * np.outer(np.arange(8), time))
    values = clean + 0.02 * generator.standard_normal((200, 3000))
    change = np.mean([waves @ (np.minimum(one, limit) - one) / 3000 for one in values], axis=0)
    wanted = np.sqrt(np.r_[1.0, np.full(7, 2.0)] @ np.abs(change) ** 2) / (0.02 / np.sqrt(3000))
    effect = Effect(np.nan, np.nan, clean, 0.02, 7)
    assert clipped_effect(effect, time, 1.0, [(1.0, limit)]).bias == pytest.approx(wanted, rel=0.15)
    turned = Effect(np.nan, np.nan, -clean, 0.02, 7)
    assert clipped_effect(turned, time, 1.0, [(-1.0, -limit)]).bias == pytest.approx(wanted, rel=0.15)
