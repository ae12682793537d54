"""Recordings: measured signals over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesperiodic import _checks
from bayesperiodic._linalg import one_thread
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.folding import AUTO, automatic_periods, fold_signals, given_frequency
from bayesperiodic.data.from_file import FromFile
from bayesperiodic.data.inspection import inspect, summary
from bayesperiodic.data.layout import without_missing
from bayesperiodic.data.recording_check import RecordingCheck
from bayesperiodic.data.signals import parts
from bayesperiodic.data.times import channel_seconds, seconds


@dataclass(frozen=True, repr=False)
class Recording(FromFile):
    """Signals measured at the same times.

    Attributes
    ----------
    time : array (samples,)
        Strictly increasing times [s]; the steps need not be equal. Dates and durations are converted as by
        `from_arrays`.
    outputs, inputs : dict of str to array (samples,)
    name : str
    synthetic : bool
        True if the recording was simulated.
    units : dict of str to str, optional
        Units of channels, as far as they are known, such as those of a file. A `Problem` refuses a channel whose unit
        is known to differ from that in its model's ``units``.

    Raises
    ------
    ValueError
        For fewer than two samples, samples that are masked, NaN or infinite, or of sizes outside 1e-100 to 1e100,
        different lengths, a time that does not increase, no output, names that are repeated or not identifiers.

    Examples
    --------
    >>> t = np.arange(0, 60, 0.01)
    >>> recording = bp.Recording.from_arrays(t, {"angle": np.sin(2 * np.pi * 1.3 * t)}, name="swing")
    >>> recording.between(10, 50)
    Recording('swing': recording of 4001 samples at 100 Hz, inputs [], outputs ['angle'])
    >>> experiment = recording.fold(samples=64)
    >>> print(f"{experiment.cycles} cycles at {experiment.frequency:.6f} Hz")
    78 cycles at 1.300000 Hz
    """

    @classmethod
    def from_arrays(
        cls,
        time: Any,
        outputs: Mapping[str, Any],
        inputs: Mapping[str, Any] | None = None,
        *,
        missing: str | None = None,
        name: str | None = None,
    ) -> "Recording":
        """Make a recording from arrays, pandas Series or xarray DataArrays.

        Parameters
        ----------
        time : array (samples,)
            Strictly increasing times [s], or dates or durations: datetime64 and timedelta64 of any resolution, pandas
            and xarray objects, Python's datetime and timedelta, texts after ISO 8601. Dates and durations are converted
            to seconds from the first sample, without a loss of precision. Dates with a time zone are compared in UTC,
            those without are taken as UTC. Integers that are no seconds by their size (as milliseconds since 1970) or
            their steps (as microseconds) are refused.
        outputs, inputs : mapping of str to array (samples,)
            Values in the units of the model's channels.
        missing : "drop" or "interpolate", optional
            What to do with missing samples (NaN, masked values, pandas' NA, NaT), which are refused by default: leave
            them out of their channel, or interpolate linearly in time over at most three successive ones.
        name : str, optional
            By default "recording".

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            As for `Recording`, and for missing samples without `missing`.

        Examples
        --------
        >>> dates = np.datetime64("2026-01-31T12:00:00.000") + np.arange(500) * np.timedelta64(20, "ms")
        >>> angle = np.sin(2 * np.pi * np.arange(500) / 50)
        >>> angle[100:103] = np.nan
        >>> run = bp.Recording.from_arrays(dates, {"angle": angle}, missing="drop")
        >>> print(run.time[:3], run.time.size)
        [0.   0.02 0.04] 497
        """
        channels = {
            f"{kind}[{key!r}]": (kind, key, values)
            for kind, given in (("outputs", outputs), ("inputs", {} if inputs is None else inputs))
            for key, values in _checks.mapping(kind, given, "{'force': values}").items()
        }
        if isinstance(time, Mapping):
            _checks.same_names("time", time, [key for _, key, _ in channels.values()])
            by_channel = channel_seconds(time)
            at: Any = {argument: by_channel[key] for argument, (_, key, _) in channels.items()}
        else:
            at = _checks.real_array("time", seconds("time", time))
        arrays = {argument: _checks.real_array(argument, values) for argument, (*_, values) in channels.items()}
        times, present = without_missing("time", at, arrays, missing)
        signals: dict[str, dict[str, np.ndarray]] = {"outputs": {}, "inputs": {}}
        for argument, (kind, key, _) in channels.items():
            signals[kind][key] = present[argument]
        if isinstance(times, dict):
            times = {channels[argument][1]: values for argument, values in times.items()}
        return cls(times, signals["outputs"], signals["inputs"], name or "recording")

    @classmethod
    def join(cls, *recordings: "Recording", name: str | None = None) -> "Recording":
        """Return one recording of the channels of several, such as of different files, each with its own times.

        Parameters
        ----------
        *recordings : Recording
            With different channels. Their times must be counted from one instant; dates are counted from the first
            sample of each, so that recordings read from files with dates are joined by `from_arrays`.
        name : str, optional
            By default that of the first.

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            For no recording, or a channel that two of them have.

        Examples
        --------
        >>> fast, slow = np.arange(0, 20, 1e-3), np.arange(0.137, 19.5, 1 / 97)
        >>> force = bp.Recording.from_arrays(fast, {"force": np.cos(6 * np.pi * fast)})
        >>> x = bp.Recording.from_arrays(slow, {"x": 0.1 * np.sin(6 * np.pi * slow)})
        >>> bp.Recording.join(force, x, name="run 1")
        Recording('run 1': recording of outputs ['force'] (20000 samples at 1000 Hz), ['x'] (1879 samples at 97 Hz))
        """
        for recording in recordings:
            _checks.instance("recordings", recording, Recording)
        if not recordings:
            raise ValueError("recordings: must be one or more, got none.")
        _checks.identifiers("channels", [channel for one in recordings for channel in one.times])
        outputs = {channel: values for one in recordings for channel, values in one.outputs.items()}
        inputs = {channel: values for one in recordings for channel, values in one.inputs.items()}
        times = {channel: time for one in recordings for channel, time in one.times.items()}
        units = {channel: unit for one in recordings for channel, unit in one.units.items()}
        return cls(times, outputs, inputs, name or recordings[0].name, any(one.synthetic for one in recordings), units)

    def between(self, start: float, stop: float) -> "Recording":
        """Return the part with start ≤ time ≤ stop.

        Parameters
        ----------
        start, stop : float
            Times [s].

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            If fewer than two samples remain.
        """
        first, last = _checks.real_array("start, stop", [start, stop])
        keep = self._by_time(lambda time: (time >= first) & (time <= last))
        if any(np.count_nonzero(kept) < 2 for kept in keep.values()):
            every = self.times.values()
            raise ValueError(
                f"start, stop: must select at least two samples between {max(time[0] for time in every):g} and "
                f"{min(time[-1] for time in every):g} s, got {start!r}, {stop!r}."
            )
        return self._part(keep, self.name)

    def check(self, frequency: float | None = None, *, periods: int = 1) -> RecordingCheck:
        """Look for faults of the sensors and the clock, and for the steady part.

        Samples: values that wrap at the range of a sensor (2π, 360, 1, or a power of two of its steps), stuck and
        clipped stretches, outliers (more than eight standard deviations from the mean period, with jumps before and
        after, not in every cycle), gaps. Cycles: ramps, the rest of a transient, steps of amplitude and phase, slow
        changes, beating. `fold` makes the same check, leaves ramps and transients out, warns of serious findings and
        refuses ruinous ones.

        The rest of a transient is exp(−t/T) times a cosine with unknown T and frequency in all channels; cycles are
        left out until its expected bias of all amplitudes together is below 0.3 standard errors, at most half of them,
        and what remains is added to ``amplitude_variance``.

        Parameters
        ----------
        frequency : float, optional
            Forcing frequency [Hz]; by default it is estimated.
        periods : int
            Forcing periods per response period.

        Returns
        -------
        RecordingCheck

        Raises
        ------
        ValueError
            For a frequency or periods ≤ 0.

        Examples
        --------
        >>> t = np.arange(0, 60, 0.01)
        >>> angle = 0.3 + 0.1 * np.cos(2 * np.pi * t)
        >>> angle[1000:1003] = 6.283
        >>> check = bp.Recording.from_arrays(t, {"angle": angle}).check()
        >>> check.findings[0].kind, check.findings[0].count
        ('outliers', 3)
        """
        if frequency is not None:
            _checks.positive("frequency", frequency)
        still = {c: v[0] for c, v in (self.inputs | self.outputs).items() if np.ptp(v) == 0.0}
        groups = self._groups(without=still)
        points = max(time.size for time in self.times.values())
        with one_thread():
            seen = inspect(groups, _checks.integer("periods", periods, 1), frequency, points)
        return summary(self.name, self.inputs | self.outputs, seen, still)

    def steady(self, frequency: float | None = None, *, periods: int = 1) -> "Recording":
        """Return the steady part that `fold` uses, as `check` finds it.

        Parameters
        ----------
        frequency, periods
            As for `check`.

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            If there is none.
        """
        check = self.check(frequency, periods=periods)
        if check.reason:
            raise ValueError(check.reason)
        return self.between(check.start, check.stop)

    def without(
        self,
        *,
        outliers: bool | ArrayLike = False,
        stuck: bool | ArrayLike = False,
        clipped: bool | ArrayLike = False,
        channel: str | None = None,
        frequency: float | None = None,
    ) -> "Recording":
        """Return the recording without faulty samples, which are left out of all channels and not filled.

        Parameters
        ----------
        outliers, stuck, clipped : bool or bool array (samples,)
            True for those that `check` finds, or a mask of the samples to leave out.
        channel : str, optional
            The channel whose faults count; by default all.
        frequency : float, optional
            As for `check`.

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            For an unknown channel, a mask of another shape, or if fewer than two samples remain.
        """
        times = self.times
        if channel is not None:
            _checks.one_of("channel", channel, times)
        wanted = {"outliers": outliers, "stuck": stuck, "clipped": clipped}
        bad = self._by_time(lambda time: np.zeros(time.size, dtype=bool))
        known = self.check(frequency).bad if any(value is True for value in wanted.values()) else {}
        for kind, value in wanted.items():
            for name in [name for name in known if value is True and channel in (None, name)]:
                bad[name][known[name][kind]] = True
            if isinstance(value, bool):
                continue
            mask, (name, *others) = (
                np.asarray(value),
                [channel] if channel else [*{id(v): c for c, v in bad.items()}.values()],
            )
            if others or mask.dtype != bool or mask.shape != bad[name].shape:
                shape = f"of shape {bad[name].shape}" if not others else "with `channel`, whose samples it marks"
                raise ValueError(
                    f"{kind}: must be True, False or a bool array {shape}, got {mask.dtype} of shape {mask.shape}."
                )
            bad[name] |= mask
        if any(np.count_nonzero(~mask) < 2 for mask in bad.values()):
            raise ValueError(f"recording: must have at least two sound samples, got none or one in {self.name!r}.")
        keep = {id(mask): ~mask for mask in bad.values()}
        return self._part({name: keep[id(mask)] for name, mask in bad.items()}, self.name)

    def unwrapped(self, channel: str, period: float = 2.0 * np.pi) -> "Recording":
        """Return the recording with a channel whose jumps by multiples of a range are removed.

        Parameters
        ----------
        channel : str
        period : float
            The range at which the sensor wraps, in the channel's unit.

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            For an unknown channel or a range ≤ 0.
        """
        _checks.one_of("channel", channel, self.inputs | self.outputs)
        period = _checks.positive("period", period)

        def cured(kind: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {name: np.unwrap(v, period=period) if name == channel else v for name, v in kind.items()}

        return replace(self, outputs=cured(self.outputs), inputs=cured(self.inputs))

    def split(self) -> "list[Recording]":
        """Divide the recording at gaps and at steps of the frequency of the first input (or output, without inputs).

        A gap is a step of time of more than a quarter of a period. The frequency steps where the period, between
        upward crossings of the mean, changes by more than 0.1 % and eight standard errors.

        Returns
        -------
        list of Recording
            The parts of at least three cycles, in their order.

        Raises
        ------
        ValueError
            If no part has three cycles.

        Examples
        --------
        >>> t = np.arange(0, 60, 0.01)
        >>> force = np.where(t < 30, np.sin(2 * np.pi * t), np.sin(2 * np.pi * 1.5 * t))
        >>> runs = bp.Recording.from_arrays(t, {"x": 0.1 * force}, {"force": force}, name="sweep").split()
        >>> [f"{run.name}: {run.fold(32).frequency:.2f} Hz" for run in runs]
        ['sweep 1: 1.00 Hz', 'sweep 2: 1.50 Hz']
        """
        channel, values = next(iter((self.inputs or self.outputs).items()))
        time = self.times[channel]
        pieces = parts(time, values)
        if not pieces:
            raise ValueError(f"recording: must have a part of at least three cycles, got none in {self.name!r}.")
        if len(pieces) == 1 and pieces[0] == slice(0, time.size):
            return [self]
        # Other times are divided where those of this channel are.
        edges = [(time[p.start] if p.start else -np.inf, np.append(time, np.inf)[p.stop]) for p in pieces]
        names = [f"{self.name} {i}" for i in range(1, len(pieces) + 1)] if len(pieces) > 1 else [self.name]
        return [
            self._part(self._by_time(partial(_between, first=first, stop=stop)), name)
            for (first, stop), name in zip(edges, names, strict=True)
        ]

    def fold(
        self,
        samples: int = 800,
        *,
        frequency: float | tuple[float, float] | None = None,
        periods: int | str = 1,
        harmonics: int | Mapping[str, int] | None = None,
        origin: float | str = 0.0,
        largest_drift: float | None = None,
        clocks: str | Mapping[str, Sequence[str]] | None = None,
        guess: str | Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> Experiment:
        """Fold the steady part of the recording into its mean period on an equidistant grid.

        The whole cycles after the transient are used. The fundamental frequency is estimated by least squares over all
        of them. The mean period is a least-squares Fourier series of the samples, at any times that cover its phases.

        The variance of the mean's amplitudes is measured harmonic by harmonic. The spectrum of K cycles has lines at
        multiples of 1/K of the fundamental, and those between the harmonics contain noise only; the variance at a
        harmonic is the mean power of the nearest K/4 lines (from 4 to 16, at most K/2) on each side. The variance of
        harmonic 0 is extrapolated from the lines above it, as that of white, exponentially correlated or 1/f noise,
        whichever explains them. Noise that lasts longer than the recording cannot be told from the mean value.
        Values that are multiples of one step have quantisation errors, but for two levels that change at the same
        phases in every cycle, as those of a square wave; the part of them that repeats in every cycle, and that no
        average removes, is added.

        Parameters
        ----------
        samples : int
            Grid points per forcing period.
        frequency : float or (float, float), optional
            Exact forcing frequency [Hz], or a frequency and its standard error. By default it is estimated; its
            standard error is that of noise, and of a random walk of the phase where the cycles show one. A value that
            differs from the estimate significantly (false-alarm rate 1e-4) and by a drift of more than one degree of
            phase over the cycles used is refused.
        periods : int or "auto"
            Forcing periods per response period. "auto" tests 1 to 8, as far as the recording has three cycles of them,
            and stores the evidence in ``Experiment.period_test``. A period is refused where more than 0.5 % of a
            channel's variance is between the lines of its spectrum, noise apart that is as strong above half of the
            resolved band. Of the others the longest one is taken whose lines are all needed: those that its divisors
            lack are not chance (F-tests against the lines beside them, with a false-alarm rate of 1 % over all
            periods), have 20 times the power of their neighbours, together 1e-4 of a channel's variance, do not fade
            in the later half, and are not those of the mains or aliases of the drive's harmonics. If there is
            none, the later half is tested, with at least six cycles. Without ``frequency``, the drive period is that of
            the inputs.
        harmonics : int or mapping of str to int, optional
            Harmonics of the response period to keep, for all channels or by channel. By default each channel keeps all
            harmonics up to the last one that is significant relative to the noise around it: an F-test on the
            squared amplitude, with a false-alarm rate of 1 % over all harmonics tested.
        origin : float or "crossing"
            Time [s] at which τ = 0. "crossing", for autonomous systems, whose phase is arbitrary: the first time >= 0
            at which the fundamental of the first output crosses zero upwards.
        largest_drift : float, optional
            Limit of the relative change of a channel's strongest harmonic over the recording, by linear regression.
        clocks : "one", "auto" or mapping of str to sequence of str, optional
            Channels that other clocks have sampled, such as ``{"logger 2": ["x"]}``; the others have the first clock,
            whose frequency is that of the experiment. Each clock's channels are folded at its own frequency, and their
            delay, which is unknown, must be a parameter of the `Problem`. By default channels whose phases drift
            steadily against the first one are refused; "one" states that all have one clock, and only warns; "auto"
            gives those that drift clocks of their own.
        guess : "data" or mapping of str to array (samples·periods,), optional
            See `Experiment`.
        name : str, optional
            By default the recording's name.

        Returns
        -------
        Experiment
            The mean period on samples·periods grid points, and its uncertainty.

        Raises
        ------
        ValueError
            For fewer than three cycles, a constant channel, a signal that is not periodic, ``periods="auto"`` without
            frequency and inputs, samples at too few phases, an estimated frequency that has aliases, a frequency
            that is not that of the recording, more harmonics than the samples resolve, an unknown channel in
            `harmonics` or `clocks`, a drift beyond the limit, clocks that differ, or samples lost by one of the
            channels, so many that its phase is wrong by more than 0.05 rad.

        Warns
        -----
        UserWarning
            If the period drifts by more than noise explains, not more than half of the cycles are used, or a finding of
            `check` is serious.

        Examples
        --------
        The displacement of an oscillator with noise of 0.1 mm; forcing and sampling rate are incommensurate:

        >>> recording = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1,
        ...                         duration=400, sampling_rate=9.7, noise={"displacement": 1e-4}, seed=1)
        >>> run = recording.fold(samples=64, harmonics={"displacement": 9}, name="run 1")
        >>> print(f"{run.frequency:.4f} Hz, {run.independent['displacement']} independent values")
        0.1000 Hz, 19 independent values

        The response period of a period-doubled oscillator:

        >>> t = np.arange(0, 30, 0.02)
        >>> drive, x = np.cos(2 * np.pi * t), np.cos(2 * np.pi * t) + 0.3 * np.cos(np.pi * t)
        >>> doubled = bp.Recording.from_arrays(t, {"x": x.round(2)}, {"force": drive}).fold(64, periods="auto")
        >>> doubled.periods, doubled.period_test.verdict.tolist()[:2]
        (2, ['not periodic', 'chosen'])
        """
        samples = _checks.integer("samples", samples, 4)
        groups, evidence, given = self._groups(), None, given_frequency(frequency)
        try:
            if periods == AUTO:
                periods, evidence = automatic_periods(groups, given and given[0])
            periods = _checks.integer("periods", periods, 1)
            with one_thread():
                folded = fold_signals(groups, samples, periods, given, harmonics, origin, largest_drift, clocks)
        except np.linalg.LinAlgError:
            raise ValueError(
                f"recording: must have samples in all parts of its periods, got {self.name!r}, which has too few; "
                "check the frequency and the gaps, or fold a part by `between` or `split`."
            ) from None
        for kind, channels in (("outputs", self.outputs), ("inputs", self.inputs)):
            folded[kind] = {channel: folded[kind][channel] for channel in channels}
        more: dict[str, Any] = {"synthetic": self.synthetic, "units": self.units, "guess": guess or {}}
        return Experiment(name or self.name, period_test=evidence, **more, **folded)


def _between(time: np.ndarray, first: float, stop: float) -> slice:
    return slice(*np.searchsorted(time, [first, stop]).tolist())
