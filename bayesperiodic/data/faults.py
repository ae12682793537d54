"""Faults of single sensors, by their samples alone: wraps, stuck and clipped stretches, outliers, the resolution."""

from dataclasses import dataclass, field

import numpy as np

from bayesperiodic.data.quantisation import step_of

# Ranges at which sensors wrap: radians, degrees, turns; and powers of two of a quantised sensor's steps.
SENSOR_TURNS = (2.0 * np.pi, 360.0, 1.0)
FEWEST_BITS, MOST_BITS = 6, 32
# Steps relative to the range that are rounding errors of exact values.
ROUNDING = 1e-12
# A jump wraps if it is a whole range to this share of it; what is left must be smooth, and small beside the jumps.
WRAP_TOLERANCE, LARGEST_UNWRAPPED_STEP, SMOOTH_UNWRAPPED = 0.35, 0.5, 0.5
# Samples of one value in a row that may be a stuck sensor, and how many times longer than usual ones they are.
FEWEST_STUCK, LONG_RUN = 10, 10.0
# Clipped samples: fewest, fewest in a row, and how many times more than at the next level.
FEWEST_CLIPPED, CLIPPED_RUN, PILED_UP = 6, 3, 6.0
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


@dataclass
class ChannelFaults:
    """Faulty samples of one channel."""

    step: float = 0.0  # of quantised values, 0 if they are not
    wrap: float = 0.0  # range at which the values wrap, 0 if they do not
    wraps: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))  # first samples after jumps
    stuck: list[slice] = field(default_factory=list)
    low: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))  # clipped samples
    high: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    outliers: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    held: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))  # that repeat the one before
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
    return 0.0, np.zeros(0, dtype=int)


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
    return [slice(int(first[i]), int(first[i] + length[i])) for i in long]


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
        ends.append(top if _piles_up(sign * values, top, place) else np.zeros(0, dtype=int))
    return ends[0], ends[1]


def _piles_up(values: np.ndarray, top: np.ndarray, place: np.ndarray) -> bool:
    """Return whether the samples at the highest value are more than a smooth signal has there."""
    if top.size < FEWEST_CLIPPED:
        return False
    _, length = runs(np.diff(top) == 1)
    together = np.flatnonzero(np.diff(top) == 1)
    if together.size < 0.5 * top.size or length.max(initial=0) < CLIPPED_RUN - 1:
        return False
    levels, counts = np.unique(values[place], return_counts=True)
    # A relay has few values; a quantised one has neighbouring levels with which the highest is compared.
    if levels.size < FEWEST_VALUES or top.size > MOST_DROPPED * place.size:
        return False
    below = counts[-6:-1]
    return bool(top.size > PILED_UP * max(float(below.max()), 1.0))


def held_of(values: np.ndarray) -> tuple[int, np.ndarray]:
    """Return how often a slower logger repeats each value, 1 if it does not, and the repeated samples."""
    first, length = runs(values)
    usual = int(np.median(length))
    inner = length[1:-1]
    if usual < 2 or inner.size < FEWEST_VALUES or np.unique(values[first]).size < FEWEST_VALUES:
        return 1, np.zeros(0, dtype=int)
    # Two equal values in a row are a run of twice the length.
    if np.mean(inner % usual == 0) < HELD:
        return 1, np.zeros(0, dtype=int)
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
    steps = np.abs(np.diff(values, axis=1))
    usual = np.quantile(steps[:, :: 1 + steps.shape[1] // SCREENED], USUAL, axis=1)
    return bool((steps.max(axis=1) > JUMP * usual).any())


def outliers_of(residuals: np.ndarray, phase: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    """Return the samples far from the mean period, or of the value of dropouts, with jumps before and after them.

    `phase` is in cycles. What is far at the same phase of many cycles is part of the signal.
    """
    middle = np.median(residuals)
    distance = np.abs(residuals - middle)
    scale = MEDIAN_TO_SD * float(np.median(distance))
    if not scale > 0.0:
        scale = float(np.quantile(distance, 0.9))
    least = max(FAR * scale, 2.0 * step, 1e-9 * np.abs(values).max())
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
        return np.zeros(0, dtype=int)
    first, length = runs(far)
    flagged = far[first]
    first, length = first[flagged], length[flagged]
    # A jump into the run and out of it, larger than between the other samples.
    change, inside = np.abs(np.diff(values)), ~(far[1:] | far[:-1])
    usual = float(np.quantile(change[inside], 0.99)) if inside.any() else 0.0
    before = np.where(first > 0, change[np.maximum(first - 1, 0)], np.inf)
    last = first + length - 1
    after = np.where(last < values.size - 1, change[np.minimum(last, change.size - 1)], np.inf)
    lone = np.minimum(before, after) > 2.0 * usual + step
    cycles = max(float(np.ptp(phase)), 1.0)
    bins = np.minimum((phase[first] % 1.0 * 64).astype(int), 63)
    cycle = np.floor(phase[first] - phase[0]).astype(int)
    often = np.zeros(64)
    for k in range(64):
        often[k] = np.unique(cycle[bins == k]).size / cycles
    every = often + np.roll(often, 1) + np.roll(often, -1)
    if far.mean() < 0.2:
        lone &= every[bins] < RETURNING * np.maximum(1.0, 3.0 * _expected(first.size, cycles))
    result = np.zeros(values.size, dtype=bool)
    for a, n in zip(first[lone], length[lone], strict=True):
        result[a : a + n] = True
    if value is not None and result[values == value].mean() > ALL_DROPPED:
        result |= values == value
    return np.flatnonzero(result)


def _expected(runs: int, cycles: float) -> float:
    """Return the expected share of cycles with a run of outliers in three of 64 bins if they are anywhere."""
    return runs / cycles * 3.0 / 64.0


def resolution(values: np.ndarray) -> float:
    """Return the step of quantised values; 0 if they are not quantised, or by rounding errors alone."""
    step = step_of(values)
    return step if step > ROUNDING * float(np.ptp(values)) else 0.0
