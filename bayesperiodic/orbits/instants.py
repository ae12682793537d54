"""Signals at instants between their samples, by local polynomials as wide as they can be without bias."""

import numpy as np

FEWEST_SAMPLES = 8
DEGREE = 7
NOISE_DEGREE, NOISE_SAMPLES = 11, 14
# A window is so much narrower than the first one in which bias is seen.
MARGIN = 1.6
BLOCK = 20_000


def interpolate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return signals (instants, channels) by polynomials through the eight samples around each instant."""
    return _fit(time, signals, at, (DEGREE + 1) // 2)[0]


def estimate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signals at instants, and the standard deviation of their errors.

    Polynomials of degree 7 are fitted to ever more samples around each instant. With white noise the mean squared
    difference between two such estimates is known but for the squared bias of the wider one, so that bias is seen once
    it stands out of the doubt about that mean. It grows like the eighth power of the width, so that in a window 1.6
    times narrower than the first in which it is seen it is 40 times smaller, and stays below the noise even where
    hundreds of instants are averaged.

    Parameters
    ----------
    time : array (samples,)
    signals : array (samples, channels)
    at : array (instants,)

    Returns
    -------
    values : array (instants, channels)
    sd : array (channels,)
    """
    narrow, narrow_gain, _ = _fit(time, signals, at, (DEGREE + 1) // 2)
    # A higher degree on nearly as few samples: its residual is noise before it is bias.
    variance = _fit(time, signals, at, NOISE_SAMPLES // 2, NOISE_DEGREE)[2].mean(0)
    count = signals.shape[1]
    halves, blind = [(DEGREE + 1) // 2], np.ones(count, dtype=bool)
    widest = max(halves[0], int(0.5 * (time.size - 1) / (time[-1] - time[0]) * np.median(np.diff(at))))
    seen = np.full(count, widest)
    while (half := halves[-1] + max(1, halves[-1] // 5)) <= widest and blind.any():
        wide, gain, _ = _fit(time, signals, at, half)
        squared = (wide - narrow) ** 2
        bias = squared.mean(0) - variance * (narrow_gain.mean() - gain.mean())
        found = blind & (bias > 2.0 * squared.std(0) / np.sqrt(len(at)))
        seen[found], blind[found] = half, False
        halves.append(half)
    values, sd = narrow.copy(), np.sqrt(variance * narrow_gain.mean())
    for channel in range(count):
        half = max(h for h in halves if h == halves[0] or h * MARGIN <= seen[channel])
        if half > halves[0]:
            fitted, gain, _ = _fit(time, signals[:, [channel]], at, half)
            values[:, channel], sd[channel] = fitted[:, 0], np.sqrt(variance[channel] * gain.mean())
    return values, sd


def crossings(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the instants at which a signal crosses zero upwards.

    A crossing counts once the signal has been below zero by a tenth of its spread, so that noise makes no others.
    """
    band = 0.1 * signal.std()
    marks = np.flatnonzero(np.abs(signal) > band)
    up = np.flatnonzero((signal[marks[:-1]] < 0.0) & (signal[marks[1:]] > 0.0))
    found = []
    for low, high in zip(marks[up], marks[up + 1], strict=True):
        span = slice(max(low - 2, 0), high + 3)
        centre = 0.5 * (time[low] + time[high])
        line = np.polynomial.Polynomial.fit(time[span] - centre, signal[span], 3)
        roots = line.roots()
        real = roots[np.abs(roots.imag) < 1e-9].real + centre
        inside = real[(real >= time[low]) & (real <= time[high])]
        if inside.size:
            found.append(inside[np.argmin(np.abs(inside - centre))])
    return np.array(found)


def _fit(
    time: np.ndarray, signals: np.ndarray, at: np.ndarray, half: int, degree: int = DEGREE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return estimates, their variance for unit noise, and the residual variance, from 2·half samples each."""
    count = 2 * half
    first = np.clip(np.searchsorted(time, at) - half, 0, time.size - count)
    centre = np.polynomial.legendre.legvander(np.zeros(1), degree)[0]
    free = max(count - degree - 1, 1)
    values, gains, rests = [], [], []
    for k in range(0, len(at), BLOCK):
        index = first[k : k + BLOCK, None] + np.arange(count)
        width = 0.5 * (time[index[:, -1]] - time[index[:, 0]])
        basis = np.polynomial.legendre.legvander((time[index] - at[k : k + BLOCK, None]) / width[:, None], degree)
        normal = basis.transpose(0, 2, 1) @ basis
        local = signals[index]
        reference = local[:, half]
        local = local - reference[:, None]
        weights = basis @ np.linalg.solve(normal, np.broadcast_to(centre[:, None], (len(index), degree + 1, 1)))
        values.append(reference + (weights.transpose(0, 2, 1) @ local)[:, 0])
        gains.append((weights[..., 0] ** 2).sum(1))
        rest = local - basis @ np.linalg.solve(normal, basis.transpose(0, 2, 1) @ local)
        rests.append((rest**2).sum(1) / free)
    return np.concatenate(values), np.concatenate(gains), np.concatenate(rests)
