"""Ways to a solution that Newton's method does not find at once: easier problems that turn into the one wanted."""

import numpy as np

from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.equations import PeriodicEquations, Solved
from bayesperiodic.periodic.family import INPUTS, Family
from bayesperiodic.periodic.trace import trace

SOFTEST = 1e-3
SHARPENING = 2.0
SMALLEST_SHARPENING = 1.02


def raise_amplitude(equations: PeriodicEquations, parameters: np.ndarray, static: np.ndarray) -> Solved | None:
    """Follow the solution while the inputs' variation about their means grows from nothing; None if that fails."""
    if not equations.model.inputs:
        return None
    mean = np.zeros_like(equations.inputs)
    width = len(equations.model.inputs)
    mean[:, :width] = equations.inputs[:, :width].mean(axis=0)
    family = Family(equations.with_inputs(mean), parameters, (INPUTS,), equations.inputs - mean)
    beginning = family.equations.solve(parameters, static)
    if beginning.code != CONVERGED:
        return None
    columns = family.equations.residual_jacobian(beginning.z, parameters)
    factors = family.equations.factors(columns)
    if not factors.regular:
        return None
    linear = factors.solve(family.slopes(np.zeros(1), beginning.z, columns)[0])
    points = list(trace(family, beginning.z, np.zeros(1), until=1.0, step=0.1, size=np.ptp(linear, axis=0)))
    if not points or points[-1].values[0] != 1.0:
        return None
    return equations.solve(parameters, points[-1].z)


def sharpen(equations: PeriodicEquations, parameters: np.ndarray, guess: np.ndarray) -> Solved | None:
    """Solve with soft signs first and sharpen them step by step; None if that fails or there are none."""
    if not equations.model.smooth_signs:
        return None
    soft = PeriodicEquations(
        equations.model.softened(), equations.grid, equations.frequency, equations.inputs, equations.drift
    )
    sharpness, factor, z = SOFTEST, SHARPENING, guess
    solved = soft.solve(np.append(parameters, sharpness), z)
    if solved.code != CONVERGED:
        return None
    z = solved.z
    while sharpness < 1.0:
        next_sharpness = min(1.0, sharpness * factor)
        solved = soft.solve(np.append(parameters, next_sharpness), z)
        if solved.code == CONVERGED:
            sharpness, z, factor = next_sharpness, solved.z, min(factor**2, SHARPENING)
        else:
            factor = np.sqrt(factor)
            if factor < SMALLEST_SHARPENING:
                return None
    return equations.solve(parameters, z)
