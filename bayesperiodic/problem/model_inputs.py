"""Inputs of the model at given parameters: the measured ones, corrected by their sensors."""

from dataclasses import replace

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.models.sensed import DELAY
from bayesperiodic.periodic.condensed import equations_for
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.problem.description import Description


def sensor_values(problem: Description, experiment: Experiment, theta: np.ndarray) -> dict[str, float]:
    """Return the parameters of sensors at one θ (names,) by plain name, without delays.

    The time of inputs is their own: an unknown delay of theirs is not removed, but added to the outputs with the other
    sign.
    """
    parameter_map = problem.parameter_maps[experiment.name]
    values = dict(zip(parameter_map.parameters, parameter_map.values(theta[None])[0].tolist(), strict=True))
    return {name: values[name] for name in problem.sensors.units if name in values and not name.startswith(DELAY)}


def model_inputs(problem: Description, experiment: Experiment, theta: np.ndarray) -> dict[str, np.ndarray]:
    """Return the measured inputs (points,) less their expected errors, corrected by their sensors at one θ (names,)."""
    errors = problem.input_errors.get(experiment.name)
    return problem.drive(experiment, errors, sensor_values(problem, experiment, theta))[0]


def without_sensors(
    problem: Description, equations: PeriodicEquations, experiment: Experiment, theta: np.ndarray
) -> tuple[PeriodicEquations, np.ndarray]:
    """Return equations at one θ (names,) as those of the model driven by corrected inputs, and its parameters."""
    parameters, model = problem.parameters(theta[None], experiment.name)[0], problem.sensors.plain_model
    if problem.model is model:
        return equations, parameters
    plain = equations_for(
        model,
        model_inputs(problem, experiment, theta),
        frequency=equations.frequency,
        samples=experiment.samples,
        scheme=problem.scheme,
        periods=experiment.periods,
        winding=experiment.winding,
    )
    return replace(plain, drift=equations.drift), parameters[: len(model.parameters)]
