"""Fourier amplitudes of periodic signals.

A real signal is sampled over one response period on an equidistant grid without the end point. Its complex amplitudes
c[h] satisfy y(t) = Re Σ_h c[h] exp(2πi h t / period), so that |c[h]| is the amplitude of harmonic h and c[0] the mean.
"""

import numpy as np


def coefficients(values: np.ndarray, harmonics: int | None = None) -> np.ndarray:
    """Return the amplitudes (…, harmonics + 1) of signals (…, points), by default all below the Nyquist harmonic."""
    points = values.shape[-1]
    limit = highest_harmonic(points)
    amplitudes = np.fft.rfft(values, axis=-1)[..., : 1 + (limit if harmonics is None else min(harmonics, limit))]
    amplitudes *= 2.0 / points
    amplitudes[..., 0] *= 0.5
    return amplitudes


def on_grid(amplitudes: np.ndarray, points: int) -> np.ndarray:
    """Return signals (…, points) from complex amplitudes (…, harmonics + 1)."""
    spectrum = np.zeros((*amplitudes.shape[:-1], points // 2 + 1), dtype=complex)
    count = min(amplitudes.shape[-1], highest_harmonic(points) + 1)
    spectrum[..., :count] = amplitudes[..., :count] * (0.5 * points)
    spectrum[..., 0] *= 2.0
    return np.fft.irfft(spectrum, n=points, axis=-1)


def at_times(amplitudes: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return one signal at given phases (fractions of the period), by Horner's rule in exp(2πi phase)."""
    turn = np.exp(2j * np.pi * np.asarray(phase))
    total = np.zeros_like(turn)
    for amplitude in amplitudes[::-1]:
        total = total * turn + amplitude
    return total.real


def derivative(amplitudes: np.ndarray, frequency: float, order: int = 1) -> np.ndarray:
    """Return the complex amplitudes of a time derivative; `frequency` [Hz] belongs to harmonic 1."""
    harmonic = np.arange(amplitudes.shape[-1])
    return amplitudes * (2j * np.pi * frequency * harmonic) ** order


def project(values: np.ndarray, harmonics: int) -> np.ndarray:
    """Return signals (…, points) without the harmonics above the given one."""
    return on_grid(coefficients(values, harmonics), values.shape[-1])


def highest_harmonic(points: int) -> int:
    """Return the highest harmonic below the Nyquist harmonic of a grid."""
    return (points - 1) // 2
