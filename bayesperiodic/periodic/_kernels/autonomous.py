"""Compiled batches of autonomous orbits: orbits of unknown frequency, continued from their anchors."""

from typing import TYPE_CHECKING

import numpy as np
from numba import types

from bayesperiodic._compile.functions import grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.newton import *

MAX_SECANTS, SECANT_RATE = 12, 0.5
ANCHOR = types.Tuple([VECTOR, MATRIX, NUMBER, CUBE, VECTOR])


@kernel(
    types.Tuple([FLAG, COUNT, NUMBER])(
        ADDRESSES, GRID, SETTING, MATRIX, PLACES, BORDER, NUMBER, MATRIX, MATRIX, MATRIX
    ),
    **OPTIONS,
)
def broyden(functions, grid, setting, band, pivots, border, target, z, states, change):
    """Improve z in place with the factors at an anchor; return whether it converged, the steps, and the frequency.

    Broyden's method ([1]_, without matrices [2]_): the steps so far correct a step with the anchor's factors. The
    uncorrected step must be less than `SECANT_RATE` times the step before. This way every direction in which the orbit
    is still to be improved has a stiffness of the same sign as at the anchor, and no fold is crossed.

    The setting has the predicted frequency; `band`, `pivots` and `border` are the bordered factors at the anchor;
    `target` is the value of the phase condition; `states` and `change` are work arrays.

    References
    ----------
    .. [1] C. G. Broyden, Mathematics of Computation 19 (1965) 577-593.
    .. [2] C. T. Kelley, Iterative Methods for Linear and Nonlinear Equations, SIAM, 1995, section 7.3.
    """
    residual, frequency, first = grid_function_at(functions.residual), setting.frequency, setting.frequency
    points, count = z.shape[0], z.shape[1]
    unit, right, below = np.empty(count), np.empty((1, z.size)), np.empty((1, 1))
    taken, squares, previous = np.empty((MAX_SECANTS, points * count + 1)), np.empty(MAX_SECANTS), np.inf
    largest(z, unit)
    for s in range(count):
        unit[s] = unit[s] if unit[s] > 0.0 else 1.0
    for iteration in range(MAX_SECANTS):
        differentiate(z, setting.drift, grid, frequency, states)
        residual(states, setting.inputs, setting.parameters, grid.tau, frequency, change)
        fold(change, grid, right[0])
        below[0, 0] = folded_product(z, border.rows[0], grid) - target
        solve_bordered(band, pivots, border, right, below)
        unfold(right[0], grid, change)
        step = taken[iteration]
        step[points * count] = -below[0, 0] / first
        for i in range(points):
            for s in range(count):
                step[i * count + s] = -change[i, s] / unit[s]
        if iteration > 0 and not dot(step, step) < SECANT_RATE**2 * squares[iteration - 1]:
            return False, iteration + 1, frequency
        for k in range(iteration):
            share = dot(taken[k], step) / squares[k]
            if k < iteration - 1:
                for i in range(step.size):
                    step[i] += share * taken[k + 1, i]
            else:
                for i in range(step.size):
                    step[i] /= 1.0 - share
        squares[iteration] = dot(step, step)
        full = 0.0
        for i in range(step.size):
            full = max(full, abs(step[i]))
        if not (full < OFF_ANCHOR and squares[iteration] > 0.0) or not frequency + step[points * count] * first > 0.0:
            return full == 0.0, iteration + 1, frequency
        for i in range(points):
            for s in range(count):
                z[i, s] += step[i * count + s] * unit[s]
        frequency += step[points * count] * first
        if full <= STEP_TOLERANCE or (iteration > 0 and full**2 <= STEP_TOLERANCE * previous):
            return True, iteration + 1, frequency
        previous = full
    return False, MAX_SECANTS, frequency


@inlined(NUMBER(NUMBER, VECTOR, VECTOR, VECTOR, NUMBER), **INNER)
def predicted_frequency(frequency, sensitivities, anchor_parameters, parameters, fraction):
    """Return the anchor's linear prediction of the frequency, or its own where that is not positive."""
    result = frequency
    for p in range(parameters.size):
        result += fraction * (parameters[p] - anchor_parameters[p]) * sensitivities[p]
    return result if result > 0.0 else frequency


@inlined(FLAG(MATRIX, MATRIX, MATRIX, NUMBER, NUMBER), **INNER)
def has_leapt(z, predicted, start, frequency, expected):
    """Return whether an orbit is not a continuation of `start`: unpredicted, shrunk, or of a shorter period."""
    if is_far(z, predicted, start) or abs(frequency - expected) > OFF_ANCHOR * expected:
        return True
    return has_shrunk(z, start) or has_shorter_period(z)


@kernel(
    types.Tuple([COUNT, COUNT, NUMBER])(ADDRESSES, GRID, SETTING, ANCHOR, NUMBER, BORDER, MATRIX, MATRIX, WORKSPACE),
    **INNER,
)
def continue_from_anchor(functions, grid, setting, anchor, orientation, border, z, history, work):
    """Follow an orbit from the anchor's parameters to those of the setting; return status, iterations and frequency.

    The first step is the whole way, from the linear prediction. A step that fails, or leaps, or crosses a fold is
    halved, and where one failed the next goes half of the remaining way, so that a fold is approached from both sides.
    If the steps become too small, the status is "other orbit".

    The anchor is its parameters, z, frequency, sensitivities and frequency_sensitivities; `orientation` is that of the
    bordered factors at the anchor, 0 if unknown. z (points, states) is filled; `border` and `history` are work arrays.
    """
    anchor_parameters, anchor_z, anchor_frequency, sensitivities, slopes = anchor
    (points, count), theta = anchor_z.shape, setting.parameters
    here, last, predicted = np.empty((points, count)), np.empty((points, count)), np.empty((points, count))
    between, done, step, before, failed, used = np.empty(theta.size), 0.0, 1.0, 1.0, np.inf, 0
    values, targets, scales = np.empty(1), np.empty(1), np.empty(1)
    unknowns = Unknowns(values, targets, scales, np.zeros((1, theta.size)), np.empty((1, 0, 0)), 0)
    copy(anchor_z, here)
    now = anchor_frequency
    predict(anchor_z, sensitivities, anchor_parameters, theta, -1.0, last)
    earlier = predicted_frequency(now, slopes, anchor_parameters, theta, -1.0)
    while done < 1.0:
        ratio = step / before
        for i in range(points):
            for s in range(count):
                predicted[i, s] = here[i, s] + ratio * (here[i, s] - last[i, s])
        for p in range(theta.size):
            between[p] = anchor_parameters[p] + (done + step) * (theta[p] - anchor_parameters[p])
        expected = now + ratio * (now - earlier)
        expected = expected if expected > 0.0 else now
        copy(predicted, z)
        differentiate(z, setting.drift, grid, expected, work.states)
        values[0], scales[0], targets[0] = expected, expected, phase_row(z, work.states, grid, border.rows[0])
        there = Setting(setting.inputs, between, expected, setting.drift)
        code, more, side = newton(functions, grid, there, unknowns, border, 1, z, history, work)
        frequency = values[0]
        used += more
        if code != CONVERGED or side * orientation < 0.0 or has_leapt(z, predicted, here, frequency, expected):
            if 0.5 * step < SMALLEST_PART:
                return OTHER_ORBIT if code == CONVERGED or code == STALLED else code, used, now
            failed, step = done + step, 0.5 * step
            continue
        copy(here, last)
        copy(z, here)
        earlier, now = now, frequency
        done, before = done + step, step
        if done >= failed:
            failed = np.inf
        step = min(2.0 * step, 1.0 - done)
        if done + step >= failed:
            step = 0.5 * (failed - done) if failed - done >= 2.0 * SMALLEST_PART else failed - done
    return CONVERGED, used, now


@kernel(types.void(ADDRESSES, GRID, SETS, CYCLE_ANCHORS, CUBE, COUNT, COUNT, FLAG, WORKSPACE, SOLUTION), **OPTIONS)
def follow_many(functions, grid, sets, orbits, parameters, start, stop, whole, work, solution):
    """Follow every orbit to its parameter vectors start … stop: by `broyden`, or else by `continue_from_anchor`.

    The results do not depend on the order of the solves. `sets` has the inputs at the anchors' frequencies;
    `parameters` is (sets, solves, parameters). If `whole`, a parameter vector needs all of its orbits: those after a
    lost one get its status without a solve. The solution's z is filled only if it has entries.
    """
    outputs, borders = grid_function_at(functions.outputs), orbits.border
    sets_count, points, count = orbits.z.shape
    size = points * count
    bordering = Border(
        np.empty((2, size)), np.empty((1, size)), np.zeros((1, 1)), np.empty((2, 4)), np.empty(2, dtype=np.int64)
    )
    history, change, inputs = np.empty((MOST_NEWTON_STEPS, 3)), np.empty((points, count)), np.empty_like(sets.inputs[0])
    predicted, z = np.empty((points, count)), np.empty((points, count))
    for b in range(start, stop):
        lost = CONVERGED
        for e in range(sets_count):
            theta, orientation = parameters[e, b], orbits.orientation[e]
            anchor = (
                orbits.parameters[e], orbits.z[e], orbits.frequency[e], orbits.sensitivities[e],
                orbits.frequency_sensitivities[e],
            )  # fmt: skip
            predict(anchor[1], anchor[3], anchor[0], theta, 1.0, predicted)
            expected = predicted_frequency(anchor[2], anchor[4], anchor[0], theta, 1.0)
            setting = Setting(sets.inputs[e], theta, expected, sets.drift[e])
            copy(predicted, z)
            close, used, f, code, wanted = False, 0, expected, lost, not (whole and lost != CONVERGED)
            if orientation != 0.0 and wanted:
                border = Border(
                    borders.columns[e], borders.rows[e], borders.corner[e], borders.small[e], borders.pivots[e]
                )
                close, used, f = broyden(
                    functions, grid, setting, orbits.band[e], orbits.pivots[e], border, orbits.target[e], z,
                    work.states, change,
                )  # fmt: skip
                close = close and not has_leapt(z, predicted, anchor[1], f, expected)
            if close:
                code = CONVERGED
            elif wanted:
                code, more, f = continue_from_anchor(
                    functions, grid, setting, anchor, orientation, bordering, z, history, work
                )
                used += more
            if code == CONVERGED and is_jagged(z, sets.inputs[e]):
                code = NOT_RESOLVED
            lost = max(lost, code)
            scale_rates(sets.inputs[e], f / anchor[2], inputs)
            differentiate(z, sets.drift[e], grid, f, work.states)
            outputs(work.states, inputs, theta, grid.tau, f, solution.outputs[e, b])
            if solution.z.size > 0:
                copy(z, solution.z[e, b])
            solution.frequency[e, b], solution.status[e, b], solution.iterations[e, b] = f, code, used
