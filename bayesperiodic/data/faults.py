"""Faults of single sensors, by their samples alone: wraps, stuck and clipped stretches, outliers, the resolution."""

from dataclasses import dataclass, field

import numpy as np
from scipy.special import bdtr, bdtrc, erf, erfc, pdtrc

from bayesperiodic.data.quantisation import step_of
from bayesperiodic.data.saturation import Saturation

# Ranges at which sensors wrap: radians, degrees, turns; and powers of two of a quantised sensor's steps.
SENSOR_TURNS = (2.0 * np.pi, 360.0, 1.0)
FEWEST_BITS, MOST_BITS = 6, 32
# Steps relative to the range that are rounding errors of exact values.
ROUNDING = 1e-12
# A jump wraps if it is a whole range to this share of it; what is left must be smooth, and small beside the jumps.
WRAP_TOLERANCE, LARGEST_UNWRAPPED_STEP, SMOOTH_UNWRAPPED = 0.35, 0.5, 0.5
# Samples of one value in a row that may be a stuck sensor, how many times longer than usual ones they are, and so many
# runs at an end of the range that they are clipped.
FEWEST_STUCK, LONG_RUN, RUNS_AT_END = 10, 10.0, 3
# Clipped samples: fewest, fewest in a row, and how many times more than at the next level. Without such a row: fewest,
# and the largest gap below them relative to that between the next values, which noise fills.
FEWEST_CLIPPED, CLIPPED_RUN, PILED_UP, FEWEST_SCATTERED, LARGEST_GAP = 6, 3, 6.0, 10, 20.0
# Distance of outliers from the mean period in standard deviations of the others, and how often they may return.
FAR, RETURNING = 8.0, 0.5
# Distance of large outliers relative to the largest one.
LARGE = 0.2
MEDIAN_TO_SD = 1.4826
# Largest step between samples relative to 80 % of them, of so many, without outliers.
JUMP, USUAL, SCREENED = 5.0, 0.8, 100_000
# Share of the most frequent value of dropouts, and different values of a channel that has such a value.
MOST_DROPPED, FEWEST_VALUES = 0.45, 18
# Share of the samples of that value with jumps before and after, from which all are dropouts.
ALL_DROPPED = 0.4
# Repeated values of a slower logger: share of the runs that have the usual length.
HELD = 0.9
# Short runs of one value: fewest samples, p-value of as many by noise, and largest share of these; size of the noise
# relative to the range below which there is none, and samples from which that is taken.
FEWEST_HELD, CHANCE_RUNS, CHANCE_SHARE, NO_NOISE, DIFFERENCED = 3, 1e-3, 0.05, 1e-9, 20_000
# Largest share of different values among those of a quantised sensor.
MOST_DIFFERENT = 0.98
# Heavy tails: distance from which residuals belong to them [standard deviations of the others], expected number of
# larger ones beyond which one is an outlier, and fewest samples between the two distances.
TAIL, RARE_IN_TAIL, FEWEST_IN_TAIL = 4.0, 1e-3, 3
# Impulses of random size and sign: fewest, ratio of large sizes to small ones, the p-value from which they are not
# one-sided, and standard errors of their correlation with the signal from which they replace it.
FEWEST_IMPULSES, SPREAD_SIZES, BOTH_SIDES, REPLACED = 10, 2.5, 0.01, 3.0
NO_SAMPLES = np.zeros(0, dtype=int)


@dataclass
class ChannelFaults:
    """Faulty samples of one channel."""

    step: float = 0.0  # of quantised values, 0 if they are not
    wrap: float = 0.0  # range at which the values wrap, 0 if they do not
    wraps: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # first samples after jumps
    stuck: list[slice] = field(default_factory=list)
    low: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # clipped samples
    high: np.ndarray = field(default_factory=NO_SAMPLES.copy)
    beside: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # at the same phases as clipped ones
    outliers: np.ndarray = field(default_factory=NO_SAMPLES.copy)
    tails: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # as large as outliers, but noise
    brief: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # of short runs of one value
    saturation: Saturation | None = None  # flat tops of the mean period
    saturated: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # samples of the flat tops
    saturation_bias: float = 0.0  # if these are wrong [standard errors of all amplitudes]
    noisy: bool = True  # beside the clipped samples, so that no signal without noise rests there
    held: np.ndarray = field(default_factory=NO_SAMPLES.copy)  # that repeat the one before
    repeats: int = 1  # samples of each value, of a slower logger


def wrap_of(values: np.ndarray, step: float) -> tuple[float, np.ndarray]:
    """Return the range at which the values of a sensor wrap, 0 if they do not, and the samples after its jumps."""
    span, change = float(np.ptp(values)), np.diff(values)
    turns = [*SENSOR_TURNS, *(step * 2.0**bits for bits in range(FEWEST_BITS, MOST_BITS) if step > 0.0)]
    for turn in turns:
        if not 0.9 * turn < span < 1.001 * turn + step:
            continue
        jumps = np.flatnonzero(np.abs(change) > (1.0 - WRAP_TOLERANCE) * turn)
        if not jumps.size or jumps.size == change.size:
            continue
        whole = np.unwrap(values, period=turn)
        steps = np.diff(whole)
        smooth = (
            np.mean(steps**2) < SMOOTH_UNWRAPPED * np.var(whole) and np.abs(steps).max() < LARGEST_UNWRAPPED_STEP * turn
        )
        # The steps over the jumps are like those of the samples beside them.
        usual = np.quantile(np.abs(np.delete(steps, jumps)), 0.99)
        if smooth and np.median(np.abs(steps[jumps])) <= 3.0 * usual + step:
            return turn, jumps + 1
    return 0.0, NO_SAMPLES


def runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first samples and the lengths of runs of one value."""
    first = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1])
    return first, np.diff(np.concatenate([first, [values.size]]))


def stuck_of(values: np.ndarray) -> list[slice]:
    """Return runs of one value that are much longer than usual ones."""
    first, length = runs(values)
    if length.size < 2 or length.max() < FEWEST_STUCK:
        return []
    # The usual length is that in which most samples are, without the longest runs.
    order = np.sort(length)
    usual = float(order[np.searchsorted(np.cumsum(order), 0.5 * order.sum())]) if order[-1] < 0.5 * values.size else 1.0
    usual = max(usual, float(np.quantile(length, 0.99)) if length.size > 100 else 1.0)
    long = np.flatnonzero(length >= max(FEWEST_STUCK, LONG_RUN * usual))
    # Several runs at the largest or the smallest value are clipped.
    level = values[first[long]]
    for end in (values.max(), values.min()):
        if np.count_nonzero(level == end) >= RUNS_AT_END:
            long, level = long[level != end], level[level != end]
    return [slice(int(first[i]), int(first[i] + length[i])) for i in long]


def brief_of(values: np.ndarray, step: float) -> np.ndarray:
    """Return the samples of runs of one value that are too long for noise of the size that the values have.

    The next value of normal noise is the same one with a probability of erf(step/√8σ) at most, and with that of chance
    pairs. Runs at the largest and smallest value are clipped, if anything. Signals without noise have none.
    """
    first, length = runs(values)
    if length.max() < FEWEST_HELD:
        return NO_SAMPLES
    noise, step = fast_noise(values), step or _spacing(values[first])
    if not noise > max(NO_NOISE * float(np.ptp(values)), 0.5 * step):
        return NO_SAMPLES
    # Runs of two count as chance: a hold of two samples is not told from it.
    pairs = (np.count_nonzero(length == 2) + 1.0) / values.size
    same = min(max(float(erf(step / (np.sqrt(8.0) * noise))), pairs), 1.0 - 1e-12)
    size = np.arange(FEWEST_HELD, length.max() + 1)
    count = np.cumsum(np.bincount(length)[::-1])[::-1][size]  # runs of that size or longer
    chance = values.size * same ** (size - 1.0)
    held = (chance < CHANCE_SHARE * count) & (pdtrc(count - 1, chance) < CHANCE_RUNS)
    if not held.any():
        return NO_SAMPLES
    level = values[first]
    long = (length >= size[np.argmax(held)]) & (level != values.max()) & (level != values.min())
    return np.flatnonzero(np.repeat(long, length))


def _spacing(values: np.ndarray) -> float:
    """Return the usual distance of values if many of them return, as those of a quantised sensor do; else 0."""
    some = values[:DIFFERENCED]
    levels = np.unique(some)
    return float(np.median(np.diff(levels))) if levels.size < MOST_DIFFERENT * some.size else 0.0


def fast_noise(values: np.ndarray) -> float:
    """Return the standard deviation of white noise, by fourth differences, to which smooth signals add little."""
    start = (values.size - min(values.size, DIFFERENCED)) // 2
    change = np.abs(np.diff(values[start : start + DIFFERENCED], 4))
    # Differences over repeated values are none of noise.
    change = change[change > 0.0]
    return MEDIAN_TO_SD * float(np.median(change)) / np.sqrt(70.0) if change.size else 0.0


def single(samples: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return samples of runs that are not at the same phases [cycles] of most cycles, as those of a rest are."""
    if not samples.size:
        return samples
    first = np.flatnonzero(np.diff(samples, prepend=-2) > 1)
    often = _often(phase, samples[first])
    keep = often < RETURNING * np.maximum(1.0, 3.0 * _expected(first.size, max(float(np.ptp(phase)), 1.0)))
    return samples[np.repeat(keep, np.diff(np.append(first, samples.size)))]


def repeat_noise(phase: np.ndarray, values: np.ndarray, left_out: np.ndarray) -> float:
    """Return the standard deviation of values at the same phase of several cycles, without some of them.

    It is that of values from the line between their neighbours in phase.
    """
    some = np.setdiff1d(np.arange(min(values.size, SCREENED)), left_out)
    if some.size < FEWEST_CLIPPED:
        return 0.0
    place = phase[some] % 1.0
    order = np.argsort(place)
    place, signal = place[order], values[some][order]
    width = np.maximum(place[2:] - place[:-2], np.finfo(float).tiny)
    weight = np.clip((place[1:-1] - place[:-2]) / width, 0.0, 1.0)
    rest = signal[1:-1] - (1.0 - weight) * signal[:-2] - weight * signal[2:]
    return MEDIAN_TO_SD * float(np.median(np.abs(rest) / np.sqrt(1.0 + weight**2 + (1.0 - weight) ** 2)))


def heavy_tails(residuals: np.ndarray, outliers: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return which of the outliers are noise: of heavy tails, or impulses of random size and sign.

    The tails between four and eight standard deviations of the others are continued by a power law (median of the
    logarithms of sizes; B. M. Hill, Ann. Stat. 3 (1975) 1163-1174). Faults have one size or sign, or replace the signal
    by a value, and leave a gap in the sizes.
    """
    middle = float(np.median(residuals))
    distance = np.abs(residuals - middle)
    scale = MEDIAN_TO_SD * float(np.median(distance))
    result = np.zeros(outliers.size, dtype=bool)
    if not outliers.size or not scale > 0.0:
        return result
    sizes = distance[distance > TAIL * scale] / (TAIL * scale)
    # Samples next to each other, as at the end of a part that ramps, are one.
    place = np.flatnonzero((distance > TAIL * scale) & (distance < FAR * scale))
    between = np.count_nonzero(np.diff(place, prepend=-residuals.size) > residuals.size // 200)
    chance = float(erfc(TAIL / np.sqrt(2.0))) * residuals.size
    relative = distance[outliers] / (TAIL * scale)
    far = np.flatnonzero(distance > FAR * scale)
    if between >= 2.0 * chance + FEWEST_IN_TAIL and between - chance >= far.size:
        index = np.log(2.0) / float(np.median(np.log(sizes)))
        result = sizes.size * np.maximum(relative, 1.0) ** -index > RARE_IN_TAIL
    elif far.size >= FEWEST_IMPULSES:
        above = int(np.count_nonzero(residuals[far] > middle))
        p_value = 2.0 * min(bdtr(above, far.size, 0.5), bdtrc(above - 1, far.size, 0.5))
        spread = np.quantile(distance[far], 0.9) > SPREAD_SIZES * np.quantile(distance[far], 0.1)
        replaced = abs(np.corrcoef(residuals[far], predicted[far])[0, 1]) > REPLACED / np.sqrt(far.size)
        result[:] = spread and p_value > BOTH_SIDES and not replaced
    return result


def clipped_of(values: np.ndarray, stuck: list[slice]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples at the lowest and at the highest value, where so many are there that they are clipped."""
    free = np.ones(values.size, dtype=bool)
    for part in stuck:
        free[part] = False
    place = np.flatnonzero(free)
    inside = values[place]
    ends = []
    for sign in (-1.0, 1.0):
        signed = sign * inside
        top = place[signed == signed.max()] if signed.size else place
        ends.append(top if _piles_up(sign * values, top, place) else NO_SAMPLES)
    return ends[0], ends[1]


def _piles_up(values: np.ndarray, top: np.ndarray, place: np.ndarray) -> bool:
    """Return whether the samples at the highest value are more than a smooth signal has there."""
    if top.size < FEWEST_CLIPPED:
        return False
    scattered = not in_rows(top)
    if scattered and top.size < FEWEST_SCATTERED:
        return False
    levels, counts = np.unique(values[place], return_counts=True)
    # A relay has few values; a quantised one has neighbouring levels with which the highest is compared.
    if levels.size < FEWEST_VALUES or top.size > MOST_DROPPED * place.size:
        return False
    gaps = np.diff(levels[-top.size - 1 :])
    if scattered and gaps[-1] > LARGEST_GAP * np.median(gaps[:-1]):  # an exact maximum of a signal without noise
        return False
    below = counts[-6:-1]
    return bool(top.size > PILED_UP * max(float(below.max()), 1.0))


def in_rows(samples: np.ndarray) -> bool:
    """Return whether clipped samples follow each other, as where a signal exceeds the limit by more than its noise."""
    next_to = np.diff(samples) == 1
    _, length = runs(next_to)
    return bool(np.count_nonzero(next_to) >= 0.5 * samples.size and length.max(initial=0) >= CLIPPED_RUN - 1)


def held_of(values: np.ndarray) -> tuple[int, np.ndarray]:
    """Return how often a slower logger repeats each value, 1 if it does not, and the repeated samples."""
    first, length = runs(values)
    usual = int(np.median(length))
    inner = length[1:-1]
    if usual < 2 or inner.size < FEWEST_VALUES or np.unique(values[first]).size < FEWEST_VALUES:
        return 1, NO_SAMPLES
    # Two equal values in a row are a run of twice the length.
    if np.mean(inner % usual == 0) < HELD:
        return 1, NO_SAMPLES
    return usual, np.flatnonzero((np.arange(values.size) - first[1]) % usual)


def dropped_value(values: np.ndarray) -> float | None:
    """Return a value that is much more frequent than any other one, as that of dropouts; None without one."""
    levels, counts = np.unique(values[:: 1 + values.size // SCREENED], return_counts=True)
    if levels.size < FEWEST_VALUES:
        return None
    order = np.argsort(counts)
    most, others = int(counts[order[-1]]), max(int(counts[order[-2]]), 1)
    if most < FEWEST_CLIPPED or most < PILED_UP * others or most > MOST_DROPPED * counts.sum():
        return None
    return float(levels[order[-1]])


def jumps(values: np.ndarray) -> bool:
    """Return whether some steps between samples (channels, samples) are larger than smooth signals with noise have."""
    for row in values:
        steps = np.diff(row)
        np.abs(steps, out=steps)
        if steps.max() > JUMP * np.quantile(steps[:: 1 + steps.size // SCREENED], USUAL):
            return True
    return False


def outliers_of(residuals: np.ndarray, phase: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    """Return the samples far from the mean period, or of the value of dropouts, with jumps before and after them.

    `phase` is in cycles. What is far at the same phase of many cycles is part of the signal.
    """
    distance = residuals - np.median(residuals)
    np.abs(distance, out=distance)
    scale = MEDIAN_TO_SD * float(np.median(distance))
    if not scale > 0.0:
        scale = float(np.quantile(distance, 0.9))
    least = max(FAR * scale, 2.0 * step, 1e-9 * max(values.max(), -values.min()))
    # Large outliers are in the mean period too, so that their neighbours are far from it as well.
    levels = {least, max(least, LARGE * float(distance.max()))}
    each = [_lone(distance > level, phase, values, step) for level in levels]
    return np.unique(np.concatenate(each))


def _lone(far: np.ndarray, phase: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    """Return the samples of runs that are far, or have the value of dropouts, with jumps before and after them."""
    value = dropped_value(values)
    if value is not None:
        far = far | (values == value)
    if not far.any() or far.all() or np.ptp(values[~far]) == 0.0:
        return NO_SAMPLES
    first, length = runs(far)
    flagged = far[first]
    first, length = first[flagged], length[flagged]
    # A jump into the run and out of it, larger than between the other samples.
    change, inside = np.diff(values), ~(far[1:] | far[:-1])
    np.abs(change, out=change)
    usual = float(np.quantile(change[inside], 0.99, overwrite_input=True)) if inside.any() else 0.0
    before = np.where(first > 0, change[np.maximum(first - 1, 0)], np.inf)
    last = first + length - 1
    after = np.where(last < values.size - 1, change[np.minimum(last, change.size - 1)], np.inf)
    lone = np.minimum(before, after) > 2.0 * usual + step
    cycles = max(float(np.ptp(phase)), 1.0)
    if far.mean() < 0.2:
        lone &= _often(phase, first) < RETURNING * np.maximum(1.0, 3.0 * _expected(first.size, cycles))
    result = np.zeros(values.size, dtype=bool)
    for a, n in zip(first[lone], length[lone], strict=True):
        result[a : a + n] = True
    if value is not None and result[values == value].mean() > ALL_DROPPED:
        result |= values == value
    return np.flatnonzero(result)


def _often(phase: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the share of the cycles with a run at about the phase of each run, by their first samples."""
    bins = np.minimum((phase[first] % 1.0 * 64).astype(int), 63)
    cycle = np.floor(phase[first] - phase[0]).astype(int)
    often = np.zeros(64)
    for k in range(64):
        often[k] = np.unique(cycle[bins == k]).size / max(float(np.ptp(phase)), 1.0)
    every = often + np.roll(often, 1) + np.roll(often, -1)
    return np.asarray(every[bins])


def _expected(runs: int, cycles: float) -> float:
    """Return the expected share of cycles with a run of outliers in three of 64 bins if they are anywhere."""
    return runs / cycles * 3.0 / 64.0


def resolution(values: np.ndarray) -> float:
    """Return the step of quantised values; 0 if they are not quantised, or by rounding errors alone."""
    step = step_of(values)
    return step if step > ROUNDING * float(np.ptp(values)) else 0.0
