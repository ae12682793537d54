"""Flat tops of a mean period beyond which a Fourier series of the other samples goes: saturated or limited."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic import _fourier

# Intervals of the cycle: so many for each sample of a cycle, at most so many, and samples in each of them.
INTERVALS_OF_SAMPLE, MOST_INTERVALS, SAMPLES_OF_INTERVAL = 4, 512, 4
# Harmonics of a series that saturates, and the largest condition number of its normal equations without the flat tops.
SERIES, LARGEST_SERIES_CONDITION = (1, 2, 3, 5, 8), 1e4
# Shares of the cycle at each end with which the search for flat tops begins, and its largest number of steps.
FIRST_SHARES, MOST_SEARCHES = (0.5, 0.35, 0.2, 0.1, 0.05), 30
# Error of the mean period relative to its standard deviation below which a series is exact.
EXACT_SERIES = 1e-3
# Rounding errors relative to the largest value.
ROUNDED_VALUES = 1e-9
# Difference of χ² by which the saturated series is better than any other one, and standard deviations of a χ² that
# a good model exceeds it by.
CLEARLY_SATURATED, GOODNESS = 25.0, 4.0
# Harmonics of the noise that is slower than a cycle's details.
SLOW_ORDERS = 8
# Range of the series relative to that of the values beyond which a force is more likely than a sensor.
LARGEST_OVERLOAD = 5.0
# Harmonics of a series that a sensor may limit, and the largest ratio of the slopes at both ends of its flat tops.
MOST_OF_SENSOR, LARGEST_SKEW = 5, 2.5
# Level of a force of one sign, relative to the range.
NEAR_ZERO = 0.01


@dataclass(frozen=True)
class PhaseBins:
    """Samples in intervals of the cycle, in even and in odd cycles."""

    place: np.ndarray  # interval of each sample, plus their number in odd cycles
    count: np.ndarray  # samples (2, intervals)
    centre: np.ndarray  # mean phase [cycles] (intervals,)


def phase_bins(phase: np.ndarray) -> PhaseBins:
    """Return the intervals of samples whose phase is given in cycles."""
    cycles = max(float(np.ptp(phase)), 1.0)
    number = int(
        min(
            INTERVALS_OF_SAMPLE * np.ceil(phase.size / cycles),
            MOST_INTERVALS,
            max(phase.size // SAMPLES_OF_INTERVAL, 1),
        )
    )
    place, total = np.empty(phase.size, dtype=np.int64), np.zeros(number)
    for first in range(0, phase.size, _fourier.CHUNK):
        part = slice(first, first + _fourier.CHUNK)
        shifted = phase[part] + 0.5 / number
        cycle = np.floor(shifted)
        rest = shifted - cycle
        place[part] = np.minimum((rest * number).astype(np.int64), number - 1)
        total += np.bincount(place[part], rest, number)
        place[part] += number * (cycle.astype(np.int64) & 1)
    count = np.bincount(place, minlength=2 * number).reshape(2, number)
    return PhaseBins(place, count, total / np.maximum(count.sum(axis=0), 1) - 0.5 / number)


@dataclass(frozen=True)
class Means:
    """Means of a channel in the intervals that have samples."""

    phase: np.ndarray  # [cycles]
    values: np.ndarray
    weights: np.ndarray  # inverse variances
    error: float  # standard deviation of their mean
    order: int  # harmonics of the mean period that are more than noise
    misfit: float  # χ² of these, with the parameters' penalty


def means_of(bins: PhaseBins, residuals: np.ndarray, amplitudes: np.ndarray, step: float) -> Means:
    """Return the means of a channel, by the residuals of its mean period with these amplitudes (harmonics + 1,)."""
    number = bins.centre.size
    sums = np.bincount(bins.place, residuals, 2 * number).reshape(2, number)
    count = bins.count.sum(axis=0)
    known = count > 0
    rest = sums.sum(axis=0)[known] / count[known]
    freedom = max(residuals.size - int(np.count_nonzero(known)), 1)
    variance = max(float(residuals @ residuals - count[known] @ rest**2), 0.0) / freedom
    phase = bins.centre[known]
    values = _fourier.at_times(amplitudes[None], phase)[0] + rest
    both = (bins.count > 0).all(axis=0)
    half = 0.5 * np.diff(sums[:, both] / bins.count[:, both], axis=0)[0]
    each = 0.25 * variance * np.sum(1.0 / bins.count[:, both])
    order = np.arange(1, SLOW_ORDERS + 1)
    slow = np.exp(-2j * np.pi * np.outer(order, bins.centre[both])) @ half
    slower = max(float(np.mean(np.abs(slow) ** 2)) / each, 1.0) if each > 0.0 else 1.0
    exact = (EXACT_SERIES * float(values.std())) ** 2 + step**2 / 12.0
    weights = 1.0 / (slower * variance / count[known] + exact)
    # A series of the first harmonics leaves the power of the others.
    power = 0.5 * np.abs(amplitudes[1:]) ** 2 * weights.sum()
    left = np.concatenate([np.cumsum(power[::-1] - 2.0)[::-1], [0.0]])
    score = left + 2.0 * np.arange(left.size) * np.log(weights.size)
    best = int(np.argmin(score))
    rest = values - _fourier.at_times(amplitudes[None, : best + 1], phase)[0]
    misfit = float(weights @ rest**2) + (2.0 * best + 1.0) * np.log(weights.size)
    error = float(np.sqrt(max(variance, (ROUNDED_VALUES * float(np.abs(values).max())) ** 2) / residuals.size))
    return Means(phase, values, weights, error, best, misfit)


@dataclass(frozen=True)
class Saturation:
    """A series of few harmonics between two levels, which is the mean period."""

    low: float  # levels, infinite without one
    high: float
    flat: np.ndarray  # (2, points), whether the series is below the one and above the other
    phase: np.ndarray  # of the points [cycles]
    beyond: np.ndarray  # of the series, at the points
    excess: np.ndarray  # of the series above the mean period, at the points
    misfit: float  # χ², with the parameters' penalty
    order: int  # harmonics of the series

    @property
    def overload(self) -> float:
        """Range of the series relative to that of the mean period."""
        return float(np.ptp(self.beyond)) / float(np.ptp(self.beyond - self.excess))

    @property
    def skew(self) -> float:
        """Ratio of the slopes at both ends of the widest flat top, at least 1.

        It is about 1 where a level cuts a smooth signal; a stick phase or a slider begins at rest.
        """
        worst = 1.0
        for end in self.flat:
            first = np.flatnonzero(end & ~np.roll(end, 1))
            last = np.flatnonzero(end & ~np.roll(end, -1))
            if not first.size:
                continue
            last = np.roll(last, -int(np.searchsorted(last, first[0])))
            k = int(np.argmax((last - first) % end.size))
            slopes = []
            for i, j in ((first[k] - 1, first[k]), (last[k], (last[k] + 1) % end.size)):
                slopes.append(abs((self.beyond[j] - self.beyond[i]) / ((self.phase[j] - self.phase[i]) % 1.0)))
            worst = max(worst, max(slopes) / max(min(slopes), 1e-3 * max(slopes), np.finfo(float).tiny))
        return float(worst)

    @property
    def like_a_sensor(self) -> bool:
        """Whether few harmonics at a level are more likely a sensor that saturates than a limited force."""
        span = float(np.ptp(self.beyond - self.excess))
        zero = any(np.isfinite(level) and abs(level) < NEAR_ZERO * span for level in (self.low, self.high))
        simple = self.order <= MOST_OF_SENSOR and self.overload < LARGEST_OVERLOAD
        return simple and not zero and self.skew < LARGEST_SKEW

    def bias(self, scatter: float) -> float:
        """Return the size of all amplitudes of the excess, relative to the standard deviation of one."""
        waves = np.exp(-2j * np.pi * np.outer(np.arange(self.order + 1), self.phase))
        sums = np.abs(waves @ self.excess) / self.phase.size
        return float(np.sqrt(np.r_[1.0, np.full(self.order, 2.0)] @ sums**2) / scatter)

    @property
    def share(self) -> float:
        """Share of the cycle at the levels."""
        return float(np.mean(self.flat.any(axis=0)))

    def holds(self, phase: np.ndarray) -> np.ndarray:
        """Return which samples, at phases in cycles, are at the levels."""
        order = np.argsort(self.phase)
        grid = self.phase[order]
        middle = 0.5 * (grid + np.append(grid[1:], grid[0] + 1.0))
        place = np.searchsorted(middle, (phase - middle[-1] + 1.0) % 1.0 + middle[-1] - 1.0) % grid.size
        return np.asarray(self.flat[:, order].any(axis=0))[place]


def saturation_of(means: Means) -> Saturation | None:
    """Return a saturated series if it is the mean period, up to noise, and one of more harmonics is not as simple."""
    if means.order <= 1:
        return None
    angle = 2.0 * np.pi * np.outer(means.phase, np.arange(1, max(SERIES) + 1))
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=2).reshape(means.phase.size, -1)
    basis = np.concatenate([np.ones((means.phase.size, 1)), waves], axis=1)
    rank = np.argsort(means.values)
    best = None
    for share in FIRST_SHARES:
        count = int(share * rank.size)
        ends = np.zeros((2, rank.size), dtype=bool)
        ends[0, rank[:count]] = ends[1, rank[rank.size - count :]] = True
        for end in ends:
            end &= _level(means, end)
        if not ends.any():
            continue
        for harmonics in SERIES:
            if harmonics < means.order:
                trial = _saturated(means, basis[:, : 2 * harmonics + 1], ends)
                if trial is not None and (best is None or trial.misfit < best.misfit):
                    best = trial
    return best if best is not None and best.misfit + CLEARLY_SATURATED < means.misfit else None


def _level(means: Means, inside: np.ndarray) -> bool:
    """Return whether the means of some intervals are equal up to noise, and a change about as large as ten of them."""
    count = np.count_nonzero(inside)
    if count < 2:
        return False
    values, weights = means.values[inside], means.weights[inside]
    return bool(weights @ (values - np.average(values, weights=weights)) ** 2 < 30.0 * count)


def _saturated(means: Means, basis: np.ndarray, ends: np.ndarray) -> Saturation | None:
    """Return the saturated series with the basis' harmonics by a search from first flat tops (2, points)."""
    values, weights = means.values, means.weights
    for _ in range(MOST_SEARCHES):
        free = ~ends.any(axis=0)
        if np.count_nonzero(free) < 2 * basis.shape[1]:
            return None
        part = basis[free] * weights[free, None]
        normal = part.T @ basis[free]
        size = np.linalg.eigvalsh(normal)
        if not size[0] * LARGEST_SERIES_CONDITION > size[-1]:
            return None
        series = basis @ np.linalg.solve(normal, part.T @ values[free])
        low, high = (
            np.average(values[end], weights=weights[end]) if end.any() else infinite
            for end, infinite in zip(ends, (-np.inf, np.inf), strict=True)
        )
        again = np.array([series < low, series > high])
        if np.array_equal(again, ends):
            break
        ends = again
    if not ends.any():
        return None
    model = np.clip(series, low, high)
    square = float(weights @ (values - model) ** 2)
    parameters = basis.shape[1] + 2 * int(np.isfinite(low)) + 2 * int(np.isfinite(high))
    freedom = values.size - parameters
    if freedom < 1 or square > freedom + GOODNESS * np.sqrt(2.0 * freedom):
        return None
    misfit = square + parameters * np.log(values.size)
    return Saturation(float(low), float(high), ends, means.phase, series, series - model, misfit, basis.shape[1] // 2)
