"""Forces of the elements of a condensed model, linearised, and the solves of its linearised equations in harmonics."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from bayesperiodic._linalg import factors
from bayesperiodic.periodic.harmonics import harmonics, on_grid, transform_tables
from bayesperiodic.periodic.memory import Memory
from bayesperiodic.periodic.receptance import compiled

# Share of a step that is left by harmonics whose coupling by the elements is neglected in Newton's matrix.
WEAK_COUPLING = 0.05
# The same with internal states, by which a change at one moment lasts; corrections of Newton's step with such states,
# and their last one relative to it.
WEAK_COUPLING_OF_MEMORY, MOST_STEP_SWEEPS, LAST_STEP_SWEEP = 0.0125, 20, 1e-4
# Points of the internal states per low harmonic in Newton's matrix.
LEAST_PRECONDITIONER_POINTS = 8
# Numbers of points and elements with steep forces that may be treated apart, and solves for which one matrix counts.
STEEP_POINTS, COUNTED_SOLVES = (0, 8, 16, 32, 64, 128, 256, 512), 1000.0
# Size of a matrix up to which no point is treated apart.
SMALL_MATRIX = 64
# Size of a matrix beyond which its factors serve for few corrections, these, and their largest ratio.
LARGEST_INVERSE, MOST_FACTOR_CORRECTIONS, FACTOR_CORRECTION_RATE = 400, 12, 0.3
MOST_LINEAR_SWEEPS, LINEAR_SWEEP_ERROR = 200, 1e-13
# Ratio of two corrections below which the next one is estimated.
FAST_SWEEPS = 0.1
# Relative size below which corrections that do not become smaller are rounding errors. While an element sticks, its
# internal state hardly forgets, and errors add up over the periods that it remembers.
ROUNDED_SWEEP = 1e-8


class Forces(NamedTuple):
    """Forces of the elements on a grid, (points, elements), and their derivatives by displacement and velocity.

    The latter are with the internal states held.
    """

    values: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    memory: Memory | None = None  # by internal states


class ResponseMatrices(NamedTuple):
    """Frequency response at harmonics, each (…, harmonics, rows, columns)."""

    d_f: np.ndarray
    d_u: np.ndarray
    y_f: np.ndarray
    y_u: np.ndarray

    @property
    def largest(self) -> np.ndarray:
        """Largest modulus of y_f over the harmonics, (…, rows, columns)."""
        return np.asarray(np.abs(self.y_f).max(axis=-3))


class Steep(NamedTuple):
    """Points and elements at which forces are steep, with what their slopes exceed the median ones by, all (pairs,)."""

    points: np.ndarray
    elements: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray

    def rest(self, forces: Forces) -> Forces:
        """Return the forces with the median slopes there."""
        stiffness, damping = forces.stiffness.copy(), forces.damping.copy()
        stiffness[self.points, self.elements] -= self.stiffness
        damping[self.points, self.elements] -= self.damping
        return forces._replace(stiffness=stiffness, damping=damping)


def steep_points(forces: Forces, rates: np.ndarray, d_f: np.ndarray) -> Steep:
    """Return the points and elements that leave the matrix of the low harmonics small if they are treated apart.

    A force that changes within few points, as friction does at a reversal, couples all harmonics. With internal states
    there are none.
    """
    none = np.zeros(0, dtype=int)
    if forces.memory is not None or (
        2 * d_f.shape[-1] * Preconditioner.strongly_coupled(forces, rates, d_f) <= SMALL_MATRIX
    ):
        return Steep(none, none, *np.zeros((2, 0)))
    slopes = [part - np.median(part, axis=0) for part in forces[1:3]]
    size = np.sqrt(np.sum(np.abs(d_f) ** 2, axis=1))
    gains = [factor.max(axis=0) for factor in (size, rates[:, None] * size)]
    steepest = sum(np.abs(slope) * gain for slope, gain in zip(slopes, gains, strict=True))
    points, elements = np.unravel_index(np.argsort(-np.ravel(steepest)), forces.values.shape)

    def first(number: int) -> Steep:
        chosen = points[:number], elements[:number]
        return Steep(*chosen, *(slope[chosen] for slope in slopes))

    def cost(steep: Steep) -> float:
        low = Preconditioner.strongly_coupled(steep.rest(forces), rates, d_f)
        matrix, apart, every = 2 * low * d_f.shape[-1], len(steep.points), 2 * len(d_f) * d_f.shape[-1]
        once = matrix**3 + apart * (matrix**2 + apart**2 + apart * every)
        return float(once + COUNTED_SOLVES * (matrix**2 + 2 * apart * every))

    return min((first(number) for number in STEEP_POINTS if number <= points.size // 2), key=cost)


class Preconditioner:
    """Inverse of the derivative of the residual by the harmonics of d, exact for the low ones and at steep points.

    The higher ones, which the elements couple only weakly, are treated as uncoupled. What `steep` points add is of low
    rank, and is inverted by the formula of Woodbury. Without a number of low harmonics both are chosen. Solves raise a
    LinAlgError where the derivative is singular.
    """

    def __init__(self, forces: Forces, rates: np.ndarray, d_f: np.ndarray, low: int = 0, steep: Steep | None = None):
        points, self.elements = forces.values.shape
        if not low and self.elements:
            steep = steep_points(forces, rates, d_f)
        self._steep, self._rates, self._d_f = steep, rates, d_f
        forces = steep.rest(forces) if steep else forces
        self.low = low = low or self.strongly_coupled(forces, rates, d_f)
        numbers = np.arange(low)
        stiffness, damping = (np.fft.fft(part, axis=0).T / points for part in forces[1:3])
        difference, total = (numbers[:, None] - numbers) % points, (numbers[:, None] + numbers) % points
        turning = 1j * rates[:low]
        same = stiffness[:, difference] + damping[:, difference] * turning
        mirrored = stiffness[:, total] - damping[:, total] * turning
        mirrored[:, :, 0] = 0.0
        by_part = [same + mirrored, 1j * (same - mirrored)]
        if forces.memory is not None:
            by_part = [a + b for a, b in zip(by_part, _of_units(forces.memory, rates, low), strict=True)]
        sums = [np.einsum("kab,bkl->kalb", d_f[:low], part) for part in by_part]
        unit = np.einsum("kl,ab->kalb", np.eye(low), np.eye(self.elements))
        by_real, by_imaginary = (s + u for s, u in zip(sums, (unit, 1j * unit), strict=True))
        blocks = [[by_real.real, by_imaginary.real], [by_real.imag, by_imaginary.imag]]
        size = low * self.elements
        matrix = np.block([[block.reshape(size, size) for block in row] for row in blocks])
        # The imaginary parts of the means are zero.
        zero = slice(size, size + self.elements)
        matrix[zero], matrix[:, zero] = 0.0, 0.0
        matrix[zero, zero] = np.eye(self.elements)
        self.matrix = matrix

    @cached_property
    def _factors(self) -> tuple[np.ndarray, np.ndarray]:
        return factors(self.matrix)

    @cached_property
    def transposed_inverse(self) -> np.ndarray:
        """Transposed inverse for the low harmonics without steep points.

        Real parts of harmonics and elements are before the imaginary ones.
        """
        return np.ascontiguousarray(np.linalg.inv(self.matrix).T)

    @cached_property
    def of_steep(self) -> np.ndarray:
        """What steep points change, (2, pairs, 2·harmonics·elements).

        The second part by a vector, without steep points, gives the factors of the vectors in the first, which are
        subtracted from it. Real parts of harmonics and elements are before the imaginary ones.
        """
        count = len(self._rates)
        if not (self._steep and len(self._steep.points)):
            return np.zeros((2, 0, 2 * count * self.elements))
        at, element, stiffness, damping = self._steep
        numbers, points, each = np.arange(count), 2 * count, np.arange(len(at))
        turns = np.exp(2j * np.pi * (np.outer(at, numbers) % points) / points)
        moved = self._without_steep(self._d_f[:, :, element].transpose(2, 0, 1) * turns.conj()[..., None] / points)
        # Twice the real part of the sum over harmonics, of which the mean counts once.
        slopes = 2.0 * turns * (stiffness[:, None] + 1j * self._rates * damping[:, None])
        slopes[:, 0] *= 0.5
        seen = np.zeros((len(at), 2, count, self.elements))
        seen[each, 0, :, element], seen[each, 1, :, element] = slopes.real, -slopes.imag
        left, right = _parts_of(moved), seen.reshape(len(at), -1)
        closed = np.eye(len(at)) + right @ left.T
        return np.stack([left, scipy.linalg.lu_solve(factors(closed), right, check_finite=False)])

    @staticmethod
    def strongly_coupled(forces: Forces, rates: np.ndarray, d_f: np.ndarray) -> int:
        """Return the number of low harmonics beyond which all are coupled weakly."""
        steepest = np.abs(forces.stiffness).max(axis=0) + rates[:, None] * np.abs(forces.damping).max(axis=0)
        weak = WEAK_COUPLING
        if forces.memory is not None:
            steepest, weak = steepest + forces.memory.steepest(rates), WEAK_COUPLING_OF_MEMORY
        coupling = np.sqrt(np.sum(np.abs(d_f * steepest[:, None, :]) ** 2, axis=(1, 2)))
        return min(len(rates), int(np.flatnonzero(~(coupling < weak)).max(initial=0)) + 1)

    def __call__(self, right: np.ndarray) -> np.ndarray:
        """Return the approximate solution (…, harmonics, elements) for a right-hand side of that shape."""
        result = self._without_steep(right)
        if not (self._steep and len(self._steep.points)):
            return result
        left, seen = self.of_steep
        real, imaginary = np.split(_parts_of(result) @ seen.T @ left, 2, axis=-1)
        return result - (real + 1j * imaginary).reshape(result.shape)

    def _without_steep(self, right: np.ndarray) -> np.ndarray:
        result, low = right.copy(), right[..., : self.low, :]
        if not self.elements:
            return result
        flat = np.concatenate([part.reshape(*right.shape[:-2], -1) for part in (low.real, low.imag)], axis=-1)
        columns = flat.reshape(-1, flat.shape[-1]).T
        solved = scipy.linalg.lu_solve(self._factors, columns, check_finite=False).T.reshape(flat.shape)
        real, imaginary = np.split(solved, 2, axis=-1)
        result[..., : self.low, :] = (real + 1j * imaginary).reshape(low.shape)
        return result


def _parts_of(values: np.ndarray) -> np.ndarray:
    """Return real and imaginary parts side by side, (…, 2·harmonics·elements)."""
    flat = values.reshape(*values.shape[:-2], -1)
    return np.concatenate([flat.real, flat.imag], axis=-1)


def times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return matrices (…, rows, columns) times vectors (…, columns)."""
    return (matrices @ vectors[..., None])[..., 0]


def residual_of(
    d: np.ndarray, forces: Forces, matrices: ResponseMatrices, free: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the residual and the size of its terms."""
    parts = d, times(matrices.d_f, harmonics(forces.values)), -free
    return parts[0] + parts[1] + parts[2], max(*(float(np.linalg.norm(part)) for part in parts), np.finfo(float).tiny)


def linearised(forces: Forces, rates: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the change of the forces for a change of d, harmonics (…, harmonics, elements) both."""
    points = len(forces.values)
    d, v = on_grid(moved, points), on_grid(1j * rates[:, None] * moved, points)
    change = forces.stiffness * d + forces.damping * v
    if forces.memory is not None:
        columns = [np.moveaxis(part.reshape(-1, *d.shape[-2:]), 0, -1) for part in (d, v)]
        change = change + np.moveaxis(forces.memory.along(*columns), -1, 0).reshape(change.shape)
    return harmonics(change)


def _of_units(memory: Memory, rates: np.ndarray, low: int) -> list[np.ndarray]:
    """Return changes of the forces by internal states for unit real and imaginary harmonics of d.

    They are (elements, harmonics, harmonics), the latter those of d, of as many low harmonics. Fewer points than those
    of the forces suffice.
    """
    memory = memory.on_fewer(LEAST_PRECONDITIONER_POINTS * low)
    points, elements = len(memory.states), memory.elements
    turns = np.exp(2j * np.pi * np.arange(points) / points)
    waves = 2.0 * turns[np.outer(np.arange(points), np.arange(low)) % points]
    waves[:, 0] = 1.0
    columns = np.concatenate([waves, 1j * waves], axis=1)
    turning = 1j * np.tile(rates[:low], 2) * columns
    d, v = (np.broadcast_to(part.real[:, None], (points, elements, 2 * low)) for part in (columns, turning))
    by_harmonic = harmonics(memory.along(d, v).reshape(points, -1))[:low].reshape(low, elements, 2, low)
    return [*by_harmonic.transpose(2, 1, 0, 3)]


def newton_step(
    forces: Forces, rates: np.ndarray, d_f: np.ndarray, residual: np.ndarray, known: Preconditioner
) -> tuple[np.ndarray, Preconditioner]:
    """Return Newton's step, corrected for the higher harmonics, and its preconditioner.

    With internal states one that is `known` from a step before serves if the corrections become small with it.
    """
    if known.low <= len(rates):
        step = _swept(known, forces, rates, d_f, residual, MOST_STEP_SWEEPS, LAST_STEP_SWEEP)
        if step is not None:
            return step, known
    if forces.memory is None:
        return known(residual), known
    inverse = Preconditioner(forces, rates, d_f)
    step = _swept(inverse, forces, rates, d_f, residual, MOST_STEP_SWEEPS, LAST_STEP_SWEEP)
    return (inverse(residual) if step is None else step), inverse


def corrected(
    equations: Any, parameters: np.ndarray, d: np.ndarray, forces: Forces, d_f: np.ndarray, free: np.ndarray,
    known: Preconditioner,
) -> np.ndarray | None:  # fmt: skip
    """Return the solution near harmonics d by corrections with a fixed matrix; None if they do not become small fast.

    `free` (harmonics, elements) are the displacements without the forces of the elements.
    """
    if forces.memory is None and len(known.matrix) > LARGEST_INVERSE:
        return _corrected_by_factors(equations, parameters, d, d_f, free, known)
    kernels, blocks = equations.model.element_kernels, np.array(equations.model.state_blocks, dtype=np.int64)
    (count, elements), result = d.shape, d[None, None].copy()
    lost, steps = np.zeros((2, 1, 1), dtype=np.int64)
    states = np.zeros((2 * count, 3 * (elements + blocks.sum()))) if forces.memory is None else forces.memory.states
    fewer = np.empty((1, 1, count // 2 if blocks.size else 0, elements), dtype=complex)
    address = (kernels.residual_jacobian if blocks.size else kernels.residual).address if elements else 0
    compiled().correct_many(
        address, np.ascontiguousarray(d_f)[None, None], free[None, None], known.transposed_inverse[None],
        known.of_steep[None], known.low, parameters[None, None], np.array([2 * np.pi * equations.frequency]),
        float(equations.grid.periods), *transform_tables(2 * count), blocks, True, 0, 1, np.full((1, 1), np.inf),
        result, np.empty_like(result), lost, steps, states[None], fewer,
    )  # fmt: skip
    return None if lost[0, 0] else np.asarray(result[0, 0])


def _corrected_by_factors(
    equations: Any, parameters: np.ndarray, d: np.ndarray, d_f: np.ndarray, free: np.ndarray, known: Preconditioner
) -> np.ndarray | None:
    """Do what `corrected` does without the inverse of a large matrix."""
    before = np.inf
    for _ in range(MOST_FACTOR_CORRECTIONS):
        forces = equations.forces(d, parameters)
        step = known(d + times(d_f, harmonics(forces.values)) - free)
        d = d - step
        length, size = float(np.linalg.norm(step)), float(np.linalg.norm(d))
        if length <= LINEAR_SWEEP_ERROR * size:
            return d
        if not length < FACTOR_CORRECTION_RATE * before:
            return d if length <= ROUNDED_SWEEP * LAST_STEP_SWEEP * size else None
        before = length
    return None


def linear_solve(forces: Forces, rates: np.ndarray, d_f: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Return x of the linearised equations (…, harmonics, elements); None if they are singular."""
    inverse = Preconditioner(forces, rates, d_f)
    try:
        return _swept(inverse, forces, rates, d_f, right, MOST_LINEAR_SWEEPS, LINEAR_SWEEP_ERROR)
    except np.linalg.LinAlgError:
        return None


def _swept(
    inverse: Preconditioner, forces: Forces, rates: np.ndarray, d_f: np.ndarray, right: np.ndarray, most: int,
    last: float,
) -> np.ndarray | None:  # fmt: skip
    """Return x of the linearised equations, corrected until the last correction is small; None if it is not."""
    x, before = inverse(right), np.inf
    for _ in range(most):
        step = inverse(right - x - times(d_f, linearised(forces, rates, x)))
        x = x + step
        size, length = float(np.linalg.norm(x)), float(np.linalg.norm(step))
        if not np.isfinite(size):
            return None
        # Where corrections become small fast, the next one is smaller than this by the same ratio.
        left = length * length / before if length < FAST_SWEEPS * before < np.inf else length
        if left <= last * size or before <= length <= ROUNDED_SWEEP * size:
            return x
        before = length
    return None
