"""Division of recordings at gaps and at steps of the frequency."""

import numpy as np
from scipy.signal import medfilt

from bayesperiodic.data.folding import gaps
from bayesperiodic.data.harmonics import MINIMUM_CYCLES

# A crossing counts after the signal was below minus this fraction of its standard deviation.
HYSTERESIS = 0.25
# Smallest relative step of the period, in itself and in standard errors.
SMALLEST_STEP, SIGNIFICANT = 1e-3, 8.0


def parts(time: np.ndarray, signal: np.ndarray) -> list[slice]:
    """Return the parts of at least three cycles between gaps of time and steps of the signal's frequency."""
    rising = _rising(time, signal)
    if rising.size < 2:
        return [slice(0, time.size)]
    period = float(np.median(np.diff(time[rising])))
    edges = np.concatenate([[0], gaps(time, period) + 1, [time.size]])
    found = []
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        inside = first + _rising(time[first:last], signal[first:last])
        steps = inside[_steps(time, signal, inside)]
        bounds = [first, *steps.tolist(), last]
        found += [slice(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    cycles = [np.searchsorted(rising, own.stop) - np.searchsorted(rising, own.start) for own in found]
    return [own for own, count in zip(found, cycles, strict=True) if count > MINIMUM_CYCLES]


def _rising(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the samples at which the signal rises above its mean, which it must have left by the hysteresis."""
    centred = signal - signal.mean()
    level = HYSTERESIS * centred.std()
    outside = np.flatnonzero(np.abs(centred) > level)
    above = centred[outside] > 0.0
    return outside[1:][above[1:] & ~above[:-1]]


def _steps(time: np.ndarray, signal: np.ndarray, rising: np.ndarray) -> list[int]:
    """Return the numbers of the crossings at which the period changes, by binary segmentation of its logarithm."""
    if rising.size < 2 * MINIMUM_CYCLES + 2:
        return []
    level = signal[rising[0] : rising[-1] + 1].mean()
    level += HYSTERESIS * signal[rising[0] : rising[-1] + 1].std()
    fraction = (signal[rising] - level) / np.maximum(signal[rising] - signal[rising - 1], np.finfo(float).tiny)
    crossing = time[rising] - np.clip(fraction, 0.0, 1.0) * (time[rising] - time[rising - 1])
    period = np.log(np.diff(crossing))
    noise = max(float(np.median(np.abs(np.diff(period)))), 1e-4)
    # A single odd period, as at a jump of the phase, is no step.
    period = medfilt(period, 3)
    found, stack = [], [(0, period.size)]
    while stack:
        first, last = stack.pop()
        size = last - first
        number = np.arange(MINIMUM_CYCLES, size - MINIMUM_CYCLES + 1)
        if not number.size:
            continue
        own = period[first:last]
        before = np.cumsum(own)[number - 1]
        difference = before / number - (own.sum() - before) / (size - number)
        score = np.abs(difference) * np.sqrt(number * (size - number) / size)
        best = int(np.argmax(score))
        if score[best] > SIGNIFICANT * noise and abs(difference[best]) > SMALLEST_STEP:
            middle = first + int(number[best])
            found.append(middle)
            stack += [(first, middle), (middle, last)]
    return sorted(found)
