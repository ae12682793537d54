"""Tables of a Duffing oscillator's response, from harmonic balance with SciPy only."""

from functools import cache

import numpy as np

import bayesperiodic as bp

TRUTH = {"m": 1.0, "c": 0.1, "k": 1.0, "k3": 0.3}
FORCE = 0.2
PRIORS = {"c": bp.LogNormal(0.1, 0.3), "k": bp.LogNormal(1.0, 0.1), "k3": bp.LogNormal(0.3, 0.3)}
ORDERS, POINTS = np.array([1, 3, 5]), 32
ANGLES = np.linspace(0.05, 3.1, 400)


def harmonic_balance(c, k, k3, angles=ANGLES, force=FORCE):
    """Return frequency [Hz] and complex amplitude (angles, sets) of x = A cos t + …, force F cos(t + angle).

    The branch is a function of this angle, round its folds: the unknowns are A, the higher cosines and sines, and ω,
    for sets of parameters (sets,).
    """
    c, k, k3 = (np.atleast_1d(np.asarray(value, dtype=float)) for value in (c, k, k3))
    t, count = 2 * np.pi * np.arange(POINTS) / POINTS, ORDERS.size
    cosines, sines = np.cos(np.outer(ORDERS, t)), np.sin(np.outer(ORDERS, t))
    x = np.zeros((c.size, 2 * count))
    x[:, -1] = 0.3 * np.sqrt(k)
    x[:, 0] = force / (k - x[:, -1] ** 2)
    frequency, amplitude = np.empty((2, len(angles), c.size), dtype=complex)
    for row, angle in enumerate(angles):
        for _ in range(30 if row == 0 else 5):
            x = x - _newton_step(x, c, k, k3, force, angle, (cosines, sines))
        frequency[row], amplitude[row] = x[:, -1] / (2 * np.pi), x[:, 0] * np.exp(-1j * angle)
    return frequency.real, amplitude


def _newton_step(x, c, k, k3, force, angle, waves):
    (cosines, sines), count = waves, ORDERS.size
    omega = x[:, -1:]
    a = x[:, :count]
    b = np.concatenate([np.zeros((len(x), 1)), x[:, count:-1]], axis=1)
    signal = a @ cosines + b @ sines
    stiff, damped = k[:, None] - (ORDERS * omega) ** 2, c[:, None] * ORDERS * omega
    cubic = 2 / POINTS * k3[:, None] * signal**3
    g = np.concatenate([stiff * a + damped * b + cubic @ cosines.T, stiff * b - damped * a + cubic @ sines.T], axis=1)
    g[:, 0] -= force * np.cos(angle)
    g[:, count] += force * np.sin(angle)
    slope = 6 / POINTS * k3[:, None] * signal**2
    every = np.concatenate([cosines, sines])
    jacobian = np.einsum("np,ap,bp->nab", slope, every, every)
    i = np.arange(count)
    jacobian[:, i, i] += stiff
    jacobian[:, i + count, i + count] += stiff
    jacobian[:, i, i + count] += damped
    jacobian[:, i + count, i] -= damped
    by_omega = np.concatenate(
        [-2 * ORDERS**2 * omega * a + c[:, None] * ORDERS * b, -2 * ORDERS**2 * omega * b - c[:, None] * ORDERS * a],
        axis=1,
    )
    jacobian[:, :, count] = 0.0  # The sine of harmonic 1 is zero; ω takes its place.
    columns = np.concatenate([np.delete(jacobian, count, axis=2), by_omega[:, :, None]], axis=2)
    return np.linalg.solve(columns, g[..., None])[..., 0]


@cache
def true_branch():
    """Return frequencies and amplitudes (angles,) at the truth, and the indices of both folds."""
    frequency, amplitude = (part[:, 0] for part in harmonic_balance(TRUTH["c"], TRUTH["k"], TRUTH["k3"]))
    turns = np.flatnonzero(np.diff(np.sign(np.diff(frequency)))) + 1
    return frequency, amplitude, turns


def swept(frequencies, direction):
    """Return the complex amplitudes that a sweep through frequencies, up or down, shows."""
    f, c, (upper, lower) = true_branch()
    first, last = slice(0, upper + 1), slice(lower, None)
    result = []
    for value in frequencies:
        on_first = value <= f[upper] if direction == "up" else value < f[lower]
        part = first if on_first else last
        result.append(np.interp(value, f[part], c[part].real) + 1j * np.interp(value, f[part], c[part].imag))
    return np.array(result)


def noisy(amplitudes, sd, seed):
    """Return amplitudes whose real and imaginary parts have errors."""
    rng = np.random.default_rng(seed)
    return amplitudes + sd * (rng.standard_normal(amplitudes.size) + 1j * rng.standard_normal(amplitudes.size))


def problem_of(frequencies, amplitudes, sweep, **more):
    """Return the problem of a table with amplitudes and phases."""
    table = {"f": frequencies, "c": amplitudes}
    columns = {"frequency": "f", "outputs": {"displacement": "c"}, "inputs": {"force": FORCE}}
    runs = bp.response_table(table, **columns, sweep=sweep)
    given = {"priors": PRIORS, "fixed": {"m": 1.0}} | more
    return bp.Problem(bp.models.duffing, runs, **given)
