"""Values of all channels with a given covariance, such as points of a Poincaré section."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import solve_triangular

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import PROPORTIONAL, ComparedSignals, LinearBlock, common, measured_channels, times
from bayesperiodic.models.model import Model

SCALE = "scale"


@dataclass(frozen=True, eq=False)
class SectionPoints(LinearBlock):
    """Values that are whitened by their covariance, which is known up to one factor, the noise parameter "scale"."""

    whitening: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))  # (size, size)

    words: ClassVar[str] = "{0.size} values with a given covariance"

    @property
    def counted(self) -> bool:
        """True: the scale is a noise parameter."""
        return True

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[SectionPoints]":
        """Return one block of experiments with a covariance."""
        if experiment.covariance is None:
            return []
        position = np.flatnonzero(experiment.measured_points) / experiment.measured_points.size
        size = position.size * len(measured_channels(experiment, model))
        root, scale = whitening(experiment.covariance[:size, :size])
        given = common(experiment, SCALE, count=float(size), size=size, position=position)
        return [cls(whitening=root, log_scale=scale, **given)]

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the whitened values."""
        return times(self.whitening, values_at(moved.values, self.at))

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the transposed whitening."""
        total.values[self.at] += (weights @ self.whitening).reshape(self.at.size, -1)

    def simulate(self, components: np.ndarray, errors: np.ndarray) -> None:
        """Fill in the errors at the points."""
        values = solve_triangular(self.whitening, components.T, lower=True).T
        errors[:, self.at] = values.reshape(len(values), self.at.size, -1)

    def parameter_names(self, noise: Any) -> tuple[str, ...]:
        """Return the scale, one for all experiments unless each has its own noise."""
        return (f"{SCALE}[{self.experiment}]" if noise.separate else SCALE,)

    def spectrum(self, noise: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the scale."""
        return values, PROPORTIONAL

    def places(self, even: bool, dense: bool) -> tuple[str, np.ndarray, str]:
        """Return the whitened values."""
        return "value", np.arange(self.size), ""


def values_at(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the values (…, points · channels) of signals (…, points, channels) at some points, point by point."""
    picked = values.take(at, axis=-2)
    return picked.reshape(*picked.shape[:-2], picked.shape[-2] * picked.shape[-1])


def whitening(covariance: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the inverse of the lower Cholesky factor, and the logarithm of its determinant."""
    root = solve_triangular(np.linalg.cholesky(covariance), np.eye(len(covariance)), lower=True)
    return root, float(np.log(np.diag(root)).sum())
