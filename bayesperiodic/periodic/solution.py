"""Periodic equilibrium states: what a solve returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Result
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.periodic.condensed import equations_for
from bayesperiodic.periodic.equations import (
    FREQUENCY,
    BorderedFactors,
    CyclicFactors,
    PeriodicEquations,
    Solved,
    phase_row,
)
from bayesperiodic.periodic.floquet import Floquet, derivative_factors, first_order_matrix
from bayesperiodic.periodic.index_one import orbit_floquet
from bayesperiodic.periodic.schemes import CyclicGrid, Scheme


def estimate_error(solution: PeriodicSolution, z: np.ndarray) -> dict[str, float]:
    """Return `PeriodicSolution.error_estimate` of a converged solution with the periodic part z (points, states)."""
    spectral, frequency, count = np.isinf(solution.scheme.order), solution.frequency, z.shape[1]
    grid = CyclicGrid(solution.scheme, solution.samples * (2 if spectral else 1), solution.periods)
    fine, g, jacobian = z, np.zeros_like(z), solution.linearisation.reshape(len(z), -1)
    if spectral:
        fine = _fourier.on_grid(_fourier.coefficients(z.T), grid.points).T
        g, jacobian = np.split(solution.twice_the_points, [count], axis=1)
    defect, slope, rates = -g, np.zeros_like(fine), []
    for order, weights in ((1, grid.packed.first), (2, grid.packed.second)):
        block = jacobian.reshape(len(fine), count, -1)[:, :, order * count : (order + 1) * count]
        rates.append(_derivative(fine, grid, weights, 1))
        slope += order * frequency ** (order - 1) * np.einsum("nes,ns->ne", block, rates[-1])
        if not spectral:
            change = rates[-1] - _derivative(z, grid, weights, 2) / 2**order
            change /= 2.0**solution.scheme.order - 1.0
            defect -= frequency**order * np.einsum("nes,ns->ne", block, change)
    matrix = grid, np.concatenate([g, jacobian], axis=1), count, frequency
    step, error = np.full_like(fine, np.nan), [np.nan] * solution.autonomous
    if solution.autonomous:
        row = phase_row(grid, fine, np.concatenate([fine, *rates], axis=1))
        solved = BorderedFactors(*matrix, slope[None], row[None], 0.0).solve_bordered(defect[None], np.zeros((1, 1)))
        if solved is not None:
            step, error = solved[0][0], [abs(float(solved[1][0, 0]))]
    else:
        factors = CyclicFactors(*matrix)
        step = factors.solve(defect) if factors.regular else step
    # The interpolation lacks the highest harmonic of an even grid.
    every = len(fine) // len(z)
    largest = np.abs(step[::every] + (fine[::every] - z)).max(axis=0)
    return dict(zip([*solution.states, FREQUENCY], [*largest.tolist(), *error], strict=False))


def _derivative(z: np.ndarray, grid: CyclicGrid, weights: np.ndarray, stride: int) -> np.ndarray:
    """Return the scheme's derivative with its offsets stretched by a stride, its weights as they are."""
    rolled = [w * np.roll(z, -stride * o, axis=0) for o, w in zip(grid.offsets.tolist(), weights.tolist(), strict=True)]
    return np.sum(rolled, axis=0)


def _twice_the_points(equations: PeriodicEquations, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return g and ∂g/∂(q, q̇, q̈) of the trigonometric interpolation, (2·points, states·(1 + 3·states))."""
    grid = CyclicGrid(equations.grid.scheme, 2 * equations.grid.samples, equations.grid.periods)
    fine, inputs = (_fourier.on_grid(_fourier.coefficients(v.T), grid.points).T for v in (z, equations.inputs))
    twice = replace(equations, grid=grid, inputs=np.ascontiguousarray(inputs))
    return twice.residual_jacobian(np.ascontiguousarray(fine), theta)


NEWTON = "newton"
# Difference of an output from a state [rad] up to which it is this angle, but for a constant.
SAME_ANGLE = 1e-6
# Largest error of the logarithm of an autonomous orbit's trivial multiplier for which the grid resolves the orbit: the
# period is then right to 0.4 % in relaxation oscillations with mu up to 20 and all schemes. A multiplier is on one side
# of the unit circle if its logarithm exceeds this error by a factor.
TRIVIAL_ERROR, CLEAR = 0.1, 2.0
# Estimated error of a driven orbit, in units of a state's range, above which its stability is unknown.
UNSURE = 0.05


@dataclass(frozen=True)
class PeriodicSolution(Result):
    """A periodic equilibrium state, stable or unstable, or the result of a failed solve.

    Attributes
    ----------
    model : str
        The model's name.
    autonomous : bool
        True if the frequency is part of the solution.
    status : str
        "converged", "stalled", "singular" (also if the cycles of an autonomous model are not isolated), "not finite",
        "other orbit" (an equilibrium instead of an autonomous model's orbit, or an orbit whose period is a fraction of
        the guess's) or "not resolved": the solution alternates from point to point by more than 1 % of a state's
        standard deviation, which is the scheme's doing, or the scheme does not relate even and odd points of an
        autonomous model ("central2", states of first order, an even grid).
        More points or another scheme help.
    found_by : str
        "newton", "sharpness", "input amplitude" or "time integration", see `solve_periodic`.
    frequency : float
        Forcing frequency [Hz]; that of the orbit for an autonomous model.
    samples, periods : int
        Grid points per forcing period, forcing periods per response period.
    winding : dict of str to int
        Turns of each angle per response period.
    scheme : Scheme
    parameters : dict of str to float
    orders : dict of str to int
        Order of each state, 1 or 2.
    tau : array (points,)
        Time in forcing periods, end point excluded; points = samples · periods.
    states, inputs, outputs : dict of str to array (points,)
    sensitivities : dict of str to dict of str to array (points,)
        ∂output/∂parameter, ``sensitivities[output][parameter]`` ([1]_, eq. 4), and for a driven model
        ``sensitivities[output]["frequency"]`` [per Hz], inputs held as functions of tau; empty unless converged. For an
        autonomous model the change is orthogonal to the flow, states in units of their range.
    state_sensitivities : dict of str to dict of str to array (points,)
        The same of the states.
    frequency_sensitivities : dict of str to float
        ∂frequency/∂parameter of an autonomous model's orbit; zero for a driven one.
    linearisation : array (points, states, 3·states)
        ∂g/∂(q, q̇, q̈) on the orbit.
    twice_the_points : array (2·points, states·(1 + 3·states))
        g and ∂g/∂(q, q̇, q̈) of the trigonometric interpolation of a solution by the fourier scheme, for
        `error_estimate`; empty for other schemes and unless converged.
    iterations : int
        Newton iterations of the last solve.
    residual : float
        Largest residual, in units of the size of its equation's terms.
    history : array (iterations, 3)
        Scaled residual before each iteration, scaled full Newton step, damping factor.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> solution.converged, solution.stable, solution.period, solution.iterations
    (True, True, 10.0, 5)

    The product of the multipliers is exp(−c/m · period), by Liouville's formula:

    >>> bool(np.isclose(np.prod(solution.multipliers), np.exp(-0.2 * 10)))
    True
    """

    model: str
    autonomous: bool
    status: str
    found_by: str
    frequency: float
    samples: int
    periods: int
    winding: dict[str, int]
    scheme: Scheme
    parameters: dict[str, float]
    orders: dict[str, int]
    tau: np.ndarray
    states: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]
    sensitivities: dict[str, dict[str, np.ndarray]]
    state_sensitivities: dict[str, dict[str, np.ndarray]]
    frequency_sensitivities: dict[str, float]
    linearisation: np.ndarray
    twice_the_points: np.ndarray
    iterations: int
    residual: float
    history: np.ndarray

    @property
    def converged(self) -> bool:
        """True if the status is "converged"."""
        return self.status == STATUSES[CONVERGED]

    @property
    def period(self) -> float:
        """The response period [s]."""
        return self.periods / self.frequency

    @property
    def floquet(self) -> Floquet | None:
        """Exponents and eigenfunctions of the linearised equations; None unless converged."""
        return None if isinstance(self._linearised, str) else self._linearised

    @cached_property
    def _linearised(self) -> Floquet | str:
        """Multipliers and eigenfunctions, or why there are none."""
        if not self.converged:
            return f"the solve ended with the status {self.status!r}"
        return orbit_floquet(self.linearisation, tuple(self.orders.values()), self._sizes(), self.period)

    def _sizes(self) -> np.ndarray:
        """Return typical sizes of the states, then of the rates of the second-order ones, for scaling."""
        sizes = {name: np.ptp(values - self._turns(name)) or 1.0 for name, values in self.states.items()}
        rates = [2 * np.pi / self.period * sizes[name] for name, order in self.orders.items() if order == 2]
        return np.array([*sizes.values(), *rates])

    def _turns(self, state: str) -> np.ndarray:
        return 2 * np.pi * self.winding.get(state, 0) / self.periods * self.tau

    def wave(self, output: str) -> np.ndarray:
        """Return an output (points,) without the uniform turning of a rotating angle.

        Parameters
        ----------
        output : str

        Returns
        -------
        array (points,)
        """
        values = self.outputs[output]
        for state, turns in self.winding.items():
            if turns and np.ptp(values - self.states[state]) < SAME_ANGLE:
                return values - self._turns(state)
        return values

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers over the response period, complex (multipliers,), largest modulus first.

        They are those of the linearised differential equations, including the trivial 1 of an autonomous model; none
        unless converged. If the matrix of the highest derivatives is singular (algebraic equations, index 1), or so
        nearly that the grid does not follow the fastest decay, there are as many as its rank; the others are zero.
        """
        with np.errstate(over="ignore"):
            return np.exp(self.floquet.exponents) if self.floquet is not None else np.empty(0, dtype=complex)

    @property
    def exponents(self) -> np.ndarray:
        """Floquet exponents log(multiplier)/period [1/s], complex (multipliers,); finite where multipliers overflow."""
        return self.floquet.exponents / self.period if self.floquet is not None else np.empty(0, dtype=complex)

    @property
    def trivial_error(self) -> float:
        """Modulus of the logarithm of an autonomous orbit's trivial multiplier, zero without discretisation errors.

        An autonomous orbit has a multiplier 1, so that this is the error of the multipliers. NaN for a driven model and
        without multipliers.
        """
        if not self.autonomous or self.floquet is None or not self.floquet.exponents.size:
            return np.nan
        return float(np.min(abs(self.floquet.exponents)))

    @property
    def resolved(self) -> bool:
        """True if the solve has converged, and an autonomous orbit's trivial multiplier is right to 10 %."""
        return self.converged and not self.trivial_error > TRIVIAL_ERROR

    @property
    def stable(self) -> bool | None:
        """True if all multipliers except an autonomous model's trivial one are inside the unit circle; None if unknown.

        It is unknown (`stability_unknown` says why) unless the solve has converged, if the grid does not resolve an
        autonomous orbit or another of its multipliers is as close to the unit circle as the trivial one is to 1, if the
        estimated error of a driven orbit exceeds 5 % of a state's range (not estimated for the fourier scheme), and if
        there are no multipliers.
        """
        return None if self.stability_unknown else bool(np.all(self._others.real < 0.0))

    @cached_property
    def stability_unknown(self) -> str:
        """Why the stability is unknown; empty if it is known."""
        if isinstance(self._linearised, str):
            return self._linearised
        if not self.resolved:
            trivial = min(self.exponents, key=abs) * self.period
            return f"the trivial multiplier is {_shown(trivial)} in place of 1: the grid does not resolve the orbit"
        if not self.autonomous and np.isfinite(self.scheme.order):
            for state, error in self.error_estimate().items():
                if error > UNSURE * np.ptp(self.states[state] - self._turns(state)):
                    return f"the discretisation error of {state!r} is estimated at more than {UNSURE:.0%} of its range"
        near = self._others[np.abs(self._others.real) <= CLEAR * self.trivial_error]
        if near.size:
            return f"the multiplier {_shown(near[0])} is as near to the unit circle as the trivial one is to 1"
        return ""

    @property
    def _others(self) -> np.ndarray:
        """Logarithms of the multipliers without the trivial one."""
        exponents = self.floquet.exponents if self.floquet is not None else np.empty(0, dtype=complex)
        return np.delete(exponents, np.argmin(abs(exponents))) if self.autonomous and exponents.size else exponents

    def error_estimate(self) -> dict[str, float]:
        """Return the estimated discretisation error of each state, the largest on the grid.

        Richardson extrapolation of the scheme's derivatives, from steps h and 2h on the same grid, is propagated to the
        states by the linearised equations. For the fourier scheme it is the change by a Newton step on twice as many
        points, a dense system of 2·points·states unknowns. An autonomous model has the error of the frequency [Hz] too.
        Where smooth signs change within one or two steps, the grid does not resolve the error, and the estimate is far
        too small.
        """
        if not self.converged:
            return dict.fromkeys(self.states, np.nan)
        z = np.stack([self.states[name] - self._turns(name) for name in self.states], axis=-1)
        return estimate_error(self, z)

    def __repr__(self) -> str:
        unknown = f", stability unknown: {self.stability_unknown}" if self.converged and self.stability_unknown else ""
        return (
            f"PeriodicSolution({self.model!r}, {self.status!r}, frequency={self.frequency:.6g} Hz, "
            f"samples={self.samples}, periods={self.periods}, iterations={self.iterations}, "
            f"residual={self.residual:.1e}{unknown})"
        )


def resolution_warning(solution: PeriodicSolution, orbit: str) -> str:
    """Return a warning, about an orbit that is named, if the trivial multiplier shows that it is not resolved."""
    if solution.resolved or not solution.converged:
        return ""
    spectral = np.isinf(solution.scheme.order)
    error = np.nan if spectral else solution.error_estimate()[FREQUENCY] / solution.frequency
    size = f" and its frequency is wrong by about {error:.2g} of its value" if np.isfinite(error) else ""
    cure = "more samples" if spectral else 'scheme="fourier", or more samples'
    multiplier = _shown(min(solution.exponents, key=abs) * solution.period)
    return (
        f"{orbit} is not resolved by {solution.samples} samples and the scheme {solution.scheme.name!r}: its trivial "
        f"multiplier is {multiplier} in place of 1{size}. Its stability is unknown. Take {cure}."
    )


def _shown(logarithm: complex) -> str:
    with np.errstate(over="ignore"):
        multiplier = np.exp(logarithm)
    return f"{multiplier.real:.3g}" if abs(multiplier.imag) < 1e-9 * abs(multiplier) else f"{multiplier:.3g}"


def describe(
    equations: PeriodicEquations, theta: np.ndarray, solved: Solved, found_by: str = NEWTON, sensitivities: bool = True
) -> PeriodicSolution:
    """Return the result of a solve as a PeriodicSolution, with sensitivities, if requested, where it converged."""
    model, grid, code = equations.model, equations.grid, equations.checked(solved).code
    by_output: dict[str, dict[str, np.ndarray]] = {}
    by_state: dict[str, dict[str, np.ndarray]] = {}
    by_parameter: dict[str, float] = {}
    if code == CONVERGED and sensitivities:
        derivative = equations.parameter_sensitivities(solved.z, theta)
        if derivative is None:
            code = SINGULAR
        else:
            names = (*model.parameters, FREQUENCY)[: len(derivative.frequency)]
            by_output = by_name(derivative.outputs, model.outputs, names)
            by_state = by_name(derivative.states, model.states, names)
            by_parameter = dict(zip(model.parameters, derivative.frequency.tolist(), strict=False))
    states, outputs = equations.states(solved.z), equations.outputs(solved.z, theta)
    columns, spectral = equations.residual_jacobian(solved.z, theta), code == CONVERGED and np.isinf(grid.scheme.order)
    return PeriodicSolution(
        model=model.name,
        autonomous=model.autonomous,
        status=STATUSES[code],
        found_by=found_by,
        frequency=equations.frequency,
        samples=grid.samples,
        periods=grid.periods,
        winding=equations.winding,
        scheme=grid.scheme,
        parameters=dict(zip(model.parameters, theta.tolist(), strict=True)),
        orders=model.orders,
        tau=grid.tau,
        states={name: states[:, i].copy() for i, name in enumerate(model.states)},
        inputs={name: equations.inputs[:, i].copy() for i, name in enumerate(model.inputs)},
        outputs={name: outputs[:, i].copy() for i, name in enumerate(model.outputs)},
        sensitivities=by_output,
        state_sensitivities=by_state,
        frequency_sensitivities=by_parameter,
        linearisation=columns[:, equations.count :].reshape(grid.points, equations.count, -1),
        twice_the_points=_twice_the_points(equations, solved.z, theta) if spectral else np.empty((0, 0)),
        iterations=len(solved.history),
        residual=equations.scaled_residual(solved.z, theta),
        history=solved.history,
    )


def settings_of(solution: PeriodicSolution) -> dict[str, Any]:
    """Return the keyword arguments of `solve_periodic` for the same frequency, grid and winding numbers."""
    return {name: getattr(solution, name) for name in ("frequency", "samples", "scheme", "periods", "winding")}


def equations_of(model: Model, solution: PeriodicSolution) -> tuple[PeriodicEquations, np.ndarray, np.ndarray]:
    """Return equations, parameters and z; raise a ValueError for a solution unconverged or of another model."""
    _checks.instance("model", model, Model)
    _checks.instance("solution", solution, PeriodicSolution)
    if solution.model != model.name:
        raise ValueError(f"model: must be {solution.model!r}, as of the solution, got {model.name!r}.")
    if not solution.converged:
        raise ValueError(
            f"solution: must have converged, got status {solution.status!r}. Solve again from another guess."
        )
    equations = equations_for(model, solution.inputs, **settings_of(solution))
    parameters = np.array([solution.parameters[name] for name in model.parameters])
    return equations, parameters, periodic_part(equations, solution.states)


def periodic_part(equations: PeriodicEquations, states: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return z (points, states) from named states that include their turns."""
    model, grid = equations.model, equations.grid
    _checks.same_names("guess", states, model.states)
    given = [_checks.finite_vector(f"guess[{n!r}]", states[n], grid.points, "samples·periods") for n in model.states]
    z = np.stack(given, axis=-1)
    return equations.reduced(z - equations.drift * grid.tau[:, None])


def as_guess(equations: PeriodicEquations, guess: Mapping[str, np.ndarray] | PeriodicSolution) -> np.ndarray:
    """Return z (points, states) from named states, or from a solution, interpolated and repeated as needed."""
    if not isinstance(guess, PeriodicSolution):
        return periodic_part(equations, guess)
    _checks.same_names("guess", guess.states, equations.model.states)
    if equations.grid.periods % guess.periods:
        raise ValueError(
            f"guess: must be a solution whose periods divide {equations.grid.periods}, got one of {guess.periods}."
        )
    z = np.stack([guess.states[name] - guess._turns(name) for name in equations.model.states])
    times = equations.grid.periods // guess.periods
    if guess.samples != equations.grid.samples:
        z = _fourier.on_grid(_fourier.coefficients(z), equations.grid.samples * guess.periods)
    return equations.reduced(np.ascontiguousarray(np.tile(z, times).T))


def by_name(values: np.ndarray, rows: tuple[str, ...], directions: tuple[str, ...]) -> dict[str, dict[str, np.ndarray]]:
    """Return the columns of values (directions, points, rows) by row and direction."""
    return {row: {name: values[d, :, r].copy() for d, name in enumerate(directions)} for r, row in enumerate(rows)}


def multiplier_sensitivities(model: Model, solution: PeriodicSolution) -> dict[str, np.ndarray]:
    r"""Return ∂multiplier/∂parameter, and for a driven model ∂multiplier/∂frequency [per Hz].

    .. math::

        \mathrm{d} \log \mu = \int \frac{w^T \, \mathrm{d}A \, v}{w^T v} \, \mathrm{d}t

    over the response period, with the eigenfunctions v of the linearised equations ẏ = A y and w of their adjoint; dA
    holds the direct change and that through the orbit. A multiplier that occurs twice has no derivative, and the result
    is not finite or large there.

    Parameters
    ----------
    model : Model
        That of the solution.
    solution : PeriodicSolution
        A converged one.

    Returns
    -------
    dict of str to complex array (multipliers,)
        In the order of ``solution.multipliers``.

    Raises
    ------
    ValueError
        If the solution has not converged, is singular or of another model.

    Examples
    --------
    The product of the multipliers is exp(−c/m · period), by Liouville's formula:

    >>> by_parameter = bp.multiplier_sensitivities(bp.models.duffing, solution)
    >>> bool(np.isclose(sum(by_parameter["c"] / solution.multipliers), -10.0))
    True
    """
    if isinstance(model, CondensedModel):
        raise model.refusal()
    equations, theta, z = equations_of(model, solution)
    derivative = equations.parameter_sensitivities(z, theta)
    if solution.floquet is None or derivative is None:
        raise ValueError("solution: must be regular, got singular linearised equations. Change a parameter slightly.")
    if solution.floquet.reduced:
        raise ValueError(
            "solution: must be of a model without algebraic equations, got a singular matrix of the highest "
            "derivatives. Eliminate a state, or take differences of `multipliers` at two parameter values."
        )
    names = [*model.parameters, FREQUENCY][: len(derivative.frequency)]
    directions = np.eye(len(names), theta.size)
    frequency = derivative.frequency if model.autonomous else np.eye(len(names))[-1]
    logarithmic = logarithmic_jacobian(equations, theta, z, solution, derivative.states, directions, frequency)
    return {name: solution.multipliers * row for name, row in zip(names, logarithmic, strict=True)}


def logarithmic_jacobian(
    equations: PeriodicEquations,
    theta: np.ndarray,
    z: np.ndarray,
    solution: PeriodicSolution,
    states: np.ndarray,
    directions: np.ndarray,
    frequency: np.ndarray,
    count: int | None = None,
) -> np.ndarray:
    """Return the derivatives of log μ along directions, complex (directions, multipliers).

    A direction is a change of z (`states`, (directions, points, states)), of the parameters (`directions`, (directions,
    parameters)) and of the frequency (directions,) [Hz]. Only the `count` largest multipliers are considered, or all.
    """
    assert solution.floquet is not None
    model, orders, sizes = equations.model, tuple(solution.orders.values()), solution._sizes()
    v, w = solution.floquet.leading(len(solution.multipliers) if count is None else count)
    v, w = v * sizes, w / sizes
    matrix, jacobian = first_order_matrix(solution.linearisation, orders), solution.linearisation
    left, right = derivative_factors(jacobian, orders, matrix, v, w)
    overlap = np.einsum("mnp,mnp->mn", w, v)
    stretching = np.einsum("mnp,npq,mnq->mn", w, matrix, v)
    state_rates, input_rates = equations.frequency_jacobian(z)
    moved = equations.changes(states)
    here, change = equations.states(z), np.empty((len(z), jacobian[0].size))
    result = np.empty((len(directions), len(v)), dtype=complex)
    for d, direction in enumerate(directions):
        model.jacobian_change(
            np.ascontiguousarray(np.concatenate([here, moved[d] + frequency[d] * state_rates], axis=1)),
            np.ascontiguousarray(np.concatenate([equations.inputs, frequency[d] * input_rates], axis=1)),
            np.concatenate([theta, direction, frequency[d : d + 1]]),
            equations.grid.tau,
            equations.frequency,
            change,
        )
        rates = np.einsum("mne,nej,mnj->mn", left, change.reshape(jacobian.shape), right, optimize=True)
        rates -= frequency[d] / equations.frequency * stretching
        result[d] = solution.period * (rates / overlap).mean(axis=1)
    return result
