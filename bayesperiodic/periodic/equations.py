"""The discretised equations of one periodic problem: residuals, linearisation, Newton's iteration, sensitivities."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple, Self

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.compiled import (
    CONVERGED,
    HALVINGS,
    MAX_SEGMENTS,
    MOST_NEWTON_STEPS,
    NO_BORDER,
    NO_UNKNOWNS,
    NOT_RESOLVED,
    Border,
    Factors,
    Functions,
    Setting,
    Unknowns,
    Workspace,
    kernels,
)
from bayesperiodic.periodic.floquet import first_order_matrix
from bayesperiodic.periodic.schemes import CyclicGrid, Scheme, default_scheme, find_scheme

# Values of all states from which an equilibrium is sought if the equations are singular at zero, in SI units, and the
# relative size of the last step at an equilibrium.
EQUILIBRIUM_VALUES = tuple(sign * 10.0**k for sign in (1, -1) for k in sorted(range(-9, 10), key=abs))
AT_EQUILIBRIUM = 1e-6


class CyclicFactors:
    """Factors of the folded band of ∂g/∂z, with pivoting; not `regular` if a pivot is zero or not finite.

    `columns` (points, states·(1 + 3·states)) are g and ∂g/∂(q, q̇, q̈), as `residual_jacobian` returns them.
    """

    def __init__(self, grid: CyclicGrid, columns: np.ndarray, states: int, frequency: float, *border: Any):
        self._grid, self._states = grid, states
        self._compiled = kernels("linear", states, grid.stencil)
        self._lower = grid.packed.half_width * states + states - 1
        size = grid.points * states
        self.band = np.empty((size, 3 * self._lower + 1))
        self.pivots = np.empty(size, dtype=np.int64)
        self._compiled.assemble(columns, grid.packed, states, frequency, self.band)
        self.regular = self._factor(*border)

    def _factor(self, *border: Any) -> bool:
        return bool(self._compiled.factor(self.band, self._lower, self._lower, self.pivots))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return x (…, points, states) of ∂g/∂z·x = right."""
        return self._substitute(self._compiled.solve, right)

    def solve_transposed(self, right: np.ndarray) -> np.ndarray:
        """Return x (…, points, states) of (∂g/∂z)ᵀ·x = right."""
        return self._substitute(kernels("batch", self._states, self._grid.stencil).solve_transposed, right)

    def _substitute(self, routine: Callable[..., None], right: np.ndarray) -> np.ndarray:
        if not self.regular:
            raise np.linalg.LinAlgError("the derivative of the equations by the states is singular")
        folded = self._fold(right)
        routine(self.band, self._lower, self._lower, self.pivots, folded)
        return self._unfold(folded).reshape(right.shape)

    def _fold(self, natural: np.ndarray) -> np.ndarray:
        """Return arrays (…, points, states) in the folded order, (arrays, size)."""
        folded = np.empty((natural.size // len(self.band), self._grid.points, self._states))
        folded[:, self._grid.packed.place] = natural.reshape(folded.shape)
        return folded.reshape(-1, len(self.band))

    def _unfold(self, folded: np.ndarray) -> np.ndarray:
        shaped = folded.reshape(-1, self._grid.points, self._states)
        return np.ascontiguousarray(shaped[:, self._grid.packed.place])


class BorderedFactors(CyclicFactors):
    """Factors of [∂g/∂z, B; C, D], also where ∂g/∂z is singular.

    B and C are `sides` and `rows` (borders, points, states), D is `corner` (borders, borders), the last arguments after
    those of `CyclicFactors`. The `orientation` is the
    sign of the determinant, which changes along a branch only at folds; 0 if the matrix is singular.
    """

    def _factor(self, *border: Any) -> bool:
        sides, rows, corner = border
        self.border = Border.empty(len(rows), len(self.band))
        self.border.columns[:-1] = self._fold(sides)
        self.border.rows[:] = self._fold(rows)
        self.border.corner[:] = corner
        self._compiled = kernels("border", self._states, self._grid.stencil)
        self.orientation = self._compiled.factor_bordered(self.band, self.pivots, self.border)
        return self.orientation != 0.0

    def solve_bordered(self, right: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return x and y of [∂g/∂z, B; C, D]·(x, y) = (right, below); None if the matrix is singular.

        x and `right` are (sides, points, states), y and `below` (sides, borders).
        """
        if not self.regular:
            return None
        folded, y = self._fold(right), np.array(below, dtype=float, order="C")
        self._compiled.solve_bordered(self.band, self.pivots, self.border, folded, y)
        return (self._unfold(folded), y) if np.isfinite(folded).all() else None


def null_vector(grid: CyclicGrid, columns: np.ndarray, states: int, frequency: float) -> np.ndarray:
    """Return the unit vector (points, states) that a nearly singular ∂g/∂z makes smallest."""
    nothing = np.empty((0, grid.points, states))
    factors = BorderedFactors(grid, columns, states, frequency, nothing, nothing, 0.0)
    vector = factors._unfold(factors.border.columns)[0]
    return vector / np.linalg.norm(vector)


FREQUENCY = "frequency"


class Solved(NamedTuple):
    """Result of the Newton iteration: z (points, states), status code, history, values of further unknowns."""

    z: np.ndarray
    code: int
    history: np.ndarray
    values: np.ndarray = np.empty(0)


class Derivatives(NamedTuple):
    """Partial derivatives on the grid, each (points, rows, columns); g_f and f_f are to the frequency, z held."""

    g_theta: np.ndarray
    g_u: np.ndarray
    g_frequency: np.ndarray
    f_q: np.ndarray
    f_theta: np.ndarray
    f_u: np.ndarray
    f_frequency: np.ndarray


@dataclass(frozen=True)
class PeriodicEquations:
    """g(z, θ) = 0 for one model, one set of inputs and one grid (de Kraker et al. 1997, eq. 2-4)."""

    model: Model
    grid: CyclicGrid
    frequency: float  # forcing frequency [Hz]; for an autonomous model that of the solution, an unknown
    inputs: np.ndarray  # (points, 3·inputs): u, u̇, ü
    drift: np.ndarray  # (states,), advance of each angle per forcing period

    @classmethod
    def build(
        cls,
        model: Model,
        inputs: Mapping[str, np.ndarray] | None,
        *,
        frequency: float,
        samples: int,
        scheme: str | Scheme | None = None,
        periods: int = 1,
        winding: int | Mapping[str, int] = 0,
    ) -> "PeriodicEquations":
        """Check the arguments and differentiate the inputs spectrally; see `solve.solve_periodic`."""
        frequency = _checks.positive("frequency", frequency)
        grid = CyclicGrid(find_scheme(scheme or default_scheme(model)), samples, periods)
        if model.autonomous and grid.periods > 1:
            raise ValueError(
                f"periods: must be 1, got {periods!r}; {model.name!r} is autonomous and has no forcing period. Give "
                "the frequency of the whole orbit."
            )
        _checks.same_names("inputs", inputs or {}, model.inputs)
        signals = np.empty((3, len(model.inputs), grid.points))
        for i, name in enumerate(model.inputs):
            values = _checks.finite_vector(f"inputs[{name!r}]", (inputs or {})[name], grid.points, "samples·periods")
            amplitudes, signals[0, i] = _fourier.coefficients(values), values
            for order in (1, 2):
                rate = _fourier.derivative(amplitudes, frequency / grid.periods, order)
                signals[order, i] = _fourier.on_grid(rate, grid.points)
        stacked = np.ascontiguousarray(signals.reshape(-1, grid.points).T)
        turns = _winding_numbers(model, winding)
        drift = np.array([2.0 * np.pi * turns.get(state, 0) / grid.periods for state in model.states])
        return cls(model, grid, frequency, stacked, drift)

    @property
    def count(self) -> int:
        """Number of states."""
        return len(self.model.states)

    @property
    def kernels(self) -> ModuleType:
        """The compiled functions of the Newton iteration for z alone or, for an autonomous model, with unknowns."""
        return kernels("bordered newton" if self.model.autonomous else "newton", self.count, self.grid.stencil)

    @property
    def bordered_kernels(self) -> ModuleType:
        """The compiled functions of the Newton iteration with further unknowns."""
        return kernels("bordered newton", self.count, self.grid.stencil)

    @property
    def functions(self) -> Functions:
        """The model's grid functions as the compiled functions take them."""
        return Functions.of(self.model.kernels)

    def setting(self, parameters: np.ndarray) -> Setting:
        """Return what else the equations depend on as the compiled functions take it."""
        return Setting(self.inputs, parameters, self.frequency, self.drift)

    @cached_property
    def winding(self) -> dict[str, int]:
        """Turns of each angle per response period."""
        turns = np.rint(self.drift * self.grid.periods / (2 * np.pi)).astype(int).tolist()
        return {s: turn for s, turn in zip(self.model.states, turns, strict=True) if s in self.model.angles}

    def at_frequency(self, frequency: float) -> Self:
        """Return the same equations at another frequency, the inputs unchanged as functions of tau."""
        ratio, width = frequency / self.frequency, len(self.model.inputs)
        inputs = self.inputs * np.repeat([1.0, ratio, ratio**2], width)
        return replace(self, frequency=frequency, inputs=inputs)

    def static_guess(self, parameters: np.ndarray) -> np.ndarray:
        """Return the equilibrium under the mean inputs, (points, states); least squares where it is not unique.

        The iteration starts from zero, or, where the equations are singular there, from `EQUILIBRIUM_VALUES` for all
        states until an equilibrium is found.
        """
        solution, _, finite = self._equilibrium(parameters, 0.0)
        for start in () if finite else EQUILIBRIUM_VALUES:
            other, converged, _ = self._equilibrium(parameters, start)
            if converged:
                solution = other
                break
        return np.tile(solution, (self.grid.points, 1))

    def linear_rates(self, parameters: np.ndarray) -> np.ndarray:
        """Return the eigenvalues [1/s] of the equations linearised about the equilibrium under the mean inputs."""
        columns = self.residual_jacobian(self.static_guess(parameters), parameters)
        jacobian = columns[:1, self.count :].reshape(1, self.count, -1)
        return np.asarray(np.linalg.eigvals(first_order_matrix(jacobian, tuple(self.model.orders.values()))[0]))

    def linear_outputs(self, parameters: np.ndarray) -> np.ndarray:
        """Return the outputs (points, channels) of the equations linearised about that equilibrium."""
        z = self.static_guess(parameters)
        columns = self.residual_jacobian(z, parameters)
        change = self.factors(columns).solve(np.ascontiguousarray(columns[:, : self.count]))
        return self.outputs(z - change, parameters)

    def _equilibrium(self, parameters: np.ndarray, start: float) -> tuple[np.ndarray, bool, bool]:
        """Return where Newton's iteration ends, if that is an equilibrium, and if the equations are finite at a start.

        All states are equal at the start.
        """
        kernels, count = self.model.kernels, self.count
        inputs, tau = np.ascontiguousarray(self.inputs.mean(axis=0)[None]), np.zeros(1)
        inputs[0, len(self.model.inputs) :] = 0.0
        states, best, step = np.zeros((1, 3 * count)), np.inf, np.full(count, np.inf)
        states[0, :count] = start
        solution = states[0, :count].copy()
        for _ in range(MOST_NEWTON_STEPS):
            row = kernels.evaluate("residual_jacobian", states, inputs, parameters, tau, self.frequency)[0]
            residual, stiffness = row[:count], row[count:].reshape(count, 3, count)[:, 0]
            with np.errstate(over="ignore"):
                size = float(np.linalg.norm(residual))
            if not np.isfinite(row).all() or size >= best:
                break
            best, solution = size, states[0, :count].copy()
            step = np.linalg.lstsq(stiffness, residual, rcond=None)[0]
            states[0, :count] -= step
        near = np.max(np.abs(step)) <= AT_EQUILIBRIUM * np.max(np.abs(solution))
        return solution, bool(near), best < np.inf

    def solve(
        self, parameters: np.ndarray, guess: np.ndarray, unknowns: Unknowns = NO_UNKNOWNS, border: Border = NO_BORDER
    ) -> Solved:
        """Run the Newton iteration for z and further unknowns from a guess (points, states) for the periodic part."""
        z, bordered = np.array(guess, dtype=float, order="C"), unknowns.values.size > 0
        history, work = np.zeros((MOST_NEWTON_STEPS, 3)), workspace(self, bordered=bordered)
        compiled = kernels("bordered newton" if bordered else "newton", self.count, self.grid.stencil)
        code, iterations, _ = compiled.newton(
            self.functions, self.grid.packed, self.setting(parameters), unknowns, border, HALVINGS, z, history, work
        )
        return Solved(z, code, history[:iterations], unknowns.values)

    @cached_property
    def separated(self) -> bool:
        """True if even and odd points of an autonomous model are separate solutions, each of free phase."""
        used = self.grid.offsets[self.grid.packed.first != 0.0]
        alone = self.model.autonomous and set(self.model.orders.values()) == {1} and self.grid.points % 2 == 0
        return alone and bool(np.all(used % 2))

    def checked(self, solved: Solved) -> Solved:
        """Return a solve, marked "not resolved" if it converged but its points alternate, or may do so."""
        if solved.code != CONVERGED:
            return solved
        jagged = self.separated or self.kernels.is_jagged(np.ascontiguousarray(solved.z), self.inputs)
        return solved._replace(code=NOT_RESOLVED) if jagged else solved

    def states(self, z: np.ndarray, drift: np.ndarray | None = None) -> np.ndarray:
        """Return q, q̇, q̈ side by side, (points, 3·states), from the periodic part."""
        out = np.empty((z.shape[0], 3 * z.shape[1]))
        rate = self.drift if drift is None else drift
        self.kernels.differentiate(z, rate, self.grid.packed, self.frequency, out)
        return out

    def changes(self, z: np.ndarray) -> np.ndarray:
        """Return the changes of q, q̇, q̈ (directions, points, 3·states) for those of z (directions, points, states)."""
        still = np.zeros(z.shape[-1])
        result = np.empty((*z.shape[:-1], 3 * z.shape[-1]))
        for direction, change in enumerate(z):
            result[direction] = self.states(np.ascontiguousarray(change), still)
        return result

    def outputs(self, z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return ŷ, (points, channels)."""
        return self.evaluate("outputs", z, parameters)

    def residual_jacobian(self, z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return g and ∂g/∂(q, q̇, q̈) side by side, (points, states·(1 + 3·states))."""
        return self.evaluate("residual_jacobian", z, parameters)

    def factors(self, columns: np.ndarray) -> CyclicFactors:
        """Return the factors of ∂g/∂z for what `residual_jacobian` returned."""
        return CyclicFactors(self.grid, columns, self.count, self.frequency)

    def bordered(
        self, columns: np.ndarray, sides: np.ndarray, rows: np.ndarray, corner: np.ndarray | float = 0.0
    ) -> BorderedFactors:
        """Return the factors of [∂g/∂z, B; C, D]."""
        return BorderedFactors(self.grid, columns, self.count, self.frequency, sides, rows, corner)

    def factorise(self, columns: np.ndarray, z: np.ndarray, factors: Factors) -> bool:
        """Fill the factors of ∂g/∂z at z that the compiled iteration uses; return False if it is singular."""
        amplitude = np.abs(z).max(axis=0)
        amplitude[amplitude == 0.0] = 1.0
        return self.kernels.factorise(columns, self.grid.packed, self.frequency, amplitude, factors)

    def sizes(self, z: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the size of each equation's terms."""
        (size, rounding), weight = np.empty((2, self.count)), np.empty((self.count, self.count))
        given = columns, self.states(z), self.grid.packed, np.abs(z).max(axis=0), self.frequency
        self.kernels.scales(*given, size, rounding, weight)
        return size

    def scaled_residual(self, z: np.ndarray, parameters: np.ndarray) -> float:
        """Return the largest residual in units of the size of its equation's terms."""
        columns = self.residual_jacobian(z, parameters)
        size = self.sizes(z, columns)
        worst = np.abs(columns[:, : self.count]).max(axis=0)
        with np.errstate(invalid="ignore"):
            return float(np.max(np.divide(worst, size, out=np.zeros(self.count), where=size > 0)))

    def derivatives(self, z: np.ndarray, parameters: np.ndarray) -> Derivatives:
        """Return the partial derivatives of g and f."""
        return Derivatives(*self.model.kernels.split_derivatives(self.evaluate("derivatives", z, parameters)))

    def frequency_jacobian(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ∂(q, q̇, q̈)/∂frequency and ∂(u, u̇, ü)/∂frequency, z and the inputs held as functions of tau."""
        order = np.repeat([0.0, 1.0, 2.0], self.count) / self.frequency
        input_order = np.repeat([0.0, 1.0, 2.0], len(self.model.inputs)) / self.frequency
        return self.states(z) * order, self.inputs * input_order

    def phase_row(self, z: np.ndarray) -> np.ndarray:
        """Return the row (points, states) of the phase condition against z, states in units of their range."""
        return phase_row(self.grid, z, self.states(z))

    def evaluate(self, name: str, z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return one of the model's grid functions at the periodic part z."""
        return self.model.kernels.evaluate(name, self.states(z), self.inputs, parameters, self.grid.tau, self.frequency)

    def reduced(self, states: np.ndarray) -> np.ndarray:
        """Return z (points, states) for the periodic parts of all states: the same."""
        return states

    def sensitivities_along(
        self, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray
    ) -> "Sensitivities | None":
        """Return derivatives along directions (directions, parameters) of the parameters; None if singular."""
        d, columns = self.derivatives(z, parameters), self.residual_jacobian(z, parameters)
        with np.errstate(over="ignore", invalid="ignore"):  # of derivatives that overflow, which callers check
            g, f = np.tensordot(directions, d.g_theta, (1, 2)), np.tensordot(directions, d.f_theta, (1, 2))
        return respond(self, z, columns, d, g, f)

    def parameter_sensitivities(self, z: np.ndarray, parameters: np.ndarray) -> "Sensitivities | None":
        """Return derivatives to every parameter and, for a driven model, last to the frequency; None if singular.

        For an autonomous model the change of the orbit is orthogonal to the flow, states in units of their range.
        """
        d, columns = self.derivatives(z, parameters), self.residual_jacobian(z, parameters)
        g, f = np.moveaxis(d.g_theta, 2, 0), np.moveaxis(d.f_theta, 2, 0)
        if not self.model.autonomous:
            g_frequency, f_frequency = frequency_derivatives(self, z, columns, d)
            g, f = np.concatenate([g, g_frequency[None]]), np.concatenate([f, f_frequency[None]])
        return respond(self, z, columns, d, g, f)

    def input_sensitivities(
        self, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray, frequency: np.ndarray
    ) -> "Sensitivities | None":
        """Return derivatives along perturbations of a driven model's inputs and frequency; None if singular.

        They are (directions, points, 3·inputs) of (u, u̇, ü) as functions of τ, and (directions,) of the frequency [Hz].
        """
        d, columns = self.derivatives(z, parameters), self.residual_jacobian(z, parameters)
        g, f = along(d.g_u, directions), along(d.f_u, directions)
        if frequency.any():
            g_frequency, f_frequency = frequency_derivatives(self, z, columns, d)
            g, f = g + frequency[:, None, None] * g_frequency, f + frequency[:, None, None] * f_frequency
        result = respond(self, z, columns, d, g, f)
        return result and result._replace(frequency=frequency)


def phase_row(grid: CyclicGrid, z: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the row (points, states) of the phase condition against z, given q, q̇, q̈ side by side."""
    folded = np.empty(z.size)
    kernels("border", z.shape[1], grid.stencil).phase_row(np.ascontiguousarray(z), states, grid.packed, folded)
    return np.ascontiguousarray(folded.reshape(z.shape)[grid.packed.place])


def workspace(equations: PeriodicEquations, *, bordered: bool) -> Workspace:
    """Return the arrays that the Newton iteration overwrites."""
    points, count = equations.grid.points, equations.count
    return Workspace(
        np.empty((points, 3 * count)),
        np.empty((points, count * (1 + 3 * count))),
        np.empty((points, equations.model.kernels.columns("derivatives") if bordered else 0)),
        empty_factors(equations.grid, count),
    )


def empty_factors(grid: CyclicGrid, states: int, sets: tuple[int, ...] = ()) -> Factors:
    """Return arrays for the factors of the compiled functions, one for each of `sets`."""
    points, reach = grid.points, max(grid.reach, 1)
    lower = grid.packed.half_width * states + states - 1
    coupled = MAX_SEGMENTS * reach * states if grid.reach else 1
    return Factors(
        np.empty((*sets, points * states, 3 * lower + 1)),
        np.empty((*sets, points * states), dtype=np.int64),
        np.empty((*sets, points, states, states)),
        np.empty((*sets, points, reach, states, states)),
        np.empty((*sets, states, reach * states, points)),
        np.empty((*sets, 1 + MAX_SEGMENTS), dtype=np.int64),
        np.empty((*sets, coupled * (3 * coupled - 2))),
        np.empty((*sets, coupled), dtype=np.int64),
    )


def _winding_numbers(model: Model, winding: int | Mapping[str, int]) -> dict[str, int]:
    """Return the winding number of every angle among the states."""
    angles = [state for state in model.states if state in model.angles]
    if not isinstance(winding, Mapping):
        turns = _checks.integer("winding", winding)
        if turns and not angles:
            raise ValueError(
                f"winding: must be 0, got {winding!r}; no state of {model.name!r} is an angle, see Model(angles=…)."
            )
        if turns and len(angles) > 1:
            example = {angles[0]: turns}
            raise ValueError(
                f"winding: must name the angles {angles} of {model.name!r}, as {example}, got {winding!r}."
            )
        return dict.fromkeys(angles, turns)
    for name, turns in winding.items():
        _checks.one_of("winding", name, angles)
        _checks.integer(f"winding[{name!r}]", turns)
    return dict.fromkeys(angles, 0) | dict(winding)


class Sensitivities(NamedTuple):
    """Derivatives along several directions, on the grid."""

    states: np.ndarray  # (directions, points, states)
    outputs: np.ndarray  # (directions, points, channels)
    frequency: np.ndarray  # (directions,), of the solution's frequency [Hz per unit]; zero for a driven model


def along(derivatives: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the derivatives (points, values, variables) times directions (directions, points, variables)."""
    with np.errstate(over="ignore", invalid="ignore"):  # Where outputs overflow the result is not finite.
        return np.ascontiguousarray(np.moveaxis(derivatives @ np.moveaxis(directions, 0, 2), 2, 0))


def frequency_derivatives(
    equations: PeriodicEquations, z: np.ndarray, columns: np.ndarray, d: Derivatives
) -> tuple[np.ndarray, np.ndarray]:
    """Return dg/dfrequency (points, states) and df/dfrequency (points, channels), z and inputs held in tau."""
    states, inputs = equations.frequency_jacobian(z)
    _, g_u, g_frequency, f_q, _, f_u, f_frequency = d
    g_q = columns[:, equations.count :].reshape(len(z), equations.count, -1)
    g = g_frequency[:, :, 0] + np.einsum("neq,nq->ne", g_q, states) + np.einsum("neu,nu->ne", g_u, inputs)
    f = f_frequency[:, :, 0] + np.einsum("ncq,nq->nc", f_q, states) + np.einsum("ncu,nu->nc", f_u, inputs)
    return g, f


def respond(
    equations: PeriodicEquations, z: np.ndarray, columns: np.ndarray, d: Derivatives, g: np.ndarray, f: np.ndarray
) -> Sensitivities | None:
    """Return the response to changes of g (directions, points, states) and f (directions, points, channels)."""
    if equations.model.autonomous:
        g_frequency, f_frequency = frequency_derivatives(equations, z, columns, d)
        factors = equations.bordered(columns, g_frequency[None], equations.phase_row(z)[None])
        solved = factors.solve_bordered(-g, np.zeros((len(g), 1)))
        if solved is None:
            return None
        z_change, frequency = solved[0], solved[1][:, 0]
        f = f + frequency[:, None, None] * f_frequency
    else:
        regular = equations.factors(columns)
        if not regular.regular:
            return None
        z_change, frequency = regular.solve(-g), np.zeros(len(g))
    return Sensitivities(z_change, f + along(d.f_q, equations.changes(z_change)), frequency)
