"""Flutter rig by numerical matrices, eigenvalues and time integration, independent of the package."""

from collections.abc import Mapping
from functools import cache

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

# As published with the data, in SI units.
RIG = {
    "b": 0.15, "span": 1.0, "a": -0.5, "rho": 1.204, "x_alpha": 0.234, "m": 5.3, "m_T": 16.9, "I_alpha": 0.1726,
    "c_h": 15.443, "c_alpha": 0.562767, "k_h": 3529.4, "k_alpha": 54.1162, "k_alpha2": 751.6, "k_alpha3": 5006.0,
}  # fmt: skip
# One unit of the heave sensor is 18 cm, the pitch sensor reads rad; so the authors' code plots them.
SENSORS = {"gain_heave": 1 / 0.18, "gain_pitch": 1.0, "offset_heave": 3.37, "offset_pitch": 0.71}


def flutter_matrices(p: Mapping[str, float]) -> tuple[np.ndarray, ...]:
    """Return mass, damping and stiffness at p["U"], written out entry by entry as they were published."""
    b, a, rho, U, pi = p["b"], p["a"], p["rho"] * p["span"], p["U"], np.pi
    c0, c1, c2, c3, c4 = 1.0, 0.165, 0.0455, 0.335, 0.3
    C, lagged = c0 - c1 - c3, c1 * c2 + c3 * c4
    mass = [
        [pi * rho * b**2 + p["m_T"], -a * pi * rho * b**3 + b * p["m"] * p["x_alpha"], 0],
        [-a * pi * rho * b**3 + b * p["m"] * p["x_alpha"], p["I_alpha"] + pi * (1 / 8 + a**2) * rho * b**4, 0],
        [0, 0, 1],
    ]
    damping = [
        [
            p["c_h"] + 2 * pi * rho * b * U * C,
            (1 + C * (1 - 2 * a)) * pi * rho * b**2 * U,
            2 * pi * rho * U**2 * b * lagged,
        ],
        [
            -2 * pi * (a + 0.5) * rho * b**2 * C * U,
            p["c_alpha"] + (0.5 - a) * (1 - C * (1 + 2 * a)) * pi * rho * b**3 * U,
            -2 * pi * rho * U**2 * b**2 * (a + 0.5) * lagged,
        ],
        [-1 / b, a - 0.5, (c2 + c4) * U / b],
    ]
    moment = p["k_alpha"] - 2 * pi * (a + 0.5) * rho * C * b**2 * U**2
    stiffness = [
        [p["k_h"], 2 * pi * rho * b * U**2 * C, 2 * pi * rho * U**3 * c2 * c4 * (c1 + c3)],
        [0, moment, -2 * pi * rho * b * U**3 * (a + 0.5) * c2 * c4 * (c1 + c3)],
        [0, -U / b, c2 * c4 * U**2 / b**2],
    ]
    return tuple(np.array(matrix, dtype=float) for matrix in (mass, damping, stiffness))


def first_order(speed: float, rig: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return A of ẏ = A y for small motion, y = (q, q̇), and the contribution of the spring's moment to ẏ."""
    mass, damping, stiffness = flutter_matrices({**rig, "U": speed})
    inverse = np.linalg.inv(mass)
    below = np.hstack([-inverse @ stiffness, -inverse @ damping])
    return np.vstack([np.hstack([np.zeros((3, 3)), np.eye(3)]), below]), -inverse[:, 1]


def hopf(rig: Mapping[str, float] = RIG) -> tuple[float, float]:
    """Return speed [m/s] and frequency [Hz] at which the equilibrium loses its stability."""

    def leading(speed: float) -> complex:
        values = np.linalg.eigvals(first_order(speed, rig)[0])
        return values[np.argmax(np.where(values.imag > 0.0, values.real, -np.inf))]

    speed = brentq(lambda speed: leading(speed).real, 10.0, 30.0)
    return speed, leading(speed).imag / (2 * np.pi)


@cache
def settled(speed: float, seconds: float = 120.0) -> tuple[float, np.ndarray]:
    """Return frequency [Hz] and states (3, 2000) of the stable cycle, by time integration from a large deflection."""
    matrix, moment = first_order(speed, RIG)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        change = matrix @ y
        change[3:] += moment * (RIG["k_alpha2"] * y[1] ** 2 + RIG["k_alpha3"] * y[1] ** 3)
        return change

    def top(t: float, y: np.ndarray) -> float:
        return float(y[3])

    # solve_ivp reads an event's direction off the function, which has no such attribute by its type.
    top.direction = -1.0  # type: ignore[attr-defined]
    start = solve_ivp(rate, (0.0, seconds), [0.05, 0.1, 0, 0, 0, 0], method="DOP853", rtol=1e-9, atol=1e-11).y[:, -1]
    last = solve_ivp(rate, (0.0, 1.5), start, method="DOP853", rtol=1e-11, atol=1e-13, events=top, dense_output=True)
    assert last.t_events is not None and last.sol is not None
    first, second = last.t_events[0][:2]
    return 1.0 / (second - first), last.sol(np.linspace(first, second, 2000, endpoint=False))[:3]
