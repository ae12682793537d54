"""The compiled code of the periodic solver, generic in the model: linear algebra, discretisation, Newton's iteration.

This text is compiled through the kernel cache. Import the functions from `compiled`, which puts in the sizes for which
loops are unrolled: the numbers of states, start points and offsets, and the band's half-width.

**Linear systems** with the cyclic block band ∂g/∂z are factored in one of two ways, both right however stable or
unstable the orbit is, which one march through the period would not be:

- Segments: where the scheme allows it, the equations are solved for the newest point and marched from `reach` unknown
  start points, until what they multiply has grown by `GROWTH`; there the next segment starts. The start points of all
  segments are coupled by a small dense system, solved with pivoting.
- Folded band: in the folded order of `schemes.CyclicGrid` a cyclic band is an ordinary one, factored with pivoting.
  Rows of the band are stored side by side: entry (i, j) of the matrix is ``band[i, j - i + lower]``, the width is
  2·lower + upper + 1 and leaves room for the fill-in of row exchanges. It is read through flat, unsigned indices,
  which spares a test for negative ones at every access.

The Newton iteration is that of de Kraker, Verbeek & van de Wouw (1997), eq. (3): damped, with step halving. A failed
solve is a status, not an exception.
"""

import numpy as np
from numba import njit

from bayesperiodic.models.code_generation import GRID_SIGNATURE

STATES, REACH, WIDTH, HALF = 0, 0, 0, 0  # 0: any number, taken from the arrays
LOWER = HALF * STATES + STATES - 1 if HALF > 0 else 0  # half-width of the folded band

CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(5)

STEP_TOLERANCE = 1e-9
MAX_ITERATIONS = 50
MAX_HALVINGS = 20
CHORD_RATE = 0.2
ROUNDING = 4.0 * np.finfo(float).eps
SCALE_POINTS = 200
NARROW = 5
FAR = 0.3
SAME = 1e-6
LARGEST_PART, SMALLEST_PART = 1.0 / 16.0, 1.0 / 256.0

GROWTH, TOO_MUCH_GROWTH = 1e4, 1e8
MAX_SEGMENTS = 12
CHECK_EVERY = 8

MATRIX, VECTOR, INDICES, PLACES = "float64[:,::1]", "float64[::1]", "int64[:,::1]", "int64[::1]"
CUBE, GAINS = "float64[:,:,::1]", "float64[:,:,:,::1]"
FUNCTION = f"FunctionType({GRID_SIGNATURE})"
GRID = f"Tuple(({VECTOR}, {VECTOR}, {INDICES}, {INDICES}, {PLACES}, int64, int64))"
FACTORS = f"Tuple(({MATRIX}, {PLACES}, {CUBE}, {GAINS}, {CUBE}, {PLACES}, {VECTOR}, {PLACES}))"
OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}


@njit(f"void({MATRIX}, {MATRIX})", **OPTIONS)
def copy(source, target):
    """Copy one array into another of the same shape; a slice assignment would bring in the text of its error."""
    one, other = source.reshape(source.size), target.reshape(target.size)
    for k in range(one.size):
        other[k] = one[k]


@njit(f"boolean({VECTOR}, uint64, {PLACES})", **OPTIONS)
def factor_narrow(flat, stop, pivots):
    """Do as `factor` for the rows before `stop` of a band of half-width `LOWER`, every loop of a known length."""
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


@njit(f"boolean({MATRIX}, int64, int64, {PLACES})", **OPTIONS)
def factor(band, lower, upper, pivots):
    """Factor in place, P·A = L·U, the pivots kept as their inverses; return False for one that is zero or not finite.

    Parameters
    ----------
    band : array (size, 2·lower + upper + 1)
    lower, upper : int
        Half-widths below and above the diagonal.
    pivots : int array (size,)
        Filled with the row exchanged with each row.
    """
    flat = band.reshape(band.size)
    size, one, below, above = np.uint64(band.shape[0]), np.uint64(1), np.uint64(lower), np.uint64(upper)
    next_row = np.uint64(band.shape[1]) - one
    first, last = np.uint64(0), np.uint64(0)
    if 0 < LOWER <= NARROW and lower == LOWER and upper == LOWER and size > 3 * LOWER:
        # Near the end the rows are shorter.
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
        # The latest unknowns last: they alone have to be waited for.
        for k in range(half):
            far += flat[diagonal + reach - k] * x[i + reach - k]
        value -= far
        for k in range(half, reach):
            value -= flat[diagonal + reach - k] * x[i + reach - k]
        x[i] = value * flat[diagonal]


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


@njit(f"void({MATRIX}, int64, int64, {PLACES}, {MATRIX})", **OPTIONS)
def solve(band, lower, upper, pivots, right):
    """Solve A·x = b in place for right-hand sides (count, size), with the factors of `factor`."""
    flat = band.reshape(band.size)
    for c in range(right.shape[0]):
        if LOWER > 0 and lower == LOWER and upper == LOWER:
            substitute(flat, pivots, np.uint64(LOWER), np.uint64(2 * LOWER), right[c])
        else:
            substitute(flat, pivots, np.uint64(lower), np.uint64(lower + upper), right[c])


@njit(f"void({MATRIX}, int64, int64, {PLACES}, {MATRIX})", **OPTIONS)
def solve_transposed(band, lower, upper, pivots, right):
    """Solve Aᵀ·x = b in place for right-hand sides (count, size), with the factors of `factor`."""
    flat = band.reshape(band.size)
    for c in range(right.shape[0]):
        if LOWER > 0 and lower == LOWER and upper == LOWER:
            substitute_transposed(flat, pivots, np.uint64(LOWER), np.uint64(2 * LOWER), right[c])
        else:
            substitute_transposed(flat, pivots, np.uint64(lower), np.uint64(lower + upper), right[c])


@njit(f"void({MATRIX}, {VECTOR}, {GRID}, {VECTOR}, float64, {MATRIX})", **OPTIONS)
def differentiate(z, drift, grid, tau, frequency, states):
    """Fill `states` (points, 3·states) with q = z + drift·tau and its time derivatives by the scheme."""
    first, second, neighbours, _, _, _, _ = grid
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    # Offsets in a row, as they are where their number is known, start with the lowest; in the middle none is cyclic.
    start, inside = ((points - neighbours[0, 0]) % points, points - WIDTH + 1) if WIDTH > 0 else (0, 0)
    squared, all_states = frequency**2, np.uint64(count)
    flat, rest = z.reshape(z.size), tau[start:]
    here, out = flat[start * count :], states.reshape(states.size)[3 * start * count :]
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


@njit(f"void({MATRIX}, {GRID}, int64, float64, {MATRIX})", **OPTIONS)
def assemble(columns, grid, states, frequency, band):
    """Fill the folded band of ∂g/∂z from the columns g, ∂g/∂(q, q̇, q̈) of the model's grid function."""
    first, second, _, shift, place, half_width, _ = grid
    points, count = columns.shape[0], STATES if STATES > 0 else states
    lower, width = half_width * count + count - 1, WIDTH if WIDTH > 0 else first.size
    one, two = first * frequency, second * frequency**2
    flat, source = band.reshape(band.size), columns.reshape(columns.size)
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
                    flat[entry] += damping * one[o] + inertia * two[o]
                flat[np.uint64(diagonal + j)] += source[column + s]


@njit(f"boolean({MATRIX}, {MATRIX}, int64)", **OPTIONS)
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


@njit(f"boolean({MATRIX}, {GRID}, float64, {VECTOR}, {CUBE}, {GAINS}, {CUBE}, {PLACES})", **OPTIONS)
def march(columns, grid, frequency, amplitude, inverses, gains, transfer, ends):
    """Express every point by its segment's start points; return False where the scheme or the matrix forbids it.

    Parameters
    ----------
    columns : array (points, states·(1 + 3·states))
    amplitude : array (states,)
        Units in which growth is judged.
    inverses : array (points, states, states)
        Filled: what multiplies the right-hand side at the newest point of each equation.
    gains : array (points, reach, states, states)
        Filled: what multiplies the points before it.
    transfer : array (states, reach·states, points)
        Filled: what multiplies the start points, the latest first.
    ends : int array (1 + MAX_SEGMENTS,)
        Filled: the number of segments, then the last point of each.
    """
    first, second, _, _, _, _, lead = grid
    points, count = columns.shape[0], STATES if STATES > 0 else inverses.shape[1]
    reach = REACH if REACH > 0 else gains.shape[1]
    one, two, here = first * frequency, second * frequency**2, reach - lead
    block, inverse = np.empty((count, count)), np.empty((count, count))
    segments, start = 0, 0
    for j in range(points):
        row = columns[j - lead if j >= lead else j - lead + points]
        for e in range(count):
            for s in range(count):
                column = count + e * 3 * count + s
                value = row[column + count] * one[reach] + row[column + 2 * count] * two[reach]
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
            for e in range(count):
                for s in range(count):
                    column = count + e * 3 * count + s
                    value = row[column + count] * one[o] + row[column + 2 * count] * two[o]
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
            if (growth > GROWTH or j == points - 1) and j - start >= reach - 1:
                if segments == MAX_SEGMENTS:
                    return False
                segments, start = segments + 1, j + 1
                ends[segments] = j
    ends[0] = segments
    return start == points


@njit(f"boolean({CUBE}, {PLACES}, {VECTOR}, {PLACES})", **OPTIONS)
def join(transfer, ends, reduced, pivots):
    """Factor the cyclic system that couples the start points of the segments; return False if it is singular."""
    count = STATES if STATES > 0 else transfer.shape[0]
    reach, segments = transfer.shape[1] // count, ends[0]
    block = reach * count
    size = segments * block
    matrix = reduced[: size * (3 * size - 2)].reshape((size, 3 * size - 2))
    matrix[:] = 0.0
    for q in range(segments):
        after = (q + 1) % segments
        for d in range(reach):
            for e in range(count):
                i = after * block + d * count + e
                matrix[i, size - 1] += 1.0
                for c in range(block):
                    matrix[i, q * block + c - i + size - 1] -= transfer[e, c, ends[q + 1] - d]
    return factor(matrix, size - 1, size - 1, pivots)


@njit(f"boolean({MATRIX}, {GRID}, float64, {VECTOR}, {FACTORS})", **OPTIONS)
def factorise(columns, grid, frequency, amplitude, factors):
    """Factor ∂g/∂z by segments, or else in the folded order; return False if it is singular or not finite."""
    band, pivots, inverses, gains, transfer, ends, reduced, reduced_pivots = factors
    if grid[6] >= 0 and march(columns, grid, frequency, amplitude, inverses, gains, transfer, ends):
        if join(transfer, ends, reduced, reduced_pivots):
            return True
    ends[0] = 0
    count = inverses.shape[1]
    lower = grid[5] * count + count - 1
    assemble(columns, grid, count, frequency, band)
    return factor(band, lower, lower, pivots)


@njit(f"void({GRID}, {FACTORS}, {MATRIX})", **OPTIONS)
def back_substitute(grid, factors, right):
    """Solve ∂g/∂z·x = b in place, b (points, states), with the factors of `factorise`."""
    band, pivots, inverses, gains, transfer, ends, reduced, reduced_pivots = factors
    place, half_width, lead = grid[4], grid[5], grid[6]
    points, count = right.shape[0], STATES if STATES > 0 else right.shape[1]
    reach, segments = REACH if REACH > 0 else gains.shape[1], ends[0]
    if segments == 0:
        lower = half_width * count + count - 1
        folded = np.empty((1, points * count))
        for i in range(points):
            for s in range(count):
                folded[0, place[i] * count + s] = right[i, s]
        solve(band, lower, lower, pivots, folded)
        for i in range(points):
            for s in range(count):
                right[i, s] = folded[0, place[i] * count + s]
        return
    forced = np.empty((points, count))
    for k in range(points):
        j = k + lead if k + lead < points else k + lead - points
        for e in range(count):
            value = 0.0
            for s in range(count):
                value += inverses[j, e, s] * right[k, s]
            forced[j, e] = value
    flat, gain, start = forced.reshape(points * count), gains.reshape(gains.size), 0
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
                # The latest points last: they alone have to be waited for.
                for d in range(reach - 1, -1, -1):
                    for s in range(count):
                        own = ((k * reach + d) * count + e) * count + s
                        value += rows[own] * before[(k + reach - 1 - d) * count + s]
                after[k * count + e] = value
        start = stop
    block = reach * count
    size = segments * block
    x = np.empty((1, size))
    for q in range(segments):
        for d in range(reach):
            for e in range(count):
                x[0, (q + 1) % segments * block + d * count + e] = forced[ends[q + 1] - d, e]
    matrix = reduced[: size * (3 * size - 2)].reshape((size, 3 * size - 2))
    solve(matrix, size - 1, size - 1, reduced_pivots, x)
    start, moved, out = 0, transfer.reshape(transfer.size), right.reshape(points * count)
    for q in range(segments):
        for e in range(count):
            for k in range(ends[q + 1] + 1 - start):
                j = np.uint64(start + k)
                value = flat[j * np.uint64(count) + np.uint64(e)]
                for c in range(block):
                    value += moved[np.uint64((e * block + c) * points) + j] * x[0, q * block + c]
                out[j * np.uint64(count) + np.uint64(e)] = value
        start = ends[q + 1] + 1


@njit(f"void({MATRIX}, {MATRIX}, {GRID}, {VECTOR}, float64, {VECTOR}, {VECTOR})", **OPTIONS)
def scales(columns, states, grid, amplitude, frequency, size, rounding):
    """Fill, for each equation, the size of its terms and the rounding error that its residual cannot fall below.

    About `SCALE_POINTS` points are looked at, all of them if an equation's terms vanish there.
    """
    first, second = grid[0], grid[1]
    points, count = states.shape[0], STATES if STATES > 0 else amplitude.size
    one, two = 0.0, 0.0
    for o in range(first.size):
        one += abs(first[o]) * frequency
        two += abs(second[o]) * frequency**2
    for e in range(count):
        start = count + e * 3 * count
        size[e], rounding[e], stride = 0.0, 0.0, max(1, points // SCALE_POINTS)
        while stride > 0:
            for i in range(0, points, stride):
                terms, error = 0.0, 0.0
                for s in range(count):
                    stiffness = abs(columns[i, start + s])
                    damping = abs(columns[i, start + count + s])
                    inertia = abs(columns[i, start + 2 * count + s])
                    terms += stiffness * abs(states[i, s]) + damping * abs(states[i, count + s])
                    terms += inertia * abs(states[i, 2 * count + s])
                    error += amplitude[s] * (stiffness + damping * one + inertia * two)
                size[e] = max(size[e], terms, abs(columns[i, e]))
                rounding[e] = max(rounding[e], error)
            stride = 1 if stride > 1 and size[e] == 0.0 else 0
        rounding[e] *= ROUNDING


@njit(f"void({MATRIX}, {VECTOR})", **OPTIONS)
def largest(z, amplitude):
    """Fill the largest absolute value of each state; four maxima at a time, none of which waits for another."""
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


@njit(f"float64({VECTOR}, {VECTOR})", fastmath={"reassoc"}, **OPTIONS)
def dot(one, other):
    """Return the sum of products, in whatever order is fastest on this machine."""
    total = 0.0
    for i in range(one.size):
        total += one[i] * other[i]
    return total


@njit(f"float64({MATRIX}, {VECTOR})", **OPTIONS)
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


@njit(f"float64({MATRIX}, {MATRIX})", **OPTIONS)
def scaled_step(z, step):
    """Return the largest step of any state in units of that state's largest value; infinite if not finite."""
    result = 0.0
    for s in range(STATES if STATES > 0 else z.shape[1]):
        moved, reached = 0.0, 0.0
        for i in range(z.shape[0]):
            change = abs(step[i, s])
            if not change < np.inf:
                return np.inf
            moved = max(moved, change)
            reached = max(reached, abs(z[i, s]), abs(z[i, s] + step[i, s]))
        if moved > 0.0:
            result = max(result, moved / reached)
    return result


@njit(
    f"Tuple((int64, int64))({FUNCTION}, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {MATRIX}, {MATRIX}, "
    f"{MATRIX}, {MATRIX}, {FACTORS})",
    **OPTIONS,
)
def newton(
    residual_jacobian, grid, inputs, parameters, tau, frequency, drift, z, history, states, columns, factors
):  # fmt: skip
    """Solve g(z) = 0 in place and return (status, iterations).

    An iteration ends the search when its step, or the one expected next at the rate seen, is below `STEP_TOLERANCE` of
    the state, or when the residual is down to rounding.

    Parameters
    ----------
    residual_jacobian : compiled grid function of the model
    grid : see `schemes.CyclicGrid.packed`
    inputs : array (points, 3·inputs)
    parameters, tau, frequency : as the grid function takes them
    drift : array (states,)
        Secular rate of each state, per forcing period (a winding angle).
    z : array (points, states)
        The guess, overwritten by the periodic part of the solution.
    history : array (MAX_ITERATIONS, 3)
        Filled for each iteration with the scaled residual before it, the scaled full step, and the damping factor.
    states, columns, factors : work arrays
        Left as they are at the last iterate; the factors are those of the last but one.
    """
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    size, rounding, amplitude = np.empty(count), np.empty(count), np.empty(count)
    step, trial = np.empty((points, count)), np.empty((points, count))
    differentiate(z, drift, grid, tau, frequency, states)
    residual_jacobian(states, inputs, parameters, tau, frequency, columns)
    previous = np.inf
    for iteration in range(MAX_ITERATIONS):
        largest(z, amplitude)
        scales(columns, states, grid, amplitude, frequency, size, rounding)
        before = norm(columns, size)
        if not np.isfinite(before):
            return NOT_FINITE, iteration
        if iteration == 0 and norm(columns, rounding) <= 1.0 and np.all(amplitude > 0.0):
            return CONVERGED, 0
        for s in range(count):
            if amplitude[s] == 0.0:
                amplitude[s] = 1.0
        if not factorise(columns, grid, frequency, amplitude, factors):
            return SINGULAR, iteration
        for i in range(points):
            for s in range(count):
                step[i, s] = -columns[i, s]
        back_substitute(grid, factors, step)
        full = scaled_step(z, step)
        if full == np.inf:
            return SINGULAR, iteration
        history[iteration, 0], history[iteration, 1] = before, full
        damping, accepted = 1.0, False
        for _ in range(MAX_HALVINGS):
            for i in range(points):
                for s in range(count):
                    trial[i, s] = z[i, s] + damping * step[i, s]
            differentiate(trial, drift, grid, tau, frequency, states)
            residual_jacobian(states, inputs, parameters, tau, frequency, columns)
            after = norm(columns, size)
            if after <= (1.0 - 1e-4 * damping) * before or full <= STEP_TOLERANCE:
                accepted = True
                break
            damping *= 0.5
        history[iteration, 2] = damping
        if not accepted:
            return STALLED, iteration + 1
        copy(trial, z)
        if full <= STEP_TOLERANCE or (damping == 1.0 and norm(columns, rounding) <= 1.0):
            return CONVERGED, iteration + 1
        if damping == 1.0 and full < CHORD_RATE * previous < np.inf and full**2 <= STEP_TOLERANCE * previous:
            return CONVERGED, iteration + 1
        previous = full if damping == 1.0 else np.inf
    return STALLED, MAX_ITERATIONS


@njit(f"void({MATRIX}, {CUBE}, {VECTOR}, {VECTOR}, float64, {MATRIX})", **OPTIONS)
def predict(anchor_z, anchor_sensitivities, anchor_parameters, parameters, fraction, z):
    """Fill z with the anchor's linear prediction, at a fraction of the way from the anchor's parameters."""
    copy(anchor_z, z)
    flat = z.reshape(z.size)
    for p in range(parameters.size):
        change, slope = fraction * (parameters[p] - anchor_parameters[p]), anchor_sensitivities[p].reshape(z.size)
        if change != 0.0:
            for k in range(flat.size):
                flat[k] += slope[k] * change


@njit(f"boolean({MATRIX}, {MATRIX}, {MATRIX})", **OPTIONS)
def is_far(z, predicted, anchor_z):
    """Return whether z is further from the prediction than `FAR` of the anchor's range and of the predicted change."""
    for s in range(STATES if STATES > 0 else z.shape[1]):
        off, change, low, high = 0.0, 0.0, np.inf, -np.inf
        for i in range(z.shape[0]):
            off = max(off, abs(z[i, s] - predicted[i, s]))
            change = max(change, abs(predicted[i, s] - anchor_z[i, s]))
            low, high = min(low, anchor_z[i, s]), max(high, anchor_z[i, s])
        if off > FAR * (high - low) and off > FAR * change:
            return True
    return False


@njit(f"int64({MATRIX}, int64)", **OPTIONS)
def repetitions(z, periods):
    """Return how many times z repeats itself within so many forcing periods: 1 if that is its shortest period."""
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    for times in range(periods, 1, -1):
        if periods % times == 0:
            shift, same = points // times, True
            for s in range(count):
                off, low, high = 0.0, np.inf, -np.inf
                for i in range(points):
                    off = max(off, abs(z[i, s] - z[i - shift, s]))
                    low, high = min(low, z[i, s]), max(high, z[i, s])
                if off > SAME * (high - low):
                    same = False
                    break
            if same:
                return times
    return 1
