"""Frequencies of slow or irregular sampling: search among spectral lines, and others that explain signals as well."""

import numpy as np

from bayesperiodic.data.coverage import covered_harmonics
from bayesperiodic.data.harmonics import MINIMUM_CYCLES, HarmonicFit, nearby_fit

# Samples that are searched, points of a grid of time for the shortest period, and the highest frequency in mean
# sampling rates.
SEARCHED, POINTS_PER_PERIOD, HIGHEST_RATE = 4000, 8, 30.0
# Largest spectral lines whose frequencies, and parts of them, may be the fundamental, and harmonics that are compared.
LARGEST_LINES, DIVISORS, COMPARED_HARMONICS = 8, (1, 2, 3), 5
# Least height of the spectral window where frequencies may be confused, so many peaks that are compared, and the
# difference of the deviances of two frequencies that tells them.
CONFUSED, WINDOW_PEAKS, TELLING_DEVIANCE = 0.7, 12, 25.0
# Least height of the window at the rate of regular times.
REGULAR_WINDOW = 0.99
# Points between lines at which a peak of the window is searched; residuals of exact signals, relative to them.
FINE_LINES, EXACT_RESIDUAL = 17, 1e-6
# Least share of the variance that a frequency explains.
LEAST_EXPLAINED = 0.5


def spectral_lines(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (lines,), four for each one of the recording, and powers there of signals (channels, samples).

    Samples are added at the nearest points of a fine grid of time, whatever the times are.
    """
    step = float(np.ptp(time)) / (time.size - 1) / (HIGHEST_RATE * POINTS_PER_PERIOD)
    place = np.rint((time - time[0]) / step).astype(int)
    length = 1 << int(4 * (place[-1] + 1)).bit_length()
    count = length // POINTS_PER_PERIOD
    spectra = np.array([np.fft.rfft(np.bincount(place, row), length)[:count] for row in values])
    return np.arange(count) / (length * step), np.abs(spectra / time.size) ** 2


def search_frequency(time: np.ndarray, values: np.ndarray, guess: float | None) -> float | None:
    """Return the fundamental frequency that explains signals (channels, samples) best, the lowest one of aliases.

    Candidates are a guess, the largest lines of the spectrum, and parts of them; None explains half of the variance.
    """
    scaled = (values - values.mean(axis=1, keepdims=True)) / values.std(axis=1, keepdims=True)
    frequency, power = spectral_lines(time, np.concatenate([scaled, np.ones((1, time.size))]))
    slow = 4 * MINIMUM_CYCLES
    # Drifts and their aliases are no lines.
    window = np.where(frequency * np.median(np.diff(time)) > 0.5, power[-1], 0.0)
    slowly = np.convolve(window > CONFUSED**2, np.ones(2 * slow + 1), "same") > 0.5
    highest = _half_rate(time, *_window_peaks(time, frequency, power[-1]))
    height = np.where(slowly | (frequency > highest), 0.0, power[:-1].sum(axis=0))
    peaks = _peaks(height, MINIMUM_CYCLES / np.ptp(time), frequency)[:LARGEST_LINES]
    candidates = [line / k for line in frequency[peaks] for k in DIVISORS] + ([guess] if guess else [])
    deviances: dict[float, float] = {}
    for candidate in candidates:
        fit = _fitted(time, scaled, candidate, max(int(highest / candidate), 1) if highest < np.inf else None)
        if fit is not None and np.max(fit.variances) < 1.0 - LEAST_EXPLAINED:
            deviances[fit.frequency] = _deviance(fit)
    if not deviances:
        return None
    near = sorted(f for f, deviance in deviances.items() if deviance < min(deviances.values()) + TELLING_DEVIANCE)
    # A multiple that explains as much is the fundamental.
    width = 1.0 / np.ptp(time)
    return next(other for other in reversed(near) if abs(other - round(other / near[0]) * near[0]) < width)


def explains(time: np.ndarray, values: np.ndarray, frequency: float) -> bool:
    """Return whether a frequency explains half of the variance of all signals (channels, samples), by some samples."""
    some = slice(None, None, 1 + time.size // SEARCHED)
    fit = _fitted(time[some], values[:, some], frequency)
    return fit is not None and bool((fit.variances < (1.0 - LEAST_EXPLAINED) * values[:, some].var(axis=1)).all())


def aliases(time: np.ndarray, values: np.ndarray, frequency: float) -> list[float]:
    """Return other frequencies that explain signals (channels, samples) as well as this one, the lowest first.

    They are its sums and differences with frequencies at which the times of the samples are in step.
    """
    lines, power = spectral_lines(time, np.ones((1, time.size)))
    peaks, height = _window_peaks(time, lines, power[0])
    highest = _half_rate(time, peaks, height)
    fitted = _fitted(time, values, frequency, max(int(highest / frequency), 1) if highest < np.inf else None)
    if fitted is None:
        return []
    harmonics = fitted.amplitudes.shape[1] - 1
    others: list[float] = []
    for candidate in sorted({abs(rate + sign * frequency) for rate in peaks for sign in (-1, 1)}):
        fit = _fitted(time, values, candidate, harmonics) if candidate * np.ptp(time) > MINIMUM_CYCLES else None
        near = fit is not None and min(abs(fit.frequency - f) for f in [frequency, *others]) * np.ptp(time) < 1.0
        if fit is not None and not near and _deviance(fit) < _deviance(fitted) + TELLING_DEVIANCE:
            others.append(fit.frequency)
    return sorted(others)


def samples_per_cycle(time: np.ndarray, values: np.ndarray, frequency: float, others: list[float]) -> float:
    """Return the steps of the times' common grid in a cycle of the strongest harmonic, if there are aliases of it."""
    fit = _fitted(time, values, frequency)
    if not others or fit is None:
        return np.inf
    strongest = 1 + int(np.abs(fit.amplitudes[:, 1:]).argmax(axis=1).max())
    return (others[0] + frequency) / (strongest * frequency)


def _peaks(height: np.ndarray, lowest: float, frequency: np.ndarray) -> np.ndarray:
    """Return the local maxima at this frequency or above, the largest first."""
    inside = height[1:-1]
    places = 1 + np.flatnonzero((inside > height[:-2]) & (inside >= height[2:]) & (frequency[1:-1] >= lowest))
    return places[np.argsort(-height[places])]


def _window_peaks(time: np.ndarray, frequency: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest frequencies at which the times of samples are nearly in step, and the window's height there."""
    places = np.sort(_peaks(power, MINIMUM_CYCLES / np.ptp(time), frequency))
    places = places[power[places] > CONFUSED**2]
    near = frequency[places][:WINDOW_PEAKS, None] + np.linspace(-1.0, 1.0, FINE_LINES) * frequency[1]
    height = np.abs(np.exp(-2j * np.pi * near[:, :, None] * (time - time[0])).mean(axis=2))
    best = height.argmax(axis=1)
    return near[np.arange(len(near)), best], height.max(axis=1, initial=0.0)


def _half_rate(time: np.ndarray, peaks: np.ndarray, height: np.ndarray) -> float:
    """Return half of the rate of regular times, by the peaks of their spectral window; infinity for others.

    Samples may be missing. Lower frequencies are those at which groups of samples return.
    """
    regular = peaks[(height > REGULAR_WINDOW) & (peaks * np.median(np.diff(time)) > 0.5)]
    return float(0.5 * regular[0]) if regular.size else np.inf


def _fitted(time: np.ndarray, values: np.ndarray, frequency: float, most: int | None = None) -> HarmonicFit | None:
    """Return the fit at the best frequency near this one; None if its phases are not covered."""
    few = min(most or COMPARED_HARMONICS, COMPARED_HARMONICS, covered_harmonics(time, frequency, time.size))
    return None if few < 1 else nearby_fit(time, values, frequency, few)


def _deviance(fit: HarmonicFit) -> float:
    """Return −2·log-likelihood of normal noise, up to a constant, with the penalty of the harmonics (BIC)."""
    channels, samples = fit.residuals.shape
    unknowns = channels * (2 * fit.amplitudes.shape[1] - 1)
    least = EXACT_RESIDUAL**2 * np.sum(np.abs(fit.amplitudes) ** 2, axis=1)
    power = np.mean(fit.residuals**2, axis=1)
    return float(samples * np.sum(np.log(np.maximum(power, least))) + unknowns * np.log(samples))
