"""Compiled corrections of many condensed solutions with the matrix of Newton's iteration at their anchors."""

import numpy as np
from numba import njit

from bayesperiodic._compile.functions import grid_function_at

CONDENSED_OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}
MOST_CORRECTIONS, CORRECTION_RATE, FIRST_CORRECTION, LAST_CORRECTION, LAST_POLISHED_CORRECTION = (
    12,
    0.3,
    0.5,
    1e-10,
    1e-13,
)
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
REALS, ROWS, COMPLEX_ROWS, STACKED_ROWS = "float64[::1]", "float64[:,::1]", "complex128[:,::1]", "float64[:,:,::1]"


@njit("void(complex128[::1], complex128[::1], int64[::1], boolean)", **CONDENSED_OPTIONS)
def transform(x, turns, place, back):
    """Replace x by its discrete Fourier transform, or by the inverse one times the number of points, a power of two.

    `turns` are exp(−2πi k/points) for half the points, `place` the bit-reversed numbers.
    """
    points = x.size
    for i in range(points):
        j = place[i]
        if j > i:
            x[i], x[j] = x[j], x[i]
    width = 1
    while width < points:
        every = points // (2 * width)
        for k in range(width):
            turn = turns[k * every]
            if back:
                turn = turn.conjugate()
            for i in range(k, points, 2 * width):
                other = turn * x[i + width]
                x[i + width] = x[i] - other
                x[i] = x[i] + other
        width *= 2


@njit(f"boolean({ROWS}, int64, int64)", **CONDENSED_OPTIONS)
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


@njit(f"void({ROWS}, {REALS}, {REALS}, int64, int64, int64, float64)", **CONDENSED_OPTIONS)
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


@njit(f"void({ROWS}, {REALS}, {ROWS}, int64, int64, int64, int64, float64)", **CONDENSED_OPTIONS)
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


@njit(
    f"boolean(int64, {ROWS}, {ROWS}, {REALS}, float64, float64, int64[::1])",
    **CONDENSED_OPTIONS,
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
                            if not abs(change) <= LAST_STATE_STEP * scale[first + r - offset]:
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
            if moving[b]:
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


@njit(f"void({ROWS}, {STACKED_ROWS}, float64, int64[::1])", **CONDENSED_OPTIONS)
def tangent(out, changes, step, sizes):
    """Replace changes (points, internal states, columns) of the rates by the periodic changes of internal states.

    `out`, `step` and `sizes` are those of `march`. At rest, where any state is periodic, the mean does not change.
    """
    points, inner, columns = changes.shape
    variables = 0
    while variables * (1 + 3 * variables) < out.shape[1]:
        variables += 1
    offset, largest = variables - inner, 0
    for s in sizes:
        largest = max(largest, s)
    a = np.empty((2 * largest, 3 * largest + columns))
    flows = np.empty((points, largest, largest))
    first = 0
    for size in sizes:
        total = np.zeros((size, columns))
        previous, begun = np.empty((2, size, columns))
        for r in range(size):
            for c in range(columns):
                previous[r, c] = begun[r, c] = changes[0, first + r, c]
        for r in range(size):
            for c in range(size):
                flows[0, r, c] = 1.0 if r == c else 0.0
        at = offset + first
        for i in range(0, points, 2):
            middle, last = i + 1, (i + 2) % points
            implicit_part(a, out[middle], out[last], variables, at, size, step)
            explicit_part(a, out[i], flows[i], variables, at, size, 2 * size, step)
            row = variables + at * 3 * variables + at
            for r in range(size):
                for c in range(columns):
                    slope = 0.0
                    for k in range(size):
                        slope += out[i, row + r * 3 * variables + k] * total[k, c]
                    e0, e1 = previous[r, c], changes[middle, first + r, c]
                    e2 = changes[last, first + r, c] if last > 0 else begun[r, c]
                    there = 3 * size + c
                    a[r, there] = total[r, c] + step / 24.0 * (5.0 * (slope + e0) + 8.0 * e1 - e2)
                    a[size + r, there] = total[r, c] + step / 6.0 * (slope + e0 + 4.0 * e1 + e2)
            for r in range(size):
                for c in range(columns):
                    previous[r, c] = changes[last, first + r, c]
            if not eliminate(a, 2 * size, size + columns):
                changes[:] = np.nan
                return
            for r in range(size):
                for c in range(size):
                    flows[middle, r, c] = a[r, 2 * size + c]
                    if last > 0:
                        flows[last, r, c] = a[size + r, 2 * size + c]
                for c in range(columns):
                    changes[middle, first + r, c] = a[r, 3 * size + c]
                    total[r, c] = a[size + r, 3 * size + c]
                    if last > 0:
                        changes[last, first + r, c] = total[r, c]
            if last == 0:
                for r in range(size):
                    for c in range(size):
                        a[r, c] = (1.0 if r == c else 0.0) - a[size + r, 2 * size + c]
        for r in range(size):
            for c in range(columns):
                a[r, size + c] = total[r, c]
                changes[0, first + r, c] = 0.0
        if eliminate(a, size, columns):
            for c in range(columns):
                for r in range(size):
                    total[r, c] = a[r, size + c]
        else:
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


@njit(
    f"void(int64, {COMPLEX_ROWS}, {REALS}, float64, float64, complex128[::1], int64[::1], int64[::1], {ROWS},"
    f"{ROWS}, complex128[::1], {COMPLEX_ROWS})",
    **CONDENSED_OPTIONS,
)
def forces(address, d, parameters, rate, periods, turns, place, blocks, states, out, work, f):
    """Fill the harmonics f of the elements' forces at harmonics d (harmonics, elements).

    The displacement and the velocity over `rate`, 2π times the frequency [Hz], are real and imaginary part of one
    series; so are the forces of two elements. With `blocks` of internal states see `march`, which starts at those in
    `states`; f is not finite if they are not found.
    """
    count, elements, points, variables = d.shape[0], d.shape[1], turns.size * 2, states.shape[1] // 3
    for e in range(elements):
        work[0], work[count] = d[0, e].real, 0.0
        for k in range(1, count):
            order = k / periods
            work[k] = d[k, e] * (1.0 - order)
            work[points - k] = d[k, e].conjugate() * (1.0 + order)
        transform(work, turns, place, True)
        for i in range(points):
            states[i, e] = work[i].real
            states[i, variables + e] = rate * work[i].imag
    if elements == 0:
        return
    if blocks.size == 0:
        grid_function_at(address)(states, np.empty((points, 0)), parameters, np.zeros(points), rate, out)
    elif not march(
        address, states, out, parameters, rate / (2.0 * np.pi), 4.0 * np.pi * periods / (rate * points), blocks
    ):
        f[:] = np.nan
        states[0] = 0.0
        return
    for e in range(0, elements, 2):
        both = e + 1 < elements
        for i in range(points):
            work[i] = complex(out[i, e], out[i, e + 1] if both else 0.0) / points
        transform(work, turns, place, False)
        for k in range(count):
            here, there = work[k], work[(points - k) % points].conjugate()
            f[k, e] = 0.5 * (here + there)
            if both:
                f[k, e + 1] = -0.5j * (here - there)


@njit(
    "void(int64, complex128[:,:,:,:,::1], complex128[:,:,:,::1], float64[:,:,::1], int64, float64[:,:,::1],"
    "float64[::1], float64, complex128[::1], int64[::1], int64[::1], boolean, int64, int64, float64[:,::1],"
    "complex128[:,:,:,::1], complex128[:,:,:,::1], int64[:,::1], int64[:,::1])",
    **CONDENSED_OPTIONS,
)
def correct_many(
    address, d_f, free, inverse, low, parameters, rate, periods, turns, place, blocks, polish, start, stop, moved, d, f,
    lost, steps,
):  # fmt: skip
    """Correct predicted harmonics d (sets, solves, harmonics, elements) in place, and fill those of the forces, f.

    `d_f` (sets, 1 or solves, harmonics, elements, elements) is the frequency response between the elements, `free` (…,
    harmonics, elements) the displacements without their forces, `inverse` (sets, size, size) the transposed inverse of
    the derivative of the residual by the `low` lowest harmonics at the anchors, `moved` (sets, solves) the predicted
    change. `lost` becomes 1 where the steps do not become small at the rate `CORRECTION_RATE`, or the first is
    not below `FIRST_CORRECTION` of the predicted change: the solution may be another one.
    """
    solves, count, elements = d.shape[1], d.shape[2], d.shape[3]
    points, size = 2 * count, low * elements
    variables = elements + blocks.sum()
    columns = variables if blocks.size == 0 else variables * (1 + 3 * variables)
    states, out = np.zeros((points, 3 * variables)), np.empty((points, columns))
    work, residual, step = (
        np.empty(points, dtype=np.complex128),
        np.empty((count, elements), dtype=np.complex128),
        np.empty(2 * size),
    )
    for index in range(start, stop):
        e, b = index // solves, index % solves
        if lost[e, b] != 0:
            continue
        response, unforced = d_f[e, b if d_f.shape[1] > 1 else 0], free[e, b if free.shape[1] > 1 else 0]
        states[0] = 0.0
        x, theta, y, before, done = d[e, b], parameters[e, b], f[e, b], np.inf, False
        for iteration in range(MOST_CORRECTIONS):
            forces(address, x, theta, rate[e], periods, turns, place, blocks, states, out, work, y)
            steps[e, b] = iteration + 1
            if done:
                break
            length, square = 0.0, 0.0
            for k in range(count):
                for i in range(elements):
                    total = x[k, i] - unforced[k, i]
                    for j in range(elements):
                        total += response[k, i, j] * y[k, j]
                    residual[k, i] = total
            step[:] = 0.0
            for k in range(low):
                for i in range(elements):
                    at = k * elements + i
                    real, imaginary = residual[k, i].real, residual[k, i].imag
                    column = inverse[e, at]
                    for row in range(2 * size):
                        step[row] += column[row] * real
                    column = inverse[e, size + at]
                    for row in range(2 * size):
                        step[row] += column[row] * imaginary
            for k in range(count):
                for i in range(elements):
                    at = k * elements + i
                    change = complex(step[at], step[size + at]) if k < low else residual[k, i]
                    x[k, i] -= change
                    length += change.real**2 + change.imag**2
                    square += x[k, i].real ** 2 + x[k, i].imag ** 2
            length, square = np.sqrt(length), np.sqrt(square)
            if not (length < np.inf and square < np.inf):
                break
            if length <= LAST_POLISHED_CORRECTION * square or (not polish and length <= LAST_CORRECTION * square):
                done = True
            elif (
                iteration == 0 and length > FIRST_CORRECTION * moved[e, b] and length > FIRST_CORRECTION * 1e-3 * square
            ):
                break
            elif iteration > 0 and not length < CORRECTION_RATE * before:
                done = length <= LAST_CORRECTION * square
                if not done:
                    break
            elif iteration > 0 and not polish and length * length <= LAST_CORRECTION * square * before:
                done = True
            before = length
        lost[e, b] = 0 if done else 1


@njit(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[::1], complex128[:,:,::1])",
    fastmath={"reassoc", "nsz", "contract"},  # for sums in vector registers
    **CONDENSED_OPTIONS,
)
def modal_responses(products, mass, damping, stiffness, rates, result):
    """Fill the frequency responses (solves, harmonics, pairs) of modes at angular frequencies.

    `products` (pairs, modes) are those of the modes at two places; mass, damping and stiffness are (solves, modes).
    """
    solves, modes, pairs = mass.shape[0], mass.shape[1], products.shape[0]
    real, imaginary = np.empty(modes), np.empty(modes)
    for b in range(solves):
        for k in range(rates.size):
            for r in range(modes):
                a = stiffness[b, r] - rates[k] ** 2 * mass[b, r]
                c = rates[k] * damping[b, r]
                size = 1.0 / (a * a + c * c)
                real[r], imaginary[r] = a * size, -c * size
            for p in range(pairs):
                x, y = 0.0, 0.0
                for r in range(modes):
                    x += products[p, r] * real[r]
                    y += products[p, r] * imaginary[r]
                result[b, k, p] = complex(x, y)


@njit(
    "void(float64[:,::1], boolean, float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1])",
    fastmath={"reassoc", "nsz", "contract"},
    **CONDENSED_OPTIONS,
)
def monodromy(free, diagonal, places, forcing, kicks, state):
    """Replace state, columns of (q, q̇, w), by those a period later; w are internal states of elements, if any.

    In each step the elements change q̇ by −forcing·force, and w, of kick·(places·(q, q̇), w) = (force, w), the first one
    for half of a step also at the end; then q and q̇ move by `free`, of four diagonal blocks if `diagonal`.
    """
    steps, elements = kicks.shape[0], forcing.shape[1]
    size, columns, inner = forcing.shape[0] // 2, state.shape[1], state.shape[0] - forcing.shape[0]
    seen, force, moved = (
        np.empty((2 * elements + inner, columns)),
        np.empty((elements + inner, columns)),
        np.empty_like(state),
    )
    for i in range(steps + 1):
        kick = kicks[i % steps]
        seen[:] = 0.0
        for a in range(2 * elements):
            first = (a // elements) * size  # displacements are of q alone, velocities of q̇
            for j in range(first, first + size):
                weight = places[a, j]
                for c in range(columns):
                    seen[a, c] += weight * state[j, c]
        for a in range(inner):
            for c in range(columns):
                seen[2 * elements + a, c] = state[2 * size + a, c]
        force[:] = 0.0
        for e in range(elements + inner):
            for a in range(2 * elements + inner):
                weight = kick[e, a]
                if weight != 0.0:
                    for c in range(columns):
                        force[e, c] += weight * seen[a, c]
        for e in range(elements):
            for j in range(size, 2 * size):
                weight = forcing[j, e]
                for c in range(columns):
                    state[j, c] -= weight * force[e, c]
        for a in range(inner):
            for c in range(columns):
                state[2 * size + a, c] = force[elements + a, c]
        if i == steps:
            return
        if diagonal:
            for j in range(size):
                a, b, k, d = free[j, j], free[j, size + j], free[size + j, j], free[size + j, size + j]
                for c in range(columns):
                    q, v = state[j, c], state[size + j, c]
                    state[j, c] = a * q + b * v
                    state[size + j, c] = k * q + d * v
        else:
            for j in range(2 * size):
                for c in range(columns):
                    moved[j, c] = 0.0
                for n in range(2 * size):
                    weight = free[j, n]
                    for c in range(columns):
                        moved[j, c] += weight * state[n, c]
            for j in range(2 * size):
                for c in range(columns):
                    state[j, c] = moved[j, c]
