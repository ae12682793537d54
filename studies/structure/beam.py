"""A steel beam with a friction joint and a stop: its matrices, and its motion by an integrator of its own."""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from studies.solver import condensed

# A cantilever of steel, 1 m by 30 mm by 6 mm; its lowest natural frequency is 4.9 Hz.
WIDTH, THICKNESS, YOUNG, DENSITY = 0.03, 0.006, 200e9, 7800.0  # m, m, N/m², kg/m³
ELEMENTS = 50  # finite elements, each node with a displacement and a rotation
FORCED, JOINT, STOP, MIDDLE, SECOND = 0.3, 0.4, 1.0, 0.5, 0.8  # parts of the length
TRUTH = {
    "alpha": 2.0,  # 1/s
    "beta": 2e-5,  # s
    "joint_stiffness": 2000.0,  # N/m
    "joint_limit": 0.3,  # N
    "stop_k": 1000.0,  # N/m
    "stop_clearance": 2e-3,  # m
}
STEPS_PER_PERIOD, PERIODS, KEPT_PERIODS = 2048, 100, 20
# The parameter of the steps, at most 0; sweeps for the forces at their ends, and their last change over the limit.
DISSIPATION, MOST_SWEEPS, SWEPT = -0.05, 100, 1e-12


def place(part: float) -> int:
    """Return the degree of freedom that is the displacement at a part of the length."""
    return 2 * round(part * ELEMENTS) - 2


def matrices() -> tuple[np.ndarray, np.ndarray]:
    """Return mass and stiffness matrix [SI units] of the cantilever, from those of unit length, mass and bending."""
    mass, stiffness = condensed.matrices(2 * ELEMENTS)
    return DENSITY * WIDTH * THICKNESS * mass, YOUNG * WIDTH * THICKNESS**3 / 12.0 * stiffness


class Motion(NamedTuple):
    """Steady motion at equidistant times [s]: the force [N] and two accelerations [m/s²]."""

    time: np.ndarray
    force: np.ndarray
    middle: np.ndarray
    outer: np.ndarray


def integrated(frequency: float, amplitude: float, every: int) -> Motion:
    """Return the last periods, each `every` step, of the motion from rest under a cosine force.

    Friction and stop are exact, without rounded corners: the force of the joint follows the displacement and is cut off
    at its limit. The steps are those of Hilber, Hughes and Taylor (Earthquake Engineering and Structural Dynamics 5,
    1977, 283-292), in all modes; the forces of joint and stop at their ends are solved by Gauss-Seidel iteration.
    """
    mass, stiffness = matrices()
    squares, modes = scipy.linalg.eigh(stiffness, mass)
    damping, h = TRUTH["alpha"] + TRUTH["beta"] * squares, 1.0 / (frequency * STEPS_PER_PERIOD)
    forced, joint, stop, *sensors = (modes[place(part)] for part in (FORCED, JOINT, STOP, MIDDLE, SECOND))
    by_q, by_v, now = 0.25 * (1.0 - DISSIPATION) ** 2, 0.5 - DISSIPATION, 1.0 + DISSIPATION
    whole = 1.0 + now * (by_v * h * damping + by_q * h**2 * squares)
    pair, kept = np.array([joint, stop]), np.array(sensors)
    compliance = by_q * h**2 * now * (pair / whole) @ pair.T
    (soft, between), (_, hard) = compliance
    limit, k, stop_k, clearance = (TRUTH[n] for n in ("joint_limit", "joint_stiffness", "stop_k", "stop_clearance"))
    q, v, a, friction, contact, before, rows = *np.zeros((3, len(squares))), 0.0, 0.0, 0.0, []
    old, first = forced * amplitude, (PERIODS - KEPT_PERIODS) * STEPS_PER_PERIOD
    for step in range(1, PERIODS * STEPS_PER_PERIOD + 1):
        force = amplitude * np.cos(2.0 * np.pi * step / STEPS_PER_PERIOD)
        q_free, v_free = q + h * v + (0.5 - by_q) * h**2 * a, v + (1.0 - by_v) * h * a
        inner = now * (damping * v_free + squares * q_free) - DISSIPATION * (damping * v + squares * q)
        a_free = (now * forced * force - DISSIPATION * old - inner) / whole
        d_joint, d_stop = (pair @ (q_free + by_q * h**2 * a_free)).tolist()
        began = friction
        for _ in range(MOST_SWEEPS):
            last = friction, contact
            reached = (began + k * (d_joint - between * contact - before)) / (1.0 + k * soft)
            friction = min(max(reached, -limit), limit)
            contact = stop_k * max(d_stop - between * friction - clearance, 0.0) / (1.0 + stop_k * hard)
            if abs(friction - last[0]) + abs(contact - last[1]) <= SWEPT * limit:
                break
        before = d_joint - soft * friction - between * contact
        elements = joint * friction + stop * contact
        a = a_free - now * elements / whole
        q, v, old = q_free + by_q * h**2 * a, v_free + by_v * h * a, forced * force - elements
        if step > first and step % every == 0:
            rows.append((step * h, force, *(kept @ a)))
    return Motion(*np.array(rows).T)
