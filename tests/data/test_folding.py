import re
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

import bayesperiodic as bp
from bayesperiodic import _fourier
from bayesperiodic.data import folding, harmonics, lines
from bayesperiodic.data.harmonics import fit_harmonics
from bayesperiodic.data.lines import Sampling
from tests.known import NOISES, autoregressive, grid

FREQUENCY = 2.317


def recording(cycles=20.3, per_cycle=119.37, noise=0.05, seed=0, transient=0.0, channels=("x", "y"), offset=0.0):
    time = offset + np.arange(int(cycles * per_cycle)) / (per_cycle * FREQUENCY)
    generator = np.random.default_rng(seed)
    angle = 2 * np.pi * FREQUENCY * time
    x = np.sin(angle) + 0.2 * np.sin(3 * angle + 0.5)
    y = mean_period(angle) + transient * np.exp(-(time - time[0]) * FREQUENCY)
    noisy = [s + noise * generator.standard_normal(time.size) for s in (x, y)]
    return bp.Recording.from_arrays(time, {"y": noisy[1]}, {"x": noisy[0]} if "x" in channels else {})


def mean_period(angle):
    return 0.7 + np.cos(angle + 0.3) + 0.3 * np.sin(2 * angle) + 0.1 * np.cos(5 * angle)


@pytest.mark.slow
def test_frequency_errors_have_the_stated_standard_error():
    """250 recordings: z-scores have unit variance or, the larger of two estimates being taken, up to a quarter less.

    The band is the two-sided 1 % band of χ².
    """
    scores = []
    for seed in range(250):
        e = recording(cycles=30.2, per_cycle=15.7, seed=seed, noise=0.1).fold(64)
        scores.append((e.frequency - FREQUENCY) / e.frequency_se)
    low, high = stats.chi2.ppf([0.005, 0.995], 250)
    assert 0.75 * low < np.sum(np.square(scores)) < high
    assert abs(np.mean(scores)) < 2.58 / np.sqrt(250)


def test_mean_period_is_exact_on_a_grid_incommensurate_with_the_sampling():
    e = recording(noise=0.0).fold(800)
    assert e.outputs["y"] == pytest.approx(mean_period(2 * np.pi * grid(800)), abs=1e-9)
    assert e.frequency == pytest.approx(FREQUENCY, rel=1e-12)
    assert e.cycles == 20


def test_noise_free_input_ends_the_frequency_refinement(monkeypatch):
    """Its frequency is exact before a step is small compared with its standard error."""
    calls, original = [], harmonics.fit_harmonics
    monkeypatch.setattr(harmonics, "fit_harmonics", lambda *given: calls.append(given) or original(*given))
    time = np.arange(716) / (119.37 * 2.0)
    x, y = np.sin(4 * np.pi * time), np.cos(4 * np.pi * time) + 0.1 * np.random.default_rng(1).standard_normal(716)
    assert bp.Recording.from_arrays(time, {"y": y}, {"x": x}).fold(100).frequency == pytest.approx(2.0, rel=1e-12)
    assert len(calls) < 20


def test_significant_harmonics_are_kept():
    e = recording().fold(800)
    assert e.harmonics == {"x": 3, "y": 5}
    assert e.independent == {"y": 11}


def test_false_alarm_rate_of_kept_harmonics_is_the_nominal_one():
    """1 % false alarms a channel: of 300 channels at most 9 keep one too many (binomial, 99.8 %)."""
    kept = [recording(cycles=10.2, per_cycle=41.3, seed=s).fold(200).harmonics for s in range(150)]
    wrong = sum((k["x"] != 3) + (k["y"] != 5) for k in kept)
    assert wrong <= stats.binom.ppf(0.998, 300, 0.01)


def test_transient_is_dropped():
    clean = recording(transient=0.0, noise=0.02).fold(100)
    disturbed = recording(transient=3.0, noise=0.02).fold(100)
    assert clean.cycles == 20
    assert 10 <= disturbed.cycles <= 17
    assert disturbed.outputs["y"] == pytest.approx(clean.outputs["y"], abs=0.02)


def test_rest_before_the_motion_is_dropped():
    moving = recording(cycles=15.0, noise=0.01)
    rest = 300
    time = np.arange(moving.time.size + rest) / moving.sampling_rate
    still = np.random.default_rng(1).normal(scale=0.01, size=rest)
    e = bp.Recording.from_arrays(
        time, {"y": np.concatenate([still, moving.outputs["y"]])}, {"x": np.concatenate([still, moving.inputs["x"]])}
    ).fold(100)
    assert e.frequency == pytest.approx(FREQUENCY, rel=1e-4)
    assert 12 <= e.cycles <= 14


def test_scatter_is_that_of_one_cycle_within_the_kept_harmonics():
    """White noise of sd 0.05: the kept harmonics hold the share (2H + 1)/119.37 of its variance.

    The mean of 12 recordings has the standard error 1.4 % (2 · 19 · 11 degrees of freedom a recording).
    """
    values = [recording(seed=s).fold(200).scatter["y"] for s in range(12)]
    assert np.mean(values) == pytest.approx(0.05 * np.sqrt(11 / 119.37), rel=0.05)


@pytest.mark.slow
def test_variance_of_the_mean_amplitudes_is_the_observed_one():
    experiments = [recording(seed=s, cycles=12.1).fold(100, frequency=FREQUENCY, harmonics=5) for s in range(200)]
    amplitudes = np.array([np.fft.rfft(e.outputs["y"])[1:6] * 2 / 100 for e in experiments])
    stated = np.mean([e.amplitude_variance["y"][1:] for e in experiments], axis=0)
    actual = np.mean(np.abs(amplitudes - amplitudes.mean(axis=0)) ** 2, axis=0)
    assert stated.mean() == pytest.approx(actual.mean(), rel=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("noise", NOISES.values(), ids=[*NOISES])
def test_variance_of_the_mean_is_right_within_half_under_noise_of_any_spectrum(noise):
    """2000 recordings of 20 cycles: the sampling errors of the ratios are 4 % at DC and 2 % at harmonics 1 and 2."""
    time, generator = np.arange(2000) / 100.0, np.random.default_rng(0)
    stated, actual = np.zeros(3), np.zeros(3)
    for _ in range(2000):
        signals = folding.Signals("slow", time, ("y",), noise(time, generator)[None], 0)
        fit = fit_harmonics(time, signals.values, 1.0, 3)
        stated += folding._noise(signals, fit, 0, Sampling.of(time, 1.0, 3, 20))[1].variance[:3]
        actual += np.abs(fit.amplitudes[0, :3]) ** 2
    assert np.all(stated < 1.5 * actual)
    assert np.all(stated > actual / 1.5)


def test_tone_between_two_harmonics_counts_as_noise_of_the_nearest_one_alone():
    """The variance is the mean power of five lines on each side, one of which is the tone's."""
    time = np.arange(2000) / 100.0
    y = np.cos(2 * np.pi * time) + 0.3 * np.cos(2 * np.pi * 5.1 * time)
    e = bp.Recording.from_arrays(time, {"y": y}).fold(64, frequency=1.0, harmonics=8)
    variance = np.zeros(9)
    variance[5] = 0.3**2 / 10
    assert e.cycles == 20
    # The possible rest of a transient in these exact data is added.
    assert e.amplitude_variance["y"] == pytest.approx(variance, abs=1e-3 * variance[5])


@pytest.mark.parametrize(("cycles", "freedom"), [(3, 4), (10, 16), (20, 20), (100, 64)])
def test_freedom_of_the_variance_is_twice_the_number_of_lines(cycles, freedom):
    time = np.arange(cycles * 16) / 16
    y = np.cos(2 * np.pi * time) + 0.1 * np.random.default_rng(0).standard_normal(time.size)
    e = bp.Recording.from_arrays(time, {"y": y}).fold(16, frequency=1.0, harmonics=5)
    assert e.amplitude_freedom["y"][1:].tolist() == [freedom] * 5
    assert 2.0 <= e.amplitude_freedom["y"][0] <= 16.0


def test_slow_noise_is_extrapolated_to_the_mean_with_few_degrees_of_freedom():
    """Expected powers of lines 1, 2, … of a random walk fall as 1/j²; those of white noise are equal."""
    line = np.arange(1.0, 41.0)
    slow, freedom = lines._at_zero(line**-2)
    assert slow > 3.0
    assert freedom == pytest.approx(2.0, abs=0.1)
    white, freedom = lines._at_zero(np.ones(40))
    assert white == pytest.approx(1.0, rel=0.1)
    assert freedom > 10.0
    assert lines._at_zero(np.zeros(40))[0] == 0.0


@pytest.mark.slow
def test_false_alarm_rate_of_kept_harmonics_is_the_nominal_one_under_slow_noise():
    """1 % false alarms a recording: of 250 at most 9 (binomial, 99.9 %)."""
    time, wrong = np.arange(2000) / 100.0, 0
    for seed in range(250):
        y = np.cos(2 * np.pi * time) + 0.1 * autoregressive(0.99)(time, np.random.default_rng(seed))
        wrong += bp.Recording.from_arrays(time, {"y": y}).fold(128, frequency=1.0).harmonics["y"] > 1
    assert wrong <= stats.binom.ppf(0.999, 250, 0.01)


def test_origin_shifts_the_phase():
    e = recording(noise=0.0, offset=3.0).fold(100, origin=3.0 + 0.25 / FREQUENCY)
    start = 2 * np.pi * FREQUENCY * 3.0
    assert e.outputs["y"] == pytest.approx(mean_period(start + 2 * np.pi * (grid(100) + 0.25)), abs=1e-8)


def test_response_of_two_forcing_periods_is_folded_exactly():
    time = np.arange(3000) / 100.3
    x, y = np.cos(2 * np.pi * FREQUENCY * time), np.cos(np.pi * FREQUENCY * time) + np.sin(2 * np.pi * FREQUENCY * time)
    e = bp.Recording.from_arrays(time, {"y": y}, {"x": x}).fold(50, periods=2)
    assert e.frequency == pytest.approx(FREQUENCY, rel=1e-9)
    assert e.outputs["y"].size == 100
    assert e.outputs["y"] == pytest.approx(np.cos(np.pi * e.tau) + np.sin(2 * np.pi * e.tau), abs=1e-6)


def test_unequal_steps_are_allowed():
    generator = np.random.default_rng(2)
    time = np.sort(generator.uniform(0, 10, 1500))
    y = mean_period(2 * np.pi * FREQUENCY * time)
    e = bp.Recording.from_arrays(time, {"y": y}).fold(100, harmonics=8)
    assert e.outputs["y"] == pytest.approx(mean_period(2 * np.pi * grid(100)), abs=1e-6)


def test_multisine_with_hundreds_of_harmonics_finds_its_fundamental():
    samples = 1024
    harmonic = np.arange(1, 400, 2)
    period = np.cos(2 * np.pi * np.arange(samples)[:, None] / samples * harmonic - np.pi * harmonic**2 / 400).sum(
        axis=1
    )
    noise = np.random.default_rng(3).standard_normal(6 * samples)
    time = np.arange(6 * samples) / 1000.0
    e = bp.Recording.from_arrays(time, {"y": np.tile(period, 6) + 0.5 * noise}).fold(2048)
    assert e.frequency == pytest.approx(1000.0 / 1024, rel=1e-5)
    assert e.harmonics["y"] == 399


def test_exactly_three_cycles_are_enough():
    time = np.arange(3 * 64) / 64
    e = bp.Recording.from_arrays(time, {"y": mean_period(2 * np.pi * time)}).fold(64, harmonics=5)
    assert e.cycles == 3
    assert e.outputs["y"] == pytest.approx(mean_period(2 * np.pi * grid(64)), abs=1e-9)
    with pytest.raises(ValueError, match=r"at least 3 cycles, got 2\.98 cycles"):
        bp.Recording.from_arrays(time[1:], {"y": mean_period(2 * np.pi * time[1:])}).fold(64, frequency=1.0)


def test_fewer_than_three_cycles_are_refused():
    with pytest.raises(ValueError, match=r"must have at least 3 cycles, got 2\.\d\d cycles in 'recording'"):
        recording(cycles=2.6, noise=0.0).fold(frequency=FREQUENCY)
    with pytest.raises(ValueError, match="at least 3 cycles, got .*; record longer, or give the forcing frequency"):
        recording(cycles=1.3, noise=0.0).fold()
    with pytest.raises(ValueError, match=r"or check frequency = 2\.317 Hz and periods = 9"):
        recording(cycles=20.3, noise=0.0).fold(frequency=FREQUENCY, periods=9)


def test_constant_input_is_refused():
    time = np.arange(500) / 100
    with pytest.raises(ValueError, match=r"inputs\['x'\]: must vary, got the constant 2; .* its value in `fixed`"):
        bp.Recording.from_arrays(time, {"y": np.sin(9 * time)}, {"x": np.full(500, 2.0)}).fold()


def test_error_for_a_signal_that_is_not_periodic_states_the_periodicity():
    noise = np.random.default_rng(4).standard_normal(4000)
    with pytest.raises(
        ValueError,
        match=r"must be periodic, got 'recording', whose mean period at .* Hz explains only \d+\.\d% .*periodicity",
    ):
        bp.Recording.from_arrays(np.arange(4000) / 100, {"y": noise}).fold()


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_random_walks_are_refused(seed):
    """The autocorrelation of some of them has no positive peak."""
    walk = np.cumsum(np.random.default_rng(seed).standard_normal(2000))
    with pytest.raises(ValueError, match=r"must (be periodic|be steady|have at least 3 cycles), got .*'recording'"):
        bp.Recording.from_arrays(np.arange(2000) / 500, {"y": walk, "z": np.roll(walk, 9)}).fold()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"harmonics": 800}, r"harmonics\['x'\]: must be at most \d+, .*got 800"),
        ({"harmonics": {"z": 3}}, "harmonics: must be one of 'x', 'y', got 'z'"),
        ({"harmonics": 0}, "must be an integer >= 1, got 0"),
        ({"samples": 2}, "samples: must be .*got 2"),
        ({"samples": 64.0}, "samples: must be an integer >= 4, got 64.0; write 64, without a decimal point"),
        ({"origin": "Crossing"}, "origin: must be a time .s. or 'crossing', got 'Crossing'"),
        ({"periods": 0}, "periods: must be .*got 0"),
        ({"frequency": -1.0}, "frequency: must be .*got -1.0"),
        ({"name": "a/b"}, "name: must be a text without .*, got 'a/b'"),
    ],
)
def test_error_names_the_bad_argument(arguments, message):
    with pytest.raises(ValueError, match=message):
        recording().fold(**({"samples": 800} | arguments))


def test_phase_origin_at_a_crossing_does_not_depend_on_the_start_of_the_recording():
    """The fundamental of y is cos(2πτ + 0.3) in the recording's time; its upward crossing is τ = 0 here."""
    for offset in (0.0, 3.17):
        e = recording(noise=0.0, channels=("y",), offset=offset).fold(100, origin="crossing")
        assert e.outputs["y"] == pytest.approx(mean_period(2 * np.pi * grid(100) - 0.5 * np.pi - 0.3), abs=1e-9)
        assert e.origin * FREQUENCY == pytest.approx((-0.25 - 0.3 / (2 * np.pi)) % 1.0, abs=1e-9)


def test_drift_of_a_steady_drive_is_small_where_its_period_is_a_fraction_of_the_response_period():
    """The drive has noise alone at the fundamental of the response."""
    time, random = np.arange(4000) / (50 * FREQUENCY), np.random.default_rng(2)
    angle = 2 * np.pi * FREQUENCY * time
    y = np.cos(angle) + 0.5 * np.cos(angle / 2) + 0.01 * random.standard_normal(time.size)
    drive = {"u": np.sin(angle) + 0.01 * random.standard_normal(time.size)}
    e = bp.Recording.from_arrays(time, {"y": y}, drive).fold(64, periods=2, largest_drift=0.02)
    assert max(map(abs, e.drift.values())) < 0.01


def test_drift_is_the_growth_of_the_strongest_harmonic_over_the_recording():
    """It grows by 0.2 of its mean over 46.34 cycles, by 6 % over half of those."""
    time = np.arange(5000) / 250.0
    noise = 0.01 * np.random.default_rng(0).standard_normal(time.size)
    growth = 1.0 + 0.06 * (time - 10.0) / 20.0
    grown = bp.Recording.from_arrays(time, {"y": growth * np.cos(2 * np.pi * FREQUENCY * time) + noise}, name="grown")
    e = grown.fold(64)
    assert e.cycles > 20
    assert e.drift["y"] == pytest.approx(0.06, rel=0.05)
    assert grown.fold(64, largest_drift=0.07).cycles == e.cycles
    with pytest.raises(
        ValueError, match=r"must be steady, got 'grown', .* strongest harmonic of 'y' changes by .\d\.\d%, .* 1\.0%"
    ):
        grown.fold(64, largest_drift=0.01)
    with pytest.raises(ValueError, match="largest_drift: must be > 0, got 0.0"):
        grown.fold(64, largest_drift=0.0)


def test_a_large_drift_of_the_amplitude_is_reported_with_a_warning():
    time = np.arange(5000) / 250.0
    growth = 1.0 + 0.2 * (time - 10.0) / 20.0
    grown = bp.Recording.from_arrays(time, {"y": growth * np.cos(2 * np.pi * FREQUENCY * time)}, name="grown")
    with pytest.warns(UserWarning, match=r"grown: the amplitude of y changes by \+1\d\.\d+% over the part used"):
        e = grown.fold(64)
    assert e.drift["y"] == pytest.approx(0.2, rel=0.1)


def driven(cycles, noise, seed, per_cycle=50, kind="white"):
    time, generator = np.arange(int(cycles * per_cycle)) / (per_cycle * FREQUENCY), np.random.default_rng(seed)
    angle = 2 * np.pi * FREQUENCY * time
    x = np.sin(angle) + 0.01 * generator.standard_normal(time.size)
    y = np.cos(angle + 0.3) + 0.1 * np.cos(3 * angle) + noise * NOISES[kind](time, generator)
    return bp.Recording.from_arrays(time, {"y": y}, {"x": x}, name="run")


@pytest.mark.parametrize(
    ("cycles", "error"),
    [(6, 1e-3), (6, 0.3), (20, -3e-4), (40, 1e-4), (40, 1e-3), (40, -0.05), (150, 1e-3), (150, 0.3)],
)
def test_wrong_frequency_is_refused_with_both_values(cycles, error):
    wrong = FREQUENCY * (1 + error)
    with pytest.raises(
        ValueError, match=r"frequency: must be that of the recording, .*; correct it, or leave"
    ) as caught:
        driven(cycles, 0.01, 1).fold(64, frequency=wrong)
    estimate, se, given = map(
        float, re.search(r"as ([\d.]+) Hz .*of (\S+) Hz, got ([\d.]+) Hz", str(caught.value)).groups()
    )
    assert abs(estimate - FREQUENCY) < 5 * se and given == pytest.approx(wrong, rel=1e-8)


@pytest.mark.parametrize("error", [0.03, -0.03, 0.1])
def test_clearly_wrong_frequency_of_few_cycles_is_refused(error):
    """A residual four times smaller decides where the phases of single cycles are too few for a test."""
    for seed in range(20):
        with pytest.raises(ValueError, match="frequency: must be that of the recording"):
            driven(4, 0.02, seed).fold(64, frequency=FREQUENCY * (1 + error))


@pytest.mark.parametrize("error", [0.0, 1e-5])
def test_frequency_that_is_right_or_negligibly_wrong_is_accepted_as_exact(error):
    """Over 40 cycles a relative error of 1e-5 is 0.14° of phase."""
    e = driven(40, 0.01, 1).fold(64, frequency=FREQUENCY * (1 + error))
    assert (e.frequency, e.frequency_se) == (FREQUENCY * (1 + error), 0.0)


def test_wrong_frequency_of_a_subharmonic_response_is_refused_in_forcing_periods():
    time = np.arange(3000) / 100.3
    x, y = np.cos(2 * np.pi * FREQUENCY * time), np.cos(np.pi * FREQUENCY * time) + np.sin(2 * np.pi * FREQUENCY * time)
    recording = bp.Recording.from_arrays(time, {"y": y}, {"x": x})
    assert recording.fold(50, periods=2, frequency=FREQUENCY).frequency == FREQUENCY
    with pytest.raises(ValueError, match=r"estimated as 2\.317 Hz .*got 2\.319317 Hz"):
        recording.fold(50, periods=2, frequency=1.001 * FREQUENCY)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*NOISES])
def test_right_frequency_is_accepted_and_the_standard_error_holds_under_noise_of_any_spectrum(kind):
    """60 recordings: no false alarm of 1e-4 each (0.6 %), and few |z| > 3 (binomial at 0.3 %, 1e-4)."""
    scores = []
    for seed in range(60):
        recording = driven(20, 0.3, seed, kind=kind)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*only the last")
            assert recording.fold(64, frequency=FREQUENCY).frequency == FREQUENCY
            e = recording.fold(64)
        scores.append((e.frequency - FREQUENCY) / e.frequency_se)
    assert np.count_nonzero(np.abs(scores) > 3.0) <= stats.binom.isf(1e-4, 60, 2 * stats.norm.sf(3.0))


def drifting(change, cycles=40, noise=0.03):
    """Return a motion whose period grows linearly by `change` over the recording."""
    tau = np.arange(0, cycles, 0.02)
    time = (tau + change * (tau**2 / (2 * cycles) - tau / 2)) / FREQUENCY
    y = mean_period(2 * np.pi * tau) + noise * np.random.default_rng(0).standard_normal(tau.size)
    return bp.Recording.from_arrays(time, {"y": y}, name="free")


@pytest.mark.parametrize("change", [0.012, -0.012, 0.02])
def test_drift_of_the_period_is_reported_with_a_warning(change):
    """The drift over the K cycles used is K/40 of that over the recording."""
    with pytest.warns(
        UserWarning, match=r"free: the period changes by [+-]0\.\d+% over the \d+ cycles used \(of \d+\)"
    ) as caught:
        e = drifting(change).fold(64)
    assert caught[0].filename == __file__
    assert e.period_drift == pytest.approx(change * e.cycles / 40, rel=0.1)


def wandering(size, seed, cycles=60):
    """Return a motion in white noise whose phase is a random walk of so many cycles after one cycle."""
    random = np.random.default_rng(seed)
    phase = np.arange(0, cycles, 0.02)
    phase += size * np.sqrt(0.02) * np.cumsum(random.standard_normal(phase.size))
    y = mean_period(2 * np.pi * phase) + 0.01 * random.standard_normal(phase.size)
    return bp.Recording.from_arrays(np.arange(phase.size) * 0.02 / FREQUENCY, {"y": y}, name="free")


@pytest.mark.parametrize("seed", range(5))
def test_irregular_phase_is_reported_with_a_warning(seed):
    with pytest.warns(UserWarning, match=r"free: the phase wanders irregularly by [\d.e+]+° of the response period"):
        wandering(0.005, seed).fold(64)


@pytest.mark.parametrize("coefficient", [0.0, 0.9, 0.99, 0.999])
def test_noise_is_no_irregular_phase(coefficient):
    """At a false-alarm rate of 1e-4, one alarm in twenty recordings has probability 0.002."""
    for seed in range(5):
        random = np.random.default_rng(seed)
        time = np.arange(3000) / (50 * FREQUENCY)
        noise = 0.05 * autoregressive(coefficient)(time, random)
        y = mean_period(2 * np.pi * FREQUENCY * time) + noise
        with warnings.catch_warnings():
            warnings.filterwarnings("error", ".*wanders")
            bp.Recording.from_arrays(time, {"y": y}).fold(64)


@pytest.mark.parametrize(("cycles", "points"), [(3, 12), (7, 20), (41, 16), (101, 12)])
def test_lines_between_harmonics_are_those_of_the_fourier_transform(cycles, points):
    signal = np.random.default_rng(1).standard_normal((cycles, points))
    power = np.abs(np.fft.fft(signal.ravel())) ** 2
    time = np.arange(cycles * points) / points
    sampling = lines.Sampling.of(time, 1.0, 1, cycles)
    assert sampling.points == 4 * points
    beside, each = sampling.lines(signal.ravel(), 3)
    np.testing.assert_allclose(each, np.fft.rfft(signal, axis=1)[:, :3] / points, atol=1e-12)
    found = np.abs(beside) ** 2 * signal.size**2
    for side in range(1, len(found) + 1):
        np.testing.assert_allclose(found[side - 1, :points], power[side::cycles], rtol=1e-9)


def test_constant_period_has_no_drift():
    assert abs(drifting(0.0).fold(64).period_drift) < 2e-4


def test_warning_if_not_more_than_half_of_a_recording_is_used():
    """Of three levels the longest is used, the last one here."""
    time = np.arange(4000) / 100.0
    level = np.where(time < 12.0, 3.0, np.where(time < 24.0, 2.5, 2.0))
    y = level * np.cos(2 * np.pi * time) + 0.01 * np.random.default_rng(0).standard_normal(4000)
    with pytest.warns(UserWarning, match=r"only the last 1[456] of \d+ cycles are used"):
        e = bp.Recording.from_arrays(time, {"y": y}).fold(64)
    assert abs(np.fft.rfft(e.outputs["y"])[1]) / 32 == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(("first", "last"), [(300, 500), (1000, 1400), (2050, 2380), (2399, 2700)])
def test_cycles_are_counted_over_a_gap(first, last):
    time = np.arange(3000) / 100.0
    keep = (np.arange(3000) < first) | (np.arange(3000) >= last)
    recording = bp.Recording.from_arrays(time[keep], {"y": np.cos(4 * np.pi * time[keep])}, name="run")
    e = recording.fold(64)
    assert e.frequency == pytest.approx(2.0, rel=1e-9)
    assert e.outputs["y"] == pytest.approx(np.cos(2 * np.pi * grid(64)), abs=1e-8)
    assert [round(part.fold(64).frequency, 6) for part in recording.split()] == [2.0] * len(recording.split())


def test_lost_samples_of_less_than_a_quarter_period_do_no_harm():
    time = np.arange(3000) / 100.0
    keep = np.random.default_rng(0).uniform(size=3000) > 0.1
    e = bp.Recording.from_arrays(time[keep], {"y": mean_period(2 * np.pi * time[keep])}).fold(64, harmonics=8)
    assert e.outputs["y"] == pytest.approx(mean_period(2 * np.pi * grid(64)), abs=1e-9)


@pytest.mark.parametrize("scale", [1e-160, 1e160])
def test_values_whose_squares_are_no_numbers_are_refused(scale):
    time = np.arange(1000) / 100.0
    with pytest.raises(ValueError, match=r"outputs\['y'\]: must be between 1e-100 and 1e\+100 in size, got up to 1e"):
        bp.Recording.from_arrays(time, {"y": scale * np.cos(4 * np.pi * time)}).fold(64)


def test_huge_grid_is_refused_before_it_is_allocated():
    with pytest.raises(ValueError, match="samples: must be at most 500000 for 2 periods, got 1000000000"):
        recording().fold(10**9, periods=2)


@pytest.mark.parametrize("harmonics", [1, 2, 59, 400])
def test_sums_and_series_at_any_times_are_those_of_the_definition(harmonics):
    generator = np.random.default_rng(0)
    phase, values = generator.uniform(-2.0, 3.0, 700), generator.standard_normal((2, 700))
    amplitudes = generator.standard_normal((2, harmonics + 1)) + 1j * generator.standard_normal((2, harmonics + 1))
    amplitudes[:, 0] = amplitudes[:, 0].real
    waves = np.exp(2j * np.pi * phase[:, None] * np.arange(harmonics + 1))
    assert _fourier.sums(values, phase, harmonics) == pytest.approx(values @ waves.conj(), abs=1e-9)
    assert _fourier.at_times(amplitudes, phase) == pytest.approx((amplitudes @ waves.T).real, abs=1e-9)


def test_work_is_linear_in_the_length_of_a_recording(monkeypatch):
    """Samples that are fitted, per sample of the recording, over both tracking and refinement."""
    sizes, original = [], harmonics.fit_harmonics
    monkeypatch.setattr(
        harmonics, "fit_harmonics", lambda time, *given: sizes.append(time.size) or original(time, *given)
    )
    for cycles in (100, 1600):
        sizes.clear()
        measured = driven(cycles, 0.1, 0, per_cycle=20)
        measured.fold(64)
        assert sum(sizes) < 30_000 + 5 * measured.time.size


@pytest.mark.parametrize("frequency", [FREQUENCY, None])
def test_folding_takes_the_memory_of_few_copies_of_a_channel(frequency):
    """Growth of the peak with the samples of two channels: 7 arrays of one channel's size, not 17 with all terms."""
    peaks, sizes = [], (300_000, 900_000)
    for size in sizes:
        long = recording(cycles=size / 800, per_cycle=800)
        tracemalloc.start()
        try:
            long.fold(64, frequency=frequency)
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert np.diff(peaks) < 10 * 8 * np.diff(sizes)


def test_standard_error_of_the_frequency_under_white_noise_is_that_of_cramer_and_rao_or_up_to_twice_as_large():
    """It is the bound itself where slow noise is not the larger one, by chance in half of the recordings."""
    time = np.arange(6000) / 50.0
    bound = 0.2 / (2 * np.pi) * np.sqrt(24 / 6000) / 120.0
    ratios = []
    for seed in range(20):
        y = np.cos(2 * np.pi * time) + 0.2 * np.random.default_rng(seed).standard_normal(6000)
        ratios.append(bp.Recording.from_arrays(time, {"y": y}).fold(64).frequency_se / bound)
    assert min(ratios) == pytest.approx(1.0, abs=0.04)
    assert max(ratios) < 2.0


@given(
    frequency=st.floats(0.01, 100.0),
    rate=st.floats(11.3, 60.0),
    cycles=st.floats(6.0, 60.0),
    origin=st.floats(-1e3, 1e3),
    amplitudes=st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), min_size=0, max_size=3),
    mean=st.floats(-10.0, 10.0),
)
def test_amplitudes_of_any_exact_signal_are_recovered(frequency, rate, cycles, origin, amplitudes, mean):
    """Rate is in samples a cycle, origin in cycles; the fundamental has amplitude 1, the drive's phase is 0."""
    assume(abs(rate - round(rate)) * cycles > 0.5 or abs(rate - round(rate)) < 1e-9)
    start = origin / frequency
    time = start + np.arange(int(rate * cycles)) / (rate * frequency)
    known = np.array([mean, 1.0, *(complex(*pair) for pair in amplitudes)])

    def signal(tau):
        return sum((c * np.exp(2j * np.pi * h * tau)).real for h, c in enumerate(known))

    tau = frequency * (time - start)
    recording = bp.Recording.from_arrays(time, {"y": signal(tau)}, {"drive": np.cos(2 * np.pi * tau)})
    experiment = recording.fold(64, harmonics=known.size - 1, origin=start)
    assert experiment.frequency == pytest.approx(frequency, rel=1e-9)
    found = np.fft.rfft(experiment.outputs["y"])[: known.size] / 32
    found[0] /= 2
    np.testing.assert_allclose(found, known, atol=1e-6)
