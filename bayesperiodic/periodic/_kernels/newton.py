"""Compiled Newton iteration, with the discretisation, residual norms, and predictions from anchors.

The iteration is that of de Kraker, Verbeek & van de Wouw (1997), eq. (3): damped, with step halving. Further unknowns
(the frequency of an autonomous model, the parameter of a continuation) border the linear systems. A failed solve is a
status, not an exception.

The source is compiled with and without further unknowns (`BORDERED`); without, in half the time.
"""

from typing import TYPE_CHECKING

import numpy as np
from numba import types

from bayesperiodic._compile.functions import as_vector, grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.border import *

BORDERED = globals().get("BORDERED", True)
CHORD_RATE = 0.2
ROUNDING_LEVEL = 4.0 * np.finfo(float).eps
SCALE_POINTS = 200
LAST_STEP, MAX_ROUNDED = 1e-6, 3  # largest step that ends the iteration at a residual at rounding level; trials of it
UNDETERMINED, RESTING = 0.1, 1e-8  # see `ending` and `find_resting`
JAGGED, ALTERNATING, ROUGHNESS = 0.01, 0.9, 0.01  # see `is_jagged`
OFF_ANCHOR = 0.3
SMALLEST_PART = 1.0 / 256.0  # smallest step of a continuation from an anchor


@kernel(types.void(MATRIX, VECTOR, GRID, NUMBER, MATRIX), **OPTIONS)
def differentiate(z, drift, grid, frequency, states):
    """Fill `states` (points, 3·states) with q = z + drift·tau and its time derivatives by the scheme."""
    first, second, neighbours, tau = grid.first, grid.second, grid.neighbours, grid.tau
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    # Offsets are consecutive where their number is known, the lowest first; in the middle no neighbour is cyclic.
    start, inside = ((points - neighbours[0, 0]) % points, points - WIDTH + 1) if WIDTH > 0 else (0, 0)
    squared, all_states = frequency**2, np.uint64(count)
    flat, rest = as_vector(z), tau[start:]
    here, out = flat[start * count :], as_vector(states)[3 * start * count :]
    for k in range(np.uint64(inside)):
        for j in range(count):
            s, rate, acceleration = np.uint64(j), 0.0, 0.0
            for o in range(WIDTH):
                value = flat[(k + np.uint64(o)) * all_states + s]
                rate += first[o] * value
                acceleration += second[o] * value
            row = np.uint64(3) * all_states * k + s
            out[row] = here[all_states * k + s] + drift[s] * rest[k]
            out[row + all_states] = (rate + drift[s]) * frequency
            out[row + all_states + all_states] = acceleration * squared
    for k in range(points - inside):
        i = k if k < start else k + inside
        for s in range(count):
            rate, acceleration = 0.0, 0.0
            for o in range(first.size):
                value = z[neighbours[i, o], s]
                rate += first[o] * value
                acceleration += second[o] * value
            states[i, s] = z[i, s] + drift[s] * tau[i]
            states[i, count + s] = (rate + drift[s]) * frequency
            states[i, 2 * count + s] = acceleration * squared


@kernel(types.void(MATRIX, MATRIX, GRID, VECTOR, NUMBER, VECTOR, VECTOR, MATRIX), **OPTIONS)
def scales(columns, states, grid, amplitude, frequency, size, rounding, weight):
    """Fill, for each equation, the size of its terms and the rounding error that its residual cannot fall below.

    `weight` (equations, states) is filled with the largest change of an equation for a unit change of a state. About
    `SCALE_POINTS` points are used, all of them if the terms of an equation vanish there.
    """
    first, second = grid.first, grid.second
    points, count = states.shape[0], STATES if STATES > 0 else amplitude.size
    one, two = 0.0, 0.0
    for o in range(first.size):
        one += abs(first[o]) * frequency
        two += abs(second[o]) * frequency**2
    for e in range(count):
        start = count + e * 3 * count
        size[e], rounding[e], stride = 0.0, 0.0, max(1, points // SCALE_POINTS)
        weight[e] = 0.0
        while stride > 0:
            for i in range(0, points, stride):
                terms, error = 0.0, 0.0
                for s in range(count):
                    stiffness = abs(columns[i, start + s])
                    damping = abs(columns[i, start + count + s])
                    inertia = abs(columns[i, start + 2 * count + s])
                    terms += stiffness * abs(states[i, s]) + damping * abs(states[i, count + s])
                    terms += inertia * abs(states[i, 2 * count + s])
                    total = stiffness + damping * one + inertia * two
                    weight[e, s] = max(weight[e, s], total)
                    error += amplitude[s] * total
                size[e] = max(size[e], terms, abs(columns[i, e]))
                rounding[e] = max(rounding[e], error)
            stride = 1 if stride > 1 and size[e] == 0.0 else 0
        rounding[e] *= ROUNDING_LEVEL


@inlined(types.void(MATRIX, VECTOR), **INNER)
def largest(z, amplitude):
    """Fill the largest absolute value of each state; four independent maxima at a time."""
    points = z.shape[0]
    whole = points - points % 4
    for s in range(STATES if STATES > 0 else z.shape[1]):
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for i in range(0, whole, 4):
            a, b = max(a, abs(z[i, s])), max(b, abs(z[i + 1, s]))
            c, d = max(c, abs(z[i + 2, s])), max(d, abs(z[i + 3, s]))
        for i in range(whole, points):
            a = max(a, abs(z[i, s]))
        amplitude[s] = max(a, b, c, d)


@inlined(NUMBER(VECTOR, VECTOR), fastmath={"reassoc"}, **INNER)
def dot(one, other):
    """Return the sum of products, in any order."""
    total = 0.0
    for i in range(one.size):
        total += one[i] * other[i]
    return total


@inlined(NUMBER(MATRIX, VECTOR), **INNER)
def norm(columns, size):
    """Return the root of the mean square of the residuals, each in units of its equation's size.

    A residual that is not zero in an equation of size zero makes it infinite; one that is NaN makes it NaN.
    """
    count, total = STATES if STATES > 0 else size.size, 0.0
    for e in range(count):
        square = 0.0
        for i in range(columns.shape[0]):
            square += columns[i, e] ** 2
        if square != 0.0:
            total += square / size[e] ** 2
    return np.sqrt(total / (columns.shape[0] * count))


@inlined(types.void(VECTOR, VECTOR, VECTOR, MATRIX, types.boolean[::1]), **INNER)
def find_resting(amplitude, moved, size, weight, resting):
    """Mark the states that change no equation noticeably, neither by their values nor by their step.

    They are at rest up to rounding, as the middle of a symmetric chain whose ends move oppositely.
    """
    for s in range(amplitude.size):
        resting[s] = True
        for e in range(size.size):
            if not weight[e, s] * max(amplitude[s], moved[s]) <= RESTING * size[e]:
                resting[s] = False


@inlined(NUMBER(MATRIX, MATRIX, types.boolean[::1]), **INNER)
def scaled_step(z, step, resting):
    """Return the largest step of any moving state in units of its largest value; infinite if not finite."""
    result = 0.0
    for s in range(STATES if STATES > 0 else z.shape[1]):
        moved, reached = 0.0, 0.0
        for i in range(z.shape[0]):
            change = abs(step[i, s])
            if not change < np.inf:
                return np.inf
            moved = max(moved, change)
            reached = max(reached, abs(z[i, s]), abs(z[i, s] + step[i, s]))
        if moved > 0.0 and not resting[s]:
            result = max(result, moved / reached)
    return result


@kernel(COUNT(GRID, FACTORS, VECTOR, VECTOR, types.boolean[::1], MATRIX, MATRIX), **INNER)
def ending(grid, factors, rounding, reached, resting, z, change):
    """Set the states at rest to zero, and return the status of a settled iteration: "singular" if undetermined.

    Constant residuals at rounding level then change a state by more than `UNDETERMINED` of its size: the restoring
    forces are too small to hold it, as where exp(x) is the only one and x tends to −∞. `change` (points, states) is
    overwritten.
    """
    for s in range(rounding.size):
        if resting[s]:
            z[:, s] = 0.0
    if BORDERED:
        return CONVERGED
    for e in range(rounding.size):
        change[:] = 0.0
        change[:, e] = rounding[e]
        back_substitute(grid, factors, change)
        for i in range(change.shape[0]):
            for s in range(rounding.size):
                if not (resting[s] or abs(change[i, s]) <= UNDETERMINED * reached[s]):
                    return SINGULAR
    return CONVERGED


@kernel(
    types.Tuple([COUNT, COUNT, NUMBER])(ADDRESSES, GRID, SETTING, UNKNOWNS, BORDER, COUNT, MATRIX, MATRIX, WORKSPACE),
    **OPTIONS,
)
def newton(functions, grid, setting, unknowns, border, halvings, z, history, work):
    """Solve g(z, values) = 0 and the conditions of the unknowns in place; return status, iterations and orientation.

    An iteration ends the search when its step, or the next step expected from the observed rate, is below
    `STEP_TOLERANCE`, or when the residual is at rounding level and the next step would be below `LAST_STEP` of the
    largest values so far, which for a state of rest is the guess. If it is not at `MAX_ROUNDED` iterates in a row,
    rounding hides whether there is a solution, and the status is "singular", as for a solution that is undetermined.
    The orientation is the sign of the determinant of the bordered matrix at the last but one iterate, 0 without a
    border.

    The setting holds the arguments where the unknowns are zero, except for the frequency. The values of the unknowns
    are overwritten; there are none unless `BORDERED`, and ∂g/∂z must then be regular. The border holds the rows and the
    corner of the conditions. An iteration takes at most `halvings` trial steps, each half as long as the one before.
    `history` is filled for each iteration with the scaled residual before it, the scaled full step, and the damping
    factor. The states and columns of `work` are left at the last iterate, the factors at the last but one.
    """
    residual_jacobian, drift, factors = grid_function_at(functions.residual_jacobian), setting.drift, work.factors
    states, columns, tau = work.states, work.columns, grid.tau
    points, count, borders = z.shape[0], STATES if STATES > 0 else z.shape[1], unknowns.values.size
    size, rounding, amplitude, weight = np.empty(count), np.empty(count), np.empty(count), np.empty((count, count))
    step, trial = np.empty((points, count)), np.empty((points, count))
    inputs, parameters, frequency = setting.inputs, setting.parameters, setting.frequency
    values, change, orientation = np.empty(borders), np.empty(borders), 0.0
    if BORDERED:
        inputs, parameters = np.empty_like(inputs), np.empty_like(parameters)
        frequency = fill_setting(setting, unknowns, unknowns.values, inputs, parameters)
    differentiate(z, drift, grid, frequency, states)
    residual_jacobian(states, inputs, parameters, tau, frequency, columns)
    previous, rounded, moved, reached = np.inf, 0, np.empty(count), np.empty(count)
    unit, resting, settled = np.empty(count), np.empty(count, dtype=np.bool_), not BORDERED
    for s in range(count):
        reached[s] = 0.0
    for iteration in range(MOST_NEWTON_STEPS):
        largest(z, amplitude)
        scales(columns, states, grid, amplitude, frequency, size, rounding, weight)
        before = norm(columns, size)
        if not np.isfinite(before):
            return NOT_FINITE, iteration, orientation
        settled = settled and norm(columns, rounding) <= 1.0
        for s in range(count):
            reached[s] = max(reached[s], amplitude[s])
            unit[s] = amplitude[s] if amplitude[s] > 0.0 else 1.0
            settled = settled and amplitude[s] > 0.0
        if settled:
            rounded, settled = 1, False
        for i in range(points):
            for s in range(count):
                step[i, s] = -columns[i, s]
        full = 0.0
        if BORDERED:
            here = Setting(inputs, parameters, frequency, drift)
            full, orientation = bordered_step(
                functions, grid, here, unknowns, border, states, columns, z, step, work, change
            )
            if orientation == 0.0:
                return SINGULAR, iteration, orientation
        else:
            if not factorise(columns, grid, frequency, unit, factors):
                return SINGULAR, iteration, orientation
            back_substitute(grid, factors, step)
        largest(step, moved)
        find_resting(amplitude, moved, size, weight, resting)
        settling = full
        full = max(full, scaled_step(z, step, resting))
        if full == np.inf:
            return SINGULAR, iteration, orientation
        if rounded > 0:
            for s in range(count):
                if moved[s] > 0.0 and not resting[s]:
                    settling = max(settling, moved[s] / reached[s])
            if settling <= LAST_STEP:
                return ending(grid, factors, rounding, reached, resting, z, step), iteration, orientation
        if rounded == MAX_ROUNDED:
            return SINGULAR, iteration, orientation
        history[iteration, 0], history[iteration, 1] = before, full
        damping, accepted = 1.0, False
        for _ in range(halvings):
            for i in range(points):
                for s in range(count):
                    trial[i, s] = z[i, s] + damping * step[i, s]
            for k in range(borders):
                values[k] = unknowns.values[k] + damping * change[k]
            if not BORDERED or unknowns.frequency < 0 or values[unknowns.frequency] > 0.0:
                if BORDERED:
                    frequency = fill_setting(setting, unknowns, values, inputs, parameters)
                differentiate(trial, drift, grid, frequency, states)
                residual_jacobian(states, inputs, parameters, tau, frequency, columns)
                after = norm(columns, size)
                accepted = after <= (1.0 - 1e-4 * damping) * before or full <= STEP_TOLERANCE
                if accepted or norm(columns, rounding) <= 1.0:
                    accepted = True
                    break
            damping *= 0.5
        history[iteration, 2] = damping
        if not accepted:
            return STALLED, iteration + 1, orientation
        copy(trial, z)
        for k in range(borders):
            unknowns.values[k] = values[k]
        fast = damping == 1.0 and full < CHORD_RATE * previous < np.inf and full**2 <= STEP_TOLERANCE * previous
        if full <= STEP_TOLERANCE or fast:
            return ending(grid, factors, rounding, reached, resting, z, step), iteration + 1, orientation
        previous = full if damping == 1.0 else np.inf
        rounded = rounded + 1 if damping == 1.0 and norm(columns, rounding) <= 1.0 else 0
    return STALLED, MOST_NEWTON_STEPS, orientation


@kernel(types.void(MATRIX, CUBE, VECTOR, VECTOR, NUMBER, MATRIX), **INNER)
def predict(anchor_z, anchor_sensitivities, anchor_parameters, parameters, fraction, z):
    """Fill z with the anchor's linear prediction, at a fraction of the way from the anchor's parameters."""
    copy(anchor_z, z)
    flat = as_vector(z)
    for p in range(parameters.size):
        change, slope = fraction * (parameters[p] - anchor_parameters[p]), as_vector(anchor_sensitivities[p])
        if change != 0.0:
            for k in range(flat.size):
                flat[k] += slope[k] * change


@kernel(FLAG(MATRIX, MATRIX, MATRIX), **INNER)
def is_far(z, predicted, anchor_z):
    """Return whether z is off the prediction by more than `OFF_ANCHOR` of the anchor's range and of the change.

    States that remain exactly at rest do not count.
    """
    for s in range(STATES if STATES > 0 else z.shape[1]):
        off, change, low, high, rest = 0.0, 0.0, np.inf, -np.inf, True
        for i in range(z.shape[0]):
            rest = rest and z[i, s] == 0.0 and anchor_z[i, s] == 0.0
            off = max(off, abs(z[i, s] - predicted[i, s]))
            change = max(change, abs(predicted[i, s] - anchor_z[i, s]))
            low, high = min(low, anchor_z[i, s]), max(high, anchor_z[i, s])
        if not rest and off > OFF_ANCHOR * (high - low) and off > OFF_ANCHOR * change:
            return True
    return False


@inlined(NUMBER(MATRIX, VECTOR, COUNT), **INNER)
def fourth_differences(z, fourth, s):
    """Fill the cyclic fourth differences of column s of z, over 16; return the sum of their squares."""
    last = z.shape[0] - 1
    for i in range(2, last - 1):
        near, far = z[i - 1, s] + z[i + 1, s], z[i - 2, s] + z[i + 2, s]
        fourth[i] = 0.375 * z[i, s] - 0.25 * near + 0.0625 * far
    for i in (0, 1, last - 1, last):
        near, far = z[i - 1, s] + z[(i + 1) % z.shape[0], s], z[i - 2, s] + z[(i + 2) % z.shape[0], s]
        fourth[i] = 0.375 * z[i, s] - 0.25 * near + 0.0625 * far
    return dot(fourth, fourth)


@inlined(FLAG(MATRIX, COUNT, NUMBER, NUMBER), **INNER)
def is_large(z, s, energy, share):
    """Return whether an energy exceeds that of a share of the variation of column s of z, and its accuracy."""
    total, square, reached = 0.0, 0.0, 0.0
    for i in range(z.shape[0]):
        total += z[i, s] - z[0, s]
        square += (z[i, s] - z[0, s]) ** 2
        reached = max(reached, abs(z[i, s]))
    variation = share**2 * (square - total**2 / z.shape[0])
    return energy > max(variation, z.shape[0] * (10.0 * STEP_TOLERANCE * reached) ** 2)


@kernel(FLAG(MATRIX, MATRIX), **OPTIONS)
def is_jagged(z, inputs):
    """Return whether a state has energy at the grid's highest harmonics that the inputs (points, 3·inputs) lack.

    The values of such a state alternate from point to point. The binomial fourth difference over 16 passes the harmonic
    k of n points with a factor sin⁴(πk/n), 1 at the highest. A state is jagged if its root mean square exceeds `JAGGED`
    of the state's standard deviation, and if most of it is at the highest harmonics: the sixth difference over 64 keeps
    more than `ALTERNATING` of the energy. The spectrum of a resolved state decreases, also at kinks, and its sixth
    differences keep less than the 0.83 of white noise. Where an input or its derivatives have more than `ROUGHNESS` at
    high harmonics, such as noise, so has the response.
    """
    points, last, jagged = z.shape[0], z.shape[0] - 1, False
    fourth, sixth = np.empty(points), np.empty(points)
    for s in range(STATES if STATES > 0 else z.shape[1]):
        energy = fourth_differences(z, fourth, s)
        for i in range(1, last):
            sixth[i] = 0.5 * fourth[i] - 0.25 * (fourth[i - 1] + fourth[i + 1])
        for i in (0, last):
            sixth[i] = 0.5 * fourth[i] - 0.25 * (fourth[i - 1] + fourth[(i + 1) % points])
        if dot(sixth, sixth) > ALTERNATING * energy and is_large(z, s, energy, JAGGED):
            jagged = True
    if jagged:
        for k in range(inputs.shape[1]):
            if is_large(inputs, k, fourth_differences(inputs, fourth, k), ROUGHNESS):
                return False
    return jagged


@kernel(COUNT(MATRIX, COUNT), **OPTIONS)
def repetitions(z, periods):
    """Return how often z repeats itself in a number of forcing periods: once if that is its shortest period."""
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    for times in range(periods, 1, -1):
        if periods % times == 0:
            shift, same = points // times, True
            for s in range(count):
                off, low, high = 0.0, np.inf, -np.inf
                for i in range(points):
                    off = max(off, abs(z[i, s] - z[i - shift, s]))
                    low, high = min(low, z[i, s]), max(high, z[i, s])
                if off > SAME_REPETITIONS * (high - low):
                    same = False
                    break
            if same:
                return times
    return 1
