"""Samples at the points of a mask."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import Block, ComparedSignals, Timed, common, measured_channels
from bayesperiodic.likelihood.noise import Noise
from bayesperiodic.models.model import Model


@dataclass(frozen=True, eq=False)
class Samples(Timed):
    """Values of one channel at some points of the period."""

    words: ClassVar[str] = "{0.channel} at {0.size} points of a mask"

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Samples]":
        """Return one block a channel, of experiments with a mask and without a covariance."""
        if experiment.mask is None or experiment.covariance is not None:
            return []
        at = np.flatnonzero(experiment.mask)
        return [
            cls(**common(experiment, channel, place, count=count, size=at.size, position=at / experiment.mask.size))
            for place, channel in enumerate(measured_channels(experiment, model))
            for count in [float(experiment.independent[channel])]
        ]

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the values at the points."""
        return moved.values[..., self.place].take(self.at, axis=-1)

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the weights at the points."""
        total.values[self.at, self.place] += weights

    def simulate(self, components: np.ndarray, errors: np.ndarray) -> None:
        """Fill in the errors at the points."""
        errors[:, self.at, self.place] = components

    def is_dense(self, noise: Any) -> bool:
        """Return whether the noise model has a covariance of points."""
        return type(noise).covariance is not Noise.covariance

    def whole_period(self) -> Block:
        """Return the same with all points and harmonics of the grid."""
        harmonic = np.minimum(np.arange(self.points), self.points - np.arange(self.points))
        averaged = self.averaged * self.points / self.size
        return replace(self, harmonic=harmonic, size=self.points, averaged=averaged)

    def places(self, even: bool, dense: bool) -> tuple[str, np.ndarray, str]:
        """Return the points on the grid, all together if they are correlated."""
        if dense:
            return self.channel, np.zeros(self.size, dtype=int), ""
        return f"{self.channel}, at", self.at, f"/{self.points} of the period"

    def along_period(self, part: np.ndarray) -> np.ndarray:
        """Return the values as cosine components along the period."""
        from scipy.fft import dct

        return np.asarray(dct(part, norm="ortho", axis=-1))
