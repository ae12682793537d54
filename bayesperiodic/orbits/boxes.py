"""The paper's recipe: recurrent boxes, and one direct fit of the whole cycle's linearised map."""

import numpy as np
from scipy.ndimage import label

from bayesperiodic.orbits.chained import Estimate, joint_covariance
from bayesperiodic.orbits.cycles import eigenvalues, has_shorter_period, newton_step, shift_between
from bayesperiodic.orbits.local import LocalMaps
from bayesperiodic.orbits.search import Candidate

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
