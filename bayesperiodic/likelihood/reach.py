"""Whether the model's branch of responses reaches the frequency at which a point of a table was measured.

A point that was measured on a branch is evidence that the branch exists there. Where the model's branch ends at a fold
before the measured frequency f, the point is compared with the orbit at the fold, whose frequency is f_fold, and
(f − f_fold)/w is one more residual, with the resolution w of the frequency as its standard deviation. Elsewhere it is
zero. So the density is continuous, and falls off beyond the fold over the width w.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import ComparedSignals, LinearBlock, common
from bayesperiodic.models.model import Model

REACH_OF_BRANCH = "reach of the branch"


@dataclass(frozen=True, eq=False)
class Reach(LinearBlock):
    """Distance of the measured frequency beyond the fold of the model's branch, in units of its resolution."""

    resolution: float = 1.0  # [Hz]

    words: ClassVar[str] = REACH_OF_BRANCH
    observed: ClassVar[bool] = False
    of_each: ClassVar[tuple[str, ...]] = ("resolution",)

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Reach]":
        """Return one block of every point of a table."""
        if experiment.sweep is None or model.autonomous:
            return []
        given = common(experiment, REACH_OF_BRANCH, count=0.0, size=1)
        return [cls(resolution=experiment.sweep.resolution * experiment.frequency, **given)]

    @property
    def alike_in(self) -> tuple[Hashable, ...]:
        """Nothing more."""
        return (type(self),)

    def compare(self, predicted: ComparedSignals, difference: ComparedSignals) -> np.ndarray:
        """Return the distance; the frequency of the prediction is that of its orbit."""
        return np.asarray(difference.frequency)[..., None] / self.resolution

    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return changes of the frequency over the resolution."""
        return np.asarray(moved.frequency)[..., None] / self.resolution

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add nothing: the frequency does not change where the branch reaches the point."""
