"""The compiled code of batches: forced orbits at many parameter vectors, each predicted from the anchor of its inputs.

Loaded through the kernel cache, with the functions of `kernels` that it imports as they are there (see `compiled`).
"""

import numpy as np
from numba import njit

from bayesperiodic.models.code_generation import grid_function_at
from bayesperiodic.periodic._kernels.newton import (
    CHORD_RATE,
    CONVERGED,
    CUBE,
    FACTORS,
    FAR,
    FUNCTION,
    GAINS,
    GRID,
    INDICES,
    LARGEST_PART,
    MATRIX,
    MAX_ITERATIONS,
    OPTIONS,
    OTHER_ORBIT,
    PLACES,
    SMALLEST_PART,
    STATES,
    STEP_TOLERANCE,
    VECTOR,
    back_substitute,
    copy,
    differentiate,
    dot,
    is_far,
    largest,
    newton,
    predict,
    repetitions,
)

MAX_CHORDS = 6
PREDICTION_RATE = 30.0
LEAST_STIFFNESS, MOST_STIFFNESS = 0.3, 3.0
POLISHED = 1e-12


@njit(f"float64({VECTOR}, {VECTOR})", **OPTIONS)
def in_units(reached, amplitude):
    """Return the largest of what each state has reached, in units of its amplitude; no state at rest counts."""
    result = 0.0
    for s in range(reached.size):
        if reached[s] > 0.0:
            result = max(result, reached[s] / amplitude[s])
    return result


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
    right : array (points, states)
        The direction, so long that its stiffness is 1 for the ∂g/∂z of the factors.
    """
    count = STATES if STATES > 0 else z.shape[1]
    position, step, reached = z.reshape(z.size), change.reshape(z.size), np.empty(count)
    weights, direction = left.reshape(left.size), right.reshape(right.size)
    if not (stiffness > LEAST_STIFFNESS and stiffness < MOST_STIFFNESS):
        return False, 0, 0.0
    correction, tolerance = 1.0 / stiffness - 1.0, STEP_TOLERANCE * min(1.0, stiffness)
    previous, moved, rate, converged = predicted, 0.0, PREDICTION_RATE, False
    for iteration in range(MAX_CHORDS):
        differentiate(z, drift, grid, tau, frequency, states)
        residual(states, inputs, parameters, tau, frequency, change)
        along = correction * dot(weights, step) if correction != 0.0 else 0.0
        back_substitute(grid, factors, change)
        for k in range(step.size):
            step[k] += along * direction[k]
            position[k] -= step[k]
        if not dot(step, step) < np.inf:
            return False, iteration + 1, moved
        largest(change, reached)
        full = in_units(reached, amplitude)
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


@njit(f"boolean({MATRIX}, int64)", **OPTIONS)
def was_damped(history, iterations):
    """Return whether Newton's iteration took a shortened step."""
    for iteration in range(iterations):
        if history[iteration, 2] < 1.0:
            return True
    return False


@njit(
    f"Tuple((int64, int64))({FUNCTION}, {GRID}, int64, {MATRIX}, {VECTOR}, {VECTOR}, float64, {VECTOR}, {VECTOR}, "
    f"{MATRIX}, {CUBE}, boolean, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {FACTORS})",
    **OPTIONS,
)
def creep(
    residual_jacobian, grid, periods, inputs, parameters, tau, frequency, drift, anchor_parameters, anchor_z,
    sensitivities, leapt, z, history, states, columns, factors,
):  # fmt: skip
    """Follow an orbit from the anchor's parameters to others in small steps; return status and iterations.

    A step that fails, or leads too far, is halved. `leapt` says that the orbit was lost before by a leap.
    """
    points, count = anchor_z.shape
    predicted, here, last = np.empty((points, count)), np.empty((points, count)), np.empty((points, count))
    once, used, done, step, before = repetitions(anchor_z, periods), 0, 0.0, LARGEST_PART, LARGEST_PART
    copy(anchor_z, here)
    predict(anchor_z, sensitivities, anchor_parameters, parameters, -before, last)
    while done < 1.0:
        for i in range(points):
            for s in range(count):
                predicted[i, s] = here[i, s] + (here[i, s] - last[i, s]) * (step / before)
        copy(predicted, z)
        between = anchor_parameters + (parameters - anchor_parameters) * (done + step)
        code, more = newton(
            residual_jacobian, grid, inputs, between, tau, frequency, drift, z, history, states, columns, factors
        )  # fmt: skip
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


@njit(
    f"void({PLACES}, {GRID}, int64, {CUBE}, {CUBE}, {VECTOR}, {VECTOR}, {MATRIX}, {MATRIX}, "
    f"{CUBE}, {GAINS}, {MATRIX}, {MATRIX}, {VECTOR}, "
    f"Tuple(({CUBE}, {INDICES}, {GAINS}, float64[:,:,:,:,::1], {GAINS}, {INDICES}, {MATRIX}, {INDICES})), "
    f"{CUBE}, {CUBE}, {CUBE}, {PLACES}, int64, int64, boolean, boolean, {GAINS}, {GAINS}, {CUBE}, {INDICES}, "
    f"{INDICES})",
    **OPTIONS,
)
def solve_many(
    functions,
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
    rates,
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
    functions : int array (3,)
        Addresses of the model's `residual`, `residual_jacobian` and `outputs`.
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
    rates : bool
        Whether the outputs depend on q̇ or q̈.
    kept_z : array (sets, solves, points, states), or without entries if z is not wanted
    y : array (sets, solves, points, channels), or without entries if the outputs are not wanted
    squares : array (sets, solves, measured)
        Filled with the sums of squares of data minus outputs.
    status, iterations : int arrays (sets, solves)
    """
    residual, residual_jacobian = grid_function_at(functions[0]), grid_function_at(functions[1])
    outputs = grid_function_at(functions[2])
    bands, pivots, inverses, gains, transfers, ends, reduced, reduced_pivots = anchor_factors
    points, count = anchor_z.shape[1], STATES if STATES > 0 else anchor_z.shape[2]
    solves = parameters.shape[1]
    states, z = np.empty((points, 3 * count)), np.empty((points, count))
    predicted, change, room = np.empty((points, count)), np.empty((points, count)), np.empty((points, y.shape[3]))
    reached, residuals = np.empty(count), np.empty(points)
    columns, history = np.empty((points, count * (1 + 3 * count))), np.empty((MAX_ITERATIONS, 3))
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
            for i in range(points):
                for s in range(count):
                    change[i, s] = predicted[i, s] - at[i, s]
            largest(change, reached)
            close, used, moved = chord(
                residual, grid, inputs[e], theta, tau, f, turn, anchor_amplitude[e], stiffness,
                in_units(reached, anchor_amplitude[e]), polish, z, states, change, kept, anchor_left[e],
                anchor_right[e],
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
            code, more = creep(
                residual_jacobian, grid, periods, inputs[e], theta, tau, f, turn, anchor_parameters[e], at,
                anchor_sensitivities[e], code == CONVERGED, z, history, states, columns, own,
            )  # fmt: skip
            used += more
        if rates:
            differentiate(z, turn, grid, tau, f, states)
        else:
            for i in range(points):
                for s in range(count):
                    states[i, s] = z[i, s] + turn[s] * tau[i]
        out = y[e, b] if y.size > 0 else room
        outputs(states, inputs[e], theta, tau, f, out)
        for m in range(measured.size):
            for i in range(points):
                residuals[i] = out[i, measured[m]] - data[e, i, m]
            squares[e, b, m] = dot(residuals, residuals)
        if kept_z.size > 0:
            copy(z, kept_z[e, b])
        status[e, b], iterations[e, b] = code, used
