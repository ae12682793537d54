"""The discretised equations of one periodic problem: solved, linearised, and perturbed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bayesperiodic import checks, fourier
from bayesperiodic.models.compile import as_columns
from bayesperiodic.models.model import Model
from bayesperiodic.periodic import compiled
from bayesperiodic.periodic.schemes import CyclicGrid, Scheme, find_scheme


class Solved(NamedTuple):
    """What Newton's iteration ended with: the periodic part z (points, states), a status code, and its history."""

    z: np.ndarray
    code: int
    history: np.ndarray


class Sensitivities(NamedTuple):
    """Derivatives on the grid: z (directions, points, states) and outputs (directions, points, channels)."""

    states: np.ndarray
    outputs: np.ndarray


@dataclass(frozen=True)
class PeriodicEquations:
    """g(z, θ) = 0 for one model, one set of inputs and one grid ([1]_, eq. 2-4).

    References
    ----------
    .. [1] de Kraker, Verbeek & van de Wouw 1997.
    """

    model: Model
    grid: CyclicGrid
    frequency: float
    inputs: np.ndarray
    drift: np.ndarray

    @classmethod
    def build(
        cls,
        model: Model,
        inputs: Mapping[str, np.ndarray] | None,
        *,
        frequency: float,
        samples: int,
        scheme: str | Scheme,
        periods: int,
        winding: int | Mapping[str, int],
    ) -> "PeriodicEquations":
        """Check the arguments and differentiate the inputs spectrally; see `solution.solve_periodic`."""
        if model.autonomous:
            raise ValueError(
                f"model: {model.name!r} is autonomous (neither inputs nor tau appear in its equations), so its period "
                "is unknown; solve_periodic takes forced models."
            )
        frequency = checks.positive("frequency", frequency)
        grid = CyclicGrid(find_scheme(scheme), samples, periods)
        checks.same_names("inputs", inputs or {}, model.inputs)
        columns: list[list[np.ndarray]] = [[], [], []]
        for name in model.inputs:
            values = checks.finite_vector(f"inputs[{name!r}]", (inputs or {})[name], grid.points)
            amplitudes = fourier.coefficients(values)
            columns[0].append(values)
            for order in (1, 2):
                rate = fourier.derivative(amplitudes, frequency / grid.periods, order)
                columns[order].append(fourier.on_grid(rate, grid.points))
        stacked = as_columns([column for order in columns for column in order], grid.points)
        return cls(model, grid, frequency, stacked, _drift(model, winding, grid.periods))

    def static_guess(self, parameters: np.ndarray) -> np.ndarray:
        """Return the equilibrium under the mean inputs, (points, states); least squares where it is not unique."""
        kernels, count = self.model.kernels, len(self.model.states)
        inputs, tau = np.ascontiguousarray(self.inputs.mean(axis=0)[None]), np.zeros(1)
        inputs[0, len(self.model.inputs) :] = 0.0
        states, best = np.zeros((1, 3 * count)), np.inf
        solution = states[0, :count].copy()
        for _ in range(compiled.MAX_ITERATIONS):
            row = kernels.evaluate("residual_jacobian", states, inputs, parameters, tau, self.frequency)[0]
            residual, stiffness = row[:count], row[count:].reshape(count, 3, count)[:, 0]
            size = float(np.linalg.norm(residual))
            if not np.isfinite(row).all() or size >= best:
                break
            best, solution = size, states[0, :count].copy()
            states[0, :count] -= np.linalg.lstsq(stiffness, residual, rcond=None)[0]
        return np.tile(solution, (self.grid.points, 1))

    def solve(self, parameters: np.ndarray, guess: np.ndarray) -> Solved:
        """Run Newton's iteration from a guess (points, states) for the periodic part."""
        grid, z = self.grid, np.array(guess, dtype=float, order="C")
        points, count = z.shape
        lower = self._lower
        history = np.zeros((compiled.MAX_ITERATIONS, 3))
        code, iterations = compiled.newton(
            self.model.kernels.residual_jacobian,
            grid.first,
            grid.second,
            grid.neighbours,
            grid.shift,
            grid.place,
            grid.half_width,
            self.inputs,
            parameters,
            grid.tau,
            self.frequency,
            self.drift,
            z,
            np.empty((points, 3 * count)),
            np.empty((points, count * (1 + 3 * count))),
            history,
            np.empty((points * count, 3 * lower + 1)),
            np.empty(points * count, dtype=np.int64),
        )
        return Solved(z, code, history[:iterations])

    def states(self, z: np.ndarray, drift: np.ndarray | None = None) -> np.ndarray:
        """Return q, q̇, q̈ side by side, (points, 3·states), from the periodic part."""
        grid, out = self.grid, np.empty((z.shape[0], 3 * z.shape[1]))
        rate = self.drift if drift is None else drift
        compiled.differentiate(z, rate, grid.first, grid.second, grid.neighbours, grid.tau, self.frequency, out)
        return out

    def outputs(self, z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return ŷ, (points, channels)."""
        return self._evaluate("outputs", self.states(z), parameters)

    def scaled_residual(self, z: np.ndarray, parameters: np.ndarray) -> float:
        """Return the largest residual in units of the size of its equation's terms."""
        states = self.states(z)
        columns = self._evaluate("residual_jacobian", states, parameters)
        count = z.shape[1]
        size, rounding = np.empty(count), np.empty(count)
        compiled.scales(
            columns,
            states,
            self.grid.first,
            self.grid.second,
            np.abs(z).max(axis=0),
            self.frequency,
            size,
            rounding,
        )
        worst = np.abs(columns[:, :count]).max(axis=0)
        with np.errstate(invalid="ignore"):
            return float(np.max(np.divide(worst, size, out=np.zeros(count), where=size > 0)))

    def parameter_sensitivities(self, z: np.ndarray, parameters: np.ndarray) -> Sensitivities | None:
        """Return derivatives to every parameter by the implicit function theorem (eq. 4); None if singular."""
        g_theta, _, f_q, f_theta, _ = self._derivatives(z, parameters)
        return self._respond(z, parameters, np.moveaxis(g_theta, 2, 0), f_q, np.moveaxis(f_theta, 2, 0))

    def input_sensitivities(
        self, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray
    ) -> Sensitivities | None:
        """Return derivatives along perturbations (directions, points, 3·inputs) of (u, u̇, ü); None if singular."""
        _, g_u, f_q, _, f_u = self._derivatives(z, parameters)
        g = np.einsum("neu,dnu->dne", g_u, directions)
        f = np.einsum("ncu,dnu->dnc", f_u, directions)
        return self._respond(z, parameters, g, f_q, f)

    def _respond(
        self, z: np.ndarray, parameters: np.ndarray, g: np.ndarray, f_q: np.ndarray, f: np.ndarray
    ) -> Sensitivities | None:
        grid, (points, count) = self.grid, z.shape
        columns = self._evaluate("residual_jacobian", self.states(z), parameters)
        band = np.empty((points * count, 3 * self._lower + 1))
        pivots = np.empty(points * count, dtype=np.int64)
        compiled.assemble(columns, grid.first, grid.second, grid.shift, grid.place, self.frequency, self._lower, band)
        if not compiled.factor(band, self._lower, self._lower, pivots):
            return None
        order = np.argsort(grid.place)
        right = np.ascontiguousarray(-g[:, order].reshape(len(g), points * count))
        compiled.solve(band, self._lower, self._lower, pivots, right)
        z_dot = np.ascontiguousarray(right.reshape(len(g), points, count)[:, grid.place])
        still = np.zeros(count)
        moved = np.stack([self.states(direction, still) for direction in z_dot]) if len(g) else np.empty((0, points, 3))
        return Sensitivities(z_dot, f + np.einsum("ncq,dnq->dnc", f_q, moved) if len(g) else f)

    def _derivatives(self, z: np.ndarray, parameters: np.ndarray) -> list[np.ndarray]:
        return self.model.kernels.split_derivatives(self._evaluate("derivatives", self.states(z), parameters))

    def _evaluate(self, name: str, states: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return self.model.kernels.evaluate(name, states, self.inputs, parameters, self.grid.tau, self.frequency)

    @property
    def _lower(self) -> int:
        count = len(self.model.states)
        return self.grid.half_width * count + count - 1


def _drift(model: Model, winding: int | Mapping[str, int], periods: int) -> np.ndarray:
    winding = winding_numbers(model, winding)
    return np.array([2.0 * np.pi * winding.get(state, 0) / periods for state in model.states])


def winding_numbers(model: Model, winding: int | Mapping[str, int]) -> dict[str, int]:
    """Return the winding number of every angle among the states."""
    angles = [state for state in model.states if state in model.angles]
    if not isinstance(winding, Mapping):
        turns = checks.integer("winding", winding, -(10**6))
        if turns and len(angles) != 1:
            raise ValueError(
                f"winding: {winding!r} is not allowed; the model {model.name!r} has the angles {angles} among its "
                "states, so name them: winding={'phi': 1}."
            )
        return dict.fromkeys(angles, turns)
    for name, turns in winding.items():
        checks.one_of("winding", name, angles)
        checks.integer(f"winding[{name!r}]", turns, -(10**6))
    return dict.fromkeys(angles, 0) | dict(winding)
