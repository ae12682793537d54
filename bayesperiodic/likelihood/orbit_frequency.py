"""The measured frequency of the orbit of an autonomous model."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import ComparedSignals, LinearBlock, common
from bayesperiodic.models.model import Model

FREQUENCY = "frequency"


@dataclass(frozen=True, eq=False)
class OrbitFrequency(LinearBlock):
    """Frequency in units of its standard error."""

    standard_error: float = 1.0  # [Hz]

    words: ClassVar[str] = FREQUENCY

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[OrbitFrequency]":
        """Return one block of every experiment of an autonomous model."""
        if not model.autonomous:
            return []
        error = experiment.frequency_se
        given = common(experiment, FREQUENCY, count=0.0, size=1, log_scale=-math.log(error))
        return [cls(standard_error=error, **given)]

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the frequency over its standard error."""
        return np.asarray(moved.frequency)[..., None] / self.standard_error

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the weight over the standard error."""
        total.frequency[...] += weights[0] / self.standard_error
