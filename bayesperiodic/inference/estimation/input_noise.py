"""What the measurement noise of the inputs brings to the outputs."""

from collections.abc import Mapping

import numpy as np

from bayesperiodic import fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.inference.problem import Problem
from bayesperiodic.periodic.sensitivity import input_sensitivities
from bayesperiodic.periodic.solution import PeriodicSolution, periodic_part


def input_noise(problem: Problem, theta: np.ndarray, solutions: Mapping[str, PeriodicSolution]) -> dict[str, float]:
    """Return the standard deviation that the inputs' noise brings to each channel, root mean square over experiments.

    The noise of each kept Fourier amplitude of an input, and of its derivatives, is carried through the linearised
    periodic problem; the variance is averaged over the period, within the harmonics kept.

    Parameters
    ----------
    problem : Problem
    theta : array (names,)
    solutions : mapping of str to PeriodicSolution
        At θ, by experiment.
    """
    variances: dict[str, list[float]] = {channel: [0.0] for channel in problem.channels}
    for e in problem.experiments:
        directions = _perturbations(e)
        if not len(directions):
            continue
        equations = problem.responses.equations[e.name].at_frequency(solutions[e.name].frequency)
        z, parameters = (
            periodic_part(equations, solutions[e.name].states),
            problem.responses.parameters(theta[None], e.name)[0],
        )
        derivative = input_sensitivities(equations, z, parameters, directions)
        if derivative is None:
            continue
        for channel in e.outputs:
            moved = e.project(channel, derivative.outputs[:, :, problem.model.outputs.index(channel)])
            variances[channel].append(float(np.sum(np.mean(moved**2, axis=1))))
    return {channel: float(np.sqrt(np.mean(v[1:] or v))) for channel, v in variances.items()}


def _perturbations(experiment: Experiment) -> np.ndarray:
    """Return one-sd perturbations (directions, points, 3·inputs) of (u, u̇, ü), two a noisy Fourier amplitude."""
    points = experiment.samples * experiment.periods
    count, directions = len(experiment.inputs), []
    for i, name in enumerate(experiment.inputs):
        for h, variance in enumerate(experiment.amplitude_variance.get(name, ())):
            for part in (1.0,) if h == 0 else (1.0, 1j):
                amplitude = np.zeros(h + 1, dtype=complex)
                amplitude[h] = part * np.sqrt(variance if h == 0 else 0.5 * variance)
                direction = np.zeros((points, 3 * count))
                for order in range(3):
                    rate = fourier.derivative(amplitude, experiment.frequency / experiment.periods, order)
                    direction[:, order * count + i] = fourier.on_grid(rate, points)
                directions.append(direction)
    return np.array(directions)
