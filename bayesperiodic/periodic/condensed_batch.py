"""Condensed solutions at many parameter vectors, predicted from the anchors of their input sets."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from bayesperiodic._linalg import unwarned
from bayesperiodic.periodic.batch import Anchor, in_blocks
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, STALLED, BatchSolution
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.element_forces import LARGEST_INVERSE, Preconditioner, ResponseMatrices, steep_points
from bayesperiodic.periodic.harmonics import harmonics, on_grid, resized, transform_tables
from bayesperiodic.periodic.memory import error_of_fewer
from bayesperiodic.periodic.receptance import compiled, unresolved

FEWEST_CONDENSED_SOLVES = 4
# Numbers in the frequency response between the elements for which parameter vectors are solved together.
MOST_RESPONSE_NUMBERS = 2**20
# Parts of the way from an anchor in which a solution is followed, and largest correction in units of the predicted
# change or, where a contact begins, of this part of the solution.
LARGEST_PATH_PART, SMALLEST_PATH_PART, STRAIGHT_PATH, LEAST_PATH_CHANGE = 1.0, 1.0 / 256.0, 0.5, 0.01
# Part of the points on which it is followed at first, and the fewest; the smallest part of the way on all points, where
# that fails.
PATH_POINTS_RATIO, FEWEST_PATH_POINTS, RETRIED_PATH_PART = 8, 64, 1.0 / 16.0


class CondensedBatch:
    """Input sets of one condensed model on one grid with an anchor each, solved for many parameter vectors."""

    @unwarned
    def __init__(self, sets: Sequence[CondensedEquations], anchors: Sequence[Anchor]):
        first = sets[0]
        self._sets, self._anchors = list(sets), list(anchors)
        self._points = points = max(len(a.z) for a in anchors)
        self._d = np.stack([resized(harmonics(a.z), points) for a in anchors])
        shape = (len(first.model.parameters), *self._d.shape[1:])
        self._slopes = np.stack(
            [
                np.zeros(shape, dtype=complex)
                if a.sensitivities is None
                else resized(harmonics(a.sensitivities), points)
                for a in anchors
            ]
        )
        self._matrices = [e.matrices(a.parameters, points)[0] for e, a in zip(sets, anchors, strict=True)]
        self._largest = [matrices.largest for matrices in self._matrices]
        self._load = np.stack([e.input_harmonics(points) for e in sets])
        self._rates = np.array([2 * np.pi * e.frequency for e in sets])
        self._known = np.array([a.sensitivities is not None for a in anchors])
        at_anchors = [e.forces(d, a.parameters) for e, d, a in zip(sets, self._d, anchors, strict=True)]
        self._linear = [
            (forces, e.rates(points), m.d_f) for e, forces, m in zip(sets, at_anchors, self._matrices, strict=True)
        ]
        self._steep = [steep_points(*p) if k else None for k, p in zip(self._known, self._linear, strict=True)]
        coupled = (
            Preconditioner.strongly_coupled(steep.rest(forces), *linear)
            for steep, (forces, *linear) in zip(self._steep, self._linear, strict=True)
            if steep
        )
        self._low = max(coupled, default=1)
        self._transform, self._blocks = transform_tables(points), np.array(first.model.state_blocks, dtype=np.int64)
        self._states = np.zeros((len(sets), points, 3 * (first.count + self._blocks.sum())))
        for states, forces in zip(self._states, at_anchors, strict=True):
            if forces.memory is not None:
                states[:] = forces.memory.states

    @cached_property
    @unwarned
    def _inverse(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Transposed inverses of the sets, what steep points change, and the number of low harmonics of all."""
        size, pairs = self._size, max((len(one.points) for one in self._steep if one), default=0)
        inverses = np.zeros((len(self._steep), size, size))
        changes = np.zeros((len(self._steep), 2, pairs, 2 * self._d[0].size))
        for number, (one, part) in enumerate(zip(self._steep, self._linear, strict=True)):
            if one:
                inverse = Preconditioner(*part, self._low, one)
                inverses[number] = inverse.transposed_inverse
                changes[number, :, : len(one.points)] = inverse.of_steep
        return inverses, changes, self._low

    @property
    def _size(self) -> int:
        """Rows of the matrix of the low harmonics."""
        return int(2 * self._low * self._d.shape[-1])

    def _responses(self, parameters: np.ndarray) -> list[ResponseMatrices]:
        """Return the frequency responses of each set, (1 or solves, harmonics, rows, columns)."""
        result = []
        for e, (equations, anchor, known) in enumerate(zip(self._sets, self._anchors, self._matrices, strict=True)):
            factors = list(equations.matrix_parameters)
            if np.array_equal(
                parameters[e][:, factors],
                np.broadcast_to(anchor.parameters[factors], (len(parameters[e]), len(factors))),
            ):
                result.append(ResponseMatrices(*(part[None] for part in known)))
            else:
                result.append(equations.many_matrices(parameters[e], self._points))
        return result

    def _linear_parts(self, parameters: np.ndarray) -> tuple[list[ResponseMatrices], np.ndarray, np.ndarray]:
        """Return the responses, that between the elements of all sets, and their displacements without forces."""
        responses = self._responses(parameters)
        vectors = max(len(r.d_f) for r in responses)
        d_f = np.empty((len(responses), vectors, *responses[0].d_f.shape[1:]), dtype=complex)
        free = np.empty(d_f.shape[:-1], dtype=complex)
        for e, response in enumerate(responses):
            d_f[e], free[e] = response.d_f, _unforced(response.d_u, self._load[e])
        return responses, d_f, free

    @unwarned
    def solve(
        self,
        parameters: np.ndarray,
        threads: int | None = None,
        *,
        keep: bool = False,
        polish: bool = False,
        without: np.ndarray | None = None,
    ) -> BatchSolution:
        """Solve every input set for every parameter vector; arguments and result as those of `batch.Batch.solve`.

        Solutions are corrected from the linear prediction of the anchor, or else followed from it in steps, on the grid
        of the anchor with the most points. One polished solve with a large matrix takes a step of Newton's, which needs
        no inverse. Where that grid does not resolve the outputs, the points are doubled; if the
        most points do not resolve them, the status is "not resolved". z has the grid of the most points.
        """
        every = np.empty((len(self._sets), *parameters.shape[-2:]))
        every[:] = parameters
        together = max(1, MOST_RESPONSE_NUMBERS // max(1, self._d.size * self._d.shape[-1]))
        solved = []
        for first in range(0, max(1, every.shape[1]), together):
            part = slice(first, first + together)
            left_out = None if without is None else without[:, part]
            solved.append(self._solve(np.ascontiguousarray(every[:, part]), threads, keep, polish, left_out))
        if len(solved) == 1:
            return solved[0]
        points = max(one.z.shape[2] for one in solved)
        z = [one.z if one.z.shape[2] == points else on_grid(harmonics(one.z), points) for one in solved]
        others = [*zip(*solved, strict=True)][1:]
        return BatchSolution(*(np.concatenate(values, axis=1) for values in (z, *others)))

    def _solve(
        self, every: np.ndarray, threads: int | None, keep: bool, polish: bool, without: np.ndarray | None
    ) -> BatchSolution:
        """Solve every input set for some parameter vectors (sets, solves, parameters), see `solve`."""
        first, count, solves = self._sets[0], len(self._sets), every.shape[1]
        change = every - np.stack([a.parameters for a in self._anchors])[:, None]
        ahead = np.einsum("ebp,epkm->ebkm", change, self._slopes)
        d = self._d[:, None] + ahead
        moved, f = np.sqrt(np.sum(np.abs(ahead) ** 2, axis=(2, 3))), np.full_like(d, np.nan)
        fewer = np.empty((count, solves, self._points // 4 if self._blocks.size else 0, first.count), dtype=complex)
        lost, steps = np.zeros((2, count, solves), dtype=np.int64)
        once = polish and solves == 1 and self._size > LARGEST_INVERSE
        lost[once | ~self._known] = 1
        if without is not None:
            lost[without] = 1
        responses, d_f, free = self._linear_parts(every)
        kernels, blocks, inverse = first.model.element_kernels, self._blocks, () if once else self._inverse
        address = (kernels.residual_jacobian if blocks.size else kernels.residual).address if first.count else 0

        def part(block: tuple[int, int]) -> None:
            compiled().correct_many(
                address, d_f, free, *inverse, every, self._rates, float(first.grid.periods), *self._transform,
                blocks, polish, *block, moved, d, f, lost, steps, self._states, fewer,
            )  # fmt: skip

        if not once:
            in_blocks(part, lost.size, FEWEST_CONDENSED_SOLVES, threads)
        status = np.full(lost.shape, CONVERGED)
        for e, b in np.argwhere(lost):
            if without is not None and without[e, b]:
                status[e, b] = STALLED
                continue
            d[e, b], status[e, b], more = self._follow(e, every[e, b], once)
            f[e, b] = harmonics(self._sets[e].forces(d[e, b], every[e, b]).values)
            steps[e, b] += more
        every_y = [
            _unforced(r.y_u, load) - (r.y_f @ y[..., None])[..., 0]
            for r, load, y in zip(responses, self._load, f, strict=True)
        ]
        outputs = np.stack([e.on_points(y) for e, y in zip(self._sets, every_y, strict=True)])
        shares = np.stack([unresolved(*of_set) for of_set in zip(self._largest, f, every_y, strict=True)])
        if blocks.size:
            change = fewer - f[:, :, : fewer.shape[2]]
            by_memory = [error_of_fewer(r.y_f, c, y) for r, c, y in zip(responses, change, every_y, strict=True)]
            for e, b in np.argwhere((lost != 0) & (status == CONVERGED)):
                by_memory[e][b] = self._sets[e].error_of_memory(d[e, b], f[e, b], every_y[e][b], every[e, b])
            shares = np.maximum(shares, by_memory)
        finer = {}
        for e, b in np.argwhere((status == CONVERGED) & ~(shares <= first.resolved_share)):
            equations, theta = self._sets[e], every[e, b]
            finer[e, b], status[e, b], history = equations.doubled(theta, d[e, b])
            outputs[e, b] = equations.outputs(on_grid(finer[e, b], 2 * len(finer[e, b])), theta)
            steps[e, b] += len(history)
        z = np.empty((count, solves, 0, first.count))
        if keep:
            points = max([self._points, *(2 * len(amplitudes) for amplitudes in finer.values())])
            z = on_grid(d, points)
            for place, amplitudes in finer.items():
                z[place] = on_grid(amplitudes, points)
        frequency = np.repeat([[e.frequency] for e in self._sets], solves, axis=1)
        return BatchSolution(z, outputs, frequency, status, steps)

    @unwarned
    def _follow(self, e: int, parameters: np.ndarray, once: bool) -> tuple[np.ndarray, int, int]:
        """Follow a solution from the anchor in steps; return it, the status, and Newton's steps.

        With `once` one step on all points is tried first. Others are on fewer points at first, whose solution starts
        the one on all points, or where those do not suffice, on all points.
        """
        equations, used = self._sets[e], 0
        if not self._known[e]:  # a guess, from which to solve
            solved = equations.solve(parameters, on_grid(self._d[e], self._points))
            return harmonics(solved.z), solved.code, len(solved.history)
        if once:
            d, code, used = self._stepped(e, parameters, self._points, LARGEST_PATH_PART)
            if code == CONVERGED:
                return d, CONVERGED, used
        fewer = max(self._points // PATH_POINTS_RATIO, FEWEST_PATH_POINTS)
        if fewer < self._points:
            d, code, more = self._stepped(e, parameters, fewer)
            used += more
            if code == CONVERGED:
                start = resized(d, self._points)
                solved = equations.solve(parameters, on_grid(start, self._points), halvings=0)
                d, used = harmonics(solved.z), used + len(solved.history)
                small = np.linalg.norm(d - start) <= LEAST_PATH_CHANGE * np.linalg.norm(d)
                if solved.code == CONVERGED and small:
                    return d, CONVERGED, used
        smallest = RETRIED_PATH_PART if fewer < self._points else SMALLEST_PATH_PART
        d, code, more = self._stepped(e, parameters, self._points, smallest)
        return d, code, used + more

    @unwarned
    def _stepped(
        self, e: int, parameters: np.ndarray, points: int, smallest: float = SMALLEST_PATH_PART
    ) -> tuple[np.ndarray, int, int]:
        """Follow a solution on a number of points; return it, the status, and Newton's steps."""
        equations, anchor = self._sets[e], self._anchors[e]
        change = parameters - anchor.parameters
        if not change.any() and len(anchor.z) == points:
            return self._d[e], CONVERGED, 0
        here, done, step, used = resized(self._d[e], points), 0.0, LARGEST_PATH_PART, 0
        ahead = resized(np.tensordot(change, self._slopes[e], (0, 0)), points)
        while done < 1.0:
            there = anchor.parameters + (done + step) * change
            predicted = here + step * ahead
            solved = equations.solve(there, on_grid(predicted, points), halvings=0)
            used, d = used + len(solved.history), harmonics(solved.z)
            size = max(float(np.linalg.norm(step * ahead)), LEAST_PATH_CHANGE * float(np.linalg.norm(d)))
            straight = np.linalg.norm(d - predicted) <= STRAIGHT_PATH * size
            if solved.code != CONVERGED or not straight:
                step *= 0.5
                if step < smallest:
                    return d, OTHER_ORBIT if solved.code == CONVERGED else solved.code, used
                continue
            ahead, here, done = (d - here) / step, d, done + step
            step = min(2.0 * step, LARGEST_PATH_PART, 1.0 - done)
        return here, CONVERGED, used

    @unwarned
    def vjp(self, parameters: np.ndarray, z: np.ndarray, weights: np.ndarray, moving: tuple[int, ...]) -> np.ndarray:
        """Return Σ weights · ∂ŷ/∂θ (sets, moving) at one solution of every input set; see `batch.Batch.vjp`."""
        result = np.full((len(self._sets), len(moving)), np.nan)
        directions = np.eye(parameters.shape[1])[list(moving)]
        for e, equations in enumerate(self._sets):
            derivative = equations.sensitivities_along(z[e], parameters[e], directions)
            if derivative is not None:
                result[e] = np.einsum("dnc,nc->d", derivative.outputs, weights[e])
        return result


def _unforced(response: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Return the harmonics (…, harmonics, rows) that inputs (harmonics, inputs) cause."""
    return (response @ load[..., None])[..., 0]
