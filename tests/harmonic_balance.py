"""Special points of Duffing's oscillator m x'' + c x' + k x + k3 x³ = F cos ωt by harmonic balance in SciPy.

The unknowns are the real and imaginary parts of the odd harmonics up to the 13th; the cubic term is evaluated on 64
points, on which it has no aliases. Guesses come from the balance of one harmonic.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import fsolve, root

HARMONICS, POINTS = np.arange(1, 14, 2), 64
WAVES = np.exp(2j * np.pi * np.outer(np.arange(POINTS) / POINTS, HARMONICS))
Theta = tuple[float, float, float, float]  # m, c, k, k3


def balance(u: np.ndarray, omega: float, theta: Theta, force: float) -> np.ndarray:
    """Return the residual (14,) of amplitudes u (14,), real parts first."""
    (m, c, k, k3), half = theta, HARMONICS.size
    amplitude = u[:half] + 1j * u[half:]
    x = np.real(WAVES @ amplitude)
    rate = 1j * HARMONICS * omega
    left = (m * rate**2 + c * rate + k) * amplitude + k3 * 2.0 / POINTS * np.conj(WAVES).T @ x**3
    left[0] -= force
    return np.concatenate([left.real, left.imag])


def jacobian(u: np.ndarray, omega: float, theta: Theta, force: float) -> np.ndarray:
    """Return its derivative (14, 14) by the amplitudes."""
    (m, c, k, k3), half = theta, HARMONICS.size
    x = np.real(WAVES @ (u[:half] + 1j * u[half:]))
    rate = 1j * HARMONICS * omega
    every = np.concatenate([np.eye(half), 1j * np.eye(half)], axis=1)  # a column an unknown
    cubic = np.conj(WAVES).T @ (3.0 * x[:, None] ** 2 * np.real(WAVES @ every))
    left = (m * rate**2 + c * rate + k)[:, None] * every + k3 * 2.0 / POINTS * cubic
    return np.concatenate([left.real, left.imag])


def one_harmonic(a: np.ndarray, theta: Theta, force: float, side: float) -> np.ndarray:
    """Return the frequencies ω at which the amplitude is a, on the right (1) or left (−1) of the backbone."""
    m, c, k, k3 = theta
    b = (k + 0.75 * k3 * a**2) / m - 0.5 * (c / m) ** 2
    inside = b**2 - ((k + 0.75 * k3 * a**2) / m) ** 2 + (force / (m * a)) ** 2
    with np.errstate(invalid="ignore"):
        return np.sqrt(b + side * np.sqrt(inside))


def amplitudes(a: float, omega: float, theta: Theta, force: float) -> np.ndarray:
    """Return the unknowns (14,) of one harmonic."""
    m, c, k, k3 = theta
    first = force / (k + 0.75 * k3 * a**2 - m * omega**2 + 1j * c * omega)
    u = np.zeros(2 * HARMONICS.size)
    u[0], u[HARMONICS.size] = first.real, first.imag
    return u


def solved(function: Callable, start: np.ndarray) -> np.ndarray:
    """Return the root, converged to rounding."""
    result = root(function, start, method="hybr", options={"xtol": 1e-13})
    assert np.max(np.abs(function(result.x))) < 1e-9, result.message
    return result.x


def fold(theta: Theta, force: float, direction: str, *, omega: float | None = None) -> float:
    """Return the frequency [Hz] of the fold of a sweep up or down; or at a given ω the force, of a level sweep."""
    a = np.linspace(0.02, 1.5 * force / (theta[1] * np.sqrt(theta[2] / theta[0])), 4000)
    if omega is None:
        rates = one_harmonic(a, theta, force, 1.0)
        a, rates = a[np.isfinite(rates)], rates[np.isfinite(rates)]
        lowest = int(np.argmin(rates))
        at = lowest if direction == "down" else lowest + int(np.argmax(rates[lowest:]))
        start, level = rates[at], force
    else:
        m, c, k, k3 = theta
        levels = a * np.hypot(k + 0.75 * k3 * a**2 - m * omega**2, c * omega)
        turns = np.flatnonzero(np.diff(np.sign(np.diff(levels)))) + 1
        at = turns[0] if direction == "up" else turns[1]
        start, level = omega, levels[at]
    u = amplitudes(a[at], start, theta, level)
    matrix = jacobian(u, start, theta, level)
    null = np.linalg.svd(matrix)[2][-1]

    def extended(y: np.ndarray) -> np.ndarray:
        u, v, value = y[:14], y[14:28], y[28]
        given = (value, theta, force) if omega is None else (omega, theta, value)
        return np.concatenate([balance(u, *given), jacobian(u, *given) @ v, [null @ v - 1.0]])

    value = solved(extended, np.concatenate([u, null, [start if omega is None else level]]))[28]
    return value / (2 * np.pi) if omega is None else value


def phase_resonance(theta: Theta, force: float, lag: float = np.pi / 2) -> tuple[float, float]:
    """Return the largest frequency [Hz] at which x lags by an angle, and the amplitude there."""
    m, c, k, k3 = theta

    def single(y: np.ndarray) -> np.ndarray:
        a, omega = y
        first = (k + 0.75 * k3 * a**2 - m * omega**2 + 1j * c * omega) * a - force * np.exp(1j * lag)
        return np.array([first.real, first.imag])

    start = np.sqrt(k / m)
    for _ in range(200):
        start = np.sqrt((k + 0.75 * k3 * (force / (c * start)) ** 2) / m)
    a, omega = fsolve(single, [force / (c * start), start])
    u = np.zeros(14)
    u[0], u[7] = a * np.cos(lag), -a * np.sin(lag)

    def extended(y: np.ndarray) -> np.ndarray:
        first = (y[0] + 1j * y[7]) * np.exp(1j * lag)
        return np.append(balance(y[:14], y[14], theta, force), first.imag)

    y = solved(extended, np.append(u, omega))
    return y[14] / (2 * np.pi), float(np.hypot(y[0], y[7]))


def backbone(theta: Theta, amplitude: float, lag: float = np.pi / 2) -> tuple[float, float]:
    """Return the frequency [Hz] at which x lags by an angle with an amplitude, and the force."""
    m, c, k, k3 = theta
    omega = np.sqrt((k + 0.75 * k3 * amplitude**2) / m)
    u = np.zeros(14)
    u[0], u[7] = amplitude * np.cos(lag), -amplitude * np.sin(lag)

    def extended(y: np.ndarray) -> np.ndarray:
        first = (y[0] + 1j * y[7]) * np.exp(1j * lag)
        return np.append(balance(y[:14], y[14], theta, y[15]), [first.imag, first.real - amplitude])

    y = solved(extended, np.append(u, [omega, c * omega * amplitude]))
    return y[14] / (2 * np.pi), float(y[15])
