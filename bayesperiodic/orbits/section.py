"""PoincareSection: points of a motion, once a forcing period or where it crosses a plane."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.data.recording import Recording

DEGREES = 180.0 / np.pi
FEWEST_SAMPLES, FEWEST_POINTS, CYCLE_SAMPLES = 8, 200, 64
# Local polynomials: degree for the values; degree and number of samples for the variance of the noise.
VALUE_DEGREE, NOISE_DEGREE, NOISE_SAMPLES = 7, 11, 14
# Half the number of samples in the smallest window.
SMALLEST_WINDOW = (VALUE_DEGREE + 1) // 2
# The window is narrower by this factor than the first window with a significant bias.
WINDOW_MARGIN = 1.6
CROSSINGS_EACH = 20_000


@dataclass(frozen=True)
class PoincareSection(Result):
    """Points of a motion in a Poincaré section, in the order of time: the input of `find_orbits`.

    Attributes
    ----------
    points : array (count, 2)
        Angles in (−π, π].
    coordinates, angles : tuple of str
        The two coordinates, and those of them that are angles, one at most.
    frequency : float
        Forcing frequency [Hz]; for crossings of a plane, returns per second.
    increments : array (count − 1, 2)
        Next point minus point. Angles include whole turns; where `winds` is False they are in half a turn either way.
    winds : bool
        Whether the whole turns between the points are known.
    noise : array (2,) or None
        Standard deviation of the points' errors; None if it must be estimated from the points.
    instants : array (count,) or None
        Times of the points [s].
    time, signals : array (samples,), array (samples, 2), or None
        The recording, angles unwrapped; None for points alone.
    values : int
        Number of measured values.
    synthetic : bool
        True if the data were simulated.

    Examples
    --------
    The driven pendulum in chaotic motion, once a forcing period:

    >>> recording = bp.simulate(bp.models.pendulum, pendulum_parameters, frequency=1.4467, duration=200,
    ...                         sampling_rate=60, start={"phi": 1})
    >>> section = bp.PoincareSection.from_recording(recording, ("angle", "rate"), frequency=1.4467, angles=["angle"])
    >>> section
    PoincareSection(290 points of angle, rate at 1.4467 Hz from a recording of 12001 samples)
    >>> section.cycle(index=0, period=2, samples=32)["angle"].shape
    (64,)
    """

    points: np.ndarray
    coordinates: tuple[str, str]
    angles: tuple[str, ...]
    frequency: float
    increments: np.ndarray
    winds: bool
    noise: np.ndarray | None = None
    instants: np.ndarray | None = None
    time: np.ndarray | None = None
    signals: np.ndarray | None = None
    values: int = 0
    synthetic: bool = False

    @classmethod
    @in_one_thread
    def from_recording(
        cls,
        recording: Recording,
        coordinates: Sequence[str],
        *,
        frequency: float,
        origin: float = 0.0,
        angles: Iterable[str] = (),
    ) -> "PoincareSection":
        """Evaluate a recording once a forcing period, at whole tau.

        Values come from local polynomials, in windows as wide as the signal allows without bias, so that points of a
        densely sampled recording have less noise than single samples.

        Parameters
        ----------
        recording : Recording
            At least 8 samples a period; the steps may differ.
        coordinates : sequence of two str
            Outputs, such as ``("angle", "rate")``.
        frequency : float
            Of the forcing [Hz].
        origin : float
            Time at which tau = 0 [s].
        angles : sequence of str
            The coordinates that are angles [rad], continuous or wrapped at any whole turn.

        Returns
        -------
        PoincareSection

        Raises
        ------
        ValueError
            For an unknown coordinate, too few samples or periods, or an angle that does not seem to be in radians.
        """
        frequency = _checks.positive("frequency", frequency)
        origin = _checks.finite_number("origin", origin)
        names, angle_names, signals = _signals(recording, coordinates, angles)
        time = recording.time
        if recording.sampling_rate < FEWEST_SAMPLES * frequency:
            rate = f"{recording.sampling_rate / frequency:.3g}"
            raise ValueError(
                f"recording: must have at least {FEWEST_SAMPLES} samples a period, got {rate}. For samples taken once "
                "a period, use from_points."
            )
        first = int(np.ceil((time[0] - origin) * frequency - 1e-9))
        last = int(np.floor((time[-1] - origin) * frequency + 1e-9))
        instants = origin + np.arange(first, last + 1) / frequency
        section = cls._of(recording, names, angle_names, signals, instants, frequency)
        if np.all(np.ptp(np.cumsum(section.increments, axis=0), axis=0) < 1e-2 * np.ptp(signals, axis=0)):
            raise ValueError(
                "recording: must be chaotic, got a motion of period 1, whose section points coincide. Use "
                "recording.fold instead."
            )
        return section

    @classmethod
    def from_crossings(
        cls,
        recording: Recording,
        coordinates: Sequence[str],
        *,
        channel: str,
        level: float = 0.0,
        direction: int = 1,
        angles: Iterable[str] = (),
    ) -> "PoincareSection":
        """Evaluate a recording where a channel crosses a level, as for autonomous systems.

        Parameters
        ----------
        recording, coordinates, angles
            As for `from_recording`.
        channel : str
            Output whose crossings define the section; not one of the coordinates.
        level : float
        direction : {1, -1}
            Upwards or downwards.

        Returns
        -------
        PoincareSection
            `frequency` is the mean number of returns per second; the times between them follow from ``instants``.

        Raises
        ------
        ValueError
            For an unknown channel, too few crossings, and as for `from_recording`.
        """
        names, angle_names, signals = _signals(recording, coordinates, angles)
        _checks.one_of("channel", channel, [name for name in recording.outputs if name not in names])
        level = _checks.finite_number("level", level)
        if direction not in (1, -1):
            raise ValueError(f"direction: must be 1 (upwards) or -1 (downwards), got {direction!r}.")
        instants = _upward_crossings(recording.time, direction * (recording.outputs[channel] - level))
        return cls._of(recording, names, angle_names, signals, instants)

    @classmethod
    def from_points(
        cls, points: Any, coordinates: Sequence[str], *, frequency: float, angles: Iterable[str] = ()
    ) -> "PoincareSection":
        """Use points that were measured once a forcing period; winding numbers and measured cycles are then unknown.

        Parameters
        ----------
        points : array (count, 2)
            All consecutive points in the order of time; angles [rad] with any number of turns.
        coordinates, frequency, angles
            As for `from_recording`.

        Returns
        -------
        PoincareSection

        Raises
        ------
        ValueError
            For too few points, another shape, NaN, or an angle that seems to be in degrees.
        """
        frequency = _checks.positive("frequency", frequency)
        names, angle_names = _names(coordinates, angles)
        values = _checks.real_array("points", points)
        if values.ndim != 2 or values.shape[1] != 2:
            raise ValueError(f"points: must have the shape (count, 2), got {values.shape}.")
        turning = np.isin(names, angle_names)
        for k, name in enumerate(names):
            extent = np.ptp(_checks.finite_vector(f"points[:, {k}] ({name})", values[:, k]))
            if turning[k] and 6.5 * np.pi < extent < 361.0:
                raise ValueError(
                    f"points[:, {k}] ({name}): must be an angle in radians, got a range of {extent:.4g}. It seems to "
                    "be in degrees: convert it with numpy.radians."
                )
        _check_count(len(values))
        increments = wrapped(np.diff(values, axis=0), turning)
        points = wrapped(values, turning)
        return cls(points, names, angle_names, frequency, increments, not angle_names, values=values.size)

    @classmethod
    def _of(
        cls,
        recording: Recording,
        names: tuple[str, str],
        angles: tuple[str, ...],
        signals: np.ndarray,
        instants: np.ndarray,
        frequency: float | None = None,
    ) -> "PoincareSection":
        """Return the section of signals at given instants; the frequency is by default that of the instants."""
        _check_count(instants.size)
        frequency = frequency or float((instants.size - 1) / (instants[-1] - instants[0]))
        time = recording.time
        values, noise = _estimate(time, signals, np.clip(instants, time[0], time[-1]))
        points, increments = wrapped(values, np.isin(names, angles)), np.diff(values, axis=0)
        measured = (instants, time, signals, signals.size, recording.synthetic)
        return cls(points, names, angles, frequency, increments, True, noise, *measured)

    def __len__(self) -> int:
        return len(self.points)

    def cycle(self, index: int, period: int, samples: int = CYCLE_SAMPLES) -> dict[str, np.ndarray] | None:
        """Interpolate the measured motion from one point over some returns.

        Parameters
        ----------
        index, period, samples : int
            Position of the first point, number of returns, samples per return.

        Returns
        -------
        dict of str to array (samples·period,), or None
            By coordinate; angles start in (−π, π] and are continuous. None for a section of points alone.
        """
        if self.instants is None or self.time is None or self.signals is None:
            return None
        knots = np.arange(period + 1)
        at = np.interp(np.arange(samples * period) / samples, knots, self.instants[index : index + period + 1])
        values = _fit(self.time, self.signals, at)[0]
        shift = self.points[index] - _fit(self.time, self.signals, self.instants[index : index + 1])[0][0]
        turns = np.where(np.isin(self.coordinates, self.angles), np.round(shift / (2.0 * np.pi)), 0.0)
        values += 2.0 * np.pi * turns
        return dict(zip(self.coordinates, values.T, strict=True))

    def __repr__(self) -> str:
        source = "points alone" if self.signals is None else f"a recording of {len(self.signals)} samples"
        names = ", ".join(self.coordinates)
        return f"PoincareSection({len(self.points)} points of {names} at {self.frequency:.6g} Hz from {source})"


def wrapped(values: np.ndarray, turning: np.ndarray | bool = True) -> np.ndarray:
    """Return values (…, coordinates), with those that are turning angles in (−π, π]."""
    return np.where(turning, np.pi - (np.pi - values) % (2.0 * np.pi), values)


def _names(coordinates: Sequence[str], angles: Iterable[str]) -> tuple[tuple[str, str], tuple[str, ...]]:
    names = _checks.identifiers("coordinates", [coordinates] if isinstance(coordinates, str) else coordinates)
    if len(names) != 2:
        raise ValueError(f"coordinates: must be two outputs, got {coordinates!r}.")
    angle_names = (angles,) if isinstance(angles, str) else tuple(angles)
    for name in angle_names:
        _checks.one_of("angles", name, names)
    if len(angle_names) > 1:
        raise ValueError(f"angles: must name at most one coordinate, got {angle_names!r}.")
    return (names[0], names[1]), angle_names


def _signals(
    recording: Recording, coordinates: Sequence[str], angles: Iterable[str]
) -> tuple[tuple[str, str], tuple[str, ...], np.ndarray]:
    """Return the names of the coordinates and of their angles, and their values (samples, 2), angles unwrapped."""
    names, angle_names = _names(coordinates, angles)
    for name in names:
        _checks.one_of("coordinates", name, recording.outputs)
    if isinstance(recording.time, Mapping):
        raise ValueError(
            f"recording: must have the same times for all channels, got {recording!r}; leave other channels out, or "
            "record the coordinates together."
        )
    signals = np.stack([recording.outputs[name] for name in names], -1)
    for name in angle_names:
        k = names.index(name)
        _check_angle(name, signals[:, k])
        signals[:, k] = np.unwrap(signals[:, k])
        _check_rate(name, names[1 - k], recording.time, signals[:, k], signals[:, 1 - k])
    return names, angle_names, signals


def _check_count(count: int) -> None:
    if count < FEWEST_POINTS:
        raise ValueError(
            f"section: must have at least {FEWEST_POINTS} points, got {count}; thousands are better. Record more "
            "forcing periods."
        )


def _check_angle(name: str, values: np.ndarray) -> None:
    """Raise a ValueError for an angle that jumps by other than 2π, or moves half a turn between samples."""
    step = np.abs(np.diff(values))
    smooth, largest, extent = float(np.quantile(step, 0.9)), float(step.max()), float(np.ptp(values))
    jumps = largest > 0.75 * extent and largest > 4.0 * smooth
    if jumps and abs(extent / 360.0 - 1.0) < 0.1:
        raise ValueError(
            f"outputs[{name!r}]: must be an angle in radians, got jumps of {largest:.4g}. It seems to be in degrees: "
            "convert it with numpy.radians."
        )
    if jumps and largest > 1.0 and abs(extent / (2.0 * np.pi) - 1.0) > 0.1:
        raise ValueError(
            f"outputs[{name!r}]: must be an angle that is continuous or jumps by a turn (6.283 rad), got jumps of "
            f"{largest:.4g}. Check the unit, and whether the angle covers half a turn only (arctan instead of arctan2)."
        )
    if np.quantile(np.abs(wrapped(np.diff(values))), 0.9) > 0.75 * np.pi or smooth > 2.0 * np.pi:
        raise ValueError(
            f"outputs[{name!r}]: must move by less than half a turn (3.14 rad) between samples, got steps of "
            f"{smooth:.4g}. Convert degrees with numpy.radians, or sample faster."
        )


def _check_rate(name: str, other: str, time: np.ndarray, angle: np.ndarray, rate: np.ndarray) -> None:
    """Raise a ValueError if the other coordinate is the rate of the unwrapped angle in another unit."""
    measured = np.diff(angle)
    expected = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    scale, product = np.sqrt(np.sum(measured**2) * np.sum(expected**2)), np.sum(measured * expected)
    if scale == 0.0 or product < 0.98 * scale:
        return
    ratio = product / np.sum(expected**2)
    for factor, quantity in ((DEGREES, "angle"), (1.0 / DEGREES, "rate")):
        if abs(ratio / factor - 1.0) < 0.1:
            raise ValueError(
                f"outputs[{name!r}]: must be the integral of {other!r}, got {ratio:.3g} times it; the {quantity} seems "
                "to be in degrees. Use radians and radians per second."
            )


def _upward_crossings(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the times at which a signal crosses zero upwards.

    Between two crossings the signal must go below minus a tenth of its standard deviation, so that noise adds none.
    """
    band = 0.1 * signal.std()
    marks = np.flatnonzero(np.abs(signal) > band)
    up = np.flatnonzero((signal[marks[:-1]] < 0.0) & (signal[marks[1:]] > 0.0))
    crossings = []
    for low, high in zip(marks[up], marks[up + 1], strict=True):
        span = slice(max(low - 2, 0), high + 3)
        centre = 0.5 * (time[low] + time[high])
        roots = np.polynomial.Polynomial.fit(time[span] - centre, signal[span], 3).roots()
        real = roots[np.abs(roots.imag) < 1e-9].real + centre
        inside = real[(real >= time[low]) & (real <= time[high])]
        if inside.size:
            crossings.append(inside[np.argmin(np.abs(inside - centre))])
    return np.array(crossings)


def _estimate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signals (instants, channels) at given instants, and the standard deviation of their errors (channels,).

    Polynomials of degree 7 are fitted in windows of increasing width. For white noise the expected squared difference
    between a narrow and a wide estimate is known except for the squared bias of the wide one; the excess is tested for
    significance. Bias is proportional to the eighth power of the width, so in a window 1.6 times narrower than the
    first significant one it is 40 times smaller, and negligible even in averages over hundreds of instants.
    """
    narrow, narrow_gain, _ = _fit(time, signals, at)
    # A higher degree on few samples: noise dominates the residual.
    variance = _fit(time, signals, at, NOISE_SAMPLES // 2, NOISE_DEGREE)[2].mean(0)
    count = signals.shape[1]
    halves, unbiased = [SMALLEST_WINDOW], np.ones(count, dtype=bool)
    widest = max(SMALLEST_WINDOW, int(0.5 * (time.size - 1) / (time[-1] - time[0]) * np.median(np.diff(at))))
    first_biased = np.full(count, widest)
    while (half := halves[-1] + max(1, halves[-1] // 5)) <= widest and unbiased.any():
        wide, gain, _ = _fit(time, signals, at, half)
        squared = (wide - narrow) ** 2
        bias = squared.mean(0) - variance * (narrow_gain.mean() - gain.mean())
        biased = unbiased & (bias > 2.0 * squared.std(0) / np.sqrt(len(at)))
        first_biased[biased], unbiased[biased] = half, False
        halves.append(half)
    values, sd = narrow.copy(), np.sqrt(variance * narrow_gain.mean())
    for channel in range(count):
        half = max(h for h in halves if h == SMALLEST_WINDOW or h * WINDOW_MARGIN <= first_biased[channel])
        if half > SMALLEST_WINDOW:
            fitted, gain, _ = _fit(time, signals[:, [channel]], at, half)
            values[:, channel], sd[channel] = fitted[:, 0], np.sqrt(variance[channel] * gain.mean())
    return values, sd


def _fit(
    time: np.ndarray, signals: np.ndarray, at: np.ndarray, half: int = SMALLEST_WINDOW, degree: int = VALUE_DEGREE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values, their variance for unit noise, and the residual variance of polynomials on 2·half samples each."""
    count = 2 * half
    first = np.clip(np.searchsorted(time, at) - half, 0, time.size - count)
    centre = np.polynomial.legendre.legvander(np.zeros(1), degree)[0]
    free = max(count - degree - 1, 1)
    values, gains, residuals = [], [], []
    for k in range(0, len(at), CROSSINGS_EACH):
        index = first[k : k + CROSSINGS_EACH, None] + np.arange(count)
        width = 0.5 * (time[index[:, -1]] - time[index[:, 0]])
        basis = np.polynomial.legendre.legvander(
            (time[index] - at[k : k + CROSSINGS_EACH, None]) / width[:, None], degree
        )
        normal = basis.transpose(0, 2, 1) @ basis
        local = signals[index]
        reference = local[:, half]
        local = local - reference[:, None]
        weights = basis @ np.linalg.solve(normal, np.broadcast_to(centre[:, None], (len(index), degree + 1, 1)))
        values.append(reference + (weights.transpose(0, 2, 1) @ local)[:, 0])
        gains.append((weights[..., 0] ** 2).sum(1))
        residual = local - basis @ np.linalg.solve(normal, basis.transpose(0, 2, 1) @ local)
        residuals.append((residual**2).sum(1) / free)
    return np.concatenate(values), np.concatenate(gains), np.concatenate(residuals)
