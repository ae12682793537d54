"""Special points of a problem's experiments, as the solver of its responses needs them."""

from typing import NamedTuple

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.special_points import FREQUENCY, Fold
from bayesperiodic.likelihood.observation import Response
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.equations import PeriodicEquations, null_vector
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.periodic.solve import as_guess
from bayesperiodic.periodic.special import SpecialEquations, SpecialPoint
from bayesperiodic.periodic.special_batch import SpecialAnchor
from bayesperiodic.periodic.special_start import find_special, fold_equations, phase_equations


class PointDerivatives(NamedTuple):
    """Derivatives of a response by all parameters of the model."""

    outputs: np.ndarray  # (parameters, points, channels)
    frequency: np.ndarray  # (parameters,)
    scale: np.ndarray  # (parameters,), of the input whose level is unknown; zero where there is none


def special_equations(experiment: Experiment, equations: PeriodicEquations) -> SpecialEquations:
    """Return the equations of an experiment's special point."""
    condition = experiment.condition
    assert condition is not None
    if isinstance(condition, Fold):
        return fold_equations(equations, condition.vary, condition.direction)
    amplitude = None if condition.level_known else condition.amplitude
    given = condition.output, condition.drive, condition.lag
    return phase_equations(equations, *given, harmonic=condition.harmonic, amplitude=amplitude)


def special_values(special: SpecialEquations, frequency: float, scale: float) -> np.ndarray:
    """Return the unknowns (unknowns,) of a point of this frequency and scale of the input."""
    return np.array([frequency if name == FREQUENCY else scale for name in special.free])


def special_anchor(
    special: SpecialEquations, parameters: np.ndarray, moving: np.ndarray, guess: SpecialPoint | None
) -> tuple[SpecialAnchor, PointDerivatives | None]:
    """Return the anchor at parameters, from a guess or found along a branch, with its derivatives if it is solved."""
    if guess is None:
        solved = find_special(special, parameters)
    else:
        solved = special.newton(guess, parameters, special.row(guess.vector) if special.is_fold else guess.vector)
    if solved.code != CONVERGED:
        return SpecialAnchor(parameters, solved.point, solved.code), None
    anchor = SpecialAnchor.at(special, parameters, solved.point, moving)
    slopes = anchor.sensitivities
    if slopes is None:
        return anchor, None
    by = {name: slopes.point.values[:, k] for k, name in enumerate(special.free)}
    frequency, none = by.pop(FREQUENCY, np.zeros(parameters.size)), np.zeros(parameters.size)
    return anchor, PointDerivatives(slopes.outputs, frequency, next(iter(by.values()), none))


def again_special(
    experiment: Experiment,
    equations: PeriodicEquations,
    values: tuple[np.ndarray, np.ndarray],
    near: PeriodicSolution,
    finer: int,
) -> Response | None:
    """Return the response at a special point, solved on a finer grid from a near solution; None if that fails.

    The equations are those of the experiment on that grid, `values` the parameters of the model and of the sensors.
    """
    (parameters, sensors), special = values, special_equations(experiment, equations)
    scaled = [name for name in special.free if name != FREQUENCY]
    scale = float(np.ptp(near.inputs[scaled[0]]) / np.ptp(experiment.inputs[scaled[0]])) if scaled else 1.0
    unknowns, z = special_values(special, near.frequency, scale), as_guess(equations, near)
    here, vector = special.at(unknowns), np.zeros_like(z)
    if special.is_fold:
        columns = here.residual_jacobian(z, parameters)
        vector = null_vector(here.grid, columns, here.count, here.frequency)
    guess = SpecialPoint(z, unknowns, vector)
    solved = special.newton(guess, parameters, special.row(vector) if special.is_fold else vector)
    if solved.code != CONVERGED:
        return None
    here, none = special.at(solved.point.values), np.empty(0)
    by = dict(zip(special.free, solved.point.values, strict=True))
    level = np.array(next((by[name] for name in scaled), 1.0))
    outputs = here.outputs(solved.point.z, parameters)[::finer]
    return Response(outputs, np.array(here.frequency), none, sensors, level)
