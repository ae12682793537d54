"""The orbits of the pendulum study by multiple shooting, independent of the package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from studies import shooting
from studies.shooting import TURN

TOLERANCE, ACCURACY = 1e-12, 1e-9


class Shot(NamedTuple):
    """Orbit that shooting converges to from given points.

    Attributes
    ----------
    points : array (period, 2)
        φ in (−π, π] and φ̇ at tau = 0, 1, …
    winding : int
    multipliers : array (2,)
        Largest modulus first.
    prime : int
        Forcing periods after which the points repeat.
    converged : bool
    """

    points: np.ndarray
    winding: int
    multipliers: np.ndarray
    prime: int
    converged: bool


def shoot(parameters: Mapping[str, float], omega: float, points: np.ndarray) -> Shot:
    """Return the orbit that multiple shooting, one segment per forcing period, converges to from points.

    The turns of each segment are those of its first integration.
    """
    p, states = parameters, np.array(points, dtype=float)
    inertia = p["m"] * p["l"] ** 2
    changes = {"width": p["v0"], "g": p["g"], "lift": p["a"], "length": p["l"]}
    changes |= {f"c{i}": p[f"k{i}"] / inertia for i in (1, 2, 3)}
    slope, jacobian, period = shooting.pendulum(omega, **changes)
    times = period * np.arange(len(states) + 1)
    ends = [shooting.flow(slope, jacobian, 0.0, period, state, TOLERANCE)[0][0] for state in states]
    turns = np.round((np.array(ends) - np.roll(states[:, 0], -1)) / TURN)
    states[1:, 0] += TURN * np.cumsum(turns)[:-1]
    winding = int(turns.sum())
    try:
        orbit = shooting.shoot(
            slope, jacobian, times, states, [TURN * winding, 0.0], tolerance=TOLERANCE, accuracy=ACCURACY
        )
    except (RuntimeError, np.linalg.LinAlgError):
        return Shot(states, winding, np.full(2, np.nan), 0, False)
    wrapped = orbit.states.copy()
    wrapped[:, 0] = -((-wrapped[:, 0] + np.pi) % TURN - np.pi)
    return Shot(wrapped, winding, orbit.multipliers, _prime(wrapped), True)


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest difference of points (period, 2), angles modulo a turn, rates in units of 5 rad/s a rad."""
    off = np.asarray(one) - np.asarray(other)
    return float(max(np.abs((off[:, 0] + np.pi) % TURN - np.pi).max(), np.abs(off[:, 1]).max() / 5.0))


def _prime(points: np.ndarray) -> int:
    period = len(points)
    for shift in range(1, period):
        if period % shift == 0 and distance(points, np.roll(points, -shift, axis=0)) < 1e-6:
            return shift
    return period
