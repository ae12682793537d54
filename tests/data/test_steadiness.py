"""The steady part of recordings: ramps, rests and transients are left out, and what is steady is kept."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.data import inspection, steadiness
from tests.known import NOISES

PER_CYCLE = 40


def design(phase, highest):
    """Return the real Fourier basis (samples, 2·highest + 1)."""
    columns = [np.ones(phase.size)]
    for h in range(1, highest + 1):
        columns += [np.cos(2 * np.pi * h * phase), np.sin(2 * np.pi * h * phase)]
    return np.column_stack(columns)


def times(cycles, per_cycle=PER_CYCLE):
    return np.arange(round(cycles * per_cycle)) / per_cycle


def wave(time):
    return np.cos(2 * np.pi * time + 0.4) + 0.2 * np.sin(6 * np.pi * time)


def recorded(envelope, noise=0.01, seed=0, per_cycle=PER_CYCLE):
    """Return a recording of 1 Hz with this amplitude at each sample, and white noise."""
    time = np.arange(envelope.size) / per_cycle
    error = noise * np.random.default_rng(seed).standard_normal(time.size)
    return bp.Recording.from_arrays(time, {"y": envelope * wave(time) + error}, name="run")


def first_amplitude(experiment, channel="y"):
    """Return the complex amplitude of harmonic 1."""
    signal = experiment.outputs[channel]
    return 2 * np.fft.rfft(signal)[1] / signal.size


def test_amplitudes_of_windows_of_one_cycle_are_those_of_least_squares():
    """Unequal steps of time; windows begin at every eighth of a cycle, counted from the end."""
    generator = np.random.default_rng(3)
    time = 5.0 + np.sort(generator.uniform(0.0, 4.3, 301)) / 2.0
    values = np.cos(4 * np.pi * time) + 0.3 * generator.standard_normal((2, time.size)) + 0.5
    found = steadiness.windows(time, values, 2.0)
    assert (found.overlap, found.cycles) == (8, 1)
    assert found.amplitudes.shape[1:] == (2, 6)
    assert found.last[-1] == time.size
    for first, last, amplitudes in zip(found.first, found.last, found.amplitudes, strict=True):
        assert np.ptp(time[first:last]) * 2.0 < 1.0
        for row, signal in enumerate(values):
            basis = design(2.0 * time[first:last], 5)
            fitted = np.linalg.lstsq(basis, signal[first:last] / signal.std(), rcond=None)[0]
            expected = np.concatenate([[fitted[0]], fitted[1::2] - 1j * fitted[2::2]])
            assert amplitudes[row] == pytest.approx(expected, rel=1e-7, abs=1e-9)


def test_windows_that_do_not_overlap_are_whole_cycles_up_to_the_end():
    time = times(6.3)
    apart = steadiness.windows(time, wave(time)[None], 1.0).apart()
    assert apart.last.tolist() == [time.size - k * PER_CYCLE for k in range(5, -1, -1)]
    assert (apart.last - apart.first).tolist() == [PER_CYCLE] * 6


def test_windows_of_long_recordings_are_of_several_cycles():
    time = times(1200, per_cycle=16)
    found = steadiness.windows(time, wave(time)[None], 1.0)
    assert (found.overlap, found.cycles) == (1, 1200 // 256)
    assert len(found.first) == 1200 // found.cycles
    assert np.abs(found.amplitudes[:, 0, 1]) * wave(time).std() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("cycles", [3, 4, 6, 7.5, 12, 30, 64, 65, 300])
def test_exact_steady_cycles_are_all_used(cycles):
    steady = recorded(np.ones(times(cycles).size), noise=0.0).fold(32, frequency=1.0)
    assert steady.cycles == int(cycles)
    assert not any(finding.severity != "harmless" for finding in steady.findings)


@pytest.mark.parametrize(
    ("cycles", "lost", "runs"),
    [(3, 0.0, 20), (4, 0.0, 20), (6, 0.01, 40), (10, 0.08, 40), (20, 0.04, 30), (60, 0.02, 15)],
)
def test_cycles_with_white_noise_are_rarely_lost(cycles, lost, runs):
    """A rest of a transient is suspected by chance; this is the mean share of the cycles that it costs."""
    ones = np.ones(cycles * PER_CYCLE)
    used = [recorded(ones, 0.02, seed).fold(32, frequency=1.0).cycles for seed in range(runs)]
    assert 1.0 - np.mean(used) / cycles <= lost


@pytest.mark.filterwarnings("ignore:run. only the last")
@pytest.mark.parametrize("kind", ["white", "autoregressive, 0.9", "autoregressive, 0.99", "1/f"])
def test_cycles_with_coloured_noise_are_rarely_lost(kind):
    """At 5 % noise not more than 15 % of the cycles on average."""
    shares = []
    for seed in range(10):
        time = times(30)
        noise = 0.05 * NOISES[kind](time, np.random.default_rng(seed))
        check = bp.Recording.from_arrays(time, {"y": wave(time) + noise}).check(1.0)
        shares.append(check.cycles / 30)
    assert np.mean(shares) >= 0.85


@pytest.mark.parametrize("size", [0.005, 0.01])
def test_slow_wander_of_the_amplitude_costs_few_cycles(size):
    """A stationary amplitude with a correlation time of four cycles; not more than a quarter of the cycles is lost."""
    shares = []
    for seed in range(10):
        generator = np.random.default_rng(seed)
        wander = np.zeros(40)
        for k in range(1, 40):
            wander[k] = np.exp(-0.25) * wander[k - 1] + np.sqrt(1 - np.exp(-0.5)) * generator.standard_normal()
        envelope = 1.0 + size * np.interp(times(40), np.arange(40), wander)
        shares.append(recorded(envelope, 0.002, seed).check(1.0).cycles / 40)
    assert np.mean(shares) >= 0.75


@pytest.mark.filterwarnings("ignore:run. only")
@pytest.mark.parametrize(("up", "down"), [(6, 0), (0, 6), (6, 6), (12, 0), (0, 12), (10, 10)])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_ramps_are_left_out_and_the_amplitude_is_that_between_them(up, down, noise):
    """Of 30 cycles; the amplitude between the ramps is 1, that of the whole recording is at most 0.9."""
    time = times(30)
    envelope = np.clip(np.minimum(time / up if up else 1.0, (30 - time) / down if down else 1.0), 0, 1)
    run = recorded(envelope, noise)
    e = run.fold(32, frequency=1.0)
    error = np.sqrt(e.amplitude_variance["y"][1])
    assert abs(first_amplitude(e)) == pytest.approx(1.0, abs=0.002 + 4.0 * error)
    assert 30 - up - down - 3 <= e.cycles <= 30 - up - down + 1 + 40 * noise
    check = run.check(1.0)
    ramps = [finding for finding in check.findings if finding.kind == "ramp"]
    assert len(ramps) == (up > 0) + (down > 0)
    assert {finding.severity for finding in ramps} == {"harmless"}
    for ramp in ramps:
        assert ramp.times[0, 0] == time[0] or ramp.times[0, 1] == time[-1]


@pytest.mark.filterwarnings("ignore:run. only")
def test_ramps_of_a_recording_of_seven_cycles_are_left_out():
    """Two cycles up, three and a half steady, one and a half down."""
    time = times(7, per_cycle=200)
    envelope = np.clip(np.minimum(time / 2, (7 - time) / 1.5), 0, 1)
    e = recorded(envelope, 0.002, per_cycle=200).fold(64)
    assert e.cycles == 3
    assert e.frequency == pytest.approx(1.0, abs=2e-3)
    assert abs(first_amplitude(e)) == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("rest", [0.3, 1.0, 2.5, 7.0])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_rest_at_the_start_is_left_out(rest, noise):
    time = times(20)
    e = recorded((time >= rest).astype(float), noise).fold(32, frequency=1.0)
    error = np.sqrt(e.amplitude_variance["y"][1])
    assert abs(first_amplitude(e)) == pytest.approx(1.0, abs=1e-6 + 4.0 * error)
    assert e.cycles >= int(20 - rest) - 2


@pytest.mark.filterwarnings("ignore:run. only")
def test_a_rest_longer_than_the_motion_is_not_the_steady_part():
    time = times(40)
    e = recorded((time >= 25).astype(float)).fold(32, frequency=1.0)
    assert abs(first_amplitude(e)) == pytest.approx(1.0, abs=0.01)
    assert 12 <= e.cycles <= 15


@pytest.mark.parametrize(("up", "down"), [(30, 0), (15, 15), (0, 30)])
def test_a_recording_without_a_steady_part_is_refused_with_the_range_of_its_amplitude(up, down):
    time = times(30)
    envelope = 0.1 + 0.9 * np.clip(np.minimum(time / up if up else 1.0, (30 - time) / down if down else 1.0), 0, 1)
    run = recorded(envelope, 0.001)
    message = (
        r"^recording: must have a steady part of 3 cycles, got 'run', in which the amplitude of 'y' changes "
        r"throughout, from 1\d% of its largest value on; record at a constant amplitude, or select a part by "
        r"`between`\.$"
    )
    with pytest.raises(ValueError, match=message):
        run.fold(32, frequency=1.0)
    with pytest.raises(ValueError, match=message):
        run.steady(1.0)


def test_single_odd_cycles_in_the_middle_are_kept():
    """A disturbed cycle inside is part of the noise; leaving out what is before it would cost half of the cycles."""
    envelope = np.ones(30 * PER_CYCLE)
    envelope[15 * PER_CYCLE : 16 * PER_CYCLE] = 1.05
    assert recorded(envelope, 0.01).check(1.0).cycles >= 28


DURATION, STEP, FREQUENCY = 150.0, 0.05, 0.2


@cache
def duffing():
    """Return 150 s of x'' + 0.2 x' + x + 0.5 x³ = cos(2π 0.2 t) from rest, after 600 s, and its times."""
    time = np.arange(0, DURATION, STEP)
    motion = solve_ivp(
        lambda s, y: [y[1], np.cos(2 * np.pi * FREQUENCY * s) - 0.2 * y[1] - y[0] - 0.5 * y[0] ** 3],
        (0, 600 + DURATION),
        [0, 0],
        rtol=1e-10,
        atol=1e-12,
        max_step=0.5,
        dense_output=True,
    ).sol
    return time, motion(time)[0], motion(time + 600)[0]


def scores(channels, seeds, noise):
    """Return the errors of amplitudes 0 to 3 from rest in their stated standard errors (runs·channels, 7), cycles."""
    time, start, late = duffing()
    exact = np.linalg.lstsq(design(FREQUENCY * time, 9), late, rcond=None)[0][:7]
    rows, cycles = [], []
    for seed in range(seeds):
        generator = np.random.default_rng(seed)
        outputs = {f"x{i}": start + noise * generator.standard_normal(time.size) for i in range(channels)}
        e = bp.Recording.from_arrays(time, outputs, {"f": np.cos(2 * np.pi * FREQUENCY * time)}).fold(
            64, frequency=FREQUENCY, harmonics=3
        )
        cycles.append(e.cycles)
        for name, values in e.outputs.items():
            found = np.linalg.lstsq(design(np.arange(64) / 64, 3), values, rcond=None)[0]
            variance = np.repeat(e.amplitude_variance[name] / [1, 2, 2, 2], [1, 2, 2, 2])
            rows.append((found - exact) / np.sqrt(variance))
    return np.array(rows), cycles


@pytest.mark.filterwarnings("ignore:recording. only")
@pytest.mark.parametrize(
    ("noise", "seeds"),
    [(0.002, 25), pytest.param(0.002, 100, marks=pytest.mark.slow), pytest.param(0.01, 100, marks=pytest.mark.slow)],
)
def test_bias_by_the_transient_of_a_duffing_oscillator_from_rest_is_small(noise, seeds):
    """Below 0.3 standard errors of each amplitude, whose mean has the standard error 1/√seeds (2.8 of it, 1 %)."""
    found, cycles = scores(1, seeds, noise)
    mean = found.mean(axis=0)
    assert np.abs(mean).max() < 0.3 + 2.8 / np.sqrt(seeds)
    # The square of the mean is larger by that of its error, on average.
    assert np.mean(mean**2) < 0.3**2 + 2.0 / seeds
    assert np.mean(found**2) < 1.4
    assert min(cycles) >= 9


@pytest.mark.filterwarnings("ignore:recording. only")
@pytest.mark.parametrize(
    ("noise", "seeds"),
    [(0.002, 2), pytest.param(0.002, 12, marks=pytest.mark.slow), pytest.param(0.01, 12, marks=pytest.mark.slow)],
)
def test_bias_by_the_transient_in_twenty_channels_is_small(noise, seeds):
    """The channels have the same transient, which they show together, and noise of their own."""
    found, cycles = scores(20, seeds, noise)
    mean = found.mean(axis=0)
    assert np.abs(mean).max() < 0.3 + 2.8 / np.sqrt(len(found))
    assert np.mean(mean**2) < 0.3**2
    assert np.mean(found**2) < 1.4
    assert min(cycles) >= 9


def test_a_slow_transient_is_left_out_as_far_as_it_biases():
    """It decays in 2 of 60 cycles, from 3 % of the amplitude: of the mean over all it is 1.7 standard errors."""
    time = times(60)
    scores = []
    for seed in range(10):
        e = recorded(1.0 + 0.03 * np.exp(-time / 2), 0.02, seed).fold(32, frequency=1.0)
        assert e.cycles >= 29
        scores.append((abs(first_amplitude(e)) - 1.0) / np.sqrt(e.amplitude_variance["y"][1] / 2))
    assert np.mean(scores) < 0.5 + 1.6 / np.sqrt(10)


def test_a_transient_of_few_cycles_before_a_ramp_is_left_out_or_in_the_stated_error():
    """The force falls to zero from 50 s on; the motion starts from rest and decays by e in two cycles."""
    time = np.arange(0, DURATION, STEP)

    def force(s):
        return np.clip((DURATION - s) / 100.0, 0, 1) * np.cos(2 * np.pi * FREQUENCY * s)

    def steady(s):
        return np.cos(2 * np.pi * FREQUENCY * s)

    def motion(drive, times):
        return solve_ivp(
            lambda s, y: [y[1], drive(s) - 0.2 * y[1] - y[0] - 0.5 * y[0] ** 3],
            (0, times[-1]),
            [0, 0],
            rtol=1e-9,
            atol=1e-11,
            max_step=0.5,
            t_eval=times,
        ).y[0]

    # One period after 60, when the transient is below 1e-13.
    late = 60 / FREQUENCY + np.arange(64) / 64 / FREQUENCY
    exact = np.fft.rfft(motion(steady, late))[1] / 32
    x = motion(force, time) + 0.01 * np.random.default_rng(1).standard_normal(time.size)
    run = bp.Recording.from_arrays(time, {"x": x}, {"force": force(time)})
    check = run.check()
    assert check.start >= 2.0 / FREQUENCY
    assert check.stop <= 60.0
    assert check.cycles >= 3
    e = run.fold(64, frequency=FREQUENCY, harmonics=3)
    assert abs(np.fft.rfft(e.outputs["x"])[1] / 32 - exact) < np.sqrt(e.amplitude_variance["x"][1])


@pytest.mark.parametrize("begins", [0.0, 0.37])
def test_the_frequency_of_a_recording_that_is_steady_throughout_is_refined_once(begins, monkeypatch):
    """Windows are whole cycles from the end, so that a part of all of them need not begin with the first sample."""
    calls, refinement = [], inspection.refine_groups
    monkeypatch.setattr(inspection, "refine_groups", lambda *given: calls.append(given) or refinement(*given))
    time = begins + np.arange(0.0, 40.3, 0.05)
    x = np.cos(2 * np.pi * time - 0.3) + 0.01 * np.random.default_rng(1).standard_normal(time.size)
    run = bp.Recording.from_arrays(time, {"x": x}, {"force": np.cos(2 * np.pi * time)}).fold(32)
    assert run.cycles == 40 and len(calls) == 1
