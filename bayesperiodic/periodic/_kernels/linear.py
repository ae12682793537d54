"""Compiled linear algebra of the periodic solver: systems with the cyclic block band ∂g/∂z.

The band is factored in one of two ways. Both are stable for any Floquet multipliers, unlike a single march through the
period:

- Segments: where the scheme allows it, the equations are solved for the newest point and marched from `reach` unknown
  start points, until their coefficients have grown by `SEGMENT_GROWTH`; there the next segment starts. The start
  points of all segments are coupled by a small dense system, solved with pivoting.
- Folded band: in the folded order of `schemes.CyclicGrid` a cyclic band is an ordinary one, factored with pivoting.
  Rows of the band are stored side by side: entry (i, j) of the matrix is ``band[i, j - i + lower]``, the width is
  2·lower + upper + 1 and leaves room for the fill-in of row exchanges. It is read through flat, unsigned indices,
  which avoids a test for negative ones at every access.
"""

import numpy as np
from numba import njit, types

from bayesperiodic._compile.functions import as_vector, inlined, kernel
from bayesperiodic.periodic.compiled import *

STATES, REACH, WIDTH, HALF = globals().get("SIZES", (0, 0, 0, 0))  # 0: any number, taken from the arrays
LOWER = HALF * STATES + STATES - 1 if HALF > 0 else 0  # half-width of the folded band
NARROW_BAND = 5
SEGMENT_GROWTH, TOO_MUCH_GROWTH = 1e4, 1e8
CHECK_EVERY = 8
OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
INNER = OPTIONS | {"no_cpython_wrapper": True}  # for functions that Python never calls: an eighth less to compile


@inlined(types.void(MATRIX, MATRIX), **INNER)
def copy(source, target):
    """Copy one array into another of the same shape; compiles faster than a slice assignment."""
    one, other = as_vector(source), as_vector(target)
    for k in range(one.size):
        other[k] = one[k]


@inlined(types.void(MATRIX, GRID, VECTOR), **INNER)
def fold(values, grid, folded):
    """Copy an array (points, states) into the folded order (size,)."""
    place, count = grid.place, values.shape[1]
    for i in range(values.shape[0]):
        for s in range(count):
            folded[place[i] * count + s] = values[i, s]


@inlined(types.void(VECTOR, GRID, MATRIX), **INNER)
def unfold(folded, grid, values):
    """Copy from the folded order (size,) into an array (points, states)."""
    place, count = grid.place, values.shape[1]
    for i in range(values.shape[0]):
        for s in range(count):
            values[i, s] = folded[place[i] * count + s]


@inlined(FLAG(VECTOR, types.uint64, PLACES), **INNER)
def factor_narrow(flat, stop, pivots):
    """Factor the rows before `stop` of a band of half-width `LOWER`, with loops of constant length."""
    one, below, row = np.uint64(1), np.uint64(LOWER), np.uint64(3 * LOWER)
    for j in range(stop):
        diagonal = j * (row + one) + below
        pivot, largest = np.uint64(0), abs(flat[diagonal])
        for i in range(LOWER):
            m = np.uint64(i) + one
            value = abs(flat[diagonal + m * row])
            if value > largest:
                pivot, largest = m, value
        pivots[j] = j + pivot
        if not (largest > 0.0 and largest < np.inf):
            return False
        if pivot != 0:
            other = diagonal + pivot * row
            for i in range(2 * LOWER + 1):
                k = np.uint64(i)
                flat[diagonal + k], flat[other + k] = flat[other + k], flat[diagonal + k]
        inverse = 1.0 / flat[diagonal]
        flat[diagonal] = inverse
        for i in range(LOWER):
            start = diagonal + (np.uint64(i) + one) * row
            multiplier = flat[start] * inverse
            flat[start] = multiplier
            for k in range(2 * LOWER):
                flat[start + one + np.uint64(k)] -= multiplier * flat[diagonal + one + np.uint64(k)]
    return True


@kernel(FLAG(MATRIX, COUNT, COUNT, PLACES), **OPTIONS)
def factor(band, lower, upper, pivots):
    """Factor in place, P·A = L·U; return False for a pivot that is zero or not finite.

    `lower` and `upper` are the half-widths below and above the diagonal. The pivots are kept as their inverses;
    `pivots` (size,) is filled with the row exchanged with each row.
    """
    flat = as_vector(band)
    size, one, below, above = np.uint64(band.shape[0]), np.uint64(1), np.uint64(lower), np.uint64(upper)
    next_row = np.uint64(band.shape[1]) - one
    first, last = np.uint64(0), np.uint64(0)
    if 0 < LOWER <= NARROW_BAND and lower == LOWER and upper == LOWER and size > 3 * LOWER:
        # The last rows are shorter.
        first = size - np.uint64(3 * LOWER)
        last = first + np.uint64(2 * LOWER - 1)
        if not factor_narrow(flat, first, pivots):
            return False
    for j in range(first, size):
        end = min(j + below, size - one)
        diagonal = j * (next_row + one) + below
        pivot, largest = j, abs(flat[diagonal])
        for m in range(one, end - j + one):
            value = abs(flat[diagonal + m * next_row])
            if value > largest:
                pivot, largest = j + m, value
        pivots[j] = pivot
        if not (largest > 0.0 and largest < np.inf):
            return False
        last = max(last, min(pivot + above, size - one))
        width = last - j
        if pivot != j:
            other = diagonal + (pivot - j) * next_row
            for k in range(width + one):
                flat[diagonal + k], flat[other + k] = flat[other + k], flat[diagonal + k]
        inverse = 1.0 / flat[diagonal]
        flat[diagonal] = inverse
        for m in range(one, end - j + one):
            start = diagonal + m * next_row
            multiplier = flat[start] * inverse
            flat[start] = multiplier
            if multiplier != 0.0:
                for k in range(one, width + one):
                    flat[start + k] -= multiplier * flat[diagonal + k]
    return True


@njit(inline="always")
def substitute(flat, pivots, below, reach, x):
    """Solve A·x = b in place for one right-hand side (size,)."""
    size, one = np.uint64(x.size), np.uint64(1)
    next_row = below + reach
    inside, known, half = size - min(below, size), min(reach, size), reach // np.uint64(2)
    for j in range(size):
        pivot = np.uint64(pivots[j])
        value = x[pivot]
        x[pivot] = x[j]
        x[j] = value
        diagonal = j * (next_row + one) + below
        if j < inside:
            for m in range(one, below + one):
                x[j + m] -= flat[diagonal + m * next_row] * value
        else:
            for m in range(one, size - j):
                x[j + m] -= flat[diagonal + m * next_row] * value
    for back in range(known):
        i = size - one - back
        diagonal = i * (next_row + one) + below
        value = x[i]
        for k in range(back):
            value -= flat[diagonal + back - k] * x[i + back - k]
        x[i] = value * flat[diagonal]
    for back in range(known, size):
        i = size - one - back
        diagonal = i * (next_row + one) + below
        value, far = x[i], 0.0
        # The latest unknowns last: only these delay the sum.
        for k in range(half):
            far += flat[diagonal + reach - k] * x[i + reach - k]
        value -= far
        for k in range(half, reach):
            value -= flat[diagonal + reach - k] * x[i + reach - k]
        x[i] = value * flat[diagonal]


@kernel(types.void(MATRIX, COUNT, COUNT, PLACES, MATRIX), **OPTIONS)
def solve(band, lower, upper, pivots, right):
    """Solve A·x = b in place for right-hand sides (count, size), with the factors of `factor`."""
    flat = as_vector(band)
    for c in range(right.shape[0]):
        if LOWER > 0 and lower == LOWER and upper == LOWER:
            substitute(flat, pivots, np.uint64(LOWER), np.uint64(2 * LOWER), right[c])
        else:
            substitute(flat, pivots, np.uint64(lower), np.uint64(lower + upper), right[c])


@kernel(types.void(MATRIX, GRID, COUNT, NUMBER, MATRIX), **OPTIONS)
def assemble(columns, grid, states, frequency, band):
    """Fill the folded band of ∂g/∂z from the columns g, ∂g/∂(q, q̇, q̈) of the model's grid function."""
    first, second, shift, place = grid.first, grid.second, grid.shift, grid.place
    points, count = columns.shape[0], STATES if STATES > 0 else states
    lower, width = grid.half_width * count + count - 1, WIDTH if WIDTH > 0 else first.size
    flat, source, squared = as_vector(band), as_vector(columns), frequency**2
    for k in range(flat.size):
        flat[k] = 0.0
    for i in range(points):
        for e in range(count):
            diagonal = (place[i] * count + e) * band.shape[1] + lower - e
            column = np.uint64(i * columns.shape[1] + count + e * 3 * count)
            for j in range(count):
                s, all_states = np.uint64(j), np.uint64(count)
                damping, inertia = source[column + all_states + s], source[column + all_states + all_states + s]
                for o in range(width):
                    entry = np.uint64(diagonal + j + shift[i, o] * count)
                    flat[entry] += damping * (first[o] * frequency) + inertia * (second[o] * squared)
                flat[np.uint64(diagonal + j)] += source[column + s]


@inlined(FLAG(MATRIX, MATRIX, COUNT), **INNER)
def invert(matrix, inverse, size):
    """Invert by Gauss-Jordan elimination with row exchanges; `matrix` is destroyed. Return False if singular."""
    count = STATES if STATES > 0 else size
    for e in range(count):
        for s in range(count):
            inverse[e, s] = 1.0 if e == s else 0.0
    for j in range(count):
        pivot = j
        for e in range(j + 1, count):
            if abs(matrix[e, j]) > abs(matrix[pivot, j]):
                pivot = e
        if not (abs(matrix[pivot, j]) > 0.0 and abs(matrix[pivot, j]) < np.inf):
            return False
        if pivot != j:
            for s in range(count):
                matrix[pivot, s], matrix[j, s] = matrix[j, s], matrix[pivot, s]
                inverse[pivot, s], inverse[j, s] = inverse[j, s], inverse[pivot, s]
        scale = 1.0 / matrix[j, j]
        for s in range(count):
            matrix[j, s] *= scale
            inverse[j, s] *= scale
        for e in range(count):
            multiplier = matrix[e, j]
            if e != j and multiplier != 0.0:
                for s in range(count):
                    matrix[e, s] -= multiplier * matrix[j, s]
                    inverse[e, s] -= multiplier * inverse[j, s]
    return True


@kernel(FLAG(MATRIX, GRID, NUMBER, VECTOR, FACTORS), **INNER)
def condense_segments(columns, grid, frequency, amplitude, factors):
    """Express every point by the start points of its segment; return False if the march grows or is singular.

    Growth is relative to `amplitude` (states,). Filled are the coefficients of the newest point of each equation:
    `inverses` (points, states, states), of the right-hand side; `gains` (points, reach, states, states), of the points
    before it; `transfer` (states, reach·states, points), of the start points, the latest first. Then `ends`
    (1 + MAX_SEGMENTS,), the number of segments and the last point of each.
    """
    inverses, gains, transfer, ends = factors.inverses, factors.gains, factors.transfer, factors.ends
    first, second, lead = grid.first, grid.second, grid.lead
    points, count = columns.shape[0], STATES if STATES > 0 else inverses.shape[1]
    reach = REACH if REACH > 0 else gains.shape[1]
    squared, here = frequency**2, reach - lead
    block, inverse = np.empty((count, count)), np.empty((count, count))
    segments, start = 0, 0
    newest, acceleration = first[reach] * frequency, second[reach] * squared
    for j in range(points):
        row = columns[j - lead if j >= lead else j - lead + points]
        for e in range(count):
            for s in range(count):
                column = count + e * 3 * count + s
                value = row[column + count] * newest + row[column + 2 * count] * acceleration
                block[e, s] = value + row[column] if here == reach else value
        if not invert(block, inverse, count):
            return False
        for e in range(count):
            for s in range(count):
                inverses[j, e, s] = inverse[e, s]
            for c in range(reach * count):
                transfer[e, c, j] = 0.0
        for d in range(reach):
            o, back = reach - 1 - d, j - 1 - d
            one, two = first[o] * frequency, second[o] * squared
            for e in range(count):
                for s in range(count):
                    column = count + e * 3 * count + s
                    value = row[column + count] * one + row[column + 2 * count] * two
                    block[e, s] = value + row[column] if here == o else value
            for e in range(count):
                for s in range(count):
                    value = 0.0
                    for t in range(count):
                        value -= inverse[e, t] * block[t, s]
                    gains[j, d, e, s] = value
                    if back >= start:
                        for c in range(reach * count):
                            transfer[e, c, j] += value * transfer[s, c, back]
                    else:
                        transfer[e, (start - 1 - back) * count + s, j] += value
        if j % CHECK_EVERY == CHECK_EVERY - 1 or j == points - 1:
            growth = 0.0
            for e in range(count):
                for d in range(reach):
                    for s in range(count):
                        growth = max(growth, abs(transfer[e, d * count + s, j]) * amplitude[s] / amplitude[e])
            if not growth < TOO_MUCH_GROWTH:
                return False
            if (growth > SEGMENT_GROWTH or j == points - 1) and j - start >= reach - 1:
                if segments == MAX_SEGMENTS:
                    return False
                segments, start = segments + 1, j + 1
                ends[segments] = j
    ends[0] = segments
    return start == points


@kernel(FLAG(FACTORS), **INNER)
def factor_interface(factors):
    """Factor the cyclic system that couples the start points of the segments; return False if it is singular."""
    transfer, ends = factors.transfer, factors.ends
    count = STATES if STATES > 0 else transfer.shape[0]
    reach, segments = transfer.shape[1] // count, ends[0]
    block = reach * count
    size = segments * block
    matrix = factors.interface[: size * (3 * size - 2)].reshape((size, 3 * size - 2))
    matrix[:] = 0.0
    for q in range(segments):
        after = (q + 1) % segments
        for d in range(reach):
            for e in range(count):
                i = after * block + d * count + e
                matrix[i, size - 1] += 1.0
                for c in range(block):
                    matrix[i, q * block + c - i + size - 1] -= transfer[e, c, ends[q + 1] - d]
    return factor(matrix, size - 1, size - 1, factors.interface_pivots)


@kernel(FLAG(MATRIX, GRID, NUMBER, VECTOR, FACTORS), **OPTIONS)
def factorise(columns, grid, frequency, amplitude, factors):
    """Factor ∂g/∂z by segments, or else in the folded order; return False if it is singular or not finite."""
    if grid.lead >= 0 and condense_segments(columns, grid, frequency, amplitude, factors):
        if factor_interface(factors):
            return True
    factors.ends[0] = 0
    count = factors.inverses.shape[1]
    lower = grid.half_width * count + count - 1
    assemble(columns, grid, count, frequency, factors.band)
    return factor(factors.band, lower, lower, factors.pivots)


@kernel(types.void(GRID, FACTORS, MATRIX), **OPTIONS)
def back_substitute(grid, factors, right):
    """Solve ∂g/∂z·x = b in place, b (points, states), with the factors of `factorise`."""
    inverses, gains, transfer, ends, lead = factors.inverses, factors.gains, factors.transfer, factors.ends, grid.lead
    points, count = right.shape[0], STATES if STATES > 0 else right.shape[1]
    reach, segments = REACH if REACH > 0 else gains.shape[1], ends[0]
    if segments == 0:
        lower = grid.half_width * count + count - 1
        folded = np.empty((1, points * count))
        fold(right, grid, folded[0])
        solve(factors.band, lower, lower, factors.pivots, folded)
        unfold(folded[0], grid, right)
        return
    forced = np.empty((points, count))
    for k in range(points):
        j = k + lead if k + lead < points else k + lead - points
        for e in range(count):
            value = 0.0
            for s in range(count):
                value += inverses[j, e, s] * right[k, s]
            forced[j, e] = value
    flat, gain, start = as_vector(forced), as_vector(gains), 0
    for q in range(segments):
        stop = ends[q + 1] + 1
        for j in range(start, start + reach):
            for d in range(j - start):
                for e in range(count):
                    for s in range(count):
                        forced[j, e] += gains[j, d, e, s] * forced[j - 1 - d, s]
        before, after = flat[start * count :], flat[(start + reach) * count :]
        rows = gain[(start + reach) * reach * count * count :]
        for k in range(stop - start - reach):
            for e in range(count):
                value = after[k * count + e]
                # The latest points last: only these delay the sum.
                for d in range(reach - 1, -1, -1):
                    for s in range(count):
                        place = ((k * reach + d) * count + e) * count + s
                        value += rows[place] * before[(k + reach - 1 - d) * count + s]
                after[k * count + e] = value
        start = stop
    block = reach * count
    size = segments * block
    x = np.empty((1, size))
    for q in range(segments):
        for d in range(reach):
            for e in range(count):
                x[0, (q + 1) % segments * block + d * count + e] = forced[ends[q + 1] - d, e]
    matrix = factors.interface[: size * (3 * size - 2)].reshape((size, 3 * size - 2))
    solve(matrix, size - 1, size - 1, factors.interface_pivots, x)
    start, moved, out = 0, as_vector(transfer), as_vector(right)
    for q in range(segments):
        for e in range(count):
            for k in range(ends[q + 1] + 1 - start):
                j = np.uint64(start + k)
                value = flat[j * np.uint64(count) + np.uint64(e)]
                for c in range(block):
                    value += moved[np.uint64((e * block + c) * points) + j] * x[0, q * block + c]
                out[j * np.uint64(count) + np.uint64(e)] = value
        start = ends[q + 1] + 1
