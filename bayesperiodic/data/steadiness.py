"""The steady part of a recording: without ramps, without the rest of a transient that matters, and what remains."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import stdtrit

from bayesperiodic import _fourier
from bayesperiodic.data.changes import LONGEST_CUT, LONGEST_CUT_FREE, POSSIBLE, PROBABLE, TRANSIENT, Changes, changes
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
# Windows, in cycles, of whose middle half the median distance is taken, the largest one of fewer.
FEWEST_FOR_MEDIAN = 18
# Windows from which changes are searched for, and false-alarm rate of a significant slope.
FEWEST_FOR_CHANGES, SLOPE_FALSE_ALARM = 5, 1e-4
# Probability of a transient from which the start is left out; more than half of the cycles are left out, and those of
# few windows, in which noise looks like one more often, only if it is clear.
LEFT_OUT, LEFT_OUT_OF_FEW, FEW_WINDOWS = 0.5, 0.95, 10
# Weight of the squared bias by a transient relative to the variance, where cycles are left out.
BIAS_WEIGHT = 4.0
# Largest correlation of the noise of neighbouring windows.
LONGEST_MEMORY = 0.8
# Second differences of smooth signals and noise, relative to their median.
SMOOTH_OR_NOISE = 6.0
# Share of a channel's standard deviation below which distances do not count.
SMALLEST_DISTANCE = 1e-9


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
    jump: np.ndarray  # (channels,) the same by jumps and narrow peaks only

    def chosen(self, used: "slice | list[int]") -> "Windows":
        """Return the windows with these indices."""
        first, last, place = (array[used] for array in (self.first, self.last, self.place))
        return replace(self, first=first, last=last, place=place, amplitudes=self.amplitudes[used])

    def among(self, numbers: np.ndarray) -> "Windows":
        """Return the same windows of all samples, of which they have those with these numbers."""
        return replace(self, first=numbers[self.first], last=numbers[self.last - 1] + 1)

    def aligned(self) -> "Windows":
        """Return the windows, each with its phase turned to the mean one."""
        first = self.amplitudes[:, :, 1]
        turn = np.angle(np.sum(first * np.conj(first.mean(axis=0)), axis=1))
        order = np.arange(self.amplitudes.shape[2])
        return replace(self, amplitudes=self.amplitudes * np.exp(-1j * turn[:, None, None] * order))

    def apart(self) -> "Windows":
        """Return windows that do not overlap, the last one among them."""
        used = [len(self.place) - 1]
        for k in range(len(self.place) - 2, -1, -1):
            if self.place[used[-1]] - self.place[k] >= self.overlap:
                used.append(k)
        return self.chosen(used[::-1])

    @cached_property
    def strongest(self) -> np.ndarray:
        """The strongest harmonic of each channel."""
        return 1 + np.abs(self.amplitudes[:, :, 1:]).mean(axis=0).argmax(axis=1)

    @cached_property
    def lines(self) -> np.ndarray:
        """Complex amplitudes of the strongest harmonic of each channel, (windows, channels)."""
        return np.take_along_axis(self.amplitudes, self.strongest[None, :, None], axis=2)[:, :, 0]

    @cached_property
    def sizes(self) -> np.ndarray:
        """Amplitudes of the strongest harmonic of each channel, (windows, channels)."""
        return np.abs(self.lines)


def windows(time: np.ndarray, values: np.ndarray, fundamental: float, length: int = 1) -> Windows:
    """Return the amplitudes of signals (channels, samples) in windows along a recording.

    They are as long as needed for samples at all phases in most of them, gaps apart, and at least `length` cycles.
    """
    duration = np.ptp(time) * time.size / (time.size - 1) * (1 + 1e-9)
    total = int(duration * fundamental)
    cycles = max(length, total // MOST_WINDOWS)
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
    scale = np.array([signal.std() for signal in values])
    sums = _block_sums(fundamental * time[used], values[:, used], edges - edges[0], order.size, harmonics.size)
    sums[:, 1:] /= scale[:, None]
    sums[:, :, empty] = 0.0
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
    first[0] -= np.count_nonzero((time[-1] - time[: first[0]]) * fundamental + 1e-9 < int(duration * fundamental))
    slip = jump = np.zeros(len(values))
    if enough.size and per_cycle(time, fundamental) >= SLOW:
        number = np.median(last[enough] - first[enough])
        slip, jump = (size / number / scale for size in _slip(values[:, used], edges[::fine] - edges[0]))
    result = Windows(first[enough], last[enough], enough, fine, cycles, np.moveaxis(amplitudes, 1, 2), slip, jump)
    return result, enough.size / np.count_nonzero(some)


def _block_sums(phase: np.ndarray, values: np.ndarray, edges: np.ndarray, orders: int, harmonics: int) -> np.ndarray:
    """Return the sums of exp(−2πi h phase), h < orders, and with signals, h < harmonics, from each edge to the next.

    The array (orders, channels + 1, edges) is that of some edges after the other, so that the waves need little memory.
    """
    sums = np.zeros((orders, len(values) + 1, edges.size), dtype=complex)
    ends = np.append(edges[1:], phase.size)
    first = 0
    while first < edges.size:
        stop = max(int(np.searchsorted(ends, edges[first] + _fourier.CHUNK, side="right")), first + 1)
        part = slice(edges[first], max(ends[stop - 1], edges[stop - 1] + 1))
        wave, place = np.exp(-2j * np.pi * (phase[part] % 1.0)), edges[first:stop] - edges[first]
        power = np.ones(wave.size, dtype=complex)
        for h in range(orders):
            for row, signal in zip(sums[h], [1.0, *(values[:, part] if h < harmonics else ())], strict=False):
                row[first:stop] = np.add.reduceat(signal * power, place)
            power *= wave
        first = stop
    return sums


def _slip(values: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return twice the median of the largest second differences in parts of signals (channels, samples).

    Samples that are not at the same phases of every cycle see jumps and narrow peaks earlier or later. The second array
    is without what smooth signals and noise have, a multiple of the median.
    """
    edges = edges[: max(np.searchsorted(edges, values.shape[1] - 2), 1)]
    edges = edges[np.r_[True, np.diff(edges) > 0]]
    if values.shape[1] < 3:
        return np.zeros(len(values)), np.zeros(len(values))
    largest, usual = np.empty(len(values)), np.empty(len(values))
    for i, v in enumerate(values):
        bend = np.diff(np.diff(v))
        np.abs(bend, out=bend)
        largest[i] = np.median(np.maximum.reduceat(bend, edges))
        usual[i] = np.median(bend, overwrite_input=True)
    return 2.0 * largest, 2.0 * np.maximum(largest - SMOOTH_OR_NOISE * usual, 0.0)


@dataclass(frozen=True)
class Steady:
    """The steady part of a recording."""

    part: Windows  # that do not overlap
    samples: slice
    level: tuple[int, int]  # samples of the part of one level, before the rest of the transient is left out
    squares: np.ndarray  # expected squared bias of the means (channels, harmonics + 1), relative to the variance
    change: np.ndarray  # relative changes of the amplitudes within each half, where they are significant (2, channels)
    bias: float = 0.0  # of all mean amplitudes together by the rest of the transient, in standard errors
    transient: float = 0.0  # probability of it
    changes: Changes | None = None  # in the part

    def among(self, numbers: np.ndarray) -> "Steady":
        """Return the same part of all samples, of which it was found by those with these numbers."""
        part = self.part.among(numbers)
        level = (int(numbers[self.level[0]]), int(numbers[self.level[1] - 1]) + 1)
        return replace(self, part=part, samples=slice(int(part.first[0]), int(part.last[-1])), level=level)


def steady_part(every: Windows, driven: bool) -> Steady | None:
    """Return the steady part of a recording; None if less than three cycles have one level."""
    longest = LONGEST_CUT if driven else LONGEST_CUT_FREE
    first, last = plateau(every) if len(every.first) > every.overlap else (0, 0)
    if last - first <= (MINIMUM_CYCLES - 1) * every.overlap // every.cycles:
        return None
    part = every.chosen(slice(first, last))
    for usual in (None, np.max, np.max):
        part = part.chosen(slice(*_trimmed(part, usual)))
    part = part.apart()
    level = (int(part.first[0]), int(part.last[-1]))
    change = np.zeros((2, part.amplitudes.shape[1]))
    if len(part.first) < FEWEST_FOR_CHANGES:
        return Steady(part, _samples(part), level, np.zeros(part.amplitudes.shape[1:]), change)
    began = part.place[0] - every.place[0] >= part.overlap
    components = _components(part.amplitudes)
    effects = changes(components, PROBABLE if began else POSSIBLE, longest)
    # The mean square error of what is biased is least; a bias counts more than noise, whose size is known.
    error = (1.0 + BIAS_WEIGHT * effects.bias**2) / np.arange(len(components), 0, -1)
    least = LEFT_OUT_OF_FEW if len(components) < FEW_WINDOWS else LEFT_OUT
    probable, clear = (effects.probability[TRANSIENT] > p for p in (least, LEFT_OUT_OF_FEW))
    most = len(error) - MINIMUM_CYCLES + 1 if clear else len(error) // 2
    first = int(np.argmin(error[:most])) if probable else 0
    part = part.chosen(slice(first, None))
    enough = len(part.first) >= FEWEST_FOR_CHANGES
    later = changes(components[first:], POSSIBLE, longest) if first and enough else effects
    squares = effects.squares[first]
    # What noise alone would show is in the variance already.
    if later.slow:
        squares = squares + later.lasting[0 if enough else first]
    by_part = squares.reshape(change.shape[1], -1)
    count = part.amplitudes.shape[2]
    by_harmonic = by_part[:, :count].copy()
    by_harmonic[:, 1:] += by_part[:, count:]
    change = np.array([_change(half) for half in np.array_split(part.sizes, 2)])
    transient = 0.0 if effects.slow else float(effects.moving.max())
    return Steady(
        part,
        _samples(part),
        level,
        by_harmonic,
        change,
        float(effects.bias[first]),
        transient,
        later if enough else None,
    )


def _samples(part: Windows) -> slice:
    return slice(int(part.first[0]), int(part.last[-1]))


def _components(shape: np.ndarray) -> np.ndarray:
    """Return real components of amplitudes (windows, channels, harmonics + 1) without common drifts of the phase.

    Of each channel they are the mean value, the parts along the mean amplitudes, and those across.
    """
    harmonic, place = np.arange(shape.shape[2]), np.arange(len(shape)) - 0.5 * (len(shape) - 1)
    mean = shape.mean(axis=0)
    size = np.abs(mean)
    turned = shape * np.divide(np.conj(mean), size, out=np.ones(mean.shape, dtype=complex), where=size > 0.0)
    noise = np.mean(np.abs(np.diff(turned, axis=0)) ** 2, axis=0) + SMALLEST_DISTANCE
    weight = harmonic * size / noise
    total = max(np.sum(weight * harmonic * size), np.finfo(float).tiny)
    for course in (place, place**2 - np.mean(place**2)):
        slope = np.einsum("k,kch->ch", course, turned.imag) / (course @ course)
        turned = turned * np.exp(-1j * np.sum(weight * slope) / total * course[:, None, None] * harmonic)
    return np.concatenate([turned.real, turned.imag[:, :, 1:]], axis=2).reshape(len(shape), -1)


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
    significant = np.abs(slope) > error * -stdtrit(count - 2, 0.5 * SLOPE_FALSE_ALARM)
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
    usual = usual or (np.max if count < FEWEST_FOR_MEDIAN * reach else np.median)
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
