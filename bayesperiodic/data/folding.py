"""Estimation of the mean steady period of sampled signals, and of its uncertainty; division of records of several."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc, fdtrc

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.clocks import CLOCK
from bayesperiodic.data.coverage import missing_phases, resolved_harmonics
from bayesperiodic.data.experiment import LeftOut
from bayesperiodic.data.faults import ROUNDING
from bayesperiodic.data.groups import CommonFit, fit_groups, leading, within
from bayesperiodic.data.harmonics import (
    NEGLIGIBLE_PHASE,
    HarmonicFit,
    Pace,
    followed_phase,
    refine_frequency,
)
from bayesperiodic.data.inspection import Inspection
from bayesperiodic.data.lines import LEAST_LEFT, Sampling, nearest
from bayesperiodic.data.quantisation import REPEATED_FREEDOM, repeated_variance, rounded_step
from bayesperiodic.data.recording_check import SERIOUS, Finding, refuse
from bayesperiodic.data.response_period import FALSE_ALARM_RATE, aperiodic, even_times, response_period
from bayesperiodic.data.several_clocks import ONE, Clocks, inspect_clocks
from bayesperiodic.data.signals import Signals, counted_cycles, cycles_of, explains_more, first_guess

if TYPE_CHECKING:
    import pandas as pd

# Most grid points of a response period.
MAXIMUM_POINTS = 1_000_000
# Share of a channel's variance that its mean period explains at least, and of one that is surely periodic.
MINIMUM_PERIODICITY, CLEARLY_PERIODIC = 0.5, 0.9
# Ratio of residual variances from which the estimated frequency is right, and the given one wrong.
CLEARLY = 4.0
# Phase [cycles] by which a frequency that is given with an error drifts at most: more would shrink the harmonics.
LARGEST_PHASE_DRIFT = 0.05
# Response cycles of the later half of a recording that show a period which the whole has not.
LATER_CYCLES = 6
CROSSING, AUTO = "crossing", "auto"

# Neighbouring harmonics on each side with which variances and slopes of one are averaged.
POOLED = 2


def fold_signals(
    groups: list[Signals],
    samples: int,
    periods: int,
    given: tuple[float, float] | None,  # frequency and standard error
    harmonics: int | Mapping[str, int] | None,
    origin: float | str,
    largest_drift: float | None,
    clocks: Clocks | None = None,
) -> dict[str, Any]:
    """Return the arguments of the `Experiment` of the mean period of the steady part; see `Recording.fold`.

    Each group of channels with common times is solved on its own samples, for one frequency and phase.
    """
    points = samples * periods
    if points > MAXIMUM_POINTS:
        raise ValueError(f"samples: must be at most {MAXIMUM_POINTS // periods} for {periods} periods, got {samples}.")
    if isinstance(origin, str) and origin != CROSSING:
        raise ValueError(f"origin: must be a time [s] or {CROSSING!r}, got {origin!r}.")
    start = 0.0 if origin == CROSSING else _checks.finite_number("origin", origin)
    frequency = None if given is None else given[0]
    groups = [replace(group, time=group.time - start) for group in groups] if start else groups
    chosen = _chosen(harmonics, [channel for group in groups for channel in group.channels])
    asked = max(chosen.values(), default=0)
    seen, others = inspect_clocks(groups, clocks, periods, frequency, points, asked)
    if seen.steady is None or seen.fit is None or seen.sizes is None:
        raise ValueError(seen.reason)
    fit, pace, parts, name = seen.fit, seen.pace, seen.parts, groups[0].name
    inputs = [channel for group in groups for channel in group.channels[: group.inputs]]
    parts, fit = _at_phases(parts, fit, pace, periods, given, seen.limits)
    drift, seen = dict(zip(seen.channels, _drift(seen.sizes), strict=True)), replace(seen, fit=None)  # with residuals
    _refuse_drift(name, drift, largest_drift)
    findings = _with_stated_clock(seen.findings, clocks)
    refuse(name, findings)
    cycles = round(max(np.ptp(part.time) for part in parts) * fit.frequency)
    _warn(name, pace, cycles, seen, given is None)
    one_cycle, noise = _noises(seen, parts, fit, cycles)
    amplitudes, size = _by_channel(parts, fit)
    _refuse_undetermined(chosen, parts, seen.limits, fit.frequency)
    kept = {c: _last_significant(a, noise[c]) for c, a in amplitudes.items()} | chosen
    outputs = [channel for channel in amplitudes if channel not in inputs]
    if origin == CROSSING:
        start, amplitudes = _from_crossing(amplitudes, outputs[0], fit.frequency)
    used = {channel: slice(highest + 1) for channel, highest in kept.items()}
    folded = {channel: _fourier.on_grid(amplitudes[channel][part], points) for channel, part in used.items()}
    error = pace.se * periods if given is None else given[1]
    error *= error > ROUNDING * fit.frequency
    walks = given is None and error > 0.0
    return {
        "frequency": fit.frequency * periods,
        "frequency_se": error,
        "phase_diffusion": (2.0 * np.pi * periods) ** 2 * pace.diffusion * fit.frequency * walks,
        "period_drift": -pace.drift,
        "outputs": {channel: folded[channel] for channel in outputs},
        "inputs": {channel: folded[channel] for channel in inputs},
        "samples": samples,
        "periods": periods,
        "cycles": cycles,
        "averaged": min(size.values()),
        "scatter": {channel: float(np.sqrt(_power(one_cycle[channel][part]))) for channel, part in used.items()},
        "independent": {channel: 2 * kept[channel] + 1 for channel in outputs},
        "harmonics": kept,
        "amplitude_variance": {channel: noise[channel].variance[part] for channel, part in used.items()},
        "amplitude_freedom": {channel: noise[channel].freedom[part] for channel, part in used.items()},
        "left_out": _left_out(amplitudes, noise, {channel: kept[channel] for channel in outputs}),
        "error_slopes": _error_slopes(noise, inputs, kept, amplitudes),
        "periodicity": _periodicity(seen, fit),
        "drift": drift,
        "origin": start,
        # The phase of a channel that defines τ = 0 is not turned.
        "middle": {} if origin == CROSSING else {c: float(p.time.mean()) for p in parts for c in p.channels},
        "findings": tuple(findings),
        "clocks": others,
    }


def _with_stated_clock(findings: Sequence[Finding], clocks: Clocks | None) -> list[Finding]:
    """Return the findings; where one clock is stated, drifts are those of the system, which do not refuse."""
    return [replace(f, severity=SERIOUS) if clocks == ONE and f.kind == CLOCK else f for f in findings]


def _from_crossing(
    amplitudes: dict[str, np.ndarray], output: str, frequency: float
) -> tuple[float, dict[str, np.ndarray]]:
    """Return the first time ≥ 0 at which the fundamental of an output crosses zero upwards, and amplitudes from it."""
    phase = np.angle(amplitudes[output][1]) / (2 * np.pi)
    start = float((-0.25 - phase) % 1.0 / frequency)
    turn = 2j * np.pi * frequency * start
    return start, {c: a * np.exp(turn * np.arange(a.size)) for c, a in amplitudes.items()}


def _by_channel(parts: list[Signals], fit: CommonFit) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return by channel the amplitudes, and the number of samples."""
    amplitudes, sizes = {}, {}
    for part, one in zip(parts, fit.each, strict=True):
        for channel, values in zip(part.channels, one.amplitudes, strict=True):
            amplitudes[channel], sizes[channel] = values, part.time.size
    return amplitudes, sizes


def _noises(
    seen: Inspection, parts: list[Signals], fit: CommonFit, cycles: int
) -> tuple[dict[str, np.ndarray], dict[str, "AmplitudeNoise"]]:
    """Return by channel the variances of one cycle's amplitudes, and those of the mean with a transient's rest."""
    one_cycle, noise, row = {}, {}, 0
    start = parts[0].time[0]
    for group, part, one, inflation in zip(seen.groups, parts, fit.each, seen.inflation, strict=True):
        sampling = Sampling.of(part.time, fit.frequency, one.amplitudes.shape[1] - 1, cycles)
        for i, channel in enumerate(part.channels):
            one_cycle[channel], of_mean = _noise(part, one, i, sampling)
            squares = seen.steady.squares[row] if seen.steady else np.zeros(0)
            order = min(squares.size, of_mean.variance.size)
            of_mean.variance[:] *= inflation
            of_mean.variance[:order] += (squares * np.var(group.values[i]))[:order]
            # The phase of the noise beside the harmonics is that at the first sample of the group.
            turn = 2j * np.pi * fit.frequency * (start - part.time[0]) * np.arange(of_mean.variance.size)
            noise[channel] = replace(of_mean, beside=of_mean.beside * np.exp(turn))
            row += 1
    return one_cycle, noise


def given_frequency(frequency: Any) -> tuple[float, float] | None:
    """Return a given frequency and its standard error, zero for an exact one."""
    if frequency is None:
        return None
    if not isinstance(frequency, tuple | list):
        return _checks.positive("frequency", frequency), 0.0
    if len(frequency) != 2:
        raise ValueError(f"frequency: must be a number or (frequency, standard error), got {frequency!r}.")
    return _checks.positive("frequency", frequency[0]), _checks.positive("frequency[1]", frequency[1])


def automatic_periods(groups: list[Signals], frequency: float | None) -> "tuple[int, pd.DataFrame]":
    """Return the response period in drive periods, and its evidence, of the signals or else of their later half.

    Of several groups of channels it is the least common multiple, and the evidence is that of the longest one.
    """
    first = groups[leading(groups)]
    if frequency is None and not first.inputs:
        raise ValueError(
            f"frequency: must be given for periods={AUTO!r}, because {first.name!r} has no input that shows the "
            "drive period, got None."
        )
    drive = first_guess(first, frequency, 1)
    if frequency is None:
        part, tracked = counted_cycles(first.drive(), drive, given=False)
        driven = first.drive().part(part)
        groups = [group.part(within(group.time, driven.time)) for group in groups]
        time = even_times(driven.time, driven.values, tracked)
        highest = resolved_harmonics(time, tracked, time.size)
        drive = refine_frequency(time, driven.values, tracked, highest)[0].frequency
    each = []
    for group in groups:
        chosen, evidence = _response_period(group, drive)
        if chosen is None:
            raise aperiodic(first.name, drive, evidence)
        each.append((chosen, evidence))
    return math.lcm(*(chosen for chosen, _ in each)), max(each, key=lambda one: one[0])[1]


def _response_period(signals: Signals, drive: float) -> "tuple[int | None, pd.DataFrame]":
    """Return the response period of channels with common times, None if there is none, and its evidence."""
    time, values = even_times(signals.time, signals.values, drive), signals.values
    chosen, evidence = response_period(time, values, signals.channels, drive)
    later = time >= 0.5 * (time[0] + time[-1])
    if chosen is None and cycles_of(time[later], drive) >= LATER_CYCLES:
        chosen, again = response_period(time[later], values[:, later], signals.channels, drive, LATER_CYCLES)
        evidence = evidence if chosen is None else again
    return chosen, evidence


def _at_phases(
    parts: list[Signals],
    fit: CommonFit,
    pace: Pace,
    periods: int,
    given: tuple[float, float] | None,
    limits: list[int],
) -> tuple[list[Signals], CommonFit]:
    """Return the steady parts and their fit: at a given frequency, or as it is, or at times that follow its phase."""
    if given is not None:
        duration = float(max(np.ptp(part.time) for part in parts))
        other = fit_groups(parts, given[0] / periods, limits)
        _refuse_frequency(fit, other, pace, duration, periods, given[1] / periods)
        return parts, other
    if not pace.diffusion or len(parts) > 1 or parts[0].inputs:
        return parts, fit
    # The cycles of a free-running oscillation are compared at equal phases; others would smear its harmonics.
    ahead = followed_phase(parts[0].time, parts[0].values, fit.each[0], pace.diffusion)
    parts = [replace(parts[0], time=parts[0].time + ahead / fit.frequency)]
    return parts, fit_groups(parts, fit.frequency, limits)


def _refuse_frequency(
    estimated: CommonFit, given: CommonFit, pace: Pace, duration: float, periods: int, error: float
) -> None:
    """Raise a ValueError if the given frequency, with its standard error, is not that of the recording."""
    difference = given.frequency - estimated.frequency
    # Few cycles have too few degrees of freedom for a test, but noise of any kind would not shrink so much.
    shrinks = np.mean(np.log(given.variances / estimated.variances)) > np.log(CLEARLY)
    clear = shrinks and abs(difference) * duration > (LARGEST_PHASE_DRIFT if error else NEGLIGIBLE_PHASE)
    if clear or (explains_more(estimated, given) and pace.differs(difference, duration, error)):
        raise ValueError(
            f"frequency: must be that of the recording, which is estimated as {estimated.frequency * periods:.9g} Hz "
            f"with a standard error of {pace.se * periods:.1g} Hz, got {given.frequency * periods:.9g} Hz, whose phase "
            f"drifts by {360.0 * abs(difference) * duration:.2g}° of the response period over the cycles used; correct "
            "it, or leave it out to use the estimate."
        )


def _warn(name: str, pace: Pace, cycles: int, seen: Inspection, estimated: bool) -> None:
    """Warn of a period that drifts, and of a steady part that is less than half of the recording."""
    total = seen.total
    if pace.drifts:
        warnings.warn(
            f"{name}: the period changes by {-pace.drift:+.2%} over the {cycles} cycles used (of {total}). The mean "
            "period and its frequency assume a constant one, and their stated errors do not contain the change; select "
            "a steadier part with `between`.",
            stacklevel=4,
        )
    elif pace.wander:
        followed = estimated and pace.diffusion > 0.0 and not any(group.inputs for group in seen.groups)
        warnings.warn(
            f"{name}: the phase wanders irregularly by {360.0 * pace.wander:.2g}° of the response period over the "
            f"{cycles} cycles used, while the amplitude is steadier. "
            + (
                "The mean period follows the phase, and the standard error of the frequency contains its random walk; "
                "slow changes of the frequency by other causes are not told from it."
                if followed
                else "The mean period assumes a constant frequency: its higher harmonics are smeared. Fold shorter "
                "parts with `between`, or measure with a steadier drive or clock."
            ),
            stacklevel=4,
        )
    elif cycles <= total // 2:
        last = seen.used[0].stop == seen.groups[0].time.size
        which, others = ("the last ", "those before") if last else ("", "the others")
        warnings.warn(
            f"{name}: only {which}{cycles} of {total} cycles are used, because {others} differ from them: a long "
            "transient, a drift, or several records in one. Check the recording, and select a part with `between` or "
            "`split`.",
            stacklevel=4,
        )


def _drift(sizes: np.ndarray) -> list[float]:
    """Return the relative growth of amplitudes (windows, channels) over the recording."""
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


def _periodicity(seen: Inspection, fit: CommonFit) -> float:
    total = np.concatenate([np.var(part.values, axis=1, ddof=1) for part in seen.parts])
    explained, channels, name = 1.0 - fit.variances / total, seen.channels, seen.groups[0].name
    worst = int(np.argmin(explained))
    if not explained[worst] >= MINIMUM_PERIODICITY:
        good = [c for c, share in zip(channels, explained, strict=True) if share >= CLEARLY_PERIODIC]
        cure = "check the frequency and `periods`, and separate records of different frequencies by `split`"
        if good:
            cure = (
                f"{good[0]!r} is periodic ({explained[channels.index(good[0])]:.1%}): a sensor without a "
                f"signal, or noise; leave the channel {channels[worst]!r} out"
            )
        raise ValueError(
            f"recording: must be periodic, got {name!r}, whose mean period at {fit.frequency:.6g} Hz explains "
            f"only {max(explained[worst], 0.0):.1%} of the variance of {channels[worst]!r} (periodicity "
            f"{explained[worst]:.3f}, at least {MINIMUM_PERIODICITY} is needed); {cure}."
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


def _noise(signals: Signals, fit: HarmonicFit, row: int, sampling: Sampling) -> tuple[np.ndarray, AmplitudeNoise]:
    """Return the variances of one cycle's complex amplitudes, (harmonics + 1,), and the noise of the mean's.

    The spectrum of the K cycles has lines at multiples of 1/K of the fundamental, and those between the harmonics
    contain noise only. The variance at a harmonic is the mean over the nearest of these lines on both sides, plus that
    of quantisation errors that repeat in every cycle.
    """
    residuals, harmonic = fit.residuals[row], np.arange(fit.amplitudes.shape[1])
    amplitude, deviation = sampling.lines(residuals, harmonic.size)
    sides = len(sampling.left) // 2
    beside = np.concatenate([amplitude[:sides, harmonic], np.conj(amplitude[:sides, -harmonic])])
    near = np.sum(np.abs(beside) ** 2, axis=0) / np.maximum(sampling.left.sum(axis=0), LEAST_LEFT)
    freedom = sampling.freedom.copy()
    near[0], freedom[0] = sampling.at_zero(amplitude)
    repeated = _repeated_error(signals.values[row], residuals, fit.amplitudes[row], sampling.phase, sampling.grid)
    # Satterthwaite; how the repeated error is distributed over the harmonics is hardly known.
    uncertain = near**2 / freedom + repeated**2 / REPEATED_FREEDOM
    total = np.divide((near + repeated) ** 2, uncertain, out=freedom.copy(), where=uncertain > 0.0)
    near += repeated
    scale = np.where(harmonic == 0, 1.0, 4.0)
    one_cycle = scale * np.sum(np.abs(deviation) ** 2, axis=0) / (len(deviation) - 1)
    return one_cycle, AmplitudeNoise(scale * near, total, freedom, beside)


def _error_slopes(
    noise: Mapping[str, AmplitudeNoise],
    inputs: Sequence[str],
    kept: Mapping[str, int],
    amplitudes: Mapping[str, np.ndarray],
) -> dict[str, dict[str, np.ndarray]]:
    """Return the regression of the errors of outputs on those of inputs, by input and output, where they correlate.

    That none of the harmonics from the first on does is tested by their coherences γ², of which −2(n − 1)·ln(1 − γ²)
    has the distribution χ² with two degrees of freedom for n lines. Slopes are averaged over neighbouring harmonics.
    Rounding errors of an input cause nothing.
    """
    slopes: dict[str, dict[str, np.ndarray]] = {}
    for name in inputs:
        if np.abs(noise[name].beside).max(initial=0.0) < ROUNDING * np.abs(amplitudes[name]).max():
            continue
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


def _left_out(
    amplitudes: Mapping[str, np.ndarray], noise: Mapping[str, AmplitudeNoise], kept: Mapping[str, int]
) -> dict[str, LeftOut]:
    """Return the harmonics above those kept, by channel, where there are any."""
    result = {}
    for channel, highest in kept.items():
        above = np.arange(highest + 1, min(amplitudes[channel].size, noise[channel].variance.size))
        if above.size:
            values = amplitudes[channel], noise[channel].variance, noise[channel].freedom
            result[channel] = LeftOut(above, *(value[above] for value in values))
    return result


def neighbours_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return Σ values/Σ weights (harmonics + 1,), the sums over neighbouring harmonics, but not with the mean value."""
    window, result = np.ones(2 * POOLED + 1), np.zeros(values.shape, dtype=values.dtype)
    np.divide(values[:1], weights[:1], out=result[:1], where=weights[:1] > 0.0)
    middle = slice(POOLED, POOLED + values.size - 1)
    total, weight = (np.convolve(terms[1:], window)[middle] for terms in (values, weights))
    np.divide(total, weight, out=result[1:], where=weight > 0.0)
    return result


def _repeated_error(
    values: np.ndarray, residuals: np.ndarray, amplitudes: np.ndarray, phase: np.ndarray, points: int
) -> float:
    """Return the variance of the mean over a cycle due to repeated quantisation errors; `phase` is in cycles."""
    if not (step := rounded_step(values, phase)) > 0.0:
        return 0.0
    place = nearest(phase, points)
    place %= points
    count = np.bincount(place, minlength=points)
    square = residuals @ residuals - np.sum(np.bincount(place, residuals, points) ** 2 / np.maximum(count, 1))
    phases = np.count_nonzero(count)
    again = values.size - phases
    if not again:
        return 0.0
    fitted = _fourier.on_grid(amplitudes, points)
    return repeated_variance(step, fitted, int(phases), scatter=square / again)


def _last_significant(amplitudes: np.ndarray, noise: AmplitudeNoise) -> int:
    tested = amplitudes.size - 1
    floor = (1e-12 * np.abs(amplitudes).max()) ** 2
    ratio = np.abs(amplitudes[1:]) ** 2 / np.maximum(noise.variance[1:], floor)
    significant = fdtrc(2, noise.lines[1:], ratio) < FALSE_ALARM_RATE / tested
    return int(np.flatnonzero(significant)[-1]) + 1 if significant.any() else 1


def _chosen(harmonics: int | Mapping[str, int] | None, names: Sequence[str]) -> dict[str, int]:
    """Return the harmonics that are asked for, by channel."""
    if harmonics is None:
        return {}
    given = harmonics if isinstance(harmonics, Mapping) else dict.fromkeys(names, harmonics)
    for channel, count in given.items():
        _checks.one_of("harmonics", channel, names)
        _checks.integer(f"harmonics[{channel!r}]", count, 1)
    return {channel: int(count) for channel, count in given.items()}


def _refuse_undetermined(chosen: Mapping[str, int], parts: list[Signals], limits: list[int], frequency: float) -> None:
    """Raise a ValueError if the samples do not determine the harmonics that are asked for."""
    for part, limit in zip(parts, limits, strict=True):
        for channel in part.channels:
            if (count := chosen.get(channel, 0)) > limit:
                raise ValueError(
                    f"harmonics[{channel!r}]: must be at most {limit}, which the samples and the grid resolve, got "
                    f"{count} (with {missing_phases(part.time, frequency)})."
                )


def _power(variance: np.ndarray) -> float:
    """Return the variance of a signal whose complex amplitudes have these variances."""
    return float(variance[0] + 0.5 * variance[1:].sum())
