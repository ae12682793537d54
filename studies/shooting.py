"""Periodic orbits by multiple shooting, independent of the package.

Everything rests on `scipy.integrate` (DOP853, for many orbits of the pendulum LSODA) with the variational equations
integrated along. The reference orbits are read from ``reference_orbits.json``; `python -m tests.reference_orbits`
computes all of them again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import odeint, solve_ivp

TURN = 2.0 * np.pi

Field = Callable[[float, np.ndarray], np.ndarray]
# From start, end and state to the state at the end of a segment and its derivative by the state at the start.
Flow = Callable[[float, float, np.ndarray], tuple[np.ndarray, np.ndarray]]
MOST_STEPS = 100_000

# φ'' + c1 tanh(φ'/width) + c2 φ' + c3 φ'|φ'| + (g + lift ω² cos ωt)/length · sin φ = 0, SI units.
PENDULUM = {"c1": 0.02, "c2": 0.05, "c3": 0.05, "width": 0.05, "g": 9.81, "lift": 0.11, "length": 0.30}


class Known(NamedTuple):
    """A tabulated periodic orbit of the pendulum.

    `section` holds (φ, φ') at t = 0, T, 2T, …, one row per forcing period T = 2π/ω. φ is not wrapped: the period after
    the last row ends at the first row with φ larger by 2π·winding. Each period can be integrated from its own row, so
    that errors grow little. The multiplier of larger modulus comes first. φ → −φ with winding → −winding is another
    orbit with the same multipliers.
    """

    omega: float
    winding: int
    section: tuple[tuple[float, float], ...]
    multipliers: tuple[complex, ...]


class Orbit(NamedTuple):
    """A periodic orbit as a chain of segments."""

    times: np.ndarray  # Starts of the segments and the end of the last one
    states: np.ndarray  # At the start of every segment
    transfer: np.ndarray  # Derivative of each segment's end by its start
    multipliers: np.ndarray  # Floquet multipliers, largest modulus first
    correction: float  # Largest component of the last Newton step


def pendulum(omega: float, **changes: float) -> tuple[Field, Field, float]:
    """Return slope, Jacobian and forcing period of the driven pendulum; `changes` replace values of PENDULUM."""
    p = PENDULUM | changes
    c1, c2, c3, width = p["c1"], p["c2"], p["c3"], p["width"]

    constant, swing = p["g"] / p["length"], p["lift"] * omega**2 / p["length"]

    # Python's numbers and functions are several times faster here than NumPy's.
    def slope(t: float, y: np.ndarray) -> np.ndarray:
        angle, rate = map(float, y)
        friction = c1 * math.tanh(rate / width) + (c2 + c3 * abs(rate)) * rate
        return np.array([rate, -friction - (constant + swing * math.cos(omega * t)) * math.sin(angle)])

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        angle, rate = map(float, y)
        friction = c1 / width * (1.0 - math.tanh(rate / width) ** 2) + c2 + 2.0 * c3 * abs(rate)
        return np.array([[0.0, 1.0], [-(constant + swing * math.cos(omega * t)) * math.cos(angle), -friction]])

    return slope, jacobian, TURN / omega


def pendulum_flow(omega: float, tolerance: float, **changes: float) -> Flow:
    """Return the flow of the driven pendulum, by LSODA and with floats in place of arrays: eight times faster."""
    p = PENDULUM | changes
    c1, c2, c3, width = p["c1"], p["c2"], p["c3"], p["width"]
    constant, swing = p["g"] / p["length"], p["lift"] * omega**2 / p["length"]

    def extended(t: float, z: np.ndarray) -> list[float]:
        angle, rate, a, b, c, d = z.tolist()
        bend, pull, speed = math.tanh(rate / width), constant + swing * math.cos(omega * t), abs(rate)
        stiffness, damping = pull * math.cos(angle), c1 / width * (1.0 - bend**2) + c2 + 2.0 * c3 * speed
        acceleration = -c1 * bend - (c2 + c3 * speed) * rate - pull * math.sin(angle)
        return [rate, acceleration, c, d, -stiffness * a - damping * c, -stiffness * b - damping * d]

    def advance(start: float, end: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first = np.concatenate([state, np.eye(2).ravel()])
        values, report = odeint(
            extended, first, [start, end], tfirst=True, full_output=True, mxstep=MOST_STEPS, rtol=tolerance,
            atol=tolerance,
        )  # fmt: skip
        if report["message"] != "Integration successful.":
            raise RuntimeError(report["message"])
        return values[-1, :2], values[-1, 2:].reshape(2, 2)

    return advance


def flow(
    slope: Field, jacobian: Field, start: float, end: float, state: np.ndarray, tolerance: float = 3e-14,
    method: Any = "DOP853",
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the state at the end of one segment and its derivative by the state at the start."""
    count = len(state)

    def extended(t: float, z: np.ndarray) -> np.ndarray:
        here, result = z[:count], np.empty(z.size)
        result[:count] = slope(t, here)
        np.matmul(jacobian(t, here), z[count:].reshape(count, count), out=result[count:].reshape(count, count))
        return result

    first = np.concatenate([state, np.eye(count).ravel()])
    done = solve_ivp(extended, (start, end), first, method=method, rtol=tolerance, atol=tolerance)
    if not done.success:
        raise RuntimeError(done.message)
    return done.y[:count, -1], done.y[count:, -1].reshape(count, count)


def multipliers(transfer: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of the product of the segments' matrices, largest modulus first.

    With two states the smaller one comes from the product of the determinants, which loses no digits.
    """
    product = np.eye(transfer.shape[1])
    for matrix in transfer:
        product = matrix @ product
    if len(product) != 2:
        values = np.linalg.eigvals(product)
        return values[np.argsort(-np.abs(values))]
    determinant, trace = np.prod(np.linalg.det(transfer)), np.trace(product)
    large = (trace + (1.0 if trace >= 0.0 else -1.0) * np.emath.sqrt(trace**2 - 4.0 * determinant)) / 2.0
    return np.array([large, determinant / large])


def shoot(
    slope: Field, jacobian: Field, times: ArrayLike, states: ArrayLike, jump: ArrayLike, pin: int | None = None,
    tolerance: float = 3e-14, method: Any = "DOP853", accuracy: float = 1e-12,
) -> Orbit:  # fmt: skip
    """Return the periodic orbit near the given states, see `closed`, integrated by `scipy.integrate.solve_ivp`.

    `slope`, `jacobian`: y' and its derivative by y, as functions of (t, y). `tolerance`, `method`: Of `solve_ivp`.
    """

    def advance(start: float, end: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return flow(slope, jacobian, start, end, state, tolerance, method)

    return closed(advance, times, states, jump, pin, accuracy)


def closed(
    advance: Flow, times: ArrayLike, states: ArrayLike, jump: ArrayLike, pin: int | None = None,
    accuracy: float = 1e-12,
) -> Orbit:  # fmt: skip
    """Return the periodic orbit near the given states by one damped Newton iteration over all segments.

    `times`: Starts of the segments and the end of the last one. `states`: Guess, one row per segment. `jump`: State at
    the end minus state at the start, such as (2π·winding, 0). `pin`: State that keeps its value at the first start; the
    last state is then an unknown constant, and the multipliers are those of the other states. `accuracy`: Largest
    component of the last Newton step, relative to the largest state if that exceeds 1.
    """
    times, x = np.asarray(times, dtype=float), np.array(states, dtype=float)
    segments, count = x.shape

    def defects(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = [advance(times[k], times[k + 1], x[k]) for k in range(segments)]
        g = np.array([end for end, _ in pairs]) - np.vstack([x[1:], x[:1] + jump])
        if pin is not None:
            g[-1, -1] = 0.0
        return g, np.array([matrix for _, matrix in pairs])

    g, transfer = defects(x)
    for _ in range(40):
        a = np.zeros((segments, count, segments, count))
        for k in range(segments):
            a[k, :, k] += transfer[k]
            a[k, :, (k + 1) % segments] -= np.eye(count)
        if pin is not None:
            a[-1, -1] = 0.0
            a[-1, -1, 0, pin] = 1.0
        step = -np.linalg.solve(a.reshape(x.size, x.size), g.ravel()).reshape(x.shape)
        size, damping = float(np.abs(step).max()), 1.0
        trial, matrices = defects(x + step)
        while size > 1e-7 and np.abs(trial).max() > (1.0 - 0.1 * damping) * np.abs(g).max():
            damping /= 2.0
            if damping < 1e-3:
                raise RuntimeError("Shooting makes no progress from this guess.")
            trial, matrices = defects(x + damping * step)
        x, g, transfer = x + damping * step, trial, matrices
        if size <= accuracy * max(1.0, np.abs(x).max()):
            inner = transfer if pin is None else transfer[:, :-1, :-1]
            return Orbit(times, x, transfer, multipliers(inner), size)
    raise RuntimeError("Shooting did not converge.")


def _known(row: Mapping[str, Any]) -> Known:
    multipliers = (complex(*m) if isinstance(m, list) else m for m in row["multipliers"])
    return Known(row["omega"], row["winding"], tuple(map(tuple, row["section"])), tuple(multipliers))


def _tables() -> tuple[dict[float, tuple[float, float, float]], dict[str, list[Known]]]:
    tables = json.loads(Path(__file__).with_name("reference_orbits.json").read_text(encoding="utf-8"))
    cycles = {float(mu): tuple(values) for mu, values in tables.pop("VAN_DER_POL").items()}
    return cycles, {name: [_known(row) for row in rows] for name, rows in tables.items()}


# Limit cycle of x'' − μ (1 − x²) x' + x = 0: μ → (period, x > 0 where x' = 0, nontrivial multiplier), from a Taylor
# series of order 40 with 36 digits. `van_der_pol_cycle` of tests/shooting.py agrees to 5e-15 in period and x, and to
# 5e-14 in the multiplier up to μ = 2, then to 5e-13 (μ = 3) and 2e-11 (μ = 5).
VAN_DER_POL, _orbits = _tables()

# The orbits of the pendulum: DOP853 with rtol = atol = 3e-14 and variational equations, one Newton over all segments,
# four per forcing period (two where ω was sought), down to a step of at most 1e-12 of the largest state.
# Against a Taylor series of order 34 with 32 digits, broken where φ' = 0 and started from these numbers: after one
# period every row meets the next within 2e-12; larger multipliers agree to 1e-11 relative, smaller ones to 1e-10, and
# the −1 and 1 at the critical ω to 4e-13. Against LSODA with three segments per period: rows within 3e-11, multipliers
# to 2e-10 relative, ω of RETURN and FOLD to 1e-12.

# Stable orbits down the cascade from the locked rotation at 13 rad/s: periods 1, 2 and 4.
STABLE = _orbits["STABLE"]
# Where a multiplier passes −1 on the branches of periods 1, 2 and 4, by Brent's method on the product of
# (1 + multiplier). From the stable orbits above down to 9.09 rad/s each branch passes −1 just once, with no fold.
DOUBLINGS = _orbits["DOUBLINGS"]
# Far below, the period-1 branch passes −1 once more and then turns in a fold (multiplier 1).
(RETURN,), (FOLD,) = _orbits["RETURN"], _orbits["FOLD"]
# Unstable orbits at 9.09 rad/s: the branches of periods 1, 2 and 4, the other rotation of period 1, and four prime
# orbits each of periods 3 and 5, which began as close returns of a chaotic trajectory; so did the remaining ones, those
# with multipliers below 50, of periods 2, 3 and 5.
UNSTABLE = _orbits["UNSTABLE"]
