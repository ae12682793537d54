"""Waveforms of orbits: all channels over the period, by local regression of the motion that follows the points.

A closed point has neighbours in the section, and the motion of each until the next point is measured. A polynomial like
that of the return map, with the same neighbours, weights and correction for noise, is fitted to this motion at many
phases, a linear one for inputs; its value at the closed point is the orbit's waveform from there to its next point.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from math import lcm
from typing import NamedTuple

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Storable
from bayesperiodic.orbits.coordinates import SHORT_RETURN, columns_of, integrand_of
from bayesperiodic.orbits.cycles import REFINING_DEGREE, VALUE_GROWTH, WIDENED, Estimate, errors_by_run
from bayesperiodic.orbits.return_map import ReturnMap
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

# Values a return whose windows do not overlap, so that the noise of their samples is independent.
INDEPENDENT = 16
# Inputs depend little on the motion, and are taken as exact in fits: linear polynomials have less noise. The bias of
# their values is proportional to the second power of the bandwidth.
INPUT_DEGREE, INPUT_GROWTH = 1, WIDENED**2 - 1.0
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
        Root mean square of the estimated bias after each point: a part is a forcing period, or a step of `find_orbits`.
    noise : array (channels, samples·period)
        Standard deviation of further errors, which are independent at 16 phases a forcing period.

    Notes
    -----
    The bias is estimated from the difference to wider neighbourhoods. It is not subtracted, and its course over the
    phases is not used: errors of its size in each channel, after each point, may be any polynomial of degree two.

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


class _MotionPart(NamedTuple):
    """Motion from a point of a cycle to the next one."""

    values: np.ndarray  # (samples, channels)
    errors: np.ndarray  # of each run of neighbours, (runs, samples, channels)
    bias: np.ndarray  # modulus, (samples, channels)
    gain: np.ndarray  # variance of the values for independent errors of unit variance, (channels,)


def waveform_of(
    following: Following, maps: ReturnMap, estimate: Estimate, shift: int, times: ReturnTimes | None
) -> Waveform:
    """Return the waveform of a refined cycle from its point `shift` returns after the first one on.

    Samples are equally spaced in time, also where the `times` between the points differ.
    """
    order = (np.arange(len(estimate.points)) + maps.steps * shift) % len(estimate.points)
    phases = following.phases(times, order)
    parts = _parts(following, maps, estimate, phases, following.outputs, REFINING_DEGREE, VALUE_GROWTH)
    if following.inputs:
        inputs = _parts(following, maps, estimate, phases, following.driven, INPUT_DEGREE, INPUT_GROWTH)
        parts = [
            _MotionPart(*(np.concatenate(two, axis=-1) for two in zip(*both, strict=True)))
            for both in zip(parts, inputs, strict=True)
        ]
    parts = [parts[j] for j in order]
    motion = _continuous([part.values for part in parts], following)
    errors = np.concatenate([part.errors for part in parts], axis=1)
    if times is not None:
        errors += _moved(motion, times, order, [phases[j] for j in order])
    common, rest = _common(errors.transpose(0, 2, 1), np.std(motion, axis=0), 2 * estimate.points.size)
    gains = np.concatenate([np.tile(part.gain[:, None], len(part.values)) for part in parts], axis=1)
    noise = np.sqrt(np.maximum(rest[:, None], following.variance[:, None] * gains))
    squares = np.concatenate([part.bias**2 for part in parts]).reshape(order.size, following.count, -1)
    bias = np.sqrt(squares.mean(axis=1)).T
    return Waveform(dict(zip(following.channels, motion.T, strict=True)), following.inputs, common, bias, noise)


def _moved(motion: np.ndarray, times: ReturnTimes, order: np.ndarray, phases: list[np.ndarray]) -> np.ndarray:
    """Return the errors (runs, samples, channels) of a motion at equal parts of the period, due to those of times."""
    samples, errors = len(motion), times.errors[:, order]
    owner = np.repeat(np.arange(order.size), [part.size for part in phases])
    until = np.cumsum(errors, axis=1) - errors
    early = errors.sum(axis=1)[:, None] * (np.arange(samples) / samples)
    early -= until[:, owner] + np.concatenate(phases) * errors[:, owner]
    rates = np.gradient(motion, float(times.each.sum()) / samples, axis=0)
    return early[:, :, None] * rates


def _parts(
    following: Following, maps: ReturnMap, estimate: Estimate, at: list[np.ndarray], columns: slice, degree: int,
    growth: float,
) -> list[_MotionPart]:  # fmt: skip
    """Return the motion of some channels at phases after each point, by polynomials of some degree.

    The bias is the difference to wider neighbourhoods over `growth`.
    """
    fits = estimate.fits
    assert fits is not None
    phases = maps.phases(np.arange(len(estimate.points)))
    pairs, runs, by_run = errors_by_run(maps, fits.narrow)
    d, parts = estimate.points.shape[1], []
    for j, places in enumerate(at):
        signals, one = partial(following.signals, columns=columns, phases=places), slice(j, j + 1)
        sizes = following.sizes[columns]
        (fit,) = maps.regress(estimate.points[one], phases[one], fits.bandwidths[one], degree, signals, sizes)
        (other,) = maps.regress(
            fits.wide_points[one], phases[one], WIDENED * fits.bandwidths[one], degree, signals, sizes, influence=False
        )
        errors = np.tensordot(by_run[:, d * j : d * (j + 1)], fit.slopes, 1)
        np.add.at(errors, runs[np.searchsorted(pairs, maps.positions[fit.neighbours])], fit.influence)
        away = other.value - fit.value
        if columns == following.outputs:
            away = _without_turns(away, following)
        parts.append(_MotionPart(fit.value, errors, np.abs(away) / growth, fit.gain))
    return parts


def _without_turns(difference: np.ndarray, following: Following) -> np.ndarray:
    """Return the difference of two motions (samples, channels) without whole turns of angles."""
    result = np.array(difference)
    for _, column in following.angles:
        result[:, column] -= TURN * np.round(result[0, column] / TURN)
    return result


def _continuous(parts: list[np.ndarray], following: Following) -> np.ndarray:
    """Return parts (samples, channels) of a motion as one, angles continuous from (−π, π] on."""
    motion = np.concatenate(parts)
    for _, column in following.angles:
        motion[:, column] = np.unwrap(motion[:, column])
        motion[:, column] -= TURN * np.ceil((motion[0, column] - np.pi) / TURN)
    return motion


def _common(errors: np.ndarray, size: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest principal components of errors (n, channels, samples), and the others' variance (channels,).

    The errors of the closed points and those of the neighbours' points are propagated by the slopes of the regression:
    they have as many components each as there are coordinates of all points. The rest is noise of single samples.
    """
    scale = np.where(size > 0.0, size, 1.0)[:, None]
    _, values, axes = np.linalg.svd((errors / scale).reshape(len(errors), -1), full_matrices=False)
    kept = (values[:most, None] * axes[:most]).reshape(-1, *errors.shape[1:]) * scale
    rest = np.sum(errors**2, axis=0) - np.sum(kept**2, axis=0)
    return kept, np.maximum(rest, 0.0).mean(axis=1)
