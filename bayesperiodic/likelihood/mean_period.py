"""Mean periods, which are compared as Fourier components within the harmonics kept."""

import math
from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import Block, ComparedSignals, Timed, common, measured_channels
from bayesperiodic.likelihood.noise_spectrum import component_variances
from bayesperiodic.likelihood.sensing import NO_PLACE, ComplexFactors, Sensing
from bayesperiodic.models.model import Model

LARGEST_TRANSFORM = 16_384
ROOT_HALF = math.sqrt(0.5)


@dataclass(frozen=True, eq=False)
class MeanPeriod(Timed):
    """Real Fourier components of one channel, which are independent and have variance v under white noise."""

    spectral: ClassVar[bool] = True

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[MeanPeriod]":
        """Return one block a channel, of experiments without a mask, a covariance and a condition."""
        if experiment.mask is not None or experiment.covariance is not None or experiment.condition is not None:
            return []
        blocks, points = [], experiment.samples * experiment.periods
        highest = _fourier.highest_harmonic(points)
        for place, channel in enumerate(measured_channels(experiment, model)):
            values, kept = experiment.outputs[channel], experiment.harmonics.get(channel)
            if np.ptp(values) == 0.0:
                raise ValueError(
                    f"outputs of experiment {experiment.name!r}: {channel!r} is constant ({values[0]:g}); a channel "
                    "must vary over the period, or tells nothing about its variance."
                )
            harmonics = np.arange(1, 1 + min(highest if kept is None else kept, highest))
            nyquist = [points // 2] if kept is None and points % 2 == 0 else []
            every = np.array([0, *harmonics, *harmonics, *nyquist])
            harmonic = every[~np.isin(every, experiment.unmeasured.get(channel, ()))]
            count = float(experiment.independent[channel])
            given = common(experiment, channel, place, count=count, size=harmonic.size, harmonic=harmonic)
            blocks.append(cls(**given, spectrum_measured=component_variances(experiment, channel, harmonic)))
        return blocks

    @property
    def layout(self) -> Hashable:
        """What blocks have in common whose experiments are compared all at once."""
        return self.points, self.channel, self.harmonic.tobytes()

    @cached_property
    def _among(self) -> np.ndarray:
        """The places (size,) of the components among those of all harmonics up to the highest one."""
        top = int(self.harmonic.max())
        below = np.arange(1, top + (2 * top < self.points))
        every = np.concatenate([[0], below, below, [top] * (2 * top == self.points)])
        return np.flatnonzero(np.isin(every, self.harmonic))

    @cached_property
    def _count(self) -> int:
        """Number of components of all harmonics up to the highest one, those included that were not measured."""
        return min(2 * int(self.harmonic.max()) + 1, self.points)

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the Fourier components of the channel."""
        return self.transform(moved.values[..., self.place])

    def transform(self, signal: np.ndarray) -> np.ndarray:
        """Return real Fourier components whose mean square is that of the signal within the harmonics."""
        result = np.empty((*signal.shape[:-1], self._count))
        if signal.size <= LARGEST_TRANSFORM or signal.ndim < 3:
            self._transform(signal, result)
        else:  # In parts that stay in the cache; larger ones cost more for their memory than for the transform.
            step = max(1, LARGEST_TRANSFORM // self.points)
            for values, components in zip(signal, result, strict=True):
                for first in range(0, len(values), step):
                    self._transform(values[first : first + step], components[first : first + step])
        return result if self.size == self._count else result.take(self._among, axis=-1)

    def _transform(self, signal: np.ndarray, result: np.ndarray) -> None:
        """Fill in the real Fourier components (…, count) of signals (…, points)."""
        highest, factor = (self._count - 1) // 2, math.sqrt(2.0 * self.size) / signal.shape[-1]
        sums = np.fft.rfft(signal)
        np.multiply(sums.real[..., : highest + 1], factor, out=result[..., : highest + 1])
        np.multiply(sums.imag[..., 1 : highest + 1], factor, out=result[..., highest + 1 : 2 * highest + 1])
        result[..., 0] *= ROOT_HALF
        if self._count % 2 == 0:
            result[..., -1] = np.add.reduce(signal * self._alternating, axis=-1) * math.sqrt(self.size)

    @cached_property
    def _waves(self) -> np.ndarray:
        """The harmonics that the components are of, the Nyquist harmonic last where it is compared."""
        highest = (self.size - 1) // 2
        return np.arange(highest + 1.0) if self.size % 2 else np.append(np.arange(highest + 1.0), self.points // 2)

    def through_sensor(
        self, sensing: Sensing, components: np.ndarray, values: np.ndarray, frequency: np.ndarray
    ) -> np.ndarray:
        """Return components (…, size) as the channel's sensor shows them, with parameters (…, names)."""
        factors = sensing.factors(self.place, values, frequency, self._waves)
        result = components if factors is None else self._multiplied(components, factors)
        if (place := sensing.offset_place[self.place]) != NO_PLACE:
            result = np.array(result)
            result[..., 0] += values[..., place] * math.sqrt(self.size)
        return result

    def through_sensor_vjp(
        self, sensing: Sensing, shown: np.ndarray, values: np.ndarray, frequency: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of Σ weights · `through_sensor`, whose result is `shown`, by components and values."""
        by_values, c = np.zeros(values.shape), self.place
        if (place := sensing.offset_place[c]) != NO_PLACE:
            by_values[..., place] += weights[..., 0] * math.sqrt(self.size)
            shown = np.array(shown)
            shown[..., 0] -= values[..., place] * math.sqrt(self.size)
        factors = sensing.factors(c, values, frequency, self._waves)
        if factors is None:
            return weights, by_values
        real, imag = self._products(shown, weights)
        for relative, by in sensing.slopes(c, values, frequency, self._waves):
            total = np.add.reduce(real if relative is None else relative.real * real - relative.imag * imag, axis=-1)
            for place, factor in by:
                if place < values.shape[-1]:
                    by_values[..., place] += total * factor
        return self._multiplied(weights, factors.conjugate), by_values

    def _products(self, components: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the complex p of Σ weights · `_multiplied`(components, factors) = Σ Re(factors · p)."""
        highest = (self.size - 1) // 2
        real, imag = components * weights, np.zeros((*components.shape[:-1], self._waves.size))
        cosine, sine = slice(1, highest + 1), slice(highest + 1, 2 * highest + 1)
        imag[..., cosine] = components[..., sine] * weights[..., cosine] - components[..., cosine] * weights[..., sine]
        total = np.concatenate([real[..., : highest + 1], real[..., 2 * highest + 1 :]], axis=-1)
        total[..., cosine] += real[..., sine]
        return total, imag

    def _multiplied(self, components: np.ndarray, factors: ComplexFactors) -> np.ndarray:
        """Return components (…, size) whose harmonics are multiplied by factors, by their real part at Nyquist."""
        highest = (self.size - 1) // 2
        real, imag = factors.real, factors.imag[..., 1 : highest + 1]
        cosine, sine = components[..., : highest + 1], components[..., highest + 1 : 2 * highest + 1]
        result = np.empty(components.shape)
        np.multiply(cosine, real[..., : highest + 1], out=result[..., : highest + 1])
        result[..., 1 : highest + 1] -= sine * imag
        np.multiply(sine, real[..., 1 : highest + 1], out=result[..., highest + 1 : 2 * highest + 1])
        result[..., highest + 1 : 2 * highest + 1] += cosine[..., 1:] * imag
        if self.size % 2 == 0:
            result[..., -1] = components[..., -1] * real[..., -1]
        return result

    @cached_property
    def _alternating(self) -> np.ndarray:
        """The signal (points,) 1, −1, 1, … of the Nyquist harmonic, over the number of points."""
        return np.where(np.arange(self.points) % 2 == 0, 1.0, -1.0) / self.points

    def spread(self, weights: np.ndarray) -> np.ndarray:
        """Return the transpose of `transform` applied to weights (…, size), its inverse but for a factor."""
        return self._signal(weights * (self.size / self.points))

    def _signal(self, components: np.ndarray) -> np.ndarray:
        """Return the signals (…, points) of components (…, size)."""
        if self.size < self._count:
            every = np.zeros((*components.shape[:-1], self._count))
            every[..., self._among] = components * math.sqrt(self._count / self.size)
            components = every
        return _fourier.from_components(components, self.points)

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the transposed transform."""
        total.values[..., self.place] += self.spread(weights)

    def simulate(self, components: np.ndarray, errors: np.ndarray) -> None:
        """Fill in the errors of the channel."""
        errors[..., self.place] = self._signal(components)

    def whole_period(self) -> Block:
        """Return the block itself."""
        return self

    def places(self, even: bool, dense: bool) -> tuple[str, np.ndarray, str]:
        """Return instants of the period if the noise is white and every harmonic is measured, or else harmonics."""
        if self.by_instants(even):
            return f"{self.channel}, at", np.arange(self.size), f"/{self.size} of the period"
        return f"{self.channel}, harmonic", self.harmonic, ""

    def independent(self, r: np.ndarray, even: bool) -> np.ndarray:
        """Return values at as many instants as there are components, if that is what `places` names."""
        return _fourier.from_components(r, self.size) if self.by_instants(even) else r

    def by_instants(self, even: bool) -> bool:
        """Return whether the independent parts are values at instants."""
        return even and self.size == self._count

    @property
    def wave_numbers(self) -> np.ndarray:
        """The harmonics."""
        return self.harmonic
