"""Measured frequency and amplitude of a resonance, compared with the model's point of the same phase."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.special_points import PhaseLag
from bayesperiodic.likelihood.block import Block, ComparedSignals, common, measured_channels
from bayesperiodic.models.model import Model


@dataclass(frozen=True, eq=False)
class Resonance(Block):
    """Frequency of a resonance, and its amplitude where the level of the input is known, in standard deviations."""

    frequency: float = 0.0  # [Hz]
    frequency_sd: float = 1.0
    line: int = 1  # the harmonic
    amplitude: float = 0.0
    amplitude_sd: float = 0.0  # zero if the amplitude is a condition, not data

    words: ClassVar[str] = "{0.channel}"

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Resonance]":
        """Return one block of experiments at a given phase."""
        lag = experiment.condition
        if not isinstance(lag, PhaseLag):
            return []
        scale = -math.log(lag.frequency_sd) - (math.log(lag.amplitude_sd) if lag.level_known else 0.0)
        place = measured_channels(experiment, model).index(lag.output)
        size = 2 if lag.level_known else 1
        given = common(experiment, "resonance", place, count=0.0, size=size, log_scale=scale)
        measured: dict[str, Any] = {"amplitude": lag.amplitude, "amplitude_sd": lag.amplitude_sd, "line": lag.harmonic}
        return [cls(frequency=experiment.frequency, frequency_sd=lag.frequency_sd, **measured, **given)]

    def compare(self, predicted: ComparedSignals, difference: ComparedSignals) -> np.ndarray:
        """Return measured minus predicted frequency and amplitude."""
        parts = [(self.frequency - np.asarray(predicted.frequency)) / self.frequency_sd]
        if self.amplitude_sd:
            parts.append((self.amplitude - np.abs(self._harmonic(predicted))) / self.amplitude_sd)
        return np.stack(parts, axis=-1)

    def changes(self, predicted: ComparedSignals, directions: ComparedSignals) -> np.ndarray:
        """Return the derivatives of frequency and amplitude."""
        parts = [np.asarray(directions.frequency) / self.frequency_sd]
        if self.amplitude_sd:
            here = self._harmonic(predicted)
            parts.append(np.real(self._harmonic(directions) * np.conj(here) / np.abs(here)) / self.amplitude_sd)
        return np.stack(parts, axis=-1)

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the transposed derivatives."""
        total.frequency[...] += weights[0] / self.frequency_sd
        if self.amplitude_sd:
            here = self._harmonic(predicted)
            pulled = np.real(np.conj(here) / np.abs(here) * self._wave)
            total.values[:, self.place] += weights[1] / self.amplitude_sd * pulled

    @property
    def _wave(self) -> np.ndarray:
        return 2.0 / self.points * np.exp(-2j * np.pi * self.line * np.arange(self.points) / self.points)

    def _harmonic(self, signals: ComparedSignals) -> np.ndarray:
        """Return the complex amplitudes (…,)."""
        return np.asarray(np.sum(signals.values[..., self.place] * self._wave, axis=-1))
