"""The compiled code of the periodic solver, generic in the model: banded algebra, discretisation, Newton, batches.

This text is compiled through the kernel cache as one module (see `compiled`), because code compiled from one file goes
stale when a function of another file that it calls has changed. Import the functions from `compiled`.

A cyclic band becomes an ordinary one in the folded order of `schemes.CyclicGrid`; pivoting then keeps the solution
accurate however stable or unstable the orbit is, which one march through the period would not. Rows of the band are
stored side by side: entry (i, j) of the matrix is ``band[i, j - i + lower]``, the width is 2·lower + upper + 1 and
leaves room for the fill-in of row exchanges. It is read through flat, unsigned indices, which spares a test for
negative ones at every access.

The Newton iteration is that of de Kraker, Verbeek & van de Wouw (1997), eq. (3): damped, with step halving. A failed
solve is a status, not an exception.
"""

import numpy as np
from numba import njit

from bayesperiodic.models.compile import GRID_SIGNATURE

STATUSES = ("converged", "stalled", "singular", "not finite", "other orbit")
CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(len(STATUSES))

STEP_TOLERANCE = 1e-9
MAX_ITERATIONS = 50
MAX_HALVINGS = 20
ROUNDING = 4.0 * np.finfo(float).eps

MATRIX, VECTOR, INDICES = "float64[:,::1]", "float64[::1]", "int64[:,::1]"
FUNCTION = f"FunctionType({GRID_SIGNATURE})"
GRID = f"{VECTOR}, {VECTOR}, {INDICES}, {INDICES}, int64[::1]"
CUBE = "float64[:,:,::1]"
OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}


@njit(f"boolean({MATRIX}, int64, int64, int64[::1])", **OPTIONS)
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
        if not (largest > 0.0 and largest < np.inf):
            return False
        pivots[j] = pivot
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


@njit(f"void({MATRIX}, int64, int64, int64[::1], {MATRIX})", **OPTIONS)
def solve(band, lower, upper, pivots, right):
    """Solve A·x = b in place for right-hand sides (count, size), with the factors of `factor`."""
    flat = band.reshape(band.size)
    size, one, below = np.uint64(right.shape[1]), np.uint64(1), np.uint64(lower)
    reach, next_row = np.uint64(lower + upper), np.uint64(band.shape[1]) - np.uint64(1)
    for c in range(right.shape[0]):
        x = right[c]
        for j in range(size):
            pivot = np.uint64(pivots[j])
            value = x[pivot]
            x[pivot] = x[j]
            x[j] = value
            diagonal = j * (next_row + one) + below
            for m in range(one, min(below, size - one - j) + one):
                x[j + m] -= flat[diagonal + m * next_row] * value
        for back in range(size):
            i = size - one - back
            diagonal = i * (next_row + one) + below
            value = x[i]
            for k in range(one, min(reach, back) + one):
                value -= flat[diagonal + k] * x[i + k]
            x[i] = value * flat[diagonal]


@njit(f"void({MATRIX}, {VECTOR}, {VECTOR}, {VECTOR}, {INDICES}, {VECTOR}, float64, {MATRIX})", **OPTIONS)
def differentiate(z, drift, first, second, neighbours, tau, frequency, states):
    """Fill `states` (points, 3·states) with q = z + drift·tau and its time derivatives by the scheme."""
    points, count = z.shape
    for i in range(points):
        for s in range(count):
            rate, acceleration = 0.0, 0.0
            for o in range(first.size):
                value = z[neighbours[i, o], s]
                rate += first[o] * value
                acceleration += second[o] * value
            states[i, s] = z[i, s] + drift[s] * tau[i]
            states[i, count + s] = (rate + drift[s]) * frequency
            states[i, 2 * count + s] = acceleration * frequency**2


@njit(f"void({MATRIX}, {VECTOR}, {VECTOR}, {INDICES}, int64[::1], float64, int64, {MATRIX})", **OPTIONS)
def assemble(columns, first, second, shift, place, frequency, lower, band):
    """Fill the folded band of ∂g/∂z from the columns g, ∂g/∂(q, q̇, q̈) of the model's grid function."""
    points = columns.shape[0]
    count = 0
    while count * (1 + 3 * count) < columns.shape[1]:
        count += 1
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


@njit(f"void({MATRIX}, {MATRIX}, {VECTOR}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {VECTOR})", **OPTIONS)
def scales(columns, states, first, second, amplitude, frequency, size, rounding):
    """Fill, for each equation, the size of its terms and the rounding error that its residual cannot fall below."""
    points, count = states.shape[0], amplitude.size
    one, two = 0.0, 0.0
    for o in range(first.size):
        one += abs(first[o]) * frequency
        two += abs(second[o]) * frequency**2
    for e in range(count):
        start = count + e * 3 * count
        size[e], rounding[e] = 0.0, 0.0
        for i in range(points):
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
        rounding[e] *= ROUNDING


@njit(f"float64({MATRIX}, {VECTOR})", **OPTIONS)
def norm(columns, size):
    """Return the root of the mean square of the residuals, each in units of its equation's size.

    A residual that is not zero in an equation of size zero makes it infinite; one that is NaN makes it NaN.
    """
    total = 0.0
    for i in range(columns.shape[0]):
        for e in range(size.size):
            if columns[i, e] != 0.0:
                total += (columns[i, e] / size[e]) ** 2
    return np.sqrt(total / (columns.shape[0] * size.size))


@njit(
    f"Tuple((int64, int64))({FUNCTION}, {GRID}, int64, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, "
    f"{MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, int64[::1])",
    **OPTIONS,
)
def newton(
    residual_jacobian,
    first,
    second,
    neighbours,
    shift,
    place,
    half_width,
    inputs,
    parameters,
    tau,
    frequency,
    drift,
    z,
    states,
    columns,
    history,
    band,
    pivots,
):
    """Solve g(z) = 0 in place and return (status, iterations).

    Parameters
    ----------
    residual_jacobian : compiled grid function of the model
    first, second, neighbours, shift, place, half_width : see `schemes.CyclicGrid`
    inputs : array (points, 3·inputs)
    parameters, tau, frequency : as the grid function takes them
    drift : array (states,)
        Secular rate of each state, per forcing period (a winding angle).
    z : array (points, states)
        The guess, overwritten by the periodic part of the solution.
    states, columns, band, pivots : work arrays
    history : array (MAX_ITERATIONS, 3)
        Filled for each iteration with the scaled residual before it, the scaled full step, and the damping factor.
    """
    points, count = z.shape
    lower = half_width * count + count - 1
    size, rounding, amplitude = np.empty(count), np.empty(count), np.empty(count)
    step, trial = np.empty((1, points * count)), np.empty((points, count))
    differentiate(z, drift, first, second, neighbours, tau, frequency, states)
    residual_jacobian(states, inputs, parameters, tau, frequency, columns)
    for iteration in range(MAX_ITERATIONS):
        for s in range(count):
            amplitude[s] = np.max(np.abs(z[:, s]))
        scales(columns, states, first, second, amplitude, frequency, size, rounding)
        before = norm(columns, size)
        if not np.isfinite(before):
            return NOT_FINITE, iteration
        if iteration == 0 and norm(columns, rounding) <= 1.0 and np.all(amplitude > 0.0):
            return CONVERGED, 0
        assemble(columns, first, second, shift, place, frequency, lower, band)
        if not factor(band, lower, lower, pivots):
            return SINGULAR, iteration
        for i in range(points):
            for s in range(count):
                step[0, place[i] * count + s] = -columns[i, s]
        solve(band, lower, lower, pivots, step)
        full = 0.0
        for s in range(count):
            moved, reached = 0.0, amplitude[s]
            for i in range(points):
                change = step[0, place[i] * count + s]
                moved = max(moved, abs(change))
                reached = max(reached, abs(z[i, s] + change))
            if not np.isfinite(moved):
                return SINGULAR, iteration
            if moved > 0.0:
                full = max(full, moved / reached)
        history[iteration, 0], history[iteration, 1] = before, full
        damping, accepted = 1.0, False
        for _ in range(MAX_HALVINGS):
            for i in range(points):
                for s in range(count):
                    trial[i, s] = z[i, s] + damping * step[0, place[i] * count + s]
            differentiate(trial, drift, first, second, neighbours, tau, frequency, states)
            residual_jacobian(states, inputs, parameters, tau, frequency, columns)
            after = norm(columns, size)
            if after <= (1.0 - 1e-4 * damping) * before or full <= STEP_TOLERANCE:
                accepted = True
                break
            damping *= 0.5
        history[iteration, 2] = damping
        if not accepted:
            return STALLED, iteration + 1
        z[:] = trial
        if full <= STEP_TOLERANCE or (damping == 1.0 and norm(columns, rounding) <= 1.0):
            return CONVERGED, iteration + 1
    return STALLED, MAX_ITERATIONS


@njit(
    f"void({FUNCTION}, {FUNCTION}, {GRID}, int64, {MATRIX}, {MATRIX}, {VECTOR}, float64, {VECTOR}, {VECTOR}, {MATRIX}, "
    f"{CUBE}, {CUBE}, int64[::1], int64[::1])",
    **OPTIONS,
)
def solve_many(
    residual_jacobian,
    outputs,
    first,
    second,
    neighbours,
    shift,
    place,
    half_width,
    inputs,
    parameters,
    tau,
    frequency,
    drift,
    anchor_parameters,
    anchor_z,
    anchor_sensitivities,
    y,
    status,
    iterations,
):
    """Solve for each row of `parameters`, from the anchor's linear prediction and, if that fails, from the anchor."""
    points, count = anchor_z.shape
    lower = half_width * count + count - 1
    states, z = np.empty((points, 3 * count)), np.empty((points, count))
    columns = np.empty((points, count * (1 + 3 * count)))
    history = np.empty((MAX_ITERATIONS, 3))
    band, pivots = np.empty((points * count, 3 * lower + 1)), np.empty(points * count, dtype=np.int64)
    for b in range(parameters.shape[0]):
        theta = parameters[b]
        z[:] = anchor_z
        for p in range(theta.size):
            change = theta[p] - anchor_parameters[p]
            if change != 0.0:
                for i in range(points):
                    for s in range(count):
                        z[i, s] += anchor_sensitivities[p, i, s] * change
        for attempt in range(2):
            if attempt == 1:
                z[:] = anchor_z
            status[b], iterations[b] = newton(
                residual_jacobian,
                first,
                second,
                neighbours,
                shift,
                place,
                half_width,
                inputs,
                theta,
                tau,
                frequency,
                drift,
                z,
                states,
                columns,
                history,
                band,
                pivots,
            )
            if status[b] == CONVERGED:
                break
        outputs(states, inputs, theta, tau, frequency, y[b])
