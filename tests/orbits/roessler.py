"""The Roessler system: recordings by a Runge-Kutta method, and periodic orbits by SciPy, independent of the package."""

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp
from scipy.optimize import root

import bayesperiodic as bp

A, B, C = 0.2, 0.2, 5.7
RETURN = 5.855
# Guesses of (y, z, period) where x crosses zero upwards.
GUESSES = {1: [(-8.4, 0.03, 5.9)], 2: [(-9.5, 0.03, 11.76)], 3: [(-10.03, 0.03, 17.6), (-10.39, 0.03, 17.5)]}


class Known(NamedTuple):
    """A periodic orbit."""

    points: np.ndarray  # (y, z) where x crosses zero upwards, (period, 2)
    times: np.ndarray  # from each to the next one, (period,)
    multiplier: float  # the unstable one


def rates(_, state):
    x, y, z = state
    return [-y - z, x + A * y, B + z * (x - C)]


@njit
def _runge_kutta(state, samples, substeps, step):
    path, stages = np.empty((samples, 3)), np.zeros((5, 3))
    for k in range(samples * substeps):
        if k % substeps == 0:
            path[k // substeps] = state
        for stage in range(4):
            x, y, z = state + 0.5 * ((stage + 1) // 2) * step * stages[stage]
            stages[stage + 1, 0] = -y - z
            stages[stage + 1, 1] = x + 0.2 * y
            stages[stage + 1, 2] = 0.2 + z * (x - 5.7)
        state = state + step / 6.0 * (stages[1] + 2.0 * stages[2] + 2.0 * stages[3] + stages[4])
    return path


@cache
def path(samples, interval, start=0):
    """Return (x, y, z) at so many instants, an interval apart, on the attractor."""
    substeps = int(np.ceil(interval / 0.01))
    first = np.random.default_rng(start).uniform([-3.0, -3.0, 0.0], [3.0, 3.0, 0.1])
    settled = _runge_kutta(first, 20_001, 1, 0.01)[-1]
    return _runge_kutta(settled, samples, substeps, interval / substeps)


def recording(samples, interval, noise=0.0, seed=0, start=0, channels="xyz"):
    """Return a recording; `noise` is the sd of white noise as a fraction of a channel's range."""
    clean = path(samples, interval, start)
    errors = noise * np.ptp(clean, axis=0) * np.random.default_rng([seed, 5]).standard_normal(clean.shape)
    outputs = {name: values for name, values in zip("xyz", (clean + errors).T, strict=True) if name in channels}
    return bp.Recording(interval * np.arange(samples), outputs, {}, name="Roessler", synthetic=True)


def _follow(state, span):
    """Return the motion over a time, with the times of upward crossings of x = 0 but the first one."""

    def upward(_, state):
        return state[0]

    upward.direction = 1
    return solve_ivp(rates, (0.0, span), state, method="DOP853", rtol=1e-11, atol=1e-12, events=upward)


@cache
def known_orbits(period):
    """Return the periodic orbits of so many returns."""
    orbits = []
    for guess in GUESSES[period]:

        def gap(unknown):
            start = np.array([0.0, *unknown[:2]])
            return _follow(start, unknown[2]).y[:, -1] - start

        solved = root(gap, guess, tol=1e-11)
        assert np.abs(solved.fun).max() < 1e-8
        start, span = np.array([0.0, *solved.x[:2]]), solved.x[2]
        motion = _follow(start, span * (1.0 + 1e-6))
        inside = motion.t_events[0] > 1e-3
        times = motion.t_events[0][inside]
        assert times.size == period
        points = np.vstack([start, motion.y_events[0][inside][:-1]])[:, 1:]
        ends = [_follow(start + sign * one, span).y[:, -1] for one in 1e-6 * np.eye(3) for sign in (1, -1)]
        slopes = np.stack([(ends[2 * k] - ends[2 * k + 1]) / 2e-6 for k in range(3)], axis=1)
        values = np.linalg.eigvals(slopes).real
        orbits.append(Known(points, np.diff(times, prepend=0.0), float(values[np.argmax(np.abs(values))])))
    return orbits
