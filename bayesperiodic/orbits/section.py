"""PoincareSection: a motion looked at once a period, or wherever it crosses a plane."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.data.recording import Recording

DEGREES = 180.0 / np.pi


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles in (−π, π]."""
    return np.pi - (np.pi - angle) % (2.0 * np.pi)


def check_angle(name: str, values: np.ndarray) -> None:
    """Raise a ValueError for an angle that jumps by other than 2π, or moves half a turn between samples.

    Parameters
    ----------
    name : str
    values : array (samples,)
    """
    step = np.abs(np.diff(values))
    smooth, largest, extent = float(np.quantile(step, 0.9)), float(step.max()), float(np.ptp(values))
    folded = largest > 0.75 * extent and largest > 4.0 * smooth
    if folded and abs(extent / 360.0 - 1.0) < 0.1:
        raise ValueError(
            f"outputs[{name!r}]: jumps of {largest:.4g} are not allowed; an angle in degrees is suspected, radians are "
            "needed."
        )
    if folded and largest > 1.0 and abs(extent / (2.0 * np.pi) - 1.0) > 0.1:
        raise ValueError(
            f"outputs[{name!r}]: jumps of {largest:.4g} are not allowed; an angle runs on or jumps by 2π (6.283 rad). "
            "Another unit than radians, or an angle of half a turn (arctan instead of arctan2), is suspected."
        )
    if np.quantile(np.abs(wrapped(np.diff(values))), 0.9) > 0.75 * np.pi or smooth > 2.0 * np.pi:
        raise ValueError(
            f"outputs[{name!r}]: steps of {smooth:.4g} between samples are not allowed; below half a turn its windings "
            "can be counted. Degrees instead of radians, or too slow a sampling, are suspected."
        )


def check_rate(name: str, other: str, time: np.ndarray, angle: np.ndarray, rate: np.ndarray) -> None:
    """Raise a ValueError where the other coordinate is the angle's rate in another unit of angle.

    Parameters
    ----------
    name, other : str
    time, angle, rate : array (samples,)
        The angle running on.
    """
    measured = np.diff(angle)
    expected = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    scale = np.sqrt(np.sum(measured**2) * np.sum(expected**2))
    if scale == 0.0 or np.sum(measured * expected) < 0.98 * scale:
        return
    ratio = np.sum(measured * expected) / np.sum(expected**2)
    for factor, unit in ((DEGREES, "degrees"), (1.0 / DEGREES, "radians and its rate in degrees per second")):
        if abs(ratio / factor - 1.0) < 0.1:
            raise ValueError(
                f"outputs[{name!r}]: {ratio:.3g} times the integral of {other!r} is not allowed; the angle in {unit} "
                "is suspected, radians and radians per second are needed."
            )


FEWEST_SAMPLES = 8
DEGREE = 7
NOISE_DEGREE, NOISE_SAMPLES = 11, 14
# A window is so much narrower than the first one in which bias is seen.
MARGIN = 1.6
BLOCK = 20_000


def interpolate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return signals (instants, channels) by polynomials through the eight samples around each instant."""
    return _fit(time, signals, at, (DEGREE + 1) // 2)[0]


def estimate(time: np.ndarray, signals: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signals at instants, and the standard deviation of their errors.

    Polynomials of degree 7 are fitted to ever more samples around each instant. With white noise the mean squared
    difference between two such estimates is known but for the squared bias of the wider one, so that bias is seen once
    it stands out of the doubt about that mean. It grows like the eighth power of the width, so that in a window 1.6
    times narrower than the first in which it is seen it is 40 times smaller, and stays below the noise even where
    hundreds of instants are averaged.

    Parameters
    ----------
    time : array (samples,)
    signals : array (samples, channels)
    at : array (instants,)

    Returns
    -------
    values : array (instants, channels)
    sd : array (channels,)
    """
    narrow, narrow_gain, _ = _fit(time, signals, at, (DEGREE + 1) // 2)
    # A higher degree on nearly as few samples: its residual is noise before it is bias.
    variance = _fit(time, signals, at, NOISE_SAMPLES // 2, NOISE_DEGREE)[2].mean(0)
    count = signals.shape[1]
    halves, blind = [(DEGREE + 1) // 2], np.ones(count, dtype=bool)
    widest = max(halves[0], int(0.5 * (time.size - 1) / (time[-1] - time[0]) * np.median(np.diff(at))))
    seen = np.full(count, widest)
    while (half := halves[-1] + max(1, halves[-1] // 5)) <= widest and blind.any():
        wide, gain, _ = _fit(time, signals, at, half)
        squared = (wide - narrow) ** 2
        bias = squared.mean(0) - variance * (narrow_gain.mean() - gain.mean())
        found = blind & (bias > 2.0 * squared.std(0) / np.sqrt(len(at)))
        seen[found], blind[found] = half, False
        halves.append(half)
    values, sd = narrow.copy(), np.sqrt(variance * narrow_gain.mean())
    for channel in range(count):
        half = max(h for h in halves if h == halves[0] or h * MARGIN <= seen[channel])
        if half > halves[0]:
            fitted, gain, _ = _fit(time, signals[:, [channel]], at, half)
            values[:, channel], sd[channel] = fitted[:, 0], np.sqrt(variance[channel] * gain.mean())
    return values, sd


def crossings(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the instants at which a signal crosses zero upwards.

    A crossing counts once the signal has been below zero by a tenth of its spread, so that noise makes no others.
    """
    band = 0.1 * signal.std()
    marks = np.flatnonzero(np.abs(signal) > band)
    up = np.flatnonzero((signal[marks[:-1]] < 0.0) & (signal[marks[1:]] > 0.0))
    found = []
    for low, high in zip(marks[up], marks[up + 1], strict=True):
        span = slice(max(low - 2, 0), high + 3)
        centre = 0.5 * (time[low] + time[high])
        line = np.polynomial.Polynomial.fit(time[span] - centre, signal[span], 3)
        roots = line.roots()
        real = roots[np.abs(roots.imag) < 1e-9].real + centre
        inside = real[(real >= time[low]) & (real <= time[high])]
        if inside.size:
            found.append(inside[np.argmin(np.abs(inside - centre))])
    return np.array(found)


def _fit(
    time: np.ndarray, signals: np.ndarray, at: np.ndarray, half: int, degree: int = DEGREE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return estimates, their variance for unit noise, and the residual variance, from 2·half samples each."""
    count = 2 * half
    first = np.clip(np.searchsorted(time, at) - half, 0, time.size - count)
    centre = np.polynomial.legendre.legvander(np.zeros(1), degree)[0]
    free = max(count - degree - 1, 1)
    values, gains, rests = [], [], []
    for k in range(0, len(at), BLOCK):
        index = first[k : k + BLOCK, None] + np.arange(count)
        width = 0.5 * (time[index[:, -1]] - time[index[:, 0]])
        basis = np.polynomial.legendre.legvander((time[index] - at[k : k + BLOCK, None]) / width[:, None], degree)
        normal = basis.transpose(0, 2, 1) @ basis
        local = signals[index]
        reference = local[:, half]
        local = local - reference[:, None]
        weights = basis @ np.linalg.solve(normal, np.broadcast_to(centre[:, None], (len(index), degree + 1, 1)))
        values.append(reference + (weights.transpose(0, 2, 1) @ local)[:, 0])
        gains.append((weights[..., 0] ** 2).sum(1))
        rest = local - basis @ np.linalg.solve(normal, basis.transpose(0, 2, 1) @ local)
        rests.append((rest**2).sum(1) / free)
    return np.concatenate(values), np.concatenate(gains), np.concatenate(rests)


FEWEST_POINTS = 200
CYCLE_SAMPLES = 64


@dataclass(frozen=True)
class PoincareSection(Result):
    """Points of a motion in a Poincaré section, in the order in which they came.

    What section 5 of [1]_ starts from.

    Attributes
    ----------
    points : array (count, 2)
        Angles in (−π, π].
    coordinates : tuple of str
    angles : tuple of str
        The coordinates that are angles, one at most.
    frequency : float
        Of the forcing [Hz]; of a plane crossing, returns per second.
    increments : array (count − 1, 2)
        Next point minus point, angles running on, or in half a turn either way where `winds` is False.
    winds : bool
        Whether the turns between the points are known.
    noise : array (2,) or None
        Standard deviation of the points' errors; None where only the points themselves can tell it.
    instants : array (count,) or None
        Times of the points [s].
    time, signals : array (samples,), array (samples, 2), or None
        The recording, angles running on; None for points alone.
    values : int
        Numbers that were measured.
    synthetic : bool
        True if the data were simulated.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    The driven pendulum in chaotic motion, once a forcing period:

    >>> import bayesperiodic as bp
    >>> theta = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
    >>> recording = bp.simulate(bp.models.pendulum, theta, frequency=1.4467, duration=200, sampling_rate=60,
    ...                         start={"phi": 1})
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
    def from_recording(
        cls,
        recording: Recording,
        coordinates: Sequence[str],
        *,
        frequency: float,
        origin: float = 0.0,
        angles: Iterable[str] = (),
    ) -> "PoincareSection":
        """Look at a recording once a forcing period, at whole tau.

        Between and, with noise, across the samples a local polynomial is taken, as wide as the signal allows without
        bias, so that a dense recording gives points with less noise than a sample.

        Parameters
        ----------
        recording : Recording
            At least 8 samples a period, of steps that need not be equal.
        coordinates : sequence of two str
            Outputs, such as ``("angle", "rate")``.
        frequency : float
            Of the forcing [Hz].
        origin : float
            Time at which tau = 0 [s].
        angles : sequence of str
            The coordinates that are angles [rad], running on or folded at any whole turn.

        Returns
        -------
        PoincareSection

        Raises
        ------
        ValueError
            For an unknown coordinate, too few samples or periods, an angle that does not look like one in radians.
        """
        frequency = _checks.positive("frequency", frequency)
        origin = _checks.finite_number("origin", origin)
        names, angle_names = _names(coordinates, angles)
        signals = _signals(recording, names, angle_names)
        time = recording.time
        if recording.sampling_rate < FEWEST_SAMPLES * frequency:
            raise ValueError(
                f"recording: {recording.sampling_rate / frequency:.3g} samples a period are not allowed; at least "
                f"{FEWEST_SAMPLES} are needed. Samples taken once a period go to from_points."
            )
        first = int(np.ceil((time[0] - origin) * frequency - 1e-9))
        last = int(np.floor((time[-1] - origin) * frequency + 1e-9))
        at = origin + np.arange(first, last + 1) / frequency
        _enough(at.size)
        values, noise = estimate(time, signals, np.clip(at, time[0], time[-1]))
        if np.all(np.ptp(values, axis=0) < 1e-2 * np.ptp(signals, axis=0)):
            raise ValueError(
                "recording: a motion of period 1 is not allowed; all its section points are one. Fold it instead."
            )
        return cls._of(values, names, angle_names, frequency, noise, at, time, signals, recording.synthetic)

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
        """Look at a recording where a channel crosses a level, as for autonomous systems.

        Parameters
        ----------
        recording : Recording
        coordinates : sequence of two str
            Outputs that are looked at, other than `channel`.
        channel : str
            Output whose crossings are taken.
        level : float
        direction : {1, -1}
            Upwards or downwards.
        angles : sequence of str
            The coordinates that are angles [rad].

        Returns
        -------
        PoincareSection
            `frequency` is that of the returns on average; the times between them follow from ``instants``.

        Raises
        ------
        ValueError
            For an unknown channel or coordinate, too few crossings, an angle that does not look like one in radians.
        """
        names, angle_names = _names(coordinates, angles)
        _checks.one_of("channel", channel, [name for name in recording.outputs if name not in names])
        level = _checks.finite_number("level", level)
        if direction not in (1, -1):
            raise ValueError(f"direction: {direction!r} is not allowed; it is 1 (upwards) or -1.")
        signals = _signals(recording, names, angle_names)
        at = crossings(recording.time, direction * (recording.outputs[channel] - level))
        _enough(at.size)
        values, noise = estimate(recording.time, signals, at)
        frequency = float((at.size - 1) / (at[-1] - at[0]))
        return cls._of(values, names, angle_names, frequency, noise, at, recording.time, signals, recording.synthetic)

    @classmethod
    def from_points(
        cls, points: Any, coordinates: Sequence[str], *, frequency: float, angles: Iterable[str] = ()
    ) -> "PoincareSection":
        """Take points that were measured once a forcing period; there is no winding and no measured cycle then.

        Parameters
        ----------
        points : array (count, 2)
            In the order of time, none left out; angles [rad] of any number of turns.
        coordinates : sequence of two str
            Their names, which are outputs of the model.
        frequency : float
            Of the forcing [Hz].
        angles : sequence of str
            The coordinates that are angles.

        Returns
        -------
        PoincareSection

        Raises
        ------
        ValueError
            For too few points, another shape, NaN, an angle that looks like one in degrees.
        """
        frequency = _checks.positive("frequency", frequency)
        names, angle_names = _names(coordinates, angles)
        try:
            values = np.array(points, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(f"points: {points!r} is not allowed; it must be an array of real numbers.") from None
        if values.ndim != 2 or values.shape[1] != 2:
            raise ValueError(f"points: shape {values.shape} is not allowed; it must be (count, 2).")
        for k, name in enumerate(names):
            _checks.finite_vector(f"points[:, {k}] ({name})", values[:, k])
            if name in angle_names and 6.5 * np.pi < np.ptp(values[:, k]) < 361.0:
                raise ValueError(
                    f"points[:, {k}] ({name}): a range of {np.ptp(values[:, k]):.4g} is not allowed; angles in degrees "
                    "are suspected, they must be in radians."
                )
        _enough(len(values))
        return cls._of(values, names, angle_names, frequency)

    @classmethod
    def _of(
        cls,
        values: np.ndarray,
        names: tuple[str, str],
        angles: tuple[str, ...],
        frequency: float,
        noise: np.ndarray | None = None,
        at: np.ndarray | None = None,
        time: np.ndarray | None = None,
        signals: np.ndarray | None = None,
        synthetic: bool = False,
    ) -> "PoincareSection":
        points, increments = values.copy(), np.diff(values, axis=0)
        for k, name in enumerate(names):
            if name in angles:
                points[:, k] = wrapped(values[:, k])
                if signals is None:
                    increments[:, k] = wrapped(increments[:, k])
        winds = signals is not None or not angles
        count = values.size if signals is None else signals.size
        return cls(points, names, angles, frequency, increments, winds, noise, at, time, signals, count, synthetic)

    def __len__(self) -> int:
        return len(self.points)

    def cycle(self, index: int, period: int, samples: int = CYCLE_SAMPLES) -> dict[str, np.ndarray] | None:
        """Return the motion measured from a point over some returns, `samples` values for each; None for points alone.

        Parameters
        ----------
        index : int
            Position of the point where it begins.
        period : int
            In returns.
        samples : int
            Per return.

        Returns
        -------
        dict of str to array (samples·period,), or None
            By coordinate; angles run on from the point's own in (−π, π].
        """
        if self.instants is None or self.time is None or self.signals is None:
            return None
        knots = np.arange(period + 1)
        at = np.interp(np.arange(samples * period) / samples, knots, self.instants[index : index + period + 1])
        values = interpolate(self.time, self.signals, at)
        shift = self.points[index] - interpolate(self.time, self.signals, self.instants[index : index + 1])[0]
        for k, name in enumerate(self.coordinates):
            if name in self.angles:
                values[:, k] += 2.0 * np.pi * np.round(shift[k] / (2.0 * np.pi))
        return {name: values[:, k] for k, name in enumerate(self.coordinates)}

    def __repr__(self) -> str:
        source = "points alone" if self.signals is None else f"a recording of {len(self.signals)} samples"
        return (
            f"PoincareSection({len(self.points)} points of {', '.join(self.coordinates)} at {self.frequency:.6g} Hz "
            f"from {source})"
        )


def _names(coordinates: Sequence[str], angles: Iterable[str]) -> tuple[tuple[str, str], tuple[str, ...]]:
    names = _checks.identifiers("coordinates", [coordinates] if isinstance(coordinates, str) else coordinates)
    if len(names) != 2:
        raise ValueError(f"coordinates: {coordinates!r} is not allowed; a section shows two outputs.")
    angle_names = (angles,) if isinstance(angles, str) else tuple(angles)
    for name in angle_names:
        _checks.one_of("angles", name, names)
    if len(angle_names) > 1:
        raise ValueError(f"angles: {angle_names!r} is not allowed; at most one of the two coordinates is an angle.")
    return (names[0], names[1]), angle_names


def _signals(recording: Recording, names: tuple[str, str], angles: tuple[str, ...]) -> np.ndarray:
    for name in names:
        _checks.one_of("coordinates", name, recording.outputs)
    for name in angles:
        check_angle(name, recording.outputs[name])
    signals = np.stack([np.unwrap(recording.outputs[n]) if n in angles else recording.outputs[n] for n in names], -1)
    for name in angles:
        k = names.index(name)
        check_rate(name, names[1 - k], recording.time, signals[:, k], signals[:, 1 - k])
    return signals


def _enough(count: int) -> None:
    if count < FEWEST_POINTS:
        raise ValueError(
            f"section: {count} points are not allowed; at least {FEWEST_POINTS} are needed to find orbits, thousands "
            "are better."
        )
