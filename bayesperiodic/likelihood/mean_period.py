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
from bayesperiodic.models.model import Model

LARGEST_TRANSFORM = 16_384
ROOT_TWO = math.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class MeanPeriod(Timed):
    """Real Fourier components of one channel, which are independent and have variance v under white noise."""

    spectral: ClassVar[bool] = True

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[MeanPeriod]":
        """Return one block a channel, of experiments without a mask and a covariance."""
        if experiment.mask is not None or experiment.covariance is not None:
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
            blocks.append(cls(**given))
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
        highest, factor = (self._count - 1) // 2, math.sqrt(0.5 * self.size)
        amplitudes = _fourier.coefficients(signal, highest)
        np.multiply(amplitudes.real, factor, out=result[..., : highest + 1])
        np.multiply(amplitudes.imag[..., 1:], factor, out=result[..., highest + 1 : 2 * highest + 1])
        result[..., 0] *= ROOT_TWO
        if self._count % 2 == 0:
            result[..., -1] = np.sum(signal * self._alternating, axis=-1) * math.sqrt(self.size)

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
