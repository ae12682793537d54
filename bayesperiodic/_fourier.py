"""Fourier amplitudes of periodic signals.

A real signal is sampled over one response period on an equidistant grid without the end point. Its complex amplitudes
c[h] satisfy y(t) = Re Σ_h c[h] exp(2πi h t / period), so that |c[h]| is the amplitude of harmonic h and c[0] the mean.
"""

from collections.abc import Iterable, Iterator
from math import factorial, sqrt

import numpy as np

# Terms of a Taylor series about the points of a fine grid, and times evaluated together.
TAYLOR, CHUNK = 6, 1 << 15


def coefficients(values: np.ndarray, harmonics: int | None = None) -> np.ndarray:
    """Return the amplitudes (…, harmonics + 1) of signals (…, points), by default all below the Nyquist harmonic."""
    points = values.shape[-1]
    limit = highest_harmonic(points)
    amplitudes = np.fft.rfft(values, axis=-1)[..., : 1 + (limit if harmonics is None else min(harmonics, limit))]
    amplitudes *= 2.0 / points
    amplitudes[..., 0] *= 0.5
    return amplitudes


def within_half_turn(angles: np.ndarray) -> np.ndarray:
    """Return angles [rad] within half a turn; unlike the remainder of a division, quickly and exactly for those."""
    return angles - 2 * np.pi * np.rint(angles / (2 * np.pi))


def on_grid(amplitudes: np.ndarray, points: int) -> np.ndarray:
    """Return signals (…, points) from complex amplitudes (…, harmonics + 1)."""
    spectrum = np.zeros((*amplitudes.shape[:-1], points // 2 + 1), dtype=complex)
    count = min(amplitudes.shape[-1], highest_harmonic(points) + 1)
    spectrum[..., :count] = amplitudes[..., :count] * (0.5 * points)
    spectrum[..., 0] *= 2.0
    return np.fft.irfft(spectrum, n=points, axis=-1)


def lagged(values: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the periodic solutions m (signals, points) of lag·ṁ = value − m; the lags (signals,) are in periods."""
    points = values.shape[-1]
    rate = 2j * np.pi * np.arange(points // 2 + 1)
    return np.fft.irfft(np.fft.rfft(values, axis=-1) / (1.0 + rate * lags[:, None]), n=points, axis=-1)


def from_components(components: np.ndarray, points: int) -> np.ndarray:
    """Return signals (…, points) from real components (…, size), whose mean square is that of the signal.

    These are the mean, the real and then the imaginary parts of the harmonics, and if their number is even that of the
    Nyquist harmonic. On as many points as components the transform is orthogonal.
    """
    size = components.shape[-1]
    highest = (size - 1) // 2
    spectrum = np.zeros((*components.shape[:-1], points // 2 + 1), dtype=complex)
    kept, factor = min(highest, highest_harmonic(points)), points / sqrt(2.0 * size)
    np.multiply(components[..., : kept + 1], factor, out=spectrum.real[..., : kept + 1])
    np.multiply(components[..., highest + 1 : highest + 1 + kept], factor, out=spectrum.imag[..., 1 : kept + 1])
    spectrum[..., 0] *= sqrt(2.0)
    signal = np.fft.irfft(spectrum, n=points)
    if size % 2 == 0:
        signal += components[..., -1:] / np.sqrt(size) * np.where(np.arange(points) % 2 == 0, 1.0, -1.0)
    return signal


def at_times(amplitudes: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return signals (…, times) at given phases (times,), fractions of the period, from amplitudes (…, harmonics + 1).

    Taylor series about the points of a fine grid, so that the time does not depend on the number of harmonics.
    """
    values = np.empty((*amplitudes.shape[:-1], phase.size))
    for part, block in blocks_at(amplitudes, phase):
        values[..., part] = block
    return values


def blocks_at(amplitudes: np.ndarray, phase: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield parts of the times with the signals of `at_times` there, so that sums need none of the whole record."""
    points = _fine(amplitudes.shape[-1] - 1)
    rate = 2j * np.pi * np.arange(amplitudes.shape[-1]) / points
    tables = np.stack([on_grid(amplitudes * rate**p / factorial(p), points) for p in range(TAYLOR)])
    flat = tables.reshape(TAYLOR, -1, points)
    for part in _parts(phase.size, points):
        place, offset = _places(phase[part], points)
        block = np.empty((*amplitudes.shape[:-1], place.size))
        for channel, row in enumerate(block.reshape(-1, place.size)):
            total = flat[-1, channel].take(place, mode="clip")
            for table in flat[-2::-1]:
                total *= offset
                total += table[channel].take(place, mode="clip")
            row[:] = total
        yield part, block


def sums(values: np.ndarray, phase: np.ndarray, harmonics: int) -> np.ndarray:
    """Return Σ_t y(t) exp(−2πi h phase(t)), h = 0 … harmonics, of signals (channels, times), by the same grid."""
    parts = _parts(phase.size, _fine(harmonics))
    return sums_of_blocks(((part, values[:, part]) for part in parts), len(values), phase, harmonics)


def sums_of_blocks(
    blocks: Iterable[tuple[slice, np.ndarray]], channels: int, phase: np.ndarray, harmonics: int
) -> np.ndarray:
    """Return the same of signals that are given part by part."""
    points = _fine(harmonics)
    tables = np.zeros((TAYLOR, channels, points))
    for part, values in blocks:
        place, offset = _places(phase[part], points)
        for channel, signal in enumerate(values):
            weighted = np.array(signal, dtype=float)
            for table in tables:
                table[channel] += np.bincount(place, weighted, points)
                weighted *= offset
    rate = -2j * np.pi * np.arange(harmonics + 1) / points
    spectra = np.fft.rfft(tables)[..., : harmonics + 1]
    return np.asarray(sum(rate**p / factorial(p) * spectrum for p, spectrum in enumerate(spectra)))


def moments(phase: np.ndarray, harmonics: int) -> np.ndarray:
    """Return Σ_t exp(−2πi h phase(t)), h = 0 … harmonics."""
    return sums(np.broadcast_to(1.0, (1, phase.size)), phase, harmonics)[0]


def _fine(harmonics: int) -> int:
    """Return how many grid points, a power of two, make Taylor series of all harmonics exact to rounding."""
    return 256 << max(harmonics - 1, 1).bit_length()


def _parts(times: int, points: int) -> Iterator[slice]:
    """Yield parts of so many times that are long compared with a grid."""
    length = max(CHUNK, 4 * points)
    return (slice(first, min(first + length, times)) for first in range(0, times, length))


def _places(phase: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest grid point of each phase, and its distance in grid steps."""
    offset = (phase - np.floor(phase)) * points
    place = np.rint(offset)
    offset -= place
    return place.astype(int) & (points - 1), offset


def derivative(amplitudes: np.ndarray, frequency: float, order: int = 1) -> np.ndarray:
    """Return the complex amplitudes of a time derivative; `frequency` [Hz] belongs to harmonic 1."""
    harmonic = np.arange(amplitudes.shape[-1])
    return amplitudes * (2j * np.pi * frequency * harmonic) ** order


def highest_harmonic(points: int) -> int:
    """Return the highest harmonic below the Nyquist harmonic of a grid."""
    return (points - 1) // 2
