"""Periodic equations of structures with few nonlinear elements, in the displacements of the elements alone.

The displacements d of the elements over the period are unknown, at points of a grid whose number is a power of two. In
harmonics d = H_du u - H_df f(d, ḋ): the frequency response H of the linear structure between the places of inputs u,
elements and outputs is that of all degrees of freedom, the forces f of the elements are evaluated at the points ([1]_).
Outputs, also accelerations, come from the forces by the same frequency response. The number of points is doubled until
the outputs do not change any more.

References
----------
.. [1] T. M. Cameron, J. H. Griffin, An alternating frequency/time domain method for calculating the steady-state
   response of nonlinear dynamic systems, Journal of Applied Mechanics 56 (1989) 149-154.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from bayesperiodic._linalg import unwarned
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, NOT_RESOLVED, SINGULAR, STALLED
from bayesperiodic.periodic.condensed_load import with_raised_load
from bayesperiodic.periodic.element_forces import (
    Forces,
    Preconditioner,
    ResponseMatrices,
    corrected,
    linear_solve,
    linearised,
    newton_step,
    residual_of,
    times,
)
from bayesperiodic.periodic.equations import PeriodicEquations, Sensitivities, Solved
from bayesperiodic.periodic.harmonics import harmonics, on_grid, resized, sampled, transform_tables
from bayesperiodic.periodic.memory import Memory, error_of_fewer, remembered
from bayesperiodic.periodic.receptance import Receptance, compiled, unresolved
from bayesperiodic.periodic.schemes import Scheme, find_scheme, fourier

# Points of the grid of the elements, and relative change of the outputs below which they are not doubled.
FEWEST_ELEMENT_POINTS, MOST_ELEMENT_POINTS, RESOLVED_CHANGE = 32, 4096, 1e-6
# The latter with internal states, whose formula is of order two at kinks: it leaves about a third of the change.
RESOLVED_CHANGE_OF_MEMORY = 5e-5
# Bound of the error of the outputs, see `unresolved`, above which points are doubled too.
RESOLVED_SHARE = 1e-4
# The largest change or bound of outputs that count as resolved by the most points; the smallest relative harmonic of an
# input.
LARGEST_OUTPUT_CHANGE, LEAST_HARMONIC = 1e-2, 1e-12
# Modes whose frequencies are compared with data.
LINEAR_MODES = 16
# Points up to which a solve that fails is repeated, and their ratio.
MOST_STARTING_POINTS, STARTING_RATIO = 512, 4
MOST_CONDENSED_STEPS, MOST_STEP_HALVINGS, LAST_NEWTON_STEP, NEWTON_ROUNDING = 40, 9, 1e-10, 1e-13
# Residual of rounding errors, in units of its largest term, with internal states; while an element sticks they hardly
# forget, and errors add up over the periods that are remembered.
ROUNDING_OF_MEMORY = 1e-8
# Residual, in units of its largest term, below which corrections with a fixed matrix are tried before Newton's step.
NEAR_SOLUTION = 0.1


@dataclass(frozen=True)
class CondensedEquations(PeriodicEquations):
    """d + H_df f(d, ḋ, θ) - H_du u = 0 for one set of inputs; z are the displacements d (points, elements)."""

    model: CondensedModel
    # Factor of the errors of the outputs, by the number of points, with which they are resolved.
    coarseness: float = 1.0

    @classmethod
    def build(
        cls,
        model: Model,
        inputs: Mapping[str, np.ndarray] | None,
        *,
        scheme: str | Scheme | None = None,
        **settings: Any,
    ) -> "CondensedEquations":
        """Check the arguments, see `PeriodicEquations.build`; harmonics take the place of a scheme."""
        if find_scheme(scheme or fourier) is not fourier:
            raise ValueError(
                f"scheme: must be 'fourier' or None for {model.name!r}, which is condensed, got {scheme!r}; the points "
                "of its elements are doubled as often as needed."
            )
        return super().build(model, inputs, scheme=fourier, **settings)  # type: ignore[return-value]

    @property
    def kernels(self) -> ModuleType:
        """Refused: what needs them is for discretised equations."""
        raise self.model.refusal()

    @property
    def of_all_states(self) -> "CondensedEquations":
        """The equations whose outputs are the displacements of all degrees of freedom."""
        return replace(self, model=self.model.with_all_outputs)

    def outputs_and_residual(self, z: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the outputs (points, channels), and the norm of the residual in units of its largest term."""
        d, matrices, load = harmonics(z), self.matrices(parameters, len(z))[0], self.input_harmonics(len(z))
        forces = self.forces(d, parameters)
        residual, size = residual_of(d, forces, matrices, times(matrices.d_u, load))
        y = times(matrices.y_u, load) - times(matrices.y_f, harmonics(forces.values))
        return self.on_points(y), float(np.linalg.norm(residual)) / size

    def displacements(self, z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return all displacements (2, points, n), and what they are if half of the points give the forces."""
        points, load, by_points = len(z), self.input_harmonics(len(z)), []
        for count in (points, points // 2):
            d = resized(harmonics(z), count)
            f = resized(harmonics(self.forces(d, parameters).values), points)
            by_points.append(np.concatenate([-f, load], axis=1))
        numbers = np.arange(points // 2) / self.grid.periods
        return self.on_points(self._receptance.displacements(parameters, self.frequency, numbers, np.array(by_points)))

    @property
    def count(self) -> int:
        """Number of elements."""
        return len(self.model.element_forces)

    @property
    def _receptance(self) -> Receptance:
        return receptance(self.model)

    def rates(self, points: int) -> np.ndarray:
        """Return the angular frequencies of the harmonics below half the points [1/s]."""
        return 2 * np.pi * self.frequency / self.grid.periods * np.arange(points // 2)

    def matrices(
        self, parameters: np.ndarray, points: int, directions: Sequence[int] = ()
    ) -> tuple[ResponseMatrices, ResponseMatrices]:
        """Return the frequency response at the harmonics below half the points, and its derivatives.

        `directions` are indices of parameters, their number standing for the frequency.
        """
        return self._receptance.recent(
            ("matrices", parameters.tobytes(), self.frequency, self.grid.periods, points, *directions),
            lambda: self._matrices(parameters, points, directions),
        )

    def _matrices(
        self, parameters: np.ndarray, points: int, directions: Sequence[int]
    ) -> tuple[ResponseMatrices, ResponseMatrices]:
        numbers = np.arange(points // 2) / self.grid.periods
        response = self._receptance(parameters, self.frequency, numbers, directions)
        here, changes = (self._parts(values) for values in (response.values, response.derivatives))
        carried, by_frequency = self._receptance.carried(self.frequency, numbers)
        orders = self._orders / self.frequency
        for number, direction in enumerate(directions):
            if direction == len(self.model.parameters):
                changes.y_f[number] += here.y_f * orders[:, None]
                changes.y_u[number] += here.y_u * orders[:, None] + by_frequency
        return here._replace(y_u=here.y_u + carried), changes

    def many_matrices(self, parameters: np.ndarray, points: int) -> ResponseMatrices:
        """Return the frequency response for parameter vectors (vectors, parameters)."""
        numbers = np.arange(points // 2) / self.grid.periods
        response = self._parts(self._receptance.many(parameters, self.frequency, numbers))
        return response._replace(y_u=response.y_u + self._receptance.carried(self.frequency, numbers)[0])

    @property
    def _orders(self) -> np.ndarray:
        return np.array([order for _, order in self.model.structure.measured.values()])

    @property
    def matrix_parameters(self) -> list[int]:
        """Indices of the parameters that are factors of matrices."""
        return list(self._receptance.matrix_parameters)

    def _parts(self, response: np.ndarray) -> ResponseMatrices:
        """Return the parts of a response of displacements (…, harmonics, rows, columns), outputs differentiated."""
        elements, rates = self.count, self.rates(2 * response.shape[-3])
        rows = response[..., elements:, :] * ((1j * rates[:, None]) ** self._orders)[..., None]
        d = response[..., :elements, :]
        return ResponseMatrices(d[..., :elements], d[..., elements:], rows[..., :elements], rows[..., elements:])

    def input_harmonics(self, points: int, inputs: np.ndarray | None = None) -> np.ndarray:
        """Return the harmonics (…, harmonics, inputs) of inputs (…, grid points, inputs), by default these."""
        values = self.inputs[:, : len(self.model.inputs)] if inputs is None else inputs
        key = ("inputs", points, values.shape, values.tobytes())
        return self._receptance.recent(key, lambda: self._input_harmonics(points, values))

    def _input_harmonics(self, points: int, values: np.ndarray) -> np.ndarray:
        amplitudes = np.fft.rfft(values, axis=-2) / values.shape[-2]
        result = np.zeros((*values.shape[:-2], points // 2, values.shape[-1]), dtype=complex)
        kept = min(points // 2, amplitudes.shape[-2])
        result[..., :kept, :] = amplitudes[..., :kept, :]
        if kept == values.shape[-2] // 2 + 1 and values.shape[-2] % 2 == 0:
            result[..., kept - 1, :] *= 0.5  # the highest harmonic of an even grid stands for two
        return result

    def reduced(self, states: np.ndarray) -> np.ndarray:
        """Return the displacements of the elements (points, elements) for those of all degrees of freedom.

        The points are as many as those of the states, or the next power of two, on which the kernels work.
        """
        d, points = states @ self.model.structure.weights.T, 1 << (len(states) - 1).bit_length()
        return d if points == len(d) else on_grid(resized(harmonics(d), points), points)

    def states(self, z: np.ndarray, drift: np.ndarray | None = None) -> np.ndarray:
        """Return d, ḋ, d̈ of the elements side by side, (points, 3·elements)."""
        d, rates = harmonics(z), self.rates(len(z))
        return on_grid(np.concatenate([(1j * rates[:, None]) ** order * d for order in range(3)], axis=1), len(z))

    def on_points(self, harmonics: np.ndarray) -> np.ndarray:
        """Return values (…, points, columns) on the experiment's grid from harmonics (…, harmonics, columns)."""
        return sampled(harmonics, self.grid.points)

    def forces(self, d: np.ndarray, parameters: np.ndarray, near: Forces | None = None) -> Forces:
        """Return the forces at harmonics d (harmonics, elements); internal states are followed from those of `near`."""
        if not self.count:
            none = np.zeros((2 * len(d), 0))
            return Forces(none, none, none)
        key = ("forces", parameters.tobytes(), self.frequency, self.grid.periods, d.tobytes())
        return self._receptance.recent(key, lambda: self._forces(d, parameters, near and near.memory))

    def _forces(self, d: np.ndarray, parameters: np.ndarray, near: Memory | None) -> Forces:
        states, given, memory = self._motion(d), self.count, None
        if self.model.state_owners:
            period = self.grid.periods / self.frequency
            memory = remembered(self.model, states, parameters, self.frequency, period, near)
            if memory is None:
                unknown = np.full((len(states), given), np.nan)
                return Forces(unknown, unknown, unknown)
        values = self._evaluated("residual_jacobian", states, parameters) if memory is None else memory.columns
        every, diagonal = given + len(self.model.state_owners), np.arange(given)
        f, slopes = values[:, :given], values[:, every:].reshape(len(values), every, 3, every)
        return Forces(f, slopes[:, diagonal, 0, diagonal], slopes[:, diagonal, 1, diagonal], memory)

    def forces_by_parameters(self, d: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return the derivatives of the forces by the parameters, (points, elements, parameters)."""
        if not self.count:
            return np.zeros((2 * len(d), 0, parameters.size))
        memory = self.forces(d, parameters).memory
        states = self._motion(d) if memory is None else memory.states
        every = self.count + len(self.model.state_owners)
        values = self._evaluated("derivatives", states, parameters)[:, : every * parameters.size]
        slopes = values.reshape(len(values), every, -1)
        of_forces = slopes[:, : self.count]
        return of_forces if memory is None else of_forces + memory.change(slopes[:, self.count :])

    def _by_frequency(self, d: np.ndarray, forces: Forces) -> np.ndarray:
        """Return the derivatives of the forces by the frequency, (points, elements), with harmonics d held."""
        v = on_grid(1j * self.rates(2 * len(d))[:, None] * d, 2 * len(d)) / self.frequency
        change, memory = forces.damping * v, forces.memory
        if memory is None:
            return np.asarray(change)
        # In units of the period, the rates of the states are inversely proportional to the frequency.
        added = memory.by_velocity * v[:, memory.owners] - memory.rates / self.frequency
        return np.asarray(change + memory.change(added[..., None])[..., 0])

    def _motion(self, d: np.ndarray) -> np.ndarray:
        """Return displacements and velocities of the elements as states of their kernels (points, 3·variables)."""
        points, every = 2 * len(d), self.count + len(self.model.state_owners)
        states, both = np.zeros((points, 3 * every)), np.concatenate([d, 1j * self.rates(points)[:, None] * d], axis=1)
        motion = on_grid(both, points)
        states[:, : self.count], states[:, every : every + self.count] = np.split(motion, 2, axis=1)
        return states

    def _evaluated(self, name: str, states: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        kernels, points = self.model.element_kernels, len(states)
        return kernels.evaluate(name, states, np.empty((points, 0)), parameters, np.zeros(points), self.frequency)

    @unwarned
    def solve(self, parameters: np.ndarray, guess: np.ndarray, *_: Any, halvings: int = MOST_STEP_HALVINGS) -> Solved:
        """Run Newton's iteration from a guess (points, elements) on its grid, each step halved so often at most."""
        d, code, history = self.newton(parameters, harmonics(guess), halvings=halvings)[:3]
        return Solved(on_grid(d, len(guess)), code, history)

    def newton(
        self, parameters: np.ndarray, d: np.ndarray, load: float = 1.0, halvings: int = MOST_STEP_HALVINGS,
        known: Preconditioner | None = None,
    ) -> tuple[np.ndarray, int, np.ndarray, Preconditioner | None]:  # fmt: skip
        """Run Newton's iteration from harmonics d; return the last ones, the code, the history, and the matrix.

        With internal states a matrix that is `known` from a solution near d, on any grid, serves for the first steps.
        """
        points = 2 * len(d)
        matrices = self.matrices(parameters, points)[0]
        free = load * times(matrices.d_u, self.input_harmonics(points))
        rates = self.rates(points)
        history: list[tuple[float, float, float]] = []
        forces = self.forces(d, parameters)
        residual, size = residual_of(d, forces, matrices, free)
        for _ in range(MOST_CONDENSED_STEPS):
            if not np.isfinite(residual).all():
                return d, NOT_FINITE, np.array(history).reshape(-1, 3), known
            before = float(np.linalg.norm(residual))
            try:
                if known is None or forces.memory is None or known.low > len(rates):
                    known = Preconditioner(forces, rates, matrices.d_f)
                near = None
                if before <= NEAR_SOLUTION * size:
                    near = corrected(self, parameters, d, forces, matrices.d_f, free, known)
                if near is not None:
                    history.append((before / size, float(np.linalg.norm(near - d)) / size, 1.0))
                    return near, CONVERGED, np.array(history), known
                step, known = newton_step(forces, rates, matrices.d_f, residual, known)
            except np.linalg.LinAlgError:
                return d, SINGULAR, np.array(history).reshape(-1, 3), known
            share = 1.0
            for _ in range(halvings + 1):
                there = d - share * step
                new_forces = self.forces(there, parameters, forces)
                residual, size = residual_of(there, new_forces, matrices, free)
                after = float(np.linalg.norm(residual))
                if after < before or after <= NEWTON_ROUNDING * size:
                    break
                share *= 0.5
            else:
                rounded = LAST_NEWTON_STEP if forces.memory is None else ROUNDING_OF_MEMORY
                if before <= rounded * size:
                    return d, CONVERGED, np.array(history).reshape(-1, 3), known
                return d, STALLED, np.array(history).reshape(-1, 3), known
            d, forces = there, new_forces
            history.append((before / size, float(np.linalg.norm(step)) / size, share))
            if share == 1.0 and (after <= NEWTON_ROUNDING * size or np.linalg.norm(step) <= LAST_NEWTON_STEP * size):
                return d, CONVERGED, np.array(history), known
        return d, STALLED, np.array(history), known

    @property
    def resolved_share(self) -> float:
        """Bound of the error of the outputs, see `unresolved`, above which points are doubled."""
        return self.coarseness * RESOLVED_SHARE

    @unwarned
    def find(self, parameters: np.ndarray, guess: np.ndarray | None) -> tuple[Solved, str]:
        """Solve from a guess (points, elements), or from rest, and double the points until the outputs are resolved."""
        points = self._fewest()
        if guess is not None:  # of which the last doubling is repeated
            points = max(points, 1 << (len(guess) // 2 - 1).bit_length())
        given = None if guess is None else harmonics(guess)
        d, code, history, known, found_by = self._from(parameters, given, points)
        while code != CONVERGED and points < MOST_STARTING_POINTS:  # few points may not resolve a contact
            points = min(STARTING_RATIO * points, MOST_STARTING_POINTS)
            d, code, history, known, found_by = self._from(parameters, given, points)
        if code == CONVERGED:
            d, code, history = self.doubled(parameters, d, known)
        return Solved(on_grid(d, 2 * len(d)), code, history), found_by

    def _from(
        self, parameters: np.ndarray, guess: np.ndarray | None, points: int
    ) -> tuple[np.ndarray, int, np.ndarray, Preconditioner | None, str]:
        """Return what `newton` does on a number of points from a guess (harmonics, elements) or rest, and how."""
        start = np.zeros((points // 2, self.count), dtype=complex) if guess is None else resized(guess, points)
        solved = self.newton(parameters, start)
        if solved[1] != CONVERGED and guess is None:
            raised = with_raised_load(self, parameters, start)
            if raised is not None:
                return *self.newton(parameters, raised), "input amplitude"
        return *solved, "newton"

    @unwarned
    def doubled(
        self, parameters: np.ndarray, d: np.ndarray, known: Preconditioner | None = None
    ) -> tuple[np.ndarray, int, np.ndarray]:
        """Double the points of a solution until its outputs are resolved; return it, the code and Newton's history.

        `known` is a matrix as that of `newton`.
        """
        history, change = np.empty((0, 3)), np.nan
        before, share = self._outputs(d, parameters)
        enough = RESOLVED_CHANGE_OF_MEMORY if self.model.state_owners else RESOLVED_CHANGE
        while not (change <= self.coarseness * enough and share <= self.resolved_share):
            if 2 * len(d) >= MOST_ELEMENT_POINTS:
                worst = np.fmax(change, share)
                return d, CONVERGED if worst <= LARGEST_OUTPUT_CHANGE else NOT_RESOLVED, history
            finer, code, history, known = self.newton(parameters, resized(d, 4 * len(d)), known=known)
            if code != CONVERGED:
                return d, code, history
            d, (after, share) = finer, self._outputs(finer, parameters)
            sizes = np.maximum(np.abs(after).max(axis=0), np.finfo(float).tiny)
            before, change = after, float(np.max(np.abs(after - before) / sizes, initial=0.0))
        return d, CONVERGED, history

    def _fewest(self) -> int:
        """Return the number of points with which to start: enough for the harmonics of the inputs."""
        sizes = np.abs(self.input_harmonics(2 * self.grid.points)).max(axis=1, initial=0.0)
        highest = int(np.flatnonzero(sizes > LEAST_HARMONIC * sizes.max(initial=0.0)).max(initial=0))
        return max(FEWEST_ELEMENT_POINTS, 1 << (4 * highest).bit_length())

    def _outputs(self, d: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the outputs on the experiment's grid, and the bound of their error by the number of points."""
        y, bound = self._output_harmonics(d, parameters)
        return self.on_points(y), bound

    def _output_harmonics(self, d: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, float]:
        matrices, f = self.matrices(parameters, 2 * len(d))[0], harmonics(self.forces(d, parameters).values)
        y = times(matrices.y_u, self.input_harmonics(2 * len(d))) - times(matrices.y_f, f)
        bound = float(unresolved(matrices.largest, f, y))
        return y, max(bound, self.error_of_memory(d, f, y, parameters))

    def error_of_memory(self, d: np.ndarray, f: np.ndarray, y: np.ndarray, parameters: np.ndarray) -> float:
        """Return the relative error of the outputs by that of internal states, d being held; 0 without such states.

        It is a third of their change if half of the points give the forces' harmonics f, since the formula is of order
        two at kinks.
        """
        if not self.model.state_owners:
            return 0.0
        memory, fewer = self.forces(d, parameters).memory, np.empty((len(d) // 2, self.count), dtype=complex)
        if memory is None:
            return np.inf
        compiled().forces_on_fewer(
            self.model.element_kernels.residual_jacobian.address, parameters, 2.0 * np.pi * self.frequency,
            float(self.grid.periods), *transform_tables(2 * len(d)), memory.blocks, memory.states, fewer,
        )  # fmt: skip
        return float(error_of_fewer(self.matrices(parameters, 2 * len(d))[0].y_f, fewer - f[: len(fewer)], y))

    def error_bound(self, z: np.ndarray, parameters: np.ndarray) -> float:
        """Return the bound of the relative error of the outputs by the number of points, see `unresolved`."""
        return self._output_harmonics(harmonics(z), parameters)[1]

    def outputs(self, z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return the outputs (points, channels) on the experiment's grid."""
        return self._outputs(harmonics(z), parameters)[0]

    def linear_rates(self, parameters: np.ndarray) -> np.ndarray:
        """Return the lowest angular frequencies [1/s] without damping, elements linear as at rest, states held."""
        modes = self._receptance.lowest(parameters, LINEAR_MODES, self.model.structure.weights)
        springs = self._at_rest(parameters).stiffness[0]
        return np.sqrt(np.linalg.eigvals(modes.stiffness + (modes.at.T * springs) @ modes.at).astype(complex))

    def _at_rest(self, parameters: np.ndarray) -> Forces:
        return self.forces(np.zeros((self._fewest() // 2, self.count), dtype=complex), parameters)

    def linear_outputs(self, parameters: np.ndarray) -> np.ndarray:
        """Return the outputs (points, channels) if the forces of the elements were linear as at rest; NaN if none."""
        points, forces = self._fewest(), self._at_rest(parameters)
        matrices, load = self.matrices(parameters, points)[0], self.input_harmonics(points)
        f = harmonics(forces.values)
        right = times(matrices.d_u, load) - times(matrices.d_f, f)
        d = linear_solve(forces, self.rates(points), matrices.d_f, right[None])
        if d is None:
            return np.full((self.grid.points, len(self.model.outputs)), np.nan)
        f = f + linearised(forces, self.rates(points), d)[0]
        return self.on_points(times(matrices.y_u, load) - times(matrices.y_f, f))

    def sensitivities_along(
        self, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray
    ) -> Sensitivities | None:
        """Return derivatives along directions (directions, parameters) of the parameters; None if singular."""
        return self._sensitivities(z, parameters, np.pad(directions, ((0, 0), (0, 1))))

    def parameter_sensitivities(self, z: np.ndarray, parameters: np.ndarray) -> Sensitivities | None:
        """Return derivatives to every parameter and last to the frequency; None if singular."""
        return self._sensitivities(z, parameters, np.eye(parameters.size + 1))

    def input_sensitivities(
        self, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray, frequency: np.ndarray
    ) -> Sensitivities | None:
        """Return derivatives along changes of inputs and frequency; None if singular."""
        of_frequency = np.zeros((len(directions), parameters.size + 1))
        of_frequency[:, -1] = frequency
        result = self._sensitivities(z, parameters, of_frequency, directions[..., : len(self.model.inputs)])
        return result and result._replace(frequency=frequency)

    @unwarned
    def slopes(
        self, d: np.ndarray, parameters: np.ndarray, directions: list[int]
    ) -> tuple[Forces, ResponseMatrices, np.ndarray, np.ndarray]:
        """Return forces, frequency response, and what changes of parameters add to d and outputs with d held.

        `directions` are indices of parameters, their number standing for the frequency; the latter are (directions,
        harmonics, elements) and (directions, harmonics, outputs).
        """
        points = 2 * len(d)
        matrices, changes = self.matrices(parameters, points, directions)
        forces = self.forces(d, parameters)
        f, load = harmonics(forces.values), self.input_harmonics(points)
        slopes, size = np.zeros((points, self.count, len(directions))), parameters.size
        of_elements = [index for index, n in enumerate(directions) if n < size]
        if of_elements:
            slopes[..., of_elements] = self.forces_by_parameters(d, parameters)[
                ..., [directions[n] for n in of_elements]
            ]
        for index in (i for i, n in enumerate(directions) if n == size):
            slopes[..., index] = self._by_frequency(d, forces)
        of_forces = harmonics(slopes.reshape(points, self.count * len(directions))).reshape(
            len(d), self.count, len(directions)
        )
        direct = np.moveaxis(of_forces, -1, 0)
        of_d = times(changes.d_u, load) - times(changes.d_f, f) - times(matrices.d_f, direct)
        of_y = times(changes.y_u, load) - times(changes.y_f, f) - times(matrices.y_f, direct)
        return forces, matrices, of_d, of_y

    @unwarned
    def _sensitivities(
        self, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray, inputs: np.ndarray | None = None
    ) -> Sensitivities | None:
        """Return derivatives along directions (directions, parameters + 1), the frequency last; None if singular.

        `inputs` (directions, grid points, inputs) are changes of the inputs.
        """
        d, points = harmonics(z), len(z)
        used = np.flatnonzero(directions.any(axis=0))
        forces, matrices, of_d, of_y = self.slopes(d, parameters, used.tolist())
        right, explicit = (np.tensordot(directions[:, used], part, (1, 0)) for part in (of_d, of_y))
        if inputs is not None:
            more = self.input_harmonics(points, inputs)
            right, explicit = right + times(matrices.d_u, more), explicit + times(matrices.y_u, more)
        return self._moved(forces, matrices, right, explicit)

    @unwarned
    def moved_by_forces(self, z: np.ndarray, parameters: np.ndarray, change: np.ndarray) -> Sensitivities | None:
        """Return derivatives along changes of the elements' forces (directions, points, elements); None if singular."""
        if not change.size:
            outputs = np.zeros((len(change), self.grid.points, len(self.model.outputs)))
            return Sensitivities(np.zeros(change.shape), outputs, np.zeros(len(change)))
        matrices, f = self.matrices(parameters, len(z))[0], harmonics(change)
        forces = self.forces(harmonics(z), parameters)
        return self._moved(forces, matrices, -times(matrices.d_f, f), -times(matrices.y_f, f))

    def _moved(
        self, forces: Forces, matrices: ResponseMatrices, right: np.ndarray, explicit: np.ndarray
    ) -> Sensitivities | None:
        """Return derivatives along what is added to d and the outputs, (directions, harmonics, …), with d held."""
        points = len(forces.values)
        rates = self.rates(points)
        moved = linear_solve(forces, rates, matrices.d_f, right)
        if moved is None:
            return None
        outputs = explicit - times(matrices.y_f, linearised(forces, rates, moved))
        return Sensitivities(on_grid(moved, points), self.on_points(outputs), np.zeros(len(right)))


_RECEPTANCES: WeakKeyDictionary[CondensedModel, Receptance] = WeakKeyDictionary()


def receptance(model: CondensedModel) -> Receptance:
    """Return the frequency response of elements and outputs to elements and inputs, computed once a model."""
    if model not in _RECEPTANCES:
        given = model.structure
        rows = np.array([*given.weights, *(at for at, _ in given.measured.values())])
        columns = np.array([*given.weights, *given.inputs.values()])
        _RECEPTANCES[model] = Receptance(given, model.parameters, rows, columns)
    return _RECEPTANCES[model]


def equations_for(model: Model, inputs: Mapping[str, np.ndarray] | None, **settings: Any) -> PeriodicEquations:
    """Return the equations of a model, condensed or discretised; arguments as those of `PeriodicEquations.build`."""
    kind = CondensedEquations if isinstance(model, CondensedModel) else PeriodicEquations
    return kind.build(model, inputs, **settings)
