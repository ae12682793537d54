"""Estimation of the mean steady period of sampled signals, and of its uncertainty; division of records of several."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc, fdtrc, softmax

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.faults import ChannelFaults, jumps, outliers_of
from bayesperiodic.data.harmonics import (
    MINIMUM_CYCLES,
    NEGLIGIBLE_PHASE,
    HarmonicFit,
    Pace,
    fit_harmonics,
    guess_frequency,
    refine_frequency,
    resolved_harmonics,
    track_frequency,
)
from bayesperiodic.data.quantisation import REPEATED_FREEDOM, repeated_variance
from bayesperiodic.data.recording_check import (
    SEVERITIES,
    WRAPS,
    Finding,
    RecordingCheck,
    bounded,
    clock_findings,
    cycle_findings,
    refuse,
    sample_findings,
    signal_faults,
)
from bayesperiodic.data.response_period import FALSE_ALARM_RATE, FINENESS, aperiodic, even_times, response_period
from bayesperiodic.data.steadiness import Steady, Windows, steady_part, windows

if TYPE_CHECKING:
    import pandas as pd

# Steps of time that are gaps, in periods, if they are longer than so many usual steps; if the period is unknown,
# in usual steps.
GAP, USUAL_STEPS, MANY_STEPS = 0.25, 3.0, 30.0
# Spreads of a channel whose squares and inverse squares are ordinary numbers, and grid points of a response period.
MAXIMUM_POINTS = 1_000_000
# A crossing counts after the signal was below minus this fraction of its standard deviation.
HYSTERESIS = 0.25
# Smallest relative step of the period, in itself and in standard errors.
SMALLEST_PERIOD_STEP, SIGNIFICANT_PERIOD_STEP = 1e-3, 8.0
MINIMUM_PERIODICITY = 0.5
# Ratio of residual variances from which the estimated frequency is right, and the given one wrong.
CLEARLY = 4.0
# Difference of two phases [cycles] at the ends of a recording that selects other cycles.
OTHER_CYCLES = 0.05
# Largest relative change of an amplitude within half of a steady part.
LARGEST_CHANGE = 0.1
# Harmonics of the first mean period, from which outliers are left out.
ROUGH_HARMONICS = 40
# Response cycles of the later half of a recording that show a period which the whole has not.
LATER_CYCLES = 6
CROSSING, AUTO = "crossing", "auto"

# The spectrum of the noise: grid points a cycle if there are not many harmonics; neighbouring lines on each side of a
# harmonic.
FINEST, NEIGHBOURING_LINES = 1 << 14, 16
# Neighbouring harmonics on each side with which variances and slopes of one are averaged.
POOLED = 2
# Lines from which frequency zero is extrapolated: for the kind of noise, and for the level of white and slow noise.
LINES_NEAR_ZERO, WHITE_LINES, SLOW_LINES = 40, 8, 2
# Correlation times in recording lengths, white floors relative to line 1, and line 0 of 1/f noise relative to line 1
# if its spectrum is flat below a quarter of a line.
CORRELATION_TIMES, FLOORS, ZERO_OF_PINK = (0.45, 0.1, 0.05, 0.025), (0.0, 0.01, 0.1), 2.75


@dataclass(frozen=True)
class Signals:
    """Channels sampled at the same times."""

    name: str  # of the recording, for messages
    time: np.ndarray  # (samples,)
    channels: tuple[str, ...]  # inputs first
    values: np.ndarray  # (channels, samples)
    inputs: int  # number of inputs

    def __post_init__(self) -> None:
        for i, (channel, values) in enumerate(zip(self.channels, self.values, strict=True)):
            if np.ptp(values) == 0.0:
                kind, remedy = "outputs", ""
                if i < self.inputs:
                    kind, remedy = "inputs", ", and write it in the model as a parameter with its value in `fixed`"
                raise ValueError(
                    f"{kind}[{channel!r}]: must vary, got the constant {values[0]:g}; leave the channel out{remedy}."
                )

    def part(self, samples: np.ndarray | slice) -> "Signals":
        """Return the signals at the selected samples."""
        return replace(self, time=self.time[samples], values=self.values[:, samples])


def fold_signals(
    signals: Signals,
    samples: int,
    periods: int,
    frequency: float | None,
    harmonics: int | Mapping[str, int] | None,
    origin: float | str,
    largest_drift: float | None,
) -> dict[str, Any]:
    """Return the arguments of the `Experiment` of the mean period of the steady part; see `Recording.fold`."""
    points = samples * periods
    if points > MAXIMUM_POINTS:
        raise ValueError(f"samples: must be at most {MAXIMUM_POINTS // periods} for {periods} periods, got {samples}.")
    if isinstance(origin, str) and origin != CROSSING:
        raise ValueError(f"origin: must be a time [s] or {CROSSING!r}, got {origin!r}.")
    start = 0.0 if origin == CROSSING else _checks.finite_number("origin", origin)
    seen = inspect(replace(signals, time=signals.time - start), periods, frequency, points)
    if seen.steady is None or seen.fit is None:
        raise ValueError(seen.reason)
    refuse(signals.name, seen.findings)
    fit, pace, limit = seen.fit, seen.pace, seen.limit
    steady = seen.signals.part(seen.steady.samples)
    if frequency is not None:
        estimated, fit = fit, fit_harmonics(steady.time, steady.values, frequency / periods, limit)
        _refuse_frequency(estimated, fit, pace, float(np.ptp(steady.time)), periods)
    drift = dict(zip(signals.channels, _drift(seen.steady.part.sizes), strict=True))
    _refuse_drift(signals.name, drift, largest_drift)
    periodicity = _periodicity(steady, fit)
    cycles = round(np.ptp(steady.time) * fit.frequency)
    _warn(signals.name, pace, cycles, seen.total)
    one_cycle, noise = zip(*(_noise(steady, fit, row, cycles) for row in range(len(steady.values))), strict=True)
    for row, squares in enumerate(seen.steady.squares):
        order = min(squares.size, noise[row].variance.size)
        noise[row].variance[:order] += (squares * np.var(seen.signals.values[row]))[:order]
    significant = [_last_significant(a, part) for a, part in zip(fit.amplitudes, noise, strict=True)]
    kept = dict(zip(signals.channels, significant, strict=True)) | _chosen(harmonics, signals.channels, limit)
    amplitudes = fit.amplitudes
    if origin == CROSSING:
        # The first time ≥ 0 at which the fundamental of the first output crosses zero upwards.
        phase = np.angle(amplitudes[signals.inputs, 1]) / (2 * np.pi)
        start = float((-0.25 - phase) % 1.0 / fit.frequency)
        amplitudes = amplitudes * np.exp(2j * np.pi * fit.frequency * start * np.arange(amplitudes.shape[1]))
    used = [slice(kept[channel] + 1) for channel in signals.channels]

    def by_channel(values: Iterable[Any]) -> dict[str, Any]:
        return dict(zip(signals.channels, values, strict=True))

    folded = by_channel(_fourier.on_grid(a[part], points) for a, part in zip(amplitudes, used, strict=True))
    inputs, outputs = signals.channels[: signals.inputs], signals.channels[signals.inputs :]
    return {
        "frequency": fit.frequency * periods,
        "frequency_se": pace.se * periods if frequency is None else 0.0,
        "period_drift": -pace.drift,
        "outputs": {channel: folded[channel] for channel in outputs},
        "inputs": {channel: folded[channel] for channel in inputs},
        "samples": samples,
        "periods": periods,
        "cycles": cycles,
        "averaged": steady.time.size,
        "scatter": by_channel(float(np.sqrt(_power(v[part]))) for v, part in zip(one_cycle, used, strict=True)),
        "independent": {channel: min(2 * kept[channel] + 1, steady.time.size) for channel in outputs},
        "harmonics": kept,
        "amplitude_variance": by_channel(v.variance[part] for v, part in zip(noise, used, strict=True)),
        "amplitude_freedom": by_channel(v.freedom[part] for v, part in zip(noise, used, strict=True)),
        "error_slopes": _error_slopes(by_channel(noise), inputs, kept),
        "periodicity": periodicity,
        "drift": drift,
        "origin": start,
        "findings": seen.findings,
    }


@dataclass(frozen=True)
class Inspection:
    """Faults, steady part and mean period of signals."""

    signals: Signals
    faults: list[ChannelFaults]
    findings: tuple[Finding, ...]
    total: int = 0  # whole cycles
    steady: Steady | None = None
    fit: HarmonicFit | None = None  # of the steady part, at the estimated frequency
    pace: Pace = Pace(0.0, 0, 0.0, False)
    limit: int = 0  # of the harmonics
    reason: str = ""  # why there is no steady part or no mean period


def inspect(signals: Signals, periods: int, frequency: float | None, points: int) -> Inspection:
    """Return what signals are like; without a steady part or a mean period, the reason."""
    faults = [signal_faults(values) for values in signals.values]

    def found(rate: float | None, limit: int = 0, used: slice = slice(0, signals.time.size)) -> list[Finding]:
        rows = zip(signals.channels, signals.values, faults, strict=True)
        every = [f for c, v, fault in rows for f in sample_findings(c, signals.time, v, fault, rate, limit, used)]
        return every + [*clock_findings(signals.time, rate)]

    def sorted_(findings: list[Finding]) -> tuple[Finding, ...]:
        return tuple(sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity)))

    if any(fault.wrap for fault in faults):
        return Inspection(signals, faults, sorted_(found(None)), reason=_wrapped(signals.name, found(None)))
    moving = np.ones(signals.time.size, dtype=bool)
    for fault in faults:
        for part in fault.stuck:
            moving[part] = False
    calm = replace(signals, values=bounded(signals.values))
    calm = calm if moving.all() else calm.part(np.flatnonzero(moving))
    try:
        fundamental = _first_guess(calm, frequency, periods)
        _refuse_gaps(signals, fundamental)
        tracked = _tracked(calm, fundamental, frequency is not None)
    except ValueError as error:
        return Inspection(signals, faults, sorted_(found(None)), reason=str(error))
    total = int(_cycles(signals.time, tracked))
    sound = _sound(signals, calm, faults, np.flatnonzero(moving), tracked, points)
    some = signals if sound.size == signals.time.size else signals.part(sound)
    every = windows(some.time, some.values, tracked)
    steady = steady_part(every)
    if steady is not None and frequency is None and steady.level != (0, sound.size):
        # The frequency of a part that ramps is not that of the steady one.
        part = some.part(steady.samples)
        few = min(ROUGH_HARMONICS, resolved_harmonics(part.time, tracked, points))
        tracked = refine_frequency(part.time, part.values, tracked, few)[0].frequency
        every = windows(some.time, some.values, tracked)
        steady = steady_part(every)
    if steady is None or np.abs(steady.change).max(initial=0.0) > LARGEST_CHANGE:
        return Inspection(signals, faults, sorted_(found(tracked)), total, reason=_unsteady(signals, every))
    steady = steady.among(sound)
    used = signals.part(steady.samples)
    limit = resolved_harmonics(used.time, tracked, points)
    fit, pace = refine_frequency(used.time, used.values, tracked, limit)
    residuals = fit.residuals
    here = sound[(sound >= steady.samples.start) & (sound < steady.samples.stop)]
    if here.size < used.time.size:
        near = fit_harmonics(signals.time[here], signals.values[:, here], tracked, limit).amplitudes
        residuals = used.values - _fourier.at_times(near, tracked * used.time)
    for fault, rest, values in zip(faults, residuals, used.values, strict=True):
        place = outliers_of(rest, used.time * fit.frequency, values, fault.step)
        fault.outliers = place + steady.samples.start
    findings = found(fit.frequency, limit, steady.samples)
    findings += cycle_findings(signals.channels, signals.time, steady, fit.frequency, total)
    return Inspection(signals, faults, sorted_(findings), total, steady, fit, pace, limit)


def _wrapped(name: str, findings: list[Finding]) -> str:
    return f"recording: must be without wraps, got {name!r}: {'. '.join(str(f) for f in findings if f.kind == WRAPS)}."


def _sound(
    signals: Signals, calm: Signals, faults: list[ChannelFaults], moving: np.ndarray, fundamental: float, points: int
) -> np.ndarray:
    """Return the numbers of the samples without outliers from a first mean period, of those that are not stuck."""
    if not jumps(signals.values):
        return moving
    limit = min(resolved_harmonics(calm.time, fundamental, points), ROUGH_HARMONICS)
    fit = fit_harmonics(calm.time, calm.values, fundamental, limit)
    bad = np.zeros(moving.size, dtype=bool)
    for fault, values, near, rest in zip(faults, signals.values[:, moving], calm.values, fit.residuals, strict=True):
        bad[outliers_of(values - near + rest, calm.time * fundamental, values, fault.step)] = True
    return moving[~bad]


def _unsteady(signals: Signals, every: Windows) -> str:
    size = every.sizes
    worst = int(np.argmax(np.ptp(size, axis=0) / size.mean(axis=0)))
    low, high = size[:, worst].min(), size[:, worst].max()
    return (
        f"recording: must have a steady part of {MINIMUM_CYCLES} cycles, got {signals.name!r}, in which the amplitude of "
        f"{signals.channels[worst]!r} changes between {low / high:.0%} and 100 % of its largest value throughout; record "
        "at a constant amplitude, or select a part by `between`."
    )


def summary(name: str, seen: Inspection) -> RecordingCheck:
    """Return what was seen as the result of `Recording.check`."""
    import pandas as pd

    time, part = seen.signals.time, seen.steady
    bad = {
        channel: {
            "outliers": fault.outliers,
            "stuck": np.concatenate([np.arange(s.start, s.stop) for s in fault.stuck] or [np.zeros(0, dtype=int)]),
            "clipped": np.concatenate([fault.low, fault.high]),
        }
        for channel, fault in zip(seen.signals.channels, seen.faults, strict=True)
    }
    named = {(finding.channel, finding.kind) for finding in seen.findings}
    bad = {c: {kind: v if (c, kind) in named else v[:0] for kind, v in each.items()} for c, each in bad.items()}
    rows = [
        {
            "lowest": values.min(),
            "highest": values.max(),
            "resolution": fault.step,
            "bits": np.log2(np.ptp(values) / fault.step + 1.0) if fault.step else np.nan,
            **{kind: places.size for kind, places in bad[channel].items()},
            "wraps": fault.wraps.size,
        }
        for channel, values, fault in zip(seen.signals.channels, seen.signals.values, seen.faults, strict=True)
    ]
    step = np.diff(time)
    step = step[step <= USUAL_STEPS * np.median(step)]
    return RecordingCheck(
        name,
        pd.DataFrame(rows, index=[*seen.signals.channels]),
        seen.findings,
        seen.fit.frequency if seen.fit else np.nan,
        round(np.ptp(time[part.samples]) * seen.fit.frequency) if part and seen.fit else 0,
        seen.total,
        float(time[part.samples.start]) if part else float(time[0]),
        float(time[part.samples.stop - 1]) if part else float(time[-1]),
        float(step.std() / np.median(step)),
        bad,
        seen.reason,
    )


def automatic_periods(signals: Signals, frequency: float | None) -> "tuple[int, pd.DataFrame]":
    """Return the response period in drive periods, and its evidence, of the signals or else of their later half."""
    if frequency is None and not signals.inputs:
        raise ValueError(
            f"frequency: must be given for periods={AUTO!r}, because {signals.name!r} has no input that shows the "
            "drive period, got None."
        )
    drive = _first_guess(signals, frequency, 1)
    _refuse_gaps(signals, drive)
    time, values = signals.time, signals.values
    if frequency is None:
        driven = values[: signals.inputs]
        tracked = track_frequency(time, driven, drive)
        time = even_times(time, driven, tracked)
        drive = refine_frequency(time, driven, tracked, resolved_harmonics(time, tracked, time.size))[0].frequency
    time = even_times(time, values, drive)
    chosen, evidence = response_period(time, values, signals.channels, drive)
    later = time >= 0.5 * (time[0] + time[-1])
    if chosen is None and _cycles(time[later], drive) >= LATER_CYCLES:
        chosen, again = response_period(time[later], values[:, later], signals.channels, drive, LATER_CYCLES)
        evidence = evidence if chosen is None else again
    if chosen is None:
        raise aperiodic(signals.name, drive, evidence)
    return chosen, evidence


def _first_guess(signals: Signals, frequency: float | None, periods: int) -> float:
    remedy = "give the forcing frequency"
    time, values = _longest_stretch(signals)
    if frequency is not None:
        fundamental: float | None = _checks.positive("frequency", frequency) / periods
        remedy = f"check frequency = {frequency!r} Hz and periods = {periods}"
    elif signals.inputs:
        guess = guess_frequency(time, values[: signals.inputs])
        fundamental = guess / periods if guess else None
    else:
        fundamental = guess_frequency(time, values)
    if fundamental is None or _cycles(signals.time, fundamental) < MINIMUM_CYCLES:
        period = "no period" if fundamental is None else f"{_cycles(signals.time, fundamental):.2f} cycles"
        raise ValueError(
            f"recording: must have at least {MINIMUM_CYCLES} cycles, got {period} in {signals.name!r} of "
            f"{np.ptp(signals.time):g} s; record longer, or {remedy}."
        )
    return fundamental


def _longest_stretch(signals: Signals) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and values of the longest part without gaps of many steps."""
    step = np.diff(signals.time)
    edges = np.concatenate([[0], np.flatnonzero(step > MANY_STEPS * np.median(step)) + 1, [signals.time.size]])
    longest = int(np.argmax(np.diff(edges)))
    part = slice(edges[longest], edges[longest + 1])
    return signals.time[part], signals.values[:, part]


def _cycles(time: np.ndarray, fundamental: float) -> float:
    """Return the number of cycles, the last sample's step included."""
    return float(np.ptp(time) * time.size / (time.size - 1) * fundamental * (1 + 1e-9))


def gaps(time: np.ndarray, period: float) -> np.ndarray:
    """Return the last samples before gaps."""
    step = np.diff(time)
    return np.flatnonzero(step > max(GAP * period, USUAL_STEPS * np.median(step)))


def _refuse_gaps(signals: Signals, fundamental: float) -> None:
    if (ends := gaps(signals.time, 1.0 / fundamental)).size:
        first, last = signals.time[ends[0]], signals.time[ends[0] + 1]
        raise ValueError(
            f"recording: must have no gap longer than {GAP:g} periods, got {signals.name!r} without samples from "
            f"{first:g} to {last:g} s (period {1.0 / fundamental:g} s); fold the parts that `split` returns."
        )


def _tracked(signals: Signals, fundamental: float, given: bool) -> float:
    """Return the frequency by which cycles are compared: the estimated one, if the given one is clearly another one."""
    time, values = signals.time, signals.values
    tracked = track_frequency(time, values, fundamental)
    if given:
        few = min(10, resolved_harmonics(time, max(tracked, fundamental), time.size))
        near = abs(tracked - fundamental) * np.ptp(time) < OTHER_CYCLES
        if near or not _explains_more(*(fit_harmonics(time, values, rate, few) for rate in (tracked, fundamental))):
            return fundamental
    if (cycles := _cycles(time, tracked)) < MINIMUM_CYCLES:
        raise ValueError(
            f"recording: must have at least {MINIMUM_CYCLES} cycles, got {cycles:.2f} cycles of {tracked:.6g} Hz in "
            f"{signals.name!r}; record longer."
        )
    return tracked


def _explains_more(fit: HarmonicFit, other: HarmonicFit) -> bool:
    return bool(np.sum(np.log(fit.variances / other.variances)) < 0.0)


def _refuse_frequency(estimated: HarmonicFit, given: HarmonicFit, pace: Pace, duration: float, periods: int) -> None:
    """Raise a ValueError if the given frequency is not that of the recording."""
    difference = given.frequency - estimated.frequency
    # Few cycles have too few degrees of freedom for a test, but noise of any kind would not shrink so much.
    shrinks = np.mean(np.log(given.variances / estimated.variances)) > np.log(CLEARLY)
    clear = shrinks and abs(difference) * duration > NEGLIGIBLE_PHASE
    if clear or (_explains_more(estimated, given) and pace.differs(difference, duration)):
        raise ValueError(
            f"frequency: must be that of the recording, which is estimated as {estimated.frequency * periods:.9g} Hz "
            f"with a standard error of {pace.se * periods:.1g} Hz, got {given.frequency * periods:.9g} Hz, whose phase "
            f"drifts by {360.0 * abs(difference) * duration:.2g}° of the response period over the cycles used; correct "
            "it, or leave it out to use the estimate."
        )


def _warn(name: str, pace: Pace, cycles: int, total: int) -> None:
    """Warn of a period that drifts, and of a steady part that is less than half of the recording."""
    if pace.drifts:
        warnings.warn(
            f"{name}: the period changes by {-pace.drift:+.2%} over the {cycles} cycles used (of {total}). The mean "
            "period and its frequency assume a constant one, and their stated errors do not contain the change; select "
            "a steadier part with `between`.",
            UserWarning,
            stacklevel=4,
        )
    elif pace.wander:
        warnings.warn(
            f"{name}: the phase wanders irregularly by {360.0 * pace.wander:.2g}° of the response period over the "
            f"{cycles} cycles used, while the amplitude is steadier. The mean period assumes a constant frequency: its "
            "higher harmonics are smeared. Fold shorter parts with `between`, or measure with a steadier drive or "
            "clock.",
            UserWarning,
            stacklevel=4,
        )
    elif cycles < total and cycles <= total // 2:
        warnings.warn(
            f"{name}: only the last {cycles} of {total} cycles are used, because those before differ from them: a long "
            "transient, a drift, or several records in one. Check the recording, and select a part with `between` or "
            "`split`.",
            UserWarning,
            stacklevel=4,
        )


def _drift(sizes: np.ndarray) -> list[float]:
    """Return the relative growth of amplitudes (windows, channels) over the part used."""
    number = np.arange(len(sizes)) - 0.5 * (len(sizes) - 1)
    return (number @ sizes / max(float(number @ number), 1.0) * len(sizes) / sizes.mean(axis=0)).tolist()


def _refuse_drift(name: str, drift: Mapping[str, float], largest: float | None) -> None:
    if largest is None:
        return
    worst = max(drift, key=lambda channel: abs(drift[channel]))
    if abs(drift[worst]) > _checks.positive("largest_drift", largest):
        raise ValueError(
            f"recording: must be steady, got {name!r}, in which the strongest harmonic of {worst!r} changes by "
            f"{drift[worst]:+.1%}, more than largest_drift = {largest:.1%}; leave it out, or select a steady part with "
            "`between`."
        )


def _periodicity(signals: Signals, fit: HarmonicFit) -> float:
    explained = 1.0 - fit.variances / np.var(signals.values, axis=1, ddof=1)
    worst = int(np.argmin(explained))
    if not explained[worst] >= MINIMUM_PERIODICITY:
        raise ValueError(
            f"recording: must be periodic, got {signals.name!r}, whose mean period at {fit.frequency:.6g} Hz explains "
            f"only {max(explained[worst], 0.0):.1%} of the variance of {signals.channels[worst]!r} (periodicity "
            f"{explained[worst]:.3f}, at least {MINIMUM_PERIODICITY} is needed); check the frequency and `periods`, "
            "and separate records of different frequencies by `split`."
        )
    return float(explained[worst])


@dataclass(frozen=True)
class AmplitudeNoise:
    """Variances of the mean period's complex amplitudes, and their degrees of freedom, (harmonics + 1,) each.

    `lines` are those of the part that was measured, `beside` the amplitudes (lines, harmonics + 1) of the noise there.
    """

    variance: np.ndarray
    freedom: np.ndarray
    lines: np.ndarray
    beside: np.ndarray


def _noise(signals: Signals, fit: HarmonicFit, row: int, cycles: int) -> tuple[np.ndarray, AmplitudeNoise]:
    """Return the variances of one cycle's complex amplitudes, (harmonics + 1,), and the noise of the mean's.

    The spectrum of the K cycles has lines at multiples of 1/K of the fundamental, and those between the harmonics
    contain noise only. The variance at a harmonic is the mean over the nearest of these lines on both sides, plus that
    of quantisation errors that repeat in every cycle.
    """
    time, residuals = signals.time, fit.residuals[row]
    per_cycle = (time.size - 1) / (np.ptp(time) * fit.frequency)
    harmonic = np.arange(fit.amplitudes.shape[1])
    # On a grid in phase, finer than the samples or the harmonics, the lines are those of a discrete Fourier transform
    # at any sampling.
    grid = FINENESS * int(np.ceil(per_cycle - 1e-6))
    points = min(grid, max(FINEST, 2 * FINENESS * harmonic.size))
    phase = (time - time[0]) * fit.frequency
    place = np.minimum(np.rint(phase * points).astype(int), points * cycles - 1)
    signal = np.bincount(place, residuals, points * cycles)
    size = np.bincount(place // points, minlength=cycles)[:, None]
    deviation = np.fft.rfft(signal.reshape(cycles, points), axis=1)[:, harmonic] / size
    sides = np.clip(cycles // 4, min(4, cycles // 2), NEIGHBOURING_LINES)
    amplitude = _between(signal.reshape(cycles, points)) / time.size
    beside = np.concatenate([amplitude[:sides, harmonic], np.conj(amplitude[:sides, -harmonic])])
    near = np.mean(np.abs(beside) ** 2, axis=0)
    freedom = np.full(harmonic.size, 4.0 * sides)
    near[0], freedom[0] = _at_zero(np.abs(amplitude[:, : points // 2].T.ravel()[:LINES_NEAR_ZERO]) ** 2)
    repeated = _repeated_error(signals.values[row], residuals, fit.amplitudes[row], phase, grid)
    # Satterthwaite; how the repeated error is distributed over the harmonics is hardly known.
    uncertain = near**2 / freedom + repeated**2 / REPEATED_FREEDOM
    total = np.divide((near + repeated) ** 2, uncertain, out=freedom.copy(), where=uncertain > 0.0)
    near += repeated
    scale = np.where(harmonic == 0, 1.0, 4.0)
    one_cycle = scale * np.sum(np.abs(deviation) ** 2, axis=0) / (cycles - 1)
    return one_cycle, AmplitudeNoise(scale * near, total, freedom, beside)


def _error_slopes(
    noise: Mapping[str, AmplitudeNoise], inputs: Sequence[str], kept: Mapping[str, int]
) -> dict[str, dict[str, np.ndarray]]:
    """Return the regression of the errors of outputs on those of inputs, by input and output, where they correlate.

    That none of the harmonics from the first on does is tested by their coherences γ², of which −2(n − 1)·ln(1 − γ²)
    has the distribution χ² with two degrees of freedom for n lines. Slopes are averaged over neighbouring harmonics.
    """
    slopes: dict[str, dict[str, np.ndarray]] = {}
    for name in inputs:
        for channel in [other for other in noise if other not in inputs]:
            one, two = (noise[c].beside[:, : 1 + min(kept[name], kept[channel])] for c in (name, channel))
            common, weight = np.sum(np.conj(one) * two, axis=0), np.sum(np.abs(one) ** 2, axis=0)
            every = weight * np.sum(np.abs(two) ** 2, axis=0)
            coherence = np.divide(np.abs(common) ** 2, every, out=np.zeros(weight.size), where=every > 0.0)[1:]
            statistic = -2.0 * (len(one) - 1) * np.log1p(-np.minimum(coherence, 1.0 - np.finfo(float).eps)).sum()
            if chdtrc(2 * coherence.size, statistic) < FALSE_ALARM_RATE:
                slope = neighbours_mean(common, weight)
                slope[0] = slope[0].real
                slopes.setdefault(name, {})[channel] = slope
    return slopes


def neighbours_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return Σ values/Σ weights (harmonics + 1,), the sums over neighbouring harmonics, but not with the mean value."""
    window, result = np.ones(2 * POOLED + 1), np.zeros(values.shape, dtype=values.dtype)
    np.divide(values[:1], weights[:1], out=result[:1], where=weights[:1] > 0.0)
    middle = slice(POOLED, POOLED + values.size - 1)
    total, weight = (np.convolve(terms[1:], window)[middle] for terms in (values, weights))
    np.divide(total, weight, out=result[1:], where=weight > 0.0)
    return result


def _between(signal: np.ndarray) -> np.ndarray:
    """Return the sums of lines s = 1, 2, … above the harmonics 0 … points − 1 of a signal (cycles, points).

    By sums over the cycles first, so that the time does not depend on the prime factors of their number.
    """
    cycles, points = signal.shape
    side = np.arange(1, min(cycles, LINES_NEAR_ZERO + 1))[:, None]
    turn = 2.0 * np.pi / cycles * side * np.arange(cycles)
    total = np.cos(turn) @ signal - 1j * (np.sin(turn) @ signal)
    total *= np.exp(-2j * np.pi / (cycles * points) * side * np.arange(points))
    return np.asarray(np.fft.fft(total, axis=1))


def _repeated_error(
    values: np.ndarray, residuals: np.ndarray, amplitudes: np.ndarray, phase: np.ndarray, points: int
) -> float:
    """Return the variance of the mean over a cycle due to repeated quantisation errors; `phase` is in cycles."""
    place = np.rint(phase * points).astype(int) % points
    count = np.bincount(place, minlength=points)
    square = np.sum(residuals**2) - np.sum(np.bincount(place, residuals, points) ** 2 / np.maximum(count, 1))
    phases = np.count_nonzero(count)
    again = values.size - phases
    fitted = _fourier.on_grid(amplitudes, points)
    return repeated_variance(values, fitted, int(phases), square / again) if again else 0.0


def _at_zero(power: np.ndarray) -> tuple[float, float]:
    """Return the expected power of the noise at frequency zero, and its degrees of freedom, from lines 1, 2, ….

    Noise that is slower than the recording is in the mean, and hardly in the lines, which have to be extrapolated.
    White noise, 1/f noise, and noise of exponential correlation over a part of the recording, each with white floors,
    are weighted by their likelihoods (P. Whittle, Ark. Mat. 2 (1953) 423-434), their levels integrated out, and their
    extrapolations averaged geometrically.
    """
    if not power.sum() > 0.0:
        return 0.0, 2.0 * WHITE_LINES
    line = np.arange(1.0, power.size + 1)
    coloured = [np.concatenate([[ZERO_OF_PINK], 1.0 / line]), *(_exponential(t, power.size) for t in CORRELATION_TIMES)]
    slow = np.array([shape / shape[1] + floor for shape in coloured for floor in FLOORS])
    shapes = np.concatenate([np.ones((1, power.size + 1)), slow])
    prior = np.log(np.where(np.arange(len(shapes)) == 0, 1.0, 1.0 / len(slow)))
    level = np.mean(power / shapes[:, 1:], axis=1)
    weight = softmax(prior - np.log(shapes[:, 1:]).sum(axis=1) - power.size * np.log(level))
    nearest = power[:SLOW_LINES].sum() / shapes[:, 1 : SLOW_LINES + 1].sum(axis=1)
    nearest[0] = power[:WHITE_LINES].mean()
    expected = np.exp(weight @ np.log(np.maximum(nearest * shapes[:, 0], np.finfo(float).tiny)))
    # Extrapolated slow noise is as uncertain as one line.
    return float(expected), float(1.0 / (weight[0] / (2.0 * WHITE_LINES) + (1.0 - weight[0]) / 2.0))


def _exponential(time: float, lines: int) -> np.ndarray:
    """Return the expected power (lines + 1,) of lines 0, 1, … of noise with a correlation time in recording lengths."""
    rate = 1.0 / time + 2j * np.pi * np.arange(lines + 1)
    return (1.0 / rate + np.expm1(-1.0 / time) / rate**2).real


def _last_significant(amplitudes: np.ndarray, noise: AmplitudeNoise) -> int:
    tested = amplitudes.size - 1
    floor = (1e-12 * np.abs(amplitudes).max()) ** 2
    ratio = np.abs(amplitudes[1:]) ** 2 / np.maximum(noise.variance[1:], floor)
    significant = fdtrc(2, noise.lines[1:], ratio) < FALSE_ALARM_RATE / tested
    return int(np.flatnonzero(significant)[-1]) + 1 if significant.any() else 1


def _chosen(harmonics: int | Mapping[str, int] | None, names: tuple[str, ...], limit: int) -> dict[str, int]:
    if harmonics is None:
        return {}
    given = harmonics if isinstance(harmonics, Mapping) else dict.fromkeys(names, harmonics)
    for channel, count in given.items():
        _checks.one_of("harmonics", channel, names)
        if _checks.integer(f"harmonics[{channel!r}]", count, 1) > limit:
            raise ValueError(
                f"harmonics[{channel!r}]: must be at most {limit}, which the samples and the grid resolve, got {count}."
            )
    return {channel: int(count) for channel, count in given.items()}


def _power(variance: np.ndarray) -> float:
    """Return the variance of a signal whose complex amplitudes have these variances."""
    return float(variance[0] + 0.5 * variance[1:].sum())


def parts(time: np.ndarray, signal: np.ndarray) -> list[slice]:
    """Return the parts of at least three cycles between gaps of time and steps of the signal's frequency."""
    rising = _rising(time, signal)
    if rising.size < 2:
        return [slice(0, time.size)]
    period = float(np.median(np.diff(time[rising])))
    edges = np.concatenate([[0], gaps(time, period) + 1, [time.size]])
    pieces = []
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        inside = first + _rising(time[first:last], signal[first:last])
        steps = inside[_steps(time, signal, inside)]
        bounds = [first, *steps.tolist(), last]
        pieces += [slice(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    cycles = [np.searchsorted(rising, part.stop) - np.searchsorted(rising, part.start) for part in pieces]
    return [part for part, count in zip(pieces, cycles, strict=True) if count > MINIMUM_CYCLES]


def _rising(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the samples at which the signal rises above its mean, which it must have left by the hysteresis."""
    centred = signal - signal.mean()
    level = HYSTERESIS * centred.std()
    outside = np.flatnonzero(np.abs(centred) > level)
    above = centred[outside] > 0.0
    return outside[1:][above[1:] & ~above[:-1]]


def _steps(time: np.ndarray, signal: np.ndarray, rising: np.ndarray) -> list[int]:
    """Return the numbers of the crossings at which the period changes, by binary segmentation of its logarithm."""
    if rising.size < 2 * MINIMUM_CYCLES + 2:
        return []
    level = signal[rising[0] : rising[-1] + 1].mean()
    level += HYSTERESIS * signal[rising[0] : rising[-1] + 1].std()
    fraction = (signal[rising] - level) / np.maximum(signal[rising] - signal[rising - 1], np.finfo(float).tiny)
    crossing = time[rising] - np.clip(fraction, 0.0, 1.0) * (time[rising] - time[rising - 1])
    period = np.log(np.diff(crossing))
    noise = max(float(np.median(np.abs(np.diff(period)))), 1e-4)
    # A single odd period, as at a jump of the phase, is no step.
    mirrored = np.concatenate([period[1:2], period, period[-2:-1]])
    period = np.median([mirrored[:-2], period, mirrored[2:]], axis=0)
    steps, stack = [], [(0, period.size)]
    while stack:
        first, last = stack.pop()
        size = last - first
        number = np.arange(MINIMUM_CYCLES, size - MINIMUM_CYCLES + 1)
        if not number.size:
            continue
        segment = period[first:last]
        before = np.cumsum(segment)[number - 1]
        difference = before / number - (segment.sum() - before) / (size - number)
        score = np.abs(difference) * np.sqrt(number * (size - number) / size)
        best = int(np.argmax(score))
        if score[best] > SIGNIFICANT_PERIOD_STEP * noise and abs(difference[best]) > SMALLEST_PERIOD_STEP:
            middle = first + int(number[best])
            steps.append(middle)
            stack += [(first, middle), (middle, last)]
    return sorted(steps)
