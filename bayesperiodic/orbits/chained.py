"""The default way from a candidate to an orbit with error bars: one-step local fits, chained."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.orbits.cycles import closing_matrix, eigenvalues, newton_step, product
from bayesperiodic.orbits.local import LocalFit, LocalMaps

DEGREE = 3
# A wider neighbourhood is taken as long as its fit agrees with those of the narrower ones within so many of their sds.
AGREEMENT = 2.5
SIZES = 6
# Of the smallest neighbourhood's bandwidth, in standard deviations of the noise.
ROOM = 2.5
STEPS = 12
CONVERGED = 1e-6
# Bias grows with the third power of the bandwidth in slopes, so that twice the neighbours differ by this much of it.
SLOPE_GROWTH = 2.0**1.5 - 1.0
# Measured: of the difference of the points two thirds come back as error, not the third that theory has.
POINT_GROWTH = 1.5


@dataclass(frozen=True)
class Estimate:
    """An orbit of the local maps, in units of the attractor's size.

    Attributes
    ----------
    points : array (period, 2)
    eigenvalues : array (2,)
    covariance : array (2·period + 2, 2·period + 2)
        Of the points and of log|eigenvalue|.
    bias : array (2·period + 2,)
        Estimated.
    turns : float
        Turns of the angle, from the fits.
    """

    points: np.ndarray
    eigenvalues: np.ndarray
    covariance: np.ndarray
    bias: np.ndarray
    turns: float


def refine(maps: LocalMaps, points: np.ndarray, neighbours: int) -> Estimate | None:
    """Return the orbit near the points of a candidate; None where there is none.

    Each point has its own neighbourhood. It is half as large (in neighbours) as the largest whose slope along the
    orbit's unstable direction agrees with those of all smaller ones, so that what bias there is falls well below the
    standard deviation; what is left is estimated from the difference to the larger one.
    """
    counts = _counts(maps, points, neighbours)
    narrow = _close(maps, points, counts)
    wide = _close(maps, points, 2 * counts)
    if narrow is None or wide is None:
        return None
    cycle, fits = narrow
    jacobian = np.concatenate([fit.jacobian for fit in fits])
    values = eigenvalues(jacobian)
    wide_values = eigenvalues(np.concatenate([fit.jacobian for fit in wide[1]]))
    slope_bias = (np.log(np.abs(wide_values)) - np.log(np.abs(values))) / SLOPE_GROWTH
    point_bias = maps.wrap(wide[0] - cycle).ravel() / POINT_GROWTH
    turn = maps.turn[np.isfinite(maps.turn)]
    run = np.sum([fit.value[0] - point for fit, point in zip(fits, cycle, strict=True)], axis=0)
    return Estimate(
        maps.wrap(cycle),
        values,
        joint_covariance(fits, cycle),
        np.concatenate([point_bias, slope_bias]),
        float(np.sum(run[np.isfinite(maps.turn)]) / turn[0]) if turn.size else 0.0,
    )


def _close(maps: LocalMaps, points: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, list[LocalFit]] | None:
    """Return the points that the chained fits close on, and the fits; None without convergence."""
    cycle, last = points.copy(), np.inf
    for step in range(STEPS):
        final = last < CONVERGED or step == STEPS - 1
        fits = [maps.fit(point[None], int(n), DEGREE, influence=final) for point, n in zip(cycle, counts, strict=True)]
        defect = maps.wrap(np.concatenate([fit.value for fit in fits]) - np.roll(cycle, -1, axis=0))
        correction = newton_step(defect[None], np.concatenate([fit.jacobian for fit in fits])[None])[0]
        size = float(np.abs(correction).max())
        if not np.isfinite(size) or np.abs(maps.wrap(cycle - points)).max() > 0.1:
            return None
        if final:
            # Neighbours come and go as the centre moves, which leaves steps far below the errors.
            return (cycle, fits) if size < 1e-3 else None
        cycle, last = cycle + correction * min(1.0, 0.03 / max(size, 1e-300)), size
    return None


def _counts(maps: LocalMaps, points: np.ndarray, neighbours: int) -> np.ndarray:
    """Return the size of each point's neighbourhood."""
    most = len(maps.arguments) // 8
    sizes = [n for n in (int(2.25 * neighbours) * 2**k for k in range(SIZES)) if n <= most] or [most]
    fits = [maps.fit(points, n, DEGREE) for n in sizes]
    roomy = np.array([fit.bandwidth >= ROOM * maps.noise.max() for fit in fits])
    roomy[-1] = True
    smallest = np.argmax(roomy, axis=0)
    start = np.array([fits[k].jacobian[j] for j, k in enumerate(smallest)])
    right, left = directions(start, 0)
    left = np.roll(left, -1, axis=0)
    targets, sds = zip(*(_along(fit, left, right) for fit in fits), strict=True)
    targets, sds = np.array(targets), np.array(sds)
    chosen = []
    for j, first in enumerate(smallest):
        best = first
        for k in range(first + 1, len(sizes)):
            if np.any(np.abs(targets[k, j] - targets[first:k, j]) > AGREEMENT * sds[first:k, j]):
                break
            best = k
        chosen.append(sizes[max(best - 1, first)])
    return np.array(chosen)


def _along(fit: LocalFit, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope along the orbit's direction and the two values of each fit, and their standard deviations."""
    slope = np.einsum("pi,pij,pj->p", left, fit.jacobian, right).real
    slopes = np.einsum("pi,pnji,pj->pn", left, fit.influence[:, :, 1:3], right).real
    sd = np.sqrt(np.concatenate([(slopes**2).sum(1)[:, None], (fit.influence[:, :, 0] ** 2).sum(1)], axis=1))
    return np.concatenate([slope[:, None], fit.value], axis=1), sd


def directions(jacobian: np.ndarray, which: int) -> tuple[np.ndarray, np.ndarray]:
    """Return right and left eigenvectors (p, 2) of the chain begun at each of its points, largest eigenvalue first."""
    right: list[np.ndarray] = []
    left: list[np.ndarray] = []
    for j in range(len(jacobian)):
        whole = product(np.roll(jacobian, -j, axis=0))
        for matrix, vectors in ((whole, right), (whole.T, left)):
            values, columns = np.linalg.eig(matrix)
            vectors.append(columns[:, np.argsort(-np.abs(values), kind="stable")[which]])
    return np.array(right), np.array(left)


def joint_covariance(fits: list[LocalFit], cycle: np.ndarray) -> np.ndarray:
    """Return the joint covariance of the points and of log|eigenvalue|, by the delta method.

    A pair of points errs by its own noise and shares it with the pairs before and after it; so errors add up over the
    runs of consecutive pairs, and are independent from run to run.
    """
    p = len(cycle)
    jacobian = np.concatenate([fit.jacobian for fit in fits])
    by_value = -np.linalg.inv(closing_matrix(jacobian[None])[0])
    by_slope = np.zeros((2, p, 2, 2))
    by_point = np.zeros((2, p, 2))
    for k in range(2):
        right, left = directions(jacobian, k)
        left = np.roll(left, -1, axis=0)
        stretch = np.einsum("pi,pij,pj->p", left, jacobian, right)
        by_slope[k] = (np.einsum("pi,pj->pij", left, right) / stretch[:, None, None]).real
        hessian = np.concatenate([fit.hessian for fit in fits])
        by_point[k] = (np.einsum("pi,pijl,pj->pl", left, hessian, right) / stretch[:, None]).real
    rows, index = [], []
    for j, fit in enumerate(fits):
        points = fit.influence[0, :, 0] @ by_value[:, 2 * j : 2 * j + 2].T
        slopes = np.einsum("kil,nli->nk", by_slope[:, j], fit.influence[0, :, 1:3])
        rows.append(np.concatenate([points, slopes + points @ by_point.reshape(2, -1).T], axis=1))
        index.append(fit.index[0])
    pairs, owner = np.unique(np.concatenate(index), return_inverse=True)
    runs = np.concatenate([[0], np.cumsum(np.diff(pairs) > 1)])
    errors = np.zeros((runs[-1] + 1, 2 * p + 2))
    np.add.at(errors, runs[owner], np.concatenate(rows))
    return errors.T @ errors
