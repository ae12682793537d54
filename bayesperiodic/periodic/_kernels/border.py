"""Compiled functions of bordered systems: further scalar unknowns of the equations, and the phase condition.

A bordered system is solved also where ∂g/∂z is singular, as it is along the orbit of an autonomous model and at folds.
The last functions detect equilibria and repeated orbits of autonomous models.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import types

from bayesperiodic._compile.functions import grid_function_at

if TYPE_CHECKING:  # defined in this module by `compiled.kernels`
    from bayesperiodic.periodic._kernels.linear import *


@inlined(NUMBER(MATRIX, PLACES), **INNER)
def determinant_sign(band, pivots):
    """Return the sign of the determinant, without the last pivot, of a matrix factored by `factor`."""
    sign, lower = 1.0, (band.shape[1] - 1) // 3
    for j in range(band.shape[0] - 1):
        if (band[j, lower] < 0.0) != (pivots[j] != j):
            sign = -sign
    return sign


@kernel(NUMBER(MATRIX, PLACES, BORDER), **OPTIONS)
def factor_bordered(band, pivots, border):
    """Factor [∂g/∂z, B; C, D] in place; return the sign of its determinant, 0 where it is singular.

    The last pivot of ∂g/∂z in the folded order, where the singularity of a cyclic system gathers, is replaced by one of
    ordinary size; the change is undone by one more bordering unknown. Along a branch of solutions the sign changes only
    at folds. `band` is that of ∂g/∂z; the border is in the folded order.
    """
    columns, rows, small = border.columns, border.rows, border.small
    borders, size, lower = rows.shape[0], band.shape[0], (band.shape[1] - 1) // 3
    pivots[size - 1] = -1
    regular = factor(band, lower, lower, pivots)
    pivot = band[size - 1, lower]
    if pivots[size - 1] < 0 or not abs(pivot) < np.inf:
        return 0.0
    logarithm, at = 0.0, size - 1
    for j in range(size - 2, -1, -1):
        logarithm -= np.log(abs(band[j, lower]))
        if pivots[j] == at:
            at = j
        elif at == j:
            at = pivots[j]
    ordinary = np.exp(logarithm / max(size - 1, 1))
    band[size - 1, lower] = 1.0 / ordinary
    for i in range(size):
        columns[borders, i] = 0.0
    columns[borders, at] = ordinary - 1.0 / pivot if regular else ordinary
    solve(band, lower, lower, pivots, columns)
    for c in range(small.shape[0]):
        for k in range(small.shape[1]):
            small[c, k] = 0.0
        for b in range(small.shape[0]):
            entry = b - c + borders
            sign = 1.0 if b == borders else -1.0
            if c == borders:
                small[c, entry] = sign * columns[b, size - 1]
            else:
                for i in range(size):
                    small[c, entry] += sign * rows[c, i] * columns[b, i]
                if b < borders:
                    small[c, entry] += border.corner[c, b]
    small[borders, borders] -= 1.0
    if not factor(small, borders, borders, border.pivots):
        return 0.0
    last = -1.0 if small[borders, borders] < 0.0 else 1.0
    return -determinant_sign(band, pivots) * determinant_sign(small, border.pivots) * last


@kernel(types.void(MATRIX, PLACES, BORDER, MATRIX, MATRIX), **OPTIONS)
def solve_bordered(band, pivots, border, right, below):
    """Solve [∂g/∂z, B; C, D]·(x, y) = (right, below) in place with the factors of `factor_bordered`.

    `right` (sides, size) is in the folded order; `below` is (sides, borders).
    """
    columns, rows = border.columns, border.rows
    borders, size, lower = rows.shape[0], band.shape[0], (band.shape[1] - 1) // 3
    known = np.empty((1, borders + 1))
    solve(band, lower, lower, pivots, right)
    for r in range(right.shape[0]):
        for c in range(borders):
            known[0, c] = below[r, c]
            for i in range(size):
                known[0, c] -= rows[c, i] * right[r, i]
        known[0, borders] = -right[r, size - 1]
        solve(border.small, borders, borders, border.pivots, known)
        for c in range(borders):
            below[r, c] = known[0, c]
            for i in range(size):
                right[r, i] -= known[0, c] * columns[c, i]
        for i in range(size):
            right[r, i] += known[0, borders] * columns[borders, i]


@kernel(NUMBER(MATRIX, MATRIX, GRID, VECTOR), **OPTIONS)
def phase_row(z, states, grid, row):
    """Fill the row (size,), folded, of the phase condition ∫ q_z'·(q − q_z) dτ = 0 against z; return row · z.

    States are in units of their range; the row has unit length. `states` are those of z.
    """
    points, count = z.shape[0], z.shape[1]
    rates, square, target = np.empty((points, count)), 0.0, 0.0
    for s in range(count):
        low, high, mean = np.inf, -np.inf, 0.0
        for i in range(points):
            low, high = min(low, z[i, s]), max(high, z[i, s])
            mean += states[i, count + s] / points
        unit = high - low if high > low else 1.0
        for i in range(points):
            rates[i, s] = (states[i, count + s] - mean) / unit**2
            square += rates[i, s] ** 2
    length = np.sqrt(square) if square > 0.0 else 1.0
    for i in range(points):
        for s in range(count):
            rates[i, s] /= length
            target += rates[i, s] * z[i, s]
    fold(rates, grid, row)
    return target


@inlined(types.void(MATRIX, NUMBER, MATRIX), **INNER)
def scale_rates(inputs, ratio, result):
    """Fill u, u̇, ü at another frequency, `ratio` times as high."""
    count = inputs.shape[1] // 3
    for i in range(inputs.shape[0]):
        for k in range(count):
            result[i, k] = inputs[i, k]
            result[i, count + k] = inputs[i, count + k] * ratio
            result[i, 2 * count + k] = inputs[i, 2 * count + k] * ratio**2


@kernel(NUMBER(SETTING, UNKNOWNS, VECTOR, MATRIX, VECTOR), **OPTIONS)
def fill_setting(setting, unknowns, values, inputs, parameters):
    """Fill inputs and parameters at values of the unknowns, from the setting at zeros; return the frequency."""
    frequency = setting.frequency
    copy(setting.inputs, inputs)
    for p in range(parameters.size):
        parameters[p] = setting.parameters[p]
    for k in range(values.size):
        for p in range(parameters.size):
            parameters[p] += values[k] * unknowns.parameters[k, p]
        for i in range(unknowns.inputs.shape[1]):
            for j in range(inputs.shape[1]):
                inputs[i, j] += values[k] * unknowns.inputs[k, i, j]
        if k == unknowns.frequency:
            frequency = values[k]
    if frequency != setting.frequency:
        scale_rates(inputs, frequency / setting.frequency, inputs)
    return frequency


@kernel(types.void(ADDRESSES, GRID, SETTING, UNKNOWNS, MATRIX, MATRIX, MATRIX, MATRIX), **OPTIONS)
def fill_slopes(functions, grid, setting, unknowns, states, columns, table, slopes):
    """Fill the first rows of `slopes` with ∂g/∂(unknowns), z held as a function of tau, folded.

    `states` and `columns` are those of `residual_jacobian` at z; `table` has room for the columns of `derivatives`.
    """
    points, parameters, frequency = states.shape[0], setting.parameters.size, setting.frequency
    count, inputs = states.shape[1] // 3, setting.inputs.shape[1]
    grid_function_at(functions.derivatives)(states, setting.inputs, setting.parameters, grid.tau, frequency, table)
    by_input, by_frequency = count * parameters, count * (parameters + inputs)
    for k in range(unknowns.values.size):
        for i in range(points):
            for e in range(count):
                value = 0.0
                for p in range(parameters):
                    value += table[i, e * parameters + p] * unknowns.parameters[k, p]
                if unknowns.inputs.shape[1] > 0:
                    for j in range(inputs):
                        value += table[i, by_input + e * inputs + j] * unknowns.inputs[k, i, j]
                if k == unknowns.frequency:
                    value += table[i, by_frequency + e]
                    for s in range(3 * count):
                        value += columns[i, count + e * 3 * count + s] * (s // count) * states[i, s] / frequency
                    for j in range(inputs):
                        order = 3 * j // inputs
                        value += table[i, by_input + e * inputs + j] * order * setting.inputs[i, j] / frequency
                slopes[k, grid.place[i] * count + e] = value


@inlined(NUMBER(MATRIX, VECTOR, GRID), **INNER)
def folded_product(z, row, grid):
    """Return row · z, the row (size,) in the folded order."""
    total, count = 0.0, z.shape[1]
    for i in range(z.shape[0]):
        for s in range(count):
            total += row[grid.place[i] * count + s] * z[i, s]
    return total


@kernel(
    types.Tuple([NUMBER, NUMBER])(
        ADDRESSES, GRID, SETTING, UNKNOWNS, BORDER, MATRIX, MATRIX, MATRIX, MATRIX, WORKSPACE, VECTOR
    ),
    **INNER,
)
def bordered_step(functions, grid, setting, unknowns, border, states, columns, z, step, work, change):
    """Fill the Newton step of z and of the unknowns' values; return its size and the orientation, 0 if singular."""
    borders, count, factors = unknowns.values.size, z.shape[1], work.factors
    fill_slopes(functions, grid, setting, unknowns, states, columns, work.derivatives, border.columns)
    assemble(columns, grid, count, setting.frequency, factors.band)
    orientation = factor_bordered(factors.band, factors.pivots, border)
    if orientation == 0.0:
        return np.inf, 0.0
    right, below, size = np.empty((1, z.size)), np.empty((1, borders)), 0.0
    fold(step, grid, right[0])
    for b in range(borders):
        below[0, b] = unknowns.targets[b] - folded_product(z, border.rows[b], grid)
        for c in range(borders):
            below[0, b] -= border.corner[b, c] * unknowns.values[c]
    solve_bordered(factors.band, factors.pivots, border, right, below)
    unfold(right[0], grid, step)
    for k in range(borders):
        change[k] = below[0, k]
        relative = abs(change[k]) / max(unknowns.scales[k], abs(unknowns.values[k]))
        size = max(size, relative) if relative < np.inf else np.inf
    return size, orientation


@inlined(FLAG(MATRIX, MATRIX), **OPTIONS)
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


@inlined(NUMBER(MATRIX, COUNT), **INNER)
def power(z, harmonic):
    """Return the power of a harmonic, summed over the states."""
    points, total = z.shape[0], 0.0
    for s in range(z.shape[1]):
        real, imaginary = 0.0, 0.0
        for i in range(points):
            angle = 2.0 * np.pi * ((harmonic * i) % points) / points
            real += z[i, s] * np.cos(angle)
            imaginary += z[i, s] * np.sin(angle)
        total += real**2 + imaginary**2
    return total


@kernel(FLAG(MATRIX), **OPTIONS)
def has_shorter_period(z):
    """Return whether only every k-th harmonic is present, for a k of 2 or more."""
    points, whole = z.shape[0], 0.0
    for s in range(z.shape[1]):
        for i in range(points):
            whole += z[i, s] ** 2 * points
    if power(z, 1) > ABSENT**2 * whole:
        return False
    powers, strongest, divisor = np.empty(points // 2), 0.0, 0
    for k in range(powers.size):
        powers[k] = power(z, k + 1)
        strongest = max(strongest, powers[k])
    for k in range(powers.size):
        if powers[k] > ABSENT**2 * strongest:
            divisor = math.gcd(k + 1, divisor)
    return divisor > 1
