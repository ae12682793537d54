"""Compiled time integration of the landing gear of eq. (9) until steady.

Two methods for each direction: the classical Runge-Kutta method with fixed steps, and the pair of orders 5 and 4 of
Dormand and Prince with error control (Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, 1993, table
5.2). Integration stops when the gas is within `tolerance` of its steady temperature, estimated from two successive
changes over a cycle, which decrease geometrically.

Rates and outputs are generated from the model's expressions. States are the gas temperature T [K], preceded by
compression q [m] and velocity [m/s] if the force is given. Parameters are in the order of `NAMES`.
"""

from functools import cache
from types import SimpleNamespace

import numpy as np
from scipy.integrate import RK45

import bayesperiodic as bp
from studies.benchmark.kernels import MAX_CYCLES, NUMBA, FirstOrder, compiled, integrators, runge_kutta, signals
from studies.gear import GEAR

NAMES = tuple(GEAR)
# Nodes, stage weights and the difference of the two results of Dormand and Prince.
NODES, DIFFERENCE = np.append(RK45.C, 1.0), RK45.E
STAGES = np.vstack([np.pad(RK45.A, ((0, 0), (0, 1))), RK45.B])


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


def _fixed_steps(rates, size):
    """Return the classical Runge-Kutta method for a direction."""
    one_cycle = runge_kutta(rates, size)

    @compiled
    def integrate(g, inputs, frequency, y, tolerance, path, slopes):
        """Integrate until steady and fill the states and their rates (steps + 1, size) of the last cycle.

        Return the number of cycles, 0 if it never becomes steady. `inputs` holds a cycle at half steps (2·steps,
        signals); `y` is the start, and the end.
        """
        change = 0.0
        for cycle in range(MAX_CYCLES):
            one_cycle(g, inputs, 1.0 / frequency, y, path, slopes)
            done, change = settled(path[0, size - 1], y[size - 1], change, tolerance)
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
        (size,) the scales of the errors.
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
                rates(y, u, g, rate[0])
                while now < end:
                    used = min(step, end - now)
                    for stage in range(1, 7):
                        for i in range(size):
                            total = 0.0
                            for j in range(stage):
                                total += STAGES[stage, j] * rate[j, i]
                            trial[i] = y[i] + used / frequency * total
                        signals(inputs, now + NODES[stage] * used, u)
                        rates(trial, u, g, rate[stage])
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


@cache
def methods(drive: str) -> SimpleNamespace:
    """Return the compiled functions fixed, controlled, outputs and rates_in_time of one direction."""
    model = bp.models.landing_gear(drive)
    first, generic = FirstOrder(model, ()), integrators(model, NAMES[:1])
    rates = compiled(first.function(NUMBA, first.rates))
    return SimpleNamespace(
        fixed=_fixed_steps(rates, first.size),
        controlled=_controlled_steps(rates, first.size),
        outputs=generic.outputs,
        rates_in_time=generic.rates_in_time,
    )
