"""How noisy the points of a section are, from the points alone."""

import numpy as np
from scipy.optimize import nnls

from bayesperiodic.orbits.local import REACH, LocalMaps

CENTRES = 600
ROUNDS = 8
# A linear return map must extend over so many standard deviations of the noise.
ROOM = 4.0


def noise_of(maps: LocalMaps, neighbours: int) -> np.ndarray:
    """Return the standard deviations (2,) of independent errors of the two coordinates, in the units of the maps.

    In a neighbourhood where the return map is a quadratic polynomial, what is left of an image has the variance of its
    own error and of the argument's, stretched by the map. The densest neighbourhoods are used, where curvature adds
    least; they are widened until the noise is small in them.
    """
    centres = maps.arguments[:: max(1, len(maps.arguments) // CENTRES)]
    noise, count = np.zeros(2), int(2.25 * neighbours)
    for _ in range(3):
        width = maps.nearest(centres, count)[0][:, -1]
        dense = centres[width <= np.median(width)]
        noise = _fitted(maps, dense, count)
        if np.median(width) / REACH > ROOM * noise.max() or count * 2 > len(maps.arguments) // 8:
            break
        count *= 2
    return noise


def _fitted(maps: LocalMaps, centres: np.ndarray, count: int) -> np.ndarray:
    fit = maps.fit(centres, count, 2, influence=False)
    left = maps.rest(centres, fit)
    rows = (np.eye(2) + fit.jacobian**2).reshape(-1, 2)
    target = left.reshape(-1)
    weight = 1.0 / np.maximum(target, 1e-30)
    solution = np.zeros(2)
    for _ in range(ROUNDS):
        solution, _ = nnls(rows * weight[:, None], target * weight)
        predicted = rows @ solution
        # Far larger than expected is curvature, not noise.
        weight = np.where(target < 4.0 * predicted, 1.0, 0.0) / np.maximum(predicted, 1e-30)
    return np.sqrt(solution)
