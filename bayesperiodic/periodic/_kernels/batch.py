"""Compiled batches of driven orbits: solves at many parameter vectors, predicted from the anchors of the input sets."""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, types

from bayesperiodic._compile.functions import as_vector, grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.newton import *

MAX_CHORDS = 6
PREDICTION_RATE = 30.0
LEAST_STIFFNESS, MOST_STIFFNESS = 0.3, 3.0
POLISHED = 1e-12
LARGEST_PART = 1.0 / 16.0


@inlined(NUMBER(VECTOR, VECTOR), **INNER)
def in_units(reached, amplitude):
    """Return the largest of the values of each state in units of its amplitude; zeros do not count."""
    result = 0.0
    for s in range(reached.size):
        if reached[s] > 0.0:
            result = max(result, reached[s] / amplitude[s])
    return result


@kernel(
    types.Tuple([FLAG, COUNT, NUMBER])(
        ADDRESSES, GRID, SETTING, VECTOR, NUMBER, NUMBER, FLAG, MATRIX, MATRIX, MATRIX, FACTORS, MATRIX, MATRIX
    ),
    **INNER,
)
def newton_chord(
    functions, grid, setting, amplitude, stiffness, predicted, polish, z, states, change, factors, left, right
):
    """Improve z in place with the factors of a nearby solution; return whether it converged, the steps, their length.

    `states` are left as they were before the last step. A step above `CHORD_RATE` times the one before ends it. The
    ratio of two steps predicts how much smaller the next one will be. The ratio of the first step to the prediction
    gives the order of magnitude, since the prediction is a chord step except for terms of second order:
    `PREDICTION_RATE` times it exceeded all but two of a hundred observed rates.

    Where ∂g/∂z is nearly singular, steps with the factors of another point are wrong in the direction that it makes
    smallest, and of the wrong sign where the stiffness in that direction has changed its sign. So this direction takes
    the stiffness expected of the present ∂g/∂z, and factors whose own stiffness differs too much are not used.

    Steps, and the change `predicted`, are in units of the amplitude. `stiffness` is that expected of the present ∂g/∂z
    in this direction, in units of that of the factors; `left` (points, states) the weights of the equations that are
    largest for a residual in this direction; `right` the direction, scaled to a stiffness of 1 for the ∂g/∂z of the
    factors. If `polish`, the steps go on until one is below `POLISHED` or at rounding level, for derivatives of the
    outputs. `states` and `change` are work arrays.
    """
    residual = grid_function_at(functions.residual)
    inputs, parameters, frequency, drift = setting
    count = STATES if STATES > 0 else z.shape[1]
    position, step, reached = as_vector(z), as_vector(change), np.empty(count)
    weights, direction = as_vector(left), as_vector(right)
    if not (stiffness > LEAST_STIFFNESS and stiffness < MOST_STIFFNESS):
        return False, 0, 0.0
    correction, tolerance = 1.0 / stiffness - 1.0, STEP_TOLERANCE * min(1.0, stiffness)
    previous, moved, rate, converged = predicted, 0.0, PREDICTION_RATE, False
    for iteration in range(MAX_CHORDS):
        differentiate(z, drift, grid, frequency, states)
        residual(states, inputs, parameters, grid.tau, frequency, change)
        along = correction * dot(weights, step) if correction != 0.0 else 0.0
        back_substitute(grid, factors, change)
        for k in range(step.size):
            step[k] += along * direction[k]
            position[k] -= step[k]
        if not dot(step, step) < np.inf:
            return False, iteration + 1, moved
        largest(change, reached)
        full = in_units(reached, amplitude)
        moved += full
        if converged and (full <= POLISHED or not full < CHORD_RATE * previous):
            return True, iteration + 1, moved
        if not full < OFF_ANCHOR or (iteration > 0 and not full < CHORD_RATE * previous):
            return False, iteration + 1, moved
        converged = converged or full <= tolerance or rate * full**2 <= tolerance * previous
        if converged and (full <= POLISHED or not polish):
            return True, iteration + 1, moved
        previous, rate = full, 1.0
    return converged, MAX_CHORDS, moved


@inlined(FLAG(MATRIX, COUNT), **INNER)
def was_damped(history, iterations):
    """Return whether the Newton iteration took a shortened step."""
    for iteration in range(iterations):
        if history[iteration, 2] < 1.0:
            return True
    return False


@kernel(
    types.Tuple([COUNT, COUNT])(
        ADDRESSES, GRID, COUNT, SETTING, UNKNOWNS, BORDER, VECTOR, MATRIX, CUBE, FLAG, MATRIX, MATRIX, WORKSPACE
    ),
    **INNER,
)
def continue_from_anchor(
    functions, grid, periods, setting, unknowns, border, anchor_parameters, anchor_z, sensitivities, leapt, z, history,
    work,
):  # fmt: skip
    """Follow an orbit from the anchor's parameters to those of the setting in small steps; return status, iterations.

    A step that fails, or leads too far, is halved. `leapt` is true if a solve has converged to another orbit before.
    """
    points, count = anchor_z.shape
    predicted, here, last = np.empty((points, count)), np.empty((points, count)), np.empty((points, count))
    once, used, done, step, before = repetitions(anchor_z, periods), 0, 0.0, LARGEST_PART, LARGEST_PART
    copy(anchor_z, here)
    predict(anchor_z, sensitivities, anchor_parameters, setting.parameters, -before, last)
    while done < 1.0:
        for i in range(points):
            for s in range(count):
                predicted[i, s] = here[i, s] + (here[i, s] - last[i, s]) * (step / before)
        copy(predicted, z)
        between = anchor_parameters + (setting.parameters - anchor_parameters) * (done + step)
        there = Setting(setting.inputs, between, setting.frequency, setting.drift)
        code, more, _ = newton(functions, grid, there, unknowns, border, HALVINGS, z, history, work)
        used += more
        if code == CONVERGED and repetitions(z, periods) > once:
            return OTHER_ORBIT, used
        if code != CONVERGED or is_far(z, predicted, here):
            step *= 0.5
            if step < SMALLEST_PART:
                return OTHER_ORBIT if leapt or code == CONVERGED else code, used
            continue
        copy(here, last)
        copy(z, here)
        done, before = done + step, step
        step = min(2.0 * step, LARGEST_PART, 1.0 - done)
    return CONVERGED, used


@kernel(types.void(ADDRESSES, GRID, COUNT, SETS, ANCHORS, CUBE, COUNT, COUNT, FLAG, FLAG, SOLUTION), **OPTIONS)
def solve_many(functions, grid, periods, sets, anchors, parameters, start, stop, polish, rates, solution):
    """Solve for input sets times parameter vectors, those of the flat indices start … stop (vectors run fastest).

    Each solve starts from the linear prediction of its set's anchor: chord steps with the anchor's factors, else
    the Newton iteration, else that from the anchor itself. Where all fail, or the result is far from the prediction of
    a solved anchor or of a shorter period than it, the orbit is followed in small steps from the anchor's parameters;
    if a step leaps, or the period becomes shorter, the status is "other orbit". The results do not depend on the order
    of the solves.

    `parameters` is (sets, solves, parameters); for `polish` see `newton_chord`; `rates` tells whether the outputs
    depend on q̇ or q̈. The solution is filled except for the frequency, z only if it has entries; solves whose status is
    not "converged" before are left out.
    """
    outputs = grid_function_at(functions.outputs)
    points, count = anchors.z.shape[1], STATES if STATES > 0 else anchors.z.shape[2]
    solves, kept, y, all_factors = parameters.shape[1], solution.z, solution.outputs, anchors.factors
    states, z = np.empty((points, 3 * count)), np.empty((points, count))
    predicted, change, reached = np.empty((points, count)), np.empty((points, count)), np.empty(count)
    columns, history = np.empty((points, count * (1 + 3 * count))), np.empty((MOST_NEWTON_STEPS, 3))
    bands, pivots, inverses, gains, transfers, ends, interfaces, interface_pivots = all_factors
    fresh = Factors(
        np.empty_like(bands[0]), np.empty_like(pivots[0]), np.empty_like(inverses[0]), np.empty_like(gains[0]),
        np.empty_like(transfers[0]), np.empty_like(ends[0]), np.empty_like(interfaces[0]),
        np.empty_like(interface_pivots[0]),
    )  # fmt: skip
    work = Workspace(states, columns, np.empty((0, 0)), fresh)
    nothing, table = np.empty(0), np.empty((0, 0))
    unknowns = Unknowns(nothing, nothing, nothing, table, np.empty((0, 0, 0)), -1)
    border = Border(table, table, table, table, np.empty(0, dtype=np.int64))
    for index in range(start, stop):
        e, b = index // solves, index % solves
        if solution.status[e, b] != CONVERGED:
            continue
        at, theta = anchors.z[e], parameters[e, b]
        setting = Setting(sets.inputs[e], theta, sets.frequency[e], sets.drift[e])
        sensitivities, anchor_parameters = anchors.sensitivities[e], anchors.parameters[e]
        predict(at, sensitivities, anchor_parameters, theta, 1.0, predicted)
        copy(predicted, z)
        known, close, used, code, doubtful, moved = ends[e, 0] != NO_FACTORS, False, 0, CONVERGED, False, np.inf
        if known:
            stiffness = 1.0
            for p in range(theta.size):
                stiffness += anchors.stiffness_gradient[e, p] * (theta[p] - anchor_parameters[p])
            for i in range(points):
                for s in range(count):
                    change[i, s] = predicted[i, s] - at[i, s]
            largest(change, reached)
            amplitude = anchors.amplitude[e]
            factors = Factors(
                bands[e], pivots[e], inverses[e], gains[e], transfers[e], ends[e], interfaces[e], interface_pivots[e]
            )
            close, used, moved = newton_chord(
                functions, grid, setting, amplitude, stiffness, in_units(reached, amplitude), polish, z, states,
                change, factors, anchors.left[e], anchors.right[e],
            )  # fmt: skip
        if not close:
            moved = np.inf
            copy(predicted, z)
            code, more, _ = newton(functions, grid, setting, unknowns, border, HALVINGS, z, history, work)
            used += more
            doubtful = was_damped(history, more)
            if code != CONVERGED:
                copy(at, z)
                code, more, _ = newton(functions, grid, setting, unknowns, border, HALVINGS, z, history, work)
                used += more
                doubtful = True
        once = repetitions(at, periods)
        far = moved > anchors.near[e] and is_far(z, predicted, at)
        if known and (doubtful or far or repetitions(z, periods) > once):
            code, more = continue_from_anchor(
                functions, grid, periods, setting, unknowns, border, anchor_parameters, at, sensitivities,
                code == CONVERGED, z, history, work,
            )  # fmt: skip
            used += more
        if code == CONVERGED and is_jagged(z, setting.inputs):
            code = NOT_RESOLVED
        if rates:
            differentiate(z, setting.drift, grid, setting.frequency, states)
        else:
            for i in range(points):
                for s in range(count):
                    states[i, s] = z[i, s] + setting.drift[s] * grid.tau[i]
        outputs(states, setting.inputs, theta, grid.tau, setting.frequency, y[e, b])
        if kept.size > 0:
            copy(z, kept[e, b])
        solution.status[e, b], solution.iterations[e, b] = code, used


@njit(inline="always")
def substitute_transposed(flat, pivots, below, reach, x):
    """Solve Aᵀ·x = b in place for one right-hand side (size,)."""
    size, one = np.uint64(x.size), np.uint64(1)
    next_row = below + reach
    inside, known, half = size - min(below, size), min(reach, size), reach // np.uint64(2)
    for i in range(known):
        diagonal = i * (next_row + one) + below
        value = x[i]
        for k in range(i):
            value -= flat[diagonal - (i - k) * next_row] * x[k]
        x[i] = value * flat[diagonal]
    for i in range(known, size):
        diagonal = i * (next_row + one) + below
        value, far = x[i], 0.0
        for k in range(half):
            far += flat[diagonal - (reach - k) * next_row] * x[i - (reach - k)]
        value -= far
        for k in range(half, reach):
            value -= flat[diagonal - (reach - k) * next_row] * x[i - (reach - k)]
        x[i] = value * flat[diagonal]
    for back in range(size):
        j = size - one - back
        diagonal = j * (next_row + one) + below
        value = x[j]
        if j < inside:
            for k in range(below):
                value -= flat[diagonal + (below - k) * next_row] * x[j + below - k]
        else:
            for k in range(back):
                value -= flat[diagonal + (back - k) * next_row] * x[j + back - k]
        pivot = np.uint64(pivots[j])
        x[j] = x[pivot]
        x[pivot] = value


@kernel(types.void(MATRIX, COUNT, COUNT, PLACES, MATRIX), **OPTIONS)
def solve_transposed(band, lower, upper, pivots, right):
    """Solve Aᵀ·x = b in place for right-hand sides (count, size), with the factors of `factor`."""
    flat = as_vector(band)
    for c in range(right.shape[0]):
        if LOWER > 0 and lower == LOWER and upper == LOWER:
            substitute_transposed(flat, pivots, np.uint64(LOWER), np.uint64(2 * LOWER), right[c])
        else:
            substitute_transposed(flat, pivots, np.uint64(lower), np.uint64(lower + upper), right[c])
