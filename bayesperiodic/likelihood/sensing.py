"""What sensors make of the outputs of a model: gain, low-pass filter, delay and offset of the Fourier harmonics.

A sensor measures gain · lowpass(signal(t − delay)) + offset. At the frequency ν a harmonic is multiplied by
gain · H(ν/cutoff) · exp(−2πi ν delay), H being the response of a Butterworth filter, and the mean by the gain.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic.models.sensed import CUTOFF, DELAY, GAIN, OFFSET, butterworth, sensor_name

NO_PLACE = -1
Slopes = list[tuple[int, Any]]


class ComplexFactors(NamedTuple):
    """Complex factors in real numbers: the rounding of NumPy's complex products depends on how many there are."""

    real: np.ndarray
    imag: np.ndarray

    def times(self, other: "ComplexFactors") -> "ComplexFactors":
        """Return the product."""
        real, imag = self.real * other.real - self.imag * other.imag, self.real * other.imag + self.imag * other.real
        return ComplexFactors(real, imag)

    @property
    def conjugate(self) -> "ComplexFactors":
        """The complex conjugates."""
        return ComplexFactors(self.real, -self.imag)

    @property
    def complex(self) -> np.ndarray:
        """The factors as complex numbers."""
        return self.real + 1j * self.imag


class SensorNames(NamedTuple):
    """Parameters of the sensors in one experiment."""

    names: tuple[str, ...]  # of outputs, and delays of inputs; last the delay of all outputs, "shift"
    orders: Mapping[str, int]  # of the filters, by channel
    late_inputs: tuple[str, ...]  # inputs with a delay among the names
    delayed: bool  # whether all outputs may be late


def _denominator(ratio: np.ndarray, order: int, slope: int = 0) -> ComplexFactors:
    """Return B(i·ratio), or its derivative by ln(ratio) if `slope` is 1."""
    coefficients = [b * k**slope for k, b in enumerate(butterworth(order))]
    square = -ratio * ratio
    parts = []
    for some in (coefficients[::2], coefficients[1::2]):
        total = np.full_like(ratio, some[-1])
        for b in some[-2::-1]:
            total = total * square + b
        parts.append(total)
    return ComplexFactors(parts[0], parts[1] * ratio)


def lowpass(ratio: np.ndarray, order: int) -> ComplexFactors:
    """Return the response of a Butterworth filter at frequencies in units of its cutoff."""
    below = _denominator(ratio, order)
    inverse = 1.0 / (1.0 + ratio ** (2 * order))
    return ComplexFactors(below.real * inverse, -below.imag * inverse)


class Sensing:
    """The sensors of the measured channels of one experiment, as functions of their parameters.

    `values` (…, names) are those of the parameters `names`, the delay of all outputs last. What is returned of a
    channel, by its index c, is at the harmonics (size,) of the response period, at the frequency (…,) of the forcing.
    """

    def __init__(self, channels: Sequence[str], sensors: SensorNames, periods: int, *, delayed: bool = False):
        names, orders = sensors.names, sensors.orders

        def place(kind: str, channel: str) -> int:
            name = sensor_name(kind, channel)
            return names.index(name) if name in names else NO_PLACE

        self._periods, self._orders = periods, tuple(orders.get(channel, 0) for channel in channels)
        self._gain, self.offset_place, self._cutoff = (
            tuple(place(kind, channel) for channel in channels) for kind in (GAIN, OFFSET, CUTOFF)
        )
        # A late input is as good as outputs that are too early.
        common = [(place(DELAY, name), -1.0) for name in sensors.late_inputs]
        common += [(len(names) - 1, 1.0)] * (sensors.delayed or delayed)
        alone = [[(i, 1.0)] * (i != NO_PLACE) for i in (place(DELAY, channel) for channel in channels)]
        self._delay = tuple(tuple(one + common) for one in alone)
        self.frequency_place = len(names)
        places = (*self._gain, *self.offset_place, *self._cutoff)
        self.active = any(self._delay) or any(i != NO_PLACE for i in places)
        self.layout = self._gain, self.offset_place, self._cutoff, self._orders, self._delay, periods

    def offset_places(self) -> Iterator[tuple[int, int]]:
        """Yield index and place of the parameter of every channel that has an offset."""
        return ((c, i) for c, i in enumerate(self.offset_place) if i != NO_PLACE)

    def delay(self, c: int, values: np.ndarray) -> np.ndarray | None:
        """Return the delay (…,) of a channel [s]; None if it is zero."""
        total: np.ndarray | None = None
        for i, sign in self._delay[c]:
            one = values[..., i] if sign > 0.0 else -values[..., i]
            total = one if total is None else total + one
        return total

    def lag(self, c: int, values: np.ndarray, frequency: np.ndarray) -> np.ndarray:
        """Return the delay (…,) of a channel in response periods."""
        delay = self.delay(c, values)
        return np.zeros(()) if delay is None else delay * (frequency / self._periods)

    def lag_slopes(self, c: int, values: np.ndarray, frequency: np.ndarray) -> Slopes:
        """Return places of parameters with the derivatives (…,) of the lag by them, that of the frequency last."""
        delay = self.delay(c, values)
        if delay is None:
            return []
        rate = frequency / self._periods
        return [(i, sign * rate) for i, sign in self._delay[c]] + [(self.frequency_place, delay / self._periods)]

    def factors(
        self,
        c: int,
        values: np.ndarray,
        frequency: np.ndarray,
        harmonic: np.ndarray,
        *,
        phase: np.ndarray | None = None,
    ) -> ComplexFactors | None:
        """Return what multiplies the harmonics (…, size) of a channel; None if it is 1.

        With `phase` (…,) the channel comes these response periods later too.
        """
        result, late = None, self.delay(c, values)
        if late is not None or phase is not None:
            lag = phase if late is None else late * (frequency / self._periods)
            lag = lag + phase if late is not None and phase is not None else lag
            angle = (-2.0 * np.pi * np.asarray(lag))[..., None] * harmonic
            result = ComplexFactors(np.cos(angle), np.sin(angle))
        if self._cutoff[c] != NO_PLACE:
            filtered = lowpass(self._ratio(c, values, frequency, harmonic), self._orders[c])
            result = filtered if result is None else result.times(filtered)
        if self._gain[c] != NO_PLACE:
            gain = values[..., self._gain[c], None]
            if result is not None:
                return ComplexFactors(result.real * gain, result.imag * gain)
            ones = np.ones(harmonic.size)
            return ComplexFactors(gain * ones, 0.0 * ones)
        return result

    def _ratio(self, c: int, values: np.ndarray, frequency: np.ndarray, harmonic: np.ndarray) -> np.ndarray:
        """Return the harmonics' frequencies in units of the cutoff, (…, size)."""
        return np.asarray(frequency / (self._periods * values[..., self._cutoff[c]]))[..., None] * harmonic

    def slopes(
        self, c: int, values: np.ndarray, frequency: np.ndarray, harmonic: np.ndarray
    ) -> Iterator[tuple[ComplexFactors | None, Slopes]]:
        """Yield relative derivatives of the factors, and what they are by each parameter times a number (…,).

        None stands for the derivative 1. The place of the frequency is `frequency_place`.
        """
        if self._gain[c] != NO_PLACE:
            yield None, [(self._gain[c], 1.0 / values[..., self._gain[c]])]
        if by_lag := self.lag_slopes(c, values, frequency):
            yield ComplexFactors(np.zeros(harmonic.size), -2.0 * np.pi * harmonic), by_lag
        if (place := self._cutoff[c]) != NO_PLACE:
            ratio = self._ratio(c, values, frequency, harmonic)
            relative = lowpass(ratio, self._orders[c]).times(_denominator(ratio, self._orders[c], slope=1))
            yield relative, [(place, 1.0 / values[..., place]), (self.frequency_place, -1.0 / frequency)]

    def first_harmonic(self, values: np.ndarray, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors (…, channels) of the first harmonic without the delay of all outputs, and their slopes.

        The slopes (names + 1, channels) by the parameters and the frequency are those of a single response.
        """
        alone, one = np.array(values), np.ones(1)
        alone[..., -1] = 0.0
        channels, factors = range(len(self._gain)), []
        slopes = np.zeros((alone.shape[-1] + 1, len(channels)), dtype=complex)
        for c in channels:
            whole = self.factors(c, alone, frequency, one)
            factors.append(np.ones(()) if whole is None else whole.complex[..., 0])
            for relative, by in self.slopes(c, alone, frequency, one) if alone.ndim == 1 else ():
                for place, slope in by:
                    slopes[place, c] += factors[c] * slope * (1.0 if relative is None else relative.complex[0])
        slopes[-2] = 0.0
        return np.stack(np.broadcast_arrays(*factors), axis=-1), slopes
