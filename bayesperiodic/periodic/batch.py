"""Many parameter vectors in one compiled call, shared among the cores."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from bayesperiodic.parallel import available_cores
from bayesperiodic.periodic.compiled import solve_many
from bayesperiodic.periodic.equations import PeriodicEquations

SMALLEST_PART = 4


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
        Index into `compiled.STATUSES`.
    iterations : int array (solves,)
    """
    grid, kernels = equations.grid, equations.model.kernels
    parameters = np.ascontiguousarray(parameters, dtype=float)
    solves = len(parameters)
    y = np.empty((solves, grid.points, kernels.channels))
    status, iterations = np.empty(solves, dtype=np.int64), np.empty(solves, dtype=np.int64)

    def part(block: slice) -> None:
        solve_many(
            kernels.residual_jacobian,
            kernels.outputs,
            grid.first,
            grid.second,
            grid.neighbours,
            grid.shift,
            grid.place,
            grid.half_width,
            equations.inputs,
            parameters[block],
            grid.tau,
            equations.frequency,
            equations.drift,
            anchor.parameters,
            anchor.z,
            anchor.sensitivities,
            y[block],
            status[block],
            iterations[block],
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
