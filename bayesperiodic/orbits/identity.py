"""What makes two periodic orbits the same: prime period, cyclic shifts, sign change, and how far section points are."""

import numpy as np

from bayesperiodic.orbits.angles import wrapped
from bayesperiodic.periodic.equations import PeriodicEquations

STILL = 1e-6


def section_points(outputs: np.ndarray, samples: int, angles: np.ndarray) -> np.ndarray:
    """Return outputs (points, coordinates) at tau = 0, 1, …, angles in (−π, π]."""
    points = np.array(outputs[::samples])
    points[:, angles] = wrapped(points[:, angles])
    return points


def differences(points: np.ndarray, others: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return points − others, (…, coordinates), angles by the shorter way."""
    result = points - others
    result[..., angles] = wrapped(result[..., angles])
    return result


def nearest_shift(points: np.ndarray, others: np.ndarray, angles: np.ndarray, scales: np.ndarray) -> tuple[int, float]:
    """Return the cyclic shift of others (period, coordinates) that is nearest to points, and their largest distance.

    Distances are in units of `scales` (coordinates,).
    """
    distances = [
        float(np.max(np.abs(differences(points, np.roll(others, -shift, axis=0), angles)) / scales))
        for shift in range(len(points))
    ]
    best = int(np.argmin(distances))
    return best, distances[best]


def is_still(outputs: np.ndarray, scales: np.ndarray) -> bool:
    """Return whether outputs (points, coordinates) move by no more than a millionth of `scales` (coordinates,)."""
    return bool(np.all(np.ptp(outputs, axis=0) <= STILL * scales))


def times_repeated(equations: PeriodicEquations, z: np.ndarray) -> int:
    """Return how many times an orbit repeats itself within its forcing periods."""
    return int(equations.kernels.repetitions(z, equations.grid.periods))
