"""Compiled corrections of many condensed solutions with the matrix of Newton's iteration at their anchors."""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from bayesperiodic._compile.functions import grid_function_at

if TYPE_CHECKING:  # defined in this module by `receptance.compiled`
    from bayesperiodic.periodic._kernels.memory import *

CONDENSED_OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}
MOST_CORRECTIONS, CORRECTION_RATE, FIRST_CORRECTION, LAST_CORRECTION, LAST_POLISHED_CORRECTION = (
    12,
    0.3,
    0.5,
    1e-10,
    1e-13,
)
COMPLEX_ROWS = "complex128[:,::1]"


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
        for first in range(0, points, 2 * width):
            for k in range(width):
                turn = turns[k * every]
                if back:
                    turn = turn.conjugate()
                i = first + k
                other = turn * x[i + width]
                x[i + width] = x[i] - other
                x[i] = x[i] + other
        width *= 2


@njit(f"void({ROWS}, int64, complex128[::1], int64[::1], complex128[::1], {COMPLEX_ROWS})", **CONDENSED_OPTIONS)
def harmonics_of(out, elements, turns, place, work, f):
    """Fill the harmonics f (harmonics, elements) of forces, the first columns of `out` (points, …)."""
    points, count = out.shape[0], f.shape[0]
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
    f"void(int64, {COMPLEX_ROWS}, {REALS}, float64, float64, complex128[::1], int64[::1], int64[::1], {ROWS},"
    f"{ROWS}, complex128[::1], {COMPLEX_ROWS})",
    **CONDENSED_OPTIONS,
)
def forces(address, d, parameters, rate, periods, turns, place, blocks, states, out, work, f):
    """Fill the harmonics f of the elements' forces at harmonics d (harmonics, elements).

    The displacement and the velocity over `rate`, 2π times the frequency [Hz], are real and imaginary part of one
    series; so are the forces of two elements. With `blocks` of internal states see `follow_states`, which starts at
    those in `states`; f is not finite if they are not found.
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
    elif not follow_states(
        address, states, out, parameters, rate / (2.0 * np.pi), 4.0 * np.pi * periods / (rate * points), blocks
    ):
        f[:] = np.nan
        return
    harmonics_of(out, elements, turns, place, work, f)


@njit(
    f"void(int64, {REALS}, float64, float64, complex128[::1], int64[::1], int64[::1], {ROWS}, {COMPLEX_ROWS})",
    **CONDENSED_OPTIONS,
)
def forces_on_fewer(address, parameters, rate, periods, turns, place, blocks, states, f):
    """Fill the harmonics f of the forces on half of the points of a motion with internal states, see `forces`."""
    points, variables, elements = states.shape[0] // 2, states.shape[1] // 3, f.shape[1]
    fewer, out = states[::2].copy(), np.empty((points, variables * (1 + 3 * variables)))
    if follow_states(
        address, fewer, out, parameters, rate / (2.0 * np.pi), 4.0 * np.pi * periods / (rate * points), blocks
    ):
        harmonics_of(out, elements, turns[::2].copy(), place[:points] // 2, np.empty(points, dtype=np.complex128), f)
    else:
        f[:] = np.nan


@njit(f"void(float64[:,:,::1], {COMPLEX_ROWS})", **CONDENSED_OPTIONS)
def subtract_steep(steep, step):
    """Correct a step (harmonics, elements) for what steep points change, see `correct_many`."""
    pairs, elements, half = steep.shape[1], step.shape[1], step.size
    factor = np.zeros(pairs)
    for pair in range(pairs):
        total = 0.0
        for at in range(half):
            value = step[at // elements, at % elements]
            total += steep[1, pair, at] * value.real + steep[1, pair, half + at] * value.imag
        factor[pair] = total
    for pair in range(pairs):
        for at in range(half):
            step[at // elements, at % elements] -= factor[pair] * complex(steep[0, pair, at], steep[0, pair, half + at])


@njit(
    "void(int64, complex128[:,:,:,:,::1], complex128[:,:,:,::1], float64[:,:,::1], float64[:,:,:,::1], int64,"
    "float64[:,:,::1], float64[::1], float64, complex128[::1], int64[::1], int64[::1], boolean, int64, int64,"
    "float64[:,::1], complex128[:,:,:,::1], complex128[:,:,:,::1], int64[:,::1], int64[:,::1], float64[:,:,::1],"
    "complex128[:,:,:,::1])",
    **CONDENSED_OPTIONS,
)
def correct_many(
    address, d_f, free, inverse, steep, low, parameters, rate, periods, turns, place, blocks, polish, start, stop,
    moved, d, f, lost, steps, known, fewer,
):  # fmt: skip
    """Correct predicted harmonics d (sets, solves, harmonics, elements) in place, and fill those of the forces, f.

    `d_f` (sets, 1 or solves, harmonics, elements, elements) is the frequency response between the elements, `free` (…,
    harmonics, elements) the displacements without their forces, `inverse` (sets, size, size) the transposed inverse of
    the derivative of the residual by the `low` lowest harmonics at the anchors, `steep` what steep points change, see
    `element_forces.Preconditioner.of_steep`, `moved` (sets, solves) the predicted
    change. `lost` becomes 1 where the steps do not become small at the rate `CORRECTION_RATE`, or the first is
    not below `FIRST_CORRECTION` of the predicted change: the solution may be another one. Internal states, if any,
    start at those of the anchors in `known` (sets, points, 3·variables), and `fewer` becomes f on half of the points.
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
        if blocks.size > 0:
            states[:] = known[e]
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
            for k in range(low):
                for i in range(elements):
                    at = k * elements + i
                    residual[k, i] = complex(step[at], step[size + at])
            subtract_steep(steep[e], residual)
            for k in range(count):
                for i in range(elements):
                    change = residual[k, i]
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
        if done and blocks.size > 0:
            forces_on_fewer(address, theta, rate[e], periods, turns, place, blocks, states, fewer[e, b])


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
