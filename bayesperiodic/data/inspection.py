"""Inspection of signals: their faults, their steady part and its mean period; what `check` and `fold` both do."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import toeplitz

from bayesperiodic import _fourier
from bayesperiodic.data import clocks
from bayesperiodic.data.coverage import determined_harmonics, resolved_harmonics
from bayesperiodic.data.cycle_findings import cycle_findings, slow_beats
from bayesperiodic.data.faults import (
    ChannelFaults,
    dropped_value,
    heavy_tails,
    jumps,
    outliers_of,
    repeat_noise,
    single,
)
from bayesperiodic.data.groups import CommonFit, Windowed, common_span, common_windows, leading, refine_groups, within
from bayesperiodic.data.harmonics import (
    MINIMUM_CYCLES,
    HarmonicFit,
    Pace,
    fit_harmonics,
)
from bayesperiodic.data.recording_check import (
    RUINOUS,
    SEVERITIES,
    WRAPS,
    Finding,
    RecordingCheck,
    bounded,
    clock_findings,
    sample_findings,
    sampling_findings,
    signal_faults,
)
from bayesperiodic.data.saturation import EXACT_SERIES, means_of, phase_bins, saturation_of
from bayesperiodic.data.signals import USUAL_STEPS, Signals, counted_cycles, cycles_of, first_guess
from bayesperiodic.data.steadiness import Steady, Windows, steady_part

# Largest relative change of an amplitude within half of a steady part.
LARGEST_CHANGE = 0.1
# Harmonics of the first mean period, from which outliers are left out.
ROUGH_HARMONICS = 40
# Most refinements of the frequency by a steady part that changes with it.
MOST_REFINEMENTS = 4
# Findings whose samples are those of another kind.
SAMPLES_OF = {"held": "stuck", "saturated": "clipped"}
# Least share of samples at which no channel is stuck.
LEAST_MOVING = 0.1
# Harmonics that samples may show whose phases do not determine them, the largest condition number of their normal
# equations, and the gain of the Bayesian information criterion by which they do.
MOST_SHOWN, LARGEST_SHOWN_CONDITION, CLEAR_GAIN = 10, 1e5, 20.0
# Share of clipped samples at a phase from which the others there are left out too.
CLIPPED_SHARE = 0.02


@dataclass(frozen=True)
class Inspection:
    """Faults, steady part and mean period of signals, in groups of channels that have common times."""

    groups: list[Signals]
    faults: list[list[ChannelFaults]]  # by group
    findings: tuple[Finding, ...]
    total: int = 0  # whole cycles
    steady: Steady | None = None  # of all groups; its samples are those of the first
    used: list[slice] = field(default_factory=list)  # samples of each group in the steady part
    sizes: np.ndarray | None = None  # (windows, channels), of the strongest harmonics in windows that do not overlap
    fit: CommonFit | None = None  # of the steady part, at the estimated frequency
    pace: Pace = Pace(0.0, 0, 0.0, False)
    limits: list[int] = field(default_factory=list)  # of the harmonics of each group
    inflation: list[np.ndarray] = field(default_factory=list)  # of their variances by missing phases
    drifts: list[clocks.Drift] = field(default_factory=list)  # of phases against the first channel
    reason: str = ""  # why there is no steady part or no mean period

    @property
    def channels(self) -> list[str]:
        """Names of the channels, group by group."""
        return [channel for group in self.groups for channel in group.channels]

    @property
    def parts(self) -> list[Signals]:
        """The steady part of each group."""
        return [group.part(used) for group, used in zip(self.groups, self.used, strict=True)]


def inspect(
    groups: list[Signals], periods: int, frequency: float | None, points: int, other: Iterable[str] = (), asked: int = 0
) -> Inspection:
    """Return what signals are like; without a steady part or a mean period, the reason.

    Channels of `other` clocks, whose times were corrected, tell nothing about the frequency. Harmonics that are asked
    for are fitted as far as the samples determine them.
    """
    faults = [[signal_faults(v, drive=i < group.inputs) for i, v in enumerate(group.values)] for group in groups]

    def stopped(reason: str, rate: float | None = None, total: int = 0) -> Inspection:
        return Inspection(groups, faults, _worst_first(_findings(groups, faults, rate)), total, reason=reason)

    if any(fault.wrap for group in faults for fault in group):
        wraps = _worst_first(_findings(groups, faults, None))
        return Inspection(groups, faults, wraps, reason=_wrapped(groups[0].name, wraps))
    moving = [_moving(group, fault) for group, fault in zip(groups, faults, strict=True)]
    try:
        calm = _calm_groups(groups, faults, moving)
        first = calm[leading(groups)]
        behind, tracked, span = _counted(groups, calm, periods, frequency, points)
    except ValueError as error:
        return stopped(str(error))
    total = int(min(cycles_of(group.time[part], tracked) for group, part in zip(groups, span, strict=True)))
    # Without the parts behind gaps over which the cycles cannot be counted.
    among = [within(group.time, first.time[behind]) for group in calm]
    calm = [group.part(part) for group, part in zip(calm, among, strict=True)]
    moving = [these[part] for these, part in zip(moving, among, strict=True)]
    sound = [_sound(*each, tracked, points) for each in zip(groups, calm, faults, moving, strict=True)]
    whole = all(these.size == group.time.size for these, group in zip(sound, groups, strict=True))
    sound = [_inside(these, part) for these, part in zip(sound, span, strict=True)]
    counted, refined = first.time, frequency is None
    del calm, first  # their values can be copies
    some = [_selected(group, these) for group, these in zip(groups, sound, strict=True)]
    every, steady, tracked = _steady_of(some, tracked, points, refined, refined and not whole, other)
    times, some = some[0].time, []
    if steady is None or np.abs(steady.change).max(initial=0.0) > LARGEST_CHANGE:
        return stopped(_unsteady(groups, every.all, tracked), tracked, total)
    used = [
        slice(int(these[part.start]), int(these[part.stop - 1]) + 1)
        for these, part in zip(sound, every.samples(steady.part), strict=True)
    ]
    steady, outer = steady.among(sound[0]), every.all.among(sound[0])
    parts = [group.part(part) for group, part in zip(groups, used, strict=True)]
    try:
        highest = [resolved_harmonics(part.time, tracked, points, asked) for part in parts]
    except ValueError as error:
        return stopped(str(error), tracked, total)
    determined = [determined_harmonics(part.time, tracked, limit) for part, limit in zip(parts, highest, strict=True)]
    limits, inflation = [limit for limit, _ in determined], [factors for _, factors in determined]
    fit, pace = refine_groups(parts, tracked, limits, other)
    if np.ptp(parts[0].time) * fit.frequency < MINIMUM_CYCLES - 1:
        return stopped(_unsteady(groups, every.all, tracked), tracked, total)
    if lost := next(filter(None, map(undetermined, parts, fit.each, highest)), ""):
        return stopped(lost, tracked, total)
    for i, part in enumerate(used):
        _describe_faults(faults[i], groups[i], part, fit.each[i], limits[i], sound[i], moving[i])
    seen = _findings(groups, faults, fit.frequency, limits, used)
    channels = [channel for group in groups for channel in group.channels]
    seen += cycle_findings(channels, groups[0].time, outer, steady, fit.frequency, total, _ends(groups))
    if frequency is None:
        lead = parts[leading(groups)]
        seen += sampling_findings(lead.time, lead.values, fit.frequency, counted, behind)
    of_clocks, drifts = _clock_findings(groups, every, times, used[0], fit.frequency, total, pace.varies)
    sizes = every.all.apart().sizes
    return Inspection(
        groups, faults, _worst_first(seen + of_clocks), total, steady, used, sizes, fit, pace, limits, inflation, drifts
    )


def _findings(
    groups: list[Signals],
    faults: list[list[ChannelFaults]],
    rate: float | None,
    limits: Iterable[int] = (),
    used: Iterable[slice] = (),
) -> list[Finding]:
    """Return the findings of samples and times, at a frequency with the highest harmonics and the parts used."""
    limits, used = [*limits] or [0] * len(groups), [*used] or [slice(0, group.time.size) for group in groups]
    every: list[Finding] = []
    for group, fault, limit, part in zip(groups, faults, limits, used, strict=True):
        for c, v, f in zip(group.channels, group.values, fault, strict=True):
            every += sample_findings(c, group.time, v, f, rate, limit, part)
    return every + _gaps(groups)


def _worst_first(some: list[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(some, key=lambda finding: -SEVERITIES.index(finding.severity)))


def _calm_groups(groups: list[Signals], faults: list[list[ChannelFaults]], moving: list[np.ndarray]) -> list[Signals]:
    """Return what `_calm` does of each group; raise a ValueError if no channel varies."""
    if not any(group.channels for group in groups):
        raise ValueError(f"recording: must have a channel that varies, got {groups[0].name!r} without one.")
    return [_calm(*each) for each in zip(groups, faults, moving, strict=True)]


def _counted(
    groups: list[Signals], calm: list[Signals], periods: int, frequency: float | None, points: int
) -> tuple[slice, float, list[slice]]:
    """Return samples of the leading group whose cycles can be counted, at which frequency, and the time in common.

    Raise a ValueError if the cycles cannot be counted, or the samples resolve no harmonic.
    """
    first = calm[leading(groups)]
    behind, tracked = counted_cycles(first, first_guess(first, frequency, periods), frequency is not None)
    span = common_span(groups, tracked)
    for group in calm:
        resolved_harmonics(group.time[within(group.time, first.time[behind])], tracked, points)
    return behind, tracked, span


def _describe_faults(
    faults: list[ChannelFaults],
    group: Signals,
    used: slice,
    fit: HarmonicFit,
    limit: int,
    sound: np.ndarray,
    moving: np.ndarray,
) -> None:
    """Set what `ChannelFaults` tell of a group by the fit of the part used, without samples that are not sound."""
    part, amplitudes, residuals = group.part(used), fit.amplitudes, fit.residuals
    here = _inside(sound, used)
    if here.size < part.time.size:
        amplitudes = fit_harmonics(group.time[here], group.values[:, here], fit.frequency, limit).amplitudes
        residuals = part.values - _fourier.at_times(amplitudes, fit.frequency * part.time)
    _set_outliers(faults, part, residuals, fit.frequency, used, moving)
    describe_limits(faults, part, HarmonicFit(fit.frequency, amplitudes, residuals), used.start)


def _clock_findings(
    groups: list[Signals],
    every: Windowed,
    time: np.ndarray,
    used: slice,
    frequency: float,
    total: int,
    varies: bool,
) -> tuple[list[Finding], list[clocks.Drift]]:
    """Return steps and steady drifts of the phases of channels against the first one; of a drive that varies, steps."""
    channels = [channel for group in groups for channel in group.channels]
    rates = {c: (g.time.size - 1) / float(np.ptp(g.time)) for g in groups for c in g.channels}
    start, stop = float(groups[0].time[used.start]), float(groups[0].time[used.stop - 1])
    phases = clocks.phases_of(every.all, time)
    inside = (phases.start >= start) & (phases.start + phases.length / frequency <= stop + 1.5 / rates[channels[0]])
    if np.count_nonzero(inside) < clocks.FEWEST_WINDOWS:
        return [], []
    steps, places = clocks.steps(channels, phases, inside)
    listed = [*clocks.step_findings(steps, rates, frequency, inside.size)]
    drifts: list[clocks.Drift] = []
    if not varies:
        cycles = round((stop - start) * frequency)
        drifts = clocks.clock_drifts(phases, inside, places)
        listed += clocks.drift_findings(drifts, channels, (start, stop), cycles, total)
    return listed, drifts


def _calm(group: Signals, faults: list[ChannelFaults], moving: np.ndarray) -> Signals:
    """Return a group at the samples that move, without rare extremes; raise a ValueError if these are too few."""
    if moving.size < LEAST_MOVING * group.time.size:
        raise ValueError(_still(group, faults))
    return _selected(replace(group, values=bounded(group.values)), moving)


def _selected(group: Signals, samples: np.ndarray) -> Signals:
    return group if samples.size == group.time.size else group.part(samples)


def _ends(groups: list[Signals]) -> tuple[float, float]:
    """Return the first and the last time that all groups have in common."""
    return max(float(group.time[0]) for group in groups), min(float(group.time[-1]) for group in groups)


def _inside(numbers: np.ndarray, part: slice) -> np.ndarray:
    """Return increasing numbers of samples that are in a part."""
    return numbers[slice(*np.searchsorted(numbers, [part.start, part.stop]))]


def _moving(group: Signals, faults: list[ChannelFaults]) -> np.ndarray:
    """Return the numbers of the samples at which no channel is stuck."""
    moving = np.ones(group.time.size, dtype=bool)
    for stuck in [part for fault in faults for part in fault.stuck]:
        moving[stuck] = False
    return np.flatnonzero(moving)


def _gaps(groups: list[Signals]) -> list[Finding]:
    """Return the gaps of the time axes, of several by channel."""
    if len(groups) == 1:
        return [*clock_findings(groups[0].time)]
    return [
        replace(finding, channel=channel, text=f"{channel}: {finding.text}")
        for group in groups
        for finding in clock_findings(group.time)
        for channel in group.channels
    ]


def _set_outliers(
    faults: list[ChannelFaults],
    part: Signals,
    residuals: np.ndarray,
    frequency: float,
    used: slice,
    moving: np.ndarray,
) -> None:
    """Set the outliers of each channel in the part used by residuals there, and keep those outside of it."""
    still = np.ones(used.stop, dtype=bool)
    still[moving[moving < used.stop]] = False
    for fault, rest, values in zip(faults, residuals, part.values, strict=True):
        inside = outliers_of(rest, part.time * frequency, values, fault.step) + used.start
        before, after = (fault.outliers < used.start), (fault.outliers >= used.stop)
        fault.outliers = np.concatenate([fault.outliers[before], inside[~still[inside]], fault.outliers[after]])


def _steady_of(
    some: list[Signals], tracked: float, points: int, refined: bool, first: bool, other: Iterable[str]
) -> tuple[Windowed, Steady | None, float]:
    """Return the windows, the steady part and the frequency, which is refined for a part, and `first` for all."""
    few = [min(ROUGH_HARMONICS, resolved_harmonics(group.time, tracked, points)) for group in some]
    if first:
        tracked = refine_groups(some, tracked, few, other)[0].frequency
    every = common_windows(some, tracked)
    driven = any(group.inputs for group in some)
    steady = steady_part(every.all, driven)
    # At the frequency of its steady part, a motion without a drive has other steady parts.
    for _ in range(MOST_REFINEMENTS if driven else 1):
        whole = every.all.apart()
        if steady is None or not refined or steady.level == (whole.first[0], whole.last[-1]):
            break
        # The frequency of a part that ramps is not that of the steady one, and at a wrong one ramps are steady.
        before, used = steady.level, every.samples(steady.part)
        parts = [group.part(part) for group, part in zip(some, used, strict=True)]
        tracked = refine_groups(parts, tracked, few, other)[0].frequency
        every = common_windows(some, tracked)
        steady = steady_part(every.all, driven)
        if steady is None or steady.level == before or np.abs(steady.change).max(initial=0.0) > LARGEST_CHANGE:
            break
    if steady is not None and refined and not driven:
        fit, pace = refine_groups(some, tracked, few, other)
        if pace.diffusion and not pace.drifts:
            # A phase that walks at random is no transient.
            again = common_windows(some, fit.frequency)
            again = replace(again, all=again.all.aligned())
            longer = steady_part(again.all, driven)
            if longer is not None:
                return again, longer, fit.frequency
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
    for fault in faults:
        fault.brief = single(fault.brief, signals.time * fundamental)
        if fault.brief.size:
            moving = _without(moving, fault.brief)
            calm = _selected(replace(signals, values=bounded(signals.values)), moving)
    if not jumps(signals.values) and all(dropped_value(values) is None for values in signals.values):
        return moving
    limit = min(resolved_harmonics(calm.time, fundamental, points), ROUGH_HARMONICS)
    fit = fit_harmonics(calm.time, calm.values, fundamental, limit)
    for fault, near, rest, measured in zip(faults, calm.values, fit.residuals, signals.values, strict=True):
        values = measured if moving.size == measured.size else measured[moving]
        rest += values - near
        fault.outliers = moving[outliers_of(rest, calm.time * fundamental, values, fault.step)]
    return _without(moving, np.concatenate([fault.outliers for fault in faults]))


def _without(numbers: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return increasing numbers of samples without others."""
    kept = np.ones(numbers.max(initial=-1) + 1, dtype=bool)
    kept[others[others < kept.size]] = False
    return numbers[kept[numbers]]


def _unsteady(groups: list[Signals], every: Windows, frequency: float) -> str:
    name, channels = groups[0].name, [channel for group in groups for channel in group.channels]
    if not every.first.size:
        return (
            f"recording: must have samples in all parts of its periods, got {name!r}, which has too few; check "
            "the frequency and the gaps, or fold a part by `between` or `split`."
        )
    if beats := [*slow_beats(channels, groups[0].time, every, frequency)]:
        return (
            f"recording: must have a steady part of {MINIMUM_CYCLES} cycles, got {name!r}, in which "
            f"{'. '.join(map(str, beats))}."
        )
    size = every.sizes
    worst = int(np.argmax(np.ptp(size, axis=0) / size.mean(axis=0)))
    low, high = size[:, worst].min(), size[:, worst].max()
    channel = channels[worst]
    return (
        f"recording: must have a steady part of {MINIMUM_CYCLES} cycles, got {name!r}, in which the amplitude "
        f"of {channel!r} changes throughout, from {low / high:.0%} of its largest value on; record at "
        "a constant amplitude, or select a part by `between`."
    )


def _union(*samples: np.ndarray) -> np.ndarray:
    """Return the numbers of samples that are in one of several arrays."""
    return np.unique(np.concatenate(samples))


def summary(name: str, channels: Iterable[str], seen: Inspection, still: Mapping[str, float]) -> RecordingCheck:
    """Return what was seen, and channels with one value, as the result of `Recording.check`."""
    import pandas as pd

    bad: dict[str, dict[str, np.ndarray]] = {}
    rows: dict[str, dict[str, float]] = {}
    named = {(f.channel, SAMPLES_OF.get(f.kind, f.kind)) for f in seen.findings}
    for group, faults in zip(seen.groups, seen.faults, strict=True):
        for channel, values, fault in zip(group.channels, group.values, faults, strict=True):
            places = {
                "outliers": fault.outliers,
                "stuck": _union(fault.held, fault.brief, *(np.arange(s.start, s.stop) for s in fault.stuck)),
                "clipped": _union(fault.low, fault.high, fault.beside, fault.saturated),
            }
            bad[channel] = {kind: v if (channel, kind) in named else v[:0] for kind, v in places.items()}
            rows[channel] = {
                "lowest": values.min(),
                "highest": values.max(),
                "resolution": fault.step,
                "bits": np.log2(np.ptp(values) / fault.step + 1.0) if fault.step else np.nan,
                **{kind: v.size for kind, v in bad[channel].items()},
                "wraps": fault.wraps.size,
            }
    times = [group.time for group in seen.groups]
    every = np.array([[min(time[0] for time in times), max(time[-1] for time in times)]])
    constant = [
        Finding(
            "constant", channel, RUINOUS, every, max(time.size for time in times), 1.0, np.nan,
            f"{channel} is constant at {value:.6g}", "leave the channel out",
        )
        for channel, value in still.items()
    ]  # fmt: skip
    used = [time[part] for time, part in zip(times, seen.used, strict=False)]
    steps = [np.diff(time) for time in times]
    steps = [step[step <= USUAL_STEPS * np.median(step)] for step in steps]
    order = [channel for channel in channels if channel in rows]
    return RecordingCheck(
        name,
        pd.DataFrame([rows[channel] for channel in order], index=order),
        (*constant, *seen.findings),
        seen.fit.frequency if seen.fit else np.nan,
        round(np.ptp(used[0]) * seen.fit.frequency) if seen.fit else 0,
        seen.total,
        float(min(time[0] for time in used or times)),
        float(max(time[-1] for time in used or times)),
        float(max(step.std() / np.median(step) for step in steps)),
        bad,
        seen.reason,
    )


def describe_limits(faults: list[ChannelFaults], used: Signals, fit: HarmonicFit, start: int) -> None:
    """Tell heavy tails from outliers, and channels that a sensor limits from those that rest.

    Of the part used, which begins at the sample `start`, by a fit without the faulty samples.
    """
    phase, stop = used.time * fit.frequency, start + used.time.size
    sound = np.ones(used.time.size, dtype=bool)
    for fault in faults:
        for part in fault.stuck:
            sound[max(part.start - start, 0) : max(part.stop - start, 0)] = False
        some = np.concatenate([fault.brief, fault.outliers])
        sound[some[(some >= start) & (some < stop)] - start] = False
    here = slice(None) if sound.all() or np.mean(sound) < LEAST_MOVING else sound
    bins = phase_bins(phase[here])
    for i, (fault, values) in enumerate(zip(faults, used.values, strict=True)):
        rest = fit.residuals[i]
        far = fault.outliers[(fault.outliers >= start) & (fault.outliers < stop)]
        if far.size:
            fault.tails = far[heavy_tails(rest, far - start, values - rest)]
            fault.outliers = np.setdiff1d(fault.outliers, fault.tails)
        clipped = np.concatenate([fault.low, fault.high])
        if clipped.size:
            scatter = repeat_noise(phase, values, clipped - start)
            fault.noisy = scatter > max(EXACT_SERIES * float(values.std()), 0.5 * fault.step)
            fault.tails = fault.tails[:0]
            fault.beside = _same_phases(phase, clipped[(clipped >= start) & (clipped < stop)] - start) + start
        means = means_of(bins, rest[here], fit.amplitudes[i], fault.step)
        fault.saturation = saturation_of(means)
        if fault.saturation is not None and not (clipped.size and fault.noisy):
            fault.saturated = clipped if clipped.size else np.flatnonzero(fault.saturation.holds(phase)) + start
            fault.saturation_bias = fault.saturation.bias(means.error)


def _same_phases(phase: np.ndarray, clipped: np.ndarray) -> np.ndarray:
    """Return the samples at phases at which some are clipped: the others are the smaller ones by noise."""
    bins = phase_bins(phase)
    number = bins.centre.size
    place = bins.place % number
    share = np.bincount(place[clipped], minlength=number) / np.maximum(bins.count.sum(axis=0), 1)
    return np.flatnonzero(share[place] > CLIPPED_SHARE)


def undetermined(used: Signals, fit: HarmonicFit, resolved: int) -> str:
    """Return a message if the samples show more harmonics than their phases determine; else an empty one.

    With the amplitudes of these harmonics the fit is clearly better, by the Bayesian information criterion.
    """
    order = fit.amplitudes.shape[1] - 1
    if order >= min(resolved, MOST_SHOWN):
        return ""
    for more in range(order + 1, min(resolved, MOST_SHOWN) + 1):
        moments = _fourier.moments(fit.frequency * used.time, 2 * more)
        size = np.linalg.eigvalsh(toeplitz(moments))
        if not size[0] * LARGEST_SHOWN_CONDITION > size[-1]:
            break
        other = fit_harmonics(used.time, used.values, fit.frequency, more)
        floor = 1e-24 * np.var(used.values, axis=1)
        gain = used.time.size * np.log((fit.variances + floor) / (other.variances + floor))
        worst = int(np.argmax(gain))
        if gain[worst] > 2.0 * (more - order) * np.log(used.time.size) + CLEAR_GAIN:
            bins = 2 * (resolved + 1)
            count = np.bincount((fit.frequency * used.time % 1.0 * bins).astype(int), minlength=bins)
            return (
                f"recording: must have samples at all phases of its period, got {used.name!r}, in which none are at "
                f"{np.mean(count == 0):.0%} of each period of {1.0 / fit.frequency:.6g} s: the others determine "
                f"{order} harmonic{'s'[: order > 1]}, and {used.channels[worst]!r} has {more} at least. Record again "
                "without the fault for which samples were left out, such as clipping by a small range."
            )
    return ""
