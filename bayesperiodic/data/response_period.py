"""Response period of a driven system in drive periods, by a test of the lines of its spectrum."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import fdtrc

from bayesperiodic.data.harmonics import MINIMUM_CYCLES, fit_harmonics, resolved_harmonics
from bayesperiodic.data.quantisation import REPEATED_FREEDOM, repeated_variance

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
CHOSEN, REST, NOTHING_ADDED, MORE_LINES = "chosen", "not periodic", "adds no lines", "lacks lines"
PRIMES = (2, 3, 5, 7)


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

    def p_value(self, divisor: int) -> float:
        """Return the p-value of the lines that a shorter response period lacks, by `divisor`: there are none.

        An F-test of their power against that of the nearest lines between harmonics, both divided by a smooth spectrum.
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
        return float(fdtrc(2 * number.size, freedom, np.mean(self.harmonics[number - 1] / (noise + floor))))


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
        one_cycle = signal - residuals
        error = 2.0 * repeated_variance(signal, one_cycle[: signal.size // cycles], signal.size // cycles, scatter)
        explained = 1.0 - float(np.mean(residuals**2)) / float(np.var(signal))
        spectra.append(Lines(cycles, 0.5 * np.abs(amplitudes[1:]) ** 2, rest, error, explained))
    return spectra


def _highest(time: np.ndarray, frequency: float, periods: int) -> int:
    limit = resolved_harmonics(time, frequency / periods, time.size)
    return min(limit, max(TESTED_HARMONICS * periods, 1))


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
        share = [line.unexplained(periods, float(v.var())) for line, v in zip(lines, values, strict=True)]
        worst = int(np.argmax(share))
        divisors = [prime for prime in PRIMES if periods % prime == 0]
        p = max((min(line.p_value(d) for line in lines) * len(lines) for d in divisors), default=np.nan)
        verdict = REST if share[worst] > LARGEST_BETWEEN else NOTHING_ADDED if p >= level else CHOSEN
        explained = min(line.explained for line in lines)
        rows.append((periods, cycles, explained, share[worst], channels[worst], np.minimum(p, 1.0), verdict))
    names = ["periods", "cycles", "explained", "between", "channel", "p", "verdict"]
    table = pd.DataFrame(rows, columns=names)
    needed = table.loc[table.verdict == CHOSEN, "periods"]
    chosen = int(needed.max()) if len(needed) else None
    table.loc[(table.verdict == CHOSEN) & (table.periods != chosen), "verdict"] = MORE_LINES
    return chosen, table


def aperiodic(name: str, frequency: float, evidence: "pd.DataFrame") -> ValueError:
    """Return the error of a recording that has no response period."""
    best = evidence.iloc[int(np.argmin(evidence["between"]))]
    return ValueError(
        f"recording: must be periodic, got {name!r}, in which no response period of 1 to {len(evidence)} drive periods "
        f"of {1.0 / frequency:.6g} s repeats: with the best one, of {best['periods']}, {best['between']:.1%} of the "
        f"variance of {best['channel']!r} is between the lines of its spectrum. A chaotic response has periodic orbits "
        "for `find_orbits`; otherwise record longer, check the frequency, select a steady part with `between`, or give "
        "`periods`."
    )
