"""Lines of the noise's spectrum beside the harmonics, for samples at any times."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from bayesperiodic.data.coverage import per_cycle
from bayesperiodic.data.response_period import FINENESS

# Grid points of a cycle if there are not many harmonics, and neighbouring lines on each side of a harmonic.
FINEST, NEIGHBOURING_LINES = 1 << 14, 16
# Lines from which frequency zero is extrapolated: for the kind of noise, and for the level of white and slow noise.
LINES_NEAR_ZERO, WHITE_LINES, SLOW_LINES = 40, 8, 2
# Correlation times in recording lengths, white floors relative to line 1, and line 0 of 1/f noise relative to line 1
# if its spectrum is flat below a quarter of a line.
CORRELATION_TIMES, FLOORS, ZERO_OF_PINK = (0.45, 0.1, 0.05, 0.025), (0.0, 0.01, 0.1), 2.75
# Points of the grid that are in memory together.
GRID_POINTS = 1 << 17
# Part of a line's noise below which it is in the fitted harmonics, and the line is of no use.
LEAST_LEFT = 0.05


@dataclass(frozen=True)
class Sampling:
    """Samples on a grid in phase, finer than the samples or the harmonics, with the lines of a discrete transform.

    Lines beside the harmonics are apart by one cycle in all those that have samples. Where samples are missing, the
    fitted harmonics take a part of the noise at these lines.
    """

    phase: np.ndarray  # (samples,) [cycles] after the first
    grid: int  # points in a cycle that tell samples apart
    points: int  # of the grid for the lines
    place: np.ndarray  # (samples,) nearest points, of cycles with samples only
    number: np.ndarray  # (covered,) of these cycles
    samples: np.ndarray  # (covered,) in each of them
    side: np.ndarray  # (lines,) distances of lines above harmonics [harmonics]
    left: np.ndarray  # (lines beside a harmonic, harmonics + 1) share of white noise left, above and then below it
    left_near_zero: np.ndarray  # (lines,) the same of the first lines
    freedom: np.ndarray  # (harmonics + 1,) of the mean over the sides

    @classmethod
    def of(cls, time: np.ndarray, frequency: float, harmonics: int, cycles: int) -> "Sampling":
        """Return the sampling of a fit over so many cycles."""
        grid = FINENESS * int(np.ceil(max(per_cycle(time, frequency), 2 * harmonics + 1) - 1e-6))
        points = min(grid, max(FINEST, 2 * FINENESS * (harmonics + 1)))
        phase = (time - time[0]) * frequency
        place = np.minimum(nearest(phase, points), points * cycles - 1)
        samples = np.bincount(place // points, minlength=cycles)
        number = np.flatnonzero(samples)
        if number.size < cycles:
            place -= points * (place // points - np.searchsorted(number, place // points))
            samples = samples[number]
        sides = int(np.clip(number.size // 4, min(4, number.size // 2), NEIGHBOURING_LINES))
        side = np.arange(1, min(number.size, LINES_NEAR_ZERO + 1)) / number.size
        ones, freedom = np.ones(LINES_NEAR_ZERO), np.full(harmonics + 1, 4.0 * sides)
        sampling = cls(
            phase, grid, points, place, number, samples, side, np.ones((2 * sides, harmonics + 1)), ones, freedom
        )
        # Equal numbers of samples in all cycles tell all lines apart.
        return sampling if np.ptp(samples) <= 1 and number.size == cycles else sampling._incomplete()

    def _incomplete(self) -> "Sampling":
        """Return the same with the shares of white noise that are left, by the lines of the sampling itself."""
        sides, harmonics = len(self.left) // 2, self.left.shape[1] - 1
        window = np.abs(self.lines(np.broadcast_to(1.0, self.place.size))[0]) ** 2
        # Lines from 2H below to 2H above harmonic 0, of which those from −H to H about each harmonic count.
        sums = np.cumsum(window[:, np.arange(-2 * harmonics - 1, 2 * harmonics + 1)], axis=1)
        left = np.maximum(1.0 - sums[:, 2 * harmonics + 1 :] + sums[:, : -2 * harmonics - 1], 0.0)
        above, below = left[:, harmonics:], left[:, harmonics::-1]
        apart = np.concatenate([[1.0], window[: 2 * sides, 0], np.zeros(2 * sides)])
        line = np.r_[-sides:0, 1 : sides + 1]
        alike = apart[np.abs(line[:, None] - line)].sum() / (2 * sides)
        near_zero = np.concatenate([above.T.ravel(), self.left_near_zero])[:LINES_NEAR_ZERO]
        return replace(
            self,
            left=np.concatenate([above[:sides], below[:sides]]),
            left_near_zero=near_zero,
            freedom=np.maximum(self.freedom / alike, 2.0),
        )

    def lines(self, values: np.ndarray, harmonics: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the lines of values (samples,) at the sides above harmonics 0 … points − 1, for each sample.

        By sums over the cycles first, so that the time does not depend on the prime factors of their number. The second
        array (covered, harmonics) is of the first harmonics in each cycle, for each of its samples.
        """
        side = 2.0 * np.pi * self.side[:, None]
        total = np.zeros((self.side.size, self.points), dtype=complex)
        each = np.zeros((self.number.size, harmonics), dtype=complex)
        length = max(GRID_POINTS // self.points, 1)
        for first in range(0, self.number.size, length):
            cycles = slice(first, min(first + length, self.number.size))
            start = first * self.points
            part = slice(*np.searchsorted(self.place, [start, cycles.stop * self.points]))
            signal = np.bincount(self.place[part] - start, values[part], (cycles.stop - first) * self.points)
            signal = signal.reshape(-1, self.points)
            turn = side * self.number[cycles]
            total += np.cos(turn) @ signal - 1j * (np.sin(turn) @ signal)
            if harmonics:
                each[cycles] = np.fft.rfft(signal, axis=1)[:, :harmonics] / self.samples[cycles, None]
        total *= np.exp(-1j / self.points * side * np.arange(self.points))
        return np.asarray(np.fft.fft(total, axis=1)) / self.phase.size, each

    def at_zero(self, lines: np.ndarray) -> tuple[float, float]:
        """Return the expected power of the noise at frequency zero, and its freedom, from the `lines`."""
        power = np.abs(lines[:, : self.points // 2].T.ravel()[:LINES_NEAR_ZERO]) ** 2
        left = self.left_near_zero[: power.size]
        return _at_zero((power / np.maximum(left, LEAST_LEFT))[left > LEAST_LEFT])


def nearest(phase: np.ndarray, points: int) -> np.ndarray:
    """Return the numbers of the nearest points of a grid with so many in a cycle; phases are in cycles."""
    place = phase * points
    return np.rint(place, out=place).astype(int)


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
