"""PoincareSection: points of a motion, once a forcing period or where it crosses a plane."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.data.recording import Recording
from bayesperiodic.orbits.coordinates import (
    channel_and_delay,
    channels_of,
    columns_of,
    coordinate_names,
    coordinate_signals,
    coordinate_values,
    crossed_of,
    delays_of,
    given_recordings,
    integrand_of,
    longest_window,
    other_channels,
    unwrapped,
    with_integrals,
    with_others,
    wrapped,
)
from bayesperiodic.orbits.crossings import Crossings, check_count, crossings_for
from bayesperiodic.orbits.integrals import HALF_WINDOW, in_parts
from bayesperiodic.orbits.stretches import FEWEST_SAMPLES, Stretches, joined, local_fit

CYCLE_SAMPLES = 64
# Points coincide if their standard deviations are below this many of the noise, or this fraction of the motion's range.
SCATTER, SMALLEST_SCATTER = 2.0, 2e-3


@dataclass(frozen=True)
class PoincareSection(Result):
    """Points of a motion in a Poincaré section, in the order of time: the input of `find_orbits`.

    Attributes
    ----------
    points : array (count, d)
        In the d coordinates, two or more; angles in (−π, π].
    coordinates, angles : tuple of str
        The coordinates, and those of them that are angles, one at most. A delayed one is a channel and, in brackets,
        the forcing periods after the phase of the section: ``"voltage[-0.25]"`` is the voltage a quarter period before.
        For crossings the delay is in seconds: ``"voltage[-0.1 s]"``. ``"integral(velocity)"`` is the integral of a
        channel over time, of mean zero.
    frequency : float
        Forcing frequency [Hz]; for crossings of a plane, returns per second.
    increments : array (count − 1, d)
        Next point minus point, NaN across a break. Angles include whole turns; where `winds` is False they are in half
        a turn either way.
    winds : bool
        Whether the whole turns between the points are known.
    noise : array (d,) or None
        Standard deviation of the points' errors; None if it must be estimated from the points.
    instants : array (count,) or None
        Times of the points [s].
    time, signals : array (samples,), array (samples, channels), or None
        The recording, angles unwrapped, one column a channel: those of the coordinates in their order, then ``others``;
        None for points alone.
    values : int
        Number of measured values of the coordinates.
    synthetic : bool
        True if the data were simulated.
    stretches : array (count,) of int, or None
        Number of the unbroken stretch of each point: a point and the one n places later are n returns apart where their
        numbers are equal. None if there is no break.
    starts : array (stretches,) of int, or None
        First sample of each stretch, by its number; None for points alone, or if there is no break.
    left_out : int
        Number of returns between the first and the last point of which the points are in gaps; 0 for crossings.
    others, inputs : tuple of str
        Further channels of the recording (of all recordings), outputs and then inputs, and those of them that are
        inputs.
    crossed : str or None
        Channel whose crossings define the section; None if the phase of a forcing does.
    noises : array (count, d) or None
        Standard deviation of each point's errors, for crossings, of which the instants have errors; `noise` is their
        root mean square.
    drifts : mapping of str to float
        Standard deviation of the errors of each integral, which are part of `noise`. They change slowly.

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
    coordinates: tuple[str, ...]
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
    stretches: np.ndarray | None = None
    starts: np.ndarray | None = None
    left_out: int = 0
    others: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    crossed: str | None = None
    noises: np.ndarray | None = None
    drifts: Mapping[str, float] = field(default_factory=dict)

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
        """Evaluate a recording once a forcing period, at whole tau.

        Values come from local polynomials, in windows as wide as the signal allows without bias, so that points of a
        densely sampled recording have less noise than single samples. Nothing is interpolated across a gap, a step of
        time above three usual ones (with few samples a period, above an eighth of one), and no orbit uses points from
        both sides of it.

        Parameters
        ----------
        recording : Recording
            At least 8 samples a period; the steps may differ. For several, see `from_recordings`.
        coordinates : sequence of str
            Two or more outputs that determine the next point, as many as the system has states, or more, such as
            ``("angle", "rate")``. What is not measured is replaced by delayed coordinates, such as
            ``("velocity", "voltage", "voltage[-0.25]")``, the voltage a quarter of the forcing period before, or by
            integrals, such as ``("velocity", "voltage", "integral(velocity)")``, the displacement; see Notes.
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
            For an unknown coordinate, too few samples or periods, an angle that does not seem to be in radians,
            delays of one channel that are too close modulo a period, or an integral whose drift is not determined.

        Notes
        -----
        Errors of the coordinates are taken as independent, and those of a point and the next one too. For white noise
        this holds for delayed coordinates as well, because no two values of a channel use the same samples: windows are
        no longer than the time between them, and delays of one channel must not be closer, modulo a period (with
        `steps` of `find_orbits`, modulo a step), than the 8 samples of the smallest window. For noise with a longer
        memory, standard deviations are too small.

        *Integrals* have a line in time in each stretch that is not known. Where the other coordinates and the integral
        minus its mean over one forcing period determine the state, the integral is a function of them, and the lines
        follow from all stretches together. Their errors, and those of a faster drift, are estimated and are part of
        `noise`; above a tenth of the standard deviation they are refused. Stretches below 10 forcing periods are left
        out, those above 30, or a 200th of the recording, are divided, and spikes are not integrated.
        """
        if not isinstance(recording, Recording):
            raise ValueError(
                f"recording: must be a Recording, got {type(recording).__name__}; from_recordings takes several."
            )
        return cls.from_recordings([recording], coordinates, frequency=frequency, origin=origin, angles=angles)

    @classmethod
    @in_one_thread
    def from_recordings(
        cls,
        recordings: Iterable[Recording],
        coordinates: Sequence[str],
        *,
        frequency: float,
        origin: float = 0.0,
        angles: Iterable[str] = (),
    ) -> "PoincareSection":
        """Evaluate recordings of one motion at the same phase of the forcing, as one section.

        Recordings that follow each other by one sample interval, between a half and one and a half, are joined. Between
        others there is a break, as at the gaps of each: nothing is interpolated across it, and no orbit uses points
        from both sides. Points in gaps are left out and counted (attribute ``left_out``).

        Parameters
        ----------
        recordings : sequence of Recording
            In any order, with times counted from one instant, so that the phase of the forcing is that of its
            `frequency` in all of them.
        coordinates, frequency, origin, angles
            As for `from_recording`.

        Returns
        -------
        PoincareSection

        Raises
        ------
        ValueError
            As for `from_recording`, for no recording, and for recordings that overlap in time.

        Examples
        --------
        The recording of `PoincareSection` as three files, of which the third does not continue the second:

        >>> recording = bp.simulate(bp.models.pendulum, pendulum_parameters, frequency=1.4467, duration=200,
        ...                         sampling_rate=60, start={"phi": 1})
        >>> files = [recording.between(*times) for times in ((0, 50), (50.01, 120), (130, 200))]
        >>> section = bp.PoincareSection.from_recordings(files, ("angle", "rate"), frequency=1.4467, angles=["angle"])
        >>> section  # doctest: +NORMALIZE_WHITESPACE
        PoincareSection(275 points of angle, rate at 1.4467 Hz from 11402 samples in 2 unbroken stretches;
        15 points in gaps left out)
        """
        frequency = _checks.positive("frequency", frequency)
        origin = _checks.finite_number("origin", origin)
        given = given_recordings(recordings)
        parts = [coordinate_signals(recording, coordinates, angles) for recording in given]
        names, angle_names = parts[0][:2]
        others, inputs = other_channels(given, names)
        signals = [with_others(one, values, others) for one, (*_, values) in zip(given, parts, strict=True)]
        samples = unwrapped(joined(given, signals, frequency), np.isin((*channels_of(names), *others), angle_names))
        if samples.sampling_rate < FEWEST_SAMPLES * frequency:
            rate = f"{samples.sampling_rate / frequency:.3g}"
            raise ValueError(
                f"recording: must have at least {FEWEST_SAMPLES} samples a period, got {rate}. For samples taken once "
                "a period, use from_points."
            )
        delays = delays_of(names)
        longest, reach = longest_window(names, samples.sampling_rate / frequency), (delays.min(), delays.max())
        drifts: dict[str, float] = {}
        if summed := any(map(integrand_of, channels_of(names))):
            samples = in_parts(samples, 1.0 / frequency)
            reach = (min(reach[0], -HALF_WINDOW), max(reach[1], HALF_WINDOW))
        instants, stretch, left_out = samples.instants(frequency, origin, reach)
        longest *= float(np.median(np.diff(instants)))
        if summed:
            samples, drifts = with_integrals(samples, names, origin, frequency, longest)
        synthetic = any(recording.synthetic for recording in given)
        section = cls._of(
            samples, names, angle_names, instants, stretch, left_out, synthetic, others, inputs, frequency, longest,
            drifts=drifts)  # fmt: skip
        extent = np.array([np.ptp(signal) for signal in samples.signals.T])[columns_of(names)]
        if np.all(np.ptp(np.nancumsum(section.increments, axis=0), axis=0) < 1e-2 * extent):
            raise ValueError(
                "recording: must be chaotic, got a motion of period 1, whose section points coincide. Use "
                "recording.fold instead."
            )
        return section

    @classmethod
    @in_one_thread
    def from_crossings(
        cls,
        recordings: Recording | Iterable[Recording],
        coordinates: Sequence[str],
        *,
        channel: str,
        level: float | None = None,
        direction: int = 1,
        angles: Iterable[str] = (),
    ) -> "PoincareSection":
        """Evaluate recordings where a channel crosses a level, as for autonomous systems.

        Between two crossings the smoothed channel goes below the level and above it by a tenth of its standard
        deviation and five standard errors, so that noise adds none.

        Parameters
        ----------
        recordings : Recording or sequence of them
            At least 8 samples a return; gaps and several recordings as for `from_recordings`.
        coordinates : sequence of str
            Outputs that determine the next crossing: one fewer than the system has states; or one, if the points are
            nearly on a curve, as for strong contraction. What is not measured is replaced by delays in seconds:
            ``"current[-0.1 s]"`` is the current 0.1 s before the crossing. They are within the shortest return.
            ``"interval(current)"``, where the channel is "current", is the time since the crossing before, which has
            most of the information where spikes are alike.
        channel : str
            Output whose crossings define the section; a coordinate only with delays, or its interval.
        level : float, optional
            By default the channel's median. It should be crossed steeply; not the foot of spikes. Some oscillations may
            miss it: orbits are fitted to points that return after as many oscillations as they do.
        direction : {1, -1}
            Upwards or downwards.
        angles
            As for `from_recording`.

        Returns
        -------
        PoincareSection
            `frequency` is the mean number of returns per second; orbits have their own period, `Orbit.duration`.

        Raises
        ------
        ValueError
            As for `from_recordings`, for an unknown channel or one of noise alone, too few crossings, delays of a
            channel that are too close or too long, and points that coincide within their noise.

        Notes
        -----
        Errors of the instants move the points along the flow and are part of ``noises``, less for a coordinate near a
        maximum or minimum of its channel, such as a quarter of a return after the crossing.

        Examples
        --------
        One channel of the Roessler system, whose attractor is thin: each maximum determines the next one.

        >>> model = bp.Model("roessler", states=["x", "y", "z"], inputs=[], parameters=["a", "b", "c"],
        ...                  equations=["dx + y + z", "dy - x - a*y", "dz - b - z*(x - c)"], outputs={"x": "x"})
        >>> recording = bp.simulate(model, {"a": 0.2, "b": 0.2, "c": 5.7}, frequency=0.17, duration=6000,
        ...                         sampling_rate=8, start={"x": 1})
        >>> section = bp.PoincareSection.from_crossings(recording, ["x[1.5 s]"], channel="x", level=0)
        >>> round(bp.find_orbits(section, periods=[1])[0].duration, 3)
        5.881
        """
        given = given_recordings([recordings] if isinstance(recordings, Recording) else recordings)
        parts = [coordinate_signals(recording, coordinates, angles, forced=False) for recording in given]
        names, angle_names = parts[0][:2]
        others, inputs = other_channels(given, names)
        every = (*channels_of(names), *others)
        _checks.one_of("channel", channel, [c for c in every if c not in names and c not in inputs])
        for name in filter(crossed_of, names):
            _checks.one_of("coordinates", name, [f"interval({channel})"])
        if direction not in (1, -1):
            raise ValueError(f"direction: must be 1 (upwards) or -1 (downwards), got {direction!r}.")
        signals = [with_others(one, values, others) for one, (*_, values) in zip(given, parts, strict=True)]
        samples = unwrapped(joined(given, signals, None), np.isin(every, angle_names))
        values = samples.signals[:, [every.index(channel)]]
        level = float(np.median(values)) if level is None else _checks.finite_number("level", level)
        crossings, error, longest = crossings_for(samples, values, level, direction, names, channel)
        if timed := any(map(crossed_of, names)):
            crossings, since, since_sd = crossings.with_intervals(error)
        section = cls._of(
            samples, names, angle_names, crossings.instants, crossings.stretch, 0, any(one.synthetic for one in given),
            others, inputs, 1.0 / float(crossings.returns.mean()), longest, channel,
        )  # fmt: skip
        section = section if section.noise is None else section._with_errors_of(crossings, error)
        extent = np.array([np.ptp(signal) for signal in samples.signals.T])[columns_of(names)]
        if timed:
            section = section._with_intervals(since, since_sd)
            extent[[crossed_of(name) is not None for name in names]] = since.mean()
        least = 0.0 if section.noise is None else SCATTER * section.noise
        if np.all(section.points.std(axis=0) < np.maximum(least, SMALLEST_SCATTER * extent)):
            raise ValueError(
                "recordings: must be chaotic, got points that coincide within their noise. The motion has period 1, or "
                "the coordinates vary too little at the crossings: use recording.fold, or other coordinates."
            )
        return section

    @classmethod
    def from_points(
        cls, points: Any, coordinates: Sequence[str], *, frequency: float, angles: Iterable[str] = ()
    ) -> "PoincareSection":
        """Use points that were measured once a forcing period; winding numbers and measured cycles are then unknown.

        Parameters
        ----------
        points : array (count, d), or sequence of such arrays
            All consecutive points in the order of time; angles [rad] with any number of turns. Several arrays are
            unbroken stretches.
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
        names, angle_names = coordinate_names(coordinates, angles)
        several = isinstance(points, Sequence) and len(points) > 0 and all(np.ndim(part) == 2 for part in points)
        parts = [_checks.real_array("points", part) for part in (points if several else [points])]
        for part in parts:
            if part.ndim != 2 or part.shape[1] != len(names):
                raise ValueError(f"points: must have the shape (count, {len(names)}), got {part.shape}.")
        values = np.concatenate(parts)
        turning = np.isin(names, angle_names)
        for k, name in enumerate(names):
            extent = np.ptp(_checks.finite_vector(f"points[:, {k}] ({name})", values[:, k]))
            if turning[k] and 6.5 * np.pi < extent < 361.0:
                raise ValueError(
                    f"points[:, {k}] ({name}): must be an angle in radians, got a range of {extent:.4g}. It seems to "
                    "be in degrees: convert it with numpy.radians."
                )
        check_count(len(values))
        stretch = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        increments = _within(wrapped(np.diff(values, axis=0), turning), stretch)
        points = wrapped(values, turning)
        stretches = stretch if len(parts) > 1 else None
        return cls(
            points, names, angle_names, frequency, increments, not angle_names, values=values.size, stretches=stretches
        )

    @classmethod
    def _of(
        cls, samples: Stretches, names: tuple[str, ...], angles: tuple[str, ...], instants: np.ndarray,
        stretch: np.ndarray, left_out: int, synthetic: bool, others: tuple[str, ...], inputs: tuple[str, ...],
        frequency: float, longest: float, crossed: str | None = None, drifts: Mapping[str, float] | None = None,
    ) -> "PoincareSection":  # fmt: skip
        """Return the section of signals at given instants, in windows no longer than `longest`."""
        check_count(instants.size)
        time, unit = samples.time, 1.0 if crossed else 1.0 / frequency
        drifts = drifts or {}
        values, noise = coordinate_values(samples, names, instants, stretch, unit, longest, drifts)
        points, increments = wrapped(values, np.isin(names, angles)), _within(np.diff(values, axis=0), stretch)
        broken = samples.starts.size > 1
        return cls(
            points, names, angles, frequency, increments, True, noise, instants, time, samples.signals,
            time.size * len(channels_of(names)), synthetic, stretch if broken else None,
            samples.starts if broken else None, left_out, others, inputs, crossed, drifts=drifts,
        )  # fmt: skip

    def _with_errors_of(self, crossings: Crossings, error: float) -> "PoincareSection":
        """Return the section with the errors due to those of the crossings, of a signal with errors of this sd."""
        assert self.noise is not None and self.measured is not None
        samples, instants, stretch = self.measured
        apart = float(np.median(crossings.band / crossings.slopes))
        before, later = (
            coordinate_values(samples, self.coordinates, instants + away, stretch, self.unit, 2.0 * apart, {})[0]
            for away in (-apart, apart)
        )
        noises = np.hypot(self.noise, error * (later - before) / (2.0 * apart * crossings.slopes[:, None]))
        return replace(self, noise=np.sqrt(np.mean(noises**2, axis=0)), noises=noises)

    def _with_intervals(self, since: np.ndarray, sd: np.ndarray) -> "PoincareSection":
        """Return the section with the times since the crossings before, and their standard deviations, (count,)."""
        times = np.array([crossed_of(name) is not None for name in self.coordinates])
        points = np.where(times, since[:, None], self.points)
        increments = np.where(times, np.diff(since)[:, None] + 0.0 * self.increments, self.increments)
        noises = None if self.noises is None else np.where(times, sd[:, None], self.noises)
        noise = None if noises is None else np.sqrt(np.mean(noises**2, axis=0))
        return replace(self, points=points, increments=increments, noise=noise, noises=noises)

    def __len__(self) -> int:
        return len(self.points)

    def delayed(self, coordinate: str) -> np.ndarray | None:
        """Evaluate a channel of the section's coordinates at a delay.

        Parameters
        ----------
        coordinate : str
            Such as ``"voltage[-0.25]"``.

        Returns
        -------
        array (count,), or None
            At the section's points; NaN where the delay leads out of a stretch. None for points alone.

        Raises
        ------
        ValueError
            For an unknown channel.
        """
        channel, delay = channel_and_delay(coordinate)
        if crossed_of(coordinate) and self.instants is not None:
            return np.append(np.nan, np.diff(self.instants) + 0.0 * self.increments[:, 0])
        channels = self.channels if self.crossed else channels_of(self.coordinates)
        _checks.one_of("coordinate", channel, channels)
        if self.measured is None:
            return None
        samples, instants, stretch = self.measured
        at, column = instants + delay * self.unit, [channels.index(channel)]
        first, last = samples.time[samples.starts[stretch]], samples.time[samples.stops[stretch] - 1]
        values = local_fit(samples._replace(signals=samples.signals[:, column]), np.clip(at, first, last), stretch)[0]
        return np.where((first <= at) & (at <= last), values[:, 0], np.nan)

    @property
    def unit(self) -> float:
        """The unit of delays [s]."""
        return 1.0 if self.crossed else 1.0 / self.frequency

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of the recording, in the order of the columns of signals."""
        return (*channels_of(self.coordinates), *self.others)

    @property
    def measured(self) -> tuple[Stretches, np.ndarray, np.ndarray] | None:
        """The recording, the times of the points (count,), and the stretch of each (count,); None for points alone."""
        if self.instants is None or self.time is None or self.signals is None:
            return None
        starts = np.zeros(1, dtype=np.int64) if self.starts is None else self.starts
        stretch = np.zeros(len(self), dtype=np.int64) if self.stretches is None else self.stretches
        return Stretches(self.time, self.signals, starts), self.instants, stretch

    def between(self, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the recording at several phases a return.

        Parameters
        ----------
        steps : int
            Number of phases a return, equally spaced, the section's is the first.

        Returns
        -------
        points : array (count·steps, d)
            In the order of time, those of a return together; NaN from the last point of a stretch on.
        increments : array (count·steps − 1, d)
            Next point minus point, NaN across a break.
        noise : array (d,)
            Standard deviation of the errors.

        Raises
        ------
        ValueError
            For points alone or crossings, and for delays of a channel that are too close modulo a step.
        """
        steps = _checks.integer("steps", steps, 1)
        measured = self.measured
        if measured is None:
            raise ValueError(f"steps: must be 1 for points alone, got {steps}. Make the section of a recording.")
        if self.crossed:
            raise ValueError(f"steps: must be 1 for crossings, got {steps}; between them other coordinates are needed.")
        samples, returns, stretch = measured
        after = np.append(np.diff(returns), 0.0)
        followed = np.append(np.diff(stretch) == 0, False)
        instants = returns[:, None] + after[:, None] * np.arange(steps) / steps
        present = followed[:, None] | (np.arange(steps) == 0)
        each = np.broadcast_to(stretch[:, None], present.shape)[present]
        names = self.coordinates
        longest = longest_window(names, samples.sampling_rate / self.frequency, steps) * float(np.median(after)) / steps
        values, noise = coordinate_values(samples, names, instants[present], each, self.unit, longest, self.drifts)
        if noise is None:
            raise ValueError(f"steps: must be 1 for stretches too short to determine the noise, got {steps}.")
        signals = np.full((present.size, len(names)), np.nan)
        signals[present.ravel()] = values
        increments = _within(np.diff(signals, axis=0), np.repeat(stretch, steps))
        return wrapped(signals, np.isin(names, self.angles)), increments, noise

    def cycle(self, index: int, period: int, samples: int = CYCLE_SAMPLES) -> dict[str, np.ndarray] | None:
        """Interpolate the measured motion from one point over some returns.

        Parameters
        ----------
        index, period, samples : int
            Position of the first point, number of returns, samples per return.

        Returns
        -------
        dict of str to array (samples·period,), or None
            By channel, over the time from the phase of the section to that phase; angles start in (−π, π] and are
            continuous. None for a section of points alone.

        Raises
        ------
        ValueError
            If the returns are not in one unbroken stretch.
        """
        if self.measured is None:
            return None
        inside = 0 <= index and index + period < len(self)
        recorded, instants, stretch = self.measured
        if not inside or stretch[index] != stretch[index + period]:
            raise ValueError(
                f"index, period: must be a point and a number of returns in one unbroken stretch, got {index!r} and "
                f"{period!r} in {self!r}."
            )
        knots = np.arange(period + 1)
        at = np.interp(np.arange(samples * period) / samples, knots, instants[index : index + period + 1])
        values = local_fit(recorded, at, np.full(samples * period, stretch[index]))[0]
        channels = channels_of(self.coordinates)
        turning = np.isin(channels, self.angles)
        values = values[:, : len(channels)]
        values += np.where(turning, wrapped(values[0]) - values[0], 0.0)
        return dict(zip(channels, values.T, strict=True))

    def __repr__(self) -> str:
        source = "points alone" if self.signals is None else f"a recording of {len(self.signals)} samples"
        if self.stretches is not None:
            source = f"{source.removeprefix('a recording of ')} in {np.unique(self.stretches).size} unbroken stretches"
        lost = f"; {self.left_out} points in gaps left out" if self.left_out else ""
        names = ", ".join(self.coordinates)
        return f"PoincareSection({len(self.points)} points of {names} at {self.frequency:.6g} Hz from {source}{lost})"


def _within(increments: np.ndarray, stretch: np.ndarray) -> np.ndarray:
    """Return increments (count − 1, d) with NaN where the next point (count,) is in another stretch."""
    return np.where((np.diff(stretch) == 0)[:, None], increments, np.nan)
