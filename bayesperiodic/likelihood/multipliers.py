"""Measured Floquet multipliers, compared as log|μ|."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import ComparedSignals, LinearBlock, common, measured_channels, times
from bayesperiodic.likelihood.section_points import values_at, whitening
from bayesperiodic.models.model import Model

MULTIPLIERS = "multipliers"


@dataclass(frozen=True, eq=False)
class Multipliers(LinearBlock):
    """Logarithms of multipliers in units of their standard deviations, given the errors of the section points."""

    slopes: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))  # (size, values), regression on the values
    whitening: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))  # (size, size)

    words: ClassVar[str] = "{0.size} Floquet multipliers"

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Multipliers]":
        """Return one block of experiments with multipliers."""
        e, count = experiment, experiment.measured_multipliers.size
        if not count:
            return []
        position, slopes = np.empty(0), np.zeros((count, 0))
        if e.multiplier_sd is not None:
            root, scale = whitening(np.diag(e.multiplier_sd**2))
        else:
            assert e.covariance is not None
            position = np.flatnonzero(e.measured_points) / e.measured_points.size
            size = position.size * len(measured_channels(e, model))
            cross = e.covariance[size:, :size]
            slopes = np.linalg.solve(e.covariance[:size, :size], cross.T).T
            root, scale = whitening(e.covariance[size:, size:] - slopes @ cross.T)
        given = common(e, MULTIPLIERS, count=0.0, size=count, position=position)
        return [cls(slopes=slopes, whitening=root, log_scale=scale, **given)]

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the whitened logarithms, less what goes with the values."""
        logarithms = moved.log_multipliers
        if self.at.size:
            logarithms = logarithms - times(self.slopes, values_at(moved.values, self.at))
        return times(self.whitening, logarithms)

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the transposed whitening and regression."""
        joint = weights @ self.whitening
        total.log_multipliers[...] += joint
        if self.at.size:
            total.values[self.at] -= (joint @ self.slopes).reshape(self.at.size, -1)
