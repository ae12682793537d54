"""Close returns of a section, and the cycles of the local maps that they lead to."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesperiodic.orbits.atlas import Atlas
from bayesperiodic.orbits.cycles import has_shorter_period, newton_step, shift_between
from bayesperiodic.orbits.local import LocalMaps

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
