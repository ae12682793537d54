"""Solves at many parameter vectors: of many input sets of a driven model, or of many autonomous orbits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np

from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.periodic.compiled import (
    CONVERGED,
    NO_FACTORS,
    NOT_RESOLVED,
    STALLED,
    Anchors,
    BatchSolution,
    Border,
    CycleAnchors,
    Functions,
    Sets,
    kernels,
)
from bayesperiodic.periodic.equations import (
    BorderedFactors,
    PeriodicEquations,
    Sensitivities,
    empty_factors,
    frequency_derivatives,
    workspace,
)

SMALLEST_BLOCK, PARTS_EACH = 4, 4
# Number of parameters up to which terms of second order cost less than the chord step that they save.
MOST_OF_SECOND_ORDER = 8


@dataclass(frozen=True)
class Anchor:
    """A solved point from which others are predicted: z ≈ z₀ + z_θ (θ − θ₀); or, without z_θ, an unconverged guess."""

    parameters: np.ndarray  # (parameters,)
    z: np.ndarray  # (points, states)
    frequency: float  # [Hz]
    sensitivities: np.ndarray | None = None  # (parameters, points, states)
    frequency_sensitivities: np.ndarray | None = None  # (parameters,), zero for a driven model

    @classmethod
    def at(cls, equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> "Anchor":
        """Return the anchor at a solution z; without sensitivities if ∂g/∂z is singular."""
        derivative = equations.parameter_sensitivities(z, parameters)
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
    """Driven input sets of one model on one grid with an anchor each, solved for many parameter vectors.

    Inputs, frequencies and winding numbers may differ.
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
        along, gradient = np.zeros((2, *sensitivities.shape[:2]))
        for e, anchor in enumerate(anchors):
            if anchor.sensitivities is not None:
                sensitivities[e], factors.ends[e, 0] = anchor.sensitivities, 0
        amplitude = np.stack([np.abs(a.z).max(axis=0) for a in anchors])
        ranges = np.stack([np.ptp(a.z, axis=0) for a in anchors])
        ratios = np.divide(ranges, amplitude, out=np.full(ranges.shape, np.inf), where=amplitude > 0.0)
        parameters, z = np.stack([a.parameters for a in anchors]), np.stack([a.z for a in anchors])
        near = first.kernels.OFF_ANCHOR * ratios.min(axis=1)
        moving = np.flatnonzero(sensitivities.any(axis=(0, 2, 3)))
        moving = moving if moving.size <= MOST_OF_SECOND_ORDER else moving[:0]
        pairs = moving.size * (moving.size + 1) // 2
        of_second_order = moving, np.empty((len(sets), pairs, *z.shape[1:]))
        known = parameters, z, sensitivities, amplitude, gradient, along, near, factors, left, right
        self._anchors = Anchors(*known, *of_second_order)
        compiled, functions = self._compiled
        compiled.prepare(functions, first.grid.packed, self._sets, self._anchors, _smooth_noise(*z.shape[1:]))

    @cached_property
    def _compiled(self) -> tuple[Any, Functions]:
        return kernels("batch", self._first.count, self._first.grid.stencil), self._first.functions

    def solve(
        self,
        parameters: np.ndarray,
        threads: int | None = None,
        *,
        keep: bool = False,
        polish: bool = False,
        without: np.ndarray | None = None,
        whole: bool = False,
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
        without : bool array (sets, solves), optional
            Solves to be left out, whose status is "stalled".
        whole : bool
            A parameter vector needs a solution for every input set: where the first set has none, the others get its
            status. Unless it is the only one, it is not solved for them. Ignored with `without`.
        """
        first, grid = self._first, self._first.grid
        every, solution = _unsolved(first, self._anchors.z, parameters, keep)
        solution.frequency[:] = self._sets.frequency[:, None]
        if without is not None:
            solution.status[without] = STALLED
        compiled, functions = self._compiled
        before = functions, grid.packed, grid.periods, self._sets, self._anchors, every
        after = polish, first.model.kernels.output_rates, solution
        status = solution.status
        whole = whole and without is None and len(status) > 1
        # A failed solve takes as long as hundreds that converge; without one, another call takes longer.
        ends = [0, status.shape[1], status.size] if whole and status.shape[1] > 1 else [0, status.size]

        def part(start: int, block: tuple[int, int]) -> None:
            compiled.solve_many(*before, start + block[0], start + block[1], *after)

        for start, stop in pairwise(ends):
            in_blocks(partial(part, start), stop - start, SMALLEST_BLOCK, threads)
            if whole:
                lost = status[0] != CONVERGED
                status[1:, lost] = status[0, lost]
        return solution

    def sensitivities(self, parameters: np.ndarray, z: np.ndarray, moving: np.ndarray) -> list[Sensitivities | None]:
        """Return the derivatives by the parameters `moving` at one solution of every input set; None if singular.

        `parameters` is (sets, parameters), z (sets, points, states).
        """
        first, points = self._first, [np.ascontiguousarray(part) for part in (parameters, z)]
        shape = self._size, moving.size, first.grid.points
        states, outputs = np.empty((*shape, first.count)), np.empty((*shape, first.model.kernels.channels))
        regular, (compiled, functions) = np.empty(self._size, dtype=np.int64), self._compiled
        compiled.respond_many(functions, first.grid.packed, self._sets, *points, moving, states, outputs, regular)
        still = np.zeros(moving.size)
        return [Sensitivities(states[e], outputs[e], still) if regular[e] else None for e in range(self._size)]

    def vjp(self, parameters: np.ndarray, z: np.ndarray, weights: np.ndarray, moving: tuple[int, ...]) -> np.ndarray:
        """Return Σ weights · ∂ŷ/∂θ (sets, moving) at one solution of every input set; NaN where it is singular.

        `weights` is (sets, points, channels); `moving` are the indices of the parameters θ.
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

        in_blocks(part, self._size, SMALLEST_BLOCK, None, each=1)
        return gradients


def in_blocks(
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
    """Orbits of one autonomous model on one grid with an anchor each, followed to many parameter vectors."""

    def __init__(self, sets: Sequence[PeriodicEquations], anchors: Sequence[Anchor]):
        self._first = sets[0]
        here = [e.at_frequency(a.frequency) for e, a in zip(sets, anchors, strict=True)]
        frequency = np.array([a.frequency for a in anchors])
        self._sets = Sets(np.stack([e.inputs for e in here]), frequency, np.stack([e.drift for e in here]))
        factors = [phase_bordered(e, a.parameters, a.z) for e, a in zip(here, anchors, strict=True)]
        z, parameters = np.stack([a.z for a in anchors]), np.stack([a.parameters for a in anchors])
        known = [a.sensitivities is not None for a in anchors]
        sensitivities, slopes = np.zeros((*parameters.shape, *z.shape[1:])), np.zeros(parameters.shape)
        for e in np.flatnonzero(known).tolist():
            sensitivities[e], slopes[e] = anchors[e].sensitivities, anchors[e].frequency_sensitivities
        band, pivots = np.stack([f.band for f in factors]), np.stack([f.pivots for f in factors])
        border = Border(*(np.stack(parts) for parts in zip(*(f.border for f in factors), strict=True)))
        target = np.array([np.sum(e.phase_row(a.z) * a.z) for e, a in zip(here, anchors, strict=True)])
        bordered = band, pivots, border, target, np.where(known, [f.orientation for f in factors], 0.0)
        self._orbits = CycleAnchors(parameters, z, frequency, sensitivities, slopes, *bordered)

    def solve(
        self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False, whole: bool = False
    ) -> BatchSolution:
        """Follow every orbit to its parameter vectors, see `Batch.solve`.

        If `whole`, a parameter vector needs all of its orbits: where one is lost, others that would take more effort
        are not followed, and get its status.
        """
        first = self._first
        every, solution = _unsolved(first, self._orbits.z, parameters, keep)
        follow_many = kernels("autonomous", first.count, first.grid.stencil).follow_many
        before = first.functions, first.grid.packed, self._sets, self._orbits, every

        def part(block: tuple[int, int]) -> None:
            follow_many(*before, *block, whole, workspace(first, bordered=True), solution)

        in_blocks(part, every.shape[1], 1, threads)
        if first.separated:
            solution.status[solution.status == CONVERGED] = NOT_RESOLVED
        return solution


def _unsolved(
    equations: PeriodicEquations, anchors: np.ndarray, parameters: np.ndarray, keep: bool
) -> tuple[np.ndarray, BatchSolution]:
    """Return the parameters (sets, solves, parameters) and arrays for solutions as those of the anchors (sets, …)."""
    sets, points, count = anchors.shape
    every = np.empty((sets, *parameters.shape[-2:]))
    every[:] = parameters
    shape = every.shape[:2]
    z = np.empty((*shape, points if keep else 0, count))
    outputs = np.empty((*shape, points, equations.model.kernels.channels))
    return every, BatchSolution(z, outputs, np.empty(shape), *np.zeros((2, *shape), dtype=int))


def phase_bordered(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> BorderedFactors:
    """Return the factors of [∂g/∂z, ∂g/∂frequency; phase row, 0] at an autonomous orbit."""
    columns, derivatives = equations.residual_jacobian(z, parameters), equations.derivatives(z, parameters)
    slope = frequency_derivatives(equations, z, columns, derivatives)[0]
    return equations.bordered(columns, slope[None], equations.phase_row(z)[None])


@cache
def _smooth_noise(points: int, states: int) -> np.ndarray:
    """Return random numbers of low harmonics: without symmetry, and without the motions that differences do not see."""
    parts = np.random.default_rng(0).standard_normal((2, max(2, points // 8), states))
    return np.fft.irfft(parts[0] + 1j * parts[1], points, axis=0)
