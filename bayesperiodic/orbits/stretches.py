"""Signals over time in unbroken stretches, and their values between the samples by local polynomials."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from bayesperiodic.data.recording import Recording

# Samples a period at least; a step of time is a gap if it is longer than that and than the first number of usual steps,
# or longer than the second number of them. The usual step is a high quantile, because the steps may differ.
FEWEST_SAMPLES, SMALLEST_GAP, LONGEST_USUAL_STEP, USUAL_STEP = 8, 1.5, 3.0, 0.9
# A recording continues the one before if it starts between these multiples of the usual step after its end.
EARLIEST, LATEST = 0.5, 1.5
# Local polynomials: degree for the values; degree and number of samples for the variance of the noise.
VALUE_DEGREE, NOISE_DEGREE, NOISE_SAMPLES = 7, 11, 14
# Half the number of samples in the smallest window.
SMALLEST_WINDOW = (VALUE_DEGREE + 1) // 2
# The window is narrower by this factor than the first window with a significant bias.
WINDOW_MARGIN = 1.6
# Fewest instants from which the window and the noise are determined.
FEWEST_INSTANTS = 50
# Instants from which windows are determined that serve everywhere in a recording.
WINDOW_INSTANTS = 2000
CROSSINGS_EACH = 20_000


class Stretches(NamedTuple):
    """Signals of one or several recordings in the order of time."""

    time: np.ndarray  # (samples,)
    signals: np.ndarray  # (samples, channels)
    starts: np.ndarray  # first sample of each unbroken stretch, (stretches,)

    @property
    def stops(self) -> np.ndarray:
        """Sample after the last one of each stretch, (stretches,)."""
        return np.append(self.starts[1:], self.time.size)

    @property
    def sampling_rate(self) -> float:
        """Mean sampling rate within the stretches."""
        lasting = np.sum(self.time[self.stops - 1] - self.time[self.starts])
        return float((self.time.size - self.starts.size) / lasting)

    def instants(
        self, frequency: float, origin: float, reach: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the times of whole tau, the stretch of each, and how many between first and last are in gaps.

        The times from tau plus the first of `reach` to tau plus the second one, in periods, are in the same stretch.
        Stretches with fewer samples than the smallest window count as gaps.
        """
        first = np.ceil((self.time[self.starts] - origin) * frequency - reach[0] - 1e-9).astype(np.int64)
        last = np.floor((self.time[self.stops - 1] - origin) * frequency - reach[1] + 1e-9).astype(np.int64)
        # Of two stretches that touch at an instant, the first one has it.
        first[1:] = np.maximum(first[1:], last[:-1] + 1)
        counts = np.where(self.stops - self.starts >= 2 * SMALLEST_WINDOW, np.maximum(last + 1 - first, 0), 0)
        stretch = np.repeat(np.arange(counts.size), counts)
        numbers = first[stretch] + np.arange(stretch.size) - np.repeat(np.cumsum(counts) - counts, counts)
        return origin + numbers / frequency, stretch, int(last[-1] + 1 - first[0]) - numbers.size

    def windows(self, at: np.ndarray, stretch: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the first of the 2·half samples about each instant, all in its stretch, and whether it is centred."""
        centred = np.searchsorted(self.time, at) - half
        first = np.clip(centred, self.starts[stretch], self.stops[stretch] - 2 * half)
        return first, first == centred


def joined(recordings: Sequence[Recording], signals: Sequence[np.ndarray], frequency: float | None) -> Stretches:
    """Return the signals of recordings, in any order, as unbroken stretches; raise a ValueError if two overlap."""
    order = sorted(range(len(recordings)), key=lambda k: recordings[k].time[0])
    times = [recordings[k].time for k in order]
    starts: list[np.ndarray] = []
    size, last_usual = 0, np.inf
    for position, (k, time) in enumerate(zip(order, times, strict=True)):
        step = np.diff(time)
        usual = usual_step(time)
        if position > 0:
            end, before = times[position - 1][-1], order[position - 1]
            if time[0] <= end:
                raise ValueError(
                    f"recordings: must not overlap in time, got recordings[{k}] from {time[0]:.9g} s and "
                    f"recordings[{before}] until {end:.9g} s. Count the times of all from one instant, and leave "
                    "repeated samples out by `between`."
                )
            away = time[0] - end
        if position == 0 or not all(EARLIEST * one <= away <= LATEST * one for one in (usual, last_usual)):
            starts.append(np.array([size]))
        limit = LONGEST_USUAL_STEP * usual
        if frequency is not None:
            limit = max(SMALLEST_GAP * usual, min(limit, 1.0 / (FEWEST_SAMPLES * frequency)))
        starts.append(size + 1 + np.flatnonzero(step > limit))
        size, last_usual = size + time.size, usual
    values = np.concatenate([signals[k] for k in order])
    return Stretches(np.concatenate(times), values, np.concatenate(starts))


def usual_step(time: np.ndarray) -> float:
    """Return a step of time that few steps without a gap exceed."""
    return float(np.quantile(np.diff(time), USUAL_STEP))


def smoothed(samples: Stretches, at: np.ndarray, stretch: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return signals (instants, channels) at given instants, and the standard deviation of their errors (channels,).

    Windows are no longer than `longest`.

    Each channel has its widest window without bias, see `unbiased_windows`.
    Where a stretch ends within the window, the smallest one is used, beside the instant if necessary. The standard
    deviation is NaN if there are too few other instants.
    """
    halves, variance = chosen_windows(samples, at, stretch, int(0.5 * samples.sampling_rate * longest))
    values, gains = windowed(samples, at, stretch, halves)
    return values, np.sqrt(variance * gains.mean(axis=0))


def chosen_windows(
    samples: Stretches, at: np.ndarray, stretch: np.ndarray, widest: int
) -> tuple[list[int], np.ndarray]:
    """Return half the number of samples in each channel's window, up to `widest`, and its noise's variance (channels,).

    Smallest windows, and NaN, where too few instants are away from the ends of their stretches.
    """
    widest = max(SMALLEST_WINDOW, widest)
    inner = samples.windows(at, stretch, max(widest, NOISE_SAMPLES // 2))[1]
    if np.count_nonzero(inner) < FEWEST_INSTANTS:
        return [SMALLEST_WINDOW] * samples.signals.shape[1], np.full(samples.signals.shape[1], np.nan)
    variance = noise_variance(samples, at[inner], stretch[inner])
    return unbiased_windows(samples, at[inner], stretch[inner], widest, variance), variance


def windowed(
    samples: Stretches, at: np.ndarray, stretch: np.ndarray, halves: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return signals at given instants, and their variances for unit noise, (instants, channels) each.

    Each channel has its window, of which `halves` are half the numbers of samples; where a stretch ends within the
    window, the smallest one is used.
    """
    values, gain = local_fit(samples, at, stretch)
    gains = np.repeat(gain[:, None], values.shape[1], axis=1)
    for channel, half in enumerate(halves):
        if half > SMALLEST_WINDOW:
            fits = samples.windows(at, stretch, half)[1]
            one = samples._replace(signals=samples.signals[:, [channel]])
            fitted, wide = local_fit(one, at[fits], stretch[fits], half)
            values[fits, channel], gains[fits, channel] = fitted[:, 0], wide
    return values, gains


def noise_variance(samples: Stretches, at: np.ndarray, stretch: np.ndarray) -> np.ndarray:
    """Return the variance (channels,) of white noise of the samples, from those about given instants."""
    # A higher degree on few samples: noise dominates the residual.
    return _residual_variance(samples, at, stretch, NOISE_SAMPLES // 2, NOISE_DEGREE)


def unbiased_windows(
    samples: Stretches, at: np.ndarray, stretch: np.ndarray, widest: int, variance: np.ndarray
) -> list[int]:
    """Return half the number of samples in the widest window without bias, for each channel.

    Polynomials of degree 7 are fitted in windows of increasing width about given instants, up to twice `widest`
    samples. For white noise of a variance (channels,) the expected squared difference between a narrow and a wide
    estimate is known except for the squared bias of the wide one; the excess is tested for significance. Bias is
    proportional to the eighth power of the width, so in a window 1.6 times narrower than the first significant one it
    is 40 times smaller, and negligible even in averages over hundreds of instants.
    """
    narrow, narrow_gain = local_fit(samples, at, stretch)
    halves, unbiased = [SMALLEST_WINDOW], np.ones(variance.size, dtype=bool)
    first_biased = np.full(variance.size, widest)
    while (half := halves[-1] + max(1, halves[-1] // 5)) <= widest and unbiased.any():
        wide, gain = local_fit(samples, at, stretch, half)
        squared = (wide - narrow) ** 2
        bias = squared.mean(0) - variance * (narrow_gain.mean() - gain.mean())
        biased = unbiased & (bias > 2.0 * squared.std(0) / np.sqrt(len(wide)))
        first_biased[biased], unbiased[biased] = half, False
        halves.append(half)
    return [
        max(h for h in halves if h == SMALLEST_WINDOW or h * WINDOW_MARGIN <= first) for first in first_biased.tolist()
    ]


def local_fit(
    samples: Stretches, at: np.ndarray, stretch: np.ndarray, half: int = SMALLEST_WINDOW
) -> tuple[np.ndarray, np.ndarray]:
    """Return values of polynomials on 2·half samples each, and their variance for unit noise."""
    centre = np.polynomial.legendre.legvander(np.zeros(1), VALUE_DEGREE)[0]
    values, gains = [], []
    for basis, reference, local in _local_bases(samples, at, stretch, half, VALUE_DEGREE):
        normal = basis.transpose(0, 2, 1) @ basis
        weights = basis @ np.linalg.solve(normal, np.broadcast_to(centre[:, None], (len(basis), VALUE_DEGREE + 1, 1)))
        values.append(reference + (weights.transpose(0, 2, 1) @ local)[:, 0])
        gains.append((weights[..., 0] ** 2).sum(1))
    return np.concatenate(values), np.concatenate(gains)


def _residual_variance(samples: Stretches, at: np.ndarray, stretch: np.ndarray, half: int, degree: int) -> np.ndarray:
    """Return the residual variance (channels,) of polynomials on 2·half samples each, the mean over the instants."""
    total = np.zeros(samples.signals.shape[1])
    for basis, _, local in _local_bases(samples, at, stretch, half, degree):
        across = basis.transpose(0, 2, 1)
        residual = local - basis @ np.linalg.solve(across @ basis, across @ local)
        total += (residual**2).sum((0, 1))
    return total / max(2 * half - degree - 1, 1) / len(at)


def _local_bases(
    samples: Stretches, at: np.ndarray, stretch: np.ndarray, half: int, degree: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield Legendre polynomials in the window of each instant, and one of its samples and all minus that one."""
    first, time = samples.windows(at, stretch, half)[0], samples.time
    for k in range(0, len(at), CROSSINGS_EACH):
        index = first[k : k + CROSSINGS_EACH, None] + np.arange(2 * half)
        width = 0.5 * (time[index[:, -1]] - time[index[:, 0]])
        places = (time[index] - at[k : k + CROSSINGS_EACH, None]) / width[:, None]
        local = samples.signals[index]
        reference = local[:, half]
        yield np.polynomial.legendre.legvander(places, degree), reference, local - reference[:, None]
