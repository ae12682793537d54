"""Estimates of the discretisation error of a solution, from the solution alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic import fourier
from bayesperiodic.periodic.equations import FREQUENCY
from bayesperiodic.periodic.factors import CyclicFactors
from bayesperiodic.periodic.schemes import CyclicGrid

if TYPE_CHECKING:
    from bayesperiodic.periodic.solution import PeriodicSolution


def estimate_error(solution: PeriodicSolution, z: np.ndarray) -> dict[str, float]:
    """Return the estimated error of each state (and of an autonomous model's frequency); see `PeriodicSolution`.

    Parameters
    ----------
    solution : PeriodicSolution
        A converged one.
    z : array (points, states)
        The periodic part of its states.
    """
    if np.isinf(solution.scheme.order):
        return _upper_spectrum(solution, z)
    grid, frequency = CyclicGrid(solution.scheme, solution.samples, solution.periods), solution.frequency
    defect, slope, derivatives = np.zeros_like(z), np.zeros_like(z), {}
    for order, weights in ((1, grid.first), (2, grid.second)):
        fine, coarse = _derivative(z, grid, weights, 1), _derivative(z, grid, weights, 2) / 2**order
        change = (fine - coarse) / (2.0**solution.scheme.order - 1.0)
        block = solution.linearisation[:, :, order * z.shape[1] : (order + 1) * z.shape[1]]
        defect -= frequency**order * np.einsum("nes,ns->ne", block, change)
        slope += order * frequency ** (order - 1) * np.einsum("nes,ns->ne", block, fine)
        derivatives[order] = fine
    error = _respond(solution, grid, z, defect, slope, derivatives[1])
    return dict(zip([*solution.states, FREQUENCY], error, strict=False))


def _derivative(z: np.ndarray, grid: CyclicGrid, weights: np.ndarray, stride: int) -> np.ndarray:
    """Return the scheme's derivative with its offsets stretched by a stride, its weights as they are."""
    rolled = [w * np.roll(z, -stride * o, axis=0) for o, w in zip(grid.offsets.tolist(), weights.tolist(), strict=True)]
    return np.sum(rolled, axis=0)


def _respond(
    solution: PeriodicSolution,
    grid: CyclicGrid,
    z: np.ndarray,
    defect: np.ndarray,
    slope: np.ndarray,
    rate: np.ndarray,
) -> list[float]:
    """Return how far a defect of the equations moves each state at most, and an autonomous model's frequency."""
    points, count = z.shape
    columns = np.concatenate([np.zeros((points, count)), solution.linearisation.reshape(points, -1)], axis=1)
    factors = CyclicFactors(grid, np.ascontiguousarray(columns), count, solution.frequency)
    if not solution.autonomous:
        return np.abs(factors.solve(defect)).max(axis=0).tolist()
    flow = rate / np.maximum(np.ptp(z, axis=0), np.finfo(float).tiny) ** 2
    flow /= np.linalg.norm(flow)
    solved = factors.solve_bordered(slope[None], flow[None], np.zeros((1, 1)), defect[None], np.zeros((1, 1)))
    if solved is None:
        return [np.nan] * (count + 1)
    return [*np.abs(solved[0][0]).max(axis=0).tolist(), abs(float(solved[1][0, 0]))]


def _upper_spectrum(solution: PeriodicSolution, z: np.ndarray) -> dict[str, float]:
    amplitudes = np.abs(fourier.coefficients(z.T))
    tails = amplitudes[:, 3 * amplitudes.shape[1] // 4 :].sum(axis=1)
    result = dict(zip(solution.states, tails.tolist(), strict=True))
    if solution.autonomous:
        relative = np.max(tails / np.maximum(np.ptp(z, axis=0), np.finfo(float).tiny))
        result[FREQUENCY] = solution.frequency * float(relative)
    return result
