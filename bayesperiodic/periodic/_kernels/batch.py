"""Compiled batches of driven orbits: solves at many parameter vectors, predicted from the anchors of the input sets."""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, types

from bayesperiodic._compile.functions import as_vector, grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.newton import *

MAX_CHORDS = 6
PREDICTION_RATE = 30.0
LEAST_STIFFNESS, MOST_STIFFNESS = 0.3, 10.0
POLISHED = 1e-12
LARGEST_PART = 1.0 / 16.0
SECOND_DISTANCE = 1e-2
INVERSE_ITERATIONS = 3


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


@inlined(NUMBER(VECTOR, VECTOR), **INNER)
def in_units(reached, amplitude):
    """Return the largest of the values of each state in units of its amplitude; zeros do not count."""
    result = 0.0
    for s in range(reached.size):
        if reached[s] > 0.0:
            result = max(result, reached[s] / amplitude[s])
    return result


@inlined(NUMBER(MATRIX, MATRIX, VECTOR), fastmath={"reassoc"}, **INNER)
def weighted_dot(one, other, weights):
    """Return the sum of products with a weight for each state, in any order."""
    total = 0.0
    for i in range(one.shape[0]):
        for s in range(STATES if STATES > 0 else one.shape[1]):
            total += weights[s] * one[i, s] * other[i, s]
    return total


@kernel(
    types.Tuple([FLAG, COUNT, NUMBER])(
        ADDRESSES, GRID, SETTING, VECTOR, NUMBER, NUMBER, NUMBER, FLAG, MATRIX, MATRIX, MATRIX, CUBE, FACTORS, MATRIX,
        MATRIX,
    ),
    **INNER,
)  # fmt: skip
def newton_chord(
    functions, grid, setting, amplitude, stiffness, predicted, beyond, polish, z, states, change, taken, factors, left,
    right,
):  # fmt: skip
    """Improve z in place with the factors of a nearby solution; return whether it converged, the steps, their length.

    Steps are corrected by those before them, by Broyden's method (C. T. Kelley, Iterative Methods for Linear and
    Nonlinear Equations, SIAM 1995, chapter 7). A step above `CHORD_RATE` times the one before ends the iteration. The
    largest ratio of a step to the one before predicts how much smaller the next one will be. For the first step the
    ratio of the terms of second order to the linear ones gives the order of magnitude: `PREDICTION_RATE` times it
    exceeded all but two of a hundred observed rates. Those of the prediction are `beyond`; without them, the first step
    is as long.

    Where ∂g/∂z is nearly singular, steps with the factors of another point are wrong in the direction that it makes
    smallest, and of the wrong sign where the stiffness in that direction has changed its sign. So this direction takes
    the stiffness expected of the present ∂g/∂z, and factors whose own stiffness differs too much are not used.

    Steps, and the change `predicted`, are in units of the amplitude. `stiffness` is that expected of the present ∂g/∂z
    in this direction, in units of that of the factors; `left` (points, states) the weights of the equations that are
    largest for a residual in this direction; `right` the direction, scaled to a stiffness of 1 for the ∂g/∂z of the
    factors. If `polish`, the steps go on until one is below `POLISHED` or at rounding level, for derivatives of the
    outputs. `states`, `change` and `taken` (steps, points, states) are work arrays.
    """
    residual = grid_function_at(functions.residual)
    inputs, parameters, frequency, drift = setting
    count = STATES if STATES > 0 else z.shape[1]
    position, step, reached = as_vector(z), as_vector(change), np.empty(count)
    weights, direction = as_vector(left), as_vector(right)
    if not (stiffness > LEAST_STIFFNESS and stiffness < MOST_STIFFNESS):
        return False, 0, 0.0
    correction, tolerance = 1.0 / stiffness - 1.0, STEP_TOLERANCE * min(1.0, stiffness)
    previous, moved, rate, converged = predicted, 0.0, 0.0, False
    squares, scale = np.empty(MAX_CHORDS), np.empty(count)
    for s in range(count):
        scale[s] = 1.0 / amplitude[s] ** 2 if amplitude[s] > 0.0 else 0.0
    for iteration in range(MAX_CHORDS):
        differentiate(z, drift, grid, frequency, states)
        residual(states, inputs, parameters, grid.tau, frequency, change)
        along = correction * dot(weights, step) if correction != 0.0 else 0.0
        back_substitute(grid, factors, change)
        for k in range(step.size):
            step[k] = -(step[k] + along * direction[k])
        for k in range(iteration):
            part = weighted_dot(taken[k], change, scale) / squares[k]
            if k < iteration - 1:
                later = as_vector(taken[k + 1])
                for j in range(step.size):
                    step[j] += part * later[j]
            else:
                for j in range(step.size):
                    step[j] /= 1.0 - part
        squares[iteration] = weighted_dot(change, change, scale)
        copy(change, taken[iteration])
        for k in range(step.size):
            position[k] += step[k]
        if not dot(step, step) < np.inf:
            return False, iteration + 1, moved
        largest(change, reached)
        full = in_units(reached, amplitude)
        moved += full
        if converged and (full <= POLISHED or not full < CHORD_RATE * previous):
            return True, iteration + 1, moved
        if not full < OFF_ANCHOR or (iteration > 0 and not full < CHORD_RATE * previous):
            return False, iteration + 1, moved
        ratio = full / previous
        if iteration > 0:
            rate = max(rate, ratio)
        else:
            ratio = PREDICTION_RATE * max(full, beyond) / predicted
        converged = converged or full <= tolerance or max(rate, ratio) * full <= tolerance
        if converged and (full <= POLISHED or not polish):
            return True, iteration + 1, moved
        previous = full
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


@inlined(types.void(CUBE, PLACES, VECTOR, VECTOR, MATRIX), **INNER)
def fill_second_order(curvature, moving, anchor_parameters, parameters, second):
    """Fill the terms of second order of the prediction."""
    flat, row = as_vector(second), 0
    second[:] = 0.0
    for i in range(moving.size):
        for j in range(i, moving.size):
            p, q = moving[i], moving[j]
            factor = (parameters[p] - anchor_parameters[p]) * (parameters[q] - anchor_parameters[q])
            if factor != 0.0:
                terms = as_vector(curvature[row])
                for k in range(flat.size):
                    flat[k] += factor * terms[k]
            row += 1


@inlined(types.void(NUMBER, NUMBER, NUMBER, MATRIX, MATRIX, MATRIX), **INNER)
def add_higher_orders(change_of_stiffness, stiffness, along, right, second, predicted):
    """Add to a linear prediction its terms of second order, and those of all orders that a near fold makes large.

    In the direction in which ∂g/∂z is smallest the equation is x + κ x²/(2 x₁) = x₁ but for other terms of second
    order, κ being the relative change of stiffness expected linearly and x₁ the linear prediction; the stiffness at its
    solution x = 2 x₁/(1 + √(1 + 2κ)) is √(1 + 2κ). The terms of second order are those at x in place of x₁, since this
    direction contributes most of them.
    """
    ratio = 2.0 / (1.0 + stiffness)
    part = along * (ratio - 1.0 + 0.5 * change_of_stiffness * ratio**2)
    flat, more, direction = as_vector(predicted), as_vector(second), as_vector(right)
    for k in range(flat.size):
        flat[k] += ratio**2 * more[k] + part * direction[k]


@inlined(COUNT(COUNT, COUNT), **INNER)
def diagonal_row(i, size):
    """Return the row of the coefficient of a parameter's square."""
    return i * size - i * (i - 1) // 2


@inlined(types.void(ADDRESSES, GRID, SETS, ANCHORS, COUNT, VECTOR, VECTOR, NUMBER, MATRIX, MATRIX, MATRIX), **INNER)
def residual_beside(functions, grid, sets, anchors, e, theta, before, distance, z, states, value):
    """Fill the residual at other parameters, at the linear prediction and a distance from it along `right`."""
    residual = grid_function_at(functions.residual)
    predict(anchors.z[e], anchors.sensitivities[e], before, theta, 1.0, z)
    if distance != 0.0:
        position, direction = as_vector(z), as_vector(anchors.right[e])
        for k in range(position.size):
            position[k] += distance * direction[k]
    differentiate(z, sets.drift[e], grid, sets.frequency[e], states)
    residual(states, sets.inputs[e], theta, grid.tau, sets.frequency[e], value)


@inlined(types.void(MATRIX, PLACES, GRID, MATRIX, FLAG, MATRIX), **INNER)
def solve_by_band(band, pivots, grid, folded, transposed, right):
    """Solve ∂g/∂z·x = b, or that of its transpose, in place, b (points, states), with the factors of the whole band."""
    lower = grid.half_width * right.shape[1] + right.shape[1] - 1
    fold(right, grid, folded[0])
    if transposed:
        solve_transposed(band, lower, lower, pivots, folded)
    else:
        solve(band, lower, lower, pivots, folded)
    unfold(folded[0], grid, right)


@kernel(FLAG(ADDRESSES, GRID, SETS, ANCHORS, COUNT, MATRIX, FACTORS), **INNER)
def prepare_anchor(functions, grid, sets, anchors, e, start, factors):
    """Fill an anchor's factors and the direction in which they are nearly singular; return False if there are none.

    `right` and `left` are approximate singular vectors of the smallest singular value of ∂g/∂z by inverse iteration
    from `start` (points, states), states in units of their largest values, equations in those of their largest terms.
    The left vector is over the equations; the right one is scaled so that left · (∂g/∂z) · right is 1.
    """
    residual_jacobian = grid_function_at(functions.residual_jacobian)
    z, left, right, amplitude = anchors.z[e], anchors.left[e], anchors.right[e], anchors.amplitude[e]
    frequency = sets.frequency[e]
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    states, columns = np.empty((points, 3 * count)), np.empty((points, count * (1 + 3 * count)))
    units, terms, rounding, weight = np.empty(count), np.empty(count), np.empty(count), np.empty((count, count))
    band, pivots, folded = np.empty_like(factors.band), np.empty_like(factors.pivots), np.empty((1, points * count))
    differentiate(z, sets.drift[e], grid, frequency, states)
    residual_jacobian(states, sets.inputs[e], anchors.parameters[e], grid.tau, frequency, columns)
    for s in range(count):
        units[s] = amplitude[s] if amplitude[s] > 0.0 else 1.0
    if not factorise(columns, grid, frequency, units, factors):
        return False
    lower = grid.half_width * count + count - 1
    assemble(columns, grid, count, frequency, band)
    if not factor(band, lower, lower, pivots):
        return False
    scales(columns, states, grid, amplitude, frequency, terms, rounding, weight)
    for s in range(count):
        terms[s] = terms[s] if terms[s] > 0.0 else 1.0
        for i in range(points):
            right[i, s] = amplitude[s] * start[i, s]  # states at rest remain there
    length = 0.0
    for _ in range(INVERSE_ITERATIONS):
        for i in range(points):
            for s in range(count):
                left[i, s] = right[i, s] / units[s] ** 2
        solve_by_band(band, pivots, grid, folded, True, left)
        length = 0.0
        for i in range(points):
            for s in range(count):
                left[i, s] *= terms[s]
                length += left[i, s] ** 2
        length = np.sqrt(length)
        for i in range(points):
            for s in range(count):
                left[i, s] *= terms[s] / length
                right[i, s] = left[i, s]
        solve_by_band(band, pivots, grid, folded, False, right)
        length = 0.0
        for i in range(points):
            for s in range(count):
                length += (right[i, s] / units[s]) ** 2
        length = np.sqrt(length)
        for i in range(points):
            for s in range(count):
                right[i, s] /= length
    total = 0.0
    for i in range(points):
        for s in range(count):
            left[i, s] *= length / terms[s] ** 2
            total += (right[i, s] / units[s]) ** 2
    for p in range(anchors.along.shape[1]):
        anchors.along[e, p] = 0.0
        for i in range(points):
            for s in range(count):
                anchors.along[e, p] += anchors.sensitivities[e, p, i, s] * right[i, s] / units[s] ** 2 / total
    return dot(as_vector(left), as_vector(left)) + total < np.inf


@kernel(types.void(ADDRESSES, GRID, SETS, ANCHORS, MATRIX), **OPTIONS)
def prepare(functions, grid, sets, anchors, start):
    """Fill what solves need: see `prepare_anchor`; and the changes of stiffness, and coefficients of second order.

    The latter are by central differences of the equations along the linear prediction: the derivatives of the stiffness
    left · (∂g/∂z) · right by each parameter, and second derivatives of the equations by a parameter, or the sum of two,
    which are balanced by a change of z. The differences change z by `SECOND_DISTANCE` of the amplitude, a parameter by
    no more than this fraction of itself. Where they are not finite, there are no factors, and no second order.
    """
    moving, total = anchors.moving, anchors.parameters.shape[1]
    points, count = anchors.z.shape[1], STATES if STATES > 0 else anchors.z.shape[2]
    states, z, value = np.empty((points, 3 * count)), np.empty((points, count)), np.empty((points, count))
    small, reached = np.empty(total), np.empty(count)
    bands, pivots, inverses, gains, transfers, ends, interfaces, interface_pivots = anchors.factors
    for e in range(anchors.z.shape[0]):
        curvature, before, gradient = anchors.curvature[e], anchors.parameters[e], anchors.stiffness_gradient[e]
        curvature[:] = 0.0
        gradient[:] = 0.0
        if ends[e, 0] == NO_FACTORS:
            continue
        factors = Factors(
            bands[e], pivots[e], inverses[e], gains[e], transfers[e], ends[e], interfaces[e], interface_pivots[e]
        )
        if not prepare_anchor(functions, grid, sets, anchors, e, start, factors):
            ends[e, 0] = NO_FACTORS
            continue
        for p in range(total):
            largest(anchors.sensitivities[e, p], reached)
            reach, parameter = in_units(reached, anchors.amplitude[e]), abs(before[p])
            small[p] = SECOND_DISTANCE / reach if reach > 0.0 else 0.0
            if parameter > 0.0:
                small[p] = min(small[p], SECOND_DISTANCE * parameter)
        largest(anchors.right[e], reached)
        aside = SECOND_DISTANCE / in_units(reached, anchors.amplitude[e])
        for p in range(total):
            if not small[p] > 0.0:
                continue
            for side in (-1.0, 1.0):
                theta = before.copy()
                theta[p] += side * small[p]
                for to in (-1.0, 1.0):
                    residual_beside(functions, grid, sets, anchors, e, theta, before, to * aside, z, states, value)
                    gradient[p] += side * to * dot(as_vector(anchors.left[e]), as_vector(value))
            gradient[p] /= 4.0 * small[p] * aside
        if not dot(gradient, gradient) < np.inf:
            gradient[:] = 0.0
            ends[e, 0] = NO_FACTORS
            continue
        finite, row = True, 0
        for i in range(moving.size):
            for j in range(i, moving.size):
                terms, p, q = curvature[row], moving[i], moving[j]
                row += 1
                if not (small[p] > 0.0 and small[q] > 0.0):
                    continue
                for side in (-1.0, 0.0, 1.0):
                    theta = before.copy()
                    theta[p] += side * small[p]
                    if j > i:
                        theta[q] += side * small[q]
                    residual_beside(functions, grid, sets, anchors, e, theta, before, 0.0, z, states, value)
                    for k in range(points):
                        for s in range(count):
                            terms[k, s] -= value[k, s] if side != 0.0 else -2.0 * value[k, s]
                back_substitute(grid, factors, terms)
                finite = finite and dot(as_vector(terms), as_vector(terms)) < np.inf
        row = 0
        for i in range(moving.size):
            for j in range(i, moving.size):
                if j > i:
                    first, last = diagonal_row(i, moving.size), diagonal_row(j, moving.size)
                    for k in range(points):
                        for s in range(count):
                            curvature[row, k, s] -= curvature[first, k, s] + curvature[last, k, s]
                row += 1
        row = 0
        for i in range(moving.size):
            for j in range(i, moving.size):
                product = small[moving[i]] * small[moving[j]]
                scale = 0.5 / product if finite and product > 0.0 else 0.0
                for k in range(points):
                    for s in range(count):
                        curvature[row, k, s] = scale * curvature[row, k, s] if scale > 0.0 else 0.0
                row += 1


@kernel(types.void(ADDRESSES, GRID, SETS, MATRIX, CUBE, PLACES, GAINS, GAINS, PLACES), **OPTIONS)
def respond_many(functions, grid, sets, parameters, z, moving, z_changes, output_changes, regular):
    """Fill the derivatives of z and of the outputs by the parameters `moving`, at one solution of each input set.

    `z_changes` is (sets, moving, points, states), `output_changes` (sets, moving, points, channels), `regular` (sets,)
    is zero where ∂g/∂z is singular.
    """
    residual_jacobian = grid_function_at(functions.residual_jacobian)
    derivatives = grid_function_at(functions.derivatives)
    points, count = z.shape[1], STATES if STATES > 0 else z.shape[2]
    total, channels = parameters.shape[1], output_changes.shape[3]
    lower, size = grid.half_width * count + count - 1, points * count
    states, columns = np.empty((points, 3 * count)), np.empty((points, count * (1 + 3 * count)))
    of_inputs = sets.inputs.shape[2] + 1  # with the frequency
    by_states = count * (total + of_inputs)
    by_parameters = by_states + channels * 3 * count
    table = np.empty((points, by_parameters + channels * (total + of_inputs)))
    band, pivots = np.empty((size, 3 * lower + 1)), np.empty(size, dtype=np.int64)
    folded, still = np.empty((1, size)), np.zeros(count)
    for e in range(z.shape[0]):
        frequency = sets.frequency[e]
        differentiate(z[e], sets.drift[e], grid, frequency, states)
        residual_jacobian(states, sets.inputs[e], parameters[e], grid.tau, frequency, columns)
        derivatives(states, sets.inputs[e], parameters[e], grid.tau, frequency, table)
        assemble(columns, grid, count, frequency, band)
        regular[e] = 1 if factor(band, lower, lower, pivots) else 0
        if regular[e] == 0:
            continue
        for m in range(moving.size):
            change, moved = z_changes[e, m], output_changes[e, m]
            for i in range(points):
                for s in range(count):
                    change[i, s] = -table[i, s * total + moving[m]]
            solve_by_band(band, pivots, grid, folded, False, change)
            differentiate(change, still, grid, frequency, states)
            for i in range(points):
                for c in range(channels):
                    value = table[i, by_parameters + c * total + moving[m]]
                    for k in range(3 * count):
                        value += table[i, by_states + c * 3 * count + k] * states[i, k]
                    moved[i, c] = value


@kernel(types.void(ADDRESSES, GRID, COUNT, SETS, ANCHORS, CUBE, COUNT, COUNT, FLAG, FLAG, SOLUTION), **OPTIONS)
def solve_many(functions, grid, periods, sets, anchors, parameters, start, stop, polish, rates, solution):
    """Solve for input sets times parameter vectors, those of the flat indices start … stop (vectors run fastest).

    Each solve starts from the prediction of its set's anchor, which is linear beyond a fold: chord steps with the
    anchor's factors, else the Newton iteration, else that from the anchor itself. Where all fail, or the result is far
    from the prediction of a solved anchor or of a shorter period than it, the orbit is followed in small steps from the
    anchor's parameters; if a step leaps, or the period becomes shorter, the status is "other orbit". The results do not
    depend on the order of the solves.

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
    taken, second = np.empty((MAX_CHORDS, points, count)), np.empty((points, count))
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
            amplitude, change_of_stiffness, along = anchors.amplitude[e], 0.0, 0.0
            for p in range(theta.size):
                change_of_stiffness += anchors.stiffness_gradient[e, p] * (theta[p] - anchor_parameters[p])
                along += anchors.along[e, p] * (theta[p] - anchor_parameters[p])
            for i in range(points):
                for s in range(count):
                    change[i, s] = predicted[i, s] - at[i, s]
            largest(change, reached)
            linear, beyond = in_units(reached, amplitude), 0.0
            fill_second_order(anchors.curvature[e], anchors.moving, anchor_parameters, theta, second)
            stiffness = np.sqrt(max(1.0 + 2.0 * change_of_stiffness, 0.0))
            if stiffness > LEAST_STIFFNESS:
                add_higher_orders(change_of_stiffness, stiffness, along, anchors.right[e], second, predicted)
                for i in range(points):
                    for s in range(count):
                        change[i, s] = predicted[i, s] - z[i, s]
                largest(change, reached)
                beyond = in_units(reached, amplitude)
                copy(predicted, z)
            factors = Factors(
                bands[e], pivots[e], inverses[e], gains[e], transfers[e], ends[e], interfaces[e], interface_pivots[e]
            )
            close, used, moved = newton_chord(
                functions, grid, setting, amplitude, stiffness, linear, beyond, polish, z, states, change, taken,
                factors, anchors.left[e], anchors.right[e],
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
