"""The measured place of a jump, compared with the fold of the model."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.special import log_ndtr

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.special_points import FREQUENCY, Fold
from bayesperiodic.likelihood.block import Block, ComparedSignals, common
from bayesperiodic.models.model import Model

LEAST_RESIDUAL = 1e-5  # below which its derivative is that at the middle of the interval
ROOT_TWO_PI = math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, eq=False)
class Jump(Block):
    """Place of a jump: in units of its standard deviation, or as a deviance residual of an interval.

    A sweep with a step d that first shows the jump at f has the fold between its last place f − d (f + d downwards) and
    f. Places have errors of standard deviation s, so that the likelihood of a fold at x is a difference of normal
    distribution functions, l(x) = ln[Φ((high − x)/s) − Φ((low − x)/s)]; the residual r with r² = 2(max l − l) has the
    sign of middle − x.
    """

    vary: str = FREQUENCY
    low: float = 0.0
    high: float = 0.0
    sd: float = 1.0

    words: ClassVar[str] = "{0.channel}"

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Jump]":
        """Return one block of experiments of a fold."""
        fold = experiment.condition
        if not isinstance(fold, Fold):
            return []
        place = experiment.frequency if fold.vary == FREQUENCY else 1.0
        other = place - fold.step if fold.direction == "up" else place + fold.step
        low, high = sorted((place, other))
        height = -math.log(fold.sd)
        if fold.step:  # of an interval, whose density has the height 1, not that of a normal distribution
            height = float(_log_probability(np.array(0.5 * (low + high)), low, high, fold.sd)) + math.log(ROOT_TWO_PI)
        given = common(experiment, f"jump in {fold.vary}", count=0.0, size=1, log_scale=height)
        return [cls(vary=fold.vary, low=low, high=high, sd=fold.sd, **given)]

    def compare(self, predicted: ComparedSignals, difference: ComparedSignals) -> np.ndarray:
        """Return the residual."""
        return self._residual(self._place(predicted))[..., None]

    def changes(self, predicted: ComparedSignals, directions: ComparedSignals) -> np.ndarray:
        """Return minus the derivatives of the residual."""
        return self._slope(self._place(predicted)) * np.asarray(self._place(directions))[..., None]

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the weight times minus the derivative of the residual."""
        self._place(total)[...] += weights[0] * self._slope(self._place(predicted))

    def _place(self, signals: ComparedSignals) -> np.ndarray:
        return np.asarray(signals.frequency if self.vary == FREQUENCY else signals.scale)

    @property
    def _middle(self) -> float:
        return 0.5 * (self.low + self.high)

    def _residual(self, place: np.ndarray) -> np.ndarray:
        """Return the residual (…,) for folds at places (…,)."""
        if self.low == self.high:
            return (self.high - place) / self.sd
        most = _log_probability(np.array(self._middle), self.low, self.high, self.sd)
        deviance = 2.0 * np.maximum(most - _log_probability(place, self.low, self.high, self.sd), 0.0)
        return np.sign(self._middle - place) * np.sqrt(deviance)

    def _slope(self, place: np.ndarray) -> np.ndarray:
        """Return minus the derivative of the residual by the place, (…,)."""
        if self.low == self.high:
            return np.full(np.shape(place), 1.0 / self.sd)
        residual = self._residual(place)
        logarithm = _log_probability(place, self.low, self.high, self.sd)
        low, high = (self.low - place) / self.sd, (self.high - place) / self.sd
        ratios = [np.exp(-0.5 * edge**2 - logarithm) / ROOT_TWO_PI for edge in (low, high)]
        slope = (ratios[0] - ratios[1]) / self.sd  # of l
        half = (self.high - self._middle) / self.sd
        most = _log_probability(np.array(self._middle), self.low, self.high, self.sd)
        curvature = 2.0 * half * np.exp(-0.5 * half**2 - most) / ROOT_TWO_PI / self.sd**2
        small = np.abs(residual) < LEAST_RESIDUAL
        return np.where(small, np.sqrt(curvature), slope / np.where(small, 1.0, residual))


def _log_probability(place: np.ndarray, low: float, high: float, sd: float) -> np.ndarray:
    """Return ln[Φ((high − x)/s) − Φ((low − x)/s)] at places x, in whichever tail it is accurate."""
    upper, lower = (high - place) / sd, (low - place) / sd
    right = lower > 0.0
    larger, smaller = np.where(right, -lower, upper), np.where(right, -upper, lower)
    first = log_ndtr(larger)
    return np.asarray(first + np.log1p(-np.exp(log_ndtr(smaller) - first)))
