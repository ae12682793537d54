"""Quantisation errors that repeat in every cycle, and do not average out."""

import numpy as np

# Samples from which the step is taken; with fewer levels the values may be exact, as those of a relay.
SAMPLES, FEWEST_LEVELS, LEVEL_TOLERANCE = 100_000, 8, 0.01
# Degrees of freedom of the variance of errors that repeat, fewer than those of any measured one.
REPEATED_FREEDOM = 3.0

# In steps: standard deviation of the noise before quantisation, variance of the mean error at one place, and variance
# of the error about it (the Fourier series of the sawtooth, with normal noise).
_NOISE, _ORDER = np.linspace(0.0, 1.0, 201), np.arange(1.0, 2001.0)
_REPEATED = np.exp(-((2.0 * np.pi * np.outer(_NOISE, _ORDER)) ** 2)) @ (0.5 / (np.pi * _ORDER) ** 2)
_SCATTER = _NOISE**2 + 1.0 / 12.0 - _REPEATED


def step_of(values: np.ndarray) -> float:
    """Return the step of quantised values (samples,); 0 if they are not multiples of one step."""
    levels = np.unique(values[:SAMPLES])
    if levels.size < FEWEST_LEVELS:
        return 0.0
    step = float(np.diff(levels).min())
    multiples = (levels - levels[0]) / step
    return step if np.all(np.abs(multiples - np.round(multiples)) < LEVEL_TOLERANCE) else 0.0


def repeated_variance(values: np.ndarray, fitted: np.ndarray, phases: int, scatter: float) -> float:
    """Return the variance of the mean over a cycle that quantisation errors cause which repeat in every cycle.

    A signal that returns to the same phases has the same error there, unless noise of the size of the step makes it
    random (dither; B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008). The errors are taken as
    independent between phases and between levels that the signal passes.

    Parameters
    ----------
    values : array (samples,)
        Recorded values.
    fitted : array (points,)
        Mean period.
    phases : int
        Different phases of the samples.
    scatter : float
        Variance of one sample from cycle to cycle.
    """
    step = step_of(values)
    if not step > 0.0:
        return 0.0
    passed = np.abs(np.diff(fitted, append=fitted[0])).sum() / step
    each = step**2 * np.interp(scatter / step**2, _SCATTER, _REPEATED, right=0.0)
    return float(each / max(min(passed, phases), 1.0))
