"""Faults of sensors that their mean periods show: heavy tails, clipped and saturated channels, missing phases."""

import numpy as np
from scipy.linalg import toeplitz

from bayesperiodic import _fourier
from bayesperiodic.data.faults import ChannelFaults, heavy_tails, repeat_noise
from bayesperiodic.data.harmonics import HarmonicFit, fit_harmonics
from bayesperiodic.data.saturation import EXACT_SERIES, means_of, phase_bins, saturation_of
from bayesperiodic.data.signals import Signals

# Least share of samples at which no channel is stuck.
LEAST_MOVING = 0.1
# Harmonics that samples may show whose phases do not determine them, the largest condition number of their normal
# equations, and the gain of the Bayesian information criterion by which they do.
MOST_SHOWN, LARGEST_SHOWN_CONDITION, CLEAR_GAIN = 10, 1e5, 20.0
# Share of clipped samples at a phase from which the others there are left out too.
CLIPPED_SHARE = 0.02


def describe(faults: list[ChannelFaults], used: Signals, fit: HarmonicFit, start: int) -> None:
    """Tell heavy tails from outliers, and channels that a sensor limits from those that rest.

    Of the part used, which begins at the sample `start`, by a fit without the faulty samples.
    """
    phase, stop = used.time * fit.frequency, start + used.time.size
    sound = np.ones(used.time.size, dtype=bool)
    for fault in faults:
        for part in fault.stuck:
            sound[max(part.start - start, 0) : max(part.stop - start, 0)] = False
        some = np.concatenate([fault.brief, fault.outliers])
        sound[some[(some >= start) & (some < stop)] - start] = False
    here = slice(None) if sound.all() or np.mean(sound) < LEAST_MOVING else sound
    bins = phase_bins(phase[here])
    for i, (fault, values) in enumerate(zip(faults, used.values, strict=True)):
        rest = fit.residuals[i]
        far = fault.outliers[(fault.outliers >= start) & (fault.outliers < stop)]
        if far.size:
            fault.tails = far[heavy_tails(rest, far - start, values - rest)]
            fault.outliers = np.setdiff1d(fault.outliers, fault.tails)
        clipped = np.concatenate([fault.low, fault.high])
        if clipped.size:
            scatter = repeat_noise(phase, values, clipped - start)
            fault.noisy = scatter > max(EXACT_SERIES * float(values.std()), 0.5 * fault.step)
            fault.tails = fault.tails[:0]
            fault.beside = _same_phases(phase, clipped[(clipped >= start) & (clipped < stop)] - start) + start
        means = means_of(bins, rest[here], fit.amplitudes[i], fault.step)
        fault.saturation = saturation_of(means)
        if fault.saturation is not None and not (clipped.size and fault.noisy):
            fault.saturated = clipped if clipped.size else np.flatnonzero(fault.saturation.holds(phase)) + start
            fault.saturation_bias = fault.saturation.bias(means.error)


def _same_phases(phase: np.ndarray, clipped: np.ndarray) -> np.ndarray:
    """Return the samples at phases at which some are clipped: the others are the smaller ones by noise."""
    bins = phase_bins(phase)
    number = bins.centre.size
    place = bins.place % number
    share = np.bincount(place[clipped], minlength=number) / np.maximum(bins.count.sum(axis=0), 1)
    return np.flatnonzero(share[place] > CLIPPED_SHARE)


def undetermined(used: Signals, fit: HarmonicFit, resolved: int) -> str:
    """Return a message if the samples show more harmonics than their phases determine; else an empty one.

    With the amplitudes of these harmonics the fit is clearly better, by the Bayesian information criterion.
    """
    order = fit.amplitudes.shape[1] - 1
    if order >= min(resolved, MOST_SHOWN):
        return ""
    for more in range(order + 1, min(resolved, MOST_SHOWN) + 1):
        moments = _fourier.moments(fit.frequency * used.time, 2 * more)
        size = np.linalg.eigvalsh(toeplitz(moments))
        if not size[0] * LARGEST_SHOWN_CONDITION > size[-1]:
            break
        other = fit_harmonics(used.time, used.values, fit.frequency, more)
        floor = 1e-24 * np.var(used.values, axis=1)
        gain = used.time.size * np.log((fit.variances + floor) / (other.variances + floor))
        worst = int(np.argmax(gain))
        if gain[worst] > 2.0 * (more - order) * np.log(used.time.size) + CLEAR_GAIN:
            bins = 2 * (resolved + 1)
            count = np.bincount((fit.frequency * used.time % 1.0 * bins).astype(int), minlength=bins)
            return (
                f"recording: must have samples at all phases of its period, got {used.name!r}, in which none are at "
                f"{np.mean(count == 0):.0%} of each period of {1.0 / fit.frequency:.6g} s: the others determine "
                f"{order} harmonic{'s'[: order > 1]}, and {used.channels[worst]!r} has {more} at least. Record again "
                "without the fault for which samples were left out, such as clipping by a small range."
            )
    return ""
