"""Many parameter vectors times many input sets of a forced model, shared among the cores."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.periodic.compiled import adjoint_kernels, autonomous_kernels, batch_kernels
from bayesperiodic.periodic.equations import PeriodicEquations, empty_factors
from bayesperiodic.periodic.sensitivity import Sensitivities, parameter_sensitivities, softening, softest_direction

SMALLEST_PART, PARTS_EACH = 4, 4
NO_FACTORS = -1


class BatchSolution(NamedTuple):
    """What a batch of solves ended with.

    Attributes
    ----------
    z : array (sets, solves, points, states)
        The periodic parts; without entries unless they were asked for.
    outputs : array (sets, solves, points, channels)
    frequency : array (sets, solves)
        [Hz].
    status : int array (sets, solves)
        Index into `compiled.STATUSES`.
    iterations : int array (sets, solves)
        Chord steps and Newton iterations.
    """

    z: np.ndarray
    outputs: np.ndarray
    frequency: np.ndarray
    status: np.ndarray
    iterations: np.ndarray


@dataclass(frozen=True)
class Anchor:
    """A solved point from which others are predicted: z ≈ z₀ + z_θ (θ − θ₀); or, without z_θ, a mere guess.

    Attributes
    ----------
    parameters : array (parameters,)
    z : array (points, states)
    frequency : float
        [Hz].
    sensitivities : array (parameters, points, states), or None
    frequency_sensitivities : array (parameters,), or None
        Zero for a forced model.
    """

    parameters: np.ndarray
    z: np.ndarray
    frequency: float
    sensitivities: np.ndarray | None = None
    frequency_sensitivities: np.ndarray | None = None

    @classmethod
    def at(cls, equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> "Anchor":
        """Return the anchor at a solution z; a mere guess where ∂g/∂z is singular."""
        derivative = parameter_sensitivities(equations, z, parameters)
        return cls.of(equations, parameters, z, derivative, np.arange(parameters.size))

    @classmethod
    def of(
        cls,
        equations: PeriodicEquations,
        parameters: np.ndarray,
        z: np.ndarray,
        derivative: Sensitivities | None,
        moving: np.ndarray,
    ) -> "Anchor":
        """Return the anchor at a solution z with derivatives by the parameters `moving` (indices), zero by others."""
        if derivative is None:
            return cls(parameters, z, equations.frequency)
        states, frequency = np.zeros((parameters.size, *z.shape)), np.zeros(parameters.size)
        states[moving], frequency[moving] = derivative.states[: moving.size], derivative.frequency[: moving.size]
        return cls(parameters, z, equations.frequency, states, frequency)


class Batch:
    """Input sets with their anchors, ready to be solved for many parameter vectors.

    Parameters
    ----------
    sets : sequence of PeriodicEquations
        Of one forced model on one grid; inputs, frequencies and winding numbers may differ.
    anchors : sequence of Anchor
        One a set.
    """

    def __init__(self, sets: Sequence[PeriodicEquations], anchors: Sequence[Anchor]):
        first = sets[0]
        layout = first.grid.scheme, first.grid.samples, first.grid.periods
        if any(e.model is not first.model or (e.grid.scheme, e.grid.samples, e.grid.periods) != layout for e in sets):
            raise ValueError("sets: all must have the same model, scheme, samples and periods.")
        self._first, self._size = first, len(sets)
        self._factors = empty_factors(first.grid, first.count, (len(sets),))
        sensitivities = np.zeros((len(sets), len(first.model.parameters), first.grid.points, first.count))
        left = np.zeros((len(sets), first.grid.points, first.count))
        right = np.zeros((len(sets), first.grid.points, 3 * first.count))
        slopes, amplitude = np.zeros(sensitivities.shape[:2]), np.stack([np.abs(a.z).max(axis=0) for a in anchors])
        for e, (equations, anchor) in enumerate(zip(sets, anchors, strict=True)):
            own = tuple(part[e] for part in self._factors)
            own[5][0] = NO_FACTORS
            if anchor.sensitivities is not None:
                sensitivities[e] = anchor.sensitivities
                columns = equations.residual_jacobian(anchor.z, anchor.parameters)
                if not equations.factorise(columns, anchor.z, own):
                    own[5][0] = NO_FACTORS
                left[e], right[e] = softest_direction(equations, anchor.z, columns)
                slopes[e] = softening(equations, anchor.z, anchor.parameters, sensitivities[e], left[e], right[e])
        ranges = np.stack([np.ptp(a.z, axis=0) for a in anchors])
        ratios = np.divide(ranges, amplitude, out=np.full(ranges.shape, np.inf), where=amplitude > 0.0)
        near = first.kernels.FAR * ratios.min(axis=1)
        self._shared = (
            first.grid.tau,
            np.array([e.frequency for e in sets]),
            np.stack([e.drift for e in sets]),
            np.stack([a.parameters for a in anchors]),
            np.stack([a.z for a in anchors]),
            sensitivities,
            amplitude,
            slopes,
            near,
            self._factors,
            left,
            np.ascontiguousarray(right[..., : first.count]),
        )
        self._inputs = np.stack([e.inputs for e in sets])

    @cached_property
    def _kernels(self) -> SimpleNamespace:
        return batch_kernels(self._first.count, self._first.grid.stencil)

    @cached_property
    def _functions(self) -> np.ndarray:
        kernels = self._first.model.kernels
        return np.array([kernels.residual.address, kernels.residual_jacobian.address, kernels.outputs.address])

    def solve(self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False) -> BatchSolution:
        """Solve every input set for every parameter vector; the result does not depend on the number of threads.

        Parameters
        ----------
        parameters : array (sets, solves, parameters), or (solves, parameters) if they are those of every set
        threads : int, optional
            By default as many as there are cores.
        keep : bool
            Return z too, after further chord steps, so that what is derived from it is as exact as it can be.
        """
        model, grid = self._first.model, self._first.grid
        solves = parameters.shape[-2]
        z = np.empty((self._size, solves, grid.points if keep else 0, self._first.count))
        y = np.empty((self._size, solves, grid.points, model.kernels.channels))
        nothing = np.empty((self._size, grid.points, 0)), np.empty(0, dtype=np.int64)
        _, status, iterations = self._solve(parameters, *nothing, z, y, threads, keep)
        frequency = np.repeat(self._shared[1][:, None], solves, axis=1)
        return BatchSolution(z, y, frequency, status, iterations)

    def squares(
        self, parameters: np.ndarray, data: np.ndarray, measured: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Solve likewise, and return no more than the sums of squares of data minus outputs, and the status.

        Parameters
        ----------
        parameters : array (sets, solves, parameters)
        data : array (sets, points, measured)
        measured : int array (measured,)
            The channels that the data are of.
        threads : int, optional

        Returns
        -------
        squares : array (sets, solves, measured)
        status : int array (sets, solves)
        """
        solves, channels = parameters.shape[-2], self._first.model.kernels.channels
        z, y = np.empty((self._size, solves, 0, self._first.count)), np.empty((self._size, solves, 0, channels))
        return self._solve(parameters, data, measured, z, y, threads)[:2]

    def orbits(
        self, parameters: np.ndarray, data: np.ndarray, measured: np.ndarray, threads: int | None = None
    ) -> tuple[BatchSolution, np.ndarray]:
        """Solve for one parameter vector of every input set, z as it is after the solve, and return `squares` too.

        Parameters
        ----------
        parameters : array (sets, 1, parameters)
        data : array (sets, points, measured)
        measured : int array (measured,)
            The channels that the data are of.
        threads : int, optional
        """
        model, points = self._first.model, self._first.grid.points
        z = np.empty((self._size, 1, points, self._first.count))
        y = np.empty((self._size, 1, points, model.kernels.channels))
        squares, status, iterations = self._solve(parameters, data, measured, z, y, threads)
        return BatchSolution(z, y, self._shared[1][:, None], status, iterations), squares

    def _solve(
        self,
        parameters: np.ndarray,
        data: np.ndarray,
        measured: np.ndarray,
        z: np.ndarray,
        y: np.ndarray,
        threads: int | None,
        polish: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fill z and y where they have entries; return sums of squares, status and iterations."""
        grid, rates, solves = self._first.grid, self._first.model.kernels.output_rates, z.shape[1]
        every = np.empty((self._size, solves, parameters.shape[-1]))
        every[:] = parameters
        squares = np.empty((self._size, solves, measured.size))
        status, iterations = np.empty((2, self._size, solves), dtype=np.int64)
        solve_many = self._kernels.solve_many

        def part(block: tuple[int, int]) -> None:
            solve_many(
                self._functions,
                grid.packed,
                grid.periods,
                self._inputs,
                every,
                *self._shared,
                data,
                measured,
                *block,
                polish,
                rates,
                z,
                y,
                squares,
                status,
                iterations,
            )

        total = self._size * solves
        workers = max(1, min(threads or available_cores(), total // SMALLEST_PART))
        parts = 1 if workers == 1 else workers * min(PARTS_EACH, max(1, total // (workers * SMALLEST_PART)))
        in_threads(part, list(pairwise([total * k // parts for k in range(parts + 1)])), workers)
        return squares, status, iterations

    def pull(
        self,
        parameters: np.ndarray,
        z: np.ndarray,
        weights: np.ndarray,
        moving: tuple[int, ...],
        threads: int | None = None,
    ) -> np.ndarray:
        """Return Σ weights · ∂ŷ/∂θ (sets, moving) at one solution of every input set; NaN where it is singular.

        Parameters
        ----------
        parameters : array (sets, parameters)
        z : array (sets, points, states)
        weights : array (sets, points, channels)
        moving : tuple of int
            The parameters by which.
        threads : int, optional
        """
        model, grid = self._first.model, self._first.grid
        vjp, (frequency, drift) = model.vjp_kernels(moving), self._shared[1:3]
        jacobian, outputs, equations = model.kernels.residual_jacobian, vjp.outputs_vjp, vjp.equations_vjp
        functions = np.array([jacobian.address, outputs.address, equations.address])
        gradients = np.empty((self._size, len(moving)))
        compiled = adjoint_kernels(self._first.count, grid.stencil)

        def part(block: tuple[int, int]) -> None:
            compiled.pull_many(
                functions,
                grid.packed,
                self._inputs,
                np.ascontiguousarray(parameters),
                grid.tau,
                frequency,
                drift,
                np.ascontiguousarray(z),
                np.ascontiguousarray(weights),
                empty_factors(grid, self._first.count),
                *block,
                gradients,
            )

        workers = max(1, min(threads or available_cores(), self._size // SMALLEST_PART))
        in_threads(part, list(pairwise([self._size * k // workers for k in range(workers + 1)])), workers)
        return gradients


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
