"""Instants at which a measured channel crosses a level, found in the smoothed channel."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesperiodic.orbits.coordinates import delays_of, longest_window_of_crossings
from bayesperiodic.orbits.stretches import SMALLEST_WINDOW, WINDOW_INSTANTS, Stretches, chosen_windows, windowed

# Fewest points of a section.
FEWEST_POINTS = 200
# A channel must go so far below the level and above it for a crossing, in standard deviations of the channel and in
# standard deviations of the smoothed channel's errors, so that noise adds none.
CROSSING_BAND, CROSSING_NOISE = 0.1, 5.0
# Smoothed values are taken this often in half a window.
VALUES_EACH_HALF = 4
# Newton steps from linear interpolation; the slope is the mean one across the band.
CROSSING_STEPS = 8


class Crossings(NamedTuple):
    """Upward crossings of zero, in the order of time."""

    instants: np.ndarray  # (count,) [s]
    stretch: np.ndarray  # of each, (count,)
    slopes: np.ndarray  # of the signal, means across the band, (count,)
    band: float  # the signal goes so far below zero and above it

    @property
    def returns(self) -> np.ndarray:
        """Times between consecutive crossings of a stretch, (returns,) [s]."""
        return np.diff(self.instants)[np.diff(self.stretch) == 0]

    def with_intervals(self, error: float) -> tuple["Crossings", np.ndarray, np.ndarray]:
        """Return those with one before in the same stretch, the times since then, and their standard deviations.

        `error` is the standard deviation of the signal's errors.
        """
        kept, variance = np.append(False, np.diff(self.stretch) == 0), (error / self.slopes) ** 2
        since, sd = np.diff(self.instants, prepend=np.nan), np.sqrt(variance + np.roll(variance, 1))
        return self.some(kept), since[kept], sd[kept]

    def within(self, samples: Stretches, earliest: float, latest: float) -> "Crossings":
        """Return those from which the delays [s] from the earliest to the latest one are in the same stretch."""
        first, last = samples.time[samples.starts], samples.time[samples.stops - 1]
        early, late = self.instants + earliest, self.instants + latest
        return self.some((early >= first[self.stretch]) & (late <= last[self.stretch]))

    def some(self, kept: np.ndarray) -> "Crossings":
        """Return some of them."""
        return self._replace(instants=self.instants[kept], stretch=self.stretch[kept], slopes=self.slopes[kept])


def crossings_for(
    samples: Stretches, values: np.ndarray, level: float, direction: int, names: Sequence[str], channel: str
) -> tuple[Crossings, float, float]:
    """Return where the values (samples, 1) of a channel cross a level and the coordinates are known.

    Also the sd of the values' errors there, and the longest window [s] of the coordinates, whose names are given.
    """
    height, delays = samples._replace(signals=direction * (values - level)), delays_of(names)
    crossings = upward_crossings(height, samples.time.size // (2 * FEWEST_POINTS))
    if not crossings.instants.size:
        raise ValueError(
            f"level: must be crossed by {channel!r}, got no crossing of {level:.6g} by {crossings.band:.3g} on both "
            f"sides. Take another one, such as {0.5 * (values.min() + values.max()):.3g}, or sample faster."
        )
    crossings = crossings.within(samples, delays.min(), delays.max())
    check_count(crossings.instants.size)
    longest = longest_window_of_crossings(names, channel, samples.sampling_rate, crossings.returns)
    return *refined(height, crossings, longest), longest


def upward_crossings(samples: Stretches, widest: int) -> Crossings:
    """Return where the only signal crosses zero upwards, by linear interpolation of smoothed values.

    Between two crossings the signal goes below minus the band and above the band, and no crossing is between stretches.
    Windows have at most 2·`widest` samples.
    """
    some = np.unique(np.linspace(0, samples.time.size - 1, WINDOW_INSTANTS).astype(int))
    piece = np.searchsorted(samples.starts, some, side="right") - 1
    (half,), variance = chosen_windows(samples, samples.time[some], piece, widest)
    long = np.flatnonzero(samples.stops - samples.starts >= 2 * SMALLEST_WINDOW)
    spans = zip(samples.starts[long], samples.stops[long], strict=True)
    places = [np.arange(start, stop, max(1, half // VALUES_EACH_HALF)) for start, stop in spans]
    stretch = np.repeat(long, [one.size for one in places])
    time = samples.time[np.concatenate([*places, np.empty(0, dtype=int)])]
    smooth, gains = windowed(samples, time, stretch, [half])
    signal, error = smooth[:, 0], float(np.sqrt(np.nan_to_num(variance[0]) * np.median(gains)))
    band = max(CROSSING_BAND * float(samples.signals.std()), CROSSING_NOISE * error)
    marks = np.flatnonzero(np.abs(signal) > band)
    low, high = marks[:-1], marks[1:]
    up = (signal[low] < 0.0) & (signal[high] > 0.0) & (stretch[low] == stretch[high])
    low, high = low[up], high[up]
    negative = np.flatnonzero(signal < 0.0)
    before = negative[np.searchsorted(negative, high) - 1]
    step = (time[before + 1] - time[before]) / (signal[before + 1] - signal[before])
    slopes = (signal[high] - signal[low]) / (time[high] - time[low])
    return Crossings(time[before] - signal[before] * step, stretch[before], slopes, band)


def refined(samples: Stretches, crossings: Crossings, longest: float) -> tuple[Crossings, float]:
    """Return the crossings of the signal in windows no longer than `longest`, and the sd of its errors there."""
    at, stretch, slopes = crossings.instants, crossings.stretch, crossings.slopes
    halves, variance = chosen_windows(samples, at, stretch, int(0.5 * samples.sampling_rate * longest))
    reach = crossings.band / slopes
    for _ in range(CROSSING_STEPS):
        values, gains = windowed(samples, at, stretch, halves)
        at = np.clip(at - values[:, 0] / slopes, crossings.instants - reach, crossings.instants + reach)
    return crossings._replace(instants=at), float(np.sqrt(variance[0] * gains.mean()))


def check_count(count: int) -> None:
    """Raise a ValueError unless there are enough points."""
    if count < FEWEST_POINTS:
        raise ValueError(
            f"section: must have at least {FEWEST_POINTS} points, got {count}; thousands are better. Record longer."
        )
