"""Compiled internal states of the elements of condensed models over a period, see `periodic.memory`."""

import numpy as np
from numba import njit

from bayesperiodic._compile.functions import grid_function_at

MEMORY_OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}
# Periods over which internal states are followed, Newton's steps between two points, those that are whole ones, and
# their last one; the last correction of the start of a period.
MOST_MARCHED_PERIODS, MOST_STATE_STEPS, WHOLE_STATE_STEPS, LAST_STATE_STEP, LAST_START_CORRECTION = (
    100,
    60,
    15,
    1e-9,
    1e-12,
)
STATE_ROUNDING = 1e-16
# Part of a change that is forgotten in a period below which the mean of a state, any of which is nearly periodic, is
# chosen, see `centre`.
HARDLY_FORGOTTEN = 1e-7
# Newton's steps over a whole period, and the last one, after which forces are corrected linearly.
MOST_PERIOD_STEPS, LAST_PERIOD_STEP = 8, 1e-6
REALS, ROWS, STACKED_ROWS = "float64[::1]", "float64[:,::1]", "float64[:,:,::1]"


@njit(f"boolean({ROWS}, int64, int64)", **MEMORY_OPTIONS)
def eliminate(a, size, columns):
    """Replace columns size … size + columns of a by the solution of the first `size` ones; False if singular."""
    for p in range(size):
        best, largest = p, abs(a[p, p])
        for r in range(p + 1, size):
            if abs(a[r, p]) > largest:
                best, largest = r, abs(a[r, p])
        if not largest > 0.0:
            return False
        if best != p:
            for c in range(p, size + columns):
                a[p, c], a[best, c] = a[best, c], a[p, c]
        for r in range(p + 1, size):
            factor = a[r, p] / a[p, p]
            if factor != 0.0:
                for c in range(p + 1, size + columns):
                    a[r, c] -= factor * a[p, c]
    for c in range(size, size + columns):
        for r in range(size - 1, -1, -1):
            total = a[r, c]
            for k in range(r + 1, size):
                total -= a[r, k] * a[k, c]
            a[r, c] = total / a[r, r]
    return True


@njit(f"void({ROWS}, {REALS}, {REALS}, int64, int64, int64, float64)", **MEMORY_OPTIONS)
def implicit_part(a, middle, last, variables, first, size, step):
    """Fill the matrix of the formula of `march` for the changes at its last two points.

    `middle` and `last` are rows of equations of `variables` states and their derivatives, see `march`.
    """
    width = 3 * variables
    for r in range(size):
        at = variables + (first + r) * width + first
        for c in range(size):
            one = 1.0 if r == c else 0.0
            a[r, c] = one - 8.0 / 24.0 * step * middle[at + c]
            a[r, size + c] = step / 24.0 * last[at + c]
            a[size + r, c] = -4.0 / 6.0 * step * middle[at + c]
            a[size + r, size + c] = one - step / 6.0 * last[at + c]


@njit(f"void({ROWS}, {REALS}, {ROWS}, int64, int64, int64, int64, float64)", **MEMORY_OPTIONS)
def explicit_part(a, before, flow, variables, first, size, place, step):
    """Fill columns `place` … of a with the change of the formula of `march` by columns `flow` at its first point."""
    width = 3 * variables
    for r in range(size):
        at = variables + (first + r) * width + first
        for c in range(size):
            total = 0.0
            for k in range(size):
                total += before[at + k] * flow[k, c]
            a[r, place + c] = flow[r, c] + 5.0 / 24.0 * step * total
            a[size + r, place + c] = flow[r, c] + step / 6.0 * total


@njit(f"boolean({ROWS}, int64, int64, float64)", **MEMORY_OPTIONS)
def hardly_forgets(out, variables, at, flow):
    """Return whether a state forgets a change, but so little of it in a period that this is not precise."""
    if not abs(1.0 - flow) <= HARDLY_FORGOTTEN:
        return False
    for i in range(out.shape[0]):
        if out[i, variables + at * 3 * variables + at] != 0.0:
            return True
    return False


@njit("float64(float64[:], int64, float64)", **MEMORY_OPTIONS)
def between(values, i, part):
    """Return periodic values a part of a step after point i − 1, by the cubic polynomial through four points."""
    points = values.size
    v0, v1, v2, v3 = values[i - 2], values[i - 1], values[i], values[(i + 1) % points]
    a, b, c = part + 1.0, part - 1.0, part - 2.0
    return -v0 * part * b * c / 6.0 + v1 * a * b * c / 2.0 - v2 * a * part * c / 2.0 + v3 * a * part * b / 6.0


@njit("float64(float64[:], float64[:])", **MEMORY_OPTIONS)
def centre(values, rates):
    """Return a mean of periodic values at the points where a state with these rates turns; of all at rest.

    Where a joint does not slide, its force is elastic, and slips of its law in proportion to force times distance, as
    Dahl's does, leave the state s with the mean c of which ∮ (s − c) |ds| = 0. It is the mean of the turning points
    with the weights ±(s − c), and so are its changes.
    """
    points, turns, here = rates.size, 0, 0.0
    at, part, place = np.empty(points, dtype=np.int64), np.empty(points), np.empty(points)
    for i in range(points):
        before, after = rates[i - 1], rates[i]
        if (after > 0.0) != (before > 0.0):
            f = before / (before - after)
            f = min(1.0, max(0.0, f + between(rates, i, f) / (before - after)))
            at[turns], part[turns], place[turns] = i, f, here + (before + 0.5 * (after - before) * f) * f
            turns += 1
        here += (13.0 * (before + after) - rates[i - 2] - rates[(i + 1) % points]) / 24.0
    length = moment = 0.0
    for k in range(turns):
        last = place[(k + turns - 1) % turns]
        length, moment = length + abs(place[k] - last), moment + 0.5 * (place[k] + last) * abs(place[k] - last)
    if length == 0.0:
        return values.mean()
    total = weights = 0.0
    for k in range(turns):
        weight = (place[k] - moment / length) * (1.0 if rates[at[k] - 1] > 0.0 else -1.0)
        total, weights = total + weight * between(values, at[k], part[k]), weights + weight
    return total / weights


@njit(
    f"boolean(int64, {ROWS}, {ROWS}, {REALS}, float64, float64, int64[::1])",
    **MEMORY_OPTIONS,
)
def march(address, states, out, theta, rate, step, sizes):
    """Fill the periodic internal states of elements, whose motion over a period is given; False if none or any is.

    `states` (points, 3·variables) have the displacements and velocities; the internal states, the last variables, are
    found. `out` becomes the equations, forces and then rates of internal states, with their derivatives (points,
    variables + variables·3·variables). Internal states are independent of each other but within blocks of these
    `sizes`. `step` is the time [s] of two steps: on each two of them the formula of Lobatto IIIA of order four holds,
    see `memory`. The start is corrected by the linear map of one period until the state is periodic.
    """
    points, variables, blocks = states.shape[0], states.shape[1] // 3, sizes.size
    inner, largest = 0, 0
    for s in sizes:
        inner += s
        largest = max(largest, s)
    offset, width = variables - inner, 3 * variables
    empty, tau = np.empty((2, 0)), np.zeros(2)
    near, value = np.zeros((2, width)), np.empty((2, out.shape[1]))
    a, flow = np.empty((2 * largest, 3 * largest + 1)), np.empty((blocks, largest, largest))
    begin, end, scale, errors = np.empty(inner), np.empty(inner), np.zeros(inner), np.full(blocks, np.inf)
    for k in range(inner):
        begin[k] = states[0, offset + k]
    known, moving = np.zeros((2, blocks), dtype=np.bool_)
    for _ in range(MOST_MARCHED_PERIODS):
        for k in range(inner):
            states[0, offset + k], scale[k] = begin[k], 0.0
        grid_function_at(address)(states[:1], empty[:1], theta, tau[:1], rate, out[:1])
        for b in range(blocks):
            for r in range(sizes[b]):
                for c in range(sizes[b]):
                    flow[b, r, c] = 1.0 if r == c else 0.0
            moving[b] = False
        for i in range(0, points, 2):
            middle, last = i + 1, (i + 2) % points
            for k in range(width):
                near[0, k], near[1, k] = states[middle, k], states[last, k]
            for k in range(offset, variables):
                near[0, k] = near[1, k] = states[i, k]
                scale[k - offset] = max(scale[k - offset], abs(states[i, k]) + step * abs(out[i, k]))
            settled = False
            for iteration in range(MOST_STATE_STEPS):
                grid_function_at(address)(near, empty, theta, tau, rate, value)
                if settled:
                    break
                settled, first = True, offset
                for b in range(blocks):
                    size = sizes[b]
                    implicit_part(a, value[0], value[1], variables, first, size, step)
                    for r in range(size):
                        k = first + r
                        x, h0, h1, h2 = states[i, k], out[i, k], value[0, k], value[1, k]
                        a[r, 2 * size] = near[0, k] - x - step / 24.0 * (5.0 * h0 + 8.0 * h1 - h2)
                        a[size + r, 2 * size] = near[1, k] - x - step / 6.0 * (h0 + 4.0 * h1 + h2)
                        moving[b] |= h0 != 0.0
                    if not eliminate(a, 2 * size, 1):
                        return False
                    share = 1.0 if iteration < WHOLE_STATE_STEPS else 0.5
                    for r in range(size):
                        for row in range(2):
                            change = a[row * size + r, 2 * size]
                            near[row, first + r] -= share * change
                            # A state that begins at 0 with rate 0 has no scale yet.
                            level = max(scale[first + r - offset], abs(near[row, first + r]))
                            if not abs(change) <= LAST_STATE_STEP * level:
                                settled = False
                            if not abs(change) < np.inf:
                                return False
                    first += size
            if not settled:
                return False
            first = offset
            for b in range(blocks):
                size = sizes[b]
                implicit_part(a, value[0], value[1], variables, first, size, step)
                explicit_part(a, out[i], flow[b], variables, first, size, 2 * size, step)
                if not eliminate(a, 2 * size, size):
                    return False
                for r in range(size):
                    for c in range(size):
                        flow[b, r, c] = a[size + r, 2 * size + c]
                first += size
            for k in range(offset, variables):
                states[middle, k] = near[0, k]
                if last > 0:
                    states[last, k] = near[1, k]
                else:
                    end[k - offset] = near[1, k]
            for k in range(value.shape[1]):
                out[middle, k] = value[0, k]
                if last > 0:
                    out[last, k] = value[1, k]
        done, first = True, 0
        for b in range(blocks):
            size, error, level = sizes[b], 0.0, 0.0
            for r in range(size):
                error = max(error, abs(end[first + r] - begin[first + r]))
                level = max(level, scale[first + r])
            if not error < np.inf:
                return False
            if moving[b] and size == 1 and hardly_forgets(out, variables, offset + first, flow[b, 0, 0]):
                middle = centre(states[:, offset + first], out[:, offset + first])
                if error > 10.0 * (HARDLY_FORGOTTEN + points * STATE_ROUNDING) * level:
                    return False
                if abs(middle) > LAST_START_CORRECTION * level:
                    done = False
                    begin[first] -= middle
            elif moving[b]:
                for r in range(size):
                    for c in range(size):
                        a[r, c] = (1.0 if r == c else 0.0) - flow[b, r, c]
                    a[r, size] = end[first + r] - begin[first + r]
                regular, length = eliminate(a, size, 1), 0.0
                for r in range(size):
                    regular = regular and abs(a[r, r]) > points * STATE_ROUNDING
                    length = max(length, abs(a[r, size]))
                if not regular and error <= points * STATE_ROUNDING * level:
                    return False
                if not (regular and length < np.inf) or (known[b] and error > 0.5 * errors[b]):
                    # Where Newton's step did not help, a further period.
                    for r in range(size):
                        a[r, size] = end[first + r] - begin[first + r]
                    known[b] = False
                    settled = False
                else:
                    known[b] = True
                    settled = length <= LAST_START_CORRECTION * level
                if not settled and error > points * STATE_ROUNDING * level:
                    done = False
                    for r in range(size):
                        begin[first + r] += a[r, size]
                errors[b] = error
            first += size
        if done:
            return True
    return False


@njit(f"void({ROWS}, {STACKED_ROWS}, float64, int64, int64, int64, {STACKED_ROWS}, {ROWS})", **MEMORY_OPTIONS)
def sweep_one(out, changes, step, variables, at, first, flows, total):
    """Do what `sweep` does for a state that depends on no other, in a seventh of the time."""
    points, columns, row = changes.shape[0], changes.shape[2], variables + at * 3 * variables + at
    for i in range(0, points, 2):
        middle, last = i + 1, (i + 2) % points
        s0, s1, s2 = step * out[i, row], step * out[middle, row], step * out[last, row]
        a, b, c, d = 1.0 - s1 / 3.0, s2 / 24.0, -2.0 / 3.0 * s1, 1.0 - s2 / 6.0
        inverse, at_middle, at_last = 1.0 / (a * d - b * c), 1.0 + 5.0 / 24.0 * s0, 1.0 + s0 / 6.0
        by_middle, by_last = inverse * (d * at_middle - b * at_last), inverse * (a * at_last - c * at_middle)
        flow = flows[i, 0, 0]
        flows[middle, 0, 0], flows[last, 0, 0] = by_middle * flow, by_last * flow
        for k in range(columns):
            one, two, before = changes[middle, first, k], changes[last, first, k], total[0, k]
            changes[middle, first, k] = by_middle * before + inverse * (d * one - b * two)
            changes[last, first, k] = total[0, k] = by_last * before + inverse * (a * two - c * one)


@njit(
    f"boolean({ROWS}, {STACKED_ROWS}, float64, int64, int64, int64, int64, {STACKED_ROWS}, {ROWS}, {ROWS})",
    **MEMORY_OPTIONS,
)
def sweep(out, changes, step, variables, at, first, size, flows, total, a):
    """Fill changes and flows, their derivatives by that of the start, of a block of states; False if singular.

    The start does not change: `flows` begins with the unit matrix, `total` with 0. Their first rows become those of the
    end of the period. For the other arguments see `periodic_changes`; a has room for two steps.
    """
    points, columns, row = changes.shape[0], changes.shape[2], variables + at * 3 * variables + at
    for i in range(0, points, 2):
        middle, last = i + 1, (i + 2) % points
        implicit_part(a, out[middle], out[last], variables, at, size, step)
        explicit_part(a, out[i], flows[i], variables, at, size, 2 * size, step)
        for r in range(size):
            for c in range(columns):
                slope = 0.0
                for k in range(size):
                    slope += out[i, row + r * 3 * variables + k] * total[k, c]
                before, there = total[r, c], 3 * size + c
                a[r, there] = before + 5.0 / 24.0 * step * slope + changes[middle, first + r, c]
                a[size + r, there] = before + step / 6.0 * slope + changes[last, first + r, c]
        if not eliminate(a, 2 * size, size + columns):
            return False
        for r in range(size):
            for c in range(size):
                flows[middle, r, c], flows[last, r, c] = a[r, 2 * size + c], a[size + r, 2 * size + c]
            for c in range(columns):
                changes[middle, first + r, c] = a[r, 3 * size + c]
                changes[last, first + r, c] = total[r, c] = a[size + r, 3 * size + c]
    return True


@njit(f"float64({ROWS}, {STACKED_ROWS}, float64, int64[::1], boolean[::1])", **MEMORY_OPTIONS)
def periodic_changes(out, changes, step, sizes, held):
    """Replace right-hand sides (points, internal states, columns) of the formula of `march` by the periodic changes.

    The first row is that of the end of the period. `out`, `step` and `sizes` are those of `march`. Return the smallest
    pivot of the closing of the period; where it is 0, as at rest, any mean is periodic, and it does not change. States
    of their own that hardly forget become `held`: their centre does not change.
    """
    points, inner, columns = changes.shape
    variables, smallest, first, largest = 0, np.inf, 0, 0
    while variables * (1 + 3 * variables) < out.shape[1]:
        variables += 1
    for s in sizes:
        largest = max(largest, s)
    a, flows = np.empty((2 * largest, 3 * largest + columns)), np.empty((points, largest, largest))
    total = np.empty((largest, columns))
    for size in sizes:
        total[:] = 0.0
        for r in range(size):
            for c in range(size):
                flows[0, r, c] = 1.0 if r == c else 0.0
        at = variables - inner + first
        if size == 1:
            sweep_one(out, changes, step, variables, at, first, flows, total)
        elif not sweep(out, changes, step, variables, at, first, size, flows, total, a):
            changes[:] = np.nan
            return 0.0
        for r in range(size):
            for c in range(size):
                one = 1.0 if r == c else 0.0
                a[r, c], flows[0, r, c] = one - flows[0, r, c], one
            for c in range(columns):
                a[r, size + c], changes[0, first + r, c] = total[r, c], 0.0
        held[first] = size == 1 and hardly_forgets(out, variables, at, 1.0 - a[0, 0])
        if held[first]:
            rates = out[:, at]
            level = centre(flows[:, 0, 0], rates)
            for c in range(columns):
                total[0, c] = -centre(changes[:, first, c], rates) / level
        elif eliminate(a, size, columns):
            for r in range(size):
                smallest = min(smallest, abs(a[r, r]))
                for c in range(columns):
                    total[r, c] = a[r, size + c]
        else:
            smallest = 0.0
            for c in range(columns):
                for r in range(size):
                    total[r, c] = 0.0
                    for i in range(points):
                        total[r, c] -= changes[i, first + r, c] / points
        for i in range(points):
            for r in range(size):
                for c in range(columns):
                    for k in range(size):
                        changes[i, first + r, c] += flows[i, r, k] * total[k, c]
        first += size
    return smallest


@njit(f"void({ROWS}, {STACKED_ROWS}, float64, int64[::1])", **MEMORY_OPTIONS)
def tangent(out, changes, step, sizes):
    """Replace changes (points, internal states, columns) of the rates by the periodic changes of internal states.

    `out`, `step` and `sizes` are those of `march`. At rest, where any state is periodic, the mean does not change.
    """
    points, inner, columns = changes.shape
    for k in range(inner):
        for c in range(columns):
            begun = e0 = changes[0, k, c]
            for i in range(0, points, 2):
                last = (i + 2) % points
                e1, e2 = changes[i + 1, k, c], changes[last, k, c] if last > 0 else begun
                changes[i + 1, k, c] = step / 24.0 * (5.0 * e0 + 8.0 * e1 - e2)
                changes[last, k, c] = step / 6.0 * (e0 + 4.0 * e1 + e2)
                e0 = e2
    periodic_changes(out, changes, step, sizes, np.zeros(inner, dtype=np.bool_))


@njit(f"boolean(int64, {ROWS}, {ROWS}, {REALS}, float64, float64, int64[::1])", **MEMORY_OPTIONS)
def correct_states(address, states, out, theta, rate, step, sizes):
    """Correct the internal states in `states` by Newton's iteration over the whole period; False if it does not end.

    Arguments are those of `march`. The rates and derivatives in `out` are those before the last step, which is small;
    the forces are corrected for it.
    """
    points, variables = states.shape[0], states.shape[1] // 3
    inner, before = 0, np.inf
    for s in sizes:
        inner += s
    offset, width = variables - inner, 3 * variables
    empty, tau, changes = np.empty((points, 0)), np.zeros(points), np.empty((points, inner, 1))
    held = np.zeros(inner, dtype=np.bool_)
    for _ in range(MOST_PERIOD_STEPS):
        grid_function_at(address)(states, empty, theta, tau, rate, out)
        length = 0.0
        for k in range(inner):
            at = offset + k
            for i in range(0, points, 2):
                middle, last = i + 1, (i + 2) % points
                x, h0, h1, h2 = states[i, at], out[i, at], out[middle, at], out[last, at]
                changes[middle, k, 0] = x + step / 24.0 * (5.0 * h0 + 8.0 * h1 - h2) - states[middle, at]
                changes[last, k, 0] = x + step / 6.0 * (h0 + 4.0 * h1 + h2) - states[last, at]
        if not periodic_changes(out, changes, step, sizes, held) > points * STATE_ROUNDING:
            return False
        for k in range(inner):
            at, scale, largest = offset + k, 0.0, 0.0
            if held[k]:
                changes[:, k, 0] -= centre(states[:, at], out[:, at])
            for i in range(points):
                scale = max(scale, abs(states[i, at]) + step * abs(out[i, at]))
                change = abs(changes[i, k, 0])
                if not change < np.inf:
                    return False
                largest = max(largest, change)
                states[i, at] += changes[i, k, 0]
            if largest > 0.0:
                length = max(length, largest / scale) if scale > 0.0 else np.inf
        if length <= LAST_PERIOD_STEP:
            for i in range(points):
                for e in range(offset):
                    for k in range(inner):
                        out[i, e] += out[i, variables + e * width + offset + k] * changes[i, k, 0]
            return True
        if not length < 0.5 * before:
            return False
        before = length
    return False


@njit(f"boolean(int64, {ROWS}, {ROWS}, {REALS}, float64, float64, int64[::1])", **MEMORY_OPTIONS)
def follow_states(address, states, out, theta, rate, step, sizes):
    """Correct the internal states in `states`, or else fill them by `march`; False if that fails too."""
    if correct_states(address, states, out, theta, rate, step, sizes):
        return True
    states[0, states.shape[1] // 3 - sizes.sum() : states.shape[1] // 3] = 0.0
    return march(address, states, out, theta, rate, step, sizes)
