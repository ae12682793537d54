"""Fourier series of sampled signals whose fundamental frequency is unknown: fits, frequencies, walks of the phase."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_toeplitz, solveh_banded
from scipy.special import fdtri, softmax, stdtrit

from bayesperiodic import _fourier
from bayesperiodic.data.coverage import covered_harmonics

MAXIMUM_HARMONICS = 600
SIGNIFICANT_POWER = 10.0
MINIMUM_CYCLES = 3
# Cycles of a stretch from which its frequency is tracked, fewest samples in them, and fewest to begin with.
TRACKED, FEWEST_TRACKED, FEWEST_REFINED = 48, 384, 12
# Deviations of the phase [cycles] below this are of no consequence; others count if they are not explained by noise.
NEGLIGIBLE_PHASE, PHASE_FALSE_ALARM = 1.0 / 360.0, 1e-4
# Gauss-Newton steps towards a wandering phase.
PHASE_ITERATIONS = 4
MOST_FREQUENCY_STEPS = 20
# Cycles from which a random walk is looked for.
FEWEST_PHASES = 8
# Variances of the walk's step that are tried, so many of them, by what they contribute to the variance of the slope
# relative to the noise of one cycle; and the gain in ln L that shows a walk, with false alarms in about 1 %.
STEP_RANGE, STEPS_TRIED, LEAST_GAIN = (1e-1, 1e6), 60, 2.0


@dataclass(frozen=True)
class HarmonicFit:
    """A Fourier series fitted to several channels."""

    frequency: float  # fundamental frequency [Hz]
    amplitudes: np.ndarray  # complex, as in `_fourier`, with phases relative to time 0, (channels, harmonics + 1)
    residuals: np.ndarray  # (channels, samples)

    @cached_property
    def variances(self) -> np.ndarray:
        """Residual variance of each channel, (channels,)."""
        degrees_of_freedom = max(self.residuals.shape[1] - (2 * self.amplitudes.shape[1] - 1), 1)
        return np.einsum("ij,ij->i", self.residuals, self.residuals) / degrees_of_freedom


def fit_harmonics(time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int) -> HarmonicFit:
    """Fit harmonics 0 … `harmonics` of `frequency` to channels (channels, samples) by least squares.

    The normal matrix of exp(2πi h f t), h = −H … H, is Hermitian Toeplitz, and well conditioned if the samples resolve
    the highest harmonic.
    """
    phase = frequency * time
    amplitudes = _solved(_fourier.moments(phase, 2 * harmonics), _fourier.sums(channels, phase, harmonics))
    amplitudes[:, 1:] *= 2.0
    residuals = _fourier.at_times(amplitudes, phase)
    return HarmonicFit(frequency, amplitudes, np.subtract(channels, residuals, out=residuals))


def _solved(moments: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Return the coefficients (channels, H + 1) of harmonics 0 … H for the sums of signals with exp(−2πi h f t)."""
    right = np.concatenate([np.conj(sums[:, :0:-1]), sums], axis=1).T
    return solve_toeplitz((moments, np.conj(moments)), right)[sums.shape[1] - 1 :].T.copy()


@dataclass(frozen=True)
class Pace:
    """Uncertainty and steadiness of an estimated fundamental frequency."""

    se: float  # standard error [Hz]
    freedom: int  # its degrees of freedom
    drift: float  # relative change of the frequency over the recording, by linear regression
    drifts: bool  # the phase deviates from that of a constant frequency by more than noise and a negligible angle
    wander: float = 0.0  # range of slow irregular phase deviations [cycles], 0 if not above those of the amplitude
    diffusion: float = 0.0  # variance of the phase's random step in a cycle [cycles²], 0 without evidence of any

    @property
    def varies(self) -> bool:
        """Whether the frequency is not constant."""
        return self.drifts or self.wander > 0.0

    def differs(self, difference: float, duration: float, error: float = 0.0) -> bool:
        """Return whether a frequency with a standard error differs significantly, and by a phase that matters."""
        spread = np.hypot(self.se, error)
        significant = abs(difference) > spread * -stdtrit(self.freedom, 0.5 * PHASE_FALSE_ALARM)
        return bool(significant and abs(difference) * duration > NEGLIGIBLE_PHASE)


def refine_frequency(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int
) -> tuple[HarmonicFit, Pace]:
    """Return the fit at the least-squares frequency, and the uncertainty of that frequency.

    Gauss-Newton iteration for the fundamental, with the amplitudes projected out and every channel weighted by its
    residual variance. It ends where a step is small compared with the standard error.
    """
    refined = _refined(time, channels, frequency, harmonics)
    return refined[0], _pace(time, *refined)


def nearby_fit(time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int) -> HarmonicFit | None:
    """Return the fit at the best frequency near this one; None if it moves to another number of cycles."""
    fit, *_, information = _refined(time, channels, frequency, harmonics)
    near = abs(fit.frequency - frequency) * np.ptp(time) < 1.0
    return fit if near and information > 0.0 and np.isfinite(fit.amplitudes).all() else None


def _refined(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int
) -> tuple[HarmonicFit, np.ndarray, np.ndarray, float]:
    """Return the fit at the least-squares frequency, its clear harmonics, the weights, and the information."""
    for _ in range(MOST_FREQUENCY_STEPS):
        fit, clear, weights, gradient, information = normal_equation(time, channels, frequency, harmonics)
        step = next_step(gradient, information, frequency, float(np.ptp(time)))
        if not step:
            break
        frequency += step
    return fit, clear, weights, information


def next_step(gradient: float, information: float, frequency: float, duration: float) -> float:
    """Return the Gauss-Newton step of a frequency, 0 where it is small compared with the standard error."""
    if not information > 0.0:
        return 0.0
    step = gradient / information
    if abs(step) < max(1e-3 / np.sqrt(information), np.finfo(float).eps * frequency):
        return 0.0
    return float(np.clip(step, -0.25 / duration, 0.25 / duration))


def normal_equation(
    time: np.ndarray, channels: np.ndarray, frequency: float, harmonics: int, counted: np.ndarray | float = 1.0
) -> tuple[HarmonicFit, np.ndarray, np.ndarray, float, float]:
    """Return the fit at a frequency, its clear harmonics, the weights, and the frequency's gradient and information.

    Weights are zero for channels that are not `counted` (1 or 0).
    """
    fit = fit_harmonics(time, channels, frequency, harmonics)
    power = 0.5 * np.sum(np.abs(fit.amplitudes[:, 1:]) ** 2, axis=1)
    clear, weights = _clear(fit), counted / np.maximum(fit.variances, 1e-24 * power)
    gradient, information = _slopes(time, fit, clear, weights)
    return fit, clear, weights, gradient, information


def _clear(fit: HarmonicFit) -> np.ndarray:
    """Return the largest and the significant harmonics; noise in the others would count as information."""
    noise = 4.0 * fit.variances[:, None] / fit.residuals.shape[1]
    power = np.abs(fit.amplitudes) ** 2
    largest = power[:, 1:].max(axis=1, keepdims=True)
    return np.where((power > SIGNIFICANT_POWER * noise) | (power == largest), fit.amplitudes, 0.0)


def _slopes(time: np.ndarray, fit: HarmonicFit, clear: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Return Σ weight · slope · residual and Σ weight · ‖slope without its harmonics‖², of the frequency's slopes."""
    phase, middle, harmonics = fit.frequency * time, time.mean(), clear.shape[1] - 1
    products, squares = np.zeros(len(clear)), np.zeros(len(clear))

    def slopes() -> Iterator[tuple[slice, np.ndarray]]:
        for part, slope in _fourier.blocks_at(_fourier.derivative(clear, 1.0), phase):
            slope *= time[part] - middle
            products[:] += np.einsum("ij,ij->i", slope, fit.residuals[:, part])
            squares[:] += np.einsum("ij,ij->i", slope, slope)
            yield part, slope

    sums = _fourier.sums_of_blocks(slopes(), len(clear), phase, harmonics)
    solved = _solved(_fourier.moments(phase, 2 * harmonics), sums)
    inside = np.real(np.conj(sums) * solved) @ np.r_[1.0, np.full(harmonics, 2.0)]
    return float(weights @ products), float(weights @ (squares - inside))


def _pace(time: np.ndarray, fit: HarmonicFit, clear: np.ndarray, weights: np.ndarray, information: float) -> Pace:
    """Return the uncertainty and the drift of a frequency from the phases of single cycles."""
    cycle = np.floor((time - time[0]) * fit.frequency).astype(int)
    return pace_of(*cycle_scores(time, cycle, int(cycle[-1]) + 1, fit, clear, weights), information)


def cycle_scores(
    time: np.ndarray, cycle: np.ndarray, cycles: int, fit: HarmonicFit, clear: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the gradients of phase and of amplitude in each cycle (cycles,), and the information of one cycle."""
    rate = _fourier.derivative(clear, 1.0)
    both, phase = np.zeros((2, cycles)), fit.frequency * time
    for part, turned in _fourier.blocks_at(np.stack([rate, 1j * rate]), phase):
        first = cycle[part][0]
        for total, each in zip(both, turned, strict=True):
            sums = np.bincount(cycle[part] - first, weights @ (each * fit.residuals[:, part]))
            total[first : first + sums.size] += sums
    power = time.size * float(weights @ np.sum(np.abs(rate) ** 2, axis=1)) / 2.0 / cycles
    return both[0], both[1], power


def pace_of(score: np.ndarray, quadrature: np.ndarray, power: float, information: float) -> Pace:
    """Return the uncertainty and the drift of a frequency from the gradients of single cycles.

    The deviations of their phases from a straight line are expanded in orthonormal polynomials. Order 1 is an error of
    the frequency, order 2 a linear drift; the mean square of the next ones, K/4 of them for K cycles (4 to 16),
    measures noise that is slow compared with a cycle (as U. K. Müller, J. Econometrics 141 (2007) 1331-1352, with
    cosines), and is at least that of independent samples. With less than seven cycles, noise of the amplitude is taken
    to be as large. Where the phases show a random walk, as those of a free-running oscillator do, what it adds to
    orders 1 and 2 counts if it is more: it is larger there than in the next orders.
    """
    if score.size < MINIMUM_CYCLES:
        return Pace(float(np.sqrt(1.0 / information)), 0, 0.0, False)
    orders = min(max(score.size // 4, 4), 16, score.size - 3)
    number = np.linspace(-1.0, 1.0, score.size)
    basis = np.linalg.qr(np.polynomial.legendre.legvander(number, orders + 2))[0].T
    phase, amplitude = basis @ score / power, basis @ quadrature / power
    others = np.concatenate([phase[3:], amplitude[1:] if orders < 4 else []])
    noise = max(float(np.mean(others**2)), 1.0 / power)
    irregular = float(np.ptp(phase[3:] @ basis[3:]))
    allowed = fdtri(orders, orders, 1.0 - PHASE_FALSE_ALARM) * max(float(np.sum(amplitude[3:] ** 2)), orders / power)
    wanders = orders >= 4 and irregular > NEGLIGIBLE_PHASE and float(np.sum(phase[3:] ** 2)) > allowed
    # The residual that `power` rests on contains the wander, the amplitudes of the cycles do not.
    least = min(1.0 / power, 0.5 * float(np.mean(np.diff(quadrature / power) ** 2)))
    walk = phase_diffusion(score / power, basis[:3], max(least, np.finfo(float).tiny))
    slope, bent = (noise, noise) if walk is None else np.maximum(walk.slopes[1:], noise)
    curvature = phase[2] * basis[2]
    bend = float(np.ptp(curvature))
    limit = -stdtrit(others.size, 0.5 * PHASE_FALSE_ALARM)
    sign = float(np.sign(curvature[0] - curvature[score.size // 2]))
    return Pace(
        float(np.sqrt(slope * power / information)),
        others.size,
        8.0 * sign * bend * score.size / (score.size - 1) ** 2,
        bool(bend > NEGLIGIBLE_PHASE and abs(phase[2]) > limit * np.sqrt(bent)),
        irregular if wanders else 0.0,
        0.0 if walk is None or slope == noise else walk.step,
    )


def followed_phase(time: np.ndarray, channels: np.ndarray, fit: HarmonicFit, step: float) -> np.ndarray:
    """Return by how many cycles a wandering phase is ahead of that of a constant frequency at each time (samples,).

    It is the likeliest random walk with the step's variance in a cycle, without its mean and slope; the Fourier series
    (channels, samples) is fitted to it again. Each Gauss-Newton step solves tridiagonal equations.
    """
    frequency, harmonics = fit.frequency, fit.amplitudes.shape[1] - 1
    stiff = 1.0 / np.maximum(step * frequency * np.diff(time), np.finfo(float).tiny)
    ahead = np.zeros(time.size)
    for _ in range(PHASE_ITERATIONS):
        phase = frequency * time + ahead
        clear, weights = _clear(fit), 1.0 / fit.variances
        slope = _fourier.at_times(_fourier.derivative(clear, 1.0), phase)
        information = weights @ slope**2
        bands = np.zeros((2, time.size))
        bands[1] = information
        bands[1, 1:] += stiff
        bands[1, :-1] += stiff
        bands[0, 1:] = -stiff
        ahead = solveh_banded(bands, weights @ (slope * fit.residuals) + information * ahead)
        root = np.sqrt(information)
        line = np.stack([np.ones(time.size), time - time.mean()], axis=1)
        ahead -= line @ np.linalg.lstsq(line * root[:, None], ahead * root, rcond=None)[0]
        fit = fit_harmonics(time + ahead / frequency, channels, frequency, harmonics)
    return ahead


def guess_frequency(time: np.ndarray, channels: np.ndarray) -> float | None:
    """Estimate the fundamental frequency [Hz] from the autocorrelation; None if it has no positive peak.

    The lag is the smallest one whose peak reaches 90 % of the highest.
    """
    from scipy.fft import next_fast_len

    samples = time.size
    lags = samples // 3 + 2
    length = next_fast_len(samples + lags, real=True)
    step = (time[-1] - time[0]) / (samples - 1)
    correlation = np.zeros(lags)
    for values in channels:
        signal = np.interp(time[0] + step * np.arange(samples), time, values)
        signal -= signal.mean()
        signal /= signal.std()
        spectrum = np.fft.rfft(signal, length)
        del signal
        spectrum.real = spectrum.real**2 + spectrum.imag**2
        spectrum.imag = 0.0
        correlation += np.fft.irfft(spectrum, length)[:lags] / np.arange(samples, samples - lags, -1)
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


def track_frequency(time: np.ndarray, channels: np.ndarray, fundamental: float) -> float:
    """Refine a frequency on the last few cycles, then on more and more of them, so that no cycle is miscounted.

    The result is that of the later half. Of a long stretch every so many cycles are used. Few samples in a cycle need
    more cycles.
    """
    cycles, total = float(MINIMUM_CYCLES), np.ptp(time) * fundamental
    while True:
        window = slice(np.searchsorted(time, time[-1] - cycles / fundamental), None)
        count = time.size - window.start
        few = min(10, covered_harmonics(time[window], fundamental, time.size)) if count >= FEWEST_REFINED else 0
        if few:
            stride = min(int(np.ceil(cycles / TRACKED)), max(count // FEWEST_TRACKED, 1))
            if stride > 1:
                used = (time[-1] - time[window]) * fundamental % stride < 1.0
                part, values = time[window][used], channels[:, window][:, used]
            else:
                part, values = time[window], channels[:, window]
            nearby = nearby_fit(part, values, fundamental, few)
            fundamental = fundamental if nearby is None else nearby.frequency
        if cycles >= total / 2:
            return fundamental
        cycles = min(2 * cycles, total / 2)


class Diffusion(NamedTuple):
    """Random walk of the phases of successive cycles, and their independent noise."""

    step: float  # variance of the walk's step in a cycle [cycles²]
    slopes: np.ndarray  # (orders,), variances of the coefficients of orthonormal polynomials in the phases [cycles²]


def phase_diffusion(phase: np.ndarray, basis: np.ndarray, least: float) -> Diffusion | None:
    """Return the random walk that phases (cycles,) show, mean values over a cycle each; None without evidence of one.

    The differences of successive phases have a tridiagonal covariance, which the discrete sine transform diagonalises:
    with the step's variance q and the noise's v, its eigenvalues are q (2 + cos ω)/3 + 2 v (1 − cos ω). The likelihood
    is that of the differences without their mean and linear trend (restricted likelihood). With equal probabilities v
    is `least`, that of the samples' white noise, or its maximum above; the result is the mean over q/v, with a prior
    flat in its logarithm. `basis` (orders, cycles) are the polynomials.
    """
    from scipy.fft import dst

    differences = np.diff(phase)
    count = differences.size
    if phase.size < FEWEST_PHASES:
        return None
    walked = np.cumsum(basis[:, ::-1], axis=1)[:, ::-1]
    # A step moves all later phases; means over a cycle have a sixth of it less, each on its own.
    spread = np.sum(walked**2, axis=1) - np.sum(basis**2, axis=1) / 6.0
    ratios = np.concatenate([[0.0], np.geomspace(*STEP_RANGE, STEPS_TRIED) / spread[1]])
    cosine = np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
    known = np.stack([np.ones(count), np.linspace(-1.0, 1.0, count)])
    moved, known = dst(differences, type=1, norm="ortho"), dst(known, type=1, norm="ortho")
    size = ratios[:, None] * (2.0 + cosine) / 3.0 + 2.0 * (1.0 - cosine)
    gram = np.einsum("an,rn,bn->rab", known, 1.0 / size, known)
    pull = (moved / size) @ known.T
    square = np.sum(moved**2 / size, axis=1) - np.sum(pull * np.linalg.solve(gram, pull[..., None])[..., 0], axis=1)
    freedom = count - len(known)
    noise = np.stack([np.maximum(square / freedom, least), np.full(ratios.size, least)])
    logarithm = freedom * np.log(noise) + square / noise + np.sum(np.log(size), axis=1) + np.linalg.slogdet(gram)[1]
    gain = -0.5 * (logarithm - logarithm[0, 0])[:, 1:]
    if gain.max() < LEAST_GAIN:
        return None
    share = softmax(gain)
    step = float(np.sum(share * noise[:, 1:] * ratios[1:]))
    return Diffusion(step, np.sum(share * noise[:, 1:]) + step * spread)
