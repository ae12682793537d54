"""Inspection of signals: their faults, their steady part and its mean period; what `check` and `fold` both do."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic.data.faults import ChannelFaults, dropped_value, jumps, outliers_of
from bayesperiodic.data.harmonics import (
    MINIMUM_CYCLES,
    HarmonicFit,
    Pace,
    determined_harmonics,
    fit_harmonics,
    refine_frequency,
    resolved_harmonics,
)
from bayesperiodic.data.recording_check import (
    RUINOUS,
    SEVERITIES,
    WRAPS,
    Finding,
    RecordingCheck,
    bounded,
    clock_findings,
    cycle_findings,
    sample_findings,
    signal_faults,
)
from bayesperiodic.data.signals import USUAL_STEPS, Signals, cycles_of, first_guess, refuse_gaps, tracked_frequency
from bayesperiodic.data.steadiness import Steady, Windows, steady_part, windows

# Largest relative change of an amplitude within half of a steady part.
LARGEST_CHANGE = 0.1
# Least share of samples at which no channel is stuck.
LEAST_MOVING = 0.1
# Harmonics of the first mean period, from which outliers are left out.
ROUGH_HARMONICS = 40


@dataclass(frozen=True)
class Inspection:
    """Faults, steady part and mean period of signals."""

    signals: Signals
    faults: list[ChannelFaults]
    findings: tuple[Finding, ...]
    total: int = 0  # whole cycles
    steady: Steady | None = None
    sizes: np.ndarray | None = None  # (windows, channels), of the strongest harmonics in windows that do not overlap
    fit: HarmonicFit | None = None  # of the steady part, at the estimated frequency
    pace: Pace = Pace(0.0, 0, 0.0, False)
    limit: int = 0  # of the harmonics
    inflation: np.ndarray = field(default_factory=lambda: np.ones(1))  # of their variances by missing phases
    reason: str = ""  # why there is no steady part or no mean period


def inspect(signals: Signals, periods: int, frequency: float | None, points: int) -> Inspection:
    """Return what signals are like; without a steady part or a mean period, the reason."""
    faults = [signal_faults(values, drive=i < signals.inputs) for i, values in enumerate(signals.values)]

    def findings(rate: float | None, limit: int = 0, used: slice = slice(0, signals.time.size)) -> list[Finding]:
        rows = zip(signals.channels, signals.values, faults, strict=True)
        every = [f for c, v, fault in rows for f in sample_findings(c, signals.time, v, fault, rate, limit, used)]
        return every + [*clock_findings(signals.time)]

    def worst_first(some: list[Finding]) -> tuple[Finding, ...]:
        return tuple(sorted(some, key=lambda finding: -SEVERITIES.index(finding.severity)))

    if any(fault.wrap for fault in faults):
        wraps = worst_first(findings(None))
        return Inspection(signals, faults, wraps, reason=_wrapped(signals.name, wraps))
    moving = np.ones(signals.time.size, dtype=bool)
    for stuck in [part for fault in faults for part in fault.stuck]:
        moving[stuck] = False
    try:
        if not signals.channels:
            raise ValueError(f"recording: must have a channel that varies, got {signals.name!r} without one.")
        if np.count_nonzero(moving) < LEAST_MOVING * moving.size:
            raise ValueError(_still(signals, faults))
        calm = replace(signals, values=bounded(signals.values)).part(np.flatnonzero(moving))
        fundamental = first_guess(calm, frequency, periods)
        refuse_gaps(signals, fundamental)
        tracked = tracked_frequency(calm, fundamental, frequency is not None)
    except ValueError as error:
        return Inspection(signals, faults, worst_first(findings(None)), reason=str(error))
    total = int(cycles_of(signals.time, tracked))
    sound = _sound(signals, calm, faults, np.flatnonzero(moving), tracked, points)
    some = signals if sound.size == signals.time.size else signals.part(sound)
    refined = frequency is None
    every, steady, tracked = _steady_of(some, tracked, points, refined, refined and some is not signals)
    if steady is None or np.abs(steady.change).max(initial=0.0) > LARGEST_CHANGE:
        return Inspection(signals, faults, worst_first(findings(tracked)), total, reason=_unsteady(signals, every))
    steady = steady.among(sound)
    used = signals.part(steady.samples)
    limit, inflation = determined_harmonics(used.time, tracked, resolved_harmonics(used.time, tracked, points))
    fit, pace = refine_frequency(used.time, used.values, tracked, limit)
    residuals = fit.residuals
    here = sound[(sound >= steady.samples.start) & (sound < steady.samples.stop)]
    if here.size < used.time.size:
        near = fit_harmonics(signals.time[here], signals.values[:, here], tracked, limit).amplitudes
        residuals = used.values - _fourier.at_times(near, tracked * used.time)
    for fault, rest, values in zip(faults, residuals, used.values, strict=True):
        inside = outliers_of(rest, used.time * fit.frequency, values, fault.step) + steady.samples.start
        before, after = (fault.outliers < steady.samples.start), (fault.outliers >= steady.samples.stop)
        fault.outliers = np.concatenate([fault.outliers[before], inside[moving[inside]], fault.outliers[after]])
    seen = findings(fit.frequency, limit, steady.samples)
    seen += cycle_findings(signals.channels, signals.time, steady, fit.frequency, total)
    return Inspection(
        signals, faults, worst_first(seen), total, steady, every.apart().sizes, fit, pace, limit, inflation
    )


def _steady_of(
    some: Signals, tracked: float, points: int, refined: bool, first: bool
) -> tuple[Windows, Steady | None, float]:
    """Return the windows, the steady part and the frequency, which is refined for a part, and `first` for all."""
    few = min(ROUGH_HARMONICS, resolved_harmonics(some.time, tracked, points))
    if first:
        tracked = refine_frequency(some.time, some.values, tracked, few)[0].frequency
    every = windows(some.time, some.values, tracked)
    steady = steady_part(every)
    if steady is not None and refined and steady.level != (0, some.time.size):
        # The frequency of a part that ramps is not that of the steady one.
        part = some.part(steady.samples)
        tracked = refine_frequency(part.time, part.values, tracked, few)[0].frequency
        every = windows(some.time, some.values, tracked)
        steady = steady_part(every)
    if steady is not None and refined and not some.inputs and steady.level != (0, some.time.size):
        fit, pace = refine_frequency(some.time, some.values, tracked, few)
        if pace.diffusion and not pace.drifts:
            # A phase that walks at random is no transient.
            aligned = windows(some.time, some.values, fit.frequency).aligned()
            longer = steady_part(aligned)
            if longer is not None:
                return aligned, longer, fit.frequency
    return every, steady, tracked


def _wrapped(name: str, findings: tuple[Finding, ...]) -> str:
    return f"recording: must be without wraps, got {name!r}: {'. '.join(str(f) for f in findings if f.kind == WRAPS)}."


def _still(signals: Signals, faults: list[ChannelFaults]) -> str:
    still = [channel for channel, fault in zip(signals.channels, faults, strict=True) if fault.stuck]
    return (
        f"recording: must move, got {signals.name!r}, in which {', '.join(map(repr, still))} is stuck most "
        "of the time; leave the channel out."
    )


def _sound(
    signals: Signals, calm: Signals, faults: list[ChannelFaults], moving: np.ndarray, fundamental: float, points: int
) -> np.ndarray:
    """Return the numbers of the samples that are not stuck, without outliers from a first mean period.

    These outliers become those of the channels.
    """
    if not jumps(signals.values) and all(dropped_value(values) is None for values in signals.values):
        return moving
    limit = min(resolved_harmonics(calm.time, fundamental, points), ROUGH_HARMONICS)
    fit = fit_harmonics(calm.time, calm.values, fundamental, limit)
    for fault, values, near, rest in zip(faults, signals.values[:, moving], calm.values, fit.residuals, strict=True):
        fault.outliers = moving[outliers_of(values - near + rest, calm.time * fundamental, values, fault.step)]
    return np.setdiff1d(moving, np.concatenate([fault.outliers for fault in faults]))


def _unsteady(signals: Signals, every: Windows) -> str:
    if not every.first.size:
        return (
            f"recording: must have samples in all parts of its periods, got {signals.name!r}, which has too few; check "
            "the frequency and the gaps, or fold a part by `between` or `split`."
        )
    size = every.sizes
    worst = int(np.argmax(np.ptp(size, axis=0) / size.mean(axis=0)))
    low, high = size[:, worst].min(), size[:, worst].max()
    return (
        f"recording: must have a steady part of {MINIMUM_CYCLES} cycles, got {signals.name!r}, in which the amplitude "
        f"of {signals.channels[worst]!r} changes throughout, from {low / high:.0%} of its largest value on; record at "
        "a constant amplitude, or select a part by `between`."
    )


def summary(name: str, seen: Inspection, still: Mapping[str, float]) -> RecordingCheck:
    """Return what was seen, and channels with one value, as the result of `Recording.check`."""
    import pandas as pd

    time, part = seen.signals.time, seen.steady
    bad = {
        channel: {
            "outliers": fault.outliers,
            "stuck": np.concatenate([fault.held, *(np.arange(s.start, s.stop) for s in fault.stuck)]),
            "clipped": np.concatenate([fault.low, fault.high]),
        }
        for channel, fault in zip(seen.signals.channels, seen.faults, strict=True)
    }
    named = {(f.channel, "stuck" if f.kind == "held" else f.kind) for f in seen.findings}
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
    every, share = np.array([[time[0], time[-1]]]), 1.0
    constant = [
        Finding(
            "constant", channel, RUINOUS, every, time.size, share, np.nan,
            f"{channel} is constant at {value:.6g}", "leave the channel out",
        )
        for channel, value in still.items()
    ]  # fmt: skip
    step = np.diff(time)
    step = step[step <= USUAL_STEPS * np.median(step)]
    return RecordingCheck(
        name,
        pd.DataFrame(rows, index=[*seen.signals.channels]),
        (*constant, *seen.findings),
        seen.fit.frequency if seen.fit else np.nan,
        round(np.ptp(time[part.samples]) * seen.fit.frequency) if part and seen.fit else 0,
        seen.total,
        float(time[part.samples.start]) if part else float(time[0]),
        float(time[part.samples.stop - 1]) if part else float(time[-1]),
        float(step.std() / np.median(step)),
        bad,
        seen.reason,
    )
