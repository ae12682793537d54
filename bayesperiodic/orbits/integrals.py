"""Integrals of channels, whose drift in each stretch is determined by the motion itself.

An integral over a stretch has an unknown constant, and an offset of the channel adds a line in time. The difference of
an integral and its mean over one forcing period about an instant has neither: it is a sum of samples with odd weights,
and a function of the state. With the other coordinates it determines the state, so that the whole integral is a
function of them too, the same one in all stretches. Constants and slopes are those for which local polynomials of that
function, each from neighbours in other stretches, agree best.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from bayesperiodic.data.faults import FAR, MEDIAN_TO_SD
from bayesperiodic.orbits.stretches import Stretches, noise_variance

# Half the window of the mean, and shortest and longest parts with a line each, in forcing periods. Parts of long
# recordings are longer, so that they are not many more than this number.
HALF_WINDOW, SHORTEST_PART, LONGEST_PART, MANY_PARTS = 0.5, 10, 30, 200
# A sample minus the value there of the polynomial through three on either side.
SPIKE_KERNEL = np.array([-1.0, 6.0, -15.0, 20.0, -15.0, 6.0, -1.0]) / 20.0
# Phases a period at which integrals are compared.
PHASES = 4
# Neighbours of a local polynomial as a multiple of its terms; smallest singular value and eigenvalue that count.
NEIGHBOURS_PER_TERM, SMALLEST_SINGULAR, SMALLEST_OF_LINES = 4, 1e-4, 1e-10
# Rounds of the robust regression, and residuals from which weights are smaller, in standard deviations.
ROBUST_ROUNDS, ROBUST_LIMIT = 8, 2.0
# Residuals count up to this many standard deviations in the covariance of successive ones.
LARGEST_RESIDUAL = 5.0
# Largest error of an integral, as a fraction of its standard deviation.
LARGEST_DRIFT = 0.1
# Variance of a random walk about its line, for one of unit variance at the end.
ABOUT_LINE = 1.0 / 15.0


class View(NamedTuple):
    """An integral and coordinates of the state at one phase of the forcing."""

    at: np.ndarray  # (n,)
    stretch: np.ndarray  # (n,)
    whole: np.ndarray  # (n,)
    known: np.ndarray  # (n, d)


class StretchLines(NamedTuple):
    """Lines of the integral of a channel, one a stretch, and the standard deviation of its error."""

    coefficients: np.ndarray  # (stretches, 2), of one and of the time from the middle of the stretch
    sd: float


def in_parts(samples: Stretches, period: float) -> Stretches:
    """Return the samples in parts that have a line each: long stretches divided equally, short ones left out.

    Raises a ValueError if all are short.
    """
    kept, starts, count, longest = [], [], 0, 0.0
    most = max(LONGEST_PART, samples.time.size / samples.sampling_rate / period / MANY_PARTS)
    for first, stop in zip(samples.starts, samples.stops, strict=True):
        time = samples.time[first:stop]
        lasting = float(time[-1] - time[0]) / period
        longest = max(longest, lasting)
        if lasting >= SHORTEST_PART:
            parts = int(np.ceil(lasting / most))
            ends = time[0] + (time[-1] - time[0]) * np.arange(parts) / parts
            starts.append(count + np.searchsorted(time, ends))
            kept.append(np.arange(first, stop))
            count += time.size
    if not kept:
        raise ValueError(
            f"recordings: must have {SHORTEST_PART} forcing periods or more without a break for the integral of a "
            f"channel, got {longest:.3g} at most. Record longer pieces, or use delayed coordinates."
        )
    index = np.concatenate(kept)
    return Stretches(samples.time[index], samples.signals[index], np.concatenate(starts))


def spikes_of(values: np.ndarray) -> np.ndarray:
    """Return which samples (bool) are far from the polynomial through three on either side, or beside one."""
    away = np.abs(np.convolve(values, SPIKE_KERNEL, mode="valid"))
    scale = MEDIAN_TO_SD * float(np.median(away)) if away.size else 0.0
    result = np.zeros(values.size, dtype=bool)
    if scale > 0.0:
        around = np.lib.stride_tricks.sliding_window_view(np.pad(away, 3), away.size)
        far = 3 + np.flatnonzero((away > FAR * scale) & (away >= around.max(axis=0)))
        result[np.add.outer(far, [-1, 0, 1])] = True
    return result


def splines(samples: Stretches, column: int) -> Iterator[tuple[int, slice, CubicSpline]]:
    """Yield each stretch and its channel, without spikes, as a function of the time from its middle."""
    for number, (first, stop) in enumerate(zip(samples.starts, samples.stops, strict=True)):
        span = slice(int(first), int(stop))
        kept = ~spikes_of(samples.signals[span, column])
        yield number, span, CubicSpline(_centred(samples.time[span])[kept], samples.signals[span, column][kept])


def high_passed(
    samples: Stretches, column: int, at: np.ndarray, stretch: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the integral (instants,) of a channel within each stretch, and that minus its mean over a period."""
    whole, local = np.zeros(at.size), np.zeros(at.size)
    half = HALF_WINDOW * period
    for number, span, spline in splines(samples, column):
        here = stretch == number
        times = at[here] - _middle(samples.time[span])
        once, twice = spline.antiderivative(1), spline.antiderivative(2)
        whole[here] = once(times)
        local[here] = whole[here] - (twice(times + half) - twice(times - half)) / period
    return whole, local


def lines_of(samples: Stretches, column: int, views: Sequence[View]) -> StretchLines:
    """Return the lines for which the integrals of each view are one function of its coordinates of the state.

    The error is that of least squares, or what the lines from every other view differ by, if that is larger. What
    remains of a drift is not a line: the residuals of successive points are then alike, and their covariance is added,
    or the variance of the integral of the channel's white noise, if that is larger.
    """
    at, stretch = (np.concatenate(every) for every in zip(*((one.at, one.stretch) for one in views), strict=True))
    middles = 0.5 * (samples.time[samples.starts] + samples.time[samples.stops - 1])
    scale = float(np.abs(at - middles[stretch]).max())
    bases = [_basis((one.at - middles[one.stretch]) / scale, one.stretch, middles.size) for one in views]
    rests = [_unpredicted(one) for one in views]
    designs = [(rest @ basis).toarray() for rest, basis in zip(rests, bases, strict=True)]
    targets = [-(rest @ one.whole) for rest, one in zip(rests, views, strict=True)]
    lines, covariance = _agreeing(designs, targets)
    one, other = (_agreeing(designs[k::2], targets[k::2])[0] for k in (0, 1))
    every = sparse.vstack(bases, format="csr").toarray()
    every -= every.mean(axis=0)  # The constant of all is not determined.
    variance = np.mean(np.sum((every @ covariance) * every, axis=1))
    variance = max(float(variance), float(np.var(every @ (one - other))) / 4.0)
    white = float(noise_variance(samples, at, stretch)[column]) / samples.sampling_rate
    walk = white * float(np.mean(samples.time[samples.stops - 1] - samples.time[samples.starts])) * ABOUT_LINE
    away = [target - design @ lines for target, design in zip(targets, designs, strict=True)]
    limit = LARGEST_RESIDUAL * MEDIAN_TO_SD * float(np.median(np.abs(np.concatenate(away))))
    products = np.concatenate(
        [
            (clipped[1:] * clipped[:-1])[np.diff(one.stretch) == 0]
            for one, clipped in zip(views, (np.clip(rest, -limit, limit) for rest in away), strict=True)
        ]
    )
    drift = max(walk, float(products.mean()))
    return StretchLines(lines.reshape(2, -1).T / [1.0, scale], float(np.sqrt(variance + drift)))


def _basis(time: np.ndarray, stretch: np.ndarray, count: int) -> sparse.csr_array:
    """Return a constant and a line in each of `count` stretches, at times (n,): (n, 2·count)."""
    rows = np.tile(np.arange(time.size), 2)
    return sparse.csr_array(
        (np.append(np.ones(time.size), time), (rows, np.append(stretch, count + stretch))), (time.size, 2 * count)
    )


def _agreeing(designs: Sequence[np.ndarray], targets: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return Huber's estimate of a linear regression, and its covariance."""
    design, target = np.concatenate(designs), np.concatenate(targets)
    trust = np.ones(target.size)
    for _ in range(ROBUST_ROUNDS):
        weighted = design.T * trust
        result = np.linalg.pinv(weighted @ design, rcond=SMALLEST_OF_LINES, hermitian=True) @ (weighted @ target)
        away = np.abs(target - design @ result)
        limit = ROBUST_LIMIT * MEDIAN_TO_SD * float(np.median(away))
        trust = np.minimum(1.0, limit / np.maximum(away, np.finfo(float).tiny))
    clipped, free = np.minimum(away, limit), max(target.size - result.size, 1)
    variance = float(np.sum(clipped**2)) / free / float(np.mean(away <= limit)) ** 2
    return result, variance * np.linalg.pinv(design.T @ design, rcond=SMALLEST_OF_LINES, hermitian=True)


def integrated(samples: Stretches, column: int, lines: StretchLines) -> Stretches:
    """Return samples with a channel replaced by its integral with the drift removed, of mean zero."""
    values = np.zeros(samples.time.size)
    for number, span, spline in splines(samples, column):
        time = _centred(samples.time[span])
        values[span] = spline.antiderivative(1)(time) + lines.coefficients[number] @ [np.ones(time.size), time]
    signals = samples.signals.copy()
    signals[:, column] = values - values.mean()
    return samples._replace(signals=signals)


def _unpredicted(view: View) -> sparse.csr_array:
    """Return the matrix (n, n) of values minus local quadratic polynomials of those in other stretches."""
    places, stretch = view.known / np.ptp(view.known, axis=0), view.stretch
    n, d = places.shape
    count = NEIGHBOURS_PER_TERM * (d + 1) * (d + 2) // 2
    distance, index = map(np.asarray, cKDTree(places).query(places, min(n, count + int(np.bincount(stretch).max()))))
    # Neighbours in other stretches, the nearest ones.
    order = np.argsort(np.where(stretch[index] == stretch[:, None], np.inf, distance), axis=1)[:, :count]
    every = np.arange(n)[:, None]
    index, distance = index[every, order], distance[every, order]
    away = (places[index] - places[:, None]) / distance[:, -1:, None]
    one, other = np.triu_indices(d)
    terms = np.concatenate([np.ones((*away.shape[:2], 1)), away, away[..., one] * away[..., other]], axis=2)
    bell = (1.0 - np.minimum(distance / distance[:, -1:], 1.0) ** 2)[..., None] + 1e-3
    weights = np.linalg.pinv(terms * bell, rcond=SMALLEST_SINGULAR)[:, 0] * bell[..., 0]
    rows = np.repeat(np.arange(n), index.shape[1])
    return sparse.csr_array(sparse.eye_array(n) - sparse.csr_array((weights.ravel(), (rows, index.ravel())), (n, n)))


def _middle(time: np.ndarray) -> float:
    return 0.5 * float(time[0] + time[-1])


def _centred(time: np.ndarray) -> np.ndarray:
    return time - _middle(time)
