"""The return map as local polynomials about fixed centres: dear to make once, cheap to evaluate anywhere after."""

import numpy as np
from scipy.spatial import cKDTree

from bayesperiodic.orbits.local import LocalMaps

DEGREE = 2
# Neighbours of all fits together.
MOST_NEIGHBOURS = 6_000_000


class Atlas:
    """Quadratic polynomials of the return map about points of the section, each good as far as its neighbours lie.

    Parameters
    ----------
    maps : LocalMaps
    count : int
        Neighbours of each fit.
    """

    def __init__(self, maps: LocalMaps, count: int):
        self._maps, self._count = maps, count
        every = -(-len(maps.arguments) * count // MOST_NEIGHBOURS)
        self._centres = maps.arguments[::every]
        fit = maps.fit(self._centres, count, DEGREE, influence=False)
        self._value, self._jacobian, self._hessian = fit.value, fit.jacobian, fit.hessian
        self._bandwidth = fit.bandwidth
        box = np.where(np.isfinite(maps.turn), maps.turn, 0.0)
        self._tree = cKDTree(maps.inside(self._centres), boxsize=box)

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return images (m, 2), derivatives (m, image, argument) and the bandwidth of the polynomials at points (m, 2).

        The bandwidth is infinite where a point lies farther from the nearest centre than that.
        """
        _, nearest = self._tree.query(self._maps.inside(points))
        away = self._maps.wrap(points - self._centres[nearest])
        curved = np.einsum("mijk,mk->mij", self._hessian[nearest], away)
        jacobian = self._jacobian[nearest]
        image = self._value[nearest] + np.einsum("mij,mj->mi", jacobian + 0.5 * curved, away)
        bandwidth = self._bandwidth[nearest]
        outside = np.sqrt(np.sum(away**2, axis=-1)) > bandwidth
        return image, jacobian + curved, np.where(outside, np.inf, bandwidth)

    def exactly(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same from fits about the points themselves."""
        fit = self._maps.fit(points, self._count, DEGREE, influence=False)
        return fit.value, fit.jacobian, fit.bandwidth
