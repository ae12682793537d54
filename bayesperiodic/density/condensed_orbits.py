"""Orbits of condensed models that the measured outputs show, from which climbs start.

Friction and contact let several orbits exist at the same parameters, and from rest the solve leads to one with small
motions. The frequency response of the linear structure is known at any parameters: from outputs and inputs follow the
forces of the elements, without their laws, and from the forces their displacements, which start the solve.
"""

import numpy as np

from bayesperiodic._linalg import unwarned
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.log_posterior import Linearisation, LogPosterior
from bayesperiodic.density.responses import InitialOrbit, ResponseSolver, initial_orbit
from bayesperiodic.density.sweeps import tables
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.element_forces import times
from bayesperiodic.periodic.harmonics import harmonics, on_grid, resized
from bayesperiodic.problem.description import Description

# Harmonics that give the size of the forces, and the part of the harmonics, the highest, that give the noise.
FIRST_HARMONICS, OF_NOISE = 3, 0.25
# Smallest noise of an output, relative to its largest harmonic, and smallest singular values in a harmonic.
LEAST_NOISE, LEAST_SINGULAR = 1e-6, 1e-6


def near_data(problem: Description, theta: np.ndarray) -> Linearisation | None:
    """Return residuals and Jacobian at θ (names,) on the orbits that the data show, or from rest where that fails.

    None for models that are not condensed, and where experiments have guesses, anchors or are no whole periods.
    """
    of_others = problem.anchors or tables(problem) or any(e.condition or e.guess for e in problem.experiments)
    if not isinstance(problem.model, CondensedModel) or of_others:
        return None
    anchors = {e.name: _orbit(problem, e, theta) for e in problem.experiments}
    density = LogPosterior(problem, ResponseSolver(problem, anchors))
    return Linearisation(theta, density.solver, density.comparisons)


def _orbit(problem: Description, experiment: Experiment, theta: np.ndarray) -> InitialOrbit:
    name, equations = experiment.name, problem.equations[experiment.name]
    assert isinstance(equations, CondensedEquations)
    shown = shown_displacements(equations, problem.parameters(theta[None], name)[0], experiment)
    orbit = None if shown is None else initial_orbit(problem, name, theta, "static", (equations, shown))
    return orbit if orbit and orbit.derivatives else initial_orbit(problem, name, theta, "static")


@unwarned
def shown_displacements(
    equations: CondensedEquations, parameters: np.ndarray, experiment: Experiment
) -> np.ndarray | None:
    """Return displacements of the elements (points, elements) that fit the measured outputs; None without such.

    In each harmonic the forces f minimise the squares of the outputs' errors in units of the noise, and of f in units
    of the largest force, which keeps it finite where the outputs do not show it. Sensors are taken as ideal.
    """
    channels = [c for c in equations.model.outputs if c in experiment.outputs]
    if experiment.mask is not None or not channels or not equations.count:
        return None
    measured = harmonics(np.stack([experiment.outputs[c] for c in channels], axis=1))
    count, points = len(measured), 1 << (2 * len(measured) - 1).bit_length()
    noise = np.median(np.abs(measured[int((1.0 - OF_NOISE) * count) :]), axis=0)
    noise = np.maximum(noise, LEAST_NOISE * np.abs(measured).max(axis=0))
    if not (count > FIRST_HARMONICS and np.all(noise > 0.0)):
        return None
    weights = np.stack([_measured(experiment, c, count) for c in channels], axis=1) / noise
    matrices, load = equations.matrices(parameters, points)[0], equations.input_harmonics(points)
    rows = [equations.model.outputs.index(c) for c in channels]
    gains = matrices.y_f[:count, rows] * weights[..., None]
    missing = weights * (times(matrices.y_u[:, rows], load)[:count] - measured)
    first = [
        np.linalg.lstsq(*pair, rcond=LEAST_SINGULAR)[0]
        for pair in zip(gains[:FIRST_HARMONICS], missing[:FIRST_HARMONICS], strict=True)
    ]
    largest = float(np.abs(first).max())
    if not 0.0 < largest < np.inf:
        return None
    transposed = np.swapaxes(gains.conj(), -1, -2)
    forces = np.linalg.solve(
        transposed @ gains + np.eye(equations.count) / largest**2, times(transposed, missing)[..., None]
    )
    acting = resized(forces[..., 0], points)
    return on_grid(times(matrices.d_u, load) - times(matrices.d_f, acting), points)


def _measured(experiment: Experiment, channel: str, count: int) -> np.ndarray:
    """Return 1 for the harmonics that the output contains and 0 for others, (harmonics,)."""
    result = 1.0 * (np.arange(count) <= experiment.harmonics.get(channel, count))
    result[[h for h in experiment.unmeasured.get(channel, ()) if h < count]] = 0.0
    return result
