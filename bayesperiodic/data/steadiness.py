"""The steady part of a recording: without ramps, without the rest of a transient that matters, and what remains."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.stats import t as student

from bayesperiodic import _fourier
from bayesperiodic.data.coverage import SLOW, determined_harmonics, per_cycle, resolved_harmonics
from bayesperiodic.data.harmonics import MINIMUM_CYCLES, fit_harmonics

# Parts of a cycle in which ramps begin or end, in recordings of so many cycles; most windows of long recordings.
WINDOWS_PER_CYCLE, FEW_CYCLES, MOST_WINDOWS = 8, 64, 256
HARMONICS = 5
# Least share of the usual samples of a window, and largest condition number of its amplitudes.
ENOUGH, LARGEST_WINDOW_CONDITION = 0.5, 30.0
# Share of the windows with samples that have enough of them; longer windows are tried otherwise.
MOST_COVERED = 0.75
# Samples for each unknown in a window of slow sampling.
SLOW_SAMPLES = 3.0
# Range of an amplitude in a steady part, relative to the amplitude and in standard deviations of a cycle's noise.
SMALL_RANGE, NOISE_RANGE = 0.08, 14.0
# Least level of a steady part relative to the largest amplitudes: a part at rest is steady too.
LEAST_LEVEL = 0.5
# Largest distance of a window from the middle of the steady part, relative to usual ones, in harmonics and mean value.
DISTANT, DISTANT_MEAN = 3.0, 12.0
# Windows, in cycles, from which the median of their distances is taken, the largest one of fewer.
FEWEST_FOR_MEDIAN = 9
# Windows from which a transient is searched for, and false-alarm rate of a significant slope.
FEWEST_FOR_TRANSIENT, SLOPE_FALSE_ALARM = 6, 1e-4
# Largest correlation of the noise of neighbouring windows.
LONGEST_MEMORY = 0.8
# Shares of a channel's standard deviation below which distances and noise do not count.
SMALLEST_DISTANCE, SMALLEST_NOISE = 1e-9, 1e-6
# Bias of the mean amplitudes by a transient that is allowed, in standard errors of all together.
ALLOWED_BIAS = 0.3
# Probability of a rest of a transient before the data, where the start was left out, and where it was not; with few
# windows, in which noise looks like one more often, it has to be clear.
PROBABLE, IMPROBABLE, IMPROBABLE_IN_FEW, FEW_WINDOWS = 0.9, 0.1, 1e-4, 10
# Decay times of transients, in cycles and relative to the recording, their number, and the number of frequencies.
SHORTEST_DECAY, LONGEST_DECAY, DECAYS, FREQUENCIES = 0.3, 1.0 / 6.0, 12, 13
# Decay times in which a transient is compared with noise, and most places of the recording with which it is compared.
LENGTH, CONTROLS = 6.0, 8


@dataclass(frozen=True)
class Windows:
    """Amplitudes of all channels in windows of whole cycles, which may overlap."""

    first: np.ndarray  # first sample of each window
    last: np.ndarray  # its last sample + 1
    place: np.ndarray  # its number; those with too few samples are missing
    overlap: int  # numbers from one window to the next that does not overlap it
    cycles: int  # in a window
    amplitudes: np.ndarray  # complex (windows, channels, harmonics + 1), relative to each channel's standard deviation
    slip: np.ndarray  # (channels,) changes of amplitudes by one sample more or less at jumps of the signals, likewise

    def chosen(self, used: "slice | list[int]") -> "Windows":
        """Return the windows with these indices."""
        first, last, place = (array[used] for array in (self.first, self.last, self.place))
        return Windows(first, last, place, self.overlap, self.cycles, self.amplitudes[used], self.slip)

    def apart(self) -> "Windows":
        """Return windows that do not overlap, the last one among them."""
        used = [len(self.place) - 1]
        for k in range(len(self.place) - 2, -1, -1):
            if self.place[used[-1]] - self.place[k] >= self.overlap:
                used.append(k)
        return self.chosen(used[::-1])

    @cached_property
    def sizes(self) -> np.ndarray:
        """Amplitudes of the strongest harmonic of each channel, (windows, channels)."""
        every = np.abs(self.amplitudes[:, :, 1:])
        strongest = every.mean(axis=0).argmax(axis=1)
        return np.take_along_axis(every, strongest[None, :, None], axis=2)[:, :, 0]


def windows(time: np.ndarray, values: np.ndarray, fundamental: float) -> Windows:
    """Return the amplitudes of signals (channels, samples) in windows along a recording.

    They are as long as needed for samples at all phases in most of them, gaps apart.
    """
    duration = np.ptp(time) * time.size / (time.size - 1) * (1 + 1e-9)
    total = int(duration * fundamental)
    cycles = max(1, total // MOST_WINDOWS)
    highest = resolved_harmonics(time, fundamental, time.size)
    if (many := per_cycle(time, fundamental)) < SLOW:
        # Higher harmonics of few samples would look like changes of the lower ones.
        higher = fit_harmonics(time, values, fundamental, highest).amplitudes
        higher[:, : HARMONICS + 1] = 0.0
        values = values - _fourier.at_times(higher, fundamental * time)
        unknowns = 2 * min(HARMONICS, highest) + 1
        cycles = max(cycles, min(int(np.ceil(SLOW_SAMPLES * unknowns / many)), total // (2 * MINIMUM_CYCLES)))
    while True:
        result, share = _windows_of(time, values, fundamental, duration, total, cycles, min(HARMONICS, highest))
        if share >= MOST_COVERED or 2 * MINIMUM_CYCLES * cycles > total:
            return result
        cycles *= 2


def _windows_of(
    time: np.ndarray, values: np.ndarray, fundamental: float, duration: float, total: int, cycles: int, highest: int
) -> tuple[Windows, float]:
    """Return windows of so many cycles, and the share that has enough samples of those that have any."""
    fine = WINDOWS_PER_CYCLE if total <= FEW_CYCLES else 1
    # Blocks of a fraction of a cycle, or of some cycles; the last one ends with the recording.
    length = cycles / fine / fundamental
    count = int(duration / length)
    back = ((time[-1] - time) / length + 1e-9).astype(int)
    edges = np.searchsorted(-back, np.arange(1 - count, 1))
    stops = np.concatenate([edges[1:], [time.size]])
    empty, edges = edges == stops, np.minimum(edges, time.size - 1)
    highest = min(highest, max((int(time.size * cycles / total) - 1) // 2, 1))
    order = np.arange(2 * determined_harmonics(time, fundamental, highest)[0] + 1)
    harmonics = order[: order.size // 2 + 1]
    used = slice(edges[0], None)
    wave, power = np.exp(-2j * np.pi * (fundamental * time[used] % 1.0)), np.ones(time[used].size, dtype=complex)
    scaled = values[:, used] / values.std(axis=1)[:, None]
    sums = np.empty((order.size, len(values) + 1, count), dtype=complex)
    for h in order:
        for row, signal in zip(sums[h], [1.0, *(scaled if h < harmonics.size else ())], strict=False):
            row[:] = np.add.reduceat(signal * power, edges - edges[0])
            row[empty] = 0.0
        power *= wave
    sums = np.lib.stride_tricks.sliding_window_view(sums, fine, axis=2).sum(axis=3)
    # Normal equations of each window, as in `fit_harmonics`; they are well conditioned where the samples are enough.
    moments = np.concatenate([np.conj(sums[:0:-1, 0]), sums[:, 0]])
    place = order[:, None] - order[None, :] + order.size - 1
    matrices = np.moveaxis(moments[place], -1, 0)
    right = np.moveaxis(np.concatenate([np.conj(sums[harmonics[:0:-1], 1:]), sums[harmonics, 1:]]), -1, 0)
    samples = sums[0, 0].real
    some = samples > 0.5
    few = samples < ENOUGH * np.median(samples[some])
    size = np.linalg.eigvalsh(matrices)
    enough = np.flatnonzero(~few & (size[:, 0] * LARGEST_WINDOW_CONDITION > size[:, -1]))
    amplitudes = np.linalg.solve(matrices[enough], right[enough])[:, harmonics[-1] :]
    amplitudes[:, 1:] *= 2.0
    first, last = edges[: count - fine + 1].copy(), stops[fine - 1 :]
    # Whole cycles before the first of many windows of several cycles are in it; its amplitudes are without them.
    first[0] -= np.count_nonzero(
        ((time[-1] - time[: first[0]]) * fundamental + 1e-9).astype(int) < int(duration * fundamental)
    )
    slip = np.zeros(len(values))
    if enough.size and per_cycle(time, fundamental) >= SLOW:
        slip = _slip(scaled, edges[::fine] - edges[0]) / np.median(last[enough] - first[enough])
    result = Windows(first[enough], last[enough], enough, fine, cycles, np.moveaxis(amplitudes, 1, 2), slip)
    return result, enough.size / np.count_nonzero(some)


def _slip(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return twice the median of the largest second differences in parts of signals (channels, samples).

    Samples that are not at the same phases of every cycle see jumps and narrow peaks earlier or later.
    """
    edges = edges[: max(np.searchsorted(edges, values.shape[1] - 2), 1)]
    edges = edges[np.r_[True, np.diff(edges) > 0]]
    largest = [np.median(np.maximum.reduceat(np.abs(np.diff(v, 2)), edges)) for v in values if v.size > 2]
    return 2.0 * np.array(largest if largest else np.zeros(len(values)))


@dataclass(frozen=True)
class Steady:
    """The steady part of a recording."""

    part: Windows  # that do not overlap
    samples: slice
    level: tuple[int, int]  # samples of the part of one level, before the rest of the transient is left out
    bias: float  # of all mean amplitudes together by the rest of the transient, in standard errors
    squares: np.ndarray  # expected squares of this bias (channels, harmonics + 1), relative to the channel's variance
    change: np.ndarray  # relative changes of the amplitudes within each half, where they are significant (2, channels)

    def among(self, numbers: np.ndarray) -> "Steady":
        """Return the same part of all samples, of which it was found by those with these numbers."""
        part = replace(self.part, first=numbers[self.part.first], last=numbers[self.part.last - 1] + 1)
        level = (int(numbers[self.level[0]]), int(numbers[self.level[1] - 1]) + 1)
        return replace(self, part=part, samples=slice(int(part.first[0]), int(part.last[-1])), level=level)


def steady_part(every: Windows) -> Steady | None:
    """Return the steady part of a recording; None if less than three cycles have one level."""
    first, last = plateau(every) if len(every.first) > every.overlap else (0, 0)
    if last - first <= (MINIMUM_CYCLES - 1) * every.overlap // every.cycles:
        return None
    part = every.chosen(slice(first, last))
    for usual in (None, np.max, np.max):
        part = part.chosen(slice(*_trimmed(part, usual)))
    part = part.apart()
    level = (int(part.first[0]), int(part.last[-1]))
    first, bias, squares = 0, 0.0, np.zeros(part.amplitudes.shape[1:])
    if len(part.first) >= FEWEST_FOR_TRANSIENT:
        probability = IMPROBABLE if len(part.first) >= FEW_WINDOWS else IMPROBABLE_IN_FEW
        if part.place[0] - every.place[0] >= part.overlap:
            probability = PROBABLE
        first, bias, squares = _after_transient(part, probability)
    part = part.chosen(slice(first, None))
    change = np.array([_change(half) for half in np.array_split(part.sizes, 2)])
    return Steady(part, slice(int(part.first[0]), int(part.last[-1])), level, bias, squares, change)


def _change(sizes: np.ndarray) -> np.ndarray:
    """Return the relative change of amplitudes (windows, channels) by linear regression, 0 where insignificant."""
    count = len(sizes)
    if count < 3:
        return np.zeros(sizes.shape[1])
    place = np.arange(count) - 0.5 * (count - 1)
    slope = place @ sizes / (place @ place)
    rest = sizes - sizes.mean(axis=0) - place[:, None] * slope
    error = np.sqrt(np.sum(rest**2, axis=0) / max(count - 2, 1) / (place @ place))
    # Noise that lasts longer than a window, as first-order autoregressive one.
    power = np.sum(rest**2, axis=0)
    memory = np.divide(np.sum(rest[1:] * rest[:-1], axis=0), power, out=np.zeros(power.size), where=power > 0.0)
    memory = np.clip(memory, 0.0, LONGEST_MEMORY)
    error *= np.sqrt((1.0 + memory) / (1.0 - memory))
    change = slope * count / np.abs(sizes.mean(axis=0))
    significant = np.abs(slope) > error * student.isf(0.5 * SLOPE_FALSE_ALARM, count - 2)
    return np.where(significant, change, 0.0)


def plateau(part: Windows) -> tuple[int, int]:
    """Return the longest part in which the range of every channel's amplitude is small, as windows first … last − 1."""
    size = part.sizes
    level = np.quantile(size, 0.9, axis=0)
    noise = np.quantile(np.abs(size[part.overlap :] - size[: -part.overlap]), 0.15, axis=0) / 0.267
    limit = np.maximum(SMALL_RANGE * level, NOISE_RANGE * noise) + 2.0 * part.slip
    best = (0, 0)
    for first in range(len(size)):
        if len(size) - first < best[1] - best[0]:
            break
        rest = size[first:]
        spread = np.maximum.accumulate(rest) - np.minimum.accumulate(rest)
        inside = (spread <= limit).all(axis=1)
        count = int(np.argmin(inside)) if not inside.all() else inside.size
        if count >= best[1] - best[0] and (np.median(rest[:count], axis=0) >= LEAST_LEVEL * level).any():
            best = (first, first + count)
    return best


def _trimmed(part: Windows, usual: Callable[..., Any] | None = None) -> tuple[int, int]:
    """Return windows first … last − 1 without those at the ends that are far from the middle half."""
    shape, reach = part.amplitudes, part.overlap
    count = len(shape)
    inner = slice(count // 4, count - count // 4)
    middle = np.median(shape[inner].real, axis=0) + 1j * np.median(shape[inner].imag, axis=0)
    away, near = np.abs(shape - middle) ** 2, np.ones(count, dtype=bool)
    # The median of few windows is one of them in every component, and the median distance from it is no scale.
    usual = usual or (np.max if count // 2 < FEWEST_FOR_MEDIAN * reach else np.median)
    for squares, factor in ((away[:, :, 1:].sum(axis=2), DISTANT), (away[:, :, 0], DISTANT_MEAN)):
        distance = np.sqrt(squares)
        near &= (distance <= factor * usual(distance[inner], axis=0) + part.slip + SMALLEST_DISTANCE).all(axis=1)
    first, last, least = 0, count, (MINIMUM_CYCLES - 1) * reach + 1
    span = min(2 * reach + 1, least)
    while last - first > least and not near[first : first + span].all():
        first += 1
    while last - first > least and not near[last - span : last].all():
        last -= 1
    return first, last


def transient_bias(shape: np.ndarray, probability: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bias of means over cycles k, k + 1, … by a transient, in standard errors, and its expected squares.

    They are (cycles,) and (cycles, components), for the components (cycles, components) of the amplitudes. A transient
    of linear decay is exp(−t/T) times a cosine and a sine, with unknown T and frequency, in all components; its sizes
    have a normal prior of that variance which makes the data most probable. What noise does at the other end of the
    recording is no transient. The averages are over all T and frequencies by their probabilities, and over no
    transient; before the data, one has this probability.
    """
    count = len(shape)
    step = np.diff(shape, axis=0)
    noise = np.maximum(np.sqrt(np.mean(step[count // 3 :] ** 2, axis=0) / 2.0), SMALLEST_NOISE)
    # Components without noise, as of a computed input, tell nothing about the others.
    noisy = noise > SMALLEST_NOISE if (noise > SMALLEST_NOISE).any() else np.ones(noise.size, dtype=bool)
    scaled = ((shape - shape.mean(axis=0)) / noise)[:, noisy]
    share = _independent((step / noise)[:, noisy]) / scaled.shape[1]
    cycle, remaining = np.arange(count, dtype=float), np.arange(count, 0, -1.0)
    gains, means, variances = [], [], []
    for decay in np.geomspace(SHORTEST_DECAY, max(LONGEST_DECAY * count, 2.0 * SHORTEST_DECAY), DECAYS):
        length = min(int(np.ceil(LENGTH * decay)) + 2, count)
        ends = np.unique(np.linspace(0, max(count - length - int(LENGTH * decay / 2), 0), CONTROLS).astype(int))
        starts = ends[ends > 0] + int(LENGTH * decay / 2)
        elsewhere = [scaled[::-1][k : k + length] for k in ends] + [scaled[k : k + length] for k in starts]
        others = np.concatenate([part for part in elsewhere if len(part) == length], axis=1)
        for angle in np.linspace(0.0, np.pi, FREQUENCIES):
            course = np.exp(-cycle[:, None] / decay + 1j * angle * cycle[:, None])
            course = np.hstack([course.real, course.imag][: 1 if angle in (0.0, np.pi) else 2])
            basis, root = np.linalg.qr(course[:length] - course[:length].mean(axis=0))
            ahead, behind = basis.T @ scaled[:length], basis.T @ others
            usual = max(float(np.mean(behind**2)), 1.0)
            ratio = max(float(np.mean(ahead**2)) / usual, 1.0)
            free, known = ahead.size * share, behind.size * share
            gains.append(
                0.5 * ((free + known) * np.log((free * ratio + known) / (free + known)) - free * np.log(ratio))
            )
            # The transient ends at zero, so that its mean is the bias.
            later = np.cumsum(course[::-1], axis=0)[::-1] / remaining[:, None] @ np.linalg.pinv(root)
            kept = 1.0 - 1.0 / ratio
            means.append(kept * later @ ahead)
            variances.append(kept * usual * np.sum(later**2, axis=1))
    weight = np.exp(np.array(gains) - max(gains))
    weight /= weight.sum() + (1.0 / probability - 1.0) * len(gains) * np.exp(-max(gains))
    mean = np.einsum("m,mkd->kd", weight, np.array(means))
    spread = np.einsum("m,mkd->kd", weight, np.array(means) ** 2) - mean**2 + (weight @ np.array(variances))[:, None]
    # The mean in the worst direction of all components, and its uncertainty in any one of them.
    total = (np.sum(mean**2, axis=1) + np.mean(spread, axis=1)) * remaining
    squares = np.zeros(shape.shape)
    squares[:, noisy] = (mean**2 + spread) * noise[noisy] ** 2
    return np.sqrt(total), squares


def _independent(steps: np.ndarray) -> float:
    """Return the effective number of independent components of noise, by the products of different cycles' steps."""
    products = steps @ steps.T
    number = np.arange(len(steps))
    apart = np.abs(number[:, None] - number) > 1
    square = float(np.mean(products[apart] ** 2)) if apart.any() else 0.0
    if not square > 0.0:
        return 1.0
    return float(np.clip(np.median(np.diag(products)) ** 2 / square, 1.0, steps.shape[1]))


def _after_transient(part: Windows, probability: float) -> tuple[int, float, np.ndarray]:
    """Return the first window to use, the bias [standard errors] then, and its expected squares by amplitude."""
    shape = part.amplitudes
    count, channels, harmonics = shape.shape
    components = np.concatenate([shape.real, shape.imag[:, :, 1:]], axis=2)
    bias, squares = transient_bias(components.reshape(count, -1), probability)
    bias = bias[: count - MINIMUM_CYCLES + 1]
    allowed = np.flatnonzero(bias[: count // 2 + 1] <= ALLOWED_BIAS)
    # If half of the cycles has more bias, the mean square error of what is biased is least.
    error = (1.0 + bias**2) / np.arange(count, MINIMUM_CYCLES - 1, -1)
    first = int(allowed[0]) if allowed.size else int(np.argmin(error))
    by_part = squares[first].reshape(channels, -1)
    by_harmonic = by_part[:, :harmonics].copy()
    by_harmonic[:, 1:] += by_part[:, harmonics:]
    return first, float(bias[first]), by_harmonic
