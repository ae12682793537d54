"""The default way from a candidate to an orbit with error bars: one-step local fits, chained."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.orbits.cycles import closing_matrix, eigenvalues, newton_step, product
from bayesperiodic.orbits.local import REACH, LocalFit, LocalMaps

DEGREE = 3
# A wider neighbourhood is taken as long as its fit agrees with those of the narrower ones within so many of their sds.
AGREEMENT = 2.5
SIZES = 6
# From a neighbourhood to the next.
WIDENED = 2.0**0.5
# Of the smallest neighbourhood's bandwidth, in standard deviations of the noise.
ROOM = 2.5
STEPS = 12
CONVERGED = 1e-6
# Bias in slopes grows with the third power of the bandwidth. In values theory has the fourth; measured is less: two
# thirds of the difference of the points come back as error.
SLOPE_GROWTH, VALUE_GROWTH = WIDENED**3 - 1.0, 1.5


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

    Each point has its own neighbourhood. It is narrower by a step than the widest whose slope along the orbit's
    unstable direction agrees with those of all narrower ones, so that what bias there is falls well below the standard
    deviation; what is left is estimated from the difference to the wider one.
    """
    bandwidths = _bandwidths(maps, points, neighbours)
    narrow = _close(maps, points, maps.within(points, bandwidths))
    wide = _close(maps, points, maps.within(points, WIDENED * bandwidths))
    if narrow is None or wide is None:
        return None
    cycle, fits = narrow
    jacobian = np.concatenate([fit.jacobian for fit in fits])
    values = eigenvalues(jacobian)
    wide_values = eigenvalues(np.concatenate([fit.jacobian for fit in wide[1]]))
    slope_bias = (np.log(np.abs(wide_values)) - np.log(np.abs(values))) / SLOPE_GROWTH
    point_bias = maps.wrap(wide[0] - cycle).ravel() / VALUE_GROWTH
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


def _bandwidths(maps: LocalMaps, points: np.ndarray, neighbours: int) -> np.ndarray:
    """Return the bandwidth of each point's neighbourhood, (period,)."""
    nearest = maps.nearest(points, int(2.25 * neighbours))[0][:, -1] / REACH
    smallest = np.maximum(nearest, ROOM * maps.noise.max())
    ladder = smallest[:, None] * WIDENED ** np.arange(SIZES)
    counts = [maps.within(points, bandwidths) for bandwidths in ladder.T]
    most = len(maps.arguments) // 8
    start = np.concatenate([maps.fit(p[None], n, DEGREE).jacobian for p, n in zip(points, counts[0], strict=True)])
    right, left = directions(start, 0)
    left = np.roll(left, -1, axis=0)
    chosen = []
    for j, point in enumerate(points):
        targets: list[np.ndarray] = []
        sds: list[np.ndarray] = []
        for count in (int(n[j]) for n in counts if n[j] <= most):
            target, sd = _along(maps.fit(point[None], count, DEGREE), left[j : j + 1], right[j : j + 1])
            if any(np.any(np.abs(target - t) > AGREEMENT * s) for t, s in zip(targets, sds, strict=True)):
                break
            targets.append(target)
            sds.append(sd)
        chosen.append(ladder[j, max(len(targets) - 2, 0)])
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
