"""PoincareSection: a motion looked at once a period, or wherever it crosses a plane."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import checks
from bayesperiodic.data.recording import Recording
from bayesperiodic.orbits import instants
from bayesperiodic.orbits.angles import check_angle, check_rate, wrapped
from bayesperiodic.store import Result

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
        frequency = checks.positive("frequency", frequency)
        origin = checks.finite_number("origin", origin)
        names, angle_names = _names(coordinates, angles)
        signals = _signals(recording, names, angle_names)
        time = recording.time
        if recording.sampling_rate < instants.FEWEST_SAMPLES * frequency:
            raise ValueError(
                f"recording: {recording.sampling_rate / frequency:.3g} samples a period are not allowed; at least "
                f"{instants.FEWEST_SAMPLES} are needed. Samples taken once a period go to from_points."
            )
        first = int(np.ceil((time[0] - origin) * frequency - 1e-9))
        last = int(np.floor((time[-1] - origin) * frequency + 1e-9))
        at = origin + np.arange(first, last + 1) / frequency
        _enough(at.size)
        values, noise = instants.estimate(time, signals, np.clip(at, time[0], time[-1]))
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
        checks.one_of("channel", channel, [name for name in recording.outputs if name not in names])
        level = checks.finite_number("level", level)
        if direction not in (1, -1):
            raise ValueError(f"direction: {direction!r} is not allowed; it is 1 (upwards) or -1.")
        signals = _signals(recording, names, angle_names)
        at = instants.crossings(recording.time, direction * (recording.outputs[channel] - level))
        _enough(at.size)
        values, noise = instants.estimate(recording.time, signals, at)
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
        frequency = checks.positive("frequency", frequency)
        names, angle_names = _names(coordinates, angles)
        try:
            values = np.array(points, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(f"points: {points!r} is not allowed; it must be an array of real numbers.") from None
        if values.ndim != 2 or values.shape[1] != 2:
            raise ValueError(f"points: shape {values.shape} is not allowed; it must be (count, 2).")
        for k, name in enumerate(names):
            checks.finite_vector(f"points[:, {k}] ({name})", values[:, k])
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
        values = instants.interpolate(self.time, self.signals, at)
        shift = self.points[index] - instants.interpolate(self.time, self.signals, self.instants[index : index + 1])[0]
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
    names = checks.identifiers("coordinates", [coordinates] if isinstance(coordinates, str) else coordinates)
    if len(names) != 2:
        raise ValueError(f"coordinates: {coordinates!r} is not allowed; a section shows two outputs.")
    angle_names = (angles,) if isinstance(angles, str) else tuple(angles)
    for name in angle_names:
        checks.one_of("angles", name, names)
    if len(angle_names) > 1:
        raise ValueError(f"angles: {angle_names!r} is not allowed; at most one of the two coordinates is an angle.")
    return (names[0], names[1]), angle_names


def _signals(recording: Recording, names: tuple[str, str], angles: tuple[str, ...]) -> np.ndarray:
    for name in names:
        checks.one_of("coordinates", name, recording.outputs)
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
