"""Many parameter vectors in one compiled call, shared among the cores."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numba import njit

from bayesperiodic.parallel import available_cores
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.newton import CONVERGED, FUNCTION, GRID, MATRIX, MAX_ITERATIONS, OPTIONS, VECTOR, newton

SMALLEST_PART = 4
CUBE = "float64[:,:,::1]"


@dataclass(frozen=True)
class Anchor:
    """A solved point from which others are predicted: z ≈ z₀ + z_θ (θ − θ₀).

    Parameters
    ----------
    parameters : array (parameters,)
    z : array (points, states)
    sensitivities : array (parameters, points, states)
    """

    parameters: np.ndarray
    z: np.ndarray
    sensitivities: np.ndarray


@njit(
    f"void({FUNCTION}, {FUNCTION}, {GRID}, int64, {MATRIX}, {MATRIX}, {VECTOR}, float64, {VECTOR}, {VECTOR}, {MATRIX}, "
    f"{CUBE}, {CUBE}, int64[::1], int64[::1])",
    **OPTIONS,
)
def _solve_many(
    residual_jacobian, outputs, first, second, neighbours, shift, place, half_width, inputs, parameters, tau, frequency, drift,
    anchor_parameters, anchor_z, anchor_sensitivities, y, status, iterations,
):
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
                residual_jacobian, first, second, neighbours, shift, place, half_width, inputs, theta, tau, frequency,
                drift, z, states, columns, history, band, pivots,
            )
            if status[b] == CONVERGED:
                break
        outputs(states, inputs, theta, tau, frequency, y[b])


def solve_batch(
    equations: PeriodicEquations, parameters: np.ndarray, anchor: Anchor, threads: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for many parameter vectors; the result does not depend on the number of threads.

    Each solve starts from the anchor's linear prediction and, if that fails, from the anchor itself.

    Parameters
    ----------
    equations : PeriodicEquations
    parameters : array (solves, parameters)
    anchor : Anchor
    threads : int, optional
        By default as many as there are cores.

    Returns
    -------
    outputs : array (solves, points, channels)
    status : int array (solves,)
        Index into `newton.STATUSES`.
    iterations : int array (solves,)
    """
    grid, kernels = equations.grid, equations.model.kernels
    parameters = np.ascontiguousarray(parameters, dtype=float)
    solves = len(parameters)
    y = np.empty((solves, grid.points, kernels.channels))
    status, iterations = np.empty(solves, dtype=np.int64), np.empty(solves, dtype=np.int64)

    def part(block: slice) -> None:
        _solve_many(
            kernels.residual_jacobian, kernels.outputs, grid.first, grid.second, grid.neighbours, grid.shift,
            grid.place, grid.half_width, equations.inputs, parameters[block], grid.tau, equations.frequency, equations.drift,
            anchor.parameters, anchor.z, anchor.sensitivities, y[block], status[block], iterations[block],
        )

    parts = max(1, min(threads or available_cores(), solves // SMALLEST_PART))
    edges = [solves * k // parts for k in range(parts + 1)]
    first, *others = [slice(*pair) for pair in pairwise(edges)]
    elsewhere = [_threads().submit(part, block) for block in others]
    part(first)
    for future in elsewhere:
        future.result()
    return y, status, iterations


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(available_cores(), thread_name_prefix="bayesperiodic")
