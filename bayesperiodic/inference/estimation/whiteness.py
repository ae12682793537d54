"""Whiteness of a residual within the harmonics that were kept."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic import fourier


@dataclass(frozen=True)
class Whiteness:
    """Bartlett's test of a residual that repeats every period.

    Attributes
    ----------
    p : float
        Probability, for white residuals, of a cumulative periodogram at least as far from a straight line; the
        Kolmogorov-Smirnov distance of the kept harmonics, exact for independent normal values. NaN if not tested.
    lag1 : float
        Circular autocorrelation at the distance of two independent values, one period / (2·harmonics + 1).
    """

    p: float
    lag1: float


def whiteness(residual: np.ndarray, harmonics: int | None = None) -> Whiteness:
    """Test one residual period (points,) for whiteness; by default over all harmonics of the grid."""
    return of_periodogram(np.abs(fourier.coefficients(residual, harmonics)[1:]) ** 2)


def of_components(components: np.ndarray, harmonic: np.ndarray) -> Whiteness:
    """Test real Fourier components (size,) that belong to given harmonics (size,)."""
    power = np.bincount(harmonic, components**2)
    complete = np.bincount(harmonic) == 2
    return of_periodogram(power[complete])


def of_periodogram(power: np.ndarray) -> Whiteness:
    """Test the squared amplitudes of harmonics 1, 2, … for being those of white noise.

    References
    ----------
    M. S. Bartlett, An Introduction to Stochastic Processes, Cambridge University Press, 1955.
    """
    from scipy.stats import kstest

    if power.size < 2 or power.sum() == 0.0:
        return Whiteness(1.0, 0.0)
    harmonic = np.arange(1, power.size + 1)
    cumulative = np.cumsum(power)[:-1] / power.sum()
    lag = 2.0 * np.pi / (2 * power.size + 1)
    return Whiteness(
        float(kstest(cumulative, "uniform").pvalue),
        float(np.sum(power * np.cos(lag * harmonic)) / power.sum()),
    )
