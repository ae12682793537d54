"""A driven bistable beam with a piezo element, three states, and its periodic orbits by Newton's method on the flow.

x'' + 0.2 x' − x(1 − x²)/2 = 0.1 v + 0.3 cos 0.8 t and v' + 0.088 v + 0.5 x' = 0, by a Runge-Kutta method.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit

import bayesperiodic as bp

PERIOD = 2.0 * np.pi / 0.8
SAMPLES, STEPS = 128, 5
CHANNELS = ("x", "y", "v")


class KnownOrbit(NamedTuple):
    """A periodic orbit of the flow."""

    states: np.ndarray  # at whole periods, (period, 3)
    multipliers: np.ndarray  # (3,)


@njit
def _rates(x, y, v, time):
    return y, 0.3 * np.cos(0.8 * time) - 0.2 * y + 0.5 * x * (1.0 - x * x) + 0.1 * v, -0.088 * v - 0.5 * y


@njit
def flow(start, periods, samples, steps):
    """Return the states at `samples` instants a period (periods·samples + 1, 3), with some steps between them."""
    path = np.empty((periods * samples + 1, 3))
    h = 2.0 * np.pi / 0.8 / (samples * steps)
    x, y, v = start[0], start[1], start[2]
    for k in range(periods * samples):
        path[k] = x, y, v
        for j in range(steps):
            time = (k * steps + j) * h
            a, b, c = _rates(x, y, v, time)
            a2, b2, c2 = _rates(x + 0.5 * h * a, y + 0.5 * h * b, v + 0.5 * h * c, time + 0.5 * h)
            a3, b3, c3 = _rates(x + 0.5 * h * a2, y + 0.5 * h * b2, v + 0.5 * h * c2, time + 0.5 * h)
            a4, b4, c4 = _rates(x + h * a3, y + h * b3, v + h * c3, time + h)
            x += h / 6.0 * (a + 2.0 * a2 + 2.0 * a3 + a4)
            y += h / 6.0 * (b + 2.0 * b2 + 2.0 * b3 + b4)
            v += h / 6.0 * (c + 2.0 * c2 + 2.0 * c3 + c4)
    path[-1] = x, y, v
    return path


@cache
def motion(periods: int) -> np.ndarray:
    """Return the states (periods·samples, 3) on the attractor."""
    settled = flow(np.array([1.0, 0.0, 0.0]), 200, 4, 80)[-1]
    result = flow(settled, periods, SAMPLES, STEPS)[:-1]
    result.flags.writeable = False
    return result


def recordings(periods: int, noise: tuple[float, float, float], piece: int = 26, seed: int = 0) -> list[bp.Recording]:
    """Return pieces of some periods each; `noise` is the sd of white noise as a fraction of each channel's range."""
    clean = motion(periods)
    sd = np.array(noise) * np.ptp(clean, axis=0)
    noisy = clean + sd * np.random.default_rng([seed, 17]).standard_normal(clean.shape)
    time = np.arange(len(clean)) * PERIOD / SAMPLES
    parts = (slice(k, k + piece * SAMPLES) for k in range(0, len(clean), piece * SAMPLES))
    return [bp.Recording(time[p], dict(zip(CHANNELS, noisy[p].T, strict=True)), {}, synthetic=True) for p in parts]


def _next(state):
    return flow(state, 1, 1, SAMPLES * STEPS)[-1]


def _slopes(state):
    steps = 1e-6 * np.eye(3)
    return np.stack([(_next(state + step) - _next(state - step)) / 2e-6 for step in steps], axis=1)


def orbit(guess: np.ndarray) -> KnownOrbit | None:
    """Return the orbit near a guess of its states (period, 3), by Newton's method on the flow; None without one."""
    states = np.array(guess)
    p = len(states)
    for _ in range(25):
        slopes = [_slopes(state) for state in states]
        system = np.zeros((p, 3, p, 3))
        for j in range(p):
            system[j, :, j] += slopes[j]
            system[j, :, (j + 1) % p] -= np.eye(3)
        missed = np.array([_next(state) for state in states]) - np.roll(states, -1, axis=0)
        step = np.linalg.solve(system.reshape(3 * p, 3 * p), missed.ravel()).reshape(p, 3)
        size = np.abs(step).max()
        states = states - step * min(1.0, 0.2 / size)
        if size < 1e-9:
            values = np.linalg.eigvals(np.linalg.multi_dot([np.eye(3), np.eye(3), *slopes[::-1]]))
            return KnownOrbit(states, values[np.argsort(-np.abs(values))])
    return None


def coordinates_of(known: KnownOrbit, coordinates: list[tuple[str, float]]) -> np.ndarray:
    """Return the points (period, d) of an orbit in channels with delays, by the Fourier series of each period."""
    path = np.concatenate([flow(state, 1, SAMPLES, STEPS)[:-1] for state in known.states])
    amplitudes = np.fft.rfft(path, axis=0)
    turns = 2j * np.pi * np.arange(len(amplitudes)) / len(known.states)
    columns = []
    for channel, delay in coordinates:
        shifted = amplitudes[:, CHANNELS.index(channel)] * np.exp(turns * delay)
        columns.append(np.fft.irfft(shifted, len(path))[::SAMPLES])
    return np.stack(columns, axis=1)


@cache
def known_orbits(periods: int, highest: int) -> tuple[tuple[KnownOrbit, int], ...]:
    """Return the orbits up to a period to which close returns of the motion lead, and the number of close returns.

    Counted are chains of points that stay within 0.08 of the attractor's size of the orbit over its period and return.
    """
    section = motion(periods)[::SAMPLES]
    size = np.ptp(section, axis=0)
    result = []
    for p in range(1, highest + 1):
        away = np.abs((section[p:] - section[:-p]) / size).max(axis=1)
        chains = np.lib.stride_tricks.sliding_window_view(section, p + 1, axis=0).transpose(0, 2, 1)
        collected = []
        for start in np.argsort(away)[:200]:
            guess = section[start : start + p]
            if any(_apart(guess, one.states) < 0.02 for one in collected):
                continue
            known = orbit(guess) if away[start] < 0.15 else None
            if known is None or any(_apart(known.states, one.states) < 1e-5 for one in collected):
                continue
            if any(np.abs(np.roll(known.states, -k, axis=0) - known.states).max() < 1e-5 for k in range(1, p)):
                continue
            collected.append(known)
        for known in collected:
            closed = [np.roll(np.concatenate([known.states] * 2), -k, axis=0)[: p + 1] for k in range(p)]
            near = sum(int(np.sum(np.abs((chains - one) / size).max((1, 2)) < 0.08)) for one in closed)
            result.append((known, near))
    return tuple(result)


def _apart(one, other):
    return min(np.abs(np.roll(one, -k, axis=0) - other).max() for k in range(len(one)))
