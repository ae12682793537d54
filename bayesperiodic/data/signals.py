"""Sampled signals, their fundamental frequency, and the parts of a record of several."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.aliases import SEARCHED, aliases, explains, samples_per_cycle, search_frequency
from bayesperiodic.data.coverage import SLOW, covered_harmonics, per_cycle, resolved_harmonics
from bayesperiodic.data.harmonics import (
    MINIMUM_CYCLES,
    fit_harmonics,
    guess_frequency,
    refine_frequency,
    track_frequency,
)

# Steps of time that are gaps, in periods, if they are longer than so many usual steps; if the period is unknown,
# in usual steps.
GAP, USUAL_STEPS, MANY_STEPS = 0.25, 3.0, 30.0
# A crossing counts after the signal was below minus this fraction of its standard deviation.
HYSTERESIS = 0.25
# Smallest relative step of the period, in itself and in standard errors.
SMALLEST_PERIOD_STEP, SIGNIFICANT_PERIOD_STEP = 1e-3, 8.0
# Fewest samples of which a frequency is guessed, and fewest in a cycle of the strongest harmonic at a regular rate;
# aliases that are listed.
FEWEST_GUESSED, FEWEST_PER_CYCLE, LISTED_ALIASES = 8, 4.0, 4
# Cycles that are searched for the frequency if there are many samples in each.
SEARCHED_CYCLES = 50.0
# Share of the steps that are usual ones where a frequency can be guessed from correlations.
USUAL_SHARE = 0.95
# Standard error of the phase [cycles] behind a gap with which cycles can be counted: five of them are less than a
# quarter of a cycle.
COUNTED = 0.05
# Difference of two phases [cycles] at the ends of a recording that selects other cycles.
OTHER_CYCLES = 0.05


class Fit(Protocol):
    """A Fourier series fitted to several channels."""

    @property
    def variances(self) -> np.ndarray:
        """Residual variance of each channel, (channels,)."""
        ...


@dataclass(frozen=True)
class Signals:
    """Channels sampled at the same times."""

    name: str  # of the recording, for messages
    time: np.ndarray  # (samples,)
    channels: tuple[str, ...]  # inputs first
    values: np.ndarray  # (channels, samples)
    inputs: int  # number of inputs

    def __post_init__(self) -> None:
        for i, (channel, values) in enumerate(zip(self.channels, self.values, strict=True)):
            if np.ptp(values) == 0.0:
                kind, remedy = "outputs", ""
                if i < self.inputs:
                    kind, remedy = "inputs", ", and write it in the model as a parameter with its value in `fixed`"
                raise ValueError(
                    f"{kind}[{channel!r}]: must vary, got the constant {values[0]:g}; leave the channel out{remedy}."
                )

    def part(self, samples: np.ndarray | slice) -> "Signals":
        """Return the signals at the selected samples."""
        return replace(self, time=self.time[samples], values=self.values[:, samples])

    def drive(self) -> "Signals":
        """Return the inputs alone."""
        return replace(self, channels=self.channels[: self.inputs], values=self.values[: self.inputs])


def first_guess(signals: Signals, frequency: float | None, periods: int) -> float:
    """Return a first estimate of the fundamental frequency; raise a ValueError for fewer than three cycles."""
    remedy = "give the forcing frequency"
    if frequency is not None:
        fundamental: float | None = _checks.positive("frequency", frequency) / periods
        remedy = f"check frequency = {frequency!r} Hz and periods = {periods}"
    else:
        guess = _estimate(signals.drive() if signals.inputs else signals)
        fundamental = guess / (periods if signals.inputs else 1) if guess else None
    if fundamental is None or cycles_of(signals.time, fundamental) < MINIMUM_CYCLES:
        period = "no period" if fundamental is None else f"{cycles_of(signals.time, fundamental):.2f} cycles"
        raise ValueError(
            f"recording: must have at least {MINIMUM_CYCLES} cycles, got {period} in {signals.name!r} of "
            f"{np.ptp(signals.time):g} s; record longer, or {remedy}."
        )
    return fundamental


def _estimate(signals: Signals) -> float | None:
    """Return a frequency from the longest stretch, or else from spectral lines; refuse one that has aliases."""
    time, values = _longest_stretch(signals)
    guess = guess_frequency(time, values) if time.size > FEWEST_GUESSED else None
    fast = guess is not None and per_cycle(time, guess) >= SLOW and cycles_of(time, guess) >= MINIMUM_CYCLES
    step = np.diff(time)
    # A few gaps leave the correlation of neighbouring samples as it is.
    even = bool(np.quantile(step, USUAL_SHARE) <= USUAL_STEPS * np.median(step))
    if guess is not None and fast and even and explains(time, values, guess):
        return guess
    some = _searched(signals.time, guess if fast else None)
    time, values = signals.time[some], signals.values[:, some]
    estimate = search_frequency(time, values, guess)
    if estimate is None or (fast and even or guess is None) and per_cycle(time, estimate) >= SLOW:
        return guess
    others = aliases(time, values, estimate)
    if (many := samples_per_cycle(time, values, estimate, others)) < FEWEST_PER_CYCLE:
        raise ValueError(
            f"frequency: must be given for {signals.name!r}, in which {many:.3g} samples per cycle do not tell "
            f"{estimate:.6g} Hz from {', '.join(f'{f:.6g}' for f in others[:LISTED_ALIASES])} Hz (aliases), got None; "
            "give it, or sample faster or at irregular times."
        )
    return estimate


def _searched(time: np.ndarray, guess: float | None) -> slice:
    """Return the last samples, or every so many in the last cycles of a frequency."""
    count = SEARCHED if guess is None else int(np.count_nonzero(time > time[-1] - SEARCHED_CYCLES / guess))
    return slice(-max(count, SEARCHED), None, 1 + count // (SEARCHED + 1))


def _longest_stretch(signals: Signals) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and values of the longest part without gaps of many steps."""
    step = np.diff(signals.time)
    edges = np.concatenate([[0], np.flatnonzero(step > MANY_STEPS * np.median(step)) + 1, [signals.time.size]])
    longest = int(np.argmax(np.diff(edges)))
    part = slice(edges[longest], edges[longest + 1])
    return signals.time[part], signals.values[:, part]


def cycles_of(time: np.ndarray, fundamental: float) -> float:
    """Return the number of cycles, the last sample's step included."""
    return float(np.ptp(time) * time.size / (time.size - 1) * fundamental * (1 + 1e-9))


def gaps(time: np.ndarray, period: float) -> np.ndarray:
    """Return the last samples before gaps."""
    step = np.diff(time)
    return np.flatnonzero(step > max(GAP * period, USUAL_STEPS * np.median(step)))


def counted_cycles(signals: Signals, fundamental: float, given: bool) -> tuple[slice, float]:
    """Return the samples over whose gaps the cycles can be counted, and the frequency by which they are compared.

    With a given frequency these are all, and it is the estimated one if the given one is clearly another one.
    """
    if not given:
        part, tracked = _coherent_part(signals, fundamental)
    else:
        part, tracked = slice(0, signals.time.size), _given_or_tracked(signals, fundamental)
    if (cycles := cycles_of(signals.time[part], tracked)) < MINIMUM_CYCLES:
        raise ValueError(
            f"recording: must have at least {MINIMUM_CYCLES} cycles, got {cycles:.2f} cycles of {tracked:.6g} Hz in "
            f"{signals.name!r}; record longer."
        )
    return part, tracked


def _given_or_tracked(signals: Signals, given: float) -> float:
    """Return the given frequency, or the estimated one if that explains more."""
    time, values = signals.time, signals.values
    tracked = track_frequency(time, values, given)
    if abs(tracked - given) * np.ptp(time) < OTHER_CYCLES:
        return given
    few = min(10, resolved_harmonics(time, max(tracked, given), time.size))
    more = explains_more(*(fit_harmonics(time, values, rate, few) for rate in (tracked, given)))
    return tracked if more else given


def _coherent_part(signals: Signals, fundamental: float) -> tuple[slice, float]:
    """Return the longest part over whose gaps the cycles can be counted, and its frequency.

    A part behind a gap belongs to it if the standard errors of the frequencies on both sides are a small part of a
    cycle over the time from the middle of one to that of the other.
    """
    time, values = signals.time, signals.values
    step = np.diff(time)
    ends = np.flatnonzero(step > max(MINIMUM_CYCLES / fundamental, MANY_STEPS * np.median(step)))
    edges = np.concatenate([[0], ends + 1, [time.size]])
    pieces = [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    first = last = int(np.argmax([np.ptp(time[piece]) for piece in pieces]))
    part = pieces[first]
    known = _measured(time[part], values[:, part], fundamental) if ends.size else None
    if known is None:
        return slice(0, time.size), track_frequency(time, values, fundamental)
    added = True
    while added:
        added = False
        for near in (first - 1, last + 1):
            if not 0 <= near < len(pieces):
                continue
            other = pieces[near]
            frequency, error = known
            if (measured := _measured(time[other], values[:, other], frequency)) is not None:
                weight = error**2 / (error**2 + measured[1] ** 2)
                frequency += weight * (measured[0] - frequency)
                error *= np.sqrt(1.0 - weight)
            apart = 0.5 * abs(time[[other.start, other.stop - 1]].sum() - time[[part.start, part.stop - 1]].sum())
            if error * apart > COUNTED:
                continue
            first, last, added = min(first, near), max(last, near), True
            part = slice(pieces[first].start, pieces[last].stop)
            few = min(10, resolved_harmonics(time[part], frequency, time.size))
            fit, pace = refine_frequency(time[part], values[:, part], frequency, few)
            known = fit.frequency, pace.se
    return part, known[0]


def _measured(time: np.ndarray, values: np.ndarray, fundamental: float) -> tuple[float, float] | None:
    """Return the frequency of a part and its standard error; None if the part is too short."""
    if np.ptp(time) * fundamental < MINIMUM_CYCLES:
        return None
    tracked = track_frequency(time, values, fundamental)
    few = min(10, covered_harmonics(time, tracked, time.size))
    if few < 1:
        return None
    fit, pace = refine_frequency(time, values, tracked, few)
    return fit.frequency, pace.se


def explains_more(fit: Fit, other: Fit) -> bool:
    """Return whether a fit leaves less than another one, over all channels."""
    return bool(np.sum(np.log(fit.variances / other.variances)) < 0.0)


def parts(time: np.ndarray, signal: np.ndarray) -> list[slice]:
    """Return the parts of at least three cycles between gaps of time and steps of the signal's frequency."""
    rising = _rising(signal)
    if rising.size < 2:
        return [slice(0, time.size)]
    period = float(np.median(np.diff(time[rising])))
    edges = np.concatenate([[0], gaps(time, period) + 1, [time.size]])
    pieces = []
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        inside = first + _rising(signal[first:last])
        steps = inside[_steps(time, signal, inside)]
        bounds = [first, *steps.tolist(), last]
        pieces += [slice(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    cycles = [np.searchsorted(rising, part.stop) - np.searchsorted(rising, part.start) for part in pieces]
    return [part for part, count in zip(pieces, cycles, strict=True) if count > MINIMUM_CYCLES]


def _rising(signal: np.ndarray) -> np.ndarray:
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
    mirrored = np.concatenate([period[1:2], period, period[-2:-1]])
    period = np.median([mirrored[:-2], period, mirrored[2:]], axis=0)
    steps, stack = [], [(0, period.size)]
    while stack:
        first, last = stack.pop()
        size = last - first
        number = np.arange(MINIMUM_CYCLES, size - MINIMUM_CYCLES + 1)
        if not number.size:
            continue
        segment = period[first:last]
        before = np.cumsum(segment)[number - 1]
        difference = before / number - (segment.sum() - before) / (size - number)
        score = np.abs(difference) * np.sqrt(number * (size - number) / size)
        best = int(np.argmax(score))
        if score[best] > SIGNIFICANT_PERIOD_STEP * noise and abs(difference[best]) > SMALLEST_PERIOD_STEP:
            middle = first + int(number[best])
            steps.append(middle)
            stack += [(first, middle), (middle, last)]
    return sorted(steps)
