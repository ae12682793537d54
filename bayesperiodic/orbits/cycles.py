"""Closed chains of local maps: Newton's step for all points of an orbit together, shifts and mirrors of orbits."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from bayesperiodic.orbits.local import REACH, Atlas, LocalFit, LocalMaps

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


# In units of the attractor's size: a return that is this close begins a search; stretches in one cell begin one search.
CLOSE = 0.08
CELL = 0.01
LONGEST_STEP = 0.03
STEPS = 14
CONVERGED = 2e-4
# Where the neighbourhood is wider, or the next points farther than so many bandwidths, the cycle has left the data.
WIDEST = 0.06
MERGED = 2e-3
NEARLY, EXACT_STEPS = 0.02, 4
SAME = 3e-3

Images = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Candidate:
    """A cycle of the local maps.

    Attributes
    ----------
    points : array (period, 2)
        In units of the attractor's size.
    returns : int
        Close returns that led to it.
    closest : int
        Position of the point that begins the closest of these stretches.
    shift : int
        The cycle's point that this stretch begins at.
    """

    points: np.ndarray
    returns: int
    closest: int
    shift: int


def candidates(maps: LocalMaps, atlas: Atlas, section: np.ndarray, period: int) -> list[Candidate]:
    """Return the prime cycles of a period that close returns lead to.

    Parameters
    ----------
    maps : LocalMaps
    atlas : Atlas
    section : array (n, 2)
        All points in the order of time, in units of the attractor's size.
    period : int
    """
    starts, members = _close_returns(maps, section, period)
    chains = section[starts[:, None] + np.arange(period)]
    step, heir = _settle(maps, atlas, chains)
    kept = np.unique(heir)
    members = [np.concatenate([members[i] for i in np.flatnonzero(heir == k)]) for k in kept]
    near = step[kept] < NEARLY
    chains, step = chains[kept[near]], step[kept[near]]
    # The patches of the atlas do not quite meet, and Newton's method may stumble over that: a few steps without it.
    for _ in range(EXACT_STEPS):
        step = _newton(maps, chains, atlas.exactly)[0]
    return _distinct(maps, section, chains, step, [m for m, is_near in zip(members, near, strict=True) if is_near])


def _settle(maps: LocalMaps, atlas: Atlas, chains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move chains (m, period, 2) by Newton's method on the atlas; return their last steps, and whom each has joined."""
    noise = float(maps.noise.max())
    step, heir = np.full(len(chains), np.inf), np.arange(len(chains))
    active = heir
    for _ in range(STEPS):
        if active.size == 0:
            break
        moved = chains[active]
        size, bandwidth = _newton(maps, moved, atlas.at)
        chains[active] = moved
        lost = (bandwidth > max(WIDEST, 2.0 * noise)) | ~np.isfinite(size)
        step[active] = np.where(lost, np.inf, size)
        active = active[(size > max(0.01 * CONVERGED, 0.05 * noise)) & ~lost]
        # Chains that have come to one place share their future.
        cells = _cells(maps, chains[active], max(MERGED, noise))
        _, first, owner = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        heir[active] = active[first][owner.ravel()]
        active = active[first]
    for _ in range(STEPS):
        heir = heir[heir]
    return step, heir


def _newton(maps: LocalMaps, chains: np.ndarray, images: Images) -> tuple[np.ndarray, np.ndarray]:
    """Move chains (m, period, 2) by a step; return its sizes and the widest bandwidths, (m,) each."""
    if not len(chains):
        return np.empty(0), np.empty(0)
    shape = chains.shape[:2]
    image, jacobian, bandwidth = images(chains.reshape(-1, 2))
    defect = maps.wrap(image.reshape(*shape, 2) - np.roll(chains, -1, axis=1))
    correction = newton_step(defect, jacobian.reshape(*shape, 2, 2))
    size = np.abs(correction).max((1, 2))
    chains += correction * np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-300))[:, None, None]
    return size, bandwidth.reshape(shape).max(1)


def _cells(maps: LocalMaps, chains: np.ndarray, size: float) -> np.ndarray:
    inside = maps.inside(chains.reshape(-1, 2)).reshape(len(chains), 2 * chains.shape[1])
    return np.floor(inside / size).astype(np.int64)


def _close_returns(maps: LocalMaps, section: np.ndarray, period: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return where the closest return in each cell of stretches begins, and where all of that cell begin."""
    noise = float(maps.noise.max())
    distance = np.abs(maps.wrap(section[period:] - section[:-period])).max(1)
    close = np.flatnonzero(distance < CLOSE + 2.0 * noise)
    close = close[np.argsort(distance[close], kind="stable")]
    cells = _cells(maps, section[close[:, None] + np.arange(period)], max(CELL, noise))
    _, first, owner, counts = np.unique(cells, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(owner.ravel(), kind="stable")
    return close[first], np.split(close[order], np.cumsum(counts)[:-1])


def _distinct(
    maps: LocalMaps, section: np.ndarray, chains: np.ndarray, step: np.ndarray, members: list[np.ndarray]
) -> list[Candidate]:
    noise = float(maps.noise.max())
    tolerance = max(SAME, 3.0 * noise)
    found: list[np.ndarray] = []
    stretches: list[list[tuple[np.ndarray, int]]] = []
    for k in np.argsort(step, kind="stable"):
        if step[k] > max(CONVERGED, 0.1 * noise):
            break
        if has_shorter_period(chains[k], maps.wrap, tolerance):
            continue
        for cycle, group in zip(found, stretches, strict=True):
            distance, shift = shift_between(chains[k], cycle, maps.wrap)
            if distance < tolerance:
                group.append((members[k], shift))
                break
        else:
            found.append(maps.wrap(chains[k]))
            stretches.append([(members[k], 0)])
    return [_candidate(maps, section, cycle, group) for cycle, group in zip(found, stretches, strict=True)]


def _candidate(
    maps: LocalMaps, section: np.ndarray, cycle: np.ndarray, group: list[tuple[np.ndarray, int]]
) -> Candidate:
    steps = np.arange(len(cycle) + 1)
    starts = np.concatenate([begins for begins, _ in group])
    shifts = np.concatenate([np.full(len(begins), shift) for begins, shift in group])
    expected = cycle[(steps + shifts[:, None]) % len(cycle)]
    away = np.abs(maps.wrap(section[starts[:, None] + steps] - expected)).max((1, 2))
    closest = int(np.argmin(away))
    return Candidate(cycle, len(starts), int(starts[closest]), int(shifts[closest]))


DEGREE = 3
# A wider neighbourhood is taken as long as its fit agrees with those of the narrower ones within so many of their sds.
AGREEMENT = 2.5
SIZES = 6
# From a neighbourhood to the next.
WIDENED = 2.0**0.5
# Of the smallest neighbourhood's bandwidth, in standard deviations of the noise.
ROOM = 2.5
REFINING_STEPS = 12
REFINED = 1e-6
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
    for step in range(REFINING_STEPS):
        final = last < REFINED or step == REFINING_STEPS - 1
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


# A box needs at least so many points that come back.
FEWEST_RETURNS = 3
# In boxes: a fixed point farther away is another box's, if anyone's.
FARTHEST = 3.0


def box_orbits(
    maps: LocalMaps, section: np.ndarray, period: int, neighbours: int, box: float
) -> list[tuple[Candidate, Estimate]]:
    """Return the orbits of one period by the recipe of [1]_, section 5.

    The section is divided into boxes. A point that is in its own or a neighbouring box again after `period` steps is
    recurrent; touching boxes with several recurrent points are a candidate. The nearest points and their images after
    `period` steps give a linear map, whose fixed point and eigenvalues are the orbit's.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.
    """
    count = int(2.25 * neighbours)
    steps = [_iterated(maps, section, k) for k in range(1, period + 1)]
    found: list[tuple[Candidate, Estimate]] = []
    for centre, members in _recurrent_boxes(maps, section, period, box):
        fit = steps[-1].fit(centre[None], count, 1)
        defect = maps.wrap(fit.value - centre)
        step = newton_step(defect[None], fit.jacobian[None])[0, 0]
        if not np.abs(step).max() < FARTHEST * box:
            continue
        fits = [maps_k.fit((centre + step)[None], count, 1) for maps_k in steps]
        points = maps.wrap(np.concatenate([(centre + step)[None], *(f.value for f in fits[:-1])]))
        if has_shorter_period(points, maps.wrap, 2.0 * box):
            continue
        estimate = Estimate(
            points,
            eigenvalues(fits[-1].jacobian),
            _spread([np.eye(2), *(f.jacobian[0] for f in fits[:-1])], joint_covariance(fits[-1:], points[:1])),
            np.zeros(2 * period + 2),
            _turns(maps, fits[-1].value[0] - points[0]),
        )
        if any(shift_between(points, other.points, maps.wrap)[0] < 2.0 * box for _, other in found):
            continue
        away = np.abs(maps.wrap(section[members] - points[0])).max(1)
        found.append((Candidate(points, len(members), int(members[np.argmin(away)]), 0), estimate))
    return found


def _iterated(maps: LocalMaps, section: np.ndarray, steps: int) -> LocalMaps:
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(maps.increments, axis=0)])
    increments = sums[steps:] - sums[:-steps]
    return LocalMaps(section[:-steps], increments, maps.turn, maps.winds, np.zeros(2))


def _recurrent_boxes(
    maps: LocalMaps, section: np.ndarray, period: int, box: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return middles and members of touching boxes with recurrent points, those with most returns first."""
    cell = np.floor(maps.inside(section) / box).astype(np.int64)
    cell -= cell.min(axis=0)
    cells_per_turn = np.ceil(maps.turn / box)
    step = np.abs(cell[period:] - cell[:-period]).astype(float)
    step = np.minimum(step, np.where(np.isfinite(cells_per_turn), cells_per_turn - step, step))
    back = np.flatnonzero(step.max(1) <= 1)
    counts = np.zeros(cell.max(axis=0) + 1, dtype=np.int64)
    np.add.at(counts, tuple(cell[back].T), 1)
    groups, number = label(counts >= FEWEST_RETURNS, structure=np.ones((3, 3)))
    owner = groups[tuple(cell[back].T)]
    result = []
    for group in range(1, number + 1):
        members = back[owner == group]
        distance = np.abs(maps.wrap(section[members + period] - section[members])).max(1)
        result.append((section[members[np.argmin(distance)]], members))
    return sorted(result, key=lambda item: -len(item[1]))


def _spread(along: list[np.ndarray], covariance: np.ndarray) -> np.ndarray:
    """Return the joint covariance of all points from that of the first, carried along by the linear maps."""
    carry = np.zeros((2 * len(along) + 2, 4))
    carry[: 2 * len(along), :2] = np.concatenate(along)
    carry[-2:, 2:] = np.eye(2)
    return carry @ covariance @ carry.T


def _turns(maps: LocalMaps, run: np.ndarray) -> float:
    angle = np.isfinite(maps.turn)
    return float(np.sum(run[angle] / maps.turn[angle]))
