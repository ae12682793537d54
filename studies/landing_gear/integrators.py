"""Compiled time integration of the landing gear of eq. (9) until steady.

Two methods for each direction: the classical Runge-Kutta method with fixed steps, and the pair of orders 5 and 4 of
Dormand and Prince with error control (Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, 1993, table
5.2). Integration stops when the gas is within `tolerance` of its steady temperature, estimated from two successive
changes over a cycle, which decrease geometrically.

States are the gas temperature T [K], preceded by compression q [m] and velocity [m/s] if the force is given. Parameters
are in the order of `NAMES`.
"""

import math

import numba
import numpy as np

from studies.landing_gear.rig import GEAR

NAMES = tuple(GEAR)
MAX_CYCLES = 5000
# Nodes, stage weights and the difference of the two results of Dormand and Prince.
NODES = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
STAGES = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
DIFFERENCE = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])

compiled = numba.njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})


@compiled
def pressure(g, q, t):
    """Return the gas pressure [Pa]."""
    return g[4] * t / (1.0 + g[5] * q + g[6] * t)


@compiled
def warming(g, p, q, v, t):
    """Return the rate of the gas temperature [K/s]."""
    return ((g[3] * p + g[10]) * v - g[13] * (1.0 + g[5] * q) * (t + g[14])) / g[12]


@compiled
def resisting(g, p, v):
    """Return the force without inertia [N]."""
    return g[2] * v * abs(v) + g[3] * p + (g[7] + g[8] * p) * math.atan(g[9] * v) + g[10]


@compiled
def displacement_rates(g, u, y, rate):
    """Fill the rates; u holds displacement, velocity and acceleration."""
    q = u[0] - g[11]
    rate[0] = warming(g, pressure(g, q, y[0]), q, u[1], y[0])


@compiled
def force_rates(g, u, y, rate):
    """Fill the rates; u holds the force."""
    p = pressure(g, y[0], y[2])
    rate[0] = y[1]
    rate[1] = (u[0] - resisting(g, p, y[1])) / g[0] - g[1]
    rate[2] = warming(g, p, y[0], y[1], y[2])


@compiled
def displacement_outputs(g, inputs, states):
    """Return force and pressure (samples, 2) of a cycle."""
    out = np.empty((states.shape[0], 2))
    for k in range(states.shape[0]):
        p = pressure(g, inputs[k, 0] - g[11], states[k, 0])
        out[k, 0] = g[0] * (inputs[k, 2] + g[1]) + resisting(g, p, inputs[k, 1])
        out[k, 1] = p
    return out


@compiled
def force_outputs(g, inputs, states):
    """Return displacement and pressure (samples, 2) of a cycle."""
    out = np.empty((states.shape[0], 2))
    for k in range(states.shape[0]):
        out[k, 0] = states[k, 0] + g[11]
        out[k, 1] = pressure(g, states[k, 0], states[k, 2])
    return out


@compiled
def settled(before, now, change, tolerance):
    """Return whether the temperature is steady, and its change over the last cycle."""
    new = now - before
    if new == 0.0:
        return True, new
    factor = new / change if change != 0.0 else 1.0
    # Not before the changes fall like those of a single exponential.
    near = 0.0 < factor < 1.0 and abs(new) * factor / (1.0 - factor) < tolerance
    return near or (abs(factor) < 0.1 and abs(new) < tolerance), new


@compiled
def signals(inputs, at, u):
    """Fill the inputs at a time [cycles], by cubic interpolation in a fine table."""
    count = inputs.shape[0]
    place = (at - math.floor(at)) * count
    k = int(place)
    s = place - k
    a, b, c, d = (
        -s * (s - 1.0) * (s - 2.0) / 6.0, (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
        -(s + 1.0) * s * (s - 2.0) / 2.0, (s + 1.0) * s * (s - 1.0) / 6.0,
    )  # fmt: skip
    for i in range(inputs.shape[1]):
        u[i] = (
            a * inputs[(k - 1) % count, i] + b * inputs[k % count, i] + c * inputs[(k + 1) % count, i]
            + d * inputs[(k + 2) % count, i]
        )  # fmt: skip


def _fixed_steps(rates, size):
    """Return the classical Runge-Kutta method for a direction."""

    @compiled
    def integrate(g, inputs, frequency, y, tolerance, path):
        """Integrate until steady and fill the states (samples, size) of the last cycle.

        Return the number of cycles, 0 if it never becomes steady. `inputs` holds a cycle at half steps (2·steps,
        signals); `y` is the start, and the end. The steps are a multiple of the samples.
        """
        steps, samples = inputs.shape[0] // 2, path.shape[0]
        h, each, change = 1.0 / (frequency * steps), steps // samples, 0.0
        k1, k2, k3, k4, trial = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
        for cycle in range(MAX_CYCLES):
            before = y[size - 1]
            for k in range(steps):
                here, middle = inputs[2 * k], inputs[2 * k + 1]
                after = inputs[2 * k + 2] if k + 1 < steps else inputs[0]
                if k % each == 0:
                    path[k // each] = y
                rates(g, here, y, k1)
                for i in range(size):
                    trial[i] = y[i] + 0.5 * h * k1[i]
                rates(g, middle, trial, k2)
                for i in range(size):
                    trial[i] = y[i] + 0.5 * h * k2[i]
                rates(g, middle, trial, k3)
                for i in range(size):
                    trial[i] = y[i] + h * k3[i]
                rates(g, after, trial, k4)
                for i in range(size):
                    y[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
            done, change = settled(before, y[size - 1], change, tolerance)
            if done:
                return cycle + 1
            if not abs(y[size - 1]) < 1e6:
                return 0
        return 0

    return integrate


def _controlled_steps(rates, size):
    """Return the pair of Dormand and Prince for a direction."""

    @compiled
    def integrate(g, inputs, frequency, y, scale, relative, tolerance, path):
        """Integrate until steady, then through one more cycle for the states (samples, size).

        Return the number of cycles, 0 if it never becomes steady. `inputs` holds a cycle (points, signals), `scale`
        (size,) what the errors are measured by.
        """
        rate, trial, u = np.empty((7, size)), np.empty(size), np.empty(inputs.shape[1])
        samples, change, step, done = path.shape[0], 0.0, 1e-3, False
        for cycle in range(MAX_CYCLES):
            before = y[size - 1]
            last = done
            for k in range(samples if last else 1):
                now, end = k / samples if last else 0.0, (k + 1) / samples if last else 1.0
                signals(inputs, now, u)
                if last:
                    path[k] = y
                rates(g, u, y, rate[0])
                while now < end:
                    used = min(step, end - now)
                    for stage in range(1, 7):
                        for i in range(size):
                            total = 0.0
                            for j in range(stage):
                                total += STAGES[stage, j] * rate[j, i]
                            trial[i] = y[i] + used / frequency * total
                        signals(inputs, now + NODES[stage] * used, u)
                        rates(g, u, trial, rate[stage])
                    error = 0.0
                    for i in range(size):
                        total = 0.0
                        for j in range(7):
                            total += DIFFERENCE[j] * rate[j, i]
                        error = max(error, abs(used / frequency * total) / (relative * scale[i]))
                    if error <= 1.0:
                        now = end if used == end - now else now + used
                        for i in range(size):
                            y[i], rate[0, i] = trial[i], rate[6, i]
                    elif used < 1e-12:
                        return 0
                    growth = min(5.0, max(0.2, 0.9 * error ** (-0.2))) if error > 0.0 else 5.0
                    step = max(step, used * growth) if error <= 1.0 and used < step else used * growth
            if last:
                return cycle + 1
            done, change = settled(before, y[size - 1], change, tolerance)
            if not abs(y[size - 1]) < 1e6:
                return 0
        return 0

    return integrate


@compiled
def displacement_rates_in_time(t, y, g, inputs, frequency):
    """Return the rates at a time [s], as SciPy requires them."""
    u, rate = np.empty(3), np.empty(1)
    signals(inputs, t * frequency, u)
    displacement_rates(g, u, y, rate)
    return rate


@compiled
def force_rates_in_time(t, y, g, inputs, frequency):
    """Return the rates at a time [s], as SciPy requires them."""
    u, rate = np.empty(3), np.empty(3)
    signals(inputs, t * frequency, u)
    force_rates(g, u, y, rate)
    return rate


FIXED_STEPS = {"displacement": _fixed_steps(displacement_rates, 1), "force": _fixed_steps(force_rates, 3)}
CONTROLLED_STEPS = {
    "displacement": _controlled_steps(displacement_rates, 1), "force": _controlled_steps(force_rates, 3),
}  # fmt: skip
OUTPUTS = {"displacement": displacement_outputs, "force": force_outputs}
SCIPY_RATES = {"displacement": displacement_rates_in_time, "force": force_rates_in_time}
