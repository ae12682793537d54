"""Compiled batches of special points, folds and points of given phase: Broyden's method from their anchors."""

from typing import TYPE_CHECKING

import numpy as np
from numba import types

from bayesperiodic._compile.functions import grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.newton import *

# Steps, and those of them during which one may be longer than the one before.
MAX_POINT_STEPS, FREE_POINT_STEPS = 16, 3
SAFETY = 0.01  # of the prediction that the next step will be below the tolerance
BEND_STEP, LEAST_BEND = 1e-4, 0.2


@inlined(types.void(MATRIX, MATRIX, MATRIX), **INNER)
def multiply(columns, rates, result):
    """Fill `result` (points, states) with ∂g/∂(q, q̇, q̈) times changes `rates` (points, 3·states)."""
    count = result.shape[1]
    for i in range(result.shape[0]):
        for e in range(count):
            value = 0.0
            for s in range(3 * count):
                value += columns[i, count + e * 3 * count + s] * rates[i, s]
            result[i, e] = value


@inlined(types.void(MATRIX, VECTOR), **INNER)
def fill_units(z, unit):
    """Fill the largest values of the columns of z, 1 where they are zero."""
    largest(z, unit)
    for s in range(unit.size):
        unit[s] = unit[s] if unit[s] > 0.0 else 1.0


@inlined(NUMBER(ADDRESSES, GRID, SETTING, MATRIX, MATRIX, NUMBER, MATRIX, MATRIX, MATRIX, MATRIX), **INNER)
def add_bend(functions, grid, setting, z, vector, step, states, rates, columns, bend):
    """Add ∂g/∂z · vector at z + step·vector over twice the step to `bend`, given the rates of the vector."""
    moved, product = z + step * vector, np.empty_like(z)
    differentiate(moved, setting.drift, grid, setting.frequency, states)
    grid_function_at(functions.residual_jacobian)(
        states, setting.inputs, setting.parameters, grid.tau, setting.frequency, columns
    )
    multiply(columns, rates, product)
    for i in range(z.shape[0]):
        for s in range(z.shape[1]):
            bend[i, s] += product[i, s] / (2.0 * step)
    return step


@kernel(
    types.Tuple([FLAG, COUNT])(
        ADDRESSES,
        GRID,
        SETTING,
        UNKNOWNS,
        MATRIX,
        PLACES,
        BORDER,
        CUBE,
        MATRIX,
        MATRIX,
        MATRIX,
        NUMBER,
        MATRIX,
        MATRIX,
        VECTOR,
        MATRIX,
        VECTOR,
        MATRIX,
    ),
    **OPTIONS,
)
def broyden(
    functions, grid, setting, unknowns, band, pivots, border, rows, bends, bend, bent, curvature, z, vector, values,
    inputs, parameters, outputs,
):  # fmt: skip
    """Improve a special point in place with the factors at an anchor; return whether it converged, and the steps.

    Broyden's method, see `autonomous.broyden`, for all unknowns: z, the values, and at a fold the null vector v. A step
    is that of the equations linearised at the anchor. `bends` and `bend` are the derivatives of ∂g/∂(q, q̇, q̈) along v,
    laid out as `residual_jacobian`, and of ∂g/∂z · v by the value, `bent` and `curvature` those of v and of dλ/ds along
    the branch, all at the anchor, zero if it is no fold; `rows` and the unknowns' targets are the conditions on the
    outputs of other points. The last arguments are filled: inputs, parameters and outputs at the point.
    """
    residual_jacobian, residual = grid_function_at(functions.residual_jacobian), grid_function_at(functions.residual)
    observe = grid_function_at(functions.outputs)
    points, count, unknown = z.shape[0], z.shape[1], values.size
    size, is_fold = points * count, curvature != 0.0
    states, rates, change = np.empty((points, 3 * count)), np.empty((points, 3 * count)), np.empty((points, count))
    columns, still, unit, vector_unit = (
        np.empty((points, count * (1 + 3 * count))), np.zeros(count), np.empty(count), np.empty(count),
    )  # fmt: skip
    right, below = np.empty((1, size)), np.empty((1, unknown))
    product, across = np.empty((points, count)), np.empty((points, count))
    total = size + unknown + (size if is_fold else 0)
    taken, squares, first, previous = (
        np.empty((MAX_POINT_STEPS, total)),
        np.empty(MAX_POINT_STEPS),
        values.copy(),
        np.inf,
    )
    fill_units(z, unit)
    fill_units(vector, vector_unit)
    for iteration in range(MAX_POINT_STEPS):
        frequency = fill_setting(setting, unknowns, values, inputs, parameters)
        differentiate(z, setting.drift, grid, frequency, states)
        for k in range(unknown):
            below[0, k] = 0.0
        if is_fold:
            residual_jacobian(states, inputs, parameters, grid.tau, frequency, columns)
            for i in range(points):
                for s in range(count):
                    change[i, s] = columns[i, s]
        else:
            residual(states, inputs, parameters, grid.tau, frequency, change)
            observe(states, inputs, parameters, grid.tau, frequency, outputs)
            for k in range(unknown):
                below[0, k] = -unknowns.targets[k]
                for i in range(points):
                    for c in range(outputs.shape[1]):
                        below[0, k] += rows[k, i, c] * outputs[i, c]
        fold(change, grid, right[0])
        solve_bordered(band, pivots, border, right, below)
        unfold(right[0], grid, change)
        step = taken[iteration]
        for k in range(unknown):
            step[size + k] = -below[0, k] / first[k]
        share = 0.0
        if is_fold:
            differentiate(vector, still, grid, frequency, rates)
            multiply(columns, rates, product)
            differentiate(change, still, grid, frequency, rates)
            multiply(bends, rates, across)
            for i in range(points):
                for s in range(count):
                    product[i, s] -= across[i, s] + below[0, 0] * bend[i, s]
            fold(product, grid, right[0])
            below[0, 0] = 0.0
            solve_bordered(band, pivots, border, right, below)
            unfold(right[0], grid, product)
            share = below[0, 0] / curvature
            for i in range(points):
                for s in range(count):
                    step[size + unknown + i * count + s] = (share * bent[i, s] - product[i, s]) / vector_unit[s]
        for i in range(points):
            for s in range(count):
                step[i * count + s] = (share * vector[i, s] - change[i, s]) / unit[s]
        if iteration > FREE_POINT_STEPS and not dot(step, step) < squares[iteration - 1]:
            return False, iteration + 1
        for k in range(iteration):
            part = dot(taken[k], step) / squares[k]
            if k < iteration - 1:
                for i in range(total):
                    step[i] += part * taken[k + 1, i]
            else:
                for i in range(total):
                    step[i] /= 1.0 - part
        squares[iteration], full = dot(step, step), 0.0
        for i in range(total):
            full = max(full, abs(step[i]))
        if full == 0.0:
            observe(states, inputs, parameters, grid.tau, frequency, outputs)
            return True, iteration + 1
        if not (full < OFF_ANCHOR and squares[iteration] > 0.0):
            return False, iteration + 1
        for i in range(points):
            for s in range(count):
                z[i, s] += step[i * count + s] * unit[s]
                if is_fold:
                    vector[i, s] += step[size + unknown + i * count + s] * vector_unit[s]
        for k in range(unknown):
            values[k] += step[size + k] * first[k]
            if not values[k] > 0.0:
                return False, iteration + 1
        if full <= STEP_TOLERANCE or (iteration > 0 and full**2 <= SAFETY * STEP_TOLERANCE * previous):
            frequency = fill_setting(setting, unknowns, values, inputs, parameters)
            differentiate(z, setting.drift, grid, frequency, states)
            observe(states, inputs, parameters, grid.tau, frequency, outputs)
            return True, iteration + 1
        previous = full
    return False, MAX_POINT_STEPS


@inlined(NUMBER(ADDRESSES, GRID, SETTING, MATRIX, PLACES, BORDER, MATRIX, MATRIX), **INNER)
def bend_of(functions, grid, setting, band, pivots, border, z, vector):
    """Return d²λ/ds² at a fold z with null vector, as the factors at the anchor give it."""
    points, count = z.shape
    states, rates, bend = np.empty((points, 3 * count)), np.empty((points, 3 * count)), np.zeros((points, count))
    columns, still, ratio = np.empty((points, count * (1 + 3 * count))), np.zeros(count), 0.0
    unit, vector_unit = np.empty(count), np.empty(count)
    fill_units(z, unit)
    largest(vector, vector_unit)
    for s in range(count):
        ratio = max(ratio, vector_unit[s] / unit[s])
    differentiate(vector, still, grid, setting.frequency, rates)
    for side in range(2):
        step = (1.0 - 2.0 * side) * BEND_STEP / ratio
        add_bend(functions, grid, setting, z, vector, step, states, rates, columns, bend)
    right, below = np.empty((1, z.size)), np.zeros((1, 1))
    fold(bend, grid, right[0])
    solve_bordered(band, pivots, border, right, below)
    return -below[0, 0]


@kernel(types.void(ADDRESSES, GRID, SETS, SPECIAL_ANCHORS, COUNT, CUBE, COUNT, COUNT, SPECIAL_SOLUTION), **OPTIONS)
def reach_many(functions, grid, sets, anchors, frequency, parameters, start, stop, solution):
    """Solve for special points times parameter vectors, those of the flat indices start … stop (vectors run fastest).

    Each starts from the linear prediction of its anchor, and is improved by `broyden`. The status is "stalled" where
    that fails, leads far from the prediction, or to a fold whose curvature is not that of the anchor, by a factor of
    `LEAST_BEND`. The results do not depend on the order of the solves.

    `sets` has the inputs whose scales are no unknowns, `frequency` is the index of the frequency among the unknowns,
    or −1.
    """
    sets_count, points, count = anchors.z.shape
    solves, unknown, borders = parameters.shape[1], anchors.values.shape[1], anchors.border
    predicted, z, vector = np.empty((points, count)), np.empty((points, count)), np.empty((points, count))
    values, inputs, theta = np.empty(unknown), np.empty_like(sets.inputs[0]), np.empty(parameters.shape[2])
    none = np.zeros((unknown, parameters.shape[2]))
    for index in range(start, stop):
        e, b = index // solves, index % solves
        if anchors.known[e] == 0:
            solution.status[e, b] = STALLED
            continue
        at = parameters[e, b]
        setting = Setting(sets.inputs[e], at, sets.frequency[e], sets.drift[e])
        unknowns = Unknowns(values, anchors.targets[e], values, none, anchors.inputs[e], frequency)
        border = Border(borders.columns[e], borders.rows[e], borders.corner[e], borders.small[e], borders.pivots[e])
        predict(anchors.z[e], anchors.z_slopes[e], anchors.parameters[e], at, 1.0, predicted)
        predict(anchors.vectors[e], anchors.vector_slopes[e], anchors.parameters[e], at, 1.0, vector)
        copy(predicted, z)
        positive = True
        for k in range(unknown):
            values[k] = anchors.values[e, k]
            for p in range(at.size):
                values[k] += (at[p] - anchors.parameters[e, p]) * anchors.value_slopes[e, p, k]
            positive = positive and values[k] > 0.0
        curvature, close, used = anchors.curvature[e], False, 0
        if positive:
            close, used = broyden(
                functions, grid, setting, unknowns, anchors.band[e], anchors.pivots[e], border, anchors.rows[e],
                anchors.bends[e], anchors.bend[e],
                anchors.bent[e], curvature, z, vector, values, inputs, theta, solution.outputs[e, b],
            )  # fmt: skip
        close = close and not is_far(z, predicted, anchors.z[e])
        if close and curvature != 0.0:
            now = fill_setting(setting, unknowns, values, inputs, theta)
            there = Setting(inputs, theta, now, setting.drift)
            bend = bend_of(functions, grid, there, anchors.band[e], anchors.pivots[e], border, z, vector)
            close = bend / curvature > LEAST_BEND and bend / curvature < 1.0 / LEAST_BEND
        if close and is_jagged(z, inputs):
            solution.status[e, b] = NOT_RESOLVED
        else:
            solution.status[e, b] = CONVERGED if close else STALLED
        solution.iterations[e, b] = used
        copy(z, solution.z[e, b])
        for k in range(unknown):
            solution.values[e, b, k] = values[k]
