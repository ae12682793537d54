"""Fourier fits and their frequency against regressions on explicit bases."""

import numpy as np
import pytest
from scipy import special, stats

from bayesperiodic import _fourier
from bayesperiodic.data import coverage, harmonics
from bayesperiodic.data.harmonics import Pace


def design(phase, highest):
    """Return the real Fourier basis (samples, 2·highest + 1)."""
    columns = [np.ones(phase.size)]
    for h in range(1, highest + 1):
        columns += [np.cos(2 * np.pi * h * phase), np.sin(2 * np.pi * h * phase)]
    return np.column_stack(columns)


def noisy(cycles, per_cycle=20.37, noise=0.1, seed=0):
    """Return the times and two channels of a signal of 2 Hz."""
    time = 3.0 + np.arange(int(cycles * per_cycle)) / (2.0 * per_cycle)
    generator = np.random.default_rng(seed)
    x = 0.4 + np.cos(4 * np.pi * time) + 0.3 * np.sin(8 * np.pi * time)
    y = 5.0 * np.sin(4 * np.pi * time + 0.5) - 1.0
    return time, np.array([x, y]) + noise * np.array([[1.0], [3.0]]) * generator.standard_normal((2, time.size))


def test_fit_is_the_regression_on_the_fourier_basis():
    time, values = noisy(5.3)
    fit = harmonics.fit_harmonics(time, values, 2.0, 3)
    basis = design(2.0 * time, 3)
    coefficients = np.linalg.lstsq(basis, values.T, rcond=None)[0]
    residuals = values.T - basis @ coefficients
    expected = np.concatenate([coefficients[:1], coefficients[1::2] - 1j * coefficients[2::2]]).T
    assert fit.amplitudes == pytest.approx(expected)
    assert fit.residuals == pytest.approx(residuals.T, abs=1e-12)
    assert fit.variances == pytest.approx(np.sum(residuals**2, axis=0) / (time.size - 7))
    few = harmonics.HarmonicFit(1.0, np.zeros((1, 4), dtype=complex), np.ones((1, 6)))
    assert few.variances == pytest.approx([6.0])


def test_refined_frequency_minimises_the_sum_of_the_logarithms_of_the_variances():
    """So does weighting every channel by its residual variance."""
    time, values = noisy(6.4, noise=0.3)
    fit, pace = harmonics.refine_frequency(time, values, 2.003, 1)

    def misfit(frequency):
        basis = design(frequency * time, 1)
        rest = values.T - basis @ np.linalg.lstsq(basis, values.T, rcond=None)[0]
        return np.sum(np.log(np.sum(rest**2, axis=0)))

    step = 0.05 * pace.se
    curvature = (misfit(fit.frequency + step) - 2 * misfit(fit.frequency) + misfit(fit.frequency - step)) / step**2
    slope = (misfit(fit.frequency + step) - misfit(fit.frequency - step)) / (2 * step)
    assert curvature > 0.0
    assert abs(slope / curvature) < 2e-3 * pace.se


def test_significant_harmonics_have_ten_times_the_power_of_the_noise():
    """The noise of a complex amplitude of n values of variance v has the power 4 v/n; the largest always counts."""
    residuals = np.tile([0.2, -0.2], (2, 50))
    noise = 4.0 * 100 * 0.04 / (100 - 9) / 100
    sizes = np.sqrt(noise * np.array([[0.0, 9.99, 10.01, 400.0, 1.0], [0.0, 1.0, 5.0, 4.0, 3.0]]))
    turned = sizes * np.exp(1j * np.arange(10).reshape(2, 5))
    found = harmonics._clear(harmonics.HarmonicFit(1.0, turned, residuals))
    assert (found != 0.0).tolist() == [[False, False, True, True, False], [False, False, True, False, False]]
    assert found[0, 2:4] == pytest.approx(turned[0, 2:4])


def test_information_is_that_left_by_a_regression_on_the_harmonics():
    """Of the slopes t·dy/dφ, with the time t from its mean."""
    time, values = noisy(4.7)
    basis, weights = design(2.0 * time, 2), np.array([3.0, 0.5])
    clear = np.array([[0.0, 1.0, 0.3j], [0.0, 0.5 - 0.2j, 0.0]])
    waves = np.exp(2j * np.pi * np.outer([0, 1, 2], 2.0 * time))
    slopes = np.real((2j * np.pi * clear * [0, 1, 2]) @ waves) * (time - time.mean())
    rest = slopes.T - basis @ np.linalg.lstsq(basis, slopes.T, rcond=None)[0]
    gradient, information = harmonics._slopes(time, harmonics.HarmonicFit(2.0, clear, values), clear, weights)
    assert gradient == pytest.approx(weights @ np.sum(slopes * values, axis=1))
    assert information == pytest.approx(weights @ np.sum(rest**2, axis=0))


@pytest.mark.parametrize(("cycles", "orders"), [(40, 10), (100, 16), (20, 5), (12, 4), (5, 2)])
def test_pace_is_that_of_the_scores_of_single_cycles(cycles, orders):
    """Their regression on orthonormal polynomials: order 2 is the drift, `orders` further ones measure the noise."""
    generator = np.random.default_rng(cycles)
    time = np.arange(cycles * 16) / 16.0
    values = 2.0 * np.cos(2 * np.pi * time)[None] + 0.3 * generator.standard_normal((1, time.size))
    fit = harmonics.fit_harmonics(time, values, 1.0, 1)
    clear, weight = fit.amplitudes * [[0.0, 1.0]], 1.0 / fit.variances
    pace = harmonics._pace(time, fit, clear, weight, information=77.0)
    slope = np.real(2j * np.pi * clear[0, 1] * np.exp(2j * np.pi * time))
    quadrature = np.real(-2 * np.pi * clear[0, 1] * np.exp(2j * np.pi * time))
    score, other = (np.sum((weight[0] * w * fit.residuals[0]).reshape(cycles, 16), axis=1) for w in (slope, quadrature))
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, cycles), orders + 3, increasing=True))[0]
    own = weight[0] * np.sum(slope**2) / cycles
    phase = basis.T @ score / own
    rest = phase[3:] if orders >= 4 else np.concatenate([phase[3:], (basis.T @ other / own)[1:]])
    noise = max(np.mean(rest**2), 1.0 / own)
    assert pace.freedom == rest.size
    assert pace.se == pytest.approx(np.sqrt(noise * own / 77.0))
    bend = phase[2] * basis[:, 2]
    # A phase of b t²/(2T) cycles over T deviates from a line by b T/8, and its frequency changes by b.
    drift = 8.0 * (bend[0] - bend[cycles // 2]) / (cycles - 1) * cycles / (cycles - 1)
    assert pace.drift == pytest.approx(drift, rel=0.05)
    significant = abs(phase[2]) > stats.t.isf(0.5e-4, rest.size) * np.sqrt(noise)
    assert pace.drifts == (significant and np.ptp(bend) > 1 / 360)


@pytest.mark.parametrize("cycles", [17, 60])
@pytest.mark.parametrize("ratio, size", [(0.97, 1.0), (1.03, 1.0), (3.0, 0.97 / 360), (3.0, 1.03 / 360)])
def test_phases_wander_by_more_than_the_amplitudes_and_a_degree(cycles, ratio, size):
    """Sums of squares of orders from 3 on are compared by F at 1e-4; the range is that of these orders, in cycles."""
    orders = min(max(cycles // 4, 4), 16)
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, cycles), orders + 3, increasing=True))[0]
    generator = np.random.default_rng(cycles)
    phase, amplitude = basis[:, 3:] @ generator.standard_normal((2, orders)).T[:, :, None].transpose(1, 0, 2)
    phase, amplitude = size * phase[:, 0] / np.ptp(phase), amplitude[:, 0] / np.linalg.norm(amplitude)
    amplitude = amplitude * np.linalg.norm(phase) / np.sqrt(ratio * stats.f.isf(1e-4, orders, orders))
    power = 1e8 * orders / np.sum(amplitude**2)
    line = 0.3 + 0.1 * np.linspace(-1, 1, cycles) ** 2
    pace = harmonics.pace_of(power * (phase + line), power * (amplitude + line), power, 1.0)
    seen = ratio > 1.0 and size > 1 / 360
    assert pace.wander == pytest.approx(size if seen else 0.0) and pace.varies == (pace.drifts or seen)
    # White noise of the samples is the least for both.
    power = ratio * stats.f.isf(1e-4, orders, orders) * orders / np.sum(phase**2)
    least = harmonics.pace_of(power * phase, np.zeros(cycles), power, 1.0)
    assert least.wander == pytest.approx(size if seen else 0.0)


def test_first_step_towards_a_wandering_phase_is_that_of_dense_equations(monkeypatch):
    """Weighted least squares of what the series leaves, with the walk's differences of variance q f Δt as a prior."""
    monkeypatch.setattr(harmonics, "PHASE_ITERATIONS", 1)
    time, values = noisy(9.3)
    time = time + 0.002 * np.random.default_rng(1).random(time.size)
    fit, step = harmonics.fit_harmonics(time, values, 2.0, 2), 3e-4
    orders = np.arange(3)
    clear = np.where((np.abs(fit.amplitudes) > 0.1) & (orders > 0), fit.amplitudes, 0.0)
    slope = np.real((2j * np.pi * orders * clear) @ np.exp(2j * np.pi * np.outer(orders, 2.0 * time)))
    weights = 1.0 / fit.variances
    information, pull = weights @ slope**2, weights @ (slope * fit.residuals)
    change = np.diff(np.eye(time.size), axis=0)
    prior = change.T @ np.diag(1.0 / (step * 2.0 * np.diff(time))) @ change
    ahead = np.linalg.solve(np.diag(information) + prior, pull)
    line, root = np.column_stack([np.ones(time.size), time]), np.sqrt(information)
    ahead = ahead - line @ np.linalg.lstsq(line * root[:, None], ahead * root, rcond=None)[0]
    found = harmonics.followed_phase(time, values, fit, step)
    assert found == pytest.approx(ahead, rel=1e-6, abs=1e-6 * np.abs(ahead).max())


def test_a_wandering_phase_is_followed_and_the_amplitude_is_not_smeared():
    """A smooth phase of ±0.12 cycles without noise; an angle a over many periods leaves J₀(2π a) of the amplitude."""
    time = np.arange(2000) / 20.0
    phase = 0.12 * np.sin(2 * np.pi * time / 25.0)
    values = np.cos(2 * np.pi * (time + phase))[None] + 0.3 * np.sin(4 * np.pi * (time + phase))
    fit = harmonics.fit_harmonics(time, values, 1.0, 3)
    assert abs(fit.amplitudes[0, 1]) == pytest.approx(special.j0(2 * np.pi * 0.12), abs=0.02)
    ahead = harmonics.followed_phase(time, values, fit, 1e-2)
    line = np.polynomial.polynomial.polyfit(time, phase, 1)
    assert ahead == pytest.approx(phase - np.polynomial.polynomial.polyval(time, line), abs=0.01)
    again = harmonics.fit_harmonics(time + ahead, values, 1.0, 3)
    assert np.abs(again.amplitudes[0]) == pytest.approx([0.0, 1.0, 0.3, 0.0], abs=0.02)


@pytest.mark.parametrize("change", [0.004, -0.004])
def test_drift_of_a_chirp_is_its_change_of_frequency(change):
    time = np.arange(60 * 20) / 20.0
    phase = time + 0.5 * change * (time - 30.0) ** 2 / 60.0
    values = np.cos(2 * np.pi * phase)[None] + 0.01 * np.random.default_rng(0).standard_normal((1, time.size))
    pace = harmonics.refine_frequency(time, values, 1.0, 2)[1]
    assert pace.drift == pytest.approx(change, rel=0.05)
    assert pace.drifts


def test_frequency_of_fewer_than_three_cycles_has_the_error_of_white_noise():
    time = np.arange(30) / 12.0
    fit = harmonics.fit_harmonics(time[:24], np.cos(2 * np.pi * time[:24])[None], 1.0, 1)
    assert harmonics._pace(time[:24], fit, fit.amplitudes, np.ones(1), 25.0) == Pace(0.2, 0, 0.0, False)


def test_a_frequency_differs_significantly_and_by_a_degree():
    limit = stats.t.ppf(1 - 0.5e-4, 6)
    pace = Pace(0.01, 6, 0.0, False)
    assert pace.differs(1.001 * limit * 0.01, 10.0) and pace.differs(-1.001 * limit * 0.01, 10.0)
    assert not pace.differs(0.999 * limit * 0.01, 10.0)
    assert Pace(1e-9, 6, 0.0, False).differs(1.001 / 3600, 10.0)
    assert not Pace(1e-9, 6, 0.0, False).differs(-0.999 / 3600, 10.0)


@pytest.mark.parametrize("fundamental", [1.0, 1.7])
def test_the_fundamental_is_found_although_a_harmonic_is_stronger(fundamental):
    time = 2.0 + np.arange(700) / 50.0
    wave = [np.cos(2 * np.pi * fundamental * h * time + h) for h in range(4)]
    x = 3.0 + 0.4 * wave[1] + wave[3]
    y = 0.02 * wave[1] + 0.2 * wave[2]
    assert harmonics.guess_frequency(time, np.array([x])) == pytest.approx(fundamental, rel=5e-3)
    assert harmonics.guess_frequency(time, np.array([x, y])) == pytest.approx(fundamental, rel=5e-3)


def test_signals_without_a_period_have_no_frequency():
    time = np.arange(200) / 10.0
    assert harmonics.guess_frequency(time, time[None]) is None
    assert harmonics.guess_frequency(time, np.cos(2 * np.pi * 0.06 * time)[None]) is None


@pytest.mark.parametrize("samples, seen", [(120, True), (119, False)])
def test_a_frequency_is_guessed_of_three_cycles_or_more(samples, seen):
    frequency = harmonics.guess_frequency(
        np.arange(samples) / 10.0, np.sin(np.pi * np.arange(samples) / 20 + 0.3)[None]
    )
    assert (frequency == pytest.approx(0.25, rel=0.02)) if seen else frequency is None


@pytest.mark.parametrize("factor", [2, 3, 4, 5])
def test_a_divisor_of_the_frequency_is_replaced_by_it(factor):
    time = np.arange(900) / 60.0
    values = np.array([np.cos(2 * np.pi * 2.0 * time) + 0.2 * np.cos(12 * np.pi * time), np.sin(4 * np.pi * time)])
    values += 0.02 * np.random.default_rng(0).standard_normal(values.shape)
    assert harmonics._largest_equivalent(time, values, 2.0 / factor) == pytest.approx(2.0)
    assert harmonics._largest_equivalent(time, values, 2.0) == 2.0


def test_a_channel_with_the_lower_frequency_keeps_it():
    time = np.arange(900) / 60.0
    x, y = np.cos(4 * np.pi * time), np.cos(2 * np.pi * time) + np.cos(4 * np.pi * time)
    assert harmonics._largest_equivalent(time, np.array([x, y]), 1.0) == 1.0


@pytest.mark.parametrize("cycles", [7, 200])
def test_a_tracked_frequency_is_that_of_the_later_part(cycles):
    """The frequency changes by 2 % at the middle; the guess is wrong by as much as three cycles allow."""
    frequency = 3.0
    time = np.arange(cycles * 20 + 1) / (20 * frequency)
    late = np.cumsum(np.where(time > 0.5 * time[-1], 1.0, 0.98)) / 20.0
    found = harmonics.track_frequency(time, np.cos(2 * np.pi * late)[None], 0.99 * frequency)
    assert found == pytest.approx(frequency, rel=1e-3)


def test_resolved_harmonics_are_those_of_the_samples_and_of_the_grid():
    """At 9.9 samples per cycle four harmonics are below half of the rate, fewer on a coarse grid."""
    time = np.arange(100) / 9.9
    assert coverage.resolved_harmonics(time, 1.0, 200) == 4
    assert coverage.resolved_harmonics(time, 1.0, 7) == 3
    assert coverage.resolved_harmonics(time, 1.0, 6) == 2
    assert coverage.resolved_harmonics(np.arange(100) / 9.37, 1.0, 200, asked=7) == 7


@pytest.mark.parametrize("turns", [-7, -1, 0, 1, 1000])
def test_angles_are_reduced_to_half_a_turn(turns):
    angles = np.array([-3.141, -0.5, -1e-9, 0.0, 0.25, 3.141])
    reduced = _fourier.within_half_turn(angles + 2 * np.pi * turns)
    assert reduced == pytest.approx(angles, rel=0, abs=abs(turns) * 2e-15)


@pytest.mark.parametrize("start, near", [(1.02, True), (0.97, True), (1.16, False)])
def test_a_fit_that_moves_to_another_number_of_cycles_is_none(start, near):
    """Of eight cycles, from 1.16 Hz to 1 Hz by 1.3 cycles."""
    time = np.arange(160) / 20.0
    values = sum(size * np.cos(2 * np.pi * (k + 1) * time + k + 0.3) for k, size in enumerate((0.2, 0.5, 1.0)))[None]
    fit = harmonics.nearby_fit(time, values, start, 3)
    assert harmonics.refine_frequency(time, values, start, 3)[0].frequency == pytest.approx(1.0)
    assert (fit is not None) == near and (fit is None or fit.frequency == pytest.approx(1.0))
