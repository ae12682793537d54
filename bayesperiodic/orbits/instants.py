"""Signals at instants between their samples, by local polynomials as wide as they can be without bias."""

import numpy as np

FEWEST_SAMPLES = 8
DEGREE = 7
# Of the variance that a wider window saves, this share may come back as squared bias.
BIAS_SHARE = 0.05
BLOCK = 20_000


def interpolate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return signals (instants, channels) by polynomials through the eight samples around each instant."""
    return _fit(time, signals, at, (DEGREE + 1) // 2)[0]


def estimate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signals at instants, and the standard deviation of their errors.

    Polynomials of degree 7 are fitted to ever more samples around each instant. With white noise the mean squared
    difference between two such estimates is known but for the squared bias of the wider one, so that bias is measured.
    A channel takes the widest window in which it is 5 % of the variance at most.

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
    best, gain, _ = _fit(time, signals, at, (DEGREE + 1) // 2)
    narrow = best
    narrow_gain = gain.mean()
    _, _, residual = _fit(time, signals, at, DEGREE)
    variance = residual.mean(0)
    sd = np.sqrt(variance * narrow_gain)
    values, open_channels = best.copy(), np.ones(signals.shape[1], dtype=bool)
    half = (DEGREE + 1) // 2 + 1
    widest = max(half, int(0.5 * (time.size - 1) / (time[-1] - time[0]) * np.median(np.diff(at))))
    while half <= widest and open_channels.any():
        wide, gain, _ = _fit(time, signals, at, half)
        squared = (wide - narrow) ** 2
        bias = squared.mean(0) - variance * (narrow_gain - gain.mean())
        doubt = 2.0 * squared.std(0) / np.sqrt(len(at))
        open_channels &= bias - doubt <= BIAS_SHARE * variance * gain.mean()
        values[:, open_channels] = wide[:, open_channels]
        sd[open_channels] = np.sqrt(variance[open_channels] * gain.mean())
        half += max(1, half // 5)
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


def _fit(time: np.ndarray, signals: np.ndarray, at: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return estimates, their variance for unit noise, and the residual variance, from 2·half samples each."""
    count = 2 * half
    first = np.clip(np.searchsorted(time, at) - half, 0, time.size - count)
    values, gains, rests = [], [], []
    for k in range(0, len(at), BLOCK):
        index = first[k : k + BLOCK, None] + np.arange(count)
        width = 0.5 * (time[index[:, -1]] - time[index[:, 0]])
        basis = np.polynomial.legendre.legvander((time[index] - at[k : k + BLOCK, None]) / width[:, None], DEGREE)
        centre = np.polynomial.legendre.legvander(np.zeros(1), DEGREE)[0]
        weights = centre @ np.linalg.pinv(basis)
        local = signals[index]
        reference = local[:, half : half + 1]
        values.append(reference[:, 0] + np.einsum("mn,mnc->mc", weights, local - reference))
        gains.append((weights**2).sum(1))
        free = count - DEGREE - 1
        if free > 0:
            q, _ = np.linalg.qr(basis)
            rest = (local - reference) - q @ (q.transpose(0, 2, 1) @ (local - reference))
            rests.append((rest**2).sum(1) / free)
        else:
            rests.append(np.zeros((len(index), signals.shape[1])))
    return np.concatenate(values), np.concatenate(gains), np.concatenate(rests)
