"""Close returns of a section, and the cycles of the local maps that they lead to."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.orbits.cycles import has_shorter_period, newton_step, shift_between
from bayesperiodic.orbits.local import LocalMaps

# In units of the attractor's size: a return that is this close begins a search; stretches in one cell begin one search.
CLOSE = 0.05
CELL = 0.01
LONGEST_STEP = 0.03
STEPS = 14
CONVERGED = 2e-4
# Where the neighbourhood is wider, or the next points farther than so many bandwidths, the cycle has left the data.
WIDEST = 0.06
SAME = 3e-3


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


def candidates(maps: LocalMaps, section: np.ndarray, period: int, count: int, degree: int) -> list[Candidate]:
    """Return the prime cycles of a period that close returns lead to.

    Parameters
    ----------
    maps : LocalMaps
    section : array (n, 2)
        All points in the order of time, in units of the attractor's size.
    period : int
    count : int
        Neighbours of each local fit.
    degree : int
    """
    starts, returns, members = _close_returns(maps, section, period)
    chains = section[starts[:, None] + np.arange(period)]
    step = np.full(len(starts), np.inf)
    active = np.arange(len(starts))
    for _ in range(STEPS):
        if active.size == 0:
            break
        fit = maps.fit(chains[active].reshape(-1, 2), count, degree, influence=False)
        shape = (active.size, period)
        defect = maps.wrap(fit.value.reshape(*shape, 2) - np.roll(chains[active], -1, axis=1))
        correction = newton_step(defect, fit.jacobian.reshape(*shape, 2, 2))
        size = np.abs(correction).max((1, 2))
        chains[active] += correction * np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-300))[:, None, None]
        step[active] = size
        lost = (fit.bandwidth.reshape(shape).max(1) > np.maximum(WIDEST, 2.0 * maps.noise.max())) | ~np.isfinite(size)
        step[active[lost]] = np.inf
        active = active[(size > 0.01 * CONVERGED) & ~lost]
    tolerance = max(SAME, 3.0 * float(maps.noise.max()))
    return _distinct(maps, section, chains, step, starts, returns, members, tolerance)


def _close_returns(
    maps: LocalMaps, section: np.ndarray, period: int
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return where the closest return in each cell of stretches begins, how many there are, and all of them."""
    distance = np.abs(maps.wrap(section[period:] - section[:-period])).max(1)
    close = np.flatnonzero(distance < CLOSE + 2.0 * maps.noise.max())
    close = close[np.argsort(distance[close], kind="stable")]
    stretch = maps.inside(section[close[:, None] + np.arange(period)].reshape(-1, 2)).reshape(len(close), -1)
    cells = np.floor(stretch / max(CELL, float(maps.noise.max()))).astype(np.int64)
    _, first, owner, counts = np.unique(cells, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(owner.ravel(), kind="stable")
    return close[first], counts, np.split(close[order], np.cumsum(counts)[:-1])


def _distinct(
    maps: LocalMaps,
    section: np.ndarray,
    chains: np.ndarray,
    step: np.ndarray,
    starts: np.ndarray,
    returns: np.ndarray,
    members: list[np.ndarray],
    tolerance: float,
) -> list[Candidate]:
    period = chains.shape[1]
    found: list[np.ndarray] = []
    groups: list[list[tuple[int, int]]] = []
    for k in np.flatnonzero(step < max(CONVERGED, 0.1 * float(maps.noise.max()))):
        if has_shorter_period(chains[k], maps.wrap, tolerance):
            continue
        for cycle, group in zip(found, groups, strict=True):
            distance, shift = shift_between(chains[k], cycle, maps.wrap)
            if distance < tolerance:
                group.append((int(k), shift))
                break
        else:
            found.append(maps.wrap(chains[k]))
            groups.append([(int(k), 0)])
    result = []
    for cycle, group in zip(found, groups, strict=True):
        stretches = [(int(i), shift) for k, shift in group for i in members[k]]
        away = [
            np.abs(maps.wrap(section[i : i + period + 1] - np.take(cycle, np.arange(period + 1) + s, 0, mode="wrap")))
            for i, s in stretches
        ]
        closest, shift = stretches[int(np.argmin([a.max() for a in away]))]
        result.append(Candidate(cycle, int(sum(returns[k] for k, _ in group)), closest, shift))
    return result
