"""Cycles of local maps: search from close returns, refinement with error estimates, and the method of boxes.

All coordinates are in units of the attractor's size. A chain is the consecutive points of p returns, at every step of
the return map; Newton's method moves all of them together until the maps along the chain close it.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from bayesperiodic.orbits.return_map import KERNEL_REACH, Atlas, LocalFit, Regression, ReturnMap, for_coordinates

# Search: a return this close starts a chain; chains in one cell are searched once.
CLOSE, CELL = 0.08, 0.01
LONGEST_CORRECTION, CORRECTIONS = 0.03, 14
# With up to two coordinates and with more, where points are fewer: largest last step, largest bandwidth of a map.
CONVERGED_CORRECTION, WIDEST_BANDWIDTH = {2: 2e-4, 3: 1e-3}, {2: 0.06, 3: 0.1}
# Chains closer than this are merged.
MERGED = 2e-3
NEARLY, EXACT_STEPS = 0.02, 4
SAME_CYCLE = 3e-3

# Refinement: a wider neighbourhood is used while its fit agrees with all narrower ones within this many of their
# standard deviations; the number of widths tried and their ratio.
AGREEMENT, WIDTHS_TRIED, WIDENED = 2.5, 6, 2.0**0.5
REFINING_DEGREE = 3
# Smallest bandwidth in standard deviations of the noise.
SMALLEST_REFINING = 2.5
# Refinement ends below this step, or this fraction of the noise.
REFINING_STEPS, REFINED, REFINED_NOISE = 12, 1e-6, 1e-3
# The bias of slopes is proportional to the third power of the bandwidth. That of values is in theory to the fourth;
# measured, the error is two thirds of the difference between the points.
SLOPE_GROWTH, VALUE_GROWTH = WIDENED**3 - 1.0, 1.5

# Boxes: fewest recurrent points in a box; a fixed point farther away, in boxes, belongs to another one.
FEWEST_RETURNS, FARTHEST = 3, 3.0

Wrap = Callable[[np.ndarray], np.ndarray]
Images = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


class MapCycle(NamedTuple):
    """A cycle of the local maps, not yet refined."""

    points: np.ndarray  # (period·steps, d)
    returns: int  # number of close returns that led to it
    closest: int  # return at which the closest measured cycle starts
    shift: int  # the cycle's point that this first point belongs to


class Estimate(NamedTuple):
    """A refined cycle of the local maps."""

    points: np.ndarray  # (p, d) with p = period·steps
    eigenvalues: np.ndarray  # (d,)
    covariance: np.ndarray  # of the points and of log|eigenvalue|, (d·p + d, d·p + d)
    bias: np.ndarray  # estimated, (d·p + d,)
    turns: float  # of the angle, from the fits
    fits: "CycleFits | None" = None  # those at the points; None for "boxes"


class ClosingFits(NamedTuple):
    """A cycle, and the local fits at its points that close it."""

    points: np.ndarray  # (p, d)
    bandwidths: np.ndarray  # (p,)
    fit: LocalFit


class CycleFits(NamedTuple):
    """A refined cycle, and that of fits WIDENED times as wide."""

    narrow: ClosingFits
    wide: ClosingFits


class PairRuns(NamedTuple):
    """Pairs of points in some fits, and the run of each.

    Consecutive pairs share the noise of a point. Errors are summed over runs of consecutive pairs, and are independent
    between runs.
    """

    pairs: np.ndarray  # positions, (n,)
    run: np.ndarray  # (n,)

    @classmethod
    def of(cls, maps: ReturnMap, *fits: LocalFit | Regression) -> "PairRuns":
        """Return the runs in fits."""
        pairs = np.unique(np.concatenate([maps.positions[fit.neighbours].ravel() for fit in fits]))
        return cls(pairs, np.concatenate([[0], np.cumsum(np.diff(pairs) > 1)]))

    def by_pair(self, maps: ReturnMap, neighbours: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return values (n, …) of neighbours (n,) among the arguments of the map, by pair."""
        result = np.zeros((self.pairs.size, *values.shape[1:]))
        np.add.at(result, np.searchsorted(self.pairs, maps.positions[neighbours]), values)
        return result

    def sums(self, maps: ReturnMap, neighbours: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the sums (runs, …) of contributions (n, …) of neighbours (n,) to errors."""
        result = np.zeros((self.run[-1] + 1, *errors.shape[1:]))
        np.add.at(result, self.run[np.searchsorted(self.pairs, maps.positions[neighbours])], errors)
        return result


def newton_step(defect: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """Return corrections (m, p, d) that close chains of linearised maps; defects are images minus the next points."""
    m, p, d = defect.shape
    system = _closing_matrix(jacobian) + 1e-14 * np.eye(d * p)
    return -np.linalg.solve(system, defect.reshape(m, d * p, 1)).reshape(m, p, d)


def _closing_matrix(jacobian: np.ndarray) -> np.ndarray:
    """Return the derivatives (m, d·p, d·p) of the defects by the points."""
    m, p, d = jacobian.shape[:3]
    system = np.zeros((m, p, d, p, d))
    for j in range(p):
        system[:, j, :, j] += jacobian[:, j]
        system[:, j, :, (j + 1) % p] -= np.eye(d)
    return system.reshape(m, d * p, d * p)


def _monodromy(jacobian: np.ndarray) -> np.ndarray:
    """Return the product (d, d) of the derivatives (p, d, d) along a chain."""
    return reduce(lambda product, matrix: matrix @ product, jacobian)


def eigenvalues(jacobian: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of the monodromy matrix of a chain (p, d, d), largest modulus first.

    The product of the k largest is the largest eigenvalue of the product of the k-th compound matrices, of the minors
    of size k (F. R. Gantmacher, The Theory of Matrices 1, 1959). Ratios keep the relative accuracy of small ones.
    """
    d, before, values = jacobian.shape[-1], 1.0, []
    for size in range(1, d + 1):
        rows = np.array(list(combinations(range(d), size)))
        minors = np.linalg.det(jacobian[:, rows[:, None, :, None], rows[None, :, None, :]])
        product = np.linalg.eigvals(_monodromy(minors))
        largest = product[np.argmax(np.abs(product))]
        values.append(largest / before if before != 0.0 else 0.0)
        before = largest
    return np.real_if_close(np.array(values), tol=1e3)


def shift_between(one: np.ndarray, other: np.ndarray, wrap: Wrap) -> tuple[float, int]:
    """Return the smallest distance of two cycles (p, d) under cyclic shifts of the other, and that shift."""
    (distance,), (shift,) = shifts_between(one, [other], wrap)
    return float(distance), int(shift)


def shifts_between(one: np.ndarray, others: Sequence[np.ndarray], wrap: Wrap) -> tuple[np.ndarray, np.ndarray]:
    """Return the same of one cycle (p, d) and each of several others, (others,) each."""
    steps = np.arange(len(one))
    shifted = np.reshape(others, (len(others), *one.shape))[:, (steps[:, None] + steps) % len(one)]
    distances = np.abs(wrap(shifted - one)).max((2, 3))
    best = np.argmin(distances, axis=1)
    return distances[np.arange(len(best)), best], best


def has_shorter_period(points: np.ndarray, wrap: Wrap, tolerance: float) -> bool:
    """Return whether the points (p, d) repeat after a divisor of p."""
    p = len(points)
    divisors = [d for d in range(1, p) if p % d == 0]
    return any(np.abs(wrap(np.roll(points, -d, axis=0) - points)).max() < tolerance for d in divisors)


def candidates(maps: ReturnMap, atlas: Atlas, period: int) -> list[MapCycle]:
    """Return the cycles of a prime period to which close returns lead."""
    starts, members = _close_returns(maps, period)
    chains = maps.points[starts[:, None] + np.arange(period * maps.steps)]
    step = np.empty(0)
    # The maps of the atlas are discontinuous between centres, so the last steps fit about the points themselves.
    for images, steps, longest in ((atlas.at, CORRECTIONS, np.inf), (atlas.exactly, EXACT_STEPS, NEARLY)):
        step, heir = _converge(maps, images, chains, steps, longest)
        kept = np.array([k for k in np.unique(heir) if step[k] < NEARLY], dtype=int)
        members = [np.concatenate([members[i] for i in np.flatnonzero(heir == k)]) for k in kept]
        chains, step = chains[kept], step[kept]
    return _distinct(maps, chains, step, members)


def _converge(
    maps: ReturnMap, images: Images, chains: np.ndarray, steps: int, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Move chains (m, period, 2); return their last steps and the chains into which they were merged."""
    noise, heir = float(maps.noise.max()), np.arange(len(chains))
    converged = for_coordinates(CONVERGED_CORRECTION, len(maps.turn))
    step, active = np.full(len(chains), np.inf), heir
    for _ in range(steps):
        if active.size == 0:
            break
        moved = chains[active]
        phases = np.tile(maps.phases(np.arange(moved.shape[1])), len(moved))
        image, jacobian, bandwidth = images(moved.reshape(-1, moved.shape[2]), phases)
        slopes = jacobian.reshape(*moved.shape, moved.shape[2])
        chains[active], size = _moved(maps, moved, image.reshape(moved.shape), slopes)
        widest = bandwidth.reshape(moved.shape[:2]).max(1)
        lost = (widest > max(for_coordinates(WIDEST_BANDWIDTH, len(maps.turn)), 2.0 * noise)) | ~(size < longest)
        step[active] = np.where(lost, np.inf, size)
        active = active[(size > max(0.01 * converged, 0.05 * noise)) & ~lost]
        cells = _cells(maps, chains[active], max(MERGED, noise))
        _, first, owner = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        heir[active] = active[first][owner.ravel()]
        active = active[first]
    for _ in range(steps):
        heir = heir[heir]
    return step, heir


def _moved(
    maps: ReturnMap, chains: np.ndarray, images: np.ndarray, jacobian: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return chains (m, period, 2) after a Newton step of limited length, and the sizes (m,) of the whole steps."""
    correction = newton_step(maps.wrap(images - np.roll(chains, -1, axis=1)), jacobian)
    size = np.abs(correction).max((1, 2))
    return chains + correction * np.minimum(1.0, LONGEST_CORRECTION / np.maximum(size, 1e-300))[:, None, None], size


def _cells(maps: ReturnMap, chains: np.ndarray, size: float) -> np.ndarray:
    count, period, d = (chains := chains[:, :: maps.steps]).shape
    inside = maps.wrap_points(chains.reshape(-1, d)).reshape(count, period * d)
    return np.floor(inside / size).astype(np.int64)


def _close_returns(maps: ReturnMap, period: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the first point of the closest return in each cell of chains, and the first points of all in that cell."""
    section, noise, steps = maps.points, float(maps.noise.max()), period * maps.steps
    returning = maps.followed(steps)
    returning = returning[maps.phases(returning) == 0]
    distance = maps.distance(section[returning + steps], section[returning])
    near = np.flatnonzero(distance < CLOSE + 2.0 * noise)
    close = returning[near[np.argsort(distance[near], kind="stable")]]
    cells = _cells(maps, section[close[:, None] + np.arange(steps)], max(CELL, noise))
    _, first, owner, counts = np.unique(cells, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(owner.ravel(), kind="stable")
    return close[first], np.split(close[order], np.cumsum(counts)[:-1])


def _distinct(maps: ReturnMap, chains: np.ndarray, step: np.ndarray, members: list[np.ndarray]) -> list[MapCycle]:
    noise = float(maps.noise.max())
    tolerance = max(SAME_CYCLE, 3.0 * noise)
    # Each cycle with the first points and the shift of each of its close returns, (returns, 2).
    groups: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for k in np.argsort(step, kind="stable"):
        if step[k] > max(for_coordinates(CONVERGED_CORRECTION, len(maps.turn)), 0.1 * noise):
            break
        returns = chains[k, :: maps.steps]
        if has_shorter_period(returns, maps.wrap, tolerance):
            continue
        distances, shifts = shifts_between(returns, [cycle[:: maps.steps] for cycle, _ in groups], maps.wrap)
        near = np.flatnonzero(distances < tolerance)
        if not near.size:
            groups.append((maps.wrap(chains[k]), []))
        group, shift = (groups[near[0]][1], shifts[near[0]]) if near.size else (groups[-1][1], 0)
        group.append(np.stack([members[k], np.full(len(members[k]), shift)]))
    result = []
    for cycle, group in groups:
        steps = np.arange(len(cycle) + 1)
        starts, shifts = np.concatenate(group, axis=1)
        expected = cycle[(steps + maps.steps * shifts[:, None]) % len(cycle)]
        closest = int(np.argmin(np.abs(maps.wrap(maps.points[starts[:, None] + steps] - expected)).max((1, 2))))
        result.append(MapCycle(cycle, len(starts), int(starts[closest]) // maps.steps, int(shifts[closest])))
    return result


def refine(maps: ReturnMap, points: np.ndarray, neighbours: int) -> Estimate | None:
    """Return the cycle near the points of a candidate; None if there is none.

    Each point has its own neighbourhood: one step narrower than the widest whose slope along the unstable direction
    agrees with those of all narrower ones. Its bias is then well below the standard deviation, and is estimated from
    the difference to the wider neighbourhood.
    """
    bandwidths = _bandwidths(maps, points, neighbours)
    narrow = close(maps, points, bandwidths)
    wide = close(maps, points, WIDENED * bandwidths) if narrow is not None else None
    if narrow is None or wide is None:
        return None
    cycle, _, fit = narrow
    values, wide_values = eigenvalues(fit.jacobian), eigenvalues(wide.fit.jacobian)
    slope_bias = (np.log(np.abs(wide_values)) - np.log(np.abs(values))) / SLOPE_GROWTH
    point_bias = maps.wrap(wide.points - cycle).ravel() / VALUE_GROWTH
    turns = _turns(maps, np.sum(fit.value - cycle, axis=0))
    covariance = _joint_covariance(maps, fit)
    bias = np.append(point_bias, slope_bias)
    return Estimate(maps.wrap(cycle), values, covariance, bias, turns, CycleFits(narrow, wide))


def _turns(maps: ReturnMap, run: np.ndarray) -> float:
    return float(np.sum(run / maps.turn))


def close(maps: ReturnMap, points: np.ndarray, bandwidths: np.ndarray) -> ClosingFits | None:
    """Return the points at which the chained fits close, and the fits; None without convergence."""
    cycle, last, refined = points.copy(), np.inf, max(REFINED, REFINED_NOISE * float(maps.noise.max()))
    for step in range(REFINING_STEPS):
        final = last < refined or step == REFINING_STEPS - 1
        phases = maps.phases(np.arange(len(cycle)))
        fit = maps.fit_within(cycle, phases, bandwidths, REFINING_DEGREE, influence=final)
        (moved,), (size,) = _moved(maps, cycle[None], fit.value[None], fit.jacobian[None])
        if not np.isfinite(size) or np.abs(maps.wrap(cycle - points)).max() > 0.1:
            return None
        if final:
            # Neighbours change as the centre moves, which leaves steps far below the errors.
            return ClosingFits(cycle, bandwidths, fit) if size < 1e-3 else None
        cycle, last = moved, size
    return None


def _bandwidths(maps: ReturnMap, points: np.ndarray, neighbours: int) -> np.ndarray:
    """Return the bandwidth of each point's neighbourhood, (p,)."""
    phases = maps.phases(np.arange(len(points)))
    nearest = maps.nearest(points, phases, int(2.25 * neighbours))[0][:, -1] / KERNEL_REACH
    ladder = np.maximum(nearest, SMALLEST_REFINING * maps.noise.max()) * WIDENED ** np.arange(WIDTHS_TRIED)[:, None]
    fit = maps.fit_within(points, phases, ladder[0], REFINING_DEGREE)
    (right, *_), (left, *_) = _eigenvectors(fit.jacobian)
    d = points.shape[1]
    targets, sds = np.empty((2, WIDTHS_TRIED, len(points), 1 + d))
    active, accepted = np.arange(len(points)), np.zeros(len(points), dtype=int)
    for size, bandwidths in enumerate(ladder):
        if size > 0:
            counts = maps.count_within(points[active], phases[active], bandwidths[active])
            active = active[counts <= maps.count // 8]
            if not active.size:
                break
            fit = maps.fit_within(points[active], phases[active], bandwidths[active], REFINING_DEGREE)
        # The slope along the unstable direction, and the values of each fit.
        slope = np.einsum("pi,pij,pj->p", left[active], fit.jacobian, right[active]).real
        slopes = np.einsum("pi,pnji,pj->pn", left[active], fit.influence[:, :, 1 : 1 + d], right[active]).real
        targets[size, active] = np.column_stack([slope, fit.value])
        sds[size, active] = np.sqrt(np.column_stack([(slopes**2).sum(1), (fit.influence[:, :, 0] ** 2).sum(1)]))
        away = np.abs(targets[size, active] - targets[:size, active])
        active = active[~np.any(away > AGREEMENT * sds[:size, active], axis=(0, 2))]
        accepted[active] += 1
    return ladder[np.maximum(accepted - 2, 0), np.arange(len(points))]


def _eigenvectors(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return right eigenvectors (d, p, d) of the monodromy matrix at each point, largest modulus first, and left ones.

    The left ones are those at each image.
    """
    monodromy = np.stack([_monodromy(np.roll(jacobian, -j, axis=0)) for j in range(len(jacobian))])
    vectors = []
    for matrices in (monodromy, monodromy.transpose(0, 2, 1)):
        values, columns = np.linalg.eig(matrices)
        order = np.argsort(-np.abs(values), axis=1, kind="stable")
        vectors.append(np.take_along_axis(columns, order[:, None], axis=2).transpose(2, 0, 1))
    return vectors[0], np.roll(vectors[1], -1, axis=1)


def _joint_covariance(maps: ReturnMap, fit: LocalFit) -> np.ndarray:
    """Return the joint covariance of the points of a cycle and of log|eigenvalue|, by the delta method."""
    errors = errors_by_run(maps, fit, PairRuns.of(maps, fit))
    return errors.T @ errors


def errors_by_run(maps: ReturnMap, fit: LocalFit, runs: PairRuns) -> np.ndarray:
    """Return the errors (runs, d·p + d) of the points of a cycle and of log|eigenvalue|."""
    jacobian, d = fit.jacobian, fit.value.shape[1]
    by_value = -np.linalg.inv(_closing_matrix(jacobian[None])[0])
    right, left = _eigenvectors(jacobian)
    slope = np.einsum("kpi,pij,kpj->kp", left, jacobian, right)
    by_slope = (np.einsum("kpi,kpj->kpij", left, right) / slope[..., None, None]).real
    by_point = (np.einsum("kpi,pijl,kpj->kpl", left, fit.hessian, right) / slope[..., None]).real
    rows = []
    for j, influence in enumerate(fit.influence):
        points = influence[:, 0] @ by_value[:, d * j : d * (j + 1)].T
        slopes = np.einsum("kil,nli->nk", by_slope[:, j], influence[:, 1 : 1 + d])
        rows.append(np.concatenate([points, slopes + points @ by_point.reshape(d, -1).T], axis=1))
    return runs.sums(maps, fit.neighbours.ravel(), np.concatenate(rows))


def box_orbits(maps: ReturnMap, period: int, neighbours: int, box: float) -> list[tuple[MapCycle, Estimate]]:
    """Return the orbits of one period by the method "boxes" of `find_orbits`.

    A point that is in its own or an adjacent box again after `period` steps is recurrent; adjacent boxes with several
    recurrent points are a candidate. The nearest points and their images after `period` steps give a linear map, whose
    fixed point and eigenvalues are the orbit's.
    """
    count, phase = int(2.25 * neighbours), np.zeros(1)
    iterates = [_iterated(maps, k) for k in range(1, period + 1)]
    orbits: list[tuple[MapCycle, Estimate]] = []
    for centre, members in _recurrent_boxes(maps, period, box):
        fit = iterates[-1].fit(centre[None], phase, count, 1)
        step = newton_step(maps.wrap(fit.value - centre)[None], fit.jacobian[None])[0, 0]
        if not np.abs(step).max() < FARTHEST * box:
            continue
        fits = [iterate.fit((centre + step)[None], phase, count, 1) for iterate in iterates]
        points = maps.wrap(np.concatenate([(centre + step)[None], *(f.value for f in fits[:-1])]))
        if has_shorter_period(points, maps.wrap, 2.0 * box):
            continue
        # The covariance of all points follows from that of the first by the linear maps.
        d = centre.size
        transfer = np.zeros((d * (period + 1), 2 * d))
        transfer[: d * period, :d] = np.concatenate([np.eye(d), *(f.jacobian[0] for f in fits[:-1])])
        transfer[-d:, d:] = np.eye(d)
        estimate = Estimate(
            points,
            eigenvalues(fits[-1].jacobian),
            transfer @ _joint_covariance(iterates[-1], fits[-1]) @ transfer.T,
            np.zeros(d * (period + 1)),
            _turns(maps, fits[-1].value[0] - points[0]),
        )
        if any(shift_between(points, other.points, maps.wrap)[0] < 2.0 * box for _, other in orbits):
            continue
        away = maps.distance(maps.points[members], points[0])
        orbits.append((MapCycle(points, len(members), int(members[np.argmin(away)]), 0), estimate))
    return orbits


def _iterated(maps: ReturnMap, steps: int) -> ReturnMap:
    single = np.full((len(maps.points) - 1, maps.points.shape[1]), np.nan)
    single[maps.positions] = maps.increments
    several = np.lib.stride_tricks.sliding_window_view(single, steps, axis=0).sum(axis=-1)
    return ReturnMap(maps.points, several, maps.turn, maps.winds, np.zeros(len(maps.turn)), maps.stretches)


def _recurrent_boxes(maps: ReturnMap, period: int, box: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return centres and members of groups of adjacent boxes with recurrent points, those with most returns first."""
    section = maps.points
    cell = np.floor(maps.wrap_points(section) / box).astype(np.int64)
    cell -= cell.min(axis=0)
    cells_per_turn = np.ceil(maps.turn / box)
    returning = maps.followed(period)
    step = np.abs(cell[returning + period] - cell[returning]).astype(float)
    step = np.minimum(step, np.where(np.isfinite(cells_per_turn), cells_per_turn - step, step))
    back = returning[step.max(1) <= 1]
    counts = np.zeros(cell.max(axis=0) + 1, dtype=np.int64)
    np.add.at(counts, tuple(cell[back].T), 1)
    groups, number = label(counts >= FEWEST_RETURNS, structure=np.ones((3,) * counts.ndim))
    owner = groups[tuple(cell[back].T)]
    result = []
    for group in range(1, number + 1):
        members = back[owner == group]
        distance = maps.distance(section[members + period], section[members])
        result.append((section[members[np.argmin(distance)]], members))
    return sorted(result, key=lambda item: -len(item[1]))
