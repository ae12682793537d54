"""Cycles that are not isolated, as those of conservative models, which have a cycle of every amplitude.

Near a guess, the equations of an autonomous model are solved on a coarse grid for the orbit and its frequency by the
Gauss-Newton method of minimal norm, which does not mind that solutions are not isolated. The linearised equations of an
isolated cycle are solved by one change only, a shift of its phase. A further one means a family of cycles.
"""

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.schemes import CyclicGrid, find_scheme

# Points of the grids that are tried, and most unknowns, Gauss-Newton steps.
FAMILY_POINTS, MOST_FAMILY_UNKNOWNS, FAMILY_STEPS = (81, 161, 321), 700, 15
# Residual of a cycle, singular values that are left out of a step, and the range of an orbit that has not shrunk, in
# units of the guess's.
FAMILY_RESIDUAL, NO_STEP, NOT_SHRUNK = 1e-10, 1e-6, 0.1
# Smallest singular value of a family (of conservative models up to 1e-12 where the grid resolves them) and of a cycle
# that is clearly isolated (van der Pol's: 3e-3 and more).
ONE_OF_MANY, ISOLATED = 1e-8, 1e-5

MANY_CYCLES = (
    "near one there are others for the same parameters, as in conservative models, so that the parameters do not "
    "determine the amplitude. Add the damping and the drive that select it, or a term that vanishes on the cycle of a "
    'given energy (how-to "Make failing solves converge").'
)


def has_neighbours(equations: PeriodicEquations, theta: np.ndarray, z: np.ndarray, frequency: float) -> bool:
    """Return whether the cycle of an autonomous model near a guess z (points, states) belongs to a continuous family.

    False also if no cycle is found there.
    """
    for points in FAMILY_POINTS:
        if points * z.shape[1] > MOST_FAMILY_UNKNOWNS and points > FAMILY_POINTS[0]:
            break
        smallest = _smallest_singular_value(equations, theta, z, frequency, points)
        if smallest < ONE_OF_MANY or smallest > ISOLATED:
            return bool(smallest < ONE_OF_MANY)
    return False


def _smallest_singular_value(
    equations: PeriodicEquations, theta: np.ndarray, z: np.ndarray, frequency: float, points: int
) -> float:
    """Return that of the linearised equations at the cycle nearest to a guess; NaN if none is found."""
    grid = CyclicGrid(find_scheme("fourier"), points, 1)
    z = _fourier.on_grid(_fourier.coefficients(z.T), points).T
    here = PeriodicEquations(equations.model, grid, frequency, np.empty((points, 0)), equations.drift)
    size = np.ptp(z, axis=0)
    if not np.all(np.isfinite(z)) or not np.any(size > 0.0):
        return np.nan
    scales = np.where(size > 0.0, size, size.max())
    step = np.inf
    for _ in range(FAMILY_STEPS):
        here = here.at_frequency(frequency)
        residual, matrix = _linearised(here, theta, np.ascontiguousarray(z), scales)
        if not (np.isfinite(residual).all() and np.isfinite(matrix).all()):
            return np.nan
        if np.abs(residual).max() < FAMILY_RESIDUAL and step < 1.0:
            break
        change = np.linalg.lstsq(matrix, -residual, rcond=NO_STEP)[0]
        step = float(np.abs(change).max())
        change /= max(1.0, 2.0 * step)
        z = z + change[:-1].reshape(z.shape) * scales
        frequency *= float(np.exp(change[-1]))
    else:
        return np.nan
    if np.any(np.ptp(z, axis=0) < NOT_SHRUNK * size):
        return np.nan
    return float(np.linalg.svd(matrix, compute_uv=False)[-1])


def _linearised(
    equations: PeriodicEquations, theta: np.ndarray, z: np.ndarray, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return g (equations,) and its derivatives by z and the logarithm of the frequency, all scaled."""
    points, count = z.shape
    columns = equations.residual_jacobian(z, theta)
    g, by = columns[:, :count], columns[:, count:].reshape(points, count, 3, count)
    unit = np.eye(points)
    once = equations.frequency * _fourier.on_grid(_fourier.derivative(_fourier.coefficients(unit), 1.0, 1), points).T
    matrix = np.zeros((points, count, points, count))
    for order, derivative in enumerate((unit, once, once @ once)):
        matrix += by[:, :, order, None, :] * derivative[:, None, :, None]
    states = equations.states(z).reshape(points, 3, count)
    by_frequency = np.einsum("nes,ns->ne", by[:, :, 1], states[:, 1]) + 2 * np.einsum(
        "nes,ns->ne", by[:, :, 2], states[:, 2]
    )
    rates = (2 * np.pi * equations.frequency) ** np.arange(3)
    sizes = np.max(np.einsum("neos,o,s->ne", np.abs(by), rates, scales), axis=0)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    whole = np.concatenate([(matrix * scales).reshape(points, count, -1), by_frequency[:, :, None]], axis=2)
    whole /= sizes[:, None]
    return (g / sizes).ravel(), whole.reshape(points * count, -1)
