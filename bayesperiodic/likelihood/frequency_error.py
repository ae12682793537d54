"""Error of the measured frequency of a driven experiment, and what it does to the measured periods.

The frequency of a recording is estimated with a standard error s. A period that is folded at the frequency f + δ
instead of f has the harmonics h of all channels turned by −2π h δ t, where t is the time from τ = 0 to the middle of
the samples: the least-squares fit keeps the phase there. What it mixes into other harmonics is less than 1/cycles of
their noise. The error δ/s is one more independent standard normal error of the experiment, beside those of its inputs,
see `input_noise`. If time is not explicit in the model, a common shift of all channels does not matter, and only the
differences of t between channels are kept. The frequency of the orbit of an autonomous model is data, see
`orbit_frequency`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.models.model import Model


@dataclass(frozen=True)
class FrequencyError:
    """Error of the frequency of one experiment, in units of its standard error."""

    se: float  # standard error [Hz]
    turns: Mapping[str, float]  # by channel, by how many response periods one standard error delays the folded period

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "FrequencyError | None":
        """Return that of an experiment; None if the frequency is exact, or data of an autonomous model."""
        if model.autonomous or not experiment.frequency_se > 0.0:
            return None
        middle = {name: experiment.middle.get(name, 0.0) for name in (*experiment.inputs, *experiment.outputs)}
        common = 0.0 if model.explicit_time else next(iter(middle.values()))
        fraction = experiment.frequency_se / experiment.periods
        return cls(experiment.frequency_se, {name: fraction * (time - common) for name, time in middle.items()})

    def true_inputs(self, inputs: Mapping[str, np.ndarray], error: float) -> dict[str, np.ndarray]:
        """Return measured inputs (points,) as they are without an error, in standard errors, of the frequency."""
        return {name: _delayed(u, -error * self.turns[name]) for name, u in inputs.items()}

    def direction(self, experiment: Experiment, names: Sequence[str]) -> np.ndarray:
        """Return the changes of measured (u, u̇, ü) (points, 3·inputs) by one standard error, as functions of τ.

        Inputs are in the order of `names`.
        """
        width, fundamental = len(names), experiment.frequency / experiment.periods
        result = np.zeros((experiment.samples * experiment.periods, 3 * width))
        for column, name in enumerate(names):
            turned = -self.turns[name] * _fourier.derivative(_fourier.coefficients(experiment.inputs[name]), 1.0)
            for order in range(3):
                rate = _fourier.derivative(turned, fundamental, order)
                result[:, order * width + column] = _fourier.on_grid(rate, len(result))
        return result


def _delayed(values: np.ndarray, fraction: float) -> np.ndarray:
    """Return a periodic signal (points,) that comes a fraction of the period later."""
    if not fraction:
        return values
    amplitudes = _fourier.coefficients(values)
    return _fourier.on_grid(amplitudes * np.exp(-2j * np.pi * fraction * np.arange(amplitudes.size)), values.size)
