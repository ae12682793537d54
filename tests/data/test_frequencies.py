"""Frequencies of signals step by step: autocorrelation, multiples, tracking, Gauss-Newton steps, uncertainty."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from bayesperiodic.data import harmonics
from bayesperiodic.data.harmonics import Diffusion


def first_peak(time, channels):
    """Return the frequency of the first of the highest peaks of the mean product of values at one distance."""
    count = time.size
    step = (time[-1] - time[0]) / (count - 1)
    even = time[0] + step * np.arange(count)
    signals = [np.interp(even, time, values) for values in channels]
    signals = [(values - values.mean()) / values.std() for values in signals]
    lags = count // 3 + 2
    product = np.array([sum(np.mean(s[: count - lag] * s[lag:]) for s in signals) for lag in range(lags)])
    low = next((lag for lag in range(lags) if product[lag] < 0.5 * product[0]), None)
    if low is None:
        return None
    peaks = [
        lag for lag in range(low + 1, lags - 1)
        if product[lag - 1] <= product[lag] > product[lag + 1] and product[lag] > 0.0
    ]  # fmt: skip
    if not peaks:
        return None
    lag = min(lag for lag in peaks if product[lag] >= 0.9 * max(product[peaks]))
    a, b, c = np.polyfit([-1.0, 0.0, 1.0], product[lag - 1 : lag + 2], 2)
    return 1.0 / ((lag - b / (2.0 * a)) * step)


@pytest.mark.parametrize("seed", range(12))
def test_a_frequency_is_guessed_by_the_first_high_peak_of_the_autocorrelation(seed, monkeypatch):
    """guess_frequency: ripples before the correlation has fallen by half do not count, later peaks of 90 % do."""
    monkeypatch.setattr(harmonics, "_largest_equivalent", lambda time, channels, frequency: frequency)
    generator = np.random.default_rng(seed)
    time = 3.0 + np.cumsum(generator.uniform(0.5, 1.5, 150 + seed))
    rate, phase = generator.uniform(0.025, 0.06), generator.uniform(0.0, 6.0, 4)
    first = np.cos(2 * np.pi * rate * time + phase[0]) + 0.3 * np.cos(2 * np.pi * 7 * rate * time + phase[1])
    second = 90.0 + 5.0 * np.cos(2 * np.pi * (1 + seed % 2) * rate * time + phase[2])
    channels = np.array([first, second]) + generator.uniform(0.0, 0.6) * generator.standard_normal((2, time.size))
    assert harmonics.guess_frequency(time, channels) == pytest.approx(first_peak(time, channels), rel=1e-9)
    assert harmonics.guess_frequency(time, channels[:1]) == pytest.approx(first_peak(time, channels[:1]), rel=1e-9)


def test_a_frequency_is_guessed_of_a_triangle_and_of_peaks_that_are_flat(monkeypatch):
    monkeypatch.setattr(harmonics, "_largest_equivalent", lambda time, channels, frequency: frequency)
    time = np.arange(120.0)
    for signal in (np.abs(time % 16 - 8), (time % 16 < 8) * 1.0, (time % 15 < 2) * 1.0):
        expected = first_peak(time, [signal])
        assert harmonics.guess_frequency(time, signal[None]) == pytest.approx(expected, rel=1e-9)
    for signal in (time, np.sqrt(time)):
        assert harmonics.guess_frequency(time, signal[None]) is first_peak(time, [signal]) is None


def equivalent(shares, per_cycle=50.0, cycles=9.0, frequency=1.0):
    """Return the multiple that _largest_equivalent chooses by the unexplained shares, and the fits that it asks for."""
    time = 2.0 + np.arange(int(cycles * per_cycle) + 1) / (per_cycle * frequency)
    values = np.stack([np.cos(2 * np.pi * frequency * time), 3.0 * np.sin(2 * np.pi * frequency * time)])
    asked = []

    def fitted(at, channels, candidate, count):
        assert at[0] == pytest.approx(time[-1] - 6.0 / frequency, abs=1.01 / (per_cycle * frequency)) and at[0] >= (
            time[-1] - 6.0 / frequency
        )
        assert at[-1] == time[-1] and np.array_equal(channels, values[:, -at.size :])
        asked.append((round(candidate / frequency, 9), count))
        share = shares.get(round(candidate / frequency), 1.0)
        return SimpleNamespace(variances=np.array([0.5, 1.0]) * share * np.var(channels, axis=1))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harmonics, "fit_harmonics", fitted)
        return harmonics._largest_equivalent(time, values, frequency) / frequency, asked


@pytest.mark.parametrize(
    "shares, factor",
    [
        ({1: 0.4, 5: 0.4}, 5), ({1: 0.4, 4: 0.479, 5: 0.481}, 4), ({1: 0.4, 3: 0.1}, 3), ({1: 0.4, 2: 0.48}, 2),
        ({1: 0.4, 2: 0.481}, 1), ({1: 0.499, 2: 0.1}, 2), ({1: 0.501, 2: 0.1}, 1), ({1: 0.0, 3: 0.9e-9}, 3),
        ({1: 0.0, 3: 1.1e-9}, 1), ({1: 0.4, 6: 0.0}, 1),
    ],
)  # fmt: skip
@pytest.mark.parametrize("frequency", [1.0, 0.3])
def test_largest_multiple_that_leaves_as_much_unexplained(shares, factor, frequency):
    """_largest_equivalent: at most a fifth more than the frequency itself, which explains more than half."""
    assert equivalent(shares, frequency=frequency)[0] == pytest.approx(factor)


@pytest.mark.parametrize("per_cycle", [8.3, 8.5, 10.6, 21.0, 21.1, 40.0, 1250.0, 1270.0, 1400.0])
def test_multiples_are_fitted_up_to_the_nyquist_frequency(per_cycle):
    """_largest_equivalent: up to 95 % of it, at most 600 harmonics of the frequency; none of a multiple beyond."""
    top = min(0.95 * 0.5 * per_cycle, 600.0)
    factors = [factor for factor in (1, 5, 4, 3, 2) if factor < top]
    assert equivalent({1: 0.1}, per_cycle)[1] == [(factor, int(top / factor + 1e-9)) for factor in factors]


@pytest.mark.parametrize("per_cycle, cycles", [(10, 5.4), (10, 23.7), (4, 60), (30, 700), (5, 700), (3, 8), (2.2, 40)])
@pytest.mark.parametrize("lost", [False, True])
def test_a_frequency_is_tracked_over_more_and_more_of_the_last_cycles(per_cycle, cycles, lost, monkeypatch):
    """track_frequency: three, six, … up to half of all; of more than 48 every so many, with 384 samples at least.

    The cycles are counted back from the end with the last frequency, 0.1 % more each time; without a fit it stays.
    """
    time = 5.0 + np.arange(round(per_cycle * cycles)) / per_cycle
    values, seen = np.stack([time, -time]), []

    def fitted(part, signals, frequency, highest):
        seen.append((part, signals, frequency, highest))
        return None if lost and len(seen) % 2 else SimpleNamespace(frequency=frequency * 1.001)

    monkeypatch.setattr(harmonics, "nearby_fit", fitted)
    monkeypatch.setattr(harmonics, "covered_harmonics", lambda at, frequency, points: min(at.size, 7 + points % 7))
    result = harmonics.track_frequency(time, values, 1.0)
    total, length, frequency, number = np.ptp(time), 3.0, 1.0, 0
    while True:
        back = time[-1] - time
        part = np.flatnonzero(back <= length / frequency)
        if part.size >= 12:
            every = min(int(np.ceil(length / 48)), max(part.size // 384, 1))
            part = [k for k in part if every == 1 or int(back[k] * frequency) % every == 0]
            assert np.array_equal(seen[number][0], time[part]) and np.array_equal(seen[number][1], values[:, part])
            assert seen[number][2:] == (
                pytest.approx(frequency),
                min(
                    10,
                    7 + time.size % 7,
                ),
            )
            number += 1
            frequency *= 1.0 if lost and number % 2 else 1.001
        if length >= total / 2:
            break
        length = min(2 * length, total / 2)
    assert number == len(seen) and result == pytest.approx(frequency)


def test_a_frequency_without_harmonics_is_not_tracked(monkeypatch):
    monkeypatch.setattr(harmonics, "covered_harmonics", lambda *_: 0)
    monkeypatch.setattr(harmonics, "nearby_fit", None)
    assert harmonics.track_frequency(np.arange(200) / 10.0, np.ones((1, 200)), 1.0) == 1.0


@pytest.mark.parametrize(
    "gradient, information, step",
    [
        (2.0, 4.0, 0.5), (-2.0, 4.0, -0.5), (2.0, 0.0, 0.0), (2.0, -1.0, 0.0), (2.0, np.nan, 0.0),
        (0.99e-3 * 2.0, 4.0, 0.0), (1.01e-3 * 2.0, 4.0, 1.01e-3 / 2.0), (-0.99e-3 * 2.0, 4.0, 0.0), (9.0, 1.0, 2.5),
        (-9.0, 1.0, -2.5), (2.0e-12 * 1e20, 1e20, 0.0), (2.4e-12 * 1e20, 1e20, 2.4e-12),
    ],
)  # fmt: skip
def test_steps_of_a_frequency_that_matter(gradient, information, step):
    """next_step: a thousandth of the standard error, rounding of 10 kHz (2.2e-12), a quarter of a cycle in 0.1 s."""
    assert harmonics.next_step(gradient, information, 1e4, 0.1) == pytest.approx(step, rel=1e-9, abs=0.0)


def test_iteration_for_a_frequency_ends_after_twenty_steps_or_at_a_small_one(monkeypatch):
    time = np.arange(50.0)
    asked, steps = [], iter([0.3, -0.1, 0.0])

    def equation(*given):
        asked.append(given)
        return given[2], "clear", "weights", 5.0, 6.0

    def step(*given):
        assert given[:2] == (5.0, 6.0) and given[3] == 49.0 and given[2] == asked[-1][2]
        return next(steps)

    monkeypatch.setattr(harmonics, "normal_equation", equation)
    monkeypatch.setattr(harmonics, "next_step", step)
    assert harmonics._refined(time, "x", 1.0, 4) == (pytest.approx(1.2), "clear", "weights", 6.0)
    assert [given[2:] for given in asked] == [(1.0, 4), (1.3, 4), (pytest.approx(1.2), 4)]
    monkeypatch.setattr(harmonics, "next_step", lambda *_: 0.5)
    assert harmonics._refined(time, "x", 1.0, 4)[0] == 1.0 + 19 * 0.5


def test_normal_equation_weighs_channels_by_their_residual_variances():
    """normal_equation: 1/variance, at most 1e24 over the power of the signal; no weight of what is not counted."""
    time = np.arange(400) / 10.0
    noise = 0.1 * np.random.default_rng(1).standard_normal(400)
    values = np.stack([7.0 + 3.0 * np.cos(2 * np.pi * time), 3.0 * np.sin(2 * np.pi * time) + noise])
    fit, clear, weights, gradient, information = harmonics.normal_equation(time, values, 1.0, 2)
    assert weights == pytest.approx([1e24 / 4.5, 1.0 / fit.variances[1]], rel=1e-6)
    np.testing.assert_array_equal(clear, harmonics._clear(fit))
    assert (gradient, information) == harmonics._slopes(time, fit, clear, weights)
    counted = harmonics.normal_equation(time, values, 1.0, 2, np.array([0.0, 1.0]))
    assert counted[2] == pytest.approx([0.0, 1.0 / fit.variances[1]])
    assert counted[4] == pytest.approx(harmonics._slopes(time, fit, clear, counted[2])[1]) and counted[4] < information


@pytest.mark.parametrize("moved, information, kept", [(0.99, 1.0, True), (1.01, 1.0, False), (0.0, 0.0, False)])
def test_a_fit_is_nearby_within_a_cycle_of_the_recording(moved, information, kept, monkeypatch):
    """nearby_fit: of 49 s."""
    for sign in (1.0, -1.0):
        fit = SimpleNamespace(frequency=2.0 + sign * moved / 49.0, amplitudes=np.ones(3))
        monkeypatch.setattr(harmonics, "_refined", lambda *_, fit=fit: (fit, None, None, information))
        assert harmonics.nearby_fit(np.arange(50.0), "x", 2.0, 3) is (fit if kept else None)
    nothing = SimpleNamespace(frequency=2.0, amplitudes=np.array([1.0, np.nan]))
    monkeypatch.setattr(harmonics, "_refined", lambda *_: (nothing, None, None, 1.0))
    assert harmonics.nearby_fit(np.arange(50.0), "x", 2.0, 3) is None


@pytest.mark.parametrize("slopes", [(1.0, 1e-9, 1e-9), (1.0, 5e-3, 9e-9), (1.0, 9e-9, 5e-3), (1.0, 0.2, 0.2)])
def test_a_random_walk_widens_the_errors_of_slope_and_drift(slopes, monkeypatch):
    """pace_of: where it adds more to them than the noise of the other orders; the sizes of the test are known."""
    cycles, power, information, asked = 24, 1e3, 50.0, []
    generator = np.random.default_rng(3)
    score, quadrature = 2.0 * generator.standard_normal((2, cycles))
    score += 240.0 * np.linspace(-1.0, 1.0, cycles) ** 2

    def walk(*given):
        asked.append(given)
        return Diffusion(0.7, np.array(slopes))

    monkeypatch.setattr(harmonics, "phase_diffusion", walk)
    pace = harmonics.pace_of(score, quadrature, power, information)
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, cycles), 9, increasing=True))[0].T
    phase = basis @ score / power
    noise = max(np.mean(phase[3:] ** 2), 1.0 / power)
    slope, bent = max(slopes[1], noise), max(slopes[2], noise)
    assert pace.se == pytest.approx(np.sqrt(slope * power / information))
    assert pace.diffusion == (0.7 if slopes[1] > noise else 0.0)
    assert pace.drifts == (abs(phase[2]) > stats.t.isf(0.5e-4, 6) * np.sqrt(bent)) == (slopes[2] < 1e-3)
    ((given, polynomials, least),) = asked
    np.testing.assert_allclose(given, score / power)
    np.testing.assert_allclose(np.abs(polynomials), np.abs(basis[:3]))
    assert least == pytest.approx(min(1.0 / power, 0.5 * np.mean(np.diff(quadrature / power) ** 2)))
    harmonics.pace_of(score, np.zeros(cycles), power, information)
    assert asked[-1][2] == np.finfo(float).tiny
    harmonics.pace_of(score, 1e6 * quadrature, power, information)
    assert asked[-1][2] == 1.0 / power


def test_pace_of_few_cycles():
    """pace_of: of two none; of three to six the amplitude's noise counts too; orders are at most n − 3."""
    assert harmonics.pace_of(np.ones(2), np.ones(2), 4.0, 25.0).se == 0.2
    for cycles in (3, 4, 5, 6, 7, 8):
        generator = np.random.default_rng(cycles)
        score, quadrature = generator.standard_normal((2, cycles))
        basis = np.linalg.qr(np.vander(np.linspace(-1, 1, cycles), min(cycles, 7), increasing=True))[0].T
        phase, amplitude = basis @ score / 1e-3, basis @ quadrature / 1e-3
        rest = np.concatenate([phase[3:], amplitude[1:] if cycles < 7 else []])
        pace = harmonics.pace_of(score, quadrature, 1e-3, 2.0)
        assert pace.freedom == rest.size
        assert pace.se == pytest.approx(np.sqrt(max(np.mean(rest**2), 1e3) * 1e-3 / 2.0))
