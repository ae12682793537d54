"""Least squares of a Fourier series on samples at any times, and the fundamental frequency that suits them best."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz

from bayesperiodic import fourier

MOST_HARMONICS = 600
CLEAR = 10.0


@dataclass(frozen=True)
class HarmonicFit:
    """A Fourier series fitted to several channels.

    Attributes
    ----------
    frequency : float
        Fundamental frequency [Hz].
    amplitudes : array (channels, harmonics + 1), complex
        As in `fourier`, phases counted from the time origin of the fit.
    residuals : array (channels, samples)
    """

    frequency: float
    amplitudes: np.ndarray
    residuals: np.ndarray

    @property
    def degrees_of_freedom(self) -> int:
        """Samples less fitted coefficients, at least 1."""
        return max(self.residuals.shape[1] - (2 * self.amplitudes.shape[1] - 1), 1)

    @property
    def variances(self) -> np.ndarray:
        """Residual variance of each channel, (channels,)."""
        return np.sum(self.residuals**2, axis=1) / self.degrees_of_freedom


def fit_harmonics(time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int) -> HarmonicFit:
    """Fit harmonics 0 … `harmonics` of `frequency` to channels (channels, samples) by least squares.

    The normal equations of the exponentials exp(2πi h f t), h = −H … H, form a Hermitian Toeplitz matrix; it is well
    conditioned as long as the samples resolve the highest harmonic.
    """
    turn = np.exp(-2j * np.pi * frequency * time)
    power = np.ones_like(turn)
    moments = np.empty(2 * harmonics + 1, dtype=complex)
    right = np.empty((2 * harmonics + 1, len(channels)), dtype=complex)
    for h in range(2 * harmonics + 1):
        moments[h] = power.sum()
        if h <= harmonics:
            right[harmonics + h] = channels @ power
            right[harmonics - h] = np.conj(right[harmonics + h])
        power *= turn
    amplitudes = solve_toeplitz((moments, np.conj(moments)), right)[harmonics:].T.copy()
    amplitudes[:, 1:] *= 2.0
    phase = frequency * time
    residuals = np.stack([y - fourier.at_times(c, phase) for y, c in zip(channels, amplitudes, strict=True)])
    return HarmonicFit(frequency, amplitudes, residuals)


def refine_frequency(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int, iterations: int = 20
) -> tuple[HarmonicFit, float]:
    """Return the fit at the least-squares frequency, and that frequency's standard error [Hz].

    Gauss-Newton on the fundamental with the amplitudes projected out; every channel is weighted by its residual
    variance. The standard error adds the scores of one cycle before squaring, so that correlation within a cycle is
    accounted for; it is never below that for independent samples. Only harmonics whose squared amplitude is ten times
    its noise, and the largest, take part in the slope, where noise would pass for information.
    """
    for _ in range(iterations):
        fit, slope, weights = _linearised(time, channels, frequency, harmonics)
        information = float(np.sum(weights * np.sum(slope**2, axis=1)))
        step = float(np.sum(weights * np.sum(slope * fit.residuals, axis=1))) / information
        limit = 0.25 / np.ptp(time)
        frequency += np.clip(step, -limit, limit)
        if abs(step) < max(1e-6 / np.sqrt(information), np.finfo(float).eps * frequency):
            break
    fit, slope, weights = _linearised(time, channels, frequency, harmonics)
    cycle = np.floor((time - time[0]) * frequency).astype(int)
    scores = np.sum(weights[:, None] * slope * fit.residuals, axis=0)
    clustered = float(np.sum(np.bincount(cycle, scores) ** 2))
    return fit, float(np.sqrt(max(clustered, information))) / information


def _linearised(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int
) -> tuple[HarmonicFit, np.ndarray, np.ndarray]:
    fit = fit_harmonics(time, channels, frequency, harmonics)
    noise = 4.0 * fit.variances[:, None] / time.size
    power = np.abs(fit.amplitudes) ** 2
    largest = power[:, 1:].max(axis=1, keepdims=True)
    clear = np.where((power > CLEAR * noise) | (power == largest), fit.amplitudes, 0.0)
    rate = fourier.derivative(clear, 1.0)
    slope = np.stack([fourier.at_times(c, frequency * time) for c in rate]) * (time - time.mean())
    slope = fit_harmonics(time, slope, frequency, harmonics).residuals
    floor = 1e-24 * np.var(channels, axis=1)
    return fit, slope, 1.0 / np.maximum(fit.variances, floor)


def guess_frequency(time: np.ndarray, channels: np.ndarray) -> float | None:
    """Return the fundamental frequency [Hz] that the autocorrelation suggests, None where it has no positive peak.

    The smallest lag whose peak reaches 90 % of the highest is taken, then multiples of its frequency are preferred
    where they explain the signals as well.
    """
    samples = time.size
    step = (time[-1] - time[0]) / (samples - 1)
    even = time[0] + step * np.arange(samples)
    correlation = np.zeros(samples)
    for values in channels:
        signal = np.interp(even, time, values)
        signal = (signal - signal.mean()) / signal.std()
        power = np.abs(np.fft.rfft(signal, 2 * samples)) ** 2
        correlation += np.fft.irfft(power)[:samples] / np.arange(samples, 0, -1)
    correlation = correlation[: samples // 3 + 2]
    negative = np.flatnonzero(correlation < 0.5 * correlation[0])
    if negative.size == 0:
        return None
    inside = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inside >= correlation[:-2]) & (inside > correlation[2:]))
    peaks = peaks[(peaks > negative[0]) & (correlation[peaks] > 0.0)]
    if peaks.size == 0:
        return None
    lag = peaks[np.flatnonzero(correlation[peaks] >= 0.9 * correlation[peaks].max())[0]]
    left, top, right = correlation[lag - 1 : lag + 2]
    bend = left - 2.0 * top + right
    offset = 0.5 * (left - right) / bend if bend else 0.0
    return _largest_equivalent(time, channels, 1.0 / ((lag + offset) * step))


def _largest_equivalent(time: np.ndarray, channels: np.ndarray, frequency: float) -> float:
    last = time >= time[-1] - 6.0 / frequency
    time, channels = time[last], channels[:, last]
    nyquist = 0.5 * (time.size - 1) / np.ptp(time)
    top = min(0.95 * nyquist, MOST_HARMONICS * frequency)

    def unexplained(candidate: float) -> float:
        fit = fit_harmonics(time, channels, candidate, max(int(top / candidate), 1))
        return float(np.max(fit.variances / np.var(channels, axis=1)))

    reference = unexplained(frequency)
    for factor in (5, 4, 3, 2):
        candidate = factor * frequency
        if candidate < top and reference < 0.5 and unexplained(candidate) <= 1.2 * reference + 1e-9:
            return candidate
    return frequency
