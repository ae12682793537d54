"""The compiled code of the periodic solver, generic in the model: linear algebra, discretisation, Newton, batches.

This text is compiled through the kernel cache as one module (see `compiled`), because code compiled from one file goes
stale when a function of another file that it calls has changed. Import the functions from `compiled`, which puts in the
sizes for which loops are unrolled: the numbers of states, start points and offsets, and the band's half-width.

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

from bayesperiodic.models.compile import GRID_SIGNATURE

STATES, REACH, WIDTH, HALF = 0, 0, 0, 0  # 0: any number, taken from the arrays
LOWER = HALF * STATES + STATES - 1 if HALF > 0 else 0  # half-width of the folded band

CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(5)

STEP_TOLERANCE, POLISHED = 1e-9, 1e-12
MAX_ITERATIONS = 50
MAX_HALVINGS = 20
MAX_CHORDS = 6
CHORD_RATE, PREDICTION_RATE = 0.2, 30.0
LEAST_STIFFNESS, MOST_STIFFNESS = 0.3, 3.0
ROUNDING = 4.0 * np.finfo(float).eps
SCALE_POINTS = 200
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
    for i in range(source.shape[0]):
        for s in range(source.shape[1]):
            target[i, s] = source[i, s]


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
    last = np.uint64(0)
    for j in range(size):
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
    width = WIDTH if WIDTH > 0 else first.size
    # Offsets in a row, as they are where their number is known, start with the lowest; in the middle none is cyclic.
    start, inside = ((points - neighbours[0, 0]) % points, points - WIDTH + 1) if WIDTH > 0 else (0, 0)
    squared = frequency**2
    flat, rest = z.reshape(z.size), tau[start:]
    here, out = flat[start * count :], states.reshape(states.size)[3 * start * count :]
    for k in range(inside):
        for s in range(count):
            rate, acceleration = 0.0, 0.0
            for o in range(width):
                value = flat[(k + o) * count + s]
                rate += first[o] * value
                acceleration += second[o] * value
            out[3 * count * k + s] = here[count * k + s] + drift[s] * rest[k]
            out[3 * count * k + count + s] = (rate + drift[s]) * frequency
            out[3 * count * k + 2 * count + s] = acceleration * squared
    for k in range(points - inside):
        i = k if k < start else k + inside
        for s in range(count):
            rate, acceleration = 0.0, 0.0
            for o in range(width):
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
    lower = half_width * count + count - 1
    one, two = first * frequency, second * frequency**2
    for i in range(points):
        for e in range(count):
            row = band[place[i] * count + e]
            row[:] = 0.0
            for s in range(count):
                column = count + e * 3 * count + s
                stiffness = columns[i, column]
                damping = columns[i, column + count]
                inertia = columns[i, column + 2 * count]
                for o in range(first.size):
                    value = damping * one[o] + inertia * two[o]
                    if shift[i, o] == 0:
                        value += stiffness
                    row[shift[i, o] * count + lower + s - e] += value


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
    """Fill the largest absolute value of each state."""
    for s in range(STATES if STATES > 0 else z.shape[1]):
        amplitude[s] = 0.0
        for i in range(z.shape[0]):
            amplitude[s] = max(amplitude[s], abs(z[i, s]))


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


@njit(
    f"Tuple((boolean, int64, float64))({FUNCTION}, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {VECTOR}, "
    f"float64, float64, boolean, {MATRIX}, {MATRIX}, {MATRIX}, {FACTORS}, {MATRIX}, {MATRIX})",
    **OPTIONS,
)
def chord(
    residual, grid, inputs, parameters, tau, frequency, drift, amplitude, stiffness, predicted, polish, z, states,
    change, factors, left, right,
):  # fmt: skip
    """Improve z in place with the factors of a nearby solution; return whether that converged, the steps, and how far.

    `states` are left as they were before the last step. A step above `CHORD_RATE` times the one before ends it. The
    ratio of two steps tells how much smaller the next one will be; that of the first step to the prediction tells the
    order of magnitude, since the prediction is a chord step too, but for terms of second order: `PREDICTION_RATE` times
    it was above all but two of a hundred rates found.

    Where ∂g/∂z is nearly singular, steps with another point's factors say little of what is left in the direction that
    it makes smallest, and after a change of its stiffness there, or of its sign, they go the wrong way. So this
    direction takes the stiffness expected of the present ∂g/∂z, and factors whose own is too far from it are not used.

    Parameters
    ----------
    residual : compiled grid function of the model
    amplitude : array (states,)
        Units of the steps.
    stiffness : float
        Expected of the present ∂g/∂z in this direction, in units of that of the factors.
    predicted : float
        The change that the prediction made, in these units.
    polish : bool
        Go on until a step is below `POLISHED` or down to rounding, for derivatives of what is compared with the data.
    change : array (points, states)
        Work array.
    left : array (points, states)
        Weights of the equations that are largest for a residual in this direction.
    right : array (points, 3·states)
        The direction with its time derivatives, so long that its stiffness is 1 for the ∂g/∂z of the factors.
    """
    points, count = z.shape[0], STATES if STATES > 0 else z.shape[1]
    if not (stiffness > LEAST_STIFFNESS and stiffness < MOST_STIFFNESS):
        return False, 0, 0.0
    correction, tolerance = 1.0 / stiffness - 1.0, STEP_TOLERANCE * min(1.0, stiffness)
    previous, moved, rate, converged = predicted, 0.0, PREDICTION_RATE, False
    for iteration in range(MAX_CHORDS):
        differentiate(z, drift, grid, tau, frequency, states)
        residual(states, inputs, parameters, tau, frequency, change)
        along = 0.0
        if correction != 0.0:
            for s in range(count):
                part = 0.0
                for i in range(points):
                    part += left[i, s] * change[i, s]
                along += correction * part
        back_substitute(grid, factors, change)
        full = 0.0
        for s in range(count):
            largest_change, total = 0.0, 0.0
            for i in range(points):
                step = change[i, s] + along * right[i, s]
                z[i, s] -= step
                largest_change = max(largest_change, abs(step))
                total += step
            if not abs(total) < np.inf:
                return False, iteration + 1, moved
            if largest_change > 0.0:
                full = max(full, largest_change / amplitude[s])
        moved += full
        if converged and (full <= POLISHED or not full < CHORD_RATE * previous):
            return True, iteration + 1, moved
        if not full < FAR or (iteration > 0 and not full < CHORD_RATE * previous):
            return False, iteration + 1, moved
        converged = converged or full <= tolerance or rate * full**2 <= tolerance * previous
        if converged and (full <= POLISHED or not polish):
            return True, iteration + 1, moved
        previous, rate = full, 1.0
    return converged, MAX_CHORDS, moved


@njit(f"void({MATRIX}, {CUBE}, {VECTOR}, {VECTOR}, float64, {MATRIX})", **OPTIONS)
def predict(anchor_z, anchor_sensitivities, anchor_parameters, parameters, fraction, z):
    """Fill z with the anchor's linear prediction, at a fraction of the way from the anchor's parameters."""
    copy(anchor_z, z)
    count = STATES if STATES > 0 else z.shape[1]
    for p in range(parameters.size):
        change = fraction * (parameters[p] - anchor_parameters[p])
        if change != 0.0:
            for i in range(z.shape[0]):
                for s in range(count):
                    z[i, s] += anchor_sensitivities[p, i, s] * change


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


@njit(f"boolean({MATRIX}, int64)", **OPTIONS)
def was_damped(history, iterations):
    """Return whether Newton's iteration took a shortened step."""
    for iteration in range(iterations):
        if history[iteration, 2] < 1.0:
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


@njit(
    f"void({FUNCTION}, {FUNCTION}, {FUNCTION}, {GRID}, int64, {CUBE}, {CUBE}, {VECTOR}, {VECTOR}, {MATRIX}, {MATRIX}, "
    f"{CUBE}, {GAINS}, {MATRIX}, {MATRIX}, {VECTOR}, "
    f"Tuple(({CUBE}, {INDICES}, {GAINS}, float64[:,:,:,:,::1], {GAINS}, {INDICES}, {MATRIX}, {INDICES})), "
    f"{CUBE}, {CUBE}, {CUBE}, {PLACES}, int64, int64, boolean, {GAINS}, {GAINS}, {CUBE}, {INDICES}, {INDICES})",
    **OPTIONS,
)
def solve_many(
    residual,
    residual_jacobian,
    outputs,
    grid,
    periods,
    inputs,
    parameters,
    tau,
    frequency,
    drift,
    anchor_parameters,
    anchor_z,
    anchor_sensitivities,
    anchor_amplitude,
    anchor_softening,
    anchor_near,
    anchor_factors,
    anchor_left,
    anchor_right,
    data,
    measured,
    start,
    stop,
    polish,
    kept_z,
    y,
    squares,
    status,
    iterations,
):
    """Solve for input sets times parameter vectors, those of the flat indices start … stop (vectors run fastest).

    Each solve starts from the linear prediction of its set's anchor: chord steps with the anchor's factors, else
    Newton's iteration, else that from the anchor itself. Where all fail, or the result is far from the prediction of a
    solved anchor or of a shorter period than it, small steps are taken along the way from the anchor's parameters.
    Where they lead is where the orbit went; if one leaps, or the period becomes shorter, the status is "other orbit".
    Nothing depends on the order of the solves.

    Parameters
    ----------
    inputs : array (sets, points, 3·inputs)
    parameters : array (sets, solves, parameters)
    frequency : array (sets,)
    drift : array (sets, states)
    anchor_parameters, anchor_z, anchor_sensitivities, anchor_factors, anchor_left, anchor_right : arrays (sets, …)
    anchor_amplitude : array (sets, states)
        The largest absolute value of each state.
    anchor_softening : array (sets, parameters)
        Derivatives of the stiffness that `chord` takes.
    anchor_near : array (sets,)
        How far chord steps may lead, in units of the amplitude, without `is_far` being asked.
    data : array (sets, points, measured)
    measured : int array (measured,)
        The channels that the data are of.
    polish : bool
        As `chord` takes it.
    kept_z : array (sets, solves, points, states), or without entries if z is not wanted
    y : array (sets, solves, points, channels), or without entries if the outputs are not wanted
    squares : array (sets, solves, measured)
        Filled with the sums of squares of data minus outputs.
    status, iterations : int arrays (sets, solves)
    """
    bands, pivots, inverses, gains, transfers, ends, reduced, reduced_pivots = anchor_factors
    points, count = anchor_z.shape[1], STATES if STATES > 0 else anchor_z.shape[2]
    solves = parameters.shape[1]
    states, z = np.empty((points, 3 * count)), np.empty((points, count))
    predicted, here, last = np.empty((points, count)), np.empty((points, count)), np.empty((points, count))
    columns, history = np.empty((points, count * (1 + 3 * count))), np.empty((MAX_ITERATIONS, 3))
    change, room = np.empty((points, count)), np.empty((points, y.shape[3]))
    own = (
        np.empty_like(bands[0]), np.empty_like(pivots[0]), np.empty_like(inverses[0]), np.empty_like(gains[0]),
        np.empty_like(transfers[0]), np.empty_like(ends[0]), np.empty_like(reduced[0]),
        np.empty_like(reduced_pivots[0]),
    )  # fmt: skip
    for index in range(start, stop):
        e, b = index // solves, index % solves
        theta, at, turn, f = parameters[e, b], anchor_z[e], drift[e], frequency[e]
        kept = (
            bands[e], pivots[e], inverses[e], gains[e], transfers[e], ends[e], reduced[e], reduced_pivots[e]
        )  # fmt: skip
        predict(at, anchor_sensitivities[e], anchor_parameters[e], theta, 1.0, predicted)
        copy(predicted, z)
        close, used, code, doubtful, moved = False, 0, CONVERGED, False, np.inf
        if ends[e, 0] >= 0:
            stiffness = 1.0
            for p in range(theta.size):
                stiffness += anchor_softening[e, p] * (theta[p] - anchor_parameters[e, p])
            ahead = 0.0
            for s in range(count):
                part = 0.0
                for i in range(points):
                    part = max(part, abs(predicted[i, s] - at[i, s]))
                if part > 0.0:
                    ahead = max(ahead, part / anchor_amplitude[e, s])
            close, used, moved = chord(
                residual, grid, inputs[e], theta, tau, f, turn, anchor_amplitude[e], stiffness, ahead,
                polish, z, states, change, kept, anchor_left[e], anchor_right[e],
            )  # fmt: skip
        if not close:
            moved = np.inf
            copy(predicted, z)
            code, more = newton(
                residual_jacobian, grid, inputs[e], theta, tau, f, turn, z, history, states, columns, own
            )  # fmt: skip
            used += more
            doubtful = was_damped(history, more)
            if code != CONVERGED:
                copy(at, z)
                code, more = newton(
                    residual_jacobian, grid, inputs[e], theta, tau, f, turn, z, history, states, columns, own
                )  # fmt: skip
                used += more
                doubtful = True
        once = repetitions(at, periods)
        far = moved > anchor_near[e] and is_far(z, predicted, at)
        if ends[e, 0] >= 0 and (doubtful or far or repetitions(z, periods) > once):
            leapt = code == CONVERGED
            done, step, before = 0.0, LARGEST_PART, LARGEST_PART
            copy(at, here)
            copy(at, last)
            predict(at, anchor_sensitivities[e], anchor_parameters[e], theta, -before, last)
            while done < 1.0:
                for i in range(points):
                    for s in range(count):
                        predicted[i, s] = here[i, s] + (here[i, s] - last[i, s]) * (step / before)
                copy(predicted, z)
                between = anchor_parameters[e] + (theta - anchor_parameters[e]) * (done + step)
                code, more = newton(
                    residual_jacobian, grid, inputs[e], between, tau, f, turn, z, history, states, columns, own
                )  # fmt: skip
                used += more
                if code == CONVERGED and repetitions(z, periods) > once:
                    code = OTHER_ORBIT
                    break
                if code != CONVERGED or is_far(z, predicted, here):
                    code = OTHER_ORBIT if leapt or code == CONVERGED else code
                    step *= 0.5
                    if step < SMALLEST_PART:
                        break
                    continue
                copy(here, last)
                copy(z, here)
                done, before = done + step, step
                step = min(2.0 * step, LARGEST_PART, 1.0 - done)
        differentiate(z, turn, grid, tau, f, states)
        out = y[e, b] if y.size > 0 else room
        outputs(states, inputs[e], theta, tau, f, out)
        for m in range(measured.size):
            total = 0.0
            for i in range(points):
                total += (out[i, measured[m]] - data[e, i, m]) ** 2
            squares[e, b, m] = total
        if kept_z.size > 0:
            copy(z, kept_z[e, b])
        status[e, b], iterations[e, b] = code, used
