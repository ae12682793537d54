"""Response period of a driven system in drive periods, by a test of the lines of its spectrum."""

from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import fdtrc

from bayesperiodic.data.coverage import per_cycle, resolved_harmonics
from bayesperiodic.data.harmonics import MINIMUM_CYCLES, fit_harmonics
from bayesperiodic.data.quantisation import REPEATED_FREEDOM, repeated_variance, rounded_step

if TYPE_CHECKING:
    import pandas as pd

# Longest response period, and most drive periods that are used.
LONGEST_RESPONSE, MOST_PERIODS = 8, 256
# Harmonics of the drive whose lines are tested, and that the noise between the lines is compared with.
TESTED_HARMONICS, SLOW_HARMONICS, FAST_HARMONICS = 8, 2, 4
# Largest share of the variance between the lines, and largest ratio of slow to fast noise, of a periodic signal.
LARGEST_BETWEEN, WHITE_RATIO = 5e-3, 3.0
# Lines on each side of a harmonic that drifts may reach, one of so many; lines whose mean whitens the others.
SKIRT, SMOOTH = 6, 8
# Lines on each side of an added one with which it is compared; amplitude that does not count, relative to the largest.
COMPARED_LINES, NEGLIGIBLE_AMPLITUDE = 4, 1e-6
# Grid points of a spectrum for each sample.
FINENESS = 4
FALSE_ALARM_RATE = 0.01
# Least power of a line that stands out, relative to the mean of the lines beside it, and least share of a channel's
# variance in the lines that a longer response period adds, which is also that of a subharmonic of 1 % of the signal's
# amplitude. Neglected, a share s changes the other lines by about s. Least part of it in the later half.
STANDS_OUT, LEAST_SHARE, LASTING = 20.0, 1e-4, 0.5
# Lines of the mains [Hz], relative error of their frequency, fewest of their periods that show a line, and the lowest
# frequency [Hz] of their aliases; lower ones are drifts.
MAINS, MAINS_ERROR, MAINS_PERIODS, LOWEST_ALIAS = np.array([50.0, 60.0, 100.0, 120.0, 150.0, 180.0]), 1e-3, 4, 1.0
# Lines that are listed in a text, and the smallest p-value that is.
LISTED, SMALLEST_P = 3, 1e-16
CHOSEN, REST, NOTHING_ADDED, MORE_LINES = "chosen", "not periodic", "adds no lines", "lacks lines"
TOO_SMALL, FOREIGN, FADING = "lines too small", "mains or alias", "lines fade"
PRIMES = (2, 3, 5, 7)


class Added(NamedTuple):
    """Lines of one channel that a response period adds to a shorter one."""

    row: int  # of the channel
    standing: np.ndarray  # numbers of those that stand out, in units of the response frequency
    foreign: np.ndarray  # the same of those that may be lines of the mains or aliases of harmonics of the drive
    share: float  # of the variance, in those that stand out and are not foreign
    contrast: float  # power of the strongest line relative to those beside it
    p: float
    later: float = np.inf  # share of the variance of the later half, if it is long enough

    def verdict(self, level: float) -> str:
        """Return what the lines say about the response period."""
        if self.p >= level or not self.standing.size + self.foreign.size:
            return NOTHING_ADDED
        if self.share < LEAST_SHARE:
            return TOO_SMALL if self.standing.size else FOREIGN
        return CHOSEN if self.later >= LASTING * self.share else FADING

    def remark(self, channel: str, periods: int, level: float) -> str:
        """Return in words what lines there are, and what would be needed."""
        verdict = self.verdict(level)
        if verdict == NOTHING_ADDED and self.standing.size + self.foreign.size:
            return f"the lines that stand out are as likely by chance: p = {self.p:.1g}, below {level:.1g} is needed"
        if verdict == NOTHING_ADDED:
            return f"no lines have {STANDS_OUT:g} times the power of their neighbours"
        lines = self.foreign if verdict == FOREIGN else self.standing
        listed = ", ".join(str(Fraction(int(n), periods)) for n in lines[:LISTED])
        text = f"lines at {listed}{', …' if lines.size > LISTED else ''} of the drive's frequency in {channel!r}"
        if verdict == FOREIGN:
            return f"{text} may be those of the mains, or aliases of the drive's harmonics"
        text += (
            f" have {self.share:.1e} of its variance, and up to {self.contrast:.3g} times the power of their neighbours"
        )
        if verdict == TOO_SMALL:
            return f"{text}; a share of {LEAST_SHARE:.0e} is needed"
        return f"{text}; they fade, to {self.later:.1e} in the later half" if verdict == FADING else text


class Lines(NamedTuple):
    """Powers of the lines of one channel: of harmonics of a response period, and of all others."""

    cycles: int
    harmonics: np.ndarray  # (harmonics,), of 1, 2, … of the response period
    rest: np.ndarray  # (lines,) of 1, 2, … of the part that is used, zero at harmonics
    error: float  # power of quantisation errors that repeat in every cycle, at a harmonic
    explained: float  # fraction of the variance

    @property
    def between(self) -> np.ndarray:
        """True at the lines between harmonics, (lines,)."""
        return (1 + np.arange(self.rest.size)) % self.cycles != 0

    def unexplained(self, periods: int, variance: float) -> float:
        """Return the share of the variance that is between the lines; 0 if it is white.

        Lines next to harmonics are left out, because slow drifts of the amplitudes broaden the harmonics.
        """
        line = 1 + np.arange(self.rest.size)
        apart = np.abs((line + self.cycles // 2) % self.cycles - self.cycles // 2) > self.cycles // SKIRT
        place = line / (self.cycles * periods)
        slow, fast = apart & (place <= SLOW_HARMONICS), apart & (place > max(0.5 * place[-1], FAST_HARMONICS))
        if fast.any() and self.rest[slow].mean() <= WHITE_RATIO * self.rest[fast].mean():
            return 0.0
        inside = apart & (place <= TESTED_HARMONICS)
        return float(self.rest[inside].mean() * np.count_nonzero(place <= TESTED_HARMONICS) / variance)

    def added(self, row: int, variance: float, divisor: int, foreign: np.ndarray, channels: int) -> Added:
        """Return the lines that a response period shorter by `divisor` lacks, and the p-value that there are none.

        An F-test of their power against that of the nearest lines between harmonics, both divided by a smooth spectrum,
        for so many channels. Foreign are those at (harmonics,) of 1, 2, … of the response frequency.
        """
        between, window = self.between, np.ones(2 * max(self.cycles, SMOOTH) + 1)
        total, count = np.convolve(self.rest, window, "same"), np.convolve(between, window, "same")
        number = 1 + np.arange(self.harmonics.size)
        number = number[(number % divisor != 0) & (number * self.cycles < self.rest.size - self.cycles)]
        place, sides = number * self.cycles - 1, min((self.cycles - 1) // 2, COMPARED_LINES)
        beside = place[:, None] + np.r_[-sides:0, 1 : sides + 1]
        floor = max(self.error, NEGLIGIBLE_AMPLITUDE**2 * self.harmonics.max())
        # Without the line itself, as those of the added lines are.
        smooth = (total - self.rest)[beside] / (count - 1)[beside]
        level = np.divide(self.rest[beside], smooth, out=np.ones(smooth.shape), where=smooth > 0.0).mean()
        noise = level * (total / count)[place]
        # Satterthwaite; how quantisation errors are distributed over the lines is hardly known.
        size = float(noise.mean())
        freedom = (size + floor) ** 2 / (size**2 / (2 * beside.size) + floor**2 / REPEATED_FREEDOM)
        power = self.harmonics[number - 1]
        p = float(fdtrc(2 * number.size, freedom, np.mean(power / (noise + floor))))
        nearest = self.rest[beside].mean(axis=1) + floor
        stands, native = power > STANDS_OUT * nearest, ~foreign[number - 1]
        share = float((power - nearest)[stands & native].sum() / variance)
        contrast = float((power / nearest)[stands].max(initial=0.0))
        return Added(row, number[stands & native], number[stands & ~native], share, contrast, min(channels * p, 1.0))


def _lines(time: np.ndarray, values: np.ndarray, frequency: float, periods: int, cycles: int) -> list[Lines]:
    """Return the lines of every channel (channels, samples) in the last cycles of so many drive periods."""
    used = time > time[-1] - cycles * periods / frequency * (1 + 1e-9)
    time, values = time[used], values[:, used]
    fit = fit_harmonics(time, values, frequency / periods, _highest(time, frequency, periods))
    per_period = (time.size - 1) / (np.ptp(time) * frequency)
    points = FINENESS * int(np.ceil(per_period - 1e-6)) * periods * cycles
    place = np.rint((time - time[0]) * frequency / (periods * cycles) * points).astype(int) % points
    spectra = []
    for signal, residuals, amplitudes in zip(values, fit.residuals, fit.amplitudes, strict=True):
        spectrum = np.fft.rfft(np.bincount(place, residuals, points))[1 : int(0.5 * per_period * periods * cycles)]
        # Irregular samples let the harmonics take a part of the noise between them, and have as much less of their own.
        rest = 2.0 * np.abs(spectrum / (time.size - 2 * amplitudes.size)) ** 2
        rest[cycles - 1 :: cycles] = 0.0
        scatter = float(np.mean(residuals**2)) * cycles / (cycles - 1)
        step, phases = rounded_step(signal, time * frequency / periods), signal.size // cycles
        error = 2.0 * repeated_variance(step, (signal - residuals)[:phases], phases, scatter=scatter)
        explained = 1.0 - float(np.mean(residuals**2)) / float(np.var(signal))
        spectra.append(Lines(cycles, 0.5 * np.abs(amplitudes[1:]) ** 2, rest, error, explained))
    return spectra


def _highest(time: np.ndarray, frequency: float, periods: int) -> int:
    limit = min(int((per_cycle(time, frequency / periods) - 1.0) / 2.0), (time.size - 2) // 2)
    if limit < 1:
        raise ValueError(
            f"periods: must be given for at least 3 samples per period of {1.0 / frequency:.6g} s, got 'auto' and "
            f"{per_cycle(time, frequency):.3g}; give their number."
        )
    return min(limit, max(TESTED_HARMONICS * periods, 1))


def _mains(frequency: float, count: int, step: float, duration: float) -> np.ndarray:
    """Return which of lines 1, 2, …, `count` of a frequency are near those of the mains, or their aliases."""
    if duration * MAINS[0] < MAINS_PERIODS:
        return np.zeros(count, dtype=bool)
    alias = np.abs(MAINS - np.rint(MAINS * step) / step)
    away = np.abs(frequency * (1 + np.arange(count))[:, None] - alias)
    return np.any((away < 1.0 / duration + MAINS_ERROR * MAINS) & (alias > LOWEST_ALIAS), axis=1)


def _aliases(line: Lines, periods: int, per_period: float) -> np.ndarray:
    """Return which harmonics of the response may be aliases of the drive's, whose power falls as 1/h² or faster."""
    number = 1 + np.arange(line.harmonics.size)
    drive = number[periods - 1 :: periods] // periods
    if not drive.size:
        return np.zeros(number.size, dtype=bool)
    power = line.harmonics[periods - 1 :: periods] * drive**2
    largest = power[drive.size // 2 :].max()
    order = per_period + np.stack([number, -number]) / periods
    near = np.abs(order - np.rint(order)) < 1.0 / (line.cycles * periods)
    return np.any(near & (line.harmonics < largest / order**2), axis=0)


def _added(
    time: np.ndarray, values: np.ndarray, frequency: float, periods: int, lines: list[Lines], level: float
) -> Added | None:
    """Return the lines of a response period that are least needed, in the channel that shows them best."""
    cycles, step = lines[0].cycles, np.ptp(time) / (time.size - 1)
    order = (NOTHING_ADDED, FOREIGN, TOO_SMALL, FADING, CHOSEN)

    def rank(added: Added) -> tuple[int, float, float]:
        return order.index(added.verdict(level)), added.share, -added.p

    later = time >= 0.5 * (time[0] + time[-1])
    fewer, half = int(np.ptp(time[later]) * frequency) // periods, None
    weakest = []
    for divisor in [prime for prime in PRIMES if periods % prime == 0]:
        every = []
        for row, (line, signal) in enumerate(zip(lines, values, strict=True)):
            foreign = _mains(frequency / periods, line.harmonics.size, step, cycles * periods / frequency)
            foreign |= _aliases(line, periods, 1.0 / (step * frequency))
            every.append(line.added(row, float(signal.var()), divisor, foreign, len(lines)))
        best = max(every, key=rank)
        if best.verdict(level) == CHOSEN and fewer >= MINIMUM_CYCLES:
            half = half or _lines(time[later], values[:, later], frequency, periods, fewer)
            power = half[best.row].harmonics[best.standing[best.standing <= half[best.row].harmonics.size] - 1]
            best = best._replace(later=float(power.sum() / values[best.row, later].var()))
        weakest.append(best)
    return min(weakest, key=rank, default=None)


def response_period(
    time: np.ndarray, values: np.ndarray, channels: tuple[str, ...], frequency: float, cycles: int = MINIMUM_CYCLES
) -> "tuple[int | None, pd.DataFrame]":
    """Return the response period in drive periods, None if there is none, and the evidence; see `Recording.fold`.

    Response periods of which the signals (channels, samples) have fewer than so many cycles are not tested.
    """
    import pandas as pd

    total = np.ptp(time) * time.size / (time.size - 1) * frequency * (1 + 1e-9)
    longest = min(int(total) // cycles, LONGEST_RESPONSE)
    rows, level = [], FALSE_ALARM_RATE / max(longest - 1, 1)
    for periods in range(1, longest + 1):
        cycles = int(min(total, MOST_PERIODS)) // periods
        lines = _lines(time, values, frequency, periods, cycles)
        between = [line.unexplained(periods, float(v.var())) for line, v in zip(lines, values, strict=True)]
        worst = int(np.argmax(between))
        added = _added(time, values, frequency, periods, lines, level)
        verdict = CHOSEN if added is None else added.verdict(level)
        rows.append(
            {
                "periods": periods,
                "cycles": cycles,
                "explained": min(line.explained for line in lines),
                "between": between[worst],
                "channel": channels[worst],
                "p": np.nan if added is None else added.p,
                "share": np.nan if added is None else added.share,
                "contrast": np.nan if added is None else added.contrast,
                "verdict": REST if between[worst] > LARGEST_BETWEEN else verdict,
                "remark": "" if added is None else added.remark(channels[added.row], periods, level),
            }
        )
    table = pd.DataFrame(rows)
    needed = table.loc[table.verdict == CHOSEN, "periods"]
    chosen = int(needed.max()) if len(needed) else None
    table.loc[(table.verdict == CHOSEN) & (table.periods != chosen), "verdict"] = MORE_LINES
    return chosen, table


def even_times(time: np.ndarray, values: np.ndarray, frequency: float) -> np.ndarray:
    """Return equidistant times if the signals (channels, samples) repeat better with them than with the times given.

    Rounded times modulate the phase, with lines at parts of the sampling rate beside those of the drive.
    """
    number = np.arange(time.size) - 0.5 * (time.size - 1)
    step = (number @ time) / (number @ number)
    even = time.mean() + step * number
    if not 1e-9 * step < np.abs(time - even).max() < 0.5 * step:
        return time
    few = min(TESTED_HARMONICS, resolved_harmonics(time, frequency, time.size))
    given, better = (fit_harmonics(t, values, frequency, few).variances for t in (time, even))
    return even if np.log(better / given).sum() < 0.0 else time


def summary(evidence: "pd.DataFrame", periods: int) -> str:
    """Return in words which response period of a driven system was chosen, and which lines were not enough."""
    chosen = evidence.loc[evidence.periods == periods].iloc[0]
    text = (
        f"response period {periods} drive period{'s' if periods > 1 else ''}, chosen of 1 to {evidence.periods.max()}: "
    )
    text += (
        f"{chosen.remark} (p {f'= {chosen.p:.1g}' if chosen.p > SMALLEST_P else f'< {SMALLEST_P:g}'})"
        if periods > 1
        else ""
    )
    unused = evidence[evidence.verdict.isin([TOO_SMALL, FOREIGN, FADING])]
    if len(unused):
        row = unused.sort_values("share").iloc[-1]
        text += (
            f"{'; ' if periods > 1 else ''}{row.remark}, or fold with periods={row.periods} if they are the response's"
        )
    elif periods == 1:
        text += "no lines between those of the drive stand out"
    return text


def aperiodic(name: str, frequency: float, evidence: "pd.DataFrame") -> ValueError:
    """Return the error of a recording that has no response period."""
    best = evidence.iloc[int(np.argmin(evidence["between"]))]
    doubtful = evidence[evidence.verdict.isin([TOO_SMALL, FOREIGN, FADING])]
    seen = f" With {doubtful.iloc[0].periods} drive periods, {doubtful.iloc[0].remark}." if len(doubtful) else ""
    return ValueError(
        f"recording: must be periodic, got {name!r}, in which no response period of 1 to {len(evidence)} drive periods "
        f"of {1.0 / frequency:.6g} s repeats: with the best one, of {best['periods']}, {best['between']:.1%} of the "
        f"variance of {best['channel']!r} is between the lines of its spectrum.{seen} A chaotic response has periodic "
        "orbits for `find_orbits`; otherwise record longer, check the frequency, select a steady part with `between`, "
        "or give `periods`."
    )
