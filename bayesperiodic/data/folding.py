"""Estimation of the mean steady period of sampled signals, and of its uncertainty; division of records of several."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc, fdtrc, softmax

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.harmonics import (
    NEGLIGIBLE_PHASE,
    HarmonicFit,
    Pace,
    fit_harmonics,
    followed_phase,
    refine_frequency,
    resolved_harmonics,
    track_frequency,
)
from bayesperiodic.data.inspection import Inspection, inspect
from bayesperiodic.data.quantisation import REPEATED_FREEDOM, repeated_variance
from bayesperiodic.data.recording_check import refuse
from bayesperiodic.data.response_period import FALSE_ALARM_RATE, FINENESS, aperiodic, even_times, response_period
from bayesperiodic.data.signals import Signals, cycles_of, explains_more, first_guess, refuse_gaps

if TYPE_CHECKING:
    import pandas as pd

# Spreads of a channel whose squares and inverse squares are ordinary numbers, and grid points of a response period.
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


def fold_signals(
    signals: Signals,
    samples: int,
    periods: int,
    given: tuple[float, float] | None,  # frequency and standard error
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
    seen = inspect(replace(signals, time=signals.time - start), periods, given and given[0], points)
    if seen.steady is None or seen.fit is None or seen.sizes is None:
        raise ValueError(seen.reason)
    fit, pace, limit = seen.fit, seen.pace, seen.limit
    steady, fit = _at_phases(seen.signals.part(seen.steady.samples), fit, pace, periods, given)
    drift = dict(zip(signals.channels, _drift(seen.sizes), strict=True))
    _refuse_drift(signals.name, drift, largest_drift)
    refuse(signals.name, seen.findings)
    cycles = round(np.ptp(steady.time) * fit.frequency)
    _warn(signals.name, pace, cycles, seen, given is None)
    one_cycle, noise = zip(*(_noise(steady, fit, row, cycles) for row in range(len(steady.values))), strict=True)
    for row, squares in enumerate(seen.steady.squares):
        order = min(squares.size, noise[row].variance.size)
        noise[row].variance[:] *= seen.inflation
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
        "frequency_se": pace.se * periods if given is None else given[1],
        "phase_diffusion": (2.0 * np.pi * periods) ** 2 * pace.diffusion * fit.frequency if given is None else 0.0,
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
        "periodicity": _periodicity(steady, fit),
        "drift": drift,
        "origin": start,
        "middle": {} if origin == CROSSING else dict.fromkeys(signals.channels, float(steady.time.mean())),
        "findings": seen.findings,
    }


def given_frequency(frequency: Any) -> tuple[float, float] | None:
    """Return a given frequency and its standard error, zero for an exact one."""
    if frequency is None:
        return None
    if not isinstance(frequency, tuple | list):
        return _checks.positive("frequency", frequency), 0.0
    if len(frequency) != 2:
        raise ValueError(f"frequency: must be a number or (frequency, standard error), got {frequency!r}.")
    return _checks.positive("frequency", frequency[0]), _checks.positive("frequency[1]", frequency[1])


def automatic_periods(signals: Signals, frequency: float | None) -> "tuple[int, pd.DataFrame]":
    """Return the response period in drive periods, and its evidence, of the signals or else of their later half."""
    if frequency is None and not signals.inputs:
        raise ValueError(
            f"frequency: must be given for periods={AUTO!r}, because {signals.name!r} has no input that shows the "
            "drive period, got None."
        )
    drive = first_guess(signals, frequency, 1)
    refuse_gaps(signals, drive)
    time, values = signals.time, signals.values
    if frequency is None:
        driven = values[: signals.inputs]
        tracked = track_frequency(time, driven, drive)
        time = even_times(time, driven, tracked)
        drive = refine_frequency(time, driven, tracked, resolved_harmonics(time, tracked, time.size))[0].frequency
    time = even_times(time, values, drive)
    chosen, evidence = response_period(time, values, signals.channels, drive)
    later = time >= 0.5 * (time[0] + time[-1])
    if chosen is None and cycles_of(time[later], drive) >= LATER_CYCLES:
        chosen, again = response_period(time[later], values[:, later], signals.channels, drive, LATER_CYCLES)
        evidence = evidence if chosen is None else again
    if chosen is None:
        raise aperiodic(signals.name, drive, evidence)
    return chosen, evidence


def _at_phases(
    steady: Signals, fit: HarmonicFit, pace: Pace, periods: int, given: tuple[float, float] | None
) -> tuple[Signals, HarmonicFit]:
    """Return the steady part and its fit: at a given frequency, or as it is, or at times that follow its phase."""
    limit = fit.amplitudes.shape[1] - 1
    if given is not None:
        other = fit_harmonics(steady.time, steady.values, given[0] / periods, limit)
        _refuse_frequency(fit, other, pace, float(np.ptp(steady.time)), periods, given[1] / periods)
        return steady, other
    if not pace.diffusion or steady.inputs:
        return steady, fit
    # The cycles of a free-running oscillation are compared at equal phases; others would smear its harmonics.
    ahead = followed_phase(steady.time, steady.values, fit, pace.diffusion)
    steady = replace(steady, time=steady.time + ahead / fit.frequency)
    return steady, fit_harmonics(steady.time, steady.values, fit.frequency, limit)


def _refuse_frequency(
    estimated: HarmonicFit, given: HarmonicFit, pace: Pace, duration: float, periods: int, error: float
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
            UserWarning,
            stacklevel=4,
        )
    elif pace.wander:
        followed = estimated and pace.diffusion > 0.0 and not seen.signals.inputs
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
            UserWarning,
            stacklevel=4,
        )
    elif cycles < total and cycles <= total // 2:
        last = seen.steady is not None and seen.steady.samples.stop == seen.signals.time.size
        which, others = ("the last ", "those before") if last else ("", "the others")
        warnings.warn(
            f"{name}: only {which}{cycles} of {total} cycles are used, because {others} differ from them: a long "
            "transient, a drift, or several records in one. Check the recording, and select a part with `between` or "
            "`split`.",
            UserWarning,
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


def _periodicity(signals: Signals, fit: HarmonicFit) -> float:
    explained = 1.0 - fit.variances / np.var(signals.values, axis=1, ddof=1)
    worst = int(np.argmin(explained))
    if not explained[worst] >= MINIMUM_PERIODICITY:
        good = [c for c, share in zip(signals.channels, explained, strict=True) if share >= CLEARLY_PERIODIC]
        cure = "check the frequency and `periods`, and separate records of different frequencies by `split`"
        if good:
            cure = (
                f"{good[0]!r} is periodic ({explained[signals.channels.index(good[0])]:.1%}): a sensor without a "
                f"signal, or noise; leave the channel {signals.channels[worst]!r} out"
            )
        raise ValueError(
            f"recording: must be periodic, got {signals.name!r}, whose mean period at {fit.frequency:.6g} Hz explains "
            f"only {max(explained[worst], 0.0):.1%} of the variance of {signals.channels[worst]!r} (periodicity "
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
