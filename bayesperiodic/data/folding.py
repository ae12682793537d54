"""Estimation of the mean steady period of sampled signals, and of its uncertainty."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.special import fdtrc, softmax

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.quantisation import repeated_variance

MAXIMUM_HARMONICS = 600
SIGNIFICANT_POWER = 10.0
MINIMUM_CYCLES = 3
MINIMUM_PERIODICITY = 0.5
FALSE_ALARM_RATE = 0.01
CROSSING = "crossing"

# The spectrum of the noise: grid points a sample, and neighbouring lines on each side of a harmonic.
FINENESS, NEIGHBOURS = 4, 16
# Degrees of freedom of the variance of repeated errors, less than of any measured one.
REPEATED_FREEDOM = 3.0
# Lines from which frequency zero is extrapolated: for the kind of noise, and for the level of white and slow noise.
LINES, WHITE_LINES, SLOW_LINES = 40, 8, 2
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

    def part(self, samples: np.ndarray) -> "Signals":
        """Return the signals at the selected samples."""
        return replace(self, time=self.time[samples], values=self.values[:, samples])


@dataclass(frozen=True)
class HarmonicFit:
    """A Fourier series fitted to several channels."""

    frequency: float  # fundamental frequency [Hz]
    amplitudes: np.ndarray  # complex, as in `_fourier`, with phases relative to time 0, (channels, harmonics + 1)
    residuals: np.ndarray  # (channels, samples)

    @property
    def variances(self) -> np.ndarray:
        """Residual variance of each channel, (channels,)."""
        degrees_of_freedom = max(self.residuals.shape[1] - (2 * self.amplitudes.shape[1] - 1), 1)
        return np.sum(self.residuals**2, axis=1) / degrees_of_freedom


def fit_harmonics(time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int) -> HarmonicFit:
    """Fit harmonics 0 … `harmonics` of `frequency` to channels (channels, samples) by least squares.

    The normal matrix of exp(2πi h f t), h = −H … H, is Hermitian Toeplitz, and well conditioned if the samples resolve
    the highest harmonic.
    """
    turn = np.exp(-2j * np.pi * frequency * time)
    power = np.ones_like(turn)
    moments = np.empty(2 * harmonics + 1, dtype=complex)
    right = np.empty((2 * harmonics + 1, len(channels)), dtype=complex)
    for h in range(2 * harmonics + 1):
        moments[h] = power.sum()
        if h <= harmonics:
            right[harmonics + h] = channels @ power
            right[harmonics - h] = np.conj(right[harmonics + h])
        power *= turn
    amplitudes = solve_toeplitz((moments, np.conj(moments)), right)[harmonics:].T.copy()
    amplitudes[:, 1:] *= 2.0
    phase = frequency * time
    residuals = np.stack([y - _fourier.at_times(c, phase) for y, c in zip(channels, amplitudes, strict=True)])
    return HarmonicFit(frequency, amplitudes, residuals)


def refine_frequency(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int, iterations: int = 20
) -> tuple[HarmonicFit, float]:
    """Return the fit at the least-squares frequency, and that frequency's standard error [Hz].

    Gauss-Newton iteration for the fundamental, with the amplitudes projected out and every channel weighted by its
    residual variance. The standard error is robust to correlation within a cycle, because the scores are summed over
    each cycle before they are squared; it is at least that for independent samples.
    """
    for _ in range(iterations):
        fit, slope, weights = _linearised(time, channels, frequency, harmonics)
        information = float(np.sum(weights * np.sum(slope**2, axis=1)))
        step = float(np.sum(weights * np.sum(slope * fit.residuals, axis=1))) / information
        limit = 0.25 / np.ptp(time)
        frequency += np.clip(step, -limit, limit)
        if abs(step) < max(1e-6 / np.sqrt(information), np.finfo(float).eps * frequency):
            break
    fit, slope, weights = _linearised(time, channels, frequency, harmonics)
    cycle = np.floor((time - time[0]) * frequency).astype(int)
    scores = np.sum(weights[:, None] * slope * fit.residuals, axis=0)
    clustered = float(np.sum(np.bincount(cycle, scores) ** 2))
    return fit, float(np.sqrt(max(clustered, information))) / information


def _linearised(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int
) -> tuple[HarmonicFit, np.ndarray, np.ndarray]:
    fit = fit_harmonics(time, channels, frequency, harmonics)
    noise = 4.0 * fit.variances[:, None] / time.size
    power = np.abs(fit.amplitudes) ** 2
    # The slope contains the largest and the significant harmonics; noise in the others would count as information.
    largest = power[:, 1:].max(axis=1, keepdims=True)
    clear = np.where((power > SIGNIFICANT_POWER * noise) | (power == largest), fit.amplitudes, 0.0)
    rate = _fourier.derivative(clear, 1.0)
    slope = np.stack([_fourier.at_times(c, frequency * time) for c in rate]) * (time - time.mean())
    slope = fit_harmonics(time, slope, frequency, harmonics).residuals
    floor = 1e-24 * np.var(channels, axis=1)
    return fit, slope, 1.0 / np.maximum(fit.variances, floor)


def guess_frequency(time: np.ndarray, channels: np.ndarray) -> float | None:
    """Estimate the fundamental frequency [Hz] from the autocorrelation; None if it has no positive peak.

    The lag is the smallest one whose peak reaches 90 % of the highest.
    """
    samples = time.size
    step = (time[-1] - time[0]) / (samples - 1)
    even = time[0] + step * np.arange(samples)
    correlation = np.zeros(samples)
    for values in channels:
        signal = np.interp(even, time, values)
        signal = (signal - signal.mean()) / signal.std()
        power = np.abs(np.fft.rfft(signal, 2 * samples)) ** 2
        correlation += np.fft.irfft(power)[:samples] / np.arange(samples, 0, -1)
    correlation = correlation[: samples // 3 + 2]
    negative = np.flatnonzero(correlation < 0.5 * correlation[0])
    if negative.size == 0:
        return None
    inside = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inside >= correlation[:-2]) & (inside > correlation[2:]))
    peaks = peaks[(peaks > negative[0]) & (correlation[peaks] > 0.0)]
    if peaks.size == 0:
        return None
    lag = peaks[np.flatnonzero(correlation[peaks] >= 0.9 * correlation[peaks].max())[0]]
    left, top, right = correlation[lag - 1 : lag + 2]
    bend = left - 2.0 * top + right
    offset = 0.5 * (left - right) / bend if bend else 0.0
    return _largest_equivalent(time, channels, 1.0 / ((lag + offset) * step))


def _largest_equivalent(time: np.ndarray, channels: np.ndarray, frequency: float) -> float:
    """Return the largest multiple of a frequency that explains the signals equally well."""
    last = time >= time[-1] - 6.0 / frequency
    time, channels = time[last], channels[:, last]
    nyquist = 0.5 * (time.size - 1) / np.ptp(time)
    top = min(0.95 * nyquist, MAXIMUM_HARMONICS * frequency)

    def unexplained(candidate: float) -> float:
        fit = fit_harmonics(time, channels, candidate, max(int(top / candidate), 1))
        return float(np.max(fit.variances / np.var(channels, axis=1)))

    reference = unexplained(frequency)
    for factor in (5, 4, 3, 2):
        candidate = factor * frequency
        if candidate < top and reference < 0.5 and unexplained(candidate) <= 1.2 * reference + 1e-9:
            return candidate
    return frequency


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
    if isinstance(origin, str) and origin != CROSSING:
        raise ValueError(f"origin: must be a time [s] or {CROSSING!r}, got {origin!r}.")
    start = 0.0 if origin == CROSSING else _checks.finite_number("origin", origin)
    signals = replace(signals, time=signals.time - start)
    fundamental = _first_guess(signals, frequency, periods)
    if frequency is None:
        fundamental = _track(signals, fundamental)
    cycle, shape = _cycles_apart(signals, fundamental)
    drift = dict(zip(signals.channels, _drift(shape[::-1]), strict=True))
    _refuse_drift(signals.name, drift, largest_drift)
    steady = signals.part(_steady_part(cycle, shape))
    limit = _resolved(steady.time, fundamental, points)
    if frequency is None:
        fit, fundamental_se = refine_frequency(steady.time, steady.values, fundamental, limit)
    else:
        fit, fundamental_se = fit_harmonics(steady.time, steady.values, fundamental, limit), 0.0
    periodicity = _periodicity(steady, fit)
    cycles = round(np.ptp(steady.time) * fit.frequency)
    one_cycle, noise = zip(*(_noise(steady, fit, row, cycles) for row in range(len(steady.values))), strict=True)
    significant = [_last_significant(a, own) for a, own in zip(fit.amplitudes, noise, strict=True)]
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

    folded = by_channel(_fourier.on_grid(a[own], points) for a, own in zip(amplitudes, used, strict=True))
    inputs, outputs = signals.channels[: signals.inputs], signals.channels[signals.inputs :]
    return {
        "frequency": fit.frequency * periods,
        "frequency_se": fundamental_se * periods,
        "outputs": {channel: folded[channel] for channel in outputs},
        "inputs": {channel: folded[channel] for channel in inputs},
        "samples": samples,
        "periods": periods,
        "cycles": cycles,
        "averaged": steady.time.size,
        "scatter": by_channel(float(np.sqrt(_power(v[own]))) for v, own in zip(one_cycle, used, strict=True)),
        "independent": {channel: min(2 * kept[channel] + 1, steady.time.size) for channel in outputs},
        "harmonics": kept,
        "amplitude_variance": by_channel(v.variance[own] for v, own in zip(noise, used, strict=True)),
        "amplitude_freedom": by_channel(v.freedom[own] for v, own in zip(noise, used, strict=True)),
        "periodicity": periodicity,
        "drift": drift,
        "origin": start,
    }


def _first_guess(signals: Signals, frequency: float | None, periods: int) -> float:
    remedy = "give the forcing frequency"
    if frequency is not None:
        fundamental: float | None = _checks.positive("frequency", frequency) / periods
        remedy = f"check frequency = {frequency!r} Hz and periods = {periods}"
    elif signals.inputs:
        guess = guess_frequency(signals.time, signals.values[: signals.inputs])
        fundamental = guess / periods if guess else None
    else:
        fundamental = guess_frequency(signals.time, signals.values)
    if fundamental is None or _cycles(signals.time, fundamental) < MINIMUM_CYCLES:
        found = "no period" if fundamental is None else f"{_cycles(signals.time, fundamental):.2f} cycles"
        raise ValueError(
            f"recording: must have at least {MINIMUM_CYCLES} cycles, got {found} in {signals.name!r} of "
            f"{np.ptp(signals.time):g} s; record longer, or {remedy}."
        )
    return fundamental


def _cycles(time: np.ndarray, fundamental: float) -> float:
    """Return the number of cycles, the last sample's step included."""
    return float(np.ptp(time) * time.size / (time.size - 1) * fundamental * (1 + 1e-9))


def _track(signals: Signals, fundamental: float) -> float:
    """Refine a frequency on the last few cycles, then on more and more of them, so that no cycle is miscounted."""
    time = signals.time
    cycles, total = MINIMUM_CYCLES, np.ptp(time) * fundamental
    while True:
        last = signals.part(time >= time[-1] - cycles / fundamental)
        few = min(10, _resolved(last.time, fundamental, time.size))
        fundamental = refine_frequency(last.time, last.values, fundamental, few)[0].frequency
        if cycles >= total / 2:
            return fundamental
        cycles = min(2 * cycles, total / 2)


def _resolved(time: np.ndarray, fundamental: float, points: int) -> int:
    per_cycle = (time.size - 1) / (np.ptp(time) * fundamental)
    resolved = min(int((per_cycle - 1.0) / 2.0), _fourier.highest_harmonic(points), (time.size - 2) // 2)
    if resolved < 1:
        raise ValueError(
            f"recording: must have at least 3 samples per cycle, to resolve the fundamental, got {per_cycle:.1f}; "
            "sample faster, or check the frequency."
        )
    return resolved


def _cycles_apart(signals: Signals, fundamental: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the cycle of each sample, counted back from the end, and the amplitudes of the whole cycles, last first.

    The amplitudes (cycles, channels, harmonics + 1) are relative to each channel's standard deviation.
    """
    time, values = signals.time, signals.values
    period = 1.0 / fundamental
    total = int(_cycles(time, fundamental))
    back = np.minimum(((time[-1] - time) / period + 1e-9).astype(int), total)
    harmonics = min(5, _resolved(time, fundamental, time.size))
    scale = values.std(axis=1)[:, None]
    ends = np.searchsorted(-back, np.arange(1 - total, 2))[::-1]
    parts = [slice(first, last) for first, last in zip(ends[1:], ends[:-1], strict=True)]
    fits = [fit_harmonics(time[part], values[:, part] / scale, fundamental, harmonics) for part in parts]
    return back, np.array([fit.amplitudes for fit in fits])


def _drift(shape: np.ndarray) -> list[float]:
    """Return the relative growth of each channel's fundamental from the first cycle to the last."""
    size = np.abs(shape[:, :, 1])
    number = np.arange(len(size)) - 0.5 * (len(size) - 1)
    return (number @ size / (number @ number) * len(size) / size.mean(axis=0)).tolist()


def _refuse_drift(name: str, drift: Mapping[str, float], largest: float | None) -> None:
    if largest is None:
        return
    worst = max(drift, key=lambda channel: abs(drift[channel]))
    if abs(drift[worst]) > _checks.positive("largest_drift", largest):
        raise ValueError(
            f"recording: must be steady, got {name!r}, in which the fundamental of {worst!r} changes by "
            f"{drift[worst]:+.1%}, more than largest_drift = {largest:.1%}; leave it out, or select a steady part with "
            "`between`."
        )


def _steady_part(cycle: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return a mask of the last whole cycles, without the first ones if they differ from the later half."""
    total = len(shape)
    half = max(total // 2, MINIMUM_CYCLES)
    middle = np.median(shape[:half].real, axis=0) + 1j * np.median(shape[:half].imag, axis=0)
    distance = np.max(np.sqrt(np.sum(np.abs(shape - middle) ** 2, axis=2)), axis=1)
    settled = distance <= 3.0 * np.median(distance[:half]) + 1e-9
    used = total
    while used > MINIMUM_CYCLES and not settled[used - 1 - min(2, used - 1) : used].all():
        used -= 1
    return cycle < used


def _periodicity(signals: Signals, fit: HarmonicFit) -> float:
    explained = 1.0 - fit.variances / np.var(signals.values, axis=1, ddof=1)
    worst = int(np.argmin(explained))
    if not explained[worst] >= MINIMUM_PERIODICITY:
        raise ValueError(
            f"recording: must be periodic, got {signals.name!r}, whose mean period at {fit.frequency:.6g} Hz explains "
            f"only {max(explained[worst], 0.0):.1%} of the variance of {signals.channels[worst]!r} (periodicity "
            f"{explained[worst]:.3f}, at least {MINIMUM_PERIODICITY} is needed); check the frequency and `periods`."
        )
    return float(explained[worst])


@dataclass(frozen=True)
class AmplitudeNoise:
    """Variances of the mean period's complex amplitudes, and their degrees of freedom, (harmonics + 1,) each.

    `lines` are those of the part that was measured.
    """

    variance: np.ndarray
    freedom: np.ndarray
    lines: np.ndarray


def _noise(signals: Signals, fit: HarmonicFit, row: int, cycles: int) -> tuple[np.ndarray, AmplitudeNoise]:
    """Return the variances of one cycle's complex amplitudes, (harmonics + 1,), and the noise of the mean's.

    The spectrum of the K cycles has lines at multiples of 1/K of the fundamental, and those between the harmonics
    contain noise only. The variance at a harmonic is the mean over the nearest of these lines on both sides, plus that
    of quantisation errors that repeat in every cycle.
    """
    time, residuals = signals.time, fit.residuals[row]
    per_cycle = (time.size - 1) / (np.ptp(time) * fit.frequency)
    # On a grid in phase, finer than the samples, the lines are those of a discrete Fourier transform at any sampling.
    points = FINENESS * int(np.ceil(per_cycle - 1e-6))
    place = np.minimum(np.rint((time - time[0]) * fit.frequency * points).astype(int), points * cycles - 1)
    signal = np.bincount(place, residuals, points * cycles)
    harmonic = np.arange(fit.amplitudes.shape[1])
    size = np.bincount(place // points, minlength=cycles)[:, None]
    deviation = np.fft.rfft(signal.reshape(cycles, points), axis=1)[:, harmonic] / size
    power = np.abs(np.fft.rfft(signal) / time.size) ** 2
    side = np.arange(1, np.clip(cycles // 4, min(4, cycles // 2), NEIGHBOURS) + 1)
    near = power[np.abs(harmonic[:, None] * cycles + np.concatenate([side, -side]))].mean(axis=1)
    freedom = np.full(harmonic.size, 4.0 * side.size)
    lines = np.arange(1, power.size)
    near[0], freedom[0] = _at_zero(power[lines[lines % cycles > 0][:LINES]])
    repeated = _repeated_error(signals.values[row], residuals, fit.amplitudes[row], place % points, points)
    # Satterthwaite; how the repeated error is distributed over the harmonics is hardly known.
    uncertain = near**2 / freedom + repeated**2 / REPEATED_FREEDOM
    total = np.divide((near + repeated) ** 2, uncertain, out=freedom.copy(), where=uncertain > 0.0)
    near += repeated
    scale = np.where(harmonic == 0, 1.0, 4.0)
    one_cycle = scale * np.sum(np.abs(deviation) ** 2, axis=0) / (cycles - 1)
    return one_cycle, AmplitudeNoise(scale * near, total, freedom)


def _repeated_error(
    values: np.ndarray, residuals: np.ndarray, amplitudes: np.ndarray, phase: np.ndarray, points: int
) -> float:
    """Return the variance of the mean over a cycle due to repeated quantisation errors; `phase` are grid points."""
    count = np.bincount(phase, minlength=points)
    square = np.sum(residuals**2) - np.sum(np.bincount(phase, residuals, points) ** 2 / np.maximum(count, 1))
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
