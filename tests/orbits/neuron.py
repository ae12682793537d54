"""The bursting neuron of J. L. Hindmarsh, R. M. Rose, Proc. R. Soc. B 221, 1984: recordings and its periodic orbits."""

from functools import cache

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import root

import bayesperiodic as bp

CURRENT, SLOWNESS = 3.25, 0.006
STEP = 0.1


@njit
def _rates(x, y, z):
    return y - x**3 + 3.0 * x**2 - z + CURRENT, 1.0 - 5.0 * x**2 - y, SLOWNESS * (4.0 * (x + 1.6) - z)


@njit
def _runge_kutta(samples, skipped, substeps, step):
    path = np.empty((samples, 3))
    x, y, z = 0.0, 0.0, 3.0
    for k in range(-skipped, samples):
        if k >= 0:
            path[k] = x, y, z
        for _ in range(substeps):
            a, b, c = _rates(x, y, z)
            d, e, f = _rates(x + 0.5 * step * a, y + 0.5 * step * b, z + 0.5 * step * c)
            g, h, i = _rates(x + 0.5 * step * d, y + 0.5 * step * e, z + 0.5 * step * f)
            j, k2, m = _rates(x + step * g, y + step * h, z + step * i)
            x += step / 6.0 * (a + 2.0 * d + 2.0 * g + j)
            y += step / 6.0 * (b + 2.0 * e + 2.0 * h + k2)
            z += step / 6.0 * (c + 2.0 * f + 2.0 * i + m)
    return path


@cache
def path(samples):
    """Return (x, y, z) at so many instants, `STEP` apart, on the attractor."""
    return _runge_kutta(samples, 20_000, 5, STEP / 5)


def recording(samples, noise):
    """Return the voltage with white noise, a fraction of its range."""
    voltage = path(samples)[:, 0]
    noisy = voltage + noise * np.ptp(voltage) * np.random.default_rng(0).standard_normal(samples)
    return bp.Recording(STEP * np.arange(samples), {"voltage": noisy}, {}, synthetic=True)


def orbit_near(samples, instant, duration):
    """Return the orbit near the motion from an instant on, by SciPy: its duration and its largest multiplier."""
    time = STEP * np.arange(samples)
    near = slice(max(np.searchsorted(time, instant) - 8, 0), np.searchsorted(time, instant) + 8)
    start = CubicSpline(time[near], path(samples)[near])(instant)
    direction = np.array(_rates(*start))

    def end(state, span):
        return solve_ivp(lambda _, s: _rates(*s), (0.0, span), state, method="DOP853", rtol=1e-10, atol=1e-11).y[:, -1]

    def gap(unknown):
        return np.append(end(unknown[:3], unknown[3]) - unknown[:3], direction @ (unknown[:3] - start))

    solved = root(gap, [*start, duration], tol=1e-9)
    assert np.abs(solved.fun).max() < 1e-6
    state, span = solved.x[:3], solved.x[3]
    slopes = [(end(state + by, span) - end(state - by, span)) / 2e-6 for by in 1e-6 * np.eye(3)]
    values = np.linalg.eigvals(np.stack(slopes, axis=1))
    return span, values[np.argmax(np.abs(values))].real
