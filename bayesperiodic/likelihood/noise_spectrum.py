"""The measured spectrum of the noise of a channel, smoothed over neighbouring harmonics."""

from typing import NamedTuple

import numpy as np
from scipy.special import digamma, polygamma

from bayesperiodic.data.experiment import Experiment

# Harmonics through whose variances a line is laid; few, so that the spectrum may be any that is smooth over them.
HARMONICS_OF_A_LINE = 5


class NoiseSpectrum(NamedTuple):
    """Variances of the complex amplitudes of the mean period, and what they were estimated from."""

    variance: np.ndarray  # (harmonics + 1,)
    freedom: np.ndarray  # (harmonics + 1,) degrees of freedom of the measured ones
    mixing: np.ndarray  # (harmonics + 1, harmonics + 1), ∂ ln(variance)/∂ ln(measured ones)

    @classmethod
    def of(cls, experiment: Experiment, channel: str) -> "NoiseSpectrum | None":
        """Return that of a channel, None if it was not measured."""
        if channel not in experiment.amplitude_variance:
            return None
        variance = np.array(experiment.amplitude_variance[channel], dtype=float)
        values = np.where(np.arange(variance.size) == 0, 1.0, 2.0)
        freedom = np.full(variance.size, values * max(experiment.cycles - 1, 1))
        given = experiment.amplitude_freedom.get(channel)
        return smoothed(variance, freedom if given is None else np.array(given, dtype=float)[: variance.size])


def smoothed(variance: np.ndarray, freedom: np.ndarray) -> NoiseSpectrum:
    """Return measured variances of amplitudes (harmonics + 1,), smoothed as far as they are smooth.

    The logarithms of the nearest harmonics' variances lie about a line in ln h, a power law, with the variances ψ′(ν/2)
    for ν degrees of freedom. Those that differ more from their lines than these explain, by the factor T in the mean
    square, move towards them by the part 1/T only, so that peaks of the spectrum remain. The mean value, which slow
    noise moves, keeps its own variance, and so do all where some are known (infinite degrees of freedom) or zero.
    """
    mixing, last = np.eye(variance.size), variance.size - 1
    measured = np.isfinite(freedom[1:]) & (freedom[1:] > 0.0)
    usable = last > 2 and np.all(variance[1:] > 0.0) and measured.all()
    if not usable:
        return NoiseSpectrum(variance, freedom, mixing)
    half = 0.5 * freedom[1:]
    spread, level = polygamma(1, half), np.log(variance[1:]) - digamma(half) + np.log(half)
    lines = _lines(np.log(np.arange(1.0, last + 1.0)), 1.0 / spread)
    expected = np.sum((np.eye(last) - lines) ** 2 * spread, axis=1) / spread
    off = (level - lines @ level) ** 2 / spread
    part = min(1.0, expected.sum() / max(off.sum(), np.finfo(float).tiny))
    weights = part * lines + (1.0 - part) * np.eye(last)
    # The result has the mean of χ²/ν, where 2/ν + … = ψ′(ν/2) is the variance of its logarithm.
    after = 1.0 / (weights**2 @ spread) + 0.5
    mixing[1:, 1:] = weights
    result = np.exp(weights @ level + digamma(after) - np.log(after))
    return NoiseSpectrum(np.concatenate([variance[:1], result]), freedom, mixing)


def component_variances(experiment: Experiment, channel: str, harmonic: np.ndarray) -> np.ndarray:
    """Return the measured variances (size,) of the Fourier components of harmonics (size,); (0,) if any is unknown.

    The scale is that of `MeanPeriod`: their mean is the variance of one value.
    """
    spectrum = NoiseSpectrum.of(experiment, channel)
    nyquist = 2 * harmonic.max() == experiment.samples * experiment.periods
    if spectrum is None or nyquist or harmonic.max() >= spectrum.variance.size:
        return np.empty(0)
    return np.asarray(harmonic.size * np.where(harmonic == 0, 1.0, 0.25) * spectrum.variance[harmonic])


def _lines(place: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the matrix of weighted least-squares lines through the nearest places, each evaluated at its place."""
    count = min(HARMONICS_OF_A_LINE, place.size)
    result = np.zeros((place.size, place.size))
    for k, here in enumerate(place):
        first = min(max(k - HARMONICS_OF_A_LINE // 2, 0), place.size - count)
        near = slice(first, first + count)
        x, w = place[near] - here, weight[near]
        moments = np.array([[w.sum(), w @ x], [w @ x, w @ x**2]])
        result[k, near] = np.linalg.solve(moments, [w, w * x])[0]
    return result
