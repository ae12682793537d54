"""Samples at the points of a mask."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy.fft import dct

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import Block, ComparedSignals, Timed, common, measured_channels
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
            cls(
                count=float(experiment.independent[channel]),
                size=at.size,
                position=at / experiment.mask.size,
                **common(experiment, channel, place),
            )
            for place, channel in enumerate(measured_channels(experiment, model))
        ]

    @cached_property
    def _at(self) -> np.ndarray:
        """Indices of the points on the grid, (size,)."""
        return np.rint(self.position * self.points).astype(int)

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the values at the points."""
        return moved.values[..., self.place].take(self._at, axis=-1)

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the weights at the points."""
        total.values[self._at, self.place] += weights

    def simulate(self, components: np.ndarray, errors: np.ndarray) -> None:
        """Fill in the errors at the points."""
        errors[:, self._at, self.place] = components

    def is_dense(self, noise: Any) -> bool:
        """Return whether the noise model has a covariance of points."""
        return bool(noise.correlates_points)

    def whole_period(self) -> Block:
        """Return the same with all points and harmonics of the grid."""
        harmonic = np.minimum(np.arange(self.points), self.points - np.arange(self.points))
        averaged = self.averaged * self.points / self.size
        return replace(self, harmonic=harmonic, size=self.points, averaged=averaged)

    def places(self, even: bool, dense: bool) -> tuple[str, np.ndarray, str]:
        """Return the points on the grid, all together if they are correlated."""
        if dense:
            return self.channel, np.zeros(self.size, dtype=int), ""
        return f"{self.channel}, at", self._at, f"/{self.points} of the period"

    def along_period(self, part: np.ndarray) -> np.ndarray:
        """Return the values as cosine components along the period."""
        return np.asarray(dct(part, norm="ortho", axis=-1))

    def refusal(self, noise: Any) -> str:
        """Return that the noise model lacks a covariance."""
        return (
            f"noise: must have a method `covariance` for the points of a mask, got {noise.name!r}; experiment "
            f"{self.experiment!r} has {self.size} points of {self.channel!r}, which have no harmonics, so that "
            "`spectrum` gives no variances of them. Implement `covariance`, or compare whole periods."
        )
