"""Solutions of condensed equations on the branch that leads from rest to the whole load."""

from typing import Any

import numpy as np

from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.element_forces import Preconditioner, residual_of, times

# Steps of the load along the branch, in units of the load and of the linear response; corrections, their largest ratio,
# the last one, and the smallest cosine between two tangents.
FIRST_LOAD_STEP, SMALLEST_LOAD_STEP, LARGEST_LOAD_STEP = 0.05, 1e-6, 0.1
MOST_LOAD_CORRECTIONS, LOAD_CONTRACTION, LOAD_ERROR, STRAIGHT_TANGENTS = 10, 0.6, 1e-7, 0.9


def with_raised_load(equations: Any, parameters: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """Follow the branch of solutions d while the load grows from zero, through folds; None if that fails."""
    points = 2 * len(start)
    matrices, rates = equations.matrices(parameters, points)[0], equations.rates(points)
    full = times(matrices.d_u, equations.input_harmonics(points))
    d, code, *_ = equations.newton(parameters, start, 0.0)
    load, unit, step = 0.0, float(np.linalg.norm(full)), FIRST_LOAD_STEP
    if code != CONVERGED or not unit > 0.0:
        return None

    def corrected(d: np.ndarray, load: float, along: np.ndarray) -> tuple[np.ndarray, float, np.ndarray, bool]:
        """Return the solution in the plane across a direction, and the tangent there."""
        size, inverse = np.inf, None
        for _ in range(MOST_LOAD_CORRECTIONS):
            forces, known = equations.forces(d, parameters), inverse
            inverse = known or Preconditioner(forces, rates, matrices.d_f)
            residual, _ = residual_of(d, forces, matrices, load * full)
            by_residual, by_load = _stacked(inverse(residual), unit), _stacked(inverse(full), unit)
            change = along[:-1] @ by_residual / (along[:-1] @ by_load + along[-1])
            move, last = _unstacked(change * by_load - by_residual, unit, d.shape), size
            size = float(np.hypot(np.linalg.norm(move) / unit, change))
            if not size < LOAD_CONTRACTION * last:
                if not known:
                    break
                size, inverse = last, None  # the same with the matrix here
                continue
            d, load = d + move, load + change
            if size < LOAD_ERROR:
                return d, load, np.append(by_load, 1.0), True
        return d, load, along, False

    try:
        _, _, before, good = corrected(d, load, np.append(np.zeros(2 * d.size), 1.0))
    except np.linalg.LinAlgError:
        return None
    before /= np.linalg.norm(before)
    while good or step >= SMALLEST_LOAD_STEP:
        try:
            there, at, tangent, good = corrected(
                d + _unstacked(step * before[:-1], unit, d.shape), load + step * before[-1], before
            )
        except np.linalg.LinAlgError:
            return None
        tangent = tangent / np.linalg.norm(tangent)
        turn = float(tangent @ before)
        if not good or abs(turn) < STRAIGHT_TANGENTS:
            step *= 0.5
            if step < SMALLEST_LOAD_STEP:
                return None
            continue
        if at >= 1.0:
            return d + (1.0 - load) / (at - load) * (there - d)
        d, load, before = there, at, tangent * np.sign(turn)
        step = min(1.5 * step, LARGEST_LOAD_STEP * (1.0 + float(np.linalg.norm(there)) / unit))
    return None


def _stacked(amplitudes: np.ndarray, unit: float) -> np.ndarray:
    return np.concatenate([amplitudes.real.ravel(), amplitudes.imag.ravel()]) / unit


def _unstacked(vector: np.ndarray, unit: float, shape: tuple[int, ...]) -> np.ndarray:
    real, imaginary = np.split(vector * unit, 2)
    return (real + 1j * imaginary).reshape(shape)
