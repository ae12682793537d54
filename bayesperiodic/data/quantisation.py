"""Quantisation errors that repeat in every cycle, and do not average out."""

import numpy as np

# Samples from which the step is taken, and levels from which faults of a sensor are sought by its step.
SAMPLES, FEWEST_LEVELS, LEVEL_TOLERANCE = 100_000, 8, 0.01
# Changes between two levels in order of phase, for each change in a cycle, above which noise moves them: one without
# noise, two if one of two changes has a single sample at the wrong side.
MOVED_CHANGES = 1.5
# Degrees of freedom of the variance of errors that repeat, fewer than those of any measured one.
REPEATED_FREEDOM = 3.0

# In steps: standard deviation of the noise before quantisation, variance of the mean error at one place, and variance
# of the error about it (the Fourier series of the sawtooth, with normal noise).
_NOISE, _ORDER = np.linspace(0.0, 1.0, 201), np.arange(1.0, 2001.0)
_REPEATED = np.exp(-((2.0 * np.pi * np.outer(_NOISE, _ORDER)) ** 2)) @ (0.5 / (np.pi * _ORDER) ** 2)
_TOTAL = _NOISE**2 + 1.0 / 12.0
_SCATTER = _TOTAL - _REPEATED


def step_of(values: np.ndarray, fewest: int = FEWEST_LEVELS) -> float:
    """Return the step of quantised values (samples,); 0 if they are not multiples of one step, or of fewer levels."""
    levels = np.unique(values[:SAMPLES])
    if levels.size < fewest:
        return 0.0
    step = float(np.diff(levels).min())
    multiples = (levels - levels[0]) / step
    return step if np.all(np.abs(multiples - np.round(multiples)) < LEVEL_TOLERANCE) else 0.0


def rounded_step(values: np.ndarray, phase: np.ndarray) -> float:
    """Return the step of rounded values (samples,) at phases [cycles], from two levels on; 0 if they are exact.

    Exact are two levels that are a function of the phase, as those of a relay or a square wave without noise. Noise
    before a converter moves the changes from cycle to cycle. Without noise the two cannot be told apart.
    """
    step = step_of(values, fewest=2)
    if not step > 0.0 or np.ptp(values) > 1.5 * step:
        return step
    by_phase = values[np.argsort(phase % 1.0, kind="stable")]
    changes = np.count_nonzero(by_phase != np.roll(by_phase, 1))
    usual = np.count_nonzero(np.diff(values)) / max(float(np.ptp(phase)), 1.0)
    return step if changes > MOVED_CHANGES * usual else 0.0


def repeated_variance(
    step: float, fitted: np.ndarray, phases: int, *, scatter: float | None = None, residual: float = 0.0
) -> float:
    """Return the variance of the mean over a cycle that quantisation errors cause which repeat in every cycle.

    A signal that returns to the same phases has the same error there, unless noise of the size of the step makes it
    random (dither; B. Widrow, I. Kollár, Quantization Noise, Cambridge University Press 2008). The errors are taken as
    independent between phases and between levels that the signal passes.

    Parameters
    ----------
    step : float
        Step of the recorded values, 0 if they are exact.
    fitted : array (points,)
        Mean period.
    phases : int
        Different phases of the samples.
    scatter : float, optional
        Variance of one sample from cycle to cycle.
    residual : float
        Without `scatter`: variance about the mean period, of noise and all rounding errors.
    """
    if not step > 0.0:
        return 0.0
    passed = np.abs(np.diff(fitted, append=fitted[0])).sum() / step
    size, sizes = (residual, _TOTAL) if scatter is None else (scatter, _SCATTER)
    each = step**2 * np.interp(size / step**2, sizes, _REPEATED, right=0.0)
    return float(each / max(min(passed, phases), 1.0))
