"""Many parameter vectors times several orbits of an autonomous model, whose frequency is part of the solution."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from bayesperiodic.parallel import available_cores, in_threads
from bayesperiodic.periodic.batch import PARTS_EACH, Anchor, BatchSolution
from bayesperiodic.periodic.compiled import autonomous_kernels
from bayesperiodic.periodic.equations import PeriodicEquations


class AutonomousBatch:
    """Orbits with their anchors, ready to be followed to many parameter vectors.

    Parameters
    ----------
    sets : sequence of PeriodicEquations
        Of one autonomous model on one grid.
    anchors : sequence of Anchor
        One an orbit.
    """

    def __init__(self, sets: Sequence[PeriodicEquations], anchors: Sequence[Anchor]):
        first, points, states = sets[0], sets[0].grid.points, sets[0].count
        self._first = first
        self._inputs = np.stack([e.at_frequency(a.frequency).inputs for e, a in zip(sets, anchors, strict=True)])
        self._drift = np.stack([e.drift for e in sets])
        parameters = anchors[0].parameters.size
        nothing = np.zeros((parameters, points, states)), np.zeros(parameters)
        self._anchors = (
            np.stack([a.parameters for a in anchors]),
            np.stack([a.z for a in anchors]),
            np.array([a.frequency for a in anchors]),
            np.stack([nothing[0] if a.sensitivities is None else a.sensitivities for a in anchors]),
            np.stack([nothing[1] if a.frequency_sensitivities is None else a.frequency_sensitivities for a in anchors]),
        )
        factored = [Bordered(e, a.parameters, a.z, a.frequency) for e, a in zip(sets, anchors, strict=True)]
        self._chords = tuple(np.stack(parts) for parts in zip(*(f.parts for f in factored), strict=True))
        self._targets = np.array([float(f.row @ a.z.ravel()) for f, a in zip(factored, anchors, strict=True)])
        known = [a.sensitivities is not None for a in anchors]
        self._orientations = np.where(known, [f.orientation for f in factored], 0.0)
        self._width, self._explicit = factored[0].width, factored[0].explicit

    def solve(
        self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False, whole: bool = False
    ) -> BatchSolution:
        """Follow every orbit to its parameter vectors; the result does not depend on the number of threads.

        Parameters
        ----------
        parameters, threads, keep
            See `batch.Batch.solve`.
        whole : bool
            The orbits of a parameter vector count only together. Where one is lost, others that would take more effort
            are not followed, and get its status.
        """
        model, grid, (sets, points, states) = self._first.model, self._first.grid, self._anchors[1].shape
        solves = parameters.shape[-2]
        every = np.empty((sets, solves, parameters.shape[-1]))
        every[:] = parameters
        z = np.empty((sets, solves, points if keep else 0, states))
        y, frequency = np.empty((sets, solves, points, model.kernels.channels)), np.empty((sets, solves))
        status, iterations = np.empty((2, sets, solves), dtype=np.int64)

        def part(block: tuple[int, int]) -> None:
            autonomous_kernels().follow_many(
                model.kernels.residual_jacobian,
                model.kernels.derivatives,
                model.kernels.outputs,
                self._explicit,
                self._width,
                grid.packed,
                self._inputs,
                every,
                grid.tau,
                self._drift,
                self._anchors,
                self._chords,
                self._targets,
                self._orientations,
                *block,
                whole,
                z,
                y,
                frequency,
                status,
                iterations,
            )

        workers = max(1, min(threads or available_cores(), solves))
        parts = 1 if workers == 1 else min(workers * PARTS_EACH, solves)
        in_threads(part, list(pairwise([solves * k // parts for k in range(parts + 1)])), workers)
        return BatchSolution(z, y, frequency, status, iterations)


class Bordered:
    """The factors of [∂g/∂z, ∂g/∂frequency; phase row, 0] at an orbit.

    Attributes
    ----------
    parts : tuple of array
        The band, its pivots, the row in the order of `place`, and what else the compiled functions need.
    work : tuple
        Room for the compiled functions, which ends in the parts.
    row : array (points·states,)
        The phase condition's, in natural order.
    orientation : float
        The sign of the determinant, which changes along a branch at folds alone; 0 where it is singular.
    explicit, width : int
        Where the explicit derivatives by the frequency start among the model's `derivatives`, and how many these are.
    """

    def __init__(self, equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray, frequency: float):
        grid, model = equations.grid, equations.model
        size, lower = z.size, grid.half_width * equations.count + equations.count - 1
        self.width = equations.evaluate("derivatives", z, parameters).shape[1]
        self.explicit = equations.count * (len(model.parameters) + 3 * len(model.inputs))
        self.parts = (
            np.empty((size, 3 * lower + 1)),
            np.empty(size, dtype=np.int64),
            np.empty(size),
            np.empty((2, size)),
            np.empty(4),
        )
        self.work = (
            np.empty((grid.points, 3 * equations.count)),
            np.empty((grid.points, equations.count * (1 + 3 * equations.count))),
            np.empty((grid.points, self.width)),
            np.empty((1, size)),
            self.parts,
        )
        self.orientation = autonomous_kernels().orient(
            model.kernels.residual_jacobian,
            model.kernels.derivatives,
            self.explicit,
            grid.packed,
            equations.at_frequency(frequency).inputs,
            parameters,
            grid.tau,
            frequency,
            equations.drift,
            np.ascontiguousarray(z),
            self.work,
        )
        self.row = self.parts[2].reshape(grid.points, -1)[grid.place].ravel()
