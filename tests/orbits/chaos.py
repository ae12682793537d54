"""Recordings of the chaotic pendulum at 9.09 rad/s by a Runge-Kutta method independent of the package."""

from functools import cache

import numpy as np
from numba import njit

import bayesperiodic as bp
from studies.shooting import PENDULUM

OMEGA = 9.09
FREQUENCY = OMEGA / (2.0 * np.pi)
SIZE = {"angle": 6.28, "rate": 32.6}
TRANSIENT = 200


@njit
def _runge_kutta(angle, rate, drive, periods, steps, kept, step, c1, c2, c3, width, length):
    path = np.empty((periods * kept + 1, 2))
    every = steps // kept
    for k in range(periods * steps + 1):
        if k % every == 0:
            path[k // every, 0], path[k // every, 1] = angle, rate
        q, v, dq, dv, sum_q, sum_v = angle, rate, 0.0, 0.0, 0.0, 0.0
        for stage in range(4):
            fraction = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            q, v = angle + fraction * step * dq, rate + fraction * step * dv
            gravity = drive[(2 * (k % steps) + (stage + 1) // 2) % (2 * steps)]
            dq, dv = v, -c1 * np.tanh(v / width) - (c2 + c3 * abs(v)) * v - gravity / length * np.sin(q)
            weight = 1.0 if stage in (0, 3) else 2.0
            sum_q, sum_v = sum_q + weight * dq, sum_v + weight * dv
        angle, rate = angle + step / 6.0 * sum_q, rate + step / 6.0 * sum_v
    return path


def _motion(start, periods, steps, kept):
    """Return (φ, φ') at `kept` instants of each of some forcing periods."""
    drive = PENDULUM["g"] + PENDULUM["lift"] * OMEGA**2 * np.cos(np.pi * np.arange(2 * steps) / steps)
    constants = [PENDULUM[name] for name in ("c1", "c2", "c3", "width", "length")]
    return _runge_kutta(*start, drive, periods, steps, kept, 1.0 / (FREQUENCY * steps), *constants)


def closed(guess: np.ndarray, period: int) -> np.ndarray:
    """Return the points (period, 2) of the orbit near a point, by Newton's method."""
    point = np.array(guess)

    def end(start):
        return _motion(start, period, 400, 1)[-1]

    for _ in range(20):
        missed = end(point) - point
        missed[0] -= 2.0 * np.pi * np.round(missed[0] / (2.0 * np.pi))
        slopes = [(end(point + by) - end(point - by)) / 2e-6 for by in 1e-6 * np.eye(2)]
        point = point - np.linalg.solve(np.stack(slopes, axis=1) - np.eye(2), missed)
    assert np.abs(missed).max() < 1e-9
    return _motion(point, period, 400, 1)[:-1]


@cache
def path(periods: int, samples: int, start: int = 0, steps: int = 400) -> np.ndarray:
    """Return (φ, φ') at `samples` instants a forcing period, on the attractor, from the random start number `start`."""
    generator = np.random.default_rng([start, 7])
    angle, rate = generator.uniform([-3.0, -10.0], [3.0, 10.0])
    steps = samples * -(-steps // samples)
    settled = _motion((angle, rate), TRANSIENT, steps, 1)[-1]
    angle = (settled[0] + np.pi) % (2.0 * np.pi) - np.pi
    result = _motion((angle, settled[1]), periods, steps, samples)
    result.flags.writeable = False
    return result


def recording(periods: int, samples: int = 40, noise: float = 0.0, seed: int = 0, start: int = 0) -> bp.Recording:
    """Return the pendulum's recording; `noise` is the sd of white noise as a fraction of the attractor's size."""
    clean = path(periods, samples, start)
    sd = noise * np.array([SIZE["angle"], SIZE["rate"]])
    noisy = clean + sd * np.random.default_rng([seed, 11]).standard_normal(clean.shape)
    time = np.arange(len(clean)) / (samples * FREQUENCY)
    return bp.Recording(time, {"angle": noisy[:, 0], "rate": noisy[:, 1]}, {}, name="chaotic pendulum", synthetic=True)


def points(periods: int, noise: float = 0.0, seed: int = 0, start: int = 0) -> np.ndarray:
    """Return section points (φ in ±π, φ'), each measured once with noise."""
    clean = path(periods, 1, start)
    sd = noise * np.array([SIZE["angle"], SIZE["rate"]])
    noisy = clean + sd * np.random.default_rng([seed, 13]).standard_normal(clean.shape)
    noisy[:, 0] = np.pi - (np.pi - noisy[:, 0]) % (2.0 * np.pi)
    return noisy
