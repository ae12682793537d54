"""The driven pendulum by SciPy's integrator and shooting, as a reference that shares nothing with the package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

TURN = 2 * np.pi
ITERATIONS = 12
TOLERANCE = 1e-12
# Newton's last step: the error after it is of the order of its square.
SMALL, LOST = 1e-6, 1e3


class Shot(NamedTuple):
    """Where shooting from an orbit's points converges to.

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
    """Return where multiple shooting, one segment a forcing period and full Newton steps, goes from points.

    The turns of each segment are those that its first integration needs.
    """
    states, size = np.array(points, dtype=float), np.inf
    ends, transfers = _advance(parameters, omega, states)
    turns = np.round((ends[:, 0] - np.roll(states[:, 0], -1)) / TURN)
    for _ in range(ITERATIONS):
        step = _newton_step(states, ends, transfers, turns)
        size = float(np.abs(step).max())
        if not size < LOST:
            break
        states += step
        if size < SMALL:
            break
        ends, transfers = _advance(parameters, omega, states)
    product = np.eye(2)
    for transfer in transfers:
        product = transfer @ product
    multipliers = np.linalg.eigvals(product)
    multipliers = multipliers[np.argsort(-np.abs(multipliers))]
    wrapped = states.copy()
    wrapped[:, 0] = -((-wrapped[:, 0] + np.pi) % TURN - np.pi)
    return Shot(wrapped, int(turns.sum()), multipliers, _prime(wrapped), size < SMALL)


def _newton_step(states: np.ndarray, ends: np.ndarray, transfers: np.ndarray, turns: np.ndarray) -> np.ndarray:
    period = len(states)
    gap = np.roll(states, -1, axis=0) - ends
    gap[:, 0] += TURN * turns
    matrix = np.zeros((2 * period, 2 * period))
    for k in range(period):
        rows, after = slice(2 * k, 2 * k + 2), 2 * ((k + 1) % period)
        matrix[rows, rows] += transfers[k]
        matrix[rows, after : after + 2] -= np.eye(2)
    return np.linalg.solve(matrix, gap.ravel()).reshape(-1, 2)


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


def _advance(parameters: Mapping[str, float], omega: float, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the states one forcing period on, and the derivatives of that by the states, (period, 2, 2)."""
    p, ends, transfers = parameters, [], []
    inertia = p["m"] * p["l"] ** 2
    c1, c2, c3 = p["k1"] / inertia, p["k2"] / inertia, p["k3"] / inertia

    def slope(t: float, y: np.ndarray) -> list[float]:
        pull = (p["g"] + p["a"] * omega**2 * np.cos(omega * t)) / p["l"]
        rate, sine, cosine, slip = y[1], np.sin(y[0]), np.cos(y[0]), np.tanh(y[1] / p["v0"])
        damping = c1 / p["v0"] * (1.0 - slip * slip) + c2 + 2.0 * c3 * abs(rate)
        acceleration = -c1 * slip - (c2 + c3 * abs(rate)) * rate - pull * sine
        by = -pull * cosine
        return [rate, acceleration, y[3], by * y[2] - damping * y[3], y[5], by * y[4] - damping * y[5]]

    for state in states:
        start = [*state, 1.0, 0.0, 0.0, 1.0]
        path = solve_ivp(slope, (0.0, TURN / omega), start, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE)
        end = path.y[:, -1]
        ends.append(end[:2])
        transfers.append([[end[2], end[4]], [end[3], end[5]]])
    return np.array(ends), np.array(transfers)
