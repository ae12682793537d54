"""Faults of sensors that mean periods show: saturation, holds, heavy tails, and phases that are missing."""

import re
import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic import _fourier
from bayesperiodic.data import inspection
from bayesperiodic.data.faults import ChannelFaults
from bayesperiodic.data.harmonics import HarmonicFit, fit_harmonics
from bayesperiodic.data.saturation import means_of, phase_bins, saturation_of
from bayesperiodic.data.signals import Signals

RATE, CYCLES, NOISE = 50, 60, 0.01
TIME = np.arange(CYCLES * RATE) / RATE
EXACT = np.array([0.0, np.exp(0.4j), 0.0, 0.2 * np.exp(1j)])
CLEAN = np.cos(2 * np.pi * TIME + 0.4) + 0.2 * np.cos(6 * np.pi * TIME + 1.0)


def noise(seed, size=NOISE):
    return size * np.random.default_rng(seed).standard_normal(TIME.size)


def recorded(values):
    return bp.Recording.from_arrays(TIME, {"x": values}, name="run")


def scores(experiment):
    """Return |error|²/variance of the first and third amplitude."""
    found = np.fft.rfft(experiment.outputs["x"])[:4] / experiment.outputs["x"].size * [1, 2, 2, 2]
    return (np.abs(found - EXACT) ** 2 / experiment.amplitude_variance["x"][:4])[[1, 3]]


@pytest.mark.parametrize("share", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("both", [False, True])
def test_saturation_before_the_noise_is_named_with_its_level_and_share_and_not_refused(share, both):
    level = np.quantile(CLEAN, 1.0 - share / (1 + both))
    limited = np.clip(CLEAN, -level if both else -np.inf, level)
    run = recorded(limited + noise(0))
    check = run.check(1.0)
    (finding,) = check.findings
    assert (finding.kind, finding.severity) == ("saturated", "serious")
    assert finding.share == pytest.approx(share, abs=0.03)
    named = [float(v) for v in re.findall(r"-?\d\.\d+", finding.text.split(" from ")[0])]
    assert named == pytest.approx([-level, level] if both else [level], abs=0.003)
    assert "Either a sensor or a stop limits it" in finding.text
    assert "or it is limited itself, as a force of friction or contact" in finding.text
    change = (np.fft.rfft(limited - CLEAN)[: 4 * CYCLES : CYCLES]) / TIME.size
    expected = np.sqrt(np.abs(change) ** 2 @ [1, 2, 2, 2]) / (NOISE / np.sqrt(TIME.size))
    assert finding.bias == pytest.approx(expected, rel=0.1)
    with pytest.warns(UserWarning, match="run: x stays at"):
        run.fold(64, frequency=1.0)


def stick():
    """Return a displacement that rests for a tenth of each half cycle, and leaves its rest at no velocity."""
    place = TIME % 1.0
    moved = np.minimum(2 * np.pi * (place % 0.5) / 0.8, np.pi)
    return np.where(place < 0.5, -np.cos(moved), np.cos(moved))


PHASE = 2 * np.pi * TIME
FLAT = {
    **{f"tanh {a}": np.tanh(a * np.cos(PHASE)) for a in (1.5, 3.0, 10.0, 50.0)},
    "Coulomb friction": np.sign(np.cos(PHASE + 0.1)) + 0.3 * np.cos(PHASE),
    "contact": np.maximum(np.cos(PHASE) + 0.3, 0.0),
    "stick": stick(),
    "maximally flat": np.cos(PHASE) - np.cos(3 * PHASE) / 9,
    "pulse": np.exp(-0.5 * ((TIME % 1.0 - 0.5) / 0.05) ** 2),
}


@pytest.mark.parametrize("size", [0.0, 0.003, 0.01, 0.05])
@pytest.mark.parametrize("values", FLAT.values(), ids=[*FLAT])
def test_flat_tops_of_the_motion_itself_have_no_serious_findings(values, size):
    assert recorded(values + noise(1, size)).check(1.0).severity == "harmless"


def test_a_level_without_noise_is_no_refused_fault_of_a_sensor():
    """Without noise, a force that a valve limits is not told from a clipped sensor; with noise on the others it is."""
    limited = np.clip(np.cos(PHASE), -0.7, 0.7)
    with pytest.warns(UserWarning, match="Either a sensor or a stop limits it, .* or it is limited itself"):
        e = recorded(limited).fold(64, frequency=1.0)
    assert e.findings[0].kind == "saturated"
    with pytest.raises(ValueError, match="is clipped at -0.7 and 0.7"):
        recorded(np.clip(np.cos(PHASE) + noise(0), -0.7, 0.7)).fold(64, frequency=1.0)


@pytest.mark.parametrize(("length", "count", "step"), [(3, 20, 0.0), (5, 1, 0.0), (5, 100, 0.0), (8, 100, 0.002)])
def test_short_holds_are_found_and_left_out(length, count, step):
    """At least 95 % of the held samples are found, and 5 % of those found are chance at most."""
    values, held = CLEAN + noise(2), np.zeros(TIME.size, dtype=bool)
    values = step * np.round(values / step) if step else values
    for first in 8 + 24 * np.random.default_rng(0).choice(120, count, replace=False):
        values[first : first + length] = values[first]
        held[first : first + length] = True
    run = recorded(values)
    found = np.isin(np.arange(TIME.size), run.check(1.0).bad["x"]["stuck"])
    assert np.count_nonzero(found & held) >= 0.95 * np.count_nonzero(held)
    assert np.count_nonzero(found & ~held) <= max(0.05 * np.count_nonzero(found), 1)
    assert np.all(scores(run.without(stuck=True, frequency=1.0).fold(64, frequency=1.0)) < 12.0)


@pytest.mark.parametrize("step", [0.0, 0.002, 0.01, 0.02])
def test_quantised_noise_has_no_short_holds(step):
    """Twenty recordings; each has one by chance with a probability of 0.001."""
    for seed in range(20):
        values = CLEAN + noise(seed)
        values = step * np.round(values / step) if step else values
        assert recorded(values).check(1.0).bad["x"]["stuck"].size == 0


@pytest.mark.parametrize("freedom", [2.0, 3.0])
def test_heavy_tails_are_noise_that_biases_nothing(freedom):
    """Student's t: the mean of 60 squares of unit size is at most 1.5 without a bias."""
    squares, kinds = [], set()
    for seed in range(30):
        error = NOISE * np.random.default_rng(seed).standard_t(freedom, TIME.size)
        e = recorded(CLEAN + error).fold(64, frequency=1.0, harmonics=3)
        squares.append(scores(e))
        kinds |= {(finding.kind, finding.severity) for finding in e.findings}
    assert np.mean(squares) < 1.5
    assert ("outliers", "serious") not in kinds and ("outliers", "ruinous") not in kinds
    assert freedom > 2.0 or ("heavy tails", "harmless") in kinds


def test_clipped_samples_are_left_out_with_their_phases_so_that_noise_does_not_select():
    """Of 20 recordings with a tenth of the samples at each end clipped, the squares of errors are of unit size."""
    squares = []
    for seed in range(20):
        run = recorded(np.clip(CLEAN + noise(seed), -1.04, 1.04)).without(clipped=True, frequency=1.0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            squares.append(scores(run.fold(64, frequency=1.0, harmonics=3)))
    assert np.mean(squares) < 2.0


def test_harmonics_that_missing_phases_do_not_determine_are_named_with_the_share():
    run = recorded(np.clip(CLEAN + noise(0), -0.74, 0.74)).without(clipped=True, frequency=1.0)
    with pytest.raises(ValueError, match=r"must have samples at all phases of its period, .* none are at 4\d% of each"):
        run.fold(64, frequency=1.0)


def test_long_runs_at_the_limit_are_clipped_and_not_stuck():
    time = np.arange(60 * 200) / 200
    values = np.cos(2 * np.pi * time) + NOISE * np.random.default_rng(0).standard_normal(time.size)
    check = bp.Recording.from_arrays(time, {"x": np.minimum(values, 0.5)}).check(1.0)
    assert [finding.kind for finding in check.findings] == ["clipped"]


def test_a_stuck_stretch_beside_clipping_is_found():
    values = np.clip(CLEAN + noise(0), -1.04, 1.04)
    values[1003:1018] = values[1003]
    check = recorded(values).check(1.0)
    assert check.bad["x"]["stuck"].tolist() == [*range(1003, 1018)]


@pytest.mark.parametrize("share, left_out", [(0.019, False), (0.021, True)])
def test_others_at_a_phase_are_left_out_if_two_percent_of_them_are_clipped(share, left_out):
    """Of 1000 samples at each of ten phases, whose intervals they fill."""
    phase = np.repeat(np.arange(1000), 10) + np.tile(np.arange(10) / 10, 1000)
    clipped = 10 * np.arange(round(1000 * share)) + 3
    beside = inspection._same_phases(phase, clipped)
    assert beside.tolist() == (10 * np.arange(1000) + 3).tolist() * left_out


def example(highest):
    """Return signals whose phases lie in the first 0.6 of each cycle, with this highest harmonic, and a fit of two."""
    time = (np.arange(50)[:, None] + np.arange(60) / 100).ravel() / 4.0
    values = 2.0 + np.cos(8 * np.pi * time) + 0.5 * np.cos(8 * np.pi * highest * time + 0.3)
    values = values + 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    used = Signals("run", time, ("x",), values[None], 0)
    return used, fit_harmonics(time, values[None], 4.0, 2)


def test_harmonics_that_are_shown_and_not_determined_are_named_with_share_period_and_channel():
    used, fit = example(3)
    text = inspection.undetermined(used, fit, 9)
    assert text.startswith(
        "recording: must have samples at all phases of its period, got 'run', in which none are at 40% of"
    )
    assert (
        "each period of 0.25 s: the others determine 2 harmonics, and 'x' has 3 at least. Record again without" in text
    )
    one = fit_harmonics(used.time, used.values, 4.0, 1)
    assert "the others determine 1 harmonic, and 'x' has" in inspection.undetermined(used, one, 9)
    assert inspection.undetermined(used, fit, 2) == ""  # no more are resolved
    assert inspection.undetermined(*example(2), 9) == "" == inspection.undetermined(*example(1), 9)


PERIOD, BEFORE = 0.5, 80
PLACE = np.arange(3000) / 50.0  # in cycles, of a period of half a second
LEVEL, ORDERS = 0.8, np.array([0.0, 1.0 + 0j, 0.0, 0.2j])


def part_used(*channels, faults=None, series=None):
    """Return faults of channels, signals, a fit with these series (channels, orders), by default of the clean wave."""
    series = np.stack([ORDERS] * len(channels)) if series is None else series
    used = Signals("run", 7.0 + PERIOD * PLACE, tuple("abc"[: len(channels)]), np.array(channels), 0)
    residuals = used.values - _fourier.at_times(series, used.time / PERIOD)
    return faults or [ChannelFaults() for _ in channels], used, HarmonicFit(1.0 / PERIOD, series, residuals)


def wave():
    return _fourier.at_times(ORDERS[None], PLACE)[0]


def limited(seed=3, size=1e-3):
    """Return a wave between -∞ and the level, with noise, and the amplitudes of the limited wave."""
    values = np.minimum(wave(), LEVEL)
    amplitudes = np.fft.rfft(values)[: 20 * 60 : 60] / values.size * np.r_[1.0, np.full(19, 2.0)]
    return values + noise(seed, size), amplitudes


@pytest.mark.parametrize("share", [0.3, 0.89, 0.91])
def test_flat_tops_are_those_of_the_samples_without_faults(share):
    """Of all samples, if less than a tenth are sound. Numbers of samples are those of the recording."""
    values, amplitudes = limited()
    stuck = [slice(10, 30), slice(BEFORE - 30, BEFORE + 1), slice(BEFORE + 100, BEFORE + 100 + int(3000 * share))]
    brief, outliers = np.array([5, BEFORE + 2980, BEFORE + 3000]), np.array([BEFORE - 1, BEFORE + 2999])
    wrong = np.zeros(3000, dtype=bool)
    wrong[0] = wrong[2980] = wrong[2999] = True
    wrong[100 : 100 + int(3000 * share)] = True
    values[wrong] += 3.0
    other = wave() + noise(4, 1e-3)
    faults = [ChannelFaults(stuck=stuck, brief=brief), ChannelFaults(outliers=outliers)]
    faults, used, fit = part_used(values, other, faults=faults, series=np.stack([amplitudes, np.r_[ORDERS, [0] * 16]]))
    inspection.describe_limits(faults, used, fit, BEFORE)
    sound = ~wrong if share < 0.9 else np.ones(3000, dtype=bool)
    phase = used.time / PERIOD
    means = means_of(phase_bins(phase[sound]), fit.residuals[0][sound], amplitudes, 0.0)
    expected = saturation_of(means)
    assert (faults[0].saturation is None) == (expected is None) == (share == 0.89)  # of 330 samples none is seen
    assert faults[0].saturation_bias == pytest.approx(expected.bias(means.error) if expected else 0.0, rel=1e-9)
    assert faults[1].saturation is None and faults[1].saturated.size == 0
    if share > 0.3:
        return
    assert faults[0].saturation.high == pytest.approx(LEVEL, abs=1e-3) and faults[0].saturation.low == -np.inf
    flat = np.flatnonzero(np.abs(wave() - LEVEL) > 0.02)
    at = np.isin(np.arange(3000) + BEFORE, faults[0].saturated)
    assert np.array_equal(at[flat], (wave() > LEVEL)[flat])


@pytest.mark.parametrize("size, step, noisy", [(1e-2, 0.0, True), (1e-2, 0.018, True), (1e-2, 0.023, False),
                                               (0.8e-3, 0.0, True), (0.55e-3, 0.0, False)])  # fmt: skip
def test_clipped_samples_are_beside_noise_that_is_more_than_half_a_step_and_a_thousandth(size, step, noisy):
    """The standard deviation of the values is 0.67, of which a thousandth is noise; its estimate is 3 % from it."""
    clean = np.minimum(wave(), LEVEL)
    values = clean + np.where(clean < LEVEL, noise(5, size), 0.0)
    high = np.flatnonzero(wave() > LEVEL)
    outside = np.array([BEFORE - 75, BEFORE - 25])  # at phases of the lowest values, if counted from the end
    fault = ChannelFaults(step=step, high=high + BEFORE, low=outside)
    (fault,), used, fit = part_used(values, faults=[fault])
    inspection.describe_limits([fault], used, fit, BEFORE)
    assert fault.noisy == noisy
    number = phase_bins(used.time / PERIOD).centre.size
    place = np.floor((PLACE + 7.0 / PERIOD + 0.5 / number) % 1.0 * number)
    assert fault.beside.tolist() == (np.flatnonzero(np.isin(place, place[high])) + BEFORE).tolist()


def test_a_level_without_noise_is_that_of_its_clipped_samples():
    values, amplitudes = limited(size=0.0)
    high = np.flatnonzero(values == LEVEL)[3:] + BEFORE  # as given, whatever the series has
    for size, saturated in ((0.0, high.tolist()), (0.01, [])):
        (fault,), used, fit = part_used(
            values + np.where(values < LEVEL, noise(6, size), 0.0), faults=[ChannelFaults(high=high)],
            series=amplitudes[None],
        )  # fmt: skip
        inspection.describe_limits([fault], used, fit, BEFORE)
        assert fault.saturation is not None and fault.noisy == bool(size)
        assert fault.saturated.tolist() == saturated and (fault.saturation_bias > 10.0) == (not size)


def test_impulses_of_random_size_in_the_part_used_are_heavy_tails():
    """Both signs, sizes from 10 to 60 standard deviations; clipped channels have no such finding."""
    places = np.r_[0, np.arange(1, 19) * 150 + 7, 2999]
    values = wave() + noise(7, 1e-3)
    values[places] += 1e-3 * np.geomspace(10.0, 60.0, 20) * np.tile([1.0, -1.0], 10)
    outside = [BEFORE - 1, BEFORE + 3000]
    given = np.sort([*outside, *(places + BEFORE)])
    faults = [ChannelFaults(outliers=given), ChannelFaults(outliers=given, high=np.array([BEFORE + 33]))]
    faults, used, fit = part_used(values, values, faults=faults)
    inspection.describe_limits(faults, used, fit, BEFORE)
    assert faults[0].tails.tolist() == (places + BEFORE).tolist() and faults[1].tails.size == 0
    assert [fault.outliers.tolist() for fault in faults] == [outside] * 2
    # Values that replace the signal follow it, and are faults.
    values = wave() + noise(7, 1e-3)
    values[places] = 0.0
    (fault,), used, fit = part_used(values, faults=[ChannelFaults(outliers=given)])
    inspection.describe_limits([fault], used, fit, BEFORE)
    assert fault.outliers.tolist() == given.tolist() and fault.tails.size == 0
