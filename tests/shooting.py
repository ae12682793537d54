"""Further systems and paths for the shooting reference of `studies.shooting`, and orbits of the pendulum by it."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from studies.shooting import TURN, Field, Orbit, pendulum, shoot


def van_der_pol(mu: float) -> tuple[Field, Field]:
    """Return slope and Jacobian of x'' − μ (1 − x²) x' + x = 0 in time over T, with T as a third, constant state."""

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        x, v, period = y
        return np.array([period * v, period * (mu * (1.0 - x * x) * v - x), 0.0])

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        x, v, period = y
        force = mu * (1.0 - x * x) * v - x
        by_x, by_v = -period * (1.0 + 2.0 * mu * x * v), period * mu * (1.0 - x * x)
        return np.array([[0.0, period, v], [by_x, by_v, force], [0.0, 0.0, 0.0]])

    return slope, jacobian


def divided(
    slope: Field, jacobian: Field, times: np.ndarray, states: np.ndarray, parts: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and states with every segment cut into equal parts by integration."""
    fine, points = [], []
    for start, end, state in zip(times[:-1], times[1:], states, strict=True):
        cuts = np.linspace(start, end, parts + 1)
        done = solve_ivp(slope, (start, end), state, method="DOP853", rtol=1e-12, atol=1e-12, t_eval=cuts)
        fine.append(cuts[:-1])
        points.append(done.y[:, :-1].T)
    return np.append(np.concatenate(fine), times[-1]), np.concatenate(points)


def trajectory(slope: Field, times: np.ndarray, states: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the states at the increasing times `at`, each segment integrated from its own start.

    The steps are longer than with the variational equations: near φ' = 0 the error of the pendulum reaches 1e-10.
    """
    at, rows = np.asarray(at, dtype=float), []
    for k, state in enumerate(states):
        last = k == len(states) - 1
        inside = at[(at >= times[k]) & ((at <= times[k + 1]) if last else (at < times[k + 1]))]
        if inside.size:
            span = (times[k], times[k + 1])
            rows.append(solve_ivp(slope, span, state, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=inside).y.T)
    return np.concatenate(rows)


def pendulum_orbit(
    omega: float, section: ArrayLike, winding: int, parts: int = 4, tolerance: float = 3e-14, method: Any = "DOP853",
    **changes: float,
) -> Orbit:  # fmt: skip
    """Return the orbit near section points at t = 0, T, 2T, … (one per forcing period), `parts` segments per period."""
    slope, jacobian, period = pendulum(omega, **changes)
    section = np.atleast_2d(np.asarray(section, dtype=float))
    times, states = divided(slope, jacobian, period * np.arange(len(section) + 1), section, parts)
    return shoot(slope, jacobian, times, states, [TURN * winding, 0.0], tolerance=tolerance, method=method)


def pendulum_grid(omega: float, section: ArrayLike, tau: ArrayLike, **changes: float) -> np.ndarray:
    """Return (φ, φ') at the forcing periods `tau`, rising from 0, each period integrated from its own section point."""
    slope, _, period = pendulum(omega, **changes)
    section = np.asarray(section)
    return trajectory(slope, period * np.arange(len(section) + 1), section, period * np.asarray(tau))


def pendulum_doubling(
    low: float, high: float, section: ArrayLike, winding: int, parts: int = 2, **options: Any
) -> tuple[float, Orbit]:
    """Return ω between `low` and `high` at which a multiplier of the orbit is −1, and the orbit there."""
    points = np.atleast_2d(section)

    def flip(omega: float) -> float:
        return float(np.prod(1.0 + pendulum_orbit(omega, points, winding, parts, **options).multipliers).real)

    omega = float(brentq(flip, low, high, xtol=1e-13, rtol=1e-14))
    return omega, pendulum_orbit(omega, points, winding, parts, **options)


def van_der_pol_cycle(
    mu: float, parts: int = 24, tolerance: float = 3e-14, method: Any = "DOP853"
) -> tuple[float, float, float]:
    """Return period, x > 0 where x' = 0, and the nontrivial multiplier of van der Pol's limit cycle."""
    slope, jacobian = van_der_pol(mu)
    # The constant third state is 1 here, so that time is plain time; x' = 0 at every half turn.
    done = solve_ivp(
        slope, (0.0, 60.0), [2.0, 0.0, 1.0], method="DOP853", rtol=1e-10, atol=1e-10, events=lambda t, y: y[1]
    )
    assert done.t_events is not None and done.y_events is not None
    (turns,), (points,) = done.t_events, done.y_events
    start = np.array([[abs(points[-1, 0]), 0.0, turns[-1] - turns[-3]]])
    times, states = divided(slope, jacobian, np.array([0.0, 1.0]), start, parts)
    orbit = shoot(slope, jacobian, times, states, np.zeros(3), pin=1, tolerance=tolerance, method=method)
    return float(orbit.states[0, 2]), float(orbit.states[0, 0]), float(orbit.multipliers[1])
