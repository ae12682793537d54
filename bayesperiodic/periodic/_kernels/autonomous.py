"""The compiled code of autonomous batches: orbits of unknown frequency, followed from their anchors.

Loaded through the kernel cache together with the functions of `kernels` that it imports (see `compiled`).

The unknowns are z and the frequency; the last equation is a phase condition, row · z = target. The matrix ∂g/∂z alone
is nearly singular, along the orbit. So its last pivot in the folded order, where this gathers, is replaced by one of
ordinary size, and what this changes is undone as one more unknown beside the frequency.
"""

import numpy as np
from numba import njit

from bayesperiodic.periodic._kernels.newton import (
    CHORD_RATE,
    CONVERGED,
    CUBE,
    FAR,
    FUNCTION,
    GAINS,
    GRID,
    INDICES,
    MATRIX,
    MAX_ITERATIONS,
    NOT_FINITE,
    OPTIONS,
    OTHER_ORBIT,
    PLACES,
    SINGULAR,
    SMALLEST_PART,
    STALLED,
    STEP_TOLERANCE,
    VECTOR,
    assemble,
    copy,
    differentiate,
    dot,
    factor,
    is_far,
    largest,
    norm,
    predict,
    scaled_step,
    scales,
    solve,
)

SHRUNK, ABSENT = 1e-6, 1e-6
MAX_SECANTS, SECANT_RATE = 12, 0.5
BORDERED = f"Tuple(({MATRIX}, {PLACES}, {VECTOR}, {MATRIX}, {VECTOR}))"
ANCHOR = f"Tuple(({VECTOR}, {MATRIX}, float64, {CUBE}, {VECTOR}))"
WORK = f"Tuple(({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {BORDERED}))"


@njit(f"float64({BORDERED})", **OPTIONS)
def border(bordered):
    """Factor [∂g/∂z, ∂g/∂f; row, 0] in place; return the sign of its determinant, 0 where it is singular.

    Along a branch of orbits the sign changes at folds alone.

    Parameters
    ----------
    bordered : band, pivots, row, sides, small
        The folded band of ∂g/∂z (size, …) and where its pivots go (size,); the row in the folded order (size,); `sides`
        (2, size), of which the first is ∂g/∂f in that order; `small` (4,). Overwritten but for the row.
    """
    band, pivots, row, sides, small = bordered
    size, lower = band.shape[0], (band.shape[1] - 1) // 3
    pivots[size - 1] = -1
    regular = factor(band, lower, lower, pivots)
    pivot = band[size - 1, lower]
    if pivots[size - 1] < 0 or not abs(pivot) < np.inf:
        return 0.0
    sign, logarithm, at = 1.0, 0.0, size - 1
    for j in range(size - 2, -1, -1):
        logarithm -= np.log(abs(band[j, lower]))
        if (band[j, lower] < 0.0) != (pivots[j] != j):
            sign = -sign
        if pivots[j] == at:
            at = j
        elif at == j:
            at = pivots[j]
    ordinary = np.exp(logarithm / max(size - 1, 1))
    band[size - 1, lower] = 1.0 / ordinary
    for i in range(size):
        sides[1, i] = 0.0
    sides[1, at] = ordinary - 1.0 / pivot if regular else ordinary
    solve(band, lower, lower, pivots, sides)
    a, b, c, d = 0.0, 0.0, -sides[0, size - 1], sides[1, size - 1] - 1.0
    for i in range(size):
        a -= row[i] * sides[0, i]
        b += row[i] * sides[1, i]
    determinant = a * d - b * c
    if not (abs(determinant) > 0.0 and abs(determinant) < np.inf):
        return 0.0
    small[0], small[1], small[2], small[3] = d / determinant, -b / determinant, -c / determinant, a / determinant
    return -sign if determinant > 0.0 else sign


@njit(f"float64({BORDERED}, float64, {MATRIX})", **OPTIONS)
def bordered_solve(bordered, missing, right):
    """Solve [∂g/∂z, ∂g/∂f; row, 0]·(x, y) = (right, missing) with the factors of `border`; return y.

    `right` (1, size), in the folded order, is overwritten by x.
    """
    band, pivots, row, sides, small = bordered
    size, lower = band.shape[0], (band.shape[1] - 1) // 3
    solve(band, lower, lower, pivots, right)
    left, last = missing, -right[0, size - 1]
    for i in range(size):
        left -= row[i] * right[0, i]
    change, undone = small[0] * left + small[1] * last, small[2] * left + small[3] * last
    for i in range(size):
        right[0, i] += undone * sides[1, i] - change * sides[0, i]
    return change


@njit(f"float64({MATRIX}, {MATRIX}, {GRID}, {VECTOR})", **OPTIONS)
def phase_row(z, states, grid, row):
    """Fill the row of the phase condition against z, states in units of their range, folded; return row · z."""
    place, points, count = grid[4], z.shape[0], z.shape[1]
    square = 0.0
    for s in range(count):
        low, high, mean = np.inf, -np.inf, 0.0
        for i in range(points):
            low, high = min(low, z[i, s]), max(high, z[i, s])
            mean += states[i, count + s] / points
        unit = high - low if high > low else 1.0
        for i in range(points):
            value = (states[i, count + s] - mean) / unit**2
            row[place[i] * count + s] = value
            square += value**2
    target, length = 0.0, np.sqrt(square) if square > 0.0 else 1.0
    for i in range(points):
        for s in range(count):
            row[place[i] * count + s] /= length
            target += row[place[i] * count + s] * z[i, s]
    return target


@njit(f"float64({MATRIX}, {GRID}, {VECTOR})", **OPTIONS)
def along(z, grid, row):
    """Return row · z of a folded row."""
    total, count = 0.0, z.shape[1]
    for i in range(z.shape[0]):
        for s in range(count):
            total += row[grid[4][i] * count + s] * z[i, s]
    return total


@njit(f"void({MATRIX}, {MATRIX}, {MATRIX}, int64, {GRID}, float64, {MATRIX})", **OPTIONS)
def frequency_slopes(states, columns, table, explicit, grid, frequency, sides):
    """Fill the first of `sides` with ∂g/∂f, z held in tau, folded; `table` has ∂g/∂f itself from column `explicit`."""
    place, count = grid[4], states.shape[1] // 3
    for i in range(states.shape[0]):
        for e in range(count):
            value, start = table[i, explicit + e], count + e * 3 * count
            for s in range(count):
                value += columns[i, start + count + s] * states[i, count + s] / frequency
                value += columns[i, start + 2 * count + s] * 2.0 * states[i, 2 * count + s] / frequency
            sides[0, place[i] * count + e] = value


@njit(f"void({MATRIX}, {GRID}, {MATRIX})", **OPTIONS)
def negative(columns, grid, right):
    """Fill `right` (1, size) with −g, folded."""
    count = right.shape[1] // columns.shape[0]
    for i in range(columns.shape[0]):
        for e in range(count):
            right[0, grid[4][i] * count + e] = -columns[i, e]


@njit(f"void({MATRIX}, {GRID}, {MATRIX})", **OPTIONS)
def unfold(right, grid, step):
    """Fill `step` (points, states) from the folded order."""
    count = step.shape[1]
    for i in range(step.shape[0]):
        for s in range(count):
            step[i, s] = right[0, grid[4][i] * count + s]


@njit(
    f"float64({FUNCTION}, {FUNCTION}, int64, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {MATRIX}, "
    f"{WORK})",
    **OPTIONS,
)
def orient(
    residual_jacobian, derivatives, explicit, grid, inputs, parameters, tau, frequency, drift, z, work
):  # fmt: skip
    """Leave the bordered factors at an orbit in the work arrays, phase row included; return their orientation."""
    states, columns, table, _, bordered = work
    differentiate(z, drift, grid, tau, frequency, states)
    residual_jacobian(states, inputs, parameters, tau, frequency, columns)
    derivatives(states, inputs, parameters, tau, frequency, table)
    phase_row(z, states, grid, bordered[2])
    frequency_slopes(states, columns, table, explicit, grid, frequency, bordered[3])
    assemble(columns, grid, z.shape[1], frequency, bordered[0])
    return border(bordered)


@njit(
    f"Tuple((int64, int64, float64, float64))({FUNCTION}, {FUNCTION}, int64, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, "
    f"float64, {VECTOR}, {MATRIX}, {WORK})",
    **OPTIONS,
)
def newton_free(
    residual_jacobian, derivatives, explicit, grid, inputs, parameters, tau, frequency, drift, z, work
):  # fmt: skip
    """Solve for z, in place, and the frequency; return status, iterations, frequency and orientation.

    Full steps alone: the first that does not bring the equations nearer ends it, "stalled". The phase is the one
    closest to the guess, whose row takes part in the orientation.
    """
    states, columns, table, right, bordered = work
    points, count = z.shape[0], z.shape[1]
    size, rounding, amplitude = np.empty(count), np.empty(count), np.empty(count)
    step, trial = np.empty((points, count)), np.empty((points, count))
    start, previous, orientation = frequency, np.inf, 0.0
    differentiate(z, drift, grid, tau, frequency, states)
    residual_jacobian(states, inputs, parameters, tau, frequency, columns)
    target = phase_row(z, states, grid, bordered[2])
    for iteration in range(MAX_ITERATIONS):
        largest(z, amplitude)
        scales(columns, states, grid, amplitude, frequency, size, rounding)
        before = norm(columns, size)
        if not before < np.inf:
            return NOT_FINITE, iteration, frequency, 0.0
        derivatives(states, inputs, parameters, tau, frequency, table)
        frequency_slopes(states, columns, table, explicit, grid, frequency, bordered[3])
        assemble(columns, grid, count, frequency, bordered[0])
        orientation = border(bordered)
        if orientation == 0.0:
            return SINGULAR, iteration, frequency, 0.0
        negative(columns, grid, right)
        faster = bordered_solve(bordered, target - along(z, grid, bordered[2]), right)
        unfold(right, grid, step)
        full = max(scaled_step(z, step), abs(faster) / max(start, frequency))
        if not full < np.inf:
            return SINGULAR, iteration, frequency, 0.0
        if not frequency + faster > 0.0:
            return STALLED, iteration, frequency, orientation
        for i in range(points):
            for s in range(count):
                trial[i, s] = z[i, s] + step[i, s]
        differentiate(trial, drift, grid, tau, frequency + faster, states)
        residual_jacobian(states, inputs, parameters, tau, frequency + faster, columns)
        after, rounded = norm(columns, size), norm(columns, rounding) <= 1.0
        if not (after < before or full <= STEP_TOLERANCE or rounded):
            return STALLED, iteration + 1, frequency, orientation
        copy(trial, z)
        frequency += faster
        if full <= STEP_TOLERANCE or rounded:
            return CONVERGED, iteration + 1, frequency, orientation
        if full < CHORD_RATE * previous < np.inf and full**2 <= STEP_TOLERANCE * previous:
            return CONVERGED, iteration + 1, frequency, orientation
        previous = full
    return STALLED, MAX_ITERATIONS, frequency, orientation


@njit(
    f"Tuple((boolean, int64, float64))({FUNCTION}, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {MATRIX}, "
    f"{BORDERED}, float64, {WORK})",
    **OPTIONS,
)
def secant(
    residual_jacobian, grid, inputs, parameters, tau, frequency, drift, z, kept, target, work
):  # fmt: skip
    """Improve z in place with the factors at an anchor; return whether that converged, the steps, and the frequency.

    Broyden's method: a step with the anchor's factors is corrected by what the steps before it have shown of the
    present matrix. What such a step is without corrections must always be less than `SECANT_RATE` times the step
    before. So every direction in which the orbit is still to be improved has a stiffness of the sign that it has at the
    anchor, and no fold is crossed. (C. G. Broyden, Mathematics of Computation 19 (1965) 577-593; without matrices:
    C. T. Kelley, Iterative Methods for Linear and Nonlinear Equations, SIAM, 1995, section 7.3.)
    """
    states, columns, _, right, _ = work
    points, count = z.shape[0], z.shape[1]
    step, unit, first = np.empty((points, count)), np.empty(count), frequency
    taken, squares, previous = np.empty((MAX_SECANTS, points * count + 1)), np.empty(MAX_SECANTS), np.inf
    largest(z, unit)
    for s in range(count):
        unit[s] = unit[s] if unit[s] > 0.0 else 1.0
    for iteration in range(MAX_SECANTS):
        differentiate(z, drift, grid, tau, frequency, states)
        residual_jacobian(states, inputs, parameters, tau, frequency, columns)
        negative(columns, grid, right)
        own = taken[iteration]
        own[points * count] = bordered_solve(kept, target - along(z, grid, kept[2]), right) / first
        unfold(right, grid, step)
        for i in range(points):
            for s in range(count):
                own[i * count + s] = step[i, s] / unit[s]
        if iteration > 0 and not dot(own, own) < SECANT_RATE**2 * squares[iteration - 1]:
            return False, iteration + 1, frequency
        for k in range(iteration):
            share = dot(taken[k], own) / squares[k]
            if k < iteration - 1:
                for i in range(own.size):
                    own[i] += share * taken[k + 1, i]
            else:
                for i in range(own.size):
                    own[i] /= 1.0 - share
        squares[iteration] = dot(own, own)
        full = 0.0
        for i in range(own.size):
            full = max(full, abs(own[i]))
        if not (full < FAR and squares[iteration] > 0.0) or not frequency + own[points * count] * first > 0.0:
            return full == 0.0, iteration + 1, frequency
        for i in range(points):
            for s in range(count):
                z[i, s] += own[i * count + s] * unit[s]
        frequency += own[points * count] * first
        if full <= STEP_TOLERANCE or (iteration > 0 and full**2 <= STEP_TOLERANCE * previous):
            return True, iteration + 1, frequency
        previous = full
    return False, MAX_SECANTS, frequency


@njit(f"float64(float64, {VECTOR}, {VECTOR}, {VECTOR}, float64)", **OPTIONS)
def predicted_frequency(frequency, sensitivities, anchor_parameters, parameters, fraction):
    """Return the anchor's linear prediction of the frequency, or its own where that is not positive."""
    result = frequency
    for p in range(parameters.size):
        result += fraction * (parameters[p] - anchor_parameters[p]) * sensitivities[p]
    return result if result > 0.0 else frequency


@njit(f"boolean({MATRIX}, {MATRIX})", **OPTIONS)
def has_shrunk(z, start):
    """Return whether an orbit has shrunk to an equilibrium."""
    for s in range(z.shape[1]):
        low, high, lowest, highest = np.inf, -np.inf, np.inf, -np.inf
        for i in range(z.shape[0]):
            low, high = min(low, z[i, s]), max(high, z[i, s])
            lowest, highest = min(lowest, start[i, s]), max(highest, start[i, s])
        if high - low > SHRUNK * (highest - lowest):
            return False
    return True


@njit(f"float64({MATRIX}, int64)", **OPTIONS)
def power(z, harmonic):
    """Return the power of a harmonic, all states together."""
    points, total = z.shape[0], 0.0
    for s in range(z.shape[1]):
        real, imaginary = 0.0, 0.0
        for i in range(points):
            angle = 2.0 * np.pi * ((harmonic * i) % points) / points
            real += z[i, s] * np.cos(angle)
            imaginary += z[i, s] * np.sin(angle)
        total += real**2 + imaginary**2
    return total


@njit(f"boolean({MATRIX})", **OPTIONS)
def has_shorter_period(z):
    """Return whether only every k-th harmonic is there, for a k of 2 or more."""
    points, whole = z.shape[0], 0.0
    for s in range(z.shape[1]):
        for i in range(points):
            whole += z[i, s] ** 2 * points
    if power(z, 1) > ABSENT**2 * whole:  # it is then there, and no larger power has to be looked for
        return False
    powers, strongest, divisor = np.empty(points // 2), 0.0, 0
    for k in range(powers.size):
        powers[k] = power(z, k + 1)
        strongest = max(strongest, powers[k])
    for k in range(powers.size):
        if powers[k] > ABSENT**2 * strongest:
            one, other = k + 1, divisor
            while other > 0:
                one, other = other, one % other
            divisor = one
    return divisor > 1


@njit(f"boolean({MATRIX}, {MATRIX}, {MATRIX}, float64, float64)", **OPTIONS)
def has_leapt(z, predicted, start, frequency, expected):
    """Return whether an orbit is no continuation of the one at `start`: far off, shrunk, or of a shorter period."""
    if is_far(z, predicted, start) or abs(frequency - expected) > FAR * expected:
        return True
    return has_shrunk(z, start) or has_shorter_period(z)


@njit(
    f"Tuple((int64, int64, float64))({FUNCTION}, {FUNCTION}, int64, {GRID}, {MATRIX}, {VECTOR}, {VECTOR}, {VECTOR}, "
    f"{ANCHOR}, float64, {MATRIX}, {WORK})",
    **OPTIONS,
)
def creep(
    residual_jacobian, derivatives, explicit, grid, inputs, parameters, tau, drift, anchor, orientation, z, work
):  # fmt: skip
    """Follow an orbit from the anchor's parameters to others; return status, iterations and frequency.

    All the way at once, from the linear prediction, or else in smaller steps: one that fails, or leaps, or crosses a
    fold is halved, and where one failed the next goes half of what is left, so that a fold is closed in from both
    sides. Where the steps become too small, the orbit that is sought is not there: "other orbit".
    """
    anchor_parameters, anchor_z, anchor_frequency, sensitivities, slopes = anchor
    points, count = anchor_z.shape
    here, last, predicted = np.empty((points, count)), np.empty((points, count)), np.empty((points, count))
    between, done, step, before, failed, used = np.empty(parameters.size), 0.0, 1.0, 1.0, np.inf, 0
    copy(anchor_z, here)
    now = anchor_frequency
    predict(anchor_z, sensitivities, anchor_parameters, parameters, -1.0, last)
    earlier = predicted_frequency(now, slopes, anchor_parameters, parameters, -1.0)
    while done < 1.0:
        ratio = step / before
        for i in range(points):
            for s in range(count):
                predicted[i, s] = here[i, s] + ratio * (here[i, s] - last[i, s])
        for p in range(parameters.size):
            between[p] = anchor_parameters[p] + (done + step) * (parameters[p] - anchor_parameters[p])
        expected = now + ratio * (now - earlier)
        expected = expected if expected > 0.0 else now
        copy(predicted, z)
        code, more, frequency, side = newton_free(
            residual_jacobian, derivatives, explicit, grid, inputs, between, tau, expected, drift, z, work
        )  # fmt: skip
        used += more
        if code != CONVERGED or side * orientation < 0.0 or has_leapt(z, predicted, here, frequency, expected):
            if 0.5 * step < SMALLEST_PART:
                return OTHER_ORBIT if code == CONVERGED or code == STALLED else code, used, now
            failed, step = done + step, 0.5 * step
            continue
        copy(here, last)
        copy(z, here)
        earlier, now = now, frequency
        done, before = done + step, step
        if done >= failed:
            failed = np.inf
        step = min(2.0 * step, 1.0 - done)
        if done + step >= failed:
            step = 0.5 * (failed - done) if failed - done >= 2.0 * SMALLEST_PART else failed - done
    return CONVERGED, used, now


@njit(f"void({MATRIX}, float64, {MATRIX})", **OPTIONS)
def change_speed(inputs, ratio, result):
    """Fill u, u̇, ü at another frequency, so many times as high."""
    count = inputs.shape[1] // 3
    for i in range(inputs.shape[0]):
        for k in range(count):
            result[i, k] = inputs[i, k]
            result[i, count + k] = inputs[i, count + k] * ratio
            result[i, 2 * count + k] = inputs[i, 2 * count + k] * ratio**2


@njit(
    f"void({FUNCTION}, {FUNCTION}, {FUNCTION}, int64, int64, {GRID}, {CUBE}, {CUBE}, {VECTOR}, {MATRIX}, "
    f"Tuple(({MATRIX}, {CUBE}, {VECTOR}, {GAINS}, {MATRIX})), Tuple(({CUBE}, {INDICES}, {MATRIX}, {CUBE}, {MATRIX})), "
    f"{VECTOR}, {VECTOR}, int64, int64, boolean, {GAINS}, {GAINS}, {MATRIX}, {INDICES}, {INDICES})",
    **OPTIONS,
)
def follow_many(
    residual_jacobian,
    derivatives,
    outputs,
    explicit,
    width,
    grid,
    inputs,
    parameters,
    tau,
    drift,
    anchors,
    chords,
    targets,
    orientations,
    start,
    stop,
    whole,
    kept_z,
    y,
    frequency,
    status,
    iterations,
):
    """Follow every orbit to its parameter vectors start … stop: by secant steps, or else as `creep` does.

    Nothing depends on the order of the solves.

    Parameters
    ----------
    explicit, width : int
        Where ∂g/∂f starts in the columns of `derivatives`, and how many these are.
    inputs : array (sets, points, 3·inputs)
        At the anchors' frequencies.
    parameters : array (sets, solves, parameters)
    drift : array (sets, states)
    anchors : parameters, z, frequency, sensitivities, frequency_sensitivities
        Arrays (sets, …).
    chords : what `border` takes and leaves, arrays (sets, …)
    targets, orientations : arrays (sets,)
        Of the phase conditions; an orientation of 0 says that an anchor is a mere guess, without factors.
    whole : bool
        Whether the orbits of a parameter vector count only together: those after a lost one get its status at once.
    kept_z : array (sets, solves, points, states), or without entries if z is not wanted
    y : array (sets, solves, points, channels)
    frequency : array (sets, solves)
    status, iterations : int arrays (sets, solves)
    """
    bands, pivots, rows, sides, small = chords
    sets, points, count = anchors[1].shape
    size = points * count
    work = (
        np.empty((points, 3 * count)), np.empty((points, count * (1 + 3 * count))), np.empty((points, width)),
        np.empty((1, size)),
        (np.empty_like(bands[0]), np.empty_like(pivots[0]), np.empty(size), np.empty((2, size)), np.empty(4)),
    )  # fmt: skip
    predicted, z, own = np.empty((points, count)), np.empty((points, count)), np.empty_like(inputs[0])
    for b in range(start, stop):
        lost = CONVERGED
        for e in range(sets):
            theta = parameters[e, b]
            anchor = (anchors[0][e], anchors[1][e], anchors[2][e], anchors[3][e], anchors[4][e])
            predict(anchor[1], anchor[3], anchor[0], theta, 1.0, predicted)
            expected = predicted_frequency(anchor[2], anchor[4], anchor[0], theta, 1.0)
            copy(predicted, z)
            close, used, f, code = False, 0, expected, lost
            if orientations[e] != 0.0 and not (whole and lost != CONVERGED):
                close, used, f = secant(
                    residual_jacobian, grid, inputs[e], theta, tau, expected, drift[e], z,
                    (bands[e], pivots[e], rows[e], sides[e], small[e]), targets[e], work,
                )  # fmt: skip
                close = close and not has_leapt(z, predicted, anchor[1], f, expected)
            if close:
                code = CONVERGED
            elif not (whole and lost != CONVERGED):
                code, more, f = creep(
                    residual_jacobian, derivatives, explicit, grid, inputs[e], theta, tau, drift[e], anchor,
                    orientations[e], z, work,
                )  # fmt: skip
                used += more
            lost = max(lost, code)
            change_speed(inputs[e], f / anchor[2], own)
            differentiate(z, drift[e], grid, tau, f, work[0])
            outputs(work[0], own, theta, tau, f, y[e, b])
            if kept_z.size > 0:
                copy(z, kept_z[e, b])
            frequency[e, b], status[e, b], iterations[e, b] = f, code, used
