"""Solves at many parameter vectors: of many input sets of a driven model, or of many autonomous orbits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from types import ModuleType

import numpy as np

from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.periodic.compiled import (
    NO_FACTORS,
    Anchors,
    BatchSolution,
    Border,
    Factors,
    Functions,
    Orbits,
    Sets,
    kernels,
)
from bayesperiodic.periodic.equations import BorderedFactors, PeriodicEquations, empty_factors, workspace
from bayesperiodic.periodic.sensitivity import (
    Sensitivities,
    frequency_derivatives,
    parameter_sensitivities,
    smallest_singular_vectors,
    stiffness_gradient,
)

SMALLEST_PART, PARTS_EACH = 4, 4


@dataclass(frozen=True)
class Anchor:
    """A solved point from which others are predicted: z ≈ z₀ + z_θ (θ − θ₀); or, without z_θ, an unconverged guess.

    Attributes
    ----------
    parameters : array (parameters,)
    z : array (points, states)
    frequency : float
        [Hz].
    sensitivities : array (parameters, points, states), or None
    frequency_sensitivities : array (parameters,), or None
        Zero for a driven model.
    """

    parameters: np.ndarray
    z: np.ndarray
    frequency: float
    sensitivities: np.ndarray | None = None
    frequency_sensitivities: np.ndarray | None = None

    @classmethod
    def at(cls, equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> "Anchor":
        """Return the anchor at a solution z; without sensitivities if ∂g/∂z is singular."""
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
    """Driven input sets with their anchors, solved for many parameter vectors.

    Parameters
    ----------
    sets : sequence of PeriodicEquations
        Of one driven model on one grid; inputs, frequencies and winding numbers may differ.
    anchors : sequence of Anchor
        One per set.
    """

    def __init__(self, sets: Sequence[PeriodicEquations], anchors: Sequence[Anchor]):
        first = sets[0]
        layout = first.grid.scheme, first.grid.samples, first.grid.periods
        if any(e.model is not first.model or (e.grid.scheme, e.grid.samples, e.grid.periods) != layout for e in sets):
            raise ValueError("sets: all must have the same model, scheme, samples and periods.")
        self._first, self._size = first, len(sets)
        self._sets = Sets(
            np.stack([e.inputs for e in sets]), np.array([e.frequency for e in sets]), np.stack([e.drift for e in sets])
        )
        factors = empty_factors(first.grid, first.count, (len(sets),))
        factors.ends[:, 0] = NO_FACTORS
        sensitivities = np.zeros((len(sets), len(first.model.parameters), first.grid.points, first.count))
        left, right = np.zeros((2, len(sets), first.grid.points, first.count))
        gradient, amplitude = np.zeros(sensitivities.shape[:2]), np.stack([np.abs(a.z).max(axis=0) for a in anchors])
        for e, (equations, anchor) in enumerate(zip(sets, anchors, strict=True)):
            if anchor.sensitivities is None:
                continue
            own = Factors(*(part[e] for part in factors))
            sensitivities[e] = anchor.sensitivities
            columns = equations.residual_jacobian(anchor.z, anchor.parameters)
            if not equations.factorise(columns, anchor.z, own):
                own.ends[0] = NO_FACTORS
            left[e], change = smallest_singular_vectors(equations, anchor.z, columns)
            gradient[e] = stiffness_gradient(equations, anchor.z, anchor.parameters, sensitivities[e], left[e], change)
            right[e] = change[:, : first.count]
        ranges = np.stack([np.ptp(a.z, axis=0) for a in anchors])
        ratios = np.divide(ranges, amplitude, out=np.full(ranges.shape, np.inf), where=amplitude > 0.0)
        self._anchors = Anchors(
            np.stack([a.parameters for a in anchors]),
            np.stack([a.z for a in anchors]),
            sensitivities,
            amplitude,
            gradient,
            first.kernels.FAR * ratios.min(axis=1),
            factors,
            left,
            right,
        )

    @cached_property
    def _functions(self) -> Functions:
        return self._first.functions

    @cached_property
    def _kernels(self) -> ModuleType:
        return kernels("batch", self._first.count, self._first.grid.stencil)

    def solve(
        self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False, polish: bool = False
    ) -> BatchSolution:
        """Solve every input set for every parameter vector; the result does not depend on the number of threads.

        Parameters
        ----------
        parameters : array (sets, solves, parameters), or (solves, parameters) if they are those of every set
        threads : int, optional
            By default the number of cores.
        keep : bool
            Return z too.
        polish : bool
            Take further chord steps, so that z and what is derived from it are as accurate as possible.
        """
        model, grid = self._first.model, self._first.grid
        solves = parameters.shape[-2]
        z = np.empty((self._size, solves, grid.points if keep else 0, self._first.count))
        y = np.empty((self._size, solves, grid.points, model.kernels.channels))
        every = np.empty((self._size, solves, parameters.shape[-1]))
        every[:] = parameters
        status, iterations = np.empty((2, self._size, solves), dtype=int)
        frequency = np.repeat(self._sets.frequency[:, None], solves, axis=1)
        solution = BatchSolution(z, y, frequency, status, iterations)
        before = self._functions, grid.packed, grid.periods, self._sets, self._anchors, every
        after, solve_many = (polish, model.kernels.output_rates, solution), self._kernels.solve_many
        _in_blocks(lambda block: solve_many(*before, *block, *after), self._size * solves, SMALLEST_PART, threads)
        return solution

    def vjp(
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
            Indices of the parameters θ.
        threads : int, optional
        """
        model, grid = self._first.model, self._first.grid
        products = model.vjp_kernels(moving)
        functions = model.kernels.residual_jacobian, products.outputs_vjp, products.equations_vjp
        addresses, gradients = np.array([f.address for f in functions]), np.empty((self._size, len(moving)))
        points = [np.ascontiguousarray(part) for part in (parameters, z, weights)]
        compiled = kernels("adjoint", self._first.count, grid.stencil)

        def part(block: tuple[int, int]) -> None:
            factors = empty_factors(grid, self._first.count)
            compiled.vjp_many(addresses, grid.packed, self._sets, *points, factors, *block, gradients)

        _in_blocks(part, self._size, SMALLEST_PART, threads, each=1)
        return gradients


def _in_blocks(
    part: Callable[[tuple[int, int]], None], total: int, smallest: int, threads: int | None, each: int = PARTS_EACH
) -> None:
    """Call a function for blocks (start, stop) of a range, up to `each` per thread, none below the smallest size."""
    workers = 1 if total < 2 * smallest else min(threads or available_cores(), total // smallest)
    if workers == 1:
        part((0, total))
        return
    parts = workers * min(each, max(1, total // (workers * smallest)))
    in_threads(part, list(pairwise([total * k // parts for k in range(parts + 1)])), workers)


class AutonomousBatch:
    """Autonomous orbits with their anchors, followed to many parameter vectors.

    Parameters
    ----------
    sets : sequence of PeriodicEquations
        Of one autonomous model on one grid.
    anchors : sequence of Anchor
        One per orbit.
    """

    def __init__(self, sets: Sequence[PeriodicEquations], anchors: Sequence[Anchor]):
        self._first = sets[0]
        here = [e.at_frequency(a.frequency) for e, a in zip(sets, anchors, strict=True)]
        frequency = np.array([a.frequency for a in anchors])
        self._sets = Sets(np.stack([e.inputs for e in here]), frequency, np.stack([e.drift for e in here]))
        factors = [phase_bordered(e, a.parameters, a.z) for e, a in zip(here, anchors, strict=True)]
        rows = [
            f.border.rows[0].reshape(a.z.shape)[e.grid.place] for e, f, a in zip(here, factors, anchors, strict=True)
        ]
        z, parameters = np.stack([a.z for a in anchors]), np.stack([a.parameters for a in anchors])
        known = [a.sensitivities is not None for a in anchors]
        sensitivities, slopes = np.zeros((*parameters.shape, *z.shape[1:])), np.zeros(parameters.shape)
        for e, anchor in enumerate(anchors):
            if anchor.sensitivities is not None and anchor.frequency_sensitivities is not None:
                sensitivities[e], slopes[e] = anchor.sensitivities, anchor.frequency_sensitivities
        self._orbits = Orbits(
            parameters,
            z,
            frequency,
            sensitivities,
            slopes,
            np.stack([f.band for f in factors]),
            np.stack([f.pivots for f in factors]),
            Border(*(np.stack(parts) for parts in zip(*(f.border for f in factors), strict=True))),
            np.array([float(np.sum(row * a.z)) for row, a in zip(rows, anchors, strict=True)]),
            np.where(known, [f.orientation for f in factors], 0.0),
        )

    def solve(
        self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False, whole: bool = False
    ) -> BatchSolution:
        """Follow every orbit to its parameter vectors; the result does not depend on the number of threads.

        Parameters
        ----------
        parameters, threads, keep
            See `batch.Batch.solve`.
        whole : bool
            A parameter vector needs all of its orbits. Where one is lost, others that would take more effort
            are not followed, and get its status.
        """
        first, (sets, points, states) = self._first, self._orbits.z.shape
        solves = parameters.shape[-2]
        every = np.empty((sets, solves, parameters.shape[-1]))
        every[:] = parameters
        solution = BatchSolution(
            np.empty((sets, solves, points if keep else 0, states)),
            np.empty((sets, solves, points, first.model.kernels.channels)),
            np.empty((sets, solves)),
            *np.empty((2, sets, solves), dtype=int),
        )
        follow_many = kernels("autonomous", states, first.grid.stencil).follow_many
        before = first.functions, first.grid.packed, self._sets, self._orbits, every
        _in_blocks(
            lambda block: follow_many(*before, *block, whole, workspace(first, bordered=True), solution),
            solves,
            1,
            threads,
        )
        return solution


def phase_bordered(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> BorderedFactors:
    """Return the factors of [∂g/∂z, ∂g/∂frequency; phase row, 0] at an autonomous orbit."""
    columns, derivatives = equations.residual_jacobian(z, parameters), equations.derivatives(z, parameters)
    slope = frequency_derivatives(equations, z, columns, derivatives)[0]
    return equations.bordered(columns, slope[None], equations.phase_row(z)[None])
