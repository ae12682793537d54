"""Closed chains of local maps: Newton's step for all points of an orbit together, shifts and mirrors of orbits."""

from collections.abc import Callable

import numpy as np

Wrap = Callable[[np.ndarray], np.ndarray]


def newton_step(defect: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """Return the corrections (m, p, 2) that close m chains of p linearised maps.

    Parameters
    ----------
    defect : array (m, p, 2)
        Image of each point minus the next point.
    jacobian : array (m, p, 2, 2)
    """
    m, p = defect.shape[:2]
    system = closing_matrix(jacobian) + 1e-14 * np.eye(2 * p)
    return -np.linalg.solve(system, defect.reshape(m, 2 * p, 1)).reshape(m, p, 2)


def closing_matrix(jacobian: np.ndarray) -> np.ndarray:
    """Return the matrices (m, 2p, 2p) of corrections to the points into changes of the defects."""
    m, p = jacobian.shape[:2]
    system = np.zeros((m, p, 2, p, 2))
    for j in range(p):
        system[:, j, :, j] += jacobian[:, j]
        system[:, j, :, (j + 1) % p] -= np.eye(2)
    return system.reshape(m, 2 * p, 2 * p)


def product(jacobian: np.ndarray) -> np.ndarray:
    """Return the matrix over the whole chain, (p, 2, 2) to (2, 2)."""
    result = np.eye(2)
    for matrix in jacobian:
        result = matrix @ result
    return result


def eigenvalues(jacobian: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of the product of the chain, larger modulus first.

    The smaller one comes from the determinants, which loses no digits.
    """
    whole = product(jacobian)
    trace, determinant = np.trace(whole), np.prod(np.linalg.det(jacobian))
    large = 0.5 * (trace + (1.0 if trace >= 0.0 else -1.0) * np.emath.sqrt(trace**2 - 4.0 * determinant))
    return np.array([large, determinant / large if large != 0.0 else 0.0])


def shift_between(one: np.ndarray, other: np.ndarray, wrap: Wrap) -> tuple[float, int]:
    """Return the distance of two cycles (p, 2) at the cyclic shift of the other that brings them closest, and it."""
    distances = [np.abs(wrap(np.roll(other, -shift, axis=0) - one)).max() for shift in range(len(one))]
    best = int(np.argmin(distances))
    return float(distances[best]), best


def has_shorter_period(points: np.ndarray, wrap: Wrap, tolerance: float) -> bool:
    """Return whether the points (p, 2) repeat after a divisor of p."""
    p = len(points)
    return any(p % d == 0 and np.abs(wrap(np.roll(points, -d, axis=0) - points)).max() < tolerance for d in range(1, p))
