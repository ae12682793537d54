"""Waveforms of orbits: all channels over the period, by local regression of the motion that follows the points.

A closed point has neighbours in the section, and the motion of each until the next point is measured. A polynomial like
that of the return map, with the same neighbours, weights and correction for noise, is fitted to this motion at many
phases; its value at the closed point is the orbit's waveform from there to its next point. Those of inputs are linear,
with more neighbours.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from math import lcm
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from bayesperiodic import _checks
from bayesperiodic._io import Storable
from bayesperiodic._linalg import TINY
from bayesperiodic.orbits.coordinates import SHORT_RETURN, columns_of, integrand_of
from bayesperiodic.orbits.cycles import REFINING_DEGREE, WIDENED, ClosingFits, CycleFits, PairRuns, close, errors_by_run
from bayesperiodic.orbits.return_map import Regression, ReturnMap
from bayesperiodic.orbits.return_times import ReturnTimes
from bayesperiodic.orbits.section import CYCLE_SAMPLES, PoincareSection
from bayesperiodic.orbits.stretches import (
    FEWEST_INSTANTS,
    NOISE_SAMPLES,
    SMALLEST_WINDOW,
    WINDOW_INSTANTS,
    noise_variance,
    unbiased_windows,
    windowed,
)


class _Polynomials(NamedTuple):
    """Degree of polynomials, and what their bias is to the difference to wider neighbourhoods."""

    degree: int
    subtracted: float
    remaining: float


# Values a return whose windows do not overlap, so that the noise of their samples is independent.
INDEPENDENT = 16
# A fraction of the difference to wider neighbourhoods is subtracted, and the bias that remains is a fraction of it.
# The bias of cubic polynomials is proportional to the fourth power of the bandwidth; a third or fifth power leaves 0.21
# or 0.12 of the difference. Inputs depend little on the motion, and are taken as exact in fits: linear polynomials have
# less noise, and nothing is subtracted; their bias is proportional to the second power.
OF_OUTPUTS = _Polynomials(REFINING_DEGREE, 1.0 / (WIDENED ** (REFINING_DEGREE + 1) - 1.0), 0.2)
OF_INPUTS = _Polynomials(1, 0.0, 1.0 / (WIDENED**2 - 1.0))
# Probability that the squared differences of inputs of two neighbourhoods are larger by noise.
INPUTS_DIFFER = 1e-3
# Degree of polynomials of errors of the size of the bias, over a part of the period.
BIAS_DEGREE = 2
TURN = 2.0 * np.pi
# Fractional part of the golden ratio, which spreads instants evenly over the phases.
SPREADING = 0.6180339887


@dataclass(frozen=True)
class Waveform(Storable):
    """Waveform of an orbit over its period, with errors.

    Attributes
    ----------
    values : mapping of str to array (samples·period,)
        All channels of the section's recordings, inputs included, by name, from the section's phase on, the end
        excluded; angles are continuous.
    inputs : tuple of str
        The channels that are inputs.
    errors : array (errors, channels, samples·period)
        Errors that the channels and phases have in common, each one standard deviation, independent of each other: of
        the closed points, propagated by the slopes of the regression, and of the regression.
    bias : array (channels, parts)
        Root mean square of the bias that may remain after each point: a part is a forcing period, or a step of
        `find_orbits`.
    noise : array (channels, samples·period)
        Standard deviation of further errors, which are independent at 16 phases a forcing period.

    Notes
    -----
    The bias of outputs is estimated from the differences to wider and to narrower neighbourhoods, and subtracted. What
    remains may be any polynomial of degree two in each channel, after each point, of the size of `bias`, a fifth of the
    difference to wider neighbourhoods.

    Examples
    --------
    An orbit of the chaotic pendulum:

    >>> orbit = pendulum_orbits[0]
    >>> waveform = orbit.waveform
    >>> waveform.outputs, waveform.values["rate"].shape == (64 * orbit.period,)
    (('angle', 'rate'), True)
    """

    values: Mapping[str, np.ndarray]
    inputs: tuple[str, ...]
    errors: np.ndarray
    bias: np.ndarray
    noise: np.ndarray

    @property
    def outputs(self) -> tuple[str, ...]:
        """The channels that are outputs, without integrals of them."""
        return tuple(name for name in self.values if name not in self.inputs and not integrand_of(name))

    @property
    def sd(self) -> dict[str, np.ndarray]:
        """Standard error of each value, by channel, (samples·period,)."""
        total = np.sqrt(np.sum(self.common_errors**2, axis=0) + self.noise**2)
        return dict(zip(self.values, total, strict=True))

    @property
    def common_errors(self) -> np.ndarray:
        """The errors, and smooth ones of the size of the bias, (n, channels, samples·period)."""
        channels, parts = self.bias.shape
        count = self.noise.shape[1] // parts
        courses = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), BIAS_DEGREE).T
        courses /= np.sqrt(np.mean(courses**2, axis=1, keepdims=True) * len(courses))
        smooth = np.einsum("kt,cp,cd,pq->kcpdqt", courses, self.bias, np.eye(channels), np.eye(parts))
        return np.concatenate([self.errors, smooth.reshape(-1, channels, parts * count)])

    def covariance(self, channels: tuple[str, ...], every: int) -> np.ndarray:
        """Compute the covariance of some channels at every so many phases.

        Parameters
        ----------
        channels : tuple of str
        every : int
            Distance of the phases, in samples.

        Returns
        -------
        array (values, values)
            Phase by phase, and in the order of the channels within a phase.

        Raises
        ------
        ValueError
            For an unknown channel.
        """
        for name in channels:
            _checks.one_of("channels", name, self.values)
        columns = [list(self.values).index(name) for name in channels]
        errors = self.common_errors[:, columns, ::every]
        flat = errors.transpose(0, 2, 1).reshape(len(errors), -1)
        return flat.T @ flat + np.diag(self.noise[columns, ::every].T.ravel() ** 2)


def mean_of_repeats(waveform: Waveform, times: int, angles: Iterable[str]) -> Waveform:
    """Return the mean of the repeats of a waveform that repeats itself so many times."""
    values = {}
    for name, whole in waveform.values.items():
        repeats = whole.reshape(times, -1)
        turns = np.round((repeats[:, :1] - repeats[:1, :1]) / TURN) if name in angles else 0.0
        values[name] = np.mean(repeats - TURN * turns, axis=0)
    errors = waveform.errors.reshape(*waveform.errors.shape[:2], times, -1).mean(axis=2)
    noise = np.sqrt(np.mean(waveform.noise.reshape(len(waveform.noise), times, -1) ** 2, axis=1) / times)
    bias = waveform.bias.reshape(len(waveform.bias), times, -1).mean(axis=1)
    return Waveform(values, waveform.inputs, errors, bias, noise)


class Following:
    """The measured motion from each argument of a return map to its image."""

    def __init__(self, section: PoincareSection, maps: ReturnMap, size: np.ndarray):
        measured = section.measured
        assert measured is not None
        self._samples, instants, stretch = measured
        self._size, self.channels, self.inputs = size, section.channels, section.inputs
        first_input = len(self.channels) - len(self.inputs)
        self.outputs, self.driven = slice(0, first_input), slice(first_input, None)
        returns, step = np.divmod(maps.positions, maps.steps)
        self._length = (instants[returns + 1] - instants[returns]) / maps.steps
        self._start, self._stretch = instants[returns] + step * self._length, stretch[returns]
        # The returns of crossings differ.
        self._usual = 0.5 if section.crossed is None else SHORT_RETURN
        # Samples from a point to the next one; INDEPENDENT of a return are equally spaced.
        spaced = lcm(INDEPENDENT, maps.steps)
        self.count = spaced * -(-CYCLE_SAMPLES // spaced) // maps.steps
        self.angles = [
            (k, column)
            for k, (name, column) in enumerate(zip(section.coordinates, columns_of(section.coordinates), strict=True))
            if name in section.angles
        ]
        extents = np.ptp(self._samples.signals, axis=0)
        turning = [column for _, column in self.angles]
        extents[turning] = np.minimum(extents[turning], TURN)
        self.sizes = np.where(extents > 0.0, extents, 1.0)  # of the channels
        self._halves, self.variance = self._windows(maps.steps)
        self._phases = np.empty(0)  # at which the motion is in memory, for the arguments that are not NaN there
        self._motion = np.empty(0)

    def _windows(self, steps: int) -> tuple[list[int], np.ndarray]:
        """Return half the number of samples in each channel's window, and the variance of the values' noise.

        Windows are at most 1/INDEPENDENT of a return.
        """
        some = np.arange(0, self._start.size, -(-self._start.size // WINDOW_INSTANTS))
        at, stretch = self._start[some] + self._length[some] * (SPREADING * some % 1.0), self._stretch[some]
        longest = float(np.quantile(self._length, self._usual)) * steps / INDEPENDENT
        widest = max(SMALLEST_WINDOW, int(0.5 * self._samples.sampling_rate * longest))
        inner = self._samples.windows(at, stretch, max(widest, NOISE_SAMPLES // 2))[1]
        enough = np.count_nonzero(inner) >= FEWEST_INSTANTS
        if enough:
            at, stretch = at[inner], stretch[inner]
        variance = noise_variance(self._samples, at, stretch)
        halves = [SMALLEST_WINDOW] * variance.size
        if enough:
            halves = unbiased_windows(self._samples, at, stretch, widest, variance)
        return halves, variance * windowed(self._samples, at, stretch, halves)[1].mean(axis=0)

    def phases(self, times: ReturnTimes | None, order: np.ndarray) -> list[np.ndarray]:
        """Return the phases between each point of a cycle and the next one at which its waveform is sampled.

        They are equally spaced in time over the period, which starts at the first point of `order`.
        """
        if times is None:
            return [np.arange(self.count) / self.count for _ in order]
        lengths, samples = times.each[order], self.count * order.size
        ends = np.cumsum(lengths)
        at = ends[-1] * np.arange(samples) / samples
        owner, result = np.searchsorted(ends, at, side="right"), [np.empty(0)] * order.size
        for j, point in enumerate(order):
            result[point] = 1.0 + (at[owner == j] - ends[j]) / lengths[j]
        return result

    def signals(self, index: np.ndarray, near: np.ndarray, columns: slice, phases: np.ndarray) -> np.ndarray:
        """Return channels (n, phases, channels) after arguments (n,), whose angles are as in the points (n, d)."""
        values = self._after(index, phases)
        for k, column in self.angles:
            away = near[:, k] * self._size[k] - values[:, 0, column]
            values[:, :, column] += TURN * np.round(away / TURN)[:, None]
        return values[:, 1:, columns]

    def _after(self, index: np.ndarray, phases: np.ndarray) -> np.ndarray:
        """Return the channels (n, 1 + phases, channels) at and after arguments (n,).

        Neighbours are those of many fits, so the motion of all arguments at the last phases is kept.
        """
        every = np.append(0.0, phases)
        if not np.array_equal(phases, self._phases):
            self._phases = phases
            self._motion = np.full((self._start.size, every.size, len(self.channels)), np.nan)
        new = np.unique(index[np.isnan(self._motion[index, 0, 0])])
        if new.size:
            at = self._start[new, None] + self._length[new, None] * every
            values, _ = windowed(self._samples, at.ravel(), np.repeat(self._stretch[new], every.size), self._halves)
            self._motion[new] = values.reshape(new.size, every.size, -1)
        return self._motion[index]


def waveform_of(
    following: Following, maps: ReturnMap, fits: CycleFits, shift: int, times: ReturnTimes | None
) -> Waveform:
    """Return the waveform of a refined cycle from its point `shift` returns after the first one on.

    Samples are equally spaced in time, also where the `times` between the points differ.
    """
    count = len(fits.narrow.points)
    order = (np.arange(count) + maps.steps * shift) % count
    phases = following.phases(times, order)
    groups = [_group(following, maps, fits, phases, order, times, following.outputs, OF_OUTPUTS)]
    if following.inputs:
        of_inputs = _widest(following, maps, fits, phases)
        groups.append(_group(following, maps, of_inputs, phases, order, None, following.driven, OF_INPUTS))
    motion, bias, noise = (np.concatenate(some) for some in list(zip(*groups, strict=True))[:3])
    errors = np.zeros((sum(len(one.errors) for one in groups), *motion.shape))
    row = column = 0
    for one in groups:
        height, width = one.errors.shape[:2]
        errors[row : row + height, column : column + width] = one.errors
        row, column = row + height, column + width
    return Waveform(dict(zip(following.channels, motion, strict=True)), following.inputs, errors, bias, noise)


class _ChannelGroup(NamedTuple):
    """Waveforms of some channels."""

    motion: np.ndarray  # (channels, samples)
    bias: np.ndarray  # root mean square after each point, (channels, points)
    noise: np.ndarray  # (channels, samples)
    errors: np.ndarray  # in common, (n, channels, samples)


def _group(
    following: Following, maps: ReturnMap, fits: CycleFits, phases: list[np.ndarray], order: np.ndarray,
    times: ReturnTimes | None, columns: slice, how: _Polynomials,
) -> _ChannelGroup:  # fmt: skip
    every = _Regressions(following, maps, phases, columns, how).parts(fits)
    parts = [every[j] for j in order]
    motion = np.concatenate([part.values for part in parts])
    if columns == following.outputs:
        motion = _continuous(motion, following)
    errors, at = np.concatenate([part.errors for part in parts], axis=1), [phases[j] for j in order]
    if times is not None:
        errors += _moved(motion, times, order, at)
    directions = _directions(motion, [part.slopes for part in parts], at, crossed=times is not None)
    independent = INDEPENDENT * len(motion) * motion.shape[1] // (following.count * maps.steps)
    most = 2 * fits.narrow.points.size
    common, rest = _common(errors, directions, most, np.std(motion, axis=0), independent)
    gains = np.concatenate([np.tile(part.gain[:, None], len(part.values)) for part in parts], axis=1)
    noise = np.sqrt(np.maximum(rest[:, None], following.variance[columns, None] * gains))
    squares = np.concatenate([part.bias**2 for part in parts]).reshape(order.size, following.count, -1)
    return _ChannelGroup(motion.T, np.sqrt(squares.mean(axis=1)).T, noise, common)


def _widest(following: Following, maps: ReturnMap, fits: CycleFits, at: list[np.ndarray]) -> CycleFits:
    """Return the cycle with neighbourhoods for inputs.

    They are one step narrower than the widest whose inputs agree with those of all narrower ones: inputs depend little
    on the motion, so that more neighbours have less noise and no more bias.
    """
    regressions = _Regressions(following, maps, at, following.driven, OF_INPUTS)
    bandwidths, variance = fits.narrow.bandwidths.copy(), following.variance[following.driven]
    for j, places in enumerate(at):
        tried: list[tuple[np.ndarray, np.ndarray]] = []
        width, each = bandwidths[j], max(1, places.size * maps.steps // INDEPENDENT)
        while True:
            fit = regressions.fit(fits.narrow.points[j], j, width, influence=False)
            value, gain = fit.value[::each], np.sum(fit.weights**2, axis=0)
            limit = chdtri(value.size, INPUTS_DIFFER)
            if any(np.sum((value - v) ** 2 / np.maximum(variance * g, TINY)) > limit for v, g in tried):
                break
            tried.append((value, gain))
            # Those of a width of the size of the attractor are all.
            if fit.neighbours.size >= maps.count or width > 1.0:
                break
            width *= WIDENED
        bandwidths[j] *= WIDENED ** max(len(tried) - 2, 0)
    return CycleFits(fits.narrow._replace(bandwidths=bandwidths), fits.narrow._replace(bandwidths=WIDENED * bandwidths))


def _moved(motion: np.ndarray, times: ReturnTimes, order: np.ndarray, phases: list[np.ndarray]) -> np.ndarray:
    """Return the errors (runs, samples, channels) of a motion at equal parts of the period, due to those of times."""
    samples, errors = len(motion), times.errors[:, order]
    owner = np.repeat(np.arange(order.size), [part.size for part in phases])
    until = np.cumsum(errors, axis=1) - errors
    early = errors.sum(axis=1)[:, None] * (np.arange(samples) / samples)
    early -= until[:, owner] + np.concatenate(phases) * errors[:, owner]
    rates = np.gradient(motion, float(times.each.sum()) / samples, axis=0)
    return early[:, :, None] * rates


def _directions(motion: np.ndarray, slopes: list[np.ndarray], phases: list[np.ndarray], crossed: bool) -> np.ndarray:
    """Return what errors of points and, of crossings, of instants make of a motion, (n, samples, channels).

    After each point these are its slopes (d, samples, channels) by the coordinates, and the rates for errors of the
    instants at which it begins and ends.
    """
    result, start = [], 0
    rates = np.gradient(motion, axis=0)
    for by_point, at in zip(slopes, phases, strict=True):
        here = slice(start, start + at.size)
        every = [*by_point, *((rates[here], at[:, None] * rates[here]) if crossed else ())]
        for direction in every:
            result.append(np.zeros(motion.shape))
            result[-1][here] = direction
        start = here.stop
    return np.array(result)


class _MotionPart(NamedTuple):
    """Motion from a point of a cycle to the next one."""

    values: np.ndarray  # (samples, channels)
    slopes: np.ndarray  # by the coordinates of the point, (d, samples, channels)
    errors: np.ndarray  # of each run of neighbours, (runs, samples, channels)
    bias: np.ndarray  # modulus of what may remain, (samples, channels)
    gain: np.ndarray  # variance of the values for independent errors of unit variance, (channels,)


@dataclass(frozen=True)
class _Regressions:
    """Polynomials of the motion of some channels at phases after each point of a cycle."""

    following: Following
    maps: ReturnMap
    at: list[np.ndarray]
    columns: slice
    how: _Polynomials

    def parts(self, fits: CycleFits) -> list[_MotionPart]:
        """Return the motion from each point to the next one."""
        narrow, wide = (self.fits(cycle) for cycle in fits)
        runs = PairRuns.of(self.maps, *(cycle.fit for cycle in fits), *narrow, *wide)
        by_run, d = [errors_by_run(self.maps, cycle.fit, runs) for cycle in fits], fits.narrow.points.shape[1]
        differences, parts = self.differences(wide, narrow), []
        away = self.subtracted(fits, narrow, differences)
        for j, both in enumerate(zip(narrow, wide, strict=True)):
            errors = [
                np.tensordot(of_points[:, d * j : d * (j + 1)], fit.slopes, 1)
                + runs.sums(self.maps, fit.neighbours, fit.influence)
                for of_points, fit in zip(by_run, both, strict=True)
            ]
            weights = [runs.by_pair(self.maps, fit.neighbours, fit.weights) for fit in both]
            error = errors[0] + away * (errors[0] - errors[1])
            gain = np.sum((weights[0] + away * (weights[0] - weights[1])) ** 2, axis=0)
            value = both[0].value - away * differences[j]
            bias = self.how.remaining * np.abs(differences[j])
            parts.append(_MotionPart(value, both[0].slopes, error, bias, gain))
        return parts

    def fits(self, cycle: ClosingFits, *, influence: bool = True) -> list[Regression]:
        """Return the fits at the points of a cycle with its bandwidths."""
        return [self.fit(cycle.points[j], j, cycle.bandwidths[j], influence=influence) for j in range(len(self.at))]

    def fit(self, point: np.ndarray, j: int, bandwidth: float, *, influence: bool) -> Regression:
        """Return the fit at a point (d,), the one number j of its cycle."""
        signals = partial(self.following.signals, columns=self.columns, phases=self.at[j])
        phase, width = self.maps.phases(np.array([j])), np.array([bandwidth])
        sizes = self.following.sizes[self.columns]
        (fit,) = self.maps.regress(point[None], phase, width, self.how.degree, signals, sizes, influence=influence)
        return fit

    def differences(self, ones: list[Regression], others: list[Regression]) -> list[np.ndarray]:
        """Return the motion by some fits less that by others, (samples, channels) after each point."""
        result = [one.value - other.value for one, other in zip(ones, others, strict=True)]
        if self.columns != self.following.outputs:
            return result
        return [_without_turns(difference, self.following) for difference in result]

    def subtracted(self, fits: CycleFits, narrow: list[Regression], differences: list[np.ndarray]) -> float:
        """Return the fraction of the differences to wider neighbourhoods that is subtracted.

        Where the bias is proportional to a power of the bandwidth, the differences to wider and to narrower
        neighbourhoods have a ratio q, and the bias is 1/(q − 1) of the former. Noise makes the estimate of q larger.
        """
        most = self.how.subtracted
        narrower = close(self.maps, fits.narrow.points, fits.narrow.bandwidths / WIDENED) if most else None
        if narrower is None:
            return 0.0
        inner = self.differences(narrow, self.fits(narrower, influence=False))
        size = np.std(np.concatenate([fit.value for fit in narrow]), axis=0)
        one, other = (np.concatenate(some) / np.where(size > 0.0, size, 1.0) for some in (differences, inner))
        square, product = float(np.sum(one**2)), float(np.sum(one * other))
        if product <= 0.0:
            return 0.0
        return min(most, product / (square - product)) if product < square else most


def _without_turns(difference: np.ndarray, following: Following) -> np.ndarray:
    """Return the difference of two motions (samples, channels) without whole turns of angles."""
    result = np.array(difference)
    for _, column in following.angles:
        result[:, column] -= TURN * np.round(result[0, column] / TURN)
    return result


def _continuous(motion: np.ndarray, following: Following) -> np.ndarray:
    """Return a motion (samples, channels) with angles continuous from (−π, π] on."""
    for _, column in following.angles:
        motion[:, column] = np.unwrap(motion[:, column])
        motion[:, column] -= TURN * np.ceil((motion[0, column] - np.pi) / TURN)
    return motion


def _common(
    errors: np.ndarray, directions: np.ndarray, most: int, size: np.ndarray, independent: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of errors (runs, samples, channels) in common, and the variance of the rest.

    The former, (n, channels, samples), are those along the directions, and the largest principal components of what is
    left: the slopes differ among the neighbours. The latter, (channels,), is noise of single samples, of which so many
    are independent.
    """
    scale = np.where(size > 0.0, size, 1.0)
    axes = np.linalg.qr((directions / scale).reshape(len(directions), -1).T)[0].T
    flat = (errors / scale).reshape(len(errors), -1)
    left = flat - (flat @ axes.T) @ axes
    axes = np.concatenate([axes, np.linalg.svd(left, full_matrices=False)[2][:most]])
    along = flat @ axes.T
    rest = np.sum((flat - along @ axes) ** 2, axis=0).reshape(errors.shape[1:]).mean(axis=0) * scale**2
    rest *= independent / max(independent - len(axes), 1)
    common = (np.linalg.qr(along, mode="r") @ axes).reshape(-1, *errors.shape[1:]) * scale
    return common.transpose(0, 2, 1), rest
