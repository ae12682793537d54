"""Complex harmonics of periodic values on grids of any number of points."""

from functools import lru_cache

import numpy as np


def harmonics(values: np.ndarray) -> np.ndarray:
    """Return the complex harmonics (…, points/2, columns) of values (…, points, columns), without the highest."""
    points = values.shape[-2]
    return np.fft.rfft(values, axis=-2)[..., : points // 2, :] / points


def on_grid(amplitudes: np.ndarray, points: int) -> np.ndarray:
    """Return values (…, points, columns) of harmonics (…, harmonics, columns), no more than half the points."""
    return np.fft.irfft(amplitudes, points, axis=-2) * points


def resized(amplitudes: np.ndarray, points: int) -> np.ndarray:
    """Return harmonics of a grid as those of another one."""
    result = np.zeros((*amplitudes.shape[:-2], points // 2, amplitudes.shape[-1]), dtype=complex)
    kept = min(amplitudes.shape[-2], points // 2)
    result[..., :kept, :] = amplitudes[..., :kept, :]
    return result


@lru_cache(maxsize=16)
def transform_tables(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return exp(−2πi k/points) for half of the points, a power of two, and all bit-reversed numbers."""
    if points < 1 or points & (points - 1):  # the kernels would write outside of their arrays
        raise ValueError(f"points: must be a power of two, got {points}.")
    place = np.zeros(1, dtype=np.int64)
    while len(place) < points:
        place = np.concatenate([2 * place, 2 * place + 1])
    return np.exp(-2j * np.pi * np.arange(points // 2) / points), place


def sampled(amplitudes: np.ndarray, points: int) -> np.ndarray:
    """Return the values of a series of harmonics at any number of points, however few."""
    count = amplitudes.shape[-2]
    if points >= 2 * count:
        return on_grid(amplitudes, points)
    # Harmonics whose numbers differ by the number of points are the same there.
    same = np.zeros((*amplitudes.shape[:-2], -(-count // points) * points, amplitudes.shape[-1]), dtype=complex)
    same[..., :count, :] = 2.0 * amplitudes
    same[..., 0, :] = amplitudes[..., 0, :]
    sums = same.reshape(*amplitudes.shape[:-2], -1, points, amplitudes.shape[-1]).sum(axis=-3)
    return np.fft.ifft(sums, axis=-2).real * points
